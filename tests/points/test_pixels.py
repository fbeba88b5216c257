"""Integrals over pixels and samples on a turned grid: against closed forms, and with their adjoints."""

import numpy as np
import pytest
from scipy.special import erf
from wave_cases import error

from mitsuba_plenoptic.lattice import turn
from mitsuba_plenoptic.points.pixels import PixelIntegrals, TurnedSamples

PITCH = (1.7e-3, 1.6e-3)
SAMPLES = (120, 130)


def test_pixel_integrals_of_a_gaussian():
    """Against the error function, for pixels that are no multiple of the sampling."""
    pixel, width = 3.1e-3, 8e-3
    y, x = (-0.1 + step * np.arange(count) for step, count in zip(PITCH[::-1], SAMPLES, strict=True))
    samples = np.exp(-(y[:, None] ** 2 + (x - 0.01) ** 2) / width**2).astype(np.float32)
    image = PixelIntegrals.of(SAMPLES, PITCH, (-0.1, -0.1), pixel, (-0.06, -0.05), (30, 40)).forward(samples)
    across, down = -0.06 + pixel * np.arange(41), -0.05 + pixel * np.arange(31)
    along_x, along_y = (np.diff(erf(v / width)) * np.sqrt(np.pi) / 2 * width for v in (across - 0.01, down))
    assert error(image, along_y[:, None] * along_x) < 1e-4


def test_samples_of_a_turned_grid():
    """A sum of waves that the grid holds, known everywhere."""
    waves = np.random.default_rng(3).uniform(-0.3, 0.3, (12, 2)) / max(PITCH)

    def intensity(x, y):
        return np.cos(2 * np.pi * (waves[:, 0] * x[..., None] + waves[:, 1] * y[..., None])).sum(-1)

    y, x = (-0.1 + step * np.arange(count) for step, count in zip(PITCH[::-1], SAMPLES, strict=True))
    held = intensity(*np.meshgrid(x, y)).astype(np.float32)
    found = TurnedSamples(SAMPLES, PITCH, (-0.1, -0.1), 33.0, 1.3e-3, (-0.05, -0.04), (60, 70)).forward(held)
    x, y = np.meshgrid(-0.05 + 1.3e-3 * np.arange(70), -0.04 + 1.3e-3 * np.arange(60))
    assert error(found, intensity(*turn(x, y, -33.0))) < 2e-3


@pytest.mark.parametrize(
    "linear",
    [
        PixelIntegrals.of(SAMPLES, PITCH, (-0.1, -0.1), 3.1e-3, (-0.06, -0.05), (30, 40)),
        # Pixels and new samples reach beyond the samples.
        PixelIntegrals.of(SAMPLES, PITCH, (-0.1, -0.1), 3.1e-3, (-0.12, -0.11), (30, 40)),
        TurnedSamples(SAMPLES, PITCH, (-0.1, -0.1), 33.0, 1.3e-3, (-0.05, -0.04), (30, 40)),
        TurnedSamples(SAMPLES, PITCH, (-0.1, -0.1), -90.0, 7e-3, (-0.15, -0.1), (30, 40)),
    ],
    ids=["pixels within", "pixels beyond", "turned within", "turned beyond"],
)
def test_adjoint(linear):
    """<A x, y> = <x, A' y> to 1e-6 of |A x| |y|."""
    rng = np.random.default_rng(0)
    x, y = (rng.normal(size=shape).astype(np.float32) for shape in (SAMPLES, (30, 40)))
    forward, adjoint = linear.forward(x), linear.adjoint(y)
    assert forward.shape == y.shape and adjoint.shape == x.shape
    difference = np.vdot(forward.astype(float), y.astype(float)) - np.vdot(x.astype(float), adjoint.astype(float))
    assert abs(difference) < 1e-6 * np.linalg.norm(forward) * np.linalg.norm(y)
