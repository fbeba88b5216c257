"""The script of the first hour on a GPU, without one."""

import json
import subprocess
import sys
from pathlib import Path

import drjit as dr
import pytest

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
def test_checks_run_in_processes_of_their_own(tmp_path):
    said, rows = run(tmp_path, "--variant", "llvm_ad_mono", "--only", "agreement: step")
    assert rows["agreement: step"]["passed"] and rows["agreement: step"]["difference"] < 1e-6
    # What the script cannot do fails, and does not stop it.
    said, rows = run(tmp_path, "--variant", "no_such_variant", "--only", "agreement: s")
    assert len(rows) > 3 and not any(row["passed"] for row in rows.values())
    assert "no_such_variant" in rows["agreement: step"]["note"] and said.count("FAILED") == len(rows)
