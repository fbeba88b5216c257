"""The incoherent sum: linear in its weights, the same for any number of threads, true to single point spreads."""

import numpy as np
import pytest

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.capture.incoherent import estimate_cost, incoherent_sum
from mitsuba_plenoptic.capture.point_spread import point_spread_function
from mitsuba_plenoptic.errors import InputError

SMALL = PlenopticCamera(detector_width=1.024, resolution=(512, 512))


def error(image, reference):
    return np.linalg.norm(image - reference) / np.linalg.norm(reference)


def random_positions(count, seed=0, distances=(205.0, 275.0)):
    rng = np.random.default_rng(seed)
    g = rng.uniform(*distances, count)
    image = rng.uniform(-0.4, 0.4, (count, 2))
    return np.column_stack([-image * g[:, None] / SMALL.mla_distance, g])


def lattice_positions(lenses, distance, per_lens=3):
    """Radiators at the same places of neighbouring lenses."""
    image = ((np.arange(lenses * per_lens) + 0.5) / per_lens - lenses / 2) * SMALL.mla_pitch
    x, y = np.meshgrid(image, image)
    scale = -distance / SMALL.mla_distance
    return np.column_stack([x.ravel() * scale, y.ravel() * scale, np.full(x.size, distance)])


def test_is_the_sum_of_point_spreads():
    positions, weights = random_positions(6), np.array([1.0, 0.5, 2.0, 0.0, 3.0, 0.1])
    expected = sum(
        weight * point_spread_function(SMALL, position, wavelength=633)
        for position, weight in zip(positions, weights, strict=True)
    )
    high = incoherent_sum(SMALL, positions, weights, wavelength=633, accuracy=0)
    assert error(high, expected) < 2e-3
    assert error(incoherent_sum(SMALL, positions, weights, wavelength=633), expected) < 2e-3
    standard = incoherent_sum(SMALL, positions, weights, wavelength=633, accuracy=0.01)
    assert error(standard, expected) < 0.02


def test_full_field_method():
    positions = random_positions(2)
    image = incoherent_sum(SMALL, positions, [1.0, 2.0], wavelength=633, method="full_field")
    expected = incoherent_sum(SMALL, positions, [1.0, 2.0], wavelength=633, accuracy=0)
    assert error(expected, image) < 0.005


@pytest.mark.parametrize("distance", [210.0, 240.0])
def test_shared_patterns_stay_true(distance):
    """One pattern for a zone of lenses, against a propagation of every radiator."""
    positions = lattice_positions(5, distance)
    weights = np.random.default_rng(1).uniform(0, 1, len(positions))
    shared = incoherent_sum(SMALL, positions, weights, wavelength=633, accuracy=0.01)
    assert estimate_cost(SMALL, positions, wavelength=633, accuracy=0.01).patterns < len(positions) / 3
    every = incoherent_sum(SMALL, positions, weights, wavelength=633, accuracy=0)
    assert estimate_cost(SMALL, positions, wavelength=633, accuracy=0).patterns == len(positions)
    assert error(shared, every) < 0.006


def test_a_tilted_surface_shares_within_the_allowed_error():
    """Radiators of which no two are at one distance or at one place of their lenses."""
    positions = lattice_positions(6, 262.0, per_lens=6)
    slope = 1 + 0.004 * positions[:, 0] + 0.002 * positions[:, 1]
    positions = positions * slope[:, None]
    weights = np.random.default_rng(1).uniform(0.5, 1, len(positions))
    cost = estimate_cost(SMALL, positions, wavelength=633)
    assert cost.patterns < len(positions) / 3
    every = incoherent_sum(SMALL, positions, weights, wavelength=633, accuracy=0)
    assert error(incoherent_sum(SMALL, positions, weights, wavelength=633), every) < 0.01
    rough = incoherent_sum(SMALL, positions, weights, wavelength=633, accuracy=0.05)
    assert 0.001 < error(rough, every) < 0.05


def test_few_radiators_are_not_mistaken_for_each_other():
    """Nothing averages out in a sum of two: near each other as they are, each has a point spread of its own."""
    g, x = 240.0, 0.002
    positions = np.array([(0.01, 0.01, g), (0.01 + x, 0.01, g)])
    assert estimate_cost(SMALL, positions, wavelength=633).patterns == 2


def test_threads_do_not_change_a_bit():
    positions = np.concatenate([random_positions(20), lattice_positions(3, 240.0)])
    weights = np.random.default_rng(2).uniform(0, 1, (len(positions), 2))
    images = [incoherent_sum(SMALL, positions, weights, wavelength=633, accuracy=0.01, threads=n) for n in (1, 2, 3)]
    assert np.array_equal(images[0], images[1])
    assert np.array_equal(images[0], images[2])


def test_channels_are_separate_sums():
    positions = np.concatenate([random_positions(4), lattice_positions(2, 240.0)])
    weights = np.random.default_rng(3).uniform(0, 1, (len(positions), 3))
    weights[::2, 1] = 0
    image = incoherent_sum(SMALL, positions, weights, wavelength=633, accuracy=0.01)
    assert image.shape == (512, 512, 3)
    for channel in range(3):
        alone = incoherent_sum(SMALL, positions, weights[:, channel], wavelength=633, accuracy=0.01)
        assert error(image[..., channel], alone) < 3e-3


def test_crop_is_a_part_of_the_whole():
    positions = random_positions(8)
    whole = incoherent_sum(SMALL, positions, np.ones(8), wavelength=633)
    crop = SMALL.replace(crop_offset=(130, 201), crop_size=(150, 101))
    part = incoherent_sum(crop, positions, np.ones(8), wavelength=633)
    assert error(part, whole[201:302, 130:280]) < 1e-5


def test_radiators_out_of_sight_give_nothing():
    assert not incoherent_sum(SMALL, [(50.0, 0.0, 240.0)], [1.0], wavelength=633).any()
    assert not incoherent_sum(SMALL, np.zeros((0, 3)), np.zeros(0), wavelength=633).any()


def test_masks_block_a_part_of_the_pupil():
    """Half the pupil of a blurred point lights half of its image, with all of the power."""
    position = np.array([[0.0, 0.0, 210.0]])
    masks = np.zeros((1, 8, 8), bool)
    masks[:, :, 4:] = True  # the half at +x
    half = incoherent_sum(SMALL, position, [1.0], wavelength=633, pupil_masks=masks)
    full = incoherent_sum(SMALL, position, [1.0], wavelength=633)
    assert half.sum() == pytest.approx(full.sum(), rel=0.01)
    # the image is nearer than the focus: a ray from +x still is at +x
    assert half[:, 256:].sum() > 0.95 * half.sum()
    rows = np.ones((1, 8, 8), bool)
    rows[:, 4:, :] = False
    assert incoherent_sum(SMALL, position, [1.0], wavelength=633, pupil_masks=rows)[:256].sum() > 0.95 * half.sum()
    opened = incoherent_sum(SMALL, position, [1.0], wavelength=633, pupil_masks=np.ones((1, 8, 8), bool))
    assert error(opened, full) < 1e-6


def test_masks_keep_patterns_apart():
    positions = lattice_positions(3, 210.0, per_lens=1)
    masks = np.ones((len(positions), 4, 4), bool)
    masks[0, :, 2:] = False
    image = incoherent_sum(SMALL, positions, np.ones(9), wavelength=633, pupil_masks=masks)
    expected = sum(
        incoherent_sum(SMALL, positions[i : i + 1], [1.0], wavelength=633, pupil_masks=masks[i : i + 1])
        for i in range(9)
    )
    assert error(image, expected) < 0.01


def test_progress_counts_every_radiator():
    calls = []
    positions = np.concatenate([random_positions(10), [(50.0, 0.0, 240.0)]])
    incoherent_sum(SMALL, positions, np.ones(11), wavelength=633, progress=lambda *call: calls.append(call))
    assert calls[0] == (1, 11)
    assert calls[-1] == (11, 11)
    assert [done for done, _ in calls] == sorted(done for done, _ in calls)


def test_the_estimate_is_of_the_right_size():
    cost = estimate_cost(SMALL, random_positions(30), wavelength=633)
    assert cost.radiators == cost.patterns == 30
    assert 0 < cost.seconds < 60
    assert 0 < cost.memory < 2**32


@pytest.mark.parametrize(
    "change, word",
    [
        ({"positions": np.zeros((2, 2))}, "positions of shape"),
        ({"positions": [(0, 0, 240), (0, np.nan, 240)]}, "position"),
        ({"positions": [(0, 0, 240), (0, 0, 0)]}, "position.*greater than 0"),
        ({"weights": np.ones(3)}, "weights of shape"),
        ({"weights": [1.0, -1.0]}, "weights"),
        ({"wavelength": 0}, "wavelength"),
        ({"method": "rays"}, "method"),
        ({"accuracy": "best"}, "accuracy"),
        ({"accuracy": -0.1}, "accuracy.*from 0"),
        ({"accuracy": 1}, "accuracy.*below 1"),
        ({"pupil_masks": np.ones((2, 4, 5), bool)}, "pupil_masks"),
        ({"pupil_masks": np.ones((2, 4, 4))}, "pupil_masks"),
        ({"pupil_masks": np.ones((2, 4, 4), bool), "method": "full_field"}, "pupil_masks"),
    ],
)
def test_mistakes(change, word):
    arguments = {"positions": [(0, 0, 240), (1, 0, 240)], "weights": [1.0, 1.0], "wavelength": 633} | change
    with pytest.raises(InputError, match=f"^{word}"):
        incoherent_sum(SMALL, **arguments)


def test_more_memory_than_allowed_is_refused_with_the_estimate(monkeypatch):
    monkeypatch.setattr("mitsuba_plenoptic.optics.sampling.MEMORY_LIMIT", 2**20)
    with pytest.raises(InputError, match=r"1 radiators by patches.*GiB"):
        incoherent_sum(SMALL, [(0.0, 0.0, 240.0)], [1.0], wavelength=633)


def test_many_radiators_at_infinity_are_refused():
    """Their blur of 5 mm covers 2,500 pixels; a few are allowed."""
    camera = PlenopticCamera()
    x = np.random.default_rng(0).uniform(-2e5, 2e5, (100, 2))
    positions = np.column_stack([x, np.full(100, 1e7)])
    with pytest.raises(InputError, match=r"^100 radiators by patches.*GiB"):
        incoherent_sum(camera, positions, np.ones(100), wavelength=633)
