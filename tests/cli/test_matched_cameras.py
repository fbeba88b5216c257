"""Cameras from data sheets on the command line, and the camera that `info --fix` writes."""

from mitsuba_plenoptic import PlenopticCamera, read_capture

SHEET = "f_number=2.8,lenses=8,6,pixels_per_lens=10,pixel_size=0.005,focal_length=50,focus_distance=320"


def test_a_scene_is_rendered_by_a_camera_of_a_data_sheet(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run("render", "letters", "-o", "raw.exr", "--spp", "1", "--camera", SHEET)
    capture = read_capture("raw.exr")
    assert capture.image.shape == (60, 80)
    assert capture.camera == PlenopticCamera.matched(
        f_number=2.8, lenses=(8, 6), pixels_per_lens=10, pixel_size=0.005, focal_length=50, focus_distance=320
    )


def test_info_prints_no_warning_for_such_a_camera(run):
    for lattice in ("square", "hexagonal"):
        said = run("info", f"{SHEET},mla_lattice={lattice}", "--wavelength", "550")
        assert "f/2.8" in said and "Warning" not in said


def test_info_writes_the_mended_camera(run, tmp_path):
    said = run("info", "aperture_radius=10", "--fix", tmp_path / "better.json")
    assert "Warning: micro-images overlap" in said and "stop the main lens down to a diameter of 15.064 mm" in said
    assert "better.json, with " in said.partition("Written:")[2] and "Still:" not in said
    assert PlenopticCamera.from_json((tmp_path / "better.json").read_text()).aperture_radius == 10
    assert "Warning" not in run("info", tmp_path / "better.json")
    assert "unchanged" in run("info", "paper", "--fix", tmp_path / "same.json")
    assert PlenopticCamera.from_json((tmp_path / "same.json").read_text()) == PlenopticCamera()
