"""Print what follows from the parameters of a camera, or of a main lens by itself.

Nothing is rendered. A file, or a name, is taken for what it holds: 'info lens.zmx' is 'info lens lens.zmx', 'info
letters' is 'info camera letters'.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..choices import RAW_SUFFIXES, Unit
from ..errors import InputError, printable, refuse_if, require_number
from . import options
from .inputs import load_camera, parse_definitions, refuse_options, require_png

if TYPE_CHECKING:
    from rich.console import Console

    from ..report import Row


def kind_of(words: Sequence[str]) -> str:
    """Return the command that is for what words after ``info`` name: ``lens`` for the file of one, else ``camera``."""
    return "lens" if any(_is_lens(word) for word in words) else "camera"


def _is_lens(source: str) -> bool:
    from ..extension import format_of
    from ..runtime import read_yaml

    suffix = Path(source).suffix.lower()
    # What is wrong with a file is said by the command.
    with contextlib.suppress(InputError, TypeError, OSError):
        if suffix in (".yaml", ".yml", ".json"):
            return "surfaces" in read_yaml(source)
        return Path(source).is_file() and format_of(suffix, "lens", source) is not None
    return False


def camera(
    source: Annotated[str, options.CAMERA],
    *,
    wavelength: options.Wavelength | None = None,
    drawing: Path | None = None,
    microlens: Path | None = None,
    fix: Path | None = None,
    dpi: options.Dpi | None = None,
    unit: Unit = "mm",
    as_json: options.Json = False,
    define: options.Definitions = None,
) -> None:
    """Print what follows from a camera's parameters, and warnings about its design.

    For a capture, the way it was made is printed too. Warnings name their remedies, which --fix applies.

    Parameters
    ----------
    source : SCENE|PRESET|CAMERA.json|NAME=VALUE,...|CAPTURE.exr
        A Mitsuba XML file, the name of a built-in scene or a preset, a camera's file or parameters, as for --camera of
        'render', a capture, or a raw picture of a Lytro camera.
    wavelength
        Of waves: wavelength in nanometres. Default: the capture's.
    drawing : FILE
        Draw the main_lens with rays, spots, light and distortion over the field, as .png or .pdf. Default: none.
    microlens : FILE.png
        Draw a microlens: its phase, a section with rays, and its spot. Default: none.
    fix : FILE.json
        Write the camera that the fewest of the changes which the warnings name make of this one. Default: none.

    Examples
    --------
    $ mitsuba-plenoptic info letters --wavelength 633
    $ mitsuba-plenoptic info camera.json --drawing lens.png
    $ mitsuba-plenoptic info camera.json --fix better.json
    """
    from ..extension import format_of
    from ..io import read_capture
    from ..runtime import require_writable, write_text

    for path, *suffixes in ((fix, ".json"), (drawing, ".png", ".pdf"), (microlens, ".png", ".pdf")):
        if path is not None:
            require_writable(path, *suffixes)
    parameters = parse_definitions(define)
    suffix = Path(source).suffix.lower()
    recorded = suffix in (".exr", *RAW_SUFFIXES) or format_of(suffix, "capture", source) is not None
    if recorded:
        refuse_options(f"{source} is no scene, and", unit=unit != "mm", D=parameters)
    require_png(dpi, drawing, microlens)
    # Bring libraries that take seconds to load.
    from ..design import design_warnings, mended
    from ..lenses import main_lens
    from ..report import design_sheet

    capture = read_capture(source) if recorded else None
    subject = capture.camera if capture else load_camera(source, parameters, unit)[0]
    if capture and wavelength is None and isinstance(capture.wavelength, float):
        wavelength = capture.wavelength
    if microlens is not None:
        # Brings Matplotlib, which takes a while to load, as does the other drawing.
        from ..report import microlens_figure

        subject.require_array(str(microlens))
        microlens_figure(subject, wavelength).save(microlens, dpi)
    if drawing is not None:
        refuse_if(
            subject.prescription is None, f"{drawing}: the camera has no main_lens of surfaces that could be drawn"
        )
        from ..report import main_lens_figure

        cell = subject.row_pitch if subject.has_array else 0.0
        main_lens_figure(main_lens(subject), subject.focus_distance, cell).save(drawing, dpi)
    facts: dict[str, Any] = {"camera": subject.to_dict(), "warnings": design_warnings(subject, wavelength)}
    facts["capture"] = {}
    if capture is not None:
        # How it was made, as far as its header states it.
        noise = None if capture.noise is None else f"{capture.relative_noise:.2%} of the mean"
        stated = {"model": capture.model, "wavelength": capture.wavelength, "noise": noise, **capture.metadata}
        facts["capture"] = {name: value for name, value in stated.items() if value not in (None, "")}
    if fix is not None:
        better = mended(subject, wavelength)
        write_text(fix, better.to_json(), ".json")
        better_facts = better.to_dict().items()
        facts["changed"] = {name: value for name, value in better_facts if facts["camera"].get(name) != value}
        facts["still"] = design_warnings(better, wavelength)
    console = _shown(facts, design_sheet(subject, wavelength), as_json)
    if console is None:
        return
    from rich.markup import escape

    if recorded:
        console.print("[bold]Capture[/bold]")
        for name, fact in facts["capture"].items():
            text = fact if isinstance(fact, str) else json.dumps(fact)
            console.print(f"  {escape(printable(name))}: {escape(printable(text))}", soft_wrap=True)
    for warning in facts["warnings"]:
        console.print(f"[bold]Warning:[/bold] {escape(warning)}.", soft_wrap=True)
    if fix is not None:
        changes = ", ".join(f"{name} = {value}" for name, value in facts["changed"].items())
        outcome = f"with {changes}" if changes else "unchanged"
        console.print(f"[bold]Written:[/bold] {escape(f'{fix}, {outcome}')}.", soft_wrap=True)
        for warning in facts["still"]:
            console.print(f"[bold]Still:[/bold] {escape(warning)}.", soft_wrap=True)


def lens(
    source: options.Existing,
    *,
    pupil: options.Positive | None = None,
    f_number: options.Positive | None = None,
    field: Annotated[list[float], options.checked(partial(require_number, minimum=0, maximum=85))] | None = None,
    drawing: Path | None = None,
    dpi: options.Dpi | None = None,
    as_json: options.Json = False,
) -> None:
    """Print spots and modulation transfer functions of a main lens, at the fields and wavelengths of its file.

    Parameters
    ----------
    source : LENS.zmx|LENS.seq|LENS.yaml
        The file of a lens.
    pupil
        Diameter in millimetres of its entrance pupil. Default: the file's.
    f_number
        Its f-number, instead. Default: the file's.
    field
        Angle in degrees from the axis; repeat for several. One or two stand for 0, 0.7 and 1 times the largest.
        Default: the file's.
    drawing : FILE
        Draw the lens with rays, spots, light and distortion over the field, as .png or .pdf. Default: none.

    Examples
    --------
    $ mitsuba-plenoptic info lens lens.zmx --f-number 4 --field 14
    """
    from ..runtime import require_writable

    refuse_if(pupil and f_number, "--pupil, --f-number: give one of the two")
    if drawing is not None:
        require_writable(drawing, ".png", ".pdf")
    require_png(dpi, drawing)
    # Bring libraries that take seconds to load.
    from ..prescription import read_prescription
    from ..report import behind_lens, lens_sheet

    prescription = read_prescription(source)
    try:
        if f_number is not None:
            pupil = prescription.paraxial.focal_length / f_number
        real_lens, distance, heights = behind_lens(prescription, pupil or 0.0, field or [])
        rows = lens_sheet(real_lens, distance, heights)
    except InputError as error:
        raise InputError(f"{source}: {str(error).removeprefix('main_lens: ')}") from None
    if drawing is not None:
        # Brings Matplotlib, which takes a while to load.
        from ..report import main_lens_figure

        main_lens_figure(real_lens, distance).save(drawing, dpi)
    _shown({"lens": prescription.to_plain()}, rows, as_json)


def _shown(facts: dict[str, Any], rows: list[Row], as_json: bool) -> Console | None:
    """Print rows as a table, and return the console for what follows it; or print them as JSON with the other facts."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if as_json:
        typer.echo(json.dumps(facts | {"sheet": [row._asdict() for row in rows]}, indent=1))
        return None
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column()
    table.add_column(justify="right", overflow="fold")
    table.add_column()
    table.add_column(overflow="fold")
    for group, members in groupby(rows, key=lambda row: row.group):
        table.add_row(f"[bold]{escape(group)}[/bold]")
        for row in members:
            table.add_row(f"  {row.quantity}", escape(row.value), row.unit, f"[dim]{escape(row.note)}[/dim]")
    console = Console(highlight=False)
    console.print(table)
    return console
