"""Responses of photodiodes for single rays, in Dr.Jit."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...optics import RGB_WAVELENGTHS
from ...prescription import LINE_D
from ...runtime import Pair, drjit_array
from .photodiode_response import PhotodiodeResponse


class PhotodiodeTable:
    """A table of responses, linear between its angles and wavelengths, for the colours of the active variant."""

    def __init__(self, response: PhotodiodeResponse):
        self._axes = [[math.radians(angle) for angle in angles] for angles in (response.angles_y, response.angles_x)]
        self._wavelengths = response.wavelengths
        table = response.of_pixels
        if self._wavelengths and not mi.is_spectral:
            # Light has these wavelengths: each channel has a table of its own.
            channels = RGB_WAVELENGTHS if mi.is_rgb else (LINE_D,)
            positions = [_fraction(self._wavelengths, wavelength, np) for wavelength in channels]
            low = [min(int(position), len(self._wavelengths) - 1) for position in positions]
            high = [min(index + 1, len(self._wavelengths) - 1) for index in low]
            weights = (np.array(positions) - low)[:, None, None]
            table = table[:, :, low] * (1 - weights) + table[:, :, high] * weights
        self._shape = table.shape
        self._table = drjit_array(mi.Float, table)
        dr.make_opaque(self._table)

    def __call__(self, side: Pair, slope: Pair, wavelengths: Any) -> Any:
        """Return the responses of pixels, given by column and row under their lens, to light of given slopes."""
        _, _, count, *sizes = self._shape
        places = [
            _between(_fraction(axis, dr.atan(t), dr), size)
            for axis, t, size in zip(self._axes, reversed(slope), sizes, strict=True)
        ]
        first = mi.UInt32(side[1] * 2 + side[0]) * count

        def at(layer: Any) -> Any:
            total = mi.Float(0)
            for (j, down), (i, across) in itertools.product(*places):
                index = ((first + layer) * sizes[0] + j) * sizes[1] + i
                total += down * across * dr.gather(mi.Float, self._table, index)
            return total

        result = dr.zeros(mi.UnpolarizedSpectrum)
        for channel in range(len(result)):
            if self._wavelengths and mi.is_spectral:
                layers = _between(_fraction(self._wavelengths, wavelengths[channel], dr), count)
                result[channel] = sum((weight * at(layer) for layer, weight in layers), mi.Float(0))
            else:
                result[channel] = at(channel if count > 1 else 0)
        return result


def _fraction(axis: Sequence[float], value: Any, module: Any) -> Any:
    """Return the fractional index of values on a rising axis, limited to the indices of its ends."""
    return sum(module.clip((value - low) / (high - low), 0, 1) for low, high in itertools.pairwise(axis))


def _between(fraction: Any, size: int) -> list[Pair]:
    """Return the two indices around a fractional index, with their weights."""
    if size == 1:
        return [(mi.UInt32(0), 1.0)]
    low = mi.UInt32(dr.minimum(dr.floor(fraction), size - 2))
    weight = fraction - mi.Float(low)
    return [(low, 1 - weight), (low + 1, weight)]
