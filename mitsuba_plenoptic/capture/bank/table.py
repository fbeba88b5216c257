r"""What the pattern of a lens depends on, as coordinates of a table.

Light of a point with the defocus m, blurred over :math:`N = D_1 |m| / D_2` lenses, has at a lens the curvature of its
wavefront, which goes with 1 / N, and the diffraction of the pupil's rim. Its ripples are those of a knife edge in the
coordinate :math:`w = e \sqrt{2 F / N}` (Goodman, "Introduction to Fourier Optics", section 4.5), e the distance from
the rim in pitches and :math:`F = D_1 D_2 / \lambda b`; in its shadow
what counts is e itself.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import scipy
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...optics.main_lens import main_lens
from ...optics.phase import in_millimetres
from ...runtime.backend import array_module
from .blend import blur_of
from .patterns import Nodes
from .radial import RadialFields, distance_of

SHADOW = 3.0
"""Distance beyond the rim, in pitches, at which a lens is dark."""

_RIPPLES = 6.0
"""Coordinate w from the rim inwards from which on ripples are left out."""

_DEPTH_STEP, _EDGES, _ANGLES = 0.02, 73, 16
"""Distance of the table's nodes in 1 / N, and numbers of nodes in the distance from the rim and in its direction."""

_FINER = (4, 2, 2)
"""How much finer than its nodes a table is."""

_GREATEST = 2**15 - 1
"""Of the whole numbers that coefficients are rounded to."""

_MOST_BLUR = 64.0
"""Lenses of blur from which on wavefront and rim count as straight."""


@dataclass(frozen=True)
class Side:
    """Depths on one side of focus, evenly in 1 / N.

    Attributes
    ----------
    sign : int
        Of the defocus.
    low, high : float
        Least and greatest 1 / N.
    """

    sign: int
    low: float
    high: float

    @property
    def nodes(self) -> int:
        """Nodes of the table."""
        return 1 + math.ceil((self.high - self.low) / _DEPTH_STEP)

    @property
    def lines(self) -> int:
        """Depths in the finer table."""
        return (self.nodes - 1) * _FINER[0] + 1


@dataclass(frozen=True)
class Coordinates:
    """From a pupil point and the vergence of a point's image to places in the table.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    sides : tuple of Side
        Those that are in the table.
    """

    camera: PlenopticCamera
    wavelength: float
    sides: tuple[Side, ...]

    @classmethod
    def between(
        cls, camera: PlenopticCamera, wavelength: float, vergences: tuple[float, float], least_blur: float
    ) -> Coordinates:
        """Cover what lies between two vergences and is blurred over some lenses at least."""
        sides = []
        for sign in (1, -1):
            blurs = [min(max(sign * float(blur_of(camera, v)), least_blur), _MOST_BLUR) for v in vergences]
            if max(blurs) > least_blur:
                sides.append(Side(sign, 1 / max(blurs), 1 / min(blurs)))
        return cls(camera, wavelength, tuple(sides))

    @property
    def ripple(self) -> float:
        """Coordinate w over the distance from the rim in pitches, times the root of N."""
        a, b = self.camera.aperture_radius, main_lens(self.camera).pupil_distance
        return float(np.sqrt(4 * a * max(self.camera.mla_pitches) / (in_millimetres(self.wavelength) * b)))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes of depth, edge and angle."""
        return sum(side.nodes for side in self.sides), _EDGES, _ANGLES

    def fields(self) -> tuple[RadialFields, NDArray[np.float64]]:
        """Return the fields of all depths, and the distances of their points."""
        lens = main_lens(self.camera)
        blur = self._blur()
        defocus_of = blur * max(self.camera.mla_pitches) / (2 * lens.pupil_radius)
        distance = distance_of(lens, (1 - defocus_of) / lens.pupil_distance)
        reach = float(np.abs(blur).max() / 2 + 2 * SHADOW) * max(self.camera.mla_pitches) * 1.1
        return RadialFields.of(self.camera, self.wavelength, distance, reach), distance

    def _blur(self) -> NDArray[np.float64]:
        """Return the blur of every depth in lenses, with the sign of its defocus."""
        return np.concatenate([side.sign / np.linspace(side.low, side.high, side.nodes) for side in self.sides])

    def nodes(self, distance: NDArray[np.float64]) -> Nodes:
        """Return all nodes of the table, flat; those of a depth follow each other."""
        depth, edge, angle = (index.ravel() for index in np.indices(self.shape))
        blur = np.abs(self._blur())[depth]
        place = np.linspace(-SHADOW, _RIPPLES, _EDGES)[edge]
        inside = np.where(place < 0, place, place * np.sqrt(blur) / self.ripple)
        radius = float(main_lens(self.camera).pupil_radius) * np.maximum(0, 1 - 2 * inside / blur)
        return Nodes(depth, distance[depth], radius, angle * (2 * np.pi / _ANGLES))

    def reach(self, vergence: Any) -> Any:
        """Return how far beyond the pupil's rim, in millimetres, a lens still has light."""
        return self.camera.aperture_radius * (2 * SHADOW / abs(blur_of(self.camera, vergence)))

    @property
    def widest(self) -> float:
        """Distance from the axis, in the pupil, beyond which no lens has light of any point."""
        return self.camera.aperture_radius * (1 + 2 * SHADOW * max((side.high for side in self.sides), default=0.0))

    def places(self, Px: Any, Py: Any, vergence: Any) -> tuple[Any, Any, Any, Any]:
        """Return the places of pupil points in the finer table.

        Parameters
        ----------
        Px, Py, vergence : Dr.Jit arrays
            Pupil points in the camera's frame, and the vergences of the images.

        Returns
        -------
        depth, edge, angle : Dr.Jit arrays
            In its lines.
        lit : Dr.Jit array
            Whether any light is there.
        """
        blur = blur_of(self.camera, vergence)
        size = dr.maximum(abs(blur), 1e-6)
        inside = (1 - dr.sqrt(Px * Px + Py * Py) * (1 / self.camera.aperture_radius)) * size * 0.5
        place = dr.select(inside < 0, inside, inside * dr.rsqrt(size) * self.ripple)
        last = (_EDGES - 1) * _FINER[1]
        edge = dr.clip((place + SHADOW) * (last / (_RIPPLES + SHADOW)), 0, last)
        depth, known = type(edge)(0), dr.mask_t(edge)(False)
        first = 0
        for side in self.sides:
            here, last = blur * side.sign > 0, side.lines - 1
            part = dr.clip((1 / size - side.low) * (last / max(side.high - side.low, 1e-9)), 0, last)
            depth = dr.select(here, part + first, depth)
            known |= here
            first += side.lines
        angle = dr.atan2(Py, Px) * (1 / (2 * np.pi)) - self.camera.mla_rotation / 360
        return depth, edge, (angle - dr.floor(angle)) * (_ANGLES * _FINER[2]), known & (place > -SHADOW)


@dataclass(frozen=True, eq=False)
class Table:
    """Coefficients on a grid that is finer than the nodes, so that only the edge needs interpolation.

    They are whole numbers of 16 bits, read by pairs: the traffic of memory is what finding them takes.

    Attributes
    ----------
    coordinates : Coordinates
        Of its nodes.
    values : int16 array (depths, angles, edges, rank or one more)
        The coefficients over their steps; the count of the last axis is even.
    steps : float32 array (rank,)
        What one stands for.
    """

    coordinates: Coordinates
    values: NDArray[np.int16]
    steps: NDArray[np.float32]

    @classmethod
    def of(cls, coordinates: Coordinates, coefficients: NDArray[np.float32]) -> Table:
        """Round coefficients (depths, angles, edges, rank), each to a part of the greatest of its kernel."""
        rank = coefficients.shape[-1]
        greatest = np.abs(coefficients).max((0, 1, 2))
        steps = np.where(greatest > 0, greatest / _GREATEST, 1).astype(np.float32)
        values = np.zeros((*coefficients.shape[:-1], _even(rank)), np.int16)
        for target, source in zip(values, coefficients, strict=True):
            target[..., :rank] = np.rint(source / steps)
        return cls(coordinates, values, steps)

    @classmethod
    def finer(cls, coordinates: Coordinates, values: NDArray[np.float32]) -> Table:
        """Interpolate coefficients at the nodes, (depths, edges, angles, rank), by splines and Fourier series."""
        spectrum = scipy.fft.rfft(values, axis=2)
        spectrum[:, :, -1] /= 2
        values = scipy.fft.irfft(spectrum, _FINER[2] * _ANGLES, axis=2) * _FINER[2]
        sides = []
        for part in np.split(values, np.cumsum([side.nodes for side in coordinates.sides])[:-1]):
            for axis in (0, 1):
                # Splines of all columns at once: a product with those of the unit vectors.
                nodes = np.arange(part.shape[axis])
                spline = scipy.interpolate.make_interp_spline(nodes, np.eye(len(nodes)), min(3, nodes[-1]))
                matrix = spline(np.arange((len(nodes) - 1) * _FINER[axis] + 1) / _FINER[axis]).astype(np.float32)
                part = np.moveaxis(np.tensordot(matrix, part, (1, axis)), 0, axis)
            sides.append(part.transpose(0, 2, 1, 3))
        return cls.of(coordinates, np.concatenate(sides))

    @classmethod
    def blank(cls, coordinates: Coordinates, rank: int) -> Table:
        """Return a table without light."""
        _, edges, angles = coordinates.shape
        lines = sum(side.lines for side in coordinates.sides)
        shape = lines, angles * _FINER[2], (edges - 1) * _FINER[1] + 1, _even(rank)
        return cls(coordinates, np.zeros(shape, np.int16), np.ones(rank, np.float32))

    @functools.cached_property
    def _flat(self) -> dict[Any, Any]:
        return {}

    def at(self, Px: Any, Py: Any, vergence: Any, active: Any) -> list[Any]:
        """Return coefficients; see `LensBank.coefficients`."""
        types = array_module()
        if types not in self._flat:
            self._flat[types] = types.UInt32(self.values.reshape(-1).view(np.uint32))
        _, angles, edges, rank = self.values.shape
        depth, edge, angle, lit = self.coordinates.places(Px, Py, vergence)
        lit &= active
        turn = types.UInt32(angle + 0.5)
        line = types.UInt32(depth + 0.5) * angles + dr.select(turn >= angles, 0, turn)
        below = types.UInt32(dr.minimum(edge, edges - 2))
        part = types.Float(edge - below)
        pairs = rank // 2
        place = (line * edges + below) * pairs
        result = []
        for pair in range(pairs):
            ends = [
                dr.reinterpret_array(
                    types.Int32, dr.gather(types.UInt32, self._flat[types], place + (pair + step), lit)
                )
                for step in (0, pairs)
            ]
            # The first of a pair is in the lower half, whose sign the shifts spread.
            for halves in ([(end << 16) >> 16 for end in ends], [end >> 16 for end in ends]):
                result.append(dr.lerp(*(types.Float(half) for half in halves), part))
        return [value * float(step) for value, step in zip(result[: len(self.steps)], self.steps, strict=True)]


def _even(rank: int) -> int:
    """Return how many coefficients are kept of so many: pairs."""
    return rank + rank % 2
