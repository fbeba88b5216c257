"""Animations: frames, their order, and their files."""

import numpy as np
import pytest
from PIL import Image

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import decode
from mitsuba_plenoptic.report.animations import sweep_distances, write_animation
from mitsuba_plenoptic.report.output_files import orbit

FRAMES = [(np.full((3, 5), value, np.float32), "") for value in (0.0, 0.5, 1.0)]


def test_gif(tmp_path):
    write_animation(tmp_path / "a.gif", FRAMES, 1.0, 2)
    with Image.open(tmp_path / "a.gif") as picture:
        assert (picture.n_frames, picture.size, picture.info["loop"], picture.info["duration"]) == (3, (10, 6), 0, 80)
        greys = []
        for index in range(3):
            picture.seek(index)
            greys.append(picture.convert("L").getpixel((4, 4)))
    assert greys == [0, 188, 255]


def test_small_images_are_enlarged_and_labelled(tmp_path):
    images = [(np.zeros((48, 48, 3), np.float32), text) for text in ("210 mm", "240 mm")]
    write_animation(tmp_path / "a.gif", images, 1.0)
    with Image.open(tmp_path / "a.gif") as picture:
        drawn = np.asarray(picture.convert("L"))
    assert drawn.shape == (480, 480)
    assert drawn[400:, :160].max() == 255 and drawn[:400].max() == 0


def test_a_sweep_takes_even_steps_of_the_reciprocal():
    found = sweep_distances([200, np.inf])
    assert (found[0], found[-1]) == (200, np.inf)
    np.testing.assert_allclose(np.diff([1 / distance for distance in found]), -1 / 200 / 23, rtol=1e-9)
    with pytest.raises(
        mp.InputError, match=r"^distance: a focal sweep goes from one distance to another, and 3 are given"
    ):
        sweep_distances([210, 240, 280])
    with pytest.raises(mp.InputError, match=r"^distance = 0: it must be greater than 0"):
        sweep_distances([0, 240])


def test_an_orbit_goes_once_round_the_pupil():
    camera = mp.PlenopticCamera(detector_width=0.512, resolution=(128, 128))
    lf = decode(mp.Capture(np.ones(camera.shape, np.float32), camera))
    views = orbit(lf)
    u, v = (np.array([float(axis[view[index]]) for view in views]) for index, axis in ((1, lf.u), (0, lf.v)))
    step = abs(float(lf.u[1] - lf.u[0]))
    radius = 0.75 * float(lf.u.max())
    assert len(set(views)) == len(views) > 8
    assert np.all(np.abs(np.hypot(u, v) - radius) <= step / np.sqrt(2) + 1e-9)
    turned = np.diff(np.unwrap(np.arctan2(v, u)))
    assert np.all(turned > 0) and turned.sum() < 2 * np.pi
    assert np.all(np.hypot(np.diff(u), np.diff(v)) <= np.sqrt(2) * step + 1e-9)
