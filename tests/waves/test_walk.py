"""The walk of rays: what leaves a detector point and what comes back to it, and a scene point's light in between."""

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.rays.tracer import Passage, Walk, follow_back

CAMERAS = {
    "square": {},
    "hexagonal": {"mla_lattice": "hexagonal", "mla_rotation": 7.0, "mla_focal_length": (0.44, 0.512, 0.6)},
    "parabolic": {"lens_model": "parabolic", "aperture_radius": 15.0},
    "medium": {"mla_medium": 1.5, "mla_focal_length": 0.768, "detector_distance": 0.768},
    "medium, parabolic": {"mla_medium": 1.5, "lens_model": "parabolic"},
    "real lens": {"main_lens": "double_gauss", "focus_distance": 240.0},
    "irregular": {"mla_jitter": (0.001, 0.02), "mla_figure_error": (1e-4, 0.05)},
    "aligned": {"mla_cra": (0.0, 0.0, 8.0, 5.0)},
    "microscope": {"main_lens": {"magnification": 20.0, "numerical_aperture": 0.5}, "mla_focal_length": 3.0},
}


@pytest.fixture(params=CAMERAS)
def walk(request):
    camera = PlenopticCamera(**CAMERAS[request.param])
    return Walk.of(camera, OpticalSystem(camera, 633.0).lens)


def drawn(walk, count=2000):
    """Return detector points, and passages through lenses near those of their chief rays."""
    rng = np.random.default_rng(0)
    pixel = tuple(rng.uniform(-1, 1, (2, count)))
    lens, offset = walk.lenslet(*walk.chief_cell(pixel)[1]), rng.uniform(-0.03, 0.03, (2, count))
    return pixel, Passage((lens.centre[0] + offset[0], lens.centre[1] + offset[1]), lens)


def test_rays_come_back_to_the_detector_point_that_they_left(walk):
    pixel, passage = drawn(walk)
    slope, weight, _ = walk.out_of_array(pixel, passage)
    pupil = tuple(walk.lens.pupil.point(m, t) for m, t in zip(passage.point, slope, strict=True))
    landed, back = walk.onto_detector(pupil, passage)
    assert np.allclose(landed, pixel, atol=1e-9)
    assert np.allclose(back, weight)


def test_the_light_of_a_point_takes_the_way_of_the_rays_that_meet_it(walk):
    """The main lens is passed by the path of waves one way, and by traced rays the other way."""
    pixel, passage = drawn(walk, 20)
    (x, y, z), slope, is_open = walk.trace(pixel, passage)
    assert is_open.any()
    distance = 0.01 if walk.camera.main_lens and not walk.camera.lens_data.converges else 250.0
    met = np.column_stack([x + (distance - z) * slope[0], y + (distance - z) * slope[1], np.full(len(x), distance)])
    out, _, _ = walk.out_of_array(pixel, passage)
    pupil = tuple(walk.lens.pupil.point(m, t) for m, t in zip(passage.point, out, strict=True))
    for index in np.flatnonzero(is_open)[:4]:
        point, own = met[index : index + 1], tuple(np.array([[P[index]]]) for P in pupil)
        lens, scene = walk.lens.waves_of(point), tuple(part[:, None] for part in point.T)
        light = lens.bind(point)
        place = np.stack(np.broadcast_arrays(*light.land(own, scene)))
        if lens.pupil.finite:
            cosines = np.stack(np.broadcast_arrays(*light.cosines(own, scene)))
            straight = np.stack(own) + lens.pupil.distance * cosines / np.sqrt(1 - (cosines**2).sum(0))
            assert np.allclose(straight, place, atol=3e-4)
        assert np.allclose(np.ravel(place), [passage.point[axis][index] for axis in (0, 1)], atol=3e-4)


def test_paraxial_rays_are_those_of_an_ideal_camera():
    camera = PlenopticCamera()
    pixel, passage = drawn(Walk.of(camera))
    point, slope, _ = Walk.of(camera).trace(pixel, passage)
    for axis in (0, 1):
        pupil, place = follow_back(pixel[axis], passage.point[axis], passage.lens.centre[axis], 240.0, camera)
        assert np.allclose(pupil, point[axis])
        assert np.allclose(place, -120.0 / 240.0 * (point[axis] + 240.0 * slope[axis]))
