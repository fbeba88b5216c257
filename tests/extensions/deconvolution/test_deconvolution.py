"""Deconvolution and incoherent sums against exact sums of spreads, closed forms, and points whose places are known."""

import functools

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, LATTICES, WAVELENGTH, sky, small_camera
from refusals import refused, refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.design import resolution_limit
from mitsuba_plenoptic.extensions.deconvolution.deconvolved import noise_of
from mitsuba_plenoptic.extensions.deconvolution.response import Response
from mitsuba_plenoptic.fields import OpticalSystem
from mitsuba_plenoptic.linear.noise import misfit
from mitsuba_plenoptic.points.units import brightness_at
from mitsuba_plenoptic.views import wave_white, white_image

SMALL, FOUR = small_camera(6), small_camera(4)


@functools.cache
def response_of(camera, distance=253.0, oversample=2, wavelength=WAVELENGTH):
    return Response(camera, [distance], wavelength=wavelength, oversample=oversample)


@pytest.mark.slow
def test_white_planes_by_rays_follow_snells_law():
    """Against a ray capture at 35 degrees, where rays of slopes that the index divides land ten pixels away."""
    camera = mp.PlenopticCamera(
        focal_length=20.0, aperture_radius=1.2, mla_distance=24.0, mla_focal_length=0.768, mla_medium=1.5,
        detector_width=38.4, resolution=(9600, 9600), crop_offset=(9000, 4752), crop_size=(96, 96),
    )  # fmt: skip
    response = response_of(camera, 120.0, 1, wavelength=None)
    image = response.forward(np.ones(response.shapes[0], np.float32))
    mi.set_variant("llvm_ad_mono")
    expected = sky(camera, 512)
    # Micro-images of a zone are evenly spaced.
    assert np.linalg.norm(image - expected) <= 0.12 * np.linalg.norm(expected)
    assert image.sum() == pytest.approx(expected.sum(), rel=0.02)


def test_volume_is_the_sum_of_its_planes():
    both = Response(SMALL, [230.0, 253.0], wavelength=None, oversample=2)
    values = np.random.default_rng(2).random(both.source_shape).astype(np.float32)
    planes = zip((230.0, 253.0), both.planes_of(values), strict=True)
    total = sum(response_of(SMALL, distance, wavelength=None).forward(plane) for distance, plane in planes)
    # Their grids are others.
    assert np.linalg.norm(both.forward(values) - total) <= 0.02 * np.linalg.norm(total)


def test_an_even_light_makes_no_bin_darker():
    """As stray light, or a black level that was not subtracted, does; pixels between micro-images explain nothing."""
    camera = mp.PlenopticCamera(detector_width=0.384, resolution=(72, 72))
    white = white_image(camera)
    for even in (0.01, 1.0):
        capture = mp.Capture(white + np.float32(even), camera)
        image = mp.reconstruct(capture, 223.2, method="deconvolved", iterations=10).image
        assert 1 < np.nanmedian(image) < 1 + 2 * even


def test_noise_is_the_detectors():
    ramp = np.tile(np.linspace(0, 1, SMALL.shape[1]), (SMALL.shape[0], 1)).astype(np.float32)
    detector = mp.Detector(read_noise=20, dark_electrons=100, full_well=20000)
    noisy = mp.expose(mp.Capture(ramp, SMALL, WAVELENGTH, "wave"), detector, photons=3000, seed=1)
    assert misfit(noise_of(noisy.metadata["exposure"], None), noisy.image, ramp) == pytest.approx(1, abs=0.03)
    photons = np.random.default_rng(4).poisson(200 * ramp) / 200
    assert misfit(noise_of(None, 200.0), photons.astype(np.float32), ramp) == pytest.approx(1, abs=0.03)
    assert noise_of(None, None) is None


FAST = small_camera(4, **HALF).replace(mla_focal_length=0.64, detector_distance=0.64, resolution=(64, 64))
NARROWING = mp.Vignetting(radius=[1.0, 0, 0, -0.2, 0, -0.2], slope_x=[0.2], scale=0.2)


def white_of_waves(camera, wavelength, points=81, step=4e-4, around=8):
    """The capture of an even world: pupil points are incoherent, and the field of each is one of x times one of y."""
    b, z, pitch = camera.mla_distance, camera.reduced_distance, camera.mla_pitch
    n, radius, waves = camera.resolution[0], camera.aperture_radius, wavelength * 1e-6
    x = (np.arange(round(4 * around * pitch / step)) + 0.5) * step - 2 * around * pitch
    lens = np.round(x / pitch)
    opened = (abs(x - lens * pitch) <= camera.mla_fill * pitch / 2) & (abs(lens) <= around)
    phase = -((x - lens * pitch) ** 2) / (waves * camera.reduced_focal_lengths[0])
    space = np.exp(-1j * np.pi * waves * z * np.fft.fftfreq(len(x), step) ** 2)
    pupil = ((np.arange(points) + 0.5) / points * 2 - 1) * radius
    fine = ((np.arange(8 * points) + 0.5) / (8 * points) * 2 - 1) * radius
    disc = np.hypot(fine, fine[:, None]) <= radius
    q = ((np.arange(4 * n) + 0.5) / 4 - n / 2) * camera.pixel_size
    centres = (np.floor(q / camera.image_growth / pitch) + 0.5) * pitch
    light = np.empty((points, len(q)))
    for centre in np.unique(centres):
        for index, place in enumerate(pupil - centre):
            field = opened * np.exp(1j * np.pi * (phase + (x**2 - 2 * x * place) / (waves * b)))
            some = centres == centre
            light[index, some] = np.interp(q[some] - centre, x, abs(np.fft.ifft(np.fft.fft(field) * space)) ** 2)
    scale = (2 * radius / points * z / b) ** 2 / camera.lattice.lens_area
    image = np.empty((len(q), len(q)))
    for column, row in np.stack(np.meshgrid(np.unique(centres), np.unique(centres)), -1).reshape(-1, 2):
        seen = camera.vignetting and camera.vignetting.power(fine / radius, fine[:, None] / radius, column, row)
        passed = (disc * (1 if seen is None else seen)).reshape(points, 8, points, 8).mean((1, 3))
        some = np.ix_(centres == row, centres == column)
        image[some] = scale * light[:, centres == row].T @ passed @ light[:, centres == column]
    return image.reshape(n, 4, n, 4).mean((1, 3)).astype(np.float32)


@pytest.mark.parametrize(
    ("options", "distance", "oversample"),
    [
        ({}, 112.0, 2),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ({"mla_fill": 0.8, "mla_medium": 1.5, "detector_distance": 0.96, "mla_focal_length": 0.96}, 112.0, 1),
                ({"vignetting": {"radius": [0.8]}}, 120.0, 1),
                ({"vignetting": NARROWING}, 112.0, 1),
            )
        ),
    ],
)
def test_an_even_world_reads_1_in_all_planes_and_behind_gaps(options, distance, oversample):
    """Points do not show on pixels, and light beyond kernels is kept. White by signed rays is less even in corners."""
    camera = FAST.replace(**options)
    capture = mp.Capture(white_of_waves(camera, 550.0), camera, 550.0, "wave")
    for method in ("incoherent", "deconvolved"):
        image = mp.reconstruct(capture, distance, method=method, oversample=oversample).image
        np.testing.assert_allclose(image[1:-1, 1:-1], 1, atol=0.007)
        np.testing.assert_allclose(image, 1, atol=0.01)
    # What amplifies errors most, bins finer than lenses in focus, shows none of the white of the capture's own model.
    own = mp.Capture(wave_white(capture, 1)[..., 0], camera, 550.0, "wave")
    if camera.vignetting is None:
        np.testing.assert_allclose(own.image, own.image.T, atol=1e-4)
    for fine in (2, 4):
        image = mp.reconstruct(own, 120.0, method="deconvolved", oversample=fine).image
        np.testing.assert_allclose(image, 1, atol=0.005)


SIZE = {"detector_width": 2.24, "resolution": (448, 448), "crop_size": (64, 64)}
ZONES = {"focal_length": 4.0, "focus_distance": 120.0, "mla_pitch": 0.04, **SIZE}
LAMPS = {
    "circles": (small_camera(**LATTICES["circles"]), 222.0, [(5, 5), (1, 2)], 0.99),
    "three focal lengths": (
        small_camera(6, mla_lattice="hexagonal", mla_focal_length=(0.45, 0.512, 0.6), detector_distance=0.512),
        222.0, [(3, 4), (1, 2)], 0.988),
    "from lens to lens": (
        FAST.replace(detector_width=0.384, resolution=(96, 96), vignetting=NARROWING, mla_rotation=20.0),
        112.0, [(2, 1), (3, 4)], 1.0,
    ),
    "within a zone": (
        mp.PlenopticCamera(**ZONES, aperture_radius=0.4, mla_focal_length=0.207, crop_offset=(320, 240),
                           vignetting=mp.Vignetting(radius=[0.9, -0.05, 0, -0.3, 0, -0.3])),
        30.0, [(32, 42), (35, 45)], 1.0,
    ),
    "prescription": (
        mp.PlenopticCamera(**ZONES | {"detector_width": 1.6, "resolution": (320, 320), "crop_offset": (198, 163)},
                           main_lens="double_gauss", mla_focal_length=0.09, mla_lattice="hexagonal"),
        30.0, [(24, 28)], 1.0,
    ),
}  # fmt: skip
"""Cameras, a distance, bins, and their light, of which hexagonal lenses diffract some beyond point spreads' reach."""


@pytest.mark.slow
@pytest.mark.parametrize("name", LAMPS)
def test_lamps_keep_their_light(name):
    """What the edge of the pupil diffracts to other lenses, and off the detector, is theirs, too."""
    camera, distance, bins, kept = LAMPS[name]
    size, across, powers = camera.row_pitch, 8, np.array([1.0, 0.7])[: len(bins)]
    inside = (np.arange(across) + 0.5) / across - camera.bin_count[0] / 2
    places = [np.stack(np.meshgrid(column + inside, row + inside), -1).reshape(-1, 2) for row, column in bins]
    q = size * np.concatenate(places)
    points = np.column_stack([-q * distance / camera.mla_distance, np.full(len(q), distance)])
    system = OpticalSystem(camera.at_wavelength(550.0), 550.0)
    weights = brightness_at(system, points) * np.repeat(powers * (size / across / system.lens.pupil.distance) ** 2, 64)
    if not system.lens.is_uniform:
        stretch = system.waves_of(points).image_stretch(camera, distance)
        weights *= np.interp(np.hypot(*q.T), stretch.places, stretch.area)
    image = mp.CaptureOperator(camera, points, wavelength=550.0, accuracy=0.0).forward(weights)
    capture = mp.Capture(np.maximum(image, 0), camera, 550.0, "wave")
    found = np.nan_to_num(mp.reconstruct(capture, distance, method="deconvolved").image)
    lamps = [found[row - 1 : row + 2, column - 1 : column + 2].sum() for row, column in bins]
    np.testing.assert_allclose(lamps, kept * powers, rtol=0.003 if kept < 1 else 0.01)


@pytest.mark.slow
def test_points_come_back():
    distance, q = 226.0, np.array([[0.045, -0.03], [-0.052, 0.041]])
    points = np.column_stack([-q * distance / SMALL.mla_distance, np.full(2, distance)])
    recorded = mp.CaptureOperator(SMALL, points, wavelength=WAVELENGTH, accuracy=0).forward([2000.0, 1000.0])
    capture = mp.Capture(np.maximum(recorded, 0), SMALL, WAVELENGTH, "wave")
    result = mp.reconstruct(capture, distance, method="deconvolved", oversample=4, iterations=60)
    image, size = result.image.astype(np.float64), SMALL.row_pitch / 4
    rows, columns = np.indices(image.shape)
    x, y = ((index - (image.shape[0] - 1) / 2) * size for index in (columns, rows))
    weight = size**2 * np.pi * 25 * 0.512**2 / (120**2 * 0.064**2 * 0.002**2)
    for place, power in zip(q, (2000, 1000), strict=True):
        near = np.hypot(x - place[0], y - place[1]) < 2.5 * size
        found = [np.average(axis[near], weights=image[near]) for axis in (x, y)]
        assert np.hypot(*(found - place)) < 0.1 * size
        assert image[near].sum() * weight == pytest.approx(power, rel=0.03)
    assert result.facts["iterations"] == 60 and 0 < result.facts["residual"] < 0.3
    assert result.facts["resolution_limit"] == resolution_limit(SMALL, distance, WAVELENGTH).frequency
    assert not result.facts["in_focus"]


def of_pixels(*values, distance=253.0, **options):
    image = np.zeros(SMALL.shape, np.float32)
    image[5, : len(values)] = values
    return mp.reconstruct(mp.Capture(image, SMALL, WAVELENGTH, "wave"), distance, method="deconvolved", **options)


test_what_no_light_makes_is_refused = refused(
    (lambda: of_pixels(0.0), "none of its pixels is lit"),
    (lambda: of_pixels(1.0, oversample=3000), "oversample = 3000"),
    (lambda: of_pixels(1.0, response="x"), "response = 'x'"),
    (lambda: of_pixels(1.0, variation=0.3), "variation = "),
    (lambda: of_pixels(1.0, distance=[230.0, 253.0, 253.0], volume=True), "distance = 253"),
    (lambda: of_pixels(1.0, -0.1), "1 of its pixels are below 0"),
)


def test_a_dark_channel_stays_dark():
    """Red light before a detector of three channels: the others are 0 or rounded, and red is what it is alone."""
    red = np.random.default_rng(0).random(SMALL.shape, np.float32)
    options = {"method": "deconvolved", "response": "ray", "iterations": 3}
    dark = np.zeros_like(red)
    found = mp.reconstruct(mp.Capture(np.stack([red, dark, dark - 1e-7], -1), SMALL, None, "wave"), 253.0, **options)
    alone = mp.reconstruct(mp.Capture(red, SMALL, None, "wave"), 253.0, **options)
    np.testing.assert_array_equal(found.image[..., 0], alone.image)
    assert (found.image[..., 1:] == 0).all() and found.facts == alone.facts
    # So are the pixels of a detector without light that read noise has all put below 0.
    noise = mp.Capture(np.stack([red, dark - 0.01, dark], -1), SMALL, None, "wave")
    found = mp.reconstruct(noise, 253.0, photons=100.0, **options)
    assert (found.image[..., 1:] == 0).all() and np.isfinite(found.facts["residual"])


@pytest.mark.parametrize(("distance", "waves", "pixels"), [(270, 7.17, 8.53), (227, 16.55, 19.69)])
def test_resolution_limit_is_the_two_formulas(distance, waves, pixels):
    found = resolution_limit(mp.PlenopticCamera(), distance, WAVELENGTH)
    assert found.waves == pytest.approx(waves, rel=1e-3)
    assert found.pixels == pytest.approx(pixels, rel=1e-3)
    assert found.frequency == found.waves
    assert not found.in_focus and resolution_limit(mp.PlenopticCamera(), 245.0, WAVELENGTH).in_focus
    assert resolution_limit(mp.PlenopticCamera(), 240.0, WAVELENGTH).frequency == pytest.approx(3.906, rel=1e-3)


def refocused(camera, image, distance=250.0, **options):
    capture = mp.Capture(image.astype(np.float32), camera, WAVELENGTH, "wave")
    return mp.reconstruct(capture, distance, method="incoherent", **options).image


def test_bins_weigh_the_capture_with_the_spreads_of_their_points():
    """The light that a bin is divided by cancels between two captures."""
    camera, distance, row, column = FOUR.replace(wavefront=(0.0, 0.0, 0.0, 0.0, 0.1, 0.05)), 250.0, 1, 2
    random, even = np.random.default_rng(0).random(camera.shape), np.ones(camera.shape)
    found = refocused(camera, random) / refocused(camera, even)
    inside = (np.arange(8) + 0.5) / 8 - camera.bin_count[0] / 2
    x, y = ((index + inside) * camera.mla_pitch for index in (column, row))
    q = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = np.column_stack([-q * distance / camera.mla_distance, np.full(len(q), distance)])
    operator = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0)
    assert found[row, column] == pytest.approx(operator.adjoint(random).sum() / operator.adjoint(even).sum(), rel=3e-4)


@pytest.mark.slow
def test_lenses_may_differ_as_far_as_light_stays_within_pixels():
    """Focal lengths that differ by 1 % widen a point's image by a third of a pixel, those by 3 % by a whole one."""
    image = np.random.default_rng(0).random(FOUR.shape)
    equal, jittered = (refocused(each, image, white=image) for each in (FOUR, FOUR.replace(mla_jitter=(0.0, 0.01))))
    np.testing.assert_allclose(jittered, equal, rtol=0.01)
    refuses(r"mla_jitter = \(0.0, 0.03\)", refocused, FOUR.replace(mla_jitter=(0.0, 0.03)), image)


def test_white_reads_1_where_gaps_leave_little_light():
    """Its border bins, in gaps, send 1.5 % of what bins on open lenses send."""
    camera = FAST.replace(mla_fill=0.5, mla_medium=1.5, detector_distance=0.96, mla_focal_length=0.96)
    even = mp.Capture(np.ones(camera.shape, np.float32), camera, 550.0, "wave")
    own = mp.Capture(wave_white(even, 1)[..., 0], camera, 550.0, "wave")
    image = mp.reconstruct(own, 120.0, method="deconvolved", oversample=4).image
    np.testing.assert_allclose(image, 1, atol=0.001)


@pytest.mark.parametrize(
    ("options", "distance", "oversample"),
    [
        ({"mla_fill": 0.7}, 260.0, 2),
        pytest.param({"mla_lattice": "hexagonal", "mla_rotation": 5.0}, 280.0, 2, marks=pytest.mark.slow),
        ({"resolution": (72, 72), "vignetting": mp.Vignetting(radius=[0.9, -0.05, 0, -0.1, 0, -0.1])}, 280.0, 1),
        ({"detector_blur": 0.004, "crop_offset": (20, 9), "crop_size": (60, 70)}, 300.0, 3),
    ],
)
def test_white_captures_by_rays_read_1_after_any_steps(options, distance, oversample):
    """Steps amplify what the response lacks of the white image where few pixels see a bin, up to a quarter."""
    camera = mp.PlenopticCamera(detector_width=0.768, resolution=(96, 96)).replace(**options)
    capture = mp.Capture(white_image(camera), camera)
    image = mp.reconstruct(capture, distance, method="deconvolved", oversample=oversample).image
    np.testing.assert_allclose(image[oversample:-oversample, oversample:-oversample], 1, atol=0.005)
