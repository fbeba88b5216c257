"""Figures for papers: images in rows and columns with colour bar and scale bars, depth maps, epipolar images.

All figures are as wide as a column or a page, with text of 7 points, and are written as PNG or PDF. NaN is hatched.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import FuncNorm, Normalize
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from ..camera import are_alike
from ..errors import refuse_if
from ..io.pictures import linear_of
from ..refocus import Reconstruction
from ..views.coordinates import camera_of
from .framing import IN_FOCUS, Canvas, scale_bar, styled
from .images import Brightness, srgb, to_bytes

__all__ = ["contact_sheet", "depth_figure", "epipolar_figure", "stack_figure", "views_figure"]

_COLUMN, _PAGE = 3.4, 7.0
"""Widths in inches of a column and of a page of two columns."""

_DPI = 300
_TEXT = 7.0
_INK, _BACK, _HATCH = "#1b1f24", "#eef0f3", "#9aa3ad"
_GAP, _TITLE, _SIDE, _BAR = 0.06, 0.2, 0.24, 0.55
_LONGEST_BAR = 2.0
_AT_DISTANCE = "bars: lengths at the distance of each image"
_MOST_LABELS = 9


@dataclass(frozen=True)
class Panel:
    """Image on a sheet with its title and, if known, its width in millimetres of the object."""

    image: np.ndarray
    title: str = ""
    width: float | None = None


def contact_sheet(results: Sequence[Reconstruction], white: float | None = None) -> Canvas:
    """Return a figure of reconstructions: a row for each method, a column for each distance, on one scale.

    Parameters
    ----------
    results : sequence of Reconstruction
        In any order. Of several with one method and distance the last is shown; missing images stay empty.
    white : float, optional
        Radiance shown white. Default: the value that 99.5 % of the bins do not exceed, or less where highlights would
        darken images that are lit all over.

    Returns
    -------
    Canvas
        Its method `save` writes PNG or PDF.

    Raises
    ------
    InputError
        If there is no reconstruction, or they are by several cameras.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> from mitsuba_plenoptic.report.figures import contact_sheet
    >>> results = mp.reconstruct(mp.example("letters-ray"), [210, 240, 280])
    >>> contact_sheet(results).save("refocused.pdf")
    """
    refuse_if(not results, "results: give at least one")
    refuse_if(
        not all(are_alike(one.camera, results[0].camera) for one in results), "results: they must be by one camera"
    )
    found = {(one.method, one.distance): one for one in results}
    methods = list(dict.fromkeys(one.method for one in results))
    distances = sorted({one.distance for one in results})

    def panel(method: str, distance: float) -> Panel:
        one, title = found.get((method, distance)), _distance(distance)
        if one is None:
            return Panel(np.zeros((0, 0)), title)
        width = one.image.shape[1] * one.bin_size if np.isfinite(distance) else None
        return Panel(one.image, title, width)

    rows = [[panel(method, distance) for distance in distances] for method in methods]
    return _sheet(rows, methods if len(methods) > 1 else [], white, _AT_DISTANCE)


def stack_figure(stack: xr.DataArray, white: float | None = None) -> Canvas:
    """Return a figure of a focal stack in rows, each image with its distance.

    Parameters
    ----------
    stack : xarray.DataArray
        As `focal_stack` returns it: distance or disparity, t, s[, c].
    white : float, optional
        As for `contact_sheet`.

    Returns
    -------
    Canvas
        Its method `save` writes PNG or PDF.
    """
    if "disparity" in stack.dims:
        panels = [Panel(np.asarray(image.values), f"disparity {float(image.disparity):g}", None) for image in stack]
        return _sheet([panels], [], white, "lenses per view")
    camera = camera_of(stack)
    panels = [
        Panel(
            np.asarray(image.values),
            _distance(float(image.distance)),
            image.sizes["s"] * camera.bin_size(float(image.distance)) if np.isfinite(image.distance) else None,
        )
        for image in stack
    ]
    columns = len(panels) if len(panels) < 5 else int(np.ceil(np.sqrt(len(panels))))
    rows = [panels[start : start + columns] for start in range(0, len(panels), columns)]
    return _sheet(rows, [], white, _AT_DISTANCE)


def views_figure(lf: xr.DataArray, white: float | None = None) -> Canvas:
    """Return a figure of a light field's views, arranged as they lie on the pupil and labelled by u and v.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).
    white : float, optional
        As for `contact_sheet`.

    Returns
    -------
    Canvas
        Its method `save` writes PNG or PDF.
    """
    unit = " mm" if "camera" in lf.attrs else ""
    across, down = (_labels(lf[name].values, name, unit) for name in ("u", "v"))
    values = _sampled(lf)
    rows = [
        [
            Panel(values[j, i], across[i] if j == 0 else "", _in_focus(lf) if i == j == 0 else None)
            for i in range(lf.sizes["u"])
        ]
        for j in range(lf.sizes["v"])
    ]
    return _sheet(rows, down, white, f"bar: length {IN_FOCUS}, in all views")


@styled
def epipolar_figure(image: xr.DataArray, white: float | None = None) -> Canvas:
    """Return a figure of an epipolar image: position on the pupil over position in the plane in focus.

    Parameters
    ----------
    image : xarray.DataArray
        As `epipolar_image` returns it: (u, s[, c]) or (v, t[, c]).
    white : float, optional
        As for `contact_sheet`.

    Returns
    -------
    Canvas
        Its method `save` writes PNG or PDF.
    """
    down, across = (str(name) for name in image.dims[:2])
    unit = " (mm)" if "camera" in image.attrs else ""
    values = _sampled(image)
    left, top, tall, bottom = 0.5, 0.08, 1.3, 0.4
    wide = _COLUMN - left - (_BAR + _GAP if values.ndim == 2 else 0.1)
    canvas = Canvas(_COLUMN, top + tall + bottom, _DPI)
    axes = canvas.axes(left, top, wide, tall)
    edges = [edge for name in (across, down) for edge in _edges(image[name].values)]
    drawn = _draw(axes, values, _grey([values], white), extent=(edges[0], edges[1], edges[3], edges[2]))
    axes.set_frame_on(True)
    for axis, name in ((axes.xaxis, across), (axes.yaxis, down)):
        axis.set_major_locator(MaxNLocator(5))
        axis.set_label_text(f"{name}{unit}", size=_TEXT, color=_INK)
    _plain(axes)
    if values.ndim == 2:
        _radiance_bar(canvas, drawn, values, _COLUMN - _BAR, top, tall)
    return canvas


@styled
def depth_figure(found: xr.Dataset, white: float | None = None) -> Canvas:
    """Return a figure of a depth map: the image in focus everywhere, the depth and its confidence.

    Parameters
    ----------
    found : xarray.Dataset
        Depth map from `depth_map`; where the depth, or without it the disparity, is unknown, the figure is hatched.
    white : float, optional
        As for `contact_sheet`.

    Returns
    -------
    Canvas
        Its method `save` writes PNG or PDF.
    """
    sought, unit = ("Depth", "mm from the main lens") if "depth" in found else ("Disparity", "lenses per view")
    found = found if "depth" in found else found.assign(depth=found.disparity.where(found.confidence > 0.5))
    image, depth = np.asarray(found["image"].values), np.asarray(found["depth"].values)
    known = depth[np.isfinite(depth)]
    near, far = (float(known.min()), float(known.max())) if known.size else (found.attrs["near"], found.attrs["far"])
    gap, margin = 0.26, 0.12
    wide = (_PAGE - 2 * gap - 2 * margin) / 3
    tall = wide * depth.shape[0] / depth.shape[1]
    canvas = Canvas(_PAGE, _TITLE + tall + 0.54, _DPI)
    unknown = "" if known.size == depth.size else "; hatched: unknown"
    parts: list[tuple[str, np.ndarray, Any, str, str]] = [
        ("In focus everywhere", image, _grey([image], white), "gray", "radiance"),
        (sought, depth, Normalize(near, far), "viridis_r", f"{unit}{unknown}"),
        ("Confidence", np.asarray(found["confidence"].values), Normalize(0, 1), "gray", "probability"),
    ]
    for index, (title, values, norm, colours, label) in enumerate(parts):
        left = margin + index * (wide + gap)
        axes = canvas.axes(left, _TITLE, wide, tall)
        drawn = _draw(axes, values, norm, colours)
        _write(axes, title, "")
        if (across := _in_focus(found)) is not None:
            scale_bar(axes, across, IN_FOCUS, size=_TEXT)
        if values.ndim == 3:
            _state(axes, f"white: radiance {norm.vmax:.3g}")
        else:
            below, end = _TITLE + tall + 0.07, _end(values, norm)
            bar = canvas.colour_bar(drawn, left, below, 0.09, label, width=wide, text=_TEXT, extend=end)
            bar.locator = MaxNLocator(4)
            bar.update_ticks()
    return canvas


@styled
def _sheet(rows: Sequence[Sequence[Panel]], labels: Sequence[str], white: float | None, bars: str) -> Canvas:
    """Return a figure of panels of equal size and scale, with labels on the left and bars below."""
    images = [panel.image for row in rows for panel in row if panel.image.size]
    aspect = images[0].shape[0] / images[0].shape[1]
    grey = images[0].ndim == 2
    columns = max(len(row) for row in rows)
    across = _COLUMN if columns < 3 else _PAGE
    left, bar = (_SIDE if labels else 0.0), (_BAR + _GAP if grey else 0.0)
    wide = (across - left - bar - (columns - 1) * _GAP) / columns
    tall = wide * aspect
    titles = [_TITLE if any(panel.title for panel in row) else _GAP for row in rows]
    tops = [sum(titles[: index + 1]) + index * tall for index in range(len(rows))]
    norm, drawn = _grey(images, white), None
    stated = [] if grey else [f"white: radiance {norm.vmax:.3g}"]
    stated += [bars] if any(panel.width is not None for row in rows for panel in row) else []
    canvas = Canvas(across, tops[-1] + tall + (_TITLE if stated else _GAP), _DPI)
    for down, row in enumerate(rows):
        for index, panel in enumerate(row):
            axes = canvas.axes(left + index * (wide + _GAP), tops[down], wide, tall)
            _write(axes, panel.title, labels[down] if labels and index == 0 else "")
            if index == 0 and down == len(rows) - 1:
                _state(axes, "; ".join(stated))
            if not panel.image.size:
                continue
            shown = _draw(axes, panel.image, norm)
            drawn = drawn or shown
            if panel.width is not None:
                scale_bar(axes, panel.width, size=_TEXT)
    if grey:
        height = min(_LONGEST_BAR, tops[-1] + tall - tops[0])
        _radiance_bar(
            canvas, drawn, np.concatenate([image.ravel() for image in images]), across - _BAR, tops[0], height
        )
    return canvas


def _grey(images: Sequence[np.ndarray], white: float | None) -> FuncNorm:
    """Return the scale of radiances from black to white, encoded in sRGB like pictures."""
    peak = Brightness().peak(images) if white is None else white
    return FuncNorm(
        (lambda values: srgb(np.clip(np.asarray(values) / peak, 0, None)), lambda codes: peak * linear_of(codes)),
        vmin=0,
        vmax=peak,
    )


def _draw(axes: Axes, values: np.ndarray, norm: Normalize, colours: str = "gray", **options: Any) -> Any:
    """Draw an image or a map with hatched NaN; return the artist."""
    known = np.isfinite(values if values.ndim == 2 else values.sum(axis=2))
    if not known.all():
        with matplotlib.rc_context({"hatch.linewidth": 0.4}):
            back = Rectangle((0, 0), 1, 1, transform=axes.transAxes, zorder=-1, linewidth=0, hatch="/////////")
            back.set(facecolor=_BACK, edgecolor=_HATCH)
            axes.add_patch(back)
    options |= {"interpolation": "none", "aspect": "auto"}
    if values.ndim == 2:
        return axes.imshow(np.ma.masked_where(~known, values), cmap=colours, norm=norm, **options)
    opaque = 255 * known.astype(np.uint8)
    return axes.imshow(np.dstack([to_bytes(values, norm.vmax), opaque]), **options)


def _state(axes: Axes, text: str) -> None:
    """Write a text below an image."""
    axes.set_xlabel(text, size=_TEXT, color=_INK, loc="left", labelpad=3)


def _in_focus(lf: xr.DataArray | xr.Dataset) -> float | None:
    """Return the width in mm of images in the plane in focus, None without a camera."""
    if "camera" not in lf.attrs or "s" not in lf.coords:
        return None
    return abs(float(lf.s[0] - lf.s[-1])) * lf.sizes["s"] / max(1, lf.sizes["s"] - 1)


def _radiance_bar(canvas: Canvas, drawn: Any, values: np.ndarray, left: float, top: float, height: float) -> None:
    """Add the scale bar of radiances."""
    end = _end(values, drawn.norm)
    canvas.colour_bar(drawn, left, top, height, "radiance", width=0.1, text=_TEXT, extend=end)


def _end(values: np.ndarray, norm: Normalize) -> str:
    """Return the shape of a scale's end: an arrow if values exceed the end."""
    return "max" if np.any(values > 1.001 * (norm.vmax or 0.0)) else "neither"


def _sampled(lf: xr.DataArray) -> np.ndarray:
    """Return the samples of a light field; NaN where no light comes from."""
    return np.asarray((lf.where(lf.weight > 0) if "weight" in lf.coords else lf).transpose(*lf.dims).values)


def _edges(positions: np.ndarray) -> tuple[float, float]:
    """Return the outer edges of evenly spaced samples; a single sample is drawn 1 wide."""
    half = (positions[-1] - positions[0]) / (len(positions) - 1) / 2 if len(positions) > 1 else 0.5
    return float(positions[0] - half), float(positions[-1] + half)


def _labels(positions: np.ndarray, name: str, unit: str) -> list[str]:
    """Return labels of positions, few enough not to overlap; the first names the quantity."""
    every = -(-len(positions) // _MOST_LABELS)
    texts = [f"{value:.2f}" if index % every == 0 else "" for index, value in enumerate(positions + 0.0)]
    return [f"{name} = {texts[0]}{unit}", *texts[1:]]


def _distance(distance: float) -> str:
    return f"{distance:g} mm" if np.isfinite(distance) else "infinity"


def _write(axes: Axes, title: str, side: str) -> None:
    axes.set_title(title, size=_TEXT, color=_INK, loc="left", pad=3)
    axes.set_ylabel(side, size=_TEXT, color=_INK, labelpad=3)


def _plain(axes: Axes) -> None:
    """Draw thin axes with small text."""
    axes.tick_params(labelsize=_TEXT, labelcolor=_INK, color=_INK, width=0.5, length=2)
    for spine in axes.spines.values():
        spine.set(linewidth=0.5, color=_INK)
