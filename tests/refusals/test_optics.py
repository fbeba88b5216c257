"""What free space and spectra refuse."""

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera, Spectrum, point_spread_function
from mitsuba_plenoptic.optics.waves import propagate
from refusals import refused, refuses

TABLE = np.arange(400.0, 700, 0.2), np.random.default_rng(0).random(1500)


def propagated(**changes):
    return propagate(**{"field": np.ones((4, 4)), "pitch": 1e-3, "distance": 1.0, "wavelength": 633.0} | changes)


def bell(places):
    """Responses of two channels."""
    return np.stack([np.exp(-(((places - middle) / 40) ** 2)) for middle in (540, 610)])


test_refused = refused(
    (lambda: propagated(field=np.zeros(5)), "^field"),
    (lambda: propagated(pitch=0.0), "^pitch"),
    (lambda: propagated(wavelength=-633.0), "^wavelength"),
    (lambda: Spectrum((), ()), "^spectrum: it must have a wavelength"),
    (lambda: Spectrum((-633.0,), ((1.0,),)), "^wavelength = -633"),
    (lambda: Spectrum((633.0, 532.0), ((1.0,),)), r"^spectrum: responses of shape \(1, 1\)"),
    (lambda: Spectrum((633.0,), ((np.nan,),)), "^spectrum: responses of shape"),
    (lambda: PlenopticCamera().lenslet(0, [1, 2]), r"^j = \[1, 2\]: "),
    (lambda: Spectrum.smooth(bell, 400, 700, 31, [TABLE]), "1024 wavelengths"),
)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (5320, "wavelength = 5320: .*angstroms, 532 nm"),
        (0.633, "wavelength = 0.633: .*micrometres, 633 nm"),
        (633e-9, "wavelength = 6.33e-07: .*metres, 633 nm"),
        (150, "wavelength = 150: .*200 to 2500 nm"),
        ("633", "wavelength = '633'"),
    ],
)
def test_wavelengths_in_other_units(given, words):
    for take in (
        lambda: Spectrum((given,), ((1.0,),)),
        lambda: point_spread_function(PlenopticCamera(), (0, 0, 240), wavelength=given),
    ):
        refuses(words, take)
