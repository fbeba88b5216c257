r"""Responses of photodiodes under lenses of a few wavelengths to pairs of directions, and to rays.

Let :math:`U_s(p)` be the field at the detector of a plane wave with the transverse direction cosines s. It passes the
lenses, which are periodic, and then a medium of index n by its orders without the paraxial approximation:

.. math:: U_s(p) = e^{i k s \cdot p} \sum_m c_m e^{2 \pi i m \cdot p / D_2 + i z k_z(s, m)}, \qquad
          k_z^2 = n^2 k^2 - |k s + 2 \pi m / D_2|^2 .

A photodiode j responds to pairs of directions by :math:`R_j(s, s') = \int_j U_s U_{s'}^* d^2p`. Before the pupil,
incoherent light has the radiance L(s, x) along rays, so that the photodiode records

.. math:: \int\!\!\int L(s, x)\, W_j(s, x)\, d^2s\, d^2x, \qquad W_j(s, x) = \frac{1}{\lambda^2} \int
          O_s(\sigma)\, R_j(s + \sigma/2, s - \sigma/2)\, e^{-i k \sigma \cdot x}\, d^2\sigma,

where :math:`O_s` is 1 if the pupil passes both directions. The function W is real and signed, and its integral over x
is :math:`R_j(s, s)`. It is tabulated over a window of x around the lens, and interpolated linearly in s and x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np
import scipy.fft
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError, refuse_if, short_repr
from ..optics.waves import in_millimetres
from ..runtime.limits import single_threaded_blas
from .lens_kinds import chief_ray_shift
from .optical_system import OpticalSystem, RayPupil
from .sampling import fast_length

_SPREADS, _LEAST_WINDOW = (14.0, 20.0), 5.0
"""Width of the window in diffraction widths of the pupil, at usual and fine accuracy, and in lenses at the least."""

_OVERSAMPLING = 1.4
"""Samples across the window over those that the highest frequency requires."""

_POINTS = 16
"""Gauss-Legendre nodes of a photodiode along each axis."""

_NEGLIGIBLE = 1e-5
"""Energy of a mode of a photodiode, relative to its strongest, below which the mode is left out."""

_FINE, _SUBSAMPLES = 1024, 4
"""Samples of a lens along an axis for its orders; samples of the pupil per step of the table."""

_STEP = 0.03
"""Largest difference of direction cosines between zones of the detector."""

_ALONG = 9
"""Lenses along each axis whose positions over their pixels are compared."""

_MOST_MEMORY = 2**30
"""Bytes of the tables of a camera."""

_RIDGE = 1e-3
"""Relative weight by which table nodes that the pupil hardly covers are held."""


def pixels_per_lens(camera: PlenopticCamera) -> int:
    """Return the count of pixels across a lens; refuse cameras that responses do not describe."""
    for name, refused, rule in (
        ("mla_lattice", camera.mla_lattice != "square", '"square"'),
        ("mla_rotation", camera.mla_rotation != 0, "0"),
        ("mla_pitch", camera.mla_pitches[0] != camera.mla_pitches[1], "a single pitch"),
        ("mla_aperture", camera.mla_aperture != "cell", '"cell"'),
        ("mla_tilt", any(camera.mla_tilt), "0"),
        ("mla_jitter", any(camera.mla_jitter), "0"),
        ("pixel_response", bool(camera.pixel_response), "left out: the responses contain it"),
        ("main_lens", camera.objective is not None, "no objective"),
        ("resolution", any(size % 2 for size in camera.resolution), "even"),
    ):
        if refused:
            value = short_repr(getattr(camera, name))
            raise InputError(f"{name} = {value}: for waves behind lenses of a few wavelengths it must be {rule}")
    count = round(camera.mla_pitch / camera.pixel_size)
    farthest = max(float(np.abs(_offsets(camera, count, axis)).max()) for axis in (0, 1))
    refuse_if(
        count < 1 or farthest > camera.mla_pitch / 2,
        f"mla_pitch = {camera.mla_pitch:g}: lenses of {camera.mla_pitch / camera.pixel_size:.4g} pixels shift by "
        f"{farthest:.3g} mm from their pixels; for waves behind lenses of a few wavelengths a lens must stay within "
        "half a pitch of its own pixels",
    )
    return count


def lens_range(camera: PlenopticCamera, count: int, axis: int) -> tuple[int, int]:
    """Return the first lattice index of the lenses with recorded pixels along an axis, and the index after the last."""
    first = camera.crop_offset[axis] - camera.resolution[axis] // 2
    return first // count, -(-(first + camera.shape[1 - axis]) // count)


def _offsets(camera: PlenopticCamera, count: int, axis: int) -> NDArray[np.float64]:
    """Return the positions of the first and the last lens's pixels relative to the regular position of the lens."""
    index = np.array(lens_range(camera, count, axis)) - [0, 1]
    return (index + 0.5) * (max(count, 1) * camera.pixel_size - camera.mla_pitch) - camera.mla_offset[axis]


def lens_centre(camera: PlenopticCamera, x: Any, y: Any) -> tuple[Any, Any]:
    """Return the positions of lenses, aligned to chief rays, by their lattice indices."""
    centre = camera.lattice.centre(x, y)
    right, up = chief_ray_shift(camera, *centre)
    return centre[0] + right, centre[1] + up


def _aside(camera: PlenopticCamera, count: int, x: Any, y: Any) -> list[Any]:
    """Return the positions of the middles of lenses' pixels relative to the lenses, by lattice indices."""
    width = count * camera.pixel_size
    return [(index + 0.5) * width - c for index, c in zip((x, y), lens_centre(camera, x, y), strict=True)]


@dataclass(frozen=True)
class Zones:
    """Positions of the detector at which responses are tabulated, an even grid over the recorded lenses."""

    # Lattice indices of the lenses at the zones, along x and y.
    x: NDArray[np.float64]
    y: NDArray[np.float64]

    @classmethod
    def of(cls, camera: PlenopticCamera, count: int) -> Zones:
        """Return the zones of a camera with `count` pixels across a lens."""
        made = []
        ranges = [lens_range(camera, count, axis) for axis in (0, 1)]
        aside = _aside(camera, count, *np.meshgrid(*(np.linspace(first, last - 1, _ALONG) for first, last in ranges)))
        for axis, (first, last) in enumerate(ranges):
            moved = np.ptp(aside[axis]) * camera.mla_medium / camera.detector_distance
            turned = (last - 1 - first) * camera.mla_pitch / camera.pupil_distance
            steps = math.ceil(max(moved, turned) / _STEP - 0.2)
            middle = (first + last - 1) / 2
            made.append(np.linspace(first, last - 1, steps + 1) if steps > 0 else np.array([middle]))
        return cls(*made)

    def __len__(self) -> int:
        return len(self.x) * len(self.y)


@dataclass(frozen=True)
class PhotodiodeResponses:
    """The responses of the photodiodes of one lens, one per pixel under it, at one wavelength in all zones."""

    camera: PlenopticCamera
    # Wavelength in nanometres, and the shortest one of the capture, which has the smallest windows.
    wavelength: float
    shortest: float
    # Whether the tables have larger windows.
    fine: bool = False

    by_points = False

    @cached_property
    def system(self) -> OpticalSystem:
        """The camera, bound to the wavelength; light up to the array follows the camera's own model of the lens."""
        return OpticalSystem(self.camera, self.wavelength, self.camera.lens_model)

    @cached_property
    def count(self) -> int:
        """Count of pixels across a lens."""
        return pixels_per_lens(self.camera)

    @cached_property
    def zones(self) -> Zones:
        """The zones of the detector."""
        return Zones.of(self.camera, self.count)

    @property
    def reach(self) -> float:
        """Largest difference of the direction cosines of the pupil's light from that of its centre."""
        return float(self.system.lens.reach) / math.hypot(self.camera.pupil_distance, self.system.lens.reach)

    @property
    def _spreads(self) -> float:
        """Width of the window in diffraction widths, the same at all wavelengths."""
        width = in_millimetres(self.shortest) / (2 * self.reach)
        return max(_SPREADS[self.fine], _LEAST_WINDOW * self.camera.mla_pitch / width)

    @property
    def window(self) -> float:
        """Width of the window."""
        return self._spreads * in_millimetres(self.wavelength) / (2 * self.reach)

    @property
    def step(self) -> float:
        """Step of the table's direction cosines: half of that of the differences of pairs."""
        return self.reach / self._spreads

    @property
    def across(self) -> int:
        """Nodes of the table from its middle to its edge in direction cosines."""
        return math.ceil(self._spreads) + 1

    @property
    def _pairs(self) -> int:
        """Differences of pairs from zero to the largest."""
        return math.floor(self._spreads) + 1

    @property
    def samples(self) -> int:
        """Samples across the window."""
        return fast_length(math.ceil(_OVERSAMPLING * (2 * self._pairs + 1)))

    @property
    def tail(self) -> float:
        """Fraction of the light that the pupil diffracts beyond the window: see `tail_density`."""
        width = in_millimetres(self.wavelength) / (2 * self.reach)
        return width / self.window * 16 * math.sqrt(0.5) / math.pi**3

    @property
    def tail_density(self) -> float:
        """Density of this light times the third power of the distance.

        This is the Airy pattern's mean over its rings (Born and Wolf, section 8.5.2).
        """
        return in_millimetres(self.wavelength) / (2 * self.reach) / math.pi**3

    @property
    def nbytes(self) -> float:
        """Approximate bytes of the tables."""
        return 4.0 * len(self.zones) * math.pi * self.across**2 * self.samples**2 * (self.count**2 + 1)

    def require_memory(self, wavelengths: int) -> None:
        """Refuse tables that are too large."""
        memory = wavelengths * self.nbytes
        refuse_if(
            memory > _MOST_MEMORY,
            f"mla_pitch = {self.camera.mla_pitch:g}: tables of {memory / 2**30:.2g} GiB for {len(self.zones)} zones of "
            f"the detector and {wavelengths} wavelengths: at most 1 GiB; record a smaller window (crop_size)",
        )

    @cached_property
    def table(self) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
        """The table of W, less the light beyond the window, which is evenly spread over it.

        Returns the index of each node of the square grid of direction cosines (n, n), rows along y, -1 where it is not
        used; the table (zones, nodes, samples * samples, photodiodes) and the mean over the pupil of its integral and
        that of the light beyond the window (zones, photodiodes). Coordinates x are relative to the lens.
        """
        used = np.zeros((2 * self.across + 1,) * 2, bool)
        overlaps = [self._overlap(x, y) for y in self.zones.y for x in self.zones.x]
        for mass, _ in overlaps:
            used |= mass > 0
        index = np.where(used, np.cumsum(used).reshape(used.shape) - 1, -1).astype(np.int32)
        table = np.empty((len(self.zones), used.sum(), self.samples**2, self.count**2), np.float32)
        means = np.empty((len(self.zones), self.count**2), np.float32)
        for number, (mass, overlap) in enumerate(overlaps):
            y, x = divmod(number, len(self.zones.x))
            for diode in range(self.count**2):
                values = self._response(self.zones.x[x], self.zones.y[y], diode, overlap, used)
                whole = values.sum(1) * (self.window / self.samples) ** 2
                table[number, :, :, diode] = values - self.tail / self.window**2 * whole[:, None]
                means[number, diode] = whole @ mass[used] / mass.sum()
        return index, table, means

    def by_direction(self, x: float, y: float) -> NDArray[np.float64]:
        """Return the light of plane waves in the photodiodes of a lens (photodiodes, n, n), rows along y.

        The direction cosines lie `step` apart around that of the chief ray; light of density 1 is its area in mm^2.
        """
        every = [self._modes(x, y, diode) for diode in range(self.count**2)]
        return np.stack([(np.abs(modes) ** 2).sum(0, dtype=np.float64) for modes in every])

    @cached_property
    def _orders(self) -> tuple[NDArray[np.int64], NDArray[np.complex128]]:
        """Orders of the lenses along an axis, and the amplitudes (orders along y, orders along x)."""
        camera, wavelength = self.camera, in_millimetres(self.wavelength)
        most = math.ceil(camera.mla_medium * camera.mla_pitch / wavelength) + 2
        order = np.arange(-most, most + 1)
        x = ((np.arange(_FINE) + 0.5) / _FINE - 0.5) * camera.mla_pitch
        waves = np.exp(-2j * math.pi * np.outer(order, x) / camera.mla_pitch)
        waves *= (np.abs(x) <= camera.mla_fill * camera.mla_pitch / 2) / _FINE
        if camera.mla_shape is None:
            lens = np.exp(-1j * math.pi * camera.mla_medium * x**2 / (wavelength * camera.mla_focal_length))
            along = waves @ lens
            return order, np.outer(along, along)
        phase = camera.mla_shape.waves(x, x[:, None], self.wavelength)
        return order, waves @ np.exp(2j * math.pi * phase) @ waves.T

    def _place(self, x: float, y: float) -> list[float]:
        """Return the position of a lens."""
        return [float(c) for c in lens_centre(self.camera, x, y)]

    def _chief(self, x: float, y: float) -> list[float]:
        """Return the direction cosines of the light from the pupil's centre at a lens."""
        slope = [-float(self.system.lens.slope_to(0.0, place)) for place in self._place(x, y)]
        return [each / math.sqrt(1 + slope[0] ** 2 + slope[1] ** 2) for each in slope]

    def _is_open(self, x: float, y: float, along: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which pairs of direction cosines `along` the axes, from the chief ray's, pass the pupil to a lens."""
        chief, place = self._chief(x, y), self._place(x, y)
        sy, sx = np.meshgrid(chief[1] + along, chief[0] + along, indexing="ij")
        cosine = np.sqrt(np.maximum(1 - sx**2 - sy**2, 1e-6))
        lens = self.system.lens
        pupil = tuple(mi.Float(lens.pupil_point(c, -s / cosine).ravel()) for c, s in zip(place, (sx, sy), strict=True))
        inner = RayPupil(self.system).inner(pupil, tuple(mi.Float(c) for c in place))
        square = sum(part.numpy().astype(float) ** 2 for part in inner)
        return np.asarray(square <= self.camera.pupil_radius**2).reshape(sx.shape)

    @single_threaded_blas()
    def _overlap(self, x: float, y: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        """Return the part of the pupil around each node (n, n), and coefficients of O for each (n, n, pairs, pairs).

        The coefficients are the projection of O on functions that are linear between nodes.
        """
        n, pairs = 2 * self.across + 1, self._pairs
        far = (self.across + pairs) * _SUBSAMPLES
        along = (np.arange(-far, far) + 0.5) / _SUBSAMPLES
        is_open = self._is_open(x, y, along * self.step)
        low = far - self.across * _SUBSAMPLES
        rows, columns = np.nonzero(is_open[low : 2 * far - low, low : 2 * far - low])
        rows, columns = rows + low, columns + low
        sides = [np.floor(along[each]).astype(int) for each in (rows, columns)]
        parts = [along[each] - side for each, side in zip((rows, columns), sides, strict=True)]
        count = np.arange(len(rows))
        hats = scipy.sparse.csr_matrix((len(rows), n * n))
        for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
            node = (sides[0] + dy + self.across) * n + sides[1] + dx + self.across
            value = np.abs(1 - dy - parts[0]) * np.abs(1 - dx - parts[1])
            hats += scipy.sparse.csr_matrix((value, (count, node)), hats.shape)
        mass = np.asarray(hats.sum(0)).ravel()
        used = np.flatnonzero(mass > 0)
        hats = hats[:, used]
        gram = (hats.T @ hats).toarray()
        gram[np.diag_indices_from(gram)] += _RIDGE * mass[used]
        factor = scipy.linalg.cho_factor(gram)
        lags = np.arange(-pairs, pairs + 1) * _SUBSAMPLES
        overlap = np.zeros((n * n, len(lags), len(lags)), np.float32)
        for number, lag in enumerate(lags):
            up, down = (is_open[rows + side * lag] for side in (1, -1))
            each = np.arange(len(rows))
            both = [up[each, columns + across] & down[each, columns - across] for across in lags]
            moments = hats.T @ np.stack(both, 1).astype(np.float32)
            # The ridge holds coefficients to their local means, so that energy is conserved.
            overlap[used, number] = scipy.linalg.cho_solve(factor, (1 + _RIDGE) * moments)
        return mass.reshape(n, n), overlap.reshape(n, n, len(lags), len(lags))

    @single_threaded_blas()
    def _modes(self, x: float, y: float, diode: int) -> NDArray[np.complex64]:
        """Return functions of the direction cosines (modes, n, n) whose products sum to the response to pairs."""
        camera, k = self.camera, 2 * math.pi / in_millimetres(self.wavelength)
        pixel, z, index = camera.pixel_size, camera.detector_distance, camera.mla_medium
        order, amplitude = self._orders
        # Of the complex wave number in the medium; its imaginary part, which absorbs, is small.
        square = (index * k) ** 2 + 1j * index * k * camera.mla_absorption
        far = self.across + 3
        # Index x, y of a lens give its pixels' displacement.
        shift = _aside(camera, self.count, x, y)
        nodes, weights = np.polynomial.legendre.leggauss(_POINTS)
        row, column = divmod(diode, self.count)
        py, px = (
            ((nodes + 1) / 2 + number - self.count / 2) * pixel + s
            for number, s in ((row, shift[1]), (column, shift[0]))
        )
        sx, sy = (chief + np.arange(-far, far + 1) * self.step for chief in self._chief(x, y))
        waves_x, waves_y = (np.exp(2j * math.pi * np.outer(order, p) / camera.mla_pitch) for p in (px, py))
        kx, ky = (k * s[:, None] + 2 * math.pi * order / camera.mla_pitch for s in (sx, sy))
        fields = np.empty((len(sy), len(sx), _POINTS**2), np.complex64)
        for number, each in enumerate(ky):
            kz = np.sqrt(square - each[:, None] ** 2 - kx[:, None, :] ** 2)
            part = (amplitude * np.exp(1j * z * kz)) @ waves_x  # (x, order along y, point along x)
            field = np.matmul(waves_y.T, part)
            field *= np.exp(1j * k * (sy[number] * py[None, :, None] + sx[:, None, None] * px))
            fields[number] = field.reshape(len(sx), -1)
        fields *= np.sqrt(np.outer(weights, weights).ravel() * pixel**2 / 4).astype(np.float32)
        flat = fields.reshape(-1, _POINTS**2)
        energy, vectors = np.linalg.eigh(flat.conj().T @ flat)
        modes = flat @ vectors[:, energy > _NEGLIGIBLE * energy[-1]]
        return np.ascontiguousarray(modes.T.reshape(-1, len(sy), len(sx)))

    def _response(
        self, x: float, y: float, diode: int, overlap: NDArray[np.float32], used: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """Return W of a photodiode at the used nodes: (nodes, samples * samples)."""
        modes, inner = self._modes(x, y, diode), self.across + 1
        far, lags = self.across + 3, range(-self._pairs, self._pairs + 1)
        pairs = np.zeros((2 * inner + 1, 2 * inner + 1, len(lags), len(lags)), np.complex64)
        for a, up in enumerate(lags):
            for b, right in enumerate(lags):
                if (up, right) < (0, 0):
                    continue
                rows, columns = min(inner, far - abs(up)), min(inner, far - abs(right))
                one, other = (
                    modes[
                        :,
                        far + side * up - rows : far + side * up + rows + 1,
                        far + side * right - columns : far + side * right + columns + 1,
                    ]
                    for side in (1, -1)
                )
                value = np.einsum("ryx,ryx->yx", one, other.conj())
                at = slice(inner - rows, inner + rows + 1), slice(inner - columns, inner + columns + 1)
                pairs[(*at, a, b)] = value
                pairs[(*at, -1 - a, -1 - b)] = value.conj()
        # Sharpened against the damping by linear interpolation in s, and below by that in x.
        pairs = pairs[1:-1] - (pairs[2:] - 2 * pairs[1:-1] + pairs[:-2]) / 12
        pairs = pairs[:, 1:-1] - (pairs[:, 2:] - 2 * pairs[:, 1:-1] + pairs[:, :-2]) / 12
        lag = np.array(lags)
        gain = (np.sinc(lag / self.samples) ** -2).astype(np.float32)
        pairs *= overlap * (gain[:, None] * gain / np.float32(self.window**2))
        wide = np.zeros((int(used.sum()), self.samples, self.samples), np.complex64)
        wide[:, (lag % self.samples)[:, None], lag % self.samples] = pairs[used]
        return scipy.fft.fftshift(scipy.fft.fft2(wide).real, axes=(1, 2)).reshape(len(wide), -1)
