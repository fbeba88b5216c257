"""Corners of a board in several raw pictures of one camera, with its white picture, for the command."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ...camera import PlenopticCamera
from ...design import focus_types
from ...errors import InputError, naming, refuse_if
from ...io import RECORDED, Capture
from ...runtime import Array, Progress
from ...views import pixels_around, read_recording
from ..raw.lytro_file import nearest_white
from .detect import detect_corners, even_colours
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
    progress: Progress,
) -> tuple[PlenopticCamera, Table, Table]:
    """Return the camera as it is known, corners in all pictures, and centres of micro-images."""
    if white is None:
        raise InputError("--white: pictures need a white picture of the same camera, or a folder of them")
    first = read_recording(paths[0], linear)
    camera = camera or getattr(first, "camera", None)
    if camera is None:
        raise InputError(f"--camera: {paths[0]} does not state its camera; give that of the data sheet")
    if white.is_dir():
        if not isinstance(first, Capture):
            raise InputError(f"{white}: {paths[0]} states no zoom and focus, by which to choose a white picture")
        white = nearest_white(white, first)
    light = even_colours(_image(read_recording(white, linear)))
    if centres is None:
        with naming(white):
            centres = unclipped(find_centres(light, like=camera.lattice).table(white.name), light)
    is_unfocused = focus_types(camera)[0] == "unfocused"
    detect = partial(detect_view_corners, camera=camera) if is_unfocused else detect_corners
    tables = []
    for frame, path in enumerate(paths):
        recording = read_recording(path, linear)
        refuse_if(
            _motors(recording) != _motors(first),
            f"{path}: its zoom and focus are at the steps {_motors(recording)}, those of {paths[0]} at "
            f"{_motors(first)}: a calibration is of one zoom and one focus",
        )
        tables.append(detect(_image(recording), light, centres, board, frame=frame, name=str(path)))
        progress(frame + 1, len(paths))
    return camera, concatenate(tables), centres


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


def _image(recording: Array | Capture) -> Array:
    """Return the values (rows, columns) of a picture, the mean of its colours."""
    return np.atleast_3d(getattr(recording, "image", recording)).mean(2, dtype=np.float64)
