r"""Light that small spheres scatter, by angle and polarisation (Mie 1908), and its power over a camera's pupil.

The package miepython has the coefficients of the series, and equations 4.47 and 4.74 of Bohren and Huffman 1983,
"Absorption and Scattering of Light by Small Particles", are their sum.

The pupil of a lens stands in a plane before the particles, as the camera sees them; Snell's law tells the directions
behind the window. That of an objective is infinitely far, and by the sine condition the point P of its stop sends rays
in the direction with :math:`n \sin\theta = |P| / f`, alike for all particles.
"""

import itertools
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, make_interp_spline

from ...camera import PlenopticCamera
from ...errors import refuse_if, require_module
from ...fields import OpticalSystem
from ...points import BORDER, PupilWeights
from ...runtime import Doubles, Numbers, Pair, require_memory
from .seeding import Seeding, Window

_LARGEST = 2000.0
"""Size parameter at most: 250 micrometres in water, where rays would do, and the series has 2000 terms."""

_FEWEST = 4
"""Cells across the pupil at least."""

_TOGETHER = 2**18
"""Directions whose scattering is computed at a time, which limits memory."""


@lru_cache(maxsize=2**14)
def _coefficients(size: float, index: complex) -> NDArray[np.complex128]:
    """Return the coefficients a and b of one sphere, (2, terms), which captures ask for several times."""
    miepython = require_module(
        "miepython", "light scattered by spheres needs a package: pip install 'mitsuba-plenoptic[particles]'"
    )
    # There the imaginary part is negative where a sphere absorbs.
    return np.asarray(miepython.coefficients(index.conjugate(), size))


def _amplitudes(diameters: Doubles, index: complex, wavelength: float, cosines: Doubles) -> NDArray[np.complex128]:
    """Return the amplitudes S1 and S2, of light across the plane of scattering and in it, (2, spheres, angles).

    Parameters are those of `cross_sections`. Phases are those of light that travels as exp(i k r).
    """
    sizes = np.pi * diameters / (wavelength * 1e-3)
    refuse_if(sizes.max(initial=0) > _LARGEST, f"diameter: a size parameter is {sizes.max():.4g}, at most {_LARGEST:g}")
    series = [_coefficients(size, complex(index)) for size in sizes.tolist()]
    scattered = np.zeros((2, *cosines.shape), complex)
    # Angular functions pi and tau, Bohren and Huffman's equation 4.47.
    before = np.zeros(cosines.shape)
    pi = np.ones(cosines.shape)
    for n in range(1, max((terms.shape[1] for terms in series), default=0) + 1):
        tau = n * cosines * pi - (n + 1) * before
        own = np.array([terms[:, n - 1] if n <= terms.shape[1] else (0, 0) for terms in series])
        a, b = (2 * n + 1) / (n * (n + 1)) * own.T[..., None]
        scattered += a * pi + b * tau, a * tau + b * pi
        before, pi = pi, ((2 * n + 1) * cosines * pi - (n + 1) * before) / n
    return scattered


def cross_sections(diameters: Doubles, index: complex, wavelength: float, cosines: Doubles) -> Doubles:
    """Return differential scattering cross-sections, in square micrometres per steradian, of unpolarised light.

    Parameters
    ----------
    diameters : float64 array (spheres,)
        Diameters in micrometres.
    index : complex
        Refractive index over that of the medium.
    wavelength : float
        Wavelength in the medium, in nanometres.
    cosines : float64 array (spheres, angles)
        Cosines of the angle between the incident and the scattered light.
    """
    wavenumber = 2 * np.pi / (wavelength * 1e-3)
    return (np.abs(_amplitudes(diameters, index, wavelength, cosines)) ** 2).sum(0) / (2 * wavenumber**2)


@dataclass(frozen=True)
class ScatteredLight:
    """The light of particles over the pupil of a camera's main lens.

    Unpolarised light is as good as two incoherent fields, across the plane of its direction and the camera's axis and
    in it. A sphere scatters each into both polarisations, which do not interfere in an image. So there are four
    amplitudes over the pupil; of light from the side through a small aperture two of them are negligible.
    """

    camera: PlenopticCamera
    # Positions at which the camera sees particles, (n, 3), diameters in micrometres, (n,), and the irradiance, (n,).
    positions: Doubles
    diameters: Doubles
    irradiance: Doubles
    # Direction in which the light travels.
    direction: Numbers
    seeding: Seeding
    window: Window
    # In vacuum, in nanometres.
    wavelength: float

    @cached_property
    def _plane(self) -> float:
        """Distance of the entrance pupil along the axis in mm."""
        return float(OpticalSystem(self.camera, self.wavelength).lens.entrance.pupil)

    def _pupil(self, positions: Doubles, x: Doubles, y: Doubles) -> Pair:
        """Return unit vectors (n, q, 3) in the fluid to points (q,) of the pupil, and the solid angles of a mm^2."""
        objective = self.camera.objective
        ratio = self.window.ratio(self.camera)
        if objective is None:
            towards = _unit(np.stack([x, y, np.full(len(x), self._plane)], -1) - positions[:, None])
            solid = -(towards[..., 2] ** 3) / (positions[:, 2:] - self._plane) ** 2
            if ratio == 1:
                return towards, solid
            sines = ratio * towards[..., :2]
            cosine = np.sqrt(1 - (sines**2).sum(-1, keepdims=True))
            return np.concatenate([sines, -cosine], -1), solid * ratio**2 * -towards[..., 2] / cosine[..., 0]
        length = objective.immersion / ratio * objective.focal_length
        sines = np.stack([x, y]) / length
        # The corners of the square around the pupil may lie beyond the horizon.
        sines *= np.minimum(1, 0.999 / np.maximum(np.hypot(*sines), 1e-300))
        cosine = np.sqrt(1 - (sines**2).sum(0))
        shape = len(positions), len(x)
        towards = np.broadcast_to(np.stack([*sines, -cosine], -1), (*shape, 3))
        return towards, np.broadcast_to(1 / (cosine * length**2), shape)

    @cached_property
    def cells(self) -> int:
        """Cells across the square around the pupil, which resolve the fringes of the largest particle's rim."""
        if self.seeding.index is None:
            return _FEWEST
        size = np.pi * float(self.diameters.max(initial=0)) * self.seeding.medium / (self.wavelength * 1e-3)
        objective = self.camera.objective
        nearest = np.abs(self.positions[:, 2] - self._plane).min(initial=np.inf)
        angle = objective.half_angle if objective else self.camera.aperture_radius / nearest
        # As many as the series has terms, over the angle that the pupil covers.
        waves = (size + 4 * size ** (1 / 3)) * angle * self.window.ratio(self.camera) / np.pi
        # 8.0: Cells across a period of the amplitude of the widest sphere's rim.
        return max(_FEWEST, int(np.ceil(8.0 * waves)))

    def _over_pupil(self, x: Doubles, y: Doubles) -> NDArray[np.complex128]:
        """Return the four amplitudes towards points (q,) of the pupil, (4, n, q).

        The sum of their squared moduli is the differential cross-section in square micrometres per steradian.
        """
        assert self.seeding.index is not None
        medium = self.seeding.medium
        wavelength = self.wavelength / medium
        count = len(self.positions)
        result = np.empty((4, count, len(x)), complex)
        # 3: Angles at which the scattering of a particle is computed, to each cell across the pupil.
        steps = np.linspace(0, 1, 3 * (self.cells + 2))
        light = np.array(self.direction)
        axis = np.array([0.0, 0.0, -1.0])
        across = _unit(np.cross(light, axis) if np.hypot(*light[:2]) > 1e-9 else np.array([1.0, 0, 0]))
        together = max(1, _TOGETHER // len(x))
        for some in (slice(first, first + together) for first in range(0, count, together)):
            towards, _ = self._pupil(self.positions[some], x, y)
            angle = np.arccos(np.clip(towards @ light, -1, 1))
            # Few angles, between which the many of the points are interpolated.
            low = angle.min(1)[:, None]
            nodes = low + steps * (angle.max(1)[:, None] - low)
            scattered = _amplitudes(self.diameters[some], self.seeding.index / medium, wavelength, np.cos(nodes))
            rows = zip(nodes, scattered.swapaxes(0, 1), angle, strict=True)
            s1, s2 = np.stack([CubicSpline(tabulated, values, axis=1)(angles) for tabulated, values, angles in rows], 1)
            # Across the plane of scattering; straight on and back any direction will do.
            normal = _unit(np.cross(light, towards) + 1e-12 * across)
            first = np.cross(normal, light)
            second = np.cross(normal, towards)
            parts = itertools.product((across, np.cross(across, light)), (across, np.cross(across, axis)))
            for pair, (incident, leaving) in enumerate(parts):
                # The lens turns light to the axis, with its polarisation.
                turned = leaving - (towards @ leaving)[..., None] / (1 + towards @ axis)[..., None] * (towards + axis)
                across_plane = s1 * (normal @ incident) * (normal * turned).sum(-1)
                result[pair, some] = across_plane + s2 * (first @ incident) * (second * turned).sum(-1)
        return result * (wavelength * 1e-3 / (2 * np.pi * np.sqrt(2)))

    @cached_property
    def powers(self) -> Doubles:
        """Powers of each particle through the pupil, in square micrometres, by amplitude, (4, n); beads have one."""
        # Gauss's rule in the square of the radius, evenly in angle.
        nodes, weights = np.polynomial.legendre.leggauss(self.cells // 2 + 4)
        turn = 2 * np.pi * (np.arange(self.cells + 12) + 0.5) / (self.cells + 12)
        radius = self.camera.aperture_radius * np.sqrt((nodes + 1) / 2)
        x, y = (np.outer(radius, part).ravel() for part in (np.cos(turn), np.sin(turn)))
        areas = np.repeat(np.pi * self.camera.aperture_radius**2 * weights / 2 / len(turn), len(turn))
        solid_angles = self._pupil(self.positions, x, y)[1] * areas
        if self.seeding.index is None:
            # Beads emit over the full solid angle.
            return (self.irradiance * self.diameters**3 / 24 * solid_angles.sum(1))[None]
        return self.irradiance * (np.abs(self._over_pupil(x, y)) ** 2 * solid_angles).sum(-1)

    def followed(self, accuracy: float) -> tuple[Doubles, PupilWeights | None]:
        """Return the powers of the amplitudes that count, (k, n), and these amplitudes, one after the other."""
        if self.seeding.index is None or not len(self.positions):
            return self.powers, None
        cells = self.cells
        count = len(self.positions)
        require_memory(300.0 * count * (cells + 2 * BORDER) ** 2, f"{count} particles over {cells} x {cells} cells")
        total = self.powers.sum(0)
        # 0.1: Mean part of a polarisation's light, over the allowed error, below which it is not followed on its own.
        strong = self.powers.sum(1) > max(0.1 * accuracy, 1e-7) * total.sum()
        # Splines through the centres of cells, and two more places at each border, beyond which there may be no light.
        at = np.concatenate([[0, 0.25], np.arange(cells) + 0.5, [cells - 0.25, cells]])
        knots = np.arange(-3.5, cells + 4)
        x, y = (self.camera.aperture_radius * (2 / cells * mesh.ravel() - 1) for mesh in np.meshgrid(at, at))
        # Per solid angle before the window, as the light of points is.
        behind, before = (light._pupil(self.positions, x, y)[1] for light in (self, replace(self, window=Window())))
        table = (self._over_pupil(x, y)[strong] * np.sqrt(behind / before)).reshape(-1, len(at), len(at))
        for _ in "yx":
            table = make_interp_spline(at, table, t=knots, axis=1).c.transpose(1, 2, 0)
        powers = self.powers[strong]
        table = table.astype(np.complex64)
        weights = PupilWeights(table, np.arange(len(table)), np.zeros((len(table), 2)), sampled=True)
        return powers * (total / powers.sum(0)), weights


def _unit(vectors: Doubles) -> Doubles:
    """Return vectors (..., 3) of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
