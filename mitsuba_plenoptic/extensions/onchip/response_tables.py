"""Tables of the response W of photodiodes to rays, by the direction s and the array point x of a ray.

W extends as far over the array as the pupil diffracts light. Near the lens W is tabulated finely. Light farther away is
diffracted by the rim of the pupil, mostly from rays near the rim; in a blurred image it makes the fringes and the light
beyond the blur. A far table with two samples per lens contains it; light beyond the table's window is folded back into
it. Both tables have the same directions. See `plane_waves` for W.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.sparse
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from ...camera import PlenopticCamera
from ...errors import refuse_if
from ...runtime import Doubles, Flags, Floats, Integers, single_threaded_blas, unit_hint
from .plane_waves import NEAR, PlaneWaveResponses, displacement

_FAR = (25, 44)
"""Least and greatest width of the far window in lenses."""

_RIDGE = 1e-3
"""Relative weight by which table nodes that the pupil hardly covers are held."""

_REVERSED = slice(None, None, -1)


class TableWindow(NamedTuple):
    """A window of the array in cells of one lens each, which are divided evenly into samples."""

    lenses: int
    # Samples per lens, which is an even number.
    samples: int
    # Count of direction pairs, from equal directions to the largest difference. Neighbouring pairs differ by `stride`
    # steps of the nodes, divided by `finer`.
    pairs: int
    stride: int
    finer: int

    @property
    def first(self) -> int:
        """Index of the first cell, relative to the lens."""
        return -(self.lenses // 2)

    @property
    def across(self) -> int:
        """Number of samples across the window, both edges included."""
        return self.lenses * self.samples + 1

    @property
    def place(self) -> Doubles:
        """Positions of the samples in lenses."""
        return self.first - 0.5 + np.arange(self.across) / self.samples

    @property
    def mirrored(self) -> Integers:
        """Indices of the samples at the mirrored positions; a window of an even number of lenses is periodic."""
        index = np.arange(self.across)
        return self.across - 1 - index if self.lenses % 2 else (self.samples - index) % (self.across - 1)


class ResponseTable(NamedTuple):
    """Tables of the response W for all zones."""

    # Index of each node of the square grid of direction cosines (n, n), rows along y, -1 where it is not used.
    nodes: NDArray[np.int32]
    # Values (zones, nodes, y, x, photodiodes) within the near and the far window. Those of the far window also continue
    # below the near one, where they are not used.
    near: NDArray[np.float16]
    far: NDArray[np.float16]
    # Means of the integral of W over the pupil (zones, photodiodes).
    means: Floats


class PhotodiodeResponses(PlaneWaveResponses):
    """The responses of the photodiodes of one lens to rays, at one wavelength in all zones."""

    def __init__(self, camera: PlenopticCamera, wavelength: float, *, fine: bool = False):
        super().__init__(camera, wavelength, fine=fine)
        # Samples across a window over those that its highest frequency requires.
        oversampling = 1.4
        # 5 x 5 lenses, finely sampled.
        pairs = math.floor(self.reach / (self.step * self.stride)) + 1
        self.near = TableWindow(NEAR, 2 * math.ceil(oversampling * (2 * pairs + 1) / (2 * NEAR)), pairs, self.stride, 1)
        # 25 lenses or more, of two samples a lens, with pairs up to the largest difference that these resolve.
        # Between the limits it is 28 diffraction widths wide.
        lenses = min(max(28.0 * self.width, _FAR[0]), _FAR[1])
        finer = max(1, math.ceil(lenses / (NEAR * self.stride) - 0.3))
        across = NEAR * self.stride * finer
        resolved = math.floor(((2 * across + 1) / oversampling - 1) / 2)
        pairs = min(resolved, math.floor(self.reach * finer / self.step) + 1)
        self.far = TableWindow(across, 2, pairs, 1, finer)
        # Approximate bytes of the tables.
        samples = self.near.across**2 + self.far.across**2
        self.nbytes = 2.0 * len(self.zones) * math.pi * self.across**2 * samples * self.count**2

    def require_memory(self, wavelengths: int) -> None:
        """Refuse tables that would exceed the limit of memory."""
        memory = wavelengths * self.nbytes
        most = 2.0**30
        refuse_if(
            memory > most,
            f"mla_pitch = {self.camera.row_pitch:g}: tables of {memory / 2**30:.2g} GiB for {len(self.zones)} zones of "
            f"the detector and {wavelengths} wavelengths: at most 1 GiB; record a smaller window (crop_size)"
            + unit_hint(memory, most),
        )

    @cached_property
    def table(self) -> ResponseTable:
        """Tables of the response W, with x in units of a lens."""
        zones = [(x, y) for y in self.zones.y for x in self.zones.x]
        windows = self.near, self.far
        pupils = [_Pupil(self, x, y, self.far.finer) for x, y in zones]
        lit = np.any([pupil.mass > 0 for pupil in pupils], axis=0)
        index = np.where(lit, np.cumsum(lit).reshape(lit.shape) - 1, -1).astype(np.int32)
        near, far = (
            np.empty((len(zones), int(lit.sum()), window.across, window.across, self.count**2), np.float16)
            for window in windows
        )
        means = np.empty((len(zones), self.count**2), np.float32)
        fold, interpolation = _fold(*windows)
        blurred = _blurred(*windows)
        for zone, ((x, y), pupil) in enumerate(zip(zones, pupils, strict=True)):
            image = self._mirror_image(zone, pupils)
            if image is not None:
                mirrored, flips = image
                nodes = index[flips][lit]
                for table, window in zip((near, far), windows, strict=True):
                    table[zone] = self._mirrored(table[mirrored][nodes], window, flips)
                diodes = np.arange(self.count**2).reshape(self.count, self.count)[flips].ravel()
                means[zone] = means[mirrored][diodes]
                continue
            overlaps = [pupil.overlap(window)[lit] for window in windows]
            for diode in range(self.count**2):
                modes = self.modes(x, y, diode)
                close, wide = (
                    self._response(modes, window, overlap, lit)
                    for window, overlap in zip(windows, overlaps, strict=True)
                )
                total = close[:, 1:, 1:].sum((1, 2)) / self.near.samples**2
                # The far samples do not resolve the light within the near window, so that some of it appears beyond.
                core = close - fold @ wide @ fold.T + interpolation @ wide @ interpolation.T
                wide -= blurred @ core @ blurred.T
                # The light from beyond the near window is folded into it.
                close -= fold @ wide @ fold.T - interpolation @ wide @ interpolation.T
                near[zone, ..., diode] = close
                far[zone, ..., diode] = wide
                means[zone, diode] = total @ pupil.light[lit] / pupil.light.sum()
        return ResponseTable(index, near, far, means)

    def _mirror_image(self, zone: int, pupils: Sequence[_Pupil]) -> tuple[int, tuple[slice, ...]] | None:
        """Return an earlier zone that is a mirror image of a zone, and the slices that flip rows and columns."""
        columns = len(self.zones.x)
        row, column = divmod(zone, columns)
        _, amplitude = self._orders
        # Largest relative difference that mirror images may have.
        alike = 1e-6
        for flips in itertools.product((slice(None), _REVERSED), repeat=2):
            mirrored = list(range(len(self.zones.y)))[flips[0]][row] * columns + list(range(columns))[flips[1]][column]
            signs = [-1 if flip == _REVERSED else 1 for flip in reversed(flips)]
            if (
                mirrored < zone
                and np.array_equal(pupils[mirrored].is_open[flips], pupils[zone].is_open)
                and np.allclose(amplitude[flips], amplitude, rtol=0, atol=alike)
                and np.allclose(self._displacement(mirrored) * signs, self._displacement(zone), rtol=0, atol=alike)
            ):
                return mirrored, flips
        return None

    def _displacement(self, zone: int) -> Doubles:
        """Return the displacement x, y, in lenses, of the pixels under a zone's lens from the lens's centre."""
        row, column = divmod(zone, len(self.zones.x))
        position = self.zones.x[column], self.zones.y[row]
        return np.array(displacement(self.camera, self.count, *position)) / self.camera.row_pitch

    def _mirrored(
        self, values: NDArray[np.float16], window: TableWindow, flips: tuple[slice, ...]
    ) -> NDArray[np.float16]:
        """Return values (nodes, y, x, photodiodes) of a window, mirrored along the flipped axes."""
        for axis, flip in enumerate(flips, 1):
            if flip == _REVERSED:
                values = np.take(values, window.mirrored, axis)
        diodes = values.reshape(*values.shape[:3], self.count, self.count)
        return diodes[..., flips[0], flips[1]].reshape(values.shape)

    def _response(self, modes: NDArray[np.complex64], window: TableWindow, overlap: Floats, lit: Flags) -> Floats:
        """Return the response W of a photodiode at the used nodes, (nodes, y, x), in a window."""
        _, _, pairs, stride, finer = window
        inner = self.across + 1
        known = modes.shape[1] // 2
        half = inner * finer + pairs * stride
        between = np.arange(-known * finer, known * finer + 1) / finer
        spline = make_interp_spline(np.arange(-known, known + 1), np.eye(2 * known + 1))(between).astype(np.float32)
        modes = spline @ modes @ spline.T if finer > 1 else modes
        # Directions farther outside the pupil are not needed.
        beyond = max(0, half - known * finer)
        modes = np.pad(modes, ((0, 0), (beyond, beyond), (beyond, beyond)))
        middle = known * finer + beyond
        lags = np.arange(-pairs, pairs + 1)
        products = np.zeros((2 * inner + 1, 2 * inner + 1, len(lags), len(lags)), np.complex64)
        conjugate = modes.conj()
        # Nodes at which both directions of a pair can pass the pupil.
        halves = np.minimum(inner, inner + 1 - np.abs(lags) * stride // finer)
        for a, b in itertools.product(range(len(lags)), repeat=2):
            if (a, b) < (pairs, pairs):
                continue
            at = tuple(slice(inner - halves[lag], inner + halves[lag] + 1) for lag in (a, b))
            ends = [
                [
                    slice(middle - halves[lag] * finer + shift, middle + halves[lag] * finer + shift + 1, finer)
                    for lag, shift in ((a, side * lags[a] * stride), (b, side * lags[b] * stride))
                ]
                for side in (1, -1)
            ]
            value = np.einsum("ryx,ryx->yx", modes[:, ends[0][0], ends[0][1]], conjugate[:, ends[1][0], ends[1][1]])
            products[at[0], at[1], a, b] = value
            products[at[0], at[1], -1 - a, -1 - b] = value.conj()
        # Sharpened against the damping by linear interpolation in s, and below by that in x.
        products = products[1:-1] - (products[2:] - 2 * products[1:-1] + products[:-2]) / 12
        products = products[:, 1:-1] - (products[:, 2:] - 2 * products[:, 1:-1] + products[:, :-2]) / 12
        size = window.across - 1
        gain = (np.sinc(lags / size) ** -2).astype(np.float32)
        chosen = (
            products[lit] * overlap * (gain[:, None] * gain / np.float32((window.lenses * self.camera.row_pitch) ** 2))
        )
        wide = np.zeros((len(chosen), size, size), np.complex64)
        wide[:, (lags % size)[:, None], lags % size] = chosen
        values = scipy.fft.fft2(wide).real
        index = np.round(window.place * window.samples).astype(int) % size
        return np.ascontiguousarray(values[:, index[:, None], index])


class _Pupil:
    """The pupil as seen from a lens, sampled in direction cosines."""

    def __init__(self, plan: PlaneWaveResponses, x: float, y: float, multiple: int):
        """Take a lens's lattice indices, and the number of which samples per step of direction are a multiple."""
        n = 2 * plan.across + 1
        # 4: Least count of samples of the pupil per step of the table.
        self.step = multiple * math.ceil(4 / multiple)
        far = (2 * plan.across + plan.stride) * self.step
        along = (np.arange(-far, far) + 0.5) / self.step
        self.is_open = plan.is_open(x, y, along * plan.step)
        low = far - plan.across * self.step
        # Rows and columns of the open samples, and their values of the functions that are linear between nodes.
        self._places = [low + index for index in np.nonzero(self.is_open[low : 2 * far - low, low : 2 * far - low])]
        sides = [np.floor(along[index]).astype(int) for index in self._places]
        fractions = [along[index] - side for index, side in zip(self._places, sides, strict=True)]
        count = np.arange(len(sides[0]))
        hats = scipy.sparse.csr_matrix((len(count), n * n))
        for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
            node = (sides[0] + dy + plan.across) * n + sides[1] + dx + plan.across
            value = np.abs(1 - dy - fractions[0]) * np.abs(1 - dx - fractions[1])
            hats += scipy.sparse.csr_matrix((value, (count, node)), hats.shape)
        self._hats = hats
        # Parts around each node (n, n): of the pupil's direction cosines, and of its area, over which rays are even.
        self.mass = (hats.T @ np.ones(len(count))).reshape(n, n)
        chief = plan.chief(x, y)
        square = sum((c + plan.step * along[index]) ** 2 for c, index in zip(chief, self._places[::-1], strict=True))
        self.light = (hats.T @ (1 - square) ** -2).reshape(n, n)

    @cached_property
    def _solve(self) -> scipy.sparse.linalg.SuperLU:
        """Factors of the matrix of the least-squares projection on the functions of the open nodes."""
        mass = self.mass.ravel()
        # The ridge holds coefficients to their local means; nodes that are not open have none.
        return scipy.sparse.linalg.splu(
            (self._hats.T @ self._hats + scipy.sparse.diags(np.where(mass > 0, _RIDGE * mass, 1.0))).tocsc()
        )

    @single_threaded_blas()
    def overlap(self, window: TableWindow) -> Floats:
        """Return coefficients of O for each node and pair of a window, (n, n, lags, lags).

        The coefficients are the projection of O on functions that are linear between nodes.
        """
        n = len(self.mass)
        # Half differences in samples.
        lags = np.arange(-window.pairs, window.pairs + 1) * (self.step * window.stride // window.finer)
        rows, columns = self._places
        samples = np.arange(len(rows))
        result = np.zeros((n * n, len(lags), len(lags)), np.float32)
        for index, lag in enumerate(lags):
            up, down = (self.is_open[rows + side * lag] for side in (1, -1))
            both = [up[samples, columns + across] & down[samples, columns - across] for across in lags]
            moments = self._hats.T @ np.stack(both, 1).astype(np.float32)
            # The factor conserves energy against the ridge.
            result[:, index] = self._solve.solve(np.asarray(moments)) * (1 + _RIDGE)
        return result.reshape(n, n, len(lags), len(lags))


def _fold(near: TableWindow, far: TableWindow) -> tuple[Floats, Floats]:
    """Return the matrices that fold and that interpolate far-window samples to near ones, (near.across, far.across)."""
    size = far.across - 1

    def interpolated(positions: Doubles) -> Doubles:
        at = ((positions - far.place[0]) * far.samples) % size
        low = np.floor(at).astype(int)
        result = np.zeros((len(positions), far.across))
        result[np.arange(len(positions)), low] = 1 - at + low
        result[np.arange(len(positions)), low + 1] += at - low
        return result

    once = interpolated(near.place)
    periods = range(0, far.lenses, near.lenses)
    folded = np.sum([interpolated(near.place + period) for period in periods], axis=0)
    return folded.astype(np.float32), once.astype(np.float32)


def _blurred(near: TableWindow, far: TableWindow) -> Floats:
    """Return the matrix that lowers samples within the near window to the resolution of the far window."""
    lag = np.arange(-far.pairs, far.pairs + 1)
    gain = (np.sinc(lag / (far.lenses * near.samples)) / np.sinc(lag / (far.lenses * far.samples))) ** 2
    far_waves, near_waves = (np.exp(2j * np.pi / far.lenses * np.outer(window.place, lag)) for window in (far, near))
    weights = np.full(near.across, 1 / near.samples)
    weights[[0, -1]] /= 2
    return np.asarray((far_waves * (gain / far.lenses) @ near_waves.conj().T).real * weights, np.float32)
