r"""Refocusing one lens at a time: the limit of partial coherence, in which no two lenses interfere.

The light of a single microlens covers the whole main lens, but comes from one cell of the MLA and goes to a few bins of
the object plane. Between these two small patches one Fourier transform to the pupil and one from it replace full
fields. With c the centre of the cell, :math:`X_0 = -c g / b` the centre of its image, and offsets :math:`\mu`,
:math:`\xi` from them,

.. math:: U(X_0 + \xi) = \frac{dP^2 d\mu^2}{\lambda^2 b g} \sum_P e^{-i k P \cdot \xi / g} \,
          e^{i k (|P - c| + |P - X_0| - P^2 / 2 f_1)} \sum_\mu e^{-i k (P - c) \cdot \mu / b} \,
          e^{i k \mu^2 / 2 b} \, u(c + \mu)

The fields u of all cells come from the detector at once, by the first link of full fields.

The phase between the centres is exact and carries the aberrations; the terms linear in the offsets are paraxial
(Goodman, "Introduction to Fourier Optics", section 5.3), and the one quadratic in :math:`\xi` drops out of the
intensity. The pupil is sampled as finely as the object patch is wide.

Out of focus the power needs far fewer samples than the field. The light of a lens of the width :math:`D_2`, blurred
over B lenses, comes to each place from a B-th of the pupil, so that its power has frequencies up to that part of the
pupil's width. The transform to every n-th sample is that of the pupil's samples folded onto the first of n parts.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type
from ..fields import FreeSpace, Hop, OpticalSystem, Step, converging, is_paraxial, retained_workspace
from ..optics import guards, in_millimetres, parabola, phasor, rays, soft_edge
from ..runtime import Array, Field, Pair, active_backend, check_memory, drjit_array, fft, single_threaded_blas
from .conjugates import Conjugates, ThinConjugates, behind_thin_lens
from .methods import Progress
from .planning import GUARD, check_pupil_diffraction, detector_step, field_subsamples

_BLURRED = 8.0
"""Blur in lenses from which on the samples of the field suffice, or fewer, in inverse proportion to the blur.

Letters blurred over 11 lenses are within 5e-4 RMS of those of all samples, and 1.4e-3 at three bins a lens. What is
lost is diffracted by the pupil's edge.
"""

TILE_MARGIN = 4.5
"""Bins around the geometric image: more than full fields need, as the pupil's edge is softened over one sample."""


def tile_lenses(camera: PlenopticCamera, distances: Sequence[float]) -> int:
    """Width of an object patch in lenses, odd: the widest blur and a margin for diffraction on both sides."""
    blur = max(camera.blur_diameter(g) for g in distances) / camera.row_pitch
    return 2 * math.ceil(blur / 2 + TILE_MARGIN) + 1


def reconstruction_tile(
    camera: PlenopticCamera, wavelength: float, distances: Sequence[float], oversample: int
) -> LensTile:
    """Return the sampling for some object distances.

    The power of a lens has twice the frequencies of the field. Blurred over many lenses it has hardly any beyond those
    of the field, and sums of it need fewer samples still.
    """
    least = min(camera.blur_diameter(g) for g in distances) / max(camera.mla_pitches)
    summed = not camera.lenses_are_bins and focus_type(camera) == "unfocused"
    resolved = not summed or least < _BLURRED
    fraction = min(1.0, _BLURRED / least) if summed and least > 0 else 1.0
    return LensTile(camera, wavelength, tile_lenses(camera, distances), oversample, resolved, fraction)


class LensTile:
    """Sampling of one lens's light in the four planes."""

    def __init__(
        self,
        camera: PlenopticCamera,
        wavelength: float,
        lenses: int,
        oversample: int,
        resolved: bool = True,
        fraction: float = 1.0,
    ):
        self.camera = camera
        self.wavelength = wavelength
        self.lenses = lenses
        self.oversample = oversample
        wave_path = in_millimetres(wavelength) * camera.mla_distance
        # Samples across a pixel, and the distance between them on detector and MLA, in millimetres.
        self.subsamples = field_subsamples(camera, wavelength)
        self.pitch = camera.pixel_size / self.subsamples
        # Extent in mm along either axis of a lattice cell, samples across an aperture, and one more, and coordinates in
        # mm on the MLA, from a lens's centre, that contain its aperture wherever samples lie.
        lattice = camera.lattice
        self.cell_width = max(camera.mla_pitches) if lattice.axis_aligned else 2 * float(lattice.cell_corners().max())
        lens_width = float(lattice.aperture_width if lattice.aperture == "circle" else self.cell_width * lattice.fill)
        self.cell_samples = math.ceil(lens_width / self.pitch - 1e-6) + 1
        self.cell = (np.arange(self.cell_samples) - (self.cell_samples - 1) / 2) * self.pitch
        # Object samples across a lens's image that its power needs: a multiple of the bins, or fewer, as a bin as wide
        # as the lens's image averages over all frequencies that a few samples cannot distinguish. Several bins per lens
        # resolve the power, which has twice the frequencies of the field.
        guard = 2 * GUARD if oversample > 1 and resolved else GUARD
        needed = fraction * (guard * camera.row_pitch * camera.aperture_diameter / wave_path)
        per_bin = math.ceil(needed / oversample)
        self.samples = math.ceil(needed) if needed < oversample else oversample * per_bin
        self.object_samples = lenses * self.samples
        # Coordinates along an axis of the pupil, in mm, for whose distance the object patch is one period.
        self.pupil_pitch = wave_path / (lenses * camera.row_pitch)
        count = 2 * math.ceil(camera.aperture_radius / self.pupil_pitch) + 1
        self.pupil = (np.arange(count) - (count - 1) / 2) * self.pupil_pitch

    @cached_property
    def to_pupil(self) -> Field:
        r"""Matrix from the cell to the pupil along an axis, :math:`\exp(-i k P \mu / b) d\mu / (\lambda b)^{1/2}`."""
        wave_path = in_millimetres(self.wavelength) * self.camera.mla_distance
        matrix = phasor(np.outer(self.pupil, self.cell) / -wave_path) * np.float32(self.pitch / math.sqrt(wave_path))
        return active_backend().arrays.asarray(matrix)

    @property
    def transformed(self) -> int:
        """Number of samples in all Fourier transforms for one lens; matrix products count by their time."""
        cell = self.cell_samples
        pupil = self.pupil.size
        image = self.object_samples
        products = cell * pupil * (cell + pupil)
        # Products of complex numbers in a matrix product that take as long as a sample of a Fourier transform.
        return 4 * cell**2 + pupil**2 + 2 * image**2 + products // 64

    @property
    def memory(self) -> float:
        """Bytes of the intermediate fields of a batch, and of the matrices shared by all batches."""
        pupil = self.pupil.size
        cell = self.cell_samples
        return 32.0 * cell * pupil + self.batch * (16.0 * cell**2 + 24.0 * max(self.object_samples, pupil) ** 2)

    @property
    def batch(self) -> int:
        """Number of lenses that are transformed together."""
        samples = 2**25 if active_backend().is_cuda else 2**20
        return max(1, samples // max(self.object_samples, self.pupil.size, self.cell_samples) ** 2)


def fine_bins(system: OpticalSystem, oversample: int) -> int:
    """Return the number of fine bins across a bin, in which power is summed before it is spread over lenses."""
    camera = system.camera
    if camera.lens_data.traced_surfaces:
        camera = behind_thin_lens(system)
    elif camera.lenses_are_bins:
        return 1
    return LensTile(camera, system.wavelength, 1, oversample).samples // oversample


@dataclass(frozen=True)
class LensBatch:
    """Some lenses with their windows in a field on the array.

    `bin` (n, 2) are column and row, among the bins of all lenses, of the bin that contains each lens's image, and
    `aside` (n, 2) the offset in bins of the window's middle from the middle of that bin. `rows` and `columns` (n, cell)
    are the samples of the windows, and `offset` their distances (2, n, cell) from the lens's centre along x and y.
    """

    bin: Array
    aside: Array
    centre: Array
    rows: Array
    columns: Array
    offset: Array
    focal_length: Array


class LensSet:
    """The lenses to which recorded pixels belong, and some lenses around them.

    `first` are the first column and row of bins with a lens, counted from the axis, and `bins` the number of columns
    and rows up to the last.
    """

    def __init__(self, tile: LensTile):
        camera = tile.camera
        ends = np.array([camera.pixel_coordinates(axis)[[0, -1]] for axis in (0, 1)])
        ends += np.array([-0.5, 0.5]) * camera.pixel_size
        low, high = rays.chief_point(camera, ends).T
        half = tile.cell_width / 2
        self.tile, self._index = tile, camera.lattice.lenses_within(tuple(low - half), tuple(high + half))
        self.centre = np.stack(camera.lattice.centre(*self._index.T.astype(np.float64)), axis=-1)
        position = self.centre / camera.row_pitch
        bins = np.floor(position).astype(np.int64)
        self._aside = position - bins - 0.5
        self.first = int(bins[:, 0].min()), int(bins[:, 1].min())
        self.bin = bins - np.array(self.first)
        self.bins = int(self.bin[:, 0].max()) + 1, int(self.bin[:, 1].max()) + 1

    def pixels(self, which: Array) -> Pair:
        """Return the first recorded column and row (n, 2) that may belong to lenses, and those after the last."""
        camera = self.tile.camera
        half = self.tile.cell_width / 2
        low, high = (
            rays.chief_detector_point(camera, self.centre[which] + side) / camera.pixel_size
            + np.array(camera.resolution) / 2
            - camera.crop_offset
            for side in (-half, half)
        )
        ends = np.floor(low + 1e-9).astype(np.int64), np.ceil(high - 1e-9).astype(np.int64)
        first, end = (np.clip(end, 0, camera.crop_size) for end in ends)
        return first, end

    def lit(self, image: Array) -> Array:
        """Return the indices, in this set, of lenses whose pixels contain light, an int64 array (n,)."""
        counts = np.pad((image > 0).cumsum(0, np.int32).cumsum(1, np.int32), ((1, 0), (1, 0)))
        (left, top), (right, bottom) = (ends.T for ends in self.pixels(np.arange(len(self._index))))
        lit = counts[bottom, right] - counts[top, right] - counts[bottom, left] + counts[top, left]
        return np.flatnonzero(lit)

    def blocks(self, which: Array) -> Iterator[Array]:
        """Yield the lenses in square blocks, whose light comes from the detector at once."""
        # Samples across the lenses whose light comes from the detector at once.
        width = max(2**10 * self.tile.pitch, 4 * self.tile.cell_width)
        column, row = ((self.centre[which] - self.centre.min(0)) // width).T
        square = row * (column.max(initial=0) + 1) + column
        for block in np.unique(square):
            yield which[square == block]

    def to_array(self, which: Array) -> Step:
        """Return the step from the pixels around some lenses to samples on the array, which hold their windows."""
        tile = self.tile
        first, end = self.pixels(which)
        low = first.min(0) + tile.camera.crop_offset
        high = end.max(0) + tile.camera.crop_offset
        across, down = (
            detector_step(tile.camera, tile.wavelength, axis, span, tile.pitch, tile.cell_samples)
            for axis, span in enumerate(zip(low.tolist(), high.tolist(), strict=True))
        )
        return Step(across, down)

    def on_array(self, amplitude: Array, which: Array) -> tuple[Field, Step]:
        """Return the field on the array from the pixels around some lenses, and the step to its samples.

        Light that strays from another lens's pixels into a cell is deflected by a micro-image and misses the main lens.
        """
        tile = self.tile
        camera = self.tile.camera
        step = self.to_array(which)
        space = FreeSpace(camera.detector_distance, camera.medium_wavelength(tile.wavelength), is_paraxial(camera))
        hop = Hop(step, space, converging(step, camera, tile.wavelength))
        first, end = self.pixels(which)
        left, top = first.min(0).tolist()
        right, bottom = end.max(0).tolist()
        with retained_workspace([step]) as workspace, fft.resting_drjit():
            pixels = workspace.repeated(amplitude[top:bottom, left:right], tile.subsamples)
            return workspace.whole(hop.forward(pixels, workspace), step.shape), step

    def batch(self, lenses: Array, step: Step) -> LensBatch:
        """Return the batch of the lenses at the given positions, with their windows in the samples of a step."""
        tile = self.tile
        centre = self.centre[lenses]
        start = np.array([step.x.start, step.y.start])
        first = np.rint((centre + tile.cell[0] - start) / tile.pitch).astype(np.int64)
        aside = start + first * tile.pitch - (centre + tile.cell[0])
        columns, rows = (index[:, None] + np.arange(tile.cell_samples) for index in first.T)
        return LensBatch(
            bin=self.bin[lenses],
            aside=self._aside[lenses] + aside / tile.camera.row_pitch,
            centre=centre,
            rows=rows,
            columns=columns,
            offset=aside.T[:, :, None] + tile.cell,
            focal_length=np.broadcast_to(tile.camera.lenslet(*self._index[lenses].T).focal_length, len(lenses)),
        )


@single_threaded_blas()  # a lens's products are too small for threads, which would wait for each other actively
def reconstruct_lens_by_lens(
    image: Array,
    camera: PlenopticCamera,
    distances: Sequence[float],
    wavelength: float,
    *,
    relay: bool = True,
    oversample: int = 1,
    checked: bool = True,
    progress: Progress = lambda done: None,
    conjugates: Conjugates | None = None,
) -> list[Array]:
    """Return images from lenses propagated one by one, the limit of `reconstruct_subsets` for large periods."""
    tile = reconstruction_tile(camera, wavelength, distances, oversample)
    lenses = LensSet(tile)
    # Every lens puts its patch among the samples of all lenses, and a margin for those at the edge.
    shape = [(count + tile.lenses - 1) * tile.samples for count in lenses.bins[::-1]]
    lit = lenses.lit(image)
    blocks = list(lenses.blocks(lit))
    light = max((16.0 * math.prod(lenses.to_array(block).columns) for block in blocks), default=0.0)
    # The sum of each plane, and its spectrum while one is integrated.
    sums = 4.0 * math.prod(shape) * (len(distances) + 2)
    check_memory(tile.memory + light + sums, "wave reconstruction lens by lens")
    conjugates = conjugates or ThinConjugates(OpticalSystem(camera, wavelength))
    arrays = active_backend().arrays
    amplitude = arrays.sqrt(arrays.asarray(image))
    totals = [arrays.zeros(shape) for _ in distances]
    done = 0
    # Stopped once, as stopping takes as long as the transforms of a lens.
    with fft.resting_drjit():
        for block in blocks:
            field, step = lenses.on_array(amplitude, block)
            for position in range(0, len(block), tile.batch):
                batch = lenses.batch(block[position : position + tile.batch], step)
                fields = pupil_fields(field, tile, batch, relay=relay)
                for total, distance in zip(totals, distances, strict=True):
                    patches = object_patches(fields, tile, batch, distance, conjugates)
                    for column, row, patch in zip(*batch.bin.T, patches, strict=True):
                        top = row * tile.samples
                        left = column * tile.samples
                        total[top : top + patch.shape[0], left : left + patch.shape[1]] += patch
                done += len(batch.bin)
                progress(done / len(lit))
    if checked and len(lit):
        guards.check(guards.PUPIL, 1 - float(totals[0].sum()) / float(image.sum(dtype=np.float64)))
        for distance in distances:
            check_pupil_diffraction(camera, wavelength, distance, TILE_MARGIN)
    return [on_bins(total, lenses) for total in totals]


def pupil_fields(light: Field, tile: LensTile, batch: LensBatch, *, relay: bool) -> Field:
    """Return the fields of some lenses at the main lens, relative to a spherical wave from the lens's centre.

    They start from a field on the array; complex64 (n, pupil, pupil). The microlenses act with `relay` only.
    """
    arrays = active_backend().arrays
    x, y = batch.offset
    cell = light[arrays.asarray(batch.rows)[:, :, None], arrays.asarray(batch.columns)[:, None, :]]
    inset = tile.camera.lattice.aperture_inset(x[:, None, :], y[:, :, None])
    cell *= arrays.asarray(soft_edge(inset / tile.pitch).astype(np.float32))
    wave_path = in_millimetres(tile.wavelength) * tile.camera.mla_distance
    for axis, shape in ((0, (slice(None), None)), (1, (slice(None), slice(None), None))):
        offset = batch.offset[axis]
        centre = batch.centre[:, axis, None]
        # Without the direction to the main lens's centre, and without its curvature.
        waves = (centre * offset + offset**2 / 2) / wave_path
        if relay:
            waves = waves + parabola(offset**2, batch.focal_length[:, None], tile.wavelength)
        cell *= arrays.asarray(phasor(waves))[shape]
    # From (lenses, i, j) to (lenses, j, p), and again.
    for _ in range(2):
        cell = arrays.tensordot(cell, tile.to_pupil, (1, 1))
    return arrays.ascontiguousarray(cell)


def object_patches(fields: Field, tile: LensTile, batch: LensBatch, distance: float, conjugates: Conjugates) -> Array:
    """Return the power of each lens's light at the samples around its bin, upright; float32 (n, samples, samples)."""
    camera = tile.camera
    focused = _aim(fields, tile, batch, distance, conjugates)
    size = tile.object_samples
    arrays = active_backend().arrays
    folded = arrays.zeros((len(fields), size, size), np.complex64)
    for top, left in itertools.product(range(0, tile.pupil.size, size), repeat=2):
        patch = focused[:, top : top + size, left : left + size]
        folded[:, : patch.shape[1], : patch.shape[2]] += patch
    lit = min(size, tile.pupil.size)
    with fft.resting_drjit():
        folded[:, :lit] = fft.fft(folded[:, :lit], axis=2)
        folded = fft.fft(folded, axis=1)
    intensity = folded.real**2
    intensity += folded.imag**2
    # Areas over the distance, which may be infinite.
    slope = camera.row_pitch / camera.mla_distance / tile.samples
    scale = tile.pupil_pitch**2 / in_millimetres(tile.wavelength) * slope / camera.pixel_size
    # The object is upside down in camera coordinates: bins grow with -X.
    return intensity[:, ::-1, ::-1] * np.float32(scale**2)


def _aim(fields: Field, tile: LensTile, batch: LensBatch, distance: float, conjugates: Conjugates) -> Field:
    """Return pupil fields multiplied by the pupil, and by the phase from the lens's centre to its image."""
    types = active_backend().types
    camera = tile.camera
    wave = in_millimetres(tile.wavelength)
    lens, row, column = fft.images_rows_and_columns(types, *fields.shape)
    P = drjit_array(types.Float64, tile.pupil)
    u = dr.gather(types.Float64, P, column)
    v = dr.gather(types.Float64, P, row)
    x, y, ax, ay = (
        dr.gather(types.Float64, drjit_array(types.Float64, values), lens)
        for values in (*batch.centre.T, *batch.aside.T)
    )
    b = dr.opaque(types.Float64, camera.mla_distance)
    conjugate = conjugates.at(x, y, batch.centre, lens, distance)
    if is_paraxial(camera):
        # Tilts, to and from the centres, cancel.
        Px = u
        Py = v
        from_mla = -parabola(u * u + v * v, b, tile.wavelength)
    else:
        # Directions change more slowly with P off the axis, on both sides alike: that only stretches the pupil's grid.
        sideways = x * x + y * y + b * b
        chief = dr.sqrt(sideways)
        Px, Py = (w * chief / b / (1 - c * c / sideways) for w, c in ((u, x), (v, y)))
        along = Px * Px + Py * Py - 2 * (Px * x + Py * y)
        from_mla = along / (dr.sqrt(sideways + along) + chief) / wave
    to_object = conjugate.path((Px, Py))
    # The first object sample is half a patch from the centre.
    half = (tile.object_samples - 1) / 2 / tile.object_samples / tile.pupil_pitch
    waves = from_mla + to_object + (u + v) * half
    # The patch is centred on a bin, not on the lens's image.
    waves -= (u * ax + v * ay) * dr.opaque(types.Float64, 1 / (tile.lenses * tile.pupil_pitch))
    inside = soft_edge(types.Float(conjugate.inside((Px, Py)) / tile.pupil_pitch))
    aimed = fft.unpack(drjit_array(types.UInt64, fft.as_words(fields))) * phasor(waves) * inside
    return fft.as_field(fft.pack(aimed), fields.shape)


def on_bins(total: Array, lenses: LensSet) -> Array:
    """Return the bins of the image, cut from the sum of power at samples over lenses."""
    tile = lenses.tile
    for axis in (0, 1):
        total = integrated(total, tile, axis)
    columns, rows = tile.camera.bin_count
    image = np.zeros((rows * tile.oversample, columns * tile.oversample))
    reach = tile.lenses // 2
    into = []
    out = []
    for axis, count in ((1, rows), (0, columns)):
        first = lenses.first[axis] + count // 2 - reach
        end = first + lenses.bins[axis] + 2 * reach
        inside = slice(max(first, 0), min(end, count))
        into.append(slice(inside.start * tile.oversample, inside.stop * tile.oversample))
        out.append(slice((inside.start - first) * tile.oversample, (inside.stop - first) * tile.oversample))
    # Integrals of dark bins are zero up to rounding, on either side.
    image[tuple(into)] = active_backend().to_host(total[tuple(out)]).clip(0)
    return image


def integrated(power: Array, tile: LensTile, axis: int) -> Array:
    r"""Return the integrals over bins, along an axis, of power that is sampled several times for each lens.

    Where the samples resolve the power, the power is the trigonometric polynomial through them, whose integrals over
    bins of m samples are exact: a frequency of f periods a sample counts :math:`m \,\mathrm{sinc}(f m)` times.
    """
    count = power.shape[axis]
    per_bin = tile.samples / tile.oversample
    if tile.oversample == 1:
        return power.reshape(*power.shape[:axis], -1, tile.samples, *power.shape[axis + 1 :]).sum(axis + 1)
    shape = (-1, *(1,) * (power.ndim - axis - 1))
    frequency = np.fft.rfftfreq(count).reshape(shape)
    response = per_bin * np.sinc(frequency * per_bin) * np.exp(1j * np.pi * frequency * (per_bin - 1))
    # As many samples as bins or more: those at the bins' starts; fewer: as many as bins, of the same polynomial.
    bins = count if per_bin > 1 else count // tile.samples * tile.oversample
    with fft.resting_drjit():
        spectrum = fft.rfft(power, axis=axis) * active_backend().arrays.asarray(
            (response * (bins / count)).astype(np.complex64)
        )
        integrals = fft.irfft(spectrum, bins, axis=axis)
    return integrals[(slice(None),) * axis + (slice(None, None, round(per_bin) if per_bin > 1 else 1),)]
