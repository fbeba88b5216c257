"""Figures: panels of images with scale bars and colour bars, and figures for papers of reconstructions and depth maps.

Matplotlib lays them out. Figures for papers are as wide as a column or a page, with text of 7 points; NaN is hatched.
"""

from __future__ import annotations

import io
import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import FuncNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import Bbox, ScaledTranslation, blended_transform_factory

from .. import views
from ..camera import PlenopticCamera, are_alike
from ..errors import refuse_if
from ..io import linear_of
from ..refocus import Reconstruction
from ..runtime import Array, Named, Pair, Shape, atomic_output
from .images import Brightness, srgb, to_bytes
from .windows import Window, Zoom

if TYPE_CHECKING:
    import xarray as xr

INK = "#1b1f24"
FAINT = "#667080"
ACCENT = "#ffb000"
"""Colours of text, of remarks and of what is marked."""

DPI = 160
PRINT_DPI = 300
"""Dots per inch of figures of reports and of papers."""

_GAP = 0.05
"""Inches around a panel."""

styled = matplotlib.rc_context(
    {name: value for name, value in matplotlib.rcParamsDefault.items() if not name.startswith("backend")}
    | {"pdf.fonttype": 42}
)
"""Decorator of functions that draw: settings of a user's Matplotlib do not change figures."""


class Plot(Figure):
    """A Matplotlib figure of a width and, unless a height is given, as high as its panels need.

    Parameters
    ----------
    width, height : float
        In inches.
    dpi : int, optional
        Dots per inch of a PNG. Default: those of reports.
    """

    def __init__(self, width: float, height: float | None = None, dpi: int | None = None):
        self._fits_panels = height is None
        self._engine = ConstrainedLayoutEngine(compress=self._fits_panels, w_pad=_GAP, h_pad=_GAP, wspace=0, hspace=0)
        super().__init__((width, height or width), dpi or DPI, facecolor="white", layout=self._engine)
        FigureCanvasAgg(self)

    def panels(self, rows: int, columns: int, aspect: float | Sequence[float] = 1.0) -> Array:
        """Return axes (rows, columns) without frame and ticks; `aspect` is height over width, of all or of each row."""
        aspects = np.broadcast_to(aspect, rows).tolist()
        if self._fits_panels:
            # More than they need; saving takes off the rest.
            self.set_figheight(sum(aspects) * self.get_figwidth() / columns + rows)
        panels = self.subplots(rows, columns, squeeze=False, height_ratios=aspects)
        for axes, high in zip(panels.flat, np.repeat(aspects, columns), strict=True):
            bare(axes).set_box_aspect(high)
        return panels

    def colour_bar(
        self, artist: Any, beside: Any, label: str, *, location: str = "right", text: float = 8, extend: str = "neither"
    ) -> Any:
        """Add a colour bar for an image beside its axes, or beside all that share its colours, and return it."""
        rows = {axes.get_subplotspec().rowspan.start for axes in np.ravel(beside)}
        bar = self.colorbar(artist, ax=beside, location=location, extend=extend, aspect=24 * len(rows), pad=0.02)
        return explained(bar, label, text)

    @styled
    def save(self, path: str | Path, dpi: float | None = None) -> None:
        """Write the figure as PNG, or as PDF with text as text and lines as lines.

        Parameters
        ----------
        dpi : float, optional
            Dots per inch of a PNG. Default: those of the figure, 300 for papers.
        """
        with atomic_output(path, ".png", ".pdf") as temporary:
            # Without the date, the same figure gives the same file.
            dated = {"CreationDate": None} if Path(path).suffix.lower() == ".pdf" else {}
            self._fit()
            self.savefig(temporary, metadata=dated, dpi=dpi or "figure")

    def save_both(self, path: Path, pdf: bool = True) -> None:
        """Write the figure as PNG, for a page, and if asked as PDF of the same name and layout, for papers."""
        self.save(path.with_suffix(".png"))
        if not pdf:
            return
        # To lay it out again would take as long as to draw it.
        self.set_layout_engine("none")
        self._fits_panels = False
        self.save(path.with_suffix(".pdf"))

    @styled
    def png(self) -> bytes:
        """Return the content of the figure's PNG."""
        picture = io.BytesIO()
        self._fit()
        self.savefig(picture, format="png")
        return picture.getvalue()

    _repr_png_ = png
    """Notebooks show figures at the end of a cell."""

    def _fit(self) -> None:
        """Make the figure as high as its panels with their texts."""
        if self._fits_panels:
            self._engine.execute(self)
            boxes = (axes.get_tightbbox() for axes in self.axes)
            content = Bbox.union([box for box in boxes if box is not None])
            self.set_figheight(content.height / self.dpi + 2 * _GAP)


def bare(axes: Axes) -> Axes:
    """Return axes after their frame and ticks are taken off."""
    axes.set(xticks=[], yticks=[], frame_on=False)
    return axes


def ruled(axes: Axes, title: str, below: str, beside: str = "", ticks: int = 5) -> None:
    """Write a small title and small labels, and leave at most some intervals between the ticks of either axis."""
    axes.set_title(title, size=9, color=INK)
    axes.set_xlabel(below, size=8, color=INK)
    axes.set_ylabel(beside, size=8, color=INK, labelpad=2)
    axes.locator_params(nbins=ticks)
    axes.tick_params(labelsize=7, color=INK, labelcolor=INK)


def explained(bar: Any, label: str, size: float) -> Any:
    """Return a colour bar after its label and look are set."""
    bar.outline.set(linewidth=0.5, edgecolor=FAINT)
    bar.ax.tick_params(labelsize=size, color=FAINT, labelcolor=INK)
    bar.set_label(label, size=size, color=INK)
    return bar


ON_DETECTOR = "on the detector"
IN_FOCUS = "in the plane in focus"
"""Planes of scale bars, besides distances."""


def show(axes: Axes, image: Array, title: str = "", *, peak: float | None = None, **texts: Any) -> None:
    """Show a linear image, whose `peak` becomes white, with the texts of `annotate`."""
    axes.imshow(to_bytes(image, peak), cmap="gray", vmin=0, vmax=255, interpolation="auto", aspect="auto")
    annotate(axes, title=title, **texts)


def show_difference(axes: Axes, difference: Array, bound: float) -> Any:
    """Draw a difference in colours from blue at `-bound` to red at `bound`; return the artist for a colour bar."""
    return axes.imshow(difference, cmap="RdBu_r", vmin=-bound, vmax=bound, interpolation="auto", aspect="auto")


def annotate(axes: Axes, *, title: str = "", side: str = "", foot: str = "", size: float = 10) -> None:
    """Write texts above, beside and, smaller, below an image."""
    axes.set_title(title, size=size, color=INK, loc="left", pad=0.5 * size)
    axes.set_ylabel(side, size=size, color=INK, labelpad=0.5 * size)
    axes.set_xlabel(foot, size=min(size, 8), color=FAINT, labelpad=4)


def mark(axes: Axes, zoom: Zoom, corner: Shape, factor: float, name: str) -> None:
    """Draw the frame of a close-up on the picture of the whole detector."""
    corners = (np.array([[each.start, each.stop] for each in (zoom.columns, zoom.rows)]).T - corner[::-1]) / factor
    axes.add_patch(Rectangle(corners[0], *np.ptp(corners, axis=0), fill=False, edgecolor=ACCENT, linewidth=1.2))
    axes.annotate(
        name,
        corners[0],
        (3, -3),
        textcoords="offset points",
        color=INK,
        size=8,
        weight="bold",
        va="top",
        bbox={"facecolor": ACCENT, "edgecolor": "none", "pad": 1.5},
    )


def scale_bar(
    axes: Axes, width: float, plane: str = "", *, below: bool = False, size: float = 8, unit: str = "mm"
) -> None:
    """Draw a bar of a round length into or below a picture of a width in a unit.

    The label states the bar's length and the plane in which it is measured.
    """
    digit = 10.0 ** math.floor(math.log10(0.3 * width))
    length = next(step * digit for step in (5.0, 2.0, 1.0) if step * digit <= 0.3 * width)
    fraction = length / width
    label = f"{length:g} {unit} {plane}".strip()
    thick = 0.045
    left, low, colour = (0.0, -3 * thick, INK) if below else (0.04, 2.5 * thick, "white")
    # Along the picture in fractions of its width, upwards in inches from its lower edge.
    figure: Any = axes.get_figure()
    inches: Any = figure.dpi_scale_trans + ScaledTranslation(0, 0, axes.transAxes)  # type: ignore[arg-type]
    frame: Named = {"transform": blended_transform_factory(axes.transAxes, inches), "clip_on": False}
    # Bright pictures need something dark behind.
    outline = [] if below else [withStroke(linewidth=3, foreground="black")]
    backing = None if below else {"facecolor": "black", "edgecolor": "none", "pad": 1.5}
    axes.add_patch(Rectangle((left, low), fraction, thick, color=colour, linewidth=0, path_effects=outline, **frame))
    x, y, align = (fraction + 0.02, low + thick / 2, "center") if below else (left, low + 2 * thick, "bottom")
    axes.text(x, y, label, color=colour, size=size, va=align, bbox=backing, **frame)


def object_bar(axes: Axes, camera: PlenopticCamera, distance: float, window: Window) -> None:
    """Draw a scale bar for an object plane; none for a plane at infinity, where there are no lengths."""
    if math.isfinite(distance):
        width = (window.right - window.left) * camera.bin_count[0] * camera.bin_size(distance)
        scale_bar(axes, width, f"at {distance:g} mm")


_COLUMN = 3.4
_PAGE = 7.0
"""Widths in inches of a column and of a page of two columns."""

_TEXT = 7.0
_LINE = 0.2
"""Inches of a sheet for a line of text, for labels on the left, and for a colour bar."""


class Panel(NamedTuple):
    """Image on a sheet with its title and, if known, its width in millimetres of the object."""

    image: Array
    title: str = ""
    width: float | None = None


def contact_sheet(results: Sequence[Reconstruction], white: float | None = None) -> Plot:
    """Return a figure of reconstructions: a row for each method and capture, a column for each distance, on one scale.

    Parameters
    ----------
    results : sequence of Reconstruction
        In any order. Several with one method, model of light and distance are of several captures, in their order;
        missing images stay empty.
    white : float, optional
        Radiance shown white. Default: the value that 99.5 % of the bins do not exceed, or less where highlights would
        darken images that are lit all over.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> from mitsuba_plenoptic.report.plots import contact_sheet
    >>> results = mp.reconstruct(mp.example("letters-ray"), [210, 240, 280])
    >>> contact_sheet(results).save("refocused.pdf")
    """
    refuse_if(not results, "results: give at least one")
    refuse_if(
        not all(are_alike(result.camera, results[0].camera) for result in results),
        "results: they must be by one camera",
    )
    distances = sorted({result.distance for result in results})
    models = {result.facts.get("model") for result in results}
    by_label: dict[str, dict[float, Panel]] = defaultdict(dict)
    for result in results:
        model = result.facts.get("model")
        label = result.method if len(models) == 1 or model is None else f"{result.method} of {model} capture"
        labels = (label, *(f"{label} {number}" for number in range(2, len(results) + 1)))
        row = next(row for row in labels if result.distance not in by_label[row])
        by_label[row][result.distance] = _panel(result.image, result.distance, result.bin_size)
    panels = [
        row.get(distance, _panel(np.zeros((0, 0)), distance, 0.0))
        for row in by_label.values()
        for distance in distances
    ]
    return _sheet(panels, len(distances), white, list(by_label) if len(by_label) > 1 else [])


def _panel(image: Array, distance: float, bin_size: float) -> Panel:
    """Return the panel of an image refocused to a distance."""
    return Panel(image, distance_text(distance), image.shape[1] * bin_size if math.isfinite(distance) else None)


def stack_figure(stack: xr.DataArray, white: float | None = None) -> Plot:
    """Return a figure of a focal stack in rows, each image with its distance.

    Parameters
    ----------
    stack : xarray.DataArray
        As `focal_stack` returns it: distance or disparity, t, s[, c].
    white : float, optional
        As for `contact_sheet`.
    """
    if "disparity" in stack.dims:
        panels = [Panel(image.values, f"disparity {float(image.disparity):g}") for image in stack]
        return _sheet(panels, len(panels), white)
    camera = views.camera_of(stack)
    distances = stack.distance.values.tolist()
    panels = [_panel(image.values, at, camera.bin_size(at)) for image, at in zip(stack, distances, strict=True)]
    return _sheet(panels, len(panels) if len(panels) < 5 else math.ceil(math.sqrt(len(panels))), white)


def views_figure(lf: xr.DataArray, white: float | None = None) -> Plot:
    """Return a figure of a light field's views, arranged as they lie on the pupil and labelled by u and v.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field, (v, u, t, s[, c]).
    white : float, optional
        As for `contact_sheet`.
    """
    unit = " mm" if "camera" in lf.attrs else ""
    across = _labels(lf.u, unit)
    down = _labels(lf.v, unit)
    values = _sampled(lf)
    last = len(values) - 1, 0
    panels = [
        Panel(values[j, i], "" if j else across[i], _in_focus(lf) if (j, i) == last else None)
        for j, i in np.ndindex(values.shape[:2])
    ]
    return _sheet(panels, len(across), white, down, f"{IN_FOCUS}, in all views")


@styled
def epipolar_figure(image: xr.DataArray, white: float | None = None) -> Plot:
    """Return a figure of an epipolar image: position on the pupil over position in the plane in focus.

    Parameters
    ----------
    image : xarray.DataArray
        As `epipolar_image` returns it: (u, s[, c]) or (v, t[, c]).
    white : float, optional
        As for `contact_sheet`.
    """
    down, across = (str(name) for name in image.dims[:2])
    unit = " (mm)" if "camera" in image.attrs else ""
    values = _sampled(image)
    plot = Plot(_COLUMN, dpi=PRINT_DPI)
    ((axes,),) = plot.panels(1, 1, 0.55)
    extent = (*_edges(image[across].values), *_edges(image[down].values)[::-1])
    artist = _draw(axes, values, _grey([values], white), extent=extent)
    axes.set_frame_on(True)
    axes.locator_params(nbins=5)
    for axis, name in ((axes.xaxis, across), (axes.yaxis, down)):
        axis.set_label_text(f"{name}{unit}", size=_TEXT, color=INK)
    axes.tick_params(labelsize=_TEXT, labelcolor=INK, color=INK, width=0.5, length=2)
    axes.spines[:].set(linewidth=0.5, color=INK)
    if values.ndim == 2:
        plot.colour_bar(artist, axes, "radiance", text=_TEXT, extend=_end(values, artist.norm))
    return plot


@styled
def depth_figure(found: xr.Dataset, white: float | None = None) -> Plot:
    """Return a figure of a depth map: the image in focus everywhere, the depth and its confidence.

    Parameters
    ----------
    found : xarray.Dataset
        Depth map from `depth_map`; where the depth, or without it the disparity, is unknown, the figure is hatched.
    white : float, optional
        As for `contact_sheet`.
    """
    sought, unit = ("Depth", "mm from the main lens") if "depth" in found else ("Disparity", "pixels per view")
    found = found if "depth" in found else found.assign(depth=found.disparity.where(found.confidence > 0.5))
    image = found["image"].values
    depth = found["depth"].values
    finite = depth[np.isfinite(depth)]
    near, far = (float(finite.min()), float(finite.max())) if finite.size else (found.attrs["near"], found.attrs["far"])
    unknown = "" if finite.size == depth.size else "; hatched: unknown"
    maps = [
        ("In focus everywhere", image, _grey([image], white), "gray", "radiance"),
        (sought, depth, Normalize(near, far), "viridis_r", f"{unit}{unknown}"),
        ("Confidence", found["confidence"].values, Normalize(0, 1), "gray", "probability"),
    ]
    plot = Plot(_PAGE, dpi=PRINT_DPI)
    (panels,) = plot.panels(1, 3, depth.shape[0] / depth.shape[1])
    for axes, (title, values, norm, colours, label) in zip(panels, maps, strict=True):
        artist = _draw(axes, values, norm, colours)
        annotate(axes, title=title, foot="" if values.ndim == 2 else f"white: radiance {norm.vmax:.3g}", size=_TEXT)
        if (across := _in_focus(found)) is not None:
            scale_bar(axes, across, IN_FOCUS, size=_TEXT)
        if values.ndim == 2:
            bar = plot.colour_bar(artist, axes, label, location="bottom", text=_TEXT, extend=_end(values, norm))
            bar.locator = MaxNLocator(4)
            bar.update_ticks()
    return plot


@styled
def _sheet(
    panels: Sequence[Panel], columns: int, white: float | None, labels: Sequence[str] = (), below: str = ""
) -> Plot:
    """Return a figure of panels in rows, of equal size and scale, with labels on the left.

    Scale bars lie in panels or, with a text on their plane, below them.
    """
    images = [panel.image for panel in panels if panel.image.size]
    rows = math.ceil(len(panels) / columns)
    grey = images[0].ndim == 2
    norm = _grey(images, white)
    stated = [] if grey else [f"white: radiance {norm.vmax:.3g}"]
    has_bars = any(panel.width for panel in panels)
    if has_bars and not below:
        stated.append("bars: lengths at the distance of each image")
    # Constrained layout takes minutes for the hundreds of views of a light field. All texts are of one size.
    across = _COLUMN if columns < 3 else _PAGE
    left = 0.24 if labels else _GAP
    right = across - (0.6 if grey else 0.0)
    wide = (right - left - (columns - 1) * _GAP) / columns
    tall = wide * images[0].shape[0] / images[0].shape[1]
    between = _LINE if any(panel.title for panel in panels[columns:]) else _GAP
    # In a narrow figure each text has a line of its own.
    text = ("\n" if columns < 3 else "; ").join(stated)
    foot = (_LINE * (1 + text.count("\n")) if stated else _GAP) + (_LINE if has_bars and below else 0.0)
    height = _LINE + rows * tall + (rows - 1) * between + foot
    plot = Plot(across, height, PRINT_DPI)
    plot.set_layout_engine("none")
    edges = {"left": left / across, "right": right / across, "top": 1 - _LINE / height, "bottom": foot / height}
    spaces = {"wspace": _GAP / wide, "hspace": between / tall}
    grid = plot.subplots(rows, columns, squeeze=False, gridspec_kw=edges | spaces).flat
    artists = []
    for index, (axes, (image, title, width)) in enumerate(zip(grid, panels, strict=False)):
        side = labels[index // columns] if labels and index % columns == 0 else ""
        annotate(bare(axes), title=title, side=side, size=_TEXT)
        if image.size:
            artists.append(_draw(axes, image, norm))
            if width:
                scale_bar(axes, width, below, below=bool(below), size=_TEXT)
    for axes in grid[len(panels) :]:
        axes.remove()
    if stated:
        plot.supxlabel(text, x=left / across, y=0.2 * _LINE / height, ha="left", va="bottom", size=_TEXT, color=INK)
    if grey:
        values = np.concatenate([image.ravel() for image in images])
        where = plot.add_axes(
            (edges["right"] + _GAP / across, edges["bottom"], 0.1 / across, edges["top"] - edges["bottom"])
        )
        explained(plot.colorbar(artists[0], cax=where, extend=_end(values, norm)), "radiance", _TEXT)
    return plot


def _grey(images: Sequence[Array], white: float | None) -> FuncNorm:
    """Return the scale of radiances from black to white, encoded in sRGB like pictures."""
    peak = Brightness().peak(images) if white is None else white
    return FuncNorm(
        (lambda values: srgb(np.clip(np.asarray(values) / peak, 0, None)), lambda codes: peak * linear_of(codes)),
        vmin=0,
        vmax=peak,
    )


def _draw(axes: Axes, values: Array, norm: Normalize, colours: str = "gray", **options: Any) -> Any:
    """Draw an image or a map with hatched NaN; return the artist."""
    finite = np.isfinite(values if values.ndim == 2 else values.sum(axis=2))
    if not finite.all():
        with matplotlib.rc_context({"hatch.linewidth": 0.4}):
            back = Rectangle((0, 0), 1, 1, transform=axes.transAxes, zorder=-1, linewidth=0, hatch="/////////")
            back.set(facecolor="#eef0f3", edgecolor="#9aa3ad")
            axes.add_patch(back)
    options |= {"interpolation": "none", "aspect": "auto"}
    if values.ndim == 2:
        return axes.imshow(np.ma.masked_where(~finite, values), cmap=colours, norm=norm, **options)
    opaque = 255 * finite.astype(np.uint8)
    return axes.imshow(np.dstack([to_bytes(values, norm.vmax), opaque]), **options)


def _in_focus(lf: xr.DataArray | xr.Dataset) -> float | None:
    """Return the width in mm of images in the plane in focus, None without a camera."""
    if "camera" not in lf.attrs or "s" not in lf.coords:
        return None
    return abs(float(lf.s[0] - lf.s[-1])) * lf.sizes["s"] / max(1, lf.sizes["s"] - 1)


def _end(values: Array, norm: Normalize) -> str:
    """Return the shape of a scale's end: an arrow if values exceed the end."""
    return "max" if np.any(values > 1.001 * (norm.vmax or 0.0)) else "neither"


def _sampled(lf: xr.DataArray) -> Array:
    """Return the samples of a light field; NaN where no light comes from."""
    return (lf.where(lf.weight > 0) if "weight" in lf.coords else lf).transpose(*lf.dims).values


def _edges(positions: Array) -> Pair:
    """Return the outer edges of evenly spaced samples; a single sample is drawn 1 wide."""
    half = (positions[-1] - positions[0]) / (len(positions) - 1) / 2 if len(positions) > 1 else 0.5
    return float(positions[0] - half), float(positions[-1] + half)


def _labels(positions: xr.DataArray, unit: str) -> list[str]:
    """Return labels of positions, few enough not to overlap; the first names the quantity."""
    stride = -(-len(positions) // 9)
    texts = ["" if index % stride else f"{value + 0.0:.2f}" for index, value in enumerate(positions.values)]
    return [f"{positions.name} = {texts[0]}{unit}", *texts[1:]]


def distance_text(distance: float) -> str:
    """Return a distance in focus, in millimetres, as text."""
    return f"{distance:g} mm" if np.isfinite(distance) else "infinity"
