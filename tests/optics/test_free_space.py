"""Angular spectrum and FFT: unitarity, closed forms and the rules on input."""

import numpy as np
import pytest
from drjit.llvm import Float64

from mitsuba_plenoptic import PhysicsError, PhysicsWarning
from mitsuba_plenoptic.optics.waves import phasor, propagate, soft_edge

WAVELENGTH = 633.0


def resolved_field(shape):
    """Random, but for the outer eighth of its spectrum, which is empty: a guard takes it for resolved."""
    field = np.random.default_rng(0).standard_normal((*shape, 2)) @ (1, 1j)
    y, x = (np.abs(np.fft.fftfreq(size)) < 7 / 16 for size in shape)
    return np.fft.ifft2(np.fft.fft2(field) * (y[:, None] & x)).astype(np.complex64)


periodic = pytest.mark.filterwarnings("ignore:.*outer eighth of its window:mitsuba_plenoptic.PhysicsWarning")


@periodic
@pytest.mark.parametrize("distance", [0.512, -240.0])
def test_against_double_precision(distance):
    """The phase, some 10^6 rad over the path, is right to single precision; every wave keeps its power."""
    pitch, shape = 2e-3, (300, 256)
    field = resolved_field(shape)
    original = field.copy()
    k = 2 * np.pi / (WAVELENGTH * 1e-6)
    ky, kx = (2 * np.pi * np.fft.fftfreq(size, pitch) for size in shape)
    kz = np.sqrt(k**2 - kx**2 - ky[:, None] ** 2)
    expected = np.fft.ifft2(np.fft.fft2(field.astype(np.complex128)) * np.exp(1j * (kz - k) * distance))
    out = propagate(field, pitch, distance, WAVELENGTH)
    assert np.linalg.norm(out - expected) < 1e-6 * np.linalg.norm(expected)
    assert np.linalg.norm(out.astype(np.complex128)) ** 2 == pytest.approx(np.linalg.norm(expected) ** 2, rel=1e-6)
    assert np.array_equal(field, original)
    assert np.array_equal(propagate(field.copy(), pitch, distance, WAVELENGTH, overwrite=True), out)


def test_gaussian_beam_spreads_by_its_closed_form():
    n, pitch, waist = 256, 4e-3, 0.06
    x = (np.arange(n) - n / 2) * pitch
    beam = np.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / waist**2)
    intensity = np.abs(propagate(beam, pitch, np.pi * waist**2 / (WAVELENGTH * 1e-6), WAVELENGTH)) ** 2
    variance = (intensity * x**2).sum() / intensity.sum()
    assert np.sqrt(4 * variance) == pytest.approx(np.sqrt(2) * waist, rel=1e-4)
    assert intensity.max() == pytest.approx(0.5, rel=1e-4)


@periodic
def test_evanescent_waves_are_cut():
    """Of a plane wave and one finer than the wavelength the first is left, and a guard tells of the second."""
    n, pitch, distance = 64, 1e-4, -1e-3
    plane, fine = np.ones((n, n)), 0.7 * np.exp(2j * np.pi * 20 * np.arange(n) / n)[None, :] * np.ones((n, 1))
    with pytest.warns(PhysicsWarning, match="32.89% .* finer than the wavelength"):
        out = propagate(plane + fine, pitch, distance, WAVELENGTH)
    assert np.abs(out - plane).max() < 1e-6
    with pytest.raises(PhysicsError, match="finer than the wavelength"):
        propagate(fine, pitch, distance, WAVELENGTH)


def test_against_hcipy():
    hcipy = pytest.importorskip("hcipy")
    n, pitch, distance = 512, 4e-3, 20.0
    x = (np.arange(n) - n / 2) * pitch
    field = np.exp(-(x[:, None] ** 2 + (x - 0.1 * n * pitch) ** 2) / (n * pitch / 10) ** 2).astype(np.complex64)
    grid = hcipy.make_uniform_grid([n, n], [n * pitch, n * pitch])
    wavefront = hcipy.Wavefront(hcipy.Field(field.astype(np.complex128).ravel(), grid), WAVELENGTH * 1e-6)
    expected = np.asarray(hcipy.AngularSpectrumPropagator(grid, distance)(wavefront).electric_field).reshape(n, n)
    expected = expected * np.exp(-2j * np.pi * distance / (WAVELENGTH * 1e-6))
    assert np.linalg.norm(propagate(field, pitch, distance, WAVELENGTH) - expected) < 1e-4 * np.linalg.norm(expected)


@pytest.mark.parametrize("array", [np.asarray, Float64], ids=["NumPy", "Dr.Jit"])
@pytest.mark.parametrize("largest", [1.0, 1e6])
def test_phasors_of_many_waves(array, largest):
    waves = np.random.default_rng(0).uniform(-largest, largest, 10_000)
    found = phasor(array(waves))
    found = np.array(found.real) + 1j * np.array(found.imag)
    # The sine and the cosine are each rounded as well, at 6e-8.
    assert np.abs(np.angle(found * np.exp(-2j * np.pi * waves))).max() < 3.5e-7
    assert np.abs(np.abs(found) - 1).max() < 3e-7


@pytest.mark.parametrize("array", [np.asarray, Float64], ids=["NumPy", "Dr.Jit"])
def test_a_soft_edge_is_one_sample_wide(array):
    assert np.allclose(np.array(soft_edge(array([-2.0, -0.5, -0.25, 0.0, 0.5, 9.0]))), [0, 0, 0.25, 0.5, 1, 1])
