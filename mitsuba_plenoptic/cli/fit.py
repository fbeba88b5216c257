"""``mitsuba-plenoptic fit``: a camera from captures of known scenes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..capture.scene import load_scene
from ..errors import InputError, require_number
from ..io.captures import read_capture
from ..io.checkpoints import SUFFIX, Checkpoint
from ..io.files import atomic_output, require_apart, require_writable
from ..runtime.progress import progress_bar
from ..runtime.variant import DEFAULT_VARIANT
from .inputs import named_camera, parse_definitions
from .options import CameraFile, Definitions, number, output_option
from .terminal import stopped_by_hand

if TYPE_CHECKING:
    from ..fitting import Fit

# Directions that are printed: the worst told.
_NAMED = 3


def fit(
    captures: Annotated[
        list[Path], typer.Argument(metavar="CAPTURE.exr...", help="Captures of known scenes by one camera.")
    ],
    output: Annotated[Path, output_option("FILE.json", "File to write: the camera.")],
    scenes: Annotated[
        list[str], typer.Option("--scene", help="What each capture shows, in their order: a file or a built-in scene.")
    ],
    names: Annotated[
        list[str], typer.Option("--number", metavar="NAME", help="What is fitted, such as mla_pitch; one or several.")
    ],
    photons: Annotated[float, number("Photons of a pixel of value 1: they tell the noise.")],
    camera: CameraFile = None,
    start: Annotated[
        bool, typer.Option("--lattice-from-first", help="Take the lattice's start from the first capture, of white.")
    ] = False,
    wavelength: Annotated[float | None, number("Wavelength.", "the captures', or 633", unit="NM")] = None,
    radiators: Annotated[
        int, typer.Option("--radiators-per-lens", metavar="N", help="Radiators per microlens and axis.")
    ] = 8,
    afar: Annotated[
        bool,
        typer.Option("--from-afar", help="Come near first, by rays with blurred captures: lengths some percent off."),
    ] = False,
    method: Annotated[
        str, typer.Option(metavar="waves|rays", help="How light goes through the camera; rays know no diffraction.")
    ] = "waves",
    accuracy: Annotated[float, number("Error that is allowed for speed, by waves; 0: none.")] = 0.0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the checkpoint of a fit that was stopped.")
    ] = False,
    define: Definitions = None,
) -> None:
    """Fit a camera's numbers to captures of known scenes, by waves or by rays.

    It starts from the captures' own camera, or from --camera. What cannot be
    told apart is printed: changes of several numbers at once that hardly
    change the captures.

    [bold]Example:[/bold]

      mitsuba-plenoptic fit raw.exr --scene letters --photons 2000 --number mla_pitch -o camera.json
    """
    from .. import fitting

    if len(scenes) != len(captures):
        raise typer.BadParameter(f"{len(captures)} captures and {len(scenes)} scenes", param_hint="--scene")
    require_apart(require_writable(output, ".json"), *captures)
    read = [read_capture(path) for path in captures]
    first = named_camera(camera) or read[0].camera
    if start:
        first = fitting.lattice_from_white(first, read[0].image)
    known = wavelength or read[0].wavelength or 633.0
    if isinstance(known, tuple):
        raise InputError(f"{captures[0]}: it has several wavelengths; a camera is fitted to captures of one")
    # Light is found below, which takes much longer than seeing what is asked for.
    fitting.model.numbers_of(first, names)
    require_number("photons", photons, positive=True)
    views = []
    for name, capture in zip(scenes, read, strict=True):
        scene = load_scene(name, variant=DEFAULT_VARIANT, parameters=parse_definitions(define))
        view = fitting.known_view(capture.image, scene, first, wavelength=known, radiators_per_lens=radiators)
        views.append(view)
    checkpoint = require_writable(output.with_name(output.name + SUFFIX))
    with Checkpoint(checkpoint, "resume" if resume else "refuse") as kept:
        with progress_bar("Cameras") as progress, stopped_by_hand(kept, progress):
            if afar and not resume:
                first = fitting.come_near(first, views, names, wavelength=known, progress=progress)
            found = fitting.fit(
                first,
                views,
                names,
                wavelength=known,
                photons=photons,
                method=method,
                accuracy=accuracy,
                progress=progress,
                checkpoint=kept,
            )
        _write(output, found)


def _write(output: Path, found: Fit) -> None:
    """Write the camera, and print what is known of it."""
    with atomic_output(output, ".json") as temporary:
        temporary.write_text(found.camera.to_json())
    for name, value in found.values.items():
        typer.echo(f"{name} = {value:.8g} +- {found.deviations[name]:.2g}")
    typer.echo(f"chi-square per pixel {found.chi_square:.4g}, {found.steps} cameras tried")
    for direction in found.directions[:_NAMED] if len(found.values) > 1 else ():
        parts = sorted(direction.parts.items(), key=lambda part: -abs(part[1]))
        terms = ", ".join(f"{part:+.2f} {name}" for name, part in parts if abs(part) > 0.1)
        typer.echo(f"told to {direction.deviation:.2g}: {terms}")
    typer.echo(f"{output}: the fitted camera")
