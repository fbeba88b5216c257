"""Where the light of rays comes from: its radiance is the child's, its place that of geometrical optics."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from any_scenes import ABSORBING_FOG, MIRROR, PANES, THIN_FOG, facing, radiating, scene_of, sensor, turned_plane

from mitsuba_plenoptic import InputError, PlenopticCamera
from mitsuba_plenoptic.capture import child as children
from mitsuba_plenoptic.capture.chains import Optics
from mitsuba_plenoptic.capture.child import Child
from mitsuba_plenoptic.capture.first_vertex import first_vertex
from mitsuba_plenoptic.capture.radiators import find_radiators, sample_pairs
from mitsuba_plenoptic.capture.sight import Sight

GREY = {"type": "diffuse", "reflectance": 0.5}
TWOSIDED = {"type": "twosided", "nested": GREY}

BSDFS = {
    **PANES,
    "half-open": {"type": "mask", "opacity": 0.5, "nested": GREY},
    "plastic": {"type": "plastic", "diffuse_reflectance": 0.5},
    "mirror": {"type": "twosided", "nested": MIRROR},
    "blend": {"type": "blendbsdf", "weight": 0.5, "first": GREY, "second": MIRROR},
}


def trace(scene, slopes, count=1):
    """Sample the first vertices of rays from the origin, `count` of each."""
    slopes = np.repeat(np.reshape(slopes, (-1, 2)), count, axis=0).T.astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(0), dr.normalize(mi.Vector3f(mi.Float(slopes[0]), mi.Float(slopes[1]), 1)))
    optics = Optics.of(scene, Child.of(scene.integrator()), scene.sensors()[0])
    return optics, ray, first_vertex(optics, 3, ray)


def room(integrator, bsdf, **objects):
    lamp = facing(0, 60, **radiating(5.0))
    lamp["to_world"] = mi.ScalarTransform4f().translate([0, 150, 100]).rotate([1, 0, 0], 90).scale(60)
    return scene_of(
        sensor(2),
        integrator,
        lamp=lamp,
        sky={"type": "constant", "radiance": 0.7},
        pane=facing(200, 60, bsdf=bsdf),
        wall=facing(300, 300, bsdf=GREY),
        behind=facing(-200, 90, bsdf=TWOSIDED),
        **objects,
    )


@pytest.mark.parametrize(
    ("integrator", "bsdf"),
    [
        ({"type": "path"}, "half-open"),
        ({"type": "path", "max_depth": 2}, "plastic"),
        ({"type": "path", "max_depth": 3}, "mirror"),
        ({"type": "path", "max_depth": 3}, "null"),
        ({"type": "direct"}, "blend"),
        ({"type": "prb", "max_depth": 3}, "thindielectric"),
        ({"type": "volpath", "max_depth": 3}, "thindielectric"),
        ({"type": "volpath"}, "plastic"),
    ],
)
def test_the_mean_radiance_is_what_the_child_says(integrator, bsdf):
    assert_the_childs(room(integrator, BSDFS[bsdf]))


@pytest.mark.parametrize("medium", [ABSORBING_FOG, THIN_FOG])
def test_media_weaken_and_glow_as_the_child_means_them(medium):
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 150]).scale(40), "interior": medium}
    assert_the_childs(room("volpath", GREY, cube={**cube, "bsdf": {"type": "null"}}))


@pytest.mark.parametrize("integrator", ["path", "volpath", "prb"])
def test_hidden_emitters_are_hidden_as_far_as_the_child_hides_them(integrator):
    lamp = facing(300, 20, emitter={"type": "area", "radiance": 3.0}, bsdf=GREY)
    near = facing(150, (40, 5), emitter={"type": "area", "radiance": 9.0}, bsdf=GREY)
    scene = scene_of(
        sensor(2),
        {"type": integrator, "hide_emitters": True},
        sky={"type": "constant", "radiance": 0.7},
        pane=facing(200, 60, bsdf=BSDFS["half-open"]),
        lamp=lamp,
        near=near,
    )
    assert_the_childs(scene)


def assert_the_childs(scene, count=2**15):
    """Compare means over many rays, within four standard deviations."""
    slopes = np.random.default_rng(1).uniform(-0.1, 0.1, (count, 2))
    optics, ray, vertex = trace(scene, slopes)
    sampler = children.random_numbers(4, count)
    ours = dr.mean(vertex.radiance).numpy()
    theirs = children.sample(optics.child.integrator, scene, sampler, ray, optics.start, mi.Bool(True))[0].numpy()
    assert ours.mean() == pytest.approx(theirs.mean(), abs=4 * math.hypot(ours.std(), theirs.std()) / math.sqrt(count))


def place_of(scene, slope=(1e-3, 5e-4)):
    """Return virtual distance and astigmatism of the light along the axis: its mean where it comes in several ways."""
    # By default not quite along the axis, where the poles of spheres are.
    place = trace(scene, slope)[-1].place
    return float(place.distance[0]), float(place.astigmatism[0])


def ball(radius, centre, bsdf):
    return {"type": "sphere", "center": centre, "radius": radius, "bsdf": bsdf}


@pytest.mark.parametrize("radius", [50.0, -1000.0, -300.0])
def test_curved_mirrors_image_as_the_mirror_formula_says(radius):
    """A wall 300 mm before a convex, a concave and a strongly concave mirror, of which the last images it to itself."""
    behind_camera = mi.ScalarTransform4f().translate([0, 0, -100]).scale(400)
    scene = scene_of(
        sensor(2),
        wall={"type": "rectangle", "to_world": behind_camera, **radiating()},
        mirror=ball(abs(radius), [0, 0, 200 + radius], {"type": "twosided", "nested": MIRROR}),
    )
    distance, astigmatism = place_of(scene)
    assert distance == pytest.approx(200 + 1 / (1 / 300 + 2 / radius), rel=1e-3)
    assert astigmatism == pytest.approx(0, abs=1e-5)


def test_an_oblique_mirror_is_astigmatic_as_coddingtons_equations_say():
    tilt, radius = math.radians(40), 30.0
    centre = [radius * math.sin(tilt), 0.0, 240 + radius * math.cos(tilt)]
    scene = scene_of(sensor(2), sky={"type": "constant"}, mirror=ball(radius, centre, MIRROR))
    distance, astigmatism = place_of(scene, (0.0, 0.0))
    tangential, sagittal = (1 / (240 + radius / 2 * f) for f in (math.cos(tilt), 1 / math.cos(tilt)))
    assert 1 / distance == pytest.approx((tangential + sagittal) / 2, rel=1e-3)
    assert astigmatism == pytest.approx(tangential - sagittal, rel=1e-2)


def test_glass_makes_depths_seem_smaller():
    glass = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0, "specular_reflectance": 0.0}
    slab = {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 220]).scale([20, 20, 10]),
        "bsdf": glass,
    }
    distance, _ = place_of(scene_of(sensor(2), slab=slab, wall=facing(300.0, 30.0, **radiating())))
    assert distance == pytest.approx(300 - 20 / 3, rel=1e-4)
    # n / d - 1 / s = (n - 1) / R for a lamp at the depth d = 10 in a ball of R = 20
    inside = scene_of(sensor(2), ball=ball(20.0, [0, 0, 220], glass), wall=facing(210.0, 5.0, **radiating()))
    assert place_of(inside)[0] == pytest.approx(208, rel=1e-4)


def test_what_leaves_the_scene_is_at_infinity_also_in_a_plane_mirror():
    plane = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 240]).rotate([0, 1, 0], 170).scale(20),
    }
    scene = scene_of(sensor(2), sky={"type": "constant"}, mirror={**plane, "bsdf": MIRROR})
    assert place_of(scene) == (math.inf, 0)


def test_normals_are_seen_as_plane_mirrors_and_panes_show_them():
    T = mi.ScalarTransform4f()
    wall = {"type": "rectangle", "to_world": T.translate([0, 0, 300]) @ T.rotate([1, 0, 0], 150), **radiating()}
    wall["to_world"] = wall["to_world"] @ T.scale(12.0)
    normal = np.array([0.0, -0.5, -math.sqrt(0.75)])
    for bsdf in ("thindielectric", "mirror"):
        pane, there = facing(240.0, 30.0, bsdf=BSDFS[bsdf]), T
        if bsdf == "mirror":
            pane, there = turned_plane(BSDFS[bsdf])
        scene = scene_of(sensor(2), pane=pane, wall={**wall, "to_world": there @ wall["to_world"]})
        vertex = trace(scene, (1e-3, 5e-4), 64)[-1]
        through = np.flatnonzero(np.abs(vertex.place.distance.numpy() - 300) < 1)
        apparent = vertex.place.apparent.numpy().T[through]
        assert len(through) > 0
        np.testing.assert_allclose(np.abs(apparent @ normal), 1, rtol=1e-4)


def test_radiators_tell_the_variance_of_their_radiance():
    """Half of the light paths are stopped by the card: each mean of 64 has a variance of 1 / 4 / 63."""
    scene = scene_of(sensor(2), pane=facing(200, 60, bsdf=PANES["half-open mask"]), wall=facing(300, 60, **radiating()))
    camera = PlenopticCamera.from_sensor(scene.sensors()[0])
    found = find_radiators(
        Sight.of(scene, scene.sensors()[0], scene.integrator(), None), camera, sample_pairs(2, np.zeros(4)),
        spp=64, seed=1, occlusion=False,
    )  # fmt: skip
    # Spread evenly, about half of them; independent ones would deviate by 0.06.
    np.testing.assert_allclose(found.radiance, 0.5, atol=3 / 64)
    assert found.variance.mean() == pytest.approx(0.25 / 63, rel=0.05)


def test_lamps_without_area_are_refused_where_a_medium_scatters():
    cube = {"type": "cube", "interior": THIN_FOG, "bsdf": {"type": "null"}}
    scene = scene_of(sensor(2), "volpath", cube=cube, light={"type": "point"})
    with pytest.raises(InputError, match=r"^scene: it has a PointLight and a scattering medium: .*$"):
        trace(scene, (0, 0))
