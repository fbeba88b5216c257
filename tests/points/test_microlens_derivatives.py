"""The transmission of microlenses and how it changes, against differences of the transmission."""

import drjit as dr
import numpy as np
import pytest
from wave_cases import WAVELENGTH, small_camera

from mitsuba_plenoptic.lattice import make_lattice
from mitsuba_plenoptic.light.microlens_orders import MicrolensArray, VaryingArrayFactor

COSINE = 0.16


@pytest.mark.parametrize("change", [{"mla_focal_length": 0.512}, {"mla_fill": 0.8}], ids=["focal length", "fill"])
@pytest.mark.parametrize("name", ["square", pytest.param("hexagonal", marks=pytest.mark.slow), "circles"])
def test_tables_of_derivatives_against_differences_of_orders(name, change):
    parameters = {
        "square": {},
        "hexagonal": {"mla_lattice": "hexagonal"},
        "circles": {"mla_lattice": "hexagonal", "mla_aperture": "circle"},
    }[name]
    camera = small_camera(2, mla_fill=0.8, **parameters)
    (key, value), step = next(iter(change.items())), 5e-3
    types = dr.llvm.ad
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
    factor = MicrolensArray(camera, WAVELENGTH).factors(COSINE)[0]
    varying = VaryingArrayFactor(factor, lattice, [numbers["mla_focal_length"]], wavelength)
    places = np.random.default_rng(3).uniform(-0.1, 0.1, (2, 500))[: len(varying.axes)]
    found = varying.at(*(types.Float64(place) for place in places))
    dr.set_grad(number, 1.0)
    dr.forward_to(found)
    derivative = dr.grad(found)
    derivative = derivative.real.numpy() + 1j * derivative.imag.numpy()
    expected = _difference(camera, key, value, step, places)
    # By the fill, samples of the edges make differences inexact: with half the step 1.4 % (hexagons).
    assert np.linalg.norm(derivative - expected) < 0.02 * np.linalg.norm(expected)


def _difference(camera, key, value, step, places):
    """Return the central difference of the sum of orders, at places."""
    sums = []
    for side in (1, -1):
        changed = camera.replace(**{key: value * (1 + side * step), "detector_distance": 0.512})
        factor = MicrolensArray(changed, WAVELENGTH).factors(COSINE)[0]
        orders = factor.orders()
        waves = [
            np.exp(2j * np.pi * np.outer(place, np.arange(-(size // 2), size // 2 + 1)) / period)
            for place, size, period in zip(places, orders.shape[::-1], factor.periods, strict=True)
        ]
        sums.append(np.einsum("pc,c->p" if len(places) == 1 else "pc,pr,rc->p", *waves, orders))
    return (sums[0] - sums[1]) / (2 * step * value)
