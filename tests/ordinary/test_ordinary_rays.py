"""An ordinary camera, without a microlens array, by rays: against Mitsuba's thin lens and rays traced here."""

import math
import pickle
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import CODE
from cases import facing, radiating, scene_of

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError, LensSystem, PlenopticCamera, design, render_capture, views
from mitsuba_plenoptic.camera.parameters import PARAMETERS
from mitsuba_plenoptic.cli import main

THIN_LENS = {"focal_length": 50.0, "focus_distance": 300.0}
THIN = THIN_LENS | {"aperture_radius": 8.0, "detector_width": 12.0}
FILM = {"resolution": (24, 16)}
WHITE = {"sky": {"type": "constant"}}


def ordinary(**given):
    return PlenopticCamera(mla_lattice="none", **(THIN | FILM | given))


def chequers(distance, half, count, place=(0.0, 0.0)):
    """A radiating wall of squares that faces the camera."""
    texture = np.indices((count, count)).sum(0)[..., None] % 2 + 0.1
    radiance = {"type": "bitmap", "data": mi.TensorXf(texture), "raw": True, "filter_type": "nearest"}
    return facing(distance, half, place, emitter={"type": "area", "radiance": radiance})


def depths():
    """Squares in focus and beyond it, partly hidden by a nearer bar that is out of focus, off the axis."""
    return {
        "focused": chequers(300.0, 16.0, 7, (-14.0, 4.0)),
        "far": chequers(600.0, 80.0, 17),
        "near": facing(200.0, (3.0, 40.0), (10.0, 0.0), **radiating(2.0)),
    }


def rendered(sensor, first, seeds=12, spp=1024, **objects):
    """Mean and its variance over seeds, which begin with `first`, of a sensor's pictures."""
    scene = scene_of(sensor, "direct", **(objects or depths()))
    images = np.array([np.array(mi.render(scene, spp=spp, seed=first + seed)) for seed in range(seeds)], np.float64)
    return images.mean(0), images.var(0, ddof=1) / seeds


def disagreement(one, other):
    """Squared differences over those that the noise makes: about 1 for equal pictures."""
    return ((one[0] - other[0]) ** 2).sum() / (one[1] + other[1]).sum()


def thinlens(camera, **changes):
    """Mitsuba's sensor with a camera's aperture, field, plane in focus and film."""
    values = {
        "type": "thinlens",
        "fov": math.degrees(2 * math.atan(camera.detector_width / (2 * camera.mla_distance))),
        "fov_axis": "x",
        "aperture_radius": camera.aperture_radius,
        "focus_distance": camera.focus_distance,
        "near_clip": 1.0,
        "film": camera.to_sensor()["film"],
    }
    return values | changes


# -- against Mitsuba's thin lens ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "given",
    [
        {},
        pytest.param({"resolution": (20, 28), "focus_distance": 500.0}, marks=pytest.mark.slow),
        {"resolution": (96, 64), "crop_offset": (70, 40), "crop_size": (20, 16)},
        pytest.param({"focus_distance": math.inf}, marks=pytest.mark.slow),
    ],
    ids=["focused", "upright film", "crop", "infinity"],
)
def test_pictures_are_those_of_the_thin_lens(given):
    camera = ordinary(**given)
    far = {"focus_distance": 1e6} if given.get("focus_distance") == math.inf else {}
    assert disagreement(rendered(camera.to_sensor(), 0), rendered(thinlens(camera, **far), 100)) < 1.3


@pytest.mark.parametrize(
    "changed", ["aperture_radius", *(pytest.param(name, marks=pytest.mark.slow) for name in ("focus_distance", "fov"))]
)
def test_the_comparison_tells_other_lenses_apart(changed):
    camera = ordinary()
    other = thinlens(camera)
    other[changed] *= 1.05 if changed == "aperture_radius" else 1.02
    assert disagreement(rendered(camera.to_sensor(), 0), rendered(other, 100)) > 2


def test_a_white_scene_reads_one():
    for given in ({}, {"lens_model": "parabolic"}, {"wavefront": (0, 0, 0, 2.0)}, {"distortion": (1e-4, 0, 0, 0, 0)}):
        for radius in (5.0, 1e-4, 1e-6):
            camera = ordinary(**given, aperture_radius=radius, crop_offset=(3, 0), crop_size=(8, 8))
            image = render_capture(scene_of(camera.to_sensor(), **WHITE), spp=64).image
            np.testing.assert_allclose(image, 1, atol=1e-5)


def test_a_small_pupil_of_a_real_lens_is_found_off_the_axis():
    """White is as bright as before a wide pupil, although aberrations move the small one by 60 of its radii."""
    means = [
        render_capture(scene_of(behind(aperture_radius=radius).to_sensor(), **WHITE), spp=256).image[:4, :4].mean()
        for radius in (1.0, 0.01)
    ]
    assert means[1] == pytest.approx(means[0], rel=0.02)


@pytest.mark.slow
def test_colours_are_those_of_lenses_at_their_wavelengths():
    camera = ordinary(glass={"index": 1.5, "abbe": 8.0})
    mi.set_variant("llvm_ad_rgb")
    sensor = camera.to_sensor()
    mean, variance = rendered(sensor, 0, spp=512)
    mi.set_variant("llvm_ad_mono")
    for channel, wavelength in enumerate((611.4, 549.1, 464.3)):
        colour = mean[..., [channel]], variance[..., [channel]]
        own = rendered(camera.at_wavelength(wavelength).to_sensor(), 100, spp=512)
        assert disagreement(colour, own) < 1.4
        if channel != 1:
            # Green is next to the line d, whose focal length is that without the glass.
            assert disagreement(colour, rendered(camera.replace(glass=None).to_sensor(), 100, spp=512)) > 1.6


@pytest.mark.parametrize("lens", [{}, {"main_lens": "double_gauss"}], ids=["thin", "prescription"])
def test_differentials_are_the_rays_of_the_next_pixels(lens):
    sensor = mi.load_dict(ordinary(**lens).to_sensor())
    place, lens_sample = mi.Point2f([0.3, 0.7], [0.4, 0.6]), mi.Point2f([0.2, 0.5], [0.5, 0.4])
    ray, _ = sensor.sample_ray_differential(0.0, 0.5, place, lens_sample)
    for name, step in (("x", mi.Point2f(1 / 24, 0)), ("y", mi.Point2f(0, 1 / 16))):
        beside, _ = sensor.sample_ray(0.0, 0.5, place + step, lens_sample)
        o, d = getattr(ray, f"o_{name}"), getattr(ray, f"d_{name}")
        found, expected = (np.array(p + 300 / v.z * v) for p, v in ((o, d), (beside.o, beside.d)))
        moved = np.abs(expected - np.array(ray.o + 300 / ray.d.z * ray.d)).max()
        assert np.abs(found - expected)[:2].max() < (0.05 if lens else 1e-4) * moved


@pytest.mark.parametrize("name", ["focal_length", "mla_distance", "detector_width"])
def test_gradients_are_differences(name):
    y, x = np.mgrid[0:64, 0:64] / 64
    texture = (0.5 + 0.3 * np.sin(17 * x + 1) * np.cos(9 * y))[..., None]
    radiance = {"type": "bitmap", "data": mi.TensorXf(texture), "raw": True}
    wall = facing(380.0, 60.0, emitter={"type": "area", "radiance": radiance})
    scene = scene_of(ordinary().to_sensor(), "direct", wall=wall)
    params = mi.traverse(scene)
    key = f"camera.{name}"
    start = float(params[key][0])

    def image(value, seed):
        params[key] = value
        params.update()
        # Gradients are drawn with the second seed.
        return mi.render(scene, params, spp=64, seed=seed, seed_grad=seed + 1)

    number = mi.Float(start)
    dr.enable_grad(number)
    made = image(number, 1)
    dr.set_grad(number, 1.0)
    found = np.array(dr.forward_to(made))
    more, less = (np.array(image(mi.Float(start * (1 + step)), 2)) for step in (1e-3, -1e-3))
    expected = (more - less) / (2e-3 * start)
    assert np.linalg.norm(found - expected) < 0.03 * np.linalg.norm(expected)


# -- prescriptions -----------------------------------------------------------------------------------


def behind(**given):
    """An ordinary camera behind a real lens of its own size, focused to infinity."""
    return ordinary(**({"main_lens": "double_gauss", "focal_length": None, "focus_distance": math.inf} | given))


def test_a_prescription_vignettes_as_rays_traced_one_by_one():
    """By the area of the exit pupil through which rays pass all surfaces, as Optiland's do (`test_spot_diagrams`)."""
    camera = behind(aperture_radius=None, detector_width=60.0, resolution=(30, 20))
    image = render_capture(scene_of(camera.to_sensor(), **WHITE), spp=1024).image
    lens, axis = LensSystem.of(camera), np.linspace(-2, 2, 401)
    x, y = (camera.pupil_radius * values.ravel() for values in np.meshgrid(axis, axis))
    read, traced = [], []
    for row in range(10):
        column = 3 * row // 2
        place = camera.pixel_coordinates(0)[column], camera.pixel_coordinates(1)[row]
        is_open = lens.ray((x, y), tuple(at + 0 * x for at in place))[2]
        traced.append(is_open.sum() * (axis[1] - axis[0]) ** 2 / math.pi)
        read.append(image[row, column])
    assert traced[0] < 0.4 * traced[-1]
    assert traced[-1] == pytest.approx(1, abs=0.05)
    assert read == pytest.approx(traced, abs=0.05)
    assert np.mean(read) == pytest.approx(np.mean(traced), rel=0.02)


# -- the parameters of an array are absent -----------------------------------------------------------

OF_ARRAY = [name for name, entry in PARAMETERS.items() if entry.of_array]
LENSES = {
    "thin": {},
    "glass": {"glass": {"index": 1.5, "abbe": 60.0}},
    "prescription": {"main_lens": "double_gauss", "focus_distance": 1000.0},
    "aberrated": {"wavefront": (0, 0, 0, 1.0), "distortion": (1e-4, 0, 0, 0, 0), "crop_size": (8, 8)},
    "hexagon": {"aperture_blades": (6, 15.0)},
    "square": {"aperture_blades": 4},
    "coded": {"aperture_image": CODE},
    "screen": {"phase_screen": {"waves": np.outer(*[[0.0, 1.0, 0.0, 1.0]] * 2).tolist(), "width": 20.0}},
}


def test_every_parameter_of_an_array_is_one():
    others = {name for name in PARAMETERS if name not in OF_ARRAY}
    assert {name for name in others if name.startswith(("mla", "detector", "pixel", "photo"))} == {
        "mla_distance",
        "mla_lattice",
        "detector_width",
        "pixel_crosstalk",
        "pixel_response",
        "detector_blur",
    }


@pytest.mark.parametrize("name", OF_ARRAY)
def test_a_parameter_of_an_array_is_refused_and_absent(name):
    camera = ordinary()
    with pytest.raises(InputError, match=rf"^{name} = .*: mla_lattice = none: the camera has no microlens array"):
        ordinary(**{name: PlenopticCamera().arguments()[name] or 1.0})
    with pytest.raises(InputError, match=f"{name} = "):
        camera.replace(**{name: 1.0})
    assert getattr(camera, PARAMETERS[name].attribute) is None
    assert name not in camera.to_dict() and f"{name}=" not in repr(camera) and name not in camera.to_sensor()
    assert f"{name} =" not in str(mi.load_dict(camera.to_sensor()))


@pytest.mark.parametrize("given", LENSES.values(), ids=LENSES)
def test_files_and_sensors_keep_the_camera(given):
    camera = ordinary(**given)
    sensor = mi.load_dict(camera.to_sensor())
    scene = mi.load_string(f"<scene version='3.0.0'>{camera.to_xml()}</scene>")
    copies = [
        PlenopticCamera.from_dict(camera.to_dict()),
        PlenopticCamera.from_json(camera.to_json()),
        pickle.loads(pickle.dumps(camera)),
        sensor.camera,
        scene.sensors()[0].camera,
        camera.replace(aperture_radius=1.0).replace(aperture_radius=camera.aperture_radius),
    ]
    assert all(copy == camera and hash(copy) == hash(camera) for copy in copies)
    exposed = {key for key in mi.traverse(sensor).keys() if key in PARAMETERS}  # noqa: SIM118
    lens = {"focal_length", "aperture_radius", "mla_distance", "detector_width"}
    assert exposed == lens | ({"wavefront"} if camera.wavefront else set())


def test_cameras_are_replaced_both_ways():
    thin = {name: value for name, value in ordinary().to_dict().items() if name != "mla_lattice"}
    array = PlenopticCamera(**thin, mla_pitch=0.1, mla_tilt=(1.0, 0.0))
    assert array.replace(mla_lattice="none") == ordinary()
    assert ordinary().replace(mla_lattice="square") == PlenopticCamera(**thin)
    assert ordinary().replace(mla_lattice="hexagonal", mla_pitch=0.2).mla_pitches == (0.2, 0.2)
    truncated = ordinary().to_dict()
    del truncated["mla_distance"]
    with pytest.raises(InputError, match="mla_distance: it is missing"):
        PlenopticCamera.from_dict(truncated)


def test_changed_parameters_apply():
    scene = scene_of(ordinary().to_sensor(), "direct", **depths())
    params = mi.traverse(scene)
    params["camera.aperture_radius"], params["camera.mla_distance"] = 4.0, 70.0
    params.update()
    camera = scene.sensors()[0].camera
    assert camera == ordinary(aperture_radius=4.0, focus_distance=None, mla_distance=70.0)
    changed = np.array(mi.render(scene, spp=16, seed=1))
    made = scene_of(camera.to_sensor(), "direct", **depths())
    np.testing.assert_allclose(changed, np.array(mi.render(made, spp=16, seed=1)), atol=1e-4)


# -- what a capture is for ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def capture():
    mi.set_variant("llvm_ad_mono")
    return render_capture(scene_of(ordinary().to_sensor(), **depths()), spp=16, noise=True)


def test_captures_are_made_written_exposed_and_shown(capture, tmp_path):
    assert capture.model == "ray" and capture.noise.shape == capture.image.shape == (16, 24)
    mp.write_capture(tmp_path / "raw.exr", capture)
    again = mp.read_capture(tmp_path / "raw.exr")
    assert again.camera == ordinary() and np.array_equal(again.image, capture.image)
    assert mp.expose(capture, mp.Detector(), photons=1000).camera == ordinary()
    assert mp.estimate_capture(scene_of(ordinary().to_sensor(), **WHITE), spp=16).seconds < 60
    assert design.design_warnings(ordinary(), 550.0) == []


@pytest.mark.needs_extension("studio")
def test_notebooks_show_it():
    shown = ordinary()._repr_html_()
    assert "focal length" in shown and "micro" not in shown


@pytest.mark.needs_extension("raw")
def test_a_photograph_through_a_mosaic_is_demosaiced():
    mi.set_variant("llvm_ad_rgb")
    sensor = ordinary().to_sensor()
    grey = render_capture(scene_of(sensor, **WHITE), spp=4)
    exposed = mp.expose(grey, mp.Detector(mosaic="RGGB", read_noise=0.0), photons=5000)
    assert mp.demosaic(exposed).image == pytest.approx(1, abs=0.2)


POINTS = np.array([[0.0, 0.0, 300.0]])
SHEET = {"f_number": 4, "lenses": 10, "pixels_per_lens": 10, "pixel_size": 0.01}
QUANTITIES = (
    "lattice", "lens_count", "bin_count", "mla_pitch", "mla_focal_length", "reduced_distance", "pixels_per_lens",
    "micro_image_pitch", "micro_image_diameter", "pupil_step",
)  # fmt: skip
CALLS = {
    "": {
        "decode": lambda made, camera: mp.decode(made),
        "micro_images": lambda made, camera: views.micro_images(made),
        "white_image": lambda made, camera: views.white_image(camera),
        "lens_grid": lambda made, camera: views.lens_grid(camera),
        "reconstruct": lambda made, camera: mp.reconstruct(made, 280.0),
        "coherent": lambda made, camera: mp.reconstruct(made, 280.0, method="coherent", wavelength=550.0),
        "estimate": lambda made, camera: mp.estimate_reconstruction(made, 280.0),
        "points": lambda made, camera: render_capture(
            scene_of(camera.to_sensor(), **depths()), model="wave", method="points", spp=4
        ),
        "matched": lambda made, camera: PlenopticCamera.matched(**SHEET, **THIN_LENS, mla_lattice="none"),
        "objective": lambda made, camera: PlenopticCamera(mla_lattice="none", main_lens=mp.Objective(40, 0.9)),
        "lenses_across": lambda made, camera: design.lenses_across(camera, 280.0),
        "focus_types": lambda made, camera: design.focus_types(camera),
        **{name: lambda made, camera, name=name: getattr(camera, name) for name in QUANTITIES},
    },
    "inverse": {
        "RayRefocus": lambda made, camera: mp.refocus.RayRefocus(camera, 280.0),
        "CoherentRefocus": lambda made, camera: mp.refocus.CoherentRefocus(camera, 280.0, 550.0),
        "DeconvolvedRefocus": lambda made, camera: mp.refocus.DeconvolvedRefocus(camera, 280.0),
        "fit": lambda made, camera: mp.fit(camera, [], ["focal_length"]),
        "lattice_from_white": lambda made, camera: mp.fitting.lattice_from_white(camera, made.image),
        "maximise": lambda made, camera: mp.optimisation.maximise(None, camera, {"focal_length": (45, 55)}),
        "information": lambda made, camera: mp.optimisation.DepthInformation(POINTS, 1e4).value(camera),
        "contrast": lambda made, camera: mp.optimisation.RefocusedContrast(camera, POINTS, [1.0], wavelength=550.0),
    },
    "calibrate": {
        "calibrate": lambda made, camera: mp.calibrate(None, mp.calibration.Board(9, 5, 10.0), camera),
        "evaluate": lambda made, camera: mp.calibration.evaluate(None, mp.calibration.Board(9, 5, 10.0), camera),
        "camera_centres": lambda made, camera: mp.calibration.camera_centres(camera),
    },
    "onchip": {
        "dual_pixel": lambda made, camera: mp.dual_pixel(made),
        "half_disparity": lambda made, camera: mp.half_disparity(camera, 280.0),
        "psf_bank": lambda made, camera: mp.psf_bank(camera, [280.0]),
    },
    "wavefront": {
        "view_slopes": lambda made, camera: mp.wavefront.view_slopes(camera, made.image, POINTS[0]),
        "fit_wavefronts": lambda made, camera: mp.wavefront.fit_wavefronts(
            camera, made.image, mp.wavefront.Zone(POINTS)
        ),
    },
    "studio": {"view": lambda made, camera: mp.view(made)},
}
"""Calls, with a capture and its camera, that need an array, by the extension that they need."""

COMMANDS = {
    "": (
        "reconstruct CAPTURE -o out.png --distance 280",
        "stack CAPTURE -o out.png --distance 280",
        "views CAPTURE -o out.png",
        "epi CAPTURE -o out.png",
        "depth CAPTURE -o out.exr",
        "convert CAPTURE -o out.nc",
        "compare letters -o out --camera CAMERA --distance 280",
        "info CAMERA --microlens out.png",
    ),
    "inverse": ("fit CAPTURE -o out.json --scene letters --photons 9 --parameter focal_length",),
    "onchip": ("dual CAPTURE -o out.png",),
    "studio": ("preview letters -o out.png --camera CAMERA", "view CAPTURE -o out.html"),
}


def needing(extension):
    """The mark of a test that needs an extension; none for the core."""
    return [pytest.mark.needs_extension(extension)] if extension else []


@pytest.mark.parametrize(
    "call",
    [
        pytest.param(call, id=name, marks=needing(extension))
        for extension, calls in CALLS.items()
        for name, call in calls.items()
    ],
)
def test_what_needs_an_array_refuses_by_name(call, capture):
    with pytest.raises(InputError, match=r"^[\w =/.-]+: mla_lattice = none: the camera has no microlens array$"):
        call(capture, capture.camera)


@pytest.mark.parametrize(
    "words",
    [
        pytest.param(words, id=words.partition(" -o")[0], marks=needing(extension))
        for extension, lines in COMMANDS.items()
        for words in lines
    ],
)
def test_commands_that_need_an_array_write_nothing(words, capture, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mp.write_capture("raw.exr", capture)
    Path("camera.json").write_text(capture.camera.to_json())
    before = sorted(tmp_path.rglob("*"))
    assert main(words.replace("CAPTURE", "raw.exr").replace("CAMERA", "camera.json").split()) == 2
    assert "mla_lattice = none: the camera has no microlens array" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_ground_truth_is_that_of_rays_through_the_middle_of_the_pupil(tmp_path, monkeypatch):
    """Squares of the scene by similar triangles."""
    monkeypatch.chdir(tmp_path)
    camera = ordinary(resolution=(96, 64))
    scene = scene_of(camera.to_sensor(), **depths())
    truth = mp.ground_truth(scene, ["depth", "shape_index"])
    x, y = (-camera.pixel_coordinates(axis) / camera.mla_distance for axis in (0, 1))
    expected, names = np.full(camera.shape, np.inf), np.full(camera.shape, "", object)
    # Nearest last.
    squares = {"far": (600.0, 0, 0, 80, 80), "focused": (300.0, -14, 4, 16, 16), "near": (200.0, 10, 0, 3, 40)}
    for name, (g, left, up, wide, high) in squares.items():
        hit = (abs(g * x - left) < wide) & (abs(g * y - up) < high)[:, None]
        expected[hit], names[hit] = g, name
    assert truth.views == {} and np.array_equal(np.isinf(truth.pixels["depth"]), np.isinf(expected))
    np.testing.assert_allclose(truth.pixels["depth"], expected, rtol=1e-5)
    assert np.array_equal(np.array(["", *truth.shapes], object)[truth.pixels["shape_index"].astype(int)], names)
    mp.write_ground_truth("a.truth.exr", truth)
    again = mp.read_ground_truth("a.truth.exr")
    assert again.views == {} and np.array_equal(again.pixels["depth"], truth.pixels["depth"])


PIXELS = {"pixel_response": (0.0, 1.0, 4.0, 0.8, 8.0, 0.1)}


@pytest.mark.parametrize("model", ["ray", "wave"])
def test_pixels_respond_by_the_direction_of_light(model):
    """The mean of the response over the pupil, whose direction is that from its points to the pixel."""
    camera = ordinary(aperture_radius=5.0, **PIXELS)
    found = render_capture(scene_of(camera.to_sensor(), **WHITE), model=model, spp=2**13).image
    P = np.linspace(-5, 5, 200)
    inside = np.hypot(P, P[:, None]) <= 5
    x, y = (camera.pixel_coordinates(axis) for axis in (0, 1))
    expected = np.empty(camera.shape)
    for row, column in np.ndindex(*camera.shape):
        angle = np.degrees(np.arctan(np.hypot(P - x[column], P[:, None] - y[row]) / camera.mla_distance))
        expected[row, column] = np.interp(angle, PIXELS["pixel_response"][::2], PIXELS["pixel_response"][1::2])[
            inside
        ].mean()
    assert np.ptp(expected) > 0.2 and found == pytest.approx(expected, abs=0.015)


@pytest.mark.parametrize("model", ["ray", "wave"])
def test_light_crosses_the_walls_between_pixels(model):
    camera = ordinary(resolution=(12, 12), detector_width=1.2, aperture_radius=2.0)
    place = camera.pixel_coordinates(0)[5] * 300.0 / camera.mla_distance
    # Its image is smaller than a pixel.
    lamp = {"lamp": facing(300.0, 0.15, (-place, -place), **radiating())}

    def taken(**changes):
        spp = 2**15 if model == "ray" else 2**12
        return render_capture(scene_of(camera.replace(**changes).to_sensor(), **lamp), model=model, spp=spp).image

    image, plain = taken(pixel_crosstalk=0.05), taken()
    assert plain[5, 5] > 0.9 * plain.sum()
    for row, column in ((5, 4), (5, 6), (4, 5), (6, 5)):
        assert image[row, column] - plain[row, column] == pytest.approx(0.05 * plain[5, 5], rel=0.15)
    assert image[5, 5] == pytest.approx(0.8 * plain[5, 5], rel=0.05)


def test_commands_render_and_describe_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    camera = "mla_lattice=none,focal_length=50,focus_distance=300,resolution=24,16"
    assert main(["render", "letters", "-o", "raw.exr", "--spp", "1", "--camera", camera]) == 0
    assert main(["info", "raw.exr"]) == 0
    shown = capsys.readouterr().out
    assert "distance to detector" in shown and "icrolens" not in shown and "Warning" not in shown
