"""Captures behind lenses of a few wavelengths, against exact sums, rays, and closed forms."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import facing, radiating, scene_of
from refusals import refused

from mitsuba_plenoptic import render_capture
from mitsuba_plenoptic.array import Conic, Sampled
from mitsuba_plenoptic.extensions.onchip import plane_waves as photodiodes
from mitsuba_plenoptic.extensions.onchip import response_tables
from mitsuba_plenoptic.extensions.onchip.plane_waves import Zones, pixels_per_lens
from mitsuba_plenoptic.extensions.onchip.response_tables import PhotodiodeResponses
from mitsuba_plenoptic.extensions.onchip.responses import LensCells, ResponseSum
from mitsuba_plenoptic.waves.spectral_nodes import Node
from tools.bench.cases.photodiodes import Wall, camera_of


@pytest.fixture(autouse=True)
def small_tables(monkeypatch):
    monkeypatch.setattr(photodiodes, "_STEPS", (6.0, 20.0))
    monkeypatch.setattr(response_tables, "_FAR", (10, 20))


def by_direction(plan, x, y):
    """Light of plane waves in the photodiodes of a lens, `step` apart around the chief ray's direction, in mm^2."""
    return np.stack([(np.abs(plan.modes(x, y, diode)) ** 2).sum(0, dtype=np.float64) for diode in range(plan.count**2)])


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
    light = by_direction(plan, -0.5, -0.5) / plan.camera.mla_pitch**2
    centre = light.shape[1] // 2
    assert whole == pytest.approx(light[:, centre, centre], rel=0.03)
    assert means.sum() == pytest.approx(1, rel=0.01)
    right = near[0, nodes[plan.across, plan.across + 1], :, :, 1::2].sum(dtype=float)
    assert right == pytest.approx(near[0, nodes[plan.across, plan.across - 1], :, :, ::2].sum(dtype=float), rel=1e-3)


@pytest.mark.parametrize("name", ["parabola", "sphere", "freeform"])
def test_shaped_lenses_against_the_fields_of_periodic_samples(name):
    """A plane wave passes samples of the path of one cell, of which the others are copies, and their FFT."""
    pitch, n, lam, depth = 0.0028, 1.5, 550e-6, 0.004
    grid = np.linspace(-0.0015, 0.0015, 41)
    height = -(grid**2 + grid[:, None] ** 2) / (2 * 0.00133) * (1 + 150 * grid) - 60 * (grid**2 * grid[:, None])
    shape = {"sphere": Conic(0.0021, glass=1.6), "freeform": Sampled(height, 0.003), "parabola": None}[name]
    camera = camera_of(4.0, 4).replace(mla_shape=shape, detector_distance=depth)
    plan = PhotodiodeResponses(camera, 550.0)
    light = by_direction(plan, -0.5, -0.5)
    middle = light.shape[1] // 2
    count = 512
    x = ((np.arange(count) + 0.5) / count - 0.5) * pitch
    square = x**2 + x[:, None] ** 2
    path = {
        "parabola": -square * n / (2 * camera.mla_focal_length),
        "sphere": 0.6 * (np.sqrt(0.0021**2 - square) - 0.0021),
        # Bicubic splines reproduce polynomials of the third degree.
        "freeform": 0.5 * (-square / (2 * 0.00133) * (1 + 150 * x) - 60 * (x**2 * x[:, None])),
    }[name]
    for along in (0, 3):
        fx, fy = (np.fft.fftfreq(count, pitch / count) + part / lam for part in (along * plan.step, 0.0))
        axial = np.sqrt((n / lam) ** 2 - fx**2 - fy[:, None] ** 2 + 0j)
        transfer = np.exp(2j * np.pi * depth * axial)
        field = np.fft.ifft2(np.fft.fft2(np.exp(2j * np.pi * path / lam)) * transfer)
        energy = np.abs(field) ** 2 * (pitch / count) ** 2
        pixels = energy.reshape(2, count // 2, 2, count // 2).sum((1, 3)).ravel()
        assert light[:, middle, middle + along] == pytest.approx(pixels, rel=0.004, abs=0.002 * pitch**2)


@pytest.mark.slow
def test_zones_that_mirror_each_other_have_mirrored_tables(monkeypatch):
    monkeypatch.setattr(photodiodes, "_STEPS", (3.0, 20.0))
    monkeypatch.setattr(response_tables, "_FAR", (15, 20))
    even = camera_of(8.0, 100)
    camera = even.replace(mla_pitch=even.mla_pitch * 0.9995, resolution=(200, 8), detector_width=even.detector_width)
    plan, other = PhotodiodeResponses(camera, 550.0), PhotodiodeResponses(camera, 550.0)
    assert len(plan.zones) == 3
    made = []
    tabulate = PhotodiodeResponses.modes
    monkeypatch.setattr(PhotodiodeResponses, "modes", lambda self, *zone: made.append(zone) or tabulate(self, *zone))
    mirrored = plan.table
    assert len(made) == 2 * plan.count**2
    monkeypatch.setattr(PhotodiodeResponses, "_mirror_image", lambda *_: None)
    for one, expected in zip(mirrored[1:], other.table[1:], strict=True):
        np.testing.assert_allclose(one.astype(float), expected.astype(float), atol=2e-3 * np.abs(expected).max())
    assert len(made) == 5 * plan.count**2


def rays_of_a_blurred_wall(lenses, spp):
    """Return the responses of so many lenses across, the sum of their light, the lenses, and rays through them."""
    camera = camera_of(4.0, lenses)
    plan = PhotodiodeResponses(camera, 550.0)
    work = ResponseSum(camera, Wall(camera, 550.0, 4.0).light, [Node(plan, (0,), np.ones((1, 1)))], spp=spp, seed=0)
    grid = LensCells(-lenses // 2, -lenses // 2, lenses, lenses)
    return plan, work, grid, work._traced(*grid.within(work._tables.margin).lenses(), 0)


@pytest.mark.slow
def test_far_sums_have_the_mean_of_all_rays():
    """Lenses of the far window are drawn, and here the rays of all of them are added."""
    plan, work, grid, rays = rays_of_a_blurred_wall(2, 16)
    window, margin, size = plan.far, work._tables.margin, plan.far.across
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
    seeds = range(0, 64 * 1200, 64)
    draws = np.array([[part.numpy() for part in work._far_sums(grid, rays, nothing, seed)] for seed in seeds])
    drawn, deviation = draws.mean(0).T.reshape(2, 2, 4), np.linalg.norm(draws.std(0)) / np.sqrt(len(seeds))
    assert deviation < 0.1 * np.linalg.norm(expected)
    assert np.linalg.norm(drawn - expected) < 3 * deviation


def test_far_sums_have_the_same_bits_in_every_run():
    """Threads add the light of many rays to a lens, in an order that varies."""
    _, work, grid, rays = rays_of_a_blurred_wall(24, 64)
    nothing = [[mi.Float(np.zeros(24**2, np.float32))] * 2]
    threads = dr.thread_count()
    try:
        dr.set_thread_count(4)
        runs = [np.stack([part.numpy() for part in work._far_sums(grid, rays, nothing, 0)]) for _ in range(12)]
    finally:
        dr.set_thread_count(threads)
    assert np.abs(runs[0]).max() > 0
    assert all(np.array_equal(run, runs[0]) for run in runs)


@pytest.mark.slow
def test_the_mean_of_captures_agrees_with_exact_sums(monkeypatch):
    monkeypatch.undo()
    wall = Wall(camera_of(8.0, 18), 650.0, 0.0)
    exact, mean = wall.exact(), wall.expected(PhotodiodeResponses(wall.camera, 650.0))
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


def test_lenses_that_a_table_aligns_to_chief_rays_are_those_of_a_smaller_pitch():
    """The chief ray at the height h moves by c h on its way to the detector, as those of a pitch smaller by this."""
    camera, height = camera_of(4.0, 400), 0.8
    moved = 0.002
    heights = height * np.linspace(0, 1, 9)
    # By Snell's law at the border of the medium.
    angles = np.degrees(np.arcsin(camera.mla_medium * np.sin(np.arctan(moved * heights / camera.detector_distance))))
    table = tuple(np.stack([heights, angles], -1).ravel().tolist())
    aligned, smaller = camera.replace(mla_cra=table), camera.replace(mla_pitch=camera.mla_pitch * (1 - moved))
    plans = [PhotodiodeResponses(each, 550.0) for each in (aligned, smaller, camera)]
    one, other, plain = (by_direction(plan, 150.0, -60.0) for plan in plans)
    assert np.linalg.norm(one - other) < 0.01 * np.linalg.norm(other)
    assert np.linalg.norm(plain - other) > 0.2 * np.linalg.norm(other)
    assert len(Zones.of(aligned, 2)) == len(Zones.of(smaller, 2)) > len(Zones.of(camera, 2))


@pytest.mark.slow
def test_gaps_between_lenses_leave_the_brightness_of_a_wall():
    wall = facing(200.0, 300.0, **radiating())
    sensors = [camera_of(4.0, 8).replace(mla_fill=fill).to_sensor() for fill in (1.0, 0.7)]
    options = {"model": "wave", "wavelength": 550.0, "spp": 16}
    means = [render_capture(scene_of(sensor, wall=wall), **options).image.mean() for sensor in sensors]
    # Apertures with gaps scatter some light to directions that do not propagate.
    assert 0.93 * means[0] < means[1] < means[0]


test_what_responses_do_not_describe_is_refused_by_name = refused(
    (lambda: pixels_per_lens(camera_of(2.0, 40).replace(mla_lattice="hexagonal")), "mla_lattice = hexagonal"),
    (lambda: pixels_per_lens(camera_of(2.0, 40).replace(mla_pitch=0.0024)), "half a pitch"),
)


def test_diffraction_orders_behind_small_lenses_lose_light_along_their_directions():
    camera = camera_of(4.0, 4).replace(mla_absorption=50.0)
    light = by_direction(PhotodiodeResponses(camera, 550.0), -0.5, -0.5).sum(0)
    middle = light.shape[0] // 2
    pitch, n, lam = camera.mla_pitch, 1.5, 550e-6
    x = ((np.arange(1024) + 0.5) / 1024 - 0.5) * pitch
    orders = np.fft.fft(np.exp(-1j * np.pi * n * x**2 / (lam * 0.004))) / 1024
    sine = np.fft.fftfreq(1024, 1 / 1024) * lam / (n * pitch)
    square = sine**2 + sine[:, None] ** 2
    energy = np.abs(orders) ** 2 * np.abs(orders[:, None]) ** 2
    cosine = np.sqrt(np.where(square < 1, 1 - square, 1))
    expected = (energy * np.exp(-50 * 0.004 / cosine))[square < 1].sum() * pitch**2
    assert light[middle, middle] == pytest.approx(expected, rel=2e-3)
    assert expected < 0.995 * np.exp(-50 * 0.004) * energy[square < 1].sum() * pitch**2
