"""Fits of cameras to captures of known points, judged by the noise that was added."""

import math
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, scattered, small_camera

from mitsuba_plenoptic import Capture, CaptureOperator, Detector, InputError, PlenopticCamera, expose, fit
from mitsuba_plenoptic.array_functions import CameraCapture
from mitsuba_plenoptic.extensions.inverse import approach
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays, vector_of
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.fitting import View, coarse_fit, lattice_from_white, noise_of
from mitsuba_plenoptic.io import checkpoints
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import brightness_of

TRUE = small_camera(2, **HALF)
POINTS = scattered(5, distances=(112.0, 128.0), image=0.05)
PHOTONS = 2000.0
ACCURACY = 0.03


def test_numbers_are_found_within_their_deviations():
    operator = CaptureOperator(TRUE, POINTS, wavelength=WAVELENGTH, accuracy=ACCURACY)
    image = brightness_of(TRUE, main_lens(TRUE)) * operator.forward(np.ones(len(POINTS)))
    weights, image, tried = np.full(len(POINTS), 1 / image.max()), image / image.max(), []
    seen = np.random.default_rng(4).poisson(image * PHOTONS) / PHOTONS
    start = TRUE.replace(mla_pitch=0.0643, mla_offset=(0.001, -0.001), detector_distance=TRUE.detector_distance * 1.01)
    names, options = ["mla_pitch", "mla_offset", "detector_distance"], {"photons": PHOTONS, "accuracy": ACCURACY}
    options |= {"wavelength": WAVELENGTH, "progress": lambda done, total: tried.append(done)}
    found = fit(start, View(seen, POINTS, weights), names, **options)
    true = {"mla_pitch": 0.064, "mla_offset.1": 0.0, "mla_offset.2": 0.0, "detector_distance": 0.512}
    assert list(found.values) == list(true)
    difference = np.array([found.values[name] - value for name, value in true.items()])
    # Chi-squared of four numbers: a hundredth lies beyond 13.3.
    inverse = np.linalg.inv(found.covariance)
    assert difference @ inverse @ difference < 13.3
    assert max(abs(difference / list(found.deviations.values()))) < 3.5
    assert found.chi_square == pytest.approx(1, abs=4 * found.chi_square_deviation)
    assert found.chi_square_deviation < 0.05
    assert found.camera.mla_pitch == found.values["mla_pitch"]
    assert found.deviations["mla_pitch"] < 1e-4
    assert tried == list(range(1, found.steps + 1))
    # The directions are those of the covariance, the worst first.
    worst = found.directions[0]
    vector = np.array([worst.parts[name] * found.scales[name] for name in true])
    assert worst.deviation >= found.directions[-1].deviation
    assert vector @ inverse @ vector == pytest.approx(worst.deviation**-2, rel=1e-6)


def test_single_parts_of_a_parameter_are_named_by_their_index():
    camera = TRUE.replace(wavefront=(0.0,) * 6)
    assert vector_of(camera, ["wavefront.5", "mla_offset.2"]).labels == ["wavefront.5", "mla_offset.2"]
    assert vector_of(camera, ["wavefront.5", "wavefront"]).labels == [f"wavefront.{term}" for term in range(2, 7)]


def lit_by_rays(camera, points, weights):
    rays, system = PointRays(camera, points, WAVELENGTH), OpticalSystem(camera, WAVELENGTH)
    return brightness_of(camera, main_lens(camera)) * rays.image(system, weights)


def by_rays(camera, points):
    """Return what a camera records of points by rays, the brightest pixel 1, and the light."""
    image = lit_by_rays(camera, points, np.ones(len(points)))
    return image / image.max(), np.full(len(points), 1 / image.max())


def test_a_fit_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    true = small_camera(2, **HALF)
    image, weights = by_rays(true, POINTS)
    view, start = View(image, POINTS, weights, 0.01), true.replace(mla_pitch=0.0643)

    def fitted(existing, progress, **changes):
        with checkpoints.Checkpoint(tmp_path / "kept", existing) as kept:
            given = {"wavelength": WAVELENGTH} | changes
            return fit(start, view, "mla_pitch", model="ray", checkpoint=kept, progress=progress, **given)

    def stop(tried, total):
        if tried == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fitted("refuse", stop)
    with pytest.raises(InputError, match="wavelength"):
        fitted("resume", None, wavelength=600.0)
    tried, start = [], true.replace(mla_pitch=0.0642)  # what is fitted may start elsewhere
    # The image has none of the noise that is given.
    with pytest.warns(UserWarning, match="chi-square is .* not 1"):
        found = fitted("resume", lambda done, total: tried.append(done))
    assert tried[0] > 1
    assert found.camera.mla_pitch == pytest.approx(0.064, abs=1e-6)
    assert not (tmp_path / "kept").exists()


@pytest.mark.slow
def test_a_camera_is_found_from_afar():
    true = PlenopticCamera(detector_width=0.512, resolution=(96, 96), **HALF)
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (60, 2)), rng.uniform(106, 112, 60)])
    image, weights = by_rays(true, points)
    view = View(np.random.default_rng(5).poisson(image * PHOTONS) / PHOTONS, points, weights)
    off = {"focal_length": 0.98, "mla_distance": 1.02, "detector_distance": 1.02}
    names = [*off, "mla_offset"]
    near = coarse_fit(true.replace(**{name: factor * getattr(true, name) for name, factor in off.items()}), view, names)
    found = fit(near, view, names, photons=PHOTONS, model="ray")
    for name in off:
        assert getattr(near, name) == pytest.approx(getattr(true, name), rel=0.005)
        assert getattr(found.camera, name) == pytest.approx(getattr(true, name), abs=4 * found.deviations[name])


@pytest.fixture(scope="module")
def recorded():
    true = small_camera(2, **HALF)
    points = scattered(8, distances=(106.0, 112.0), image=0.05)
    mi.set_variant("llvm_ad_mono")
    return (true, points, *by_rays(true, points))


def quickly(camera, view, names="mla_pitch", **options):
    start = camera.replace(mla_pitch=0.06402)
    return fit(start, view, names, wavelength=WAVELENGTH, model="ray", **({"photons": PHOTONS} | options))


@pytest.mark.slow
def test_chi_square_of_a_right_model_is_one(recorded):
    """Counts after Poisson: over noises its mean is 1, and its spread as stated, with few photons."""
    true, points, image, weights = recorded
    photons = 20.0
    lit, found, errors = image * photons, [], []
    for seed in range(4):
        view = View(np.random.default_rng(seed).poisson(lit) / photons, points, weights)
        found.append(quickly(true, view, photons=photons))
        errors.append((found[-1].values["mla_pitch"] - 0.064) / found[-1].deviations["mla_pitch"])
    off = [(one.chi_square - 1) / one.chi_square_deviation for one in found]
    assert abs(np.mean(off)) < 4 / 2
    assert max(map(abs, off)) < 4 and max(map(abs, errors)) < 4
    # Of the squares of many Poisson numbers of mean m over m the variance is 2 + 1 / m.
    assert found[0].chi_square_deviation < np.sqrt(3.5 / (lit > 1).sum())


@pytest.mark.slow
def test_deviations_are_not_those_of_a_kink(recorded):
    """Without noise the deviation is the true one; beside a kink, slopes of the captures state a fifth of it."""
    true, points, image, weights = recorded
    names = ["mla_pitch", "focal_length", "mla_offset"]
    with pytest.warns(UserWarning, match="chi-square is"):
        bound = quickly(true, View(image, points, weights), names)
    found = quickly(true, View(np.random.default_rng(14).poisson(image * PHOTONS) / PHOTONS, points, weights), names)
    errors = np.array([found.values[name] - value for name, value in bound.values.items()])
    assert errors @ np.linalg.solve(bound.covariance, errors) < 13.3
    for name, deviation in bound.deviations.items():
        assert found.deviations[name] == pytest.approx(deviation, rel=0.25)


def test_chi_square_of_what_a_detector_records_is_one(recorded):
    """With noise of reading and of dark current, rounding, and photons that free no electron, as metadata have it."""
    true, points, image, weights = recorded
    detector = Detector(quantum_efficiency=0.5, read_noise=3.0, dark_electrons=4.0, full_well=4000, bits=10)
    seen = expose(Capture(image, true), detector, photons=4000.0, seed=2)
    noise, saturation = noise_of(seen)
    flat = expose(Capture(np.full(true.shape, 0.4), true), detector, photons=4000.0, seed=3).image
    assert (noise.electrons * 0.4 + noise.dark_variance) / noise.electrons**2 == pytest.approx(flat.var(), rel=0.1)
    full = expose(Capture(np.full(true.shape, 40.0), true), detector, photons=4000.0, seed=3).image
    assert 0.98 * full.max() < saturation <= full.min()
    found = quickly(true, View(seen.image, points, weights, noise, saturation=saturation), photons=None)
    assert found.chi_square == pytest.approx(1, abs=4 * found.chi_square_deviation)
    assert found.values["mla_pitch"] == pytest.approx(0.064, abs=4 * found.deviations["mla_pitch"])
    assert noise_of(Capture(image, true)) == (None, None)


def test_a_wrong_unit_is_warned_of(recorded):
    true, points, image, weights = recorded
    with pytest.warns(UserWarning, match=r"chi-square is .* not 1: .* times as bright as the model"):
        quickly(true, View(np.random.default_rng(1).poisson(image * PHOTONS).astype(float), points, weights))


def test_saturated_pixels_are_left_out(recorded):
    """A fifth of the pixels with light are saturated: without a word of it that shows, with it they do no harm."""
    true, points, image, weights = recorded
    seen = np.random.default_rng(6).poisson(image * PHOTONS) / PHOTONS
    level = np.quantile(seen[seen > 0.02], 0.8)
    cut = np.minimum(seen, level)
    with pytest.warns(UserWarning, match=r"chi-square .* pixels have the same highest value, .* if they are saturated"):
        bad = quickly(true, View(cut, points, weights))
    assert bad.chi_square > 1 + 20 * bad.chi_square_deviation
    for options in ({"saturation": level}, {"mask": image > 0.9 * level}):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = quickly(true, View(cut, points, weights, **options))
        assert found.chi_square == pytest.approx(1, abs=4 * found.chi_square_deviation)
        assert found.values["mla_pitch"] == pytest.approx(0.064, abs=4 * found.deviations["mla_pitch"])
        assert found.pixels < (cut < level).sum() + 1 if "saturation" in options else found.pixels < cut.size


def test_a_number_at_a_bound_has_a_one_sided_deviation(recorded):
    """Inside the bound by the deviation the sum of squares is larger by 1, as captures of other cameras have it."""
    true, points, image, weights = recorded
    seen = np.random.default_rng(7).poisson(image * PHOTONS) / PHOTONS
    bound = 0.064 + 2e-6
    with pytest.warns(UserWarning, match=r"fit: at a bound: mla_pitch = 0\.064002 \(its lowest\)"):
        found = quickly(true, View(seen, points, weights), bounds={"mla_pitch": (bound, 0.065)})
    assert found.at_bounds == {"mla_pitch": "lowest"}
    pitches = (bound, bound + found.deviations["mla_pitch"])
    images = [lit_by_rays(true.replace(mla_pitch=pitch), points, weights) for pitch in pitches]
    variance = np.maximum(images[0], 1 / PHOTONS) / PHOTONS
    squares = [((one - seen) ** 2 / variance).sum() for one in images]
    assert squares[1] - squares[0] == pytest.approx(1, abs=0.15)


@pytest.mark.slow
def test_from_afar_no_number_leaves_its_bounds(recorded):
    true, points, image, weights = recorded
    start = true.replace(mla_pitch=0.068)
    with pytest.warns(UserWarning, match="coarse_fit: at a bound: mla_pitch = "):
        near = coarse_fit(start, View(image, points, weights), "mla_pitch", bounds={"mla_pitch": (0.067, 0.07)})
    assert near.mla_pitch == pytest.approx(0.067, abs=1e-5)
    # By default lengths stay within half of where they start; what shows no lattice does not tell the pitch.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        near = coarse_fit(start, View(np.eye(*true.shape), points, weights), "mla_pitch")
    assert 0.034 <= near.mla_pitch <= 0.102


def test_from_afar_a_fit_goes_on_with_the_blur_where_it_stopped(recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    # However long the disk took.
    monkeypatch.setattr(checkpoints, "FRACTION", math.inf)
    true, points, image, weights = recorded
    view, start, nearest, tried = View(image, points, weights), true.replace(mla_pitch=0.065), approach._nearest, []

    def counted(*arguments):
        tried.append(arguments[4])
        if len(tried) == 2:
            raise KeyboardInterrupt
        return nearest(*arguments)

    def fitted(name, existing):
        tried.clear()
        with checkpoints.Checkpoint(tmp_path / name, existing) as kept:
            return coarse_fit(start, view, "mla_pitch", checkpoint=kept).mla_pitch

    whole = fitted("whole", "refuse")
    monkeypatch.setattr(approach, "_nearest", counted)
    with pytest.raises(KeyboardInterrupt):
        fitted("broken", "refuse")
    blurs = list(tried)
    monkeypatch.setattr(approach, "_nearest", lambda *arguments: tried.append(arguments[4]) or nearest(*arguments))
    # The blur during which the first run was stopped, and those that are less.
    assert fitted("broken", "resume") == pytest.approx(whole, rel=1e-4) and tried[0] == blurs[1] < blurs[0]


@pytest.mark.parametrize("numbers", [{"mla_lattice": "hexagonal"}, {"mla_pitch": (0.064, 0.0606)}])
def test_lattice_from_white(numbers):
    """Discs at the micro-images' centres, of a camera that is turned and shifted."""
    camera = small_camera(12, mla_rotation=0.7, mla_offset=(0.011, -0.013), **numbers)
    size = camera.resolution[0]
    x = (np.arange(size) + 0.5 - size / 2) * camera.pixel_size
    shrunk = camera.mla_distance / (camera.mla_distance + camera.detector_distance)
    across, up = np.meshgrid(x * shrunk, x * shrunk)
    cx, cy = camera.lattice.centre(*camera.lattice.cell(across, up))
    white = 1 / (1 + np.exp((np.hypot(across - cx, up - cy) - 0.02) / 0.001))
    pitches = np.array(camera.mla_pitches) * (1.02, 0.985 if "mla_pitch" in numbers else 1.02)
    pitch = tuple(pitches) if "mla_pitch" in numbers else pitches[0]
    found = lattice_from_white(camera.replace(mla_pitch=pitch, mla_rotation=-0.3, mla_offset=(0.0, 0.0)), white)
    assert found.mla_pitches == pytest.approx(camera.mla_pitches, rel=1e-3)
    assert found.mla_rotation == pytest.approx(0.7, abs=0.02)
    assert found.mla_offset == pytest.approx(camera.mla_offset, abs=3e-4)


FEW = np.array([(0.01, -0.02, 215.0), (-0.03, 0.02, 240.0)])


@pytest.fixture
def kernels():
    """Return a function that lists the kernels since it was called last, in memory, on disk or compiled."""
    before = dr.flag(dr.JitFlag.KernelHistory)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    yield lambda: {each["hash"] for each in dr.kernel_history() if each["type"] == dr.KernelType.JIT}
    dr.set_flag(dr.JitFlag.KernelHistory, before)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lattice", "name", "values"),
    [
        ("hexagonal", "mla_distance", (119.9, 120.07)),
        ("square", "wavefront", ((0, 0.1, 0.2), (0, 0.2, 0.1))),
        ("square", "mla_offset", ((0.001, 0.002), (0.003, 0.001))),
    ],
)
def test_a_camera_that_changes_compiles_nothing_after_the_first_step(lattice, name, values, kernels):
    camera = PlenopticCamera(resolution=(64, 64), detector_width=0.128, mla_lattice=lattice)

    def step(value):
        function = CameraCapture(lambda made: CaptureOperator(made, FEW, wavelength=633), camera, (name,))
        capture = function.at(np.ones(2), np.array(value, float))
        capture.vjp(2 * capture.value, [True, True])
        return kernels()

    # No other test has a camera of the first values, whose tables would be remembered.
    first, second = map(step, values)
    assert first and not second - first
