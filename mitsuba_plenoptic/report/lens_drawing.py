"""A drawing of a real main lens: its surfaces with rays, spots, and light and distortion over the field."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ..camera import PlenopticCamera
from ..errors import InputError
from ..io.files import require_writable
from ..optics.lens_figures import field_figures, ray_paths, spot
from ..optics.lens_system import LensSystem
from ..prescription.data import height
from ..prescription.glass import LINE_C, LINE_D, LINE_F
from .drawing import Canvas

_FIELDS = (0.0, 0.7, 1.0)
"""Places that are drawn, over the distance of the detector's corner from the axis."""

_RAYS = ("#1b6ca8", "#2a8f52", "#b8442e")
"""Colours of the rays to each of them."""

_LINES = {"F": (LINE_F, "#2463d6"), "d": (LINE_D, "#d9a400"), "C": (LINE_C, "#d03b2f")}
"""Wavelengths of the spots, by the names of their lines, and their colours."""

_HEIGHTS = 13
"""Places for which curves are computed."""

_INK, _GLASS = "#1b1f24", "#dfeaf3"


def draw_main_lens(path: Path, camera: PlenopticCamera) -> None:
    """Draw the main lens of a camera into a PNG.

    Parameters
    ----------
    path : Path
        The file.
    camera : PlenopticCamera
        A camera with a real main lens.

    Raises
    ------
    InputError
        If its main lens is thin, the file is no PNG by its name, or it cannot be written.
    """
    require_writable(path, ".png")
    if camera.prescription is None:
        raise InputError(f"{path}: the camera has no main_lens of surfaces that could be drawn")
    corner = math.hypot(camera.detector_width, camera.detector_height) / 2
    canvas = Canvas(10.6, 7.4)
    name = camera.prescription.name or "main lens"
    _surfaces(canvas.axes(0.3, 0.5, 10.0, 3.3), camera, corner, name)
    for number, part in enumerate(_FIELDS):
        _spot(canvas.axes(0.5 + 2.1 * number, 4.6, 1.8, 1.8), camera, part * corner)
    _curves(canvas.axes(7.3, 4.6, 1.1, 2.1), canvas.axes(9.1, 4.6, 1.1, 2.1), camera, corner)
    canvas.save(path)


def _surfaces(axes: Axes, camera: PlenopticCamera, corner: float, name: str) -> None:
    """Draw glasses, stop and rays from the axis, 0.7 of the field and the corner."""
    lens = LensSystem.of(camera)
    surfaces = lens.forwards
    # From the scene to the array z falls.
    vertices = lens.front - lens.scale * np.cumsum([surface.gap for surface in surfaces])
    profiles = []
    for surface, vertex, given in zip(surfaces, vertices, lens.prescription.surfaces, strict=True):
        radius = np.linspace(-1, 1, 65) * given.semi_aperture
        profiles.append((vertex - lens.scale * height(surface, radius**2), lens.scale * radius))
    for number, given in enumerate(lens.prescription.surfaces):
        (z, y), stop = profiles[number], number == lens.prescription.stop
        if given.glass is not None:
            behind, below = profiles[number + 1]
            outline = np.concatenate([z, behind[::-1]]), np.concatenate([y, below[::-1]])
            axes.fill(*outline, facecolor=_GLASS, edgecolor=_INK, linewidth=0.8)
        if stop:
            edge, open_to = float(np.max(np.abs(y))), float(lens.scale * lens.stop_radius)
            for side in (-1, 1):
                axes.plot([z[32]] * 2, [side * open_to, side * 1.15 * edge], color=_INK, linewidth=2.5)
    reach = 0.25 * camera.mla_distance
    for part, colour in zip(_FIELDS, _RAYS, strict=True):
        z, y = ray_paths(camera, part * corner)
        slope = (np.zeros(z.shape[1]), (y[1] - y[0]) / (z[1] - z[0]))
        (_, last, front), (_, turned), _ = lens.trace((slope[0], y[0]), slope)
        end = lens.front + reach
        axes.plot(
            np.vstack([z, [end] * z.shape[1]]), np.vstack([y, last + turned * (end - front)]), color=colour, lw=0.7
        )
    array = float(vertices[-1]) - float(lens.back_distance)
    axes.plot([array] * 2, [-corner, corner], color=_INK, linewidth=2)
    axes.invert_xaxis()
    axes.set_aspect("equal", adjustable="datalim")
    sizes = f"f = {camera.focal_length:.4g} mm, f/{camera.f_number:.3g}, microlenses at the right"
    axes.set_title(f"{name}: {sizes}", size=10, color=_INK, loc="left")


def _spot(axes: Axes, camera: PlenopticCamera, height: float) -> None:
    """Draw where the rays of a point meet the MLA, in three colours."""
    largest = 0.5 * camera.mla_pitch
    for line, (wavelength, colour) in _LINES.items():
        x, y = spot(camera, height, wavelength)
        some = slice(None, None, max(1, len(x) // 600))
        axes.plot(x[some], y[some], ".", color=colour, markersize=1.2, label=line)
        largest = max([largest, *np.abs(x), *np.abs(y)])
    pitch = camera.mla_pitch
    axes.plot(np.array([-1, 1, 1, -1, -1]) * pitch / 2, np.array([-1, -1, 1, 1, -1]) * pitch / 2, color=_INK, lw=0.6)
    axes.set_xlim(-1.1 * largest, 1.1 * largest)
    axes.set_ylim(-1.1 * largest, 1.1 * largest)
    axes.set_aspect("equal")
    axes.set_title(f"spot at {height:.3g} mm", size=9, color=_INK, loc="left")
    axes.set_xlabel(f"square: a microlens, {1e3 * pitch:.3g} um", size=7, color=_INK)
    axes.legend(fontsize=6, loc="upper right", frameon=False, markerscale=4, handletextpad=0, borderpad=0)


def _curves(light: Axes, distortion: Axes, camera: PlenopticCamera, corner: float) -> None:
    """Draw light and distortion over the field."""
    figures = field_figures(camera, tuple((corner * np.linspace(0, 1, _HEIGHTS)).tolist()))
    heights = [each.height for each in figures]
    for axes, values, title in (
        (light, [100 * each.light for each in figures], "light, %"),
        (distortion, [100 * each.distortion for each in figures], "distortion, %"),
    ):
        axes.set_frame_on(True)
        axes.plot(values, heights, color=_RAYS[0])
        axes.set_title(title, size=9, color=_INK, loc="left")
        axes.set_ylabel("mm from the axis", size=7, color=_INK)
        axes.xaxis.set_major_locator(MaxNLocator(2))
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.tick_params(labelsize=7, color=_INK, labelcolor=_INK)
    light.set_xlim(0, 105)
