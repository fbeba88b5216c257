r"""Refocusing one lens at a time: the limit of partial coherence, where no two lenses interfere.

The light of a single microlens covers the whole main lens, but comes from one cell of the MLA and goes to a few bins
of the object plane. Between these two small patches a Fourier transform each way across the pupil does what full
fields would. With c the centre of the cell, :math:`X_0 = -c g / b` that of its image, and offsets :math:`\mu`,
:math:`\xi` from them,

.. math:: U(X_0 + \xi) = \frac{dP^2 d\mu^2}{\lambda^2 b g} \sum_P e^{-i k P \cdot \xi / g} \,
          e^{i k (|P - c| + |P - X_0| - P^2 / 2 f_1)} \sum_\mu e^{-i k (P - c) \cdot \mu / b} \,
          e^{i k \mu^2 / 2 b} \, u(c + \mu)

The phase between the centres is exact and carries the aberrations; the terms linear in the offsets are paraxial
(Goodman, "Introduction to Fourier Optics", section 5.3), and the one quadratic in :math:`\xi` drops out of the
intensity. The pupil is sampled as finely as the object patch is wide.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import numpy as np

from .. import lattice, rays
from .._backend import backend
from ..camera import MOST_PIXELS, PlenopticCamera
from ..errors import InputError
from ..propagation import guards
from ..propagation.angular_spectrum import advance
from ..propagation.fft import Field, as_field, as_words, fft, fft2, pack, resting_drjit, unpack
from ..propagation.sampling import check_memory, fast_length, in_millimetres, pupil_turns
from ._elements import converging_phase, detector_lens, lens_phase
from ._plan import GUARD, field_subsamples

# Samples that are transformed together, on the processor and on a CUDA device.
_BATCH_SAMPLES, _CUDA_BATCH_SAMPLES = 2**20, 2**25

_THROUGHPUT_LENSES = 25

_MARGIN = 4.5
"""Bins around the geometric image: more than full fields need, as the pupil's edge is softened over one sample."""


def reconstruct_lens_by_lens(
    image: np.ndarray,
    camera: PlenopticCamera,
    distances: Sequence[float],
    wavelength: float,
    *,
    relay: bool = True,
    oversample: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> list[np.ndarray]:
    """Propagate every lens alone and add the intensities.

    Parameters
    ----------
    image : (rows, columns) float32 array
        The capture, not negative.
    camera : PlenopticCamera
        The camera; its recorded window is the image. Lenses are thin parabolic phase elements.
    distances : sequence of floats
        Object distances, which share the way up to the main lens.
    wavelength : float
        Wavelength in nanometres.
    relay : bool
        Whether the microlenses act in the MLA plane.
    oversample : int
        Bins per lens along each axis.
    progress : callable
        Called with the share of the work done.

    Returns
    -------
    list of (rows, columns) float64 arrays
        Power in each bin, in pixel values times pixels.
    """
    tile = Tile(camera, wavelength, tile_lenses(camera, distances), oversample)
    check_memory(tile.memory, "wave reconstruction lens by lens")
    x, y = (LensAxis(camera, wavelength, tile, axis) for axis in (0, 1))
    lenses = _lit_lenses(image, x, y)
    libraries = backend()
    amplitude = libraries.arrays.sqrt(libraries.arrays.asarray(image))
    # Every lens puts its patch among the bins of all lenses, and a margin for those at the edge.
    shape = [(axis.index.size + tile.lenses - 1) * oversample for axis in (y, x)]
    totals = [libraries.arrays.zeros(shape) for _ in distances]
    in_rim = [0.0 for _ in distances]
    for place in range(0, len(lenses), tile.batch):
        batch = lenses[place : place + tile.batch]
        fields = pupil_fields(amplitude, tile, x, y, batch, relay=relay)
        for index, (total, distance) in enumerate(zip(totals, distances, strict=True)):
            patches = _patches(fields, tile, x, y, batch, distance)
            inner = patches[:, oversample:-oversample, oversample:-oversample]
            in_rim[index] += float(patches.sum(dtype=np.float64) - inner.sum(dtype=np.float64))
            for (row, column), patch in zip(batch, patches, strict=True):
                top, left = row * oversample, column * oversample
                total[top : top + patch.shape[0], left : left + patch.shape[1]] += patch
        progress((place + len(batch)) / len(lenses))
    if len(lenses):
        guards.judge(guards.PUPIL, 1 - float(totals[0].sum()) / float(image.sum(dtype=np.float64)))
    for total, rim in zip(totals, in_rim, strict=True):
        guards.judge(guards.OBJECT, guards.share(rim, float(total.sum())))
    return [_on_bins(total, camera, tile, x, y) for total in totals]


@functools.lru_cache(maxsize=16)
def white_throughput(camera: PlenopticCamera, wavelength: float, *, relay: bool = True) -> float:
    """Share of a white micro-image's power that comes back through the main lens.

    Its edge is one of the pupil, where light diffracts out: 7 % for the paper's camera. Divided by this, a capture
    of a white scene reads 1.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    relay : bool
        Whether the microlenses act in the MLA plane.
    """
    # The micro-image of the lens beside the axis, in the four lenses around that. A smaller detector than those does
    # not change what comes back of it.
    around = math.ceil(2 * camera.micro_image_pitch / camera.pixel_size)
    if around > MOST_PIXELS // 2:
        raise InputError(
            f"mla_pitch = {camera.mla_pitch:g}: a micro-image of {around // 2} pixels is too wide for waves"
        )
    whole = (max(camera.resolution[0], 2 * around), max(camera.resolution[1], 2 * around))
    camera = camera.replace(
        resolution=whole, detector_width=whole[0] * camera.pixel_size, crop_offset=(0, 0), crop_size=whole
    )
    first = [max(0, size // 2 - around) for size in camera.resolution]
    size = [min(size, 2 * around) for size in camera.resolution]
    camera = camera.replace(crop_offset=tuple(first), crop_size=tuple(size))
    centre = rays.chief_detector_point(camera.mla_pitch / 2, camera.mla_distance, camera.detector_distance)
    px, py = (
        (np.arange(size[axis]) + first[axis] + 0.5 - camera.resolution[axis] / 2) * camera.pixel_size - centre
        for axis in (0, 1)
    )
    inside = (camera.micro_image_diameter / 2 - np.hypot(px, py[:, None])) / camera.pixel_size
    image = np.clip(inside + 0.5, 0, 1)
    tile = Tile(camera, wavelength, _THROUGHPUT_LENSES, 1)
    check_memory(tile.memory, "wave reconstruction of a white micro-image")
    x, y = (LensAxis(camera, wavelength, tile, axis) for axis in (0, 1))
    place = np.array([[int(np.flatnonzero(axis.index == 0)[0]) for axis in (y, x)]])
    arrays = backend().arrays
    amplitude = arrays.asarray(np.sqrt(image).astype(np.float32))
    field = pupil_fields(amplitude, tile, x, y, place, relay=relay)[0]
    inside = (camera.aperture_radius - np.hypot(tile.pupil, tile.pupil[:, None])) / tile.pupil_pitch
    power = float((abs(field) ** 2 * arrays.asarray(np.clip(inside + 0.5, 0, 1))).sum()) * tile.pupil_pitch**2
    return power / (image.sum() * camera.pixel_size**2)


def tile_lenses(camera: PlenopticCamera, distances: Sequence[float]) -> int:
    """Width of an object patch in lenses, odd: the widest blur and a margin for diffraction on both sides."""
    blur = max(camera.blur_diameter(g) for g in distances) / camera.mla_pitch
    return 2 * math.ceil(blur / 2 + _MARGIN) + 1


@dataclass(frozen=True)
class Tile:
    """Sampling of one lens's light in the four planes, the same for all lenses.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    lenses : int
        Width of the object patch in lenses, odd.
    oversample : int
        Bins per lens.
    """

    camera: PlenopticCamera
    wavelength: float
    lenses: int
    oversample: int

    @cached_property
    def pitch(self) -> float:
        """Distance of samples on detector and MLA, in millimetres."""
        return self.camera.pixel_size / self.subsamples

    @cached_property
    def subsamples(self) -> int:
        """Samples across a pixel."""
        return field_subsamples(self.camera, self.wavelength)

    @cached_property
    def cell(self) -> np.ndarray:
        """MLA coordinates from a lens's centre, within its cell."""
        count = self.cell_samples
        return (np.arange(count) - (count - 1) / 2) * self.pitch

    @property
    def cell_samples(self) -> int:
        """Samples across a cell."""
        return math.ceil(self.camera.mla_pitch / self.pitch - 1e-6)

    @cached_property
    def pixels(self) -> int:
        """Most pixels that belong to one lens, along an axis."""
        return math.ceil(self.camera.micro_image_pitch / self.camera.pixel_size) + 1

    @cached_property
    def padded(self) -> int:
        """Samples of the window from detector to MLA: what wraps round misses the cell."""
        source = self.pixels * self.camera.pixel_size + self._chief_shift
        spread = self.camera.detector_distance * in_millimetres(self.wavelength) / (2 * self.pitch)
        window = (source + self.camera.mla_pitch) / 2 + self._chief_shift + spread
        # The pixels themselves must have room.
        return fast_length(max(window / self.pitch, self.pixels * self.subsamples))

    @property
    def _chief_shift(self) -> float:
        """How far micro-images at the rim lie from their lenses."""
        half_field = max(self.camera.detector_width, self.camera.detector_height) / 2
        return half_field * self.camera.detector_distance / self.camera.mla_distance

    @cached_property
    def samples(self) -> int:
        """Object samples across a lens's image, enough for the pupil's light and a multiple of the bins."""
        camera = self.camera
        needed = (
            GUARD
            * camera.mla_pitch
            * camera.aperture_diameter
            / (in_millimetres(self.wavelength) * camera.mla_distance)
        )
        return self.oversample * max(1, math.ceil(needed / self.oversample))

    @property
    def object_samples(self) -> int:
        """Object samples across the patch."""
        return self.lenses * self.samples

    @property
    def pupil_pitch(self) -> float:
        """Distance of pupil samples: the object patch is one period."""
        return in_millimetres(self.wavelength) * self.camera.mla_distance / (self.lenses * self.camera.mla_pitch)

    @cached_property
    def pupil(self) -> np.ndarray:
        """Pupil coordinates along an axis, in millimetres."""
        count = self.pupil_samples
        return (np.arange(count) - (count - 1) / 2) * self.pupil_pitch

    @property
    def pupil_samples(self) -> int:
        """Samples across the pupil."""
        return min(self.object_samples, 2 * math.ceil(self.camera.aperture_radius / self.pupil_pitch) + 1)

    @cached_property
    def to_pupil(self) -> Field:
        r"""From the cell to the pupil along an axis, :math:`\exp(-i k P \mu / b) d\mu / (\lambda b)^{1/2}`."""
        wave_path = in_millimetres(self.wavelength) * self.camera.mla_distance
        turns = np.outer(self.pupil, self.cell) / wave_path
        matrix = np.exp(-2j * math.pi * turns) * (self.pitch / math.sqrt(wave_path))
        return backend().arrays.asarray(matrix.astype(np.complex64))

    @cached_property
    def transfer(self) -> Field:
        """Transfer function from detector to MLA."""
        ones = backend().arrays.ones((self.padded, self.padded), np.complex64)
        return advance(ones, self.pitch, self.camera.detector_distance, self.wavelength)

    @property
    def transformed(self) -> int:
        """Samples that the Fourier transforms of one lens go through."""
        return 4 * self.padded**2 + self.object_samples * (self.object_samples + self.pupil.size)

    @property
    def memory(self) -> float:
        """Bytes of the fields of one batch on the way, and of the matrices that serve all."""
        bins = self.lenses * self.oversample
        matrices = (
            32.0 * self.cell_samples * self.pupil_samples + 16.0 * self.padded**2 + 8.0 * bins * self.object_samples
        )
        # What `LensAxis` holds of each lens.
        lenses = sum(size / self.camera.pixels_per_lens + 2 for size in self.camera.crop_size)
        axes = lenses * 24 * (self.padded + self.cell_samples)
        return matrices + axes + self.batch * (16.0 * self.padded**2 + 24.0 * self.object_samples**2)

    @property
    def batch(self) -> int:
        """Lenses that are transformed together."""
        samples = _CUDA_BATCH_SAMPLES if backend().is_cuda else _BATCH_SAMPLES
        return max(1, samples // max(self.object_samples, self.padded) ** 2)


class LensAxis:
    """All lenses along one axis: their pixels, and their factors of a field.

    Attributes
    ----------
    index : (lenses,) int64 array
        Lattice indices of the lenses that any recorded pixel belongs to.
    pixel : (lenses, pixels) int64 array
        Recorded pixels of each lens, clipped to the image.
    owned : (lenses, pixels) bool array
        Whether they are the lens's own.
    source : (lenses, samples) complex64 array
        Phase of the converging light at the samples of those pixels, zero where not the lens's own.
    shift : (lenses, padded) complex64 array
        What shifts the spectrum from the pixels to the lens's centre.
    tilt : (lenses, cell) complex64 array
        What takes out the direction from the lens's centre to that of the main lens, and its curvature.
    centre : (lenses,) float64 array
        Coordinates of the centres in millimetres.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float, tile: Tile, axis: int) -> None:
        offset, size = camera.crop_offset[axis], camera.crop_size[axis]
        half = camera.resolution[axis] / 2
        centres = (np.arange(size) + offset + 0.5 - half) * camera.pixel_size
        # A subsampled pixel at the border of two cells may belong to both.
        edges = np.array([-0.5, 0.5]) * (camera.pixel_size - tile.pitch)
        first, last = detector_lens(centres[[0, -1]] + edges, camera).astype(np.int64)
        self.index = np.arange(first, last + 1)
        self.centre = lattice.cell_centre(self.index.astype(np.float64), camera.mla_pitch)
        edge = rays.chief_detector_point(self.index * camera.mla_pitch, camera.mla_distance, camera.detector_distance)
        pixel = np.floor(edge / camera.pixel_size + half + 1e-9).astype(np.int64)[:, None] + np.arange(tile.pixels)
        subsamples = tile.subsamples
        fine = (pixel[..., None] + (np.arange(subsamples) + 0.5) / subsamples).reshape(self.index.size, -1)
        p = (fine - half) * camera.pixel_size
        recorded = (pixel >= offset) & (pixel < offset + size)
        self.owned = detector_lens(p, camera) == self.index[:, None]
        self.owned &= np.repeat(recorded, subsamples, axis=1)
        self.pixel = np.repeat(np.clip(pixel - offset, 0, size - 1), subsamples, axis=1)
        self.source = converging_phase(p, self.index[:, None].astype(np.float64), camera, wavelength) * self.owned

        wave = in_millimetres(wavelength)
        frequency = np.fft.fftfreq(tile.padded, tile.pitch)
        way = self.centre + tile.cell[0] - p[:, 0]
        self.shift = np.exp(2j * math.pi * np.outer(way, frequency)).astype(np.complex64)
        turns = (self.centre[:, None] * tile.cell + tile.cell**2 / 2) / (wave * camera.mla_distance)
        self.tilt = np.exp(2j * math.pi * turns).astype(np.complex64)


def _lit_lenses(image: np.ndarray, x: LensAxis, y: LensAxis) -> np.ndarray:
    """Places (row, column) among the lenses of both axes of those with light; int64 (n, 2)."""
    by_column = np.stack(
        [
            image[:, pixel[own]].any(1) if own.any() else np.zeros(len(image), bool)
            for pixel, own in zip(x.pixel, x.owned, strict=True)
        ],
        1,
    )
    lit = np.stack([by_column[pixel[own]].any(0) for pixel, own in zip(y.pixel, y.owned, strict=True)])
    return np.argwhere(lit)


def pupil_fields(
    amplitude: np.ndarray, tile: Tile, x: LensAxis, y: LensAxis, batch: np.ndarray, *, relay: bool
) -> Field:
    """Fields of some lenses at the main lens, relative to a wave from the lens's centre.

    Parameters
    ----------
    amplitude : (rows, columns) float32 array
        Square root of the capture.
    tile : Tile
        Sampling.
    x, y : LensAxis
        All lenses.
    batch : (n, 2) int64 array
        Row and column of each lens.
    relay : bool
        Whether the microlens acts.

    Returns
    -------
    complex64 array (n, pupil, pupil)
    """
    arrays = backend().arrays
    j, i = batch.T
    size = x.source.shape[1]
    field = arrays.zeros((len(batch), tile.padded, tile.padded), np.complex64)
    row, column = arrays.asarray(y.pixel[j]), arrays.asarray(x.pixel[i])
    field[:, :size, :size] = amplitude[row[:, :, None], column[:, None, :]]
    field[:, :size, :size] *= arrays.asarray(y.source[j])[:, :, None]
    field[:, :size, :size] *= arrays.asarray(x.source[i])[:, None, :]
    with resting_drjit():
        field = fft2(field)
        field *= tile.transfer
        field *= arrays.asarray(y.shift[j])[:, :, None]
        field *= arrays.asarray(x.shift[i])[:, None, :]
        cell = fft2(field, inverse=True)[:, : tile.cell.size, : tile.cell.size]
        microlens = (
            lens_phase(tile.cell, tile.camera.mla_focal_length, tile.wavelength) if relay else np.ones(1, np.complex64)
        )
        cell = cell * arrays.asarray(y.tilt[j] * microlens)[:, :, None]
        cell *= arrays.asarray(x.tilt[i] * microlens)[:, None, :]
        # One product for the whole batch: many small ones would each wait for the threads of the BLAS.
        product = _product if len(batch) > 1 else _product_without_blas
        fields = product(product(cell, tile.to_pupil), tile.to_pupil)
    return arrays.ascontiguousarray(fields)


def _product(fields: Field, matrix: Field) -> Field:
    """Multiply a matrix (p, i) with fields (n, i, j) over i, and turn them: (n, j, p)."""
    return backend().arrays.tensordot(fields, matrix, (1, 1))


def _product_without_blas(fields: Field, matrix: Field) -> Field:
    """Do what `_product` does with the same bits on any number of threads.

    So has `white_throughput`, by which every image is divided.
    """
    return backend().arrays.einsum("nij,pi->njp", fields, matrix)


def _patches(fields: Field, tile: Tile, x: LensAxis, y: LensAxis, batch: np.ndarray, distance: float) -> np.ndarray:
    """Power of each lens in the bins around its own, upright; float32 (n, bins, bins)."""
    camera = tile.camera
    focused = _aim(fields, tile, x.centre[batch[:, 1]], y.centre[batch[:, 0]], distance)
    count, size = tile.pupil.size, tile.object_samples
    arrays = backend().arrays
    padded = arrays.zeros((len(batch), size, size), np.complex64)
    padded[:, :count, :count] = focused
    with resting_drjit():
        padded[:, :count] = fft(padded[:, :count], axis=2)
        padded = fft(padded, axis=1)
    intensity = padded.real**2
    intensity += padded.imag**2
    per_bin = tile.samples // tile.oversample
    bins = arrays.repeat(arrays.eye(size // per_bin, dtype=np.float32), per_bin, axis=1)
    sums = arrays.tensordot(arrays.tensordot(intensity, bins, (1, 1)), bins, (1, 1))
    sample = camera.bin_size(distance) / tile.samples
    scale = tile.pupil_pitch**2 / (in_millimetres(tile.wavelength) * distance) * sample / camera.pixel_size
    # The object is upside down in camera coordinates: bins grow with -X.
    return sums[:, ::-1, ::-1] * np.float32(scale**2)


def _aim(fields: Field, tile: Tile, cx: np.ndarray, cy: np.ndarray, distance: float) -> Field:
    """Multiply pupil fields by the way from the lens's centre to its image's, the main lens, and the pupil."""
    types = backend().types
    camera, wave = tile.camera, in_millimetres(tile.wavelength)
    n, count = len(cx), tile.pupil.size
    index = dr.arange(types.UInt32, n * count * count)
    lens, rest = index // (count * count), index % (count * count)
    row, column = rest // count, rest % count
    P = types.Float64(tile.pupil)
    u, v = dr.gather(types.Float64, P, column), dr.gather(types.Float64, P, row)
    x, y = (dr.gather(types.Float64, types.Float64(c), lens) for c in (cx, cy))
    b, g = (dr.opaque(types.Float64, length) for length in (camera.mla_distance, distance))
    # Directions change more slowly with P off the axis, on both sides alike: that only stretches the pupil's grid.
    sideways = x * x + y * y + b * b
    chief = dr.sqrt(sideways)
    Px, Py = (w * chief / b / (1 - c * c / sideways) for w, c in ((u, x), (v, y)))
    square = Px * Px + Py * Py
    along = square - 2 * (Px * x + Py * y)
    from_mla = along / (dr.sqrt(sideways + along) + chief) / wave
    to_object, _ = pupil_turns(camera, Px, Py, -x * g / b, -y * g / b, g, wave)
    # The first object sample is half a patch from the centre.
    half = (tile.object_samples - 1) / 2 / tile.object_samples / tile.pupil_pitch
    turns = from_mla + to_object + (u + v) * half
    sine, cosine = dr.sincos(types.Float(turns - dr.round(turns)) * (2 * math.pi))
    # The edge of the pupil is softened over one sample.
    within = types.Float((camera.aperture_radius - dr.sqrt(square)) / tile.pupil_pitch)
    coverage = dr.clip(within + 0.5, 0, 1)
    aimed = unpack(types.UInt64(as_words(fields))) * types.Complex2f(cosine, sine) * coverage
    return as_field(pack(aimed), fields.shape)


def _on_bins(total: np.ndarray, camera: PlenopticCamera, tile: Tile, x: LensAxis, y: LensAxis) -> np.ndarray:
    """Cut the sum over lenses to the bins of the image."""
    columns, rows = camera.lens_count
    image = np.zeros((rows * tile.oversample, columns * tile.oversample))
    reach = tile.lenses // 2
    into, out = [], []
    for axis, count in ((y, rows), (x, columns)):
        first = int(axis.index[0]) + count // 2 - reach
        end = first + axis.index.size + 2 * reach
        kept = slice(max(first, 0), min(end, count))
        into.append(slice(kept.start * tile.oversample, kept.stop * tile.oversample))
        out.append(slice((kept.start - first) * tile.oversample, (kept.stop - first) * tile.oversample))
    image[tuple(into)] = backend().to_host(total[tuple(out)])
    return image
