"""The transmission of microlenses and how it changes, against differences of the transmission."""

import drjit as dr
import numpy as np
import pytest
from wave_cases import WAVELENGTH, small_camera

from mitsuba_plenoptic.lattice import make_lattice
from mitsuba_plenoptic.runtime.backend import array_module
from mitsuba_plenoptic.system.microlens_derivatives import VaryingMicrolenses
from mitsuba_plenoptic.system.microlens_orders import axis_orders, plane_orders
from mitsuba_plenoptic.system.microlenses import is_separable

COSINE = 0.16


@pytest.mark.parametrize("change", [{"mla_focal_length": 0.512}, {"mla_fill": 0.8}], ids=["focal length", "fill"])
@pytest.mark.parametrize("name", ["square", "hexagonal", "circles"])
def test_tables_of_derivatives_against_differences_of_orders(name, change):
    parameters = {
        "square": {},
        "hexagonal": {"mla_lattice": "hexagonal"},
        "circles": {"mla_lattice": "hexagonal", "mla_aperture": "circle"},
    }[name]
    camera = small_camera(2, mla_fill=0.8, **parameters)
    (key, value), step = next(iter(change.items())), 5e-3
    types = array_module().ad
    number = types.Float64(value)
    dr.enable_grad(number)
    numbers = {"mla_focal_length": types.Float64(0.512), "mla_fill": types.Float64(0.8)} | {key: number}
    lattice = make_lattice(
        camera.mla_lattice,
        (types.Float64(0.064), types.Float64(0.064)),
        offset=(types.Float64(0), types.Float64(0)),
        aperture=camera.mla_aperture,
        fill=numbers["mla_fill"],
    )
    wavelength = types.Float64(WAVELENGTH)
    varying = VaryingMicrolenses(camera, WAVELENGTH, COSINE, lattice, [numbers["mla_focal_length"]], wavelength)
    x, y = (np.random.default_rng(3).uniform(-0.1, 0.1, (2, 500))).tolist()
    if is_separable(camera):
        found = varying.along(types.Float64(x), 0)
    else:
        found = varying.at(types.Float64(x), types.Float64(y))
    dr.set_grad(number, 1.0)
    dr.forward_to(found)
    derivative = dr.grad(found)
    derivative = derivative.real.numpy() + 1j * derivative.imag.numpy()
    expected = _difference(camera, key, value, step, x, y)
    assert np.linalg.norm(derivative - expected) < 0.015 * np.linalg.norm(expected)


def _difference(camera, key, value, step, x, y):
    """Return the central difference of the sum of orders, at places."""
    sums = []
    for side in (1, -1):
        changed = camera.replace(**{key: value * (1 + side * step), "detector_distance": 0.512})
        if is_separable(camera):
            count = int(COSINE / (WAVELENGTH * 1e-6) * 0.064)
            orders = axis_orders(changed, WAVELENGTH, count, 0)
            q = np.arange(-count, count + 1)
            sums.append(np.exp(2j * np.pi * np.outer(x, q) / 0.064) @ orders)
        else:
            orders = plane_orders(changed, WAVELENGTH, COSINE)
            width, height = camera.lattice.period()
            rows, columns = (np.arange(-(size // 2), size // 2 + 1) for size in orders.shape)
            across = np.exp(2j * np.pi * np.outer(x, columns) / width)
            down = np.exp(2j * np.pi * np.outer(y, rows) / height)
            sums.append(np.einsum("pr,rc,pc->p", down, orders, across))
    return (sums[0] - sums[1]) / (2 * step * value)
