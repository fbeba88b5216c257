"""A microscope's objective and tube lens as the plain data that a camera stores."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..errors import (
    InputError,
    naming,
    put_checked,
    refuse_if,
    require_choice,
    require_length,
    require_number,
    suggest_keywords,
)
from .lens_data import SINGLE, LensData, even_count, require_alone, require_unscaled

_WIDEST = 0.1
"""Numerical aperture on the image side at most: directions there are taken as small."""


@suggest_keywords
@dataclass(frozen=True)
class Objective(LensData):
    r"""An infinity-corrected objective with its tube lens, the main lens of a light-field microscope.

    The objective obeys Abbe's sine condition, and its stop lies in its back focal plane, one focal length before the
    tube lens: the microscope is telecentric on both sides. The objective's focal length is :math:`f = f_T / M` and the
    radius of the stop :math:`f \, NA` (Gu, "Advanced Optical Imaging Theory", chapter 6). They determine the camera's
    `focal_length`, `aperture_radius` and `mla_distance`.

    Parameters
    ----------
    magnification : float
        Lateral magnification M, positive; the image stands upside down.
    numerical_aperture : float
        Numerical aperture NA on the object side, less than the immersion's refractive index.
    immersion : float
        Refractive index n between objective and object, in which the object lies, too: 1 for air, 1.33 for water,
        1.515 for oil.
    tube_focal_length : float
        Focal length :math:`f_T` of the tube lens in millimetres.
    arrangement : {"image", "fourier"}
        Where the microlens array stands: in the native image plane (Levoy, Ng, Adams, Footer and Horowitz 2006, "Light
        field microscopy"), or behind a further lens in the image of the stop (Llavador, Sola-Pikabea, Saavedra, Javidi
        and Martínez-Corral 2016, "Resolution improvements in integral microscopy with Fourier plane recording").
    fourier_focal_length : float, optional
        Focal length :math:`f_F` in millimetres of that further lens, which stands this far behind the native image
        plane and before the array; for "fourier" alone.
    field_stop : float, optional
        Radius, or half the width, of a field stop in the native image plane, in millimetres there: it bounds the
        micro-images of wide objects; for "fourier" alone. Default: there is none, and micro-images may overlap.
    field_stop_shape : {"disc", "square"}
        Shape of the field stop; the sides of a square are along those of the detector.
    """

    mark = "magnification"
    is_thin = False
    converges = False
    focused_on = "an objective is focused on its native object plane"
    sets = ("focal_length", "aperture_radius", "mla_distance")

    magnification: float
    numerical_aperture: float
    immersion: float = 1.0
    tube_focal_length: float = 200.0
    arrangement: str = "image"
    fourier_focal_length: float | None = None
    field_stop: float | None = None
    field_stop_shape: str = "disc"

    def __post_init__(self) -> None:
        with naming("main_lens"):
            put_checked(
                self,
                magnification=partial(require_number, positive=True, maximum=1000),
                immersion=partial(require_number, minimum=1, maximum=4.0),
                numerical_aperture=partial(require_number, positive=True),
                tube_focal_length=require_length,
                arrangement=partial(require_choice, choices=("image", "fourier")),
                fourier_focal_length=require_length,
                field_stop=require_length,
                field_stop_shape=partial(require_choice, choices=("disc", "square")),
            )
        refuse_if(
            self.numerical_aperture >= self.immersion,
            f"main_lens: numerical_aperture = {self.numerical_aperture:g}: it must be less than the index of the "
            f"immersion, {self.immersion:g}",
        )
        refuse_if(
            self.image_aperture > _WIDEST,
            f"main_lens: numerical_aperture = {self.numerical_aperture:g} with magnification = "
            f"{self.magnification:g}: their quotient must be at most {_WIDEST:g}, as the image side is paraxial",
        )
        refuse_if(
            self.is_fourier and self.fourier_focal_length is None,
            "main_lens: fourier_focal_length: it is missing; arrangement = fourier needs the lens before the array",
        )
        for name in () if self.is_fourier else ("fourier_focal_length", "field_stop"):
            if (length := getattr(self, name)) is not None:
                raise InputError(f"main_lens: {name} = {length:g}: it is for arrangement = fourier; leave it out")

    @property
    def name(self) -> str:
        """Name of the objective in messages: ``20x/0.5 objective``."""
        return f"{self.magnification:g}x/{self.numerical_aperture:g} objective"

    @property
    def focal_length(self) -> float:
        """Focal length :math:`f_T / M` of the objective on the tube lens's side, in mm."""
        return self.tube_focal_length / self.magnification

    @property
    def stop_radius(self) -> float:
        """Radius in mm of the stop in the back focal plane."""
        return self.focal_length * self.numerical_aperture

    @property
    def image_aperture(self) -> float:
        """Numerical aperture NA / M in the native image plane."""
        return self.numerical_aperture / self.magnification

    @property
    def half_angle(self) -> float:
        """Angle in radians of the steepest rays of the object against the axis."""
        return math.asin(self.numerical_aperture / self.immersion)

    @property
    def last_focal_length(self) -> float:
        """Focal length in mm of the last lens before the array; the array stands at this distance behind it."""
        return self.tube_focal_length if self.fourier_focal_length is None else self.fourier_focal_length

    @property
    def is_fourier(self) -> bool:
        """Whether the array stands in the image of the stop."""
        return self.arrangement == "fourier"

    def view_scale(self, detector_distance: float) -> float:
        """Return the scale :math:`z M / f_F` of the object's picture under a lens of the Fourier arrangement.

        Parameters
        ----------
        detector_distance : float
            Distance z from the array to the detector in millimetres, `PlenopticCamera.reduced_distance` in a medium.
        """
        return detector_distance * self.magnification / self.last_focal_length

    @property
    def images_stop(self) -> bool:
        """Whether the array stands in the image of the stop."""
        return self.is_fourier

    @property
    def nearest(self) -> float:
        """The z of the front principal plane, in mm in the camera frame."""
        return -self.immersion * self.focal_length

    def own_numbers(self, focal_length: float | None) -> tuple[float, float]:
        """Return the focal length and the radius of the stop, in mm; a given focal length changes neither."""
        return self.focal_length, self.stop_radius

    def array_distance(self) -> float:
        """Return the focal length of the lens before the array."""
        return self.last_focal_length

    def settled(self, stated: dict[str, float]) -> dict[str, float]:
        """Return the parameters set by the objective; refuse given ones that differ."""
        numbers = self.focal_length, self.stop_radius, self.last_focal_length
        return require_unscaled(stated, dict(zip(self.sets, numbers, strict=True)), SINGLE)

    def require_fit(self, camera: Any) -> None:
        """Refuse further aberrations, no array, and, in the image of the stop, arrays and stops that do not suit it."""
        camera.require_array(f"main_lens = {self.label}")
        require_alone(camera)
        if not self.is_fourier:
            return
        refuse_if(
            any(camera.mla_tilt),
            f"mla_tilt = {camera.mla_tilt}: an array in the image of the stop must stand upright; leave it out",
        )
        pitch = min(camera.mla_pitches)
        refuse_if(
            pitch < 3 * camera.pixel_size * (1 - SINGLE),
            f"mla_pitch = {pitch:g}: in the Fourier arrangement it must be at least three pixels of "
            f"{camera.pixel_size:.4g} mm",
        )
        narrowest = camera.pixel_size * self.last_focal_length / (2 * camera.reduced_distance)
        if self.field_stop is not None:
            refuse_if(
                self.field_stop < narrowest * (1 - SINGLE),
                f"main_lens: field_stop = {self.field_stop:g}: it must be at least {narrowest:.4g}, half a pixel there",
            )
        radius = self.blur_diameter(0) / 2
        far = radius + camera.lattice.aperture_reach
        index = camera.lattice.lenses_within((-far, -far), (far, far))
        nearest = np.hypot(*camera.lattice.centre(*index.T)).min(initial=math.inf)
        refuse_if(
            nearest >= far,
            f"mla_pitch = {pitch:g}: none lies in the image of the stop of {2 * radius:.4g} mm; take narrower lenses",
        )

    def require_distance(self, camera: Any, distance: float) -> None:
        """Refuse a depth that is not finite or not before the objective."""
        refuse_if(
            not -self.focal_length < distance < math.inf,
            f"distance = {distance:g}: it must be a finite depth beyond the native object plane, more than "
            f"{-self.focal_length:g}",
        )

    def focus_distance(self, focal_length: float, mla_distance: float) -> float:
        """Return 0, the distance of the native object plane, which is in focus."""
        return 0.0

    def bin_count(self, camera: Any) -> tuple[int, int]:
        """Return the number of bins: as for the array or, in the Fourier arrangement, of pixels along a pitch."""
        if not self.is_fourier:
            return super().bin_count(camera)
        across, down = camera.mla_pitches
        return even_count(across, camera.pixel_size), even_count(down, camera.pixel_size)

    def bin_size(self, camera: Any, distance: float) -> float:
        """Return the object-side width in mm of a lens, or of a pixel in the Fourier arrangement, at all depths."""
        if self.is_fourier:
            return float(camera.pixel_size / self.view_scale(camera.reduced_distance))
        return float(camera.row_pitch / self.magnification)

    def image_blur(self, camera: Any, distance: float) -> float:
        """Return the diameter in mm of the blur on the array, as `blur_diameter`."""
        return self.blur_diameter(distance)

    def blur_diameter(self, distance: float) -> float:
        r"""Diameter on the array of the light of a point on the axis, by rays.

        :math:`2 M |d| \tan\alpha` in the native image plane; in the Fourier arrangement the stop's image's diameter.

        Parameters
        ----------
        distance : float
            Distance d of the point beyond the native object plane, in millimetres.
        """
        if self.is_fourier:
            return 2 * self.last_focal_length * self.image_aperture
        return 2 * self.magnification * abs(distance) * math.tan(self.half_angle)
