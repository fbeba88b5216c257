"""An ordinary camera, without a microlens array, by rays: against Mitsuba's thin lens and rays traced here."""

import math

import mitsuba as mi
import numpy as np
import pytest
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
    return {
        "type": "thinlens",
        "fov": math.degrees(2 * math.atan(camera.detector_width / (2 * camera.mla_distance))),
        "fov_axis": "x",
        "aperture_radius": camera.aperture_radius,
        "focus_distance": camera.focus_distance,
        "near_clip": 1.0,
        "film": camera.to_sensor()["film"],
    } | changes


@pytest.mark.parametrize(
    "given",
    [
        {"resolution": (96, 64), "crop_offset": (70, 40), "crop_size": (20, 16)},
        pytest.param({"focus_distance": math.inf}, marks=pytest.mark.slow),
    ],
    ids=["crop", "infinity"],
)
def test_pictures_are_those_of_the_thin_lens(given):
    camera = ordinary(**given)
    far = {"focus_distance": 1e6} if given.get("focus_distance") == math.inf else {}
    assert disagreement(rendered(camera.to_sensor(), 0), rendered(thinlens(camera, **far), 100)) < 1.3


def test_a_white_scene_reads_one():
    for given in ({}, {"lens_model": "parabolic"}, {"wavefront": (0, 0, 0, 2.0)}, {"distortion": (1e-4, 0, 0, 0, 0)}):
        for radius in (5.0, 1e-6):
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


def behind(**given):
    """An ordinary camera behind a real lens of its own size, focused to infinity."""
    return ordinary(**({"main_lens": "double_gauss", "focal_length": None, "focus_distance": math.inf} | given))


def test_a_prescription_vignettes_as_rays_traced_one_by_one():
    """By the area of the exit pupil through which rays pass all surfaces, as Optiland's do (`test_ordinary_points`)."""
    camera = behind(aperture_radius=None, detector_width=60.0, resolution=(30, 20))
    image = render_capture(scene_of(camera.to_sensor(), **WHITE), spp=1024).image
    lens, axis = LensSystem.of(camera), np.linspace(-2, 2, 401)
    x, y = (camera.pupil_radius * values.ravel() for values in np.meshgrid(axis, axis))
    read, traced = [], []
    for row in range(10):
        column = 3 * row // 2
        place = camera.pixel_coordinates(0)[column], camera.pixel_coordinates(1)[row]
        traced.append(lens.ray((x, y), tuple(at + 0 * x for at in place))[2].sum() * (axis[1] - axis[0]) ** 2 / math.pi)
        read.append(image[row, column])
    assert traced[0] < 0.4 * traced[-1]
    assert traced[-1] == pytest.approx(1, abs=0.05)
    assert read == pytest.approx(traced, abs=0.05)
    assert np.mean(read) == pytest.approx(np.mean(traced), rel=0.02)


OF_ARRAY = [name for name, entry in PARAMETERS.items() if entry.of_array]


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


def test_cameras_are_replaced_both_ways():
    thin = {name: value for name, value in ordinary().to_dict().items() if name != "mla_lattice"}
    assert PlenopticCamera(**thin, mla_pitch=0.1, mla_tilt=(1.0, 0.0)).replace(mla_lattice="none") == ordinary()
    assert ordinary().replace(mla_lattice="square") == PlenopticCamera(**thin)
    assert ordinary().replace(mla_lattice="hexagonal", mla_pitch=0.2).mla_pitches == (0.2, 0.2)
    truncated = ordinary().to_dict()
    del truncated["mla_distance"]
    with pytest.raises(InputError, match="mla_distance: it is missing"):
        PlenopticCamera.from_dict(truncated)


SHEET = {"f_number": 4, "lenses": 10, "pixels_per_lens": 10, "pixel_size": 0.01}
CALLS = {
    "lens_grid": lambda made: views.lens_grid(made.camera),
    "estimate": lambda made: mp.estimate_reconstruction(made, 280.0),
    "matched": lambda made: PlenopticCamera.matched(**SHEET, **THIN_LENS, mla_lattice="none"),
    "objective": lambda made: PlenopticCamera(mla_lattice="none", main_lens=mp.Objective(40, 0.9)),
    "lenses_across": lambda made: design.lenses_across(made.camera, 280.0),
    "pupil_step": lambda made: made.camera.pupil_step,
    "fit": lambda made: mp.fit(made.camera, [], ["focal_length"]),
    "calibrate": lambda made: mp.calibrate(None, mp.calibration.Board(9, 5, 10.0), made.camera),
    "psf_bank": lambda made: mp.psf_bank(made.camera, [280.0]),
}


@pytest.mark.needs_extension("inverse", "calibrate", "onchip")
@pytest.mark.parametrize("name", CALLS)
def test_what_needs_an_array_refuses_by_name(name):
    made = mp.Capture(np.ones((16, 24), np.float32), ordinary())
    with pytest.raises(InputError, match="mla_lattice = none"):
        CALLS[name](made)


def test_ground_truth_is_that_of_rays_through_the_middle_of_the_pupil(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    camera = ordinary(resolution=(96, 64))
    truth = mp.ground_truth(scene_of(camera.to_sensor(), **depths()), ["depth", "shape_index"])
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
    assert mp.read_ground_truth("a.truth.exr").views == {}


RESPONSE = (0.0, 1.0, 4.0, 0.8, 8.0, 0.1)


@pytest.mark.parametrize("model", ["ray", "wave"])
def test_pixels_respond_by_the_direction_of_light(model):
    """The mean of the response over the pupil, whose direction is that from its points to the pixel."""
    camera = ordinary(aperture_radius=5.0, pixel_response=RESPONSE)
    found = render_capture(scene_of(camera.to_sensor(), **WHITE), model=model, spp=2**13).image
    P = np.linspace(-5, 5, 200)
    inside = np.hypot(P, P[:, None]) <= 5
    x, y = (camera.pixel_coordinates(axis) for axis in (0, 1))
    expected = np.empty(camera.shape)
    for row, column in np.ndindex(*camera.shape):
        angle = np.degrees(np.arctan(np.hypot(P - x[column], P[:, None] - y[row]) / camera.mla_distance))
        expected[row, column] = np.interp(angle[inside], RESPONSE[::2], RESPONSE[1::2]).mean()
    assert np.ptp(expected) > 0.2 and found == pytest.approx(expected, abs=0.015)


def test_commands_render_and_describe_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    camera = "mla_lattice=none,focal_length=50,focus_distance=300,resolution=24,16"
    assert main(["render", "letters", "-o", "raw.exr", "--spp", "1", "--camera", camera]) == 0
    assert main(["info", "raw.exr"]) == 0
    shown = capsys.readouterr().out
    assert "distance to detector" in shown and "icrolens" not in shown and "Warning" not in shown
