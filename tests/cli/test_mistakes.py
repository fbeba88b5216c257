"""What the command says about a user's mistakes: one line, status 2, and nothing written."""

import gzip
import re

import numpy as np
import OpenEXR
import pytest
from cameras import write_scene
from PIL import Image
from refusals import refuses

from mitsuba_plenoptic import read_capture, reconstruct
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.views.light_field_files import open_light_field


@pytest.mark.parametrize(("line", "words"), [
    ("recontruct x.exr", "Did you mean 'reconstruct'?"),
    ("reconstruct {raw} -o {out}.exr --distance -30", "--distance = -30: .*greater than the focal length 80"),
    ("reconstruct {raw} -o {out}.exr --distance 210 --wavelength 0.5", "--wavelength = 0.5: .*micrometres"),
    ("reconstruct {raw} -o {out}.exr --distance 210 --oversample 1.5", "--oversample = '1.5'"),
    ("reconstruct {raw} -o {out}.exr --f-number 2", "--f-number; aperture_radius is focal_length / (2 f_number)"),
    ("reconstruct -o {out}.exr --distance 210 -- -x.exr", "-x.exr: there is no such file"),
    ("reconstruct {raw} --distance 210 -o", "'-o' requires"),
    ("render letters -o {out}.exr -D a=1 -D b=-2 --seed 1 --spp 16", "parameter a: the scene "),
    ("render letters -o {out}.exr --camera a=1,b=2", "a: it is not a camera parameter"),
    ("render letters -o {out}.exr --camera focal_length=50,focal_length=60", "focal_length is given twice"),
    ("render letters -o {out}.exr --aov depht", "--aov = 'depht': .*did you mean depth?"),
    ("render letters -o {out}/raw.exr", "does not exist"),
    ("render letters -o {out}.exr --camera {raw}", "it is an OpenEXR image"),
    ("render letters -o {out}.exr --white {out}.exr", "two results would be written to it"),
    ("render letters --estimate --noise", "--noise: "),
    ("info paper_double_gauss --drawing {out}.jpg", "give a name that ends in .png"),
    ("info", "Missing argument .*see mitsuba-plenoptic info camera --help"),
    ("info f_number=4,lenses=(9),mla_pitch=1,pixel_size=1,focal_length=5,focus_distance=9", "written lenses="),
    ("info paper -D resolution=64", "-D: paper is no scene"),
    ("reconstruct {raw} -o {out}.exr --distance 55cm", "--distance = '55cm': .*without the unit"),
    ("reconstruct {raw} -o {out}.pdf --distance 240 --distance 240", "--distance = 240: it is given twice"),
    ("reconstruct {raw} -o {out}.exr --distance 240 --linear", "--linear: it is for pictures"),
    ("views {raw} -o {out}.png --view-count 3", "--view-count = 3: of no use for"),
    ("views {raw} -o {out}.exr --scale 2", "--scale 2: it is for plain pictures"),
    ("views {raw} -o {out}.gif --figure", "--figure: it is for .png and .pdf"),
    ("render letters -o {out}.exr --model wave --workers 0", "--workers = 0: "),
    ("render letters -o {out}.exr --model wave --workers 2 --scheduler here", "workers, scheduler: give one of"),
    ("stack {raw} -o {out}.gif --distance 240", "--distance: a focal sweep goes .*and 1 are given"),
])  # fmt: skip
def test_mistakes(line, words, mistake):
    mistake(line, words)


@pytest.mark.parametrize("line", ["render letters -o {out}.exr --workers 2", "render letters --estimate --workers 2"])
def test_no_workers_are_started_for_ray_captures(line, mistake, monkeypatch):
    monkeypatch.setattr("mitsuba_plenoptic.runtime.batches.Cluster.__enter__", None)
    mistake(line, "--workers: a ray capture does not take it")


def test_parameters_are_followed_through_defaults_and_includes(raw, tmp_path, run, complaint):
    (tmp_path / "part.xml").write_text(
        '<scene version="3.0.0"><shape type="sphere"><float name="radius" value="$of_part"/>'
        '<point name="center" x="0" y="0" z="240"/></shape></scene>'
    )
    defaults = """<default name="base" value="3"/><default name="size" value="$base"/>
        <default name="of_part" value="$base"/><default name="only" value="4"/><default name="width" value="$only"/>
        <default name="spp" value="2"/><!-- <float name="radius" value="$only"/> --><integrator"""
    sensor = """<float name="detector_width" value="$width"/>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>"""
    scene = write_scene(tmp_path, '<emitter type="constant"/><include filename="part.xml"/>', sensor=sensor)
    scene.write_text(scene.read_text().replace("<integrator", defaults))
    words = ["render", scene, "--camera", tmp_path / "camera.json", "-o", tmp_path / "a.exr"]
    (tmp_path / "camera.json").write_text(read_capture(raw).camera.to_json())
    run(*words, "-D", "base=1", "-D", "of_part=1", "-D", "spp=1")
    assert read_capture(tmp_path / "a.exr").metadata["spp"] == 1
    for name in ("only", "width"):
        assert complaint(*words, "-D", f"{name}=1").startswith(f"-D {name}: it is of the scene's own camera")


@pytest.mark.parametrize(
    "line",
    [
        "reconstruct {copy} -o {copy} --distance 240",
        "reconstruct {raw} -o {link} --distance 240 --white {copy}",
        "expose {copy} -o {link} --photons 100",
        pytest.param("demosaic {copy} -o {copy}", marks=pytest.mark.needs_extension("raw")),
    ],
)
def test_what_is_read_is_not_written_over(line, raw, tmp_path, complaint):
    copy, link = tmp_path / "copy.exr", tmp_path / "link.exr"
    copy.write_bytes(raw.read_bytes())
    link.symlink_to(copy)
    assert "it is read, and would be lost" in complaint(*line.format(raw=raw, copy=copy, link=link).split())
    assert copy.read_bytes() == raw.read_bytes()


@pytest.mark.needs_extension("deconvolution")
@pytest.mark.filterwarnings("default::mitsuba_plenoptic.PhysicsWarning")
def test_an_option_of_another_method_is_one_note_and_an_option_of_none_is_refused(raw, tmp_path, capfd, complaint):
    plain = ["reconstruct", str(raw), "--distance", "240", "-o"]
    options = ["--interleave", "2", "--relay", "--wavelength", "633", "--iterations", "1", "--footprint", "lens"]
    assert main([*plain, str(tmp_path / "ray.exr"), *options]) == 0
    (note,) = capfd.readouterr().err.splitlines()
    assert note.startswith("mitsuba-plenoptic: warning: method ray has no use for --")
    assert "--relay (of coherent and partial)" in note and "--footprint" not in note
    assert main([*plain, str(tmp_path / "quiet.exr"), *options, "-q"]) == 0
    assert capfd.readouterr().err == ""
    assert main([*plain, str(tmp_path / "plain.exr")]) == 0
    assert (tmp_path / "plain.exr").read_bytes() == (tmp_path / "ray.exr").read_bytes()
    assert "--interleaf; did you mean --interleave?" in complaint(*plain, "a.exr", "--interleaf", 2)


def test_advice_names_options_at_the_shell_and_arguments_in_python(raw, tmp_path, complaint):
    picture = tmp_path / "picture.png"
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(picture)
    assert "give --white or --camera for a raw picture" in complaint("views", picture, "-o", tmp_path / "a.png")
    stack = "stack", picture, "-o", tmp_path / "a.png", "--view-count", 2, "--distance", 240
    assert "'stack' takes --disparity" in complaint(*stack)
    refuses(r"wavelength = None: .* give wavelength$", reconstruct, read_capture(raw), 240, method="coherent")
    refuses("give white or camera for a raw picture", open_light_field, picture)


METASHAPE = b'<?xml version="1.0" encoding="UTF-8"?>\n<!-- <scene> -->\n<document version="2.0.0"/>'
WRONG_KINDS = {
    "jpeg": (b"\xff\xd8\xff\xe0 a picture", ".jpg", "a JPEG picture"),
    "numpy": (b"\x93NUMPY\1\0", ".npy", "an array of NumPy"),
    "matlab": (b"MATLAB 5.0 MAT-file, Platform: posix".ljust(116) + bytes(8), ".mat", "a .mat file of MATLAB 5"),
    "gzip": (gzip.compress(b"{}"), ".json", "packed by gzip (unpack it)"),
    "empty": (b"", ".exr", "an empty file"),
    "text": ("naïve".encode() * 1000, ".txt", "text that begins with 'naïvenaïve"),
    "camera": (b' {"focal_length": 80}', ".js", "text in JSON"),
    "metashape": (METASHAPE, ".xml", "XML with the root <document>"),
    "yaml": (b"%YAML:1.0\n---\n", ".yml", "YAML of OpenCV"),
    "folder": (None, "", "a folder"),
}


@pytest.mark.needs_extension("calibrate", "lensdesign", "raw")
@pytest.mark.parametrize(("kinds", "line"), [
    ("numpy camera metashape yaml", "views {given} -o {out}.png"),
    ("folder gzip", "stack {given} -o {out}.png --distance 240"),
    ("jpeg empty", "reconstruct {given} -o {out}.exr --distance 240"),
    ("text camera metashape empty", "render {given} -o {out}.exr"),
    ("jpeg metashape", "render letters -o {out}.exr --camera {given}"),
    ("matlab folder", "info {given}"),
    ("jpeg numpy folder metashape", "calibrate white {given} -o {out}.json --camera paper"),
])  # fmt: skip
def test_files_of_a_wrong_kind_are_named(kinds, line, raw, tmp_path, complaint):
    for kind in kinds.split():
        content, suffix, what = WRONG_KINDS[kind]
        given = tmp_path / f"{kind}{suffix}"
        given.mkdir() if content is None else given.write_bytes(content)
        said = complaint(*line.format(given=given, out=tmp_path / "out", raw=raw).split())
        assert re.match(rf"{re.escape(f'{given}: it is {what}')}.*; .", said)
    assert not list(tmp_path.glob("out*"))


def test_wrong_scenes(tmp_path, complaint):
    path = write_scene(tmp_path, sensor='<string name="mla_pitch" value="wide"/>')
    said = complaint("render", path, "-o", tmp_path / "raw.exr")
    assert all(words in said for words in (str(path), "line 3", "mla_pitch = 'wide'"))


@pytest.mark.parametrize("size", [200, -1000])
def test_captures_that_are_cut_off(size, raw, tmp_path, complaint):
    path, out = tmp_path / "damaged.exr", tmp_path / "out.exr"
    path.write_bytes(raw.read_bytes()[:size])
    for words in (["reconstruct", path, "-o", out, "--distance", "240"], ["info", path]):
        assert complaint(*words).startswith(f"{path}: it cannot be read as an OpenEXR image, or is damaged: its ")
    assert not out.exists()


def test_images_that_are_no_captures(raw, tmp_path, complaint):
    foreign, result = tmp_path / "foreign.exr", tmp_path / "result.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {"Y": np.zeros((4, 4), np.float32)}).write(str(foreign))
    assert complaint("info", foreign).startswith(f"{foreign}: it has no attribute 'mitsuba_plenoptic' in its header")
    assert main(["reconstruct", str(raw), "-o", str(result), "--distance", "240"]) == 0
    assert complaint("info", result).startswith(f"{result}: it holds a 'reconstruction', not a capture")


def test_our_own_mistakes_keep_their_traceback(monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a bug")

    monkeypatch.setattr("mitsuba_plenoptic.scene.load_scene", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        main(["info", "letters"])
