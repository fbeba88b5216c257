"""Reconstructions of captures by cameras whose lenses are displaced or whose array is tilted, like those of others."""

import cases
import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, warped
from cases import facing, scene_of

from mitsuba_plenoptic import Capture, PlenopticCamera, example, reconstruct, render_capture
from mitsuba_plenoptic.refocus.displacement import PupilCentroid, brought_back, displacements, is_known
from mitsuba_plenoptic.refocus.straight import straightened, straightened_image
from mitsuba_plenoptic.report.photographs import thin_lens_image
from mitsuba_plenoptic.views import white_image

STRAIGHT = PlenopticCamera(**HALF, resolution=(192, 192), detector_width=0.768)
"""12 x 12 lenses of 16 x 16 pixels."""

HALF_WIDTH = 0.384
WARP = warped(STRAIGHT, 0.6, 18)[0].mla_warp
"""Up to 0.6 pixels in the corners, of fifth degree."""

FITTED = STRAIGHT.replace(
    mla_warp=WARP,
    mla_transmissions=np.random.default_rng(8).uniform(0.8, 1.2, (14, 14)),
    vignetting={"radius": [0.97, 0, 0, -0.03, 0, 0], "scale": HALF_WIDTH, "apodisation_2": [-0.2]},
)
DISTANCE = 114.0


def wall(camera):
    size = 1.3 * HALF_WIDTH * DISTANCE / camera.mla_distance
    texture = mi.Bitmap(np.random.default_rng(3).random((24, 24, 1)).astype(np.float32))
    light = {"type": "area", "radiance": {"type": "bitmap", "bitmap": texture, "raw": True}}
    return scene_of(camera.to_sensor(), wall=facing(DISTANCE, size, emitter=light))


@pytest.mark.slow
def test_unequal_and_displaced_lenses_are_refocused_as_well_as_equal_ones():
    """By their correlation with Mitsuba's thin lens; their capture differs by a twelfth in its mean."""
    captures = [render_capture(wall(each), model="wave", wavelength=633, spp=64) for each in (STRAIGHT, FITTED)]
    images = [reconstruct(each, DISTANCE, method="coherent").image for each in captures]
    images.append(thin_lens_image(wall(STRAIGHT), STRAIGHT, DISTANCE, 512))
    correlations = np.corrcoef([image[2:-2, 2:-2].ravel() for image in images])[2]
    assert correlations[1] > correlations[0] - 0.002 > 0.9
    # Waves lose light at the rims of micro-images, which the outline of the vignetting leaves out.
    straight, fitted, thin = (image.mean() for image in images)
    assert 0.99 * straight < fitted < 1.01 * thin
    assert abs(captures[1].image.mean() / captures[0].image.mean() - 1) > 0.05


def test_white_captures_are_straightened():
    """Micro-images computed for displaced and tilted lenses become those of the regular camera, but for their rims."""
    camera = STRAIGHT.replace(mla_warp=WARP, mla_jitter=(0.0005, 0.0), mla_tilt=(2.0, -1.0))
    assert straightened(camera) == STRAIGHT
    expected, given = white_image(STRAIGHT), white_image(camera)
    found = straightened_image(given[..., None], camera)[..., 0]
    before, after = (np.sqrt(np.mean((image - expected) ** 2)) for image in (given, found))
    assert after < 0.4 * before


def test_a_white_reference_is_straightened_too():
    camera = STRAIGHT.replace(mla_warp=WARP, mla_tilt=(1.0, 0.0))
    white = Capture(white_image(camera), camera)
    assert np.nanmax(np.abs(reconstruct(Capture(2 * white.image, camera), DISTANCE, white=white).image - 2)) < 0.02


CAMERA = PlenopticCamera(detector_width=0.768, resolution=(192, 192))
FOCUSED = PlenopticCamera(detector_width=0.768, resolution=(192, 192), detector_distance=0.4)


def error(image, camera):
    return float(np.abs(image - cases.known_radiance(camera, "ramp")).max())


def test_a_plane_that_is_read_beside_its_bins_is_brought_back():
    random = np.random.default_rng(1)
    y, x = (axis[..., None] for axis in np.mgrid[:9, :11].astype(float))
    moved = random.uniform(-0.6, 0.6, (2, 9, 11, 1))

    def plane(x, y):
        return 2 + 0.3 * x - 0.2 * y

    image = plane(x + moved[0], y + moved[1])
    image[4, 5] = np.nan
    back = brought_back(image, moved, random.uniform(0.2, 1, image.shape), 1)
    assert np.isnan(back[4, 5])
    back[4, 5] = plane(5, 4)
    np.testing.assert_allclose(back, plane(x, y), atol=1e-9)


def test_displacements_are_told_of_both_axes_and_cut_at_a_lens():
    slope = 0.01
    y, x = (axis[..., None] - 2.0 for axis in np.mgrid[:5, :5].astype(float))
    step = slope * CAMERA.mla_pitch / 2
    tilted = [1 + step * (x + 0.4), 1 + step * (y - 9.0)]
    tilted[0][0, 0] = np.nan
    across, down = displacements(tilted, slope, CAMERA, 2)
    assert across[0, 0] == 0
    np.testing.assert_allclose(across.ravel()[1:], 0.4, atol=1e-9)
    np.testing.assert_allclose(down, -2)


@pytest.mark.filterwarnings("ignore:distance = 150")
def test_a_ramp_that_interference_displaces_is_drawn_back(monkeypatch, distance=150.0):
    """Divided by white alone, by hand, it is off to first order, as the gentle slope shows; drawn back it is not."""
    monkeypatch.setattr(cases, "SLOPE", 0.1)
    monkeypatch.setattr(cases, "_RAMP_END", 4.0)
    ramp = cases.wall_capture(CAMERA, distance, "ramp", "ray", 16)
    white = cases.wall_capture(CAMERA, 400.0, "white", "ray", 16)
    options = {"method": "coherent", "wavelength": cases.WALL_WAVELENGTH}
    divided = reconstruct(ramp, distance, **options).image / reconstruct(white, distance, **options).image
    assert error(reconstruct(ramp, distance, white=white, **options).image, CAMERA) < 0.6 * error(divided, CAMERA)


def test_focused_cameras_are_divided_alone():
    assert is_known(CAMERA)
    assert not is_known(FOCUSED)
    white = Capture(white_image(FOCUSED), FOCUSED)
    image = reconstruct(Capture(0.5 * white.image, FOCUSED), 280.0, white=white).image
    np.testing.assert_allclose(image[np.isfinite(image)], 0.5, rtol=1e-5)


@pytest.mark.slow
def test_a_plane_divided_by_a_white_capture_is_the_same_beside_others():
    capture, white = example("letters-wave"), example("white")
    beside, alone = (reconstruct(capture, g, method="coherent", white=white) for g in ([240.0, 280.0], 240.0))
    assert np.sqrt(np.nanmean((beside[0].image - alone.image) ** 2)) < 2e-3 * np.nanmax(alone.image)


def by_points(camera, x, y, wavelength, count=400):
    """The squared sinc of a square lens, weighed over a disc."""
    line = ((np.arange(count) + 0.5) / count * 2 - 1) * camera.aperture_radius
    Px, Py = np.meshgrid(line, line)
    width = wavelength * 1e-6 * camera.mla_distance / camera.mla_pitch
    weight = np.sinc((Px - x) / width) ** 2 * np.sinc((Py - y) / width) ** 2
    weight *= np.hypot(Px, Py) <= camera.aperture_radius
    return (weight * Px).sum() / weight.sum(), (weight * Py).sum() / weight.sum()


def test_centroids_are_those_of_a_sum_over_the_pupil(wavelength=450.0):
    centroid = PupilCentroid(CAMERA, wavelength)
    places = [(0.0, 0.0), (3.0, -1.0), (4.8, 0.0), (-2.0, 4.9), (5.3, 0.4)]
    x, y = centroid(*np.array(places).T)
    for place, *found in zip(places, x, y, strict=True):
        np.testing.assert_allclose(found, by_points(CAMERA, *place, wavelength), atol=0.04)
    # At the rim light comes from within.
    assert 4.8 - x[2] > 0.2
    for far in centroid(np.array([0.0, 16.0, -300.0]), np.array([19.0, 0.0, 300.0])):
        assert (np.abs(far) <= CAMERA.aperture_radius).all()
