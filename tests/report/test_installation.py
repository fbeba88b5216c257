"""``doctor``: what it calls ready renders, and what fails is named, without a GPU, without OptiX, without LLVM."""

import json

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.report import installation

NO_LLVM = "no LLVM 17 or newer was found; run: INSTALL"


@pytest.fixture
def machine(monkeypatch, capfd):
    """Return the status and the JSON of ``doctor`` on a machine with these parts."""

    some = ("scalar_rgb", "llvm_ad_mono", "cuda_ad_mono")

    def simulate(*, cuda=False, llvm=None, script=installation._TRIANGLE, variants=some):
        monkeypatch.setattr(dr, "has_backend", lambda _: cuda)
        monkeypatch.setattr(mi, "variants", lambda: list(variants))
        monkeypatch.setattr(installation.llvm, "problem", lambda: llvm)
        monkeypatch.setattr(installation, "_TRIANGLE", script)
        status = main(["doctor", "--json"])
        return status, json.loads(capfd.readouterr().out)

    return simulate


def test_without_a_gpu_llvm_renders(machine):
    status, found = machine(variants=["llvm_ad_mono", "llvm_ad_mono_polarized", "cuda_ad_mono"])
    assert status == 0 and found["ready"] and found["verdict"] == "Ready to render"
    assert found["Variants"] == {
        "llvm_ad_mono": "works here",
        "llvm_ad_mono_polarized": "works here; wave captures are unpolarized",
        "cuda_ad_mono": "not usable here",
    }
    assert found["Versions"]["mitsuba"] and found["GPU"]["CUDA"] == "not found" and "OptiX" not in found["GPU"]


@pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="a CUDA device is here")
def test_a_driver_that_mitsuba_cannot_use(machine):
    """The true failure of a true CUDA variant, with a driver found that is not there, and nothing else to render."""
    status, found = machine(cuda=True, llvm=NO_LLVM)
    assert status == 1 and found["verdict"] == "Not ready: no variant renders here" and found["problem"] == NO_LLVM
    assert found["Variants"]["llvm_ad_mono"] == "not usable here"
    assert found["Variants"]["cuda_ad_mono"].startswith("fails here: ")
    assert all(words in found["GPU"]["OptiX"] for words in ("fails", "535 or newer", "NVIDIA_DRIVER_CAPABILITIES"))


def test_cuda_without_llvm_is_not_ready_for_the_default_variant(machine):
    status, found = machine(cuda=True, llvm=NO_LLVM, script="pass")
    assert status == 1 and not found["ready"] and found["GPU"]["OptiX"] == "works"
    other = "llvm_ad_mono, the default variant, does not render here; --variant cuda_ad_mono does"
    assert found["verdict"] == f"Not ready: {other}"


@pytest.mark.parametrize(
    ("script", "fault"),
    [
        ("import os, sys; sys.stderr.write('LLVM ERROR: a line\\n'); sys.stderr.flush(); os.abort()",
         "ended by SIGABRT after: LLVM ERROR: a line"),
        ("import time; time.sleep(60)", "no answer within 0.3 s"),
        ("raise SystemExit(3)", "exit status 3"),
        (installation._TRIANGLE.replace("0, 0, 4], [0", "0, 0, 8.95], [0"),
         "a triangle at a distance of 4 is rendered at 8.9"),
    ],
)  # fmt: skip
def test_a_variant_that_aborts_hangs_or_renders_something_else(script, fault, monkeypatch):
    monkeypatch.setattr(installation, "_TRIANGLE", script)
    if "sleep" in script:
        monkeypatch.setattr(installation, "TRIAL_SECONDS", 0.3)
    assert installation.trial("llvm_ad_mono").startswith(fault)
