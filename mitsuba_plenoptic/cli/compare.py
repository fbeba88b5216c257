"""``mitsuba-plenoptic compare``: rays against waves on a user's own scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..bounds import require_wavelength
from ..capture.render import MOST_SAMPLES
from ..errors import require_count, require_number
from ..plugins.integrator import MOST_RADIATORS
from ._common import Definitions, ResumeOnly, parse_definitions
from ._stages import stage_lines


def compare(
    scene: Annotated[str, typer.Argument(help="A Mitsuba XML file, or the name of a built-in scene.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder to write into; made if it is not there.")
    ],
    distance: Annotated[
        list[float],
        typer.Option(metavar="MM", help="Distance from the main lens to focus on; repeat for several."),
    ],
    wavelength: Annotated[float, typer.Option(metavar="NM", help="Wavelength in nanometres.")] = 633.0,
    radiators_per_lens: Annotated[
        int, typer.Option(metavar="N", help="Radiators per microlens and axis; the time grows with its square.")
    ] = 8,
    spp: Annotated[
        int, typer.Option(metavar="N", help="Samples per pixel by rays, light paths per radiator by waves.")
    ] = 16,
    resume: ResumeOnly = False,
    define: Definitions = None,
    variant: Annotated[
        str,
        typer.Option(metavar="NAME", help="Mitsuba variant of one colour: llvm_ad_mono or cuda_ad_mono."),
    ] = "llvm_ad_mono",
) -> None:
    """Capture a scene by rays and by waves, refocus it in every way, and compare.

    Writes figures, captures and reconstructions, all numbers and report.html,
    which shows them in a browser. The ray capture has parabolic lenses, so that
    diffraction is its only difference from the wave capture. A run that was
    stopped goes on where it stood.

    [bold]Examples:[/bold]

      mitsuba-plenoptic compare chart -o chart --distance 210 --distance 240

      mitsuba-plenoptic compare still_life -o still_life --distance 215
      --distance 258 -D resolution=2048 -D detector_width=4.096
    """
    # Figures need libraries that take a second to load, which other commands need not wait for.
    from ..report.compare import compare as compute
    from ..report.experiment import Settings

    settings = Settings(
        scene=scene,
        distances=tuple(sorted({require_number("distance", value, positive=True) for value in distance})),
        parameters=parse_definitions(define),
        wavelength=require_wavelength(wavelength),
        radiators_per_lens=require_count("radiators_per_lens", radiators_per_lens, maximum=MOST_RADIATORS),
        spp=require_count("spp", spp, maximum=MOST_SAMPLES),
        paths=spp,
        variant=variant,
    )
    with stage_lines() as (notify, finished):
        results = compute(settings, output, notify=notify, finished=finished, resume=resume)
    found = results["captures"]
    typer.echo(f"Rays against waves: {found['psnr']:.1f} dB, SSIM {found['ssim']:.3f}, energy {found['energy']:.3f}")
    typer.echo(f"{output / 'report.html'}: open it in a browser")
