"""Verdicts on limits come out both ways, and the plain loop gives the sums of our reconstruction."""

import math

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera, design
from mitsuba_plenoptic.extensions.paper import paper_limits as limits
from mitsuba_plenoptic.extensions.paper.procedures import back_path, light_path, micro_image
from mitsuba_plenoptic.refocus.projection import pupil_radius, ray_sums

PAPER, WAVELENGTH = PlenopticCamera(), 633.0


@pytest.mark.parametrize("distance", [240.0, 280.0])
def test_the_plain_loop_gives_the_sums_of_our_reconstruction(distance):
    camera = PlenopticCamera(detector_width=0.512, resolution=(256, 256))
    part = camera.replace(crop_offset=(32, 64), crop_size=(160, 96))
    image = np.random.default_rng(0).random((96, 160), np.float32)
    ours = ray_sums(image[..., None], part, distance, pupil_radius(part), "point", 1)[..., 0]
    assert limits.run_plain_sums(image, part, distance) == pytest.approx(ours, abs=1e-4)
    assert np.count_nonzero(ours) >= 15


def test_a_plain_loop_with_other_sums_is_not_timed(monkeypatch):
    small = PlenopticCamera(detector_width=0.256, resolution=(128, 128))
    # Scaled to the paper's 4096 x 4096 pixels, of which no computer adds 200 million a second in a plain loop.
    assert limits.plain_seconds(small, 280.0) > 0.1
    monkeypatch.setattr(limits, "run_plain_sums", lambda image, camera, distance: np.zeros(camera.bin_count[::-1]))
    with pytest.raises(RuntimeError, match="different sums"):
        limits.plain_seconds(small, 280.0)


def test_verdicts_on_limits_come_out_each_way():
    """Of the time of a plain program, and of narrow lenses, whose pixels are as wide as their spot of diffraction."""
    for plain, verdict in ((65.0, "differs"), (100.0, "confirmed")):
        claim = limits.check_limits(PAPER, WAVELENGTH, plain, 0.03)[2]
        assert claim.statement.endswith("330 s.") and claim.verdict == verdict
    for pitch, verdict in ((0.064, "differs"), (0.0325, "partly"), (0.026, "confirmed")):
        size = {"mla_pitch": pitch, "detector_width": 64 * pitch, "resolution": (round(64 * pitch / 0.0065),) * 2}
        assert limits.check_limits(PAPER.replace(**size), WAVELENGTH, 1.0, 1.0)[1].verdict == verdict


def test_deconvolution_is_best_where_lenses_begin_to_see_different_phases():
    distance, fraction = limits.deconvolved_fraction(PAPER, WAVELENGTH)
    # w^2 / 2 M^2 lambda from focus, at 2.1 M / w by Broxton's formula, of the b / 2 p g of the pixels.
    depth = 0.064**2 / (2 * 0.5**2 * 633e-6)
    assert distance == pytest.approx(240 + depth, abs=0.5)
    assert fraction == pytest.approx(2 * 0.5 / (0.94 * 0.064) * 2 * 0.002 * distance / 120, rel=0.05)


def test_focused_cameras_keep_the_plane_in_focus_and_their_range():
    *focused, plain = limits.focused_cameras(PAPER, WAVELENGTH)
    assert plain.camera is PAPER and plain.pixels == 128 and len(focused) == 4
    for each in focused:
        assert each.camera.focus_distance != pytest.approx(240) and design.focus_type(each.camera) == "keplerian"
        assert design.best_distances(each.camera)[0] == pytest.approx(240)
        # A spot of diffraction, magnified by the virtual depth; the main lens's image is nearer to it than the array.
        spot = WAVELENGTH * 1e-6 * 0.512 / 0.064
        field = 8.192 * 120 / each.camera.mla_distance
        assert each.pixels == pytest.approx(field / (spot * each.virtual_depth), rel=1e-4)
        assert each.near < 240 < each.far


def test_pixels_against_range():
    for ranges, verdict in (((0.1, 0.2, 0.3), "confirmed"), ((0.1, 0.3, 0.2), "partly"), ((0.3, 0.2, 0.1), "differs")):
        cameras = [limits.FocusedCamera(PAPER, 3.0, 500.0, 240.0, 1 / (1 / 240 - 1e-3 * width)) for width in ranges]
        assert [each.range for each in cameras] == pytest.approx(ranges)
        assert limits.pixels_against_range(cameras).verdict == verdict
    assert (
        "infinity" in limits.pixels_against_range([limits.FocusedCamera(PAPER, 3.0, 500.0, 200.0, math.inf)]).measured
    )


def test_rays_of_a_point_meet_in_its_image(distance=210.0):
    (_, lens, array) = np.moveaxis(light_path(PAPER, (2.0, distance), np.linspace(-5, 5, 7)), 1, 0)
    image = 1 / (1 / PAPER.focal_length - 1 / distance)
    met = lens[:, 1] + (array[:, 1] - lens[:, 1]) / PAPER.mla_distance * image
    assert met == pytest.approx(np.full(7, -2.0 * image / distance))


def test_the_way_back_leads_through_the_pupil_to_the_plane_in_focus():
    pixels = micro_image(PAPER, 3 * PAPER.mla_pitch)
    _, _, pupil, plane = np.moveaxis(back_path(PAPER, 3 * PAPER.mla_pitch, pixels, 240.0), 1, 0)
    assert np.abs(pupil[:, 1]).max() == pytest.approx(PAPER.aperture_radius)
    assert plane[:, 1] == pytest.approx(np.full(7, -3 * PAPER.mla_pitch * 2))
