"""Rays of different wavelengths through a camera of glass lenses: which light each ray is, and what it meets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..optics.spectrum import RGB_WAVELENGTHS
from ..prescription import Glass
from ..prescription.glass import LINE_D

_STEP = 1.0
"""Distance in nanometres of the wavelengths between which indices go in straight lines: right to 1e-7."""


@dataclass(frozen=True)
class Light:
    """What single rays meet.

    Attributes
    ----------
    ratio, mla_ratio : Float
        Focal lengths of the thin main lens and of the microlenses over those that are stated.
    indices : list of Float, or None
        Behind each surface of a real main lens.
    """

    ratio: Any
    mla_ratio: Any
    indices: list[Any] | None

    def through(self, lens: Any) -> Any:
        """Return a main lens as these rays meet it."""
        if self.indices is not None:
            return replace(lens, indices=self.indices)
        return replace(lens, focal_length=lens.focal_length * self.ratio)


@dataclass(frozen=True)
class Dispersion:
    """A camera's glasses, for the colours of the active variant.

    Attributes
    ----------
    wavelengths : tuple of float
        In rgb variants those of the channels, in spectral ones a grid, in nanometres.
    ratio, mla_ratio, indices
        As of `Light`, at these wavelengths; what is the same for all of them is a float.
    """

    wavelengths: tuple[float, ...]
    ratio: Any
    mla_ratio: Any
    indices: list[Any] | None

    @classmethod
    def of(cls, camera: PlenopticCamera) -> Dispersion | None:
        """Return that of a camera; None where all rays go the same ways."""
        if not camera.is_dispersive or not (mi.is_rgb or mi.is_spectral):
            return None
        wavelengths = RGB_WAVELENGTHS
        if mi.is_spectral:
            wavelengths = tuple(np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + _STEP, _STEP).tolist())

        def along(glass: Glass | None, value: Callable[[Glass, float], float]) -> Any:
            if glass is None:
                return 1.0
            # Beyond a table detectors are all but blind; its ends stand for what it does not tell.
            low, high = glass.reach
            table = mi.Float([value(glass, min(max(wavelength, low), high)) for wavelength in wavelengths])
            dr.make_opaque(table)
            return table

        indices = None
        if camera.prescription is not None:
            indices = [along(surface.glass, Glass.at) for surface in camera.prescription.surfaces]
        return cls(
            wavelengths, along(camera.glass, Glass.focal_ratio), along(camera.mla_glass, Glass.focal_ratio), indices
        )

    def ends(self, camera: PlenopticCamera) -> list[PlenopticCamera]:
        """Return a camera as its shortest and longest wavelengths meet it."""
        glasses = [glass for glass in (camera.glass, camera.mla_glass) if glass is not None]
        low = max([min(self.wavelengths), *(glass.reach[0] for glass in glasses)])
        high = min([max(self.wavelengths), *(glass.reach[1] for glass in glasses)])
        return [camera.at_wavelength(wavelength) for wavelength in (min(low, LINE_D), max(high, LINE_D))]

    def draw(self, sample: Any, wavelengths: Any) -> tuple[Light, Any, Any]:
        """Choose the light of rays.

        Parameters
        ----------
        sample : Point2f
            Random numbers, of whose first a part is used up in rgb variants.
        wavelengths : Spectrum
            Of the rays, in spectral variants.

        Returns
        -------
        light : Light
            What they meet.
        sample : Point2f
            The random numbers that are left.
        share : Spectrum
            Factor on the weight of every channel.
        """
        if mi.is_spectral:
            place = dr.clip((wavelengths[0] - self.wavelengths[0]) / _STEP, 0, len(self.wavelengths) - 1)
            low = mi.UInt32(dr.minimum(dr.floor(place), len(self.wavelengths) - 2))
            part = place - mi.Float(low)
            share = dr.zeros(mi.UnpolarizedSpectrum)
            share[0] = mi.Float(len(share))

            def take(table: Any) -> Any:
                first, second = dr.gather(mi.Float, table, low), dr.gather(mi.Float, table, low + 1)
                return first + part * (second - first)
        else:
            scaled = mi.Float(sample[0]) * 3
            whole = dr.minimum(dr.floor(scaled), 2)
            channel = mi.UInt32(whole)
            sample = mi.Point2f(scaled - whole, sample[1])
            share = mi.UnpolarizedSpectrum(*(dr.select(channel == i, mi.Float(3), 0) for i in range(3)))

            def take(table: Any) -> Any:
                return dr.gather(mi.Float, table, channel)

        def of(value: Any) -> Any:
            return take(value) if dr.is_array_v(value) else value

        indices = None if self.indices is None else [of(index) for index in self.indices]
        return Light(of(self.ratio), of(self.mla_ratio), indices), sample, share
