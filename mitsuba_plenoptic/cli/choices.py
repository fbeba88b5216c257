"""Choices and defaults that the help of commands shows, written out, so that no help waits for the library.

``tests/cli/test_choices.py`` compares them with those of the library.
"""

MODELS = ("ray", "wave")
AGAINST = ("ordinary",)
UNITS = ("mm", "cm", "m")
VIEW_METHODS = ("shift", "fourier")
AXES = ("horizontal", "vertical")
EXAMPLES = ("letters-ray", "letters-wave", "white")
MOSAICS = ("RGGB", "GRBG", "GBRG", "BGGR")
ALL_MOSAICS = ("RGGB", "GRBG", "GBRG", "BGGR", "QUAD_RGGB", "QUAD_GRBG", "QUAD_GBRG", "QUAD_BGGR")
RAW_SUFFIXES = (".png", ".tif", ".tiff")
PICTURES = (".exr", ".png", ".pdf")
ANIMATED = (".gif",)
LIGHT_FIELDS = (".nc", ".zarr", ".mat", ".eslf.png", ".png")
VOLUMES = (".tif", ".tiff", ".zarr")
QUANTITIES = ("depth", "virtual_depth", "position", "normal", "albedo", "shape_index")
