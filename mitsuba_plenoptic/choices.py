"""Words and suffixes of files that users choose from, each once: for the library's checks, and for help without it."""

from typing import Literal, get_args

Model = Literal["ray", "wave"]
"""How light propagates."""

MODELS: tuple[Model, ...] = get_args(Model)

Unit = Literal["mm", "cm", "m"]
"""Unit of a scene's lengths."""

Axis = Literal["horizontal", "vertical"]
"""Direction of a line in the scene."""

Example = Literal["letters-ray", "letters-wave", "white"]
"""Captures that come with the package: the letters by both models, and a luminous wall by the same camera."""

Against = Literal["ordinary"]
"""Cameras against which a comparison can set the scene's camera: one without a microlens array."""

Mosaic = Literal["RGGB", "GRBG", "GBRG", "BGGR"]
"""Bayer's mosaic and its turns (Bayer 1976, US patent 3971065), by the filters of the first two rows of two pixels."""

MOSAICS: tuple[Mosaic, ...] = get_args(Mosaic)

AnyMosaic = Literal[Mosaic, "QUAD_RGGB", "QUAD_GRBG", "QUAD_GBRG", "QUAD_BGGR"]
"""Those, and quad mosaics, each of whose filters covers 2 x 2 pixels."""

QUANTITIES = {
    "depth": "Z",
    "virtual_depth": "Z",
    "position": "XYZ",
    "normal": "XYZ",
    "albedo": "RGB",
    "shape_index": "I",
}
"""Quantities of ground truth, of the point that a ray meets, with their channels."""

LYTRO_SUFFIXES = (".lfp", ".lfr", ".raw")
"""Of raw pictures of Lytro cameras; a file ``.raw`` has its metadata in a text file of the same name."""

RAW_SUFFIXES = (".png", ".tif", ".tiff", ".bmp")
"""Of raw pictures."""

PICTURES = (".exr", ".png", ".pdf")
"""Of one picture, or of the values that it shows."""

ANIMATED = (".gif",)

LIGHT_FIELDS = (".nc", ".zarr", ".mat", ".eslf.png", ".png")
"""Of light fields to write; ``.mat`` belongs to an extension."""

VOLUMES = (".tif", ".tiff", ".zarr")
