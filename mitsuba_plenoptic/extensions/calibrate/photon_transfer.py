r"""Gain and noise of an image sensor, from white and dark pictures: the photon transfer curve.

The variance of a pixel grows with its mean along a line, :math:`\sigma^2 = \sigma_d^2 + K (\mu - \mu_d)`, whose
slope is the gain K (Janesick 2007, "Photon Transfer"; EMVA Standard 1288, Release 4.0 Linear, section 6.6).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...detector import Detector
from ...errors import InputError, refuse_if, require_count, suggest_keywords
from ...linear import dark_variance
from ...runtime import IMAGE, Doubles, Flags, Integers, as_array
from .white_frames import level_and_noise, matching, stuck

_ORDERS = 2, 4, 6
"""Orders of the differences along either axis that remove a picture's structure: low ones leave slopes of it, and high
ones reach from narrow micro-images to their rims. Both add variance, so that the order with the least gain counts."""

_BLOCKS = 16
"""Blocks along either side that are drawn with replacement for deviations."""

_ROUNDING = 1 / 12
"""Variance of rounding."""


@dataclass(frozen=True)
class PhotonTransfer:
    """What white and dark pictures tell about a sensor; deviations are standard deviations of the estimates.

    Attributes
    ----------
    detector : Detector
        The sensor, for `expose`: gain, read noise, bits and black level. Its quantum efficiency is 1, so that photons
        count as electrons; its full well is the largest number, which it need not reach.
    gain, gain_deviation : float
        Digital numbers per electron.
    read_noise, read_noise_deviation : float
        Standard deviation of the dark signal in electrons. Where it is below half a digital number, rounding hides it,
        and the deviation says so.
    dark_offset, dark_offset_deviation : float
        Mean of the dark pictures in digital numbers: the detector's black level, not rounded, with the dark current.
    saturated_pixels, dead_pixels, hot_pixels : int
        Pixels with the largest number or a full well in a white picture; single pixels with less than a quarter of the
        light of all their neighbours; pixels that are ten standard deviations off in the dark. All are left out.
    signal, variance : array (n,)
        Points of the line: mean above the dark offset and variance, in digital numbers, from dim to bright.
    """

    detector: Detector
    gain: float
    gain_deviation: float
    read_noise: float
    read_noise_deviation: float
    dark_offset: float
    dark_offset_deviation: float
    saturated_pixels: int
    dead_pixels: int
    hot_pixels: int
    signal: Doubles
    variance: Doubles


@suggest_keywords
def photon_transfer(white: Any, dark: Any, *, bits: int | None = None) -> PhotonTransfer:
    """Return the gain and the noise of an image sensor, from pictures of something white and of darkness.

    Two or more pictures of the same white differ by noise alone, so that all pixels tell the variance. Of a single one,
    differences along rows and columns leave the noise and little else; they are taken where the picture is flattest,
    such as in the middle of micro-images, 30 % of it, and of the order, 2, 4 or 6, that leaves least. By what the next
    one leaves more, structure may still count, which is a part of the deviation. Then everything that differs from
    pixel to pixel counts as noise: unequal sensitivities of 0.5 % add a quarter to the variance of 10000 electrons, and
    the gain is as much too high. Likewise a single dark picture cannot tell unequal offsets of pixels from read noise,
    but those of whole rows and columns are left out.

    Parameters
    ----------
    white : array (rows, columns) or (n, rows, columns), or sequence of arrays
        Digital numbers of one or more pictures of the same white scene, as recorded: not demosaiced, averaged,
        resampled or compressed, which changes the noise.
    dark : array or sequence of arrays
        Digital numbers of one or more pictures with the same exposure time without light.
    bits : int, optional
        Bits of a digital number, 1 to 16. Default: 8 if no number is larger than 255, otherwise 16.

    Returns
    -------
    PhotonTransfer
        The `Detector`, with the numbers from which it is made.

    Raises
    ------
    InputError
        If pictures have different sizes or colours, are smaller than 32 pixels, do not differ in brightness, a dark
        one is cut off at 0, or wells are full: in a single white picture, or in all but 5 % of the pixels of several.

    Examples
    --------
    >>> import numpy as np
    >>> import mitsuba_plenoptic as mp
    >>> sensor, random = mp.Detector(gain=0.5, read_noise=4, full_well=20000), np.random.default_rng(1)
    >>> white = [sensor.digital_numbers(np.full((400, 400), 9000.0), random) for _ in range(2)]
    >>> dark = [sensor.digital_numbers(np.zeros((400, 400)), random) for _ in range(2)]
    >>> found = mp.photon_transfer(white, dark, bits=12)
    >>> round(found.gain, 2), round(found.read_noise, 1)
    (0.5, 4.0)
    """
    bright = _frames("white", white)
    black = _frames("dark", dark)
    matching("dark", black[0], bright[0])
    if bits is None:
        bits = 8 if max(bright.max(), black.max()) <= 255 else 16
    bits = require_count("bits", bits, maximum=16)
    top = 2**bits - 1
    refuse_if(max(bright.max(), black.max()) > top, f"bits = {bits}: the pictures have numbers up to {bright.max():g}")
    clipped = float((black <= 0).mean())
    refuse_if(
        clipped > 0.01, f"dark: {clipped:.0%} of its pixels are 0: noise is cut off; raise the camera's black level"
    )

    offset = black.mean(0)
    level, noise = level_and_noise(offset)
    # Of rounding, too.
    noise += 1
    hot = np.abs(offset - level) > 10.0 * noise
    mean_light = bright.mean(0) - level
    dead, _ = stuck(mean_light, noise)
    saturated = (bright >= top).any(0)
    bad = hot | dead | saturated
    refuse_if(
        bad.mean() > 0.5, f"white: {saturated.sum()} pixels are saturated and {dead.sum()} dead: too few are left"
    )

    # Where single pixels are saturated, the largest number cuts off the noise of those around.
    alone = saturated & (ndimage.uniform_filter(saturated.astype(np.float32), 3) < 0.9)
    refuse_if(
        len(bright) == 1 and alone.mean() > 5e-4,
        f"white: {alone.sum()} single pixels have the largest number, {top}: their noise is cut off; expose it less, "
        "or give several",
    )

    darkness = _Spread.of(black, bad)
    # Unequal pixels are noise in both pictures, or in none if there are several of each.
    alike = _Spread.of(black[:1], bad) if len(bright) == 1 else darkness

    def estimate(light: _Spread, choice: Integers | slice = slice(None)) -> tuple[float, float, float]:
        mean, variance = light.of_blocks(choice)
        _, least = alike.of_blocks(choice)
        dark_mean, dark_variance = darkness.of_blocks(choice)
        gain = (variance - least) / mean
        return gain, math.sqrt(max(dark_variance - _ROUNDING, 0)) / gain, dark_mean

    def spreads() -> list[_Spread]:
        if len(bright) > 1:
            return [_Spread.of(bright - level, bad)]
        by_order = [_Spread.of(bright - level, bad, order, 0.3) for order in _ORDERS]
        return sorted(by_order, key=lambda spread: estimate(spread)[0])

    light, *later_orders = spreads()
    smooth = ndimage.uniform_filter(mean_light, 5)
    for fraction in (0.25, 0.1, 0.03):
        # wells are full where the brightest pixels are nearer to their highest numbers than noise would spread,
        # or vary hardly more than in the dark
        brightest = light.good & (smooth >= np.quantile(smooth[light.good], 1 - fraction))
        if brightest.sum() * len(bright) < 2500:
            break
        top_mean = float(smooth[brightest].mean())
        top_variance = float(light.variances[brightest].mean())
        highest = float(np.quantile(bright[:, brightest], 0.999)) - level + 0.5
        near = highest - top_mean < 2.2 * math.sqrt(top_variance)
        if top_mean <= noise or not (near or top_variance < 1.5 * max(alike.of_blocks()[1], _ROUNDING)):
            continue
        # Full wells cut off the noise below the largest number; of several pictures the other pixels tell the gain.
        full = smooth > highest - 6.0 * math.sqrt(light.line()[1].max())
        saturated = saturated | full
        bad = bad | ndimage.binary_dilation(full, iterations=2)
        refuse_if(
            len(bright) == 1 or (~bad & (smooth > noise)).mean() < 0.05,
            f"white: its brightest pixels, of {top_mean + level:.4g}, vary by {math.sqrt(top_variance):.3g}, and the "
            f"highest number is {highest + level:.4g}: full wells cut off their noise, or there is too little light; "
            "it must be exposed otherwise",
        )
        light, *later_orders = spreads()
        break
    mean, variance = light.of_blocks()
    _, least = alike.of_blocks()
    refuse_if(
        mean <= noise or variance <= least,
        f"white: its mean is {mean + level:.4g} and its variance {variance:.4g}, those of the dark picture are "
        f"{level:.4g} and {least:.4g}: it must be brighter",
    )
    generator = np.random.default_rng(0)
    draws = [estimate(light, generator.integers(0, _BLOCKS**2, _BLOCKS**2)) for _ in range(200)]
    deviations = np.std(draws, axis=0)
    gain, read, dark_offset = estimate(light)
    if later_orders:
        deviations[0] = math.hypot(deviations[0], estimate(later_orders[0])[0] - gain)
    if darkness.of_blocks()[1] < 0.25 + _ROUNDING:
        deviations[1] = max(deviations[1], math.sqrt(_ROUNDING) / gain)
    black_level = min(max(round(dark_offset), 0), top - 1)
    detector = Detector(
        quantum_efficiency=1.0,
        full_well=max((top - black_level) / gain, 1.0),
        read_noise=read,
        bits=bits,
        gain=gain,
        black_level=black_level,
    )
    signal, variances = light.line()
    return PhotonTransfer(
        detector=detector,
        gain=gain,
        gain_deviation=float(deviations[0]),
        read_noise=read,
        read_noise_deviation=float(deviations[1]),
        dark_offset=dark_offset,
        dark_offset_deviation=float(deviations[2]),
        saturated_pixels=int(saturated.sum()),
        dead_pixels=int(dead.sum()),
        hot_pixels=int(hot.sum()),
        signal=signal,
        variance=variances,
    )


def _frames(name: str, value: Any) -> Doubles:
    """Return one or more pictures as an array (n, rows, columns) of digital numbers."""
    rule = "it must be pictures of digital numbers"
    alone = getattr(value, "ndim", 3) == 2
    frames = as_array(name, value, IMAGE[:2] if alone else ("frame", *IMAGE[:2]), rule=rule)
    frames = frames[None] if frames.ndim == 2 else frames
    refuse_if(
        frames.ndim != 3 or min(frames.shape[1:], default=0) < 32 or not len(frames),
        f"{name} of shape {frames.shape}: it must be (rows, columns) or (n, rows, columns), at least 32 of each",
    )
    refuse_if(not np.isfinite(frames).all(), f"{name}: its numbers must be finite")
    return frames


@dataclass(frozen=True, eq=False)
class _Spread:
    """Means and variances of the pixels of one or more pictures, with the pixels that are used."""

    means: Doubles
    variances: Doubles
    good: Flags

    @classmethod
    def of(cls, frames: Doubles, bad: Flags, order: int = _ORDERS[-1], flattest: float = 1.0) -> _Spread:
        """Return the spread between pictures, or of a single picture about its smooth part where it is flattest."""
        if len(frames) > 1:
            # Lamps flicker: pictures are compared at the same brightness.
            scale = frames.mean((1, 2)) / frames.mean() if abs(frames.mean()) > frames.std() else np.ones(len(frames))
            even = frames / scale[:, None, None]
            return cls(even.mean(0), even.var(0, ddof=1), ~bad)
        picture = frames[0]
        steps = np.array([math.comb(order, k) * (-1.0) ** k for k in range(order + 1)])
        steps /= np.sqrt((steps**2).sum())
        # The squared differences have the variance of this mean of their pixels.
        means = _both(picture, steps**2)
        squares = _both(picture, steps) ** 2
        good = ~ndimage.binary_dilation(bad, np.ones((len(steps),) * 2, bool))
        if flattest < 1:
            orders = ((0, 1), (1, 0), (0, 2), (1, 1), (1, 1), (2, 0))
            change = sum(ndimage.gaussian_filter(picture, 1.5, order=order) ** 2 for order in orders)
            # Over the noise that the mean promises.
            rough = ndimage.uniform_filter(change, len(steps)) / np.maximum(
                means, max(float(means.mean()) * 1e-3, 1e-12)
            )
            good &= rough <= np.quantile(rough[good], flattest)
        return cls(means, squares, good)

    @cached_property
    def _blocks(self) -> Doubles:
        """The number of used pixels, and the sums of their means and of their variances, in each block (3, blocks)."""
        row, column = (np.arange(count) * _BLOCKS // count for count in self.good.shape)
        block = (row[:, None] * _BLOCKS + column)[self.good]
        sums = [np.bincount(block, values[self.good], _BLOCKS**2) for values in (self.means, self.variances)]
        return np.stack([np.bincount(block, minlength=_BLOCKS**2), *sums])

    def of_blocks(self, choice: Integers | slice = slice(None)) -> tuple[float, float]:
        """Return mean and variance of the used pixels of some blocks, by default of all."""
        count, mean, variance = self._blocks[:, choice].sum(1)
        return float(mean / count), float(variance / count)

    def line(self) -> tuple[Doubles, Doubles]:
        """Return means and variances of equal numbers of used pixels, from dim to bright."""
        groups = np.array_split(np.argsort(self.means[self.good]), 12)
        means, variances = (
            np.array([values[self.good][rows].mean() for rows in groups]) for values in (self.means, self.variances)
        )
        return means, variances


def _both(picture: Doubles, weights: Doubles) -> Doubles:
    """Return a picture filtered by weights along both axes."""
    return ndimage.correlate1d(ndimage.correlate1d(picture, weights, 0), weights, 1)


def electrons(white: NDArray[np.floating]) -> float:
    """Return the electrons of a pixel of value 1, from the differences of neighbours in a white picture.

    It is the photon noise that explains these; unequal pixels count as noise, too.
    """
    bright = ndimage.binary_erosion(white > 0.8 * np.quantile(white, 0.99), iterations=3)
    return float(white[bright].mean()) / _deviation(white, bright) ** 2


def _deviation(picture: NDArray[np.floating], chosen: Flags) -> float:
    """Return the standard deviation of chosen pixels, from differences to their neighbours on the left and right."""
    second = ((2 * picture - np.roll(picture, 1, 1) - np.roll(picture, -1, 1)) / np.sqrt(6))[chosen]
    return level_and_noise(second)[1]


@dataclass(frozen=True)
class SensorNoise:
    """Digital numbers per electron, variance of a dark pixel in electrons squared, and where both come from."""

    gain: float
    dark_variance: float
    source: str

    @classmethod
    def of(cls, white: Doubles, dark: Doubles | None, light_field: Doubles) -> SensorNoise:
        """Return the noise by white and dark picture; where these do not tell it, by differences of neighbours."""
        try:
            refuse_if(dark is None, "no dark picture")
            found = photon_transfer(white, dark)
            source = "noise: from the white and the dark picture"
            return cls(found.gain, dark_variance(found.read_noise, found.gain), source)
        except InputError as error:
            reason = str(error)
        gain = 1 / electrons(white)
        # What differs in the darkest places is hardly of photons.
        around = ndimage.uniform_filter(light_field, 5)
        darkest = around <= np.quantile(around, 0.02)
        read_noise = _deviation(light_field, darkest) / gain
        source = (
            "noise: from differences of neighbours, of photons in the white picture and of the sensor in the darkest "
            f"places ({reason})"
        )
        return cls(gain, dark_variance(read_noise, gain), source)
