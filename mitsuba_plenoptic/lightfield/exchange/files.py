"""Light fields by file name: which reader and writer a suffix means."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from ...camera import PlenopticCamera
from ...errors import InputError, argument
from ...io.captures import Capture, read_capture
from ...io.files import require_writable
from ...io.ground_truth import NAME, SUFFIX, GroundTruth, read_ground_truth
from .. import MicroImages, decode, estimate_lens_grid, micro_images
from .labelled import read_labelled, write_labelled
from .lftoolbox import read_lftoolbox, write_lftoolbox
from .pictures import TIFF, read_mosaic, read_picture, write_mosaic

# The suffix that LFToolbox gives to pictures with the samples of each lens together.
_LENSES = ".eslf.png"


def open_light_field(
    path: str | Path,
    *,
    white: str | Path | None = None,
    views: int | None = None,
    linear: bool = False,
    camera: PlenopticCamera | None = None,
    truth: str | Path | bool = False,
) -> xr.DataArray:
    """Read a light field, or decode one from a capture.

    Parameters
    ----------
    path : path
        ``.exr``: a capture of this package; ``.nc``, ``.zarr``: a light field with its axes, weights and camera, as
        `save_light_field` writes it; ``.mat``: a light field of LFToolbox; ``.eslf.png`` with `views`: samples
        of each lens together; ``.png`` with `views`: a mosaic of views; ``.png`` or ``.tiff`` with `white` or `camera`:
        a raw picture of some plenoptic camera.
    white : path, optional
        A picture of something white by the same camera, ``.exr``, ``.png`` or ``.tiff``. For a capture of this package
        it replaces the computed one; for a raw picture it shows where the micro-images are.
    views : int, optional
        Views along each axis of a mosaic.
    linear : bool
        Whether pictures hold values proportional to light, as raw data does, instead of sRGB.
    camera : PlenopticCamera, optional
        The camera of a raw picture, or another one than a capture's. With it distances are in millimetres.
    truth : path or bool
        Ground truth of a capture, for `decode`. True: what the capture names, if it lies beside it.

    Raises
    ------
    InputError
        If the name's suffix is unknown, an argument is missing or of no use for this kind of file, or the file
        cannot be read.
    """
    path = Path(path)
    name = path.name.lower()
    if views is not None:
        _refuse(path, camera=None if camera is None else "given")
    if white is not None and views is not None:
        raise InputError(f"{path}: a white image and a number of views exclude each other")
    if not any(str(one).lower().endswith((".png", *TIFF)) for one in (path, white)):
        _refuse(path, linear=linear or None)
    if name.endswith(".exr"):
        _refuse(path, views=views)
        capture = read_capture(path)
        known = _ground_truth(path, capture, truth) if camera is None or not isinstance(truth, bool) else None
        by = None if white is None else _white_capture(white, linear)
        return decode(capture, camera=camera, white=by, truth=known)
    _refuse(path, truth=None if isinstance(truth, bool) else truth)
    if name.endswith(".mat"):
        _refuse(path, white=white, views=views, camera=None if camera is None else "given")
        return read_lftoolbox(path)
    if name.endswith((".nc", ".zarr")):
        _refuse(path, white=white, views=views, camera=None if camera is None else "given")
        return read_labelled(path)
    if name.endswith((".png", *TIFF)):
        if views is not None:
            layout = "lenses" if name.endswith(_LENSES) else "views"
            return read_mosaic(path, views, layout=layout, linear=linear)
        reference = None if white is None else _white(white, linear)
        if camera is not None:
            return decode(read_picture(path, linear=linear), camera=camera, white=reference)
        if reference is None:
            raise InputError(
                f"{path}: give {argument('white')} or {argument('camera')} for a raw picture, or {argument('views')} "
                "for a mosaic of views"
            )
        return decode(read_picture(path, linear=linear), white=reference, grid=estimate_lens_grid(reference))
    raise InputError(f"{path}: a capture or light field has a name that ends in .exr, .nc, .zarr, .mat, .png or .tiff")


def open_micro_images(
    path: str | Path,
    *,
    white: str | Path | None = None,
    linear: bool = False,
    camera: PlenopticCamera | None = None,
) -> MicroImages | None:
    """Sample the micro-images of a capture's file, for the depth maps of focused cameras.

    Parameters
    ----------
    path, white, linear, camera
        As for `open_light_field`.

    Returns
    -------
    MicroImages or None
        None if the file is no capture of this package: light fields have no micro-images any more.

    Raises
    ------
    InputError
        As for `open_light_field`.
    """
    path = Path(path)
    if path.suffix.lower() != ".exr":
        return None
    by = None if white is None else _white_capture(white, linear)
    return micro_images(read_capture(path), camera=camera, white=by)


def save_light_field(path: str | Path, lf: xr.DataArray) -> None:
    """Write a light field to keep, or for another program.

    Parameters
    ----------
    path : path
        ``.nc`` or ``.zarr``: NetCDF or Zarr, with axes, weights and camera; ``.mat``: LFToolbox; ``.eslf.png``:
        samples of each lens together; ``.png``: a mosaic of views.
    lf : xarray.DataArray
        The light field.

    Raises
    ------
    InputError
        If the name's suffix is unknown or the file cannot be written.
    """
    name = require_light_field_path(path).name.lower()
    if name.endswith((".nc", ".zarr")):
        write_labelled(path, lf)
    elif name.endswith(".mat"):
        write_lftoolbox(path, lf)
    else:
        write_mosaic(path, lf, layout="lenses" if name.endswith(_LENSES) else "views")


def require_light_field_path(path: str | Path) -> Path:
    """Check, before a long computation, that a light field can be written there, in a format that the name tells.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        If the name's suffix is unknown or the file cannot be written.
    """
    return require_writable(path, ".nc", ".zarr", ".mat", ".eslf.png", ".png")


def _ground_truth(path: Path, capture: Capture, truth: str | Path | bool) -> GroundTruth | None:
    """Read the ground truth of a capture: a file, or the one that the capture names, if it is there and is its own."""
    if not isinstance(truth, bool):
        return read_ground_truth(truth)
    name = capture.metadata.get(NAME)
    # A name from a file leads nowhere but to its own folder.
    if not truth or not isinstance(name, str) or Path(name).name != name or not name.endswith(SUFFIX):
        return None
    if not (path.parent / name).is_file():
        return None
    found = read_ground_truth(path.parent / name)
    return found if found.camera == capture.camera else None


def _white_capture(path: str | Path, linear: bool) -> Capture | np.ndarray:
    """Read a white capture with its camera, or a picture, which tells none."""
    return read_capture(path) if Path(path).suffix.lower() == ".exr" else read_picture(path, linear=linear)


def _white(path: str | Path, linear: bool) -> np.ndarray:
    """Read a white image."""
    found = _white_capture(path, linear)
    return found.image if isinstance(found, Capture) else found


def _refuse(path: Path, **options: object) -> None:
    for name, value in options.items():
        if value is not None:
            raise InputError(f"{name} = {value}: of no use for {path}")
