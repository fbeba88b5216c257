"""Reconstruction against dense matrices, correlation on exact shifts, and tracking against known positions."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusals import refused, refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import particles as pt
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.linear.map import LinearMap

CAMERA = mp.PlenopticCamera(detector_width=0.512, resolution=(128, 128))
SMALL = CAMERA.replace(detector_width=0.128, resolution=(16, 16))
GRID = pt.VoxelGrid((-0.2, -0.2, 236), (0.2, 0.2, 246), (2, 3, 3))
TURNED = pt.VoxelGrid((-0.2, -0.2, 236), (0.2, 0.2, 246), (3, 3, 2))


def small_rays():
    return pt.RayProjector(SMALL, GRID, wavelength=550)


class Dense(LinearMap):
    def __init__(self, matrix, shape):
        super().__init__((matrix.shape[1],), shape, matrix.dtype)
        self.matrix = matrix

    def forward(self, weights):
        return (self.matrix @ weights).reshape(self.image_shape)

    def adjoint(self, image):
        return self.matrix.T @ np.ravel(image)


def dense_case(count=18, pixels=60):
    random = np.random.default_rng(5)
    matrix = random.random((pixels, count)) * (random.random((pixels, count)) < 0.4)
    light = np.where(random.random(count) < 0.3, random.random(count), 0)
    return Dense(matrix, (10, 6)), light


@pytest.mark.parametrize("method", ["mart", "sirt"])
def test_steps_are_those_of_a_dense_matrix(method):
    operator, light = dense_case()
    image = operator.forward(light) + 0.05
    found = pt.reconstruct_volume(operator, image, GRID, method=method, iterations=7, relaxation=0.8)
    A, b = operator.matrix, image.ravel()
    x = np.full(A.shape[1], b.sum() / A.sum())
    for _ in range(7):
        if method == "mart":
            x = x * np.exp(0.8 * np.array([A[:, j] @ np.log(b / (A @ x)) / A[:, j].sum() for j in range(len(x))]))
        else:
            part = (b - A @ x) / A.sum(1)
            x = np.maximum(x + 0.8 * np.array([A[:, j] @ part / A[:, j].sum() for j in range(len(x))]), 0)
    assert_allclose(found.values.ravel(), x, rtol=1e-5, atol=1e-7)
    assert found.dims == ("z", "y", "x")
    assert_allclose(found["z"], [238.5, 243.5])


def test_steps_stop_and_go_on(tmp_path):
    operator, light = dense_case()
    image = operator.forward(light)
    whole = pt.reconstruct_volume(operator, image, GRID, iterations=40)
    assert whole.attrs["stopped"] == "iterations"
    noisy = pt.reconstruct_volume(operator, image, GRID, iterations=40, noise=0.1)
    assert noisy.attrs["stopped"] == "noise" and noisy.attrs["iterations"] < 40
    assert noisy.attrs["residual"] * np.sqrt((image**2).mean()) <= 0.1
    assert pt.reconstruct_volume(operator, image, GRID, iterations=40, tolerance=0.2).attrs["stopped"] == "tolerance"
    # A run stopped after 15 steps goes on with the same bits.
    saved = mp.Checkpoint(tmp_path / "volume.checkpoint", "resume")

    def stop(done, total):
        if done == 15:
            saved.stop()

    with pytest.raises(KeyboardInterrupt), saved:
        pt.reconstruct_volume(operator, image, GRID, iterations=40, progress=stop, checkpoint=saved)
    with mp.Checkpoint(tmp_path / "volume.checkpoint", "resume") as saved:
        steps, options = [], {"iterations": 40, "checkpoint": saved}
        again = pt.reconstruct_volume(operator, image, GRID, progress=lambda *done: steps.append(done[0]), **options)
    assert steps[0] == 16
    assert (again.values == whole.values).all()


@pytest.mark.slow
def test_voxels_have_point_spreads_between_those_of_regular_points():
    grid = pt.VoxelGrid((-0.09, -0.07, 235), (0.11, 0.13, 237), (1, 2, 2))
    light, errors = np.array([1.0, 0.5, 0.0, 2.0]), []
    exact = mp.CaptureOperator(CAMERA, grid.points, wavelength=550, accuracy=0).forward(light)
    for per_lens in (2, 10):
        projector = pt.VoxelProjector(CAMERA, grid, wavelength=550, per_lens=per_lens, accuracy=0)
        image = projector.forward(light)
        assert abs(float(image.sum() / exact.sum()) - 1) < 0.005
        errors.append(np.linalg.norm(image - exact) / np.linalg.norm(exact))
    assert errors[1] < min(0.08, errors[0] / 4)
    other = np.random.default_rng(3).random(image.shape).astype(np.float32)
    assert_allclose((image * other).sum(dtype=float), projector.adjoint(other) @ light, rtol=1e-4)
    stored = pt.VoxelProjector(CAMERA, grid, wavelength=550, per_lens=10, accuracy=0, budget=1.0)
    assert_allclose(stored.forward(light), image, atol=1e-4 * image.max())


def test_voxels_by_rays_are_points_by_rays():
    light = np.random.default_rng(2).random(18)
    projector = pt.RayProjector(CAMERA, GRID, wavelength=550)
    image = projector.forward(light)
    exact = PointRays(CAMERA, GRID.points, 550.0).image(OpticalSystem(CAMERA, 550.0), light)
    assert_allclose(image, exact, atol=1e-5 * exact.max())
    assert_allclose(image.sum(dtype=float), light.sum(), rtol=1e-3)
    other = np.random.default_rng(3).random(image.shape).astype(np.float32)
    assert_allclose((image * other).sum(dtype=float), projector.adjoint(other) @ light, rtol=1e-5)


def test_voxels_are_projected_from_where_they_are_seen():
    seen = pt.VoxelGrid((-0.2, -0.2, 220 + 16 / 1.4), (0.2, 0.2, 220 + 26 / 1.4), (2, 3, 3))
    light = np.random.default_rng(2).random(18)
    window = pt.Window(220, 1.4)
    plain = pt.VoxelProjector(CAMERA, GRID, wavelength=550)
    through = pt.VoxelProjector(CAMERA, GRID, wavelength=550, window=window)
    image, expected = (each.forward(light) for each in (through, pt.VoxelProjector(CAMERA, seen, wavelength=550)))
    assert_allclose(image, expected, atol=2e-5 * expected.max())
    # Only a projector that looks through the window explains what it shows, or points where it shows them.
    seeding, still = pt.Seeding(count=1, index=None, medium=1.4, window=220), pt.Uniform((0, 0, 0))
    truth = pt.particle_sequence(CAMERA, GRID, seeding, still, interval=1, seed=1)
    capture = mp.Capture(image, CAMERA, metadata={"particles": json.loads(truth.attrs["particles"])})
    for other in (through, mp.CaptureOperator(CAMERA, window.apparent(GRID.points, CAMERA, 550), wavelength=550)):
        pt.reconstruct_volume(other, capture, GRID, iterations=1)
    for other in (plain, mp.CaptureOperator(CAMERA, GRID.points, wavelength=550)):
        refuses(r"Window\(.*=220.*1.4\)", pt.reconstruct_volume, other, capture, GRID)


def test_points_between_voxels_follow_the_lattice():
    camera = CAMERA.replace(mla_lattice="hexagonal", mla_rotation=7.0, mla_offset=(0.01, 0.02))
    grid = pt.VoxelGrid((-0.09, -0.07, 235), (0.11, 0.13, 237), (1, 2, 2))
    projector = pt.VoxelProjector(camera, grid, wavelength=550, per_lens=3)
    # The light of a voxel is about its own place, and the points are a whole number of thirds of lattice steps apart.
    assert_allclose(projector._spread.T @ projector.operator.points, grid.points, atol=1e-5)
    between = (projector.operator.points[:, :2] - projector.operator.points[0, :2]) * -120 / 236
    turn = np.radians(camera.mla_rotation)
    unturned = between @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    steps = unturned @ np.linalg.inv(camera.replace(mla_rotation=0.0).lattice.basis) * 3
    assert_allclose(steps, np.rint(steps), atol=1e-6)


def test_quality_and_ghosts():
    grid = pt.VoxelGrid((-1, -1, 99), (1, 1, 101), (20, 40, 40))
    places, light = np.array([[0.2, 0.1, 100], [-0.5, 0.4, 99.7]]), np.array([1.0, 2.0])
    volume = pt.drawn_particles(grid, places, light, (0.1, 0.1, 0.2))
    assert_allclose(float(volume.sum()), 3, rtol=2e-4)
    for place in np.random.default_rng(2).uniform([-0.7, -0.7, 99.3], [0.7, 0.7, 100.7], (20, 3)):
        # Half a voxel wide, wherever in a voxel: the same light, and its centroid to what voxels can tell.
        narrow = pt.drawn_particles(grid, place[None], light[:1], (0.025, 0.025, 0.05))
        assert_allclose(float(narrow.sum()), 1, rtol=1e-9)
        assert_allclose([float((narrow * narrow[axis]).sum()) for axis in "xyz"], place, atol=2e-3)
    assert_allclose(float((volume * volume["x"]).sum() / volume.sum()), (0.2 - 1.0) / 3, atol=1e-3)
    assert pt.quality(volume, 5 * volume) == pytest.approx(1)
    # Two curves of the same width, a distance d apart: exp(-d^2 / 4 s^2); voxels of 0.05 widen them.
    one, other = (pt.drawn_particles(grid, np.array([[x, 0, 100]]), light[:1], (0.1, 0.1, 0.2)) for x in (0, 0.15))
    assert pt.quality(one, other) == pytest.approx(np.exp(-(0.15**2) / (0.04 + 0.05**2 / 3)), abs=2e-4)
    assert pt.ghost_fraction(volume, places, (0.5, 0.5, 1)) == pytest.approx(0, abs=1e-5)
    assert pt.ghost_fraction(volume, places[:1], (0.35, 0.35, 0.5)) == pytest.approx(2 / 3, abs=0.02)
    assert pt.elongation(CAMERA, 240) == pytest.approx(2**0.5 * 240 / 5)


def shifted_pair(move, count=500):
    grid = pt.VoxelGrid((-1, -1, 99), (1, 1, 103), (32, 48, 48))
    random = np.random.default_rng(8)
    low, high = np.array([-1.3, -1.3, 98.4]), np.array([1.3, 1.3, 103.6])
    places, light = random.uniform(low, high, (count, 3)), random.uniform(0.5, 1, count)
    return [pt.drawn_particles(grid, places + step, light, (0.05, 0.05, 0.15)) for step in (0.0, move(places))]


def test_correlation_finds_exact_shifts():
    # 2.4, -1.3 and 3.2 voxels.
    move = np.array([0.1, -0.054, 0.4])
    found = pt.correlate_volumes(*shifted_pair(lambda places: move), window=(16, 16, 16))
    error = (found["displacement"].values - move) / np.array([2 / 48, 2 / 48, 4 / 32])
    assert np.sqrt((error**2).mean((0, 1, 2))).max() < 0.15
    assert np.abs(error.mean((0, 1, 2))).max() < 0.05
    assert found.sizes == {"z": 3, "y": 5, "x": 5, "axis": 3}
    assert_allclose(found["x"][0], -1 + 8 / 24, atol=1e-9)


@pytest.mark.parametrize(("across", "rate", "window"), [("z", 0.05, (8, 24, 24)), ("y", 0.08, (16, 16, 16))])
def test_correlation_finds_shears_up_to_the_borders(across, rate, window):
    index = "xyz".index(across)
    centre = (0, 0, 101)[index]
    move = lambda p: np.outer(rate * (p[:, index] - centre), [1, 0, 0])  # noqa: E731
    found = pt.correlate_volumes(*shifted_pair(move, 2000), window=window)
    layers = found["displacement"].sel(axis="x").mean([name for name in "xyz" if name != across])
    place = found[across].values - centre
    assert np.polyfit(place, layers, 1)[0] == pytest.approx(rate, rel=0.05)
    # Layers to a tenth of a voxel; the outer ones, which have neighbours on one side, as the others.
    assert np.abs(layers - rate * place).max() < 0.1 * 2 / 48
    assert found["outlier"].mean() < 0.1


@pytest.mark.parametrize(("voxels", "is_wrong"), [(10, False), (14, True)])
def test_displacements_beyond_a_window_are_warned_of(voxels, is_wrong, recwarn):
    pt.correlate_volumes(*shifted_pair(lambda places: np.array([voxels / 24, 0, 0]), 1500), window=(16, 16, 16))
    assert ["vectors are outliers, and others" in str(each.message) for each in recwarn] == [True] * is_wrong


def test_empty_windows_have_no_displacement_of_their_own():
    first, second = shifted_pair(lambda places: np.array([0.1, 0, 0]))
    for volume in (first, second):
        volume[8:16, 16:32, 16:32] = 0
    found = pt.correlate_volumes(first, second.transpose("x", "z", "y"), window=(8, 16, 16), overlap=0)
    assert found["outlier"].values[1, 1, 1] and found["correlation"].values[1, 1, 1] == 0
    assert np.abs(found["displacement"].values - [0.1, 0, 0]).max() < 0.1
    # One particle that leaves its window, and nothing else.
    one, other = (first.copy(data=np.zeros(first.shape)) for _ in range(2))
    one[4, 8, 8] = other[20, 40, 40] = 1
    found = pt.correlate_volumes(one, other, window=(8, 16, 16), overlap=0)
    assert np.isnan(found["displacement"]).all()
    found = pt.correlate_volumes(one, one, window=(32, 48, 48))
    assert_allclose(found["displacement"].values.ravel(), 0, atol=1e-9)


def test_particles_are_located_and_matched():
    grid = pt.VoxelGrid((-1, -1, 99), (1, 1, 101), (20, 40, 40))
    places = np.array([[0.21, 0.1, 100.03], [-0.51, 0.42, 99.7], [0.62, -0.63, 100.4]])
    volume = pt.drawn_particles(grid, places, np.array([1, 2, 1.5]), (0.06, 0.06, 0.12))
    found, light = pt.locate_particles(volume, apart=(7, 7, 7))
    order = np.argsort(light)
    assert_allclose(found[order], places[[0, 2, 1]], atol=0.01)
    assert_allclose(light[order], [1, 1.5, 2], rtol=0.03)
    move = np.array([0.3, 0, 0.1])
    second = np.concatenate([places[::-1] + move + 0.01, [[5, 5, 5]]])
    first, other = pt.match_particles(places, second, np.broadcast_to(move, places.shape), (0.1, 0.1, 0.2))
    assert (first, other) == (pytest.approx([0, 1, 2]), pytest.approx([2, 1, 0]))


def test_least_squares_find_positions_and_light():
    places, light = np.array([[0.05, 0.02, 231.0], [-0.07, -0.04, 250.0]]), np.array([1.0, 0.6])
    # In water behind a window at 225 mm.
    seen = np.where([0, 0, 1], 225 + (places - 225) / 1.333, places)
    image = mp.CaptureOperator(CAMERA, seen, wavelength=550, accuracy=0).forward(light)
    start = places + np.array([[0.01, -0.01, 0.3], [-0.01, 0.01, -0.3]])
    capture = mp.Capture(image, CAMERA, 550.0, "wave")
    window = pt.Window(225, 1.333)
    found, power = pt.refine_particles(capture, start, np.ones(2), window=window, iterations=3, bins=(2, 1))
    assert np.abs((found - places)[:, :2]).max() < 5e-4
    assert np.abs((found - places)[:, 2]).max() < 0.03
    assert_allclose(power, light, rtol=0.02)


test_bad_volumes_are_refused_in_one_line = refused(
    (lambda: pt.VoxelGrid((0, 0, 1), (1, 1, 1), (2, 2, 2)), "empty"),
    (lambda: pt.RayProjector(CAMERA, GRID, wavelength=550, budget=1e-9), "budget = 1e-09"),
    (lambda: pt.RayProjector(CAMERA, NEAR, wavelength=550), "focus at 80"),
    (lambda: pt.RayProjector(CAMERA.replace(stray_light=0.1), GRID, wavelength=550), "stray_light = 0.1"),
    (lambda: pt.VoxelProjector(CAMERA.replace(mla_tilt=(1.0, 0.0)), GRID, wavelength=550), "mla_tilt = "),
    (lambda: pt.drawn_particles(GRID, np.zeros((1, 3)), np.ones(1), (0.1, 0.1, 1)), "half a voxel"),
    (lambda: pt.drawn_particles(GRID, np.full((1, 3), np.nan), [1], (0.1, 0.1, 9)), r"positions\[0, 0\] = nan: "),
    (lambda: pt.match_particles([[0, 0, np.inf]], [[0, 0, 1]], [[0, 0, 0]], (1, 1, 1)), r"first\[0, 2\] = inf: "),
    (lambda: pt.quality(FAR, FAR.assign_coords(x=FAR["x"] + 9e-4)), "differ in x"),
    (lambda: pt.quality(EMPTY + np.inf, EMPTY), "finite"),
    (lambda: pt.reconstruct_volume(DENSE, np.full((10, 6), np.nan), GRID), "finite"),
    (lambda: pt.reconstruct_volume(small_rays(), np.ones((16, 16)), TURNED), r"grid of shape \(3, 3, 2\)"),
    (lambda: pt.reconstruct_volume(small_rays(), mp.Capture(np.ones((16, 16)), NARROW), GRID), "capture: its camera"),
    (lambda: pt.reconstruct_volume(dense_case(7)[0], np.ones((10, 6)), GRID), "grid of 18 voxels"),
    (lambda: pt.correlate_volumes(EMPTY, EMPTY, window=(4, 4, 4)), "first: the volume is empty"),
    (lambda: pt.correlate_volumes(EMPTY, EMPTY, window=(9, 4, 4)), r"window = \(9, 4, 4\)"),
)


DENSE, NARROW = dense_case()[0], SMALL.replace(aperture_radius=3)
NEAR = pt.VoxelGrid((0, 0, 60), (1, 1, 90), (2, 2, 2))
EMPTY = pt.VoxelGrid((0, 0, 0), (1, 1, 1), (4, 4, 4)).labelled(np.zeros(64))
FAR = pt.VoxelGrid((0, 0, 240), (1, 1, 241), (4, 4, 4)).labelled(np.ones(64))
