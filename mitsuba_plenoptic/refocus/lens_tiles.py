"""Sampling of the light of one lens as it is propagated back; it is the same for all lenses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type
from ..light.optical_system import OpticalSystem, is_paraxial
from ..optics.waves import advance, in_millimetres, phasor
from ..runtime.backend import backend
from ..runtime.fft import Field, fast_length
from .conjugates import behind_thin_lens
from .planning import GUARD, field_subsamples

# Samples that are transformed together, on the processor and on a CUDA device.
_BATCH_SAMPLES, _CUDA_BATCH_SAMPLES = 2**20, 2**25

_PRODUCTS = 64
"""Products of complex numbers in a matrix product that take as long as a sample of a Fourier transform."""

_FINE_GUARD = 2 * GUARD
"""`GUARD` for several bins per lens: they resolve the power, which has twice the frequencies of the field."""

_BLURRED = 1.0
"""Blur in lenses from which on the samples of the field suffice for sums over lenses."""

TILE_MARGIN = 4.5
"""Bins around the geometric image: more than full fields need, as the pupil's edge is softened over one sample."""


def tile_lenses(camera: PlenopticCamera, distances: Sequence[float]) -> int:
    """Width of an object patch in lenses, odd: the widest blur and a margin for diffraction on both sides."""
    blur = max(camera.blur_diameter(g) for g in distances) / camera.mla_pitch
    return 2 * math.ceil(blur / 2 + TILE_MARGIN) + 1


def reconstruction_tile(
    camera: PlenopticCamera, wavelength: float, distances: Sequence[float], oversample: int
) -> LensTile:
    """Return the sampling for some object distances.

    Fine bins of lattices whose lenses are not bins are summed over lenses. From a blur of one lens on, the power that
    an unfocused camera's lens sends has next to none of the frequencies beyond its field's, and such sums are within
    2e-4 RMS of those of twice as many samples; in focus they would be 6e-3 off.
    """
    least = min(camera.blur_diameter(g) for g in distances) / max(camera.mla_pitches)
    summed = not camera.lenses_are_bins and focus_type(camera) == "unfocused"
    resolved = not summed or least < _BLURRED
    return LensTile(camera, wavelength, tile_lenses(camera, distances), oversample, resolved)


@dataclass(frozen=True)
class LensTile:
    """Sampling of one lens's light in the four planes."""

    camera: PlenopticCamera
    wavelength: float
    lenses: int
    oversample: int
    resolved: bool = True

    @cached_property
    def pitch(self) -> float:
        """Distance of samples on detector and MLA, in millimetres."""
        return self.camera.pixel_size / self.subsamples

    @cached_property
    def subsamples(self) -> int:
        """Number of samples across a pixel."""
        return field_subsamples(self.camera, self.wavelength)

    @cached_property
    def cell_width(self) -> float:
        """Extent of a cell of the lattice along both axes."""
        lattice = self.camera.lattice
        return max(self.camera.mla_pitches) if lattice.axis_aligned else 2 * float(lattice.cell_corners().max())

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
        """Number of samples across an aperture."""
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
        spread = self.camera.reduced_distance * in_millimetres(self.wavelength) / (2 * self.pitch)
        window = (source + self.cell_width) / 2 + self._chief_shift + spread
        # The pixels themselves must have room.
        return fast_length(max(window / self.pitch, self.pixels * self.subsamples))

    @property
    def _chief_shift(self) -> float:
        """Distance of micro-images at the rim of the detector from their lenses."""
        half_field = max(self.camera.detector_width, self.camera.detector_height) / 2
        return half_field * self.camera.reduced_distance / self.camera.mla_distance

    @cached_property
    def samples(self) -> int:
        """Object samples across a lens's image, enough for the pupil's light and a multiple of the bins.

        A bin as wide as the lens's image averages over all frequencies that a few samples confuse.
        """
        camera = self.camera
        needed = (
            (_FINE_GUARD if self.oversample > 1 and self.resolved else GUARD)
            * camera.mla_pitch
            * camera.aperture_diameter
            / (in_millimetres(self.wavelength) * camera.mla_distance)
        )
        return self.oversample * max(1, math.ceil(needed / self.oversample))

    @property
    def object_samples(self) -> int:
        """Number of object samples across the patch."""
        return self.lenses * self.samples

    @cached_property
    def to_bins(self) -> Field:
        r"""From the power at samples across the patch to that in bins along an axis, float32 (bins, samples).

        Where samples miss nothing of the power, it is the trigonometric polynomial through them, whose integrals over
        bins of m samples are exact: a frequency of f periods a sample counts :math:`m \,\mathrm{sinc}(f m)` times.
        """
        count, per_bin = self.object_samples, self.samples // self.oversample
        first = np.zeros(count)
        first[:per_bin] = 1
        if self.oversample > 1:
            frequency = np.fft.rfftfreq(count)
            middle = np.exp(-1j * np.pi * frequency * (per_bin - 1))
            first = np.fft.irfft(per_bin * np.sinc(frequency * per_bin) * middle, count)
        bins = [np.roll(first, start) for start in range(0, count, per_bin)]
        return backend().arrays.asarray(np.array(bins, dtype=np.float32))

    @property
    def pupil_pitch(self) -> float:
        """Distance of pupil samples, for which the object patch is one period."""
        return in_millimetres(self.wavelength) * self.camera.mla_distance / (self.lenses * self.camera.mla_pitch)

    @cached_property
    def pupil(self) -> np.ndarray:
        """Pupil coordinates along an axis, in millimetres."""
        count = self.pupil_samples
        return (np.arange(count) - (count - 1) / 2) * self.pupil_pitch

    @property
    def pupil_samples(self) -> int:
        """Number of samples across the pupil."""
        return min(self.object_samples, 2 * math.ceil(self.camera.aperture_radius / self.pupil_pitch) + 1)

    @cached_property
    def to_pupil(self) -> Field:
        r"""From the cell to the pupil along an axis, :math:`\exp(-i k P \mu / b) d\mu / (\lambda b)^{1/2}`."""
        wave_path = in_millimetres(self.wavelength) * self.camera.mla_distance
        matrix = phasor(np.outer(self.pupil, self.cell) / -wave_path) * np.float32(self.pitch / math.sqrt(wave_path))
        return backend().arrays.asarray(matrix)

    @cached_property
    def transfer(self) -> Field:
        """Transfer function from detector to MLA."""
        ones = backend().arrays.ones((self.padded, self.padded), np.complex64)
        z, wavelength = self.camera.detector_distance, self.camera.medium_wavelength(self.wavelength)
        return advance(ones, self.pitch, z, wavelength, paraxial=is_paraxial(self.camera))

    @property
    def transformed(self) -> int:
        """Samples that one lens's Fourier transforms go through; matrix products count by their time."""
        products = self.cell_samples * self.pupil_samples * (self.cell_samples + self.pupil_samples)
        return (
            4 * self.padded**2 + self.object_samples * (self.object_samples + self.pupil.size) + products // _PRODUCTS
        )

    @property
    def memory(self) -> float:
        """Bytes of the intermediate fields of one batch, and of the matrices that all batches use."""
        bins = self.lenses * self.oversample
        matrices = (
            32.0 * self.cell_samples * self.pupil_samples + 16.0 * self.padded**2 + 8.0 * bins * self.object_samples
        )
        return matrices + self.batch * (16.0 * self.padded**2 + 24.0 * self.object_samples**2)

    @property
    def batch(self) -> int:
        """Number of lenses that are transformed together."""
        samples = _CUDA_BATCH_SAMPLES if backend().is_cuda else _BATCH_SAMPLES
        return max(1, samples // max(self.object_samples, self.padded) ** 2)


def fine_bins(system: OpticalSystem, oversample: int) -> int:
    """Return the count of fine bins across a bin, in which power is summed before it is spread over lenses."""
    camera = system.camera
    if camera.lens_data.traced_surfaces:
        camera = behind_thin_lens(system)
    elif camera.lenses_are_bins:
        return 1
    return LensTile(camera, system.wavelength, 1, oversample).samples // oversample
