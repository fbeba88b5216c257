"""The paper "Wave-Optical Reconstruction of Plenoptic Camera Images", computed again in one go."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import InputError, require_choice
from ..io.captures import read_capture
from ..reconstruction import reconstruct
from ..runtime.variant import set_variant
from .claims import check_claims, timing_table
from .experiment import METHODS, Settings, open_store, run_experiment
from .figures import draw_comparison, figure_2, figure_4
from .framing import letter_zooms
from .measurements import measure
from .page import Report, write_report
from .stage_store import StageOptions

# The methods of the paper's comparison.
TIMED = ("ray", "coherent", "partial")
_REPEATS = 3


def seconds_on_one_core(capture: Path, distance: float) -> dict[str, float]:
    """Time the reconstruction of a capture's file at a distance on one processor core: seconds by method.

    What counts is processor time, which does not grow with what else the machine does, and of several runs the
    shortest, in which kernels are compiled. Where the system allows it (Linux does), the process is held to one core.
    """

    def hold() -> None:
        if hasattr(os, "sched_setaffinity"):
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

    answer = subprocess.run(
        [sys.executable, "-m", __name__, str(capture), f"{distance!r}"],
        env={**os.environ, "DRJIT_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        preexec_fn=hold if os.name == "posix" else None,
        capture_output=True,
        text=True,
        check=False,
    )
    if answer.returncode:
        raise InputError(f"timing of {capture}: {answer.stderr.strip().splitlines()[-1]}")
    return dict(json.loads(answer.stdout))


def _main() -> None:
    set_variant(None)
    capture, distance = read_capture(sys.argv[1]), float(sys.argv[2])
    found = {}
    for method in METHODS:
        if method.name in TIMED:
            runs = []
            for _ in range(_REPEATS):
                start = time.process_time()
                reconstruct(capture, distance, **method.options)
                runs.append(time.process_time() - start)
            found[method.name] = round(min(runs), 3)
    print(json.dumps(found))


if __name__ == "__main__":
    _main()


_LETTERS = {"eight": "the 8 (210 mm)", "f": "the F (240 mm)", "hash": "the # (280 mm)"}

_PLATES = {
    "fig2.png": "The paper's figure 2: the object and its image on the detector, by waves; below, 8 x 8 lenses of each "
    "letter.",
    "fig4.png": "The paper's figure 4: reconstructions by rays (a), coherent (b) and partially coherent (c) at 280 mm, "
    "and partially coherent at 210 mm (d).",
}

_PAPER = Settings(
    scene="letters",
    distances=(210.0, 240.0, 280.0),
    slider=(200.0, 210.0, 220.0, 230.0, 240.0, 250.0, 260.0, 270.0, 280.0, 290.0, 300.0),
    spp=64,
    points=64,
    truth_spp=4096,
)

# The quick one has the paper's lenses and pixels on a detector of half the width, and letters of half the size.
PRESETS = {
    "quick": replace(
        _PAPER,
        parameters={"resolution": "2048", "detector_width": "4.096", "letter_scale": "0.5"},
        points=32,
    ),
    "paper": _PAPER,
}


def reproduce(output: Path, *, preset: str = "quick", stages: StageOptions | None = None) -> dict[str, Any]:
    """Make the paper's figures 2 and 4, its timing comparison and its conclusions, with a report.

    The wave capture is made from signed rays, and once more point by point, as in the paper; the report states their
    difference.
    """
    settings = PRESETS[require_choice("preset", preset, PRESETS)]
    store = open_store(output, stages)
    experiment = run_experiment(settings, store)
    numbers = measure(experiment)
    last = settings.distances[-1]
    seconds = store.facts(
        "seconds_on_one_core",
        {"capture": experiment.wave_key, "distance": last},
        lambda _: seconds_on_one_core(experiment.wave_file, last),
    )
    near, _, far = _LETTERS
    claims = check_claims(experiment, numbers, seconds, near, far)
    zooms = letter_zooms(experiment, _LETTERS)
    figure_2(output / "fig2.png", experiment, _LETTERS)
    panels = [("ray", last), ("coherent", last), ("partial", last), ("partial", settings.distances[0])]
    figure_4(output / "fig4.png", experiment, panels)
    columns, rows = experiment.camera.bin_count
    confirmed = sum(claim.verdict == "confirmed" for claim in claims)
    report = Report(
        title="A plenoptic camera by rays and by waves",
        lead=f"Three letters at 210, 240 and 280 mm, recorded through {columns} x {rows} microlenses at "
        f'{settings.wavelength:g} nm and refocused from one capture, after the paper "Wave-Optical '
        f'Reconstruction of Plenoptic Camera Images". Of its {len(claims)} conclusions {confirmed} are confirmed.',
        experiment=experiment,
        numbers=numbers,
        zooms=zooms,
        plates=_PLATES | draw_comparison(output, experiment, numbers, zooms),
        command=f"mitsuba-plenoptic reproduce --preset {preset}",
        claims=claims,
        timing=timing_table(experiment, seconds),
    )
    return write_report(output, report)
