"""The commands on light fields: what they write."""

import json
import re

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter

from mitsuba_plenoptic import Capture, PlenopticCamera, decode, read_capture, render_capture, with_camera, write_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.views import depth_map, epipolar_image, focal_stack, refocus, white_image
from mitsuba_plenoptic.views.light_field_files import open_light_field

CAMERA = PlenopticCamera(detector_width=0.512, resolution=(128, 128))


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    """Write a capture of random light once."""
    image = np.random.default_rng(0).random(CAMERA.shape, dtype=np.float32) * white_image(CAMERA)
    path = tmp_path_factory.mktemp("capture") / "raw.exr"
    write_capture(path, Capture(image, CAMERA))
    return path


@pytest.fixture(scope="module")
def lf(raw):
    return decode(read_capture(raw))


def parts(path):
    """Read the parts of an EXR file by name, and the JSON of the first."""
    found = OpenEXR.File(str(path), separate_channels=True).parts
    images = {}
    for part in found:
        planes = [part.channels[name].pixels for name in ("Y", "R", "G", "B") if name in part.channels]
        images[part.name()] = planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)
    return images, json.loads(found[0].header["mitsuba_plenoptic"])


def test_views(raw, lf, tmp_path, run):
    run("views", raw, "-o", tmp_path / "all.exr")
    images, header = parts(tmp_path / "all.exr")
    assert len(images) == lf.sizes["v"] * lf.sizes["u"]
    name = f"v={float(lf.v[2]):.4g} u={float(lf.u[3]):.4g}"
    np.testing.assert_array_equal(images[name], lf.values[2, 3])
    assert header["coordinates"]["s"] == pytest.approx(lf.s.values.tolist())
    assert PlenopticCamera.from_dict(header["camera"]) == CAMERA

    assert "3 x 3 views of 8 x 8 pixels" in run("views", raw, "-o", tmp_path / "some.png", "--count", 3)
    assert Image.open(tmp_path / "some.png").size == (960, 960)


def test_views_with_a_white_image(raw, lf, tmp_path, run):
    """Its radiance is of no account: light fields stay in units of the capture."""
    write_capture(tmp_path / "white.exr", Capture(2 * white_image(CAMERA), CAMERA))
    run("views", raw, "-o", tmp_path / "one.exr", "--count", 1, "--white", tmp_path / "white.exr")
    (image,) = parts(tmp_path / "one.exr")[0].values()
    middle = lf.sizes["u"] // 2
    np.testing.assert_allclose(image, lf.values[middle, middle], rtol=1e-5)


def test_epi(raw, lf, tmp_path, run):
    run("epi", raw, "-o", tmp_path / "a.exr", "--axis", "vertical", "--at", float(lf.s[5]), "--through", float(lf.u[2]))
    image = parts(tmp_path / "a.exr")[0]["epipolar"]
    np.testing.assert_array_equal(image, epipolar_image(lf, "vertical", at=lf.s[5], through=lf.u[2]).values)
    run("epi", raw, "-o", tmp_path / "a.png")
    assert Image.open(tmp_path / "a.png").size == (960 // 11 * 8, 960 // 11 * 11)


@pytest.mark.parametrize("method", ["shift", "fourier"])
def test_stack(raw, lf, method, tmp_path, run):
    distances = ("--distance", 210, "--distance", 250.5, "--distance", 280)
    run("stack", raw, "-o", tmp_path / "a.exr", *distances, "--method", method)
    images, header = parts(tmp_path / "a.exr")
    assert list(images) == ["210 mm", "250.5 mm", "280 mm"]
    expected = focal_stack(lf, [210, 250.5, 280], method=method)
    for image, plane in zip(images.values(), expected.values, strict=True):
        np.testing.assert_allclose(image, plane, atol=1e-5)
    assert header["coordinates"]["distance"] == [210, 250.5, 280]
    run("stack", raw, "-o", tmp_path / "a.png", *distances, "--method", method)
    # Three pictures in two rows of two.
    assert Image.open(tmp_path / "a.png").size == (960, 960)


def test_depth(raw, lf, tmp_path, run):
    options = ("--near", 200, "--far", 300, "--planes", 8)
    run("depth", raw, "-o", tmp_path / "a.exr", *options)
    images, header = parts(tmp_path / "a.exr")
    found = depth_map(lf, 200, 300, planes=8)
    for name in ("depth", "disparity", "confidence", "image"):
        np.testing.assert_allclose(images[name], found[name].values, rtol=1e-5, atol=1e-6)
    assert (header["near"], header["far"], header["planes"]) == (200, 300, 8)
    assert "confidence above half" in run("depth", raw, "-o", tmp_path / "a.png", *options, "--scale", 40)
    assert Image.open(tmp_path / "a.png").size == (3 * 40 * 8, 40 * 8)
    # A figure, with labels, as wide as a page.
    run("depth", raw, "-o", tmp_path / "b.png", *options)
    assert Image.open(tmp_path / "b.png").size[0] == 7 * 300


def test_depth_warns_when_it_knows_little(tmp_path, capfd):
    write_capture(tmp_path / "even.exr", Capture(white_image(CAMERA), CAMERA))
    assert main(["depth", str(tmp_path / "even.exr"), "-o", str(tmp_path / "a.png"), "--planes", "8"]) == 0
    output, error = capfd.readouterr()
    assert "0 % of the bins" in output
    assert error.startswith("mitsuba-plenoptic: warning: depth: hardly any bin determines it")


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    """Capture a wall with random texture 500 mm before a fast hexagonal camera that is focused to 320 mm."""
    to_world = mi.ScalarTransform4f
    texture = gaussian_filter(np.random.default_rng(0).random((256, 256, 1)), (2, 2, 0), mode="wrap")
    texture = np.float32((texture - texture.min()) / np.ptp(texture))
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "light": {"type": "constant"},
            "sensor": {"type": "perspective", "to_world": to_world().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])},
            "wall": {
                "type": "rectangle",
                "to_world": to_world().translate([0, 0, 500]).rotate([1, 0, 0], 180).scale(30),
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "bitmap", "data": mi.TensorXf(texture), "raw": True},
                },
            },
        }
    )
    sheet = {"f_number": 2.8, "lenses": 40, "pixels_per_lens": 10, "pixel_size": 0.005}
    camera = PlenopticCamera.matched(**sheet, focal_length=50, focus_distance=320, mla_lattice="hexagonal")
    path = tmp_path_factory.mktemp("wall") / "wall.exr"
    write_capture(path, render_capture(with_camera(scene, camera), spp=64))
    return path


def test_depth_says_where_to_widen_the_search(wall, tmp_path, capfd):
    """By default a fast camera is searched to 458 mm, where a point moves by two lenses from view to view."""
    assert main(["depth", str(wall), "-o", str(tmp_path / "a.exr")]) == 0
    error = capfd.readouterr().err
    assert re.search(
        r"warning: depth: \d+ % of the bins agree best at the far end of the search, 458.2 mm, and are probably "
        "farther: widen the search with --far",
        error,
    )
    assert "hardly any bin" not in error
    assert main(["depth", str(wall), "-o", str(tmp_path / "b.exr"), "--far", "600"]) == 0
    output, error = capfd.readouterr()
    assert "warning" not in error and int(re.search(r": (\d+) % of the bins", output)[1]) > 90
    images, _ = parts(tmp_path / "b.exr")
    assert np.nanmedian(images["depth"]) == pytest.approx(500, rel=0.01)


def test_expose(raw, tmp_path, run):
    told = run(
        "expose", raw, "-o", tmp_path / "a.exr", "--photons", 500, "--bits", 10, "--seed", 4, "--full-well", 2000
    )
    assert "300 electrons" in told
    noisy = read_capture(tmp_path / "a.exr")
    assert noisy.image.mean() == pytest.approx(read_capture(raw).image.mean(), rel=0.02)
    assert noisy.metadata["exposure"]["full_well"] == 2000
    assert noisy.metadata["exposure"]["seed"] == 4


def test_convert_there_and_back(raw, lf, tmp_path, run):
    run("convert", raw, "-o", tmp_path / "a.nc")
    # A light field is as good a source as a capture, with its distances where it tells the camera.
    run("stack", tmp_path / "a.nc", "-o", tmp_path / "a.exr", "--distance", 210)
    np.testing.assert_allclose(parts(tmp_path / "a.exr")[0]["210 mm"], refocus(lf, 210).values, atol=1e-5)
    run("convert", tmp_path / "a.nc", "-o", tmp_path / "a.eslf.png")
    run("convert", tmp_path / "a.eslf.png", "--view-count", lf.sizes["u"], "-o", tmp_path / "b.nc")
    found = open_light_field(tmp_path / "b.nc").values
    # The largest value is white.
    np.testing.assert_allclose(found / found.max(), lf.values / lf.values.max(), atol=2e-4)


def test_figures_enlarged_pictures_and_animations(raw, lf, tmp_path, run, coarse_figures):
    distances = ["--distance", 236, "--distance", 244]
    # Each command draws by the same function for either kind of file.
    for command, *options in (["reconstruct", *distances], ["views"], ["depth"]):
        run(command, raw, "-o", tmp_path / f"{command}.png", "--figure", *options)
        assert Image.open(tmp_path / f"{command}.png").width in (255, 525)
    for command, *options in (["stack", *distances], ["epi"], ["views"]):
        run(command, raw, "-o", tmp_path / f"{command}.pdf", *options)
        assert (tmp_path / f"{command}.pdf").read_bytes()[:5] == b"%PDF-"
    assert len(list(tmp_path.iterdir())) == 6

    for command, *options in (["stack", *distances], ["views", "--count", 2]):
        run(command, raw, "-o", tmp_path / "plain.png", "--scale", 1, *options)
        run(command, raw, "-o", tmp_path / "large.png", "--scale", 3, *options)
        plain, large = (np.asarray(Image.open(tmp_path / f"{name}.png")) for name in ("plain", "large"))
        np.testing.assert_array_equal(large[1::3, 1::3], plain)
        assert large.shape == (3 * plain.shape[0], 3 * plain.shape[1])
    run("epi", raw, "-o", tmp_path / "large.png", "--scale", 1)
    assert Image.open(tmp_path / "large.png").size == (8, lf.sizes["u"])

    assert "46 images from 236 to 244 mm and back" in run(
        "stack", raw, "-o", tmp_path / "a.gif", *distances, "--scale", 2
    )
    with Image.open(tmp_path / "a.gif") as picture:
        assert (picture.n_frames, picture.size) == (46, (16, 16))
    assert "one after the other" in run("views", raw, "-o", tmp_path / "b.gif")
    assert Image.open(tmp_path / "b.gif").size == (480, 480)
