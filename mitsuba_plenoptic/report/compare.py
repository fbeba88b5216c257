"""Rays and waves compared on any scene with a plenoptic camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import InputError
from .experiment import Settings, open_store, run_experiment
from .figures import draw_comparison
from .framing import brightest_zoom
from .measurements import measure
from .page import Report, write_report
from .stage_store import StageOptions


def compare(settings: Settings, output: Path, *, stages: StageOptions | None = None) -> dict[str, Any]:
    """Capture a scene by rays and by waves, refocus it in every way, and report how they differ.

    The ray capture has parabolic lenses, whose aberrations are those of the wave capture's thin phases, so that
    diffraction is the only difference.
    """
    if not settings.distances:
        raise InputError("distance: give at least one to refocus to")
    store = open_store(output, stages)
    experiment = run_experiment(settings, store)
    numbers = measure(experiment)
    zooms = [brightest_zoom(experiment)]
    columns, rows = experiment.camera.bin_count
    name = Path(settings.scene).stem.replace("_", " ")
    report = Report(
        title=f"Rays and waves: {name}",
        lead=f"Recorded through {columns} x {rows} microlenses, once by rays and once by waves at "
        f"{settings.wavelength:g} nm, and refocused from one capture.",
        experiment=experiment,
        numbers=numbers,
        zooms=zooms,
        plates=draw_comparison(output, experiment, numbers, zooms),
        command=_command(settings),
    )
    return write_report(output, report)


def _command(settings: Settings) -> str:
    words = ["mitsuba-plenoptic compare", settings.scene]
    words += [f"--distance {distance:g}" for distance in settings.distances]
    words += [f"-D {name}={value}" for name, value in settings.parameters.items()]
    words += [
        f"--wavelength {settings.wavelength:g}",
        f"--spp {settings.spp}",
        f"--variant {settings.variant}",
    ]
    return " ".join(words)
