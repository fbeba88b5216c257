"""Light fields of the benchmark in the folders of the 4D Light Field Benchmark, for programs that read these.

Honauer, Johannsen, Kondermann and Goldluecke 2016, "A dataset and evaluation methodology for depth estimation on 4D
light fields": views ``input_Cam000.png`` row by row, ``parameters.cfg``, and the depth (metres) and disparity (pixels
from view to view, positive for what is nearer than the plane in focus) of the central view as PFM. A decoded light
field is such an array of cameras on the pupil, one step of views apart, with sensors as far behind it as the microlens
array and as large, shifted so that the plane in focus stays in place.
"""

from __future__ import annotations

import configparser
import io
import json
from pathlib import Path

import numpy as np
import xarray as xr

from ..camera import PlenopticCamera
from ..errors import refuse_if, require_choice
from ..io.files import atomic_output, write_text
from ..lightfield import decode, disparity
from ..lightfield.exchange.hci import PARAMETERS, SECTION
from ..lightfield.geometry import camera_of
from ..report.images import Brightness, write_png
from .contents import CAPTURES, Benchmark, capture_of, central_truth


def export_hci(made: Benchmark, folder: str | Path, capture: str = "ray") -> list[Path]:
    """Write the light fields that are decoded from captures of a kind, each to a folder of its own.

    In mirrors the depth is that of the mirror image. Views at the rim of the pupil, which it covers in part, are left
    out: there are as many as fit into the pupil as a square.

    Parameters
    ----------
    made : Benchmark
        The benchmark.
    folder : path
        Where folders ``SCENE_CAMERA_CAPTURE`` are written.
    capture : str
        Kind of captures.

    Returns
    -------
    list of Path
        The folders.

    Raises
    ------
    InputError
        If there is no such kind of captures, or a file cannot be written.
    """
    require_choice("capture", capture, CAPTURES)
    written = []
    for index in made.entries():
        sample = made[index]
        recorded = capture_of(sample, capture)
        lf = decode(recorded, white=made.white(index, recorded.model))
        depth = central_truth(sample)["virtual_depth"]
        place = Path(folder) / "_".join([*made.name(index), capture])
        version = str(made.manifest["recipe"]["benchmark"])
        write_hci(place, lf, depth, name="_".join(made.name(index)), version=version, white=1.0)
        written.append(place)
    return written


def write_hci(
    folder: Path,
    lf: xr.DataArray,
    depth: np.ndarray | None,
    *,
    name: str,
    version: str = "",
    white: float | None = None,
) -> int:
    """Write a light field to a folder of the 4D Light Field Benchmark, and return how many views stand in a row.

    The depth in millimetres of the central view, where it is known, is written, too. The value `white` is white in the
    pictures, by default that of any other picture.
    """
    camera = camera_of(lf)
    refuse_if(not camera.lens_data.converges, "light field: its camera has no plane at a distance; save it as .nc")
    middle = lf.sizes["v"] // 2
    half = min(int(camera.aperture_radius / (np.sqrt(2) * camera.pupil_step)), middle)
    lf = lf.isel({axis: slice(middle - half, middle + half + 1) for axis in ("v", "u")})
    white = Brightness().white([lf.values]) if white is None else white
    folder.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(lf.values.reshape(-1, *lf.shape[2:])):
        colours = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
        write_png(folder / f"input_Cam{number:03d}.png", colours, peak=white)
    shifts = (0.0, 0.0)
    if depth is not None:
        shift = -np.reshape([disparity(lf, distance) for distance in depth.ravel()], depth.shape)
        for kind, values in (("gt_depth_lowres", depth / 1000), ("gt_disp_lowres", shift)):
            _write_pfm(folder / f"{kind}.pfm", values)
        shifts = (float(np.nanmin(shift)), float(np.nanmax(shift)))
    ours = {"camera": json.dumps(camera.to_dict()), "white": f"{white:.9g}", "channels": str(3 if lf.ndim == 5 else 1)}
    _write_parameters(folder / PARAMETERS, camera, name, version, shifts, 2 * half + 1, ours)
    return 2 * half + 1


def _write_parameters(
    path: Path,
    camera: PlenopticCamera,
    name: str,
    version: str,
    shifts: tuple[float, float],
    views: int,
    ours: dict[str, str],
) -> None:
    """Write the geometry of the cameras, of which `views` stand in a row, and what only this package reads."""
    columns, rows = camera.bin_count
    low, high = shifts
    parser = configparser.ConfigParser(interpolation=None)
    parser["intrinsics"] = {
        "image_resolution_x_px": str(columns),
        "image_resolution_y_px": str(rows),
        "focal_length_mm": f"{camera.mla_distance:.9g}",
        "sensor_size_mm": f"{max(columns, rows) * camera.mla_pitch:.9g}",
        "fstop": "100",
    }
    parser["extrinsics"] = {
        "num_cams_x": str(views),
        "num_cams_y": str(views),
        "baseline_mm": f"{camera.pupil_step:.9g}",
        "focus_distance_m": f"{camera.focus_distance / 1000:.9g}",
        **{f"center_cam_{axis}": "0" for axis in ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")},
    }
    parser["meta"] = {
        "scene": name,
        "category": "plenoptic",
        "date": "",
        "version": version,
        "authors": "mitsuba_plenoptic",
        "contact": "",
        "disp_min": f"{low:.6g}",
        "disp_max": f"{high:.6g}",
        "frustum_disp_min": f"{low:.6g}",
        "frustum_disp_max": f"{high:.6g}",
        "depth_map_scale": "1",
    }
    parser[SECTION] = ours
    text = io.StringIO()
    parser.write(text)
    write_text(path, text.getvalue())


def _write_pfm(path: Path, values: np.ndarray) -> None:
    """Write a map as a portable float map, which begins with the lowest row."""
    rows, columns = values.shape
    with atomic_output(path, ".pfm") as temporary:
        temporary.write_bytes(f"Pf\n{columns} {rows}\n-1\n".encode() + np.flipud(values).astype("<f4").tobytes())
