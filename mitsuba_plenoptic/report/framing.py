"""Framing of images in figures: the part to show, the brightness, and the places of close-ups."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from ..camera import PlenopticCamera
from ..runtime.files import atomic_output
from .experiment import Experiment
from .images import data_url, to_bytes

_LENSES = 8
"""Microlenses across a close-up."""


class Window(NamedTuple):
    """Part of an image, given in fractions of its height and width."""

    top: float
    bottom: float
    left: float
    right: float
    field_aspect: float = 1.0

    def of(self, image: np.ndarray) -> np.ndarray:
        """Return the part of an image that the window shows."""
        rows, columns = image.shape[:2]
        return image[
            round(self.top * rows) : round(self.bottom * rows), round(self.left * columns) : round(self.right * columns)
        ]

    @property
    def aspect(self) -> float:
        """Height of the window over its width."""
        return self.field_aspect * (self.bottom - self.top) / (self.right - self.left)


class Zoom(NamedTuple):
    """A close-up of the detector: a title, and a window of whole pixels."""

    title: str
    rows: slice
    columns: slice


def lit_window(images: Sequence[np.ndarray], *, fraction: float = 0.03, margin: float = 0.05) -> Window:
    """Return the part of the field, symmetric about its middle, that contains the light of all images."""
    reach = []
    for axis in (1, 0):
        ends = []
        for image in images:
            lit = np.flatnonzero(image.max(axis=axis) > fraction * image.max())
            middle = image.shape[1 - axis] / 2
            if lit.size:
                ends.append(max(abs(lit[0] - middle), abs(lit[-1] + 1 - middle)) / (2 * middle))
        reach.append(min(0.5, max(ends, default=0.5) + margin))
    rows, columns = images[0].shape[:2]
    return Window(0.5 - reach[0], 0.5 + reach[0], 0.5 - reach[1], 0.5 + reach[1], rows / columns)


def brightest_zoom(experiment: Experiment) -> Zoom:
    """Return a close-up at the place where a capture has the most contrast from lens to lens."""
    camera = experiment.camera
    columns, rows = camera.bin_count
    of_lenses = experiment.ray.image
    for axis, count in enumerate((rows, columns)):
        of_lenses = np.stack([part.mean(axis) for part in np.array_split(of_lenses, count, axis)], axis)
    gradient = np.hypot(*np.gradient(of_lenses))
    half = _LENSES // 2
    inner = gradient[half : rows - half, half : columns - half]
    row, column = np.unravel_index(np.argmax(inner), inner.shape) if inner.size else (0, 0)
    slopes = (np.array([column, row]) + half - np.array([columns, rows]) / 2) * camera.mla_pitch / camera.mla_distance
    return zoom_at(f"{_LENSES} x {_LENSES} lenses", camera, slopes)


def zoom_at(title: str, camera: PlenopticCamera, slopes: np.ndarray) -> Zoom:
    """Return a close-up of whole micro-images around the detector point of a chief ray with slopes (x, y)."""
    half = _LENSES / 2 * camera.micro_image_pitch / camera.pixel_size
    pitch = camera.micro_image_pitch
    spans = []
    for axis in (1, 0):
        at = round(slopes[axis] * camera.mla_distance / camera.mla_pitch) * pitch / camera.pixel_size
        middle = camera.resolution[axis] / 2 + at
        size = round(2 * half)
        first = min(max(0, round(middle - half)), max(0, camera.resolution[axis] - size))
        spans.append(slice(first, first + size))
    return Zoom(title, spans[0], spans[1])


_DPI = 160
INK = "#1b1f24"
FAINT = "#667080"
ACCENT = "#ffb000"


styled = matplotlib.rc_context(
    {name: value for name, value in matplotlib.rcParamsDefault.items() if not name.startswith("backend")}
    | {"pdf.fonttype": 42}
)
"""Decorator of functions that draw: settings of a user's Matplotlib do not change figures."""


class Canvas:
    """A figure whose parts are placed in inches from its upper left corner."""

    def __init__(self, width: float, height: float, dpi: int = _DPI) -> None:
        self._size = width, height
        self.figure = Figure(figsize=(width, height), dpi=dpi, facecolor="white")
        FigureCanvasAgg(self.figure)

    def axes(self, left: float, top: float, width: float, height: float) -> Axes:
        """Add axes without frame and ticks."""
        across, down = self._size
        axes = self.figure.add_axes((left / across, 1 - (top + height) / down, width / across, height / down))
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_frame_on(False)
        return axes

    def colour_bar(
        self,
        drawn: Any,
        left: float,
        top: float,
        height: float,
        label: str,
        *,
        width: float = 0.14,
        text: float = 8,
        extend: str = "neither",
    ) -> Any:
        """Add a colour bar for an image along the longer side of a rectangle, and return it."""
        along = "vertical" if height > width else "horizontal"
        axes = self.axes(left, top, width, height)
        bar = self.figure.colorbar(drawn, cax=axes, orientation=along, extend=extend)
        # A frame, or white would end in the page.
        axes.set_frame_on(True)
        bar.outline.set(linewidth=0.5, edgecolor=FAINT)
        bar.ax.tick_params(labelsize=text, color=FAINT, labelcolor=INK)
        bar.set_label(label, size=text, color=INK)
        return bar

    @styled
    def save(self, path: str | Path) -> None:
        """Write the figure as PNG, or as PDF with text as text and lines as lines."""
        with atomic_output(path, ".png", ".pdf") as temporary:
            # Without the date, the same figure gives the same file.
            dated = {"CreationDate": None} if Path(path).suffix.lower() == ".pdf" else {}
            self.figure.savefig(temporary, metadata=dated)

    @styled
    def data_url(self) -> str:
        """Return the figure as the address of a PNG, for pages."""
        picture = io.BytesIO()
        self.figure.savefig(picture, format="png")
        return data_url("png", picture.getvalue())

    def save_both(self, path: Path) -> None:
        """Write the figure as PNG, for a page, and as PDF of the same name, for papers."""
        for suffix in (".png", ".pdf"):
            self.save(path.with_suffix(suffix))


def show(axes: Axes, image: np.ndarray, title: str, *, peak: float | None = None, size: float = 10) -> None:
    """Show a linear image, whose `peak` becomes white."""
    axes.imshow(to_bytes(image, peak), cmap="gray", vmin=0, vmax=255, interpolation="auto", aspect="auto")
    axes.set_title(title, size=size, color=INK, loc="left", pad=6)


def show_difference(axes: Axes, difference: np.ndarray, bound: float) -> Any:
    """Draw a difference in colours from blue at `-bound` to red at `bound`; return the artist for a colour bar."""
    return axes.imshow(difference, cmap="RdBu_r", vmin=-bound, vmax=bound, interpolation="auto", aspect="auto")


def annotate(axes: Axes, *, title: str = "", side: str = "", foot: str = "") -> None:
    """Write texts above, beside and below an image."""
    axes.set_title(title, size=10, color=INK, loc="left", pad=6)
    axes.set_ylabel(side, size=10, color=INK, labelpad=6)
    axes.set_xlabel(foot, size=8, color=FAINT, labelpad=4)


def mark(axes: Axes, zoom: Zoom, corner: tuple[int, int], factor: float, name: str) -> None:
    """Draw the frame of a close-up on the picture of the whole detector."""
    x, y = (zoom.columns.start - corner[1]) / factor, (zoom.rows.start - corner[0]) / factor
    width, height = (zoom.columns.stop - zoom.columns.start) / factor, (zoom.rows.stop - zoom.rows.start) / factor
    axes.add_patch(Rectangle((x, y), width, height, fill=False, edgecolor=ACCENT, linewidth=1.2))
    axes.annotate(
        name,
        (x, y),
        (3, -3),
        textcoords="offset points",
        color=INK,
        size=8,
        weight="bold",
        va="top",
        bbox={"facecolor": ACCENT, "edgecolor": "none", "pad": 1.5},
    )


ON_DETECTOR, IN_FOCUS = "on the detector", "in the plane in focus"
"""Planes of scale bars, besides distances."""


def scale_bar(axes: Axes, width: float, plane: str = "", *, below: bool = False, size: float = 8) -> None:
    """Draw a bar of a round length into or below a picture that is `width` millimetres wide.

    The label states the bar's length and the plane in which it is measured.
    """
    digit = 10.0 ** math.floor(math.log10(0.3 * width))
    length = next(step * digit for step in (5.0, 2.0, 1.0) if step * digit <= 0.3 * width)
    fraction, label = length / width, f"{length:g} mm {plane}".strip()
    height = 0.045 / (axes.get_position().height * axes.figure.get_size_inches()[1])  # type: ignore[union-attr]
    x, y, colour = (0.0, -3 * height, INK) if below else (0.04, 2.5 * height, "white")
    frame: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False}
    # Bright pictures need something dark behind.
    outline = [] if below else [withStroke(linewidth=3, foreground="black")]
    backing = {"facecolor": "black", "edgecolor": "none", "pad": 1.5}
    axes.add_patch(Rectangle((x, y), fraction, height, color=colour, linewidth=0, path_effects=outline, **frame))
    if below:
        axes.text(x + fraction + 0.02, y + height / 2, label, color=colour, size=size, va="center", **frame)
    else:
        axes.text(x, y + 2 * height, label, color=colour, size=size, va="bottom", bbox=backing, **frame)


def object_bar(axes: Axes, camera: PlenopticCamera, distance: float, window: Window) -> None:
    """Draw a scale bar for an object plane; none for a plane at infinity, where there are no lengths."""
    if math.isfinite(distance):
        width = (window.right - window.left) * camera.bin_count[0] * camera.bin_size(distance)
        scale_bar(axes, width, f"at {distance:g} mm")
