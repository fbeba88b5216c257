"""Pictures and animations: tone, scale, order of frames, and nothing half-written."""

import numpy as np
import pytest
from PIL import Image
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import decode
from mitsuba_plenoptic.report.animations import sweep_distances, write_animation
from mitsuba_plenoptic.report.images import Brightness, shrink, to_bytes, write_png
from mitsuba_plenoptic.report.output_files import orbit


@pytest.mark.parametrize(
    ("pixels", "peak", "expected"),
    [
        # 12.92 x 0.001 and 1.055 x 0.5^(1/2.4) - 0.055, times 255
        ([[0.0, 0.001, 0.5, 1.0, 2.0, -1.0]], 1, [[0, 3, 188, 255, 255, 0]]),
        ([[0.0, 7.0]], None, [[0, 255]]),
        ([[[1.0, 0.0, 0.0]]], None, [[[255, 0, 0]]]),
        ([[0.0, 0.0]], None, [[0, 0]]),
        ([[np.nan, np.inf, 1.0]], None, [[0, 0, 255]]),
    ],
    ids=["encoding", "peak", "colour", "black", "not finite"],
)
def test_pictures(tmp_path, pixels, peak, expected):
    write_png(tmp_path / "a.png", np.array(pixels), peak=peak)
    assert np.array(Image.open(tmp_path / "a.png")).tolist() == expected


def test_failure_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.png"
    write_png(path, np.ones((2, 2)))
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_png(path, np.ones((2, 2, 7)))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_shrink_averages_whole_blocks():
    image = np.arange(36, dtype=np.float32).reshape(6, 6)
    assert shrink(image, 6) is image
    assert shrink(image, 3).tolist() == [[3.5, 5.5, 7.5], [15.5, 17.5, 19.5], [27.5, 29.5, 31.5]]
    assert shrink(np.ones((10, 7, 3)), 4).shape == (3, 2, 3)
    assert shrink(np.ones((1, 100)), 10).shape == (1, 10)


def test_a_lamp_out_of_focus_does_not_make_the_rest_black():
    """3 % of the bins are as bright as a lamp; of what is lit, a grey of 18 % stays one that can be seen."""
    lit = np.random.default_rng(0).uniform(0.1, 0.6, (100, 100))
    lamp = lit.copy()
    lamp[:30, :10] = 50.0
    white = Brightness().peak([lit])
    assert white == pytest.approx(np.percentile(lit, 99.5))
    assert to_bytes(np.full((1, 1), 0.18), Brightness().peak([lamp])) > 60
    assert white < Brightness().peak([lamp, lit]) < 5 * white
    assert Brightness(percentile=99.5).peak([lamp]) == 50
    # What is bright on black is what the picture is about.
    for faint in (0.0, 1e-3):
        assert Brightness().peak([np.where(np.arange(100) < 3, 1.0, faint * lit)]) == 1
    assert Brightness().peak([np.zeros((3, 3)), np.full((3, 3), np.nan)]) == 1


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
    refuses("^distance: .* and 3 are given", sweep_distances, [210, 240, 280])
    refuses("^distance = 0", sweep_distances, [0, 240])


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
