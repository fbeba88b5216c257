r"""Colours as spectra and spectra as colours, by Mitsuba's own tables of CIE 1931 and D65.

Light of a colour gets the spectrum of D65 times a reflectance, and that is :math:`\sum_c v_c \rho_c(\lambda)` with
three reflectances, of the primaries red, green and blue of sRGB: nowhere negative, of sum 1, and as smooth as they can
be (the rule of Mallett and Yuksel 2019, "Spectral primary decomposition for rendering with sRGB reflectance", section
4; the numbers are found here). It is linear, so that light of any strength, and sums of lights, have spectra.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..optics.spectrum import WAVELENGTHS, Responses, Spectrum, Table

_STEP = 10.0
"""Distance in nanometres of the wavelengths at which reflectances are found."""

_EXACT = 1e5
"""How much more the colours count than the smoothness."""

_UNKNOWN = 0.01
"""Part of the channels' responses to wavelengths that a spectrum does not know, at most."""

_LOW, _HIGH = 380.0, 730.0
"""What is visible: beyond, the luminous efficiency is below 1/1000 of its peak."""


def srgb(count: int = WAVELENGTHS, tables: Sequence[Table] = ()) -> Spectrum:
    """Return the responses of linear sRGB to light, as Mitsuba's films of colours have them."""
    return Spectrum.smooth(*SRGB, count, tables)


def tables_of(scene: Any) -> list[Table]:
    """Return the spectra of a scene, of light and of surfaces, that are tables; those alike once."""
    return list({(x.tobytes(), y.tobytes()): (x, y) for x, y in _tables(scene).values()}.values())


def _tables(thing: Any) -> dict[str, Table]:
    """Return, by their names, the spectra of a scene or a plugin that are tables."""
    parameters, found = mi.traverse(thing), {}
    for key in parameters.keys():  # noqa: SIM118 (Mitsuba's mapping is no iterable)
        stem, _, last = key.rpartition(".")
        if last != "values":
            continue
        values = np.array(parameters[key], np.float64)
        if f"{stem}.wavelengths" in parameters:
            found[stem] = np.array(parameters[f"{stem}.wavelengths"], np.float64), values
        elif f"{stem}.range" in parameters:
            low, high = (float(end) for end in parameters[f"{stem}.range"])
            found[stem] = np.linspace(low, high, len(values)), values
    return found


def require_spectra(scene: Any, wavelengths: tuple[float, ...], responses: NDArray[np.float32]) -> None:
    """Refuse wavelengths at which a spectrum of the scene has no values, which Mitsuba takes for 0.

    A number or a colour as radiance stands for the spectrum of D65, which Mitsuba has from 360 to 830 nm; so it has
    black bodies. A table that emits may end where there is no light. One of a surface may end with 0.

    Shapes: `responses` (channels, wavelengths).
    """
    places, visible = np.array(wavelengths), (float(mi.MI_CIE_MIN), float(mi.MI_CIE_MAX))
    if (wavelength := _beyond(places, responses, *visible)) is not None:
        for emitter in scene.emitters():
            parameters = mi.traverse(emitter)
            for key in parameters.keys():  # noqa: SIM118 (Mitsuba's mapping is no iterable)
                if key.endswith(".temperature") or (key.endswith(".range") and tuple(parameters[key]) == visible):
                    raise InputError(
                        f"wavelength = {wavelength:g}: emitter {(emitter.get_shape() or emitter).id()} has light from "
                        f"{visible[0]:g} to {visible[1]:g} nm only, as have D65, for which numbers and colours stand, "
                        'and black bodies: give it a table or <spectrum name="radiance" value="1"/>'
                    )
    for shape in {shape.bsdf().ptr: shape for shape in scene.shapes() if shape.bsdf() is not None}.values():
        for name, (table, values) in _tables(shape.bsdf()).items():
            low, high = table[0] if values[0] else -math.inf, table[-1] if values[-1] else math.inf
            if (wavelength := _beyond(places, responses, low, high)) is not None:
                raise InputError(
                    f"wavelength = {wavelength:g}: the {name} of surface {shape.id()} is a table from {table[0]:g} to "
                    f"{table[-1]:g} nm: it must reach to the wavelength"
                )


def require_upsampled(spectrum: Spectrum) -> None:
    """Refuse responses to what colours have no spectrum for, beyond that of D65."""
    low, high = float(mi.MI_CIE_MIN), float(mi.MI_CIE_MAX)
    if (wavelength := _beyond(np.array(spectrum.wavelengths), spectrum.matrix(), low, high)) is not None:
        raise InputError(
            f"responses: they answer to {wavelength:.4g} nm; colours have the spectrum of D65, from {low:g} to "
            f"{high:g} nm: end the table there, or use a spectral variant"
        )


def _beyond(wavelengths: NDArray[np.float64], responses: NDArray[np.float32], low: float, high: float) -> float | None:
    """Return a wavelength beyond bounds if more than a hundredth of the channels' responses are to such ones."""
    outside, weights = (wavelengths < low) | (wavelengths > high), np.abs(responses).sum(axis=0)
    return float(wavelengths[outside][0]) if weights[outside].sum() > _UNKNOWN * weights.sum() else None


def _srgb_responses(wavelengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the responses (3, n) per nanometre of red, green and blue."""
    xyz = np.array(mi.cie1931_xyz(mi.Float(wavelengths)), np.float64)
    matrix = np.array([np.ravel(mi.xyz_to_srgb(mi.ScalarColor3f(unit))) for unit in np.eye(3).tolist()], np.float64).T
    return np.asarray(matrix @ xyz * mi.MI_CIE_Y_NORMALIZATION)


SRGB = Responses(_srgb_responses, _LOW, _HIGH)
"""Those of linear sRGB."""


def _d65(wavelengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the spectrum of D65, of luminance 1."""
    return np.array(mi.cie_d65(mi.Float(wavelengths)), np.float64)


def upsampling(wavelengths: tuple[float, ...]) -> NDArray[np.float64]:
    """Return the spectra (3, n) of light of red, green and blue 1 at some wavelengths in nanometres."""
    grid, basis = _reflectances()
    places = np.array(wavelengths)
    return np.stack([np.interp(places, grid, row) for row in basis]) * _d65(places)


@functools.cache
def _reflectances() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return wavelengths, and at each the reflectances (3, n) of the primaries."""
    # It takes a while to import, and few captures upsample.
    from scipy.optimize import lsq_linear

    grid = np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + _STEP / 2, _STEP)
    count = len(grid)
    seen = _srgb_responses(grid) * _d65(grid) * _STEP
    # D65 itself is white to the last digit.
    seen /= seen.sum(axis=1, keepdims=True)
    smooth = np.kron(np.eye(3), np.diff(np.eye(count), axis=0))
    colours = np.kron(np.eye(3), seen)
    whole = np.kron(np.ones((1, 3)), np.eye(count))
    matrix = np.vstack([smooth, _EXACT * colours, _EXACT * whole])
    target = np.concatenate([np.zeros(len(smooth)), _EXACT * np.eye(3).ravel(), np.full(count, _EXACT)])
    found = lsq_linear(matrix, target, bounds=(0, 1), method="bvls", max_iter=2000)
    return grid, np.maximum(found.x, 0).reshape(3, count)
