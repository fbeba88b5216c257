"""Wavelengths and the channels that record them."""

import numpy as np
import pytest

from mitsuba_plenoptic import InputError, Spectrum


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
    # A table needs no line of names, which may hold digits.
    bare, named = tmp_path / "bare.csv", tmp_path / "named.csv"
    bare.write_text("400,0.5\n500,2\n700,0\n")
    named.write_text("wavelength/nm,channel 1\n400,0.5\n500,2\n700,0\n")
    assert Spectrum.sensor(bare) == Spectrum.sensor(named)
    assert Spectrum.sensor(bare).wavelengths[0] < 402


def bell(places):
    return np.stack([np.exp(-(((places - middle) / 40) ** 2)) for middle in (540, 610)])


def steps(*lines, width):
    """The table of lamp lines of radiance 1."""
    return np.array([(line + side * (width / 2 + 0.1 * out), 1.0 - out) for line in lines for side, out in SIDES]).T


SIDES = ((-1, 1), (-1, 0), (1, 0), (1, 1))


@pytest.mark.parametrize(
    "table",
    [
        pytest.param(steps(532, width=20), id="532 +- 10"),
        pytest.param(steps(532, width=0.05), id="fine"),
        pytest.param(steps(435.8, 546.1, 577, 579, width=0.5), id="mercury"),
        pytest.param((np.arange(400.0, 701), np.random.default_rng(0).random(301)), id="rough"),
    ],
)
def test_tables_of_light_are_integrated_right(table):
    """However narrow, to 1 % of the channel that answers most, by dense sums of trapezes."""
    spectrum = Spectrum.smooth(bell, 400, 700, 31, [tuple(table)])
    places = np.sort(np.concatenate([np.arange(400, 700.005, 0.01), table[0]]))
    expected = np.trapezoid(bell(places) * np.interp(places, *table, left=0, right=0), places, axis=1)
    found = np.array(spectrum.responses) @ np.interp(spectrum.wavelengths, *table, left=0, right=0)
    assert np.abs(found - expected).max() < 0.01 * expected.max()
    assert 31 <= len(spectrum.wavelengths) < 500
    # Smooth light needs no more nodes than are asked for.
    smooth = Spectrum.smooth(bell, 400, 700, 31, [(np.array([300.0, 800.0]), np.array([1.0, 2.0]))])
    assert smooth == Spectrum.smooth(bell, 400, 700, 31)


def test_a_detector_of_narrow_filters(tmp_path):
    """The channels' responses to a line are those of the table, though all nodes of Gauss would miss them."""
    table = tmp_path / "filters.csv"
    table.write_text("400,0,0\n531,0,0\n531.5,1,0\n532.5,1,0\n533,0,0\n600,0,0\n601,0,4\n602,0,0\n900,0,0\n")
    sensor = Spectrum.sensor(table)
    assert sensor.centroids() == pytest.approx((532, 601), abs=0.01)
    assert np.array(sensor.responses).sum(1) == pytest.approx([1, 1], rel=1e-6)
    light = np.array([531.9, 532, 532.1]), np.array([0.0, 1, 0])
    found = Spectrum.sensor(table, tables=[light])
    value = np.array(found.responses) @ np.interp(found.wavelengths, *light, left=0, right=0)
    assert value == pytest.approx([0.1 / 1.5, 0], rel=0.01, abs=1e-9)


@pytest.mark.parametrize(("text", "message"), [
    ("wavelength,red\n", "rows"),
    ("wavelength,red\n400,1\n400,2\n", "rising"),
    ("wavelength,red\n400,1\n500,blue\n", "numbers"),
    ("wavelength,red\n400,nan\n500,1\n", "row 1"),
    ("wavelength,red\n400,0\n500,0\n", "channel 1"),
    ("wavelength,red\n-400,1\n500,1\n", "wavelength = -400"),
])  # fmt: skip
def test_tables_that_are_none(tmp_path, text, message):
    table = tmp_path / "sensor.csv"
    table.write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        Spectrum.sensor(table)
    assert str(table) in str(refused.value)


def test_shares_are_lagrange_polynomials():
    """They hand every polynomial up to their degree from the nodes to all wavelengths."""
    spectrum = Spectrum(tuple(range(400, 701, 10)), (tuple([1.0] * 31),)).interpolated(5)
    x, nodes = ((np.array(values) - 550) / 150 for values in (spectrum.wavelengths, spectrum.nodes))
    for power in range(5):
        assert nodes**power @ spectrum.shares() == pytest.approx(x**power, abs=1e-12)
    assert spectrum.interpolated(31).nodes == ()


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
    assert Spectrum((400.0, 500.0, 600.0, 700.0), ((0.0, 1.0, 0.5, 0.0),)).interpolated(3).nodes == (500.0, 600.0)
    assert Spectrum((400.0, 500.0), ((1.0, 1.0),)).interpolated(3).nodes == ()
