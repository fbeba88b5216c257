"""Light scattered by spheres against published tables, an arbitrary-precision sum, and miepython's own sum."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mitsuba_plenoptic.particles import cross_sections

miepython = pytest.importorskip("miepython")


def angles(*degrees):
    return np.cos(np.radians(degrees))[None]


def test_bohren_and_huffmans_example():
    # Their appendix A, m = 1.55, x = 5.213: S11 over its value forwards.
    found = cross_sections(np.array([1.05]), 1.55, 632.8, angles(0, 9, 18, 27, 45, 90))[0]
    assert_allclose(found / found[0], [1.0, 0.785390, 0.356897, 0.0766119, 0.0701845, 0.0124601], rtol=2e-5)
    # Their scattering efficiency is the integral of the differential cross-section.
    node, weight = np.polynomial.legendre.leggauss(60)
    sections = cross_sections(np.array([1.05]), 1.55, 632.8, node[None])[0]
    assert_allclose(2 * np.pi * sections @ weight / (np.pi * 0.525**2), 3.10543, rtol=2e-6)


def test_large_spheres_against_sums_with_sixty_digits():
    # mpmath, 50 micrometres: the recurrences are the hardest here; sizes are computed together.
    large = [22567322.42022337, 160.69792057572855, 44.66098458652747, 15.76336871832395, 6.9625857851874144]
    small = [114.07918522867793, 1.959900731784244, 0.026959644838990122, 0.03355114484300375, 0.03473902419803021]
    at = angles(0, 30, 88, 90, 180)[0]
    assert_allclose(cross_sections(np.array([50.0]), 1.1, 412.6, at[None])[0], large, rtol=1e-6)
    assert_allclose(cross_sections(np.array([2.0, 50.0]), 1.19, 412.6, np.stack([at, at]))[0], small, rtol=1e-9)


@pytest.mark.parametrize("index", [1.19, 1.5 + 0.1j, 0.75])
def test_scattering_against_miepython(index):
    diameter, wavelength, at = 7.3, 412.6, angles(0, 20, 70, 90, 135, 180)[0]
    size = np.pi * diameter * 1e3 / wavelength
    first, second = miepython.S1_S2(np.conj(index), size, at)
    shape = abs(first) ** 2 + abs(second) ** 2
    found = cross_sections(np.array([diameter]), index, wavelength, at[None])[0]
    assert_allclose(found / found[0], shape / shape[0], rtol=1e-6)
    node, weight = np.polynomial.legendre.leggauss(300)
    whole = 2 * np.pi * cross_sections(np.array([diameter]), index, wavelength, node[None])[0] @ weight
    efficiency = miepython.efficiencies_mx(np.conj(index), size)[1]
    assert_allclose(whole / (np.pi * diameter**2 / 4), efficiency, rtol=1e-6)
