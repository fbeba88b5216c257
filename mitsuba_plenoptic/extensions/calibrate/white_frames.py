"""White pictures and dark frames as sensors record them: dark signal, saturated, dead and unlit pixels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.ndimage

from ... import choices
from ...errors import refuse_if, warn
from ...io import EXPOSED, RECORDED, Capture, read_numbers
from ...runtime import Array, Pair, as_pixels
from ...views import read_recording

_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
"""The neighbours of a pixel."""


@dataclass(frozen=True)
class WhiteFrame:
    """A white picture less its dark frame, with a mask of the pixels that count.

    Attributes
    ----------
    light : (rows, columns) float64 array
        Values proportional to light.
    good : (rows, columns) bool array
        Pixels that are lit, and neither saturated nor defective.
    saturated, defective, unlit : int
        Numbers of pixels that are not good: at the picture's largest value, defective in the dark frame, and in rows
        and columns outside the lit part of the sensor.
    """

    light: Array
    good: Array
    saturated: int
    defective: int
    unlit: int

    @classmethod
    def of(cls, white: Array | Capture, dark: Array | None = None) -> WhiteFrame:
        """Return the frame of a white picture (rows, columns) and a dark one of the same size."""
        light = single_channel("white", white)
        # What no detector has recorded may be as bright in many pixels.
        computed = isinstance(white, Capture) and not {EXPOSED, RECORDED} & white.metadata.keys()
        saturated = np.zeros(light.shape, bool) if computed else clipped("white", light)
        defective = np.zeros(light.shape, bool)
        if dark is not None:
            dark = matching("dark", dark, light)
            level, noise = level_and_noise(dark)
            defective = np.abs(dark - level) > 10.0 * max(noise, 1e-3 * np.ptp(light))
            refuse_if(dark.mean() > 0.5 * light.mean(), "dark: it is not darker than half of the white picture")
            light = light - dark
        lit_range = []
        for axis in (0, 1):
            mean = light.mean(axis=1 - axis)
            lit = np.flatnonzero(mean > 0.1 * np.median(mean))
            refuse_if(not len(lit), "white: it is dark")
            lit_range.append(slice(lit[0], lit[-1] + 1))
        unlit = np.ones(light.shape, bool)
        unlit[tuple(lit_range)] = False
        defective &= ~unlit
        good = ~(saturated | defective | unlit)
        return cls(light, good, int(saturated.sum()), int(defective.sum()), int(unlit.sum()))


def sensor_pictures(white: Path, **others: Path | None) -> list:
    """Return the values of a sensor's pictures, (rows, columns), the white one first; None where there is no file.

    They are proportional to light: the numbers in a picture. Pictures have one channel, and the size of the white one.
    """
    light = single_channel("white", values_of(white))
    named = {name.replace("_", " "): path for name, path in others.items()}
    pictures = [None if path is None else matching(name, values_of(path), light) for name, path in named.items()]
    return [light, *pictures]


def values_of(path: Path) -> Array | Capture:
    """Return the numbers in a picture, or a capture that tells whether a detector recorded it."""
    if path.suffix.lower() in choices.RAW_SUFFIXES:
        return read_numbers(path).numbers.astype(np.float64)
    return read_recording(path, linear=True)


def level_and_noise(values: Array) -> Pair:
    """Return the median of values and the deviation of usual ones from it."""
    level = float(np.median(values))
    return level, 1.4826 * float(np.median(np.abs(values - level)))


def clipped(name: str, picture: Array) -> Array:
    """Return the pixels with the largest value of a picture, if they are not few; refuse too many."""
    highest = picture >= picture.max()
    refuse_if(
        highest.mean() > 0.1,
        f"{name}: {highest.mean():.0%} of its pixels have its largest value: at most 10% may be saturated",
    )
    return highest & (highest.mean() >= 1e-4)


def stuck(light: Array, noise: float) -> Pair:
    """Return single dead pixels, and hot ones: four times darker and brighter than all their neighbours.

    Blurred light does not differ so much. By noise alone none does, as the difference must be ten times the noise, too.
    """
    least = scipy.ndimage.minimum_filter(light, footprint=_AROUND, mode="mirror")
    most = scipy.ndimage.maximum_filter(light, footprint=_AROUND, mode="mirror")
    return (light < least / 4) & (least - light > 10 * noise), (light > 4 * most) & (light - most > 10 * noise)


def black_level(light: Array) -> float:
    """Return the black level, with a warning, of a light field less its dark picture, (rows, columns), or 0.

    Pixels of the darkest places, which their neighbours tell, cannot be darker than no light. Where they lie below 0 by
    more than 1% of the mean light, the light field has another black level than the dark picture.
    """
    near = scipy.ndimage.convolve(light, _AROUND / 8)
    darkest = light.ravel()[np.argsort(near, axis=None)[: max(light.size // 3000, 30)]]
    level = float(np.median(darkest))
    mean = light.mean() - level
    if level >= -0.01 * mean:
        return 0.0
    warn(
        f"light field: its darkest places lie {-level:.4g} numbers below the dark picture, {-level / mean:.1%} of the "
        "mean light: its black level is taken as that much lower"
    )
    return level


def matching(name: str, picture: Array | Capture, white: Array) -> Array:
    """Return a picture of one channel with the pixels of a white one; refuse others."""
    values = single_channel(name, picture)
    refuse_if(
        values.shape != white.shape,
        f"{name} of shape {values.shape}: it must have the pixels of the white picture, {white.shape}",
    )
    return values


def single_channel(name: str, picture: Array | Capture) -> Array:
    """Return a picture of one channel as (rows, columns) numbers; refuse others."""
    values = as_pixels(name, picture, np.float64)
    refuse_if(
        values.ndim == 3 and values.shape[2] != 1,
        f"{name} of shape {values.shape}: it must have one channel, for one range of wavelengths",
    )
    values = values[..., 0] if values.ndim == 3 else values
    refuse_if(values.ndim != 2, f"{name} of shape {values.shape}: it must be a picture")
    return values
