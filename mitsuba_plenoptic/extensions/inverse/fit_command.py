"""``mitsuba-plenoptic fit``: camera parameters from captures of known scenes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ... import choices
from ...cli import inputs, options, options_of, stopping
from ...errors import InputError, refuse_if
from ...runtime import progress_bar

if TYPE_CHECKING:
    from .fitting import Fit


def fit(
    captures: list[options.CaptureFile],
    *,
    output: Annotated[Path, options.ends_in(".json")],
    scene: list[str],
    parameter: list[str],
    photons: options.Positive | None = None,
    saturation: options.Positive | None = None,
    mask: Path | None = None,
    camera: options.CameraFile | None = None,
    lattice_from_first: bool = False,
    wavelength: options.Wavelength | None = None,
    points_per_lens: int = 64,
    from_afar: bool = False,
    light: Annotated[dict[str, Any], options_of("extensions.inverse.capture_fit:fit", "model", "accuracy")],
    resume: options.Resume = False,
    unit: choices.Unit = "mm",
    define: options.Definitions = None,
) -> None:
    """Fit a camera's parameters to captures of known scenes, by the wave or the ray model.

    The fit starts from the captures' own camera, or from --camera. Captures made by 'expose' have the noise and
    saturation of their detector. Joint changes of several parameters that hardly change the captures are printed.

    Parameters
    ----------
    captures : CAPTURE.exr...
        Captures of known scenes by one camera.
    output : FILE.json
        File to write: the camera.
    scene
        What each capture shows, in their order: a file or a built-in scene.
    parameter : NAME
        Parameter to fit, such as mla_pitch; repeat for several.
    photons
        Photons counted in a pixel of value 1, for the noise. Default: the noise that 'expose' keeps.
    saturation : VALUE
        Value from which on pixels are left out as saturated. Default: what 'expose' keeps, or none.
    mask : FILE.png
        Picture of the captures' size, not black where pixels are left out.
    lattice_from_first
        Take the lattice's start from the first capture, of white.
    wavelength : NM
        Of waves: wavelength in nanometres. Default: the captures', or 633.
    points_per_lens
        Points of the scene's surfaces for each microlens.
    from_afar
        Fit coarsely first, by rays and blurred captures: lengths some percent off.

    Examples
    --------
    $ mitsuba-plenoptic fit raw.exr --scene letters --photons 2000 --parameter mla_pitch -o camera.json
    """
    import numpy as np

    from ...io import CHECKPOINT_SUFFIX, read_capture, read_picture
    from ...runtime import DEFAULT_VARIANT, require_output
    from ...scene import load_scene
    from . import fitting
    from .point_rays import vector_of

    if len(scene) != len(captures):
        raise typer.BadParameter(f"{len(captures)} captures and {len(scene)} scenes", param_hint="--scene")
    require_output(output, *captures, mask)
    read = [read_capture(path) for path in captures]
    noises = [fitting.noise_of(capture) for capture in read]
    for path, (noise, _) in zip(captures, noises, strict=True):
        refuse_if(
            noise is None and photons is None, f"{path}: it keeps no noise, as 'expose' has not made it; give --photons"
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
    if lattice_from_first:
        first = fitting.lattice_from_white(first, read[0].image)
    wavelength_of_all = wavelength or read[0].wavelength or 633.0
    if isinstance(wavelength_of_all, tuple):
        raise InputError(f"{captures[0]}: it has several wavelengths; a camera is fitted to captures of one")
    # Light is found below, which takes much longer than seeing what is asked for.
    vector_of(first, parameter)
    views = []
    for name, capture, (noise, full) in zip(scene, read, noises, strict=True):
        loaded = load_scene(name, variant=DEFAULT_VARIANT, parameters=inputs.parse_definitions(define), unit=unit)
        inputs.require_in_use(name, inputs.parse_definitions(define))
        view = fitting.known_view(
            capture.image,
            loaded,
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
        if from_afar:
            with progress_bar("Coarse fit") as progress, stopping.resumable(progress, coarse):
                first = fitting.coarse_fit(
                    first, views, parameter, wavelength=wavelength_of_all, progress=progress, checkpoint=coarse
                )
        with progress_bar("Cameras") as progress, stopping.resumable(progress, steps):
            result = fitting.fit(
                first,
                views,
                parameter,
                wavelength=wavelength_of_all,
                photons=photons,
                **light,
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
    # Directions that are printed: the worst determined.
    for direction in result.directions[:3] if len(result.values) > 1 else ():
        parts = sorted(direction.parts.items(), key=lambda component: -abs(component[1]))
        terms = ", ".join(f"{component:+.2f} {name}" for name, component in parts if abs(component) > 0.1)
        typer.echo(f"determined to {direction.deviation:.2g}: {terms}")
    typer.echo(f"{output}: the fitted camera")
