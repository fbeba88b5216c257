"""Pictures: tone, scale, and nothing half-written."""

import numpy as np
import pytest
from PIL import Image

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.report.images import Brightness, shrink, to_bytes, write_png
from mitsuba_plenoptic.report.plots import contact_sheet, depth_figure


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


def test_a_wall_is_seen_next_to_a_lamp_in_all_figures():
    """A lamp of 10,000 times its radiance."""
    camera = mp.PlenopticCamera(detector_width=4.096, resolution=(512, 512))
    image = 0.5 * mp.views.white_image(camera)
    image[252:260, 252:260] *= 1e4
    capture = mp.Capture(image, camera)
    sheet = contact_sheet(mp.reconstruct(capture, [210, 240]))
    depth = depth_figure(mp.views.depth_map(mp.decode(capture), 200, 260, planes=16))
    for axes in (sheet.axes[0], sheet.axes[1], depth.axes[0]):
        (image,) = axes.images
        assert np.median(np.asarray(image.get_array())) == pytest.approx(0.5, rel=0.02)
        assert image.norm(0.5) > 0.3
