"""What all commands have in common: -q, -v, the line after Ctrl-C, and values that are refused at once."""

import contextlib
import contextvars
import io
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from unittest import mock

import pytest
from rich.console import Console
from stopped_runs import start_command
from test_imports import HEAVY, loaded

from mitsuba_plenoptic.cli import COMMANDS, load, main, render_command
from mitsuba_plenoptic.io import write_capture
from mitsuba_plenoptic.plugins import sensor
from mitsuba_plenoptic.runtime import claim, claiming, progress

STUDIO, SHARPNESS, INVERSE = (pytest.mark.needs_extension(name) for name in ("studio", "sharpness", "inverse"))


def test_every_command_can_be_quiet_and_verbose():
    options = [(option.opts, option.help) for name in COMMANDS for option in load(name).params]
    for words in (["-q", "--quiet"], ["-v", "--verbose"]):
        assert sum(opts == words for opts, _ in options) == len(COMMANDS)
    assert len({text for opts, text in options if "--resume" in opts}) == 1


def test_quiet_commands_print_results_and_errors_alone_and_verbose_ones_name_files(raw, tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(progress, "FIRST_LINE", 0.001)
    out = tmp_path / "out.exr"
    words = ["reconstruct", str(raw), "--distance", "240", "-o", str(out)]
    assert main([*words, "--relay", "-q"]) == 0
    quiet = capfd.readouterr()
    assert quiet.err == "" and "out.exr" in quiet.out
    assert main([*words, "-q", "--oversample", "0"]) == 2
    assert capfd.readouterr().err.startswith("mitsuba-plenoptic: error: --oversample = 0: ")
    assert main([*words, "--relay"]) == 0
    assert "warning" in capfd.readouterr().err
    assert main([*words, "-v"]) == 0
    told = capfd.readouterr().err
    for what in (f"{raw}: read", f"{out}: written", "variant llvm_ad_mono"):
        assert re.search(rf"^mitsuba-plenoptic: [\d.]+ s: {re.escape(what)}$", told, re.MULTILINE), told


@pytest.mark.parametrize(
    ("line", "label"),
    [
        ("reconstruct {raw} --distance 240 --estimate", "Estimating"),
        pytest.param("preview letters -D resolution=64 -o {out}.png", "Previewing", marks=STUDIO),
    ],
)
def test_every_bar_has_a_percentage_and_a_time_left(line, label, raw, tmp_path, monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr(progress, "has_screen", lambda: True)
    made = Console(file=shown, force_terminal=True, width=120, color_system=None)
    monkeypatch.setattr("rich.console.Console", lambda **_: made)
    assert main(line.format(raw=raw, out=tmp_path / "out").split()) == 0
    assert re.search(rf"{label} +[━╸╺ ]+ +\d+% \S+ (-:--:--|\d:\d\d:\d\d)", shown.getvalue())


WAVES = "render", "letters", "-D", "resolution=128", "-D", "detector_width=0.256", "--model", "wave", "--spp", "16"


@pytest.mark.slow
def test_ctrl_c_in_a_wave_capture_says_how_to_go_on(tmp_path):
    words = [*WAVES, "--method", "points", "-o", str(tmp_path / "raw.exr"), "--checkpoint", str(tmp_path / "kept")]
    process = start_command(*words, interrupt_after=1)
    _, error = process.communicate(timeout=600)
    assert process.returncode == 130, error
    stopping, stopped = error.splitlines()[-2:]
    assert "stopping after the current batch" in stopping
    assert re.fullmatch(r"mitsuba-plenoptic: stopped( at [1-9]\d* %)?: the same command goes on from there", stopped)
    assert [path.name for path in tmp_path.iterdir()] == ["kept"]
    process = start_command(*words)
    output, error = process.communicate(timeout=600)
    assert process.returncode == 0, error
    assert "resuming from there" in error
    assert "raw.exr: capture" in output


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("model", ["ray", "wave"])
def test_signals_end_commands_in_order(monkeypatch, capsys, tmp_path, request, name, model):
    """Batch systems send others than Ctrl-C; a checkpoint of an earlier run stays, and is named."""
    number = getattr(signal, name)
    monkeypatch.setattr("mitsuba_plenoptic.scene.render_capture", lambda *_, **__: os.kill(os.getpid(), number))
    # Programs that run in the background may ignore some.
    before = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    request.addfinalizer(partial(signal.signal, number, signal.signal(number, before)))
    words = ["render", "letters", "-o", str(tmp_path / "raw.exr"), "--model", model, "-D", "resolution=64"]
    for earlier in ([], ["raw.exr.checkpoint"]):
        for path in earlier:
            (tmp_path / path).touch()
        line = "the same command goes on from" if earlier and model == "wave" else "nothing unfinished is kept"
        assert main(words) == 128 + number
        assert f"mitsuba-plenoptic: stopped: {line}" in capsys.readouterr().err.splitlines()[-1]
        assert signal.getsignal(number) == before and [path.name for path in tmp_path.iterdir()] == earlier


@pytest.mark.parametrize("name", ["same", "symbolic", "hard", "path"])
@pytest.mark.parametrize("words", ["render letters -D resolution=64", "compare letters --distance 240"])
def test_an_output_is_computed_by_one_process(monkeypatch, complaint, tmp_path, words, name):
    """Whatever it is called, and before anything is computed; folders have no hard links."""
    monkeypatch.chdir(tmp_path)
    is_folder = words.startswith("compare")
    output = Path("out" if is_folder else "out.exr")
    output.mkdir() if is_folder else output.touch()
    other = {"symbolic": Path("other.exr"), "path": tmp_path / output}.get(name, output)
    if name == "symbolic":
        other.symlink_to(output)
    elif name == "hard" and not is_folder:
        other = Path("other.exr")
        other.hardlink_to(output)
    with claiming():
        claim(output, is_folder)
        # Locks exclude each other within a process, too, where each is taken for itself.
        said = contextvars.Context().run(complaint, *words.split(), "-o", other)
    assert said.startswith(f"{other}: another process is computing this")
    assert not any(".lock" in path.name for path in tmp_path.rglob("*"))


def test_an_output_is_held_until_it_is_written(monkeypatch, capsys, tmp_path):
    """Of a name of which a checkpoint's would be too long."""
    output = tmp_path / f"{'a' * 245}.exr"
    said = []

    def write(path, capture):
        said.append(contextvars.Context().run(main, words))
        write_capture(path, capture)

    monkeypatch.setattr("mitsuba_plenoptic.io.write_capture", write)
    words = ["render", "letters", "-o", str(output), "-q", "-D", "resolution=64", "-D", "detector_width=0.128"]
    assert (main(words), said) == (0, [2]), capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [output.name]


PLACES = {
    # C++ code that tries to convert an object of Python drops any exception from there.
    "drops": (render_command, "open_scene", render_command.open_scene),
    # Mitsuba calls the sensor from C++.
    "makes an error of": (sensor, "read_camera", mock.Mock(side_effect=RuntimeError("KeyboardInterrupt:"))),
}


@pytest.mark.parametrize(("module", "name", "goes_on"), PLACES.values(), ids=PLACES)
def test_ctrl_c_that_a_library_takes(tmp_path, monkeypatch, capsys, request, module, name, goes_on):
    # Shells have background processes ignore it.
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(partial(signal.signal, signal.SIGINT, handler))

    def press(*arguments):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        return goes_on(*arguments)

    monkeypatch.setattr(module, name, press)
    assert main([*WAVES, "-o", str(tmp_path / "raw.exr")]) == 130
    assert capsys.readouterr().err.splitlines()[-1].startswith("mitsuba-plenoptic: stopped")
    assert not list(tmp_path.glob("*.exr"))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


RAYS = ["render", "letters", "-D", "resolution=256", "--spp", "1000000"]


def press_keys(process, delay):
    """Press Ctrl-C, and again where Mitsuba loses the signal, as it does just when it starts a pass."""
    for _ in range(8):
        time.sleep(delay)
        process.send_signal(signal.SIGINT)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=15)
            break


@pytest.mark.parametrize(("words", "delay"), [(WAVES, 0.0), pytest.param(RAYS, 2.0, marks=pytest.mark.slow)])
def test_ctrl_c_is_one_line_and_a_status(words, delay, tmp_path):
    command = [sys.executable, "-m", "mitsuba_plenoptic", *words, "-v", "-o", str(tmp_path / "raw.exr")]
    before = signal.signal(signal.SIGINT, signal.SIG_DFL)
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, before)
    told = []
    with ThreadPoolExecutor(1) as keyboard:
        for line in process.stderr:
            told.append(line)
            if "variant" in line:
                keyboard.submit(press_keys, process, delay)
    # Python ends a module that -m runs by the signal itself, which shells show as 130, too, if Ctrl-C came while a
    # library executed a text, as dataclasses do.
    assert process.wait(timeout=600) in (130, -signal.SIGINT)
    assert told[-1].startswith("mitsuba-plenoptic: stopped")
    assert sum("stopped" in line for line in told) == 1 and "Traceback" not in "".join(told)
    assert list(tmp_path.iterdir()) == []


def test_info_prints_json_alone(raw, tmp_path, run):
    for source in ("letters", raw):
        found = json.loads(run("info", source, "--json"))
        assert found["camera"]["resolution"] and isinstance(found["warnings"], list)
        assert {"group", "quantity", "value", "unit", "note"} == set(found["sheet"][0])
        assert bool(found["capture"]) == (source == raw)
    found = json.loads(run("info", "raytrix", "--json", "--fix", tmp_path / "better.json"))
    better = json.loads((tmp_path / "better.json").read_text())
    assert {name: better[name] for name in found["changed"]} == found["changed"]


LIGHT = {
    "", "choices", "errors", "extension", "presets", "public_modules", "refocus_options", "scene_files",
    "cli", "cli.inputs", "cli.options", "cli.program", "cli.signatures", "cli.stopping", "plugins",
    "runtime", "runtime.garbage", "runtime.llvm", "runtime.locks", "runtime.progress",
    # The data of cameras with on-chip lenses belong to the presets.
    "extensions.onchip.cameras", "extensions.deconvolution.options",
}  # fmt: skip
"""What may be imported for help, and before a value is refused that can be judged without the library."""


def test_help_and_refused_options_import_no_library():
    code = f"""
    import contextlib, io, sys
    from mitsuba_plenoptic.cli import main
    for name in {list(COMMANDS)}:
        for words in ([*name.split(), "--help"], [*name.split(), "--nosuch-option"]):
            with contextlib.suppress(SystemExit), contextlib.redirect_stderr(io.StringIO()) as told:
                with contextlib.redirect_stdout(told):
                    main(words)
            assert "--help" in told.getvalue() or "such option" in told.getvalue(), (words, told.getvalue())
    """
    own, libraries = loaded(textwrap.dedent(code).strip())
    # Options that are not given are not judged.
    assert not libraries & {*HEAVY, "rich.progress", "pydantic"}
    assert own <= LIGHT | {module.removeprefix("mitsuba_plenoptic.") for module in COMMANDS.values()}


def test_words_are_completed():
    asked = {"COMP_WORDS": "mitsuba-plenoptic render letters --model ", "COMP_CWORD": "4"}
    asked["_MITSUBA_PLENOPTIC_COMPLETE"] = "complete_bash"
    command = [sys.executable, "-m", "mitsuba_plenoptic"]
    made = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | asked)
    assert set(made.stdout.split()) == {"ray", "wave"}, made.stderr


REFUSED = [
    ("render letterz -o raw.exr", "did you mean letters?"),
    ("render letters", "--output"),
    ("render letters -o raw.exr --wavelength abc", "--wavelength = 'abc': "),
    ("render letters -o raw.png", "raw.png: "),
    ("reconstruct missing.exr -o out.exr --distance 240", "missing.exr: "),
    ("reconstruct {there} -o out.exr --distance nan", "--distance = nan"),
    ("reconstruct {there} -o out.jpg --distance 240", "out.jpg: "),
    ("reconstruct letters -o out.png --distance 240", "letters: it is a scene"),
    ("sheet {there} -o sheet.exr", "sheet.exr: "),
    ("views {there} -o views.jpg", "views.jpg: give a name that ends in .exr or .png or .pdf or .gif"),
    ("example letterz", "one of letters-ray"),
]
REFUSED_BY_EXTENSIONS = [
    ("view {scene} -o page.html", "scene.xml: it is a scene"),
    ("sweep letters -o sweep.csv", "sweep.csv: "),
    ("sweep letters -o out.nc --grid missing.yaml", "missing.yaml: "),
    ("dataset missing.yaml -o d", "missing.yaml: "),
    ("calibrate centres missing.png -o centres.csv", "missing.png: "),
    ("fit {there} --scene letters -o camera.xml --parameter mla_pitch", "camera.xml: "),
    ("mtf missing.exr", "missing.exr: "),
]


@pytest.mark.parametrize(
    "lines", [REFUSED, pytest.param(REFUSED_BY_EXTENSIONS, marks=[STUDIO, SHARPNESS, INVERSE])], ids=["core", "others"]
)
def test_values_are_refused_before_the_library_is_imported(lines, raw, tmp_path):
    (tmp_path / "scene.xml").write_text("<scene/>")
    lines = [(line.format(there=raw, scene=tmp_path / "scene.xml").split(), rule) for line, rule in lines]
    code = f"""
    import contextlib, io, sys
    from mitsuba_plenoptic.cli import main
    for words, rule in {lines}:
        with contextlib.redirect_stderr(io.StringIO()) as told:
            assert main(words) == 2, words
        said = told.getvalue()
        assert rule in said and said.startswith("mitsuba-plenoptic: error: ") and said.count("\\n") == 1, said
        assert not set(sys.modules) & {HEAVY}, words
    """
    own, libraries = loaded(textwrap.dedent(code).strip())
    asked = {module.removeprefix("mitsuba_plenoptic.") for module in COMMANDS.values()}
    assert own <= LIGHT | asked and not libraries & HEAVY
