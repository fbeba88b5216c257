"""Page on a camera fitted to its white picture: recorded and simulated pixels side by side."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from scipy.spatial import cKDTree

from ...light.render_capture import render_capture
from ...report.pages import Page, Picture, Section
from ...report.plots import INK, Plot, annotate, show, show_difference, styled
from ...runtime.backend import set_variant
from .fitted_camera import stray_fraction
from .white_fit import WhiteFit

_LENSES = 12
"""Lenses along a side of the pictures that are shown side by side."""

_SAMPLES = 128
"""Samples per pixel of the simulated capture."""

_LARGEST = 0.06
"""Difference, over the light in the middle of micro-images, that has the strongest colour."""

_REACH = 0.6
"""Distance from a lens, in pitches, to which its profile is drawn."""


def write_white_report(path: Path, found: WhiteFit, summary: list[str]) -> None:
    """Write the page, for which a part of the white picture is simulated through the fitted camera."""
    light = "rays" if found.wavelength is None else f"waves of {found.wavelength:g} nm"
    lead = f"Simulated by {light}, {_SAMPLES} samples per pixel, for {_LENSES} x {_LENSES} lenses in the middle."
    caption = "Recorded and simulated pixels of the white picture, their difference, and profiles."
    lines = Markup("<pre>{}</pre>").format("\n".join(summary))
    sections = [
        Section("Pictures", [Picture(white_figure(found).png(), caption)]),
        Section("Numbers", [lines]),
    ]
    Page("A camera fitted to its white picture", lead, sections).write(path)


def side_by_side(found: WhiteFit, samples: int = _SAMPLES) -> tuple[np.ndarray, np.ndarray]:
    """Return recorded and simulated light of the lenses in the middle, over the mean light in lenses' middles.

    Both have the shape (rows, columns). Simulated is an evenly white scene through the fitted camera, with its stray
    light.
    """
    set_variant(None)
    pitch = found.camera.micro_image_pitch / found.camera.pixel_size
    size = [min(round(_LENSES * pitch), full) for full in found.camera.resolution]
    first = [(full - part) // 2 for full, part in zip(found.camera.resolution, size, strict=True)]
    camera = found.camera.replace(crop_offset=tuple(first), crop_size=tuple(size))
    scene = {"type": "scene", "lamp": {"type": "constant"}, "camera": camera.to_sensor()}
    direct = {"type": "direct"}
    waves = {"type": "plenoptic_wave", "wavelength": found.wavelength, "child": direct}
    integrator = direct if found.wavelength is None else waves
    capture = render_capture(mi.load_dict(scene | {"integrator": integrator}, parallel=False), spp=samples).image
    simulated = capture + stray_fraction(found.camera, found.field) * capture.mean()
    recorded = found.frame.light[first[1] : first[1] + size[1], first[0] : first[0] + size[0]]
    return recorded / np.nanmean(found.brightness), simulated


@styled
def white_figure(found: WhiteFit) -> Plot:
    """Return a figure of recorded and simulated pixels, the mean residual, and lenses off the warped array."""
    recorded, simulated = side_by_side(found)
    peak, difference = float(np.quantile(recorded, 0.999)), recorded - simulated
    plot = Plot(12.3)
    upper, lower = plot.panels(2, 3, (recorded.shape[0] / recorded.shape[1], 1))
    show(upper[0], recorded, "Recorded", peak=peak)
    show(upper[1], simulated, "Simulated", peak=peak)
    drawn = show_difference(upper[2], difference, _LARGEST)
    annotate(upper[2], title=f"Difference, {np.sqrt((difference**2).mean()):.1%} RMS")
    plot.colour_bar(drawn, upper[2], "of the light in the middle")
    reach = found.camera.micro_image_pitch / found.camera.pixel_size
    middle, half = len(found.judgement.difference) // 2, round(reach)
    part = np.s_[middle - half : middle + half + 1, middle - half : middle + half + 1]
    show_difference(lower[0], found.judgement.difference[part], _LARGEST / 2)
    annotate(lower[0], title=f"Mean micro-image, {found.judgement.mean_image:.2%} RMS", foot="colours twice as strong")
    _profile(lower[1], found, recorded, simulated)
    rows, columns = found.frame.light.shape
    off = np.hypot(*found.off_array.T)
    x, y = found.place.T
    marks = lower[2].scatter(x, y, c=off, s=8e4 / len(off) ** 1.1, cmap="viridis", vmin=0, vmax=0.3)
    side = max(rows, columns)
    lower[2].set(xlim=((columns - side) / 2, (columns + side) / 2), ylim=((rows + side) / 2, (rows - side) / 2))
    annotate(lower[2], title="Lenses off the warped array")
    plot.colour_bar(marks, lower[2], "pixels")
    return plot


def _profile(axes: Axes, found: WhiteFit, recorded: np.ndarray, simulated: np.ndarray) -> None:
    """Draw the light of micro-images over the distance from the lens's place."""
    rows, columns = recorded.shape
    left, top = ((full - part) // 2 for full, part in zip(found.camera.resolution, (columns, rows), strict=True))
    y, x = np.mgrid[:rows, :columns]
    distance, lens = cKDTree(found.place - found.off_array).query(np.stack([x + left, y + top], axis=-1))
    bright = (found.brightness / np.nanmean(found.brightness))[lens]
    # Farther out, and at the picture's border, other lenses may be nearer.
    edges = np.arange(0, _REACH * found.camera.micro_image_pitch / found.camera.pixel_size, 0.5)
    bins = np.digitize(distance.ravel(), edges) - 1
    counts = np.maximum(np.bincount(bins, minlength=len(edges)), 1)
    axes.set_frame_on(True)
    for image, style, name in ((recorded, "o", "recorded"), (simulated, "-", "simulated")):
        mean = np.bincount(bins, (image / bright).ravel(), minlength=len(edges)) / counts
        axes.plot(
            edges[:-1] + 0.25, mean[:-1], style, color=INK if style == "-" else "#d1495b", markersize=4, label=name
        )
    axes.set(xlim=(0, edges[-1]), xticks=np.arange(0, edges[-1], 4), yticks=np.linspace(0, 1, 6))
    axes.tick_params(labelsize=8)
    axes.legend(frameon=False, fontsize=8)
    annotate(axes, title="Mean over the distance from the lens", foot="pixels")
