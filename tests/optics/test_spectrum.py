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
