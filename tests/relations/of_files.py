"""Relations of files: what is written in each format of captures, light fields and volumes is read again."""

import importlib.util
import tempfile
from pathlib import Path

import numpy as np
import tifffile
import xarray as xr
from relation import relation

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import choices, exchange
from mitsuba_plenoptic.camera.entry import Use
from mitsuba_plenoptic.refocus.results import Volume, write_volume

STEP = 1.15 / 65535
"""Half of one of the sixteen bits of pictures, in sRGB at its steepest."""

FORMATS = {
    "capture": [".exr", *choices.RAW_SUFFIXES[:3]],
    "light field": [each for each in choices.LIGHT_FIELDS if each != ".zarr" or importlib.util.find_spec("zarr")],
    "volume": [*(each for each in choices.VOLUMES if each != ".zarr" or importlib.util.find_spec("zarr")), ".ome.tif"],
}
"""Suffixes that are written; Zarr needs a package that is not always installed."""


def chosen(draw, kind):
    """Return the suffix of a file of a kind, and note it for the coverage."""
    draw.format = f"{kind} {draw.rng.choice(FORMATS[kind])}"
    return draw.format.removeprefix(f"{kind} ")


def greatest(one, other):
    """Return the greatest difference, infinite where shapes or missing values differ."""
    one, other = np.asarray(one, float), np.asarray(other, float)
    if one.shape != other.shape or np.any(np.isnan(one) != np.isnan(other)):
        return np.inf
    return float(np.nanmax(np.abs(one - other), initial=0.0))


@relation(Use.RAYS, method="files of captures")
def capture_files(draw):
    """A capture that is written and read is the same, with its camera; raw pictures have the detector's numbers."""
    camera, suffix = draw.camera, chosen(draw, "capture")
    capture = mp.Capture(draw.rng.random(camera.shape, np.float32), camera)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"capture{suffix}"
        if suffix == ".exr":
            mp.write_capture(path, capture)
        else:
            capture = mp.expose(capture, photons=1000.0, seed=1)
            mp.write_raw(path, capture)
        read = mp.read_capture(path)
    same = read.camera.to_dict() == camera.to_dict()
    return (greatest(read.image, capture.image) if same else np.inf), 1e-6


@relation(Use.DECODING, method="files of light fields")
def light_field_files(draw):
    """A light field that is written and read has the same samples, in sixteen bits of pictures; NetCDF all of it."""
    suffix = chosen(draw, "light field")
    lf = mp.decode(draw.rng.random(draw.camera.shape, np.float32), camera=draw.camera)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"views{suffix}"
        exchange.save_light_field(path, lf)
        read = exchange.open_light_field(path)
        if suffix in (".nc", ".zarr"):
            xr.testing.assert_identical(read, lf)
    values, peak = np.nan_to_num(lf.values), float(np.nanmax(lf.values))
    return greatest(np.squeeze(read.values) * (peak / np.nanmax(read.values)), values) / peak, STEP


@relation(Use.RAY_REFOCUSING, method="files of volumes")
def volume_files(draw):
    """A volume that is written is read by tifffile with its values and distances."""
    suffix = chosen(draw, "volume")
    image = draw.rng.random(draw.camera.shape, np.float32)
    distances = np.array([0.97, 0.98, 0.99]) * draw.camera.focus_distance
    volume = Volume.of(mp.reconstruct(image, distances, camera=draw.camera, method="ray"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"volume{suffix}"
        write_volume(path, volume)
        values = xr.open_zarr(path).to_array().values[0] if suffix == ".zarr" else tifffile.imread(path)
    return greatest(values, volume.values), 0.0
