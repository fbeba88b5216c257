"""Source files of the viewer, recognised by suffix and, for OpenEXR, by the kind stated in the header."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr

from ... import choices
from ...camera import PlenopticCamera
from ...errors import InputError, naming, refuse_if, require_number
from ...io import Capture, read_attributes, read_capture, read_exr, read_exr_parts, read_picture
from ...runtime import Array
from ...views import open_light_field, read_recording
from .viewer import Recording, decoded


def read_source(
    path: str | Path, *, white: str | Path | None, views: int | None, linear: bool, camera: PlenopticCamera | None
) -> Recording | xr.DataArray | xr.Dataset:
    """Return the recording, focal stack or depth map that a source file of the viewer contains.

    OpenEXR holds a capture, a focal stack, a reconstruction or a depth map of this package, other files what
    `open_light_field` reads, whose options these are.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    kind = read_attributes(path).get("kind") if suffix == ".exr" else None
    if isinstance(kind, str) and kind in _COMPUTED:
        with naming(path):
            return _COMPUTED[kind](path)
    if suffix == ".exr":
        capture = read_capture(path, camera=camera)
        lens = capture.camera.lens_data
        if not lens.is_thin and not lens.images_stop and views is None:
            reference = None if white is None else read_recording(white, linear)
            lf = decoded(capture, reference.image if isinstance(reference, Capture) else reference)
            return Recording.of(capture, path.stem, lf)
    lf = open_light_field(path, white=white, views=views, linear=linear, camera=camera)
    if suffix == ".exr":
        return Recording.of(capture, path.stem, lf)
    # Raw pictures were decoded; of mosaics and light fields there is no raw picture.
    raw = read_picture(path, linear=linear) if lf.attrs.get("grid") and suffix in choices.RAW_SUFFIXES else None
    return Recording(path.stem, lf, raw)


def _stack(path: Path) -> xr.DataArray:
    """Read a focal stack that `write_stack` wrote."""
    parts, attributes = read_exr_parts(path)
    distances = attributes.get("coordinates", {}).get("distance")
    if not isinstance(distances, list) or len(distances) != len(parts):
        raise InputError("its header does not state the distance of each image")
    return _planes([_image(image) for image in parts.values()], distances, "shifted views")


def _reconstruction(path: Path) -> xr.DataArray:
    """Read a reconstruction that `write_reconstruction` wrote as a stack of one image."""
    image, _, attributes = read_exr(path)
    return _planes([image], [attributes.get("distance")], str(attributes.get("method", "reconstruction")))


def _planes(images: list[Array], distances: list, method: str) -> xr.DataArray:
    """Return images as a focal stack."""
    values = [require_number("distance", value, positive=True, finite=False) for value in distances]
    refuse_if(len({image.shape for image in images}) > 1, "all of its images must be of one size")
    dims = ("distance", "t", "s", "c")[: 1 + images[0].ndim]
    return xr.DataArray(np.stack(images), dims=dims, coords={"distance": values}, attrs={"method": method})


def _depth(path: Path) -> xr.Dataset:
    """Read a depth map that `write_depth` wrote."""
    parts, _ = read_exr_parts(path)
    names = "depth", "confidence", "image"
    for name in names:
        refuse_if(name not in parts, f"it has no part {name}")
    images = {name: _image(parts[name]) for name in names}
    return xr.Dataset({name: (("t", "s", "c")[: image.ndim], image) for name, image in images.items()})


def _image(channels: dict[str, Array]) -> Array:
    """Return the image of a part, whose channels are Y, or R, G and B."""
    if set(channels) == {"Y"}:
        return channels["Y"]
    if set(channels) == set("RGB"):
        return np.stack([channels[name] for name in "RGB"], axis=-1)
    raise InputError(f"it has the channels {', '.join(channels)} instead of Y or R, G, B")


_COMPUTED: dict[str, Callable[[Path], xr.DataArray | xr.Dataset]] = {
    "focal stack": _stack,
    "reconstruction": _reconstruction,
    "depth": _depth,
}
