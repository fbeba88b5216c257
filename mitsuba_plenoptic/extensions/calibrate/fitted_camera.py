"""Parameters of a camera from what a fit to its white picture found."""

from dataclasses import replace

import numpy as np
import scipy.interpolate

from ...camera import VIGNETTING_NUMBERS, LensTransmissions, PlenopticCamera, StrayLight
from ...runtime import Array, exponents, monomials
from .array_fit import ArrayFit
from .field_fit import FieldNumbers
from .micro_image import NUMBERS, MicroImageModel, PupilNumbers

_ALONG = 9
"""Values along a side of the table of stray light."""


def fitted_camera(
    model: MicroImageModel,
    camera: PlenopticCamera,
    array: ArrayFit,
    field: FieldNumbers,
    position: Array,
    lens: Array,
    light: Array,
) -> PlenopticCamera:
    """Return the camera with the array, pupil, blur, stray light and brightness of lenses that a fit found.

    `position` (n, 2) are the positions of micro-images in pixels, `lens` (n, 2) their indices along and across the
    rows, see `array_fit.lattice_index`, and `light` (n,) the light in their middle.
    """
    shrunk = camera.pixel_size / camera.image_growth
    light = light / light.mean()
    numbers = dict(zip(NUMBERS, field.values(position).T[..., None], strict=True))
    # The widest pupil in any direction, which the vignetting of other places makes narrower.
    angle = np.linspace(0, 2 * np.pi, 360)
    outline, _ = model.shape.outline(np.cos(angle), np.sin(angle), 0.0, 0.0)
    elongated = numbers["ellipse_x"] * np.cos(2 * angle) + numbers["ellipse_y"] * np.sin(2 * angle)
    radius = float((numbers["radius"] * (1 + outline) * (1 + elongated)).max())
    polynomials = {name: field.coefficients[name].tolist() for name in VIGNETTING_NUMBERS}
    polynomials["radius"] = (field.coefficients["radius"] / radius).tolist()
    changes = {
        **array.lattice_parameters(),
        "mla_warp": tuple(array.warp.tolist()) if array.warp.any() else (),
        "detector_blur": abs(float(field.coefficients["blur"][0])) * camera.pixel_size,
        "stray_light": stray_light(model, camera, field, position, light),
        "mla_transmissions": _transmissions(camera, array, lens, light),
        "vignetting": replace(model.shape, scale=field.scale * shrunk, **polynomials),
    }
    wider = radius * camera.pupil_step / camera.pupil_radius
    if camera.objective is None:
        return camera.replace(aperture_radius=camera.aperture_radius * wider, **changes)
    aperture = camera.objective.numerical_aperture * wider
    return camera.replace(main_lens=replace(camera.objective, numerical_aperture=aperture), **changes)


def _transmissions(camera: PlenopticCamera, array: ArrayFit, lens: Array, light: Array) -> LensTransmissions:
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


def stray_light(
    model: MicroImageModel, camera: PlenopticCamera, field: FieldNumbers, position: Array, light: Array
) -> float | StrayLight:
    """Return stray light over the mean irradiance of a white picture, from that over the light in lenses' middles."""
    some = slice(None, None, max(len(position) // 32, 1))
    cell = camera.lattice.cell_area * (camera.image_growth / camera.pixel_size) ** 2
    direct = [model.pupil_light(PupilNumbers(*numbers)) / cell for numbers in field.values(position[some])]
    share = light * field.values(position)[:, NUMBERS.index("stray")] / np.mean(light[some] * direct)
    if np.ptp(share) < 2e-3:
        return max(float(share.mean()), 0.0)
    grid = np.stack(np.meshgrid(*(np.linspace(-0.5, count - 0.5, _ALONG) for count in camera.resolution)), axis=-1)
    (x, y), (across, down) = (((places - field.middle) / field.scale).T for places in (position, grid.reshape(-1, 2)))
    coefficients = np.linalg.lstsq(np.stack(monomials(x, y, exponents(2)), axis=-1), share)[0]
    table = np.stack(monomials(across, down, exponents(2)), axis=-1) @ coefficients
    return StrayLight(table.clip(0, 1).reshape(_ALONG, _ALONG))
