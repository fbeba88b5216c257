"""The fuzzing of `tools/fuzz.py`: it starts from whole inputs, finds and shrinks what is planted, and nothing else."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"

# Outcomes, the number from which on a case has them, and the case: what is found must be shrunk to that number.
PLANTED = [
    ("fine", 0, "image()"),
    ("refused", 0, "Detector(bits=17)"),
    ("accepted", 0, "forbidden(Detector(bits=16))"),
    ("not finite", 100, "Reconstruction(image(at=(0, 0), to=inf if {n} >= 100 else 0), 240.0, 1.0, 'ray', CAMERA)"),
    ("not finite", 100, "light_field() * (nan if {n} >= 100 else 1)"),
    ("not finite", 100, "'f-number nan' if {n} >= 100 else 'f-number 8'"),
    ("wrong shape", 100, "Reconstruction(image()[: 0 if {n} >= 100 else 1], 240.0, 1.0, 'ray', CAMERA)"),
    ("exception", 100, "1 / max(100 - {n}, 0)"),
    ("crash", 0, "os.abort()"),
    ("too long", 0, "list(iter(int, 1))"),
    ("too long", 0, "__import__('time').sleep(60)"),
]
# Those that end only when their time does, of which they get little.
ENDLESS = [case for outcome, _, case in PLANTED if outcome == "too long"]
# What bad inputs are made of, as it is without the damage: if this were refused, all the rest would show nothing.
WHOLE = [
    *(f"read(file('{name}'))" for name in ("grey.exr", "colour.exr")),
    "read(relabelled('colour.exr'))",
    "read(lying('grey.exr', 'channels', None, channels('Y')))",
    "read(poisoned('grey.exr', (3, 3), 1))",
    "read(misplaced('grey.exr', 0, b''))",
    "render(sensor('float', 'focal_length', '70'))",
    "render(waves('float', 'accuracy', '0.05'))",
    "render(beside=holding('scene.xml', SCENE))",
    "render(('<emitter', '<include filename=\"i0.xml\"/><emitter'), beside=includes(''))",
    "resume(file('stopped.checkpoint'))",
    "resume(lying_checkpoint())",
    "sweep('--grid', file('grid.yaml'))",
    *(f"open_light_field(file('{name}.mat'))" for name in ("uint8", "uint16", "single", "version7")),
    *(f"open_views(file('{name}.png'))" for name in ("views", "lenses.eslf")),
    "open_light_field(matlab(LF=ONES, LensletGridModel=GRID_MODEL))",
    "open_light_field(hdf5(LF=np.ones((2, 4, 4, 3, 3), np.uint8)))",
    *(f"command(*{words})" for words in ("RENDER", "REFOCUS", "EXPOSE")),
    "render_capture(wall(CAMERA, 240.0), spp=1)",
]
SCRIPT = """
import json, sys
from pathlib import Path
from hypothesis import strategies as st
from fuzz import write_report
from fuzzing.runner import Kind, fuzz
planted, single, endless = json.loads(sys.argv[1])
kinds = [Kind(case, 30, st.integers(0, 1000).map(lambda n, case=case: case.format(n=n))) for case in planted]
kinds += [Kind(case, 1, st.just(case)) for case in single]
report = fuzz(kinds, 30 * len(planted) + len(single), 0, seconds=3)
late = fuzz([Kind(case, 1, st.just(case)) for case in endless], len(endless), 0, seconds=0.3)
report.counts.update(late.counts)
report.findings += late.findings
write_report(Path(sys.argv[2]), report)
"""


def run(*arguments):
    return subprocess.run(
        [sys.executable, *map(str, arguments)], capture_output=True, text=True, cwd=TOOLS, timeout=240, check=False
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Everything planted and everything whole, in one run."""
    folder = tmp_path_factory.mktemp("fuzz")
    cases = [case for _, _, case in PLANTED] + WHOLE
    numbered = [case for case in cases if "{n}" in case]
    single = [case for case in cases if case not in numbered + ENDLESS]
    result = run("-c", SCRIPT, json.dumps([numbered, single, ENDLESS]), folder)
    assert result.returncode == 0, result.stderr
    return json.loads((folder / "report.json").read_text()), (folder / "report.md").read_text()


@pytest.mark.slow
def test_what_is_whole_is_fine(report):
    assert {case: report[0]["counts"][case] for case in WHOLE} == {case: {"fine": 1} for case in WHOLE}


@pytest.mark.slow
def test_what_is_planted_is_found_and_shrunk(report):
    content, text = report
    found = {finding["kind"]: finding for finding in content["findings"]}
    for outcome, first, case in PLANTED:
        if outcome in ("fine", "refused"):
            assert list(content["counts"][case]) == [outcome]
        else:
            finding = found.pop(case)
            assert (finding["outcome"], finding["case"]) == (outcome, case.format(n=first))
    assert not found
    assert "SIGABRT" in text
    assert "ZeroDivisionError" in text


@pytest.mark.slow
def test_a_case_of_the_report_is_replayed():
    result = run("fuzz.py", "--replay", "light_field() * nan")
    assert (result.returncode, result.stdout.splitlines()[0]) == (1, "not finite")


@pytest.mark.slow
def test_a_slice_of_it_finds_nothing(tmp_path):
    result = run("fuzz.py", "--count", 150, "--seed", 8, "--workers", 1, "-o", tmp_path)
    assert result.returncode == 0, result.stdout
    counts = json.loads((tmp_path / "report.json").read_text())["counts"]
    # Not everything is refused: some damage is harmless, and gives a result.
    assert len(counts) == 16
    assert {outcome for count in counts.values() for outcome in count} == {"refused", "fine"}
    assert "| all | 162 |" in (tmp_path / "report.md").read_text()
