"""The camera by rays at the paper's full size, 4096 x 4096 pixels."""

import numpy as np
import pytest

from mitsuba_plenoptic import design, load_scene, render_capture

pytestmark = pytest.mark.slow


def white_capture(aperture_radius):
    return render_capture(load_scene("white", parameters={"aperture_radius": str(aperture_radius)}), spp=16)


@pytest.mark.parametrize("aperture_radius", [5, 10])
def test_mean_of_the_white_scene_is_the_closed_form(aperture_radius):
    capture = white_capture(aperture_radius)
    camera = capture.camera
    # Whole periods about the axis; the outermost pixels count in part.
    half = 63 * camera.micro_image_pitch / camera.pixel_size
    weight = np.clip(half - np.abs(np.arange(4096) + 0.5 - 2048) + 0.5, 0, 1)
    mean = weight @ capture.image.astype(np.float64) @ weight / (2 * half) ** 2
    assert mean == pytest.approx(design.white_mean(camera), rel=5e-3)


def test_every_micro_image_stands_in_its_place():
    capture = white_capture(5)
    camera = capture.camera
    x = (np.arange(4096) + 0.5) * camera.pixel_size - camera.detector_width / 2
    centres = (np.arange(-64, 64) + 0.5) * camera.mla_pitch * (1 + camera.detector_distance / camera.mla_distance)
    checked = 0
    for profile in (capture.image.sum(axis=0, dtype=np.float64), capture.image.sum(axis=1, dtype=np.float64)):
        for centre in centres:
            if abs(centre) + camera.micro_image_diameter / 2 < camera.detector_width / 2:
                near = np.abs(x - centre) < camera.micro_image_pitch / 2
                found = (profile * x)[near].sum() / profile[near].sum()
                assert abs(found - centre) < 0.1 * camera.pixel_size
                checked += 1
    assert checked == 2 * 126
