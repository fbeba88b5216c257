"""Derivatives of captures by waves behind real main lenses: against the full field, whose lens is fitted by itself."""

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.fitted_lens import lens_change

POINT = np.array((0.03, -0.02, 115.0))


def behind(name="double_gauss", **numbers):
    return small_camera(2, main_lens=name, **(HALF | numbers))


def test_changes_of_the_light_against_refitted_lenses():
    """The path, but for its piston, by lenses that are fitted anew to either side."""
    camera = behind("singlet")
    points = np.array([(0.5, -0.3, 110.0)])
    lens = OpticalSystem(camera, WAVELENGTH).waves_of(points)
    change = lens_change(lens, "wavelength")
    rng = np.random.default_rng(1)
    pupil = tuple(part[None] for part in 0.6 * lens.pupil.radius * rng.uniform(-1, 1, (2, 50)))
    fields, inverse_distance = lens.fitted.pupils.field(points)
    lanes = [np.array([[number]]) for number in change.aberration.at(fields, inverse_distance)[0]]
    field = fields[:, :1], fields[:, 1:]
    found = change.aberration.over_pupil(lanes, field).value(pupil)
    high, low = (
        OpticalSystem(camera, WAVELENGTH + step).waves_of(points).bind(points).length(pupil) for step in (1, -1)
    )
    expected = (high - low) / 2
    found, expected = found - found.mean(), expected - expected.mean()
    assert np.abs(expected).max() > 1e-6
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()


@pytest.mark.slow
def test_what_hides_parts_of_the_pupil_grows_with_its_opening():
    camera, step = behind(), 0.03
    points, weights = scattered(2, distances=(112.0, 128.0), image=0.05), np.ones(2)
    hidden = np.ones((2, 8, 8))
    hidden[:, :, 5:] = 0

    def image(side):
        changed = camera.replace(aperture_radius=camera.aperture_radius + side * step)
        operator = CaptureOperator(changed, points, wavelength=WAVELENGTH, accuracy=0, pupil_weights=hidden)
        return operator.forward(weights)

    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0, pupil_weights=hidden)
    found = operator.derivative(weights, {"aperture_radius": 1.0})
    assert error(found, (image(1) - image(-1)) / (2 * step)) < 0.025
