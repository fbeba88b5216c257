"""Files that version 1.0 wrote, whose waves were parabolic, and the version that files state now."""

import json
import shutil
from importlib.metadata import version
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from refusals import refuses
from stopped_runs import StoppedError, stopped_before

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Checkpoint, Job, Spectrum
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.io.exr import read_exr
from mitsuba_plenoptic.views import white_image
from mitsuba_plenoptic.views.light_field_files import open_light_field

OLD = Path(__file__).parents[1] / "files_of_1_0"
VERSION = version("mitsuba-plenoptic")


def attributes_of(path):
    """Return what an OpenEXR file states of itself."""
    with OpenEXR.File(str(path), header_only=True) as file:
        return json.loads(file.header()["mitsuba_plenoptic"])


@pytest.fixture
def remarks(caplog):
    """Return the lines in the log, and empty it."""
    caplog.set_level("INFO", "mitsuba_plenoptic")

    def remarks():
        lines = [record.getMessage() for record in caplog.records]
        caplog.clear()
        return lines

    return remarks


@pytest.mark.parametrize("name", ["wave.exr", "spread.exr", "wave.png"])
def test_wave_captures_behind_a_thin_lens_were_parabolic(name, remarks, tmp_path):
    # The remark is made once of each file.
    path = Path(shutil.copy(OLD / name, tmp_path))
    read = mp.read_raw if path.suffix == ".png" else mp.read_capture
    found = read(path)
    assert found.model == "wave" and found.camera.lens_model == "parabolic"
    assert remarks() == [f"{path}: a wave capture of version 1.0 or earlier: its lens_model is read as parabolic"]
    assert read(path).camera == found.camera and remarks() == []


@pytest.mark.parametrize("name", ["ray.exr", "small_lenses.exr", "real_lens.exr"])
def test_other_captures_mean_what_they_state(name, remarks):
    """By rays; by waves behind lenses of few wavelengths, which followed the camera; and behind a real lens."""
    found, stated = mp.read_capture(OLD / name), attributes_of(OLD / name)
    assert found.model == ("ray" if name == "ray.exr" else "wave") and "version" not in stated
    assert found.camera == mp.PlenopticCamera.from_dict(stated["camera"])
    assert found.camera.lens_model == "ideal" and remarks() == []


def test_the_camera_that_is_read_has_the_spread_of_1_0():
    """A full field at f/2.8, whose camera says ideal: spherical aberration spreads it over many pixels."""
    found = mp.read_capture(OLD / "spread.exr")
    spreads = {
        model: mp.CaptureOperator(
            found.camera.replace(lens_model=model), [(0.0, 0.0, 72.0)], wavelength=633.0, method="full_field"
        ).forward([1.0])
        for model in ("parabolic", "ideal")
    }
    np.testing.assert_allclose(spreads[found.camera.lens_model], found.image, atol=1e-5 * found.image.max())
    assert np.linalg.norm(spreads["ideal"] - found.image) > 0.5 * np.linalg.norm(found.image)


@pytest.mark.parametrize(
    ("wavelength", "metadata", "expected"),
    [
        (550.0, {}, "parabolic"),
        (633.0, {}, "ideal"),
        ((633.0, 550.0, 450.0), {}, "ideal"),
        (None, {"wavelength": "600, 550, 450"}, "parabolic"),
        (None, {"wavelength": "633, 550, 450"}, "ideal"),
        # Means of channels, of light up to 700 nm.
        ((580.0, 540.0, 450.0), {"spectrum": {"wavelengths": [400.0, 700.0]}}, "ideal"),
        (None, {"spectrum": "mine", "wavelength": [None, "green"]}, "parabolic"),
    ],
)
def test_the_longest_wavelength_decides_whether_lenses_were_small(wavelength, metadata, expected, tmp_path):
    """Lenses of 12.4 um are as wide as 20 waves of 620 nm."""
    camera = mp.PlenopticCamera(mla_pitch=0.0124, detector_width=0.0496, resolution=(16, 16))
    stated = attributes_of(OLD / "wave.exr")
    stated |= {"camera": camera.to_dict(), "wavelength": wavelength, "metadata": metadata}
    channels = dict.fromkeys("RGB" if isinstance(wavelength, tuple) else "Y", np.ones(camera.shape, np.float32))
    OpenEXR.File({"mitsuba_plenoptic": json.dumps(stated)}, channels).write(str(tmp_path / "wave.exr"))
    assert mp.read_capture(tmp_path / "wave.exr").camera == camera.replace(lens_model=expected)


def test_a_camera_by_itself_is_ideal():
    assert mp.PlenopticCamera.from_json((OLD / "camera.json").read_text()).lens_model == "ideal"


def test_truth_and_white_captures_by_rays_still_belong_to_it():
    """Both have the camera as it was stated."""
    wave, ray = (mp.read_capture(OLD / f"{model}.exr") for model in ("wave", "ray"))
    white = mp.Capture(white_image(ray.camera), ray.camera)
    lf = mp.decode(wave, truth=mp.read_ground_truth(OLD / "wave.truth.exr"), white=white)
    assert "depth" in lf.coords and "depth" in open_light_field(OLD / "wave.exr", truth=True).coords
    other = mp.Capture(white.image, ray.camera.replace(aperture_radius=4.5))
    refuses(r"white: its camera has aperture_radius = 4\.5, that of the capture 5", mp.decode, wave, white=other)


def test_captures_written_again_keep_their_camera(tmp_path, remarks):
    found = mp.read_capture(OLD / "wave.exr")
    mp.write_capture(tmp_path / "again.exr", found)
    remarks()
    again = mp.read_capture(tmp_path / "again.exr")
    assert again.camera == found.camera and again.metadata == found.metadata and remarks() == []
    # An ideal wave capture of this version stays one.
    ideal = mp.Capture(found.image, found.camera.replace(lens_model="ideal"), 633.0, "wave")
    mp.write_capture(tmp_path / "ideal.exr", ideal)
    assert mp.read_capture(tmp_path / "ideal.exr").camera == ideal.camera and remarks() == []


def test_a_checkpoint_is_refused_in_one_line(tmp_path):
    """Even by the same run: the version is named first."""
    path = tmp_path / "wave.exr.checkpoint"
    shutil.copy(OLD / path.name, path)
    with np.load(path) as archive:
        run, shape = json.loads(str(archive["header"]))["run"], archive["image"].shape
    with pytest.raises(mp.InputError) as caught, Checkpoint(path, "resume") as checkpoint:
        checkpoint.run = run
        checkpoint.begin(shape)
    said = str(caught.value)
    assert said.startswith(f"{path}: the checkpoint of another run: version = nothing there, {VERSION} here; software.")
    assert "\n" not in said and path.read_bytes() == (OLD / path.name).read_bytes()


def test_a_checkpoint_of_another_lens_model_is_refused(tmp_path):
    path, camera = tmp_path / "checkpoint", mp.read_capture(OLD / "wave.exr").camera

    def compute(lens_model):
        seen = camera.replace(lens_model=lens_model)
        operator = mp.CaptureOperator(seen, [(0.0, 0.0, 240.0)], spectrum=Spectrum.lines(600.0, 550.0, 450.0))
        with Checkpoint(path, "resume") as checkpoint:
            operator.forward([[1.0, 1.0, 1.0]], job=Job(None, None, checkpoint))

    with pytest.raises(StoppedError), stopped_before(lambda sums: len(sums) == 1):
        compute("parabolic")
    with np.load(path) as archive:
        assert json.loads(str(archive["header"]))["version"] == VERSION
    refuses(r"another run: camera\.lens_model = parabolic there, ideal here$", compute, "ideal")


def test_files_state_the_version(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    capture = mp.read_capture(OLD / "wave.exr")
    mp.write_capture("raw.exr", capture)
    mp.write_raw("raw.png", mp.expose(capture, mp.Detector(), photons=100, seed=1))
    mp.write_ground_truth("raw.truth.exr", mp.read_ground_truth(OLD / "wave.truth.exr"))
    for name in ("raw.exr", "raw.truth.exr"):
        assert attributes_of(name)["version"] == VERSION
    assert f'"version": "{VERSION}"'.encode() in Path("raw.png").read_bytes()
    assert mp.read_raw("raw.png").camera == capture.camera
    assert main(["reconstruct", "raw.exr", "-o", "out.exr", "--distance", "240"]) == 0
    assert read_exr("out.exr")[2]["version"] == VERSION
