"""The script of the first hour on a GPU, without one."""

import json
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import pytest

from tools import first_gpu_run

SCRIPT = Path(__file__).parents[2] / "tools/first_gpu_run.py"


def run(tmp_path, *words):
    done = subprocess.run(
        [sys.executable, SCRIPT, "-o", tmp_path, *words],
        capture_output=True,
        text=True,
        check=True,
        cwd=SCRIPT.parents[1],
    )
    return done.stdout, json.loads((tmp_path / "rows.json").read_text())


@pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="a CUDA device is here")
def test_without_a_device_the_table_says_not_run(tmp_path):
    said, rows = run(tmp_path)
    assert {"doctor", "tests marked gpu", "scene: still_life, wave", "agreement: signed rays"} <= set(rows)
    assert all(f"| {name} | not run |" in said for name in rows)
    assert (tmp_path / "table.md").read_text().strip() == said.strip()


@pytest.mark.slow
def test_a_check_that_takes_too_long_is_ended_with_all_it_has_started():
    start = time.perf_counter()
    row = first_gpu_run.in_own_process("tests marked gpu", first_gpu_run.DRY, 4.0, dry=True)
    assert not row["passed"] and row["note"] == "stopped after 4 s" and time.perf_counter() - start < 10


@pytest.mark.slow
def test_a_dry_run_tries_captures_commands_and_wheels(tmp_path):
    said, rows = run(tmp_path, "--dry-run", "--only", "scene: letters, ray", "--wheels", tmp_path)
    assert "a dry run" in said and not rows["wheels"]["passed"] and "cupy-cuda12x" in rows["wheels"]["note"]
    assert {"means", "over_noise", "cold", "warm", "peak"} <= set(rows["scene: letters, ray"])
    _, rows = run(tmp_path, "--dry-run", "--only", "bench")
    assert "no CUDA device" in rows["bench: speed.gpu"]["note"]


@pytest.mark.slow
def test_checks_run_in_processes_of_their_own(tmp_path):
    said, rows = run(tmp_path, "--variant", "llvm_ad_mono", "--only", "agreement: step")
    assert rows["agreement: step"]["passed"] and rows["agreement: step"]["difference"] < 1e-6
    # What the script cannot do fails, and does not stop it.
    said, rows = run(tmp_path, "--variant", "no_such_variant", "--only", "agreement: s")
    assert len(rows) > 3 and not any(row["passed"] for row in rows.values())
    assert "no_such_variant" in rows["agreement: step"]["note"] and said.count("FAILED") == len(rows)
