"""Figures of an experiment, as PNG: the paper's, and those that compare."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke

from .. import design
from ..camera import PlenopticCamera
from ..io.files import atomic_output
from .experiment import METHODS, TITLES, Experiment
from .images import shrink, to_bytes

_DPI = 160
_INK = "#1b1f24"
_FAINT = "#667080"
_ACCENT = "#ffb000"


class Window(NamedTuple):
    """A part of an image in fractions of its height and width."""

    top: float
    bottom: float
    left: float
    right: float

    def of(self, image: np.ndarray) -> np.ndarray:
        """Cut the part out of an image."""
        rows, columns = image.shape[:2]
        return image[
            round(self.top * rows) : round(self.bottom * rows), round(self.left * columns) : round(self.right * columns)
        ]

    @property
    def aspect(self) -> float:
        """Height over width, for a square image."""
        return (self.bottom - self.top) / (self.right - self.left)


class Zoom(NamedTuple):
    """A place on the detector to look at closely: a title, and a window of whole pixels."""

    title: str
    rows: slice
    columns: slice


def lit_window(images: Sequence[np.ndarray], *, share: float = 0.03, margin: float = 0.05) -> Window:
    """Find the part of the field, the same distance from its middle on both sides, that holds the light of images."""
    reach = []
    for axis in (1, 0):
        ends = []
        for image in images:
            lit = np.flatnonzero(image.max(axis=axis) > share * image.max())
            middle = image.shape[1 - axis] / 2
            if lit.size:
                ends.append(max(abs(lit[0] - middle), abs(lit[-1] + 1 - middle)) / (2 * middle))
        reach.append(min(0.5, max(ends, default=0.5) + margin))
    return Window(0.5 - reach[0], 0.5 + reach[0], 0.5 - reach[1], 0.5 + reach[1])


def common_peak(images: Sequence[np.ndarray], window: Window) -> float:
    """Choose the value that becomes white: all but glints stay below it."""
    return max(float(np.quantile(window.of(image), 0.997)) for image in images)


def letter_zooms(experiment: Experiment, letters: Mapping[str, str], lenses: int = 8) -> list[Zoom]:
    """Look closely at the micro-images in the middle of each of some shapes, given with titles by their ids."""
    zooms = []
    for name, title in letters.items():
        low, high = experiment.boxes[name]
        middle = (low + high) / 2
        zooms.append(_zoom(title, experiment.camera, -middle[:2] / middle[2], lenses))
    return zooms


def brightest_zoom(experiment: Experiment, lenses: int = 8) -> Zoom:
    """Look closely at where a capture has most contrast from lens to lens."""
    camera = experiment.camera
    columns, rows = camera.bin_count
    means = _resize_mean(experiment.ray.image, rows, columns)
    gradient = np.hypot(*np.gradient(means))
    half = lenses // 2
    inner = gradient[half : rows - half, half : columns - half]
    row, column = np.unravel_index(np.argmax(inner), inner.shape) if inner.size else (0, 0)
    slopes = (np.array([column, row]) + half - np.array([columns, rows]) / 2) * camera.mla_pitch / camera.mla_distance
    return _zoom(f"{lenses} x {lenses} lenses", camera, slopes, lenses)


def figure_2(path: Path, experiment: Experiment, letters: Mapping[str, str]) -> None:
    """Draw the paper's figure 2: the object and, by waves, the detector image, with micro-images close up.

    Parameters
    ----------
    path : Path
        File to write.
    experiment : Experiment
        Where the images come from.
    letters : mapping
        Titles by the id of three shapes.
    """
    camera, wave = experiment.camera, experiment.wave.image
    window = lit_window([experiment.pinhole, *experiment.truths.values()])
    zooms = letter_zooms(experiment, letters)
    edge, gap, close = 0.25, 0.2, 3.3
    half = (3 * close + gap) / 2
    figure = _Canvas(2 * half + gap + 2 * edge, 0.5 + half * window.aspect + 0.55 + close + 0.5)

    axes = figure.axes(edge, 0.5, half, half * window.aspect)
    seen = window.of(experiment.pinhole)
    _show(axes, seen, "Object, seen from the centre of the main lens")
    in_view = (window.right - window.left) * design.field_width(camera, camera.focus_distance)
    _scale_bar(axes, 2.0, in_view, f"2 mm at {camera.focus_distance:g} mm")
    for name in letters:
        low, high = experiment.boxes[name]
        z = (low[2] + high[2]) / 2
        foot = (np.array([(low[0] + high[0]) / 2, low[1]]) / z) * camera.mla_distance
        across = 0.5 - foot[0] / camera.detector_width
        down = 0.5 - foot[1] / camera.detector_height
        axes.text(
            (across - window.left) / (window.right - window.left) * seen.shape[1],
            (down - window.top) / (window.bottom - window.top) * seen.shape[0] + 0.025 * seen.shape[1],
            f"{z:g} mm",
            color="white",
            ha="center",
            va="top",
            size=8,
        )

    axes = figure.axes(edge + half + gap, 0.5, half, half * window.aspect)
    peak = float(np.quantile(wave[wave > 0.01 * wave.max()], 0.95))
    seen = window.of(wave)
    small = shrink(seen, 1400)
    # Averaging pixels dims the micro-images, which do not fill their cells.
    _show(axes, small, "Detector image, by waves", peak=0.7 * peak)
    _scale_bar(axes, 1.0, seen.shape[1] * camera.pixel_size, "1 mm")
    corner = round(window.top * wave.shape[0]), round(window.left * wave.shape[1])
    for index, zoom in enumerate(zooms):
        _mark(axes, zoom, corner, seen.shape[1] / small.shape[1], "abc"[index])
        cut = wave[zoom.rows, zoom.columns]
        below = figure.axes(edge + index * (close + gap), 0.5 + half * window.aspect + 0.55, close, close)
        _show(below, cut, f"({'abc'[index]})  Micro-images of {zoom.title}", peak=peak)
        _scale_bar(below, 0.1, cut.shape[1] * camera.pixel_size, "0.1 mm", below=True)
    figure.save(path)


def figure_4(path: Path, experiment: Experiment, panels: Sequence[tuple[str, float]]) -> None:
    """Draw the paper's figure 4: four reconstructions, by method and distance."""
    window = lit_window(list(experiment.truths.values()))
    images = [experiment.images[panel] for panel in panels]
    peak = common_peak(images, window)
    edge, gap, title, wide = 0.2, 0.2, 0.42, 5.0
    tall = wide * window.aspect
    figure = _Canvas(2 * wide + gap + 2 * edge, 2 * (title + tall) + edge)
    for index, ((name, distance), image) in enumerate(zip(panels, images, strict=True)):
        down, across = divmod(index, 2)
        axes = figure.axes(edge + across * (wide + gap), title + down * (title + tall), wide, tall)
        _show(axes, window.of(image), f"({'abcd'[index]})  {TITLES[name]}, {distance:g} mm", peak=peak, size=11)
        _object_bar(axes, experiment.camera, distance, window)
    figure.save(path)


def figure_grid(path: Path, experiment: Experiment, notes: Mapping[tuple[str, float], str]) -> None:
    """Draw every method at every distance beside the thin lens, with a note under each."""
    names = ["truth", *(method.name for method in METHODS)]
    rows = [(f"{distance:g} mm", distance) for distance in experiment.settings.distances]
    window = lit_window(list(experiment.truths.values()))
    peak = common_peak([experiment.truths[distance] for _, distance in rows], window)
    wide, gap, left, title, foot = 2.7, 0.08, 0.45, 0.4, 0.3
    tall = wide * window.aspect
    figure = _Canvas(left + len(names) * (wide + gap), title + len(rows) * (tall + foot))
    for down, (label, distance) in enumerate(rows):
        for across, name in enumerate(names):
            axes = figure.axes(left + across * (wide + gap), title + down * (tall + foot), wide, tall)
            image = experiment.truths[distance] if name == "truth" else experiment.images[name, distance]
            _show(axes, window.of(image), "", peak=peak)
            if name == "truth":
                _object_bar(axes, experiment.camera, distance, window)
            _annotate(
                axes,
                title=TITLES[name] if down == 0 else "",
                side=label if across == 0 else "",
                foot=notes.get((name, distance), ""),
            )
    figure.save(path)


def figure_captures(path: Path, experiment: Experiment, zooms: Sequence[Zoom]) -> None:
    """Draw micro-images by rays, by waves, and their difference."""
    ray, wave, camera = experiment.ray.image, experiment.wave.image, experiment.camera
    peak = float(np.quantile(ray[ray > 0], 0.999)) if np.any(ray > 0) else 1.0
    size, gap, left, title, foot = 2.9, 0.1, 0.45, 0.4, 0.35
    figure = _Canvas(left + 3 * (size + gap) + 0.8, title + len(zooms) * (size + gap) + foot)
    drawn: Any = None
    for row, zoom in enumerate(zooms):
        cuts = [image[zoom.rows, zoom.columns] for image in (ray, wave)]
        panels = [figure.axes(left + i * (size + gap), title + row * (size + gap), size, size) for i in range(3)]
        _show(panels[0], cuts[0], "", peak=peak)
        _show(panels[1], cuts[1], "", peak=peak)
        drawn = _show_difference(panels[2], cuts[1] - cuts[0], 0.6 * peak)
        for axes, name in zip(panels, ("By rays", "By waves", "Waves minus rays"), strict=True):
            _annotate(axes, title=name if row == 0 else "", side=zoom.title if axes is panels[0] else "")
        if row == len(zooms) - 1:
            _scale_bar(panels[0], 0.1, cuts[0].shape[1] * camera.pixel_size, "0.1 mm", below=True)
    figure.colour_bar(drawn, left + 3 * (size + gap), title, min(3.0, size), "radiance")
    figure.save(path)


def figure_interference(path: Path, experiment: Experiment, notes: Mapping[tuple[str, float], str]) -> None:
    """Draw what the coherent methods add to the limit in which no two lenses interfere."""
    window = lit_window(list(experiment.truths.values()))
    distances, names = experiment.settings.distances, ("coherent", "partial")
    wide, gap, left, title, foot = 3.4, 0.1, 0.45, 0.4, 0.32
    tall = wide * window.aspect
    figure = _Canvas(left + len(distances) * (wide + gap) + 0.9, title + len(names) * (tall + foot))
    bound = 0.15 * max(float(experiment.images["limit", distance].max()) for distance in distances)
    drawn: Any = None
    for down, name in enumerate(names):
        for across, distance in enumerate(distances):
            axes = figure.axes(left + across * (wide + gap), title + down * (tall + foot), wide, tall)
            difference = experiment.images[name, distance] - experiment.images["limit", distance]
            drawn = _show_difference(axes, window.of(difference), bound)
            _annotate(
                axes,
                title=f"{distance:g} mm" if down == 0 else "",
                side=TITLES[name] if across == 0 else "",
                foot=notes.get((name, distance), ""),
            )
    figure.colour_bar(drawn, left + len(distances) * (wide + gap), title, tall, "radiance beyond the limit")
    figure.save(path)


class _Canvas:
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
        with atomic_output(path) as temporary:
            self._figure.savefig(temporary, dpi=_DPI)


def _zoom(title: str, camera: PlenopticCamera, slopes: np.ndarray, lenses: int) -> Zoom:
    """Window of whole micro-images around where the chief ray of given slopes (x, y) meets the detector."""
    half = lenses / 2 * camera.micro_image_pitch / camera.pixel_size
    pitch = camera.micro_image_pitch
    spans = []
    for axis in (1, 0):
        at = round(slopes[axis] * camera.mla_distance / camera.mla_pitch) * pitch / camera.pixel_size
        middle = camera.resolution[axis] / 2 + at
        size = round(2 * half)
        first = min(max(0, round(middle - half)), max(0, camera.resolution[axis] - size))
        spans.append(slice(first, first + size))
    return Zoom(title, spans[0], spans[1])


def _resize_mean(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Average an image over a grid of cells."""
    by_row = np.stack([part.mean(axis=0) for part in np.array_split(image, rows, axis=0)])
    return np.stack([part.mean(axis=1) for part in np.array_split(by_row, columns, axis=1)], axis=1)


def _show(axes: Axes, image: np.ndarray, title: str, *, peak: float | None = None, size: float = 10) -> None:
    axes.imshow(to_bytes(image, peak), cmap="gray", vmin=0, vmax=255, interpolation="auto", aspect="auto")
    axes.set_title(title, size=size, color=_INK, loc="left", pad=6)


def _show_difference(axes: Axes, difference: np.ndarray, bound: float) -> Any:
    return axes.imshow(difference, cmap="RdBu_r", vmin=-bound, vmax=bound, interpolation="auto", aspect="auto")


def _annotate(axes: Axes, *, title: str = "", side: str = "", foot: str = "") -> None:
    axes.set_title(title, size=10, color=_INK, loc="left", pad=6)
    axes.set_ylabel(side, size=10, color=_INK, labelpad=6)
    axes.set_xlabel(foot, size=8, color=_FAINT, labelpad=4)


def _mark(axes: Axes, zoom: Zoom, corner: tuple[int, int], factor: float, name: str) -> None:
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


def _scale_bar(axes: Axes, length: float, width: float, label: str, *, below: bool = False) -> None:
    """Lay a bar of `length` into an image that is `width` wide, both in the same unit, or under it."""
    share = length / width
    height = 0.045 / (axes.get_position().height * axes.figure.get_size_inches()[1])  # type: ignore[union-attr]
    x, y, colour = (0.0, -3 * height, _INK) if below else (0.04, 2.5 * height, "white")
    place: dict[str, Any] = {"transform": axes.transAxes, "clip_on": False}
    # Bright pictures need an outline.
    outline = [] if below else [withStroke(linewidth=2, foreground="black")]
    axes.add_patch(Rectangle((x, y), share, height, color=colour, linewidth=0, path_effects=outline, **place))
    if below:
        axes.text(x + share + 0.02, y + height / 2, label, color=colour, size=8, va="center", **place)
    else:
        axes.text(x, y + 1.8 * height, label, color=colour, size=8, va="bottom", path_effects=outline, **place)


def _object_bar(axes: Axes, camera: PlenopticCamera, distance: float, window: Window) -> None:
    """Lay a scale bar in the object plane, of a length that suits the field."""
    width = (window.right - window.left) * camera.bin_count[0] * camera.bin_size(distance)
    length = next(step for step in (50.0, 20.0, 10.0, 5.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.0) if step < 0.3 * width)
    _scale_bar(axes, length, width, f"{length:g} mm")
