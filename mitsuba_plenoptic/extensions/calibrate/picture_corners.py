"""Corners of a board in several raw pictures of one camera, with its white picture, for the command."""

from collections.abc import Sequence
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.spatial import cKDTree

from ...camera import PlenopticCamera
from ...design import focus_type
from ...errors import InputError, naming, refuse_if
from ...io import RECORDED, Capture, Checkpoint, digest
from ...runtime import Array, Progress
from ...views import lens_mosaic, open_light_field, pixels_around, read_recording
from ..raw.lytro_file import nearest_white
from .detect import camera_centres, detect_corners, even_colours
from .observations import DOUBTFUL_COLUMN, Board, Table, concatenate
from .view_corners import detect_view_corners
from .white_centres import find_centres


def corners_of_pictures(
    paths: Sequence[Path],
    white: Path | None,
    board: Board,
    camera: PlenopticCamera | None,
    centres: Table | None,
    linear: bool,
    checkpoint: Checkpoint,
    progress: Progress,
) -> tuple[PlenopticCamera, Table, Table]:
    """Return the camera as it is known, corners in all pictures, and centres of micro-images.

    The checkpoint keeps the corners of the pictures that are done.
    """
    if is_light_field(paths[0]):
        lf = open_light_field(paths[0])
        camera = camera_of_views(lf)
        light, centres = lens_mosaic(lf["weight"]), camera_centres(camera)
    else:
        if white is None:
            raise InputError("--white: pictures need a white picture of the same camera, or a folder of them")
        recording = read_recording(paths[0], linear)
        camera = camera or getattr(recording, "camera", None)
        if camera is None:
            raise InputError(f"--camera: {paths[0]} does not state its camera; give that of the data sheet")
        if white.is_dir():
            if not isinstance(recording, Capture):
                raise InputError(f"{white}: {paths[0]} states no zoom and focus, by which to choose a white picture")
            white = nearest_white(white, recording)
        light = even_colours(grey(read_recording(white, linear)))
        if centres is None:
            with naming(white):
                centres = unclipped(find_centres(light, like=camera.lattice).table(white.name), light)
    is_unfocused = focus_type(camera) == "unfocused"
    detect = partial(detect_view_corners, camera=camera) if is_unfocused else detect_corners
    # On which the corners in a picture depend, but for the picture.
    facts = {"board": f"{board.columns}x{board.rows}", "lattice": camera.mla_lattice, "unfocused": is_unfocused}
    found = checkpoint.begin_arrays(**facts, white=digest(light, *centres.columns.values())) or {}
    progress(1, len(paths) + 1)
    first = None
    tables = []
    for frame, path in enumerate(paths):
        recording = recorded(path, linear)
        motors = _motors(recording)
        first = motors if frame == 0 else first
        refuse_if(
            motors != first,
            f"{path}: its zoom and focus are at the steps {motors}, those of {paths[0]} at {first}: a calibration is "
            "of one zoom and one focus",
        )
        image = grey(recording)
        key = digest(image)
        if f"{key}.u" not in found:
            table = detect(image, light, centres, board, name=str(path))
            found |= {f"{key}.{name}": values for name, values in table.columns.items()}
            checkpoint.save_arrays(partial(dict, found))
        columns = {name.partition(".")[2]: values for name, values in found.items() if name.startswith(key)}
        tables.append(Table(str(path), columns | {"frame": np.full(len(columns["u"]), frame)}))
        progress(frame + 2, len(paths) + 1)
    return camera, concatenate(tables), centres


def is_light_field(path: Path) -> bool:
    """Return whether a file holds views, or samples of each lens together, instead of a raw picture."""
    return path.name.lower().endswith((".mat", ".nc", ".zarr", ".eslf.png"))


def camera_of_views(lf: xr.DataArray) -> PlenopticCamera:
    """Return a camera whose raw picture is a light field's mosaic of lenses; only the numbers of pixels are known.

    Rays tell products of lengths in the camera alone, so that the width of pixels may be chosen: as of a camera that
    sees 40 degrees from a distance of 10 mm.
    """
    v, u, t, s = lf.shape[:4]
    refuse_if(u != v, f"light field: {u} x {v} views: it must be as wide as high")
    camera = PlenopticCamera.matched(
        f_number=4.0, lenses=(s, t), pixels_per_lens=u, pixel_size=7.2 / (s * u), focal_length=10.0, focus_distance=inf
    )
    return camera.replace(mla_offset=tuple(np.array([s, t]) % 2 * camera.mla_pitch / 2))


def recorded(path: Path, linear: bool) -> Capture | Array:
    """Read a raw picture, or a light field's mosaic of lenses."""
    return lens_mosaic(open_light_field(path)) if is_light_field(path) else read_recording(path, linear)


def unclipped(centres: Table, white: Array) -> Table:
    """Return centres with those marked as doubtful where a rim of the main lens clips the micro-image.

    Such a rim, not that of the stop, displaces the middle: what is seen there is smaller than elsewhere.
    """
    distance, _ = cKDTree(centres.pixel).query(centres.pixel, k=2)
    half = int(np.ceil(np.median(distance[:, 1]) / 2))
    _, _, patch = pixels_around(white, centres.pixel + 0.5, half)
    near = np.hypot(*(np.indices(patch.shape[1:]) - half)) < half
    size = (patch[:, near] / np.maximum(patch[:, half, half, None], 1e-9)).clip(0, 1).sum(1)
    clipped = size < 0.97 * np.quantile(size, 0.9)
    return Table(centres.name, centres.columns | {DOUBTFUL_COLUMN: centres[DOUBTFUL_COLUMN] | clipped})


def _motors(recording: Array | Capture) -> Any:
    """Return the steps of a Lytro camera's zoom and focus at a picture, None where it does not state them."""
    lens = getattr(recording, "metadata", {}).get(RECORDED, {}).get("devices", {}).get("lens", {})
    return lens.get("zoomStep"), lens.get("focusStep")


def grey(recording: Array | Capture) -> Array:
    """Return the values (rows, columns) of a picture or capture, the mean of its colours."""
    return np.atleast_3d(getattr(recording, "image", recording)).mean(2, dtype=np.float64)
