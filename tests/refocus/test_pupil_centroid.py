"""Where the light of a pixel comes from in the pupil, against a plain sum over the pupil's points."""

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.refocus.displacement import PupilCentroid

CAMERA = PlenopticCamera(detector_width=0.768, resolution=(192, 192))


def by_points(camera, x, y, wavelength, count=400):
    """The squared sinc of a square lens, weighed over a disc."""
    line = ((np.arange(count) + 0.5) / count * 2 - 1) * camera.aperture_radius
    Px, Py = np.meshgrid(line, line)
    width = wavelength * 1e-6 * camera.mla_distance / camera.mla_pitch
    weight = np.sinc((Px - x) / width) ** 2 * np.sinc((Py - y) / width) ** 2
    weight *= np.hypot(Px, Py) <= camera.aperture_radius
    return (weight * Px).sum() / weight.sum(), (weight * Py).sum() / weight.sum()


@pytest.mark.parametrize("wavelength", [633.0, 450.0])
def test_centroids_are_those_of_a_sum_over_the_pupil(wavelength):
    centroid = PupilCentroid(CAMERA, wavelength)
    places = [(0.0, 0.0), (3.0, -1.0), (4.8, 0.0), (-2.0, 4.9), (5.3, 0.4)]
    x, y = centroid(*np.array(places).T)
    for place, *found in zip(places, x, y, strict=True):
        np.testing.assert_allclose(found, by_points(CAMERA, *place, wavelength), atol=0.04)
    # At the rim light comes from within.
    assert 4.8 - x[2] > 0.2


def test_what_lies_far_outside_comes_from_the_pupil():
    centroid = PupilCentroid(CAMERA, 633.0)
    for places in centroid(np.array([0.0, 16.0, -300.0]), np.array([19.0, 0.0, 300.0])):
        assert (np.abs(places) <= CAMERA.aperture_radius).all()
