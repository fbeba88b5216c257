"""``mitsuba-plenoptic reproduce``: the paper's figures, timing and conclusions."""

from __future__ import annotations

from typing import Annotated

import typer

from .options import OutputFolder, ResumeOnly
from .terminal import stage_lines


def reproduce(
    output: OutputFolder,
    preset: Annotated[
        str,
        typer.Option(
            metavar="quick|paper",
            help="A detector of half the width with letters of half the size, or the paper's 4096 x 4096 pixels.",
        ),
    ] = "quick",
    resume: ResumeOnly = False,
) -> None:
    """Compute the paper's figures, timing and conclusions again.

    Writes figures, captures and reconstructions, all numbers and report.html,
    which shows them in a browser. What the folder already holds and is still
    valid is kept, so that a run that was stopped goes on where it stood, even
    in the midst of the wave capture.

    [bold]Examples:[/bold]

      mitsuba-plenoptic reproduce -o demo

      mitsuba-plenoptic reproduce --preset paper -o paper
    """
    # Figures need libraries that take a second to load, which other commands need not wait for.
    from ..report.reproduce import reproduce as compute

    with stage_lines(resume) as stages:
        results = compute(output, preset=preset, stages=stages)
    for claim in results["claims"]:
        typer.echo(f"{claim['verdict']:<15} {claim['statement']}")
    typer.echo(f"{output / 'report.html'}: open it in a browser")
