"""The built-in scenes: what stands where, that parameters reach it, and that the meshes can be made again."""

import math
import re
import warnings
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from built_in_scenes import figures
from built_in_scenes.mesh import flat_mesh
from cameras import BUILT_IN
from cases import facing, film, radiating
from make_meshes import write_all

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError, PlenopticCamera, estimate_capture, load_scene, render_capture, scene_path
from mitsuba_plenoptic.scene.capture import pass_counts

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("letters", "white", "chart", "still_life", "vitrine", "colour_chart")
DISTANCES = {"eight": 210.0, "f": 240.0, "hash": 280.0}


def load(name, **parameters):
    return mi.load_file(str(scene_path(name)), **{"resolution": "64", **parameters})


def boxes(scene):
    return {shape.id(): np.array([shape.bbox().min, shape.bbox().max]) for shape in scene.shapes()}


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


def test_letters_stand_where_they_should_and_scale_in_their_planes():
    found, small = boxes(load("letters")), boxes(load("letters", letter_scale="0.25"))
    assert set(found) == set(DISTANCES)
    for (name, distance), place in zip(DISTANCES.items(), (1, 0, -1), strict=True):
        low, high = found[name]
        assert low[2] == high[2] == distance
        np.testing.assert_allclose([low[1], high[1]], [-2, 2], atol=1e-6)
        np.testing.assert_allclose((low[0] + high[0]) / 2, place * 3.2 * distance / 240, atol=1e-5)
        np.testing.assert_allclose(small[name], [low * [0.25, 0.25, 1], high * [0.25, 0.25, 1]], atol=1e-6)


def test_letters_read_from_left_to_right():
    resolution = 256
    view = {"fov": math.degrees(2 * math.atan(8.192 / 2 / 120)), "film": film(resolution, resolution)}
    pinhole = mi.load_dict({"type": "perspective", **view})
    image = np.array(mi.render(load("letters"), sensor=pinhole, spp=64, seed=1))[..., 0]
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


@pytest.mark.slow
def test_meshes_and_textures_come_out_the_same(tmp_path):
    made = {path.relative_to(tmp_path) for path in write_all(tmp_path)}
    scenes = ROOT / "scenes"
    committed = (path for pattern in ("*.png", "*.hdr", "meshes/*.ply") for path in scenes.glob(pattern))
    assert made == {path.relative_to(scenes) for path in committed}
    for path in made:
        assert (tmp_path / path).read_bytes() == (scenes / path).read_bytes(), path
    kept = (path for path in scenes.rglob("*") if path.suffix in (".png", ".hdr", ".ply", ".xml"))
    assert sum(path.stat().st_size for path in kept) < 2**20


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
    for spp in (28, 40, 7):
        told = lambda count, total, spp=spp: done.append(count * spp // total)  # noqa: E731
        render_capture(scene, model="ray", spp=spp, progress=told)
    assert done == [16, 24, 28, 16, 32, 40, 4, 6, 7]


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


_WORDS = r"the whole scene is nearer than 4\.9 mm, within the main lens's focal length of 6\.84 mm: .* "


def matte(reflectance):
    return {"type": "diffuse", "reflectance": reflectance}


def described(volume, length, power=1.0):
    """Describe a scene by hand whose lengths are multiplied by `length`, its lamps at points by `power`."""
    transform = mi.ScalarTransform4f

    def at(*place):
        return transform().translate([length * value for value in place])

    def fog(place, name, density):
        cube = {"type": "cube", "to_world": place @ transform().scale(0.5 * length), "bsdf": {"type": "null"}}
        return cube | {"interior": {"type": name, "sigma_t": density, "scale": 1 / length, "albedo": 0.7}}

    cloud = {"type": "gridvolume", "filename": str(volume), "to_world": at(-1, -1, 2.5) @ transform().scale(2 * length)}
    large, tilted = transform().scale(3 * length), at(0.5, -1, 1) @ transform().rotate([1, 0, 0], 30).scale([2, 1, 1])
    aimed = transform().look_at([-length, 0, -length], [0, 0, 3 * length], [0, 1, 0])
    stand = {"type": "cylinder", "p1": [0, 0, 0.5 * length], "radius": 0.1 * length, "to_world": at(0, 0, 0)}
    heights = {"type": "bitmap", "filename": str(volume.with_suffix(".exr")), "raw": True}
    checks = matte({"type": "checkerboard", "to_uv": transform().scale(5)})
    bumps = {"type": "bumpmap", "arbitrary": heights, "scale": 0.2 * length, "bsdf": checks}
    return {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 4},
        "camera": {
            "type": "perspective",
            "to_world": transform().look_at([0, 0, -2 * length], [0, 0, length], [0, 1, 0]),
            "near_clip": 1.5 * length,
            "far_clip": 1e3 * length,
            "film": {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}},
        },
        # Nearer than the camera sees.
        "near": {"type": "sphere", "radius": 0.3 * length, "center": [0.2 * length, 0, -length]},
        "wall": facing(3 * length, 3 * length, bsdf=matte({"type": "volume", "volume": cloud})),
        "bumpy": facing(2 * length, 0.7 * length, (-length, length), bsdf=bumps),
        "mist": fog(at(0.9, 0, 1.5), "homogeneous", 1.5),
        "cloud": fog(at(-0.9, -0.8, 1.5), "heterogeneous", cloud | {"to_world": at(-2, -2, 0) @ large}),
        "group": {"type": "shapegroup", "stand": stand},
        "first": {"type": "instance", "to_world": tilted, "group": {"type": "ref", "id": "group"}},
        "lamp": {"type": "point", "position": [length, 2 * length, 0], "intensity": 8 * power},
        "spot": {"type": "spot", "to_world": aimed, "intensity": 20 * power},
        "glow": facing(2 * length, 0.4 * length, (1.5 * length, 1.5 * length), **radiating(3.0)),
        "sky": {"type": "constant", "radiance": 0.1},
    }


@pytest.fixture
def volume(tmp_path):
    """Write a volume of densities, and heights of bumps next to it."""
    mi.set_variant("llvm_ad_mono")
    random = np.random.default_rng(0)
    path = tmp_path / "grid.vol"
    mi.VolumeGrid(random.random((4, 4, 4, 1), np.float32)).write(str(path))
    mi.Bitmap(random.random((8, 8), np.float32)).write(str(path.with_suffix(".exr")))
    return path


def test_scaled_scenes_look_like_those_scaled_by_hand(volume, tmp_path):
    config = mi.parser.ParserConfig("llvm_ad_mono")
    path = tmp_path / "scene.xml"
    mi.parser.write_file(mi.parser.parse_dict(config, described(volume, 1.0)), str(path))
    assert mp.load_scene(path, unit="m").bbox().max.z == pytest.approx(3000)
    known = mi.render(mp.load_scene(described(volume, 1e3, 1e6)), spp=16, seed=1).numpy()
    found = mi.render(mp.load_scene(path, unit="m"), spp=16, seed=1).numpy()
    assert np.quantile(np.abs(found - known), 0.9) < 1e-3 * known.mean()
    found = mi.render(mp.load_scene(described(volume, 1.0), unit="m"), spp=16, seed=1).numpy()
    # Few rays, at edges, go either way, by rounding.
    assert np.quantile(np.abs(found - known), 0.9) < 1e-4 * known.mean()
    assert abs(found.mean() - known.mean()) < 2e-3 * known.mean()


def test_lamps_of_any_colour_are_scaled():
    mi.set_variant("llvm_ad_spectral")
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 4]).rotate([0, 1, 0], 180)}
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 10, "film": film}
    for colour in ({"type": "rgb", "value": [1, 2, 3]}, {"type": "spectrum", "value": [(400, 1), (700, 3)]}):
        lamp = {"type": "point", "intensity": colour}
        scene = {"type": "scene", "integrator": {"type": "path"}, "camera": camera, "wall": wall, "lamp": lamp}
        small, large = (mi.render(mp.load_scene(scene, unit=unit), spp=16, seed=1).numpy() for unit in ("mm", "m"))
        np.testing.assert_allclose(large, small, rtol=1e-4)
        assert small.min() > 0


@pytest.mark.parametrize(
    ("turned", "height", "told"),
    [((0, 1, 0, 180), 0, True), ((1, 0, 0, 90), 0, True), ((1, 0, 0, 90), -4.9, True), ((1, 0, 0, 90), -5.1, False)],
)
def test_a_camera_that_touches_a_surface_is_told_so(turned, height, told):
    mi.set_variant("llvm_ad_mono")
    T, camera = mi.ScalarTransform4f, mp.PlenopticCamera(detector_width=0.064, resolution=(32, 32))
    wall = T().translate([0, height, 0]).rotate(turned[:3], turned[3]).scale(500)
    scene = {"type": "scene", "wall": {"type": "rectangle", "to_world": wall}}
    scene["ball"] = {"type": "sphere", "center": [0, 0, 240], "radius": 9.0}
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        mp.with_camera(mp.load_scene(scene), camera)
    assert [str(each.message).startswith("a surface touches the camera's main lens") for each in found] == [True] * told


def test_scenes_in_metres_are_warned_of_everywhere():
    mi.set_variant("llvm_ad_mono")
    camera = mp.PlenopticCamera.preset("lytro")
    box = mi.cornell_box()
    with pytest.warns(UserWarning, match=_WORDS + r"load_scene\(..., unit=\"m\"\) scales them$"):
        mp.with_camera(mp.load_scene(box), camera)
    with pytest.warns(UserWarning, match=_WORDS):
        seen = mp.with_camera(mp.load_scene(box), camera.replace(resolution=(20, 20), detector_width=0.028))
    with pytest.warns(UserWarning, match=_WORDS):
        mp.render_capture(seen, spp=1)
    sensor = camera.to_sensor(to_world=box["sensor"]["to_world"])
    with pytest.warns(UserWarning, match=_WORDS):
        mp.load_scene({**box, "sensor": sensor})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mp.with_camera(mp.load_scene(box, unit="m"), camera)


@pytest.mark.parametrize(
    ("preset", "depth", "words"),
    [
        # The focal length is 6.84 mm, and what is 106.6 mm away or more is made sharp.
        ("lytro", 40.0, r"nearer than 40 mm, and refocusing makes nothing sharp that is nearer than 106\.6 mm"),
        ("lytro", 60.0, None),
        ("lytro", 230.0, None),
        # The focal length is 80 mm, and what is 188.5 mm away or more is made sharp.
        *(("paper", depth, f"the whole scene is nearer than {depth:g} mm") for depth in (79.0, 81.0, 94.0)),
    ],
)
def test_scenes_within_half_of_what_is_sharp_are_told(preset, depth, words):
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, depth]).scale(0.5)}
    scene = {"type": "scene", "wall": wall, "sensor": mp.PlenopticCamera.preset(preset).to_sensor()}
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        mp.load_scene(scene, variant="llvm_ad_mono")
    told = [str(one.message) for one in found]
    assert [bool(re.search(words, one)) for one in told] == [True] if words else not told
