"""``mitsuba-plenoptic info`` and ``doctor``: the design sheet of a camera, and the state of the installation."""

from __future__ import annotations

import json
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import printable, refuse_if
from ..presets import PRESETS
from .inputs import Definitions, load_camera, numeric, parse_definitions, read_recorded
from .judging import CAMERA, WAVELENGTH

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from ..camera import PlenopticCamera
    from ..io.captures import Capture
    from ..report.design_sheet import Row


def info(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SCENE|PRESET|CAMERA.json|NAME=VALUE,...|CAPTURE.exr",
            help=f"A Mitsuba XML file, a built-in scene's name, a camera's ({', '.join(PRESETS)}), its file or "
            "parameters, as for --camera of 'render', a capture, or a raw picture of a Lytro camera.",
        ),
        CAMERA,
    ],
    wavelength: Annotated[
        float | None,
        numeric("Wavelength in nanometres of the diffraction figures.", "the capture's", unit="NM"),
        WAVELENGTH,
    ] = None,
    drawing: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            show_default="none",
            help="Draw the main_lens with rays, spots, light and distortion over the field, as .png or .pdf.",
        ),
    ] = None,
    microlens: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png",
            show_default="none",
            help="Draw a microlens: its phase, a section with rays, and its spot.",
        ),
    ] = None,
    fix: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.json",
            show_default="none",
            help="Write the camera that the fewest of the changes which the warnings name make of this one.",
        ),
    ] = None,
    define: Definitions = None,
) -> None:
    """Print what follows from a camera's parameters, and what is poor about the design.

    Nothing is rendered. For a capture, how it was made is printed too. Warnings name
    what would mend them, which --fix does.

    [bold]Examples:[/bold]

      mitsuba-plenoptic info letters --wavelength 633

      mitsuba-plenoptic info raytrix --wavelength 550

      mitsuba-plenoptic info raw.exr

      mitsuba-plenoptic info camera.json --drawing lens.png

      mitsuba-plenoptic info camera.json --microlens microlens.png

      mitsuba-plenoptic info camera.json --fix better.json
    """
    from rich.console import Console
    from rich.markup import escape

    from ..design import design_warnings
    from ..io.files import require_writable
    from ..io.lytro_file import SUFFIXES as LYTRO_SUFFIXES
    from ..report.design_sheet import design_sheet

    if fix is not None:
        require_writable(fix, ".json")
    parameters = parse_definitions(define)
    recorded = source.lower().endswith((".exr", *LYTRO_SUFFIXES))
    refuse_if(
        parameters and recorded,
        f"-D: {source} is no scene, and has no scene parameters; leave it out",
    )
    capture = read_recorded(Path(source), None, False) if recorded else None
    camera = capture.camera if capture else load_camera(source, parameters)[0]
    if capture and wavelength is None and isinstance(capture.wavelength, float):
        wavelength = capture.wavelength
    if drawing is not None:
        # Brings Matplotlib, which takes a while to load.
        from ..report.lens_drawing import draw_main_lens

        draw_main_lens(drawing, camera)
    if microlens is not None:
        from ..report.microlens_drawing import draw_microlens

        draw_microlens(microlens, camera, wavelength)
    console = Console(highlight=False)
    console.print(_table(design_sheet(camera, wavelength)))
    if capture:
        console.print("[bold]Capture[/bold]")
        for name, fact in _origin(capture).items():
            console.print(f"  {escape(printable(name))}: {escape(printable(fact))}", soft_wrap=True)
    for warning in design_warnings(camera, wavelength):
        console.print(f"[bold]Warning:[/bold] {escape(warning)}.", soft_wrap=True)
    if fix is not None:
        _write_mended(console, fix, camera, wavelength)


def _write_mended(console: Console, path: Path, camera: PlenopticCamera, wavelength: float | None) -> None:
    """Write the camera without the warnings, and say what has changed and what has not been mended."""
    from rich.markup import escape

    from ..design import design_warnings, mended
    from ..io.files import write_text

    better = mended(camera, wavelength)
    write_text(path, better.to_json(), ".json")
    old, new = camera.to_dict(), better.to_dict()
    changed = [f"{name} = {value}" for name, value in new.items() if old.get(name) != value]
    what = f"with {', '.join(changed)}" if changed else "unchanged"
    console.print(f"[bold]Written:[/bold] {escape(f'{path}, {what}')}.", soft_wrap=True)
    for warning in design_warnings(better, wavelength):
        console.print(f"[bold]Still:[/bold] {escape(warning)}.", soft_wrap=True)


def _origin(capture: Capture) -> dict[str, str]:
    """Describe how a capture was made, as far as its header says."""
    noise = None if capture.noise is None else f"{capture.relative_noise:.2%} of the mean"
    facts = {"model": capture.model, "wavelength": capture.wavelength, "noise": noise, **capture.metadata}
    return {
        name: value if isinstance(value, str) else json.dumps(value)
        for name, value in facts.items()
        if value not in (None, "")
    }


def _table(rows: list[Row]) -> Table:
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column()
    table.add_column(justify="right", overflow="fold")
    table.add_column()
    table.add_column(overflow="fold")
    for group, members in groupby(rows, key=lambda row: row.group):
        table.add_row(f"[bold]{escape(group)}[/bold]")
        for row in members:
            table.add_row(f"  {row.quantity}", escape(row.value), row.unit, f"[dim]{escape(row.note)}[/dim]")
    return table


def doctor() -> None:
    """Check the installation: versions, LLVM, Mitsuba variants, threads and GPU.

    The exit status is 0 if captures can be rendered here and 1 if not.
    """
    from ..report.installation import inspect_installation

    found = inspect_installation()
    for title, lines in found.sections.items():
        typer.echo(f"\n{typer.style(title, bold=True)}")
        for name, value in lines:
            typer.echo(f"  {name:<26} {value}")
    typer.echo()
    if found.problem:
        typer.echo(f"Problem: {found.problem}.")
    if not found.ready:
        raise typer.Exit(1)
    typer.echo("Ready to render.")
