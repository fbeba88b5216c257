"""Zernike polynomials: orthonormal over the pupil, in Noll's order, with slopes that are their derivatives."""

import numpy as np
import pytest

from mitsuba_plenoptic.lenses.thin import Wavefront, noll, zernike


def test_orthonormal_in_nolls_order():
    # The table of Noll (1976).
    expected = [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3), (4, 0), (4, 2)]
    assert [noll(j) for j in range(1, 13)] == expected
    nodes, weights = np.polynomial.legendre.leggauss(16)
    angle = 2 * np.pi * np.arange(64) / 64
    radius = np.sqrt((nodes + 1) / 2)[:, None]
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    values = np.array([np.polynomial.polynomial.polyval2d(x, y, zernike(j)) for j in range(1, 37)])
    products = np.einsum("iab,jab,a->ij", values, values, weights / 2) / 64
    assert np.allclose(products, np.eye(36), atol=1e-12)
    # Defocus: root of 3 times 2 r^2 - 1.
    assert Wavefront([0, 0, 0, 1.0], 2.0).path(2.0, 0.0) == pytest.approx(3**0.5 * 633e-6)


def test_slopes_are_derivatives():
    wavefront, h = Wavefront(np.random.default_rng(0).normal(size=36).tolist(), 5.0), 1e-4
    across = (wavefront.path(1 + h, 0.5) - wavefront.path(1 - h, 0.5)) / (2 * h)
    up = (wavefront.path(1, 0.5 + h) - wavefront.path(1, 0.5 - h)) / (2 * h)
    assert wavefront.slope(1.0, 0.5) == pytest.approx((across, up), rel=1e-6)
