"""The command ``run`` and the option ``--save-run``: what is repeated, and what a run file may hold."""

from __future__ import annotations

import errno
import json
import os
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import typer
import xarray as xr
import yaml
from scene_cases import letters

from mitsuba_plenoptic import read_capture
from mitsuba_plenoptic.cli import app, commands_of, main
from mitsuba_plenoptic.cli.stopping import checkpoint_of
from mitsuba_plenoptic.io import checkpoints
from mitsuba_plenoptic.io.exr import read_exr

STEPS = """
shared:
  distance: [210, 240]
  camera: camera.json
steps:
- render: {scene: wall.xml, output: raw.exr, spp: 1}
- reconstruct: {capture: raw.exr, output: out.exr}
- stack:
    source: raw.exr
    output: stack.png
    distance: 240
"""

WALL = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective"><film type="hdrfilm"><string name="pixel_format" value="luminance"/></film></sensor>
<shape type="ply"><string name="filename" value="wall.ply"/>
<emitter type="area"/></shape></scene>"""

PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
-900 -900 240
900 -900 240
0 {height} 240
3 2 1 0
"""


@pytest.fixture
def folder(tmp_path):
    camera = {"focus_distance": 240, "detector_width": 1.024, "resolution": [256, 256]}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    (tmp_path / "wall.xml").write_text(WALL)
    (tmp_path / "wall.ply").write_text(PLY.format(height=900))
    (tmp_path / "run.yaml").write_text(STEPS)
    return tmp_path


@pytest.fixture
def fresh(folder, run):
    """Run the file, and return the numbers of the steps that were not up to date."""

    def fresh():
        lines = [line for line in run("run", folder / "run.yaml").splitlines() if line.startswith("step ")]
        return [int(line.split()[1]) for line in lines if not line.endswith(": up to date")]

    return fresh


def test_only_what_has_changed_is_computed_again(folder, fresh):
    assert fresh() == [1, 2, 3]
    assert {path.name for path in folder.iterdir()} >= {"raw.exr", "out_210.exr", "out_240.exr", "stack.png"}
    assert fresh() == []
    # What lay in the folder before, or was made by hand, is not what the step wrote.
    (folder / "out_240.exr").write_bytes((folder / "out_210.exr").read_bytes())
    assert fresh() == [2]
    assert read_exr(folder / "out_240.exr")[2]["distance"] == 240
    # A mesh that only the scene names.
    (folder / "wall.ply").write_text(PLY.format(height=-500))
    assert fresh() == [1, 2, 3]
    # A setting of one step; a shared file of two.
    (folder / "run.yaml").write_text(STEPS.replace("distance: 240\n", "distance: 245\n"))
    assert fresh() == [3]
    (folder / "camera.json").write_text((folder / "camera.json").read_text().replace("240", "241"))
    assert fresh() == [1, 2, 3]
    # The folder may be moved.
    assert fresh() == []
    assert str(folder) not in (folder / "run.steps.json").read_text()


def test_a_damaged_log_is_no_log(folder, fresh):
    assert fresh() == [1, 2, 3]
    log = json.loads((folder / "run.steps.json").read_text())
    (folder / "run.steps.json").write_text(json.dumps(log | dict.fromkeys(log, 3) | {"x": {"written": 3}}))
    assert fresh() == [1, 2, 3]


def test_a_file_that_another_process_runs_is_refused(folder, complaint):
    log = folder / "run.steps.json"
    with checkpoints.locked(checkpoints.lock_of(log), "never"):
        assert f"{folder / 'run.yaml'}: another process is running it; wait" in complaint("run", folder / "run.yaml")
    assert not log.exists()


def test_a_finished_run_needs_no_folder_that_it_may_write(folder, fresh, monkeypatch):
    assert fresh() == [1, 2, 3]
    opened = Path.open

    def denied(path, mode="r", *given, **options):
        if "w" in mode:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return opened(path, mode, *given, **options)

    monkeypatch.setattr(Path, "open", denied)
    folder.chmod(0o555)  # for all but the superuser
    try:
        assert fresh() == []
    finally:
        folder.chmod(0o755)


def test_save_run_repeats_a_command(raw, tmp_path, run):
    here, file = tmp_path / "results", tmp_path / "run.yaml"
    here.mkdir()
    words = ["reconstruct", raw, "-o", here / "a b.exr", "--distance", "inf", "--distance", "1e3", "--oversample", "1"]
    run(*words, "--save-run", file)
    run("epi", raw, "-o", here / "epi.png", "--at=-0.25", "--figure", "--save-run", file)
    text = file.read_text()
    assert text == (
        f"version: {version('mitsuba-plenoptic')}\n"
        f"steps:\n- reconstruct:\n    capture: {raw}\n    distance: [inf, 1000]\n    output: {here / 'a b.exr'}\n"
        f"    oversample: 1\n- epi:\n    source: {raw}\n    output: {here / 'epi.png'}\n    at: -0.25\n"
        "    figure: true\n"
    )
    made = (here / "a b_inf.exr").read_bytes()
    (here / "a b_inf.exr").unlink()
    run("run", file)
    assert (here / "a b_inf.exr").read_bytes() == made
    # The same command again adds nothing.
    run("epi", raw, "-o", here / "epi.png", "--at=-0.25", "--figure", "--save-run", file)
    assert file.read_text() == text


def test_files_are_named_from_the_run_file(raw, tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs").mkdir()
    (tmp_path / "raw.exr").write_bytes(raw.read_bytes())
    # A folder and a file that have the names of a scene and of a value.
    (tmp_path / "letters").mkdir()
    (tmp_path / "ray").write_text("")
    words = ["--spp", 1, "-D", "resolution=64", "--model", "ray"]
    run("render", "letters", "-o", "small.exr", *words, "--save-run", "runs/run.yaml", "--quiet")
    run("views", "raw.exr", "-o", "views.png", "--count", 1, "--save-run", "runs/run.yaml")
    text = (tmp_path / "runs" / "run.yaml").read_text()
    assert "scene: letters" in text and "source: ../raw.exr" in text and "define: [resolution=64]" in text
    assert "model: ray\n" in text and "quiet" not in text
    before = read_capture("small.exr")
    (tmp_path / "small.exr").unlink()
    run("run", "runs/run.yaml")
    assert np.array_equal(read_capture("small.exr").image, before.image)


WORDS = ["0x10", "010", "1e5", "true", "null", "a: b", "#x", "- a", "é", "a,b", "1:30", '"', " a", "no", ".5", "@", "~"]


def test_words_survive(raw, tmp_path, monkeypatch, run):
    """Files whose names would be other values in YAML."""
    monkeypatch.chdir(tmp_path)
    for word in WORDS:
        Path(word).write_bytes(raw.read_bytes())
        run("reconstruct", "-o", "a.exr", "--distance", 240, "--save-run", "run.yaml", "--", word)
        Path("a.exr").unlink()
        run("run", "run.yaml")
        assert Path("a.exr").exists()
        Path("run.yaml").unlink()


def test_values_by_name_are_definitions(tmp_path, run):
    given = {"scene": "letters", "output": "s.nc", "vary": {"distance": [210, 240.5], "aperture_radius": 4}}
    step = given | {"define": [f"{name}={value}" for name, value in letters(2).items()], "spp": 1}
    (tmp_path / "run.yaml").write_text(yaml.safe_dump({"steps": [{"sweep": step}]}))
    run("run", tmp_path / "run.yaml")
    with xr.open_dataset(tmp_path / "s.nc") as found:
        assert found.distance.values.tolist() == [210, 240.5] and found.aperture_radius.values.tolist() == [4]


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("steps: 3", "a run file must have 'steps', a list of commands with their options"),
        ("steps:\n- render: {}\nstep: 1", "step: it is not one of version, shared, steps; did you mean steps?"),
        ("steps: [render]", "step 1 = 'render': it must be one command, with its options by name"),
        ("steps:\n- rendr: {}", "step 1: command = 'rendr': it must be one of "),
        ("steps:\n- run: {}", "step 1: command = 'run': it must be one of "),
        ("steps:\n- render: 3", "step 1 (render) = 3: it must be options by name"),
        ("steps:\n- render: {sp: 3}", "step 1 (render): sp: it is not one of scene, output"),
        ("steps:\n- render: {spp: x}", "step 1 (render): spp = 'x': "),
        ("steps:\n- render: {spp: [1, 2]}", "step 1 (render): spp = [1, 2]: "),
        ("steps:\n- render: {spp: null}", "step 1 (render): spp = null: it must be a number or a text"),
        ("steps:\n- render: {noise: 1}", "step 1 (render): noise = 1: it must be true or false"),
        ("steps:\n- depth: {}", "step 1 (depth): Missing"),
        ("shared: {sp: 1}\nsteps:\n- render: {}", "shared: sp: no step has such an option; did you mean spp?"),
        ("steps:\n- render: {scene: letters, output: a.exr, spp: 0}", "step 1 (render): spp = 0: it must be at least"),
        ("steps:\n- render: {scene: lettres, output: a.exr}", "step 1 (render): "),
        ("steps:\n- views: {source: no.exr, output: a.png}", "step 1 (views): no.exr: there is no such file"),
        (
            "steps:\n- epi: {source: a.exr, output: a.png}\n- views: {source: a.exr, output: ./a.png}",
            "step 2 (views): output = ./a.png: step 1 writes it, too; give each a name of its own",
        ),
    ],
)
def test_mistakes_name_step_key_value_and_rule(text, rule, tmp_path, complaint):
    (tmp_path / "run.yaml").write_text(text)
    said = complaint("run", tmp_path / "run.yaml")
    assert said.startswith(f"{tmp_path / 'run.yaml'}: {rule}"), said
    assert not (tmp_path / "run.steps.json").exists()


def test_steps_are_parsed_before_the_first_is_run(folder, complaint):
    (folder / "run.yaml").write_text(STEPS.replace("distance: 240\n", "distance: near\n"))
    assert "step 3 (stack): distance = 'near'" in complaint("run", folder / "run.yaml")
    assert not (folder / "raw.exr").exists()


def test_a_step_is_not_added_where_it_would_mean_something_else(raw, tmp_path, complaint):
    file = tmp_path / "run.yaml"
    file.write_text("steps:\n- example: {name: white}\nshared: {output: a.png}\n")
    words = ["views", raw, "-o", tmp_path / "views.png", "--count", 1, "--save-run"]
    assert "the step cannot be added at its end" in complaint(*words, file)
    assert complaint(*words, tmp_path / "run.json").endswith("give a name that ends in .yaml or .yml")


def test_resume_means_the_same_in_every_command_that_has_it(tmp_path):
    kept = {resume: checkpoint_of(tmp_path / "a.exr", resume) for resume in (False, True)}
    assert kept[False].existing == "resume_if_same" and kept[True].existing == "resume"
    assert kept[True].path == tmp_path / "a.exr.checkpoint"
    texts = {
        option.help
        for _, command in commands_of(typer.main.get_command(app))
        for option in command.params
        if "--resume" in option.opts
    }
    assert len(texts) == 1


OLD = Path(__file__).parents[2] / "files_of_1_0"
VERSION = version("mitsuba-plenoptic")


def test_a_run_file_says_what_has_changed_and_runs(tmp_path, monkeypatch, capfd):
    steps = (OLD / "run.yaml").read_text()
    (tmp_path / "run.yaml").write_text(steps.replace("letter_scale=0.05", "letter_scale=0.05, lens_model=parabolic"))
    monkeypatch.chdir(tmp_path)
    assert main(["run", "run.yaml"]) == 0
    said = [line for line in capfd.readouterr().err.splitlines() if "1.0" in line]
    assert said == [
        "mitsuba-plenoptic: run.yaml: it states no version, as those of version 1.0 and earlier: waves refracted at a "
        "thin main lens as lens_model parabolic then, and follow the camera's lens_model now; the line version: "
        f"{VERSION} ends this"
    ]
    assert read_capture("wave.exr").camera == read_capture(OLD / "wave.exr").camera


@pytest.mark.parametrize(
    ("version", "step", "changed"),
    [
        ("", "render: {scene: letters, output: a.exr, spp: 0}", False),
        ("", "render: {scene: speckle, output: a.exr, spp: 0}", True),
        ("", "render: {scene: letters, model: wave, output: a.exr, spp: 0}", True),
        (f"version: {VERSION}\n", "render: {scene: letters, model: wave, output: a.exr, spp: 0}", False),
        ("", "reconstruct: {capture: no.exr, output: a.exr, distance: 240}", False),
        ("", "reconstruct: {capture: no.exr, output: a.exr, distance: 240, method: coherent}", True),
        ("", "dataset: {recipe: no.yaml, output: data}", True),
    ],
)
def test_the_remark_is_made_of_waves_without_a_version(tmp_path, capfd, version, step, changed):
    (tmp_path / "run.yaml").write_text(f"{version}steps:\n- {step}\n")
    assert main(["run", str(tmp_path / "run.yaml")]) == 2
    assert capfd.readouterr().err.count("it states no version") == changed
