"""Derivatives of captures by waves behind real main lenses: against the full field, whose lens is fitted by itself."""

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error, in_every_lens, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator
from mitsuba_plenoptic.lenses.fitted_lens import lens_change
from mitsuba_plenoptic.lenses.pupil_fit import ExitPupil
from mitsuba_plenoptic.lenses.thin import Wavefront
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.arrival import field_grids
from mitsuba_plenoptic.points.derivatives.plan import DerivativePlan
from mitsuba_plenoptic.points.full_field import full_field

POINT = np.array((0.03, -0.02, 115.0))


def behind(name="double_gauss", **numbers):
    return small_camera(2, main_lens=name, **(HALF | numbers))


@pytest.mark.slow
def test_aberrations_are_added_on_the_exit_pupil(monkeypatch):
    camera, amounts = behind(mla_rotation=9.0), np.zeros(11)
    amounts[[3, 6, 10]] = 1.0, -0.7, 0.5
    found = CaptureOperator(camera, [POINT], wavelength=WAVELENGTH, accuracy=0).derivative(
        [1.0], {"wavefront": amounts.tolist()}
    )
    grids, plain, sides, step = (
        field_grids(OpticalSystem(camera, WAVELENGTH), POINT, 1.0, 1.4),
        ExitPupil.path,
        [],
        3e-3,
    )
    for amount in (step, -step):
        added = Wavefront((amount * amounts).tolist(), camera.pupil_radius)

        def path(self, pupil, point, wavelength, added=added):
            return plain(self, pupil, point, wavelength) + added.path(*pupil) * (1 / (wavelength * 1e-6))

        monkeypatch.setattr(ExitPupil, "path", path)
        sides.append(full_field(OpticalSystem(camera, WAVELENGTH), POINT, grids=grids))
    assert error(found, (sides[0] - sides[1]) / (2 * step)) < 0.005


@pytest.mark.parametrize(("name", "shared"), [("double_gauss", False), (None, True)])
def test_many_points_share_the_changes_of_their_spreads_behind_thin_lenses_only(name, shared):
    """What a copy's own image does as a real lens changes, the spread that it is a copy of does not tell."""
    points = in_every_lens(behind(name), 24, 115.0)
    plan = DerivativePlan(OpticalSystem(behind(name), WAVELENGTH), points, None, 0.02)
    assert bool(plan._shifts.any()) == shared


def test_changes_of_the_light_against_refitted_lenses():
    """The path, but for its piston, by lenses that are fitted anew to either side."""
    camera = behind("singlet")
    points = np.array([(0.5, -0.3, 110.0)])
    lens = OpticalSystem(camera, WAVELENGTH).waves_of(points)
    change = lens_change(lens, "wavelength")
    rng = np.random.default_rng(1)
    pupil = tuple(part[None] for part in 0.6 * lens.pupil_radius * rng.uniform(-1, 1, (2, 50)))
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
