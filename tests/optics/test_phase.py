"""Phasors keep their accuracy at any number of waves, and edges are softened over one sample."""

import numpy as np
import pytest
from drjit.llvm import Float64

from mitsuba_plenoptic.optics.waves import parabola, phasor, soft_edge


@pytest.mark.parametrize("array", [np.asarray, Float64], ids=["NumPy", "Dr.Jit"])
@pytest.mark.parametrize("largest", [1.0, 1e6])
def test_phasors_of_many_waves(array, largest):
    waves = np.random.default_rng(0).uniform(-largest, largest, 10_000)
    found = phasor(array(waves))
    found = np.array(found.real) + 1j * np.array(found.imag)
    # The sine and the cosine are each rounded as well, at 6e-8.
    assert np.abs(np.angle(found * np.exp(-2j * np.pi * waves))).max() < 3.5e-7
    assert np.abs(np.abs(found) - 1).max() < 3e-7


def test_a_parabola_delays_its_centre_by_a_lens():
    """The phase -pi r^2 / lambda f, in waves."""
    assert parabola(0.032**2, 0.512, 633.0) == pytest.approx(-(0.032**2) / (2 * 633e-6 * 0.512))
    assert parabola(0.032**2, -0.512, 633.0) > 0


@pytest.mark.parametrize("array", [np.asarray, Float64], ids=["NumPy", "Dr.Jit"])
def test_a_soft_edge_is_one_sample_wide(array):
    assert np.allclose(np.array(soft_edge(array([-2.0, -0.5, -0.25, 0.0, 0.5, 9.0]))), [0, 0, 0.25, 0.5, 1, 1])
