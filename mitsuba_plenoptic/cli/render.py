"""``mitsuba-plenoptic render``: from a scene to a capture."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from ..capture.estimate import estimate_capture
from ..capture.render import render_capture
from ..capture.scene import load_scene
from ..io.captures import write_capture
from ..io.checkpoints import SUFFIX, Checkpoint
from ..io.files import remove_leftovers, require_writable
from .inputs import batches_on, named_camera, parse_definitions, require_capture_output
from .options import (
    CameraFile,
    Definitions,
    Model,
    RadiatorsPerLens,
    Resume,
    Samples,
    Scene,
    Scheduler,
    Seed,
    Variant,
    Workers,
    number,
    output_option,
)
from .terminal import progress_bar


def render(
    scene: Scene,
    output: Annotated[Path | None, output_option("FILE.exr", "File to write; not needed with --estimate.")] = None,
    model: Model = None,
    spp: Samples = None,
    seed: Seed = 0,
    wavelength: Annotated[
        str | None,
        number(
            "By waves: wavelength in nanometres; for a variant of three channels three, as 611,549,464.",
            "the scene's, else 633",
            unit="NM",
        ),
    ] = None,
    radiators_per_lens: RadiatorsPerLens = None,
    noise: Annotated[
        bool,
        typer.Option("--noise", help="Keep the standard deviation of each pixel, too, as layer 'noise' of the file."),
    ] = False,
    estimate: Annotated[
        bool, typer.Option("--estimate", help="Print what it would take, after a few seconds, and stop.")
    ] = False,
    resume: Resume = False,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            show_default="FILE.exr.checkpoint",
            help="By waves: where to keep what is done until the capture is written.",
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    define: Definitions = None,
    camera: CameraFile = None,
    variant: Variant = None,
) -> None:
    """Render what a scene's plenoptic camera records.

    The scene needs a sensor of type [bold]plenoptic[/bold]. The capture is
    written as float32 OpenEXR, which any EXR viewer shows; its header holds
    the camera and how it was made. A long wave capture keeps a checkpoint
    beside the output, from which [bold]--resume[/bold] goes on after a crash.

    [bold]Examples:[/bold]

      mitsuba-plenoptic render letters -o raw.exr --spp 16

      mitsuba-plenoptic render letters -o wave.exr --model wave

      mitsuba-plenoptic render letters -o small.exr -D resolution=1024

      mitsuba-plenoptic render still_life --model wave --estimate

      mitsuba-plenoptic render letters -o wave.exr --model wave --resume

      mitsuba-plenoptic render my_scene.xml -o colour.exr --variant llvm_ad_rgb

      mitsuba-plenoptic render letters -o raw.exr --camera camera.json
    """
    parameters = parse_definitions(define)
    chosen = named_camera(camera)
    options = {"wavelength": wavelength, "radiators_per_lens": radiators_per_lens}
    wave = {name: value for name, value in options.items() if value is not None}
    if estimate:
        with batches_on(workers, scheduler) as batch_map:
            loaded = load_scene(scene, variant=variant, parameters=parameters, camera=chosen)
            cost = estimate_capture(loaded, model=model, spp=spp, seed=seed, batch_map=batch_map, **wave)
        what = f"{cost.radiators} radiators, {cost.patterns} point spreads, " if cost.radiators else ""
        typer.echo(f"{scene}: {what}about {cost.seconds:.3g} s and {cost.memory / 2**30:.2g} GiB")
        return
    if output is None:
        raise typer.BadParameter("name the file to write, or ask for an --estimate", param_hint="--output")
    # Before the rendering, which may take long.
    require_capture_output(output)
    if resume:
        remove_leftovers(output)
    checkpoint = require_writable(checkpoint or output.with_name(output.name + SUFFIX))
    with Checkpoint(checkpoint, "resume" if resume else "refuse") as kept, batches_on(workers, scheduler) as batch_map:
        loaded = load_scene(scene, variant=variant, parameters=parameters, camera=chosen)
        start = time.perf_counter()
        with progress_bar("Rendering") as progress:
            capture = render_capture(
                loaded,
                model=model,
                spp=spp,
                seed=seed,
                progress=progress,
                checkpoint=kept,
                batch_map=batch_map,
                noise=noise,
                **wave,
            )
        seconds = time.perf_counter() - start
        write_capture(output, capture)
    rows, columns = capture.camera.shape
    deviation = "" if capture.noise is None else f", noise {capture.relative_noise:.2%} of the mean"
    typer.echo(f"{output}: capture of {columns} x {rows} pixels, rendered in {seconds:.1f} s{deviation}")
