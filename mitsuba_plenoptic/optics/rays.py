"""The thin-lens ray formulas, defined once for the sensor, the wave capture and the reconstructions.

In the camera frame the main lens is in z = 0, the scene towards +z, the microlens array (MLA) in z = -b, and the
detector in z = -(b + z). Rays are followed from the detector towards the scene and described by points and slopes
(dx/dz, dy/dz), one axis at a time, which is exact for ideal (stigmatic) thin lenses. All functions work on floats,
NumPy arrays and Dr.Jit arrays.

Symbols: p detector point, m MLA point, c microlens centre, P pupil point, t slope between MLA and main lens,
X scene point at distance g, q point of the MLA plane.
"""

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..prescription import defocus_factor
from ..runtime import Numbers, Pair, drjit_array, module_of, rsqrt, take


def chief_point(camera: PlenopticCamera, p: Any, distance: Any = None) -> Any:
    """Position on the MLA of the line from a detector point to the main lens's centre: p b / (b + z).

    The pupil's centre may be at another distance than the main lens.
    """
    b = camera.mla_distance if distance is None else distance
    return p * (b / (b + camera.reduced_distance))


def chief_detector_point(camera: PlenopticCamera, m: Any) -> Any:
    """Position on the detector of the line from the main lens's centre through an MLA point: m (b + z) / b."""
    b = camera.mla_distance
    return m * ((b + camera.reduced_distance) / b)


def chief_lenses(camera: PlenopticCamera, x: Any, y: Any) -> Pair:
    """Lattice indices of the lenses of detector points: those whose cells hold the line to the pupil's centre.

    Behind an objective these lines are parallel to the axis.
    """
    if not camera.lens_data.converges:
        return camera.lattice.cell(x, y)
    return camera.lattice.cell(*(chief_point(camera, p, camera.pupil_distance) for p in (x, y)))


def pupil_point(m: Any, t: Any, mla_distance: Any) -> Any:
    """Position on the main lens of a ray of slope t from the MLA: m + b t."""
    return m + mla_distance * t


def main_lens_slope(t: Any, P: Any, focal_length: Any) -> Any:
    """Slope of a ray after the main lens: t - P/f1."""
    return t - P / focal_length


def object_direction(P: Any, slope: Any, distance: Any) -> Any:
    """Position on the object plane of a ray from a pupil point, divided by the plane's distance: X/g = P/g + t'."""
    return P / distance + slope


def mla_point(X: Any, P: Any, distance: Any, mla_distance: Any, focal_length: Any) -> Any:
    """Position on the MLA of the ray from a scene point through a pupil point: -X b/g + P (1 + b/g - b/f1)."""
    return conjugate_coordinate(X, distance, mla_distance) + P * defocus_factor(distance, mla_distance, focal_length)


def conjugate_coordinate(X: Any, distance: Any, mla_distance: Any) -> Any:
    """Return the projection of a scene point through the main lens's centre onto the MLA plane: -X b/g."""
    return -X * mla_distance / distance


def slopes_to_cosines(tx: Any, ty: Any) -> Pair:
    """Return direction cosines from slopes, t / sqrt(1 + tx^2 + ty^2)."""
    scale = rsqrt(1 + tx * tx + ty * ty)
    return tx * scale, ty * scale


def cosines_to_slopes(sx: Any, sy: Any) -> Pair:
    """Return slopes from direction cosines, s / sqrt(1 - sx^2 - sy^2)."""
    scale = rsqrt(1 - sx * sx - sy * sy)
    return sx * scale, sy * scale


def refracted(slope: Pair, index: float) -> Pair:
    """Return the slope behind a border at which direction cosines grow by a relative index, by Snell's law."""
    sx, sy = slopes_to_cosines(*slope)
    return cosines_to_slopes(index * sx, index * sy)


def into_medium(slope: Pair, turn: Pair, chief: Pair | None, index: Any) -> Pair:
    r"""Return the slope behind a microlens and the border of a medium of index n; `out_of_medium` is the inverse.

    Lenses that turn direction cosines follow Snell's law, :math:`s = n s' + \tau`. Ideal lenses have the slope

    .. math:: t' = \frac{c}{n} \left[ t + c^2 \left( \tfrac{1}{n^2} - 1 \right) (t_c \cdot (t - t_c))\, t_c \right]
              - \frac{\tau}{n} , \qquad c = \left[ 1 + \left( 1 - \tfrac{1}{n^2} \right) t_c^2 \right]^{-1/2} :

    Snell's law for the chief ray and its derivative for other rays, so that all light of one direction meets in the
    lens's focal plane. Both laws hold in either direction of light.

    Parameters
    ----------
    slope : (array, array)
        Slope before the lens, on the side of the main lens.
    turn : (array, array)
        Change of the direction by the lens, from behind it to before it: minus the offset from the lens's centre, over
        the focal length in air.
    chief : (array, array), optional
        Slope before the lens of the ray through the centres of the lens and of the pupil. None: the lens turns
        direction cosines.
    index : float or array
        Refractive index n.
    """
    if chief is None:
        cosines = slopes_to_cosines(*slope)
        return cosines_to_slopes(*((s - change) / index for s, change in zip(cosines, turn, strict=True)))
    if _is_one(index):
        return slope[0] - turn[0], slope[1] - turn[1]
    c = rsqrt(_widening(chief, index))
    along = c * c * (1 / (index * index) - 1) * _dot(chief, (slope[0] - chief[0], slope[1] - chief[1]))
    x, y = ((c * (t + along * c0) - change) / index for t, change, c0 in zip(slope, turn, chief, strict=True))
    return x, y


def out_of_medium(slope: Pair, turn: Pair, chief: Pair | None, index: Any) -> tuple[Pair, Any]:
    """Return the slope before a microlens from the slope in the medium behind it, and whether light passes the border.

    This is the inverse of `into_medium`, with the same parameters. Lenses that turn direction cosines reflect steep
    light totally; its slope is 0.
    """
    if chief is None:
        sx, sy = (index * s + change for s, change in zip(slopes_to_cosines(*slope), turn, strict=True))
        emerges = sx * sx + sy * sy < 1
        select = dr.select if dr.is_array_v(sx) else np.where
        return cosines_to_slopes(select(emerges, sx, 0), select(emerges, sy, 0)), emerges
    if _is_one(index):
        return (slope[0] + turn[0], slope[1] + turn[1]), True
    c = rsqrt(_widening(chief, index))
    bent = tuple((index * t + change) / c - c0 for t, change, c0 in zip(slope, turn, chief, strict=True))
    along = 1 + (1 - 1 / (index * index)) * _dot(chief, bent)
    return (bent[0] + along * chief[0], bent[1] + along * chief[1]), True


def etendue_factor(before: Pair, behind: Pair, chief: Pair | None, index: Any) -> Any:
    """Return the weight with which rays that are uniform over a detector in a medium are uniform over the pupil.

    The weight is the ratio of slope areas before a microlens and in the medium, divided by the factor n^2 that it has
    on the axis: c^-4 with the c of `into_medium`, and for lenses that turn direction cosines the square of the ratio of
    1 + t^2. For ideal lenses without a medium it is 1.
    """
    if chief is None:
        root = (1 + _dot(before, before)) / (1 + _dot(behind, behind))
    elif _is_one(index):
        return 1.0
    else:
        root = _widening(chief, index)
    return root * root


def _widening(chief: Pair, index: Any) -> Any:
    """Return the factor c^-2 of `into_medium`."""
    return 1 + (1 - 1 / (index * index)) * _dot(chief, chief)


def _dot(a: Pair, b: Pair) -> Any:
    return a[0] * b[0] + a[1] * b[1]


def _is_one(index: Any) -> bool:
    """Return whether the index is the number 1, so that slopes stay bit for bit the same."""
    return isinstance(index, (int, float)) and index == 1


_ANGLES = 1025
"""Angles in the table."""


def second_leg(pairs: Numbers, absorption: float, kind: Any = None) -> Callable[[Any, Any], Any]:
    """Return a function of lateral path and depth behind the lenses that gives the part of the power that counts.

    `pairs` are angles of incidence in degrees and the responses of pixels there, in turn, of which the last is the
    steepest, or none; `absorption` is the medium's coefficient in 1/mm, for the law of Beer and Lambert. `kind` is the
    type of the paths' arrays: of Dr.Jit, by default the active variant's, or of NumPy.
    """
    fine = np.linspace(0, pairs[-2] if pairs else 90, _ANGLES)
    table = np.interp(fine, pairs[::2], pairs[1::2]) if pairs else None
    if pairs and kind is not np.ndarray:
        table = drjit_array(kind or mi.Float, table)
        dr.make_opaque(table)
    step = math.radians(float(fine[1]))

    def power(aside: Any, depth: Any) -> Any:
        module = module_of(aside)
        passed = module.exp(-absorption * module.hypot(aside, depth)) if absorption else 1.0
        if not pairs:
            return passed
        angle = (dr.atan if module is dr else np.arctan)(aside / depth)
        position = module.clip(angle / step, 0, _ANGLES - 1)
        low = module.minimum(module.floor(position), _ANGLES - 2)
        first = take(table, low)
        second = take(table, low + 1)
        return (first + (position - low) * (second - first)) * passed

    return power
