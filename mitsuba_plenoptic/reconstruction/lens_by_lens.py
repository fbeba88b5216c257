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

from collections.abc import Sequence

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..optics import guards
from ..optics.phase import in_millimetres, parabola, phasor, soft_edge
from ..optics.power import fraction
from ..runtime.backend import backend
from ..runtime.fft import Field, as_field, as_words, fft, fft2, pack, resting_drjit, split, unpack
from ..system.optical_system import OpticalSystem
from ..system.sampling import check_memory
from .conjugates import Conjugates, ThinConjugates
from .lens_sets import LensBatch, LensSet, lens_set
from .lens_tiles import Tile, reconstruction_tile
from .methods import Progress


def reconstruct_lens_by_lens(
    image: np.ndarray,
    camera: PlenopticCamera,
    distances: Sequence[float],
    wavelength: float,
    *,
    relay: bool = True,
    oversample: int = 1,
    judged: bool = True,
    progress: Progress = lambda done: None,
    conjugates: Conjugates | None = None,
) -> list[np.ndarray]:
    """Propagate every lens alone and add the intensities: the limit of `reconstruct_subsets` for large periods.

    See `waves.Power`.
    """
    tile = reconstruction_tile(camera, wavelength, distances, oversample)
    check_memory(tile.memory, "wave reconstruction lens by lens")
    lenses = lens_set(tile)
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
            patches = object_patches(fields, tile, batch, distance, conjugates)
            inner = patches[:, oversample:-oversample, oversample:-oversample]
            in_rim[index] += float(patches.sum(dtype=np.float64) - inner.sum(dtype=np.float64))
            for column, row, patch in zip(*batch.bin.T, patches, strict=True):
                top, left = row * oversample, column * oversample
                total[top : top + patch.shape[0], left : left + patch.shape[1]] += patch
        progress((place + len(batch.bin)) / len(lit))
    if judged and len(lit):
        guards.judge(guards.PUPIL, 1 - float(totals[0].sum()) / float(image.sum(dtype=np.float64)))
    for total, rim in zip(totals, in_rim, strict=True) if judged else ():
        guards.judge(guards.OBJECT, fraction(rim, float(total.sum())))
    return [on_bins(total, lenses) for total in totals]


def pupil_fields(amplitude: np.ndarray, tile: Tile, batch: LensBatch, *, relay: bool) -> Field:
    """Return the fields of some lenses at the main lens, relative to a wave from the lens's centre.

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
        microlens = (
            phasor(parabola(tile.cell**2, batch.focal_length[:, None], tile.wavelength)) if relay else np.complex64(1)
        )
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

    So has the white throughput, by which every image is divided.
    """
    return backend().arrays.einsum("nij,pi->njp", fields, matrix)


def object_patches(
    fields: Field, tile: Tile, batch: LensBatch, distance: float, conjugates: Conjugates | None = None
) -> np.ndarray:
    """Return the power of each lens in the bins around its own, upright; float32 (n, bins, bins)."""
    camera = tile.camera
    focused = _aim(fields, tile, batch, distance, conjugates or ThinConjugates(OpticalSystem(camera, tile.wavelength)))
    count, size = tile.pupil.size, tile.object_samples
    arrays = backend().arrays
    padded = arrays.zeros((len(fields), size, size), np.complex64)
    padded[:, :count, :count] = focused
    with resting_drjit():
        padded[:, :count] = fft(padded[:, :count], axis=2)
        padded = fft(padded, axis=1)
    intensity = padded.real**2
    intensity += padded.imag**2
    sums = arrays.tensordot(arrays.tensordot(intensity, tile.to_bins, (1, 1)), tile.to_bins, (1, 1))
    # Areas over the distance, which may be infinite.
    slope = camera.mla_pitch / camera.mla_distance / tile.samples
    scale = tile.pupil_pitch**2 / in_millimetres(tile.wavelength) * slope / camera.pixel_size
    # The object is upside down in camera coordinates: bins grow with -X.
    return sums[:, ::-1, ::-1] * np.float32(scale**2)


def passing_power(fields: Field, tile: Tile, batch: LensBatch, distance: float, conjugates: Conjugates) -> float:
    """Return the power of lenses' fields that the pupil lets through, in pixel values times areas."""
    aimed = _aim(fields, tile, batch, distance, conjugates)
    return float((abs(aimed) ** 2).sum(dtype=np.float64)) * tile.pupil_pitch**2


def _aim(fields: Field, tile: Tile, batch: LensBatch, distance: float, conjugates: Conjugates) -> Field:
    """Multiply pupil fields by the way from the lens's centre to its image's, the main lens, and the pupil."""
    types = backend().types
    camera, wave = tile.camera, in_millimetres(tile.wavelength)
    n, count = len(fields), tile.pupil.size
    index = dr.arange(types.UInt32, n * count * count)
    lens, row, column = split(types, index, count, count)
    P = types.Float64(tile.pupil)
    u, v = dr.gather(types.Float64, P, column), dr.gather(types.Float64, P, row)
    x, y = (dr.gather(types.Float64, types.Float64(np.ascontiguousarray(c)), lens) for c in batch.centre.T)
    b = dr.opaque(types.Float64, camera.mla_distance)
    conjugate = conjugates.at(x, y, batch.centre, lens, distance)
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
    if batch.aside is not None:
        # The patch is centred on a bin, not on the lens's image.
        ax, ay = (dr.gather(types.Float64, types.Float64(np.ascontiguousarray(a)), lens) for a in batch.aside.T)
        waves -= (u * ax + v * ay) * dr.opaque(types.Float64, 1 / (tile.lenses * tile.pupil_pitch))
    inside = soft_edge(types.Float(conjugate.inside((Px, Py)) / tile.pupil_pitch))
    aimed = unpack(types.UInt64(as_words(fields))) * phasor(waves) * inside
    return as_field(pack(aimed), fields.shape)


def on_bins(total: np.ndarray, lenses: LensSet) -> np.ndarray:
    """Cut the sum over lenses to the bins of the image."""
    tile = lenses.tile
    columns, rows = tile.camera.bin_count
    image = np.zeros((rows * tile.oversample, columns * tile.oversample))
    reach = tile.lenses // 2
    into, out = [], []
    for axis, count in ((1, rows), (0, columns)):
        first = lenses.first[axis] + count // 2 - reach
        end = first + lenses.bins[axis] + 2 * reach
        kept = slice(max(first, 0), min(end, count))
        into.append(slice(kept.start * tile.oversample, kept.stop * tile.oversample))
        out.append(slice((kept.start - first) * tile.oversample, (kept.stop - first) * tile.oversample))
    # Integrals of dark bins are zero but for rounding, on either side.
    image[tuple(into)] = backend().to_host(total[tuple(out)]).clip(0)
    return image
