"""The commands on light fields, and the sheet of reconstructions: what they write."""

import json
import math
import os
import re

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mitsuba_plenoptic import Capture, Detector, PlenopticCamera, expose, read_capture, reconstruct, write_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.refocus import read_reconstruction, write_reconstruction
from mitsuba_plenoptic.views import depth_map, epipolar_image, focal_stack, white_image

CAMERA = PlenopticCamera(detector_width=0.512, resolution=(128, 128))


def parts(path):
    """Read the parts of an EXR file by name, and the JSON of the first."""
    found = OpenEXR.File(str(path), separate_channels=True).parts
    images = {}
    for part in found:
        planes = [part.channels[name].pixels for name in ("Y", "R", "G", "B") if name in part.channels]
        images[part.name()] = planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)
    return images, json.loads(found[0].header["mitsuba_plenoptic"])


def test_views(shot, lf, tmp_path, run):
    run("views", shot, "-o", tmp_path / "all.exr")
    images, header = parts(tmp_path / "all.exr")
    assert len(images) == lf.sizes["v"] * lf.sizes["u"]
    name = f"v={float(lf.v[2]):.4g} u={float(lf.u[3]):.4g}"
    np.testing.assert_array_equal(images[name], lf.values[2, 3])
    assert header["coordinates"]["s"] == pytest.approx(lf.s.values.tolist())
    assert PlenopticCamera.from_dict(header["camera"]) == CAMERA

    assert "3 x 3 views of 8 x 8 pixels" in run("views", shot, "-o", tmp_path / "some.png", "--count", 3)
    # The radiance of a white image is of no account: light fields stay in units of the capture.
    write_capture(tmp_path / "white.exr", Capture(2 * white_image(CAMERA), CAMERA))
    run("views", shot, "-o", tmp_path / "one.exr", "--count", 1, "--white", tmp_path / "white.exr")
    (image,) = parts(tmp_path / "one.exr")[0].values()
    middle = lf.sizes["u"] // 2
    np.testing.assert_allclose(image, lf.values[middle, middle], rtol=1e-5)


def test_epi_and_stack(shot, lf, tmp_path, run):
    options = "--axis=vertical", f"--at={float(lf.s[5])}", f"--through={float(lf.u[2])}"
    run("epi", shot, "-o", tmp_path / "a.exr", *options)
    image = parts(tmp_path / "a.exr")[0]["epipolar"]
    np.testing.assert_array_equal(image, epipolar_image(lf, "vertical", at=lf.s[5], through=lf.u[2]).values)
    distances = ("--distance", 210, "--distance", 250.5, "--distance", 280)
    run("stack", shot, "-o", tmp_path / "a.exr", *distances)
    images, header = parts(tmp_path / "a.exr")
    assert list(images) == ["210 mm", "250.5 mm", "280 mm"]
    np.testing.assert_allclose(list(images.values()), focal_stack(lf, [210, 250.5, 280]), atol=1e-5)
    assert header["coordinates"]["distance"] == [210, 250.5, 280]
    # Three pictures in two rows of two.
    run("stack", shot, "-o", tmp_path / "a.png", *distances)
    assert Image.open(tmp_path / "a.png").size == (960, 960)


def test_depth(shot, lf, tmp_path, run, coarse_figures):
    options = ("--near", 200, "--far", 300, "--planes", 8)
    run("depth", shot, "-o", tmp_path / "a.exr", *options)
    images, header = parts(tmp_path / "a.exr")
    found = depth_map(lf, 200, 300, planes=8)
    for name in ("depth", "disparity", "confidence", "image"):
        np.testing.assert_allclose(images[name], found[name].values, rtol=1e-5, atol=1e-6)
    assert (header["near"], header["far"], header["planes"]) == (200, 300, 8)
    assert "confidence above half" in run("depth", shot, "-o", tmp_path / "a.png", *options, "--scale", 40)
    assert Image.open(tmp_path / "a.png").size == (3 * 40 * 8, 40 * 8)
    # A figure, with labels, as wide as a page.
    run("depth", shot, "-o", tmp_path / "b.png", *options)
    assert Image.open(tmp_path / "b.png").size[0] == 7 * 75


def test_depth_warns_when_it_knows_little(tmp_path, capfd):
    write_capture(tmp_path / "even.exr", Capture(white_image(CAMERA), CAMERA))
    assert main(["depth", str(tmp_path / "even.exr"), "-o", str(tmp_path / "a.png"), "--planes", "8"]) == 0
    output, error = capfd.readouterr()
    assert "0 % of the bins" in output
    assert error.startswith("mitsuba-plenoptic: warning: depth: hardly any bin determines it")


@pytest.mark.slow
def test_depth_says_where_to_widen_the_search(tmp_path, capfd, monkeypatch):
    def told(far, planes):
        words = ["depth", str(tmp_path / "raw.exr"), "-o", str(tmp_path / "a.exr"), "--near", "195"]
        assert main([*words, "--far", far, "--planes", planes]) == 0
        return capfd.readouterr().err

    assert main(["example", "letters-ray", "-o", str(tmp_path / "raw.exr")]) == 0
    wanted = r"\d+ % of the bins agree best at the far end .*, 225 mm, and are .* widen the search with --far"
    assert re.search(wanted, told("225", "32"))
    assert "with --far" not in told("310", "16")
    monkeypatch.setattr("mitsuba_plenoptic.views.beyond_search", lambda estimate: (0.0, 0.5))
    assert "with --far" in told("310", "16") and "with --far" not in told("inf", "16")


def test_expose(shot, tmp_path, run):
    options = "--photons", 500, "--bits", 10, "--seed", 4, "--full-well", 2000
    assert "300 electrons" in run("expose", shot, "-o", tmp_path / "a.exr", *options)
    expected = expose(read_capture(shot), Detector(bits=10, full_well=2000), photons=500, seed=4).image
    np.testing.assert_array_equal(read_capture(tmp_path / "a.exr").image, expected)


def test_figures_enlarged_pictures_and_animations(shot, lf, tmp_path, run, coarse_figures):
    distances, few = ["--distance", 236, "--distance", 244], ["--count", 2]
    # Each command draws by the same function for either kind of file.
    for command, *options in (["reconstruct", *distances], ["views", *few], ["depth", "--planes", 8]):
        run(command, shot, "-o", tmp_path / f"{command}.png", "--figure", *options)
        assert Image.open(tmp_path / f"{command}.png").width in (255, 525)
    run("epi", shot, "-o", tmp_path / "epi.pdf")
    assert (tmp_path / "epi.pdf").read_bytes()[:5] == b"%PDF-"

    for scale in (1, 3):
        run("stack", shot, "-o", tmp_path / f"{scale}.png", "--scale", scale, *distances)
    plain, large = (np.asarray(Image.open(tmp_path / f"{scale}.png")) for scale in (1, 3))
    np.testing.assert_array_equal(large, plain.repeat(3, 0).repeat(3, 1))
    run("epi", shot, "-o", tmp_path / "large.png", "--scale", 1)
    assert Image.open(tmp_path / "large.png").size == (8, lf.sizes["u"])

    told = run("stack", shot, "-o", tmp_path / "a.gif", *distances, "--scale", 2)
    assert "46 images from 236 to 244 mm and back" in told
    with Image.open(tmp_path / "a.gif") as picture:
        assert (picture.n_frames, picture.size) == (46, (16, 16))
    assert "one after the other" in run("views", shot, "-o", tmp_path / "b.gif")
    assert Image.open(tmp_path / "b.gif").size == (480, 480)


@pytest.fixture(scope="module")
def results(shot, tmp_path_factory):
    """Write reconstructions at two distances, and others at one of them, which are read as they were."""
    folder, capture = tmp_path_factory.mktemp("results"), read_capture(shot)
    paths = [folder / f"{index}.exr" for index in range(3)]
    found = [*reconstruct(capture, [240, math.inf]), reconstruct(capture, 240, footprint="point")]
    for path, one in zip(paths, found, strict=True):
        write_reconstruction(path, one)
        back = read_reconstruction(path)
        np.testing.assert_array_equal(back.image, one.image)
        for name in ("distance", "bin_size", "method", "camera", "options"):
            assert getattr(back, name) == getattr(one, name)
    return paths


def test_a_name_that_is_no_text_is_refused_first(shot, complaint):
    name = os.fsdecode(b"sheet\xff.png")
    assert "must be text in UTF-8" in complaint("reconstruct", shot, "--distance", "240", "-o", name)


def test_sheets_of_all_or_of_chosen_distances(results, shot, tmp_path, run, complaint, coarse_figures):
    path = tmp_path / "sheet.pdf"
    assert run("sheet", *results, "-o", path) == f"{path}: 3 images (methods: 1, distances: 2)\n"
    assert path.read_bytes().startswith(b"%PDF-")
    path = tmp_path / "sheet.png"
    told = run("sheet", *results, "-o", path, "--distance", "240")
    assert told == f"{path}: 2 images (methods: 1, distances: 1)\n"
    said = complaint("sheet", *results, "-o", path, "--distance", "210")
    assert said.startswith("--distance = 210: ") and "240, inf" in said
    assert complaint("sheet", shot, "-o", path).startswith(f"{shot}: it holds a 'capture'")
