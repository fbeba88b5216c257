"""Light fields by file name: the reader and writer for each suffix."""

import math
from pathlib import Path

import xarray as xr

from ..camera import PlenopticCamera, are_alike
from ..choices import LIGHT_FIELDS, RAW_SUFFIXES
from ..errors import InputError, argument, content_of, naming, refuse_if
from ..extension import format_of, place
from ..io import (
    TRUTH_NAME,
    TRUTH_SUFFIX,
    Capture,
    GroundTruth,
    read_attributes,
    read_capture,
    read_ground_truth,
    read_labelled_data,
    read_numbers,
    read_picture,
    read_pixels,
    states_detector,
    write_labelled_data,
)
from ..runtime import Array, require_writable
from .coordinates import camera_of, light_field, require_light_field
from .decoding import decode
from .grid import bin_grid
from .grid_estimation import estimate_lens_grid
from .lens_images import MicroImages, micro_images
from .mosaics import read_mosaic, stated_mosaic, write_mosaic

# The suffix that LFToolbox gives to pictures with the samples of each lens together.
_LENSES = ".eslf.png"

HCI = "parameters.cfg"
"""File in each folder of the 4D Light Field Benchmark, which belongs to an extension."""


def open_light_field(
    path: str | Path,
    *,
    white: str | Path | None = None,
    views: int | None = None,
    linear: bool = False,
    camera: PlenopticCamera | None = None,
    truth: str | Path | bool = False,
) -> xr.DataArray:
    """Return a light field read from a file, or decoded from a capture.

    Parameters
    ----------
    path : path
        ``.exr``: a capture of this package; ``.nc``, ``.zarr``: a light field with its axes, weights and camera, as
        `save_light_field` writes it; ``.mat``: a light field of LFToolbox; a folder with ``parameters.cfg``: one of the
        4D Light Field Benchmark (HCI); ``.eslf.png`` with `views`: samples of each lens together; ``.png`` with
        `views`: a mosaic of views (both without `views` if `save_light_field` wrote them); ``.png`` or ``.tiff`` with
        `white` or `camera`: a raw picture of a plenoptic camera.
    white : path, optional
        A picture of something white by the same camera, ``.exr``, ``.png`` or ``.tiff``. For a capture of this package
        it replaces the computed one; for a raw picture it shows where the micro-images are.
    views : int, optional
        Views along each axis of a mosaic.
    linear : bool
        Whether pictures hold values proportional to light, as raw data does, instead of sRGB.
    camera : PlenopticCamera, optional
        The camera of a raw picture or of a light field's mosaic of lenses, or another one than a capture's. With it
        distances are in millimetres.
    truth : path or bool
        Ground truth of a capture, for `decode`. True: the file that the capture names, if it lies in the same folder.
    """
    path = Path(path)
    name = path.name.lower()
    if views is not None:
        _refuse(path, camera=None if camera is None else "given")
    refuse_if(
        white is not None and views is not None, f"{path}: a white image and a number of views exclude each other"
    )
    if not any(str(source).lower().endswith(RAW_SUFFIXES) for source in (path, white)):
        _refuse(path, linear=linear or None)
    if name.endswith(".exr"):
        _refuse(path, views=views)
        capture = read_capture(path, camera=camera)
        ground_truth = _ground_truth(path, capture, truth) if camera is None or not isinstance(truth, bool) else None
        by = None if white is None else read_recording(white, linear, camera)
        return decode(capture, camera=camera, white=by, truth=ground_truth)
    _refuse(path, truth=None if isinstance(truth, bool) else truth)
    key = HCI if (path / HCI).is_file() else path.suffix.lower()
    if (of_extension := format_of(key, "light field", str(path))) or name.endswith((".nc", ".zarr")):
        _refuse(path, white=white, views=views)
        lf = place(*of_extension)(path) if of_extension else read_labelled(path)
        return lf if camera is None else of_camera(lf, camera, path)
    if name.endswith(RAW_SUFFIXES):
        picture = read_numbers(path) if camera is None and white is None else None
        stated = picture and stated_mosaic(picture)
        if stated or views is not None:
            count, layout = stated or (views, "lenses" if name.endswith(_LENSES) else "views")
            rule = f"{path} states {count} views along each axis; leave it out"
            refuse_if(views not in (None, count), f"{argument('views')} = {views}: {rule}")
            return read_mosaic(path, int(count or 0), layout=layout, linear=linear)
        reference = None if white is None else read_recording(white, linear)
        # Pictures have no camera, by which a white capture could be refused.
        reference = reference.image if isinstance(reference, Capture) else reference
        if camera is not None or (path.is_file() and states_detector(read_numbers(path))):
            return decode(read_capture(path, camera=camera, linear=linear), white=reference)
        if reference is None:
            raise InputError(
                f"{path}: give {argument('white')} or {argument('camera')} for a raw picture, or {argument('views')} "
                "for a mosaic of views"
            )
        return decode(read_picture(path, linear=linear), white=reference, grid=estimate_lens_grid(reference))
    refuse_if(
        format_of(path.suffix.lower(), "capture", str(path)),
        f"{path}: a raw picture of such a camera is a mosaic of colours; demosaic it first",
    )
    raise InputError(
        f"{path}: it is {content_of(path)}{_step(path)}; a capture or light field is a folder with {HCI}, or has a "
        f"name that ends in .exr, {', '.join(LIGHT_FIELDS)}, .tiff or .bmp"
    )


def of_camera(lf: xr.DataArray, camera: PlenopticCamera, path: Path) -> xr.DataArray:
    """Return a light field with the camera that its mosaic of lenses was calibrated as."""
    bins = bin_grid(camera)
    v, u, t, s = lf.shape[:4]
    refuse_if(
        bins.shape != (t, s) or camera.crop_size != (s * u, t * v),
        f"{path}: its mosaic of lenses has {s * u} x {t * v} pixels, the camera's picture {camera.crop_size}",
    )
    return light_field(lf.values, lf["weight"].values, camera, bins, white=lf["white"].values)


def _step(path: Path) -> str:
    """Return how a folder of pictures, or an HDF5 file, becomes a mosaic of views."""
    pictures = [file for file in path.iterdir() if file.suffix.lower() in RAW_SUFFIXES] if path.is_dir() else []
    if pictures:
        return (
            f" of {len(pictures)} pictures: if they are views, join them (ImageMagick: montage *{pictures[0].suffix} "
            f"-tile {math.isqrt(len(pictures))}x -geometry +0+0 views.png), and give views.png with {argument('views')}"
        )
    if path.suffix.lower() not in (".h5", ".hdf5"):
        return ""
    return (
        ": the views of an old file of HCI are a mosaic, v, u, rows, columns, colours = LF.shape; PIL.Image.fromarray("
        "LF[()].swapaxes(1, 2).reshape(v * rows, u * columns, colours)).save('views.png'); give views.png with "
        f"{argument('views')}"
    )


def open_micro_images(
    path: str | Path, *, white: str | Path | None, linear: bool, camera: PlenopticCamera | None
) -> MicroImages | None:
    """Return the micro-images in a capture's file, for depth maps of focused cameras; None for other cameras.

    Parameters
    ----------
    path, white, linear, camera
        As for `open_light_field`.

    Returns
    -------
    MicroImages or None
        None if the file is no capture of this package: light fields have no micro-images any more.
    """
    path = Path(path)
    if path.suffix.lower() != ".exr":
        return None
    by = None if white is None else read_recording(white, linear, camera)
    return micro_images(read_capture(path, camera=camera), camera=camera, white=by)


def save_light_field(path: str | Path, lf: xr.DataArray) -> None:
    """Write a light field to a file, in a format of this package or of another program.

    Parameters
    ----------
    path : path
        ``.nc`` or ``.zarr``: NetCDF or Zarr, with axes, weights and camera; ``.mat``: LFToolbox; ``.eslf.png``:
        samples of each lens together; ``.png``: a mosaic of views.
    lf : xarray.DataArray
        The light field.
    """
    name = require_writable(path, *LIGHT_FIELDS).name.lower()
    if name.endswith((".nc", ".zarr")):
        write_labelled(path, lf)
    elif of_extension := format_of(Path(path).suffix.lower(), "light field", str(path), write=True):
        place(*of_extension)(path, lf)
    else:
        write_mosaic(path, lf, layout="lenses" if name.endswith(_LENSES) else "views")


def _ground_truth(path: Path, capture: Capture, truth: str | Path | bool) -> GroundTruth | None:
    """Return the ground truth of a capture, from a given file or the capture's own; None if there is none."""
    if not isinstance(truth, bool):
        return read_ground_truth(truth)
    name = capture.metadata.get(TRUTH_NAME)
    # A name from a file leads nowhere but to its own folder.
    if not truth or not isinstance(name, str) or Path(name).name != name or not name.endswith(TRUTH_SUFFIX):
        return None
    if not (path.parent / name).is_file():
        return None
    stored = read_ground_truth(path.parent / name)
    return stored if are_alike(stored.camera, capture.camera) else None


def read_recording(path: str | Path, linear: bool, camera: PlenopticCamera | None = None) -> Capture | Array:
    """Read a capture with its camera, or a given one instead, or the pixels of another program's picture."""
    if Path(path).suffix.lower() in RAW_SUFFIXES:
        return read_picture(path, linear=linear)
    return read_capture(path, camera=camera) if read_attributes(path) else read_pixels(path)


def _refuse(path: Path, **options: object) -> None:
    for name, value in options.items():
        refuse_if(value is not None, f"{name} = {value}: of no use for {path}")


def write_labelled(path: str | Path, lf: xr.DataArray) -> None:
    """Write a light field to a file that `read_labelled` or ``xarray.open_dataarray`` opens.

    Parameters
    ----------
    path : path
        A name that ends in ``.nc`` for NetCDF 3, or in ``.zarr`` for a folder of Zarr, which needs the package zarr.
    lf : xarray.DataArray
        The light field.
    """
    lf = require_light_field(lf)
    write_labelled_data(path, lf.to_dataset(name=lf.name or "radiance"))


def read_labelled(path: str | Path) -> xr.DataArray:
    """Read a light field that `write_labelled` wrote.

    NetCDF 4 is not read. A file of this package states a digest of its values and attributes, which is checked.

    Parameters
    ----------
    path : path
        The file.
    """
    data = read_labelled_data(path, "light field")
    with naming(path):
        refuse_if(len(data.data_vars) != 1, f"it holds the variables {', '.join(map(str, data.data_vars))}, not one")
        lf = require_light_field(next(iter(data.data_vars.values())))
        if lf.attrs.get("camera"):
            camera_of(lf)
    return lf
