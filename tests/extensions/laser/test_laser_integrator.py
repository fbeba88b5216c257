"""Captures of scenes with laser light: power against other captures, mixed light, shadows, fringes, refusals."""

import math

import cases
import mitsuba as mi
import numpy as np
import pytest
from cameras import error, small_camera
from refusals import refused
from stopped_runs import StoppedError, stopped_before

from mitsuba_plenoptic import Checkpoint, PhysicsError, laser, load_scene, render_capture
from mitsuba_plenoptic.extensions.laser.lit_points import LaserScene, named_lasers
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.points.units import radiance_weight
from mitsuba_plenoptic.scene import estimate_capture

CAMERA = small_camera(2, focal_length=40, aperture_radius=1.25, mla_distance=60)
WAVELENGTH = 633.0
LENGTH = WAVELENGTH * 1e-6

LASER = {"type": "point", "position": [0, 0, 20], "intensity": {"type": "spectrum", "value": 1e4}}


def wall(distance=120.0, half=20.0, place=(0.0, 0.0), bsdf=None):
    return cases.facing(distance, half, place, bsdf=bsdf or {"type": "diffuse"})


def scene_of(camera=CAMERA, integrator=None, **objects):
    own = {"type": "plenoptic_laser", "lasers": "laser", "points_per_spot": 4.0, **(integrator or {})}
    sensor = camera.to_sensor()
    sensor["sampler"] = {"type": "independent", "sample_count": 4}
    given = {"sensor": sensor, "wall": wall(), "laser": LASER, **objects}
    return load_scene({"type": "scene", "integrator": own, **given}, variant="llvm_ad_mono")


def posed(turn, **objects):
    """Return the camera, turned by an angle and moved if it is not 0, and objects that stand before it as given."""
    pose = mi.ScalarTransform4f()
    if turn:
        pose = pose.translate([5, -3, 7]).rotate([0, 0.6, 0.8], turn)
    placed = {"sensor": {**CAMERA.to_sensor(), "to_world": pose}}
    for name, given in objects.items():
        if "position" in given:
            placed[name] = {**given, "position": list(pose @ mi.ScalarPoint3f(*given["position"]))}
        else:
            placed[name] = {**given, "to_world": pose @ given["to_world"]}
    return placed


def lit(scene, per_spot=4.0, names=("laser",), camera=CAMERA, seed=0):
    system = OpticalSystem(camera, WAVELENGTH)
    return LaserScene(scene, scene.sensors()[0], named_lasers(scene, names, "test"), system).points(per_spot, seed)


@pytest.mark.slow
def test_the_mean_power_is_that_of_a_wave_capture():
    scene = scene_of(integrator={"modes": 12})
    capture = render_capture(scene)
    assert capture.wavelength == WAVELENGTH
    assert capture.metadata["modes"] == 12
    assert 0 < estimate_capture(scene).seconds < 600
    waves = {"type": "plenoptic_wave", "wavelength": WAVELENGTH}
    other = render_capture(cases.scene_of(CAMERA.to_sensor(), waves, wall=wall(), laser=LASER), spp=256)
    bright = other.image > 0.3 * other.image.max()
    assert capture.image[bright].sum() == pytest.approx(other.image[bright].sum(), rel=0.06)
    ratio = capture.image[bright] / other.image[bright]
    assert 0.6 / math.sqrt(12) < ratio.std() < 1.1 / math.sqrt(12)


def test_weights_against_the_closed_form():
    points = lit(scene_of())
    x, y, z = points.positions.T
    np.testing.assert_allclose(z, 120, rtol=1e-6)
    # A point source of intensity I, height h above a matte wall of albedo 1/2: I cos / r^2 times 1 / 2 pi.
    h = 100.0
    radiance = 1e4 * h / (x**2 + y**2 + h**2) ** 1.5 * 0.5 / math.pi
    relative = points.weights / radiance
    np.testing.assert_allclose(relative, relative[0], rtol=1e-4)
    # All cells together are the square on the array from which the chief rays come.
    area = (np.ptp(x) / 2) * (np.ptp(y) / 2)
    system = OpticalSystem(CAMERA, WAVELENGTH)
    assert relative.sum() == pytest.approx(radiance_weight(CAMERA, system.lens, area), rel=0.05)
    # Four in each resolved spot, each anywhere in its cell, by the seed.
    spot = LENGTH * CAMERA.mla_distance / (2 * CAMERA.aperture_radius)
    assert len(x) == pytest.approx(4 * area / spot**2, rel=0.1)
    assert len(np.unique(x.round(6))) > 0.9 * len(x)
    assert not np.array_equal(lit(scene_of(), seed=1).positions, points.positions)


def test_a_spot_between_the_first_rays_is_found():
    place = [0.003, 0.0041, 120]
    towards = mi.ScalarTransform4f().look_at(origin=[*place[:2], 119], target=place, up=[0, 1, 0])
    spot = {"type": "spot", "to_world": towards, "cutoff_angle": 0.6, "intensity": LASER["intensity"]}
    points = lit(scene_of(laser=spot), per_spot=30)
    assert len(points.weights) > 3
    assert np.abs(points.positions - place).max() < math.tan(math.radians(0.6))


def test_points_whose_light_a_wavefront_brings_to_the_detector_are_found():
    waves = 0.5
    camera = CAMERA.replace(wavefront=(0, 0, 0, waves))
    blurred = np.ptp(lit(scene_of(camera), per_spot=1.0, camera=camera).positions[:, 0])
    sharp = np.ptp(lit(scene_of(), per_spot=1.0).positions[:, 0])
    # The slope of a defocus at the pupil's edge is 4 sqrt(3) a / radius; the magnification is 1/2.
    blur = camera.mla_distance * 4 * math.sqrt(3) * waves * 633e-6 / camera.aperture_radius
    assert (blurred - sharp) / 4 == pytest.approx(blur, rel=0.1)


@pytest.mark.slow
def test_small_things_far_out_of_focus_beside_the_field_are_found(x=0.9):
    """Only its blur, of a radius of 1.25 mm, reaches the detector: it is imaged 1.35 mm from the axis."""
    towards = mi.ScalarTransform4f().look_at(origin=[0, 0, 20], target=[x, 0.1, 40], up=[0, 1, 0])
    spot = {"type": "spot", "to_world": towards, "cutoff_angle": 0.5, "intensity": LASER["intensity"]}
    points = lit(scene_of(card=wall(40.0, 0.02, (x, 0.1)), laser=spot), per_spot=12)
    # The radiance of a matte card of albedo 1/2, times the area of its image.
    square = x**2 + 0.1**2 + 20**2
    radiance = 1e4 * 20 / square**1.5 * 0.5 / math.pi
    expected = radiance_weight(CAMERA, OpticalSystem(CAMERA, WAVELENGTH).lens, (0.04 * 60 / 40) ** 2) * radiance
    assert points.weights[points.positions[:, 2] < 60].sum() == pytest.approx(expected, rel=0.2)


def test_other_light_adds_as_intensity():
    sky = {"type": "constant", "radiance": {"type": "spectrum", "value": 2.0}}
    mixed = render_capture(scene_of(sky=sky), seed=3).image
    alone = render_capture(scene_of(), seed=3).image
    daylight = render_capture(cases.scene_of(CAMERA.to_sensor(), wall=wall(), sky=sky), spp=64).image
    with pytest.warns(UserWarning, match="the camera sees no surface that the lasers light"):
        render_capture(scene_of(sky=sky, laser={**LASER, "intensity": {"type": "spectrum", "value": 0.0}}))
    assert (mixed - alone).sum() == pytest.approx(daylight.sum(), rel=0.05)
    assert error(mixed - alone, daylight) < 0.5
    assert alone.std() > mixed.mean() * 0.1


def test_two_lasers_make_fringes_on_the_wall():
    x = 8.0
    lasers = {name: {**LASER, "position": [side * x, 0, 0]} for name, side in (("laser", -1), ("other", 1))}
    points = lit(scene_of(**lasers), per_spot=16, names=("laser", "other"))
    one, two = (lit(scene_of(**lasers), per_spot=16, names=(name,)) for name in lasers)
    assert np.array_equal(points.positions, one.positions)
    paths = [np.hypot(np.hypot(points.positions[:, 0] - s * x, points.positions[:, 1]), 120.0) for s in (-1, 1)]
    fringes = 2 * np.sqrt(one.weights * two.weights) * np.cos(2 * np.pi * (paths[0] - paths[1]) / LENGTH)
    assert error(points.weights, one.weights + two.weights + fringes) < 0.05
    # Fringes of period lambda D / 2 x = 4.7 um, of contrast nearly 1.
    assert points.weights.min() < 0.01 * points.weights.max()


def test_directional_lasers_make_straight_fringes():
    angle = 0.01
    sine, cosine = math.sin(angle), math.cos(angle)
    ahead = {"type": "directional", "irradiance": {"type": "spectrum", "value": 1.0}, "direction": [sine, 0, cosine]}
    lasers = {"laser": ahead, "other": ahead | {"direction": [-sine, 0, cosine]}}
    points = lit(scene_of(**lasers), per_spot=16, names=("laser", "other"))
    phase = 2 * np.pi * points.positions[:, 0] * math.sin(angle) / LENGTH
    assert error(points.weights, 4 * lit(scene_of(**lasers), per_spot=16).weights * np.cos(phase) ** 2) < 1e-3


def test_points_do_not_depend_on_where_the_camera_stands():
    # Half of a wall, in the camera's +x.
    one, other = (lit(scene_of(**posed(turn, wall=wall(place=(20.0, 0.0)), laser=LASER))) for turn in (0, 40))
    assert len(one.weights) == len(other.weights) > 100
    np.testing.assert_allclose(other.positions, one.positions, atol=1e-4)
    np.testing.assert_allclose(other.weights, one.weights, rtol=1e-4)


def test_shadows_have_no_laser_light():
    # A plate over half of the wall's light: it hides the laser from all points with x > 0 but not the lens.
    place = mi.ScalarTransform4f().translate([30.0, 0, 60]).scale([5, 30, 1])
    plate = {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse"}}
    side = {**LASER, "position": [60.0, 0, 0]}
    x = lit(scene_of(laser=side, plate=plate)).positions[:, 0]
    # Light from (60, 0, 0) through the edges of the plate at x = 25 and 35 meets the wall at x = -10 and 10.
    assert len(x) == 0
    x = lit(scene_of(laser=side, plate={**plate, "to_world": plate["to_world"].translate([-1, 0, 0])})).positions[:, 0]
    assert len(x) > 100
    assert x.max() < 1


def test_points_that_the_pupil_sees_in_part_are_refused():
    plate = wall(30.0, 5.0, (5.6, 0.0), {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.0}})
    with pytest.raises(PhysicsError, match="of the laser light comes from points that objects hide"):
        lit(scene_of(**posed(40, wall=wall(), plate=plate, laser={**LASER, "position": [0, 0, 40]})))


@pytest.mark.slow
def test_modes_of_a_source():
    for source in ({"source_diameter": 1.0, "source_distance": 60.0}, {"bandwidth": 2.0, "roughness": 0.05}):
        count = round(laser.mode_count(CAMERA, wavelength=WAVELENGTH, distance=120, **source))
        scenes = [scene_of(integrator={"points_per_spot": 1.0} | given) for given in (source, {"modes": count})]
        one, other = (render_capture(scene).image for scene in scenes)
        assert count > 1 and np.array_equal(one, other)


@pytest.mark.slow
def test_a_stopped_capture_resumes_with_the_same_bits(tmp_path):
    def compute(existing="refuse", seed=2):
        with Checkpoint(tmp_path / "laser.checkpoint", existing) as keeper:
            scene = scene_of(integrator={"modes": 3, "points_per_spot": 1.0})
            return render_capture(scene, seed=seed, checkpoint=keeper).image

    whole = compute()
    with pytest.raises(StoppedError), stopped_before(lambda sums: len(sums) == 2):
        compute()
    assert np.array_equal(compute("resume"), whole)
    assert not np.array_equal(compute(seed=1), whole)


def surface_lamp(lamp, kind):
    scene = scene_of(lamp=lamp)
    return scene, [next(emitter.id() for emitter in scene.emitters() if emitter.class_name() == kind)]


AREA = {"type": "sphere", "radius": 0.1, "emitter": {"type": "area"}}
BEAM = {"type": "rectangle", "emitter": {"type": "directionalarea"}}
OWN = {"type": "plenoptic_laser", "lasers": "laser"}


test_refusals = refused(
    (lambda: lit(scene_of(laser={**LASER, "intensity": {"type": "spectrum", "value": -1.0}})), "laser: .*negative"),
    (lambda: lit(scene_of(wall=wall(bsdf={"type": "diffuse", "reflectance": -0.5}))), "negative reflectance"),
    (lambda: load_scene({"type": "scene", "integrator": OWN}, variant="llvm_ad_rgb"), "variant llvm_ad_rgb"),
    (lambda: scene_of(integrator={"lasers": ""}), "lasers: "),
    (lambda: scene_of(integrator={"modes": 2, "bandwidth": 1.0}), "modes, bandwidth"),
    (lambda: scene_of(integrator={"mode": 2}), "mode: .*modes"),
    (lambda: render_capture(scene_of(integrator={"lasers": "lasr"})), "lasr.*laser"),
    (lambda: named_lasers(*surface_lamp(AREA, "AreaLight"), "test"), "AreaLight"),
    (lambda: named_lasers(*surface_lamp(BEAM, "DirectionalArea"), "test"), "DirectionalArea"),
    (lambda: render_capture(scene_of(integrator={"bandwidth": 1.0})), "roughness"),
    (lambda: render_capture(scene_of(wall=wall(bsdf={"type": "roughconductor"}))), "wall of type RoughConductor"),
    (lambda: render_capture(scene_of(integrator={"lasers": "laser, laser"})), "lasers = laser"),
    (lambda: render_capture(scene_of(), noise=True), "noise"),
)
