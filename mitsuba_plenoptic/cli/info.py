"""``mitsuba-plenoptic info`` and ``doctor``: the design sheet of a camera, and the state of the installation."""

from __future__ import annotations

import contextlib
import json
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..choices import RAW_SUFFIXES
from ..errors import InputError, printable, refuse_if, require_number
from ..presets import PRESETS
from .inputs import load_camera, parse_definitions, refuse_options, refuse_scene_options, require_png
from .options import CAMERA, Definitions, Dpi, Unit, numeric, wavelength_option

if TYPE_CHECKING:
    from rich.table import Table

    from ..io import Capture
    from ..report import Row


_positive = partial(require_number, positive=True)

Json = Annotated[bool, typer.Option("--json", help="Print JSON for other programs, and nothing else.")]


def info(
    source: Annotated[
        str | None,
        typer.Argument(
            metavar="SCENE|PRESET|CAMERA.json|NAME=VALUE,...|CAPTURE.exr|LENS.zmx|LENS.yaml",
            show_default=False,
            help=f"A Mitsuba XML file, a built-in scene's name, a camera's ({', '.join(PRESETS)}), its file or "
            "parameters, as for --camera of 'render', a capture, a raw picture of a Lytro camera, or a lens's file.",
            callback=CAMERA,
        ),
    ] = None,
    wavelength: Annotated[float | None, wavelength_option("the capture's")] = None,
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
    dpi: Dpi = None,
    pupil: Annotated[
        float | None,
        numeric("Of a lens: diameter of its entrance pupil.", "the file's", unit="MM", check=_positive),
    ] = None,
    f_number: Annotated[float | None, numeric("Of a lens: f-number.", "the file's", check=_positive)] = None,
    field: Annotated[
        list[float] | None,
        numeric(
            "Of a lens: angle from the axis; repeat for several.",
            "the file's",
            unit="DEG",
            check=partial(require_number, minimum=0, maximum=85),
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="PRESET|FILE|NAME=VALUE,...",
            show_default="none",
            help="The camera, instead of SCENE.",
            callback=CAMERA,
        ),
    ] = None,
    unit: Unit = "mm",
    as_json: Json = False,
    define: Definitions = None,
) -> None:
    """Print what follows from a camera's parameters, and warnings about its design.

    Nothing is rendered. For a capture, the way it was made is printed too. Warnings name their remedies, which --fix
    applies. Of a lens, spots and modulation transfer functions are printed, at the fields and wavelengths of its file.

    [bold]Examples:[/bold]

      mitsuba-plenoptic info letters --wavelength 633

      mitsuba-plenoptic info raytrix --wavelength 550

      mitsuba-plenoptic info camera.json --drawing lens.png

      mitsuba-plenoptic info camera.json --fix better.json

      mitsuba-plenoptic info lens.zmx --f-number 4 --field 14
    """
    refuse_if((source is None) == (camera is None), "SCENE, --camera: give one of the two")
    from rich.console import Console
    from rich.markup import escape

    from ..extension import format_of
    from ..io import read_capture
    from ..runtime import read_yaml, require_writable, write_text

    source = str(camera if source is None else source)
    for path, *suffixes in ((fix, ".json"), (drawing, ".png", ".pdf"), (microlens, ".png", ".pdf")):
        if path is not None:
            require_writable(path, *suffixes)
    parameters = parse_definitions(define)
    suffix = Path(source).suffix.lower()
    recorded = suffix in (".exr", *RAW_SUFFIXES) or format_of(suffix, "capture", source) is not None
    is_lens = Path(source).is_file() and format_of(suffix, "lens", source) is not None
    if Path(source).is_file() and suffix in (".yaml", ".yml", ".json"):
        with contextlib.suppress(InputError, TypeError):
            is_lens = "surfaces" in read_yaml(source)
    if recorded or is_lens:
        refuse_scene_options(source, parameters, unit)
    require_png(dpi, drawing, microlens)
    # Bring libraries that take seconds to load.
    from ..design import design_warnings, mended
    from ..lenses import main_lens
    from ..prescription import read_prescription
    from ..report import behind_lens, design_sheet, lens_sheet

    if is_lens:
        refuse_options(f"{source}, a main lens,", microlens=microlens, fix=fix, wavelength=wavelength)
        refuse_if(pupil and f_number, "--pupil, --f-number: give one of the two")
        prescription = read_prescription(source)
        try:
            if f_number is not None:
                pupil = prescription.paraxial.focal_length / f_number
            lens, distance, heights = behind_lens(prescription, pupil or 0.0, field or [])
            rows = lens_sheet(lens, distance, heights)
        except InputError as error:
            raise InputError(f"{source}: {str(error).removeprefix('main_lens: ')}") from None
        facts: dict[str, Any] = {"lens": prescription.to_plain()}
        cell = 0.0
    else:
        refuse_options(f"{source}, which is no lens,", pupil=pupil, f_number=f_number, field=field)
        capture = read_capture(source) if recorded else None
        shown_camera = capture.camera if capture else load_camera(source, parameters, unit)[0]
        if capture and wavelength is None and isinstance(capture.wavelength, float):
            wavelength = capture.wavelength
        if microlens is not None:
            from ..report import microlens_figure

            shown_camera.require_array(str(microlens))
            microlens_figure(shown_camera, wavelength).save(microlens, dpi)
        refuse_if(
            drawing is not None and shown_camera.prescription is None,
            f"{drawing}: the camera has no main_lens of surfaces that could be drawn",
        )
        lens = main_lens(shown_camera)
        distance = shown_camera.focus_distance
        cell = shown_camera.row_pitch if shown_camera.has_array else 0.0
        rows = design_sheet(shown_camera, wavelength)
        facts = {"camera": shown_camera.to_dict(), "warnings": design_warnings(shown_camera, wavelength)}
        facts["capture"] = _origin(capture) if capture else {}
        if fix is not None:
            better = mended(shown_camera, wavelength)
            write_text(fix, better.to_json(), ".json")
            better_facts = better.to_dict().items()
            facts["changed"] = {name: value for name, value in better_facts if facts["camera"].get(name) != value}
            facts["still"] = design_warnings(better, wavelength)
    if drawing is not None:
        # Brings Matplotlib, which takes a while to load.
        from ..report import main_lens_figure

        main_lens_figure(lens, distance, cell).save(drawing, dpi)
    if as_json:
        typer.echo(json.dumps(facts | {"sheet": [row._asdict() for row in rows]}, indent=1))
        return
    console = Console(highlight=False)
    console.print(_table(rows))
    if recorded:
        console.print("[bold]Capture[/bold]")
        for name, fact in facts["capture"].items():
            text = fact if isinstance(fact, str) else json.dumps(fact)
            console.print(f"  {escape(printable(name))}: {escape(printable(text))}", soft_wrap=True)
    for warning in facts.get("warnings", []):
        console.print(f"[bold]Warning:[/bold] {escape(warning)}.", soft_wrap=True)
    if fix is not None:
        changes = ", ".join(f"{name} = {value}" for name, value in facts["changed"].items())
        outcome = f"with {changes}" if changes else "unchanged"
        console.print(f"[bold]Written:[/bold] {escape(f'{fix}, {outcome}')}.", soft_wrap=True)
        for warning in facts["still"]:
            console.print(f"[bold]Still:[/bold] {escape(warning)}.", soft_wrap=True)


def _origin(capture: Capture) -> dict[str, Any]:
    """Return the facts of how a capture was made, as far as its header states them."""
    noise = None if capture.noise is None else f"{capture.relative_noise:.2%} of the mean"
    facts = {"model": capture.model, "wavelength": capture.wavelength, "noise": noise, **capture.metadata}
    return {name: value for name, value in facts.items() if value not in (None, "")}


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


def doctor(as_json: Json = False) -> None:
    """Check the installation: versions, LLVM, Mitsuba variants, threads and GPU.

    Each variant that may work renders a triangle in a process of its own, which takes some seconds. The exit status
    is 0 if captures can be rendered here with the default variant, and 1 if not.
    """
    from ..report import inspect_installation

    installation = inspect_installation()
    if as_json:
        sections = {title: dict(lines) for title, lines in installation.sections.items()}
        facts: dict[str, Any] = {
            "ready": installation.ready,
            "verdict": installation.verdict,
            "problem": installation.problem,
        }
        typer.echo(json.dumps(facts | sections, indent=1))
        raise typer.Exit(0 if installation.ready else 1)
    for title, lines in installation.sections.items():
        typer.echo(f"\n{typer.style(title, bold=True)}")
        for name, value in lines:
            typer.echo(f"  {name:<26} {value}")
    typer.echo()
    if installation.problem:
        typer.echo(f"Problem: {installation.problem}.")
    typer.echo(f"{installation.verdict}.")
    if not installation.ready:
        raise typer.Exit(1)
