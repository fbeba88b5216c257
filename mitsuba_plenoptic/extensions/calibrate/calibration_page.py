"""The report on a calibration: a page with its numbers, residuals and boards."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from skimage.measure import block_reduce

from ...report import pages, plots
from ...runtime import Array
from .adjustment import rms
from .board_model import UNITS
from .calibration_result import Calibration, ResidualMap, field_cells, group_means, residual_map, summary
from .observations import Board, placed
from .observations import Table as Corners
from .picture_corners import grey, recorded

# Cells across the detector of which the mean residual is drawn, and how much it is enlarged there.
_CELLS = 24
_ENLARGED = 100

# Parts of which the residuals by field and by depth are listed.
_PARTS = 6


def write_calibration_report(
    path: str | Path,
    calibration: Calibration,
    board: Board,
    corners: Corners,
    centres: Corners | None,
    pictures: Sequence[Path] = (),
) -> None:
    """Write the report on a calibration as an HTML page, with the corners on the raw pictures if these are given."""
    size = calibration.camera.crop_size
    evaluation = calibration.evaluation
    outliers = evaluation.outliers
    lens = residual_map(calibration, board, corners, "view" if corners.in_views else "lens", 1)
    # Rows far off would hide in means what the others show.
    found = [pages.Picture(on_pictures(pictures, corners).png(), "Corners that were found.")] if pictures else []
    usual = replace(calibration, evaluation=evaluation.without_outliers())
    corners = corners.keep(np.delete(np.arange(len(evaluation.residuals)), outliers))
    field, depth = (
        residual_map(usual, board, corners, by, parts) for by, parts in (("field", _CELLS), ("depth", _PARTS))
    )
    maps = [("Corners", field.key, field.mean)]
    if centres is not None:
        fitted = np.delete(np.arange(len(centres.pixel)), calibration.centre_outliers)
        middle, cell = field_cells(centres.pixel[fitted], size[0] / _CELLS)
        maps.append(("Centres of micro-images", middle, group_means(-calibration.centre_residuals[fitted], cell)[1]))
    caption = f"observed less predicted, outliers left out, means of cells of the detector, enlarged {_ENLARGED} times."
    radius = np.hypot(*(corners.pixel - (np.array(size) - 1) / 2).T)
    # Equally many observations each.
    ranges = [rows for rows in np.array_split(np.argsort(radius), _PARTS) if len(rows)]
    by_radius = [(*radius[rows[[0, -1]]], len(rows), rms(usual.evaluation.residuals[rows])) for rows in ranges]
    residuals: list[pages.Block] = [
        *(pages.Picture(arrows(middle, mean, size).png(), f"{name}: {caption}") for name, middle, mean in maps),
        _ranges("Views: pixels from the pupil's middle", zip(*lens.key.T, lens.count, lens.error, strict=True))
        if corners.in_views
        else pages.Picture(
            lens_errors(lens, size).png(), "Error of the corners that each lens shows, at its micro-image."
        ),
        _ranges("Pixels from the detector's centre", by_radius),
        _ranges("Distance of the corner, mm", zip(*depth.key.T, depth.count, depth.error, strict=True)),
    ]
    *lines, error = summary(calibration, 100)
    records = [(name, value, calibration.deviations[name], UNITS[name]) for name, value in calibration.numbers.items()]
    numbers = pages.Table({"number": "{0}", "value": "{1:.7g}", "deviation": "{2:.2g}", "unit": "{3}"}, records)
    columns = {"frame": "{0}", "error": "{1:.4f}", "outliers": "{2}", "held out": "{6:.4f}"}
    columns |= {f"{axis}, mm": f"{{{column}:.2f}}" for column, axis in enumerate("xyz", 3)}
    of_pose = np.bincount(evaluation.pose[outliers], minlength=len(evaluation.frames))
    positions = np.asarray(evaluation.poses)[:, 3:].T
    errors = evaluation.frames, evaluation.pose_errors, of_pose
    poses = zip(*errors, *positions, calibration.held_out, strict=True)
    picture = pages.Picture(boards(calibration, board).png(), "Boards before the camera.")
    sections = [
        pages.Section("Numbers", [numbers, lines]),
        pages.Section("Poses", [picture, pages.Table(columns, poses), *found]),
        pages.Section("Residuals", residuals),
    ]
    lead = f"{error[0].upper()}{error[1:]} (root mean square of two-dimensional distances, every row counted)."
    pages.Page("Calibration", lead, sections).write(path)


def _ranges(title: str, ranges: Iterable[Sequence[float]]) -> pages.Table:
    """Return the errors in ranges of a quantity."""
    return pages.Table({title: "{0:.0f} to {1:.0f}", "observations": "{2}", "error": "{3:.4f}"}, ranges)


@plots.styled
def on_pictures(pictures: Sequence[Path], corners: Corners) -> plots.Plot:
    """Return a figure of raw pictures, coarsely sampled, with the corners in each at their places."""
    plot = plots.Plot(8.0)
    axes = plot.panels(-(-len(pictures) // 4), 4).flat
    for frame, path in enumerate(pictures):
        image = grey(recorded(path, True))
        # So coarse that micro-images are not told apart.
        step = -(-max(image.shape) // 200)
        plots.show(axes[frame], block_reduce(image, step, np.mean), f"{frame}")
        seen = corners.keep(corners["frame"] == frame)
        x, y = (seen[name] / step for name in ("xy" if seen.in_views else "uv"))
        axes[frame].plot(x, y, ",", color=plots.ACCENT, scalex=False, scaley=False)
    return plot


@plots.styled
def arrows(middle: Array, mean: Array, size: Sequence[int]) -> plots.Plot:
    """Return a figure of mean residuals as arrows from the middle of each cell of the detector."""
    plot = plots.Plot(8.0)
    axes = _detector(plot, size)
    x, y = (middle + 0.5).T
    axes.quiver(x, y, *(_ENLARGED * mean).T, angles="xy", scale_units="xy", scale=1, color="#9a5b00", width=0.0016)
    axes.plot(x, y, ".", color=plots.INK, markersize=2)
    return plot


@plots.styled
def lens_errors(lens: ResidualMap, size: Sequence[int]) -> plots.Plot:
    """Return a figure of the error of each lens, at its micro-image."""
    plot = plots.Plot(8.0)
    axes = _detector(plot, size)
    most = max(float(np.quantile(lens.error, 0.95)), 1e-12)
    x, y = (lens.key[:, 2:] + 0.5).T
    marks = axes.scatter(x, y, c=lens.error, s=6, cmap="YlOrBr", vmin=0, vmax=most)
    end = "max" if lens.error.max() > most else "neither"
    plot.colour_bar(marks, axes, f"px; up to {lens.error.max():.2f}", extend=end)
    return plot


def _detector(plot: plots.Plot, size: Sequence[int]) -> Axes:
    """Return axes as wide and as high as the detector, in pixels from its upper left corner."""
    ((axes,),) = plot.panels(1, 1, size[1] / size[0])
    axes.set(xlim=(0, size[0]), ylim=(size[1], 0), frame_on=True)
    axes.spines[:].set(linewidth=0.5, color=plots.FAINT)
    return axes


@plots.styled
def boards(calibration: Calibration, board: Board) -> plots.Plot:
    """Return a figure of the boards, obliquely from the side, with the camera at the left end of the axis."""
    width = (board.columns - 1) * board.square
    height = (board.rows - 1) * board.square
    outline = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    evaluation = calibration.evaluation
    plot = plots.Plot(8.0)
    ((axes,),) = plot.panels(1, 1, 0.4)
    axes.axhline(0, color=plots.FAINT, linewidth=0.5)
    axes.plot(0, 0, "o", color=plots.INK, markersize=5)
    axes.annotate("camera", (0, 0), (0, -8), textcoords="offset points", va="top", size=8, color=plots.FAINT)
    for frame, pose in zip(evaluation.frames, evaluation.poses, strict=True):
        corner = placed(outline, pose[None], np.zeros(len(outline), dtype=int))
        # Oblique: depth to the right, x towards the reader.
        across = corner[:, 2] + 0.35 * corner[:, 0]
        up = corner[:, 1] - 0.35 * corner[:, 0]
        axes.fill(across, up, facecolor=f"{plots.ACCENT}26", edgecolor="#9a5b00", linewidth=0.8)
        axes.annotate(f"{frame}", (across[0], up[0]), size=8, color=plots.FAINT)
    axes.set_aspect("equal", adjustable="datalim")
    return plot
