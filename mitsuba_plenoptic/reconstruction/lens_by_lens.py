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
import scipy

from ..bounds import MOST_PIXELS
from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import guards, rays
from ..optics.free_space import advance
from ..optics.main_lens import main_lens
from ..optics.phase import in_millimetres
from ..optics.pupil import PupilFraction
from ..optics.sampling import check_memory, fast_length
from ..runtime.backend import backend
from ..runtime.fft import Field, as_field, as_words, fft, fft2, pack, resting_drjit, unpack
from ..runtime.indexing import split
from ._elements import converging_phase, detector_lens, lens_phase
from ._plan import GUARD, field_subsamples

# Samples that are transformed together, on the processor and on a CUDA device.
_BATCH_SAMPLES, _CUDA_BATCH_SAMPLES = 2**20, 2**25

_THROUGHPUT_LENSES = 25

# Lenses looked at together for light.
_LIT_BATCH = 512

# Parts of a sample along an axis of which those in the aperture are counted.
_PARTS = 4

# Where the coordinates of one axis go in a field (n, y, x).
_AXES = ((slice(None), None, slice(None)), (slice(None), slice(None), None))

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
    lenses = all_lenses(camera, wavelength, tile)
    lit = lenses.lit(image)
    libraries = backend()
    amplitude = libraries.arrays.sqrt(libraries.arrays.asarray(image))
    # Every lens puts its patch among the bins of all lenses, and a margin for those at the edge.
    shape = [(count + tile.lenses - 1) * oversample for count in lenses.bins[::-1]]
    totals = [libraries.arrays.zeros(shape) for _ in distances]
    in_rim = [0.0 for _ in distances]
    for place in range(0, len(lit), tile.batch):
        batch = lenses.batch(lit[place : place + tile.batch])
        fields = pupil_fields(amplitude, tile, batch, relay=relay)
        for index, (total, distance) in enumerate(zip(totals, distances, strict=True)):
            patches = _patches(fields, tile, batch, distance)
            inner = patches[:, oversample:-oversample, oversample:-oversample]
            in_rim[index] += float(patches.sum(dtype=np.float64) - inner.sum(dtype=np.float64))
            for column, row, patch in zip(*batch.bin.T, patches, strict=True):
                top, left = row * oversample, column * oversample
                total[top : top + patch.shape[0], left : left + patch.shape[1]] += patch
        progress((place + len(batch.bin)) / len(lit))
    if len(lit):
        guards.judge(guards.PUPIL, 1 - float(totals[0].sum()) / float(image.sum(dtype=np.float64)))
    for total, rim in zip(totals, in_rim, strict=True):
        guards.judge(guards.OBJECT, guards.share(rim, float(total.sum())))
    return [_on_bins(total, camera, tile, lenses) for total in totals]


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
    if not is_aligned(camera):
        return _mean_throughput(camera, wavelength, relay)
    # The micro-image of a lens beside the axis, in the lenses around that.
    around = math.ceil(2 * camera.micro_image_pitch / camera.pixel_size)
    camera = _around_axis(camera, around)
    centre = rays.chief_detector_point(camera.mla_pitch / 2, camera.mla_distance, camera.detector_distance)
    px, py = (camera.pixel_coordinates(axis) - centre for axis in (0, 1))
    inside = (camera.micro_image_diameter / 2 - np.hypot(px, py[:, None])) / camera.pixel_size
    image = np.clip(inside + 0.5, 0, 1)
    tile = Tile(camera, wavelength, _THROUGHPUT_LENSES, 1)
    check_memory(tile.memory, "wave reconstruction of a white micro-image")
    lenses = Aligned(camera, wavelength, tile)
    power = _power(image, lenses, np.array([lenses.find(0, 0)]), relay=relay)
    return power / (image.sum() * camera.pixel_size**2)


def _mean_throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> float:
    """Share that comes back of the light, of a white scene, of the pixels whose own ray passes the main lens."""
    around = math.ceil(3 * camera.micro_image_pitch / camera.pixel_size)
    camera = _around_axis(camera, around)
    tile = Tile(camera, wavelength, _THROUGHPUT_LENSES, 1)
    lenses = Scattered(camera, wavelength, tile)
    back = sent = 0.0
    px, py = (camera.pixel_coordinates(axis) for axis in (0, 1))
    for kind in range(len(camera.mla_focal_lengths)):
        # Among the lenses beside the axis there is one of every kind.
        i, j = camera.lattice.cell(0.0, 0.0)
        i += kind
        kind = int(camera.lattice.lens_type(i, j)) if len(camera.mla_focal_lengths) > 1 else 0
        to_pupil = camera.mla_distance / camera.detector_distance
        centre = [
            rays.chief_detector_point(c, camera.mla_distance, camera.detector_distance)
            for c in camera.lattice.centre(i, j)
        ]
        Px, Py = (centre[0] - px) * to_pupil, ((centre[1] - py) * to_pupil)[:, None]
        image = PupilFraction(camera, kind)(*np.broadcast_arrays(Px, Py))
        sent += float(image[np.hypot(Px, Py) <= camera.lit_radius].sum())
        back += _power(image, lenses, np.array([lenses.find(i, j)]), relay=relay)
    return back / (sent * camera.pixel_size**2)


def white_power(
    camera: PlenopticCamera, wavelength: float, distance: float, *, relay: bool = True, oversample: int = 1
) -> np.ndarray:
    """Power in each bin from a white scene, for an aligned lattice and if no two lenses interfere.

    For a focused camera the bins of a lens overlap with those of a few others. Light from the rim of its micro-image,
    which came from within the pupil through a part of the lens, returns as if through the lens's centre and misses the
    pupil. So some bins get more light than others. All lenses are taken for the one beside the axis.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    distance : float
        Object distance.
    relay : bool
        Whether the microlenses act in the MLA plane.
    oversample : int
        Bins per lens along each axis.

    Returns
    -------
    (rows, columns) float64 array
        In pixel values times pixels.
    """
    part = _around_axis(camera, math.ceil(2 * camera.micro_image_pitch / camera.pixel_size))
    tile = Tile(part, wavelength, tile_lenses(camera, [distance]), oversample)
    lenses = Aligned(part, wavelength, tile)
    centre = rays.chief_detector_point(camera.mla_pitch / 2, camera.mla_distance, camera.detector_distance)
    to_pupil = camera.mla_distance / camera.detector_distance
    Px, Py = ((centre - part.pixel_coordinates(axis)) * to_pupil for axis in (0, 1))
    image = PupilFraction(camera)(Px, Py[:, None])
    batch = lenses.batch(np.array([lenses.find(0, 0)]))
    libraries = backend()
    amplitude = libraries.arrays.asarray(np.sqrt(image))
    fields = pupil_fields(amplitude, tile, batch, relay=relay)
    patch = libraries.to_host(_patches(fields, tile, batch, distance)[0]).astype(np.float64)
    everywhere = Aligned(camera, wavelength, tile)
    comb = np.zeros([(count - 1) * oversample + 1 for count in everywhere.bins[::-1]])
    comb[::oversample, ::oversample] = 1
    total = libraries.arrays.asarray(scipy.signal.oaconvolve(comb, patch))
    return _on_bins(total, camera, tile, everywhere)


def _around_axis(camera: PlenopticCamera, around: int) -> PlenopticCamera:
    """Return the camera with just so many pixels on both sides of the axis, whether its detector has them or not."""
    if around > MOST_PIXELS // 2:
        raise InputError(
            f"mla_pitch = {camera.mla_pitch:g}: a micro-image of {around // 2} pixels is too wide for waves"
        )
    columns, rows = (max(size, 2 * around) for size in camera.resolution)
    return camera.replace(
        resolution=(columns, rows),
        detector_width=columns * camera.pixel_size,
        crop_offset=(columns // 2 - around, rows // 2 - around),
        crop_size=(2 * around, 2 * around),
    )


def _power(image: np.ndarray, lenses: Lenses, which: np.ndarray, *, relay: bool) -> float:
    """Power that one lens sends through the main lens."""
    tile = lenses.tile
    arrays = backend().arrays
    amplitude = arrays.asarray(np.sqrt(image).astype(np.float32))
    field = pupil_fields(amplitude, tile, lenses.batch(which), relay=relay)[0]
    inside = (tile.camera.aperture_radius - np.hypot(tile.pupil, tile.pupil[:, None])) / tile.pupil_pitch
    return float((abs(field) ** 2 * arrays.asarray(np.clip(inside + 0.5, 0, 1))).sum()) * tile.pupil_pitch**2


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
    def cell_width(self) -> float:
        """Extent of a cell of the lattice along both axes."""
        lattice = self.camera.lattice
        return self.camera.mla_pitch if lattice.axis_aligned else 2 * float(lattice.cell_corners().max())

    @property
    def lens_width(self) -> float:
        """Extent of an aperture along both axes."""
        lattice = self.camera.lattice
        return float(lattice.aperture_width if lattice.aperture == "circle" else self.cell_width * lattice.fill)

    @cached_property
    def cell(self) -> np.ndarray:
        """MLA coordinates from a lens's centre, within its aperture's extent."""
        count = self.cell_samples
        return (np.arange(count) - (count - 1) / 2) * self.pitch

    @property
    def cell_samples(self) -> int:
        """Samples across an aperture."""
        return math.ceil(self.lens_width / self.pitch - 1e-6)

    @cached_property
    def pixels(self) -> int:
        """Most pixels that belong to one lens, along an axis."""
        growth = self.camera.micro_image_pitch / self.camera.mla_pitch
        return math.ceil(self.cell_width * growth / self.camera.pixel_size) + 1

    @cached_property
    def padded(self) -> int:
        """Samples of the window from detector to MLA: what wraps round misses the cell."""
        source = self.pixels * self.camera.pixel_size + self._chief_shift
        spread = self.camera.detector_distance * in_millimetres(self.wavelength) / (2 * self.pitch)
        window = (source + self.cell_width) / 2 + self._chief_shift + spread
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
        first, last = detector_lens(centres[[0, -1]] + edges, camera, axis).astype(np.int64)
        self.index = np.arange(first, last + 1)
        self.centre = camera.lattice.axis_centre(self.index.astype(np.float64), axis)
        edge = rays.chief_detector_point(self.index * camera.mla_pitch, camera.mla_distance, camera.detector_distance)
        pixel = np.floor(edge / camera.pixel_size + half + 1e-9).astype(np.int64)[:, None] + np.arange(tile.pixels)
        subsamples = tile.subsamples
        fine = (pixel[..., None] + (np.arange(subsamples) + 0.5) / subsamples).reshape(self.index.size, -1)
        p = (fine - half) * camera.pixel_size
        recorded = (pixel >= offset) & (pixel < offset + size)
        self.owned = detector_lens(p, camera, axis) == self.index[:, None]
        self.owned &= np.repeat(recorded, subsamples, axis=1)
        self.pixel = np.repeat(np.clip(pixel - offset, 0, size - 1), subsamples, axis=1)
        phase = converging_phase(p, self.index[:, None].astype(np.float64), camera, wavelength, axis)
        self.source = phase * self.owned
        self.shift, self.tilt = _shift(self.centre, p[:, 0], tile), _tilt(self.centre, tile)


def _shift(centre: np.ndarray, first: np.ndarray, tile: Tile) -> Field:
    """Return what shifts spectra along an axis from each lens's first pixel sample to the first one of its cell."""
    way = centre + tile.cell[0] - first
    return np.exp(2j * math.pi * np.outer(way, np.fft.fftfreq(tile.padded, tile.pitch))).astype(np.complex64)


def _tilt(centre: np.ndarray, tile: Tile) -> Field:
    """Return what takes out, along an axis, the direction from lenses to the main lens's centre, and its curvature."""
    wave_path = in_millimetres(tile.wavelength) * tile.camera.mla_distance
    turns = (centre[:, None] * tile.cell + tile.cell**2 / 2) / wave_path
    return np.exp(2j * math.pi * turns).astype(np.complex64)


@dataclass(frozen=True)
class LensBatch:
    """Some lenses, and their factors of a field; what belongs to one axis is shaped to multiply fields (n, y, x).

    Attributes
    ----------
    bin : (n, 2) int64 array
        Column and row, among the bins of all lenses, of the bin that holds each lens's image.
    aside : (n, 2) float64 array, or None
        How far along x and y the lens's centre lies from the middle of that bin, in bins; None if nowhere.
    centre : (n, 2) float64 array
        Centres in millimetres.
    row, column : int64 arrays (n, pixels, 1) and (n, 1, pixels)
        Recorded pixels of each lens.
    source : list of complex64 arrays
        Factors of the converging light at those pixels, zero where not the lens's own.
    shift : list of complex64 arrays
        Factors of the spectra that shift them from the pixels to the lenses' centres.
    tilt : list of complex64 arrays
        Factors in the cells along y and along x.
    focal_length : float64 array (n,)
        Of each lens.
    aperture : float32 array (cell, cell), or None
        How much of each sample of a cell the aperture lets through; None if all.
    """

    bin: np.ndarray
    aside: np.ndarray | None
    centre: np.ndarray
    row: np.ndarray
    column: np.ndarray
    source: list[Field]
    shift: list[Field]
    tilt: list[Field]
    focal_length: np.ndarray
    aperture: np.ndarray | None


class Aligned:
    """Lenses of an upright square lattice, one of which lies on every bin: all is done one axis at a time.

    Attributes
    ----------
    tile : Tile
        Sampling.
    first : (int, int)
        First column and row of bins that any recorded pixel's lens lies on, counted from the axis.
    bins : (int, int)
        Columns and rows of such bins.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float, tile: Tile) -> None:
        self.tile = tile
        self._x, self._y = (LensAxis(camera, wavelength, tile, axis) for axis in (0, 1))
        self.first = int(self._x.index[0]), int(self._y.index[0])
        self.bins = self._x.index.size, self._y.index.size

    def find(self, i: float, j: float) -> tuple[int, int]:
        """Place of the lens with these indices: row and column."""
        return int(j) - self.first[1], int(i) - self.first[0]

    def lit(self, image: np.ndarray) -> np.ndarray:
        """Places (row, column) of lenses with light; int64 (n, 2)."""
        return _lit_lenses(image, self._x, self._y)

    def batch(self, which: np.ndarray) -> LensBatch:
        """Take some lenses by their places."""
        x, y = self._x, self._y
        j, i = which.T
        return LensBatch(
            bin=which[:, ::-1],
            aside=None,
            centre=np.stack([x.centre[i], y.centre[j]], axis=-1),
            row=y.pixel[j][:, :, None],
            column=x.pixel[i][:, None, :],
            source=[y.source[j][:, :, None], x.source[i][:, None, :]],
            shift=[y.shift[j][:, :, None], x.shift[i][:, None, :]],
            tilt=[y.tilt[j], x.tilt[i]],
            focal_length=np.full(len(which), self.tile.camera.mla_focal_length),
            aperture=None,
        )


class Scattered:
    """Lenses of any lattice, each for itself. Attributes and methods are those of `Aligned`."""

    def __init__(self, camera: PlenopticCamera, wavelength: float, tile: Tile) -> None:
        self.tile, self._camera, self._wavelength = tile, camera, wavelength
        lattice, b, z = camera.lattice, camera.mla_distance, camera.detector_distance
        ends = np.array([camera.pixel_coordinates(axis)[[0, -1]] for axis in (0, 1)])
        low, high = rays.chief_point(ends + np.array([-0.5, 0.5]) * camera.pixel_size, b, z).T
        self._index = lattice.lenses_within(tuple(low - tile.cell_width / 2), tuple(high + tile.cell_width / 2))
        self._centre = np.stack(lattice.centre(*self._index.T.astype(np.float64)), axis=-1)
        place = self._centre / camera.mla_pitch
        bins = np.floor(place).astype(np.int64)
        self._aside = place - bins - 0.5
        self.first = int(bins[:, 0].min()), int(bins[:, 1].min())
        self._bin = bins - np.array(self.first)
        self.bins = int(self._bin[:, 0].max()) + 1, int(self._bin[:, 1].max()) + 1
        self._subsamples = round(camera.pixel_size / tile.pitch)
        edge = rays.chief_detector_point(self._centre - tile.cell_width / 2, b, z)
        half = np.array(camera.resolution) / 2
        self._first_pixel = np.floor(edge / camera.pixel_size + half + 1e-9).astype(np.int64)
        self._aperture = self._cover()

    def find(self, i: float, j: float) -> int:
        """Place of the lens with these indices."""
        return int(np.flatnonzero((self._index == (int(i), int(j))).all(1))[0])

    def lit(self, image: np.ndarray) -> np.ndarray:
        """Places of lenses near which there is light; int64 (n,)."""
        lit = np.zeros(len(self._index), bool)
        for start in range(0, len(lit), _LIT_BATCH):
            which = np.arange(start, min(start + _LIT_BATCH, len(lit)))
            (column, _, in_columns), (row, _, in_rows) = (self._pixels(which, axis) for axis in (0, 1))
            own = in_rows[:, :, None] & in_columns[:, None, :]
            lit[which] = (own & (image[row[:, :, None], column[:, None, :]] > 0)).any((1, 2))
        return np.flatnonzero(lit)

    def batch(self, which: np.ndarray) -> LensBatch:
        """Take some lenses by their places."""
        camera, tile, centre = self._camera, self.tile, self._centre[which]
        (column, px, in_columns), (row, py, in_rows) = (self._pixels(which, axis) for axis in (0, 1))
        i, j = self._index[which].T.astype(np.float64)
        chief = (rays.chief_point(p, camera.mla_distance, camera.detector_distance) for p in (px, py))
        own_i, own_j = camera.lattice.cell(*np.broadcast_arrays(*(c[s] for c, s in zip(chief, _AXES, strict=True))))
        own = (own_i == i[:, None, None]) & (own_j == j[:, None, None])
        own &= in_rows[:, :, None] & in_columns[:, None, :]
        phases = [
            lens_phase(p - c[:, None], camera.detector_distance, self._wavelength)
            for p, c in zip((px, py), centre.T, strict=True)
        ]
        lengths = np.array(camera.mla_focal_lengths)
        kind = camera.lattice.lens_type(i, j).astype(int) if len(lengths) > 1 else np.zeros(len(which), int)
        shift = [_shift(c, p[:, 0], tile) for p, c in zip((px, py), centre.T, strict=True)]
        return LensBatch(
            bin=self._bin[which],
            aside=self._aside[which],
            centre=centre,
            row=row[:, :, None],
            column=column[:, None, :],
            source=[own, phases[1][:, :, None], phases[0][:, None, :]],
            shift=[shift[1][:, :, None], shift[0][:, None, :]],
            tilt=[_tilt(centre[:, 1], tile), _tilt(centre[:, 0], tile)],
            focal_length=lengths[kind],
            aperture=self._aperture,
        )

    def _pixels(self, which: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels of some lenses along an axis, sample by sample: clipped index, coordinate, whether recorded."""
        camera = self._camera
        offset, size = camera.crop_offset[axis], camera.crop_size[axis]
        pixel = self._first_pixel[which, axis, None] + np.arange(self.tile.pixels)
        part = (np.arange(self._subsamples) + 0.5) / self._subsamples
        fine = (pixel[..., None] + part).reshape(len(which), -1)
        p = (fine - camera.resolution[axis] / 2) * camera.pixel_size
        recorded = (pixel >= offset) & (pixel < offset + size)
        column, recorded = (
            np.repeat(values, self._subsamples, axis=1) for values in (np.clip(pixel - offset, 0, size - 1), recorded)
        )
        return column, p, recorded

    def _cover(self) -> np.ndarray:
        """Part of each sample of a cell that lies in the aperture."""
        parts = ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5) * self.tile.pitch
        fine = (self.tile.cell[:, None] + parts).ravel()
        inside = self._camera.lattice.in_aperture(*np.meshgrid(fine, fine))
        size = self.tile.cell.size
        return inside.reshape(size, _PARTS, size, _PARTS).mean((1, 3), dtype=np.float32)


Lenses = Aligned | Scattered


def is_aligned(camera: PlenopticCamera) -> bool:
    """Whether there is a lens on each bin, which it fills."""
    return camera.lenses_are_bins


def all_lenses(camera: PlenopticCamera, wavelength: float, tile: Tile) -> Lenses:
    """Return the lenses that any recorded pixel belongs to."""
    return Aligned(camera, wavelength, tile) if is_aligned(camera) else Scattered(camera, wavelength, tile)


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


def pupil_fields(amplitude: np.ndarray, tile: Tile, batch: LensBatch, *, relay: bool) -> Field:
    """Fields of some lenses at the main lens, relative to a wave from the lens's centre.

    Parameters
    ----------
    amplitude : (rows, columns) float32 array
        Square root of the capture.
    tile : Tile
        Sampling.
    batch : LensBatch
        The lenses.
    relay : bool
        Whether the microlens acts.

    Returns
    -------
    complex64 array (n, pupil, pupil)
    """
    arrays = backend().arrays
    count, size = len(batch.bin), batch.row.shape[1]
    field = arrays.zeros((count, tile.padded, tile.padded), np.complex64)
    field[:, :size, :size] = amplitude[arrays.asarray(batch.row), arrays.asarray(batch.column)]
    for factor in batch.source:
        field[:, :size, :size] *= arrays.asarray(factor)
    with resting_drjit():
        field = fft2(field)
        field *= tile.transfer
        for factor in batch.shift:
            field *= arrays.asarray(factor)
        cell = fft2(field, inverse=True)[:, : tile.cell.size, : tile.cell.size]
        microlens = lens_phase(tile.cell, batch.focal_length[:, None], tile.wavelength) if relay else np.complex64(1)
        cell = cell * arrays.asarray(batch.tilt[0] * microlens)[:, :, None]
        cell *= arrays.asarray(batch.tilt[1] * microlens)[:, None, :]
        if batch.aperture is not None:
            cell *= arrays.asarray(batch.aperture)
        # One product for the whole batch: many small ones would each wait for the threads of the BLAS.
        product = _product if count > 1 else _product_without_blas
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


def _patches(fields: Field, tile: Tile, batch: LensBatch, distance: float) -> np.ndarray:
    """Power of each lens in the bins around its own, upright; float32 (n, bins, bins)."""
    camera = tile.camera
    focused = _aim(fields, tile, batch, distance)
    count, size = tile.pupil.size, tile.object_samples
    arrays = backend().arrays
    padded = arrays.zeros((len(fields), size, size), np.complex64)
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


def _aim(fields: Field, tile: Tile, batch: LensBatch, distance: float) -> Field:
    """Multiply pupil fields by the way from the lens's centre to its image's, the main lens, and the pupil."""
    types = backend().types
    camera, wave = tile.camera, in_millimetres(tile.wavelength)
    n, count = len(fields), tile.pupil.size
    index = dr.arange(types.UInt32, n * count * count)
    lens, row, column = split(types, index, count, count)
    P = types.Float64(tile.pupil)
    u, v = dr.gather(types.Float64, P, column), dr.gather(types.Float64, P, row)
    x, y = (dr.gather(types.Float64, types.Float64(np.ascontiguousarray(c)), lens) for c in batch.centre.T)
    b, g = (dr.opaque(types.Float64, length) for length in (camera.mla_distance, distance))
    # Directions change more slowly with P off the axis, on both sides alike: that only stretches the pupil's grid.
    sideways = x * x + y * y + b * b
    chief = dr.sqrt(sideways)
    Px, Py = (w * chief / b / (1 - c * c / sideways) for w, c in ((u, x), (v, y)))
    square = Px * Px + Py * Py
    along = square - 2 * (Px * x + Py * y)
    from_mla = along / (dr.sqrt(sideways + along) + chief) / wave
    to_object = main_lens(camera).path((Px, Py), (-x * g / b, -y * g / b, g), tile.wavelength)
    # The first object sample is half a patch from the centre.
    half = (tile.object_samples - 1) / 2 / tile.object_samples / tile.pupil_pitch
    turns = from_mla + to_object + (u + v) * half
    if batch.aside is not None:
        # The patch is centred on a bin, not on the lens's image.
        ax, ay = (dr.gather(types.Float64, types.Float64(np.ascontiguousarray(a)), lens) for a in batch.aside.T)
        turns -= (u * ax + v * ay) * dr.opaque(types.Float64, 1 / (tile.lenses * tile.pupil_pitch))
    sine, cosine = dr.sincos(types.Float(turns - dr.round(turns)) * (2 * math.pi))
    # The edge of the pupil is softened over one sample.
    within = types.Float((camera.aperture_radius - dr.sqrt(square)) / tile.pupil_pitch)
    coverage = dr.clip(within + 0.5, 0, 1)
    aimed = unpack(types.UInt64(as_words(fields))) * types.Complex2f(cosine, sine) * coverage
    return as_field(pack(aimed), fields.shape)


def _on_bins(total: np.ndarray, camera: PlenopticCamera, tile: Tile, lenses: Lenses) -> np.ndarray:
    """Cut the sum over lenses to the bins of the image."""
    columns, rows = camera.bin_count
    image = np.zeros((rows * tile.oversample, columns * tile.oversample))
    reach = tile.lenses // 2
    into, out = [], []
    for axis, count in ((1, rows), (0, columns)):
        first = lenses.first[axis] + count // 2 - reach
        end = first + lenses.bins[axis] + 2 * reach
        kept = slice(max(first, 0), min(end, count))
        into.append(slice(kept.start * tile.oversample, kept.stop * tile.oversample))
        out.append(slice((kept.start - first) * tile.oversample, (kept.stop - first) * tile.oversample))
    image[tuple(into)] = backend().to_host(total[tuple(out)])
    return image
