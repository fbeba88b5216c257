"""A camera at one wavelength: its lattice, microlenses and main lens."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, cast

from ..array import Lattice
from ..camera import PlenopticCamera
from ..lenses import ClosedLens, MainLens, PointLight, cached_main_lens
from ..prescription import LINE_D
from ..runtime import Doubles
from .microlens_orders import MicrolensArray, microlens_array
from .transmittance import upright

if TYPE_CHECKING:
    from ..lenses import RealLens


def is_paraxial(camera: PlenopticCamera) -> bool:
    """Return whether waves from a field of many points propagate paraxially, by slopes, like the camera's rays.

    Behind an ideal thin main lens the light of a single point converges to the point's image, by direction cosines. No
    phase does that to the light of all points together, except in paraxial propagation, by slopes: a parabola.
    """
    return camera.main_lens is None and camera.lens_model == "ideal"


@dataclass(frozen=True)
class OpticalSystem:
    """Camera, lattice, microlenses and main lens at one wavelength in nanometres, for captures and reconstructions."""

    camera: PlenopticCamera
    wavelength: float
    lens_model: str | None = None

    @classmethod
    def by_design(cls, camera: PlenopticCamera) -> OpticalSystem:
        """Return the optical system at the main lens's design wavelength, for rays without a wavelength."""
        return cls(camera, getattr(camera.main_lens, "wavelength", LINE_D))

    @cached_property
    def lattice(self) -> Lattice:
        """Lattice of the microlenses."""
        return self.camera.lattice

    @cached_property
    def microlenses(self) -> MicrolensArray:
        """Transmission of the microlenses, in the frame of the camera."""
        return microlens_array(self.camera, self.wavelength)

    @cached_property
    def upright_microlenses(self) -> MicrolensArray:
        """Transmission of the microlenses, in the frame rotated with their lattice about the axis."""
        turned = self.camera.mla_rotation != 0
        return microlens_array(upright(self.camera), self.wavelength) if turned else self.microlenses

    @cached_property
    def lens(self) -> MainLens:
        """Main lens of the camera, for waves and rays; see `MainLens` for its methods."""
        return cached_main_lens(self.camera, self.wavelength, model=self.lens_model or self.camera.lens_model)

    def waves_of(self, points: Doubles) -> MainLens:
        """Return the main lens for waves from scene points (n, 3), or refuse points without such waves."""
        return self.lens.waves_of(points)

    def waves_of_one(self, point: Doubles) -> PointLight:
        """Return the light of a scene point (3,) on the exit pupil, as exactly as the lens can represent it."""
        return cast(ClosedLens, self.lens) if self.lens.is_uniform else cast("RealLens", self.lens).waves_of_one(point)
