"""The kernel bank behind real main lenses: against exact sums, plain formulas, and captures by rays."""

import pickle

import mitsuba as mi
import numpy as np
import pytest
from wave_cases import WAVELENGTH, error, small_camera

from mitsuba_plenoptic import CaptureOperator, InputError, render_capture
from mitsuba_plenoptic.capture.bank import LensBank, local_camera, local_vergences, near_weight
from mitsuba_plenoptic.capture.bank.blend import blur_of, least_blur, most_blur
from mitsuba_plenoptic.capture.bank.local_lens import Spread, at_pupil, derivatives, local_point
from mitsuba_plenoptic.capture.bank.plan import BankPlan
from mitsuba_plenoptic.capture.lens_paths import paths_of
from mitsuba_plenoptic.capture.pupil_edges import PupilEdges
from mitsuba_plenoptic.optics.fitted_lens import lens_of_rays, lens_of_waves
from mitsuba_plenoptic.optics.lens_system import LensSystem
from mitsuba_plenoptic.runtime.backend import array_module


def behind(name="double_gauss", lenses=24, **parameters):
    """Return a camera of few lenses that a real one serves."""
    return small_camera(lenses, **{"main_lens": name, "focal_length": 80, "aperture_radius": 5} | parameters)


def wall(camera, distance, lenses=2, per_lens=8):
    """Return points of a wall on the axis, even in every lens."""
    place = ((np.arange(lenses * per_lens) + 0.5) / per_lens - lenses / 2) * camera.mla_pitch
    x, y = (part.ravel() * -distance / camera.mla_distance for part in np.meshgrid(place, place))
    return np.column_stack([x, y, np.full(len(x), distance)])


@pytest.mark.parametrize("distance", [216.0, pytest.param(272.0, marks=pytest.mark.slow)], ids=["before", "behind"])
def test_walls_are_those_of_exact_sums(distance):
    camera = behind()
    points, ones = wall(camera, distance), np.ones(256)
    image = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="bank").forward(ones)
    exact = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0).forward(ones)
    assert near_weight(camera, float(lens_of_rays(camera).vergence(distance)), 0.01) == 0
    assert error(image, exact) < 0.01
    assert image.sum() == pytest.approx(exact.sum(), rel=0.004)


@pytest.mark.slow
def test_adjoint_is_the_transpose():
    camera, generator = behind(lenses=12), np.random.default_rng(0)
    points = wall(camera, 216.0, per_lens=2)
    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="bank", accuracy=0.03)
    weights, image = generator.random(len(points)), generator.random(camera.shape)
    forward, back = operator.forward(weights), operator.adjoint(image)
    assert float((forward * image).sum()) == pytest.approx(float(weights @ back), rel=1e-4)


def test_batches_can_be_sent_to_other_processes():
    camera = behind(lenses=12)
    plan = BankPlan(camera, wall(camera, 216.0, per_lens=2), None, WAVELENGTH, 0.03)
    own, sent = plan.rays(0).trace(), pickle.loads(pickle.dumps(plan.rays(0))).trace()
    assert len(own.x) > 100
    np.testing.assert_array_equal(own.coefficients, sent.coefficients)


def test_a_perfect_wave_is_found_where_it_is_in_the_table():
    """Light that converges without aberrations through a round pupil is the table's own."""
    camera, types = behind(), array_module()
    a, b, defocus = camera.pupil_radius, camera.pupil_distance, -0.05
    x, y = types.Float(1.0, -2.0, 3.0), types.Float(0.5, 4.0, 1.2 * a)
    inverse = ((types.Float(1 / defocus), types.Float(0)), (types.Float(0), types.Float(1 / defocus)))
    radius = np.hypot(x, y)
    outward = [types.Float(np.array(part) / radius / (a * defocus)) for part in (x, y)]
    Px, Py, vergence = local_point(camera, inverse, [(types.Float(radius / a), outward)])
    np.testing.assert_allclose(np.array(Px), np.array(x), rtol=1e-5)
    np.testing.assert_allclose(np.array(Py), np.array(y), rtol=1e-5)
    np.testing.assert_allclose(np.array(vergence), (1 - defocus) / b, rtol=1e-6)


def test_of_two_edges_the_nearer_counts():
    camera, types = behind(), array_module()
    a, one = camera.pupil_radius, types.Float(1.0)
    inverse = ((one * 20, one * 0), (one * 0, one * 20))
    edges = [(one * 0.9, (one * (20 / a), one * 0)), (one * 0.8, (one * 0, one * (20 / a)))]
    for order in (edges, edges[::-1]):
        Px, Py, _ = local_point(camera, inverse, order)
        assert (Px[0], Py[0]) == pytest.approx((0.9 * a, 0), abs=1e-4)


@pytest.mark.slow
def test_rays_find_the_derivatives_and_edges_that_fitted_paths_have():
    """Two ways to the same: from the array by neighbouring rays, and from the point by polynomials."""
    camera, types = behind("cooke_triplet", 128, aperture_radius=6), mi.Float
    system = LensSystem.of(camera, WAVELENGTH)
    distance, centre, P = 205.0, (2.0, -1.2), (-2.5, 3.0)
    point, slope, _ = system.ray(P, centre)
    position = np.array([[*(x + s * (distance - point[2]) for x, s in zip(point, slope, strict=False)), distance]])
    light = lens_of_waves(camera, position, WAVELENGTH).bind(position)
    pupil = tuple(np.array([[value]]) for value in P)
    assert np.hypot(*np.array(light.land(pupil, None)).ravel() - centre) < 1e-4
    (xx, xy), (yx, yy) = derivatives(light, pupil, 1e-3)
    bank = LensBank.learn(
        local_camera(camera), WAVELENGTH, 0.1, local_vergences(camera, (float(system.vergence(distance)),) * 2)
    )
    path = paths_of(camera, [bank], WAVELENGTH).follow(
        *((types(pair[0]), types(pair[1])) for pair in (P, centre)), None
    )
    start = np.array([path.point[k][0] for k in range(3)])
    Px, Py, vergence = path.asked(types(distance - start[2]), None)
    mean = np.trace(np.linalg.inv(np.array([[xx, xy], [yx, yy]]).reshape(2, 2))) / 2
    assert (1 - camera.pupil_distance * vergence[0]) == pytest.approx(1 / mean, rel=0.02)
    within = float(light.inside(pupil)[0, 0])
    assert camera.pupil_radius - np.hypot(Px[0], Py[0]) == pytest.approx(within, rel=0.1)


def test_edges_hold_what_is_open():
    camera = behind("cooke_triplet", 128, aperture_radius=7)
    lens, edges = LensSystem.of(camera), PupilEdges.of(camera)
    axis = np.linspace(-1.2, 1.2, 81) * camera.pupil_radius
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    for height in (0.0, 2.0, 4.0):
        is_open = lens.ray((x, y), (0 * x, 0 * x + height))[2]
        moved = edges.within((mi.Float(x), mi.Float(y)), (mi.Float(0), mi.Float(height)))
        away = np.hypot(np.array(moved[0]) - x, np.array(moved[1]) - y)
        assert away[is_open].max() < 0.03 * camera.pupil_radius
        assert np.count_nonzero((away < 1e-6) & ~is_open) < 0.03 * np.count_nonzero(is_open)


def test_blur_counts_aberrations_at_their_least_and_most():
    camera = behind("cooke_triplet", 128, aperture_radius=7)
    lens, spread = lens_of_rays(camera), Spread.of(camera)
    assert spread == Spread.of(camera.replace(crop_offset=(7, 8), crop_size=(64, 64)))
    before, behind_focus = (float(lens.vergence(distance)) for distance in (215.0, 270.0))
    assert blur_of(camera, before) > 0 > blur_of(camera, behind_focus)
    assert least_blur(camera, before) == pytest.approx(blur_of(camera, before) - spread.less[0])
    assert least_blur(camera, behind_focus) == pytest.approx(-blur_of(camera, behind_focus) - spread.less[1])
    assert most_blur(camera, before) >= blur_of(camera, before) + spread.most
    low, high = local_vergences(camera, (before, before))
    assert low < at_pupil(camera, before) < high
    # The Cooke triplet's spherical aberration takes some lenses of blur away before focus.
    assert spread.less[0] > 1


@pytest.mark.slow
def test_light_of_a_vignetted_lens_has_the_energy_of_rays():
    mi.set_variant("llvm_ad_mono")
    camera = behind("cooke_triplet", 128, focal_length=16, aperture_radius=1.55, focus_distance=200.0,
                    mla_focal_length=0.3, crop_offset=(3936, 64), crop_size=(96, 96))  # fmt: skip
    place = mi.ScalarTransform4f().translate([0, 0, 60]) @ mi.ScalarTransform4f().scale([60, 60, -1])
    wall = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": 1.0}}
    scene = mi.load_dict({"type": "scene", "s": camera.to_sensor(), "integrator": {"type": "path"}, "wall": wall})
    rays = render_capture(scene, model="ray", spp=256).image.mean()
    waves = render_capture(scene, model="wave", method="bank", accuracy=0.03, spp=4).image.mean()
    assert 0.2 < rays < 0.4
    assert waves == pytest.approx(rays, rel=0.015)


def test_light_that_the_lens_focuses_elsewhere_is_refused():
    points = [(0, 0, 150)]
    single = behind("singlet", 4)
    with pytest.raises(
        InputError, match=r"wavelength = 850: method = bank: main_lens = .* blurs its light over .* less"
    ):
        CaptureOperator(single, points, wavelength=850, method="bank", accuracy=0.03).estimate()


def test_what_is_not_known_is_refused():
    camera = behind(lenses=4)
    with pytest.raises(InputError, match="pupil_weights: method bank takes none behind a main_lens; use patch"):
        CaptureOperator(camera, [(0, 0, 216)], wavelength=633, method="bank", pupil_weights=np.ones((1, 4, 4)))
    mi.set_variant("llvm_ad_rgb")
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 216]).scale([9, 9, -1])}
    sensor = camera.to_sensor()
    sensor["film"]["pixel_format"] = "rgb"
    lamp = {"type": "area", "radiance": 1.0}
    scene = mi.load_dict(
        {"type": "scene", "s": sensor, "integrator": {"type": "path"}, "wall": wall | {"emitter": lamp}}
    )
    with pytest.raises(InputError, match=r"method = bank: main_lens = .* disperses light, of which a bank records one"):
        render_capture(scene, model="wave", method="bank")
