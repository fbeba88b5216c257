"""The rays that the figures of the setup and of the ways back show, against the thin lens's formula."""

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.extensions.paper.procedures import back_path, light_path, micro_image

CAMERA = PlenopticCamera()


@pytest.mark.parametrize("distance", [210.0, 240.0, 280.0])
def test_rays_of_a_point_meet_in_its_image(distance):
    pupil = np.linspace(-5, 5, 7)
    (_, lens, array) = np.moveaxis(light_path(CAMERA, (2.0, distance), pupil), 1, 0)
    image = 1 / (1 / CAMERA.focal_length - 1 / distance)
    slopes = (array[:, 1] - lens[:, 1]) / CAMERA.mla_distance
    assert lens[:, 1] + slopes * image == pytest.approx(np.full(7, -2.0 * image / distance))


def test_the_way_back_leads_through_the_pupil_to_the_plane_in_focus():
    pixels = micro_image(CAMERA, 3 * CAMERA.mla_pitch)
    _, _, pupil, plane = np.moveaxis(back_path(CAMERA, 3 * CAMERA.mla_pitch, pixels, 240.0), 1, 0)
    assert np.abs(pupil[:, 1]).max() == pytest.approx(CAMERA.aperture_radius)
    assert plane[:, 1] == pytest.approx(np.full(7, -3 * CAMERA.mla_pitch * 2))
