"""Cameras in sweeps: each capture is that of the camera with the varied value written into what states it."""

import itertools
import json

import mitsuba as mi
import numpy as np
import pytest
import xarray as xr
from cameras import write_scene

from mitsuba_plenoptic import PlenopticCamera, load_scene, read_capture, reconstruct, render_capture, with_camera
from mitsuba_plenoptic.camera import camera_and_record, varied_camera
from mitsuba_plenoptic.capture_spec import CaptureSpec
from mitsuba_plenoptic.extensions.studio.sweep import sweep

pytest.importorskip("h5netcdf")

SHEET = {
    "f_number": 4, "lenses": 4, "pixels_per_lens": 5, "pixel_size": 0.012, "focal_length": 50, "focus_distance": 240
}  # fmt: skip
BY_SIZE = {name: value for name, value in SHEET.items() if name != "lenses"} | {"sensor_size": 0.24}
MATCHED_PARAMETERS = PlenopticCamera.matched(**SHEET).to_dict()

BALL = """<emitter type="constant"/><shape type="sphere"><point name="center" x="0.5" y="0" z="240"/>
<float name="radius" value="2"/><bsdf type="diffuse"><texture name="reflectance" type="checkerboard">
<transform name="to_uv"><scale x="40" y="40"/></transform></texture></bsdf></shape>"""


def text_of(camera):
    return ",".join(f"{name}={value}" for name, value in camera.items())


def without(camera, *names):
    return {name: value for name, value in camera.items() if name not in names}


@pytest.fixture
def scene(tmp_path):
    """Write a scene of a ball in the plane in focus, whose sensor is none of this package."""
    path = tmp_path / "ball.xml"
    film = '<film type="hdrfilm"><string name="pixel_format" value="luminance"/></film>'
    sensor = f'<integrator type="path"/><sensor type="perspective">{film}</sensor>'
    path.write_text(f'<scene version="3.0.0">{sensor}{BALL}</scene>')
    return path


@pytest.mark.parametrize(
    ("stated", "grid", "replaced"),
    [
        (SHEET, {"pixels_per_lens": [4, 5, 6]}, ()),
        (SHEET, {"mla_distance": [63, 64]}, ("focus_distance",)),
        (SHEET, {"mla_pitch": [0.05, 0.06]}, ("pixels_per_lens",)),
        (without(SHEET, "f_number"), {"f_number": [4, 8]}, ()),
        (BY_SIZE, {"lenses": [3, 4], "f_number": [4, 5]}, ("sensor_size",)),
        ({"mla_focal_length": 0.4}, {"mla_focal_length": [0.4, 0.5], "focus_distance": [240]}, ()),
        ({"mla_distance": 110, "mla_focal_length": 0.4}, {"focus_distance": [240, 280]}, ("mla_distance",)),
    ],
)  # fmt: skip
def test_varied_values_are_stated_before_anything_follows(stated, grid, replaced):
    """The camera is that of the text ``--camera`` with the value written into it."""
    for place in range(2):
        varied = {name: values[min(place, len(values) - 1)] for name, values in grid.items()}
        single = camera_and_record(text_of(without(stated, *replaced) | varied))[0]
        assert varied_camera(stated, varied) == single
        assert place == 0 or varied_camera(stated, {name: values[0] for name, values in grid.items()}) != single


@pytest.mark.parametrize(
    ("varied", "sheet"),
    [
        ({"f_number": 5.0, "focus_distance": 280.0}, {"f_number": 5.0, "focus_distance": 280.0}),
        ({"focal_length": 60.0, "pixel_size": 0.01}, {"focal_length": 60.0, "pixel_size": 0.01}),
        ({"sensor_size": 0.36}, {"lenses": 6}),
        ({"sensor_size": 0.24, "resolution": 40}, {"pixel_size": 0.006, "lenses": 8, "pixels_per_lens": 5}),
    ],
)
def test_a_camera_of_parameters_whose_micro_images_touch_has_a_sheet(varied, sheet):
    stated = without(MATCHED_PARAMETERS, "mla_distance") | {"focus_distance": 240}
    found, expected = varied_camera(stated, varied).arguments(), PlenopticCamera.matched(**SHEET | sheet).arguments()
    for name in ("mla_pitch", "detector_distance", "mla_focal_length", "detector_width", "aperture_radius"):
        assert found[name] == pytest.approx(expected[name], rel=1e-9), name
    assert found["resolution"] == expected["resolution"]


def test_points_are_captures_and_reconstructions_of_their_own(scene, tmp_path, run):
    """Smaller images begin at the first pixel, and the rest is no number."""
    camera, grid = tmp_path / "camera.json", {"sensor_size": [0.24, 0.36], "pixels_per_lens": [5, 6]}
    camera.write_text(json.dumps(BY_SIZE))
    words = ["--vary", "sensor_size=0.24,0.36", "--vary", "pixels_per_lens=5,6", "--vary", "distance=210,240"]
    run("sweep", scene, "-o", tmp_path / "s.nc", "--spp", "2", "--camera", camera, *words)
    with xr.open_dataset(tmp_path / "s.nc", engine="h5netcdf") as made:
        assert made.capture.dims == (*grid, "row", "column")
        assert [made[name].attrs["units"] for name in ("sensor_size", "distance", "bin_size")] == ["mm"] * 3
        for size, pixels in itertools.product(*grid.values()):
            point = made.sel(sensor_size=size, pixels_per_lens=pixels)
            stated = text_of(BY_SIZE | {"sensor_size": size, "pixels_per_lens": pixels})
            run("render", scene, "-o", tmp_path / "r.exr", "--spp", "2", "--camera", stated)
            capture = read_capture(tmp_path / "r.exr")
            assert capture.image.std() > 0.01
            assert float(point.pixel_size) == pytest.approx(capture.camera.pixel_size)
            found = [(point.capture, capture.image)]
            for result in reconstruct(capture, [210, 240]):
                plane = point.sel(distance=result.distance)
                assert float(plane.bin_size) == pytest.approx(result.bin_size)
                found.append((plane.reconstruction, result.image))
            for image, expected in found:
                rows, columns = expected.shape
                np.testing.assert_array_equal(image[:rows, :columns], expected)
                assert np.isnan(image[rows:]).all() and np.isnan(image[:, columns:]).all()


@pytest.mark.parametrize(("colours", "pixel_format"), [("mono", "rgb"), ("rgb", "rgb")])
def test_a_scenes_own_sensor_is_varied_in_what_it_states(tmp_path, colours, pixel_format):
    """Here the focus, from which another distance of the array follows, and the scene's sampler is kept."""
    fixed = '<float name="detector_width" value="0.128"/><float name="focus_distance" value="240"/>'
    fixed += '<string name="mla_lattice" value="hexagonal"/>'
    fixed += '<sampler type="multijitter"><integer name="sample_count" value="4"/></sampler>'
    scene = write_scene(tmp_path, BALL, sensor=fixed, pixel_format=pixel_format)
    spec = CaptureSpec(str(scene), variant=f"llvm_ad_{colours}", spp=4)
    channel, lengths = (("channel",), [60, 70]) if colours == "rgb" else ((), [60])
    with sweep(spec, {"focal_length": lengths, "distance": [240]}, tmp_path / "s.nc") as made:
        assert made.reconstruction.dims == ("focal_length", "distance", "bin_row", "bin_column", *channel)
        for length in lengths:
            own = f'<float name="focal_length" value="{length}"/>'
            scene = write_scene(tmp_path, BALL, sensor=fixed + own, pixel_format=pixel_format)
            mi.set_variant(f"llvm_ad_{colours}")
            capture = render_capture(load_scene(scene), spp=4)
            assert capture.camera.focus_distance == pytest.approx(240)
            assert (made.sizes["bin_column"], made.sizes["bin_row"]) == capture.camera.bin_count
            np.testing.assert_array_equal(made.capture.sel(focal_length=length).values, capture.image)


def test_the_camera_of_another_scene_is_varied_with_its_lens(scene, tmp_path, run):
    size = '<float name="detector_width" value="0.128"/><float name="focus_distance" value="240"/>'
    other = write_scene(tmp_path, sensor=f'<string name="main_lens" value="cooke_triplet"/>{size}')
    words = ["--camera", other, "--spp", "2", "--vary", "focal_length=60"]
    run("sweep", scene, "-o", tmp_path / "s.nc", *words)
    camera = "main_lens=cooke_triplet,detector_width=0.128,focus_distance=240,resolution=[64,64],focal_length=60"
    run("render", scene, "-o", tmp_path / "r.exr", "--camera", camera, "--spp", "2")
    with xr.open_dataset(tmp_path / "s.nc", engine="h5netcdf") as made:
        np.testing.assert_array_equal(made.capture.sel(focal_length=60), read_capture(tmp_path / "r.exr").image)


@pytest.mark.parametrize("sensor", ["", '<sensor type="perspective"/>'])
def test_a_scene_without_a_plenoptic_sensor_states_no_camera(sensor, scene, tmp_path, complaint):
    other = tmp_path / "other.xml"
    other.write_text(f'<scene version="3.0.0">{sensor}<shape type="sphere"/></scene>')
    words = ["sweep", scene, "-o", tmp_path / "s.nc", "--camera", other, "--vary", "focal_length=60,70"]
    for line in (complaint("info", other), complaint(*words)):
        assert line.startswith(f"{other}: {'sensor of type PerspectiveCamera' if sensor else 'it has no sensor'}")
        assert line.count("other.xml") == line.count("--camera") == 1


def test_parameters_of_a_scene_state_its_camera_at_each_of_their_values(tmp_path):
    sensor = '<float name="aperture_radius" value="$stop"/><float name="detector_width" value="0.128"/>'
    scene = write_scene(tmp_path, BALL, sensor=sensor)
    with sweep(CaptureSpec(str(scene), spp=2), {"stop": [3, 5], "mla_pitch": [0.05]}, tmp_path / "s.nc") as made:
        for stop in (3, 5):
            loaded = load_scene(scene, parameters={"stop": str(stop)})
            camera = PlenopticCamera.from_sensor(loaded.sensors()[0]).replace(mla_pitch=0.05)
            image = render_capture(with_camera(loaded, camera), spp=2).image
            np.testing.assert_array_equal(made.capture.sel(stop=stop, mla_pitch=0.05).values, image)


@pytest.mark.parametrize(
    ("camera", "vary", "words"),
    [
        (text_of(SHEET), "apertur_radius=2,4", "did you mean aperture_radius?"),
        ("paper", "f_number=4,8", "f_number: micro-images of .* mm apart: .*; aperture_radius is focal_length / (2 "),
        ("phone", "f_number=4,8", "f_number: the camera has no microlens array.*; aperture_radius is"),
        (text_of(SHEET), "aperture_radius=2,3 f_number=4", "aperture_radius = 2: it follows from f_number and"),
        (text_of(without(SHEET, "lenses")), "f_number=4,8", "lenses, resolution or sensor_size: missing"),
    ],
)  # fmt: skip
def test_mistakes_name_what_works(camera, vary, words, scene, tmp_path, complaint):
    varied = [word for each in vary.split() for word in ("--vary", each)]
    said = complaint("sweep", scene, "-o", tmp_path / "s.nc", "--camera", camera, *varied)
    assert all(part in said for part in words.split(".*")), said
    assert not (tmp_path / "s.nc").exists()


@pytest.mark.parametrize("name", ["capture", "bin_row"])
def test_parameters_of_a_scene_with_the_names_of_the_dataset_are_refused(name, tmp_path, complaint):
    scene = write_scene(tmp_path, f'<emitter type="constant"><float name="radiance" value="${name}"/></emitter>')
    assert complaint("sweep", scene, "-o", tmp_path / "s.nc", "--vary", f"{name}=1,2").startswith(f"grid: {name}: ")
