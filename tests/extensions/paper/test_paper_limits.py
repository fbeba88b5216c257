"""Verdicts on limits come out both ways, and the plain loop gives the sums of our reconstruction."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera, design
from mitsuba_plenoptic.extensions.paper import paper_limits as limits
from mitsuba_plenoptic.extensions.paper.claims import check_claims
from mitsuba_plenoptic.extensions.paper.procedures import back_path, light_path, micro_image
from mitsuba_plenoptic.refocus.projection import pupil_radius, ray_sums

PAPER, WAVELENGTH = PlenopticCamera(), 633.0


def test_the_plain_loop_gives_the_sums_of_our_reconstruction(distance=280.0):
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
    endless = limits.FocusedCamera(PAPER, 3.0, 500.0, 200.0, math.inf)
    assert "infinity" in limits.pixels_against_range([endless]).measured


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


FAIR = {"coherent": (0.08, 0.05), "partial": (0.009, 0.008), "seconds": (9.0, 1.0, 3.5), "mesh": (0.3, 0.01)}

READINGS = {
    "quarters": (0.009, 0.009),
    "sublattice": (0.009, 0.009),
    "colours": (4, 3),
    "literal_coherent": (0.08, 0.05),
    "literal_partial": (0.02, 0.02),
    "coherent_from_rays": (0.08, 0.05),
    "limit_from_rays": (0.01, 0.015),
}


def verdicts(coherent, partial, seconds, mesh, **readings):
    """Verdicts by statement; `mesh` is how far coherent and partial images are from that by rays, at each distance."""
    camera = PlenopticCamera(detector_width=2.048, resolution=(1024, 1024))
    ray = np.add.outer(np.arange(32.0), np.arange(32.0)) / 62
    noise = np.random.default_rng(0).normal(0, 1, ray.shape)
    images = {}
    for distance, shares in zip((210.0, 280.0), np.broadcast_to(mesh, (2, 2)), strict=True):
        images["ray", distance] = ray
        for method, share in zip(("coherent", "partial"), shares, strict=True):
            images[method, distance] = ray + share * noise
    interference = [
        {"shape": shape, "shape_distance": own, "distance": other, "coherent": coherent[k], "partial": partial[k]}
        for k, (shape, own, other) in enumerate((("near", 210.0, 280.0), ("far", 280.0, 210.0)))
    ]
    experiment = SimpleNamespace(settings=SimpleNamespace(distances=(210.0, 280.0)), images=images, camera=camera)
    read = {**READINGS, **readings}
    numbers = {
        "reconstructions": [{"bins": [32, 32]}],
        "interference": interference,
        "readings": [
            {"shape": shape, "distance": distance, **{name: pair[k] for name, pair in read.items()}}
            for k, (shape, distance) in enumerate((("near", 280.0), ("far", 210.0)))
        ],
    }
    named = dict(zip(("ray", "coherent", "partial"), seconds, strict=True))
    claims = check_claims(experiment, numbers, named, "near", "far")
    return {claim.statement.split(":")[0]: claim.verdict for claim in claims}


@pytest.mark.parametrize(
    ("statement", "partly", "differs"),
    [
        ("Coherent propagation shows", [{"coherent": (0.08, 0.01)}], [{"coherent": (0.01, 0.01)}]),
        ("Partially coherent propagation strongly", [{"partial": (0.009, 0.04)}], [{"partial": (0.08, 0.05)}]),
        (
            "The partially coherent image",
            [{"mesh": ((0.3, 0.01), (0.01, 0.01))}],
            # As near as before, but no nearer than the coherent one; near on average, but not in what it shows.
            [{"mesh": (0.01, 0.01)}, {"mesh": (0.9, 0.3)}, {"mesh": (0.1, 0.03)}],
        ),
        ("Apart from interference", [{"limit_from_rays": (0.01, 0.03)}], [{"limit_from_rays": (0.03, 0.03)}]),
        *(
            # Where nothing is visible nothing is removed.
            (statement, [{name: (0.015, 0.009)}], [{name: (0.015, 0.015)}, {"coherent": (0.01, 0.01)}])
            for statement, name in (
                ("Four propagations, every second lens", "partial"),
                ("Four propagations, one for each quarter", "quarters"),
                ("Four propagations, of the four regular", "sublattice"),
            )
        ),
        ("With four propagations the images", [{"colours": (5, 4)}], [{"colours": (188, 144)}]),
        (
            "With a phase at the detector",
            [{"literal_coherent": (0.08, 0.03)}],
            [{"literal_coherent": (0.01, 0.01), "literal_partial": (0, 0)}, {"literal_partial": (0.05, 0.05)}],
        ),
        ("Reconstruction by waves is faster", [], [{"seconds": (0.1, 1.0, 3.5)}]),
        ("Partially coherent propagation takes", [], [{"seconds": (9.0, 1.0, 1.5)}, {"seconds": (9.0, 1.0, 5.0)}]),
    ],
)
def test_verdicts_come_out_each_way(statement, partly, differs):
    for verdict, changes in (("confirmed", [{}]), ("partly", partly), ("differs", differs)):
        for change in changes:
            found = verdicts(**{**FAIR, **change})
            assert next(found[name] for name in found if name.startswith(statement)) == verdict, change
