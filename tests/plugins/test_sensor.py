"""The sensor plugin: radiometry, geometry, variants, parameters and gradients, and rays of each colour."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import error
from cases import facing, radiating, scene_of
from scipy.ndimage import binary_erosion

from mitsuba_plenoptic import InputError, LensSystem, PlenopticCamera, reconstruct, render_capture
from mitsuba_plenoptic.views import white_image


def white_scene(sensor, **extra):
    return scene_of(sensor, sky={"type": "constant"}, **extra)


def picture_wall(texture, *place):
    radiance = {"type": "bitmap", "data": mi.TensorXf(texture), "raw": True}
    return facing(*place, emitter={"type": "area", "radiance": radiance})


def smooth_texture(size=32):
    y, x = np.mgrid[0:size, 0:size] / size
    return (0.5 + 0.3 * np.sin(7 * x + 1) * np.cos(5 * y))[..., None].astype(np.float32)


LENSES = {"detector_width": 0.256, "resolution": (64, 48)}
DOUBLE_GAUSS = {"mla_lattice": "none", "main_lens": "double_gauss", "focal_length": 50, "focus_distance": 800}
SLANTED = (0.6, 0.0, -0.8)


def outputs(camera, integrator, spp=64, pixel_format="luminance", **objects):
    """Return the image and the extra outputs before a sky and a slanted wall of radiance 1, in mm from the lens."""
    distance = camera.focus_distance or 240.0
    to_world = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], np.degrees(np.arccos(-0.8)))
    wall = {"type": "rectangle", "to_world": to_world.scale(900), "emitter": {"type": "area", "radiance": 1.0}}
    scene = white_scene(camera.to_sensor(pixel_format=pixel_format), **(objects or {"wall": wall}))
    image = np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=spp))
    return np.split(image, [scene.sensors()[0].film().base_channels_count()], axis=2)


@pytest.mark.parametrize(
    ("camera", "is_one"),
    [
        (LENSES, True),
        ({**DOUBLE_GAUSS, "detector_width": 24, "resolution": (36, 24)}, False),
        ({**LENSES, "aperture_radius": 10.0, "crop_offset": (10, 8), "crop_size": (30, 20)}, False),
    ],
)
def test_extra_outputs_are_those_of_rays_that_pass(camera, is_one):
    """First moments are the image, mean points are on the wall, dark pixels read 0; the sky is behind blocked rays."""
    camera = PlenopticCamera(**camera)
    child = {"type": "aov", "aovs": "p:position,n:geo_normal", "q": {"type": "path"}}
    image, found = outputs(camera, {"type": "moment", "a": child})
    names = mi.load_dict({"type": "moment", "a": child}).aov_names()
    of = {name: found[..., channel] for channel, name in enumerate(names)}
    for name in ("a.q.R", "a.X", "a.Y", "a.Z"):
        assert of[name] == pytest.approx(image[..., 0], abs=1e-6)
    dark, lit = image[..., 0] == 0, image[..., 0] > 0
    assert not found[dark].any() and (of["a.q.A"][lit] == 1).all()
    place, normal = ([of[f"a.{name}.{axis}"][lit] for axis in "XYZ"] for name in "pn")
    distance = camera.focus_distance or 240.0
    assert np.dot(SLANTED, np.subtract(place, [[0], [0], [distance]])) == pytest.approx(0, abs=5e-6 * distance)
    assert np.abs(SLANTED @ np.array(normal)) == pytest.approx(1, abs=1e-5)
    # Weights of 0 and 1 are their own squares; of other weights the mean square is the larger.
    assert np.allclose(of["m2_a.Y"], image[..., 0], atol=1e-6) == is_one
    assert (of["m2_a.Y"] >= image[..., 0] ** 2 - 1e-6).all()
    assert image.mean() == pytest.approx(outputs(camera, {"type": "volpath"})[0].mean(), rel=0.01)


def test_stokes_vectors_of_polarized_light_are_as_bright_as_the_image():
    mi.set_variant("llvm_ad_mono_polarized")
    filtered = facing(200.0, 900.0, bsdf={"type": "polarizer"})
    integrator = {"type": "stokes", "d": {"type": "aov", "aovs": "d:depth", "p": {"type": "path"}}}
    camera = PlenopticCamera(**LENSES, detector_blur=0.004)
    image, found = outputs(camera, integrator, filter=filtered, wall=facing(240.0, 900.0, **radiating()))
    assert found[..., 0] == pytest.approx(image[..., 0], abs=1e-6)
    assert np.abs(found[..., 3]) == pytest.approx(image[..., 0], abs=1e-5)
    assert found[..., [6, 9]] == pytest.approx(0, abs=1e-4)
    assert found[found[..., -1] > 0, -1] == pytest.approx(200, abs=0.2)


def test_an_index_is_that_of_one_ray_and_alpha_of_rays_that_pass():
    camera = PlenopticCamera(**LENSES)
    balls = {f"ball{k}": {"type": "sphere", "center": [0.12 * k - 0.24, 0, 240], "radius": 0.05} for k in range(5)}
    integrator = {"type": "aov", "aovs": "d:depth,i:shape_index", "p": {"type": "path"}}
    image, found = outputs(camera, integrator, pixel_format="luminance_alpha", **balls)
    assert len(np.unique(found[..., 1])) == 1 + len(balls) and (found[..., 1] % 1 == 0).all()
    assert ((found[..., 1] > 0) == (found[..., 0] > 239)).all()
    # Rays that pass meet the sky or a dark ball.
    assert (image[..., 1] == ((image[..., 0] > 0) | (found[..., 0] > 0))).all() and image[..., 1].min() == 0


def test_shutter_times_reach_the_rays(camera_dict):
    sensor = mi.load_dict(camera_dict(shutter_open=0.25, shutter_close=0.75))
    ray, _ = sensor.sample_ray(0.5, 0.5, [0.5, 0.5], [0.5, 0.5])
    assert (sensor.shutter_open(), sensor.shutter_open_time()) == (0.25, 0.5)
    assert dr.allclose(ray.time, 0.5)


def test_numbers_and_places_are_checked(camera_dict):
    sensor = mi.load_dict(camera_dict(mla_offset=mi.ScalarPoint3f(0.01, 0.02, 0)))
    assert sensor.camera.mla_offset == (0.01, 0.02)
    parameters = mi.traverse(sensor)
    parameters["aperture_radius"] = 10.0
    parameters.update()
    assert np.allclose(sensor.bbox().max, [10, 10, 0])
    parameters["mla_pitch"] = -1.0
    with pytest.raises(InputError, match="mla_pitch = -1"):
        parameters.update()
    with pytest.raises(RuntimeError, match="plenoptic: to_world"):
        mi.load_dict(camera_dict(to_world=mi.ScalarTransform4f().scale(2)))
    scene = white_scene(camera_dict(resolution=32))
    with pytest.raises(InputError, match="light tracing"):
        mi.load_dict({"type": "ptracer"}).render(scene, scene.sensors()[0], spp=1)


def derivatives(scene, parameter, spp, step=None):
    """Return the derivative of a capture by the last number of a parameter, and the difference of captures."""
    parameters, key = mi.traverse(scene), f"camera.{parameter}"
    Number, start = type(parameters[key]), np.array(parameters[key], dtype=np.float64).ravel()
    change, step = np.eye(start.size)[-1], step or 1e-3 * start[-1]

    def image(value):
        parameters[key] = value
        parameters.update()
        return mi.render(scene, parameters, spp=spp, seed=1)

    value = Number(start)
    dr.enable_grad(value)
    rendered = image(value)
    dr.set_grad(value, Number(change))
    gradient = np.array(dr.forward_to(rendered))
    higher, lower = (np.array(image(Number(start + sign * step * change))) for sign in (1, -1))
    return gradient[..., 0], (higher - lower)[..., 0] / (2 * step)


@pytest.mark.parametrize(("parameter", "lens_model"), [("mla_distance", "ideal"), ("detector_distance", "parabolic")])
def test_gradients_behind_a_medium_agree_off_the_axis(parameter, lens_model):
    """By Snell's law, 30 mm off the axis, where it moves light by many pixels."""
    camera = PlenopticCamera(
        detector_width=30064 * 0.002, resolution=(30064, 64), crop_offset=(30000, 0), crop_size=(64, 64),
        mla_medium=1.5, mla_focal_length=0.768, lens_model=lens_model,
    )  # fmt: skip
    wall = picture_wall(smooth_texture(128), 210.0, 1.2, (-30.0 * 210 / 120, 0.0))
    scene = scene_of(camera.to_sensor(), "path", wall=wall)
    gradient, difference = derivatives(scene, parameter, 256, 1e-4 * getattr(camera, parameter))
    # Away from the pupil's moving edge, which white images have where light goes without Snell's law.
    inside = binary_erosion(white_image(camera.replace(aperture_radius=4.0)) > 0.999, iterations=2)
    assert inside.sum() > 300
    assert np.linalg.norm(gradient[inside] - difference[inside]) <= 0.03 * np.linalg.norm(difference[inside])


SYMBOLIC = {
    "square": {"mla_pitch": 0.25, "mla_focal_length": 1.5},
    "parabolic": {"mla_lattice": "hexagonal", "mla_pitch": 0.25, "mla_focal_length": 1.5, "lens_model": "parabolic"},
    "prescription": {"main_lens": "cooke_triplet", "mla_pitch": 0.25, "mla_focal_length": 1.5},
    "none": {"mla_lattice": "none"},
}


def small(kind):
    return PlenopticCamera(
        focal_length=50, aperture_radius=5, focus_distance=400, resolution=(32, 24), detector_width=2, **SYMBOLIC[kind]
    )


@pytest.mark.parametrize("kind", SYMBOLIC)
def test_rays_of_symbolic_loops_are_those_of_evaluated_ones(kind):
    sensor = mi.load_dict(small(kind).to_sensor())

    def total(mode):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, 500)

        def body(count, sums, sampler):
            at = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
            ray, weight = sensor.sample_ray_differential(0.0, *at)
            parts = dr.select(ray.maxt > 0, 1, 0) * mi.Array3f(weight[0], ray.d_x.x, ray.o.y)
            return count + 1, sums + parts, sampler

        start = mi.UInt32(0), mi.Array3f(0), sampler
        return np.array(dr.while_loop(start, lambda count, *_: count < 3, body, mode=mode)[1])

    assert np.array_equal(total("symbolic"), total("evaluated"))


def test_a_batch_is_the_pictures_of_its_cameras_and_follows_their_parameters():
    """Whatever sensors there are: of a refused one an exception holds what was made."""
    with pytest.raises(InputError) as held:
        type(mi.load_dict(small("square").to_sensor()))(mi.Properties("plenoptic"))
    cameras = [small("square"), small("none")]
    film = {"type": "hdrfilm", "width": 64, "height": 24, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    ball = {"sky": {"type": "constant"}, "ball": {"type": "sphere", "center": [0, 0, 400], "radius": 3.0}}
    batch = {"type": "batch", "a": cameras[0].to_sensor(), "b": cameras[1].to_sensor(), "film": film}
    scene = mi.load_dict({"type": "scene", "batch": batch, **ball})
    parameters = mi.traverse(scene)
    parameters["batch.a.focal_length"] = 45.0
    parameters.update()
    found = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=512))
    for part, camera in zip(np.hsplit(found, 2), cameras, strict=True):
        own = camera.replace(focal_length=45.0) if camera.has_array else camera
        alone = mi.load_dict({"type": "scene", "camera": own.to_sensor(), **ball})
        expected = np.array(mi.render(alone, integrator=mi.load_dict({"type": "path"}), spp=512))
        assert part.mean() == pytest.approx(expected.mean(), rel=0.01)
        assert held.traceback and np.corrcoef(part.ravel(), expected.ravel())[0, 1] > 0.98


@pytest.mark.parametrize("kind", ["prbvolpath", "prb_projective"])
def test_integrators_that_hold_the_rays_of_the_sensor_refuse_gradients_by_it(kind):
    """Their gradient would be 0 in silence; by moving shapes, those that project edges refuse the sensor."""
    texture = picture_wall(smooth_texture(), 400.0, 40.0)
    scene = scene_of(small("square").to_sensor(), {"type": kind}, wall=texture, cube={"type": "cube"})
    parameters = mi.traverse(scene)
    name = next(key for key in parameters.keys() if key.endswith(".mla_distance"))  # noqa: SIM118
    dr.enable_grad(parameters[name])
    parameters.update()
    with pytest.raises(RuntimeError) as refusal:
        mi.render(scene, parameters, spp=1)
    assert str(refusal.value.__cause__).startswith("plenoptic: mla_distance: ")
    dr.disable_grad(parameters[name])
    parameters.update()
    if kind == "prb_projective":
        dr.enable_grad(parameters["cube.vertex_positions"])
        parameters.update()
        with pytest.raises(InputError, match=r"^plenoptic: prb_projective "):
            dr.backward(dr.sum(mi.render(scene, parameters, spp=1), axis=None))


FROZEN = """
    import sys
    import drjit as dr, mitsuba as mi, numpy as np
    mi.set_variant("llvm_ad_mono")
    import mitsuba_plenoptic as mp
    sensor = mp.PlenopticCamera.from_json(sys.argv[1]).to_sensor()
    scene = mi.load_dict({"type": "scene", "camera": sensor, "sky": {"type": "constant"}})

    def taken(integrator):
        return lambda seed: mi.render(scene, integrator=integrator, spp=4, seed=seed)

    rays = taken(mi.load_dict({"type": "path"}))
    assert np.array_equal(dr.freeze(rays)(mi.UInt32(3)), rays(mi.UInt32(3)))
    try:
        dr.freeze(taken(mi.load_dict({"type": "plenoptic_wave"})))(mi.UInt32(3))
    except RuntimeError as error:
        while error.__cause__:
            error = error.__cause__
        print(type(error).__name__, error)
"""


def test_frozen_functions_capture_by_rays_and_refuse_waves_in_one_line(python):
    """In a process of its own, since Dr.Jit freezes no function beside another scene, whose objects it might call."""
    made = python(FROZEN, small("square").to_json())
    assert made.returncode == 0, made.stderr
    assert made.stdout.startswith("InputError captures by waves: dr.freeze: ")


RGB_WAVELENGTHS = (611.4, 549.1, 464.3)
"""Of red, green and blue in nanometres, as the documentation states them."""

SMALL = {"resolution": (64, 64), "detector_width": 0.128}
FLINT = {"index": 1.7, "abbe": 30.0}


def sensor_of(camera):
    return mi.load_dict(camera.to_sensor(pixel_format="rgb"))


def rays(sensor, channel, count=256):
    """Rays of one channel, by the third of the random numbers that stands for it, and their weights."""
    random = np.random.default_rng(1).random((4, count)).astype(np.float32)
    lens = mi.Point2f((random[2] + channel) / 3 if mi.is_rgb else random[2], random[3])
    return sensor.sample_ray(0.0, mi.Float(random[3]), mi.Point2f(*random[:2]), lens)


@pytest.mark.parametrize("channel", [0, 2])
def test_channels_through_a_singlet(channel):
    """Slopes and places are those of the wavelength of the channel alone, traced in double precision."""
    mi.set_variant("llvm_ad_rgb")
    camera = PlenopticCamera(main_lens="singlet", focal_length=80, aperture_radius=4, **SMALL)
    ray, weight = rays(sensor_of(camera), channel)
    weight = np.array(weight)
    own = np.zeros(3)
    own[channel] = 3
    lit = weight[channel] > 0
    assert lit.sum() > 50 and np.all(weight[:, lit] == own[:, None])
    # Behind the array a ray goes from its pixel to the centre of its lens: what leaves the main lens must come back so
    # through it at that wavelength, and at no other.
    p = (np.random.default_rng(1).random((4, 256)).astype(np.float32)[:2, lit] - 0.5) * camera.detector_width
    chief = p * camera.pupil_distance / (camera.pupil_distance + camera.detector_distance)
    expected = ((np.floor(chief / camera.mla_pitch) + 0.5) * camera.mla_pitch - p) / camera.mla_focal_length
    origin, direction = np.array(ray.o, np.float64)[:, lit], np.array(ray.d, np.float64)[:, lit]
    misses = [
        LensSystem.of(camera, wavelength).through(tuple(origin), tuple(direction[:2] / direction[2]))[1] - expected
        for wavelength in RGB_WAVELENGTHS
    ]
    errors = [np.abs(miss).max() for miss in misses]
    assert errors[channel] < 2e-5 and min(errors[:channel] + errors[channel + 1 :]) > 1e-4


@pytest.mark.slow
def test_polarized_variants_record_the_same_light_through_glass():
    """Weights are Mueller matrices there: a product with a spectrum ended in `std::bad_cast`."""
    images = []
    for variant in ("llvm_ad_spectral", "llvm_ad_spectral_polarized"):
        mi.set_variant(variant)
        sensor = PlenopticCamera(main_lens="double_gauss", **SMALL).to_sensor()
        images.append(render_capture(white_scene(sensor, integrator="direct"), spp=2).image)
    np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-5)


def test_spectral_rays_follow_their_first_wavelength():
    mi.set_variant("llvm_ad_spectral")
    camera = PlenopticCamera(glass=FLINT, mla_glass=FLINT, **SMALL)
    ray, weight = rays(sensor_of(camera), 0)
    wavelengths = np.array(ray.wavelengths)[0]
    weight = np.array(weight)
    assert np.all(weight[1:] == 0) and np.any(weight[0] > 0)
    plain, _ = rays(sensor_of(PlenopticCamera(**SMALL)), 0)
    for lane in np.flatnonzero(weight[0] > 0)[:3]:
        other, _ = rays(sensor_of(camera.at_wavelength(float(wavelengths[lane]))), 0)
        assert np.abs(np.array(other.d)[:, lane] - np.array(ray.d)[:, lane]).max() < 2e-6
        if abs(wavelengths[lane] - 587.56) > 30:
            assert np.abs(np.array(plain.d)[:, lane] - np.array(ray.d)[:, lane]).max() > 1e-5


def test_every_channel_is_the_capture_at_its_wavelength():
    """Of thin lenses of glass, against cameras with the focal lengths of each wavelength, without dispersion."""
    mi.set_variant("llvm_ad_rgb")
    scale = mi.ScalarTransform4f().scale([40, 40, 1])
    board = facing(240.0, 10.0, **radiating({"type": "checkerboard", "to_uv": scale, "color0": 0.1, "color1": 0.9}))
    camera = PlenopticCamera(glass=FLINT, mla_glass=FLINT, **SMALL)

    def capture(camera, spp):
        scene = scene_of(camera.to_sensor(pixel_format="rgb"), "direct", board=board)
        return render_capture(scene, spp=spp).image.reshape(16, 4, 16, 4, 3).mean((1, 3))

    found, plain = capture(camera, 768), capture(camera.replace(glass=None, mla_glass=None), 256)
    for channel, wavelength in ((0, RGB_WAVELENGTHS[0]), (2, RGB_WAVELENGTHS[2])):
        alone = capture(camera.at_wavelength(wavelength), 256)
        own, other = (error(found[..., channel], image[..., channel]) for image in (alone, plain))
        assert own < 0.03
    assert other > 0.1
    # Glasses of one index for all wavelengths leave all channels to every ray.
    _, weight = rays(sensor_of(PlenopticCamera(glass=1.5, **SMALL)), 1)
    assert set(np.unique(np.array(weight))) <= {0.0, 1.0}


@pytest.mark.filterwarnings("ignore:.*does not go back through the main lens")
def test_waves_refocus_each_channel_with_its_own_lens():
    """The plane that is sharp at a wavelength, where the stated focal length would blur it."""
    mi.set_variant("llvm_ad_mono")
    camera = PlenopticCamera(glass={"index": 1.5, "abbe": 20.0}, resolution=(128, 128), detector_width=0.256)
    image = np.random.default_rng(0).random((128, 128, 3)).astype(np.float32)
    wavelengths = (650.0, 550.0, 450.0)
    made = reconstruct(image, 240.0, method="coherent", camera=camera, wavelength=wavelengths).image
    for channel, wavelength in enumerate(wavelengths):
        own = {"camera": camera.at_wavelength(wavelength), "wavelength": wavelength}
        alone = reconstruct(image[..., channel], 240.0, method="coherent", **own).image
        assert np.array_equal(made[..., channel], alone, equal_nan=True)
