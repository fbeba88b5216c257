"""Microscopes by waves and rays: against the Debye integral, closed forms, and one way of following light the other."""

from dataclasses import replace

import numpy as np
import pytest
from cameras import capture, disk, error, pattern_count, sky
from cases import scene_of
from numpy.polynomial.legendre import leggauss
from scipy.special import j0

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lenses.telecentric import FourierLens, TelecentricLens
from mitsuba_plenoptic.points.point_spread import point_fields

AIR, OIL = mp.Objective(20, 0.5), mp.Objective(40, 1.3, 1.515, tube_focal_length=180)
FOURIER = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)
WAVELENGTH = 550.0


def camera_with(objective, **numbers):
    usual = {"mla_pitch": 0.15, "mla_focal_length": 3.0, "mla_offset": (0.075, 0.075)}
    usual |= {"detector_width": 1.35, "resolution": (135, 135)}
    return mp.PlenopticCamera(**({"main_lens": objective} | usual | numbers))


def fourier_camera(**numbers):
    usual = {"mla_pitch": 0.5, "mla_focal_length": 20.0, "mla_offset": (0.25, 0.25)}
    usual |= {"detector_width": 3.5, "resolution": (700, 700)}
    return camera_with(FOURIER, **(usual | numbers))


def debye(objective, radius, depth):
    """Intensity of a point on the axis, by quadrature over the angles at which light leaves it."""
    nodes, weights = leggauss(300)
    half = objective.half_angle / 2
    angle, k = (nodes + 1) * half, 2 * np.pi * objective.immersion / (WAVELENGTH * 1e-6)
    pupil = np.sqrt(np.cos(angle)) * np.sin(angle) * np.exp(1j * k * depth * np.cos(angle)) * weights * half
    amplitude = j0(np.outer(radius * k / objective.magnification, np.sin(angle))) @ pupil
    power = 2 * np.pi * (np.sin(angle) * weights * half).sum() * (objective.magnification / k) ** 2
    return np.abs(amplitude) ** 2 / power


@pytest.mark.parametrize(("objective", "depth"), [(AIR, 0.01), (AIR, -0.03), (OIL, 0.0), (OIL, -0.004)])
def test_the_field_before_the_lenses_is_the_debye_integral(objective, depth):
    X, Y = 0.004, -0.003
    field = point_fields(camera_with(objective), (X, Y, depth), wavelength=WAVELENGTH).mla
    rows, columns = np.indices(field.samples.shape)
    x = field.origin[0] + columns * field.pitch + objective.magnification * X
    y = field.origin[1] + rows * field.pitch + objective.magnification * Y
    radius = np.hypot(x, y)
    grid = np.linspace(0, radius.max() * 1.001, 6001)
    assert error(np.abs(field.samples) ** 2, np.interp(radius, grid, debye(objective, grid, depth))) < 1e-3


def test_the_sign_of_the_depth_is_that_of_the_frame():
    """The image of what lies beyond the native plane stands before the array: its light diverges from there."""
    lens, upper = TelecentricLens(AIR), (0.0, 1.0)
    assert lens.land(upper, (0.0, 0.0, 0.01))[1] < 0 < lens.land(upper, (0.0, 0.0, -0.01))[1]
    # Light through the upper half of the stop goes down behind the tube lens.
    assert lens.cosines(upper, (0.0, 0.0, 0.01))[1] < 0


@pytest.mark.parametrize("objective", [OIL, FOURIER])
def test_rays_are_perpendicular_to_the_waves(objective):
    kind = FourierLens if objective.is_fourier else TelecentricLens
    lens, point = kind(objective), (0.01, -0.02, 0.006)
    P, step = np.array([0.3, -0.55]) * lens.pupil.radius, 1e-4

    def path(x, y):
        return lens.path((np.float64(x), np.float64(y)), point, WAVELENGTH) * WAVELENGTH * 1e-6

    slope = [(path(*(P + move)) - path(*(P - move))) / (2 * step) for move in step * np.eye(2)]
    place, cosine = lens.land(tuple(P), point), lens.cosines(tuple(P), point)
    image = np.array(slope) * objective.tube_focal_length
    if objective.is_fourier:
        assert np.allclose(cosine, -image / objective.last_focal_length, rtol=1e-5)
        assert np.allclose(place, -P * objective.last_focal_length / objective.tube_focal_length)
    else:
        assert np.allclose(place, image, rtol=1e-5)
        assert np.allclose(cosine, -P / objective.tube_focal_length)
    # The ray back from there comes to the point; z rises towards the scene, light goes the other way.
    start, back, is_open = lens.trace(place, tuple(-c for c in cosine))
    at_point = [s + t * (point[2] - start[2]) for s, t in zip(start[:2], back, strict=True)]
    assert is_open and np.allclose(at_point, point[:2], atol=1e-9)


def test_every_image_moves_alike():
    """Points a lens apart share a pattern, without error: the wavefront of a plane's points is one."""
    camera = camera_with(AIR)
    points = np.array([[-0.007, -0.006, 0.012]] * 3) - np.array([[0, 0, 0], [0.15, 0, 0], [0, 0.3, 0]]) / 20
    shared = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0.02)
    assert pattern_count(shared, WAVELENGTH) == 1
    apart = sum(capture(camera, points[[n]], [n + 1], wavelength=WAVELENGTH, accuracy=0.02) for n in range(3))
    assert error(shared.forward([1, 2, 3]), apart) < 1e-4


def lens_images(camera, spread, lens):
    """The part of a spread behind the lens with these indices, and coordinates from its centre."""
    x = camera.pixel_coordinates(0)
    across, down = (x - index * camera.mla_pitch for index in lens)
    columns, rows = (np.abs(offset) < camera.mla_pitch / 2 for offset in (across, down))
    return spread[np.ix_(rows, columns)], across[columns], down[rows]


@pytest.mark.parametrize("depth", [0.04, -0.04])
def test_each_lens_of_a_fourier_microscope_sees_the_parallax_of_its_direction(depth):
    camera, X, M, f = fourier_camera(), 0.01, 20, 50
    spread = mp.point_spread_function(camera, (X, 0.0, depth), wavelength=WAVELENGTH, method="full_field")
    for lens in ((0, 0), (1, 0), (-1, 0), (0, 1)):
        part, x, y = lens_images(camera, spread, lens)
        bright = np.where(part > 0.3 * part.max(), part, 0) / part[part > 0.3 * part.max()].sum()
        sines = -M * np.array(lens) * camera.mla_pitch / f
        tangents = sines / np.sqrt(1 - sines @ sines)
        expected = camera.detector_distance * M / f * (np.array([X, 0]) + depth * tangents)
        # 1 % of the largest, 0.145 mm
        assert np.allclose([(bright @ x).sum(), (bright.T @ y).sum()], expected, atol=1e-3)


def test_each_lens_of_a_fourier_microscope_has_its_part_of_the_stop():
    camera = fourier_camera()
    spread = mp.point_spread_function(camera, (0.0, 0.0, 0.0), wavelength=WAVELENGTH, method="full_field")
    half, f = camera.mla_pitch / 2, FOURIER.last_focal_length
    nodes, weights = leggauss(12)
    for lens in ((0, 0), (1, 0), (1, -1)):
        x, y = (index * camera.mla_pitch + half * nodes for index in lens)
        # Each solid angle is d^2m M^2 / (n^2 f^2 cos), and all of them are 2 pi (1 - cos alpha).
        cosine = np.sqrt(1 - (20 / f) ** 2 * (x**2 + y[:, None] ** 2))
        part = (20 / f * half) ** 2 * (weights @ (1 / cosine) @ weights) / (2 * np.pi * (1 - np.sqrt(0.75)))
        assert lens_images(camera, spread, lens)[0].sum() == pytest.approx(part, rel=0.01)
    assert spread.sum() == pytest.approx(1, abs=0.005)


def test_each_lens_of_a_fourier_microscope_forms_an_airy_pattern():
    """Its width at half of the peak is 1.029 wavelengths times its f-number."""
    camera = fourier_camera(mla_aperture="circle", detector_width=0.5, resolution=(300, 300))
    row = mp.point_spread_function(camera, (0.0, 0.0, 0.0), wavelength=WAVELENGTH, method="full_field")[149:151].mean(0)
    edge = np.interp(-row.max() / 2, -row[150:], camera.pixel_coordinates(0)[150:])
    assert 2 * edge == pytest.approx(1.029 * WAVELENGTH * 1e-6 * 20 / 0.5, rel=0.01)


@pytest.mark.parametrize("numbers", [
    {},
    {"mla_lattice": "hexagonal", "mla_rotation": 8.0, "crop_offset": (250, 200), "crop_size": (300, 360)},
    {"mla_medium": 1.5, "mla_fill": 0.8},
    {"mla_focal_length": (20.0, 19.0, 21.5), "mla_lattice": "hexagonal", "mla_aperture": "circle"},
    {"main_lens": replace(FOURIER, field_stop=0.6)},
    {"main_lens": replace(FOURIER, field_stop=0.5, field_stop_shape="square")},
])  # fmt: skip
def test_points_of_a_depth_share_a_full_field(numbers):
    """In and out of focus, on and off the axis; where the field stop cuts light, the power is right."""
    camera = fourier_camera(**numbers)
    points = [(0.0013, 0.0, 0.02), (-0.017, 0.0088, 0.02), (0.011, 0.0184, 0.0), (0.0231, -0.0143, -0.03)]
    shared, exact = (
        mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, method=method) for method in ("patch", "full_field")
    )
    spreads = exact @ np.eye(4)
    assert np.allclose((shared @ np.eye(4)).sum(0), spreads.sum(0), rtol=0.015)
    whole = [0, 2] if camera.main_lens.field_stop else [0, 1, 2, 3]
    weights = np.array([1.0, 2.0, 0.5, 3.0])[whole] @ np.eye(4)[whole]
    image = shared.forward(weights)
    assert error(image, exact.forward(weights)) < (0.009 if camera.main_lens.field_stop else 0.004)
    random = np.random.default_rng(0).random(image.shape)
    assert shared.adjoint(random) @ weights == pytest.approx(np.vdot(image.astype(float), random), rel=1e-5)


def test_rays_of_white_fill_the_micro_images():
    """Mean of a white capture: the stop's image under a lens, over a cell."""
    image = sky(camera_with(mp.Objective(20, 0.4), resolution=(270, 270)), 64)
    assert image[30:-30, 30:-30].mean() == pytest.approx(np.pi * (0.02 * 3 / 0.15) ** 2, rel=0.005)


def test_rays_see_a_small_light_where_waves_do():
    camera, X, Y, depth = camera_with(AIR), 0.0078, -0.0072, 0.02
    by_rays = mp.render_capture(scene_of(camera.to_sensor(), "direct", light=disk([X, Y, depth], 4e-4)), spp=1024).image
    # A surface shines with the cosine, which a point does not.
    cells = (np.arange(64) + 0.5) / 32 - 1
    cosine = np.sqrt(1 - 0.25 * np.minimum(cells**2 + cells[:, None] ** 2, 1))
    by_waves = capture(camera, [(X, Y, depth)], [1.0], wavelength=WAVELENGTH, pupil_weights=cosine[None])
    x = camera.pixel_coordinates(0)
    for image in (by_rays, by_waves):
        image /= image.sum()
    centre = [(by_waves @ x).sum(), (by_waves.T @ x).sum()]
    assert np.allclose([(by_rays @ x).sum(), (by_rays.T @ x).sum()], centre, atol=0.006)
    width = [np.sqrt((image @ (x - centre[0]) ** 2).sum()) for image in (by_rays, by_waves)]
    assert width[0] == pytest.approx(width[1], rel=0.1)


@pytest.mark.needs_extension("deconvolution")
def test_a_bead_comes_back_to_its_place():
    """From other light than the response's: an exact spread of one point between bins."""
    camera = camera_with(AIR, detector_width=1.05, resolution=(105, 105))
    place, depth = (0.0041, -0.0023), 0.02
    spread = mp.point_spread_function(camera, (*place, depth), wavelength=WAVELENGTH)
    seen = mp.Capture(spread, camera, WAVELENGTH, "wave", {})
    found = mp.reconstruct(seen, depth, method="deconvolved", oversample=3, iterations=15)
    image = np.nan_to_num(found.image)
    # Pictures have +x to the left and +y up.
    rows, columns = ((size / 2 - np.arange(size) - 0.5) * found.bin_size for size in image.shape)
    bright = np.where(image > 0.02 * image.max(), image, 0) / image[image > 0.02 * image.max()].sum()
    assert np.allclose([bright.sum(0) @ columns, bright.sum(1) @ rows], place, atol=0.1 * found.bin_size)
