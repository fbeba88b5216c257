r"""Conversion between colours and spectra, by Mitsuba's tables of CIE 1931 and D65.

The spectrum of a colour is that of D65 times the reflectance :math:`\sum_c v_c \rho_c(\lambda)`. The reflectances of
the sRGB primaries red, green and blue are nonnegative, have the sum 1, and are as smooth as these conditions allow
(the rule of Mallett and Yuksel 2019, "Spectral primary decomposition for rendering with sRGB reflectance", section
4; their values are computed here). The conversion is linear, so it holds for light of any strength and for sums.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import InputError
from ..runtime import Doubles, Floats, Numbers, Pair, drjit_array
from .spectrum import WAVELENGTHS, Spectrum, Table, interpolated

_STEP = 10.0
"""Step in nanometres between the wavelengths at which reflectances are computed."""

_EXACT = 1e5
"""Weight of the colours relative to the smoothness in the least-squares fit."""

_CIE_STEP = 5.0
"""Step in nanometres of Mitsuba's tables of CIE 1931."""

_LOW = 380.0
_HIGH = 730.0
"""Visible range in nanometres: beyond it, the luminous efficiency is below 1/1000 of its peak."""


def srgb(count: int = WAVELENGTHS, tables: Sequence[Table] = ()) -> Spectrum:
    """Return the spectral responses of linear sRGB, which Mitsuba's colour films also use."""
    return Spectrum.smooth(srgb_responses, _LOW, _HIGH, count, tables)


def tables_of(scene: Any) -> list[Table]:
    """Return the tabulated spectra of a scene's emitters and surfaces, without duplicates."""
    return list({(x.tobytes(), y.tobytes()): (x, y) for x, y in _tables(scene).values()}.values())


def _tables(thing: Any) -> dict[str, Table]:
    """Return the tabulated spectra of a scene or a plugin by name."""
    parameters = mi.traverse(thing)
    tables = {}
    for key in parameters.keys():  # noqa: SIM118 (Mitsuba's mapping is no iterable)
        stem, _, last = key.rpartition(".")
        if last != "values":
            continue
        values = np.array(parameters[key], np.float64)
        if f"{stem}.wavelengths" in parameters:
            tables[stem] = np.array(parameters[f"{stem}.wavelengths"], np.float64), values
        elif f"{stem}.range" in parameters:
            low, high = (float(end) for end in parameters[f"{stem}.range"])
            tables[stem] = np.linspace(low, high, len(values)), values
    return tables


def require_spectra(scene: Any, wavelengths: Numbers, responses: Floats) -> None:
    """Refuse wavelengths at which a spectrum of the scene has no values, where Mitsuba takes 0.

    A scalar or a colour given as radiance means the spectrum of D65. Mitsuba defines D65 and black bodies from 360 to
    830 nm. An emitter's table may end anywhere, with no light beyond; a surface's table may end only with 0.

    Shapes: `responses` (channels, wavelengths).
    """
    at = np.array(wavelengths)
    visible = (float(mi.MI_CIE_MIN), float(mi.MI_CIE_MAX))
    if (wavelength := _beyond(at, responses, *visible)) is not None:
        for emitter in scene.emitters():
            parameters = mi.traverse(emitter)
            for key in parameters.keys():  # noqa: SIM118 (Mitsuba's mapping is no iterable)
                if key.endswith(".temperature") or (key.endswith(".range") and tuple(parameters[key]) == visible):
                    raise InputError(
                        f"wavelength = {wavelength:g}: emitter {(emitter.get_shape() or emitter).id()} has light from "
                        f"{visible[0]:g} to {visible[1]:g} nm only (a number or a colour stands for D65, which ends "
                        'there, as do black bodies): give it a table or <spectrum name="radiance" value="1"/>'
                    )
    for shape in {shape.bsdf().ptr: shape for shape in scene.shapes() if shape.bsdf() is not None}.values():
        for name, (table, values) in _tables(shape.bsdf()).items():
            low = table[0] if values[0] else -math.inf
            high = table[-1] if values[-1] else math.inf
            if (wavelength := _beyond(at, responses, low, high)) is not None:
                raise InputError(
                    f"wavelength = {wavelength:g}: the {name} of surface {shape.id()} is a table from {table[0]:g} to "
                    f"{table[-1]:g} nm: it must reach to the wavelength"
                )


def require_upsampled(spectrum: Spectrum) -> None:
    """Refuse responses at wavelengths beyond the range of D65, where colours have no spectrum."""
    low = float(mi.MI_CIE_MIN)
    high = float(mi.MI_CIE_MAX)
    if (wavelength := _beyond(np.array(spectrum.wavelengths), spectrum.matrix(), low, high)) is not None:
        raise InputError(
            f"responses: they answer to {wavelength:.4g} nm; colours have the spectrum of D65, from {low:g} to "
            f"{high:g} nm: end the table there, or use a spectral variant"
        )


def _beyond(wavelengths: Doubles, responses: Floats, low: float, high: float) -> float | None:
    """Return a wavelength outside the bounds if more than 1 % of the responses lie outside, otherwise None."""
    outside = (wavelengths < low) | (wavelengths > high)
    weights = np.abs(responses).sum(axis=0)
    # 0.01: Largest fraction of the channels' responses at wavelengths where a spectrum has no values.
    return float(wavelengths[outside][0]) if weights[outside].sum() > 0.01 * weights.sum() else None


def srgb_responses(wavelengths: Doubles) -> Doubles:
    """Return the responses (3, n) per nanometre of red, green and blue in linear sRGB."""
    xyz = np.array(mi.cie1931_xyz(drjit_array(mi.Float, wavelengths)), np.float64)
    matrix = np.array([np.ravel(mi.xyz_to_srgb(mi.ScalarColor3f(unit))) for unit in np.eye(3).tolist()], np.float64).T
    return np.asarray(matrix @ xyz * mi.MI_CIE_Y_NORMALIZATION)


def srgb_table() -> Doubles:
    """Return rows of a wavelength and the responses of linear sRGB; Mitsuba's tables are linear between these rows."""
    wavelengths = np.arange(_LOW, _HIGH + _CIE_STEP / 2, _CIE_STEP)
    return np.column_stack([wavelengths, srgb_responses(wavelengths).T])


def _d65(wavelengths: Doubles) -> Doubles:
    """Return the spectrum of D65, of luminance 1."""
    return np.array(mi.cie_d65(drjit_array(mi.Float, wavelengths)), np.float64)


def upsampling(wavelengths: Numbers) -> Doubles:
    """Return the spectra (3, n) of unit red, green and blue light at wavelengths in nanometres."""
    grid, basis = _reflectances()
    at = np.array(wavelengths)
    return interpolated(grid, basis, at) * _d65(at)


@functools.cache
def _reflectances() -> Pair:
    """Return wavelengths, and the reflectances (3, n) of the sRGB primaries at each of them."""
    # Imported here because it is slow to import and few captures upsample.
    from scipy.optimize import lsq_linear

    grid = np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + _STEP / 2, _STEP)
    count = len(grid)
    recorded = srgb_responses(grid) * _d65(grid) * _STEP
    # Normalised so that D65 itself is exactly white.
    recorded /= recorded.sum(axis=1, keepdims=True)
    smooth = np.kron(np.eye(3), np.diff(np.eye(count), axis=0))
    colours = np.kron(np.eye(3), recorded)
    total = np.kron(np.ones((1, 3)), np.eye(count))
    matrix = np.vstack([smooth, _EXACT * colours, _EXACT * total])
    target = np.concatenate([np.zeros(len(smooth)), _EXACT * np.eye(3).ravel(), np.full(count, _EXACT)])
    solution = lsq_linear(matrix, target, bounds=(0, 1), method="bvls", max_iter=2000)
    return grid, np.maximum(solution.x, 0).reshape(3, count)
