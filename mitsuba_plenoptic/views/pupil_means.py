r"""The mean point of the pupil that the samples of a view see: blur mixes light of other points, which the rim cuts.

With the pupil's transmission A and the light k of one pupil point over the samples of a lens, a sample at u reads
:math:`\int A(P)\, k(u - P)\, d^2P`, whose mean point is that of the integrand. It is nearer to the pupil's middle than
u, by which views would show too little parallax.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import scipy
import xarray as xr

from ..camera import PlenopticCamera
from ..detector import DetectorOperator
from ..optics import in_millimetres
from ..runtime import Doubles

# Samples across a pixel, and the most across the grid.
_SAMPLES = 8
_MOST = 1024

# Deviation, over that of a texture's autocorrelation, of the Gaussian of the scene's movement between two points of the
# pupil up to which light of one moves the view of the other; light that moves farther agrees with nothing.
_ALIKE = 2.0


def alike_pixels(texture: float, slope: float) -> float:
    """Return within how many pixels points of the pupil show alike what has a disparity; see `texture_of`."""
    # Quarters of octaves are fine enough, and few.
    return 2 ** (round(4 * math.log2(_ALIKE * texture / max(abs(slope), 1e-9))) / 4)


@functools.lru_cache(maxsize=64)
def light_of_views(
    camera: PlenopticCamera,
    wavelength: float | None,
    between: tuple[float, float],
    alike: float,
    u: tuple[float, ...],
    v: tuple[float, ...],
) -> tuple[Doubles, Doubles]:
    """Return the light (v, u) of views at steps along the pupil, and the sums (2, v, u) of light times its u and v.

    `between` are variances in squared pixels, along u and v, of the pixels between which samples are interpolated, and
    `alike` says within how many pixels the light of pupil points agrees.
    """
    along, spectra, spread = _pupil(camera, wavelength, *between)
    near = np.exp(-np.square(along / alike) / 2)
    transfer = scipy.fft.rfft2(spread * near * near[:, None])
    images = (scipy.fft.irfft2(spectrum * transfer, spread.shape) for spectrum in spectra)
    columns, rows = (np.rint(np.divide(steps, along[1])).astype(int) % len(along) for steps in (u, v))
    light, *sums = (image[np.ix_(rows, columns)] for image in images)
    return np.maximum(light, 1e-6), np.stack(sums)


def texture_of(lf: xr.DataArray) -> float:
    """Return the deviation in lenses of a Gaussian with the autocorrelation of the central view, without its noise."""
    view = np.nan_to_num(lf.values[lf.shape[0] // 2, lf.shape[1] // 2]).astype(np.float64)
    view -= view.mean()
    # Noise is alike in no two lenses: one and two lenses apart there is texture alone.
    near, far = (
        np.mean(view[step:] * view[:-step]) + np.mean(view[:, step:] * view[:, :-step])
        if min(view.shape) > step
        else 0.0
        for step in (1, 2)
    )
    falls = math.log(near / far) if min(near, far) > 0 else math.inf
    return float(np.clip(math.sqrt(1.5 / max(falls, 1e-9)), 0.5, 50.0))


@functools.lru_cache(maxsize=4)
def _pupil(
    camera: PlenopticCamera, wavelength: float | None, across: float, down: float
) -> tuple[Doubles, list[Any], Doubles]:
    """Return places in pixels; spectra of the pupil, and of it times both; and the light of one of its points.

    Places begin in the middle, as those of Fourier transforms.
    """
    radius = camera.pupil_radius / camera.pupil_step
    # Light of a lens that reaches farther than this meets itself from the other side.
    side = 2 * (radius + max(4.0, radius))
    samples = max(2, min(_SAMPLES, 2 * int(_MOST / side / 2)))
    count = 2 * math.ceil(side * samples / 2)
    along = scipy.fft.fftfreq(count, samples / count)
    x, y = np.meshgrid(along, along)
    pupil = camera.aperture.power(-x / radius, -y / radius)
    spectra = [scipy.fft.rfft2(values) for values in (pupil, pupil * x, pupil * y)]
    spread = scipy.fft.irfft2(_transfer(camera, wavelength, (across, down), count, samples), (count, count))
    return along, spectra, spread


def _transfer(
    camera: PlenopticCamera, wavelength: float | None, between: tuple[float, float], count: int, samples: int
) -> Doubles:
    """Return the Fourier transform, as of `rfft2`, of the light of one pupil point over the samples of a lens."""
    fx, fy = scipy.fft.rfftfreq(count, 1 / samples), scipy.fft.fftfreq(count, 1 / samples)[:, None]
    transfer = DetectorOperator.of(camera).transfer(fx, fy)
    # A pixel, and the pixels between which a sample is interpolated.
    for frequency, variance in ((fx, between[0]), (fy, between[1])):
        transfer = transfer * np.sinc(frequency) * np.sinc(frequency * math.sqrt(12 * variance))
    # Of a pupil point, a lens that is out of focus there shows its aperture, times this shift in pixels.
    smear = abs(camera.pupil_shift(camera.mla_focal_lengths[0])) / camera.pupil_step
    if smear:
        aperture = camera.lattice.aperture_image(1 / samples, smear)
        aperture = np.pad(aperture, (0, max(0, count - len(aperture))))[:count, :count]
        transfer = transfer * np.abs(scipy.fft.rfft2(aperture))
    if wavelength is not None:
        # The spot's transform is the autocorrelation of the aperture, at distances that are frequencies times this.
        lag = in_millimetres(wavelength) * camera.reduced_distance / camera.pixel_size
        opening = camera.lattice.aperture_image(lag * samples / count, 1.0)
        size = 2 * len(opening)
        pairs = scipy.fft.irfft2(np.abs(scipy.fft.rfft2(opening, (size, size))) ** 2, (size, size))
        row, column = (np.rint(np.abs(f) * count / samples).astype(int).ravel() for f in (fy, fx))
        shared = pairs[np.ix_(np.minimum(row, len(opening)), np.minimum(column, len(opening)))] / pairs[0, 0]
        transfer = transfer * shared
    return np.asarray(transfer)
