"""Scenes in metres: scaled by the loader as by hand, what cannot be scaled refused, and warned of everywhere."""

import re
import warnings

import mitsuba as mi
import numpy as np
import pytest
from cases import facing, radiating

import mitsuba_plenoptic as mp

_WORDS = r"the whole scene is nearer than 4\.9 mm, within the main lens's focal length of 6\.84 mm: .* "


def matte(reflectance):
    return {"type": "diffuse", "reflectance": reflectance}


def described(volume, length, power=1.0, **lamp):
    """Describe a scene by hand whose lengths are multiplied by `length`, its lamps at points by `power`."""
    transform = mi.ScalarTransform4f

    def at(*place):
        return transform().translate([length * value for value in place])

    def fog(place, name, density):
        cube = {"type": "cube", "to_world": place @ transform().scale(0.5 * length), "bsdf": {"type": "null"}}
        return cube | {"interior": {"type": name, "sigma_t": density, "scale": 1 / length, "albedo": 0.7}}

    cloud = {"type": "gridvolume", "filename": str(volume), "to_world": at(-1, -1, 2.5) @ transform().scale(2 * length)}
    large = transform().scale(3 * length)
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
        "first": {
            "type": "instance",
            "to_world": at(0.5, -1, 1) @ transform().rotate([1, 0, 0], 30).scale([2, 1, 1]),
            "group": {"type": "ref", "id": "group"},
        },
        "lamp": {"type": "point", "position": [length, 2 * length, 0], "intensity": lamp.get("point", 8 * power)},
        "spot": {
            "type": "spot",
            "to_world": transform().look_at([-length, 0, -length], [0, 0, 3 * length], [0, 1, 0]),
            "intensity": 20 * power,
        },
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
    """As dictionaries and as files."""
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


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_lamps_of_any_colour_are_scaled(variant):
    mi.set_variant(variant)
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
