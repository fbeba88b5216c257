"""Ground truth against analytic surfaces, mirrors and rays."""

import math

import cases
import mitsuba as mi
import numpy as np
import pytest
from light_field_cases import CAMERAS
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views import depth_error, depth_map, pick_views

QUANTITIES = ("depth", "virtual_depth", "position", "normal", "albedo", "shape_index")

CAMERA = mp.PlenopticCamera(detector_width=0.96, resolution=(240, 180))
"""15 x 11 lenses of 16 pixels."""

ORIGIN = [30, -20, 55]


def pose():
    return mi.ScalarTransform4f().translate(ORIGIN).rotate([0, 1, 0], 35).rotate([1, 0, 0], -12).rotate([0, 0, 1], 8)


def scene_of(camera, to_world, **objects):
    """Put objects, given in the camera's frame, before a camera."""
    placed = {name: thing | {"to_world": to_world @ thing["to_world"]} for name, thing in objects.items()}
    return mp.load_scene({"type": "scene", "sensor": camera.to_sensor(to_world), **placed})


def still(camera, to_world):
    """A sphere before a slanted plane, which leaves a part of the view empty."""
    plane = mi.ScalarTransform4f().translate([0.3, 0, 262]).rotate([0, 1, 0], 150).scale([0.7, 2, 1])
    ball = mi.ScalarTransform4f().translate([-0.2, 0.1, 226]).scale(0.35)
    grey = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.3}}
    return scene_of(
        camera, to_world,
        plane={"type": "rectangle", "to_world": plane, "bsdf": {"type": "twosided", "bsdf": grey}},
        ball={"type": "sphere", "to_world": ball},
    )  # fmt: skip


def chief_rays(camera):
    """Origins on the pupil and slopes, per pixel, of rays through the centres of lenses, by the textbook's formulas."""
    b, z, f1 = camera.mla_distance, camera.detector_distance, camera.focal_length
    y, x = np.meshgrid(*(camera.pixel_coordinates(axis) for axis in (1, 0)), indexing="ij")
    centre = camera.lattice.centre(*camera.lattice.cell(x * b / (b + z), y * b / (b + z)))
    slope = [(c - p) / z for c, p in zip(centre, (x, y), strict=True)]
    pupil = np.stack([c + b * t for c, t in zip(centre, slope, strict=True)])
    return pupil, np.stack(slope) - pupil / f1


def view_rays(camera, lf):
    """Origins and slopes of the samples of a light field, which meet the plane in focus where it says."""
    s, t, u, v = (lf[name].broadcast_like(lf.weight).transpose(*"vuts").values for name in "stuv")
    pupil = np.stack([u, v])
    return pupil, (np.stack([s, t]) - pupil) / camera.focus_distance


def depth_of_ball(pupil, slope, centre, radius):
    """Axial distance of the near side of a ball, infinite where rays miss it."""
    ox, oy, oz = pupil[0] - centre[0], pupil[1] - centre[1], -centre[2]
    a = 1 + slope[0] ** 2 + slope[1] ** 2
    half = ox * slope[0] + oy * slope[1] + oz
    root = half**2 - a * (ox**2 + oy**2 + oz**2 - radius**2)
    return np.where(root > 0, (-half - np.sqrt(np.maximum(root, 0))) / a, np.inf)


@pytest.mark.parametrize(
    ("part", "camera"),
    [
        ("pixels", CAMERAS["turned"].replace(detector_width=0.64, resolution=(320, 256))),
        ("views", CAMERAS["crop"]),
        ("views", CAMERAS["hexagonal, upright"].replace(detector_width=0.64, resolution=(320, 256))),
    ],
)
def test_a_ball_before_a_plane_in_closed_form(part, camera, tmp_path):
    mp.write_ground_truth(tmp_path / "a.truth.exr", mp.ground_truth(still(camera, pose())))
    truth = mp.read_ground_truth(tmp_path / "a.truth.exr")
    assert truth.camera == camera and list(truth.pixels) == list(truth.views) == list(QUANTITIES)
    found = getattr(truth, part)
    if part == "pixels":
        pupil, slope = chief_rays(camera)
    else:
        lf = mp.decode(mp.views.white_image(camera), camera=camera, truth=truth)
        pupil, slope = view_rays(camera, lf)
        np.testing.assert_array_equal(lf.position_x.values, found["position"][..., 0])
    open_ = np.hypot(*pupil) < camera.aperture_radius - 1e-3
    closed = np.hypot(*pupil) > camera.aperture_radius + 1e-3
    assert np.isnan(found["depth"][closed]).all() and not found["shape_index"][closed].any()
    middle, normal = np.array([0.3, 0, 262]), np.array([0.5, 0, -math.sqrt(0.75)])
    # Axial distance at which rays from the pupil meet the plane.
    along, across = (np.tensordot(normal[:2], part, 1) for part in (slope, pupil))
    plane = (middle @ normal - across) / (along + normal[2])
    beside = np.stack([*(pupil + plane * slope), plane], axis=-1) - middle
    # How far within its edges the plane is met.
    within = np.minimum(0.7 - np.abs(beside @ (math.sqrt(0.75), 0, 0.5)), 2 - np.abs(beside[..., 1]))
    plane = np.where(within > 0, plane, np.inf)
    smaller, ball, larger = (depth_of_ball(pupil, slope, (-0.2, 0.1, 226), 0.35 * part) for part in (0.999, 1, 1.001))
    # Rays that graze edges may fall to either side, and the curved side of a sphere magnifies rounding there.
    edge = (np.isfinite(smaller) != np.isfinite(larger)) | (np.abs(within) < 1e-3)
    sure, near, depth = open_ & ~edge, ball < plane, np.minimum(ball, plane)
    met = sure & np.isfinite(depth)
    assert 0.02 < near[open_].mean() < 0.5 and edge[open_].mean() < 0.02 and (sure & ~met).any()
    np.testing.assert_allclose(found["depth"][sure], depth[sure], rtol=4e-6)
    number = {name: 1 + truth.shapes.index(name) for name in ("ball", "plane")}
    index = np.where(near, number["ball"], np.where(np.isfinite(plane), number["plane"], 0))
    assert np.array_equal(found["shape_index"][sure], index[sure])
    for lit, albedo in ((met & near, 0.5), (met & ~near, 0.3)):
        np.testing.assert_allclose(found["albedo"][lit], albedo, rtol=1e-6)
    depth = np.where(met, depth, 0)
    place = np.stack([*(pupil + depth * slope), depth], axis=-1)
    to_world = np.array(pose().matrix, np.float64)
    np.testing.assert_allclose(found["position"][met], (place @ to_world[:3, :3].T + ORIGIN)[met], atol=1e-3)
    outwards = np.where(near[..., None], (place - np.array([-0.2, 0.1, 226])) / 0.35, normal)
    np.testing.assert_allclose((found["normal"] @ to_world[:3, :3])[met], outwards[met], atol=2e-3)
    np.testing.assert_allclose(truth.to_world, to_world, rtol=1e-6)


MIRROR = {"type": "conductor"}


def mirrored(bsdf, kind="rectangle", turned=45.0):
    """Return depth and virtual depth in a mirror 215 mm away, turned to a wall 20 mm aside, parallel to the axis."""
    place = mi.ScalarTransform4f().translate([0, 0, 215])
    mirror = place.rotate([0, 1, 0], 180 - turned).scale(2)
    # To the side that the mirror is turned to.
    wall = place.translate([20, 0, 0]).rotate([0, 1, 0], -90).scale(30)
    scene = scene_of(
        CAMERA, pose(),
        mirror={"type": kind, "to_world": mirror, "bsdf": bsdf}, wall={"type": "rectangle", "to_world": wall},
    )  # fmt: skip
    found = mp.ground_truth(scene, ["depth", "virtual_depth"])
    assert list(found.views) == ["depth", "virtual_depth"]
    return [found.views[name][np.isfinite(found.views["depth"])] for name in found.views]


def test_virtual_depth_is_that_of_the_image_in_a_plane_mirror_alone():
    # Turned by 45 degrees it shows the wall, 20 mm from its middle, in a plane 20 mm behind its middle.
    for kind in ("rectangle", "disk"):
        surface, image = mirrored(MIRROR, kind)
        assert np.ptp(surface) > 0.5 and surface.size > 1000
        np.testing.assert_allclose(image, 215 + 20, rtol=2e-6)
    for bsdf in ({"type": "roughconductor"}, {"type": "thindielectric"}):
        surface, image = mirrored(bsdf)
        np.testing.assert_array_equal(surface, image)
    # A ball, and the back of a mirror, which is black.
    np.testing.assert_array_equal(*mirrored(MIRROR, "sphere"))
    np.testing.assert_array_equal(*mirrored(MIRROR, turned=180 + 45.0))
    # Both sides of one that has two.
    image = mirrored({"type": "twosided", "bsdf": MIRROR}, turned=180 + 45.0)[1]
    np.testing.assert_allclose(image, 215 + 20, rtol=2e-6)


def test_virtual_depth_goes_over_several_mirrors_and_to_infinity():
    to_world = mi.ScalarTransform4f()
    first = to_world.translate([0, 0, 215]).rotate([0, 1, 0], 135).scale(2)
    second = to_world.translate([20, 0, 215]).rotate([0, 1, 0], -45).scale(9)
    wall = to_world.translate([20, 0, 240]).rotate([0, 1, 0], 180).scale(9)
    things = {"first": {"type": "rectangle", "to_world": first, "bsdf": MIRROR}}
    assert np.isinf(mp.ground_truth(scene_of(CAMERA, to_world, **things), "virtual_depth").views["virtual_depth"]).any()
    things["second"] = {"type": "rectangle", "to_world": second, "bsdf": MIRROR}
    things["wall"] = {"type": "rectangle", "to_world": wall}
    found = mp.ground_truth(scene_of(CAMERA, to_world, **things), "virtual_depth").views["virtual_depth"]
    # 20 mm to the second mirror and 25 mm from it to the wall.
    np.testing.assert_allclose(found[np.isfinite(found)], 215 + 20 + 25, rtol=2e-6)


def test_depth_maps_tell_their_error():
    camera = mp.PlenopticCamera(detector_width=2.048, resolution=(384, 384))
    # Coarse enough that lenses could not leave finer stripes, of which views show the same, as much contrast.
    stripes = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([28, 31, 1])}
    wall = mi.ScalarTransform4f().translate([0, 0, 262]).rotate([0, 1, 0], 165).scale(20)
    to_world = pose()
    bsdf, sky = {"type": "diffuse", "reflectance": stripes}, {"type": "constant"}
    card = {"type": "rectangle", "to_world": to_world @ wall, "bsdf": bsdf}
    scene = cases.scene_of(camera.to_sensor(to_world), "direct", sky=sky, card=card)
    lf = mp.decode(mp.render_capture(scene, spp=4), truth=mp.ground_truth(scene, "depth"))
    assert pick_views(lf, 3).depth.shape == (3, 3, 32, 32)
    found = depth_map(lf, 230, 300, planes=24)
    error = depth_error(found)
    assert error.median < 0.01 and error.share > 0.3
    # Moving the truth by 1 % moves all errors by as much.
    assert 0.03 < depth_error(found.assign(truth=found.truth * 1.05)).median < 0.06
    refuses("no ground truth", depth_error, found.drop_vars("truth"))


def test_variants(camera_dict):
    for variant in ("llvm_ad_rgb", "llvm_ad_spectral"):
        mi.set_variant(variant)
        scene = still(CAMERA, pose())
        assert np.isfinite(mp.ground_truth(scene, ["depth"]).pixels["depth"]).any()
        if variant == "llvm_ad_spectral":
            refuses("rgb variant", mp.ground_truth, scene, ["albedo"])
        else:
            albedo = mp.ground_truth(scene, ["albedo"]).pixels["albedo"]
            assert set(np.round(albedo[np.isfinite(albedo)], 4)) == {np.float32(0.3), np.float32(0.5)}


def test_what_an_instance_places_is_that_instance():
    to_world = mi.ScalarTransform4f()
    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.1}}
    copied = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    placed = {f"copy_{n}": copied | {"to_world": to_world.translate([0.2 - 0.4 * n, 0, 240])} for n in (0, 1)}
    wall = {"type": "rectangle", "to_world": to_world.translate([0, 0, 300]).scale(5)}
    scene = mp.load_scene({"type": "scene", "sensor": CAMERA.to_sensor(), "wall": wall, "group": group, **placed})
    truth = mp.ground_truth(scene, ["shape_index", "depth"])
    middle = truth.views["shape_index"].shape[0] // 2
    index, depth = truth.views["shape_index"][middle, middle], truth.views["depth"][middle, middle]
    # +x is to the left.
    left, right = index[:, : index.shape[1] // 2], index[:, index.shape[1] // 2 :]
    for part, name in ((left, "copy_0"), (right, "copy_1")):
        assert {truth.shapes[int(number) - 1] for number in np.unique(part)} == {"wall", name}
    assert np.array_equal(depth < 250, index != 1 + truth.shapes.index("wall"))
