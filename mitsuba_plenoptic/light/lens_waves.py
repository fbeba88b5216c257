"""The phases of microlenses, in units of the lens that a ray meets, without the path by which rays land."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lattice import Lattice
from ..optics.waves import in_millimetres
from .lens_kinds import Kind, LensKinds
from .microlenses import aperture_points
from .oblique import phase


@dataclass(frozen=True)
class LensWaves:
    """The microlenses of one camera at one wavelength."""

    # A camera whose detector is near the microlenses' focus; one with glass is taken `at_wavelength`.
    camera: PlenopticCamera
    wavelength: float

    @property
    def lattice(self) -> Lattice:
        """The microlens lattice."""
        return self.camera.lattice

    @cached_property
    def _lens_kinds(self) -> LensKinds:
        return LensKinds(self.camera)

    @property
    def kinds(self) -> list[Kind]:
        """The kinds of microlenses."""
        return self._lens_kinds.every

    @property
    def defocus(self) -> float:
        """Largest defocus of the microlenses' waves on the detector, in radians at the edge of a lens."""
        square = float(self.lattice.aperture_reach) ** 2
        most = max(abs(self.convergence(kind)) for kind in self.kinds)
        return math.pi * most * square / in_millimetres(self.wavelength)

    @property
    def aberration(self) -> float:
        """Difference of the shape of lenses from the parabola by which rays land, in radians at the edge of a lens.

        It is that of the slopes, since a phase may have jumps.
        """
        shape, lattice, (focal_length, *_) = self.camera.mla_shape, self.lattice, self.camera.reduced_focal_lengths
        assert shape is not None
        u, v = lattice.to_frame(*aperture_points(lattice))
        strength = shape.strength(self.wavelength)
        slopes = (s * strength + place / focal_length for s, place in zip(shape.slopes(u, v), (u, v), strict=True))
        most = float(np.hypot(*slopes).max())
        return math.pi * most * float(lattice.aperture_reach) / in_millimetres(self.wavelength)

    def convergence(self, kind: Kind) -> float:
        """Return the wavefront curvature behind a lens for a pupil point, less that for focus on the detector."""
        # Waves from a point of an objective's stop are plane.
        own = self.camera.lens_data.converges / self.camera.pupil_distance
        return 1 / kind.distance + own - 1 / kind.focal_length

    def _beyond_parabola(self, u: NDArray[np.float64], v: NDArray[np.float64], kind: Kind) -> NDArray[np.float64]:
        """Return the phase of a lens in waves, less the phase of the parabola by which rays land."""
        shape = self.camera.mla_shape
        assert shape is not None
        ratio = kind.focal_length / self.camera.reduced_focal_lengths[kind.lens_type]
        parabola = (u * u + v * v) / (2 * in_millimetres(self.wavelength) * kind.focal_length)
        return np.asarray(shape.waves(u, v, self.wavelength) / ratio + parabola)

    def _beyond_paraxial(
        self, u: NDArray[np.float64], v: NDArray[np.float64], kind: Kind, cosines: tuple[float, float]
    ) -> NDArray[np.float64]:
        """Return the phase of a lens in waves for light of some direction cosines without the paraxial one."""
        camera = self.camera
        power = 1 / kind.focal_length - camera.lens_data.converges / camera.pupil_distance
        enlargement = self._lens_kinds.enlargement(kind.focal_length)
        path = phase(u, v, cosines, power, camera.mla_medium, enlargement)
        return np.asarray(path / in_millimetres(self.wavelength))

    def transmission(
        self, x: NDArray[np.float64], y: NDArray[np.float64], kind: Kind, cosines: tuple[float, float], steep: bool
    ) -> tuple[NDArray[np.complex64], NDArray[np.bool_]]:
        """Return the transmission of a lens of a kind and its neighbours at positions from its centre.

        Light has some direction cosines. Unless `steep`, each ray lands by its own point of the lens, and phases that
        displace light within the lens are left out. The mask of the lens's aperture is returned as well.
        """
        lattice, camera = self.lattice, self.camera
        wavelength = in_millimetres(self.wavelength)
        # Lens types alternate along a row.
        centre = lattice.centre(float(kind.lens_type), 0.0)
        i, j = lattice.cell(x + centre[0], y + centre[1])
        cx, cy = (c - c0 for c, c0 in zip(lattice.centre(i, j), centre, strict=True))
        # Neighbours are assumed to deviate as the lens itself does.
        powers = camera.mla_focal_lengths[kind.lens_type] / kind.focal_length / np.array(camera.mla_focal_lengths)
        types = lattice.lens_type(i, j).astype(int) if len(powers) > 1 else np.zeros(i.shape, int)
        waves = ((x * x + y * y) * powers[kind.lens_type] - ((x - cx) ** 2 + (y - cy) ** 2) * powers[types]) / (
            2 * wavelength
        )
        if steep:
            # A quadratic phase shifts the landing point in proportion to the position on the lens.
            waves += self.convergence(kind) * (x * x + y * y) / (2 * wavelength)
            waves += self._beyond_paraxial(*lattice.to_frame(x - cx, y - cy), kind, cosines)
        if camera.mla_shape is not None:
            waves += self._beyond_parabola(*lattice.to_frame(x - cx, y - cy), kind)
        inside = lattice.in_aperture(x - cx, y - cy)
        T = np.where(inside, np.exp(2j * np.pi * waves), 0).astype(np.complex64)
        # Functions are undefined outside the aperture, where rays have no coefficients.
        return T, (i == kind.lens_type) & (j == 0) & inside
