"""Point spreads by direct sums in double precision, which share no code with captures.

The field on the microlens array is a sum over the pupil's directions; microlenses are sampled sixteen times as finely
and cut to a band; free space is an angular spectrum, cut at some steepest direction. Grids are the same for all
wavelengths.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from mitsuba_plenoptic import PlenopticCamera

BANDS = ((0.5e-3, 0.6, 0.35), (0.5e-3, 0.8, 0.45), (0.4e-3, 1.0, 0.6))
"""Distance of samples and width of the window in millimetres, and steepest direction cosine."""

_DIRECTIONS, _FINER, _TAPER, _PARTS = 900, 16, 0.06, 16


def smooth(value: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 0 below 0, 1 above 1, and a cubic between."""
    clipped = np.clip(value, 0, 1)
    return clipped * clipped * (3 - 2 * clipped)


def arriving(
    camera: PlenopticCamera, point: NDArray[np.float64], wavelength: float, place: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Return the field of a point on the microlens array, at all pairs of places, for unit power through the pupil."""
    k, b, a = 2e6 * math.pi / wavelength, camera.mla_distance, camera.aperture_radius
    X, Y, g = point.tolist()
    x, y = -X * b / g, -Y * b / g
    half = 1.02 * (a + max(abs(x), abs(y))) / b
    step = 2 * half / _DIRECTIONS
    along = (np.arange(_DIRECTIONS) + 0.5) * step - half

    def pupil(sx: NDArray[np.float64], sy: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        length = b / np.sqrt(1 - sx**2 - sy**2)
        return x - length * sx, y - length * sy, length

    sx, sy = np.meshgrid(along, along)
    Px, Py, length = pupil(sx, sy)
    radius = np.hypot(Px, Py)
    cover, rim = (radius < a).astype(float), np.abs(radius - a) < 1.2 * b * step
    part = ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5) * step
    Qx, Qy, _ = pupil(sx[rim][:, None, None] + part[:, None], sy[rim][:, None, None] + part)
    cover[rim] = (np.hypot(Qx, Qy) < a).mean((1, 2))
    distance, far = np.sqrt((Px - X) ** 2 + (Py - Y) ** 2 + g * g), math.sqrt(x * x + y * y + b * b)
    if camera.lens_model == "ideal":
        # To the point's real image.
        image = 1 / (1 / camera.focal_length - 1 / g)
        Xi, Yi = -X * image / g, -Y * image / g
        path = math.sqrt(Xi**2 + Yi**2 + image**2) - np.sqrt((Px - Xi) ** 2 + (Py - Yi) ** 2 + image**2)
    else:
        path = distance - math.sqrt(X * X + Y * Y + g * g) - (Px**2 + Py**2) / (2 * camera.focal_length)
    path += length - far
    amplitude = g * length**2 / (distance**2 * b)
    power = (cover * amplitude**2).sum() * step**2
    waves = cover * amplitude * np.exp(1j * k * path) * (step**2 / (wavelength * 1e-6 * math.sqrt(power)))
    field = np.exp(1j * k * np.outer(place - y, along)) @ waves @ np.exp(1j * k * np.outer(along, place - x))
    square = (place - x) ** 2 + (place - y)[:, None] ** 2
    tilt = (x * (place - x) + y * (place - y)[:, None]) / far
    return np.asarray(field * np.exp(1j * k * (square - tilt**2) / (2 * far)))


def lenses(camera: PlenopticCamera, wavelength: float, axis: int, count: int, step: float) -> NDArray[np.complex128]:
    """Return the factor of a square array along an axis, cut to the band of the samples, which end smoothly."""
    fine, width = step / _FINER, count * step
    place = (np.arange(count * _FINER) - count * _FINER // 2 + 0.5) * fine
    pitch, aperture = camera.mla_pitches[axis], camera.lattice.aperture_widths[axis]
    offset = (place - camera.mla_offset[axis]) % pitch - pitch / 2
    passed = np.clip((aperture / 2 - np.abs(offset)) / fine + 0.5, 0, 1) if aperture < pitch else 1.0
    passed = passed * smooth((width / 2 - np.abs(place)) / _TAPER)
    phase = np.exp(-1j * math.pi * offset**2 / (wavelength * 1e-6 * camera.mla_focal_lengths[0]))
    spectrum, frequency = scipy.fft.fft(phase * passed), scipy.fft.fftfreq(count * _FINER, fine)
    spectrum *= np.exp(2j * math.pi * frequency * (step - fine) / 2)
    spectrum *= smooth((0.8 - np.abs(frequency) * 2 * step) / 0.2)
    kept = np.r_[: count // 2, count * _FINER - count // 2 : count * _FINER]
    return np.asarray(scipy.fft.ifft(spectrum[kept]) / _FINER)


def spread(
    camera: PlenopticCamera, point: NDArray[np.float64], wavelength: float, band: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Return the fractions of a point's power in the pixels."""
    step, width, steepest = band
    count = 2 * round(width / step / 2)
    field = arriving(camera, point, wavelength, (np.arange(count) - count // 2 + 0.5) * step)
    field *= lenses(camera, wavelength, 0, count, step) * lenses(camera, wavelength, 1, count, step)[:, None]
    cosine = scipy.fft.fftfreq(count, step) * wavelength * 1e-6
    square = cosine**2 + cosine[:, None] ** 2
    turns = camera.detector_distance / (wavelength * 1e-6) * (np.sqrt(np.maximum(1 - square, 0)) - 1)
    transfer = np.exp(2j * math.pi * turns) * smooth((steepest - np.sqrt(square)) / (0.15 * steepest))
    intensity = np.abs(scipy.fft.ifft2(scipy.fft.fft2(field) * transfer)) ** 2
    # the integral over each sample's own area
    shape = np.sinc(scipy.fft.fftfreq(count))
    intensity = scipy.fft.ifft2(scipy.fft.fft2(intensity) * shape * shape[:, None]).real
    pixels, each = camera.resolution[0], round(camera.pixel_size / step)
    first = count // 2 - pixels * each // 2
    inner = intensity[first : first + pixels * each, first : first + pixels * each]
    return np.asarray(inner.reshape(pixels, each, pixels, each).sum((1, 3)) * step**2)
