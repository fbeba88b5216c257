"""Refocusing through microlens arrays of every kind: back to where the light came from, with its energy."""

import numpy as np
import pytest
from cameras import HALF, LATTICES, WAVELENGTH, capture, error, scattered, small_camera

from mitsuba_plenoptic import PlenopticCamera, reconstruct
from mitsuba_plenoptic.refocus import lens_by_lens
from mitsuba_plenoptic.refocus.lens_by_lens import reconstruct_lens_by_lens
from mitsuba_plenoptic.refocus.radiance import over_lenses
from mitsuba_plenoptic.refocus.wave_methods import reconstruct_subsets
from mitsuba_plenoptic.views import white_image

SMALL = small_camera(12, **HALF)
SCATTERED = scattered(5, distances=(112.5, 127.5), image=0.4)


def white_capture(camera):
    """Sharp discs about the true centres."""
    b, z = camera.mla_distance, camera.detector_distance
    px, py = camera.pixel_coordinates(0)[None, :], camera.pixel_coordinates(1)[:, None]
    cx, cy = camera.lattice.centre(*camera.lattice.cell(px * b / (b + z), py * b / (b + z)))
    distance = np.hypot(px - cx * (b + z) / b, py - cy * (b + z) / b)
    return np.clip((camera.micro_image_diameter / 2 - distance) / camera.pixel_size + 0.5, 0, 1).astype(np.float32)


def test_an_array_next_to_the_upright_one_gives_next_to_the_same_image():
    """Out of focus, where light reaches all bins without being spread over lenses; by ways of one axis and of two."""
    image, turned = np.maximum(capture(SMALL, SCATTERED, np.ones(5)), 0), SMALL.replace(mla_rotation=1e-6)
    for interleave in (1, 2, "auto"):
        options = {"method": "partial", "wavelength": WAVELENGTH, "interleave": interleave}
        one, two = (reconstruct(image, 112.5, camera=c, **options).image for c in (SMALL, turned))
        assert error(np.nan_to_num(two), np.nan_to_num(one)) < 0.01


@pytest.mark.parametrize("blur", [8.1, 16.0])
def test_lenses_out_of_focus_take_fewer_samples(blur, monkeypatch):
    """Sums over lenses are those of fine samples, which are taken in focus, and where bins are shown as they are."""
    camera = SMALL.replace(mla_lattice="hexagonal")
    nearness = 1 / camera.focal_length - 1 / camera.mla_distance
    nearness += blur * camera.row_pitch / camera.aperture_diameter / camera.mla_distance
    px, py = (camera.pixel_coordinates(axis) for axis in (0, 1))
    image = (white_capture(camera) * (1.2 + np.sin(30 * px) * np.sin(50 * py[:, None]))).astype(np.float32)
    sums = []
    for least in (8.0, np.inf):
        monkeypatch.setattr(lens_by_lens, "_BLURRED", least)
        fine = reconstruct_lens_by_lens(image, camera, [1 / nearness], WAVELENGTH, oversample=9)[0]
        sums.append(over_lenses(fine, camera, 1, 9, 0.0))
    assert 0 < error(*sums) < 5e-4
    monkeypatch.undo()
    beyond = [1 / nearness]
    blurred, sharp, shown = (
        lens_by_lens.reconstruction_tile(kind, WAVELENGTH, distances, 9).samples
        for kind, distances in ((camera, beyond), (camera, [*beyond, camera.focus_distance]), (SMALL, beyond))
    )
    assert sharp == shown >= (3 if blur > 9 else 2) * blurred


@pytest.mark.parametrize("name", ["turned", "rectangular", "stretched", "three focal lengths"])
def test_single_lenses_are_full_fields_of_one_lens(name):
    camera = SMALL.replace(**LATTICES[name])
    px, py = (camera.pixel_coordinates(axis) for axis in (0, 1))
    i, j = camera.lattice.cell(0.09, -0.12)
    cx, cy = camera.lattice.centre(i, j)
    image = (np.hypot(px - cx, py[:, None] - cy) < 0.016).astype(np.float32)
    for distance in (112.5, 120.0):
        full, single = (
            over_lenses(route(image, camera, [distance], WAVELENGTH, oversample=9)[0], camera, 1, 9)
            for route in (reconstruct_subsets, reconstruct_lens_by_lens)
        )
        assert single.sum() == pytest.approx(full.sum(), rel=0.02)
        # in focus it is the sharp edge of a lens that falls on the samples
        assert error(single, full) < 0.03


def test_far_subsets_are_the_limit_of_single_lenses():
    """On a hexagonal lattice, with the subsets taken along its own vectors."""
    camera = SMALL.replace(**LATTICES["hexagonal"])
    image = np.maximum(capture(camera, SCATTERED, np.ones(5)), 0)
    images = [reconstruct_subsets(image, camera, [115.0], WAVELENGTH, interleave=period)[0] for period in (1, 4)]
    limit = reconstruct_lens_by_lens(image, camera, [115.0], WAVELENGTH)[0]
    assert error(images[1], limit) < 0.006 < 0.012 < error(images[0], limit)


MATCHED = PlenopticCamera.matched(
    f_number=2.8, lenses=20, pixels_per_lens=10, pixel_size=0.005, focal_length=50, focus_distance=320,
    mla_lattice="hexagonal",
)  # fmt: skip


@pytest.mark.slow
def test_white_of_hexagonal_lenses_has_no_rows():
    """A white wall refocused lens by lens is even, with rows of lenses at any height between the rows of pixels."""
    options = {"method": "partial", "interleave": "auto", "wavelength": 550.0, "camera": MATCHED}
    wall = reconstruct(white_image(MATCHED), 320.0, **options).image[6:-6, 6:-6]
    assert wall.mean() == pytest.approx(1, abs=0.02)
    assert wall.mean(1).std() < 1.5e-3 and wall.mean(0).std() < 5e-4
