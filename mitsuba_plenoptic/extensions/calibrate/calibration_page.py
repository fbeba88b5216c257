"""The report on a calibration: a page with its numbers, residuals and boards."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ...report.page import template
from ...runtime.files import write_text
from .board_model import UNITS
from .calibration_result import Calibration, ResidualMap, field_cells, group_means, residual_map
from .observations import Board, Table, placed

_TEMPLATES = Path(__file__).parent / "templates"

# Cells across the detector of which the mean residual is drawn, and how much it is enlarged there.
_CELLS = 24
_ENLARGED = 100

# Parts of which the residuals by field and by depth are listed.
_PARTS = 6

_WIDTH = 760
"""Width of the drawings."""


def write_calibration_report(
    path: str | Path, calibration: Calibration, board: Board, corners: Table, centres: Table | None
) -> None:
    """Write the report on a calibration as an HTML page."""
    size, seen = calibration.camera.crop_size, calibration.evaluation
    outliers = seen.outliers
    lens = residual_map(calibration, board, corners, "lens", 1)
    # Rows far off would hide in means what the others show.
    calibration = replace(calibration, evaluation=seen.without_outliers())
    corners = corners.keep(np.delete(np.arange(len(seen.residuals)), outliers))
    field, depth = (
        residual_map(calibration, board, corners, by, parts) for by, parts in (("field", _CELLS), ("depth", _PARTS))
    )
    maps = [("Corners", _arrows(field.key, field.mean, size))]
    if centres is not None:
        used = np.delete(np.arange(len(centres.pixel)), calibration.centre_outliers)
        middle, cell = field_cells(centres.pixel[used], size[0] / _CELLS)
        means = group_means(-calibration.centre_residuals[used], cell)[1]
        maps.append(("Centres of micro-images", _arrows(middle, means, size)))
    radius = np.hypot(*(corners.pixel - (np.array(size) - 1) / 2).T)
    page = template("calibration.html", _TEMPLATES).render(
        calibration=calibration,
        seen=seen,
        outliers=outliers + 2,
        outliers_by_frame=np.bincount(seen.pose[outliers], minlength=len(seen.frames)).tolist(),
        units=UNITS,
        weak=calibration.weak_directions(),
        maps=maps,
        width=_WIDTH,
        height=round(_WIDTH * size[1] / size[0]),
        enlarged=_ENLARGED,
        tables=[
            ("Pixels from the detector's centre", _by(radius, calibration.evaluation.residuals)),
            ("Distance of the corner, mm", [*zip(*depth.key.T, depth.count, depth.error, strict=True)]),
        ],
        lenses=_lenses(lens, size),
        worst=float(lens.error.max()),
        boards=_boards(calibration, board),
    )
    write_text(path, page, ".html")


def _arrows(middle: np.ndarray, mean: np.ndarray, size: Sequence[int]) -> list[tuple[float, float, float, float]]:
    """Return mean residuals as lines from the middle of each cell of the detector, in units of the drawing."""
    lines = np.concatenate([middle + 0.5, middle + 0.5 + _ENLARGED * mean], axis=1) * (_WIDTH / size[0])
    return [tuple(line) for line in lines.round(1).tolist()]


def _lenses(lens: ResidualMap, size: Sequence[int]) -> list[tuple[float, float, float]]:
    """Return the position of each lens, and as its darkness the lens's error over the 95 % quantile of all errors."""
    position = (lens.key[:, 2:] + 0.5) * (_WIDTH / size[0])
    dark = (lens.error / max(float(np.quantile(lens.error, 0.95)), 1e-12)).clip(0.05, 1)
    return [tuple(mark) for mark in np.column_stack([position.round(1), dark.round(2)]).tolist()]


def _by(quantity: np.ndarray, residuals: np.ndarray) -> list[tuple[float, float, int, float]]:
    """Return ranges of a quantity that hold equally many observations, and the RMS residual in each range."""
    squares = (residuals**2).sum(1)
    return [
        (float(quantity[part[0]]), float(quantity[part[-1]]), len(part), math.sqrt(squares[part].mean()))
        for part in np.array_split(np.argsort(quantity), _PARTS)
        if len(part)
    ]


def _boards(calibration: Calibration, board: Board) -> list[dict[str, Any]]:
    """Draw the boards obliquely from the side, with the camera at the left end of the axis."""
    width, height = (board.columns - 1) * board.square, (board.rows - 1) * board.square
    outline = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    seen = calibration.evaluation
    outlines = [placed(outline, pose[None], np.zeros(len(outline), dtype=int)) for pose in seen.poses]
    scale = (_WIDTH - 40) / max((corner[:, 2] + 0.35 * np.abs(corner[:, 0])).max() for corner in outlines)
    drawings = []
    for frame, corner in zip(seen.frames, outlines, strict=True):
        # Oblique: depth to the right, x towards the reader.
        across = 20 + scale * (corner[:, 2] + 0.35 * corner[:, 0])
        down = 150 - scale * (corner[:, 1] - 0.35 * corner[:, 0])
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))
        drawings.append({"frame": int(frame), "points": points, "x": round(across[0], 1), "y": round(down[0], 1)})
    return drawings
