"""Ground truth against analytic surfaces and against Mitsuba's own perspective camera and integrator."""

import math

import cameras
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from light_field_cases import CAMERAS

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views import depth_error, depth_map, pick_views

QUANTITIES = ("depth", "virtual_depth", "position", "normal", "albedo", "shape_index")

CAMERA = mp.PlenopticCamera(detector_width=0.96, resolution=(240, 180))
"""15 x 11 lenses of 16 pixels."""

ORIGIN = [30, -20, 55]


def pose():
    """Look sideways and up from a place in the world, rolled."""
    to_world = mi.ScalarTransform4f().translate(ORIGIN).rotate([0, 1, 0], 35)
    return to_world.rotate([1, 0, 0], -12).rotate([0, 0, 1], 8)


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
    centre = [(np.floor(p * b / (b + z) / camera.mla_pitch) + 0.5) * camera.mla_pitch for p in (x, y)]
    slope = [(c - p) / z for c, p in zip(centre, (x, y), strict=True)]
    pupil = np.stack([c + b * t for c, t in zip(centre, slope, strict=True)])
    return pupil, np.stack(slope) - pupil / f1


def view_rays(camera, lf):
    """Origins and slopes of the samples of a light field, which meet the plane in focus where it says."""
    s, t, u, v = (lf[name].broadcast_like(lf.weight).transpose(*"vuts").values for name in "stuv")
    pupil = np.stack([u, v])
    return pupil, (np.stack([s, t]) - pupil) / camera.focus_distance


def depth_of_plane(pupil, slope, point, normal):
    """Axial distance at which rays (x, y) from the pupil meet a plane."""
    (nx, ny, nz), (x, y) = normal, pupil
    return ((point - np.array([0, 0, 0])) @ normal - nx * x - ny * y) / (nx * slope[0] + ny * slope[1] + nz)


def depth_of_ball(pupil, slope, centre, radius):
    """Axial distance of the near side of a ball, infinite where rays miss it."""
    ox, oy, oz = pupil[0] - centre[0], pupil[1] - centre[1], -centre[2]
    a = 1 + slope[0] ** 2 + slope[1] ** 2
    half = ox * slope[0] + oy * slope[1] + oz
    root = half**2 - a * (ox**2 + oy**2 + oz**2 - radius**2)
    return np.where(root > 0, (-half - np.sqrt(np.maximum(root, 0))) / a, np.inf)


class TestAgainstAnalyticSurfaces:
    @pytest.fixture
    def truth(self):
        normal = np.array([math.sin(math.radians(30)), 0, -math.cos(math.radians(30))])
        wall = mi.ScalarTransform4f().translate([0, 0, 262]).rotate([0, 1, 0], 150).scale(100)
        ball = mi.ScalarTransform4f().translate([-0.2, 0.1, 226]).scale(0.35)
        scene = scene_of(
            CAMERA, pose(), wall={"type": "rectangle", "to_world": wall}, ball={"type": "sphere", "to_world": ball}
        )
        return normal, scene, mp.ground_truth(scene)

    @pytest.mark.parametrize("part", ["pixels", "views"])
    def test_depth_normal_position_and_index(self, truth, part):
        normal, _, truth = truth
        found = getattr(truth, part)
        if part == "pixels":
            pupil, slope = chief_rays(CAMERA)
        else:
            white = mp.views.white_image(CAMERA)
            pupil, slope = view_rays(CAMERA, mp.decode(white, camera=CAMERA))
        open_ = np.hypot(*pupil) < CAMERA.aperture_radius - 1e-3
        closed = np.hypot(*pupil) > CAMERA.aperture_radius + 1e-3
        assert np.isnan(found["depth"][closed]).all() and not found["shape_index"][closed].any()
        wall = depth_of_plane(pupil, slope, np.array([0, 0, 262.0]), normal)
        ball = depth_of_ball(pupil, slope, (-0.2, 0.1, 226), 0.35)
        depth = np.minimum(wall, ball)
        # Rays that graze the ball may fall to either side of its rim.
        rim = np.isfinite(ball) != np.isfinite(depth_of_ball(pupil, slope, (-0.2, 0.1, 226), 0.35 * 1.001))
        sure = open_ & ~rim
        assert 0.02 < np.isfinite(ball)[open_].mean() < 0.5 and rim[open_].mean() < 0.01
        np.testing.assert_allclose(found["depth"][sure], depth[sure], rtol=4e-6)
        # The curved side of a sphere that grazes magnifies rounding.
        expected = np.where(ball < wall, 1 + truth.shapes.index("ball"), 1 + truth.shapes.index("wall"))
        assert np.array_equal(found["shape_index"][sure], expected[sure])

        place = np.stack([*(pupil + depth * slope), depth], axis=-1)
        to_world = np.array(pose().matrix, np.float64)
        np.testing.assert_allclose(found["position"][sure], (place @ to_world[:3, :3].T + ORIGIN)[sure], atol=1e-3)
        outwards = np.where((ball < wall)[..., None], (place - np.array([-0.2, 0.1, 226])) / 0.35, np.array(normal))
        turned = found["normal"] @ to_world[:3, :3]
        np.testing.assert_allclose(turned[sure], outwards[sure], atol=2e-3)
        np.testing.assert_allclose(found["albedo"][sure], 0.5)
        np.testing.assert_allclose(truth.to_world, to_world, rtol=1e-6)

    def test_a_file_keeps_it(self, truth, tmp_path):
        truth = truth[2]
        mp.write_ground_truth(tmp_path / "a.truth.exr", truth)
        read = mp.read_ground_truth(tmp_path / "a.truth.exr")
        assert (read.camera, read.shapes) == (truth.camera, truth.shapes)
        np.testing.assert_array_equal(read.to_world, truth.to_world)
        for part in ("pixels", "views"):
            before, after = getattr(truth, part), getattr(read, part)
            assert list(after) == list(QUANTITIES)
            for name in QUANTITIES:
                np.testing.assert_array_equal(after[name], before[name])


class TestAgainstMitsuba:
    # Only the coordinates of the light field count here, and a white that is even costs nothing.
    @pytest.mark.filterwarnings("ignore:white. .* of its light is distributed over the micro-images:UserWarning")
    @pytest.mark.parametrize("name", ["other", "crop", "hexagonal, upright"])
    def test_views_are_those_of_perspective_cameras_on_the_pupil(self, name):
        camera = CAMERAS[name]
        to_world = pose()
        scene = still(camera, to_world)
        truth = mp.ground_truth(scene)
        lf = mp.decode(np.zeros(camera.shape), camera=camera, truth=truth, white=np.ones(camera.shape))
        aovs = "depth:depth,position:position,normal:sh_normal,albedo:albedo,index:shape_index"
        integrator = mi.load_dict({"type": "aov", "aovs": aovs})
        focus = camera.focus_distance
        seen = 0
        for j, i in ((lf.sizes["v"] // 2, lf.sizes["u"] // 2), (3, lf.sizes["u"] // 2 + 1), (lf.sizes["v"] - 4, 4)):
            u, v = float(lf.u[i]), float(lf.v[j])
            # The film is what the bins cover of the plane in focus: the camera's middle stays where the axis meets it.
            width, height = (abs(float(lf[axis][0] - lf[axis][1])) * lf.sizes[axis] for axis in "st")
            middle = [float(lf[axis].mean()) for axis in "st"]
            sensor = mi.load_dict(
                {
                    "type": "perspective",
                    "fov": math.degrees(2 * math.atan(width / 2 / focus)),
                    "near_clip": 0.1,
                    "principal_point_offset_x": (u - middle[0]) / width,
                    "principal_point_offset_y": (v - middle[1]) / height,
                    "to_world": to_world @ mi.ScalarTransform4f().translate([u, v, 0]),
                    "film": cameras.film(lf.sizes["s"], lf.sizes["t"]),
                }
            )
            columns, rows = lf.sizes["s"], lf.sizes["t"]
            lane = dr.arange(mi.UInt32, rows * columns)
            place = mi.Point2f((lane % columns + 0.5) / columns, (lane // columns + 0.5) / rows)
            ray, _ = sensor.sample_ray_differential(0.0, 0.0, place, mi.Point2f(0.5))
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(0, rows * columns)
            found = mi.SamplingIntegrator.sample(integrator, scene, sampler, ray, None, mi.Bool(True))[2]
            values = {
                one: np.array(value).reshape(rows, columns)
                for one, value in zip(integrator.aov_names(), found, strict=True)
            }
            view = lf.isel(v=j, u=i)
            index = view.shape_index.values
            # Mitsuba numbers the shapes of all scenes of the process. Rounding may put rays along edges to either side.
            theirs = values["index.I"]
            number = {own: np.median(theirs[index == own]) for own in np.unique(index)}
            assert len(set(number.values())) == len(number) > 1 and number.get(0.0, 0) == 0
            same = np.vectorize(number.get)(index) == theirs
            assert same.mean() > 0.99
            met = same & (index > 0)
            assert np.isposinf(view.depth.values[same & (index == 0)]).all()
            axis = np.array(to_world.matrix, np.float64)[:3, 2]
            # Mitsuba's rays start in the near clipping plane.
            along = 0.1 + values["depth.T"] * (np.array(ray.d).T @ axis).reshape(rows, columns)
            np.testing.assert_allclose(view.depth.values[met], along[met], rtol=1e-5)
            for quantity in ("position", "normal"):
                for letter in "xyz":
                    expected = values[f"{quantity}.{letter.upper()}"]
                    np.testing.assert_allclose(view[f"{quantity}_{letter}"].values[met], expected[met], atol=3e-3)
            np.testing.assert_allclose(view.albedo_g.values[met], values["albedo.G"][met], rtol=1e-6)
            seen += met.sum()
        assert seen > 100


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


@pytest.mark.parametrize("kind", ["rectangle", "disk"])
def test_virtual_depth_is_that_of_the_image_in_a_plane_mirror(kind):
    # Turned by 45 degrees it shows the wall, 20 mm from its middle, in a plane 20 mm behind its middle.
    surface, image = mirrored(MIRROR, kind)
    assert np.ptp(surface) > 0.5 and surface.size > 1000
    np.testing.assert_allclose(image, 215 + 20, rtol=2e-6)


def test_virtual_depth_stays_at_what_is_no_plane_mirror():
    for bsdf in ({"type": "roughconductor"}, {"type": "plastic"}, {"type": "dielectric"}, {"type": "thindielectric"}):
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


def test_pixels_of_one_micro_image_look_through_one_lens():
    camera = CAMERAS["turned"]
    truth = mp.ground_truth(still(camera, mi.ScalarTransform4f()), ["position", "depth"])
    # Of whatever lattice: back from where the ray meets the scene to the plane in focus and the lens.
    lit = np.isfinite(truth.pixels["depth"])
    assert lit.any() and list(truth.views) == ["depth", "position"]
    rows, columns = np.nonzero(lit)
    x, y = (camera.pixel_coordinates(axis)[index] for axis, index in ((0, columns), (1, rows)))
    b, z = camera.mla_distance, camera.detector_distance
    i, j = camera.lattice.cell(x * b / (b + z), y * b / (b + z))
    cx, cy = camera.lattice.centre(i, j)
    X, Y, g = truth.pixels["position"][lit].T.astype(np.float64)
    for at, c, p in ((X, cx, x), (Y, cy, y)):
        P = c + b / z * (c - p)
        slope = (c - p) / z - P / camera.focal_length
        np.testing.assert_allclose(P + slope * g, at, atol=2e-4)


def test_depth_maps_tell_their_error():
    camera = mp.PlenopticCamera(detector_width=2.048, resolution=(512, 512))
    # Coarse enough that lenses could not leave finer stripes, of which views show the same, as much contrast.
    stripes = {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([28, 31, 1])}
    wall = mi.ScalarTransform4f().translate([0, 0, 262]).rotate([0, 1, 0], 165).scale(20)
    to_world = pose()
    scene = mp.load_scene(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "sensor": camera.to_sensor(to_world),
            "sky": {"type": "constant"},
            "wall": {
                "type": "rectangle",
                "to_world": to_world @ wall,
                "bsdf": {"type": "diffuse", "reflectance": stripes},
            },
        }
    )
    lf = mp.decode(mp.render_capture(scene, spp=4), truth=mp.ground_truth(scene, "depth"))
    assert pick_views(lf, 3).depth.shape == (3, 3, 32, 32)
    found = depth_map(lf, 230, 300, planes=24)
    error = depth_error(found)
    assert error.median < 0.01
    assert error.share > 0.3
    # Moving the truth by 1 % moves all errors by as much.
    moved = depth_error(found.assign(truth=found.truth * 1.05))
    assert 0.03 < moved.median < 0.06
    with pytest.raises(mp.InputError, match="no ground truth"):
        depth_error(found.drop_vars("truth"))


def test_variants(camera_dict):
    for variant in ("llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono_polarized"):
        mi.set_variant(variant)
        scene = still(CAMERA, pose())
        depth = mp.ground_truth(scene, ["depth"]).pixels["depth"]
        assert np.isfinite(depth).any()
        if variant == "llvm_ad_spectral":
            with pytest.raises(mp.InputError, match="rgb variant"):
                mp.ground_truth(scene, ["albedo"])
        else:
            albedo = mp.ground_truth(scene, ["albedo"]).pixels["albedo"]
            assert set(np.round(albedo[np.isfinite(albedo)], 4)) == {np.float32(0.3), np.float32(0.5)}


def test_what_an_instance_places_is_that_instance():
    to_world = mi.ScalarTransform4f()
    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.1}}
    placed = {
        f"copy_{number}": {
            "type": "instance",
            "to_world": to_world.translate([x, 0, 240]),
            "group": {"type": "ref", "id": "group"},
        }
        for number, x in enumerate((0.2, -0.2))
    }
    wall = {"type": "rectangle", "to_world": to_world.translate([0, 0, 300]).scale(5)}
    scene = mp.load_scene({"type": "scene", "sensor": CAMERA.to_sensor(), "wall": wall, "group": group, **placed})
    truth = mp.ground_truth(scene, ["shape_index", "depth"])
    middle = truth.views["shape_index"].shape[0] // 2
    index, depth = truth.views["shape_index"][middle, middle], truth.views["depth"][middle, middle]
    # +x is to the left.
    left, right = index[:, : index.shape[1] // 2], index[:, index.shape[1] // 2 :]
    assert {truth.shapes[int(number) - 1] for number in np.unique(left)} == {"wall", "copy_0"}
    assert {truth.shapes[int(number) - 1] for number in np.unique(right)} == {"wall", "copy_1"}
    assert np.array_equal(depth < 250, index != 1 + truth.shapes.index("wall"))
