"""``mitsuba-plenoptic render``: from a scene to a capture."""

from __future__ import annotations

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from ..capture.estimate import estimate_capture
from ..capture.render import is_wave_capture, refuse_by_rays, render_capture
from ..errors import InputError
from ..io.captures import Capture, write_capture
from ..io.checkpoints import SUFFIX, Checkpoint
from ..io.files import remove_leftovers, require_different, require_writable
from ..io.ground_truth import NAME, QUANTITIES, require_quantities, truth_path, write_ground_truth
from ..runtime.progress import progress_bar
from .inputs import (
    CameraFile,
    Definitions,
    Model,
    Resume,
    Samples,
    Scene,
    Scheduler,
    Seed,
    Workers,
    batches_on,
    number,
    open_scene,
    output_option,
    parse_definitions,
)
from .terminal import stopped_by_hand


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
    method: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            show_default="the scene's, else signed_rays",
            help="By waves: signed_rays, which takes the rays of a ray capture, or points, the plain reference for "
            "matte scenes, with --spp points for each microlens.",
        ),
    ] = None,
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
    camera: CameraFile = None,
    sensor: Annotated[int, number("Which of the scene's sensors, counted from 0.")] = 0,
    white: Annotated[
        Path | None,
        typer.Option(metavar="FILE.exr", help="Write the camera's white image, too, computed from its parameters."),
    ] = None,
    aov: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,NAME,...",
            help="Also write ground truth, next to the capture, as FILE.truth.exr, of each pixel and of each decoded "
            f"view: {', '.join(QUANTITIES)}.",
        ),
    ] = None,
    define: Definitions = None,
    variant: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            show_default="llvm_ad_rgb if the film records rgb, else llvm_ad_mono",
            help="Mitsuba variant, for example llvm_ad_rgb or cuda_ad_mono.",
        ),
    ] = None,
) -> None:
    """Render what a scene's plenoptic camera records.

    The scene needs a sensor of type [bold]plenoptic[/bold]. The capture is
    written as float32 OpenEXR, which any EXR viewer shows; its header holds
    the camera and how it was made. A long wave capture keeps a checkpoint
    next to the output, from which [bold]--resume[/bold] continues after Ctrl-C or a crash.

    [bold]Examples:[/bold]

      mitsuba-plenoptic render letters -o raw.exr --spp 16

      mitsuba-plenoptic render letters -o wave.exr --model wave

      mitsuba-plenoptic render letters -o wave.exr --model wave --method signed_rays --spp 16

      mitsuba-plenoptic render letters -o small.exr -D resolution=1024

      mitsuba-plenoptic render still_life --model wave --estimate

      mitsuba-plenoptic render letters -o wave.exr --model wave --resume

      mitsuba-plenoptic render my_scene.xml -o raw.exr --camera lytro --white white.exr

      mitsuba-plenoptic render letters -o raw.exr --camera camera.json

      mitsuba-plenoptic render still_life -o raw.exr --aov depth,normal,shape_index
    """
    parameters = parse_definitions(define)
    options = {"wavelength": wavelength, "method": method}
    wave = {name: value for name, value in options.items() if value is not None}
    if estimate:
        refused = {"noise": noise, "resume": resume, "checkpoint": checkpoint, "white": white, "aov": aov}
        for name in (name for name, value in refused.items() if value):
            raise InputError(f"--{name}: an estimate does not take it; leave it out")
        with progress_bar("Estimating"):
            loaded = open_scene(scene, parameters, variant, camera, sensor)
            if not is_wave_capture(loaded, model):
                refuse_by_rays(workers=workers, scheduler=scheduler)
            with batches_on(workers, scheduler) as batch_map:
                cost = estimate_capture(
                    loaded, sensor=sensor, model=model, spp=spp, seed=seed, batch_map=batch_map, **wave
                )
        what = f"{cost.points} points, {cost.patterns} point spreads, " if cost.points else ""
        typer.echo(f"{scene}: {what}about {cost.seconds:.3g} s and {cost.memory / 2**30:.2g} GiB")
        return
    if output is None:
        raise typer.BadParameter("name the file to write, or ask for an --estimate", param_hint="--output")
    # Before the rendering, which may take long.
    names = None if aov is None else require_quantities(name.strip() for name in aov.split(","))
    for path in filter(None, (output, white)):
        require_writable(path, ".exr")
    truth_file = require_writable(truth_path(output))
    require_different(output, white, truth_file if names else None)
    saved = Checkpoint(
        require_writable(checkpoint or output.with_name(output.name + SUFFIX)), "resume" if resume else "refuse"
    )
    with progress_bar("Loading the scene"):
        loaded = open_scene(scene, parameters, variant, camera, sensor)
    if resume:
        remove_leftovers(output)
    by_waves = is_wave_capture(loaded, model)
    if not by_waves:
        refuse_by_rays(resume=resume or None, checkpoint=checkpoint, workers=workers, scheduler=scheduler)
    with saved if by_waves else nullcontext(), batches_on(workers, scheduler) as batch_map:
        with progress_bar("Rendering") as progress, stopped_by_hand(saved, progress) if by_waves else nullcontext():
            start = time.perf_counter()
            capture = render_capture(
                loaded,
                sensor=sensor,
                model=model,
                spp=spp,
                seed=seed,
                progress=progress,
                checkpoint=saved if by_waves else None,
                batch_map=batch_map,
                noise=noise,
                **wave,
            )
        seconds = time.perf_counter() - start
        if names:
            # Brings libraries that take a second to load.
            from ..lightfield import ground_truth

            write_ground_truth(truth_file, ground_truth(loaded, names, sensor=sensor))
            capture.metadata[NAME] = truth_file.name
            typer.echo(f"{truth_file}: ground truth, {', '.join(names)}")
        write_capture(output, capture)
    if white:
        # Brings libraries that take a second to load.
        from ..lightfield import white_image

        write_capture(white, Capture(white_image(capture.camera), capture.camera, metadata={"scene": "white image"}))
        typer.echo(f"{white}: white image")
    rows, columns = capture.camera.shape
    deviation = "" if capture.noise is None else f", noise {capture.relative_noise:.2%} of the mean"
    typer.echo(f"{output}: capture of {columns} x {rows} pixels, rendered in {seconds:.1f} s{deviation}")
