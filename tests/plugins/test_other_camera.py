"""Scenes seen by another camera than their own."""

import threading
import time

import mitsuba as mi
import numpy as np
import pytest
from cameras import SMALL_SENSOR, write_scene

import mitsuba_plenoptic as mp

ORDINARY = mp.PlenopticCamera(
    mla_lattice="none", focal_length=50, aperture_radius=5, focus_distance=400, resolution=(24, 18), detector_width=24
)
"""A camera without an array, whose pictures are quickly taken."""


def test_objects_without_names_and_the_film_of_colours_are_kept(tmp_path):
    text = '<emitter type="constant"/><shape type="sphere"/><shape type="cube"/>'
    scene = mp.load_scene(write_scene(tmp_path, text, sensor=SMALL_SENSOR, pixel_format="rgb"), variant="llvm_ad_rgb")
    made = mp.with_camera(scene, mp.PlenopticCamera(detector_width=0.128, resolution=(32, 32)))
    assert len(made.shapes()) == 2
    assert mp.render_capture(made, spp=1).image.shape == (32, 32, 3)


def test_a_scene_without_a_camera_is_seen_from_the_origin(tmp_path):
    text = '<scene version="3.0.0"><integrator type="path"/><shape type="sphere"/></scene>'
    (tmp_path / "scene.xml").write_text(text)
    lytro = mp.PlenopticCamera.preset("lytro")
    camera = lytro.replace(mla_tilt=(0.1, -0.2), distortion=(1e-4, -1e-6, 1e-8, 1e-5, -2e-5))
    sensor = mp.with_camera(mp.load_scene(tmp_path / "scene.xml"), camera).sensors()[0]
    assert mp.PlenopticCamera.from_sensor(sensor) == camera
    assert np.array_equal(np.ravel(sensor.world_transform().translation()), [0, 0, 0])


def garden(sensor, size=1.0):
    """Describe two instances of a group of textured shapes, a lamp, and a meter on a wall before a sensor."""
    T, tiny = mi.ScalarTransform4f, {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    checks = {"type": "checkerboard", "to_uv": mi.ScalarTransform3f().scale([6, 6])}
    box = {"type": "cube", "to_world": T().translate([20 * size, 0, 0]).scale(8 * size)}
    ball = {"type": "sphere", "radius": 10 * size, "bsdf": {"type": "diffuse", "reflectance": checks}}
    tree, lamp = {"tree": {"type": "ref", "id": "tree"}}, {"type": "area", "radiance": 3.0}
    wall = T().translate([0, 0, 600 * size]).rotate([0, 1, 0], 180).scale(200 * size)
    return {
        "type": "scene",
        "integrator": {"type": "direct"},
        "0-wall": {"type": "rectangle", "to_world": wall, "meter": {"type": "irradiancemeter", "film": tiny}},
        "sky": {"type": "constant"},
        "tree": {"type": "shapegroup", "ball": ball, "box": box},
        "i": {"type": "instance", **tree, "to_world": T().translate([-30 * size, 0, 400 * size])},
        "j": {"type": "instance", **tree, "to_world": T().translate([20 * size, 20 * size, 400 * size]).scale(1.5)},
        "key-light": {"type": "sphere", "center": [20 * size, -20 * size, 380 * size], "radius": 4 * size, "e": lamp},
        "Camera": sensor,
    }


def ids(scene):
    """Return the ids of all that a scene shows, by which `mi.traverse` names it."""
    named = {key.partition(".")[0] for key in mi.traverse(scene).keys()}  # noqa: SIM118 (no plain mapping)
    return sorted(named | {each.id() for each in scene.shapes()})


def test_instances_ids_and_meters_stay_and_the_picture_is_that_of_the_scenes_own_camera():
    scene, pinhole = mp.load_scene(garden(ORDINARY.to_sensor())), {"type": "perspective"}
    with pytest.raises(mp.InputError, match=r"IrradianceMeter: .*sensor=1"):
        mp.render_capture(scene)
    own = {model: mp.render_capture(scene, sensor=1, model=model, spp=16).image for model in ("ray", "wave")}
    for given, models in (
        (mi.load_dict(garden(pinhole), parallel=False), ["ray"]),
        (mp.load_scene(garden(pinhole, 1e-3), unit="m"), ["ray", "wave"]),
    ):
        before, made = ids(given), mp.with_camera(given, ORDINARY)
        assert ids(given) == ids(made) == ids(mp.with_camera(made, ORDINARY)) == before
        assert {"0-wall", "tree", "i", "j", "key-light", "Camera"} <= set(before)
        for model in models:
            np.testing.assert_allclose(mp.render_capture(made, model=model, spp=16).image, own[model], atol=1e-5)


def test_files_dictionaries_and_names_stand_for_scenes_and_presets_for_cameras(tmp_path):
    path = write_scene(tmp_path)
    assert mp.with_camera(path, "lytro").sensors()[0].camera == mp.PlenopticCamera.preset("lytro")
    described = {"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant"}}
    described["camera"] = ORDINARY.to_sensor()
    images = [mp.render_capture(scene, spp=4).image for scene in (described, mp.load_scene(described))]
    np.testing.assert_array_equal(*images)
    assert mp.estimate_capture(described, spp=4).seconds > 0
    assert mp.ground_truth(described).camera == ORDINARY
    assert mp.with_camera(str(path), ORDINARY).sensors()[0].camera == ORDINARY


def test_the_camera_stands_where_the_named_or_the_first_camera_stood():
    T, tiny = mi.ScalarTransform4f, {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    line = {"type": "radiancemeter", "film": tiny, "to_world": T().translate([1, 0, 0])}
    cameras = {name: {"type": "perspective", "to_world": T().translate([x, 0, 0])} for name, x in (("b", 2), ("c", 3))}
    scene = mp.load_scene({"type": "scene", "ball": {"type": "sphere", "center": [0, 0, 400]}, "a": line, **cameras})
    for sensor, name, x in ((None, "b", 2), (0, "a", 1), (1, "b", 2), (2, "c", 3)):
        (made,) = mp.with_camera(scene, ORDINARY, sensor).sensors()
        assert (made.id(), made.world_transform().translation().x[0]) == (name, x)
    with pytest.raises(mp.InputError, match="sensor = 3"):
        mp.with_camera(scene, ORDINARY, sensor=3)
    batch = {"type": "batch", "film": {"type": "hdrfilm", "width": 4}, **cameras}
    both = mp.load_scene({"type": "scene", "both": batch})
    with pytest.raises(mp.InputError, match="sensor BatchSensor 'both'"):
        mp.with_camera(both, ORDINARY)


@pytest.mark.parametrize(
    ("variant", "kind", "channels"),
    [
        ("llvm_ad_mono", "rgb", ()),
        ("llvm_ad_rgb", "luminance", (3,)),
        ("llvm_ad_spectral", "xyz", (3,)),
        ("llvm_ad_spectral", "luminance_alpha", ()),
    ],
)
def test_the_colours_of_the_film_are_kept(variant, kind, channels):
    mi.set_variant(variant)
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}}
    scene = {"type": "scene", "integrator": {"type": "path"}, "sky": sky, "camera": {"type": "perspective"}}
    scene["camera"] |= {} if kind is None else {"film": {"type": "hdrfilm", "pixel_format": kind}}
    image = mp.render_capture(mp.with_camera(mp.load_scene(scene), ORDINARY), model="ray", spp=64).image
    assert image.shape[2:] == channels
    known = [0.7, 0.4, 0.2] if channels else [float(mi.luminance(mi.ScalarColor3f([0.7, 0.4, 0.2]))[0])]
    np.testing.assert_allclose(image.reshape(-1, len(known)).mean(0), known, atol=0.005)


def test_bands_of_a_spectral_film_are_not_lost_without_a_word():
    mi.set_variant("llvm_ad_spectral")
    film = {"type": "specfilm", "green": {"type": "spectrum", "value": [(500, 1), (600, 1)]}}
    scene = mp.load_scene({"type": "scene", "camera": {"type": "perspective", "film": film}})
    with pytest.warns(UserWarning, match="specfilm"):
        assert mp.with_camera(scene, ORDINARY).sensors()[0].film().base_channels_count() == 3


def test_samplers_are_asked_for_no_other_count_and_keep_theirs(capfd):
    sensor = ORDINARY.to_sensor() | {"sampler": {"type": "orthogonal", "sample_count": 25}}
    described = {"type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"}, "camera": sensor}
    scene = mp.load_scene(described)
    for model in ("ray", "wave"):
        mp.render_capture(scene, model=model)
    mp.render_capture(scene, model="ray", spp=4)
    assert scene.sensors()[0].sampler().sample_count() == 25
    assert "WARN" not in "".join(capfd.readouterr())


def test_plugins_are_made_in_the_thread_that_loads(tmp_path):
    """Others would wait for the interpreter with whatever they hold, messages of Dr.Jit, for example."""
    found = []

    class Probe(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            # Meanwhile other threads, if there are any, take the next plugin.
            time.sleep(0.005)
            found.append(threading.get_ident())

    mi.register_bsdf("probe", Probe)
    shapes = {f"ball{index}": {"type": "sphere", "bsdf": {"type": "probe"}} for index in range(4)}
    text = "".join('<shape type="sphere"><bsdf type="probe"/></shape>' for _ in range(4))
    for unit in ("mm", "m"):
        mp.load_scene({"type": "scene", **shapes}, unit=unit)
        mp.load_scene(write_scene(tmp_path, text), unit=unit)
    assert found == [threading.get_ident()] * 16


def shapes(x):
    T, lamp = mi.ScalarTransform4f(), {"type": "area", "radiance": 2.0}
    copy = {"type": "instance", "to_world": T.translate([-40, x, 400]).scale(8), "tree": {"type": "ref", "id": "group"}}
    return {
        **{"type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant", "radiance": 0.1}},
        "box": {"type": "cube", "to_world": T.translate([x, 0, 400]).scale(8), "lamp": lamp},
        "ball": {"type": "sphere", "center": [40 - x, 0, 400], "radius": 8, "lamp": lamp},
        "group": {"type": "shapegroup", "cube": {"type": "cube"}},
        "copy": copy,
    }


@pytest.mark.parametrize(
    ("seen", "back"),
    [
        (lambda scene: np.array(mi.render(scene, spp=16, integrator=mi.load_dict({"type": "prb"}))), False),
        (lambda scene: mp.render_capture(scene, spp=16).image, True),
        (lambda scene: mp.render_capture(scene, spp=16, model="wave").image, False),
        (lambda scene: np.nan_to_num(mp.ground_truth(scene, ["depth"]).pixels["depth"], posinf=0), True),
    ],
)
def test_shapes_move_in_both_scenes(seen, back):
    mi.set_variant("llvm_ad_mono")
    first = mp.with_camera(mp.load_scene(shapes(0)), ORDINARY)
    moved = mp.with_camera(first, ORDINARY)
    if back:
        first, moved = moved, first
    before = seen(moved)
    parameters = mi.traverse(first)
    parameters["box.vertex_positions"] = parameters["box.vertex_positions"] + mi.Float([30, 0, 0] * 24)
    for name, step in (("ball", [-30, 0, 0]), ("copy", [0, 30, 0])):
        parameters[f"{name}.to_world"] = mi.Transform4f().translate(step) @ parameters[f"{name}.to_world"]
    parameters.update()
    after = seen(moved)
    assert np.array_equal(after, seen(mp.with_camera(mp.load_scene(shapes(30)), ORDINARY)))
    assert not np.array_equal(after, before)
