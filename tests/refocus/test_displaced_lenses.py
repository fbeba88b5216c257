"""Reconstructions of captures by cameras whose lenses are displaced or whose array is tilted, like those of others."""

import functools

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, warped
from cases import facing, scene_of

from mitsuba_plenoptic import Capture, PlenopticCamera, reconstruct, render_capture
from mitsuba_plenoptic.refocus.straight import straightened, straightened_image
from mitsuba_plenoptic.report.experiment import thin_lens_image
from mitsuba_plenoptic.views import white_image

STRAIGHT = PlenopticCamera(**HALF, resolution=(192, 192), detector_width=0.768)
"""12 x 12 lenses of 16 x 16 pixels."""

HALF_WIDTH = 0.384
WARP = warped(STRAIGHT, 0.6, 18)[0].mla_warp
"""Up to 0.6 pixels in the corners, of fifth degree."""

CAMERAS = {
    "straight": {},
    "tilted": {"mla_tilt": (0.3, -0.2), "mla_warp": WARP},
    "irregular": {"mla_jitter": (0.0005, 0.0), "mla_seed": 2},
    "fitted": {
        "mla_warp": WARP,
        "mla_transmissions": np.random.default_rng(8).uniform(0.8, 1.2, (14, 14)),
        "vignetting": {"radius": [0.97, 0, 0, -0.03, 0, 0], "scale": HALF_WIDTH, "apodisation_2": [-0.2]},
    },
}
DISTANCE = 114.0


def wall(camera):
    """Return a scene of a wall with a random texture, somewhat finer than the lenses."""
    size = 1.3 * HALF_WIDTH * DISTANCE / camera.mla_distance
    texture = mi.Bitmap(np.random.default_rng(3).random((24, 24, 1)).astype(np.float32))
    light = {"type": "area", "radiance": {"type": "bitmap", "bitmap": texture, "raw": True}}
    return scene_of(camera.to_sensor(), wall=facing(DISTANCE, size, emitter=light))


@functools.cache
def capture(name):
    return render_capture(wall(STRAIGHT.replace(**CAMERAS[name])), model="wave", wavelength=633, spp=64)


@functools.cache
def reference():
    return thin_lens_image(wall(STRAIGHT), STRAIGHT, DISTANCE, 512)


def correlation(image):
    inner = np.s_[2:-2, 2:-2]
    return np.corrcoef(image[inner].ravel(), reference()[inner].ravel())[0, 1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "method"), [("tilted", "partial"), ("irregular", "partial"), ("fitted", "deconvolved")]
)
def test_displaced_lenses_are_refocused_as_well_as_regular_ones(name, method):
    """The correlation with Mitsuba's thin lens is at most 0.002 below that of the straight camera."""
    straight, found = (
        correlation(reconstruct(capture(each), DISTANCE, method=method).image) for each in ("straight", name)
    )
    assert straight > 0.9
    # Vignetting takes light from the rims; it is a weight on scenes' light, which in responses diffracts at it, too.
    vignetted = 0.006 if method == "deconvolved" else 0.003
    assert found > straight - (vignetted if name == "fitted" else 0.002)


def test_unequal_lenses_are_refocused_as_well_as_equal_ones():
    """Their capture differs by a twelfth in its mean."""
    straight, found = (reconstruct(capture(name), DISTANCE, method="coherent").image for name in ("straight", "fitted"))
    assert correlation(found) > correlation(straight) - 0.002
    # Waves lose light at the rims of micro-images, which the outline of the vignetting leaves out.
    assert 0.99 * straight.mean() < found.mean() < 1.01 * reference().mean()
    assert abs(capture("fitted").image.mean() / capture("straight").image.mean() - 1) > 0.05


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
    image = reconstruct(Capture(2 * white.image, camera), DISTANCE, white=white).image
    assert np.nanmax(np.abs(image - 2)) < 0.02
