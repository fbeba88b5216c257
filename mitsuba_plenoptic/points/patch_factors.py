"""The factors of fields on a patch, from pupil to detector: pupil, microlens array with curvature, free space.

Apart from these factors, a field depends only on Fourier transforms of fixed sizes (see `patch`). The camera parameters
that enter the factors may be floats or Dr.Jit arrays with gradients, while grids and positions are fixed.
"""

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import numpy as np

from ..fields import ArrayFactor, VaryingArrayFactor, has_response, recorded_amplitude
from ..lenses import Light, MainLens, VaryingLens
from ..optics import in_millimetres, phasor, smooth_edge, soft_edge, transfer
from ..runtime import (
    Array,
    Doubles,
    Field,
    Integers,
    Pair,
    Sizes,
    Triple,
    array_module,
    drjit_array,
    fft,
    is_zero,
    on_cuda,
    turn,
)
from .field_grid import Grid, Placement, lens_amplitude
from .pupil_weights import PupilWeights
from .seen_pupil import SeenPupil
from .windows import part_of


@dataclass(frozen=True)
class Elements:
    """The optical elements that a field passes, with parameters as floats or Dr.Jit arrays with gradients.

    A Dr.Jit array has one entry for each parameter, or one for each lane of the factor that depends on it. The lens and
    the array are functions, since not every factor depends on them.
    """

    lens: Callable[[], MainLens | VaryingLens]
    array: Callable[[float], Sequence[ArrayFactor | VaryingArrayFactor]]
    """From the largest direction cosine of the microlenses to their factors, in the frame of the lattice."""
    wavelength: Any  # in nanometres
    detector_distance: Any  # in millimetres
    turned: Any = 0.0  # counter-clockwise rotation of the lattice relative to its frame, in degrees
    growth: Any = 1.0
    """Factor on all sample distances on the MLA and the detector, and on the positions of patches. It follows the
    wavelength, so that directions and points of the pupil are fixed."""
    aberration: Callable[[Any, Any], Any] | None = None
    """An additional path of the main lens, in millimetres, at points x and y of its pupil in the camera frame."""


@dataclass(frozen=True)
class Fields:
    """The data from which the fields of points with patches of one size are computed."""

    grid: Grid
    placement: Placement
    positions: Doubles  # scene points in the frame of the lattice, (n, 3)
    pupil_weights: PupilWeights | None

    @property
    def samples(self) -> int:
        """Total number of samples of all patches."""
        return int((self.placement.samples**2).sum())


FIELD_BYTES = 2**26
"""Approximate bytes of the factors of the fields that are computed together."""


def chunks_of(grid: Grid, placement: Placement, patches: Integers, most: int) -> list[Integers]:
    """Return patches of one size in chunks of at most `most`, whose factors have at most `FIELD_BYTES`."""
    first = patches[0]
    across = float((placement.last[first] - placement.first[first]).max()) + 2
    if not grid.is_separable:
        # On the array, as a factor there depends on both axes.
        across = 1.5 * float(placement.samples[first])
    size = min(most, max(1, int(FIELD_BYTES / (8 * across**2))))
    return [patches[start : start + size] for start in range(0, len(patches), size)]


def fields_memory(samples: float) -> float:
    """Return the approximate bytes of the fields that a thread computes, with so many samples across a patch."""
    if on_cuda():
        # Without blocks there are as many samples of all that is made of a field.
        # 2**29: Approximate bytes of the fields of many points that a device computes together, see `patch`.
        return 64 * samples**2 + 2 * FIELD_BYTES + 2**29
    return 10 * samples**2 + 2 * FIELD_BYTES


class PatchFactors:
    """The factors of fields on patches of one size, in the order in which the fields pass them.

    They are the pupil, (n, directions along y, along x); the curvature of the light and the microlens array, on the
    array's samples along their `axes`; and the transfer function to the detector, for the directions of all points.
    """

    def __init__(
        self, fields: Fields, amplitudes: Doubles, elements: Callable[[int], Elements] | None = None, types: Any = None
    ):
        """Prepare the factors of fields with given amplitudes.

        `elements` is a function from the number of lanes to the elements; the default is those of the grid's camera.
        `types` is the module of Dr.Jit's arrays, by default without gradients.
        """
        self._grid = fields.grid
        self._placement = fields.placement
        self._positions = fields.positions
        self._amplitudes = amplitudes
        self._weights = fields.pupil_weights
        self._types = types or array_module()
        grid = fields.grid
        placement = fields.placement
        self._elements_of = functools.cache(elements or (lambda lanes: self._own))
        self.samples = int(placement.samples[0])
        # Distances between neighbouring direction cosines along x and y.
        self._steps = (in_millimetres(grid.wavelength) / (self.samples * grid.pitch)).tolist()
        finest = min(self._steps)
        half = 2 * grid.cosine / finest
        # Orders that would be aliased into the band are omitted; a few more samples represent the others.
        self.mla_samples = max(self.samples, fft.fast_length(0.87 * (self.samples + half)))
        # Distances in mm between samples on the array along x and y.
        self._mla_steps = self.samples * grid.pitch / self.mla_samples
        self._highest = min(self.samples + half, 2 * self.mla_samples - self.samples - half) / 2 * finest
        # Each axis has a factor: the curvature and the microlenses' factor of its coordinate. A factor of both is
        # separate.
        self.axes = [(0,), (1,)] if grid.is_separable else [(0,), (1,), (0, 1)]
        self.chief = (placement.first + placement.last) // 2  # index of the central direction of each point, (n, 2)
        directions = int((placement.last - placement.first).max()) + 1
        self._low, count = self.chief.min(0), len(self._positions)
        # First of the transfer function's directions, along x and y, that each point's field contains, (n, 2).
        self.first_directions = self.chief - self._low
        columns, rows = (int(size) for size in self.chief.max(0) - self._low + self.samples)
        on_array = [(count, *[self.mla_samples] * len(axes)) for axes in self.axes]
        self.shapes = [(count, directions, directions), *on_array, (rows, columns)]

    @functools.cached_property
    def _own(self) -> Elements:
        """Optical elements of the camera to which the grid belongs."""
        grid = self._grid
        lens = functools.cache(lambda: grid.lens.opaque(self._constant))
        return Elements(lens, grid.microlenses.factors, grid.wavelength, grid.camera.space_behind[0])

    def of_points(self, parts: Sequence, points: slice) -> list:
        """Return some points' part of each factor, or of data of equal layout; None where a factor is None."""
        *factors, transfer = parts
        mine = [None if factor is None else factor[points] for factor in factors]
        return [*mine, None if transfer is None else self.directions_of(transfer, points)]

    def directions_of(self, transfer: Field, points: slice) -> Field:
        """Return the part of a transfer function, (points, along y, along x), that the fields of points contain."""
        return part_of(transfer, self.first_directions[points, ::-1], (self.samples, self.samples))

    def values(self) -> Iterator:
        """Yield the factors as flat Dr.Jit arrays Complex2f."""
        pupil, power = self._pupil(self._elements(self.shapes[0]))
        dr.schedule(power)  # together with the pupil, since it is a sum over it
        yield pupil
        # The factor on each field that makes its intensity a density of the fraction of the power.
        lit = power > 0
        wavelength = self._elements(self.shapes[0][:1]).wavelength
        steps = self._constant(math.prod(self._steps))
        lam = self._constant(in_millimetres(wavelength))
        scale = drjit_array(self._types.Float64, self._amplitudes) * steps / dr.sqrt(dr.select(lit, power, 1))
        scale = dr.select(lit, scale / (lam * self._constant(float(self.mla_samples) ** 2)), 0)
        for axes, shape in zip(self.axes, self.shapes[1:-1], strict=True):
            elements = self._elements(shape)
            yield self._on_axis(elements, axes[0], scale) if len(axes) == 1 else self._on_plane(elements)
        yield self._transfer(self._elements(self.shapes[-1]))

    def _elements(self, shape: Sizes) -> Elements:
        """Return the optical elements in arrays of the shape that a factor has."""
        return self._elements_of(math.prod(shape))

    def _constant(self, value: Any) -> Any:
        """Return a value that is not compiled into kernels."""
        return value if dr.is_array_v(value) else dr.opaque(self._types.Float64, value)

    def _each(self, values: Any, patch: Any) -> Any:
        """Return, for each lane, the value that belongs to the point of the lane's patch."""
        if isinstance(values, np.ndarray):
            values = drjit_array(self._types.Float64, values)
        return dr.gather(self._types.Float64, values, patch)

    def _pupil(self, elements: Elements) -> Pair:
        """Return plane waves from the pupil, (n, along y, along x), and the power of each point through it."""
        types = self._types
        lens = elements.lens()
        grid = self._grid
        placement = self._placement
        _, size, _ = self.shapes[0]
        patch, row, column = fft.images_rows_and_columns(types, *self.shapes[0])

        def value(values: Array) -> Any:
            return self._each(values, patch)

        steps = self._steps
        growth = elements.growth
        start = grid.origin + placement.corner * grid.pitch - placement.image
        nx = types.Float64(column) + value(placement.first[:, 0])
        ny = types.Float64(row) + value(placement.first[:, 1])
        sx = nx * self._constant(steps[0])
        sy = ny * self._constant(steps[1])
        b = self._constant(lens.pupil.distance)
        image = value(placement.image[:, 0]) * growth, value(placement.image[:, 1]) * growth
        pupil, R, length = lens.pupil.from_array((sx, sy), image)
        X, Y = turn(value(self._positions[:, 0]), value(self._positions[:, 1]), -elements.turned)
        point = (X, Y, value(self._positions[:, 2]))
        light = lens.bind(self._positions, patch)
        waves = self._path(elements, light, pupil, point)
        waves += length / self._constant(in_millimetres(elements.wavelength))
        start[:, 1] *= grid.pitch[0] / grid.pitch[1]
        waves += (nx * value(start[:, 0]) + ny * value(start[:, 1])) / self._constant(self.samples * grid.pitch[0])
        # The power is that of the hard edge; the width of the soft edge depends on the grid.
        width = math.sqrt(math.prod(steps)) * grid.band.edge
        sample = dr.detach(R) * self._constant(width)

        def soften(inside: Any) -> Any:
            return (smooth_edge if grid.band.smooth else soft_edge)(types.Float(inside / sample))

        cover = soften(light.inside(pupil))
        bright = types.Float(light.amplitude(pupil, point) * R * R / b)
        power = types.Float64(bright * bright * cover)
        if grid.camera.vignetting is not None:
            # The light is dimmed: its power is that before.
            seen_pupil = SeenPupil(grid.camera.vignetting, cast(Light, light), lens.pupil.radius)
            scene_point = (*self._in_camera(elements, X, Y), point[2])
            cover = types.Float(seen_pupil.amplitude(self._in_camera(elements, *pupil), scene_point, soften))
        if self._weights is not None:
            in_camera = self._in_camera(elements, *pupil)
            passed, amplitude = self._weights.at(patch, *in_camera, lens.pupil.radius, sample)
            power *= types.Float64(passed)
            cover = cover * amplitude
        return phasor(waves) * (bright * cover), dr.block_sum(power, size * size) * self._constant(math.prod(steps))

    def _path(self, elements: Elements, light: Light, pupil: Pair, point: Triple) -> Any:
        """Return the path in waves from points to the pupil, both given in the lattice frame."""
        camera = self._grid.camera
        is_round = not camera.wavefront and camera.phase_screen is None
        if is_round and elements.aberration is None:
            return light.path(pupil, point, elements.wavelength)
        in_camera = self._in_camera(elements, *pupil)
        if is_round:
            waves = light.path(pupil, point, elements.wavelength)
        else:
            X, Y = self._in_camera(elements, *point[:2])
            waves = light.path(in_camera, (X, Y, point[2]), elements.wavelength)
        if elements.aberration is None:
            return waves
        return waves + elements.aberration(*in_camera) / self._constant(in_millimetres(elements.wavelength))

    def _in_camera(self, elements: Elements, x: Any, y: Any) -> Pair:
        """Return the camera-frame components of a vector given in the lattice frame."""
        angle = self._grid.rotation + elements.turned
        return (x, y) if is_zero(angle) else turn(x, y, self._constant(angle))

    def _position(self, patch: Any, sample: Any, axis: int) -> Any:
        """Return the coordinate on the MLA of samples of points."""
        grid = self._grid
        corner = grid.origin[axis] + self._placement.corner[:, axis] * grid.pitch[axis]
        return self._each(corner, patch) + self._types.Float64(sample) * self._constant(float(self._mla_steps[axis]))

    def _on_axis(self, elements: Elements, axis: int, scale: Any) -> Any:
        """Return the factor on the MLA along an axis, (n, samples): curvature, microlenses, and along y the scale.

        The tilt of the chief ray is omitted.
        """
        types = self._types
        placement = self._placement
        shape = len(self._positions), self.mla_samples
        patch, sample = fft.rows_and_columns(types, *shape)
        m = self._position(patch, sample, axis)
        image = self._each(placement.image[:, axis], patch)
        growth = elements.growth
        mu = (m - image) * growth
        # path from the pupil: (mu^2 - (s mu)^2) / 2 R, where the part along the other axis is negligible
        lens = elements.lens()
        b = self._constant(lens.pupil.distance)
        square = self._each((placement.image**2).sum(1), patch) * growth * growth + b * b
        radius = image * image * growth * growth
        spread = (1 - radius / square) / (2 * self._constant(in_millimetres(elements.wavelength)))
        curvature = spread * (lens.pupil.finite / dr.sqrt(square))
        shift = ((placement.first - self.chief)[:, axis] + self.samples // 2) / self.mla_samples
        product = phasor(mu * mu * curvature + types.Float64(sample) * self._each(shift, patch))
        for factor in elements.array(self._highest):
            if factor.axes == (axis,):
                product *= factor.at(m * growth)
        return product * types.Float(self._each(scale, patch)) if axis else product

    def _on_plane(self, elements: Elements) -> Any:
        """Return the factor of both coordinates, (n, along y, along x): microlenses if not separable, brightness."""
        types = self._types
        size = self.mla_samples
        patch, row, column = fft.images_rows_and_columns(types, len(self._positions), size, size)
        x, y = (self._position(patch, sample, axis) * elements.growth for axis, sample in enumerate((column, row)))
        product = types.Complex2f(types.Float(lens_amplitude(self._grid.camera, x, y, self._mla_steps)))
        for factor in elements.array(self._highest):
            if len(factor.axes) == 2:
                product = factor.at(x, y) * product
        return product

    def _transfer(self, elements: Elements) -> Any:
        """Return the transfer function from MLA to detector, times what pixels record of each direction."""
        types = self._types
        row, column = fft.rows_and_columns(types, *self.shapes[-1])
        sx, sy = (
            (types.Float64(index) + self._constant(float(self._low[axis] - self.samples // 2)))
            * self._constant(self._steps[axis])
            for axis, index in ((0, column), (1, row))
        )
        # In the medium both direction cosines and wavelength are smaller by its index.
        medium = self._constant(self._grid.camera.space_behind[1])
        distance = self._constant(elements.detector_distance)
        sx = sx / medium
        sy = sy / medium
        free_space = transfer(sx, sy, distance, elements.wavelength / medium)
        camera = self._grid.camera
        return free_space * recorded_amplitude(camera, sx, sy) if has_response(camera) else free_space
