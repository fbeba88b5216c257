r"""Waves on the pupil common to the fields of points of similar distance, up to smooth factors: tilts or spheres.

The factors are functions of the pupil point and the scene point: see `pupil_sums`. A parabolic main lens adds the same
phase to the light of all points. Their fields then differ mainly by tilts; sums of tilts are non-uniform Fourier
transforms (`Tilts`).

An ideal main lens turns the sphere around each point into a sphere around the point's image, and these spheres differ
by much more than tilts: by 41 waves at f/2, 3.5 mm off the axis. With the vergence v behind the lens and the slopes u
of the point,

.. math:: p(P, X) = \frac{1}{\lambda v} \left((1 + u^2)^{1/2} - (1 + |v P + u|^2)^{1/2}\right) .

So p depends on P and u by :math:`v P + u` only: waves that converge to points of one plane, at the distance 1 / v, are
copies of one sphere, shifted by :math:`m = -u / v`. Their sum is a convolution of that sphere with the points of the
plane (`Spheres`). The transform of the points is again a non-uniform one.
"""

import functools
import math
from collections.abc import Iterator
from typing import Any, Protocol

import drjit as dr
import numpy as np
import scipy
from numpy.typing import NDArray

from ...lenses import ThinLens
from ...optics import in_millimetres, phasor
from ...points import blocks
from ...runtime import Doubles, Field, Pair, active_backend, array_module, backend_of, fft, on_cuda
from .nonuniform import PlaneWaves

_FADED = 0.3
"""Width of the edge over which the sphere is faded out, over the half width of the part of it that is needed."""


class PupilGrid:
    """The square part of a wide grid, `count` x `count` samples, that contains the pupil."""

    def __init__(self, lens: ThinLens, origin: Pair, pitch: float):
        self.pitch = pitch
        self.count = 2 * math.ceil(lens.pupil.radius / pitch) + 3
        middle = [round(-start / pitch) for start in origin]
        self.middle = np.array([start + index * pitch for start, index in zip(origin, middle, strict=True)])
        left, top = (index - self.count // 2 for index in middle)
        self.rows, self.columns = slice(top, top + self.count), slice(left, left + self.count)

    def along(self, axis: int) -> Doubles:
        """Return the coordinates of the samples along an axis (0: x, 1: y)."""
        return self.middle[axis] + (np.arange(self.count) - self.count // 2) * self.pitch


class Carrier(Protocol):
    """Carrier waves of a layer's points: their fields without the smooth factors.

    `shift` (n,) are phase factors of the points that the sums leave out.
    """

    shift: NDArray[np.complex128]

    def forward(self, amplitudes: Field) -> Iterator[tuple[slice, Field]]:
        """Yield blocks of rows of the sum of the waves with given amplitudes (n,) on the pupil's samples."""

    def adjoint(self, samples: Iterator[tuple[slice, Field]]) -> Field:
        """Return each wave's inner product with samples, which come in blocks of rows."""

    def common(self, pupil: Pair) -> Any:
        """Return the additional path in waves, common to all points, at points of the pupil."""

    def remainder(self, waves: Doubles, x: Doubles, y: Doubles, points: Any) -> Doubles:
        """Return paths of some points in waves at m pupil points, less the paths of the carrier waves, (m, n)."""


class Tilts:
    """Plane waves relative to the path of the middle of a layer's points (n, 3)."""

    def __init__(self, lens: ThinLens, wavelength: float, points: Doubles, grid: PupilGrid):
        self._lens = lens
        self._wavelength = wavelength
        vergence = 1 / points[:, 2]
        distance = _finite_inverse((vergence.min() + vergence.max()) / 2)
        tilt = points[:, :2] * vergence[:, None]
        self.middle = np.append((tilt.min(0) + tilt.max(0)) / 2 * distance, distance)
        self._frequencies = self._cosines(points) - self._cosines(self.middle[None])
        self._frequencies /= in_millimetres(wavelength)
        waves = PlaneWaves(self._frequencies * grid.pitch, grid.count)
        self.forward = waves.forward
        self.adjoint = waves.adjoint
        self.shift = np.exp(2j * math.pi * (self._frequencies @ grid.middle))

    @staticmethod
    def memory(lens: ThinLens, points: Doubles, grid: PupilGrid) -> float:
        """Return an upper bound, in bytes, of the memory of the sums, apart from memory that grows with the points."""
        return PlaneWaves.memory(grid.count)

    def common(self, pupil: Pair) -> Any:
        """Return the path in waves of the middle of the layer."""
        opaque = array_module().Float64
        X, Y, g = (dr.opaque(opaque, float(value)) for value in self.middle)
        return self._lens.path(pupil, (X, Y, g), self._wavelength)

    def remainder(self, waves: Doubles, x: Doubles, y: Doubles, points: Any) -> Doubles:
        """Return paths in waves less the middle point's path and the tilts."""
        of_middle = self._lens.path((x[:, None], y[:, None]), tuple(self.middle), self._wavelength)
        return waves - of_middle - np.stack([x, y], 1) @ self._frequencies[points].T

    def _cosines(self, points: Doubles) -> Doubles:
        return np.stack(self._lens.cosines((0.0, 0.0), tuple(points.T)), -1)


class Spheres:
    """Spherical waves towards the images of points (n, 3) by an ideal lens, with the images moved into one plane."""

    def __init__(self, lens: ThinLens, wavelength: float, points: Doubles, grid: PupilGrid):
        self._lens = lens
        self._wavelength = wavelength
        self._grid = grid
        self._distance, self._images = _images(lens, points)
        self._reach = _reach(self._images, grid)
        # What is beyond the window is faded out there, so that nothing comes in on the other side.
        self._count = 2 * fft.fast_length(self._reach * (1 + _FADED))
        # At the pupil's centre paths are zero.
        self.shift = np.exp(2j * math.pi * self._path((self._images**2).sum(1)))
        self._waves = PlaneWaves((grid.middle - self._images) / (grid.pitch * self._count), self._count)

    @staticmethod
    def window(lens: ThinLens, points: Doubles, grid: PupilGrid) -> float:
        """Return the width of the window of the convolution, in samples of the pupil."""
        return 2 * (1 + _FADED) * _reach(_images(lens, points)[1], grid)

    @classmethod
    def memory(cls, lens: ThinLens, points: Doubles, grid: PupilGrid) -> float:
        """Return an upper bound, in bytes, of the memory of the sums, apart from memory that grows with the points."""
        count = fft.fast_length(cls.window(lens, points, grid))
        # The points' plane is a part of the window, as wide as the images.
        band = 2 * (2 * _reach(_images(lens, points)[1], grid) - grid.count) / count
        return 8.0 * count * (grid.count + count / 2) + PlaneWaves.memory(count, min(1.0, band / 2))

    def forward(self, amplitudes: Field) -> Iterator[tuple[slice, Field]]:
        """Yield blocks of rows of the sum of the waves with these amplitudes (n,) on the samples of the pupil."""
        arrays = backend_of(amplitudes).arrays
        wide = arrays.empty((self._count, self._grid.count), np.complex64)
        for rows, spectrum in self._waves.forward(amplitudes):
            spectrum *= self._kernel(rows)
            wide[rows] = _to_samples(spectrum, 1)[:, self._inner]
        samples = arrays.empty((self._grid.count,) * 2, np.complex64)
        for columns in blocks(self._grid.count):
            samples[:, columns] = _to_samples(wide[:, columns], 0)[self._inner]
        for rows in blocks(self._grid.count):
            yield rows, samples[rows]

    def adjoint(self, samples: Iterator[tuple[slice, Field]]) -> Field:
        """Return each wave's inner product with samples, which come in blocks of rows."""
        arrays = active_backend().arrays
        wide = arrays.zeros((self._count, self._grid.count), np.complex64)
        for rows, block in samples:
            wide[self._inner][rows] = block
        for columns in blocks(self._grid.count):
            wide[:, columns] = _to_frequencies(wide[:, columns], 0)

        def spectra() -> Iterator[tuple[slice, Field]]:
            for rows in blocks(self._count):
                padded = arrays.zeros((rows.stop - rows.start, self._count), np.complex64)
                padded[:, self._inner] = wide[rows]
                yield rows, _to_frequencies(padded, 1) * self._kernel(rows).conj()

        return self._waves.adjoint(spectra())

    def common(self, pupil: Pair) -> Any:
        """Return the path in waves of the lens's aberrations at points of the pupil."""
        return self._lens.aberration(pupil, self._wavelength)

    def remainder(self, waves: Doubles, x: Doubles, y: Doubles, points: Any) -> Doubles:
        """Return paths in waves less the paths of the spheres and the aberrations."""
        X, Y = self._images[points].T
        sphere = self._path(X**2 + Y**2) - self._path((x[:, None] - X) ** 2 + (y[:, None] - Y) ** 2)
        return waves - sphere - self._lens.aberration((x[:, None], y[:, None]), self._wavelength)

    def _path(self, square: Any) -> Any:
        return _sphere(square, self._distance, self._wavelength)

    @property
    def _inner(self) -> slice:
        """Slice of the window's samples that lie within the pupil."""
        first = self._count // 2 - self._grid.count // 2
        return slice(first, first + self._grid.count)

    def _kernel(self, rows: slice) -> Field:
        """Return rows of the sphere's spectrum, with zero frequency in the middle."""
        quarter = _spectrum(self._count, self._grid.pitch, self._reach, self._distance, self._wavelength, on_cuda())
        order = backend_of(quarter).arrays.asarray(np.abs(np.arange(self._count) - self._count // 2))
        return quarter[order[rows]][:, order]


def _sphere(square: Any, radius: float, wavelength: float) -> Any:
    """Return the sag of a sphere in waves at squared distances from the axis through the sphere's vertex."""
    return square / (radius * (np.sqrt(1 + square / radius**2) + 1) * in_millimetres(wavelength))


@functools.lru_cache(maxsize=1)
def _spectrum(count: int, pitch: float, reach: float, radius: float, wavelength: float, cuda: bool) -> Field:
    """Return the spectrum of a sphere, which is even along both axes, at frequencies that are not negative.

    The sphere fades out beyond `reach` samples in its window of `count` samples. The last layer's spectrum is cached,
    on CUDA there; CuPy has no cosine transform of this type.
    """
    step = np.arange(count // 2 + 1)
    # The edge is so wide that it holds no steeper light than the samples do.
    middle = 1 + _FADED / 2
    # 5.0: Standard deviations of the edge's normal distribution in half of its width.
    scale = math.sqrt(2) * _FADED / (2 * 5.0)
    edge = scipy.special.erfc((step / reach - middle) / scale) / (2 * count)
    square = (step * pitch) ** 2
    quarter = np.empty((len(step),) * 2, np.complex64)
    for rows in blocks(len(step)):
        quarter[rows] = phasor(-_sphere(square[rows, None] + square, radius, wavelength)) * (edge[rows, None] * edge)
    for component in (quarter.real, quarter.imag):
        component[...] = scipy.fft.dctn(component, type=1)
    return active_backend().arrays.asarray(quarter)


def _images(lens: ThinLens, points: Doubles) -> tuple[float, Doubles]:
    """Return the distance of the plane in the middle of points' images, and the chief rays' positions on it, (n, 2)."""
    vergence = lens.vergence(points[:, 2])
    distance = _finite_inverse((vergence.min() + vergence.max()) / 2)
    return distance, points[:, :2] * (-distance / points[:, 2:])


def _finite_inverse(nearness: float) -> float:
    """Return the reciprocal of a mean inverse distance, finite also where points on opposite sides make it zero."""
    # At most 1e20 mm, the largest distance of the middle of a layer or of its images.
    return 1 / math.copysign(max(abs(nearness), 1e-20), nearness)


def _reach(images: Doubles, grid: PupilGrid) -> float:
    """Return the largest distance along an axis, in samples, between a sample of the pupil and an image."""
    return grid.count / 2 + float(np.abs(images - grid.middle).max()) / grid.pitch


def _to_samples(spectrum: Field, axis: int) -> Field:
    """Return the inverse transform along an axis whose zero is in the middle, without a factor."""
    roll = backend_of(spectrum).arrays.roll
    half = spectrum.shape[axis] // 2
    return roll(fft.fft(roll(spectrum, -half, axis), axis=axis, inverse=True, norm="forward"), half, axis)


def _to_frequencies(samples: Field, axis: int) -> Field:
    """Return the adjoint of `_to_samples`."""
    roll = backend_of(samples).arrays.roll
    half = samples.shape[axis] // 2
    return roll(fft.fft(roll(samples, -half, axis), axis=axis), half, axis)
