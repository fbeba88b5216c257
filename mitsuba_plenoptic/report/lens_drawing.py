"""A drawing of a real main lens: its surfaces with rays, spots, and light and distortion over the field."""

import math

import numpy as np
from matplotlib.axes import Axes

from ..camera import PlenopticCamera
from ..lenses import RealLens, main_lens
from ..prescription import LINE_C, LINE_F, height
from .lens_quality import FIELDS, FieldFigures, field_figures, ray_paths
from .plots import INK, Plot, bare, ruled, scale_bar, styled

_RAYS = ("#1b6ca8", "#2a8f52", "#b8442e")
"""Colours of the rays to each of the fields."""


@styled
def main_lens_figure(lens: RealLens, distance: float, cell: float = 0.0) -> Plot:
    """Return a figure of a main lens with its rays and spots, and with light and distortion over the field.

    Parameters
    ----------
    lens : RealLens
        The main lens.
    distance : float
        Distance in millimetres of the objects whose spots are drawn; where it is negative, infinity.
    cell : float
        Pitch in millimetres of a microlens, which is drawn around the spots; 0: there are none.
    """
    plot = Plot(10.6, 7.4)
    rows = plot.add_gridspec(2, 1, height_ratios=(3.6, 2.8))
    _surfaces(bare(plot.add_subplot(rows[0])), lens, "microlenses" if cell else "image plane")
    *spots, light, distortion = rows[1].subgridspec(1, 5, width_ratios=(2, 2, 2, 1.6, 1.6)).subplots(squeeze=False)[0]
    used = lens.prescription.wavelengths or (LINE_F, LINE_C)
    lines = min(used), lens.light, max(used)
    fields = field_figures(lens, [part * lens.corner for part in FIELDS], distance, lines)
    # Where all is dark, positions are NaN.
    positions = np.hstack([rays[:2] for field in fields for rays in field.rays.values()])
    largest = float(np.fmax.reduce(np.abs(positions), axis=None, initial=cell / 2))
    for axes, field in zip(spots, fields, strict=True):
        _spot(axes, field, cell)
        axes.axis((-1.1 * largest, 1.1 * largest) * 2)
    scale_bar(spots[0], 2200 * largest, below=True, unit="um")
    if cell:
        spots[-1].set_xlabel(f"squares: a microlens, {1e3 * cell:.3g} um", size=7, color=INK)
    spots[-1].legend(fontsize=6, loc="upper left", bbox_to_anchor=(1, 1), frameon=False, markerscale=4, handletextpad=0)
    heights = lens.corner * np.linspace(0, 1, 13)
    fields = field_figures(lens, heights.tolist(), distance, [])
    light.plot([100 * field.light for field in fields], heights, color=_RAYS[0])
    light.set_xlim(0, max(105, *(105 * field.light for field in fields)))
    distortion.plot([100 * field.distortion for field in fields], heights, color=_RAYS[0])
    for axes, title in ((light, "light, %"), (distortion, "distortion, %")):
        ruled(axes, title, "", "mm from the axis", ticks=3)
    return plot


@styled
def camera_figure(camera: PlenopticCamera) -> Plot:
    """Return a figure of a camera whose main lens forms an image, from the side, with rays of a point in focus."""
    plot = Plot(6.0, 1.8, dpi=100)
    axes = bare(plot.subplots())
    if camera.prescription is not None:
        _surfaces(axes, main_lens(camera), "microlenses" if camera.has_array else "detector")
        return plot
    corner = math.hypot(camera.detector_width, camera.detector_height) / 2
    heights = camera.aperture_radius * np.linspace(-1, 1, 5)
    nearness = max(0.0, 1 / camera.focus_distance)
    start = -1 / max(nearness, 1 / (1.5 * camera.mla_distance))
    rays = [heights * (1 + start * nearness), heights, 0 * heights]
    axes.plot([start, 0, camera.mla_distance], rays, color=_RAYS[0], lw=0.7)
    ends = np.array([camera.aperture_radius, corner])
    axes.vlines([0, camera.mla_distance], -ends, ends, color=INK, lw=2)
    scale_bar(axes, float(np.ptp(axes.get_xlim())), below=True)
    return plot


def _surfaces(axes: Axes, lens: RealLens, image: str) -> None:
    """Draw a lens's glasses and stop, with rays from the axis, 0.7 of the field and the corner of the image."""
    described = lens.prescription
    # From the scene to the array z falls.
    vertices = lens.front - lens.scale * np.cumsum([surface.gap for surface in lens.forwards])
    profiles = []
    for surface, vertex in zip(described.surfaces, vertices, strict=True):
        radius = np.linspace(-1, 1, 65) * surface.semi_aperture
        profiles.append(np.array([vertex - lens.scale * height(surface, radius**2), lens.scale * radius]))
    for index, surface in enumerate(described.surfaces):
        if surface.glass is not None:
            outline = np.hstack([profiles[index], profiles[index + 1][:, ::-1]])
            axes.fill(*outline, facecolor="#dfeaf3", edgecolor=INK, linewidth=0.8)
    z, y = profiles[described.stop]
    edges = np.outer([lens.scale * lens.stop_radius, 1.15 * y[-1]], [-1, 1])
    axes.plot([z[32]] * 2, edges, color=INK, linewidth=2.5)
    for fraction, colour in zip(FIELDS, _RAYS, strict=True):
        axes.plot(*ray_paths(lens, fraction * lens.corner), color=colour, lw=0.7)
    axes.plot([vertices[-1] - lens.back_distance] * 2, [-lens.corner, lens.corner], color=INK, linewidth=2)
    axes.invert_xaxis()
    axes.set_aspect("equal")
    scale_bar(axes, float(abs(np.ptp(axes.get_xlim()))), below=True)
    title = f"{described.name or 'main lens'}: f = {lens.focal_length:.4g} mm, {image} at the right"
    axes.set_title(title, size=10, color=INK, loc="left")


def _spot(axes: Axes, field: FieldFigures, cell: float) -> None:
    """Draw the points at which rays of an object point meet the MLA, by wavelength, with a microlens around them."""
    for (wavelength, rays), colour in zip(field.rays.items(), ("#2463d6", "#d9a400", "#d03b2f"), strict=False):
        # A regular choice of a regular grid would be a coarse grid, and show patterns that the spot does not have.
        x, y, *_ = np.random.default_rng(0).permutation(rays, axis=1)[:, :600]
        axes.plot(x, y, ".", color=colour, markersize=1.2, label=f"{wavelength:.4g} nm")
    bare(axes).set_aspect("equal")
    axes.set_title(f"spot at {field.height:.3g} mm", size=9, color=INK, loc="left")
    if cell:
        corners = np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])
        axes.plot(*corners * cell / 2, color=INK, lw=0.6)
