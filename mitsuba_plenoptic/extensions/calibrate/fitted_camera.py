"""Parameters of a camera from what a fit to its white picture found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import scipy.interpolate

from ...camera import VIGNETTING_NUMBERS, LensTransmissions, PlenopticCamera, Vignetting
from ...prescription import Objective
from .array_fit import ArrayFit
from .field_fit import FieldNumbers


def fitted_camera(
    camera: PlenopticCamera,
    array: ArrayFit,
    field: FieldNumbers,
    position: np.ndarray,
    lens: np.ndarray,
    light: np.ndarray,
) -> PlenopticCamera:
    """Return the camera with the array, pupil, blur, stray light and brightness of lenses that a fit found.

    `position` (n, 2) are the positions of micro-images in pixels, `lens` (n, 2) their indices along and across the
    rows, see `array_fit.lattice_index`, and `light` (n,) the light in their middle.
    """
    shrunk = camera.pixel_size / camera.image_growth
    # The widest pupil, which the vignetting of other places makes narrower.
    radius = float((field.terms(position)[:, field.number == 0] @ field.coefficients["radius"]).max())
    polynomials = {name: field.coefficients[name] for name in VIGNETTING_NUMBERS}
    polynomials |= {name: -polynomials[name] for name in ("slope_x", "slope_y")}
    polynomials["radius"] = polynomials["radius"] / radius
    changes: dict[str, Any] = {
        **array.lattice_parameters(),
        "mla_warp": tuple(array.warp.tolist()) if array.warp.any() else (),
        "detector_blur": abs(float(field.coefficients["blur"][0])) * camera.pixel_size,
        "stray_light": stray_fraction(camera, field),
        "mla_transmissions": _transmissions(camera, array, lens, light / light.mean()),
        "vignetting": Vignetting(scale=field.scale * shrunk, **{name: p.tolist() for name, p in polynomials.items()}),
    }
    wider = radius * camera.pupil_step / camera.pupil_radius
    if camera.objective is None:
        return camera.replace(aperture_radius=camera.aperture_radius * wider, **changes)
    aperture = camera.objective.numerical_aperture * wider
    objective: Objective = replace(camera.objective, numerical_aperture=aperture)
    return camera.replace(main_lens=objective, **changes)


def _transmissions(camera: PlenopticCamera, array: ArrayFit, lens: np.ndarray, light: np.ndarray) -> LensTransmissions:
    """Return a table of the lenses' brightness; lenses that are not whole have that of the nearest."""
    along, row = (lens - array.nearest).T
    column = along - 0.5 * (row % 2) if camera.lattice.stagger == 2 else along
    index = np.rint(np.stack([column, row], axis=-1)).astype(int)
    # Lenses beyond, which the borders of the picture cut.
    low = index.min(0) - 2
    high = index.max(0) + 2
    columns, rows = np.meshgrid(*(np.arange(first, last + 1) for first, last in zip(low, high, strict=True)))
    values = scipy.interpolate.griddata(index, light, (columns, rows), method="nearest")
    return LensTransmissions(values, first=(int(low[0]), int(low[1])))


def stray_fraction(camera: PlenopticCamera, field: FieldNumbers) -> float:
    """Return stray light over the mean irradiance of a white picture, from that over the light in lenses' middles."""
    n = {name: float(values[0]) for name, values in field.coefficients.items()}
    bright = 1 + n["apodisation_2"] / 2 + n["apodisation_4"] / 3
    cell = camera.lattice.cell_area * (camera.image_growth / camera.pixel_size) ** 2
    return max(n["stray"], 0.0) / (np.pi * n["radius"] ** 2 * bright / cell)
