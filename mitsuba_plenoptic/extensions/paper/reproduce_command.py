"""``mitsuba-plenoptic reproduce``: the study of the paper, computed again."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from ...cli import options, stopping


def reproduce(
    output: options.OutputFolder,
    preset: Annotated[
        Literal["quick", "paper"],
        typer.Option(
            help="A detector of half the width with letters of half the size, or the paper's 4096 x 4096 pixels, "
            "and figures as PDF, too.",
        ),
    ] = "quick",
    resume: options.Resume = False,
) -> None:
    """Compute the paper's figures, timing and conclusions again.

    Writes figures, captures and reconstructions, all results and report.html,
    which shows them in a browser. Valid results that the folder already
    holds are reused: a run that was stopped resumes where it was, even within
    the wave capture.

    [bold]Examples:[/bold]

      mitsuba-plenoptic reproduce -o demo

      mitsuba-plenoptic reproduce --preset paper -o paper
    """
    # Figures need libraries that take a second to load, which other commands need not wait for.
    from .reproduction import reproduce as compute

    with stopping.stage_lines(resume) as stages:
        results = compute(output, preset=preset, stages=stages)
    for claim in results["claims"]:
        typer.echo(f"{claim['verdict']:<15} {claim['statement']}")
    typer.echo(f"{output / 'report.html'}: open it in a browser")
