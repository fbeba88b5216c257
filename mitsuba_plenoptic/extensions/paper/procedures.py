"""The paper's figures 1 and 3, the setup and both reconstruction paths, drawn from the camera's parameters."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse, FancyArrowPatch

from ...camera import PlenopticCamera
from ...optics import rays
from ...prescription import lens_data
from ...rays import follow_back
from ...report import plots
from ...runtime import Array, Pair

_LIGHT = "#d08700"
_RAYS = 7
"""Rays through the pupil, or pixels of a micro-image, that are drawn."""

_BEHIND = 0.08
"""Distance between array and detector as drawn, over that between main lens and array; it is too short to be seen."""


def light_path(camera: PlenopticCamera, point: Pair, pupil: Array) -> Array:
    """Return rays from an object point (X, g) through points of the pupil to the array.

    Returns
    -------
    array (rays, 3, 2)
        Positions (z, x) of each ray at the object, the main lens and the microlens array; z is 0 at the main lens and
        positive towards the detector.
    """
    X, g = point
    m = rays.mla_point(X, pupil, g, camera.mla_distance, camera.focal_length)
    along = np.broadcast_to([-g, 0.0, camera.mla_distance], (len(pupil), 3))
    return np.stack([along, np.stack([np.full_like(pupil, X), pupil, m], axis=-1)], axis=-1)


def back_path(camera: PlenopticCamera, lens: float, pixels: Array, distance: float) -> Array:
    """Return rays from pixels through a lens's centre, traced back to an object plane.

    Returns
    -------
    array (pixels, 4, 2)
        Positions (z, x) of each ray at the detector, the lens's centre, the main lens and the object plane.
    """
    b = camera.mla_distance
    P, position = follow_back(pixels, lens, lens, distance, camera)
    along = np.broadcast_to([b + camera.detector_distance, b, 0.0, -distance], (len(pixels), 4))
    across = [pixels, np.full_like(pixels, lens), P, -position * distance / b]
    return np.stack([along, np.stack(across, axis=-1)], axis=-1)


def micro_image(camera: PlenopticCamera, lens: float) -> Array:
    """Return detector points across a lens's micro-image, between the ends of the pupil."""
    half = camera.aperture_radius * camera.detector_distance / camera.mla_distance
    return rays.chief_detector_point(camera, lens) + np.linspace(-half, half, _RAYS)


@plots.styled
def figure_1(path: Path, camera: PlenopticCamera, objects: Mapping[str, float], pdf: bool) -> None:
    """Draw the paper's figure 1: the setup, with rays from a point of each object to the array."""
    far = max(objects.values())
    b = camera.mla_distance
    plot = plots.Plot(10.5, 4.7)
    axes = plot.subplots()
    _axis(axes, (-1.12 * far, 1.25 * b), 2.0 * camera.aperture_radius)
    axes.set_title("Setup; heights are enlarged", size=10, color=plots.INK, loc="left", pad=6)
    pupil = np.linspace(-1, 1, _RAYS) * camera.aperture_radius
    for index, (name, distance) in enumerate(objects.items()):
        height = 0.4 * camera.aperture_radius * (1 - index)
        for path_ in light_path(camera, (height, distance), pupil):
            axes.plot(*path_.T, color=f"C{index}", linewidth=0.7, alpha=0.8)
        top = (1 + 0.3 * index) * camera.aperture_radius
        axes.plot([-distance] * 2, [-camera.aperture_radius, top], color=plots.FAINT, linewidth=1)
        image = lens_data.image_distance(camera.focal_length, distance)
        axes.annotate(
            f"{name}, g = {distance:g} mm\nimage at {image:.4g} mm", (-distance, top), (0, 4),
            textcoords="offset points", ha="center", va="bottom", size=7, color=f"C{index}",
        )  # fmt: skip
    _main_lens(axes, camera)
    _array(axes, camera)
    below = -1.25 * camera.aperture_radius
    axes.annotate("", (b, below), (0, below), arrowprops={"arrowstyle": "<->", "color": plots.FAINT, "linewidth": 0.8})
    axes.text(b / 2, below, f"b = {b:g} mm", ha="center", va="bottom", size=8, color=plots.FAINT)
    plot.save_both(path, pdf)


@plots.styled
def figure_3(path: Path, camera: PlenopticCamera, distance: float, pdf: bool) -> None:
    """Draw the paper's figure 3: reconstruction back to an object plane, by rays and by waves."""
    plot = plots.Plot(10.5, 5.6)
    axes, steps = plot.subplots(2, 1, height_ratios=(3.2, 1.3))
    _axis(axes, (-1.1 * distance, 1.25 * camera.mla_distance), 1.6 * camera.aperture_radius)
    axes.set_title(f"(a)  By rays: each pixel through the centre of its lens, to {distance:g} mm", size=10, loc="left")
    for index, lens in enumerate((-3.0, 0.0, 3.0)):
        centre = lens * camera.row_pitch
        for path_ in back_path(camera, centre, micro_image(camera, centre), distance):
            axes.plot(*_stretched(path_, camera).T, color=f"C{index}", linewidth=0.7)
    axes.plot([-distance] * 2, [-camera.aperture_radius, camera.aperture_radius], color=plots.FAINT, linewidth=1)
    _main_lens(axes, camera)
    _array(axes, camera)
    _waves(steps, camera, distance)
    plot.save_both(path, pdf)


def _waves(axes: Axes, camera: PlenopticCamera, distance: float) -> None:
    """Draw the steps of the wave reconstruction, from the detector on the right to the object on the left."""
    plots.bare(axes).set(xlim=(0, 1), ylim=(0, 1))
    axes.set_title("(b)  By waves: one field for all lenses, or one for each subset, whose intensities are added",
                   size=10, loc="left")  # fmt: skip
    steps = (
        ("detector", r"$\sqrt{I}\;e^{-i\pi|p-c|^2/\lambda z}$", f"z = {camera.detector_distance:g} mm"),
        ("microlenses", r"$e^{-i\pi|m-c|^2/\lambda f_2}$", f"$f_2$ = {camera.mla_focal_lengths[0]:g} mm"),
        ("main lens", r"$e^{-i\pi P^2/\lambda f_1}$, pupil", f"$f_1$ = {camera.focal_length:g} mm"),
        ("object plane", r"$|U|^2$, summed over bins", f"g = {distance:g} mm"),
    )
    between = f"free space {steps[0][2]}", f"b = {camera.mla_distance:g} mm", steps[3][2]
    middles = np.linspace(0.9, 0.1, len(steps))
    for middle, (name, formula, value) in zip(middles, steps, strict=True):
        box = {"boxstyle": "round,pad=0.5", "facecolor": "#f4f6f8", "edgecolor": plots.FAINT}
        axes.text(
            middle, 0.6, f"{name}\n{formula}\n{value}", ha="center", va="center", size=9, color=plots.INK, bbox=box
        )
    for first, second, text in zip(middles, middles[1:], between, strict=False):
        axes.add_patch(FancyArrowPatch((first - 0.085, 0.6), (second + 0.085, 0.6), arrowstyle="->", mutation_scale=12,
                                       color=_LIGHT))  # fmt: skip
        axes.text((first + second) / 2, 0.1, f"angular spectrum,\n{text}", ha="center", size=7.5, color=_LIGHT)


def _axis(axes: Axes, along: Pair, across: float) -> None:
    """Draw the optical axis of a setup, within limits along it and across."""
    plots.bare(axes).set(xlim=along, ylim=(-across, across))
    axes.axhline(0, color=plots.FAINT, linewidth=0.5, linestyle="dashdot")


def _stretched(points: Array, camera: PlenopticCamera) -> Array:
    """Return points with the detector moved away from the array, so that drawings show the space between."""
    (_, pixel), (array, lens) = points[:2]
    detector = (1 + _BEHIND) * camera.mla_distance
    # Enlarged about the lens, so that rays go straight on.
    enlarged = lens + (pixel - lens) * (detector - array) / camera.detector_distance
    return np.array([(detector, enlarged), *points[1:]])


def _main_lens(axes: Axes, camera: PlenopticCamera) -> None:
    radius = camera.aperture_radius
    width = 0.06 * camera.mla_distance
    axes.add_patch(Ellipse((0, 0), width, 2 * radius, facecolor="#dbe9f6", edgecolor=plots.INK, linewidth=0.8))
    text = f"main lens\n$f_1$ = {camera.focal_length:g} mm\n$D_1$ = {2 * radius:g} mm"
    axes.annotate(
        text, (0, radius), (0, 4), textcoords="offset points", ha="center", va="bottom", size=7, color=plots.INK
    )


def _array(axes: Axes, camera: PlenopticCamera) -> None:
    b = camera.mla_distance
    half = camera.detector_width / 2
    axes.plot([b, b], [-half, half], color=plots.INK, linewidth=2.5)
    detector = (1 + _BEHIND) * b
    axes.plot([detector] * 2, [-half, half], color=plots.INK, linewidth=1)
    columns, rows = camera.bin_count
    text = (
        f"{columns} x {rows} microlenses,\n"
        f"$D_2$ = {camera.row_pitch:g} mm, $f_2$ = {camera.mla_focal_lengths[0]:g} mm;\n"
        f"detector {camera.detector_distance:g} mm behind,\n{camera.resolution[0]} x {camera.resolution[1]} pixels of "
        f"{1000 * camera.pixel_size:.3g} µm"
    )
    axes.annotate(
        text, (detector, half), (0, 4), textcoords="offset points", ha="right", va="bottom", size=7, color=plots.INK
    )
