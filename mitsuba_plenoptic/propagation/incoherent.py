"""Sums of the point spreads of many radiators, which add as intensities."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._backend import backend
from ..camera import PlenopticCamera
from ..errors import InputError
from .accuracy import DEFAULT_ACCURACY, band_for, check_accuracy, wavefront_step
from .fft import resting_drjit, worker_count
from .full_field import full_field
from .patch import Copies, Grid, PatchBatch, Placement, Tile, Workspace, place
from .patterns import LARGEST_ZONE, find_patterns
from .pixels import integrate_pixels
from .sampling import check_memory, check_positions, check_wavelength

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
) -> NDArray[np.float32]:
    """Add the point spreads of radiators, each with a weight.

    The bits of the result do not depend on the number of threads.

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

    Returns
    -------
    float32 array (rows, columns) or (rows, columns, channels)
        Integrals over the recorded pixels.

    Raises
    ------
    InputError
        If an input has a wrong shape or value, or the work would need too much memory.
    """
    wavelength = check_wavelength(wavelength)
    points = check_positions(positions)
    factors = _check_weights(weights, len(points))
    masks = _check_masks(pupil_masks, len(points))
    if method not in METHODS:
        raise InputError(f"method = {method!r}: it must be one of {', '.join(METHODS)}")
    accuracy = check_accuracy(accuracy)
    report = progress or (lambda done, total: None)
    if method == "full_field":
        if masks is not None:
            raise InputError("pupil_masks: method 'full_field' knows none, use 'patch'")
        image = _sum_full_fields(camera, points, factors, wavelength, report)
    else:
        work = _PatchSum(camera, points, factors, masks, wavelength, accuracy)
        image = work.run(_threads(threads), report)
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


def estimate_cost(
    camera: PlenopticCamera,
    positions: Any,
    *,
    wavelength: float,
    accuracy: float = DEFAULT_ACCURACY,
    pupil_masks: Any = None,
    threads: int | None = None,
) -> Cost:
    """Estimate what `incoherent_sum` by patches will take, by doing a little of it.

    Parameters
    ----------
    camera, positions, wavelength, accuracy, pupil_masks, threads
        As for `incoherent_sum`.

    Returns
    -------
    Cost

    Raises
    ------
    InputError
        If an input has a wrong shape or value, or the work would need too much memory.
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
    return work.cost(_threads(threads))


def _threads(threads: int | None) -> int:
    """Threads that transform: all cores, or one to give a CUDA device its work."""
    return 1 if backend().is_cuda else threads or worker_count()


def _check_weights(weights: Any, count: int) -> NDArray[np.float64]:
    factors = np.asarray(weights, np.float64)
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


def _sum_full_fields(
    camera: PlenopticCamera,
    points: NDArray[np.float64],
    factors: NDArray[np.float64],
    wavelength: float,
    report: Progress,
) -> NDArray[np.float32]:
    image = np.zeros((*camera.shape, factors.shape[1]), np.float32)
    for done, (point, factor) in enumerate(zip(points, factors, strict=True), 1):
        if factor.any():
            psf = full_field(camera, point, wavelength)
            for channel, weight in enumerate(factor):
                image[..., channel] += np.float32(weight) * psf
        report(done, len(points))
    return image


@dataclass(frozen=True)
class _Box:
    """A rectangle of the grid: first sample and size, along x and y."""

    left: int
    top: int
    columns: int
    rows: int

    @classmethod
    def between(cls, low: NDArray[np.int64], high: NDArray[np.int64]) -> _Box:
        """Make the rectangle of two corners, the second one outside."""
        return cls(*(int(number) for number in (*low, *(high - low))))


@dataclass(frozen=True)
class _Window:
    """The part of the detector that is computed: its pixels, and the samples that they feel."""

    pixels: _Box
    samples: _Box


class _PatchSum:
    """Radiators gathered into patterns, and patterns into chunks of one patch size and neighbourhood.

    Each chunk is added into a tile of its own, in the order of its patterns, and the tiles into the image in the
    order of the chunks: so the result does not depend on which thread does what.
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
        self.camera, self.total, self.masks = camera, len(points), masks
        lit = np.flatnonzero(factors.any(1))
        self.grid = Grid.of(camera, wavelength, band_for(accuracy, len(points)), points)
        step = wavefront_step(accuracy, camera, points[lit])
        patterns = find_patterns(camera, points[lit], None if masks is None else masks[lit], wavelength, step)
        placement = _place_all(self.grid, patterns.positions)
        shifts = patterns.shift * self.grid.lens_samples
        low = placement.corner[patterns.pattern] + shifts
        high = low + placement.samples[patterns.pattern, None]
        self.window = self._window(low, high)
        box = self.window.samples
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

    def _window(self, low: NDArray[np.int64], high: NDArray[np.int64]) -> _Window:
        """Bound the recorded pixels that patches reach, and the samples that these feel."""
        pitch, p = self.grid.pitch, self.camera.pixel_size
        start = np.array(self.camera.crop_offset)
        stop = start + np.array(self.camera.crop_size)
        if len(low):
            start = np.clip(np.floor(low.min(0) * pitch / p).astype(np.int64) - _EDGE, start, stop)
            stop = np.clip(np.ceil(high.max(0) * pitch / p).astype(np.int64) + _EDGE, start, stop)
        first = np.floor(start * p / pitch).astype(np.int64) - _EDGE
        last = np.ceil(stop * p / pitch).astype(np.int64) + _EDGE
        return _Window(_Box.between(start, stop), _Box.between(first, last))

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
            directions = (self.placement.last[first] - self.placement.first[first]).max() + 2
            size = int(min(_CHUNK, max(1, _CHUNK_BYTES // (8 * directions**2))))
            chunks += [group[start : start + size] for start in range(0, len(group), size)]
        return chunks

    def memory(self, threads: int) -> float:
        """Bytes that `run` takes."""
        channels, box = self.factors.shape[1], self.window.samples
        image = 4.0 * channels * (box.rows * box.columns + 2 * math.prod(self.camera.shape))
        samples = float(self.placement.samples.max(initial=0))
        tile = samples * 4 / 3 + LARGEST_ZONE * self.grid.lens_samples
        return image + (threads + 1) * (4 * channels * tile**2 + 10 * samples**2 + 2 * _CHUNK_BYTES)

    def cost(self, threads: int) -> Cost:
        """Estimate what `run` takes from a few patterns of each patch size."""
        memory = self.memory(threads)
        self._check_memory(memory)
        samples = self.placement.samples
        seconds = 0.0
        with resting_drjit():
            for size in np.unique(samples):
                of_size = [chunk for chunk in self.chunks if samples[chunk[0]] == size]
                some = of_size[len(of_size) // 2][:_TRIAL]
                _sum_batch(*self._prepare(some[:1]))  # compiles the kernels
                backend().synchronize()
                start = time.perf_counter()
                _sum_batch(*self._prepare(some))
                backend().synchronize()
                taken = time.perf_counter() - start
                seconds += taken / len(some) * sum(len(chunk) for chunk in of_size) / threads
        return Cost(len(self.factors), len(samples), seconds, memory)

    def _check_memory(self, memory: float) -> None:
        largest, patterns = int(self.placement.samples.max(initial=0)), len(self.positions)
        what = f"{self.total} radiators by patches of {largest} x {largest} samples"
        check_memory(memory, what)
        each = 8.0 * largest**2
        if patterns > _CHUNK and each > _PATCH_LIMIT:
            raise InputError(
                f"{what}: {patterns} patches, the largest of {each / 2**30:.2f} GiB, {memory / 2**30:.1f} GiB at a "
                f"time; for more than {_CHUNK} patches each may take {_PATCH_LIMIT / 2**30:.2f} GiB"
            )

    def run(self, threads: int, report: Progress) -> NDArray[np.float32]:
        """Add all chunks and integrate over the pixels."""
        self._check_memory(self.memory(threads))
        box, channels = self.window.samples, self.factors.shape[1]
        fine = backend().arrays.zeros((channels, box.rows, box.columns), np.float32)
        done = self.total - len(self.factors)
        report(done, self.total)
        with resting_drjit(), ThreadPoolExecutor(threads) as pool:
            for chunk, (tile, sums) in self._tiles(pool, threads):
                _add(fine, box, tile, sums)
                done += int((self.last - self.first)[chunk].sum())
                report(done, self.total)
        return self._integrate(fine)

    def _integrate(self, fine: NDArray[np.float32]) -> NDArray[np.float32]:
        """Integrate the sum over the recorded pixels."""
        camera, grid, pixels, box = self.camera, self.grid, self.window.pixels, self.window.samples
        image = np.zeros((*camera.shape, len(fine)), np.float32)
        left, top = pixels.left - camera.crop_offset[0], pixels.top - camera.crop_offset[1]
        target = image[top : top + pixels.rows, left : left + pixels.columns]
        for channel, intensity in enumerate(fine):
            target[..., channel] = backend().to_host(
                integrate_pixels(
                    intensity,
                    grid.pitch,
                    (box.left * grid.pitch, box.top * grid.pitch),
                    camera.pixel_size,
                    (pixels.left * camera.pixel_size, pixels.top * camera.pixel_size),
                    (pixels.rows, pixels.columns),
                )
            )
        return np.maximum(image, 0, out=image)

    def _tiles(
        self, pool: ThreadPoolExecutor, threads: int
    ) -> Iterator[tuple[NDArray[np.int64], tuple[_Box, NDArray[np.float32]]]]:
        """Yield the sums of the chunks in their order, computing a few ahead."""
        pending: deque[tuple[NDArray[np.int64], Future[Any]]] = deque()
        for chunk in self.chunks:
            pending.append((chunk, pool.submit(_sum_batch, *self._prepare(chunk))))
            if len(pending) > threads:
                first, future = pending.popleft()
                yield first, future.result()
        while pending:
            first, future = pending.popleft()
            yield first, future.result()

    def _prepare(self, chunk: NDArray[np.int64]) -> tuple[PatchBatch, list[Copies]]:
        """Make the fields of a chunk, scaled by their largest weights, and the weights relative to these."""
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
        batch = PatchBatch(self.grid, _take(self.placement, chunk), self.positions[chunk], amplitudes, masks)
        return batch, copies


def _sum_batch(batch: PatchBatch, copies: list[Copies]) -> tuple[_Box, NDArray[np.float32]]:
    """Add the intensities of a batch into one tile."""
    tile, work = Tile(batch, copies), Workspace(batch)
    for start in range(0, len(copies), batch.together):
        batch.add(start, min(len(copies), start + batch.together), work, tile)
    sums = tile.intensity()
    return _Box(*tile.corner, sums.shape[2], sums.shape[1]), sums


def _add(image: NDArray[np.float32], box: _Box, tile: _Box, sums: NDArray[np.float32]) -> None:
    """Add a tile to the part of the grid that is kept."""
    left, top = max(box.left, tile.left), max(box.top, tile.top)
    right = min(box.left + box.columns, tile.left + tile.columns)
    bottom = min(box.top + box.rows, tile.top + tile.rows)
    if left < right and top < bottom:
        image[:, top - box.top : bottom - box.top, left - box.left : right - box.left] += sums[
            :, top - tile.top : bottom - tile.top, left - tile.left : right - tile.left
        ]


def _place_all(grid: Grid, points: NDArray[np.float64]) -> Placement:
    starts = range(0, max(1, len(points)), _PLACE_BLOCK)
    placements = [place(grid, points[start : start + _PLACE_BLOCK]) for start in starts]
    return Placement(*(np.concatenate([getattr(p, name) for p in placements]) for name in _FIELDS))


def _take(placement: Placement, which: NDArray[Any]) -> Placement:
    return Placement(*(getattr(placement, name)[which] for name in _FIELDS))


_FIELDS = tuple(Placement.__dataclass_fields__)
