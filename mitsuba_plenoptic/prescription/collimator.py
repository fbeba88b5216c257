"""A telescope's objective with a collimator, as plain data: the main lens of a Shack-Hartmann sensor."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from ..errors import naming, put_checked, refuse_if, require_length, suggest_keywords
from .lens_data import SINGLE, THIN, LensData, require_unscaled


@suggest_keywords
@dataclass(frozen=True)
class Collimator(LensData):
    r"""A thin objective and, behind its focus, a collimator that images the pupil onto the microlens array.

    Light of a star arrives at the array as a parallel beam, in which each microlens sees a part of the pupil: the
    camera is a Shack-Hartmann wavefront sensor (Platt and Shack 2001, "History and principles of Shack-Hartmann
    wavefront sensing"). With the camera's `focal_length` :math:`f_1` and the collimator's :math:`f_c`, the collimator
    stands :math:`f_1 + f_c` behind the objective, which is the pupil, and the array :math:`f_c (1 + f_c / f_1)` behind
    the collimator, which gives `mla_distance`. There the pupil is imaged upside down with the magnification :math:`f_c
    / f_1` (Goodman, "Introduction to Fourier Optics", section 5.3); the quadratic phases of both lenses cancel. Both
    lenses are ideal, and the collimator is wide enough for all light. `CaptureOperator` simulates cameras with a
    collimator by the method ``full_field``.

    Parameters
    ----------
    collimator_focal_length : float
        Focal length :math:`f_c` in millimetres.
    """

    mark: ClassVar[str] = "collimator_focal_length"
    is_thin: ClassVar[bool] = False
    converges: ClassVar[bool] = False
    focused_on: ClassVar[str] = "a telescope with a collimator is focused at infinity"

    collimator_focal_length: float

    def __post_init__(self) -> None:
        with naming("main_lens"):
            put_checked(self, collimator_focal_length=require_length)

    @property
    def images_stop(self) -> bool:
        """True, as the array stands in the image of the pupil."""
        return True

    def own_numbers(self, focal_length: float | None) -> tuple[float, float]:
        """Return focal length and radius of a thin objective in mm."""
        return THIN.own_numbers(focal_length)

    def magnification(self, focal_length: float) -> float:
        """Return the size of the pupil's image divided by the size of the pupil.

        Parameters
        ----------
        focal_length : float
            Focal length of the objective in millimetres.
        """
        return self.collimator_focal_length / focal_length

    def array_distance(self) -> float:
        """Return NaN, as the distance follows from both focal lengths, see `settled`."""
        return math.nan

    def settled(self, stated: dict[str, float]) -> dict[str, float]:
        """Return the parameters completed by the distance of the pupil's image; refuse another distance."""
        length = stated["focal_length"]
        collimator = self.collimator_focal_length
        distance = length + collimator + collimator * (1 + self.magnification(length))
        if not math.isnan(stated["mla_distance"]):
            require_unscaled(stated, {"mla_distance": distance}, SINGLE)
        return stated | {"mla_distance": distance}

    def focus_distance(self, focal_length: float, mla_distance: float) -> float:
        """Return infinity, as light of stars leaves the collimator parallel."""
        return math.inf

    def require_fit(self, camera: Any) -> None:
        """Refuse distortion, glass, and no or a tilted array."""
        camera.require_array(f"main_lens = {self.label}")
        for name, value in (("distortion", camera.distortion), ("mla_tilt", camera.mla_tilt)):
            refuse_if(any(value), f"{name} = {value}: behind a collimator it must be 0")
        refuse_if(
            camera.glass is not None, "glass: the lenses of a telescope with a collimator have none; leave it out"
        )

    def require_distance(self, camera: Any, distance: float) -> None:
        """Refuse all object distances, as no object plane is imaged onto the array."""
        refuse_if(True, f"distance = {distance:g}: behind a collimator the array is in the image of the pupil")

    def image_blur(self, camera: Any, distance: float) -> float:
        """Return the diameter in mm of the pupil's image on the array."""
        return float(camera.aperture_diameter * self.magnification(camera.focal_length))
