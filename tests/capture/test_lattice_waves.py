"""Waves through microlens lattices of every kind: orders, point spreads, captures, and the way back."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from mitsuba_plenoptic.capture.incoherent import estimate_cost, incoherent_sum
from scipy.special import j1

from mitsuba_plenoptic import PlenopticCamera, reconstruct, render_capture
from mitsuba_plenoptic.capture.pixels import turn_samples
from mitsuba_plenoptic.capture.point_spread import point_spread_function
from mitsuba_plenoptic.optics.microlenses import PlaneTransmission, orders, period, plane_orders
from mitsuba_plenoptic.reconstruction.full_fields import reconstruct_subsets
from mitsuba_plenoptic.reconstruction.lens_by_lens import reconstruct_lens_by_lens
from mitsuba_plenoptic.reconstruction.spread import over_lenses
from mitsuba_plenoptic.reconstruction.white import white_throughput
from mitsuba_plenoptic.runtime.backend import array_module

WAVELENGTH = 633.0
SMALL = PlenopticCamera(detector_width=0.768, resolution=(384, 384))
LATTICES = {
    "hexagonal": {"mla_lattice": "hexagonal"},
    "turned": {"mla_rotation": 7.0, "mla_offset": (0.01, -0.02)},
    "circles": {"mla_lattice": "hexagonal", "mla_rotation": 11.0, "mla_aperture": "circle", "mla_fill": 0.95},
    "gaps": {"mla_fill": 0.8},
    "three kinds": {"mla_lattice": "hexagonal", "mla_focal_length": (0.44, 0.512, 0.6), "mla_offset": (0.013, 0.0)},
}
WAVES = [
    {"method": "coherent"},
    {"method": "partial", "interleave": 2},
    {"method": "partial", "interleave": "auto"},
]

lattices = pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES.keys())


def error(image, reference):
    return np.linalg.norm(image - reference) / np.linalg.norm(reference)


def turned(positions, degrees):
    """Turn scene points counter-clockwise about the axis."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y, g = positions.T
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y, g])


def scattered(count=5, seed=0):
    rng = np.random.default_rng(seed)
    g = rng.uniform(225.0, 255.0, count)
    return np.column_stack([rng.uniform(-0.25, 0.25, (count, 2)) * -g[:, None] / SMALL.mla_distance, g])


def lens_steps(camera, i, j):
    """Places on the MLA at i and j steps along the lattice vectors from the centre of lens (0, 0)."""
    (ax, ay), (bx, by) = camera.lattice.basis
    cx, cy = camera.lattice.centre(0.0, 0.0)
    return np.stack([cx + i * ax + j * bx, cy + i * ay + j * by], axis=-1)


def white_capture(camera):
    """Sharp discs about the true centres."""
    b, z = camera.mla_distance, camera.detector_distance
    px, py = camera.pixel_coordinates(0)[None, :], camera.pixel_coordinates(1)[:, None]
    cx, cy = camera.lattice.centre(*camera.lattice.cell(px * b / (b + z), py * b / (b + z)))
    distance = np.hypot(px - cx * (b + z) / b, py - cy * (b + z) / b)
    return np.clip((camera.micro_image_diameter / 2 - distance) / camera.pixel_size + 0.5, 0, 1).astype(np.float32)


# -- the transmission --------------------------------------------------------------------------------


def test_orders_of_a_square_lattice_are_those_of_two_axes():
    plane = plane_orders(SMALL, WAVELENGTH, 0.2)
    single = orders(SMALL, WAVELENGTH, plane.shape[0] // 2)
    assert np.allclose(plane, np.outer(single, single) * (plane != 0), atol=1e-6)


def test_orders_of_holes_are_airy_patterns():
    """Lenses of hardly any power on a hexagonal lattice, whose reciprocal lattice is hexagonal, too."""
    camera = SMALL.replace(mla_lattice="hexagonal", mla_aperture="circle", mla_fill=0.9, mla_focal_length=1e6)
    found = plane_orders(camera, WAVELENGTH, 0.2)
    q = [np.arange(size) - size // 2 for size in found.shape]
    width, height = period(camera)
    argument = np.pi * 0.9 * camera.mla_pitch * np.hypot(q[1] / width, q[0][:, None] / height)
    with np.errstate(invalid="ignore"):
        airy = np.where(argument == 0, 1, 2 * j1(argument) / argument)
    there = (q[0][:, None] + q[1]) % 2 == 0
    expected = camera.lattice.lens_area / camera.lattice.cell_area * airy * there * (found != 0)
    # a lens's centre is on the axis, so that there is no other phase
    assert np.abs(found - expected).max() < 3e-4
    assert np.abs(found[~there]).max() < 1e-5


@lattices
def test_orders_are_converged_and_hold_the_light(lattice):
    camera = SMALL.replace(**lattice)
    found = plane_orders(camera, WAVELENGTH, 0.35)
    assert error(found, plane_orders(camera, WAVELENGTH, 0.35, fine=1234)) < 3e-3
    open_part = camera.lattice.lens_area / camera.lattice.cell_area
    # what is missing goes farther, about an edge's share of the inverse of the angle
    assert 0.985 * open_part < (np.abs(found) ** 2).sum() < 1.001 * open_part


@lattices
def test_transmission_is_the_sum_of_its_orders(lattice):
    camera = SMALL.replace(**lattice)
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 500))
    types = array_module()
    found = PlaneTransmission(camera, WAVELENGTH, 0.2).at(types.Float64(x), types.Float64(y))
    amplitudes = plane_orders(camera, WAVELENGTH, 0.2)
    angle = np.radians(camera.mla_rotation)
    x, y = x - camera.mla_offset[0], y - camera.mla_offset[1]
    x, y = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    along_x, along_y = (
        np.exp(2j * np.pi * np.outer(place, np.arange(size) - size // 2) / side)
        for place, size, side in zip((x, y), amplitudes.shape[::-1], period(camera), strict=True)
    )
    expected = np.einsum("kj,ji,ki->k", along_y, amplitudes, along_x)
    assert error(np.array(found.real) + 1j * np.array(found.imag), expected) < 1e-3


def test_samples_of_a_turned_grid():
    """A sum of waves that the grid holds, known everywhere."""
    rng = np.random.default_rng(3)
    waves = rng.uniform(-0.3, 0.3, (12, 2)) / 1.1e-3

    def intensity(x, y):
        return np.cos(2 * np.pi * (waves[:, 0] * x[..., None] + waves[:, 1] * y[..., None])).sum(-1)

    pitch, origin = (1.1e-3, 1.05e-3), (-0.11, -0.1)
    x, y = (start + step * np.arange(200) for start, step in zip(origin, pitch, strict=True))
    held = intensity(*np.meshgrid(x, y)).astype(np.float32)
    image = turn_samples(held, pitch, origin, 33.0, 1.3e-3, (-0.05, -0.04), (60, 70))
    x, y = np.meshgrid(-0.05 + 1.3e-3 * np.arange(70), -0.04 + 1.3e-3 * np.arange(60))
    back = np.radians(-33.0)
    expected = intensity(np.cos(back) * x - np.sin(back) * y, np.sin(back) * x + np.cos(back) * y)
    assert error(image, expected) < 2e-3


# -- point spreads and their sums --------------------------------------------------------------------


@lattices
@pytest.mark.parametrize(
    "position", [(0.2, -0.1, 225.0), pytest.param((-0.1, 0.2, 240.0), marks=pytest.mark.slow)], ids=["blurred", "sharp"]
)
def test_patch_against_full_field(lattice, position):
    camera = SMALL.replace(**lattice)
    full = point_spread_function(camera, position, wavelength=WAVELENGTH, method="full_field")
    assert error(point_spread_function(camera, position, wavelength=WAVELENGTH), full) < 0.01


@pytest.mark.slow
@lattices
@pytest.mark.parametrize("position", [(-5.2, 5.1, 210.0), (8.5, 3.0, 280.0)])
def test_patch_against_full_field_at_the_rim(lattice, position):
    camera = PlenopticCamera(crop_offset=(1024, 1024), crop_size=(2048, 2048)).replace(**lattice)
    x, y, g = position
    full = point_spread_function(camera, (x / 2, y / 2, g), wavelength=WAVELENGTH, method="full_field")
    assert error(point_spread_function(camera, (x / 2, y / 2, g), wavelength=WAVELENGTH), full) < 0.01


def test_a_hexagonal_lattice_is_the_same_after_a_sixth_of_a_turn():
    camera = SMALL.replace(mla_lattice="hexagonal")
    positions = scattered()
    image = incoherent_sum(camera, positions, np.ones(5), wavelength=WAVELENGTH)
    again = incoherent_sum(camera.replace(mla_rotation=60.0), positions, np.ones(5), wavelength=WAVELENGTH)
    assert error(again, image) < 2e-3


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_scene_and_lattice_turn_together(kind):
    camera = SMALL.replace(mla_lattice=kind, mla_offset=(0.011, 0.0))
    positions = scattered()
    image = incoherent_sum(camera, positions, np.ones(5), wavelength=WAVELENGTH)
    around = camera.replace(mla_rotation=90.0, mla_offset=(0.0, 0.011))
    again = incoherent_sum(around, turned(positions, 90), np.ones(5), wavelength=WAVELENGTH)
    # rows grow with y and columns with x: from x to y is from columns to rows
    assert error(again, np.rot90(image, -1)) < 1e-3


def test_pupil_masks_do_not_turn_with_the_lattice():
    camera = SMALL.replace(mla_rotation=90.0)
    masks = np.zeros((5, 16, 16), bool)
    masks[:, :, 8:] = True
    image = incoherent_sum(SMALL, scattered(), np.ones(5), wavelength=WAVELENGTH, pupil_masks=masks)
    again = incoherent_sum(camera, scattered(), np.ones(5), wavelength=WAVELENGTH, pupil_masks=masks)
    assert error(again, image) < 2e-3


@pytest.mark.parametrize("name", ["hexagonal", "three kinds"])
def test_shared_patterns_stay_true(name):
    """One pattern for all lenses of a kind in a zone, against a propagation of every radiator."""
    camera = SMALL.replace(**LATTICES[name])
    i, j = (index.ravel() for index in np.mgrid[-4:0, 0:4] + np.array([0.2, 0.3])[:, None, None])
    positions = np.column_stack([lens_steps(camera, i, j) * -240.0 / camera.mla_distance, np.full(i.size, 240.0)])
    weights = np.random.default_rng(1).uniform(0, 1, i.size)
    kinds = len(camera.mla_focal_lengths)
    assert estimate_cost(camera, positions, wavelength=WAVELENGTH, accuracy=0.05).patterns <= 2 * kinds
    shared = incoherent_sum(camera, positions, weights, wavelength=WAVELENGTH, accuracy=0.05)
    every = incoherent_sum(camera, positions, weights, wavelength=WAVELENGTH, accuracy=0)
    assert 0 < error(shared, every) < 0.02


@pytest.mark.parametrize(
    "name", ["circles", *(pytest.param(name, marks=pytest.mark.slow) for name in ("hexagonal", "turned"))]
)
def test_wave_and_ray_captures_hold_the_same_energy(camera_dict, name):
    lattice = {k: ", ".join(map(str, v)) if isinstance(v, tuple) else v for k, v in LATTICES[name].items()}
    wall = {
        "type": "disk",
        "to_world": mi.ScalarTransform4f().translate([0.1, -0.05, 250]).rotate([0, 1, 0], 180).scale(0.4),
        "emitter": {"type": "area", "radiance": 1.0},
    }
    sensor = camera_dict(**lattice)
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "camera": sensor, "wall": wall})
    ray = render_capture(scene, spp=64)
    wave = render_capture(scene, model="wave", spp=1, radiators_per_lens=4)
    assert wave.image.sum() == pytest.approx(ray.image.sum(), rel=0.02)


# -- and back ----------------------------------------------------------------------------------------


def test_routes_of_two_axes_and_of_one_agree():
    """A quarter of a turn changes nothing on a square lattice but the way that its fields take."""
    camera = SMALL.replace(mla_rotation=90.0)
    image = incoherent_sum(SMALL, scattered(), np.ones(5), wavelength=WAVELENGTH)
    for interleave in (1, 2):
        one, two = (reconstruct_subsets(image, c, [230.0], WAVELENGTH, interleave=interleave) for c in (SMALL, camera))
        assert error(two[0], one[0]) < 2e-3
    one, two = (reconstruct_lens_by_lens(image, c, [230.0], WAVELENGTH) for c in (SMALL, camera))
    assert error(two[0], one[0]) < 2e-3
    assert white_throughput(camera, WAVELENGTH) == pytest.approx(white_throughput(SMALL, WAVELENGTH), abs=0.01)


@lattices
def test_single_lenses_are_full_fields_of_one_lens(lattice):
    camera = SMALL.replace(**lattice)
    px, py = (camera.pixel_coordinates(axis) for axis in (0, 1))
    i, j = camera.lattice.cell(0.09, -0.12)
    cx, cy = camera.lattice.centre(i, j)
    image = (np.hypot(px - cx, py[:, None] - cy) < 0.016).astype(np.float32)
    for distance in (225.0, 240.0):
        full, single = (
            over_lenses(route(image, camera, [distance], WAVELENGTH, oversample=9)[0], camera, 1, 9)
            for route in (reconstruct_subsets, reconstruct_lens_by_lens)
        )
        assert single.sum() == pytest.approx(full.sum(), rel=0.01)
        assert error(single, full) < 0.02


@pytest.mark.parametrize(
    "name", ["hexagonal", *(pytest.param(name, marks=pytest.mark.slow) for name in ("turned", "circles", "gaps"))]
)
def test_a_white_capture_reads_one(name):
    camera = PlenopticCamera(detector_width=1.28, resolution=(640, 640), **LATTICES[name])
    white = white_capture(camera)
    for options in WAVES:
        for result in reconstruct(white, [228.0, 240.0], camera=camera, wavelength=WAVELENGTH, **options):
            middle = result.image[5:-5, 5:-5]
            # Sharp micro-images are not what waves record: one wave of them interferes the most.
            assert middle.mean() == pytest.approx(1, abs=0.02 if options["method"] == "coherent" else 0.01)
            assert middle.std() < 0.03


@pytest.mark.parametrize("options", [{"method": "ray"}, *WAVES], ids=lambda o: str(list(o.values())))
@pytest.mark.parametrize("name", ["hexagonal", "three kinds", pytest.param("turned", marks=pytest.mark.slow)])
def test_forward_then_back_lands_where_the_point_is(name, options):
    camera = SMALL.replace(**LATTICES[name])
    for (x, y), distance in (((0.13, -0.08), 228.0), ((-0.1, 0.12), 240.0)):
        # in focus a lens is the finest that can be told
        cx, cy = camera.lattice.centre(*camera.lattice.cell(x, y))
        position = (-cx * distance / camera.mla_distance, -cy * distance / camera.mla_distance, distance)
        spread = point_spread_function(camera, position, wavelength=WAVELENGTH)
        image = reconstruct(spread, distance, camera=camera, wavelength=WAVELENGTH, **options).image
        row, column = np.unravel_index(image.argmax(), image.shape)
        near = image[row - 1 : row + 2, column - 1 : column + 2].astype(float)
        near -= min(near.min(), 0.2 * near.max())
        rows, columns = np.mgrid[row - 1 : row + 2, column - 1 : column + 2] + 0.5 - 6
        assert (near * columns).sum() / near.sum() == pytest.approx(cx / camera.mla_pitch, abs=0.25)
        assert (near * rows).sum() / near.sum() == pytest.approx(cy / camera.mla_pitch, abs=0.25)


def test_one_subset_is_the_coherent_field():
    camera = SMALL.replace(**LATTICES["hexagonal"])
    image = white_capture(camera)
    coherent, partial = (
        reconstruct(image, 235.0, camera=camera, wavelength=WAVELENGTH, **options).image
        for options in ({"method": "coherent"}, {"method": "partial", "interleave": 1})
    )
    assert np.array_equal(coherent, partial)


def test_far_subsets_are_the_limit_of_single_lenses():
    """On a hexagonal lattice, with the subsets taken along its own vectors."""
    camera = SMALL.replace(**LATTICES["hexagonal"])
    image = incoherent_sum(camera, scattered(), np.ones(5), wavelength=WAVELENGTH)
    images = [reconstruct_subsets(image, camera, [235.0], WAVELENGTH, interleave=period)[0] for period in (1, 4)]
    limit = reconstruct_lens_by_lens(image, camera, [235.0], WAVELENGTH)[0]
    assert error(images[1], limit) < 0.02 < error(images[0], limit)
