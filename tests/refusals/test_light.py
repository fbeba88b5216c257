"""What captures of scenes by signed rays and their derivatives refuse, and lengths of scenes in other units."""

import drjit as dr
import mitsuba as mi
import pytest
from cases import facing, radiating, scene_of, sensor

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError, PlenopticCamera, estimate_capture, load_scene, render_capture
from mitsuba_plenoptic.array import Conic
from mitsuba_plenoptic.fields.lens_kinds import LensKinds
from mitsuba_plenoptic.waves.signed_camera import require_parameters
from refusals import refused

SMALL = PlenopticCamera(detector_width=0.128, resolution=(64, 64))


def by_waves(camera, **options):
    options = {"method": "signed_rays", "spp": 4} | options
    return render_capture(scene_of(camera, wall=facing(240.0, 60.0, **radiating())), model="wave", **options)


def without_parameters(folder):
    (folder / "fixed.xml").write_text("<scene version='3.0.0'><sensor type='plenoptic'/></scene>")
    return folder / "fixed.xml"


def derived(names, by_points=False, **parameters):
    require_parameters(PlenopticCamera(**parameters), names, by_points)


test_refused = refused(
    (lambda: by_waves(sensor(4, 8, detector_distance=1.0)), "detector_distance = .*: "),
    (lambda: by_waves(SMALL.replace(mla_shape=Conic(0.25, 0.0, (3e3,))).to_sensor()), "mla_shape = .*parabola"),
    (lambda: by_waves(SMALL.replace(aperture_radius=600.0).to_sensor()), r"aperture_radius = 600: \d{4} lenses"),
    (lambda: LensKinds(PlenopticCamera(mla_jitter=(0.0, 0.08))), r"mla_jitter = .* \d+"),
    (lambda: LensKinds(PlenopticCamera(mla_jitter=(0.0, 0.03), mla_tilt=(0.3, 0.3))), "mla_tilt = .*kinds"),
    (lambda: derived(["aperture_radius"]), "aperture_radius: "),
    (lambda: derived(["mla_pitch"], mla_pitch=(0.064, 0.07)), "mla_pitch: .*two pitches"),
    (lambda: derived(["mla_offset"], mla_jitter=(1e-3, 0)), "mla_jitter = .*: derivatives"),
    (lambda: derived(["focal_length"], True, detector_distance=0.3), "focal_length: .*detector_distance = 0.3"),
    (lambda: estimate_capture(load_scene("letters"), spp=0), "spp = 0"),
    (lambda folder: load_scene(without_parameters(folder), parameters={"widht": "4"}), "widht: .*no parameters"),
    (lambda: load_scene("letters", unit="km"), "^unit = 'km'"),
)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lamp": {"type": "point", "intensity": {"type": "d65"}}}, "point 'lamp': intensity"),
        ({"cam": {"type": "orthographic"}}, "orthographic 'cam'"),
        ({"made": "made"}, "scene: made"),
    ],
)
def test_what_cannot_be_scaled_is_refused_by_name(change, words):
    change = {name: mi.load_dict({"type": "sphere"}) if one == "made" else one for name, one in change.items()}
    with pytest.raises(InputError, match=f"^unit: {words}"):
        mp.load_scene({"type": "scene", **change}, unit="m")


def test_colours_that_have_no_spectrum_are_refused(tmp_path):
    camera = sensor(6, 16)
    camera["film"]["pixel_format"] = "rgb"
    mi.set_variant("llvm_ad_rgb")
    table = tmp_path / "silicon.csv"
    table.write_text("400,1,1,1\n1000,1,1,1\n")
    with pytest.raises(InputError, match="D65, from 360 to 830 nm"):
        by_waves(camera, responses=str(table))


ROUGH = {"type": "roughconductor", "alpha": 0.3}
ROUGHNESS = "wall.bsdf.alpha.value"


def lit(bsdf, lamp, child="path"):
    """Return the scene of a wall in the light of a lamp, to be captured by signed rays."""
    integrator = {"type": "plenoptic_wave", "method": "signed_rays", "child": {"type": child}}
    return scene_of(sensor(4, 8), integrator, wall=facing(250.0, 0.3, bsdf=bsdf), lamp=lamp)


@pytest.mark.parametrize(
    ("child", "key", "words"),
    [
        ("path", "wall.to_world", "wall.to_world"),
        ("path", "camera.aperture_radius", "aperture_radius"),
        ("prbvolpath", ROUGHNESS, "nested PRBVolpathIntegrator"),
    ],
)
def test_what_cannot_be_differentiated_is_refused_by_name(child, key, words):
    scene = lit(ROUGH, {"type": "point", "position": [0.0, 40.0, 0.0], "intensity": 3e4}, child)
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    with pytest.raises(InputError, match=f"^plenoptic_wave: {words}"):
        scene.integrator().render_forward(scene, params)
    # Mitsuba follows parameters of all scenes that there are.
    dr.disable_grad(params[key])


def test_light_without_a_derivative_is_refused_with_what_is_missing():
    scene = lit({"type": "diffuse"}, {"type": "point", "position": [0, 0, 100]})
    params = mi.traverse(scene)
    dr.enable_grad(params["lamp.position"])
    params.update()
    with pytest.raises(InputError, match=r"no derivative .*lamps"):
        scene.integrator().render_backward(scene, params, dr.ones(mi.TensorXf, (32, 32, 1)))
