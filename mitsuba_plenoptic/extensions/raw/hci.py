"""Folders of the 4D Light Field Benchmark (HCI) as light fields.

A folder has views ``input_Cam000.png`` and so on, row by row, and ``parameters.cfg``. Folders written by this package
have a further section there, with the camera, the radiance of white, and the number of channels, as views are always in
colour.
"""

import configparser
import io
import json
import math
from pathlib import Path

import numpy as np
import xarray as xr

from ...camera import PlenopticCamera
from ...errors import InputError, naming, refuse_if, refusing, require_count, require_number, short_repr, warn
from ...io import read_picture
from ...report import images
from ...runtime import Array, Sizes, atomic_output, read_text, require_memory, write_text
from ...views import bin_grid, camera_of, disparity, light_field, warn_of_dark

PARAMETERS = "parameters.cfg"
SECTION = "mitsuba_plenoptic"

_GEOMETRY = ("focal_length_mm", "sensor_size_mm", "baseline_mm", "focus_distance_m")


def read_hci(folder: str | Path) -> xr.DataArray:
    """Read a light field from a folder of the 4D Light Field Benchmark.

    Parameters
    ----------
    folder : path
        A folder that ``convert --format hci`` or another program wrote.

    Returns
    -------
    xarray.DataArray
        With the camera, in units of its capture, if this package wrote the folder; else from 0 to 1, with the
        plenoptic camera of the same geometry where the parameters state it: its pupil is as wide as the camera array.
        ``disp_min`` and ``disp_max`` are kept, with the sign of `disparity`, as the default search of `depth_map`.
    """
    folder = Path(folder)
    parser = configparser.ConfigParser(interpolation=None)
    text = read_text(folder / PARAMETERS, 2**20)
    with naming(folder / PARAMETERS), refusing("it cannot be read as the parameters of a light field:"):
        parser.read_string(text)
        stated = {name: text for section in parser.sections() for name, text in parser[section].items()}
        columns, rows = (
            require_count(name, _number(stated, name), maximum=1000) for name in ("num_cams_x", "num_cams_y")
        )
        ours = parser.has_section(SECTION)
        camera = PlenopticCamera.from_dict(json.loads(stated["camera"])) if ours else None
        white = require_number("white", _number(stated, "white"), positive=True) if ours else 1.0
        missing = [] if ours else [name for name in _GEOMETRY if name not in stated]
        geometry = [
            require_number(name, _number(stated, name), positive=True, finite=name != _GEOMETRY[-1])
            for name in _GEOMETRY
            if not ours and not missing
        ]
        least, greatest = (
            require_number(name, _number(stated, name)) if name in stated else 0.0 for name in ("disp_min", "disp_max")
        )
        grey = ours and stated["channels"] == "1"
    if missing:
        warn(
            f"{folder / PARAMETERS}: it has no {', '.join(missing)}: without it the light field has no camera, and "
            "disparities in pixels per view take the place of distances"
        )
    views: list[Array] = []
    for index in range(rows * columns):
        path = folder / f"input_Cam{index:03d}.png"
        picture = read_picture(path)
        if not views:
            # Bytes of a value of three channels while views are gathered and checked.
            require_memory(24.0 * rows * columns * picture[..., :1].size, f"{folder}: a light field")
        refuse_if(
            bool(views) and picture.shape != views[0].shape,
            f"{path}: it has the shape {picture.shape}, the views before {views[0].shape if views else ()}",
        )
        views.append(picture)
    values = np.stack(views).reshape(rows, columns, *views[0].shape) * np.float32(white)
    values = np.ascontiguousarray(values[..., 0]) if grey and values.ndim == 5 else values
    if geometry:
        with naming(folder / PARAMETERS):
            camera = _camera_of_array(geometry, values.shape)
    bins = None if camera is None else bin_grid(camera)
    if bins is not None and bins.shape != values.shape[2:4]:
        raise InputError(
            f"{folder}: its views of {values.shape[2:4]} pixels do not fit its camera of {bins.shape} lenses"
        )
    lf = light_field(values, None, camera, bins)
    # HCI's disparities are positive nearer.
    range_of_scene = {"least": -greatest, "greatest": -least}
    return lf.assign_attrs(disparities=json.dumps(range_of_scene)) if least < greatest else lf


def _number(stated: dict[str, str], name: str) -> float:
    """Return a number that parameters state by its name."""
    refuse_if(name not in stated, f"{name}: it is missing")
    with refusing(f"{name} = {short_repr(stated[name])}: it must be a number", ValueError):
        return float(stated[name])


def _camera_of_array(geometry: list[float], shape: Sizes) -> PlenopticCamera:
    """Return the plenoptic camera that sees views (v, u, t, s) as a rectified array of pinhole cameras does."""
    focal_length, sensor, baseline, focus = geometry
    views = max(shape[:2])
    most = max(shape[2:4])
    # Only the ratio of the focal length and the sensor counts. Lenses this small have micro-images centred behind them.
    pitch = min(sensor, views * baseline / 8) / most
    b = focal_length * pitch * most / sensor
    z = b * pitch / (views * baseline - pitch)
    return PlenopticCamera(
        focal_length=1 / (1 / b + 1 / (1000 * focus)),
        focus_distance=1000 * focus,
        # All of the square of cameras.
        aperture_radius=views * baseline / math.sqrt(2),
        mla_pitch=pitch,
        mla_focal_length=z,
        detector_distance=z,
        detector_width=shape[3] * views * baseline * z / b,
        resolution=(shape[3] * views, shape[2] * views),
    )


def write_hci(folder: Path, lf: xr.DataArray, depth: Array | None, *, name: str) -> int:
    """Write a light field to a folder of the 4D Light Field Benchmark; return the number of views in a row.

    Views beyond the square within the pupil are left out. The central depth in millimetres is written, too, if known.
    """
    camera = camera_of(lf)
    refuse_if(not camera.lens_data.converges, "light field: its camera has no plane at a distance; save it as .nc")
    views = f"{lf.sizes['u']} x {lf.sizes['v']}"
    middle = lf.sizes["v"] // 2
    refuse_if(lf.sizes["u"] != lf.sizes["v"], f"light field of {views} views: a folder has as many down as across")
    half = min(int(camera.pupil_radius / (np.sqrt(2) * camera.pupil_step)), (lf.sizes["v"] - 1) // 2)
    lf = lf.isel({axis: slice(middle - half, middle + half + 1) for axis in ("v", "u")})
    warn_of_dark(folder, lf.values)
    white = images.Brightness().peak([lf.values])
    folder.mkdir(parents=True, exist_ok=True)
    for index, picture in enumerate(lf.values.reshape(-1, *lf.shape[2:])):
        colours = picture if picture.ndim == 3 else np.repeat(picture[..., None], 3, axis=2)
        images.write_png(folder / f"input_Cam{index:03d}.png", colours, peak=white)
    shifts = (0.0, 0.0)
    if depth is not None:
        shift = -np.reshape([disparity(lf, distance) for distance in depth.ravel()], depth.shape)
        for kind, values in (("gt_depth_lowres", depth / 1000), ("gt_disp_lowres", shift)):
            # A portable float map begins with the lowest row.
            header = "Pf\n{1} {0}\n-1\n".format(*values.shape)
            with atomic_output(folder / f"{kind}.pfm", ".pfm") as temporary:
                temporary.write_bytes(header.encode() + np.flipud(values).astype("<f4").tobytes())
        shifts = (float(np.nanmin(shift)), float(np.nanmax(shift)))
    ours = {"camera": json.dumps(camera.to_dict()), "white": f"{white:.9g}", "channels": str(3 if lf.ndim == 5 else 1)}
    rows, columns = lf.shape[2:4]
    low, high = shifts
    parser = configparser.ConfigParser(interpolation=None)
    parser["intrinsics"] = {
        "image_resolution_x_px": str(columns),
        "image_resolution_y_px": str(rows),
        "focal_length_mm": f"{camera.mla_distance:.9g}",
        "sensor_size_mm": f"{max(columns, rows) * camera.row_pitch:.9g}",
        "fstop": "100",
    }
    parser["extrinsics"] = {
        "num_cams_x": str(2 * half + 1),
        "num_cams_y": str(2 * half + 1),
        "baseline_mm": f"{camera.pupil_step:.9g}",
        "focus_distance_m": f"{camera.focus_distance / 1000:.9g}",
        **{f"center_cam_{axis}": "0" for axis in ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")},
    }
    parser["meta"] = {
        "scene": name,
        "category": "plenoptic",
        "date": "",
        "version": "",
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
    write_text(folder / PARAMETERS, text.getvalue())
    return 2 * half + 1
