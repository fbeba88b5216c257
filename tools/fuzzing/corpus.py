"""Whole files and captures, from which the bad ones are made."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import OpenEXR
import xarray as xr

from mitsuba_plenoptic import Capture, PlenopticCamera, decode, reconstruct, write_capture
from mitsuba_plenoptic.lightfield import white_image
from mitsuba_plenoptic.lightfield.exchange import write_lftoolbox, write_mosaic
from mitsuba_plenoptic.reconstruction import write_reconstruction
from mitsuba_plenoptic.report.output_files import write_views

SCENE = """<?xml version="1.0" encoding="utf-8"?>
<scene version="3.0.0">
    <default name="resolution" value="16"/>
    <default name="kind" value="path"/>
    <default name="mesh" value="square.ply"/>
    <integrator type="$kind">
        <integer name="max_depth" value="2"/>
    </integrator>
    <sensor type="plenoptic">
        <float name="focal_length" value="80"/>
        <float name="detector_width" value="0.128"/>
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resolution"/>
            <integer name="height" value="$resolution"/>
            <string name="pixel_format" value="luminance"/>
            <string name="component_format" value="float32"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <shape type="ply">
        <string name="filename" value="$mesh"/>
        <bsdf type="diffuse"><texture type="bitmap" name="reflectance">
            <string name="filename" value="dots.png"/>
        </texture></bsdf>
    </shape>
    <emitter type="constant"/>
</scene>
"""

PLY = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
-50 -50 240
50 -50 240
0 50 240
3 0 2 1
"""


@cache
def camera() -> PlenopticCamera:
    """Four lenses of sixteen pixels along each axis."""
    return PlenopticCamera(resolution=(64, 64), detector_width=0.256)


@cache
def capture(channels: int = 1) -> Capture:
    """Make a textured white image."""
    image = white_image(camera()) * np.random.default_rng(0).random((64, 64), dtype=np.float32)
    wavelength = 633.0
    if channels == 3:
        image = np.stack([image, image / 2, image / 4], axis=-1)
    return Capture(image, camera(), wavelength, "wave", {"seed": 0, "scene": "white.xml"})


@cache
def light_field(channels: int = 1) -> xr.DataArray:
    """Decode the capture."""
    return decode(capture(channels))


@cache
def files() -> dict[str, bytes]:
    """Files by name."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_capture(folder / "grey.exr", capture())
        write_capture(folder / "colour.exr", capture(3))
        write_reconstruction(folder / "refocused.exr", reconstruct(capture(), 240.0))
        write_views(folder / "views.exr", light_field()[6:8, 6:8])
        plain = {"Y": np.ones((64, 64), np.float32)}
        OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION}, plain).write(str(folder / "foreign.exr"))
        for precision in ("uint8", "uint16", "single"):
            write_lftoolbox(folder / f"{precision}.mat", light_field(3), precision=precision)
        write_mosaic(folder / "views.png", light_field(), layout="views")
        write_mosaic(folder / "lenses.eslf.png", light_field(3), layout="lenses")
        _write_version_7(folder / "version7.mat")
        return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def _write_version_7(path: Path) -> None:
    """Make a file as MATLAB writes it with -v7.3: HDF5 after a text of 512 bytes."""
    with h5py.File(path, "w", userblock_size=512) as file:
        numbers = np.transpose((light_field(3).values * 65535).astype(np.uint16))
        file.create_dataset("LF", data=numbers, chunks=True, compression="gzip")
        file["MaxLum"] = np.ones((1, 1))
        grid = file.create_group("LensletGridModel")
        for name, value in (("HSpacing", 16.0), ("VSpacing", 16.0), ("HOffset", 8.0), ("VOffset", 8.0), ("Rot", 0.0)):
            grid[name] = np.full((1, 1), value)
        for name, value in (("UMax", 4.0), ("VMax", 4.0), ("FirstPosShiftRow", 5.0)):
            grid[name] = np.full((1, 1), value)
        grid["Orientation"] = np.array([[ord(c)] for c in "horz"], dtype=np.uint16)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
