"""The response of a camera to the bins of object planes: from radiance to the capture, and the adjoint.

Kernels are means of exact point spreads, or of rays.
"""

import contextlib
import functools
import itertools
import math
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from ...camera import PlenopticCamera, Use, Vignetting, require_support
from ...design import resolution_limit
from ...detector import SHARP, DetectorOperator
from ...fields import OpticalSystem, upright
from ...lenses import FittedLens, MainLens, RealLens, inverse_distance, open_area
from ...optics import in_millimetres
from ...points import Copies, Fields, Grid, Recorder, Scatter, band_for, chunks_of, place, radiance_weight, scene_points
from ...rays import Passage, Walk
from ...refocus import regular_place, straightened
from ...runtime import Box, Doubles, Floats, Integers, Job, Pair, Part, active_backend, add, turn
from ...views import lens_numbers, lenses_of_pixels, white_image
from .cells import BinCells, UprightBins
from .kernels import Kernel, PlaneResponse, StoredResponse, make_kernel, merged, require_response_memory, zones


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
    # 0.01: Relative error for which the grid, and how much of the diffracted light is retained, are chosen.
    arguments = system, band_for(0.01, 2**20), points
    grid = Grid.of(*arguments)
    together = 1
    if grid.rotation == 0:
        together = max(1, int(camera.pixel_size / (3 * float(grid.pitch.max()))))
    return Grid.of(*arguments, together), together


def wave_batches(
    grid: Grid,
    cells: BinCells,
    distance: float,
    cell: Integers,
    radiators: int = 0,
    vignetting: Vignetting | None = None,
) -> list[list[Scatter]]:
    """Return, for each bin of a cell, the batches whose summed results on a grid are the bin's response.

    By default there are as many `radiators` along a lens as the plane needs. All light passes the pupil as the cell's
    middle sees it through `vignetting`.
    """
    if vignetting is not None:
        numbers = vignetting.at(*cells.middle(cell))
        constant: Any = {name: (float(value),) for name, value in numbers.items()}
        grid = replace(grid, camera=grid.camera.replace(vignetting=replace(vignetting, **constant)))
    depth = finite_distance(cells.camera, distance)
    lens = grid.lens
    nearness = float(inverse_distance(lens, np.array([[0.0, 0.0, depth]]))[0])
    limit = resolution_limit(cells.camera, distance, grid.wavelength)
    lines = 0.0 if limit.in_focus else limit.frequency / (2 * limit.lenses)  # along a lens
    airy = in_millimetres(grid.wavelength) * lens.pupil.distance / (2 * lens.pupil.radius)
    pitch = max(cells.camera.mla_pitches)
    # With more than one along a period of the finest detail that the pupil resolves no pixel feels the grid, which a
    # blur of 2 pitches hides; 4 along a period of the finest lines that the plane's light resolves.
    spots = 1.1 * pitch / airy if cells.camera.blur_diameter(distance) < 2 * pitch else 0.0
    # Bins finer than lenses show what 8 points leave of the finest fringes.
    fewest = 8 if cells.fineness == (1, 1) else 10
    points_along = radiators or max(fewest, min(48, math.ceil(max(4 * lines, spots))))
    places = cells.bin_places(cell, points_along)
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
        # 4 batches at least: cores share the only kernel, and its speed is known before its end.
        groups = [some for same in alike for some in chunks_of(grid, placement, same, math.ceil(len(same) / 4))]
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
    return min(distance, 1e6 * camera.focal_length)


def ray_grid(camera: PlenopticCamera) -> Grid:
    """Return a grid whose samples are at most half as wide as pixels."""
    turned = upright(camera)
    steps = np.array(turned.lattice.grid_step) * (turned.micro_image_pitch / turned.row_pitch)
    origin = -np.array([camera.detector_width, camera.detector_height]) / 2
    pitch = steps / np.ceil(2 * steps / camera.pixel_size)
    wavelength = 1.0  # nothing depends on it
    system = OpticalSystem(turned, wavelength)
    band = band_for(0.5, 1)
    lens = system.waves_of(np.empty((0, 3)))
    return Grid(turned, lens, system.microlenses, camera.mla_rotation, wavelength, band, 0.0, pitch, origin)


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


def ray_batches(across: int, cells: BinCells, distance: float, cell: Integers) -> list[list[RayBatch]]:
    """Return, for each bin of a cell, the batch of `across` x `across` rays that are its response."""
    half = np.array(cells.bin_sizes) / 2
    return [[RayBatch(cells, distance, positions[0] - half, across)] for positions in cells.bin_places(cell)]


@functools.cache
def _pairs(count: int) -> Pair:
    """Return points (n, 2) of the unit square, paired with points (2, n) of the unit disc."""
    pairs = scene_points.sample_pairs(count)
    angle = 2 * np.pi * pairs[:, 3]
    return pairs[:, :2], np.sqrt(pairs[:, 2]) * np.stack([np.cos(angle), np.sin(angle)])


def _trace(batch: RayBatch) -> Part:
    """Return the light of a bin's rays, each distributed to the four nearest samples."""
    cells = batch.cells
    grid = cells.grid
    camera = cells.camera
    light = grid.lens.bind(np.empty((0, 3)))
    walk = Walk.of(camera, grid.lens)
    inside, disc = _pairs(batch.samples)
    b = camera.mla_distance
    q = batch.corner + inside * cells.bin_sizes
    pupil = tuple(grid.lens.pupil.radius * disc)
    g = finite_distance(camera, batch.distance)
    point = -q[:, 0] * g / b, -q[:, 1] * g / b, np.full(len(q), g)
    m = light.land(pupil, point)
    lenslet = walk.lenslet(*camera.lattice.cell(*m))
    passes = camera.lattice.in_aperture(m[0] - lenslet.centre[0], m[1] - lenslet.centre[1])
    landed, _ = walk.onto_detector(pupil, Passage((m[0], m[1]), lenslet))
    # Of a small bin all rays may meet gaps: it has no light, at the place where they land.
    lit = passes | ~passes.any()
    power = (walk.transmittance(pupil, m) * passes)[lit]
    position = ((np.stack(landed, axis=-1) - grid.origin) / grid.pitch)[lit]
    below = np.floor(position).astype(np.int64)
    low = below.min(0)
    columns, rows = (below.max(0) - low + 2).tolist()
    sums = np.zeros(rows * columns)
    over = position - below
    for right, down in np.ndindex(2, 2):
        weight = power * np.abs(1 - right - over[:, 0]) * np.abs(1 - down - over[:, 1])
        pixel = (below[:, 1] - low[1] + down) * columns + below[:, 0] - low[0] + right
        sums += np.bincount(pixel, weight, len(sums))
    sums *= bin_weight(cells) / (len(q) * grid.pitch.prod())
    return Part(Box(int(low[0]), int(low[1]), columns, rows), sums.reshape(1, rows, columns).astype(np.float32))


_ZONE = 16
"""Lenses along an axis that one core works on, and for which one kernel serves at least."""

_MEMORY = 2 * 2**30
"""Bytes of a plane's kernels beyond which zones grow, and of all planes' beyond which they are stored on disk."""

_LIT = 0.6
"""Fraction of a kernel's blocks that hold light, at most."""


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
    ):
        job = job or Job()
        self._oversample = oversample
        # Kernels are of the light of regular lenses; displaced and dimmer ones send it elsewhere, and pixels mix it.
        self._detector = DetectorOperator.of(camera)
        self._gain: Any = np.float32(1)
        self._bright: Any = np.float32(1)
        lens = lenses_of_pixels(camera).astype(np.float64)
        if camera.mla_transmissions is not None:
            self._gain = camera.mla_transmissions.at(camera.lattice, *lens).astype(np.float32)
        places, aside = None, 0.0
        if camera.lattice.displacement is not None or any(camera.mla_tilt):
            even = camera.replace(mla_transmissions=None)
            places, aside = functools.partial(regular_place, even), _farthest(even)
        recorded = camera
        camera = straightened(camera).replace(**SHARP)
        require_support(camera, Use.RESPONSES | Use.KERNELS)
        if wavelength is None:
            grid = ray_grid(camera)
            self._together = 1
        else:
            camera = camera.at_wavelength(wavelength)
            recorded = recorded.at_wavelength(wavelength)
            fine, self._together = wave_grid(camera, distances, wavelength)
            grid = fine.merged(self._together)
        # As many bins of cells along a lens as of a reconstruction if they repeat with lenses, in every row or in
        # every second, or finer ones.
        along = across = max(6, oversample)
        if grid.rotation == 0 and grid.lens.is_uniform:
            along = oversample * camera.lattice.stagger
            across = oversample if camera.lattice.rectangular and camera.lattice.aspect == 1 else across
        self.cells = BinCells(grid, along, across)
        # 256 x 256 rays of a bin; several of the finer bins of cells make up one.
        rays = math.ceil(256 * math.sqrt(oversample / math.sqrt(along * across)))
        self._batches: Callable[..., Sequence[Sequence]] = functools.partial(ray_batches, rays)
        if wavelength:
            self._batches = functools.partial(wave_batches, fine)
        self._camera = camera
        self._distances = distances
        everywhere = np.full((1, 2), 2**40)
        self._recorder = Recorder(camera, grid, -everywhere, everywhere, regular=places, aside=aside)
        self._sampled = self.cells.holding(self._recorder.box)
        # Cells end beyond the samples on which pixels depend.
        corners, self._recorder.box = self.cells.corners(self._sampled)
        kernel_bytes = [self._kernel_memory(distance, oversample**2) for distance in distances]
        # Far too large kernels are refused before the light of some is computed.
        self._require_memory(1, len(distances) > 1)
        # The unit of work is a sample of a point spread, 16 ns on two cores of a processor of 2023; in it, a kernel's
        # sample and a product in a step of an inversion, which is a forward and an adjoint response.
        step = (0.42 / (along * across) + 0.05) / 16
        kernel_samples = sum(self._kernel_memory(distance, along * across) for distance in distances) * _LIT / 4
        applied = math.ceil(step * steps * kernel_samples * len(self._sampled))
        middle = self._middle(np.arange(len(self._sampled)))
        bins = [some for distance in distances for some in self._batches(self.cells, distance, middle)]
        of_zone = _samples(bins)
        compared = 0
        # Zones divide the work among the cores; where lenses are alike, one kernel serves several.
        groups = zones(self._sampled, _ZONE)
        if wavelength:
            # The light of 2 x 2 points of lenses in the middle and in 12 positions around it.
            points = (wave_batches(fine, BinCells(grid, 1, 1), distance, middle, 2) for distance in distances)
            compared = 13 * _samples(itertools.chain(*points))
            self._done = 0
            self._total = compared + of_zone + applied
            unlike = max(self._unlike(distance, job) for distance in distances)
        else:
            # Rays one lens apart are alike with an objective, or without aberrations.
            ideal = camera.lens_model == "ideal" and camera.mla_medium == 1 and not any(camera.wavefront)
            unlike = 0.0 if ideal or not camera.lens_data.converges else math.inf
        # Lenses along the longer side of the detector.
        widest = max(len(self._sampled.count), int(self._sampled.count.max()))
        # 0.06: Difference of the light of two lenses, over this light, for which one kernel serves all between them.
        lenses = max(_ZONE, math.floor(widest / max(1, unlike / 0.06)))
        self._vignetting = vignetting = recorded.vignetting
        uneven = vignetting is not None or not self.cells.grid.lens.is_uniform
        if uneven and wavelength:
            lenses = min(lenses, self._width_of_pupils(widest))
            self._batches = functools.partial(wave_batches, fine, vignetting=vignetting)
        while lenses < widest and len(zones(self._sampled, lenses)) * max(kernel_bytes) > _MEMORY:
            lenses *= 2
        groups_of_cells = zones(self._sampled, lenses)
        middles = [self._middle(members) for members in groups_of_cells]
        owner = np.empty(len(self._sampled), np.int64)
        for index, members in enumerate(groups_of_cells):
            owner[members] = index
        groups = max(groups, groups_of_cells, key=len)
        owners = [owner[members[len(members) // 2]] for members in groups]
        zone = None
        if uneven and wavelength:
            seen = np.ones((3, len(self._sampled)), np.float32)
            for members, index in zip(groups, owners, strict=True):
                seen[:2, members] = self.cells.middle(middles[index])[:, None]
            sums = np.zeros((3, self._recorder.box.rows, self._recorder.box.columns), np.float32)
            for some, samples in zip(seen, sums, strict=True):
                self.cells.windows(samples)[corners[:, 1], corners[:, 0]] = some[:, None, None]
            x, y, ones = np.moveaxis(self._recorder.record(active_backend().arrays.asarray(sums)), -1, 0)
            zone = np.stack([x, y]) / ones
        if wavelength or uneven:
            own, whole, beyond = _dimmed(recorded, self.cells.grid.lens, lens, zone, wavelength or 0.0)
        self._store(len(distances) > 1 and _LIT * len(middles) * sum(kernel_bytes) > _MEMORY)
        # Beside those that the threads compute, another one is prepared.
        most = max(batch.memory for some in bins for batch in some)
        self._require_memory(len(middles), self._folder is not None, (job.workers.threads + 1) * most)
        # How many zones there are is known by now: what is left has the rest of the progress.
        left = len(middles) * of_zone + applied
        self._done = compared * left // (of_zone + applied)
        self._total = self._done + left
        self.prepared = 1 - applied / self._total
        self.planes: list[PlaneResponse] = []
        far = []
        for distance in distances:
            # A zone may be a single batch: all cores are busy only if the batches of all zones are computed together.
            of_middles = [self._batches(self.cells, distance, cell) for cell in middles]
            bins = [some for of_middle in of_middles for some in of_middle]
            with self._computed(bins, job) as parts:
                kernels = [
                    make_kernel(self.cells, cell, ([next(parts) for _ in some] for some in of_middle), self._together)
                    for cell, of_middle in zip(middles, of_middles, strict=True)
                ]
            if wavelength:
                central = owners[len(owners) // 2]
                far.append(self._far_light(kernels[central], distance, middles[central]))
            blocks = [block for kernel in kernels for block in kernel.blocks]
            matrices = self._stored([block.matrix for block in blocks], f"{len(self.planes)}")
            for block, matrix in zip(blocks, matrices, strict=True):
                block.matrix = matrix
            of_zones = [kernels[index] for index in owners]
            self.planes.append(PlaneResponse(self.cells, self._sampled, groups, of_zones, self._recorder))
        self._far: Any = np.float32(0)
        if far:
            # Gaps between lenses scatter half of it evenly.
            self._far = np.float32(np.mean(far)) * (beyond if camera.lattice.fills else (1 + beyond) / 2)
        self.bins = [
            UprightBins.over(self.cells, plane.lit, camera, distance, oversample)
            for plane, distance in zip(self.planes, distances, strict=True)
        ]
        columns, rows = (oversample * count for count in camera.bin_count)
        self._windows = [
            (slice(-top, rows - top), slice(-left, columns - left)) for left, top in (bins.first for bins in self.bins)
        ]
        self.shapes = [bins.shape for bins in self.bins]
        super().__init__((sum(math.prod(shape) for shape in self.shapes),), camera.shape)
        if uneven:
            # Edges of kernels are not quite those of pupils: a lens has the light that its pupil passes all the same.
            gain = self._gain
            self._gain = np.float32(1)
            far_light = self._far
            self._far = np.float32(0)
            ones = np.ones(self.source_shape, np.float32)
            white = self._direct(ones)
            ratio = np.divide(own, whole, out=np.ones_like(own), where=whole > 1e-6 * whole.max()).clip(0, 4)
            number = lens_numbers(recorded).ravel()
            light, right, at_zone = (np.bincount(number, some.ravel()) for some in (white, own, whole))
            # So have bins, of whose light the middle's pupil has passed more or less than those of the lenses do.
            self.light = sent = self._sent(owner, middles, far or [0.0] * len(distances))
            dim = ratio
            for step in range(4 if wavelength else 1):
                self._gain = dim
                if step:
                    arrived = self.adjoint(np.ones_like(own))
                    lit = arrived > 1e-3 * arrived.max()
                    self._bright = self._bright * np.divide(sent, arrived, out=np.ones_like(sent), where=lit)
                arrived_at = np.bincount(number, self._direct(ones).ravel())
                # Of lenses at the rim some have hardly any pixels, and others no light of their zone.
                lenses = (at_zone > 1e-3 * at_zone.max()) & (arrived_at > 1e-3 * arrived_at.max())
                share = np.divide(light * right, at_zone * arrived_at, out=np.ones_like(light), where=lenses)
                dim = dim * share[number].reshape(ratio.shape).astype(np.float32)
            self._gain = gain * dim
            # Far light has the lens's pupil, not the zone's.
            self._far = far_light / dim.clip(0.1)
        if wavelength is None:
            # Samples show borders of micro-images but roughly, and steps would amplify that: white is exact.
            flat = self._direct(np.full(self.source_shape, 1 / len(distances), np.float32))
            white = white_image(recorded.replace(**SHARP))
            # A response that is far from the white image is left as it is.
            if np.linalg.norm(white - flat) < 0.25 * np.linalg.norm(white):
                seen = flat > 1e-3 * flat.max()
                self._gain = self._gain * np.divide(white, flat, out=np.zeros_like(flat), where=seen).clip(0, 20)
        if recorded.stray_light:
            # Interpolation leaves less than no light between micro-images, which steps would divide stray light by.
            # 0.005: Light of a white scene there, over that of the brightest pixel, as in `RichardsonLucy`.
            white = self._direct(np.ones(self.source_shape, np.float32))
            self._gain = np.where(white > 0.005 * white.max(), self._gain, np.float32(0))

    def _computed(self, bins: Sequence[Sequence], job: Job) -> contextlib.closing[Generator[Part, None, None]]:
        """Return the results of the batches of bins, whose samples count as progress."""
        done = self._done
        batches = list(itertools.chain.from_iterable(bins))
        samples = [batch.samples for batch in batches]
        self._done += sum(samples)
        return contextlib.closing(job.each(batches, samples, done, self._total))

    def _far_light(self, kernel: Kernel, distance: float, cell: Integers) -> float:
        """Return the light that falls beyond a cell's kernel, over that within.

        As bins tile cells, apertures pass the part of their light which they cover of the array.
        """
        camera = self.cells.camera
        batches = itertools.chain.from_iterable(self._batches(self.cells, distance, cell))
        sent = sum(copy.weights.sum() for batch in batches for copy in batch.copies)
        sent *= camera.lattice.lens_area * len(camera.mla_focal_lengths) / self.cells.vectors.diagonal().prod()
        if self._vignetting is not None:
            sent *= self._vignetting.power(*_pairs(2**10)[1], *self.cells.middle(cell)).mean()
        arrived = sum(float(block.matrix.sum(dtype=np.float64)) for block in kernel.blocks)
        return max(0.0, sent / (arrived * self.cells.grid.pitch.prod()) - 1)

    def _sent(self, owner: Integers, middles: Sequence[Integers], far: Sequence[float]) -> Floats:
        """Return the light of bins within kernels, as the pupils of lenses pass it and not those of their zones.

        Behind a real lens that is known: where all of it is recorded it is the light of the bin's open pupil.
        """
        lens, cells, camera = self.cells.grid.lens, self.cells, self._camera
        disc = _pairs(2**8)[1]
        pupil = tuple(lens.pupil.radius * disc)
        edge = lens.pupil.radius * math.sqrt(math.pi / disc.shape[1])

        def light(position: Any) -> Floats:
            inside, passed = _pupil_of(lens, self._vignetting, pupil, position)
            return np.asarray(np.clip(inside / edge + 0.5, 0, 1) * passed, np.float32)

        dark = np.zeros((1, disc.shape[1]), np.float32)
        index = self._sampled.index
        places_of = [np.moveaxis(cells.middle(some), -1, 0)[..., None] for some in (index, np.array(middles))]
        of_lenses = np.concatenate([*map(light, np.array_split(places_of[0], -(-len(index) // 4096), 1)), dark])
        of_zones = np.concatenate([light(places_of[1]), dark])
        zone = np.append(owner, len(middles))
        ones = np.ones((*camera.shape, 1), np.float32)
        corners, _ = cells.corners(self._sampled)
        windows = cells.windows(active_backend().to_host(self._recorder.spread(ones)[0]))
        recorded = windows[corners[:, 1], corners[:, 0]].sum((1, 2))
        complete = np.append(recorded > 0.99 * recorded.max(), False)
        light_of_bins = self.adjoint(ones[..., 0])
        planes = self.planes_of(light_of_bins)
        for distance, bins, beyond, arrived in zip(self._distances, self.bins, far, planes, strict=True):
            g = finite_distance(camera, distance)
            axes = (
                ((np.arange(count) + first + 0.5) / self._oversample - lenses / 2) * camera.row_pitch
                for count, first, lenses in zip(bins.shape[::-1], bins.first, camera.bin_count, strict=True)
            )
            places = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
            points = np.column_stack([-places * g / camera.mla_distance, np.full(len(places), g)])
            open_light = np.zeros(len(points))
            if not lens.is_uniform:
                fitted = cast(FittedLens, lens)
                stretch = fitted.image_stretch(camera, distance)
                open_light = open_area(fitted, points) * np.interp(np.hypot(*places.T), stretch.places, stretch.area)
                weight = radiance_weight(camera, lens, (camera.row_pitch / self._oversample) ** 2)
                open_light *= weight / (math.pi * lens.reach**2 * (1 + beyond))
            for some in np.array_split(np.arange(len(points)), -(-len(points) // 2048)):
                landed = lens.bind(points[some]).land(pupil, tuple(points[some].T[..., None]))
                x, y = turn(landed[0], landed[1], -cells.grid.rotation)
                row = np.floor(y / cells.vectors[1, 1])
                column = np.floor((x - row * cells.vectors[1, 0]) / cells.vectors[0, 0])
                cell = self._sampled.find(np.stack([column, row], -1).astype(np.int64))
                samples = np.arange(disc.shape[1])
                here, there = of_lenses[cell, samples].sum(1), of_zones[zone[cell], samples].sum(1)
                ratio = np.divide(here, there, out=np.ones_like(here), where=there > 0.01 * disc.shape[1])
                sure = (open_light[some] > 0) & complete[cell].all(1)
                arrived.flat[some] = np.where(sure, open_light[some], arrived.flat[some] * ratio)
        return light_of_bins

    def _middle(self, members: Integers) -> Integers:
        """Return the cell in the middle of a zone."""
        cell_index = self._sampled.index[members]
        places = cell_index @ self.cells.vectors
        return cell_index[np.argmin(((places - places.mean(0)) ** 2).sum(1))]

    def _width_of_pupils(self, widest: int) -> int:
        """Return the width of zones over which the pupil changes by a tenth, a quarter behind a real lens, at most."""
        disc = self.cells.grid.lens.pupil.radius * _pairs(2**10)[1]
        index = self._sampled.index[:: max(1, len(self._sampled) // 100)]

        def light(cells: Integers) -> Doubles:
            places = np.moveaxis(self.cells.middle(cells), -1, 0)[..., None]
            inside, passed = _pupil_of(self.cells.grid.lens, self._vignetting, disc, places)
            return (inside >= 0) * passed

        step = max(1, widest // 8)
        here = light(index)
        darkest = here.mean(1).clip(0.05)
        changes = [(abs(light(index + np.array(to)) - here).mean(1) / darkest).max() for to in ((step, 0), (0, step))]
        # Finer zones help where the kernels' pupil is even; that of real lenses changes within a kernel, too.
        parts = 4 if self._vignetting is None else 10
        return max(1, math.floor(step / max(1e-9, parts * float(max(changes)))))

    def _unlike(self, distance: float, job: Job) -> float:
        """Return the change of the light of 2 x 2 points from the middle to the corners, over this light.

        Aberrations need not grow towards the corners: of the changes to the corners, half-way to them and to the
        middles of the borders the steepest counts, as if it went on to the corners.
        """
        index = self._sampled.index
        cells = BinCells(self.cells.grid, 1, 1)
        places = index @ cells.vectors
        centre = (places.max(0) + places.min(0)) / 2
        reach = (places.max(0) - places.min(0)) / 2
        half = 2 * sum(cells.size) + math.ceil(cells.camera.blur_diameter(distance) / cells.grid.pitch.min())

        def nearest(*aim: float) -> int:
            return int(np.argmin(((places - centre - reach * aim) ** 2).sum(1)))

        def light(cell: Integers) -> Any:
            left, top = (cell @ cells.samples + cells.first_sample - half).tolist()
            image = active_backend().arrays.zeros((1, 2 * half, 2 * half), np.float32)
            with self._computed(self._batches(cells, distance, cell, 2), job) as parts:
                for block in parts:
                    box, sums = merged(block.box, block.sums[0], self._together)
                    add(Part(box, sums[None]), Box(left, top, 2 * half, 2 * half), image)
            return image

        aims = [(x, y) for reached in (0.5, 1.0) for x in (-reached, reached) for y in (-reached, reached)]
        aims += [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)]
        middle = nearest(0.0, 0.0)
        at_middle = light(index[middle])
        bright = math.sqrt((at_middle**2).sum())
        if not bright:
            return math.inf
        steepest = 0.0
        for number in {nearest(*aim) for aim in aims} - {middle}:
            away = math.dist(places[number], places[middle]) / math.hypot(*reach)
            change = math.sqrt(((light(index[number]) - at_middle) ** 2).sum())
            steepest = max(steepest, change / (bright * away))
        return steepest

    def _kernel_memory(self, distance: float, bins: float) -> float:
        """Return the approximate bytes of one kernel of a plane with all of its blocks."""
        camera = self.cells.camera
        grid = self.cells.grid
        samples = 1.1 * camera.blur_diameter(distance) / grid.pitch.min() + 8 / grid.pitch.min() * camera.pixel_size
        across, down = (samples / size + 2 for size in self.cells.size)
        return float(4 * across * down * bins * np.prod(grid.lens_samples.diagonal()) * len(camera.mla_focal_lengths))

    def _require_memory(self, groups: int, on_disk: bool, fields: float = 0.0) -> None:
        def memory(oversample: int) -> float:
            of_lens = math.prod(self.cells.fineness) * (oversample / self._oversample) ** 2
            kernel_bytes = [self._kernel_memory(distance, of_lens) for distance in self._distances]
            bins = 4.0 * len(self._sampled) * len(self._camera.mla_focal_lengths) * of_lens * len(kernel_bytes)
            samples = 4.0 * self._recorder.box.rows * self._recorder.box.columns
            kernels = _LIT * groups * (max(kernel_bytes) if on_disk else sum(kernel_bytes))
            return kernels + 2 * max(kernel_bytes) + 12 * bins + 4 * samples + self._recorder.memory + fields

        require_response_memory(memory, self._oversample, self._distances)

    def forward(self, values: Floats, /) -> Floats:
        """Return the image that the detector records of planes."""
        return self._detector.forward(self._direct(values))

    def _direct(self, values: Floats) -> Floats:
        """Return the light of planes that falls on the detector."""
        box = self._recorder.box
        by_samples = self._recorder.by_samples
        shape = (box.rows, box.columns) if by_samples else self.image_shape
        image = active_backend().arrays.zeros(shape, np.float32)
        for plane, bins, radiance in zip(self.planes, self.bins, self.planes_of(values * self._bright), strict=True):
            plane.add_forward((bins.share.T @ radiance.ravel()).reshape(plane.shape), image)
        if by_samples:
            image = self._recorder.record(image[None])[..., 0]
        if np.any(self._far):
            image += self._far * _around(self._camera, image)
        return np.asarray(self._gain * image)

    def adjoint(self, image: Floats, /) -> Floats:
        """Return the transpose of `forward`, applied to an image."""
        light = self._gain * self._detector.adjoint(image)
        if np.any(self._far):
            light += _around(self._camera, self._far * light)
        if self._recorder.by_samples:
            light = self._recorder.spread(light[..., None])[0]
        planes = zip(self.planes, self.bins, strict=True)
        return np.concatenate([bins.share @ plane.adjoint(light).ravel() for plane, bins in planes]) * self._bright


def _samples(bins: Iterable[Sequence]) -> int:
    """Return the samples of the batches of bins, to which their time is about proportional."""
    return sum(batch.samples for some in bins for batch in some)


def _around(camera: PlenopticCamera, image: Floats) -> Floats:
    """Return the mean of an image over nine lenses around each, in blocks of a lens; a symmetric matrix."""
    width = max(1, round(camera.micro_image_pitch / camera.pixel_size))
    whole = np.pad(image, [(0, -size % width) for size in image.shape])
    means = whole.reshape(len(whole) // width, width, -1, width).sum(3).sum(1) / np.float32(width**2)
    around = uniform_filter(means, 9, mode="reflect").repeat(width, 0).repeat(width, 1)
    return around[: image.shape[0], : image.shape[1]]


def _farthest(camera: PlenopticCamera) -> float:
    """Return how far displaced lenses move their light on the detector, at most, along an axis, in millimetres."""
    ends = [camera.pixel_coordinates(axis)[:: max(1, size - 1)] for axis, size in enumerate(reversed(camera.shape))]
    x, y = np.meshgrid(*(np.linspace(end[0], end[-1], 65) for end in ends))
    u, v = regular_place(camera, x, y)
    return 1.1 * float(max(abs(u - x).max(), abs(v - y).max())) + camera.pixel_size


def _pupil_of(lens: MainLens, vignetting: Vignetting | None, pupil: Any, place: Any) -> tuple[Doubles, Any]:
    """Return the distance in mm of pupil points from the outline that places see, positive inside, and what passes."""
    if not lens.is_uniform:
        return cast(FittedLens, lens).system.inside(pupil, place), 1.0
    radius = lens.pupil.radius
    outline, passed = (vignetting or Vignetting(1.0)).outline(pupil[0] / radius, pupil[1] / radius, place[0], place[1])
    return outline * radius, passed


def _dimmed(
    camera: PlenopticCamera, main_lens: MainLens, lens: Doubles, zone: NDArray | None, wavelength: float
) -> tuple[Floats, Floats, Floats]:
    """Return the light of pixels of some lenses, that with the pupil of the middles of their zones, or whole, and far.

    An edge of the pupil is blurred as wide as a lens and a pixel see it, and as the aperture of a lens diffracts it.
    Far light, 1 on the mean, has the pupil's edge as its source, or the borders of lenses, which cast an even pupil.
    """
    width = camera.lattice.aperture_width
    aside = width * abs(1 - camera.reduced_distance / min(camera.reduced_focal_lengths))
    airy = in_millimetres(wavelength) * camera.reduced_distance / width
    # 0.376: Standard deviation of a Gaussian as wide, at half of its maximum, as the pattern of a slit.
    blur = DetectorOperator(0.376 * airy / camera.pixel_size)
    white = np.ones(camera.shape, np.float32)
    if main_lens.is_uniform:
        white = white_image(camera.replace(vignetting=None, mla_transmissions=None, **SHARP))
    places = np.meshgrid(*(camera.pixel_coordinates(axis) for axis in (0, 1)))
    centres = camera.lattice.centre(*lens)
    on_pupil = camera.pupil_distance / camera.reduced_distance
    pupil = [(c * camera.image_growth - q) * on_pupil for c, q in zip(centres, places, strict=True)]
    edge = (camera.pixel_size + aside) * on_pupil

    def light(*place: Any) -> Floats:
        inside, passed = _pupil_of(main_lens, camera.vignetting, pupil, place)
        return blur.forward((white * np.clip(inside / edge + 0.5, 0, 1) * passed).astype(np.float32))

    here = light(*centres)
    inside, _ = _pupil_of(main_lens, camera.vignetting, pupil, centres)
    rims = blur.forward(np.clip(1 - abs(inside) / edge, 0, 1).astype(np.float32))
    far = np.zeros_like(here)
    for part in (here, rims):
        mean = _around(camera, part)
        far += np.divide(part, 2 * mean, out=np.full_like(part, 0.5), where=mean > 0.02)
    return here, blur.forward(white) if zone is None else light(*zone), far
