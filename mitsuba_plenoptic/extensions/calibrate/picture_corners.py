"""Corners of a board in several raw pictures of one camera, with its white picture, for the command."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ...camera import PlenopticCamera
from ...design import focus_types
from ...errors import naming, refuse_if
from ...io import RECORDED, Capture
from ...runtime import Array, Progress
from ...views import pixels_around, read_recording
from ..raw.lytro_file import nearest_white
from .detect import detect_corners, even_colours
from .observations import DOUBTFUL_COLUMN, Board, Table, concatenate
from .view_corners import detect_view_corners
from .white_centres import find_centres

_BESIDE = 0.4
"""Pixels between the micro-images of a picture and of its white one from which on they are of two cameras."""

_WHOLE = 0.97
"""Size of a micro-image, in parts of what those that nothing clips have, below which its centre does not count."""


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
    refuse_if(white is None, "--white: pictures need a white picture of the same camera, or a folder of them")
    assert white is not None
    first = read_recording(paths[0], linear)
    if camera is None:
        refuse_if(
            not isinstance(first, Capture), f"--camera: {paths[0]} does not state its camera; give the data sheet's"
        )
        camera = first.camera
    steps = motors(first)
    if white.is_dir():
        refuse_if(steps is None, f"{white}: {paths[0]} states no zoom and focus, by which to choose a white picture")
        white = nearest_white(white, first)
    light = even_colours(_image(read_recording(white, linear)))
    if centres is None:
        with naming(white):
            centres = unclipped(find_centres(light, like=camera.lattice).table(white.name), light)
    tables = []
    for frame, path in enumerate(paths):
        recording = read_recording(path, linear)
        others = motors(recording)
        refuse_if(
            others != steps,
            f"{path}: its zoom and focus are at the steps {others}, those of {paths[0]} at {steps}: a calibration is of "
            "one zoom and one focus",
        )
        image = _image(recording)
        _require_same_lenses(image, light, centres, path)
        if set(focus_types(camera)) == {"unfocused"}:
            tables.append(detect_view_corners(image, light, centres, board, camera, frame=frame, name=str(path)))
        else:
            tables.append(detect_corners(image, light, centres, board, frame=frame, name=str(path)))
        progress(frame + 1, len(paths))
    return camera, concatenate(tables), centres


def unclipped(centres: Table, white: Array) -> Table:
    """Return centres with those marked as doubtful where a rim of the main lens clips the micro-image.

    Such a rim, not that of the stop, displaces the middle: what is seen there is smaller than elsewhere.
    """
    distance, _ = cKDTree(centres.pixel).query(centres.pixel, k=2)
    half = int(np.ceil(np.median(distance[:, 1]) / 2))
    _, _, patch = pixels_around(white, centres.pixel + 0.5, half)
    middle = patch[:, half - 1 : half + 2, half - 1 : half + 2].mean((1, 2))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    near = np.hypot(x, y) < half
    size = (patch / np.maximum(middle, 1e-9)[:, None, None]).clip(0, 1)[:, near].sum(1)
    clipped = size < _WHOLE * np.quantile(size, 0.9)
    if clipped.mean() > 0.9:
        return centres
    return Table(centres.name, centres.columns | {DOUBTFUL_COLUMN: centres[DOUBTFUL_COLUMN] | clipped})


def _require_same_lenses(image: Array, white: Array, centres: Table, path: Path) -> None:
    """Refuse a picture whose micro-images, on average over parts of it, lie beside those of the white picture."""
    refuse_if(
        image.shape != white.shape,
        f"{path}: it has {image.shape[1]} x {image.shape[0]} pixels, and the white picture {white.shape[1]} x "
        f"{white.shape[0]}",
    )
    pixel = centres.keep(centres[DOUBTFUL_COLUMN] == 0).pixel if DOUBTFUL_COLUMN in centres.columns else centres.pixel
    quarter = (pixel > np.median(pixel, axis=0)) @ [1, 2]
    distance, _ = cKDTree(pixel).query(pixel, k=2)
    half = int(np.median(distance[:, 1]) / 2)
    shifts = []
    for number in range(4):
        some = pixel[quarter == number][:: max(1, int((quarter == number).sum() / 2000))]
        middles = []
        for picture in (image, white):
            x, y, patch = pixels_around(picture, some + 0.5, half)
            light = patch - np.quantile(patch, 0.02, axis=(1, 2), keepdims=True)
            away = [(light.sum(1) * (x - some[:, :1])).sum(), (light.sum(2) * (y - some[:, 1:])).sum()]
            middles.append(np.array(away) / max(float(light.sum()), 1e-9))
        shifts.append(middles[0] - middles[1])
    shift = float(np.hypot(*np.median(shifts, axis=0)))
    refuse_if(
        shift > _BESIDE,
        f"{path}: its micro-images lie {shift:.2g} pixels beside those of the white picture, which is of another "
        "camera, zoom or focus",
    )


def motors(recording: Array | Capture) -> tuple[float, float] | None:
    """Return the steps of a Lytro camera's zoom and focus at a picture, None where it does not state them."""
    record = recording.metadata.get(RECORDED, {}) if isinstance(recording, Capture) else {}
    lens = record.get("devices", {}).get("lens", {})
    return (lens["zoomStep"], lens["focusStep"]) if {"zoomStep", "focusStep"} <= set(lens) else None


def _image(recording: Array | Capture) -> Array:
    """Return the values (rows, columns) of a picture, the mean of its colours."""
    image = np.asarray(getattr(recording, "image", recording), np.float64)
    return image.mean(2) if image.ndim == 3 else image
