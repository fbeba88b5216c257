"""Wavelengths and the channels that record them."""

import numpy as np
import pytest

from mitsuba_plenoptic.errors import InputError
from mitsuba_plenoptic.optics.spectrum import Spectrum


def test_lines_have_a_channel_each():
    spectrum = Spectrum.lines(633, 532.0)
    assert spectrum.wavelengths == (633, 532) and spectrum.channels == 2
    assert np.array_equal(spectrum.matrix(), np.eye(2)) and spectrum.matrix().dtype == np.float32


@pytest.mark.parametrize(
    ("wavelengths", "responses", "message"),
    [
        ((), (), "spectrum: it must have a wavelength"),
        ((-633.0,), ((1.0,),), "wavelength = -633"),
        ((633.0,), (), "spectrum: responses of shape"),
        ((633.0, 532.0), ((1.0,),), r"spectrum: responses of shape \(1, 1\)"),
        ((633.0,), ((np.nan,),), "spectrum: responses of shape"),
        ((633.0, 532.0), ((1.0,), (1.0, 2.0)), "spectrum: responses"),
        ((633.0,), (("red",),), "spectrum: responses"),
    ],
)
def test_mistakes(wavelengths, responses, message):
    with pytest.raises(InputError, match=f"^{message}"):
        Spectrum(wavelengths, responses)


def test_a_band_integrates_polynomials():
    """A flat band of n nodes is exact up to the degree 2 n - 1, by the closed form of the integral."""
    band = Spectrum.band(550, 40, 3)
    places = (np.array(band.wavelengths) - 550) / 20
    for power in range(6):
        mean = 0 if power % 2 else 1 / (power + 1)
        assert np.array(band.responses) @ places**power == pytest.approx([mean], abs=1e-12)
    assert Spectrum.bands((610, 550, 460), 10, 2).channels == 3
    assert Spectrum.bands((610, 550, 460), 10, 2).centroids() == pytest.approx((610, 550, 460))


def test_a_sensor_is_read_from_a_table(tmp_path):
    table = tmp_path / "sensor.csv"
    table.write_text("wavelength,red,green\n400,0,0\n500,0,2\n600,1,0\n700,0,0\n")
    sensor = Spectrum.sensor(table, 200)
    assert np.array(sensor.responses).sum(1) == pytest.approx([1, 1])
    # A triangle's mean is that of its corners.
    assert sensor.centroids() == pytest.approx((600, 500), abs=0.05)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wavelength,red\n", "no rows"),
        ("wavelength,red\n400,1\n400,2\n", "rising wavelength"),
        ("wavelength,red\n400\n500\n", "a wavelength and responses"),
        ("wavelength,red\n400,1\n500,blue\n", "no table of numbers"),
        ("wavelength,red\n400,nan\n500,1\n", "row 1: all numbers must be finite"),
        ("wavelength,red\n400,0\n500,0\n", "channel 1: its responses sum to 0"),
        ("wavelength,red\n-400,1\n500,1\n", "wavelength = -400"),
    ],
)
def test_tables_that_are_none(tmp_path, text, message):
    table = tmp_path / "sensor.csv"
    table.write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        Spectrum.sensor(table)
    assert str(table) in str(refused.value) and "\n" not in str(refused.value)


def test_shares_are_lagrange_polynomials():
    """They hand every polynomial up to their degree from the nodes to all wavelengths."""
    spectrum = Spectrum(tuple(range(400, 701, 10)), (tuple([1.0] * 31),)).interpolated(5)
    x, nodes = ((np.array(values) - 550) / 150 for values in (spectrum.wavelengths, spectrum.nodes))
    for power in range(5):
        assert nodes**power @ spectrum.shares() == pytest.approx(x**power, abs=1e-12)
    assert spectrum.interpolated(31).nodes == ()
    with pytest.raises(InputError, match="they must be different"):
        Spectrum((633.0,), ((1.0,),), (600.0, 600.0))


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_nodes_of_flat_responses_are_those_of_gauss_and_legendre(count):
    spectrum = Spectrum.band(550, 100, 40).interpolated(count)
    np.testing.assert_allclose(spectrum.nodes, 550 + 50 * np.polynomial.legendre.leggauss(count)[0], rtol=1e-12)


def test_nodes_lie_where_channels_answer():
    """The sums over wavelengths of polynomials of almost twice the degree are exact where there is one channel."""
    wavelengths = np.linspace(400, 700, 61)
    response = np.exp(-(((wavelengths - 460) / 30) ** 2))
    spectrum = Spectrum(tuple(wavelengths.tolist()), (tuple(response.tolist()),)).interpolated(4)
    weights = spectrum.shares() @ response
    assert np.all(weights > 0)
    for degree in range(8):
        x = (wavelengths - 460) / 60
        at_nodes = ((np.array(spectrum.nodes) - 460) / 60) ** degree
        assert weights @ at_nodes == pytest.approx(response @ x**degree, abs=1e-9 * response.sum())


def test_wavelengths_that_no_channel_answers_to_take_no_nodes():
    spectrum = Spectrum((400.0, 500.0, 600.0, 700.0), ((0.0, 1.0, 0.5, 0.0),))
    assert spectrum.interpolated(3).nodes == (500.0, 600.0)
    assert Spectrum((400.0, 500.0), ((1.0, 1.0),)).interpolated(3).nodes == ()
