"""The response of a camera to the bins of object planes: from radiance to the capture, and the adjoint.

Kernels are means of exact point spreads, or of rays.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from ...camera import PlenopticCamera, Use, Vignetting, require_support
from ...design import resolution_limit
from ...detector import SHARP, DetectorOperator
from ...errors import refuse_if
from ...fields import OpticalSystem, upright
from ...lenses import FittedLens, RealLens, inverse_distance
from ...optics import in_millimetres
from ...points import Copies, Fields, Grid, Recorder, Scatter, band_for, chunks_of, place, radiance_weight, scene_points
from ...rays import Passage, Walk
from ...refocus import regular_place, straightened
from ...runtime import Box, Doubles, Floats, Job, Part, active_backend, add
from ...views import lenses_of_pixels, mean_response, white_image
from .cells import BinCells, UprightBins
from .kernels import Kernel, PlaneResponse, StoredResponse, make_kernel, merged, require_response_memory, zones

_ACCURACY = 0.01
"""Relative error for which the grid, and how much of the diffracted light is retained, are chosen."""

_MANY = 2**20

_RADIATORS = 8
_MOST_RADIATORS = 48
"""Points along a lens, at least and at most, whose mean stands for the light of its bins."""

_RADIATORS_PER_LINE = 4
"""The same along a period of the finest lines that the plane's light resolves."""

_RADIATORS_PER_SPOT = 1.1
"""The same along a period of the finest detail that the pupil resolves, above 1: no pixel then feels the grid."""

_BLURRED = 2
"""Pitches as wide as which blur hides the grid of the fewest points."""

_PIXEL_SAMPLES = 3
"""Samples across a pixel, at least, in which the light of kernels is kept."""

_INFINITY = 1e6
"""Focal lengths at which light counts as collimated."""


def wave_grid(camera: PlenopticCamera, distances: Sequence[float], wavelength: float) -> tuple[Grid, int]:
    """Return the grid for the light of planes at some distances, and how many samples are merged on each axis.

    Pixels hardly feel detail finer than a third of them. Where the lattice is turned, samples are interpolated before
    they are integrated, and none are merged.
    """
    depths = [finite_distance(camera, distance) for distance in distances]
    points = np.array([[0.0, 0.0, depth] for depth in depths])
    system = OpticalSystem(camera, wavelength)
    if not system.lens.is_uniform:
        points = np.concatenate([points, cast(RealLens, system.lens).farthest(depths)])
    arguments = system, band_for(_ACCURACY, _MANY), points
    grid = Grid.of(*arguments)
    together = 1
    if grid.rotation == 0:
        together = max(1, int(camera.pixel_size / (_PIXEL_SAMPLES * float(grid.pitch.max()))))
    return Grid.of(*arguments, together), together


def wave_batches(
    grid: Grid,
    cells: BinCells,
    distance: float,
    cell: NDArray[np.int64],
    radiators: int = 0,
    vignetting: Vignetting | None = None,
) -> list[list[Scatter]]:
    """Return, for each bin of a cell, the batches whose summed results on a grid are the bin's response.

    By default there are as many `radiators` along a lens as the plane needs. All light passes the pupil as the cell's
    middle sees it through `vignetting`.
    """
    if vignetting is not None:
        numbers = vignetting.at(*cells.middle(cell))
        constant: dict[str, Any] = {name: (float(value),) for name, value in numbers.items()}
        seen = replace(vignetting, **constant)
        grid = replace(grid, camera=grid.camera.replace(vignetting=seen))
    depth = finite_distance(cells.camera, distance)
    lens = grid.lens
    nearness = float(inverse_distance(lens, np.array([[0.0, 0.0, depth]]))[0])
    limit = resolution_limit(cells.camera, distance, grid.wavelength)
    lines = 0.0 if limit.in_focus else limit.frequency / (2 * limit.lenses)  # along a lens
    airy = in_millimetres(grid.wavelength) * lens.pupil.distance / (2 * lens.pupil.radius)
    pitch = max(cells.camera.mla_pitches)
    spots = pitch / airy if cells.camera.blur_diameter(distance) < _BLURRED * pitch else 0.0
    wanted = math.ceil(max(_RADIATORS_PER_LINE * lines, _RADIATORS_PER_SPOT * spots))
    points_along = radiators or max(_RADIATORS, min(_MOST_RADIATORS, wanted))
    places = cells.bin_places(cell, math.ceil(points_along / cells.oversample))
    weight = bin_weight(cells) / places.shape[1]
    if not lens.is_uniform:
        fitted = cast(FittedLens, lens)
        weight *= float(fitted.open_fraction(*places.mean((0, 1))[:, None])[0])
        places = fitted.within(places)
    batches = []
    for points in places:
        positions = lens.points(points, np.full(len(points), nearness))
        placement = place(grid, positions)
        alike = (np.flatnonzero(placement.samples == size) for size in np.unique(placement.samples))
        groups = [some for same in alike for some in chunks_of(grid, placement, same, math.ceil(len(same) / _BATCHES))]
        copy = Copies(np.zeros((1, 2), np.int64), np.full((1, 1), weight, np.float32))
        batches.append(
            [
                Scatter(
                    Fields(grid, placement.take(some), positions[some], None), np.ones(len(some)), [copy] * len(some)
                )
                for some in groups
            ]
        )
    return batches


def bin_weight(cells: BinCells) -> float:
    """Return the light that all pixels together record from a bin of radiance 1 if no light is lost."""
    return radiance_weight(cells.camera, cells.grid.lens, cells.bin_sizes[0] * cells.bin_sizes[1])


def finite_distance(camera: PlenopticCamera, distance: float) -> float:
    """Return a finite distance in mm; for infinity, one so large that light is collimated."""
    return min(distance, _INFINITY * camera.focal_length)


_RAYS = 256
"""Square root of the rays of a bin of a reconstruction."""

_NO_WAVE = 1.0
"""Wavelength, in nanometres, of the grid; nothing depends on it."""


def ray_grid(camera: PlenopticCamera) -> Grid:
    """Return a grid whose samples are at most half as wide as pixels."""
    turned = upright(camera)
    steps = np.array(turned.lattice.grid_step) * (turned.micro_image_pitch / turned.row_pitch)
    origin = -np.array([camera.detector_width, camera.detector_height]) / 2
    pitch = steps / np.ceil(2 * steps / camera.pixel_size)
    system = OpticalSystem(turned, _NO_WAVE)
    band = band_for(0.5, 1)
    lens = system.waves_of(np.empty((0, 3)))
    return Grid(turned, lens, system.microlenses, camera.mla_rotation, _NO_WAVE, band, 0.0, pitch, origin)


@dataclass(frozen=True)
class RayBatch:
    """Rays of one bin, as a batch."""

    cells: BinCells
    distance: float
    corner: Doubles
    across: int

    @property
    def samples(self) -> int:
        """Number of rays."""
        return self.across**2

    @property
    def memory(self) -> float:
        """Approximate bytes of the rays."""
        return 200.0 * self.samples

    def prepare(self) -> Callable[[], Part]:
        """Return the function that traces the rays."""
        return functools.partial(_trace, self)


def ray_batches(across: int, cells: BinCells, distance: float, cell: NDArray[np.int64]) -> list[list[RayBatch]]:
    """Return, for each bin of a cell, the batch of `across` x `across` rays that are its response."""
    half = np.array(cells.bin_sizes) / 2
    return [[RayBatch(cells, distance, positions[0] - half, across)] for positions in cells.bin_places(cell)]


@functools.cache
def _pairs(count: int) -> Doubles:
    return scene_points.sample_pairs(count)


def _pupil_points(pairs: Doubles) -> Doubles:
    """Return points (2, n) that are even over the unit disc."""
    angle = 2 * np.pi * pairs[:, 3]
    return np.sqrt(pairs[:, 2]) * np.stack([np.cos(angle), np.sin(angle)])


def _trace(batch: RayBatch) -> Part:
    """Return the light of a bin's rays, each distributed to the four nearest samples."""
    cells = batch.cells
    grid = batch.cells.grid
    camera = batch.cells.camera
    lens = grid.lens
    light = grid.lens.bind(np.empty((0, 3)))
    walk = Walk.of(camera, grid.lens)
    pairs = _pairs(batch.samples)
    b = camera.mla_distance
    q = batch.corner + pairs[:, :2] * cells.bin_sizes
    across, down = lens.pupil.radius * _pupil_points(pairs)
    pupil = across, down
    g = finite_distance(camera, batch.distance)
    point = -q[:, 0] * g / b, -q[:, 1] * g / b, np.full(len(q), g)
    m = light.land(pupil, point)
    lenslet = walk.lenslet(*camera.lattice.cell(*m))
    passes = camera.lattice.in_aperture(m[0] - lenslet.centre[0], m[1] - lenslet.centre[1])
    landed, _ = walk.onto_detector(pupil, Passage((m[0], m[1]), lenslet))
    power = np.broadcast_to(walk.transmittance(pupil, m), passes.shape)[passes]
    position = ((np.stack(landed, axis=-1) - grid.origin) / grid.pitch)[passes]
    below = np.floor(position).astype(np.int64)
    low = below.min(0)
    columns, rows = (below.max(0) - low + 2).tolist()
    sums = np.zeros(rows * columns)
    over = position - below
    for right in (0, 1):
        for down in (0, 1):
            weight = power * np.abs(1 - right - over[:, 0]) * np.abs(1 - down - over[:, 1])
            pixel = (below[:, 1] - low[1] + down) * columns + below[:, 0] - low[0] + right
            sums += np.bincount(pixel, weight, len(sums))
    sums *= bin_weight(cells) / (len(pairs) * grid.pitch.prod())
    return Part(Box(int(low[0]), int(low[1]), columns, rows), sums.reshape(1, rows, columns).astype(np.float32))


_FINE = 6
"""Bins along a lens, at least, of which upright bins are composed that are not those of the lattice."""

_ZONE = 16
"""Lenses along an axis that one core works on, and for which one kernel serves at least."""

_ALIKE = 0.06
"""Difference of the light of two lenses, over this light, for which one kernel serves all lenses between them."""

_MEMORY = 2 * 2**30
"""Bytes of a plane's kernels beyond which zones grow, and of all planes' beyond which they are stored on disk."""

_LIT = 0.6
"""Fraction of a kernel's blocks that hold light, at most."""

_WIDEST_SPREAD = 0.35
"""Pixels over which unequal focal lengths may spread light that equal lenses focus."""

_ALIKE_PUPILS = 0.1
"""Change of the light of two lenses that see other pupils, over this light, for which one kernel serves, weighted."""

_PUPIL_POINTS = 2**10
_PLACES = 100
_DARK = 0.05

_EVENLY = 0.5
_AROUND = 4
"""Part of the light beyond kernels that gaps scatter evenly, and micro-images to each side over which."""

_AIRY_DEVIATION = 0.376
"""Standard deviation of a Gaussian as wide, at half of its maximum, as the pattern of a slit, over wavelength/slit."""

_UNLIT = 1e-6
_BRIGHTEST = 4.0

_EVERYWHERE = 2**40

_PROGRESS = 1000
"""Parts of a bin's light in which progress is counted."""

_BATCHES = 4
"""Batches of a bin's radiators, at least: cores share the only kernel, and its speed is known before its end."""

_SPREAD_TIME = 16.0
_PRODUCT_TIME = 0.05
_KERNEL_TIME = 0.6
"""Relative times of a sample of a point spread, and, in a step of an inversion, of a product and of a kernel's sample.

In nanoseconds on two cores of a processor of 2023; a step is a forward and an adjoint response.
"""


class Response(StoredResponse):
    r"""The capture of object planes made of bins of uniform radiance: :math:`I = \sum_k A_k x_k`.

    Computing the point spreads takes the fraction `prepared` of the total time, with `steps` applications of the
    response and its adjoint; a job's progress ends there.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        distances: Sequence[float],
        *,
        wavelength: float | None,
        oversample: int,
        job: Job | None = None,
        steps: float = 0.0,
    ) -> None:
        job = job or Job()
        self._oversample = oversample
        # Kernels are of the light of regular lenses; displaced and dimmer ones send it elsewhere, and pixels mix it.
        self._detector = DetectorOperator.of(camera)
        self._gain: Floats | None = None
        lens = lenses_of_pixels(camera).astype(np.float64)
        if camera.mla_transmissions is not None:
            self._gain = camera.mla_transmissions.at(camera.lattice, *lens).astype(np.float32)
        strays = bool(camera.stray_light)
        places, aside = None, 0.0
        if camera.lattice.displacement is not None or any(camera.mla_tilt):
            even = camera.replace(mla_transmissions=None)
            places, aside = functools.partial(regular_place, even), _farthest(even)
        recorded = camera
        camera = straightened(camera).replace(**SHARP)
        require_support(camera, Use.RESPONSES | Use.KERNELS)
        _require_equal_lenses(camera)
        if wavelength is None:
            grid = ray_grid(camera)
            self._together = 1
            # Several of the finer bins of cells make up a bin.
            rays = math.ceil(_RAYS * math.sqrt(oversample / _fine(grid, camera, oversample)))
            self._batches: Callable[..., Sequence[Sequence[Any]]] = functools.partial(ray_batches, rays)
        else:
            camera = camera.at_wavelength(wavelength)
            fine, self._together = wave_grid(camera, distances, wavelength)
            grid = fine.merged(self._together)
            self._batches = functools.partial(wave_batches, fine)
        self.cells, self._camera, self._distances = (
            BinCells(grid, _fine(grid, camera, oversample)),
            camera,
            tuple(distances),
        )
        all_pixels = np.full((1, 2), -_EVERYWHERE), np.full((1, 2), _EVERYWHERE)
        self._recorder = Recorder(camera, grid, *all_pixels, regular=places, aside=aside)
        self._sampled = self.cells.holding(self._recorder.box)
        kernel_bytes = [self._kernel_memory(distance, oversample) for distance in distances]
        # Far too large kernels are refused before the light of some is computed.
        self._require_memory(1, len(distances) > 1)
        # Zones divide the work among the cores; where lenses are alike, one kernel serves several.
        groups = zones(self._sampled, _ZONE)
        unlike = 0.0 if _alike(camera) else math.inf
        if wavelength:
            unlike = max(self._unlike(distance, job) for distance in distances)
        width = max(_ZONE, self._widest if unlike <= _ALIKE else math.floor(self._widest * _ALIKE / unlike))
        self._vignetting = vignetting = recorded.vignetting
        if vignetting is not None and wavelength:
            width = min(width, self._width_of_pupils(vignetting))
            self._batches = functools.partial(wave_batches, fine, vignetting=vignetting)
        groups_of_cells = self._zones(max(kernel_bytes), width)
        owner = np.repeat(np.arange(len(groups_of_cells)), list(map(len, groups_of_cells)))[
            np.argsort(np.concatenate(groups_of_cells))
        ]
        groups = max(groups, groups_of_cells, key=len)
        middles = [owner[members[len(members) // 2]] for members in groups]
        if vignetting is not None:
            seen = np.empty((len(self._sampled) + 1, 2))
            for members, zone in zip(groups, middles, strict=True):
                seen[members] = self.cells.middle(self._middle(groups_of_cells[zone]))
            x, y = np.meshgrid(*(recorded.pixel_coordinates(axis) for axis in (0, 1)))
            cell = self._sampled.find(self.cells.at(*(places(x, y) if places else (x, y))))
            zone = np.moveaxis(seen[cell], -1, 0) if wavelength else None
            dimmed = _dimmed(recorded, lens, zone, wavelength or 0.0)
            self._gain = dimmed if self._gain is None else self._gain * dimmed
        self._store(len(distances) > 1 and _LIT * len(groups_of_cells) * sum(kernel_bytes) > _MEMORY)
        # Far too many bins are refused before they are put into batches.
        stored = self._folder is not None
        self._require_memory(len(groups_of_cells), stored)
        middle = self._middle(groups_of_cells[0])
        batches = [
            batch for distance in distances for some in self._batches(self.cells, distance, middle) for batch in some
        ]
        # Beside those that the threads compute, another one is prepared.
        self._require_memory(
            len(groups_of_cells), stored, (job.workers.threads + 1) * max(batch.memory for batch in batches)
        )
        spreads = len(groups_of_cells) * sum(batch.samples for batch in batches)
        bins = self.cells.bins[0] * self.cells.bins[1]
        self.prepared = self._prepared(spreads, steps)
        total = math.ceil(_PROGRESS * len(distances) * len(groups_of_cells) * bins / self.prepared)
        self.planes: list[PlaneResponse] = []
        far = []
        for distance in distances:
            kernels = self._kernels(
                distance, groups_of_cells, job, _PROGRESS * len(self.planes) * len(groups_of_cells) * bins, total
            )
            if wavelength:
                zone = middles[len(middles) // 2]
                far.append(self._far_light(kernels[zone], distance, self._middle(groups_of_cells[zone])))
            matrices = [block.matrix for kernel in kernels for block in kernel.blocks]
            held = iter(self._stored(matrices, f"{len(self.planes)}"))
            kernels = [
                Kernel(kernel.steps, [replace(block, matrix=next(held)) for block in kernel.blocks])
                for kernel in kernels
            ]
            self.planes.append(PlaneResponse(self.cells, self._sampled, groups, [kernels[index] for index in middles]))
        self._far = float(np.mean(far)) if far else 0.0
        self.bins = [
            UprightBins.over(self.cells, plane.lit, camera, distance, oversample)
            for plane, distance in zip(self.planes, distances, strict=True)
        ]
        columns, rows = (oversample * count for count in camera.bin_count)
        # Of the bins of a reconstruction among these.
        self._windows = [
            (slice(-top, rows - top), slice(-left, columns - left)) for left, top in (bins.first for bins in self.bins)
        ]
        self.shapes = [bins.shape for bins in self.bins]
        super().__init__((sum(math.prod(shape) for shape in self.shapes),), camera.shape)
        if strays:
            # Interpolation leaves less than no light between micro-images, which steps would divide stray light by.
            # 0.005: Light of a white scene there, over that of the brightest pixel, as in `RichardsonLucy`.
            white = self._direct(np.ones(self.source_shape, np.float32))
            gain = np.float32(1) if self._gain is None else self._gain
            self._gain = np.where(white > 0.005 * white.max(), gain, np.float32(0))

    def _kernels(
        self, distance: float, groups: Sequence[NDArray[np.int64]], job: Job, done: int, total: int
    ) -> list[Kernel]:
        """Return the kernel of each zone, computed from the point spreads of the zone's middle cell.

        A zone may be a single batch, so that all cores are busy only if the batches of all zones are computed together.
        """
        cells = [self._middle(members) for members in groups]
        batches = [self._batches(self.cells, distance, cell) for cell in cells]
        flat = [batch for bins in batches for some in bins for batch in some]
        share = [
            _PROGRESS * (index + 1) // len(some) - _PROGRESS * index // len(some)
            for bins in batches
            for some in bins
            for index in range(len(some))
        ]
        with contextlib.closing(job.each(flat, share, done, total)) as parts:
            return [
                make_kernel(self.cells, cell, ([next(parts) for _ in some] for some in bins), self._together)
                for cell, bins in zip(cells, batches, strict=True)
            ]

    def _far_light(self, kernel: Kernel, distance: float, cell: NDArray[np.int64]) -> float:
        """Return the light that falls beyond a cell's kernel, over that within.

        As bins tile cells, apertures pass the part of their light which they cover of the array.
        """
        camera = self.cells.camera
        batches = itertools.chain.from_iterable(self._batches(self.cells, distance, cell))
        sent = sum(copy.weights.sum() for batch in batches for copy in batch.copies)
        types = len(camera.mla_focal_lengths)
        sent *= camera.lattice.lens_area * types / self.cells.vectors.diagonal().prod() * mean_response(camera)
        if self._vignetting is not None:
            sent *= self._vignetting.power(*_pupil_points(_pairs(_PUPIL_POINTS)), *self.cells.middle(cell)).mean()
        arrived = sum(float(block.matrix.sum(dtype=np.float64)) for block in kernel.blocks)
        return max(0.0, sent / (arrived * self.cells.grid.pitch.prod()) - 1)

    def _with_far(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return an image with the light beyond kernels, which gaps scatter evenly in part; its own adjoint."""
        far = np.float32(self._far)
        if not far or self._camera.lattice.fills:
            return image * (1 + far)
        width = 2 * math.ceil(_AROUND * self._camera.micro_image_pitch / self._camera.pixel_size) + 1
        evenly = np.float32(_EVENLY)
        return image * (1 + far * (1 - evenly)) + far * evenly * uniform_filter(image, width, mode="reflect")

    def _prepared(self, spreads: float, steps: float) -> float:
        """Return the fraction that point spreads take of the time of an inversion of some steps."""
        products = 0.0
        for distance in self._distances:
            kernel = _LIT * self._kernel_memory(distance, self.cells.oversample) / 4 * len(self._sampled)
            products += kernel * (_PRODUCT_TIME + _KERNEL_TIME / self.cells.oversample**2)
        return _SPREAD_TIME * spreads / (_SPREAD_TIME * spreads + steps * products)

    def _middle(self, members: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the cell in the middle of a zone."""
        cell_index = self._sampled.index[members]
        places = cell_index @ self.cells.vectors
        middle: NDArray[np.int64] = cell_index[np.argmin(((places - places.mean(0)) ** 2).sum(1))]
        return middle

    def _zones(self, kernels: float, width: int) -> list[NDArray[np.int64]]:
        """Return the cells of each zone of one kernel, as large as its light allows, or as memory asks."""
        while True:
            groups = zones(self._sampled, width)
            if width >= self._widest or len(groups) * kernels <= _MEMORY:
                return groups
            width *= 2

    @property
    def _widest(self) -> int:
        """Lenses along the longer side of the detector."""
        return max(len(self._sampled.count), int(self._sampled.count.max()))

    def _width_of_pupils(self, vignetting: Vignetting) -> int:
        """Return the width of zones over which the pupil changes by what can be divided out, at most."""
        across, down = _pupil_points(_pairs(_PUPIL_POINTS))
        index = self._sampled.index[:: max(1, len(self._sampled) // _PLACES)]

        def light(cells: NDArray[np.int64]) -> Doubles:
            x, y = np.moveaxis(self.cells.middle(cells), -1, 0)[..., None]
            return np.asarray(vignetting.power(across, down, x, y))

        step = max(1, self._widest // 8)
        here = light(index)
        change = max(
            float((abs(light(index + np.array([i, j])) - here).mean(1) / here.mean(1).clip(_DARK)).max())
            for i, j in ((step, 0), (0, step))
        )
        return max(1, math.floor(step * _ALIKE_PUPILS / change)) if change else self._widest

    def _unlike(self, distance: float, job: Job) -> float:
        """Return the change of the light of 2 x 2 points from the middle to the corners, over this light.

        Aberrations need not grow towards the corners: of the changes to the corners, half-way to them and to the
        middles of the borders the steepest counts, as if it went on to the corners.
        """
        index = self._sampled.index
        cells = BinCells(self.cells.grid, 1)
        places = index @ cells.vectors
        centre = (places.max(0) + places.min(0)) / 2
        reach = (places.max(0) - places.min(0)) / 2
        half = 2 * sum(cells.size) + math.ceil(cells.camera.blur_diameter(distance) / cells.grid.pitch.min())

        def nearest(*aim: float) -> int:
            return int(np.argmin(((places - centre - reach * aim) ** 2).sum(1)))

        def light(cell: NDArray[np.int64]) -> Any:
            left, top = (cell @ cells.samples + cells.first_sample - half).tolist()
            image = active_backend().arrays.zeros((1, 2 * half, 2 * half), np.float32)
            batches = itertools.chain.from_iterable(self._batches(cells, distance, cell, 2))
            with contextlib.closing(job.workers(batches)) as parts:
                for block in parts:
                    box, sums = merged(block.box, block.sums[0], self._together)
                    add(Part(box, sums[None]), Box(left, top, 2 * half, 2 * half), image)
            return image

        aims = [(x, y) for reached in (0.5, 1.0) for x in (-reached, reached) for y in (-reached, reached)]
        aims += [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)]
        middle = nearest(0.0, 0.0)
        at_middle = light(index[middle])
        vdot = active_backend().arrays.vdot
        bright = float(vdot(at_middle, at_middle))
        if not bright:
            return math.inf
        steepest = 0.0
        for number in {nearest(*aim) for aim in aims} - {middle}:
            aside = light(index[number]) - at_middle
            change = math.sqrt(float(vdot(aside, aside)) / bright)
            away = math.dist(places[number], places[middle]) / math.hypot(*reach)
            steepest = max(steepest, change / away)
        return steepest

    def _kernel_memory(self, distance: float, oversample: int) -> float:
        """Return the approximate bytes of one kernel of a plane with all of its blocks."""
        camera = self.cells.camera
        grid = self.cells.grid
        samples = 1.1 * camera.blur_diameter(distance) / grid.pitch.min() + 8 / grid.pitch.min() * camera.pixel_size
        across, down = (samples / size + 2 for size in self.cells.size)
        return float(
            4 * across * down * oversample**2 * np.prod(grid.lens_samples.diagonal()) * len(camera.mla_focal_lengths)
        )

    def _require_memory(self, groups: int, on_disk: bool, fields: float = 0.0) -> None:
        def memory(oversample: int) -> float:
            oversample = math.ceil(oversample * self.cells.oversample / self._oversample)
            kernel_bytes = [self._kernel_memory(distance, oversample) for distance in self._distances]
            bins = 4.0 * len(self._sampled) * len(self._camera.mla_focal_lengths) * oversample**2 * len(kernel_bytes)
            samples = 4.0 * self._recorder.box.rows * self._recorder.box.columns
            kernels = _LIT * groups * (max(kernel_bytes) if on_disk else sum(kernel_bytes))
            return kernels + 2 * max(kernel_bytes) + 12 * bins + 4 * samples + self._recorder.memory + fields

        require_response_memory(memory, self._oversample, self._distances)

    def to_image(self, values: NDArray[np.float32], plane: int) -> NDArray[np.float32]:
        """Return a plane's bins, of all bins, as an upright image of a reconstruction's bins."""
        return np.ascontiguousarray(self.planes_of(values)[plane][self._windows[plane]])

    def from_image(self, image: NDArray[Any], plane: int) -> NDArray[np.float32]:
        """Return the transpose of `to_image`, applied to an image."""
        values = np.zeros(self.source_shape, np.float32)
        self.planes_of(values)[plane][self._windows[plane]] = image
        return values

    def forward(self, values: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Return the image that the detector records of planes."""
        return np.asarray(self._detector.forward(self._direct(values)))

    def _direct(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the light of planes that falls on the detector."""
        width, height = self.cells.size
        libraries = active_backend()
        samples = libraries.arrays.zeros((len(self._sampled), height, width), np.float32)
        for plane, bins, radiance in zip(self.planes, self.bins, self.planes_of(values), strict=True):
            plane.add_forward((bins.share.T @ radiance.ravel()).reshape(plane.shape), samples)
        sums = self.cells.join(samples, self._sampled, self._recorder.box)
        image = self._with_far(self._recorder.record(sums[None])[..., 0])
        return image if self._gain is None else np.asarray(self._gain * image)

    def adjoint(self, image: NDArray[np.float32], /) -> NDArray[np.float32]:
        """Return the transpose of `forward`, applied to an image."""
        light = self._detector.adjoint(image)
        light = self._with_far(light if self._gain is None else self._gain * light)
        sums = self._recorder.spread(light[..., None])[0]
        samples = self.cells.split(sums, self._recorder.box, self._sampled)
        planes = zip(self.planes, self.bins, strict=True)
        return np.concatenate([bins.share @ plane.adjoint(samples).ravel() for plane, bins in planes])


def _require_equal_lenses(camera: PlenopticCamera) -> None:
    """Refuse a camera whose lenses differ by more than responses know."""
    focal = camera.mla_jitter[1]
    # The width on the detector of light that converges to a point behind a lens of the nominal focal length.
    width = focal * max(camera.mla_pitches) * camera.detector_distance / min(camera.mla_focal_lengths)
    refuse_if(
        width > _WIDEST_SPREAD * camera.pixel_size,
        f"mla_jitter = {camera.mla_jitter}: its focal lengths spread light over {width / camera.pixel_size:.2g} "
        f"pixels: responses, of equal lenses, allow {_WIDEST_SPREAD:g}; use method ray, or leave it out",
    )


def _farthest(camera: PlenopticCamera) -> float:
    """Return how far displaced lenses move their light on the detector, at most, along an axis, in millimetres."""
    ends = [camera.pixel_coordinates(axis)[:: max(1, size - 1)] for axis, size in enumerate(reversed(camera.shape))]
    x, y = np.meshgrid(*(np.linspace(end[0], end[-1], 65) for end in ends))
    u, v = regular_place(camera, x, y)
    return 1.1 * float(max(abs(u - x).max(), abs(v - y).max())) + camera.pixel_size


def _dimmed(camera: PlenopticCamera, lens: Doubles, zone: Doubles | None, wavelength: float) -> Floats:
    """Return the light of pixels of some lenses over that with the pupil of the middles of their zones, or the whole.

    An edge of the pupil is blurred as wide as a lens and a pixel see it, and as the aperture of a lens diffracts it.
    """
    vignetting = cast(Vignetting, camera.vignetting)
    radius = camera.micro_image_diameter / 2
    width = camera.lattice.aperture_width
    aside = width * abs(1 - camera.reduced_distance / min(camera.reduced_focal_lengths))
    airy = in_millimetres(wavelength) * camera.reduced_distance / width
    blur = DetectorOperator(_AIRY_DEVIATION * airy / camera.pixel_size)
    white = white_image(camera.replace(vignetting=None, mla_transmissions=None, **SHARP))
    places = np.meshgrid(*(camera.pixel_coordinates(axis) for axis in (0, 1)))
    centres = camera.lattice.centre(*lens)
    pupil = [(c * camera.image_growth - q) / radius for c, q in zip(centres, places, strict=True)]

    def light(x: Any, y: Any) -> Floats:
        outline, passed = vignetting.outline(pupil[0], pupil[1], x, y)
        inside = np.clip(outline * radius / (camera.pixel_size + aside) + 0.5, 0, 1)
        return np.asarray(blur.forward((white * inside * passed).astype(np.float32)))

    whole = blur.forward(white) if zone is None else light(*zone)
    ratio = np.divide(light(*centres), whole, out=np.ones_like(whole), where=whole > _UNLIT * whole.max())
    return ratio.clip(0, _BRIGHTEST)


def _alike(camera: PlenopticCamera) -> bool:
    """Return whether rays one lens apart are alike: with an objective, or without aberrations."""
    ideal = camera.lens_model == "ideal" and camera.mla_medium == 1 and not any(camera.wavefront)
    return ideal or not camera.lens_data.converges


def _fine(grid: Grid, camera: PlenopticCamera, oversample: int) -> int:
    """Return the bins of cells along a lens: those of a reconstruction if they repeat with lenses, or finer ones."""
    lattice = camera.lattice
    separable = lattice.separable and lattice.aspect == 1 and grid.lens.is_uniform
    return oversample if separable else max(_FINE, oversample)
