"""Wave captures of scenes whose light comes through mirrors, panes, glass and fog, or from infinity."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import WAVELENGTH, error
from cases import (
    TRANSPARENT,
    bars_through,
    by_signed_rays,
    captures,
    card_before,
    contrast,
    energy,
    half_lit,
    in_fog,
    lamp_behind_glass,
    lit_mirror,
    plastic,
    slanted,
    square_behind,
)
from scipy.ndimage import convolve1d

from mitsuba_plenoptic import design, reconstruct


@pytest.fixture(scope="module")
def bars_directly():
    mi.set_variant("llvm_ad_mono")
    return [contrast(capture, 300.0) for capture in captures(bars_through("directly", 20), 16)]


@pytest.mark.parametrize(
    "way", ["mirror", *(pytest.param(way, marks=pytest.mark.slow) for way in ("slab", "half-open mask", "fog"))]
)
def test_bars_come_back_into_focus_at_their_virtual_distance(way, bars_directly):
    by_rays, by_waves = captures(bars_through(way, 20), 16)
    assert energy(by_rays, by_waves) == pytest.approx(0.99, abs=0.015)
    rays, waves = (contrast(capture, 300.0) for capture in (by_rays, by_waves))
    directly_by_rays, directly = bars_directly
    assert waves == pytest.approx(directly * rays / directly_by_rays, abs=0.03)


def through_card(pane):
    return by_signed_rays(square_behind(pane)).image


@pytest.fixture(scope="module")
def without_card():
    mi.set_variant("llvm_ad_mono")
    return through_card(None)


@pytest.mark.parametrize("card", ["mask", pytest.param("thindielectric", marks=pytest.mark.slow)])
def test_a_transparent_card_changes_nothing(card, without_card):
    assert error(through_card(TRANSPARENT[card]), without_card) <= 0.02


def test_the_edge_of_a_surface_seen_slantwise_lies_where_rays_see_it():
    """At 5 degrees one side of the pupil gets 1.5 times the light of the other, which would move blurred edges."""
    found = captures(slanted("transparent mask"), spp=16)
    rays, waves = (capture.image.reshape(16, 16, -1).mean(axis=(1, 2))[3:11] for capture in found)
    assert (waves - rays).sum() / rays.max() == pytest.approx(0, abs=0.03)


def test_a_sky_does_not_shine_through_a_black_card():
    capture = by_signed_rays(card_before(10, 2.0, sky={"type": "constant"}), spp=16)
    columns = reconstruct(capture, 1000.0).image[4:-4].mean(axis=0)
    middle = len(columns) // 2
    assert columns[middle - 3] <= 0.03
    assert columns[middle + 2] > 0.8


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(in_fog, marks=pytest.mark.slow),
        pytest.param(lambda: lamp_behind_glass(True), marks=pytest.mark.slow),
        lambda: lit_mirror(2),
        pytest.param(lambda: plastic(6), marks=pytest.mark.slow),
    ],
    ids=["fog", "lamp behind glass, hidden", "mirror", "plastic"],
)
def test_energy_is_that_of_rays(scene):
    assert energy(*captures(scene())) == pytest.approx(0.995, abs=0.015)


def test_a_shiny_metal_lights_the_half_of_the_pupil_that_its_lamp_shines_to():
    """Rays, blurred by the diffraction of a square microlens."""
    metal = {"type": "roughconductor", "material": "none", "alpha": 0.005}
    by_rays, by_waves = captures(half_lit(metal, 0.0), spp=256)
    camera = by_rays.camera
    x = (np.arange(9 * 65) - 9 * 32 - 4) / 9 * camera.pixel_size
    spot = (np.sinc(x / design.spot_radius(camera, WAVELENGTH)) ** 2).reshape(65, 9).sum(axis=1)
    blurred = convolve1d(convolve1d(by_rays.image, spot / spot.sum(), axis=0), spot / spot.sum(), axis=1)
    inside = (slice(16, -16), slice(16, -16))
    assert error(by_waves.image[inside], blurred[inside]) <= 0.05
    shares = []
    for image in (by_waves.image, blurred):
        left, right = (half.mean() for half in np.split(image[inside].reshape(-1, 2, 8).mean(axis=0), 2))
        shares.append(max(left, right) / min(left, right))
    assert shares[1] > 3.5
    assert shares[0] == pytest.approx(shares[1], rel=0.03)
