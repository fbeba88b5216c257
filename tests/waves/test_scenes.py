"""The built-in scenes: what stands where, that parameters reach it, and that the meshes can be made again."""

import math
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from built_in_scenes import figures
from built_in_scenes.mesh import flat_mesh
from cameras import BUILT_IN
from cases import film
from make_meshes import write_all

from mitsuba_plenoptic import InputError, PlenopticCamera, estimate_capture, load_scene, render_capture, scene_path
from mitsuba_plenoptic.scene.capture import pass_counts

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("letters", "white", "chart", "still_life", "vitrine", "colour_chart")
DISTANCES = {"eight": 210.0, "f": 240.0, "hash": 280.0}
STILL_LIFE = ("table", "backdrop", "pawn", "die", "ball", "lambda", "knot", "window", "lamp")


def load(name, **parameters):
    return mi.load_file(str(scene_path(name)), **{"resolution": "64", **parameters})


def thin_camera(resolution, **parameters):
    """Build one of Mitsuba's own cameras with the view of the plenoptic one."""
    view = {"fov": math.degrees(2 * math.atan(8.192 / 2 / 120)), "film": film(resolution, resolution)}
    return mi.load_dict({"type": "perspective", **view, **parameters})


def first_rays(resolution):
    """Return the rays of a thin camera through the middles of its pixels."""
    x, y = dr.meshgrid(*[(dr.arange(mi.Float, resolution) + 0.5) / resolution] * 2)
    return thin_camera(resolution).sample_ray(0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))[0]


def render(scene, resolution=128, spp=64, **parameters):
    return np.array(mi.render(scene, sensor=thin_camera(resolution, **parameters), spp=spp, seed=1))[..., 0]


def shapes(scene):
    return {shape.id(): shape for shape in scene.shapes()}


def box(shape):
    return np.array(shape.bbox().min), np.array(shape.bbox().max)


@pytest.mark.parametrize("name", NAMES)
def test_camera_and_film_are_the_papers_and_parameters_reach_them(name):
    scene = mi.load_file(str(scene_path(name)))
    assert PlenopticCamera.from_sensor(scene.sensors()[0]) == PlenopticCamera()
    plate = scene.sensors()[0].film()
    plate.prepare([])
    assert plate.rfilter().class_name() == "BoxFilter" and plate.bitmap().pixel_format() == mi.Bitmap.PixelFormat.Y
    assert not [key for key in mi.traverse(scene).properties if "object_" in key]
    changed = {
        "detector_width": 2.048, "focal_length": 70.0, "aperture_radius": 4.0, "mla_distance": 110.0,
        "mla_focal_length": 0.4, "mla_pitch": 0.05, "lens_model": "parabolic",
    }  # fmt: skip
    scene = load(name, resolution="96", spp="9", **{key: str(value) for key, value in changed.items()})
    sensor = scene.sensors()[0]
    camera = PlenopticCamera.from_sensor(sensor)
    assert sensor.sampler().sample_count() == 9
    assert camera.resolution == (96, 96) and camera.pixels_per_lens == pytest.approx(96 * 0.05 / 2.048, rel=0.01)
    for key, value in changed.items():
        assert getattr(camera, key) == (pytest.approx(value) if isinstance(value, float) else value)
    # Nobody asked for another detector distance, so the detector stays in the microlenses' focus.
    assert camera.detector_distance == pytest.approx(0.4)


@pytest.mark.parametrize("name", [name for name in BUILT_IN if name not in NAMES])
def test_resolution_samples_the_same_detector(name):
    full = load_scene(name).sensors()[0].camera
    columns = full.resolution[0] // 20
    camera = load_scene(name, parameters={"resolution": str(columns)}).sensors()[0].camera
    assert camera.resolution[0] == columns
    assert camera.detector_width == full.detector_width
    # As near to the detector's shape as whole pixels come.
    assert camera.detector_height == pytest.approx(full.detector_height, abs=camera.pixel_size / 2)
    assert camera.pixels_per_lens == pytest.approx(full.pixels_per_lens * columns / full.resolution[0])


@pytest.mark.parametrize(
    ("name", "variant"),
    [("vitrine", "llvm_ad_mono"), ("colour_chart", "llvm_ad_rgb"), ("colour_chart", "llvm_ad_spectral")],
)
def test_renders_in_every_colour_mode(name, variant):
    mi.set_variant(variant)
    capture = np.array(mi.render(load(name, mla_pitch="0.512", mla_focal_length="4.096"), spp=4, seed=3))
    coloured = name == "colour_chart" and variant != "llvm_ad_mono"
    assert capture.shape == (64, 64, 3 if coloured else 1)
    assert np.isfinite(capture).all()
    assert capture.max() > 0.5


def test_letters_stand_where_they_should_and_scale_in_their_planes():
    found, small = shapes(load("letters")), shapes(load("letters", letter_scale="0.25"))
    assert set(found) == set(DISTANCES)
    for (name, distance), place in zip(DISTANCES.items(), (1, 0, -1), strict=True):
        low, high = box(found[name])
        assert low[2] == high[2] == distance
        np.testing.assert_allclose([low[1], high[1]], [-2, 2], atol=1e-6)
        np.testing.assert_allclose((low[0] + high[0]) / 2, place * 3.2 * distance / 240, atol=1e-5)
        np.testing.assert_allclose(box(small[name]), [low * [0.25, 0.25, 1], high * [0.25, 0.25, 1]], atol=1e-6)


def test_letters_read_from_left_to_right():
    resolution = 256
    image = render(load("letters"), resolution)
    assert image.max() == pytest.approx(1, abs=1e-5)
    bright = np.flatnonzero(image.sum(axis=0))
    runs = np.split(bright, np.flatnonzero(np.diff(bright) > 1) + 1)
    assert len(runs) == 3
    pixel = 8.192 / 120 * 240 / resolution
    v, u = (0.5 * resolution - 0.5 - np.arange(resolution)) * pixel, (np.arange(resolution) + 0.5) * pixel
    outlines = (figures.letter_eight(), figures.letter_f(), figures.letter_hash())
    for run, outline, distance, place in zip(runs, outlines, DISTANCES.values(), (-3.2, 0, 3.2), strict=True):
        letter = image[:, run]
        # Area and middle tell the letters apart, and each from its mirror images.
        w, (y, x) = letter.sum(), np.meshgrid(v, u[run] - 8.192 - place, indexing="ij")
        mesh, scale = flat_mesh(outline), 240 / distance
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        areas = np.abs(np.cross(b - a, c - a)[:, 2]) / 2
        # +x is to the left.
        middle = areas @ ((a + b + c) / 3)[:, :2] / areas.sum() * (-scale, scale)
        seen = w * pixel**2, (letter * x).sum() / w, (letter * y).sum() / w
        np.testing.assert_allclose(seen, [areas.sum() * scale**2, *middle], atol=0.02, rtol=0.005)


def test_white_wall_fills_the_view():
    scene, aperture = load("white"), 10.0
    low, high = box(shapes(scene)["wall"])
    assert low[2] == high[2] == 240.0
    camera = PlenopticCamera(aperture_radius=aperture)
    # Any MLA point that the detector sees, through any pupil point.
    edge = (camera.detector_width / 2 + camera.mla_pitch) * 240.0 / 120.0
    assert min(-low[0], high[0], -low[1], high[1]) > edge + aperture
    image = render(scene, 64, 64, type="thinlens", aperture_radius=aperture, focus_distance=200.0)
    np.testing.assert_allclose(image, 1, atol=1e-5)
    assert box(shapes(load("white", wall_distance="300"))["wall"])[0][2] == 300.0


def test_still_life_shows_everything_between_200_and_300():
    scene = load("still_life")
    found = shapes(scene)
    assert set(STILL_LIFE) <= set(found)
    resolution = 128
    image = render(scene, resolution, 16)
    assert np.isfinite(image).all()
    # A typical surface is between 0.1 and 1, and nothing is black.
    assert np.mean((image > 0.08) & (image < 1)) > 0.75
    assert image.min() > 0

    hit = scene.ray_intersect(first_rays(resolution))
    depth = np.array(hit.p.z)
    assert depth.min() > 190
    assert depth.max() < 300.01
    for name, shape in found.items():
        count = np.count_nonzero(np.array(hit.shape == mi.ShapePtr(shape)))
        if name in ("window", "lamp"):
            assert count == 0
        elif not name.startswith("pearl"):
            assert count > 100, name


@pytest.mark.slow
def test_meshes_and_textures_come_out_the_same(tmp_path):
    made = {path.relative_to(tmp_path) for path in write_all(tmp_path)}
    scenes = ROOT / "scenes"
    committed = {
        path.relative_to(scenes) for pattern in ("*.png", "*.hdr", "meshes/*.ply") for path in scenes.glob(pattern)
    }
    assert made == committed
    for path in made:
        assert (tmp_path / path).read_bytes() == (scenes / path).read_bytes(), path
    assert (
        sum(path.stat().st_size for path in scenes.rglob("*") if path.suffix in (".png", ".hdr", ".ply", ".xml"))
        < 2**20
    )


def test_dictionaries_are_scenes_and_any_sensor_renders(camera_dict):
    far = camera_dict(resolution=64, detector_width=0.128, focus_distance=300.0)
    world = {"type": "scene", "integrator": {"type": "path"}, "light": {"type": "constant"}}
    scene = load_scene(world | {"near": camera_dict(resolution=64, detector_width=0.128), "far": far})
    capture = render_capture(scene, sensor=1, spp=2)
    assert capture.camera.focus_distance == pytest.approx(300)
    assert (capture.metadata["scene"], capture.metadata["sensor"]) == ("dictionary", 1)
    assert render_capture(scene, spp=2).camera.focus_distance == pytest.approx(240)
    # A sensor of its own, as `mi.render` takes one.
    np.testing.assert_array_equal(render_capture(scene, sensor=mi.load_dict(far), spp=2).image, capture.image)
    assert estimate_capture(scene, sensor=1, spp=2).seconds > 0
    for wrong in (2, -1, "far"):
        with pytest.raises(InputError, match="sensor = "):
            render_capture(scene, sensor=wrong)
    for described, options, thing in (
        ({"type": "scene"}, {"parameters": {"spp": "4"}}, "a dictionary"),
        ({"type": "sphere"}, {}, "'sphere'"),
        ({"type": "scene", "sensor": camera_dict(focal_lenght=3.0)}, {}, "focal_lenght"),
        ({"type": "scene", "sensor": camera_dict(focal_length=None)}, {}, r"sensor\.focal_length = None"),
        ({"type": "scene", "sensor": camera_dict(focal_length=None)}, {"unit": "m"}, r"sensor\.focal_length = None"),
    ):
        with pytest.raises(InputError, match=thing):
            load_scene(described, **options)


def test_passes_of_large_ray_captures_have_a_power_of_two_of_samples(monkeypatch):
    """So that no two threads add samples of one pixel, in an order that varies."""
    mi.set_variant("llvm_ad_mono")
    scene, done = load_scene("letters", parameters={"resolution": "32", "detector_width": "0.064"}), []
    monkeypatch.setattr("mitsuba_plenoptic.scene.capture._RAYS_PER_PASS", 28 * 32**2)
    monkeypatch.setattr("mitsuba_plenoptic.runtime.batches._LOOK", 1e9)
    for spp in (28, 40):
        render_capture(
            scene, model="ray", spp=spp, progress=lambda count, total, spp=spp: done.append(count * spp // total)
        )
    assert done == [16, 24, 28, 16, 32, 40]
    render_capture(scene, model="ray", spp=7, progress=lambda count, total: done.append(count * 7 // total))
    assert done[6:] == [4, 6, 7]


@pytest.mark.parametrize(
    ("sampler", "spp", "counts"),
    [
        ("independent", 2**14 + 3, [2**14, 2, 1]),
        ("stratified", 100, [64, 16, 16, 4]),
        ("stratified", 3, [1, 1, 1]),
        ("ldsampler", 5, [4, 4]),
    ],
)
def test_passes_have_counts_that_the_sampler_draws(camera_dict, sampler, spp, counts):
    sensor = mi.load_dict(camera_dict(resolution=4) | {"sampler": {"type": sampler, "sample_count": 4}})
    assert pass_counts(sensor, spp, 2**20) == counts
