"""Point spreads from the kernels of signed rays: against exact spreads, their sum, their transpose, and refusals."""

import numpy as np
import pytest
from mitsuba_plenoptic.objective import Objective
from wave_cases import WAVELENGTH, error, small_camera

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.errors import InputError
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.light.phase_space import plan_of
from mitsuba_plenoptic.optics.spectrum import Spectrum
from mitsuba_plenoptic.points.bank_rays import Landing, averaged
from mitsuba_plenoptic.points.operator import CaptureOperator
from mitsuba_plenoptic.points.stored import StoredOperator
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.runtime.jobs import Job

CAMERAS = {
    "square": small_camera(10),
    "hexagonal, turned": small_camera(10, mla_lattice="hexagonal", mla_rotation=7.0, mla_offset=(0.01, -0.02)),
    "three focal lengths": small_camera(10, mla_lattice="hexagonal", mla_focal_length=(0.48, 0.512, 0.55)),
    "double Gauss": PlenopticCamera.preset("paper_double_gauss").replace(detector_width=0.64, resolution=(320, 320)),
    "objective": PlenopticCamera.preset("lfm"),
}
SMALL = CAMERAS["square"]


def blurred(camera, blur):
    """Return the distance of points whose blur has a radius of so many lenses, and the scale from array to points."""
    part = 1 - blur * camera.mla_pitch / camera.aperture_radius
    distance = 1 / (1 / camera.focal_length - part / camera.mla_distance)
    return distance, -distance / camera.mla_distance


def grid(camera, blur, across=6, lenses=1.0):
    """Return points on an even grid over a lens."""
    distance, scale = blurred(camera, blur)
    along = ((np.arange(across) + 0.5) / across - 0.5) * lenses * camera.mla_pitch
    place = np.stack(np.meshgrid(along, along), -1).reshape(-1, 2)
    return np.column_stack([place * scale, np.full(len(place), distance)])


def images(camera, points, weights, accuracy=0.01):
    """Return the sums of spreads by `bank` and, exactly, by `patch`."""
    made = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="bank", accuracy=accuracy)
    exact = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0)
    return made.forward(weights), exact.forward(weights)


@pytest.mark.parametrize(
    ("name", "limit"),
    [
        ("square", 0.03),
        pytest.param("double Gauss", 0.03, marks=pytest.mark.slow),
        pytest.param("hexagonal, turned", 0.025, marks=pytest.mark.slow),
        pytest.param("three focal lengths", 0.025, marks=pytest.mark.slow),
    ],
)
def test_sums_of_blurred_points_against_exact_ones(name, limit):
    """A single lens of points is nearly all edge; larger walls and each method's own limits are in the bench case."""
    points = grid(CAMERAS[name], 2.0)
    made, exact = images(CAMERAS[name], points, np.ones(len(points)))
    assert error(made, exact) < limit
    assert made.sum() == pytest.approx(len(points), rel=0.005)


@pytest.mark.slow
def test_an_objectives_points_against_exact_ones():
    camera = CAMERAS["objective"]
    size = 320
    view = camera.replace(detector_width=size * camera.pixel_size, resolution=(size, size))
    lens = camera.objective
    depth = 2 * camera.mla_pitch / (lens.magnification * np.tan(lens.half_angle))
    points = np.array([(0.0, 0.0, depth), (2e-4, 1e-4, depth), (-3e-4, 0.0, depth)])
    made, exact = images(view, points, [1.0, 0.5, 2.0], accuracy=0)
    assert error(made, exact) < 0.04


@pytest.mark.slow
def test_a_single_blurred_point_at_high_accuracy():
    point = grid(SMALL, 2.0, 3)[:1]
    made, exact = images(SMALL, point, [1.0], accuracy=0)
    assert error(made, exact) < 0.035
    usual, _ = images(SMALL, point, [1.0])
    assert error(made, exact) < 0.7 * error(usual, exact)


@pytest.mark.parametrize("name", ["square", pytest.param("three focal lengths", marks=pytest.mark.slow)])
def test_adjoint_is_the_transpose(name):
    camera = CAMERAS[name].replace(crop_offset=(50, 90), crop_size=(180, 150))
    generator = np.random.default_rng(0)
    points, weights = grid(camera, 3.0, 4, 3.0), generator.normal(size=(16, 2))
    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="bank")
    pixels = generator.random((*camera.shape, 2), dtype=np.float32)
    forward, back = operator.forward(weights).astype(float), operator.adjoint(pixels)
    assert back.shape == (16, 2)
    assert np.vdot(forward, pixels) == pytest.approx(np.vdot(weights, back), rel=1e-5)


def test_sums_are_linear_and_independent_of_other_points_and_threads():
    points = np.concatenate([grid(SMALL, 1.0, 2), grid(SMALL, -3.0, 2)])
    operator = CaptureOperator(SMALL, points, wavelength=WAVELENGTH, method="bank")
    weights = np.arange(8) - 2.0
    whole = operator.forward(weights)
    np.testing.assert_array_equal(whole, operator.forward(weights, job=Job(batch_map=Threads(1))))
    alone = [
        weight * CaptureOperator(SMALL, [point], wavelength=WAVELENGTH, method="bank").forward([1.0])
        for point, weight in zip(points, weights, strict=True)
    ]
    assert error(whole, sum(alone)) < 1e-5


def test_blocks_of_the_detector_and_crops_are_parts_of_the_whole(monkeypatch):
    points, weights = grid(SMALL, 3.0, 3, 3.0), np.ones(9)
    whole = CaptureOperator(SMALL, points, wavelength=WAVELENGTH, method="bank").forward(weights)
    crop = SMALL.replace(crop_offset=(65, 101), crop_size=(75, 51))
    part = CaptureOperator(crop, points, wavelength=WAVELENGTH, method="bank").forward(weights)
    assert error(part, whole[101:152, 65:140]) < 1e-5
    monkeypatch.setattr("mitsuba_plenoptic.points.bank_plan._BLOCK_BYTES", 2**24)
    operator = CaptureOperator(SMALL, points, wavelength=WAVELENGTH, method="bank")
    assert error(operator.forward(weights), whole) < 1e-5
    pixels = np.random.default_rng(0).random(SMALL.shape, dtype=np.float32)
    assert np.vdot(whole.astype(float), pixels) == pytest.approx(operator.adjoint(pixels).sum(), rel=1e-5)


@pytest.mark.slow
def test_channels_of_a_spectrum_are_sums_at_its_wavelengths():
    points = grid(SMALL, 2.0, 2)
    operator = CaptureOperator(SMALL, points, spectrum=Spectrum.lines(633.0, 532.0), method="bank")
    both = operator.forward(np.ones((4, 2)))
    for channel, wavelength in enumerate((633.0, 532.0)):
        alone = CaptureOperator(SMALL, points, wavelength=wavelength, method="bank").forward(np.ones(4))
        np.testing.assert_allclose(both[..., channel], alone, atol=1e-7)


def test_points_out_of_sight_and_none():
    for points in ([(50.0, 0.0, 240.0)], np.zeros((0, 3))):
        operator = CaptureOperator(SMALL, points, wavelength=WAVELENGTH, method="bank")
        assert not operator.forward(np.ones(len(points))).any()
        assert not operator.adjoint(np.ones(SMALL.shape, np.float32)).any()
        assert operator.estimate().points == 0


def test_estimate_counts_the_points():
    cost = CaptureOperator(SMALL, grid(SMALL, 2.0, 3), wavelength=WAVELENGTH, method="bank").estimate()
    assert cost.points == 9 and cost.seconds > 0 and cost.memory > 2**20


def test_light_of_the_pupil_lands_where_rays_through_the_centres_of_lenses_do():
    """Up to the mean enlargement of micro-images, of a few thousandths."""
    plan = plan_of(SMALL, WAVELENGTH, False, WAVELENGTH)
    landing = Landing.of(OpticalSystem(SMALL, WAVELENGTH), plan)
    z, b = SMALL.detector_distance, SMALL.mla_distance
    assert landing.scales == pytest.approx([b / z], rel=4e-3)
    assert landing.bases == pytest.approx([1 + z / b], rel=4e-5)


def test_averaged_tables_are_running_means():
    plan = plan_of(SMALL, WAVELENGTH, False, WAVELENGTH)
    node, part = plan.nodes[-1], plan.table[-1][:1]
    width = 3 * node.sides[0] / node.counts[0]
    smooth = averaged(plan, width)[-1][:1]
    np.testing.assert_allclose(smooth.sum((1, 2)), part.sum((1, 2)), rtol=1e-3, atol=1e-2)
    # The spectrum of the mean over three samples, whose own samples resolve it.
    rough = sum(np.roll(part, (i, j), (1, 2)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
    assert error(smooth[..., 0], rough[..., 0]) < 0.05


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (PlenopticCamera.preset("raytrix"), r"^detector_distance = .*: method bank takes detectors near the focus"),
        (SMALL.replace(mla_pitch=0.01), r"^mla_pitch = 0\.01: method bank takes lenses of at least 20 wavelengths"),
        (SMALL.replace(mla_jitter=(0.001, 0.0)), r"^mla_jitter"),
        (SMALL.replace(mla_medium=1.2), r"^mla_medium = 1\.2: method bank takes 1 only"),
    ],
)
def test_cameras_beyond_the_kernels_are_refused(camera, words):
    with pytest.raises(InputError, match=words):
        CaptureOperator(camera, [(0.0, 0.0, 2400.0)], wavelength=WAVELENGTH, method="bank").forward([1.0])


def test_the_stops_image_stored_spreads_and_derivatives_are_refused():
    lens = Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)
    fourier = PlenopticCamera(main_lens=lens, mla_pitch=0.5, mla_focal_length=20, detector_width=4)
    with pytest.raises(InputError, match=r"^method = bank: light covers all of the stop's image"):
        CaptureOperator(fourier, [(0.0, 0.0, 0.01)], wavelength=WAVELENGTH, method="bank")
    point = [(0.0, 0.0, 240.0)]
    half = CaptureOperator(SMALL, point, wavelength=WAVELENGTH, method="bank", pupil_weights=[[[0, 1], [0, 1]]])
    with pytest.raises(InputError, match="pupil_weights: method bank takes none"):
        half.forward([1.0])
    operator = CaptureOperator(SMALL, point, wavelength=WAVELENGTH, method="bank")
    with pytest.raises(InputError, match="method = bank: it has no derivatives"):
        operator.derivative([1.0], {"focal_length": 1.0})
    with pytest.raises(InputError, match="method = bank: it has no single point spreads to store"):
        StoredOperator(SMALL, point, wavelength=WAVELENGTH, method="bank")


def test_a_point_in_focus_before_few_coarse_pixels():
    """So few of its rays reach cells that some windows of the kernels have none."""
    camera = PlenopticCamera(
        focal_length=10, aperture_radius=1.8, focus_distance=64, mla_pitch=0.04, mla_focal_length=0.132,
        detector_width=0.4, resolution=(100, 100),
    )  # fmt: skip
    image = CaptureOperator(camera, [(0.05, 0.05, 64.0)], wavelength=WAVELENGTH, method="bank").forward([1.0])
    assert image.sum() == pytest.approx(1, abs=0.01)
