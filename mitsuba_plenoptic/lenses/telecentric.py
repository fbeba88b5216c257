r"""A microscope's objective and tube lens for rays and waves: telecentric, with Abbe's sine condition.

The camera frame's origin is the native object plane; a point (X, Y, d) with d > 0 lies beyond it, farther from the
objective. Light of the point that passes the stop at P, in the back focal plane, left the point at the angle
:math:`\theta` to the axis with :math:`n \sin\theta = |P| / f`: the sine condition. Its path to the stop exceeds that of
light from the origin by

.. math:: \Phi(P) = n d (\cos\theta - 1) - \frac{X P_x + Y P_y}{f}, \qquad
          n \cos\theta = n \sqrt{1 - (|P| / n f)^2}

without :math:`n d`, which is the same for all P. A source that radiates uniformly in all directions sends the power
:math:`d\Omega = d^2P / (f^2 n^2 \cos\theta)` through the stop, hence the amplitude :math:`\cos^{-1/2}\theta` there;
over angles, whose measure is :math:`\sin\theta \cos\theta d\theta`, this is the apodisation :math:`\cos^{1/2}\theta` of
an aplanatic lens (Gu, "Advanced Optical Imaging Theory", section 6.1; Broxton et al. 2013, "Wave optics theory and 3-D
deconvolution for the light field microscope", equation 2).

Behind the tube lens, light from P arrives at the native image plane with the direction cosines :math:`s = -P / f_T`,
whatever the object point. A further lens turns these directions into positions :math:`f_F s` on the image of the stop,
and positions x in the native image plane into slopes :math:`x / f_F` there. In this Fourier arrangement a field stop in
the native image plane bounds the directions of rays, and the stop their positions.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from ..optics import in_millimetres
from ..prescription import Objective
from ..runtime import Doubles, Pair, Triple, minimum, rsqrt, safe_sqrt, sqrt
from .closed_lens import ClosedLens
from .common import LensNumbers, builds
from .protocol import Entrance, Traced
from .pupil import Pupil


@dataclass(frozen=True)
class TelecentricLens(ClosedLens):
    """An objective before a microlens array; `MainLens` documents its methods.

    Parameters
    ----------
    objective : Objective
        The objective, its tube lens, and the arrangement of the array.
    """

    objective: Objective
    pupil: Pupil = field(init=False)

    def __post_init__(self) -> None:
        lens = self.objective
        # The tube lens images the stop to infinity, a further lens onto the array.
        pupil = Pupil(lens.stop_radius, lens.tube_focal_length, finite=0, swap=lens.fourier_focal_length)
        object.__setattr__(self, "pupil", pupil)

    @property
    def entrance(self) -> Entrance:
        """Native object plane, and the bounds of rays on the objective's front principal plane."""
        front = self.front
        steepest = math.tan(self.objective.half_angle)
        return Entrance(radius=-front * steepest, depths=(front,), growth=1 / self.objective.magnification)

    def _sines(self, pupil: Pair) -> Pair:
        """Return n sin(theta), by components, of the light that leaves the object for a point of the stop."""
        return pupil[0] * (1 / self.objective.focal_length), pupil[1] * (1 / self.objective.focal_length)

    def _cosine(self, pupil: Pair) -> Any:
        """Return cos(theta) of the light to a point of the stop, a small constant where the sine would exceed 1."""
        x, y = self._sines(pupil)
        square = 1 - (x * x + y * y) * (1 / self.objective.immersion**2)
        return safe_sqrt(square, 1e-6)

    def vergence(self, distance: Any) -> Any:
        r"""Return the reciprocal of the distance behind the tube lens at which light from a depth converges.

        The distance is that of the parabolic wave with the same path difference from focus at the stop's edge.
        """
        lens = self.objective
        drop = 2 * math.sin(lens.half_angle / 2) ** 2
        return 1 / self.pupil.distance + 2 * lens.immersion * drop * distance / self.pupil.radius**2

    def images(self, points: Doubles) -> Doubles:
        """Return the positions (n, 2) of the chief rays of points in the native image plane."""
        return -self.objective.magnification * points[:, :2]

    def points(self, images: Doubles, inverse_distance: Doubles) -> Doubles:
        """Return the scene points (n, 3) with given `images` and `inverse_distance`."""
        return np.column_stack([images * (-1 / self.objective.magnification), inverse_distance])

    def path(self, pupil: Pair, point: Triple, wavelength: float) -> Any:
        """Return the path in waves from a scene point to a point of the stop, less the path to the stop's centre."""
        x, y = self._sines(pupil)
        X, Y, d = point
        n = self.objective.immersion
        # cos - 1 without cancellation
        drop = -(x * x + y * y) / (n * (1 + self._cosine(pupil)))
        return (d * drop - (X * x + Y * y)) * (1 / in_millimetres(wavelength))

    def amplitude(self, pupil: Pair, point: Triple) -> Any:
        r"""Return the amplitude :math:`\cos^{-1/2}\theta` on the stop, the same for all object points."""
        return rsqrt(self._cosine(pupil))

    @property
    def front(self) -> float:
        """Coordinate z in the camera frame of the plane where rays start: the objective's front principal plane."""
        return -self.objective.immersion * self.objective.focal_length

    def trace(self, position: Pair, slope: Pair) -> Traced:
        """Return the ray from a position on the array to the scene; the image side is paraxial."""
        return self.ray((slope[0] * self.window.distance, slope[1] * self.window.distance), position)

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the array through a point of the window."""
        # The slopes are the same for all image positions.
        scale = -1 / (self.objective.immersion * self._cosine(pupil))
        sines = self._sines(pupil)
        behind = sines[0] * scale, sines[1] * scale
        x, y = (t * self.front - m / self.objective.magnification for m, t in zip(position, behind, strict=True))
        return (x, y, self.front), behind, self.is_open(pupil)

    def power_through(self, point: Doubles) -> float:
        """Return `passed_power`, which is equal for all scene points."""
        return self.passed_power

    @property
    def passed_power(self) -> float:
        r"""Integral of the squared amplitude over the stop: :math:`2 \pi f^2 n^2 (1 - \cos\alpha)`."""
        lens = self.objective
        return 4 * math.pi * (lens.focal_length * lens.immersion * math.sin(lens.half_angle / 2)) ** 2

    def cosines(self, pupil: Pair, point: Triple) -> Pair:
        """Return the direction cosines, at the array, of light that passed a point of the stop."""
        return -pupil[0] / self.pupil.distance, -pupil[1] / self.pupil.distance

    def land(self, pupil: Pair, point: Triple) -> Pair:
        r"""Return the position in the native image plane, :math:`-M (X + d \tan\theta)`: the gradient of the path."""
        scale = 1 / (self.objective.immersion * self._cosine(pupil))
        x, y = self._sines(pupil)
        M = self.objective.magnification
        X, Y, d = point
        return -M * (X + d * x * scale), -M * (Y + d * y * scale)


@dataclass(frozen=True)
class FourierLens(TelecentricLens):
    """An objective, and a lens behind its native image that images the stop onto the array: the Fourier arrangement.

    Parameters
    ----------
    visible : float
        Radius in mm of the circle in the native image plane that the detector sees through any lens.
    """

    visible: float = math.inf

    @property
    def window(self) -> Pupil:
        """The native image plane, bounded by what the detector sees and by the circle around the field stop."""
        lens = self.objective
        stop = math.inf if lens.field_stop is None else lens.field_stop
        corner = math.sqrt(2) if lens.field_stop_shape == "square" else 1.0
        return Pupil(min(self.visible, corner * stop), lens.last_focal_length, finite=0)

    @property
    def entrance(self) -> Entrance:
        """Native object plane, and the bounds of rays on the objective's front principal plane."""
        native = super().entrance
        return replace(native, radius=native.radius + self.window.radius / self.objective.magnification, growth=0.0)

    def field_inset(self, x: Any, y: Any) -> Any:
        """Return the distance in mm of positions in the native image plane from the field stop's edge, inside it."""
        stop = math.inf if self.objective.field_stop is None else self.objective.field_stop
        if self.objective.field_stop_shape == "square":
            return minimum(stop - abs(x), stop - abs(y))
        return stop - sqrt(x * x + y * y)

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the array, where the stop is imaged, through a native image point."""
        stop = position[0] * self.pupil.stop_scale, position[1] * self.pupil.stop_scale
        start, slope, is_open = super().ray(stop, pupil)
        return start, slope, is_open & (self.field_inset(*pupil) >= 0)

    def in_window(self, pupil: Pair, point: Triple) -> Pair:
        """Return where light from a scene point through a point of the stop passes the native image plane."""
        return super().land(pupil, point)

    def cosines(self, pupil: Pair, point: Triple) -> Pair:
        """Return the direction cosines, at the array, of light that passed a point of the stop."""
        x, y = self.in_window(pupil, point)
        return -x / self.window.distance, -y / self.window.distance

    def land(self, pupil: Pair, point: Triple) -> Pair:
        """Return the position on the array of the light from a scene point through a point of the stop."""
        return self.pupil.image(pupil, point)


@builds(Objective)
def telecentric_lens(numbers: LensNumbers) -> TelecentricLens:
    """Return the main lens of a camera that has an objective."""
    camera = numbers.camera
    objective = cast(Objective, camera.main_lens)
    if not objective.images_stop:
        return TelecentricLens(objective)
    # From a corner of the detector through the opposite edge of the stop's image.
    aside = math.hypot(camera.detector_width, camera.detector_height) / 2 + objective.blur_diameter(0) / 2
    return FourierLens(objective, aside / camera.reduced_distance * objective.last_focal_length)
