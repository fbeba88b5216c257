"""Point spread functions: the full field against closed forms and itself, the patch against the full field."""

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, capture, error, in_every_lens, small_camera
from scipy.special import j1

from mitsuba_plenoptic import CaptureOperator, InputError, PlenopticCamera, Vignetting, point_spread_function
from mitsuba_plenoptic.array import Conic
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.points.full_fields import full_field
from mitsuba_plenoptic.points.pupil_weights import PupilWeights
from mitsuba_plenoptic.prescription import Glass
from tools.bench.cases import lens_models, point_spreads

SMALL = small_camera(16)
METHODS = ("patch", "full_field")


def behind_a_fast_lens(f_number, pixels, blur, scale=1.0):
    """A camera of few pixels a lens, and 520 points that its lenses blur."""
    camera = PlenopticCamera.matched(
        f_number=f_number, lenses=10, pixels_per_lens=pixels, pixel_size=0.011, focal_length=50 * scale,
        focus_distance=320 * scale,
    )  # fmt: skip
    places = np.random.default_rng(1).uniform(-2, 2, (520, 2)) * camera.mla_pitch
    return camera, point_spreads.blurred(camera, places, blur)


def test_fast_lenses_bend_no_light_off_the_patch():
    """Spots lie up to a lens beside the light on the array, which is wider than the Airy pattern."""
    camera, points = behind_a_fast_lens(2.8, 5, 1, scale=1 / 12)
    operator = CaptureOperator(camera, points, wavelength=550)
    full = point_spread_function(camera, points[0], wavelength=550, method="full_field")
    assert error(operator.forward(np.arange(520) == 0), full) < 0.01


@pytest.mark.parametrize("f_number, accuracy", [(2, 0.05), (4, 0.01)])
def test_sums_behind_fast_lenses_keep_their_accuracy(f_number, accuracy):
    """Of points among so many that less of the diffracted light is kept than of few."""
    camera, points = behind_a_fast_lens(f_number, 7, 1)
    weights = np.arange(520) < 8
    exact = CaptureOperator(camera, points[weights], wavelength=550, accuracy=0).forward(np.ones(8))
    image = CaptureOperator(camera, points, wavelength=550, accuracy=accuracy).forward(weights.astype(float))
    assert error(image, exact) < accuracy


@pytest.mark.parametrize(
    "camera, g",
    [
        (small_camera(6, aperture_radius=2.0), 215.0),
        pytest.param(PlenopticCamera(detector_width=0.128, resolution=(512, 512)), 230.0, marks=pytest.mark.slow),
        (small_camera(16, mla_focal_length=5.4, detector_distance=5.4), 240.0),
        pytest.param(small_camera(3, mla_pitch=0.02), 230.0, marks=pytest.mark.slow),
    ],
    ids=["small pupil", "fine pixels", "weak lenses", "small lenses"],
)
def test_patch_of_extreme_cameras_against_full_field(camera, g):
    position = (0.06, -0.05, g)
    patch, full = (point_spread_function(camera, position, wavelength=WAVELENGTH, method=name) for name in METHODS)
    assert error(patch, full) < 0.005


@pytest.mark.slow
def test_gaps_between_microlenses_at_the_default_accuracy():
    camera = small_camera(4, mla_fill=0.5, **HALF)
    points = in_every_lens(camera, 1, 115.0, per_lens=2) + np.array([0.06, -0.05, 0.0])
    exact = capture(camera, points, np.full(len(points), 150.0), method="full_field")
    many = np.repeat(points, 150, axis=0)
    assert error(capture(camera, many, np.ones(len(many))), exact) < 0.01


def test_hidden_cells_of_the_pupil():
    """Their borders do not depend on where the samples of the pupil lie."""
    camera, position = small_camera(6), np.array([0.06, -0.05, 230.0])
    weights = np.array([[[False, False], [False, True]]])
    patch = CaptureOperator(camera, [position], wavelength=WAVELENGTH, accuracy=0, pupil_weights=weights).forward([1.0])
    full = full_field(OpticalSystem(camera, WAVELENGTH), position, pupil_weights=PupilWeights.of(weights, 1))
    assert error(patch, full) < 0.003


def test_spreads_by_rays_share_the_pupils_image_on_the_array_among_lenses():
    """The image of a point off the focus is even. Without array it is on the detector."""
    camera, (X, Y, g) = SMALL.replace(aperture_blades=6), (0.2, 0.1, 225.0)
    rays = point_spread_function(camera, (X, Y, g), model="ray")
    u, v = np.meshgrid(*[(np.arange(2000) + 0.5) / 1000 - 1] * 2)
    passed = camera.aperture.power(u, v) * (u**2 + v**2 < 1)
    blur, scale = camera.aperture_radius * camera.defocus(g), camera.mla_distance / g
    cells = np.stack(camera.lattice.cell(-X * scale + blur * u, -Y * scale + blur * v), -1).astype(int) + 50
    expected = np.bincount((cells @ [1, 100]).ravel(), passed.ravel(), 10**4) / camera.aperture.power(u, v).sum()
    growth = camera.image_growth
    x, y = np.meshgrid(camera.pixel_coordinates(0) / growth, camera.pixel_coordinates(1) / growth)
    below = np.stack(camera.lattice.cell(x, y), -1).astype(int) + 50
    found = np.bincount((below @ [1, 100]).ravel(), rays.ravel(), 10**4)
    assert np.abs(found - expected).max() < 0.005 * expected.max()
    disc = point_spread_function(SMALL.replace(mla_lattice="none"), (X, Y, g), model="ray")
    area = np.pi * (camera.aperture_radius * camera.defocus(g) / camera.pixel_size) ** 2
    assert disc.sum() == pytest.approx(1, rel=1e-3) and np.median(disc[disc > 0]) == pytest.approx(1 / area, rel=0.02)


def test_rays_refract_at_their_wavelength_in_microlenses_of_a_shape():
    """As glass does whose index is the same at all wavelengths; spreads of prescriptions have a relation."""

    def spread(glass, **options):
        camera = SMALL.replace(mla_focal_length=None, mla_shape=Conic(0.3, glass=glass), detector_distance=0.5)
        return point_spread_function(camera, (0.2, 0.1, 225.0), model="ray", **options)

    flint = Glass.from_plain({"index": 1.7, "abbe": 25.0})
    assert np.array_equal(spread(flint, wavelength=450.0), spread(flint.at(450.0)))
    assert error(spread(flint, wavelength=450.0), spread(flint)) > 0.05


def test_airy_pattern_of_the_bare_main_lens():
    """In focus, without microlenses, at D1 = 5 where the thin parabolic lens is diffraction limited."""
    camera = small_camera(8, aperture_radius=2.5, mla_distance=120 - 0.512, detector_distance=0.512)
    psf = full_field(OpticalSystem(camera, WAVELENGTH), np.array([0.0, 0.0, 240.0]), microlenses=False)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    p, lam = camera.pixel_size, WAVELENGTH * 1e-6
    x = (np.arange(256) - 127.5)[:, None] * p + nodes * p / 2
    r = np.hypot(x[:, None, :, None], x[None, :, None, :])
    sine = camera.aperture_radius / np.hypot(camera.aperture_radius, 120)
    v = 2 * np.pi * sine * r / lam
    density = np.pi * (sine / lam) ** 2 * (2 * j1(v) / v) ** 2
    assert error(psf, np.einsum("ijkl,k,l->ij", density, weights, weights) * (p / 2) ** 2) < 1e-3


def test_light_that_converges_behind_the_lens_lands_where_its_rays_do():
    """The power on the detector is its part of the blurred disc of light."""
    camera, options = small_camera(8, aperture_radius=2), {"accuracy": 0, "virtual": True}
    fast, slow = (capture(camera, [(0.1, -0.2, -900.0)], [1.0], method=method, **options) for method in METHODS)
    assert error(fast, slow) <= 0.01
    blur = 2 * (1 - 120 * (1 / 80 + 1 / 900))
    assert slow.sum() == pytest.approx(0.512**2 / (np.pi * blur**2), rel=0.03)


def test_stars_are_airy_patterns_behind_ideal_lenses(monkeypatch):
    monkeypatch.setattr(lens_models, "MODELS", ("ideal",))
    worst = [row["worst"] for row in lens_models.stars(f_numbers=(5.6,), places=(0.0,))]
    assert len(worst) == 2 and max(worst) < 0.003


def test_light_that_never_reaches_the_mla_is_refused():
    """A parabolic phase adds cosines, and may ask for more than 1; an ideal lens adds slopes."""
    steep = {"position": (400.0, 0, 85.0), "wavelength": 633}
    with pytest.raises(InputError, match=r"^position"):
        point_spread_function(SMALL.replace(lens_model="parabolic"), **steep)
    assert not point_spread_function(SMALL, **steep).any()


def test_dimmed_light_is_a_part_of_the_light():
    """An apodised pupil passes 1 + a / 2 of a point's light, an outline of 0.6 its square."""
    small = PlenopticCamera(detector_width=0.256, resolution=(64, 64))
    points = np.array([[0.02, -0.03, 238.0], [-0.05, 0.01, 243.0]])
    for given, part in (
        (Vignetting(radius=1.0, apodisation_2=-0.5), 0.75),
        (Vignetting(radius=0.6), 0.36),
        (Vignetting(radius=1.0, slope_x=[0.4]), 1.0),
    ):
        plain, dimmed = (capture(small.replace(vignetting=each), points, [1, 2]).sum() for each in (None, given))
        assert dimmed == pytest.approx(part * plain, rel=0.015)


def test_an_ordinary_camera_has_the_mean_response_of_its_pupil():
    camera = PlenopticCamera(mla_lattice="none", detector_width=0.08, resolution=(40, 40))
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 400)])
    inside = np.hypot(x, y) < 1
    angle = np.degrees(np.arctan(np.hypot(x, y)[inside] * camera.pupil_radius / camera.pupil_distance))
    for options in ({}, {"model": "ray"}):
        dimmed, plain = (
            point_spread_function(each, (0.0, 0.0, 240.0), wavelength=550.0, **options)
            for each in (camera.replace(pixel_response=(0, 1, 3, 0.3)), camera)
        )
        assert dimmed.sum() / plain.sum() == pytest.approx(np.interp(angle, [0, 3], [1, 0.3]).mean(), rel=0.01)
