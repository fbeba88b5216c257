"""What the fields of points are multiplied by on their way over a patch: pupil, curvature, microlenses, free space.

These are all that the field depends on beside Fourier transforms of fixed sizes (see `patch`). The numbers of the
camera that they are made of may be floats, or Dr.Jit numbers that carry gradients, while grids and places stay as they
are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..lattice import turn
from ..lenses.base import Light, MainLens
from ..lenses.lens_changes import VaryingLens, VaryingLight
from ..optics.free_space import transfer
from ..optics.phase import in_millimetres, phasor, smooth_edge, soft_edge
from ..runtime.backend import array_module
from ..runtime.fft import split
from ..system.microlens_orders import axis_transmission, plane_transmission
from ..system.microlenses import is_separable
from ..system.sampling import fast_length
from .grid import Grid, Placement
from .pupil_weights import PupilWeights


class Microlenses(Protocol):
    """The transmission of the microlenses in the frame of their lattice: one of the two, as `is_separable` tells."""

    def along(self, coordinate: Any, axis: int) -> Any:
        """Return the factor along one axis."""

    def at(self, x: Any, y: Any) -> Any:
        """Return the transmission at some places."""


@dataclass(frozen=True)
class Elements:
    """The optical elements that a field passes; numbers are floats or Dr.Jit numbers, which may carry gradients.

    Numbers of Dr.Jit may be there once, or once for each lane of the factor that is made of them.

    Attributes
    ----------
    lens : MainLens or VaryingLens
        The main lens.
    microlenses : Microlenses
        In the frame of the lattice.
    wavelength : float
        In nanometres.
    detector_distance : float
        In millimetres.
    turned : float
        Degrees by which the lattice is turned, counter-clockwise, from where its frame is.
    growth : float
        Factor on all distances of samples on the MLA and the detector, and on the places of patches. It follows the
        wavelength, so that directions and points of the pupil stay where they are.
    aberration : callable, optional
        Returns a further path of the main lens at points x and y of its pupil in the camera frame, in millimetres.
    """

    lens: MainLens | VaryingLens
    microlenses: Any
    wavelength: Any
    detector_distance: Any
    turned: Any = 0.0
    growth: Any = 1.0
    aberration: Callable[[Any, Any], Any] | None = None

    @classmethod
    def of(cls, grid: Grid, cosine: float) -> Elements:
        """Take those of a camera in the frame of its lattice, with microlenses up to a direction cosine."""
        camera, wavelength = grid.camera, grid.wavelength
        make = axis_transmission if is_separable(camera) else plane_transmission
        return cls(grid.lens, make(camera, wavelength, cosine), wavelength, camera.detector_distance)


class PatchFactors:
    """The factors of points whose patches have one size.

    Parameters
    ----------
    grid, placement, positions, amplitudes, weights
        As of `patch.PatchBatch`.
    types : module, optional
        Of Dr.Jit's arrays. Default: those of the active processor without gradients.

    Attributes
    ----------
    samples, mla_samples : int
        Across each patch on the detector, and on the MLA.
    highest : float
        Largest direction cosine to which microlenses may send light.
    directions : int
        Across the square that holds the plane waves from each pupil.
    chief : int array (n, 2)
        Number of the middle direction of each.
    transfer_shape : (int, int)
        Directions along y and x for which there is a transfer function.
    """

    def __init__(
        self,
        grid: Grid,
        placement: Placement,
        positions: NDArray[np.float64],
        amplitudes: NDArray[np.float64],
        weights: PupilWeights | None,
        types: Any = None,
    ) -> None:
        self._grid, self._placement, self._positions = grid, placement, positions
        self._amplitudes, self._weights = amplitudes, weights
        self._types = types or array_module()
        self.separable = is_separable(grid.camera)
        self.samples = int(placement.samples[0])
        finest = float((in_millimetres(grid.wavelength) / (self.samples * grid.pitch)).min())
        half = 2 * grid.cosine / finest
        # Orders that would fold back into the kept band are cut; a few more samples keep those of use.
        self.mla_samples = max(self.samples, fast_length(0.87 * (self.samples + half)))
        self.highest = min(self.samples + half, 2 * self.mla_samples - self.samples - half) / 2 * finest
        self.chief = (placement.first + placement.last) // 2
        self.directions = int((placement.last - placement.first).max()) + 1
        self._low = self.chief.min(0)
        columns, rows = (int(size) for size in self.chief.max(0) - self._low + self.samples)
        self.transfer_shape = rows, columns

    @property
    def _steps(self) -> list[float]:
        """Distances of directions along x and y."""
        return (in_millimetres(self._grid.wavelength) / (self.samples * self._grid.pitch)).tolist()

    def _constant(self, number: Any) -> Any:
        """Return a number that is no part of the kernel's code."""
        return number if dr.is_array_v(number) else dr.opaque(self._types.Float64, number)

    def _each(self, numbers: Any, number: Any) -> Any:
        """Return for each lane the number of its point."""
        if isinstance(numbers, np.ndarray):
            numbers = self._types.Float64(np.ascontiguousarray(numbers, np.float64))
        return dr.gather(self._types.Float64, numbers, number)

    def pupil(self, elements: Elements) -> tuple[Any, Any]:
        """Return plane waves from the pupil, (n, along y, along x), and the power of each point through it.

        Returns
        -------
        waves : Complex2f of Dr.Jit
        power : Float64 of Dr.Jit
        """
        types, lens, grid, placement = self._types, elements.lens, self._grid, self._placement
        size = self.directions
        index = dr.arange(types.UInt32, len(self._positions) * size * size)
        number, row, column = split(types, index, size, size)

        def value(numbers: NDArray[Any]) -> Any:
            return self._each(numbers, number)

        steps, growth = self._steps, elements.growth
        start = grid.origin + placement.corner * grid.pitch - placement.image
        nx = types.Float64(column) + value(placement.first[:, 0])
        ny = types.Float64(row) + value(placement.first[:, 1])
        sx, sy = nx * self._constant(steps[0]), ny * self._constant(steps[1])
        b = self._constant(lens.pupil_distance)
        image = value(placement.image[:, 0]) * growth, value(placement.image[:, 1]) * growth
        pupil, R, length = lens.from_array((sx, sy), image)
        X, Y = turn(value(self._positions[:, 0]), value(self._positions[:, 1]), -elements.turned)
        point, light = (X, Y, value(self._positions[:, 2])), lens.bind(self._positions, number)
        waves = self._path(elements, light, pupil, point)
        waves += length / self._constant(in_millimetres(elements.wavelength))
        start[:, 1] *= grid.pitch[0] / grid.pitch[1]
        waves += (nx * value(start[:, 0]) + ny * value(start[:, 1])) / self._constant(self.samples * grid.pitch[0])
        # The power is that of the hard edge; the width of the soft one is a matter of the grid.
        width = math.sqrt(math.prod(steps)) * grid.band.edge
        sample = dr.detach(R) * self._constant(width)
        soften = smooth_edge if grid.band.smooth else soft_edge
        cover = soften(types.Float(light.inside(pupil) / sample))
        bright = types.Float(light.amplitude(pupil, point) * R * R / b)
        power = types.Float64(bright * bright * cover)
        if self._weights is not None:
            place = self._in_camera(elements, *pupil)
            passed, amplitude = self._weights.at(number, *place, lens.pupil_radius, sample)
            power *= types.Float64(passed)
            cover *= types.Float(amplitude)
        return phasor(waves) * (bright * cover), dr.block_sum(power, size * size) * self._constant(math.prod(steps))

    def _path(
        self, elements: Elements, light: Light | VaryingLight, pupil: tuple[Any, Any], point: tuple[Any, Any, Any]
    ) -> Any:
        """Return the path from points to the pupil in waves; both are given in the frame of the lattice."""
        if elements.lens.is_round and elements.aberration is None:
            return light.path(pupil, point, elements.wavelength)
        in_camera = self._in_camera(elements, *pupil)
        if elements.lens.is_round:
            waves = light.path(pupil, point, elements.wavelength)
        else:
            X, Y = self._in_camera(elements, *point[:2])
            waves = light.path(in_camera, (X, Y, point[2]), elements.wavelength)
        if elements.aberration is None:
            return waves
        return waves + elements.aberration(*in_camera) / self._constant(in_millimetres(elements.wavelength))

    def _in_camera(self, elements: Elements, x: Any, y: Any) -> tuple[Any, Any]:
        """Turn a vector of the lattice's frame into one of the camera's."""
        return turn(x, y, self._grid.rotation + elements.turned)

    def scale(self, elements: Elements, power: Any) -> Any:
        """Return the factor on each field that makes its intensity the density of a fraction of the power."""
        lit = power > 0
        steps = self._constant(math.prod(self._steps))
        lam = self._constant(in_millimetres(elements.wavelength))
        scale = self._types.Float64(self._amplitudes) * steps / dr.sqrt(dr.select(lit, power, 1))
        return dr.select(lit, scale / (lam * self._constant(float(self.mla_samples) ** 2)), 0)

    def along(self, elements: Elements, axis: int, scale: Any) -> Any:
        """Return the factor on the MLA along x (axis 0) or y, (n, samples), as Complex2f; that along y has the scale.

        The microlenses are in it if they are such a product.
        """
        types, placement = self._types, self._placement
        count = len(self._positions)
        index = dr.arange(types.UInt32, count * self.mla_samples)
        _, number, sample = split(types, index, count, self.mla_samples)
        m = self._each(self._corner[:, axis], number)
        m += types.Float64(sample) * self._constant(float(self._mla_pitch[axis]))
        image, growth = self._each(placement.image[:, axis], number), elements.growth
        mu = (m - image) * growth
        # path from the pupil: (mu^2 - (s mu)^2) / 2 R, of which the part along the other axis is tiny
        b = self._constant(elements.lens.pupil_distance)
        square = self._each((placement.image**2).sum(1), number) * growth * growth + b * b
        own = image * image * growth * growth
        spread = (1 - own / square) / (2 * self._constant(in_millimetres(elements.wavelength)))
        curvature = spread * elements.lens.curvature(square)
        shift = ((placement.first - self.chief)[:, axis] + self.samples // 2) / self.mla_samples
        waves = mu * mu * curvature + types.Float64(sample) * self._each(shift, number)
        factor = phasor(waves)
        if self.separable:
            factor *= elements.microlenses.along(m * growth, axis)
        return factor * types.Float(self._each(scale, number)) if axis else factor

    def lenses(self, elements: Elements) -> Any:
        """Return the transmission of the microlenses, (n, samples along y, samples along x), as Complex2f."""
        types, size = self._types, self.mla_samples
        number, row, column = split(types, dr.arange(types.UInt32, len(self._positions) * size * size), size, size)
        x, y = (
            (
                self._each(self._corner[:, axis], number)
                + types.Float64(index) * self._constant(float(self._mla_pitch[axis]))
            )
            * elements.growth
            for axis, index in ((0, column), (1, row))
        )
        return elements.microlenses.at(x, y)

    @property
    def _corner(self) -> NDArray[np.float64]:
        """Places of the first samples on the MLA, (n, 2)."""
        return self._grid.origin + self._placement.corner * self._grid.pitch

    @property
    def _mla_pitch(self) -> NDArray[np.float64]:
        """Distance between samples on the MLA along x and y."""
        return self.samples * self._grid.pitch / self.mla_samples

    def transfer(self, elements: Elements) -> Any:
        """Return the transfer function from MLA to detector, of all directions of all points, as Complex2f."""
        types = self._types
        rows, columns = self.transfer_shape
        _, row, column = split(types, dr.arange(types.UInt32, rows * columns), rows, columns)
        sx, sy = (
            (types.Float64(index) + self._constant(float(self._low[axis] - self.samples // 2)))
            * self._constant(self._steps[axis])
            for axis, index in ((0, column), (1, row))
        )
        return transfer(sx, sy, elements.detector_distance, elements.wavelength)
