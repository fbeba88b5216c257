"""Captures behind lenses of a few wavelengths, against exact sums, rays, and closed forms."""

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import InputError, PlenopticCamera, render_capture
from mitsuba_plenoptic.capture.response_draws import _from_half, _quantiles
from mitsuba_plenoptic.capture.responses import Grid, ResponseSum
from mitsuba_plenoptic.capture.signed_colours import Node
from mitsuba_plenoptic.system import photodiodes, response_tables
from mitsuba_plenoptic.system.phase_space import has_small_lenses
from mitsuba_plenoptic.system.photodiodes import pixels_per_lens
from mitsuba_plenoptic.system.response_tables import PhotodiodeResponses
from tools.bench.cases.photodiodes import Wall, camera_of
from tools.bench.scenes.light_paths import facing, radiating, scene_of


@pytest.fixture(autouse=True)
def small_tables(monkeypatch):
    monkeypatch.setattr(photodiodes, "_STEPS", (6.0, 20.0))
    monkeypatch.setattr(response_tables, "_FAR", (10, 20))


def test_tables_keep_the_light_of_each_direction_and_mirror_it():
    plan = PhotodiodeResponses(camera_of(4.0, 4), 550.0)
    nodes, near, far, means = plan.table
    middle = nodes[plan.across, plan.across]
    # Integrals of both tables, the far one less its part below the near one.
    inside = np.abs(plan.far.place) <= plan.near.lenses / 2
    rest = far[0, middle].astype(float)
    rest[np.ix_(inside, inside)] = 0
    edges = np.ones(plan.near.across)
    edges[[0, -1]] = 0.5
    whole = np.einsum("y,x,yxd->d", edges, edges, near[0, middle].astype(float)) / plan.near.samples**2
    whole += rest[1:, 1:].sum((0, 1)) / plan.far.samples**2
    by_direction = plan.by_direction(-0.5, -0.5) / plan.camera.mla_pitch**2
    centre = by_direction.shape[1] // 2
    assert whole == pytest.approx(by_direction[:, centre, centre], rel=0.03)
    assert means.sum() == pytest.approx(1, rel=0.01)
    right, left = (
        near[0, nodes[plan.across, plan.across + side], :, :, column::2].sum(dtype=float)
        for side, column in ((1, 1), (-1, 0))
    )
    assert right == pytest.approx(left, rel=1e-3)


def test_each_cell_of_the_far_window_can_be_drawn():
    """Also for directions without response, as nodes that only some zones use have."""
    plan = PhotodiodeResponses(camera_of(4.0, 4), 550.0)
    plan.table.far[0, 0] = 0
    drawn = _quantiles(plan)
    for row in drawn[:2]:
        cells, counts = np.unique(row >> 16, return_counts=True)
        assert len(cells) == plan.far.lenses**2
        np.testing.assert_array_equal(counts[row >> 16], row & 0xFFFF)
    assert len(drawn) == plan.table.far.shape[1] + 1


def test_half_precision_is_read_exactly():
    values = np.array([0.0, 1.0, -2.5, 6e-8, -3e-5, 65504.0, 0.333], np.float16)
    words = mi.UInt32(values.view(np.uint16).astype(np.uint32) << 16)
    assert _from_half(words).numpy().tolist() == values.astype(np.float32).tolist()


def test_far_sums_have_the_mean_of_all_rays():
    """Of a blurred wall; lenses of the far window are drawn, and here the rays of all of them are added."""
    camera = camera_of(4.0, 2)
    plan = PhotodiodeResponses(camera, 550.0)
    wall = Wall(camera, 550.0, 4.0)
    work = ResponseSum(camera, wall.light, [Node(plan, (0,), np.ones((1, 1)))], spp=16, seed=0)
    window, margin, size = plan.far, work._tables.margin, plan.far.across
    grid = Grid(-1, -1, 2, 2)
    rays = work._traced(*grid.within(margin).lenses(), 0)
    table = np.pad(plan.table.far[0].astype(float), [(0, 1), (0, 0), (0, 0), (0, 0)]).reshape(-1, 4)
    light, first = rays.lights[0].numpy(), rays.far[0].numpy()
    expected = np.zeros((2, 2, 4))
    for ray in np.flatnonzero(light):
        at = np.array(divmod(ray // work._rays, 2 + 2 * margin)) - margin
        for target in np.ndindex(2, 2):
            cell = at - target
            if np.abs(cell).max() > 2 and cell.min() >= window.first and cell.max() < window.first + window.lenses:
                y, x = (cell - window.first) * window.samples
                expected[target] += light[ray] * table[first[ray] + y * size + x]
    nothing = [[mi.Float(np.zeros(4, np.float32))] * 2]
    seeds = range(0, 64 * 300, 64)
    draws = [[part.numpy() for part in work._far_sums(grid, rays, nothing, seed)] for seed in seeds]
    drawn = np.mean(draws, axis=0)
    drawn = drawn.T.reshape(2, 2, 4)
    assert np.linalg.norm(expected) > 0
    assert np.linalg.norm(drawn - expected) < 0.15 * np.linalg.norm(expected)


def test_light_passes_to_the_other_side_by_the_orders_of_the_lens():
    plan = PhotodiodeResponses(camera_of(1.8, 4), 550.0)
    light = plan.by_direction(-0.5, -0.5)
    area, far = plan.camera.mla_pitch**2, light.shape[1] // 2
    # Lenses without gaps lose only evanescent light.
    assert light.sum(0) / area == pytest.approx(np.ones(light.shape[1:]), abs=0.01)
    right, left = light[1] + light[3], light[0] + light[2]
    assert right[far, far] == pytest.approx(left[far, far], rel=1e-4)
    # Light that comes from the left, at 8 degrees.
    aside = round(0.139 / plan.step)
    assert right[far, far + aside] > 6 * left[far, far + aside]
    assert right[far, far - aside] == pytest.approx(left[far, far + aside], rel=1e-3)


@pytest.mark.slow
def test_the_mean_of_captures_agrees_with_exact_sums():
    wall = Wall(camera_of(8.0, 18), 650.0, 0.0)
    plan = PhotodiodeResponses(wall.camera, 650.0)
    exact, mean = wall.exact(), wall.expected(plan)
    assert np.linalg.norm(mean - exact) < 0.01 * np.linalg.norm(exact)
    assert mean.sum() == pytest.approx(exact.sum(), rel=0.01)


@pytest.mark.slow
def test_drawn_rays_have_the_expected_mean():
    wall = Wall(camera_of(1.8, 6), 550.0, 0.0)
    plan = PhotodiodeResponses(wall.camera, 550.0)
    mean = wall.expected(plan)
    drawn = np.mean([wall.captured(plan, 4096, seed) for seed in range(4)], axis=0)
    assert np.linalg.norm(drawn - mean) < 0.02 * np.linalg.norm(mean)


@pytest.mark.slow
@pytest.mark.parametrize("aside", [0, 1600], ids=["on the axis", "off the axis"])
def test_a_white_wall_is_even_and_as_bright_as_by_rays(aside):
    camera = camera_of(2.0, 2000).replace(crop_offset=(1992 - aside, 1992), crop_size=(16, 16))
    wall = facing(200.0, 300.0, **radiating())
    image = render_capture(scene_of(camera.to_sensor(), wall=wall), model="wave", wavelength=550.0, spp=16).image
    # Without diffraction, micro-images of the pupil fill this part of the lenses.
    part = np.pi * (camera.aperture_radius * 0.004 / 1.5 / camera.mla_distance) ** 2 / camera.mla_pitch**2
    assert image.mean() == pytest.approx(part, rel=0.01)
    right, left = image[:, 1::2], image[:, ::2]
    assert right.std() < 0.002 * right.mean()
    # Off the axis, at the lens's position over the distance from the pupil, chief rays are inclined to one side.
    split = (right.mean() - left.mean()) / image.mean()
    assert split == pytest.approx(0.0, abs=1e-3) if aside == 0 else split < -0.05


def test_zones_shift_photodiodes_with_a_pitch_that_is_no_whole_number_of_pixels():
    even = camera_of(2.0, 40)
    camera = even.replace(mla_pitch=even.mla_pitch * 0.998)
    zones = PhotodiodeResponses(camera, 550.0).zones
    assert pixels_per_lens(camera) == 2
    assert len(zones) == 16
    assert len(PhotodiodeResponses(even, 550.0).zones) == 1


def test_gaps_between_lenses_leave_the_brightness_of_a_wall():
    wall = facing(200.0, 300.0, **radiating())
    sensors = [camera_of(4.0, 8).replace(mla_fill=fill).to_sensor() for fill in (1.0, 0.7)]
    options = {"model": "wave", "wavelength": 550.0, "spp": 16}
    means = [render_capture(scene_of(sensor, wall=wall), **options).image.mean() for sensor in sensors]
    # Apertures with gaps scatter some light to directions that do not propagate.
    assert 0.93 * means[0] < means[1] < means[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mla_lattice": "hexagonal"}, "mla_lattice = 'hexagonal'"),
        ({"mla_rotation": 3.0}, "mla_rotation = 3.0"),
        ({"mla_aperture": "circle"}, "mla_aperture = 'circle'"),
        ({"mla_pitch": 0.0024}, "half a pitch"),
    ],
)
def test_what_responses_do_not_describe_is_refused_by_name(changes, message):
    with pytest.raises(InputError, match=message):
        pixels_per_lens(camera_of(2.0, 40).replace(**changes))


def test_only_lenses_of_a_few_wavelengths_need_responses():
    assert has_small_lenses(camera_of(2.0, 4), 550.0)
    assert not has_small_lenses(PlenopticCamera(), 550.0)
