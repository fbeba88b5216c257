"""Metrics of images and captures: differences and similarity, interference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import scipy
import skimage.metrics

from ..camera import PlenopticCamera
from ..design import native_field
from ..fields import clear
from ..io import Capture
from ..runtime import Array, Named, as_array
from ..views import white_image

_WINDOW = 7
"""Pixels across the window of the structural similarity."""


@dataclass(frozen=True)
class ImageMetrics:
    """Differences of an image from its reference: PSNR, SSIM and others.

    Attributes
    ----------
    psnr : float
        Peak signal-to-noise ratio in dB; the peak is the reference's maximum.
    ssim : float or None
        Structural similarity over windows of 7 x 7 pixels, the data's range being the reference's maximum; None for
        images that have no such window, or a black reference.
    energy : float
        Sum over the reference's sum.
    """

    psnr: float
    ssim: float | None
    energy: float


def rounded(metrics: ImageMetrics | Difference) -> Named:
    """Return figures by name, rounded to their significant digits."""
    return {name: round(value, 5) if isinstance(value, float) else value for name, value in asdict(metrics).items()}


def ssim_text(ssim: float | None) -> str:
    """Return a structural similarity as text, also for images too small to have one."""
    return "not defined" if ssim is None else f"{ssim:.3f}"


def common_scale(images: Sequence[Array], references: Sequence[Array]) -> float:
    """Return the common factor on all images that fits them best to their references (least squares)."""
    products = sum(float(np.nansum(a * b)) for a, b in zip(images, references, strict=True))
    squares = sum(float(np.sum(np.square(a), where=~np.isnan(a * b))) for a, b in zip(images, references, strict=True))
    return products / squares if squares > 0 else 1.0


def image_metrics(image: Array, reference: Array) -> ImageMetrics:
    """Return the metrics of an image (rows, columns[, channels]) against a reference of its shape, brightness included.

    Samples that are NaN in either are not compared: the error, the peak and the sums are those of all others, the
    structural similarity that of the windows without such samples, by channel.
    """
    image = as_array("image", image, dtype=np.float32)
    reference = as_array("reference", reference, dtype=np.float32)
    finite = ~(np.isnan(image) | np.isnan(reference))
    if not finite.any():
        return ImageMetrics(psnr=math.nan, ssim=None, energy=math.nan)
    peak = float(reference[finite].max())
    mean_square = float(np.mean((image - reference)[finite] ** 2, dtype=np.float64))
    energy, total = (float(pixels[finite].sum(dtype=np.float64)) for pixels in (image, reference))
    window = (_WINDOW, _WINDOW, 1)[: image.ndim]
    # Windows that lie within the image and know all of their samples.
    complete = scipy.ndimage.minimum_filter(finite, window, mode="constant", cval=0)
    ssim = None
    if complete.any() and peak > 0:
        channels = -1 if image.ndim == 3 else None
        _, likeness = skimage.metrics.structural_similarity(
            np.where(finite, image, 0),
            np.where(finite, reference, 0),
            win_size=_WINDOW,
            data_range=peak,
            channel_axis=channels,
            full=True,
        )
        ssim = float(likeness[complete].mean(dtype=np.float64))
    psnr = math.inf if mean_square == 0 else -math.inf
    if mean_square > 0 and peak > 0:
        psnr = -10 * math.log10(mean_square / peak**2)
    # Nothing is as bright as a black reference but what is black itself.
    return ImageMetrics(psnr, ssim, energy / total if total > 0 else 1.0 if energy == 0 else math.inf)


def relative_error(image: Array, reference: Array) -> float:
    """Return the root of the summed squared differences over the root of the reference's squared sum."""
    reference = as_array("reference", reference)
    return float(np.linalg.norm(as_array("image", image) - reference) / np.linalg.norm(reference))


def interference(image: Array, limit: Array, region: Array | tuple[slice, slice]) -> float:
    """Return the RMS difference of a reconstruction from the limit without interference, over the limit's mean.

    The root mean square is taken within a region of bins. A high-pass filter would not serve as a measure, since it
    responds to any detail.

    Parameters
    ----------
    image : array
        The reconstruction.
    limit : array
        The same plane without interference, such as by ``method="incoherent"``.
    region : array of bool, or pair of slice
        The bins that count, such as those of `lit_region`.
    """
    limit = as_array("limit", limit, dtype=None)
    difference = as_array("image", image)[region] - limit[region]
    mean = float(np.nanmean(limit[region], dtype=np.float64))
    return float(np.sqrt(np.nanmean(difference**2)) / mean) if mean > 0 else 0.0


def lit_region(limit: Array) -> Array:
    """Return a mask of the bins brighter than a tenth of the brightest one."""
    return limit > 0.1 * np.nanmax(limit)


def shape_window(camera: PlenopticCamera, low: Array, high: Array) -> tuple[slice, slice] | None:
    """Return the bins (rows, columns) of a scene's box, seen from the main lens's centre; None if none is seen.

    The box's corners (x, y, z) are given in the camera's frame; its depth is taken as the depth of its middle.
    """
    z = (low[2] + high[2]) / 2
    spans = []
    for axis in (1, 0):
        count = camera.bin_count[axis]
        # Image coordinates grow against the scene's.
        ends = [-value / camera.bin_size(z) + count / 2 for value in (high[axis], low[axis])]
        span = slice(max(0, math.floor(ends[0])), min(count, math.ceil(ends[1])))
        if span.start >= span.stop:
            return None
        spans.append(span)
    return spans[0], spans[1]


@dataclass(frozen=True)
class Difference:
    """Difference of two captures over some pixels, relative to the root mean square of the second capture.

    Attributes
    ----------
    measured : float
        The measured difference, noise included.
    noise : float or None
        The difference by noise alone; None if a capture does not state its noise.
    true : float or None
        The difference without noise.
    noise_alone : bool or None
        Whether noise explains the measured difference.
    """

    measured: float
    noise: float | None
    true: float | None
    noise_alone: bool | None


def capture_difference(a: Capture, b: Capture, pixels: Array | None = None) -> Difference:
    """Return the difference of two captures of one camera, over some pixels or over all.

    Parameters
    ----------
    a, b : Capture
        The captures, with the noise that ``render_capture(..., noise=True)`` keeps.
    pixels : array of bool, optional
        The pixels that count. Default: all.
    """
    where = ... if pixels is None else pixels
    reference = float(np.sum(np.square(b.image, dtype=np.float64)))
    squares = float(np.sum(np.square(a.image.astype(np.float64) - b.image)[where]))
    measured = _root(squares, reference)
    if a.noise is None or b.noise is None:
        return Difference(measured, None, None, None)
    variances = (np.square(a.noise, dtype=np.float64) + np.square(b.noise, dtype=np.float64))[where]
    expected = float(variances.sum())
    # A squared normal deviate has twice the square of its variance for a variance.
    uncertain = math.sqrt(2 * float(np.sum(variances**2)))
    excess = squares - expected
    # Variances may be wrong by 3 % themselves: their estimates rest on sixteen numbers a pixel.
    alone = excess <= max(3.0 * uncertain, 0.03 * expected)
    return Difference(measured, _root(expected, reference), _root(excess, reference), alone)


@dataclass(frozen=True)
class ContrastChange:
    """A change of contrast between two images of one plane that is more than noise.

    Attributes
    ----------
    ratio : float
        Contrast of the second image over that of the first.
    frequency : float
        Where it is, in cycles a bin.
    finest : float
        The highest frequency, in cycles a bin, at which a change of a twentieth would have been seen.
    """

    ratio: float
    frequency: float
    finest: float


def contrast_change(first: Array, second: Array, truth: Array) -> ContrastChange:
    """Return a change of contrast from the first image to the second; its ratio is 1 if none is more than noise.

    The change is that at the lowest frequency where it reaches a fifth, otherwise the largest.

    Both spectra are projected onto that of the truth, whose noise is independent of theirs; so noise adds nothing to
    the ratio but its scatter, which is that of what the ratio leaves. Changes count from a twentieth, and three
    standard deviations, on.
    """
    seen = ~np.isnan(first + second + truth)
    edge = np.outer(*(scipy.signal.windows.hann(size, sym=False) for size in truth.shape))
    a, b, t = (
        scipy.fft.fft2(np.where(seen, image - np.mean(image[seen]), 0) * edge) for image in (first, second, truth)
    )
    radius = np.hypot(*np.meshgrid(*map(scipy.fft.fftfreq, truth.shape), indexing="ij"))
    found = ContrastChange(1.0, 0.0, 0.0)
    for low in np.arange(0.02, 0.5, 0.03):
        ring = (radius >= low) & (radius < low + 0.03)
        waves, by_rays, by_waves = t[ring], a[ring], b[ring]
        along = np.vdot(waves, by_rays).real
        left = by_rays - along / (np.vdot(waves, waves).real or 1) * waves
        # Where the first image itself is noise, it has no contrast to be changed.
        if along <= 5 * np.linalg.norm(left * waves):
            continue
        ratio = float(np.vdot(waves, by_waves).real / along)
        # The window correlates neighbouring frequencies, whose sum scatters twice as much as if they were independent.
        scatter = 6 * np.linalg.norm((by_waves - ratio * by_rays) * waves) / along
        if scatter < 0.05:
            found = replace(found, finest=low)
        if abs(ratio - 1) > max(scatter, 0.05, abs(found.ratio - 1)) and abs(found.ratio - 1) < 0.2:
            found = replace(found, ratio=ratio, frequency=low + 0.015)
    return found


def middle_of_micro_images(camera: PlenopticCamera) -> Array:
    """Return a mask (rows, columns) of pixels that see the main lens, or a field, within four fifths of its radius."""
    lens = camera.objective
    if lens is None:
        return white_image(clear(camera.replace(aperture_radius=0.8 * camera.aperture_radius))) > 0.5
    # In the Fourier arrangement micro-images are bounded by the field.
    narrow = replace(lens, field_stop=0.8 * native_field(camera) * lens.magnification / 2)
    return white_image(clear(camera.replace(main_lens=narrow))) > 0


def _root(squares: float, reference: float) -> float:
    return math.sqrt(max(squares, 0.0) / reference) if reference > 0 else 0.0
