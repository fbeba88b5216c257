"""The paper "Wave-Optical Reconstruction of Plenoptic Camera Images", computed again in one go."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import require_choice
from .claims import check_claims, timing_table
from .experiment import Settings, open_store, run_experiment
from .figures import draw_comparison, figure_2, figure_4
from .framing import letter_zooms
from .measurements import measure
from .page import Report, write_report
from .stage_store import StageOptions
from .timing import seconds_on_one_core

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

    Parameters
    ----------
    output, stages
        As for `report.compare.compare`, which returns the same, too.
    preset : {"quick", "paper"}
        A smaller detector and smaller letters, or the paper's.

    Raises
    ------
    InputError
        If the preset is unknown or the folder cannot be written.
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
