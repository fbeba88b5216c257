"""The capture operator: linear, with adjoint and derivatives, on any number of threads, true to point spreads."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, capture, error, in_every_lens, pattern_count, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator, Job, PlenopticCamera, Spectrum, Vignetting
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.fitted_lens import lens_change
from mitsuba_plenoptic.points import accuracy
from mitsuba_plenoptic.points.derivatives import DIFFERENTIABLE, plan
from mitsuba_plenoptic.points.full_fields import FullFieldSum
from mitsuba_plenoptic.points.patch_plan import PatchSum
from mitsuba_plenoptic.points.pupil_weights import PupilWeights
from mitsuba_plenoptic.runtime.batches import Threads

SMALL = small_camera(4, **HALF)


def near(count):
    return scattered(count, distances=(112.0, 128.0), image=0.05)


def half_open(cells=16):
    """Return pupil weights of which the half at +x is open."""
    return np.repeat(np.arange(cells)[None, :] >= cells / 2, cells, axis=0)


@pytest.mark.parametrize("method", ["patch", "full_field"])
def test_a_surface_seen_slantwise_sends_more_light_to_one_side_of_the_pupil(method):
    r"""Power 1 + s x over a disc: the half at +x gets :math:`1/2 + 2 s / 3 \pi` of it."""
    weights = replace(PupilWeights.of(np.ones((1, 1, 1), bool), 1), slant=np.array([[0.3, 0.0]]))
    image = capture(SMALL, np.array([(0.0, 0.0, 112.5)]), [1.0], method=method, pupil_weights=weights, accuracy=0)
    left, right = (half.sum() for half in np.split(image, 2, axis=1))
    # The blur of a point before the focus is upright.
    assert max(left, right) / (left + right) == pytest.approx(0.5 + 0.2 / np.pi, abs=0.003)
    assert right > left


@pytest.mark.parametrize("points", [[(50.0, 0.0, 120.0)], np.zeros((0, 3))], ids=["out of sight", "none"])
def test_what_cannot_be_seen_gives_nothing(points):
    operator = CaptureOperator(SMALL, points, wavelength=WAVELENGTH)
    assert not operator.forward(np.ones(len(points))).any()
    assert not operator.adjoint(np.ones(SMALL.shape)).any()


def test_a_job_that_fails_leaves_nothing_under_way():
    """Threads would go on, and Dr.Jit's own would keep resting, as long as anyone holds the exception."""
    closed = []

    class Watched(Threads):
        def __call__(self, batches):
            with contextlib.closing(super().__call__(batches)) as results:
                try:
                    yield from results
                finally:
                    closed.append(True)

    class Failing:
        def begin(self, shape, **facts):
            pass

        def save(self, snapshot):
            raise OSError

    def fail(done, total):
        if done:
            raise OSError

    operator = CaptureOperator(SMALL, near(100), wavelength=WAVELENGTH)
    for work, job in (
        (lambda job: operator.forward(np.ones(100), job=job), Job(batch_map=Watched(), keeper=Failing())),
        (lambda job: operator.forward(np.ones(100), job=job), Job(fail, Watched())),
        (lambda job: operator.adjoint(np.ones(SMALL.shape), job=job), Job(fail, Watched())),
    ):
        with pytest.raises(OSError) as caught:
            work(job)
        assert closed.pop() and caught.tb


def test_weights_that_cancel_leave_nothing():
    """Of two radiators at one place, which share a point spread, beside others and alone."""
    operator = CaptureOperator(SMALL, in_every_lens(SMALL, 3, 120.0)[[4, 4, 0]], wavelength=WAVELENGTH, accuracy=0.1)
    assert not operator.forward([1.0, -1.0, 0.0]).any()
    assert error(operator.forward([1.0, -1.0, 2.0]), operator.forward([0.0, 0.0, 2.0])) < 1e-6


@pytest.mark.slow
def test_scipy_multiplies_spectra():
    """And the adjoint is that of the sum, of interpolated spectra, shared spreads and weighted pupils, too."""
    rng = np.random.default_rng(2)
    spectrum = Spectrum((633, 600, 570, 532), tuple(map(tuple, rng.random((3, 4)).tolist()))).interpolated(2)
    points = np.append(near(3), near(1) + np.array([1e-4, 0, 0]), axis=0)
    cells = rng.uniform(0, 1, (4, 4, 4))
    operator = CaptureOperator(SMALL, points, spectrum=spectrum, accuracy=0.01, pupil_weights=cells)
    weights, image = rng.normal(size=(4, 4)), rng.normal(size=(*SMALL.shape, 3))
    assert (operator.source_shape, operator.image_shape) == (weights.shape, image.shape)
    made, back = operator @ weights.ravel(), operator.T @ image.ravel()
    assert (made.reshape(image.shape) == operator.forward(weights)).all()
    assert (back.reshape(weights.shape) == operator.adjoint(image)).all()
    assert made @ image.ravel() == pytest.approx(weights.ravel() @ back, rel=1e-5)
    assert error(operator @ np.stack([weights.ravel(), -weights.ravel()], 1), np.stack([made, -made], 1)) < 1e-6


def test_responses_mix_channels_as_a_matrix():
    matrix = np.array([(1.0, 0.5), (0.2, 2.0), (-0.1, 1.0)])
    weights = np.random.default_rng(7).normal(size=(5, 2))
    lines = CaptureOperator(SMALL, near(5), spectrum=Spectrum.lines(633, 532))
    mixed = CaptureOperator(SMALL, near(5), spectrum=Spectrum((633, 532), tuple(map(tuple, matrix))))
    image = mixed.forward(weights)
    assert image.shape == (*SMALL.shape, 3)
    assert error(image, lines.forward(weights) @ matrix.T) < 1e-5
    assert error(mixed.adjoint(image), lines.adjoint(image @ matrix)) < 1e-5


@pytest.mark.parametrize("axis", [0, 1])
def test_half_of_the_pupil_lights_half_of_the_image(axis):
    camera, position = small_camera(16), [(0.0, 0.0, 210.0)]
    weights = half_open(8) if axis == 1 else half_open(8).T
    half, whole, opened = (
        capture(camera, position, [1.0], pupil_weights=given) for given in (weights[None], None, np.ones((1, 8, 8)))
    )
    assert half.sum() == pytest.approx(whole.sum(), rel=0.01)
    # The image lies behind the array: a ray from +x still is at +x.
    far = half[:, 256:] if axis == 1 else half[256:]
    assert far.sum() > 0.95 * half.sum()
    assert error(opened, whole) < 1e-6


def shared_and_alone(camera, positions):
    """Return operators whose points may share spreads, and do not."""
    return [CaptureOperator(camera, positions, wavelength=WAVELENGTH, accuracy=each) for each in (0.02, 0)]


def test_shared_patterns_stay_true():
    camera = small_camera(12)
    positions = in_every_lens(camera, 4, 240.0, per_lens=2, offset=1.7)
    weights = np.random.default_rng(1).uniform(0, 1, len(positions))
    shared, every = shared_and_alone(camera, positions)
    assert pattern_count(shared) < len(positions) / 2
    assert pattern_count(every) == len(positions)
    assert 0 < error(shared.forward(weights), every.forward(weights)) < 0.01


def test_unequal_lenses_share_nothing():
    """Pupils narrow by a tenth from lens to lens."""
    camera = small_camera(8, vignetting=Vignetting([1.0, 0, 0, -0.6, 0, -0.6], 6 * 0.064))
    positions = in_every_lens(camera, 2, 240.0, per_lens=2, offset=1.7)
    shared, every = shared_and_alone(camera, positions)
    assert pattern_count(shared) == len(positions)
    assert error(shared.forward(np.ones(len(positions))), every.forward(np.ones(len(positions)))) < 0.01


def test_few_points_are_not_mistaken_for_each_other():
    """Nothing averages out in a sum of two: near each other as they are, each has a point spread of its own."""
    positions = [(0.005, 0.005, 120.0), (0.006, 0.005, 120.0)]
    assert pattern_count(CaptureOperator(SMALL, positions, wavelength=WAVELENGTH)) == 2


@pytest.mark.slow
def test_many_cores_are_no_reason_to_refuse(monkeypatch):
    """Each thread takes memory, of which more than some GiB are refused."""
    few = CaptureOperator(SMALL, near(2), wavelength=WAVELENGTH)
    alone = few.estimate(Job(batch_map=Threads(2))).memory
    monkeypatch.setattr("mitsuba_plenoptic.runtime.batches.worker_count", lambda: 256)
    assert few.estimate().memory == alone
    assert alone < CaptureOperator(SMALL, near(100), wavelength=WAVELENGTH).estimate().memory < 4 * 2**30


@pytest.mark.parametrize(("method", "kind", "count"), [("patch", PatchSum, 30), ("full_field", FullFieldSum, 4)])
def test_the_estimate_leaves_the_sum_as_soon_as_its_speed_is_known(method, kind, count, monkeypatch):
    monkeypatch.setattr("mitsuba_plenoptic.runtime.progress.SETTLED", 0.0)
    ended = []
    monkeypatch.setattr(kind, "image", lambda *_: ended.append(True))
    cost = CaptureOperator(SMALL, near(count), wavelength=WAVELENGTH, method=method).estimate(Job(batch_map=Threads(1)))
    assert not ended and 0 < cost.seconds < 600 and 0 < cost.memory < 2**32


def test_many_points_keep_their_power_whatever_hides_others():
    """What is cut is put back on patches; nearly hidden pupils, which lose more of it, do not count for open ones."""
    camera, points = small_camera(16), scattered(600)
    seen = np.ones((600, 16, 16), bool)
    seen[300:, :, :15] = False
    open_ones = (np.arange(600) < 300).astype(float)
    image = CaptureOperator(camera, points, wavelength=550.0, accuracy=0.01, pupil_weights=seen).forward(open_ones)
    assert image.sum(dtype=float) == pytest.approx(300, rel=0.002)


def test_pupil_weights_do_not_turn_with_the_lattice():
    cameras, weights = (SMALL, SMALL.replace(mla_rotation=90.0)), np.repeat(half_open()[None], 5, axis=0)
    image, again = (capture(camera, near(5), np.ones(5), pupil_weights=weights) for camera in cameras)
    assert error(again, image) < 2e-3


def test_the_opening_of_a_fast_stigmatic_lens_against_differences_of_captures():
    """A step of 2 % of the radius: for smaller ones the captures' own scatter counts, for larger ones the curvature."""
    camera = PlenopticCamera(
        focal_length=4.0, aperture_radius=4 / 3.6, mla_distance=4.04, mla_focal_length=0.004, mla_medium=1.5,
        mla_pitch=0.0028, detector_width=0.0224, resolution=(16, 16),
    )  # fmt: skip
    step = 0.02 * camera.aperture_radius
    operator, *sides = (
        CaptureOperator(camera.replace(aperture_radius=radius), [(0.1, -0.05, 404.0)], wavelength=550, accuracy=0)
        for radius in (camera.aperture_radius, camera.aperture_radius + step, camera.aperture_radius - step)
    )
    up, down = (side.forward([1.0]) for side in sides)
    assert error(operator.derivative([1.0], {"aperture_radius": 1.0}), (up - down) / (2 * step)) < 0.02


def test_defocus_of_the_bare_main_lens_in_closed_form():
    """On the axis of a lens of radius 1: [sin(u/4) / (u/4)]^2 (Born and Wolf, section 8.8), and its derivative."""
    # One weak microlens about the axis.
    camera = PlenopticCamera(
        aperture_radius=1.0, mla_distance=119.5, detector_distance=0.5, mla_focal_length=1e5, mla_pitch=2.0,
        mla_offset=(1.0, 1.0), detector_width=0.008, resolution=(4, 4),
    )  # fmt: skip
    point, amount = [(0.0, 0.0, 240.0)], 0.15
    sharp = CaptureOperator(camera, point, wavelength=WAVELENGTH, accuracy=0).forward([1.0])[1:3, 1:3].mean()
    defocused = camera.replace(wavefront=(0.0, 0.0, 0.0, amount))
    operator = CaptureOperator(defocused, point, wavelength=WAVELENGTH, accuracy=0)
    # sqrt(3) (2 r^2 - 1) waves: u/4 is pi times the difference between rim and centre.
    growth = np.pi * 2 * np.sqrt(3)
    x = growth * amount
    value, slope = np.sinc(x / np.pi) ** 2, 2 * np.sinc(x / np.pi) * (np.cos(x) - np.sinc(x / np.pi)) / x * growth
    change = operator.derivative([1.0], {"wavefront": (0.0, 0.0, 0.0, 1.0)})[1:3, 1:3].mean()
    assert operator.forward([1.0])[1:3, 1:3].mean() / sharp == pytest.approx(value, rel=1e-3)
    assert change / sharp == pytest.approx(slope, rel=1e-3)


def test_directions_that_do_not_fit_into_memory_are_taken_in_turn(monkeypatch):
    operator = CaptureOperator(
        small_camera(2, **HALF), near(2), spectrum=Spectrum.lines(550.0, WAVELENGTH), accuracy=0.1
    )
    weights = np.random.default_rng(1).uniform(0.5, 1, (2, 2))
    directions = [{"mla_pitch": 1e-3}, {"mla_offset": (1e-3, 0)}, {"focal_length": 0.1}]
    together = operator.jacobian(weights, directions)
    monkeypatch.setattr("mitsuba_plenoptic.points.derivatives.plan.MEMORY_LIMIT", 1.0)
    told = []
    found = operator.jacobian(weights, directions, job=Job(progress=lambda *done: told.append(done)))
    np.testing.assert_allclose(found, together, rtol=1e-5, atol=1e-6 * abs(together).max())
    assert told[-1] == (12, 12)


MOVING = {"mla_pitch": (1.0, -0.5), "mla_distance": 1.0, "mla_rotation": 1.0, "detector_distance": 1.0}
"""Numbers by which copies change otherwise than their spreads."""


def test_copies_change_as_points_of_their_own(monkeypatch):
    """Without what tells copies from their spreads the derivative by the pitch is off by more than itself."""
    # A few points count as many.
    monkeypatch.setattr(accuracy, "_FEW", 8)
    camera = small_camera(2, **HALF)
    points = in_every_lens(camera, 4, 118.0)
    operator, alone = (CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0.1) for _ in range(2))
    weights = np.linspace(0.3, 1, len(points))
    shared = operator.jacobian(weights, [{name: change} for name, change in MOVING.items()])
    system = OpticalSystem(operator.camera, WAVELENGTH)
    assert len(plan.DerivativePlan(system, operator.points, None, 0.1)._positions) < len(weights)
    monkeypatch.setattr(plan, "derivatives_share", lambda accuracy, count: False)
    own = alone.jacobian(weights, [{name: change} for name, change in MOVING.items()])
    for name, found, expected in zip(MOVING, shared, own, strict=True):
        assert error(found, expected) < 0.07, name
    image = np.random.default_rng(3).normal(size=operator.camera.shape)
    gradient = operator.gradient(weights, image)
    assert set(gradient) == set(DIFFERENTIABLE)
    for (name, change), slope in zip(MOVING.items(), shared, strict=True):
        product = np.vdot(slope.astype(float), image) - np.vdot(change, gradient[name])
        assert abs(product) < 1e-4 * np.linalg.norm(slope) * np.linalg.norm(image), name


def test_changes_of_the_light_against_refitted_lenses():
    """The path, but for its piston, by lenses that are fitted anew to either side."""
    camera = small_camera(2, main_lens="singlet", **HALF)
    points = np.array([(0.5, -0.3, 110.0)])
    lens = OpticalSystem(camera, WAVELENGTH).waves_of(points)
    change = lens_change(lens, "wavelength")
    rng = np.random.default_rng(1)
    pupil = tuple(part[None] for part in 0.6 * lens.pupil.radius * rng.uniform(-1, 1, (2, 50)))
    fields, inverse_distance = lens.fitted.pupils.field(points)
    lanes = [np.array([[number]]) for number in change.aberration.at(fields, inverse_distance)[0]]
    found = change.aberration.over_pupil(lanes, (fields[:, :1], fields[:, 1:])).value(pupil)
    lenses = (OpticalSystem(camera, WAVELENGTH + step).waves_of(points) for step in (1, -1))
    high, low = (each.bind(points).length(pupil) for each in lenses)
    expected = (high - low) / 2
    found, expected = found - found.mean(), expected - expected.mean()
    assert np.abs(expected).max() > 1e-6
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()
