"""``mitsuba-plenoptic reproduce``: the study of the paper, computed again."""

from pathlib import Path
from typing import Literal

import typer

from ...cli import options, stopping
from ...errors import refuse_if


def reproduce(
    *,
    output: options.OutputFolder,
    preset: Literal["quick", "paper"] | None = None,
    real: Path | None = None,
    wavelength: float | None = None,
    resume: options.Resume = False,
) -> None:
    """Compute the paper's figures, timing and conclusions again.

    Writes figures, captures and reconstructions, all results and report.html, which shows them in a browser. Valid
    results that the folder already holds are reused: a run that was stopped resumes where it was, even within the wave
    capture.

    Parameters
    ----------
    preset
        A detector of half the width with letters of half the size, or the paper's 4096 x 4096 pixels, and figures as
        PDF, too. Default: quick.
    real : FOLDER
        Judge real light instead: a folder with light, white and dark (.png, .tiff or .exr), camera.json and
        shapes.json.
    wavelength : NM
        Of real light, as waves. Default: 550.

    Examples
    --------
    $ mitsuba-plenoptic reproduce -o demo
    $ mitsuba-plenoptic reproduce --preset paper -o paper
    $ mitsuba-plenoptic reproduce --real letters -o real
    """
    refuse_if(real is not None and preset is not None, "--preset: with --real it has no use; leave it out")
    refuse_if(real is None and wavelength is not None, "--wavelength: it is for --real; leave it out")
    # Figures need libraries that take a second to load, which other commands need not wait for.
    from .reproduction import reproduce as compute

    with stopping.stage_lines(resume) as stages:
        if real is not None:
            from .real_light import reproduce_real

            claims = reproduce_real(output, real, wavelength=wavelength or 550.0, stages=stages)["real"]["claims"]
        else:
            claims = compute(output, preset=preset or "quick", stages=stages)["claims"]
    for claim in claims:
        typer.echo(f"{claim['verdict']:<15} {claim['statement']}")
    typer.echo(f"{output / 'report.html'}: open it in a browser")
