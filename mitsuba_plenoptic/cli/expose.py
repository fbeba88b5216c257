"""``mitsuba-plenoptic expose``: from a noise-free capture to what a real detector records."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..detector import Detector
from ..detector import expose as record
from ..errors import InputError
from ..io.captures import write_capture
from ..io.files import require_writable
from ._common import load_capture


def expose(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE.exr", help="A file that 'render' wrote.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FILE.exr", help="File to write.")],
    photons: Annotated[
        float, typer.Option(metavar="N", help="Photons that hit a pixel of value 1 during the exposure.")
    ],
    quantum_efficiency: Annotated[
        float, typer.Option(metavar="SHARE", help="Electrons per photon, up to 1.")
    ] = Detector.quantum_efficiency,
    full_well: Annotated[
        float, typer.Option(metavar="N", help="Electrons at which a pixel saturates.")
    ] = Detector.full_well,
    dark_electrons: Annotated[
        float, typer.Option(metavar="N", help="Mean electrons without light.")
    ] = Detector.dark_electrons,
    read_noise: Annotated[
        float, typer.Option(metavar="N", help="Standard deviation of the reading, in electrons.")
    ] = Detector.read_noise,
    bits: Annotated[int, typer.Option(metavar="N", help="Bits of a digital number, up to 16.")] = Detector.bits,
    gain: Annotated[
        float | None,
        typer.Option(metavar="K", show_default="the full well is the largest number", help="Numbers per electron."),
    ] = None,
    black_level: Annotated[
        int | None,
        typer.Option(
            metavar="N", show_default="four deviations of the dark noise", help="Number without any electron."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of the noise.")] = 0,
) -> None:
    """Add what a real detector does: photon and read noise, saturation, digital numbers.

    The sensor is linear after EMVA Standard 1288. The result is a capture in
    the units of the first, so that every command takes it.

    [bold]Example:[/bold]

      mitsuba-plenoptic expose raw.exr -o noisy.exr --photons 2000
    """
    if output.suffix.lower() != ".exr":
        raise InputError(f"{output}: a capture is written as OpenEXR; give a name that ends in .exr")
    require_writable(output)
    detector = Detector(
        quantum_efficiency=quantum_efficiency,
        full_well=full_well,
        dark_electrons=dark_electrons,
        read_noise=read_noise,
        bits=bits,
        gain=gain,
        black_level=black_level,
    )
    write_capture(output, record(load_capture(capture), detector, photons=photons, seed=seed))
    electrons = detector.quantum_efficiency * photons
    typer.echo(f"{output}: {electrons:.4g} electrons in a pixel of value 1; a full well is {full_well:g}")
