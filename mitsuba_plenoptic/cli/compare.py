"""``mitsuba-plenoptic compare``: rays against waves on a user's own scene."""

from __future__ import annotations

from typing import Annotated

import typer

from ..bounds import require_wavelength
from ..capture.render import MOST_SAMPLES
from ..errors import require_count, require_number
from .inputs import parse_definitions
from .options import Definitions, Distances, OutputFolder, ResumeOnly, Scene, number
from .terminal import stage_lines


def compare(
    scene: Scene,
    output: OutputFolder,
    distance: Distances,
    wavelength: Annotated[float, number("Wavelength in nanometres.", unit="NM")] = 633.0,
    spp: Annotated[int, number("Samples per pixel, by rays and by waves.")] = 16,
    resume: ResumeOnly = False,
    define: Definitions = None,
    variant: Annotated[
        str, typer.Option(metavar="NAME", help="Mitsuba variant of one colour: llvm_ad_mono or cuda_ad_mono.")
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
    from ..report.metrics import ssim_text

    settings = Settings(
        scene=scene,
        distances=tuple(sorted({require_number("distance", value, positive=True) for value in distance})),
        parameters=parse_definitions(define),
        wavelength=require_wavelength(wavelength),
        spp=require_count("spp", spp, maximum=MOST_SAMPLES),
        noise=spp > 1,
        variant=variant,
    )
    with stage_lines(resume) as stages:
        results = compute(settings, output, stages=stages)
    found = results["captures"]
    similarity = ssim_text(found["ssim"])
    typer.echo(f"Rays against waves: {found['psnr']:.1f} dB, SSIM {similarity}, energy {found['energy']:.3f}")
    found = found["difference"]
    if found["all"]["noise"] is None:
        typer.echo("Noise: not known of one sample; use --spp 2 or more")
    elif found["all"]["noise_alone"]:
        typer.echo(f"They differ by {found['all']['measured']:.2%}, which noise alone explains; use more --spp")
    else:
        typer.echo(
            f"They differ by {found['all']['measured']:.2%}: noise {found['all']['noise']:.2%}, diffraction "
            f"{found['all']['true']:.2%} ({found['middle']['true']:.2%} in the middle of micro-images, "
            f"{found['rim']['true']:.2%} at their rim)"
        )
    typer.echo(f"{output / 'report.html'}: open it in a browser")
