r"""The response of a Fourier light-field microscope to the bins of object planes: convolutions of the detector.

The array stands in the image of the stop. There a point (X, Y, d) has the field of the point (0, 0, d) times a plane
wave of the direction cosines :math:`M X / f_F`. All lenses together are one thin screen there, and free space behind it
propagates a tilted wave to the same intensity, shifted by :math:`z M X / f_F` (Goodman, "Introduction to Fourier
Optics", section 4.2; exact for small directions, as behind an objective). So all points of a plane have the same point
spread, and a plane's capture is a convolution (Guo, Liu, Hua, Li, Jia 2019, "Fourier light-field microscopy", Optics
Express 27, 25573).

Bins lie on a grid `oversample` times as fine as the pixels, in the pictures under the lenses. Bins at the same position
within a pixel share one kernel, so that a plane has as many kernels as there are bins in a pixel.
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...camera import PlenopticCamera
from ...detector import SHARP, DetectorOperator
from ...errors import warn
from ...fields import OpticalSystem
from ...points import FullFieldPlan, fine_camera, radiance_weight
from ...runtime import Floats, Job, active_backend, fft
from .kernels import StoredResponse, require_response_memory
from .response import Response

_MEMORY = 2 * 2**30
"""Bytes of the kernels' spectra beyond which they are stored on disk."""


class FourierResponse(StoredResponse):
    r"""The capture of object planes made of bins of even radiance: :math:`I = \sum_k A_k x_k`.

    Bins fill the picture of one lens, with `PlenopticCamera.bin_count` times `oversample` bins. Everything outside is
    taken to be dark: in a real microscope a field stop hides it. For `steps` and `prepared` see `Response`.
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
        assert wavelength is not None
        self._detector = DetectorOperator.of(camera)
        camera = camera.replace(**SHARP)
        self._camera, self._oversample, self._count = camera, oversample, len(distances)
        columns, rows = (oversample * count for count in camera.bin_count)
        self.shapes = [(rows, columns)] * len(distances)
        # Bins are ordered as in a lens's picture.
        self._windows = [(slice(None, None, -1),) * 2] * len(distances)
        super().__init__((len(distances) * rows * columns,), camera.shape)
        lengths = np.add(camera.crop_size, camera.bin_count) - 1
        self._size = tuple(fft.fast_length(float(length)) for length in reversed(lengths))
        self._store(len(distances) > 1 and self._spectra_memory(oversample) > _MEMORY)
        deepest = max(abs(distance) for distance in distances)
        lens: Any = camera.objective
        cut = lens.magnification * deepest * math.tan(lens.half_angle)
        if lens.field_stop is not None and cut > lens.field_stop / 2:
            warn(
                f"distance = {deepest:g}: beyond depths of {deepest * lens.field_stop / 2 / cut:.2g} mm the field stop "
                "cuts the light of bins by their place; the response is that of the bin in the middle"
            )
        fine = fine_camera(camera, wavelength, deepest, oversample, beyond=1)

        def memory(oversample: int) -> float:
            spectra = self._spectra_memory(oversample) / (self._count if self._folder else 1)
            bins = 4.0 * self._count * oversample**2 * math.prod(camera.bin_count)
            spread = 4.0 * math.prod(fine.resolution) * (oversample / self._oversample) ** 2
            return spectra + 12 * bins + 6 * spread + 24.0 * math.prod(self._size)

        require_response_memory(memory, oversample, distances)
        # The first bin on the pixel in the middle of a lens's picture.
        size = camera.bin_size(0) / oversample
        x, y = ((oversample * (count // 2) + 0.5 - oversample * count / 2) * size for count in camera.bin_count)
        points = np.array([[x, y, depth] for depth in distances])
        system = OpticalSystem(fine.at_wavelength(wavelength), wavelength)
        self._lens, plan = system.lens, FullFieldPlan(system, points, None, 0.0)
        unit = np.ones(1, np.float32)
        batches = [plan.batch(plane, unit) for plane in range(len(distances))]
        self._spectra: list[fft.Field] = []
        # A sample of a full field takes some 24 times as long as one of the transforms of an inversion's step; the unit
        # is that of `Response`.
        spreads = [8 * plan.cost(plane) for plane in range(len(distances))]
        total = sum(spreads) + len(batches) * math.ceil(steps * oversample**2 * math.prod(self._size) / 3)
        self.prepared = sum(spreads) / total
        for partial_sum in (job or Job()).each(batches, spreads, 0, total):
            spectra = self._kernel_spectra(np.asarray(partial_sum.sums[0]), fine)
            self._spectra += self._stored([spectra], f"{len(self._spectra)}")

    def forward(self, values: Floats, /) -> Floats:
        """Return the image that the detector records of planes."""
        libraries = active_backend()
        rows, columns = self._size
        total = libraries.arrays.zeros((rows, columns // 2 + 1), np.complex64)
        with fft.resting_drjit():
            for radiance, spectra in zip(self.planes_of(values), self._spectra, strict=True):
                for phase, spectrum in zip(self._phases, spectra, strict=True):
                    total += self._spectrum(radiance[phase]) * libraries.arrays.asarray(spectrum)
            height, width = self._camera.shape
            rows_of = fft.fft(total, axis=0, inverse=True)[:height]
            image = libraries.to_host(fft.irfft(rows_of, columns, axis=1)[:, :width])
        return self._detector.forward(np.ascontiguousarray(image))

    def adjoint(self, image: Floats, /) -> Floats:
        """Return the transpose of `forward`, applied to an image."""
        libraries = active_backend()
        columns = self._size[1]
        result = np.empty(self.source_shape, np.float32)
        width, height = self._camera.bin_count
        with fft.resting_drjit():
            image_spectrum = self._spectrum(self._detector.adjoint(image))
            for plane, spectra in zip(self.planes_of(result), self._spectra, strict=True):
                for phase, spectrum in zip(self._phases, spectra, strict=True):
                    back = image_spectrum * libraries.arrays.asarray(spectrum).conj()
                    back = fft.fft(back, axis=0, inverse=True)[:height]
                    plane[phase] = libraries.to_host(fft.irfft(back, columns, axis=1)[:, :width])
        return result

    @property
    def _phases(self) -> list[tuple[slice, slice]]:
        """Slices of the bins, by rows and columns, that lie at the same position within their pixels."""
        starts = [slice(start, None, self._oversample) for start in range(self._oversample)]
        return list(itertools.product(starts, starts))

    def _spectrum(self, samples: Floats) -> Any:
        """Return the spectrum of samples that lie in the first corner of the convolutions' period."""
        arrays = active_backend().arrays
        rows, columns = self._size
        wide = arrays.zeros((len(samples), columns), np.float32)
        wide[:, : samples.shape[1]] = arrays.asarray(samples)
        spectrum = arrays.zeros((rows, columns // 2 + 1), np.complex64)
        spectrum[: len(samples)] = fft.rfft(wide, axis=1)
        return fft.fft(spectrum, axis=0)

    def _kernel_spectra(self, spread: Floats, fine: PlenopticCamera) -> fft.Field:
        """Return the spectra of a plane's kernels, from the middle bin's spread on the fine camera's pixels."""
        o = self._oversample
        camera = self._camera
        per_bin = round(camera.pixel_size / fine.pixel_size / o)
        spread = _over_bins(_over_bins(spread, per_bin), per_bin)
        # Sums over as much of a pixel as a bin is wide.
        rows, columns = (length // per_bin for length in spread.shape)
        parts = spread.reshape(rows, per_bin, columns, per_bin).sum(axis=(1, 3))
        np.maximum(parts, 0, out=parts)  # what interpolation leaves below zero is not light
        area = (camera.pixel_size / o * camera.mla_distance / camera.reduced_distance) ** 2
        parts *= np.float32(radiance_weight(camera, self._lens, area))
        # From the bin in the middle to the recorded pixels; the fine window has more pixels on both sides.
        windows = np.array([columns, rows]) // o
        # Where a kernel's samples lie around the first corner of the period, and which of them.
        positions = []
        sources = []
        for axis, bins in zip((1, 0), reversed(camera.bin_count), strict=True):
            first = (windows[axis] - camera.resolution[axis]) // 2 + bins // 2 + camera.crop_offset[axis]
            places = np.arange(windows[axis] + 1) - first
            inside = (places > -bins) & (places < camera.crop_size[axis])
            positions.append(places[inside] % self._size[1 - axis])
            sources.append(inside)
        wrapped = np.zeros(self._size, np.float32)
        spectra = active_backend().arrays.empty((o**2, self._size[0], self._size[1] // 2 + 1), np.complex64)
        for spectrum, (down, across) in zip(spectra, self._phases, strict=True):
            kernel = _over_pixels(_over_pixels(parts, o, across.start), o, down.start)
            wrapped[np.ix_(*positions)] = kernel[np.ix_(*sources)]
            spectrum[...] = self._spectrum(wrapped)
        return spectra

    def _spectra_memory(self, oversample: int) -> float:
        """Return the bytes of all kernels' spectra."""
        return 4.0 * self._count * oversample**2 * math.prod(self._size)


def response_of(camera: PlenopticCamera) -> type[Response] | type[FourierResponse]:
    """Return the kind of the response of a camera."""
    return FourierResponse if camera.lens_data.images_stop else Response


class _KnownError(Exception):
    """Ends a response whose work is known."""


def response_seconds(camera: PlenopticCamera, distance: float, wavelength: float, steps: float) -> float:
    """Return about how long a plane's response and its steps take on two cores of a processor of 2023."""

    def end(done: int, total: int) -> None:
        raise _KnownError(total)

    try:
        response_of(camera)(camera, [distance], wavelength=wavelength, oversample=1, job=Job(progress=end), steps=steps)
    except _KnownError as known:
        return 16e-9 * float(known.args[0])
    return 0.0


def _over_bins(spread: Floats, width: int) -> Floats:
    """Return a point's spread averaged over positions of the point along bins `width` samples wide, transposed."""
    length = spread.shape[1]
    spectrum = np.fft.rfft(spread).astype(np.complex64)
    spectrum *= np.sinc(np.fft.rfftfreq(length) * width).astype(np.float32)
    return np.asarray(np.fft.irfft(spectrum, length).T, np.float32)


def _over_pixels(parts: Floats, count: int, start: int) -> Floats:
    """Return sums along pixels, each of `count` parts, of parts moved on by `start`, transposed; one pixel is added."""
    return np.pad(parts, ((0, 0), (start, count - start))).reshape(len(parts), -1, count).sum(-1).T
