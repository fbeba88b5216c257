"""Speckle, fringes and coherence of captures of laser light against closed forms."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import j1
from scipy.stats import kstest

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, laser

from .. import Row, case, figure

WAVELENGTH = 633.0
LENGTH = WAVELENGTH * 1e-6

OPEN = PlenopticCamera(
    focal_length=40, aperture_radius=1, mla_distance=60, mla_focal_length=1e4, mla_pitch=0.64, detector_distance=0.1,
    detector_width=2.3, resolution=(360, 360),
)  # fmt: skip
"""A camera whose microlenses have no power: its speckle is that of a plain camera, the same everywhere."""

SMALL = PlenopticCamera(
    focal_length=40, aperture_radius=1.25, mla_distance=60, detector_width=0.256, resolution=(128, 128)
)
"""A plenoptic camera of 4 x 4 lenses."""

DISTANCE = 120.0
"""Distance that both focus on the array, at half the size."""

RESOLVED = 1.22 * LENGTH * OPEN.mla_distance / (2 * OPEN.aperture_radius)
"""Radius of the Airy disc on the array, which is also the distance of independent samples."""


def wall(camera: PlenopticCamera, per_spot: float, seed: int = 0) -> NDArray[np.float64]:
    """Return points of a rough wall in focus, in a jittered grid with some in each square of side lambda / NA."""
    spot = LENGTH * DISTANCE / (2 * camera.aperture_radius)
    side = camera.detector_width * DISTANCE / camera.mla_distance + 8 * spot
    count = math.ceil(side / spot * math.sqrt(per_spot))
    cells = np.stack(np.meshgrid(np.arange(count), np.arange(count)), -1).reshape(-1, 2)
    place = (cells + np.random.default_rng(seed).random(cells.shape)) * (side / count) - side / 2
    return np.column_stack([place, np.full(len(place), DISTANCE)])


def operator_of(camera: PlenopticCamera, points: NDArray[np.float64]) -> CaptureOperator:
    """Return the operator of points at the wavelength of all figures."""
    return CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field")


def patterns(camera: PlenopticCamera, per_spot: float, modes: int) -> tuple[list[NDArray[np.float32]], float]:
    """Return intensities of realisations in the plane of the array, over the detector alone, and their pitch."""
    operator, rng, found = operator_of(camera, wall(camera, per_spot)), np.random.default_rng(1), []
    for _ in range(modes):
        field = operator.field(np.exp(2j * math.pi * rng.random(len(operator.points))), plane="array")
        x = field.origin[0] + np.arange(field.samples.shape[1]) * field.pitch
        inside = np.flatnonzero(np.abs(x) < camera.detector_width / 2)
        held = slice(int(inside[0]), int(inside[-1]) + 1)
        found.append(np.abs(field.samples[held, held]) ** 2)
    return found, field.pitch


def contrast(intensity: NDArray[np.float32]) -> float:
    """Return the standard deviation over the mean."""
    return float(intensity.std(dtype=np.float64) / intensity.mean(dtype=np.float64))


def grain_width(intensity: NDArray[np.float32], pitch: float) -> float:
    """Return the full width at half maximum of the autocovariance, which is circular, in millimetres."""
    change = intensity - intensity.mean(dtype=np.float64)
    size = 2 * change.shape[0]
    product = np.fft.irfft2(np.abs(np.fft.rfft2(change, (size, size))) ** 2, (size, size))
    lags = np.arange(1, 40)
    overlap = change.shape[0] * (change.shape[0] - lags)
    along = (product[0, lags] + product[lags, 0]) / 2 / overlap / (product[0, 0] / change.size)
    lag = np.concatenate([[0.0], lags]) * pitch
    value = np.concatenate([[1.0], along])
    k = int(np.argmax(value < 0.5))
    # A parabola through the three samples nearest to the half.
    fit = np.polyfit(value[k - 2 : k + 2], lag[k - 2 : k + 2], 3)
    return float(2 * np.polyval(fit, 0.5))


def airy(radius: NDArray[np.float64], width: float) -> NDArray[np.float64]:
    """Return 2 J1(pi r / w) / (pi r / w), with w the wavelength over the angle of a disc."""
    v = math.pi * np.maximum(np.abs(radius), 1e-12) / width
    return np.asarray(2 * j1(v) / v)


def pixel_contrast(camera: PlenopticCamera) -> float:
    """Return the contrast of speckle that is integrated over square pixels, from its autocovariance.

    The square is (1 / A^2) times the integral of the squared Airy amplitude times the pixel's autocorrelation (Goodman,
    "Speckle Phenomena in Optics", chapter 4).
    """
    nodes, weights = np.polynomial.legendre.leggauss(60)
    lag, weight = (nodes + 1) / 2 * camera.pixel_size, weights / 2
    inner = 2 * weight * (1 - lag / camera.pixel_size)
    covariance = airy(np.hypot(lag[:, None], lag), LENGTH * camera.mla_distance / (2 * camera.aperture_radius)) ** 2
    return math.sqrt(float(inner @ covariance @ inner))


def exponential_test(intensity: NDArray[np.float32], pitch: float) -> tuple[int, float]:
    """Return the count of independent samples, and the Kolmogorov-Smirnov p of a negative exponential distribution."""
    step = math.ceil(RESOLVED / pitch)
    samples = intensity[::step, ::step].ravel()
    return samples.size, float(kstest(samples / intensity.mean(dtype=np.float64), "expon").pvalue)


def visibility(points: int = 4000) -> float:
    """Return the largest error of the coherence on the pupil of an incoherent disc, by van Cittert and Zernike.

    The adjoint takes a sample of the pupil to the conjugate fields there of all points, so the coherence of two samples
    is a sum over points, without noise.
    """
    angle = np.arange(points) * (math.pi * (3 - math.sqrt(5)))
    diameter = 1.5 * LENGTH * DISTANCE / OPEN.aperture_radius
    disc = np.sqrt((np.arange(points) + 0.5) / points) * diameter / 2
    place = np.column_stack([disc * np.cos(angle), disc * np.sin(angle), np.full(points, DISTANCE)])
    operator = operator_of(OPEN, place)
    rows = operator.field(np.ones(points), plane="pupil")
    size, pitch = rows.samples.shape[0], rows.pitch
    middle = round(-rows.origin[1] / pitch)
    reach = math.floor(0.9 * OPEN.aperture_radius / pitch)
    columns = np.linspace(middle - reach, middle + reach, 21).astype(int)
    fields = []
    for column in columns:
        sample = np.zeros((size, size), np.complex64)
        sample[middle, column] = 1
        fields.append(operator.field_adjoint(sample, plane="pupil").conj())
    power = [np.vdot(field, field).real for field in fields]
    found = [np.vdot(field, fields[0]) / math.sqrt(own * power[0]) for field, own in zip(fields, power, strict=True)]
    # A source on the axis of a thin lens: the phases of the two samples' paths cancel by symmetry only in the modulus.
    exact = airy((columns - columns[0]) * pitch, LENGTH * DISTANCE / diameter)
    return float(np.abs(np.abs(found) - np.abs(exact)).max())


def fringes() -> tuple[float, float]:
    """Return relative errors of period and contrast of the fringes of two coherent points behind the array's plane.

    Their images lie at a distance L behind the array and d apart, so the period is lambda L / d (Young). The
    amplitudes 1 and 1/2 have the contrast 2 a / (1 + a^2) = 0.8.
    """
    camera = OPEN.replace(aperture_radius=2.5, detector_width=2.4, resolution=(600, 600))
    near, apart, ratio = 60.0, 0.15, 0.5
    operator = operator_of(camera, np.array([(-apart / 2, 0, near), (apart / 2, 0, near)]))
    both, one, two = (operator.field(given, plane="array") for given in ([1, ratio], [1, 0], [0, ratio]))
    image = 1 / (1 / camera.focal_length - 1 / near)
    beyond = image - camera.mla_distance
    period = LENGTH * beyond / (apart * image / near)
    x = both.origin[0] + np.arange(both.samples.shape[1]) * both.pitch
    inner = np.abs(x) < 0.7
    held = np.ix_(inner, inner)
    parts = np.abs(one.samples[held]) ** 2 + np.abs(two.samples[held]) ** 2
    line = (np.abs(both.samples[held]) ** 2).sum(0) / parts.sum(0)

    def residual(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(1 + p[0] * np.cos(2 * math.pi * x[inner] / (period * p[1]) + p[2]) - line)

    start = np.angle(np.sum((line - 1) * np.exp(-2j * math.pi * x[inner] / period)))
    fit = least_squares(residual, [0.8, 1.0, start]).x
    return float(abs(fit[1] - 1)), float(abs(abs(fit[0]) / (2 * ratio / (1 + ratio**2)) - 1))


def mean_of_realisations(modes: int, per_spot: float) -> tuple[float, float]:
    """Return the deviation of a mean over modes from the incoherent capture, over its noise, and that of their powers.

    The noise of fully developed speckle, of contrast 1 in each pixel, is the capture over the root of the modes; pixels
    that are larger than grains have less.
    """
    operator = operator_of(SMALL, wall(SMALL, per_spot))
    weights = np.ones(len(operator.points))
    mean = laser.coherent_capture(operator, weights, modes=modes, seed=5)
    exact = CaptureOperator(SMALL, operator.points, wavelength=WAVELENGTH).forward(weights)
    bright = exact > 0.1 * exact.max()
    noise = math.sqrt(float(np.mean((mean[bright] / exact[bright] - 1) ** 2)) * modes)
    return noise, float(abs(mean[bright].sum() / exact[bright].sum() - 1))


@case(
    "speckle",
    "Laser light: contrast, grains and distribution of speckle, coherence and fringes against closed forms",
    page="docs/theory/coherence.md",
    quick={"width": 0.8, "modes": 2, "realisations": 8},
)
def speckle(
    *, width: float = OPEN.detector_width, per_spot: float = 30, modes: int = 32, realisations: int = 200
) -> Iterator[Row]:
    """Take a rough wall in focus, with `per_spot` points in each square of side lambda / NA, and fewer for the mean."""
    camera = OPEN.replace(detector_width=width, resolution=(round(width / OPEN.pixel_size),) * 2)
    found, pitch = patterns(camera, per_spot, modes)
    spot = LENGTH * camera.mla_distance / (2 * camera.aperture_radius)
    grains = (width / spot) ** 2
    # The contrast of a finite pattern scatters by about 1 / sqrt(grains), the mean by 1 / sqrt(modes).
    bound, mean_bound = max(0.02, 2 / math.sqrt(grains)), max(0.01, 0.14 / math.sqrt(realisations))
    yield figure("grains, squares of side lambda b / D on the array", grains)
    for count in [n for n in (1, 2, 8, 32) if n <= modes]:
        error = abs(contrast(np.mean(found[:count], axis=0)) * math.sqrt(count) - 1)
        yield figure(f"contrast of {count} modes over 1/sqrt({count}), less 1", error, at_most=bound)
    # Half of (2 J1(v) / v)^2 lies at v = 1.6163.
    error = grain_width(found[0], pitch) / (2 * 1.61634 / math.pi * spot) - 1
    yield figure("width of a grain over 1.029 lambda b / D, less 1", abs(error), at_most=0.03)
    samples, p = exponential_test(found[0], pitch)
    yield figure(f"Kolmogorov-Smirnov p of {samples} samples, negative exponential", p, at_least=0.01)
    operator = operator_of(camera, wall(camera, per_spot))
    for count in [n for n in (1, 8) if n <= modes]:
        weights = np.ones(len(operator.points))
        images = [laser.coherent_capture(operator, weights, modes=count, seed=seed) for seed in range(2, 5)]
        error = abs(
            float(np.mean([contrast(image) for image in images])) * math.sqrt(count) / pixel_contrast(camera) - 1
        )
        yield figure(f"contrast of {count} modes after pixels, over the closed form, less 1", error, at_most=bound)
    yield figure("coherence of a disc on the pupil, largest error", visibility(), at_most=0.01)
    period, depth = fringes()
    yield figure("Young's fringes: period over lambda L / d, less 1", period, at_most=0.005)
    yield figure("Young's fringes: contrast over 2 a / (1 + a^2), less 1", depth, at_most=0.005)
    noise, power = mean_of_realisations(realisations, per_spot / 5)
    what = f"mean of {realisations} modes against the incoherent capture"
    yield figure(f"{what}: RMS deviation over that of patterns of contrast 1", noise, at_most=1.05)
    yield figure(f"{what}: ratio of powers, less 1", power, at_most=mean_bound)
