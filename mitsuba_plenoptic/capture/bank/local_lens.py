r"""A real main lens as each microlens sees it: like a thin one there, whose table of coefficients serves it.

What a microlens makes of a point's light depends on the light about that lens alone: on the curvature of its wavefront,
and on the nearest edge of the pupil. With M the map of the point's rays from the exit pupil to the array, and J its
derivatives at P, the light that comes from there has at :math:`M(P)` the curvature

.. math:: (1 - J^{-1}) / b,

and ripples like those of a knife edge across which, at the distance d from P on the pupil, the phase has changed by
:math:`\pi \, d^T J \, d / \lambda b` (Goodman, "Introduction to Fourier Optics", sections 4.4 and 4.5, with the second
derivatives of the path). A perfect wave that converges through a round pupil has both with :math:`J = 1 - b v`, v its
vergence. So the real lens's light is found in the table of such waves: at the vergence of the same mean curvature, and
as many pitches from the edge on the array.

Left out is that the two curvatures differ by the aberrations' astigmatism, and that edges are curved otherwise.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...errors import InputError
from ...optics.fitted_lens import FAR, farthest_points, lens_of_waves
from ...optics.lens_light import LensLight
from ...optics.lens_system import LensSystem
from ...optics.pupil_fit import Pupils

POWERLESS = 1e9
"""Focal length, in millimetres, of the thin lens in the table: light comes to it converging, and stays as it is."""

_FIELDS, _ACROSS = 7, 21
"""Points along the field, and places across the pupil, at which the blur is compared with that near the axis."""

_STEP = 1e-3
"""Step on the pupil, over its radius, by which derivatives are found."""

_BLUR = 8.0
"""Lenses of blur, on both sides of focus, at which that is done: there the bank begins to be used."""

LINES = 486.1327, 656.2725
"""Wavelengths in nanometres between which dispersion counts, beside a lens's own: the lines F and C."""

TOLERANCE = 0.25
"""Lenses by which light of other wavelengths may be blurred less than theirs."""

_NEAREST = 0.1
"""Distance of the nearest points that count from the lens's front and from its entrance pupil, over focal lengths."""


def local_camera(camera: PlenopticCamera) -> PlenopticCamera:
    """Return the camera whose bank serves a camera: itself, or one with a thin lens for a real one's exit pupil."""
    if camera.prescription is None:
        return camera
    return camera.replace(
        main_lens=None,
        focal_length=POWERLESS,
        mla_distance=camera.pupil_distance,
        aperture_radius=camera.pupil_radius,
    )


def at_pupil(camera: PlenopticCamera, vergence: Any) -> Any:
    """Return vergences from the exit pupil of images whose vergences from the rear principal plane are given."""
    return vergence / (1 + vergence * (camera.pupil_distance - camera.mla_distance))


def derivatives(light: LensLight, pupil: tuple[Any, Any], step: float) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Return the derivatives, by Px and Py, of x and of y where rays through places of the exit pupil come."""
    x, y = pupil
    along, across = (
        [
            (high - low) * (0.5 / step)
            for high, low in zip(light.land(ahead, None), light.land(behind, None), strict=True)
        ]
        for ahead, behind in (((x + step, y), (x - step, y)), ((x, y + step), (x, y - step)))
    )
    return (along[0], across[0]), (along[1], across[1])


@dataclass(frozen=True)
class Spread:
    """By how much points are blurred otherwise, by places on pupil and detector and wavelength, than near the axis.

    Attributes
    ----------
    less : (float, float)
        Lenses by which they are blurred less, at most, before focus and behind it (of positive and negative blur).
    most : float
        Lenses by which they are blurred less or more, at most.
    """

    less: tuple[float, float]
    most: float

    @classmethod
    def of(cls, camera: PlenopticCamera) -> Spread:
        """Trace rays to find that of a camera with a real main lens, all over its detector, between `LINES`."""
        assert camera.prescription is not None
        own = camera.prescription.wavelength
        return _spread(_whole(camera), (own, *LINES) if camera.is_dispersive else (own,))


def require_served(camera: PlenopticCamera, wavelength: float) -> None:
    """Refuse a wavelength whose light a real main lens blurs less than `Spread` tells.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.

    Raises
    ------
    InputError
        If it does.
    """
    less = less_than_told(camera, wavelength)
    if less > TOLERANCE:
        name = camera.prescription.name if camera.prescription is not None else ""
        raise InputError(
            f"wavelength = {wavelength:g}: method = bank: main_lens = {name or 'prescription'} blurs its light over "
            f"{less:.2g} lenses less than that of {LINES[0]:.0f} to {LINES[1]:.0f} nm; use patch"
        )


def less_than_told(camera: PlenopticCamera, wavelength: float) -> float:
    """Return by how many lenses a wavelength's light is blurred less than `Spread` tells."""
    if camera.prescription is None or not camera.is_dispersive or LINES[0] <= wavelength <= LINES[1]:
        return 0.0
    told, own = Spread.of(camera), _spread(_whole(camera), (wavelength,))
    return max(new - old for new, old in zip(own.less, told.less, strict=True))


def _nearest(system: LensSystem) -> float:
    """Return the distance of the nearest points that count in the camera frame; in the pupil itself nothing images."""
    front = max(*system.front_bounds[1], Pupils.of(system).entrance)
    return float(front + _NEAREST * system.focal_length)


def _whole(camera: PlenopticCamera) -> PlenopticCamera:
    return camera.replace(crop_offset=(0, 0), crop_size=camera.resolution)


@functools.lru_cache(maxsize=16)
def _spread(camera: PlenopticCamera, wavelengths: tuple[float, ...]) -> Spread:
    system = LensSystem.of(camera)
    pupils = Pupils.of(system)
    per_lens = max(camera.mla_pitches) / (2 * camera.pupil_radius)
    nearest = 1 / (_nearest(system) - pupils.entrance)
    less, most = [], 0.0
    for sign in (1, -1):
        vergence = (1 - sign * _BLUR * per_lens) / camera.pupil_distance
        nearness = (pupils.at_infinity - vergence) * pupils.magnification**2
        nearness = min(max(nearness, 1 / FAR), nearest)
        found = np.concatenate([_blurs(camera, pupils, nearness, wavelength).ravel() for wavelength in wavelengths])
        own = (1 - camera.pupil_distance * pupils.convergence(nearness)) / per_lens
        less.append(max(0.0, float((sign * (own - found)).max())))
        most = max(most, float(np.abs(own - found).max()))
    return Spread((less[0], less[1]), most)


def _blurs(camera: PlenopticCamera, pupils: Pupils, nearness: float, wavelength: float) -> NDArray[np.float64]:
    """Return the blurs in lenses, along both axes of the astigmatism, of points all over the field, (2, n)."""
    farthest = farthest_points(camera, wavelength, (1 / nearness + pupils.entrance,))
    points = farthest * np.array([1.0, 0.0, 1.0]) + np.linspace(0, 1, _FIELDS)[:, None] * farthest * [0.0, 1.0, 0.0]
    light = lens_of_waves(camera, points, wavelength).bind(points)
    assert isinstance(light, LensLight)
    axis = np.linspace(-1, 1, _ACROSS) * camera.pupil_radius
    x, y = (values.reshape(1, -1) for values in np.meshgrid(axis, axis))
    (xx, xy), (yx, yy) = derivatives(light, (x, y), _STEP * camera.pupil_radius)
    middle, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, (xy + yx) / 2)
    kept = light.is_open((x, y))
    per_lens = max(camera.mla_pitches) / (2 * camera.pupil_radius)
    return np.stack([(middle - half)[kept], (middle + half)[kept]]) / per_lens


def local_vergences(camera: PlenopticCamera, vergences: tuple[float, float]) -> tuple[float, float]:
    """Return between which vergences the local camera's bank must serve images between some of a camera's own."""
    if camera.prescription is None:
        return vergences
    system = LensSystem.of(camera)
    nearest = float(system.vergence(_nearest(system)))
    more = Spread.of(camera).most * max(camera.mla_pitches) / (2 * camera.pupil_radius) / camera.pupil_distance
    low, high = (float(at_pupil(camera, max(vergence, nearest))) for vergence in sorted(vergences))
    return low - more, high + more


def local_point(camera: PlenopticCamera, inverse: Any, edges: Any) -> tuple[Any, Any, Any]:
    """Return the pupil point and the vergence by which `LensBank.coefficients` of the local camera serve a microlens.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, with a real main lens.
    inverse : ((array, array), (array, array))
        Derivatives of the pupil point's x and y by the place on the array where its rays come.
    edges : sequence of (array, (array, array))
        For each edge 1 where it is and less within, linear beside it; and its derivatives by the place on the array.
    """
    pitch, a, b = max(camera.mla_pitches), camera.pupil_radius, camera.pupil_distance
    (xx, xy), (yx, yy) = inverse
    defocus = 2 / (xx + yy)
    within: Any = None
    outward: Any = None
    for value, (gx, gy) in edges:
        steepness = dr.maximum(dr.hypot(gx, gy), 1e-6)
        nx, ny = towards = gx / steepness, gy / steepness
        away = (1 - value) / (steepness * pitch)
        # Ripples go by the curvature across the edge.
        across = abs(nx * (xx * nx + xy * ny) + ny * (yx * nx + yy * ny)) * abs(defocus)
        away = dr.select(away > 0, away * dr.sqrt(across), away)
        if within is None:
            within, outward = away, towards
        else:
            nearer = away < within
            within = dr.select(nearer, away, within)
            outward = [dr.select(nearer, new, old) for new, old in zip(towards, outward, strict=True)]
    # On the array the edge lies on the other side of the pupil's image if the light has crossed before.
    radius = dr.maximum(a - within * pitch / abs(defocus), 0) * dr.sign(defocus)
    return radius * outward[0], radius * outward[1], (1 - defocus) / b
