"""Irregular arrays and pixels with an angular response, by rays: where micro-images lie, and how bright they are."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import sky, white

from mitsuba_plenoptic import PlenopticCamera, design

CAMERA = PlenopticCamera(resolution=(512, 512), detector_width=1.024)
SMALL = CAMERA.replace(resolution=(64, 64), detector_width=0.128)


def test_micro_images_lie_behind_displaced_lenses():
    """The middle of each is the chief ray through its lens's centre, c (b + z) / b, to 0.03 pixels."""
    camera = CAMERA.replace(mla_jitter=(0.002, 0.0), mla_seed=5)
    image = sky(camera, 64)
    misses, shifts = [], []
    for i in range(-6, 6):
        for j in range(-6, 6):
            lens = camera.lenslet(np.array([i]), np.array([j]))
            regular = (np.array([i, j]) + 0.5) * camera.mla_pitch
            centre = np.concatenate(lens.centre)
            expected, nominal = (
                c * (1 + camera.detector_distance / camera.mla_distance) / camera.pixel_size + 256
                for c in (centre, regular)
            )
            # The micro-image is 21 pixels wide and its neighbour 32 away.
            low = np.rint(nominal).astype(int) - 14
            part = image[low[1] : low[1] + 28, low[0] : low[0] + 28]
            place = [np.sum(part * (np.arange(28) + 0.5)[None, :]), np.sum(part * (np.arange(28) + 0.5)[:, None])]
            misses.append(np.array(place) / part.sum() + low - expected)
            shifts.append(expected - nominal)
            assert lens.focal_length == camera.mla_focal_length
    assert np.abs(misses).max() < 0.03
    assert np.std(shifts) == pytest.approx(0.002 * (1 + 0.512 / 120) / 0.002, rel=0.15)


def test_focal_lengths_scatter():
    """Micro-images of lenses out of focus widen: the blur of each lens is that of a camera with its focal length."""
    camera = SMALL.replace(mla_jitter=(0.0, 0.08))
    found = sky(camera, 1024)
    for i, j in ((-1, -1), (0, -1), (-1, 0), (0, 0)):
        focal_length = float(camera.lenslet(np.array([i]), np.array([j])).focal_length[0])
        alone = sky(SMALL.replace(mla_focal_length=focal_length, detector_distance=0.512), 1024)
        own = np.s_[32 * (j + 1) : 32 * (j + 2), 32 * (i + 1) : 32 * (i + 2)]
        assert np.abs(found[own] - alone[own]).mean() < 4e-3
    assert np.abs(found - sky(SMALL, 1024)).mean() > 6e-3


@pytest.mark.parametrize(
    "more",
    [
        {"mla_jitter": (0.004, 0.0)},
        # Micro-images overlap.
        pytest.param({"mla_jitter": (0.002, 0.05), "aperture_radius": 8.0}, marks=pytest.mark.slow),
        {"aperture_radius": 8.0, "mla_pitch": (0.05, 0.07), "mla_rotation": 12.0},
    ],
    ids=str,
)
def test_noise_and_light_of_many_candidates(more):
    """A pixel that sees only a white wall has no noise, and the mean is the closed form."""
    camera = CAMERA.replace(**more)
    scene = white(camera)
    assert len(scene.sensors()[0]._rays.choice.lenses) > 1
    images = np.stack([np.array(mi.render(scene, spp=16, seed=seed))[..., 0] for seed in range(6)])
    window = np.outer(np.hanning(514)[1:-1], np.hanning(514)[1:-1])
    assert np.average(images.mean(0), weights=window) == pytest.approx(design.white_mean(camera), rel=2e-3)
    # Without knowledge of the lenses that light a pixel, more than half have a deviation of 0.1 to 0.5.
    assert np.median(images.std(0)) == 0


def test_pixels_that_answer_to_angles():
    """White pixels have the response at their angles of incidence, averaged over the lens."""
    pairs = (0.0, 1.0, 10.0, 0.2)
    camera = CAMERA.replace(pixel_response=pairs, resolution=(32, 32), detector_width=0.064, mla_offset=(0.032, 0.032))
    image = sky(camera, 2048)
    x = camera.pixel_coordinates(0)
    m = (np.arange(400) + 0.5) / 400 * 0.064 - 0.032
    for column in (16, 20, 24):
        # A pixel of the middle row; places on the lens by a plain sum.
        dx, dy = np.meshgrid(m - x[column], m - x[16])
        angle = np.degrees(np.arctan(np.hypot(dx, dy) / 0.512))
        expected = np.interp(angle, pairs[::2], pairs[1::2]).mean()
        assert image[16, column] == pytest.approx(expected, rel=0.01)
