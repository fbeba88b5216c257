"""Sums of the point spreads of many radiators, which add as intensities."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..lattice import turn
from ..optics import guards
from ..optics.microlenses import is_separable
from ..optics.sampling import check_memory, check_positions, check_wavelength
from ..runtime.backend import backend, one_at_a_time
from ..runtime.batches import Batch, BatchMap, Box, InTurn, Part, PartialSum, Threads, add
from ..runtime.fft import resting_drjit
from .accuracy import DEFAULT_ACCURACY, band_for, check_accuracy, wavefront_step
from .full_field import full_field
from .patch import Copies, Grid, PatchBatch, Placement, Tile, Workspace, place
from .pixels import integrate_pixels, turn_samples
from .sharing import LARGEST_ZONE, find_patterns

METHODS = ("patch", "full_field")

Progress = Callable[[int, int], None]

_EDGE = 8
"""Samples around a window that its pixels' integrals feel."""

_CHUNK = 64
"""Radiators that are prepared together and added into one tile."""

_PATCH_LIMIT = 2**26
"""Bytes of one radiator's field above which many are refused: blurred over thousands of pixels, they take days."""

_CHUNK_BYTES = 2**26
_PLACE_BLOCK = 4096
_TRIAL = 4


@one_at_a_time
def incoherent_sum(
    camera: PlenopticCamera,
    positions: Any,
    weights: Any,
    *,
    wavelength: float,
    method: str = "patch",
    accuracy: float = DEFAULT_ACCURACY,
    pupil_masks: Any = None,
    progress: Progress | None = None,
    threads: int | None = None,
    batch_map: BatchMap | None = None,
    start: PartialSum | None = None,
    keep: Callable[[PartialSum], None] | None = None,
) -> NDArray[np.float32]:
    """Add the point spreads of radiators, each with a weight.

    The bits of the result depend neither on the number of threads or workers nor on whether the sum was continued.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    positions : array (n, 3)
        Scene points (X, Y, g) in the camera frame.
    weights : array (n,) or (n, channels)
        Factors on the point spreads, not negative.
    wavelength : float
        Wavelength in nanometres.
    method : {"patch", "full_field"}
        Route, as for `point_spread_function`.
    accuracy : float
        Of method "patch": relative error (L2, over the image) that is allowed for speed, below 1. Radiators of nearly
        the same wavefront at neighbouring lenses then share a point spread, which the allowed error rules. 0: every
        radiator has its own, and the most of the diffracted light is kept.
    pupil_masks : bool array (n, m, m), optional
        For each radiator the open cells of the square around the pupil: rows along y, columns along x. What
        passes is normalised anew, so that each point spread still sums to its weight. Method "patch" only.
    progress : callable (done, total), optional
        Called with the numbers of radiators.
    threads : int, optional
        Default: all cores this process may use.
    batch_map : callable, optional
        Computes the batches of the sum elsewhere; see `BatchMap`. Default: on threads of this process.
    start : PartialSum, optional
        What `keep` was given in a sum of the same inputs, to go on from there. Its array is added to.
    keep : callable, optional
        Called after every batch with the sum so far, whose array the next batch changes.

    Returns
    -------
    float32 array (rows, columns) or (rows, columns, channels)
        Integrals over the recorded pixels.

    Raises
    ------
    InputError
        If an input has a wrong shape or value, or the work would need too much memory.
    PhysicsError
        If too much of the light is lost (see `guards`).
    """
    wavelength = check_wavelength(wavelength)
    points = check_positions(positions)
    factors = _check_weights(weights, len(points))
    masks = _check_masks(pupil_masks, len(points))
    if method not in METHODS:
        raise InputError(f"method = {method!r}: it must be one of {', '.join(METHODS)}")
    accuracy = check_accuracy(accuracy)
    if method == "full_field" and masks is not None:
        raise InputError("pupil_masks: method 'full_field' knows none, use 'patch'")
    work: _Sum
    if method == "full_field":
        work = _FullFieldSum(camera, points, factors, wavelength)
        batch_map = batch_map or InTurn()
    else:
        batch_map = batch_map or Threads(threads)
        work = _PatchSum(camera, points, factors, masks, wavelength, accuracy)
        work.check_memory(batch_map)
    with guards.watch():
        image = _add_up(work, batch_map, progress, start, keep)
    return image[..., 0] if np.ndim(weights) == 1 else image


@dataclass(frozen=True)
class Cost:
    """What an incoherent sum by patches will take.

    Attributes
    ----------
    radiators : int
        Radiators whose light reaches the recorded window.
    patterns : int
        Point spreads that are computed for them.
    seconds : float
        Time, from that of a few of them on this machine now.
    memory : float
        Bytes at most.
    """

    radiators: int
    patterns: int
    seconds: float
    memory: float


@one_at_a_time
def estimate_cost(
    camera: PlenopticCamera,
    positions: Any,
    *,
    wavelength: float,
    accuracy: float = DEFAULT_ACCURACY,
    pupil_masks: Any = None,
    batch_map: BatchMap | None = None,
) -> Cost:
    """Estimate what `incoherent_sum` by patches will take, by doing a little of it.

    Parameters
    ----------
    camera, positions, wavelength, accuracy, pupil_masks, batch_map
        As for `incoherent_sum`.

    Returns
    -------
    Cost

    Raises
    ------
    InputError
        If an input has a wrong shape or value, or the work would need too much memory.
    PhysicsError
        If too much of the light would be lost.
    """
    points = check_positions(positions)
    work = _PatchSum(
        camera,
        points,
        np.ones((len(points), 1)),
        _check_masks(pupil_masks, len(points)),
        check_wavelength(wavelength),
        check_accuracy(accuracy),
    )
    return work.cost(batch_map or Threads())


def _check_weights(weights: Any, count: int) -> NDArray[np.float64]:
    try:
        factors = np.asarray(weights, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"weights: they must be numbers, ({count},) or ({count}, channels)") from None
    if factors.ndim not in (1, 2) or len(factors) != count:
        raise InputError(f"weights of shape {factors.shape}: it must be ({count},) or ({count}, channels)")
    if not np.isfinite(factors).all() or (factors < 0).any():
        raise InputError("weights: they must be finite and not negative")
    return factors.reshape(count, -1) if count else np.zeros((0, factors.size or 1))


def _check_masks(masks: Any, count: int) -> NDArray[np.bool_] | None:
    if masks is None:
        return None
    opened = np.asarray(masks)
    if opened.dtype != np.bool_ or opened.ndim != 3 or opened.shape[::2] != (count, opened.shape[1]):
        raise InputError(
            f"pupil_masks of shape {opened.shape} and type {opened.dtype}: it must be ({count}, m, m) booleans"
        )
    return opened


class _Sum(Protocol):
    """What the two methods have in common: a sum of batches on a box of some grid."""

    arrays: Any  # NumPy, or CuPy for parts that lie on a CUDA device
    box: Box
    channels: int
    total: int  # radiators, those that are left out too
    radiators: NDArray[np.int64]  # of each batch

    def batches(self, first: int) -> Iterator[Batch]:
        """Give the batches from one on, in their order."""

    def sent(self, batch: int) -> float:
        """Sum of a batch's samples if no light were lost; 0 if that is looked at elsewhere."""

    def image(self, sums: NDArray[np.float32]) -> NDArray[np.float32]:
        """Turn the sum, (channels, rows, columns), into (rows, columns, channels) of pixels."""


def _add_up(
    work: _Sum,
    batch_map: BatchMap,
    progress: Progress | None,
    start: PartialSum | None,
    keep: Callable[[PartialSum], None] | None,
) -> NDArray[np.float32]:
    shape = (work.channels, work.box.rows, work.box.columns)
    start = start or PartialSum(0, work.arrays.zeros(shape, np.float32))
    if start.sums.shape != shape or not 0 <= start.batches <= len(work.radiators):
        raise InputError(
            f"start: {start.batches} batches of shape {start.sums.shape}: this sum has {len(work.radiators)} of "
            f"shape {shape}"
        )
    done = work.total - int(work.radiators[start.batches :].sum())
    if progress:
        progress(done, work.total)
    sums = work.arrays.asarray(start.sums)
    arrived, sent = start.arrived, start.sent
    with contextlib.closing(batch_map(work.batches(start.batches))) as parts:
        for index, part in enumerate(parts, start.batches):
            add(part, work.box, sums)
            arrived += float(part.sums.sum(dtype=np.float64))
            sent += work.sent(index)
            if keep:
                keep(PartialSum(index + 1, sums, arrived, sent))
            done += int(work.radiators[index])
            if progress:
                progress(done, work.total)
    if sent:
        guards.judge(guards.PATCH, 1 - arrived / sent)
    return work.image(sums)


@dataclass(frozen=True)
class _FullField:
    """One radiator by the slow route: a batch."""

    camera: PlenopticCamera
    position: NDArray[np.float64]
    factors: NDArray[np.float32]  # of the channels
    wavelength: float

    @property
    def samples(self) -> int:
        """Those on the detector."""
        return math.prod(self.camera.shape)

    def prepare(self) -> Callable[[], Part]:
        """Do all of it."""
        psf = full_field(self.camera, self.position, self.wavelength)
        part = Part(_pixels(self.camera), self.factors[:, None, None] * psf)
        return lambda: part


def _pixels(camera: PlenopticCamera) -> Box:
    return Box(*camera.crop_offset, *camera.crop_size)


class _FullFieldSum:
    """Radiators one by one, on the recorded pixels."""

    def __init__(
        self,
        camera: PlenopticCamera,
        points: NDArray[np.float64],
        factors: NDArray[np.float64],
        wavelength: float,
    ) -> None:
        self.camera, self.wavelength = camera, wavelength
        self.arrays: Any = np
        self.box, self.total, self.channels = _pixels(camera), len(points), factors.shape[1]
        lit = factors.any(1)
        self.points, self.factors = points[lit], factors[lit].astype(np.float32)
        self.radiators = np.ones(len(self.points), np.int64)

    def batches(self, first: int) -> Iterator[Batch]:
        """Give one batch a radiator."""
        for point, factors in zip(self.points[first:], self.factors[first:], strict=True):
            yield _FullField(self.camera, point, factors, self.wavelength)

    def sent(self, batch: int) -> float:
        """Give 0: what a full field loses is found where it is computed."""
        return 0.0

    def image(self, sums: NDArray[np.float32]) -> NDArray[np.float32]:
        """Put the channels last."""
        return np.ascontiguousarray(sums.transpose(1, 2, 0))


@dataclass(frozen=True)
class _Window:
    """The part of the detector that is computed: its pixels, and the samples that they feel."""

    pixels: Box
    samples: Box


class _PatchSum:
    """Radiators gathered into patterns, and patterns into chunks of one patch size and neighbourhood.

    Each chunk is a batch: it is added into a tile of its own, in the order of its patterns.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        points: NDArray[np.float64],
        factors: NDArray[np.float64],
        masks: NDArray[np.bool_] | None,
        wavelength: float,
        accuracy: float,
    ) -> None:
        self.camera, self.masks, self.arrays = camera, masks, backend().arrays
        self.total, self.channels = len(points), factors.shape[1]
        lit = np.flatnonzero(factors.any(1))
        self.grid = Grid.of(camera, wavelength, band_for(accuracy, len(points)), points)
        step = wavefront_step(accuracy, camera, points[lit])
        places = self.grid.to_frame(points[lit])
        patterns = find_patterns(self.grid.camera, places, None if masks is None else masks[lit], wavelength, step)
        placement = _place_all(self.grid, patterns.positions)
        shifts = patterns.shift @ self.grid.lens_samples
        low = placement.corner[patterns.pattern] + shifts
        high = low + placement.samples[patterns.pattern, None]
        self.window = self._window(low, high)
        self.box = box = self.window.samples
        start, size = np.array([box.left, box.top]), np.array([box.columns, box.rows])
        seen = ((high > start) & (low < start + size)).all(1)
        # the radiators that are seen, pattern by pattern
        order = np.flatnonzero(seen)
        order = order[np.argsort(patterns.pattern[order], kind="stable")]
        self.shifts, self.factors = shifts[order], factors[lit[order]]
        kept, self.first = np.unique(patterns.pattern[order], return_index=True)
        self.last = np.append(self.first[1:], len(order))
        self.positions, self.placement = patterns.positions[kept], _take(placement, kept)
        self.mask_of = lit[order[self.first]]
        self.chunks = self._sort(patterns.zone[kept])
        members = self.last - self.first
        self.power = np.add.reduceat(self.factors.sum(1), self.first) if len(kept) else np.zeros(0)
        self.radiators = np.array([members[chunk].sum() for chunk in self.chunks], np.int64)

    def _window(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> _Window:
        """Bound the recorded pixels that patches reach, and the samples that these feel."""
        pitch, p = self.grid.pitch, self.camera.pixel_size
        start = np.array(self.camera.crop_offset)
        stop = start + np.array(self.camera.crop_size)
        if len(low):
            reached = self._turned(low.min(0) * pitch, high.max(0) * pitch, self.grid.rotation)
            start = np.clip(np.floor(reached[0] / p).astype(np.int64) - _EDGE, start, stop)
            stop = np.clip(np.ceil(reached[1] / p).astype(np.int64) + _EDGE, start, stop)
        felt = self._turned(start * p, stop * p, -self.grid.rotation)
        first = np.floor(felt[0] / pitch).astype(np.int64) - _EDGE
        last = np.ceil(felt[1] / pitch).astype(np.int64) + _EDGE
        return _Window(Box.between(start, stop), Box.between(first, last))

    def _turned(
        self, low: NDArray[np.float64], high: NDArray[np.float64], degrees: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Bound a rectangle, given from the detector's corner, after a turn about the axis."""
        if degrees == 0:
            return low, high
        x, y = (np.array([low[axis], low[axis], high[axis], high[axis]]) + self.grid.origin[axis] for axis in (0, 1))
        corners = np.stack(turn(x, y[[0, 2, 0, 2]], degrees), -1) - self.grid.origin
        return corners.min(0), corners.max(0)

    def _sort(self, zone: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        samples, corner = self.placement.samples, self.placement.corner
        if not len(samples):
            return []
        area = np.maximum(1, samples // 3)
        alone = self.last - self.first == 1
        keys = (
            np.where(alone, corner[:, 0] // area, zone[:, 0]),
            np.where(alone, corner[:, 1] // area, zone[:, 1]),
            samples,
            alone,
        )
        order = np.lexsort(keys)
        changes = np.any([np.diff(key[order]) != 0 for key in keys], axis=0)
        chunks = []
        for group in np.split(order, np.flatnonzero(changes) + 1):
            first = group[0]
            across = (self.placement.last[first] - self.placement.first[first]).max() + 2
            if not is_separable(self.grid.camera):
                across = 1.5 * samples[first]  # on the MLA, of which the microlenses take an array
            size = int(min(_CHUNK, max(1, _CHUNK_BYTES // (8 * across**2))))
            chunks += [group[start : start + size] for start in range(0, len(group), size)]
        return chunks

    def memory(self, batch_map: BatchMap) -> float:
        """Bytes that the sum takes in this process."""
        box = self.box
        image = 4.0 * self.channels * (box.rows * box.columns + 2 * math.prod(self.camera.shape))
        if self.grid.rotation != 0:
            image += 12.0 * box.rows * box.columns
        samples = float(self.placement.samples.max(initial=0))
        tile = 4 * self.channels * (samples * 4 / 3 + LARGEST_ZONE * float(self.grid.lens_samples.max())) ** 2
        return image + (batch_map.workers + 1) * tile + (batch_map.threads + 1) * (10 * samples**2 + 2 * _CHUNK_BYTES)

    def cost(self, batch_map: BatchMap) -> Cost:
        """Estimate what the sum takes from a few patterns of each patch size."""
        memory = self.check_memory(batch_map)
        samples = self.placement.samples
        seconds = arrived = sent = 0.0
        for size in np.unique(samples):
            of_size = [chunk for chunk in self.chunks if samples[chunk[0]] == size]
            some = of_size[len(of_size) // 2][:_TRIAL]
            with resting_drjit():
                self._batch(some[:1]).prepare()()  # compiles the kernels
                backend().synchronize()
                start = time.perf_counter()
                part = self._batch(some).prepare()()
                backend().synchronize()
                taken = time.perf_counter() - start
            arrived += float(part.sums.sum(dtype=np.float64))
            sent += self._sent(some)
            seconds += taken / len(some) * sum(len(chunk) for chunk in of_size) / batch_map.workers
        guards.require(guards.PATCH, 1 - arrived / sent if sent else 0.0)
        return Cost(len(self.factors), len(samples), seconds, memory)

    def check_memory(self, batch_map: BatchMap) -> float:
        """Return the bytes that the sum takes, or refuse them."""
        memory = self.memory(batch_map)
        largest, patterns = int(self.placement.samples.max(initial=0)), len(self.positions)
        what = f"{self.total} radiators by patches of {largest} x {largest} samples"
        check_memory(memory, what)
        each = 8.0 * largest**2
        if patterns > _CHUNK and each > _PATCH_LIMIT:
            raise InputError(
                f"{what}: {patterns} patches, the largest of {each / 2**30:.2f} GiB, {memory / 2**30:.1f} GiB at a "
                f"time; for more than {_CHUNK} patches each may take {_PATCH_LIMIT / 2**30:.2f} GiB"
            )
        return memory

    def sent(self, batch: int) -> float:
        """Sum of a batch's samples if all the power through the pupil were on its patches."""
        return self._sent(self.chunks[batch])

    def _sent(self, chunk: NDArray[np.int64]) -> float:
        if self.camera.lattice.lens_area < self.camera.lattice.cell_area:
            return 0.0  # how much of it falls on what is opaque between the lenses is not known beforehand
        seen = chunk if self.masks is None else chunk[self.masks[self.mask_of[chunk]].any((1, 2))]
        return float(self.power[seen].sum()) / self.grid.pitch.prod()

    def image(self, sums: NDArray[np.float32]) -> NDArray[np.float32]:
        """Integrate the sum over the recorded pixels."""
        camera, grid, pixels, box = self.camera, self.grid, self.window.pixels, self.box
        image = np.zeros((*camera.shape, self.channels), np.float32)
        left, top = pixels.left - camera.crop_offset[0], pixels.top - camera.crop_offset[1]
        target = image[top : top + pixels.rows, left : left + pixels.columns]
        edge = pixels.left * camera.pixel_size, pixels.top * camera.pixel_size
        pitch = float(grid.pitch[0]), float(grid.pitch[1])
        origin = box.left * pitch[0], box.top * pitch[1]
        for channel, intensity in enumerate(sums):
            samples, steps, start = intensity, pitch, origin
            if grid.rotation != 0:
                samples, steps, start = self._upright(intensity, pitch, origin, edge)
            integrals = integrate_pixels(samples, steps, start, camera.pixel_size, edge, (pixels.rows, pixels.columns))
            target[..., channel] = backend().to_host(integrals)
        return np.maximum(image, 0, out=image)

    def _upright(
        self,
        intensity: NDArray[np.float32],
        pitch: tuple[float, float],
        origin: tuple[float, float],
        edge: tuple[float, float],
    ) -> tuple[NDArray[np.float32], tuple[float, float], tuple[float, float]]:
        """Turn the sum from the lattice's frame to samples in the camera's; origins are given from the corner."""
        pixels, p, step = self.window.pixels, self.camera.pixel_size, min(pitch)
        shape = (math.ceil(pixels.rows * p / step) + 2 * _EDGE, math.ceil(pixels.columns * p / step) + 2 * _EDGE)
        start = edge[0] - _EDGE * step, edge[1] - _EDGE * step
        corner = self.grid.origin.tolist()
        turned = turn_samples(
            intensity,
            pitch,
            (origin[0] + corner[0], origin[1] + corner[1]),
            self.grid.rotation,
            step,
            (start[0] + corner[0], start[1] + corner[1]),
            shape,
        )
        return turned, (step, step), start

    def batches(self, first: int) -> Iterator[Batch]:
        """Give the chunks as batches."""
        for chunk in self.chunks[first:]:
            yield self._batch(chunk)

    def _batch(self, chunk: NDArray[np.int64]) -> _Chunk:
        """Describe a chunk: its fields are scaled by their largest weights, and the weights relative to these."""
        amplitudes = np.empty(len(chunk))
        copies = []
        for index, pattern in enumerate(chunk):
            members = slice(self.first[pattern], self.last[pattern])
            shifts, copy = np.unique(self.shifts[members], axis=0, return_inverse=True)
            weights = np.zeros((len(shifts), self.factors.shape[1]))
            np.add.at(weights, copy, self.factors[members])
            amplitudes[index] = math.sqrt(weights.max())
            copies.append(Copies(shifts, (weights / weights.max()).astype(np.float32)))
        masks = None if self.masks is None else self.masks[self.mask_of[chunk]]
        return _Chunk(self.grid, _take(self.placement, chunk), self.positions[chunk], amplitudes, masks, copies)


@dataclass(frozen=True)
class _Chunk:
    """A batch of patterns of one patch size and neighbourhood; attributes as of `PatchBatch` and `Tile`."""

    grid: Grid
    placement: Placement
    positions: NDArray[np.float64]
    amplitudes: NDArray[np.float64]
    masks: NDArray[np.bool_] | None
    copies: list[Copies]

    @property
    def samples(self) -> int:
        """Those of all patches."""
        return int((self.placement.samples**2).sum())

    def fields(self) -> PatchBatch:
        """Make the fields."""
        return PatchBatch(self.grid, self.placement, self.positions, self.amplitudes, self.masks)

    def prepare(self) -> Callable[[], Part]:
        """Make the fields, and give the function that adds their intensities."""
        return partial(_sum_batch, self.fields(), self.copies)


def _sum_batch(batch: PatchBatch, copies: list[Copies]) -> Part:
    """Add the intensities of a batch into one tile."""
    tile, work = Tile(batch, copies), Workspace(batch)
    for start in range(0, len(copies), batch.together):
        batch.add(start, min(len(copies), start + batch.together), work, tile)
    sums = tile.intensity()
    return Part(Box(*tile.corner, sums.shape[2], sums.shape[1]), sums)


def _place_all(grid: Grid, points: NDArray[np.float64]) -> Placement:
    starts = range(0, max(1, len(points)), _PLACE_BLOCK)
    placements = [place(grid, points[start : start + _PLACE_BLOCK]) for start in starts]
    return Placement(*(np.concatenate([getattr(p, name) for p in placements]) for name in _FIELDS))


def _take(placement: Placement, which: NDArray[Any]) -> Placement:
    return Placement(*(getattr(placement, name)[which] for name in _FIELDS))


_FIELDS = tuple(Placement.__dataclass_fields__)
