"""``mitsuba-plenoptic fit``: camera parameters from captures of known scenes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ... import choices
from ...cli import inputs, options, stopping
from ...errors import InputError, refuse_if, require_number
from ...runtime import progress_bar

if TYPE_CHECKING:
    from .fitting import Fit

# Directions that are printed: the worst determined.
_NAMED = 3


def fit(
    captures: Annotated[
        list[Path],
        typer.Argument(
            metavar="CAPTURE.exr...", help="Captures of known scenes by one camera.", callback=options.RECORDING
        ),
    ],
    output: Annotated[Path, options.output_option("FILE.json", "File to write: the camera.", ".json")],
    scenes: Annotated[
        list[str], typer.Option("--scene", help="What each capture shows, in their order: a file or a built-in scene.")
    ],
    names: Annotated[
        list[str],
        typer.Option("--parameter", metavar="NAME", help="Parameter to fit, such as mla_pitch; repeat for several."),
    ],
    photons: Annotated[
        float | None,
        options.numeric(
            "Photons counted in a pixel of value 1, for the noise.",
            "the noise that 'expose' keeps",
            check=partial(require_number, positive=True),
        ),
    ] = None,
    saturation: Annotated[
        float | None,
        options.numeric(
            "Value from which on pixels are left out as saturated.",
            "what 'expose' keeps, or none",
            unit="VALUE",
            check=partial(require_number, positive=True),
        ),
    ] = None,
    mask: Annotated[
        Path | None,
        typer.Option(metavar="FILE.png", help="Picture of the captures' size, not black where pixels are left out."),
    ] = None,
    camera: options.CameraFile = None,
    start: Annotated[
        bool, typer.Option("--lattice-from-first", help="Take the lattice's start from the first capture, of white.")
    ] = False,
    wavelength: Annotated[float | None, options.wavelength_option("the captures', or 633")] = None,
    points_per_lens: Annotated[
        int, typer.Option(metavar="N", help="Points of the scene's surfaces for each microlens.")
    ] = 64,
    afar: Annotated[
        bool,
        typer.Option(
            "--from-afar",
            help="Fit coarsely first, by rays and blurred captures: lengths some percent off.",
        ),
    ] = False,
    model: Annotated[
        choices.Model, typer.Option(help="How light propagates; the ray model has no diffraction.")
    ] = "wave",
    accuracy: Annotated[float, options.numeric("Tolerated error of the wave model, for speed; 0: none.")] = 0.0,
    resume: options.Resume = False,
    unit: options.Unit = "mm",
    define: options.Definitions = None,
) -> None:
    """Fit a camera's parameters to captures of known scenes, by the wave or the ray model.

    The fit starts from the captures' own camera, or from --camera. Captures made by 'expose' have the noise and
    saturation of their detector. Joint changes of several parameters that hardly change the captures are printed.

    [bold]Example:[/bold]

      mitsuba-plenoptic fit raw.exr --scene letters --photons 2000 --parameter mla_pitch -o camera.json
    """
    import numpy as np

    from ...io import CHECKPOINT_SUFFIX, read_capture, read_picture
    from ...runtime import DEFAULT_VARIANT, require_apart, require_writable
    from ...scene import load_scene
    from . import fitting
    from .point_rays import vector_of

    if len(scenes) != len(captures):
        raise typer.BadParameter(f"{len(captures)} captures and {len(scenes)} scenes", param_hint="--scene")
    require_apart(require_writable(output), *captures, mask)
    read = [read_capture(path) for path in captures]
    noises = [fitting.noise_of(capture) for capture in read]
    for path, (noise, _) in zip(captures, noises, strict=True):
        refuse_if(
            noise is None and photons is None,
            f"{path}: it keeps no noise, as 'expose' has not made it; give --photons",
        )
        if noise is not None and photons is not None:
            raise InputError(
                f"photons = {photons:g}: {path} keeps the noise that 'expose' gave it; leave out --photons"
            )
    left_out = None if mask is None else np.atleast_3d(read_picture(mask)).any(-1)
    for path, capture in zip(captures, read, strict=True):
        if left_out is not None and left_out.shape != capture.camera.shape:
            raise InputError(
                f"{mask}: it has {left_out.shape} pixels, {path} {capture.camera.shape}: give one mask for all"
            )
    first = inputs.named_camera(camera) or read[0].camera
    first.require_array("fit")
    if start:
        first = fitting.lattice_from_white(first, read[0].image)
    wavelength_of_all = wavelength or read[0].wavelength or 633.0
    if isinstance(wavelength_of_all, tuple):
        raise InputError(f"{captures[0]}: it has several wavelengths; a camera is fitted to captures of one")
    # Light is found below, which takes much longer than seeing what is asked for.
    vector_of(first, names)
    views = []
    for name, capture, (noise, full) in zip(scenes, read, noises, strict=True):
        scene = load_scene(name, variant=DEFAULT_VARIANT, parameters=inputs.parse_definitions(define), unit=unit)
        inputs.require_in_use(name, inputs.parse_definitions(define))
        view = fitting.known_view(
            capture.image,
            scene,
            first,
            wavelength=wavelength_of_all,
            points_per_lens=points_per_lens,
            noise=noise,
            mask=left_out,
            saturation=full if saturation is None else saturation,
        )
        views.append(view)
    # The coarse fit's stays until the end, as the fine fit starts, and has its bounds, from there.
    coarse = stopping.checkpoint_of(output, resume, output.with_name(f"{output.name}.coarse{CHECKPOINT_SUFFIX}"))
    with coarse, stopping.checkpoint_of(output, resume) as steps:
        if afar:
            with progress_bar("Coarse fit") as progress, stopping.resumable(progress, coarse):
                first = fitting.coarse_fit(
                    first, views, names, wavelength=wavelength_of_all, progress=progress, checkpoint=coarse
                )
        with progress_bar("Cameras") as progress, stopping.resumable(progress, steps):
            result = fitting.fit(
                first,
                views,
                names,
                wavelength=wavelength_of_all,
                photons=photons,
                model=model,
                accuracy=accuracy,
                progress=progress,
                checkpoint=steps,
            )
        _write(output, result)


def _write(output: Path, result: Fit) -> None:
    """Write the camera's file, and print parameters, deviations and warnings of the fit."""
    from ...runtime import write_text

    write_text(output, result.camera.to_json(), ".json")
    for name, value in result.values.items():
        side = result.at_bounds.get(name)
        at_bound = f", at its {side}: the deviation is one-sided" if side else ""
        typer.echo(f"{name} = {value:.8g} +- {result.deviations[name]:.2g}{at_bound}")
    typer.echo(
        f"chi-square per pixel {result.chi_square:.4g} +- {result.chi_square_deviation:.2g} over {result.pixels} "
        f"pixels, {result.steps} cameras tried"
    )
    for direction in result.directions[:_NAMED] if len(result.values) > 1 else ():
        parts = sorted(direction.parts.items(), key=lambda component: -abs(component[1]))
        terms = ", ".join(f"{component:+.2f} {name}" for name, component in parts if abs(component) > 0.1)
        typer.echo(f"determined to {direction.deviation:.2g}: {terms}")
    typer.echo(f"{output}: the fitted camera")
