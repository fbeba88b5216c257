"""A drawing of a real main lens: its surfaces with rays, spots, and light and distortion over the field."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ..camera import PlenopticCamera
from ..errors import InputError
from ..lenses import main_lens, sequential
from ..prescription import LINE_C, LINE_D, LINE_F, height
from ..runtime import require_writable
from .plots import INK, Plot, bare, scale_bar, styled

_ACROSS = 301
"""Rays across the pupil."""


@dataclass(frozen=True)
class FieldFigures:
    """Effects of a main lens on light at one distance from the axis on the microlens array (MLA).

    Parameters
    ----------
    height : float
        Distance from the axis in millimetres.
    spot : float
        Root mean square radius of a point's image, projected onto the MLA, in millimetres; NaN where all is dark.
    light : float
        Open area of the exit pupil over the open area on the axis.
    distortion : float
        Displacement of a point's image away from the axis, by its chief ray against paraxial optics, over its distance.
    """

    height: float
    spot: float
    light: float
    distortion: float


# A drawing asks for it at every height.
@functools.lru_cache(maxsize=8)
def _reach(camera: PlenopticCamera) -> float:
    """Return the radius in mm of a circle that contains the exit pupil as seen from anywhere on the detector."""
    return float(main_lens(camera).reach)


def chief(
    camera: PlenopticCamera, wavelength: float | None, height: float, distance: float | None
) -> tuple[float, float]:
    """Return Y/g of the chief ray of a height on the MLA in an object plane, and Y in mm where the lens begins.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a real main lens.
    wavelength : float or None
        Wavelength in nanometres; None means the prescription's.
    height : float
        Distance from the axis on the MLA in millimetres.
    distance : float or None
        Distance g of the object plane in millimetres; None means the plane in focus.
    """
    lens = main_lens(camera, wavelength)
    slope = np.atleast_1d(lens.chief_slope(np.array([height])))
    (_, y, z), (_, t), _ = lens.trace((np.zeros(1), np.full(1, height)), (np.zeros(1), slope))
    nearness = _nearness(camera, distance)
    return float((y * nearness + (1 - z * nearness) * t)[0]), float((y + (lens.front - z) * t)[0])


def _nearness(camera: PlenopticCamera, distance: float | None = None) -> float:
    """Return the reciprocal of an object plane's distance in 1/mm; None means the plane in focus or, without, 0."""
    distance = camera.focus_distance if distance is None else distance
    return 1 / distance if distance > 0 else 0.0


def _passing(
    traced: Callable[[np.ndarray, np.ndarray], tuple[Any, ...]], middle: float, reach: float
) -> tuple[Any, np.ndarray, float]:
    """Return what is traced from a grid that rays through the lens fill, which of them pass, and their area.

    The grid lies about (0, `middle`), within `reach` of which all rays pass.
    """
    low = np.array([-reach, middle - reach])
    high = np.array([reach, middle + reach])
    # First grids are coarse, but for the ray in the middle; each is as wide as what passes the one before.
    for across in (65, 65, 65, _ACROSS):
        x, y = np.meshgrid(*np.linspace(low, high, across).T)
        result, is_open = traced(x.ravel(), y.ravel())
        step = (high - low) / (across - 1)
        if is_open.any() and across < _ACROSS:
            places = np.stack([x.ravel(), y.ravel()])[:, is_open]
            low = places.min(1) - step
            high = places.max(1) + step
    return result, is_open, float(is_open.sum() * step.prod())


def spot(
    camera: PlenopticCamera, height: float, wavelength: float, distance: float | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions and slopes on the MLA of the rays of one object point that pass the lens.

    The object point is where the chief ray of a position on the MLA meets the object plane. Its rays fill the stop.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a real main lens.
    height : float
        Distance of the position from the axis in millimetres.
    wavelength : float
        Wavelength in nanometres; the object point is that of the chief ray at the prescription's own.
    distance : float, optional
        Distance of the object plane in millimetres; may be infinite. Default: that in focus.

    Returns
    -------
    x, y : float64 arrays (n,)
        Positions in millimetres; y is along the direction from the axis.
    slopes : float64 array (2, n)
        dx/dz and dy/dz, z towards the scene.
    """
    seen, entered = chief(camera, None, height, distance)
    lens = main_lens(camera, wavelength)
    nearness = _nearness(camera, distance)

    def traced(x: np.ndarray, y: np.ndarray) -> tuple[Any, Any]:
        slope = (-x * nearness, seen - y * nearness)
        scale = 1 - lens.front * nearness
        place, turned, is_open, _ = lens.through((x, y, np.full_like(x, lens.front)), tuple(t / scale for t in slope))
        return np.array([*place, *turned]), is_open

    rays, is_open, _ = _passing(traced, entered, abs(entered) + 1.5 * lens.front_bounds[0])
    x, y, *slopes = rays[:, is_open]
    return x, y - height, np.array(slopes)


def lateral_colour(camera: PlenopticCamera, height: float, wavelengths: tuple[float, float]) -> float:
    """Return the difference in image height, in mm, between chief rays of the second and the first wavelength.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a real main lens.
    height : float
        Distance from the axis on the MLA in millimetres.
    wavelengths : (float, float)
        Wavelengths in nanometres.
    """
    first, second = (chief(camera, wavelength, height, None)[0] for wavelength in wavelengths)
    # What is seen farther out from the same position is imaged nearer to the axis.
    return camera.mla_distance * (second - first)


def ray_paths(camera: PlenopticCamera, height: float, count: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Return ray paths, in a plane with the axis, from a position on the MLA through all surfaces to before the lens.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a real main lens.
    height : float
        Distance of the position from the axis in millimetres.
    count : int
        Rays, evenly over what the lens lets through.

    Returns
    -------
    z, y : float64 arrays (surfaces + 1, count)
        Their positions in the camera frame, on the MLA and on each surface; NaN where no ray passes the lens.
    """
    lens = main_lens(camera)
    slopes = (np.linspace(-1, 1, _ACROSS) * _reach(camera) - height) / lens.pupil.distance
    _, _, is_open = lens.trace((0.0 * slopes, np.full_like(slopes, height)), (0.0 * slopes, slopes))
    passing = slopes[is_open] if is_open.any() else np.array([math.nan])
    slopes = np.linspace(passing[0], passing[-1], count)
    N = 1 / np.sqrt(1 + slopes**2)
    point = (0.0 * slopes, np.full(count, height / lens.scale), np.full(count, -lens.back_distance / lens.scale))
    direction = (0.0 * slopes, slopes * N, N)
    vertex = lens.front / lens.scale - lens.numbers.length
    z = [vertex + point[2]]
    y = [point[1]]
    surfaces = sequential.elements(
        lens.prescription, lens.prescription.wavelength, stop_radius=lens.stop_radius, backwards=True
    )
    for surface in surfaces:
        vertex += surface.gap
        point, direction, _, _ = sequential.follow([surface], point, direction)
        # A plane has a single height.
        z.append(vertex + point[2] + 0.0 * slopes)
        y.append(point[1])
    return lens.scale * np.array(z), lens.scale * np.array(y)


def field_figures(
    camera: PlenopticCamera, heights: tuple[float, ...], distance: float | None = None
) -> list[FieldFigures]:
    """Return the field figures of a real main lens, from rays that fill its stop.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; where no real plane is in focus, infinitely far points are taken.
    heights : tuple of float
        Distances from the axis on the MLA in millimetres.
    distance : float, optional
        Distance of the object plane in millimetres. Default: that in focus.

    Returns
    -------
    list of FieldFigures
        The figures of each height.
    """
    lens = main_lens(camera)
    figures: list[FieldFigures] = []
    area = 1.0
    for field in (0.0, *heights):

        def traced(x: np.ndarray, y: np.ndarray, field: float = field) -> tuple[Any, Any]:
            return None, lens.ray((x, y), (0 * x, field + 0 * x))[2]

        middle = field + lens.pupil.distance * float(lens.chief_slope(np.array([field]))[0])
        passing = _passing(traced, middle, abs(middle) + _reach(camera))[2]
        x, y, _ = spot(camera, field, lens.light, distance)
        radius = math.sqrt(np.var(x) + np.var(y)) if x.size else math.nan
        distortion = -field / (camera.mla_distance * chief(camera, None, field, distance)[0]) - 1 if field else 0.0
        figures.append(FieldFigures(field, radius, passing / area, distortion))
        area = (passing or 1.0) if len(figures) == 1 else area
    return figures[1:]


_FIELDS = (0.0, 0.7, 1.0)
"""Field heights that are drawn, over the distance of the detector's corner from the axis."""

_RAYS = ("#1b6ca8", "#2a8f52", "#b8442e")
"""Colours of the rays to each of them."""


@styled
def draw_main_lens(path: Path, camera: PlenopticCamera, distance: float | None = None) -> None:
    """Draw the main lens of a camera into a PNG or PDF.

    Parameters
    ----------
    path : Path
        The file.
    camera : PlenopticCamera
        A camera with a real main lens.
    distance : float, optional
        Distance in millimetres of the objects whose spots are drawn. Default: that in focus.
    """
    require_writable(path, ".png", ".pdf")
    if camera.prescription is None:
        raise InputError(f"{path}: the camera has no main_lens of surfaces that could be drawn")
    corner = math.hypot(camera.detector_width, camera.detector_height) / 2
    plot = Plot(10.6, 7.4)
    rows = plot.add_gridspec(2, 1, height_ratios=(3.6, 2.8))
    _surfaces(bare(plot.add_subplot(rows[0])), camera, corner, camera.prescription.name or "main lens")
    *spots, light, distortion = rows[1].subgridspec(1, 5, width_ratios=(2, 2, 2, 1.6, 1.6)).subplots(squeeze=False)[0]
    largest = max([_spot(axes, camera, part * corner, distance) for axes, part in zip(spots, _FIELDS, strict=True)])
    for axes in spots:
        axes.set_xlim(-1.1 * largest, 1.1 * largest)
        axes.set_ylim(-1.1 * largest, 1.1 * largest)
    scale_bar(spots[0], 2200 * largest, below=True, unit="um")
    spots[-1].legend(fontsize=6, loc="upper left", bbox_to_anchor=(1, 1), frameon=False, markerscale=4, handletextpad=0)
    _curves(light, distortion, camera, corner, distance)
    plot.save(path)


@styled
def camera_figure(camera: PlenopticCamera) -> Plot:
    """Return a figure of a camera whose main lens forms an image, from the side, with rays of a point in focus."""
    plot = Plot(6.0, 1.8, dpi=100)
    axes = bare(plot.subplots())
    corner = math.hypot(camera.detector_width, camera.detector_height) / 2
    if camera.prescription is not None:
        _surfaces(axes, camera, corner, camera.prescription.name or "main lens")
        return plot
    heights = camera.aperture_radius * np.linspace(-1, 1, 5)
    start = -1 / max(_nearness(camera), 1 / (1.5 * camera.mla_distance))
    rays = [heights * (1 + start * _nearness(camera)), heights, 0 * heights]
    axes.plot([start, 0, camera.mla_distance], rays, color=_RAYS[0], lw=0.7)
    ends = np.array([camera.aperture_radius, corner])
    axes.vlines([0, camera.mla_distance], -ends, ends, color=INK, lw=2)
    scale_bar(axes, float(np.ptp(axes.get_xlim())), below=True)
    return plot


def _surfaces(axes: Axes, camera: PlenopticCamera, corner: float, name: str) -> None:
    """Draw a lens's glasses and stop, with rays from the axis, 0.7 of the field and the corner."""
    lens = main_lens(camera)
    surfaces = lens.forwards
    # From the scene to the array z falls.
    vertices = lens.front - lens.scale * np.cumsum([surface.gap for surface in surfaces])
    profiles = []
    for surface, vertex, described in zip(surfaces, vertices, lens.prescription.surfaces, strict=True):
        radius = np.linspace(-1, 1, 65) * described.semi_aperture
        profiles.append((vertex - lens.scale * height(surface, radius**2), lens.scale * radius))
    for index, described in enumerate(lens.prescription.surfaces):
        z, y = profiles[index]
        stop = index == lens.prescription.stop
        if described.glass is not None:
            behind, below = profiles[index + 1]
            outline = np.concatenate([z, behind[::-1]]), np.concatenate([y, below[::-1]])
            axes.fill(*outline, facecolor="#dfeaf3", edgecolor=INK, linewidth=0.8)
        if stop:
            edge = float(np.max(np.abs(y)))
            open_to = float(lens.scale * lens.stop_radius)
            for side in (-1, 1):
                axes.plot([z[32]] * 2, [side * open_to, side * 1.15 * edge], color=INK, linewidth=2.5)
    reach = 0.25 * camera.mla_distance
    for fraction, colour in zip(_FIELDS, _RAYS, strict=True):
        z, y = ray_paths(camera, fraction * corner)
        slope = (np.zeros(z.shape[1]), (y[1] - y[0]) / (z[1] - z[0]))
        (_, last, front), (_, turned), _ = lens.trace((slope[0], y[0]), slope)
        end = lens.front + reach
        axes.plot(
            np.vstack([z, [end] * z.shape[1]]), np.vstack([y, last + turned * (end - front)]), color=colour, lw=0.7
        )
    array = float(vertices[-1]) - float(lens.back_distance)
    axes.plot([array] * 2, [-corner, corner], color=INK, linewidth=2)
    axes.invert_xaxis()
    axes.set_aspect("equal")
    scale_bar(axes, abs(float(np.diff(axes.get_xlim())[0])), below=True)
    right = "microlenses" if camera.has_array else "detector"
    sizes = f"f = {camera.focal_length:.4g} mm, f/{camera.f_number:.3g}, {right} at the right"
    axes.set_title(f"{name}: {sizes}", size=10, color=INK, loc="left")


def _spot(axes: Axes, camera: PlenopticCamera, height: float, distance: float | None) -> float:
    """Draw the points at which rays of an object point meet the MLA, and return the largest coordinate in mm."""
    largest = 0.0
    colours = ("#2463d6", "#d9a400", "#d03b2f")
    lens = camera.prescription
    lines = {"F": LINE_F, "d": LINE_D, "C": LINE_C}
    if lens is not None and lens.wavelengths:
        lines = {f"{w:.4g} nm": w for w in (min(lens.wavelengths), lens.wavelength, max(lens.wavelengths))}
    for (line, wavelength), colour in zip(lines.items(), colours, strict=False):
        x, y, _ = spot(camera, height, wavelength, distance)
        # A regular choice of a regular grid would be a coarse grid, and show patterns that the spot does not have.
        some = np.random.default_rng(0).permutation(x.size)[:600]
        axes.plot(x[some], y[some], ".", color=colour, markersize=1.2, label=line)
        largest = max([largest, *np.abs(x), *np.abs(y)])
    bare(axes).set_aspect("equal")
    axes.set_title(f"spot at {height:.3g} mm", size=9, color=INK, loc="left")
    if camera.has_array:
        cell = camera.row_pitch
        axes.plot(np.array([-1, 1, 1, -1, -1]) * cell / 2, np.array([-1, -1, 1, 1, -1]) * cell / 2, color=INK, lw=0.6)
        axes.set_xlabel(f"square: a microlens, {1e3 * cell:.3g} um", size=7, color=INK)
        largest = max(largest, cell / 2)
    return largest


def _curves(light: Axes, distortion: Axes, camera: PlenopticCamera, corner: float, distance: float | None) -> None:
    """Draw light and distortion over the field."""
    figures = field_figures(camera, tuple((corner * np.linspace(0, 1, 13)).tolist()), distance)
    heights = [field_height.height for field_height in figures]
    for axes, values, title in (
        (light, [100 * field_height.light for field_height in figures], "light, %"),
        (distortion, [100 * field_height.distortion for field_height in figures], "distortion, %"),
    ):
        axes.plot(values, heights, color=_RAYS[0])
        axes.set_title(title, size=9, color=INK, loc="left")
        axes.set_ylabel("mm from the axis", size=7, color=INK)
        axes.xaxis.set_major_locator(MaxNLocator(2))
        axes.yaxis.set_major_locator(MaxNLocator(4))
        axes.tick_params(labelsize=7, color=INK, labelcolor=INK)
    light.set_xlim(0, max(105, *(105 * field_height.light for field_height in figures)))
