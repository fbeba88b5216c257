"""The parts that figures are drawn with: a canvas in inches, pictures, titles and scale bars."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from ..camera import PlenopticCamera
from ..io.files import atomic_output
from .framing import Window, Zoom
from .images import to_bytes

_DPI = 160
_INK = "#1b1f24"
_FAINT = "#667080"
_ACCENT = "#ffb000"


class Canvas:
    """A figure whose parts are placed in inches from its upper left corner."""

    def __init__(self, width: float, height: float) -> None:
        self._size = width, height
        self._figure = Figure(figsize=(width, height), dpi=_DPI, facecolor="white")
        FigureCanvasAgg(self._figure)

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """Add axes without frame and ticks."""
        across, down = self._size
        axes = self._figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_frame_on(False)
        return axes

    def colour_bar(self, drawn: Any, left: float, top: float, height: float, label: str) -> None:
        """Add the scale of a difference image."""
        axes = self.axes(left, top, 0.14, height)
        bar = self._figure.colorbar(drawn, cax=axes)
        bar.ax.tick_params(labelsize=8, color=_FAINT, labelcolor=_INK)
        bar.set_label(label, size=8, color=_INK)

    def save(self, path: Path) -> None:
        """Write it as PNG."""
        with atomic_output(path, ".png") as temporary:
            self._figure.savefig(temporary, dpi=_DPI)


def show(axes: Axes, image: np.ndarray, title: str, *, peak: float | None = None, size: float = 10) -> None:
    """Show a linear image, whose `peak` becomes white."""
    axes.imshow(to_bytes(image, peak), cmap="gray", vmin=0, vmax=255, interpolation="auto", aspect="auto")
    axes.set_title(title, size=size, color=_INK, loc="left", pad=6)


def show_difference(axes: Axes, difference: np.ndarray, bound: float) -> Any:
    """Show a difference, from blue at `-bound` to red; return what a colour bar needs."""
    return axes.imshow(difference, cmap="RdBu_r", vmin=-bound, vmax=bound, interpolation="auto", aspect="auto")


def annotate(axes: Axes, *, title: str = "", side: str = "", foot: str = "") -> None:
    """Write above, beside and below an image."""
    axes.set_title(title, size=10, color=_INK, loc="left", pad=6)
    axes.set_ylabel(side, size=10, color=_INK, labelpad=6)
    axes.set_xlabel(foot, size=8, color=_FAINT, labelpad=4)


def mark(axes: Axes, zoom: Zoom, corner: tuple[int, int], factor: float, name: str) -> None:
    """Frame on the whole detector what a close-up shows."""
    x, y = (zoom.columns.start - corner[1]) / factor, (zoom.rows.start - corner[0]) / factor
    width, height = (zoom.columns.stop - zoom.columns.start) / factor, (zoom.rows.stop - zoom.rows.start) / factor
    axes.add_patch(Rectangle((x, y), width, height, fill=False, edgecolor=_ACCENT, linewidth=1.2))
    axes.annotate(
        name,
        (x, y),
        (3, -3),
        textcoords="offset points",
        color=_INK,
        size=8,
        weight="bold",
        va="top",
        bbox={"facecolor": _ACCENT, "edgecolor": "none", "pad": 1.5},
    )


def scale_bar(axes: Axes, length: float, width: float, label: str, *, below: bool = False) -> None:
    """Lay a bar of `length` into an image that is `width` wide, both in the same unit, or under it."""
    fraction = length / width
    height = 0.045 / (axes.get_position().height * axes.figure.get_size_inches()[1])  # type: ignore[union-attr]
    x, y, colour = (0.0, -3 * height, _INK) if below else (0.04, 2.5 * height, "white")
    place: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False}
    # Bright pictures need an outline.
    outline = [] if below else [withStroke(linewidth=2, foreground="black")]
    axes.add_patch(Rectangle((x, y), fraction, height, color=colour, linewidth=0, path_effects=outline, **place))
    if below:
        axes.text(x + fraction + 0.02, y + height / 2, label, color=colour, size=8, va="center", **place)
    else:
        axes.text(x, y + 1.8 * height, label, color=colour, size=8, va="bottom", path_effects=outline, **place)


def object_bar(axes: Axes, camera: PlenopticCamera, distance: float, window: Window) -> None:
    """Lay a scale bar in the object plane, of a length that suits the field."""
    width = (window.right - window.left) * camera.bin_count[0] * camera.bin_size(distance)
    length = next(step for step in (50.0, 20.0, 10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.0) if step < 0.3 * width)
    scale_bar(axes, length, width, f"{length:g} mm")
