"""Page on a camera fitted to its white picture: recorded and simulated pixels side by side."""

from pathlib import Path

import mitsuba as mi
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from scipy.spatial import cKDTree

from ...report import pages, plots
from ...runtime import Array, Pair, set_variant
from ...scene import render_capture
from .white_fit import WhiteFit

_LENSES = 12
"""Lenses along a side of the pictures that are shown side by side."""

_SAMPLES = 128
"""Samples per pixel of the simulated capture."""


def write_white_report(path: Path, fit: WhiteFit, summary: list[str]) -> None:
    """Write the page, for which a part of the white picture is simulated through the fitted camera."""
    light = "rays" if fit.wavelength is None else f"waves of {fit.wavelength:g} nm"
    lead = f"Simulated by {light}, {_SAMPLES} samples per pixel, for {_LENSES} x {_LENSES} lenses in the middle."
    caption = "Recorded and simulated pixels of the white picture, their difference, and profiles."
    lines = Markup("<pre>{}</pre>").format("\n".join(summary))
    sections = [
        pages.Section("Pictures", [pages.Picture(white_figure(fit).png(), caption)]),
        pages.Section("Numbers", [lines]),
    ]
    pages.Page("A camera fitted to its white picture", lead, sections).write(path)


def side_by_side(fit: WhiteFit, samples: int = _SAMPLES) -> Pair:
    """Return recorded and simulated light of the lenses in the middle, over the mean light in lenses' middles.

    Both have the shape (rows, columns). Simulated is an evenly white scene through the fitted camera.
    """
    set_variant(None)
    pitch = fit.camera.micro_image_pitch / fit.camera.pixel_size
    size = [min(round(_LENSES * pitch), full) for full in fit.camera.resolution]
    first = [(full - cut) // 2 for full, cut in zip(fit.camera.resolution, size, strict=True)]
    camera = fit.camera.replace(crop_offset=tuple(first), crop_size=tuple(size))
    scene = {"type": "scene", "lamp": {"type": "constant"}, "camera": camera.to_sensor()}
    direct = {"type": "direct"}
    waves = {"type": "plenoptic_wave", "wavelength": fit.wavelength, "child": direct}
    integrator = direct if fit.wavelength is None else waves
    simulated = render_capture(mi.load_dict(scene | {"integrator": integrator}, parallel=False), spp=samples).image
    recorded = fit.frame.light[first[1] : first[1] + size[1], first[0] : first[0] + size[0]]
    return recorded / np.nanmean(fit.brightness), simulated


@plots.styled
def white_figure(fit: WhiteFit) -> plots.Plot:
    """Return a figure of recorded and simulated pixels, the mean residual, and lenses off the warped array."""
    recorded, simulated = side_by_side(fit)
    peak = float(np.quantile(recorded, 0.999))
    difference = recorded - simulated
    plot = plots.Plot(12.3)
    upper, lower = plot.panels(2, 3, (recorded.shape[0] / recorded.shape[1], 1))
    plots.show(upper[0], recorded, "Recorded", peak=peak)
    plots.show(upper[1], simulated, "Simulated", peak=peak)
    # Difference, over the light in the middle of micro-images, that has the strongest colour.
    mesh = plots.show_difference(upper[2], difference, 0.06)
    plots.annotate(upper[2], title=f"Difference, {np.sqrt((difference**2).mean()):.1%} RMS")
    plot.colour_bar(mesh, upper[2], "of the light in the middle")
    middle = len(fit.judgement.difference) // 2
    half = round(fit.camera.micro_image_pitch / fit.camera.pixel_size)
    span = slice(middle - half, middle + half + 1)
    plots.show_difference(lower[0], fit.judgement.difference[span, span], 0.03)
    plots.annotate(
        lower[0], title=f"Mean micro-image, {fit.judgement.mean_image:.2%} RMS", foot="colours twice as strong"
    )
    _profile(lower[1], fit, recorded, simulated)
    rows, columns = fit.frame.light.shape
    off = np.hypot(*fit.off_array.T)
    x, y = fit.place.T
    marks = lower[2].scatter(x, y, c=off, s=8e4 / len(off) ** 1.1, cmap="viridis", vmin=0, vmax=0.3)
    side = max(rows, columns)
    lower[2].set(xlim=((columns - side) / 2, (columns + side) / 2), ylim=((rows + side) / 2, (rows - side) / 2))
    plots.annotate(lower[2], title="Lenses off the warped array")
    plot.colour_bar(marks, lower[2], "pixels")
    return plot


def _profile(axes: Axes, fit: WhiteFit, recorded: Array, simulated: Array) -> None:
    """Draw the light of micro-images over the distance from the lens's place."""
    rows, columns = recorded.shape
    left, top = ((full - cut) // 2 for full, cut in zip(fit.camera.resolution, (columns, rows), strict=True))
    y, x = np.mgrid[:rows, :columns]
    distance, lens = cKDTree(fit.place - fit.off_array).query(np.stack([x + left, y + top], axis=-1))
    bright = (fit.brightness / np.nanmean(fit.brightness))[lens]
    # Farther out, and at the picture's border, other lenses may be nearer.
    edges = np.arange(0, 0.6 * fit.camera.micro_image_pitch / fit.camera.pixel_size, 0.5)
    counts = np.maximum(np.histogram(distance, edges)[0], 1)
    axes.set_frame_on(True)
    images = {"recorded": (recorded, "o", "#d1495b"), "simulated": (simulated, "-", plots.INK)}
    for name, (image, style, colour) in images.items():
        mean = np.histogram(distance, edges, weights=image / bright)[0] / counts
        axes.plot(edges[:-1] + 0.25, mean, style, color=colour, markersize=4, label=name)
    axes.set(xlim=(0, edges[-1]), xticks=np.arange(0, edges[-1], 4), yticks=np.linspace(0, 1, 6))
    axes.tick_params(labelsize=8)
    axes.legend(frameon=False, fontsize=8)
    plots.annotate(axes, title="Mean over the distance from the lens", foot="pixels")
