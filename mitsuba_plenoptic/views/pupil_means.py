r"""The mean point of the pupil that the samples of a view see: blur mixes light of other points, which the rim cuts.

With the pupil's transmission A and the light k of one pupil point over the samples of a lens, a sample at u reads
:math:`\sum_n \int A(P)\, k(u - P - n N)\, d^2P` from lenses n pitches away, whose micro-images are N pixels apart. At
a disparity :math:`\delta` in lenses per view, what these show at P a lens itself shows at :math:`P - n / \delta`. The
mean of these points is nearer to the pupil's middle than u, by which views would show too little parallax.
"""

import functools
import itertools
import math
from typing import Any

import numpy as np
import scipy
import xarray as xr

from ..camera import PlenopticCamera
from ..detector import DetectorOperator
from ..optics import in_millimetres
from ..runtime import Doubles, Numbers, Pair

# Samples across a pixel, and the most across the grid.
_SAMPLES = 4
_MOST = 512


@functools.lru_cache(maxsize=256)
def light_of_views(
    camera: PlenopticCamera,
    wavelength: float | None,
    spreads: Pair,
    texture: float,
    slope: float,
    u: Numbers,
    v: Numbers,
) -> Pair:
    """Return the light (v, u) of views at steps along the pupil, and the sums (2, v, u) of light times its u and v.

    `spreads` are variances in squared pixels, along u and v, of the light of samples; see `spread_of_samples`.
    `texture` is that of `texture_of`, and `slope` the disparity, not 0.
    """
    samples, spectra, spread, around = _pupil(camera, wavelength, spreads)
    count = spectra.shape[1]
    places = np.arange(-(count // 2), count // 2) / samples
    kernels = np.zeros((3, count, count))
    for lenses in around:
        # 1.6: Deviation, over that of a texture's autocorrelation, of the Gaussian of the scene's movement
        # between two points of the pupil up to which light of one moves the view of the other; light that
        # moves farther agrees with nothing.
        x, y = (np.exp(-np.square((places * slope + away) / (1.6 * texture)) / 2) for away in lenses)
        pixels = lenses * camera.micro_image_pitch / camera.pixel_size
        column, row = (len(spread) - count) // 2 - np.rint(pixels * samples).astype(int)
        light = spread[row : row + count, column : column + count] * x * y[:, None]
        kernels += light * np.array([1, *(-lenses / slope)])[:, None, None]
    near, *beside = scipy.fft.rfft2(scipy.fft.ifftshift(kernels, axes=(1, 2)))
    columns, rows = (np.rint(np.multiply(steps, samples)).astype(int) % count for steps in (u, v))
    spectra = [spectra[0] * near, *(spectra[1:] * near + spectra[0] * np.stack(beside))]
    light, *sums = scipy.fft.irfft2(spectra, (count, count))[:, rows[:, None], columns]
    return np.maximum(light, 1e-6), np.asarray(sums)


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
def _pupil(camera: PlenopticCamera, wavelength: float | None, spreads: Pair) -> tuple[int, Any, Doubles, Doubles]:
    """Return samples a pixel; spectra of the pupil, and of it times both coordinates; the light of one of its points.

    Last are places (lenses, 2) of a lens and those around it, in pitches. The light's middle is that of its array.
    """
    radius = camera.pupil_radius / camera.pupil_step
    # Light of a lens that reaches farther than this meets itself from the other side.
    side = 2 * (radius + max(4.0, radius))
    samples = max(2, min(_SAMPLES, 2 * int(_MOST / side / 2)))
    count = 2 * math.ceil(side * samples / 2)
    along = scipy.fft.fftfreq(count, samples / count)
    x, y = np.meshgrid(along, along)
    pupil = camera.aperture.power(-x / radius, -y / radius)
    spectra = scipy.fft.rfft2(pupil * np.stack([np.ones_like(x), x, y]))
    # Light from both sides of the grid meets twice as far away as the lenses around.
    around = np.array([*itertools.product(range(-1, 2), repeat=2)]) @ camera.lattice.regular.basis / camera.row_pitch
    reach = 2 * around.max() * camera.micro_image_pitch / camera.pixel_size
    wide = count + 2 * math.ceil(reach * samples)
    spread = scipy.fft.irfft2(_transfer(camera, wavelength, spreads, wide, samples), (wide, wide))
    return samples, spectra, scipy.fft.fftshift(spread), around


def _transfer(camera: PlenopticCamera, wavelength: float | None, spreads: Pair, count: int, samples: int) -> Doubles:
    """Return the Fourier transform, as of `rfft2`, of the light of one pupil point over the samples of a lens."""
    fx, fy = scipy.fft.rfftfreq(count, 1 / samples), scipy.fft.fftfreq(count, 1 / samples)[:, None]
    transfer = DetectorOperator.of(camera).transfer(fx, fy)
    # A pixel, and the pixels between which a sample is interpolated.
    for frequency, variance in zip((fx, fy), spreads, strict=True):
        transfer = transfer * np.sinc(frequency) * np.sinc(frequency * math.sqrt(12 * variance - 1))
    # Of a pupil point, a lens that is out of focus there shows its aperture, times this shift in pixels.
    smears = [abs(camera.pupil_shift(f2)) / camera.pupil_step for f2 in camera.mla_focal_lengths]
    images = (camera.lattice.aperture_image(1 / samples, smear)[:count, :count] for smear in smears)
    transforms = (
        scipy.fft.rfft2(image, (count, count)) * np.exp(2j * np.pi * (fx + fy) * (len(image) // 2 / samples))
        for image in images
    )
    transfer = transfer * sum(transform.real for transform in transforms) / len(smears)
    if wavelength is not None:
        # The spot's transform is the autocorrelation of the aperture, at distances that are frequencies times this.
        lag = in_millimetres(wavelength) * camera.reduced_distance / camera.pixel_size
        opening = camera.lattice.aperture_image(lag * samples / count, 1.0)
        size = 2 * len(opening)
        pairs = scipy.fft.irfft2(np.abs(scipy.fft.rfft2(opening, (size, size))) ** 2, (size, size))
        row, column = (np.rint(np.abs(f) * count / samples).astype(int).ravel() for f in (fy, fx))
        shared = pairs[np.ix_(np.minimum(row, len(opening)), np.minimum(column, len(opening)))] / pairs[0, 0]
        transfer = transfer * shared
    return transfer
