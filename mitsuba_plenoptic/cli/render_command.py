"""``mitsuba-plenoptic render`` and ``expose``: captures of scenes, and what a real detector records."""

import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from ..choices import RAW_SUFFIXES, Model, Unit
from ..runtime import progress_bar
from . import options
from .inputs import batches_on, open_scene, parse_definitions, refuse_options
from .signatures import options_of
from .stopping import checkpoint_of, resumable


def render(
    scene: options.Scene,
    *,
    output: Annotated[Path, options.ends_in(".exr")] | None = None,
    model: Model | None = None,
    spp: options.Count | None = None,
    seed: options.Seed = 0,
    wavelength: options.Wavelengths | None = None,
    bandwidth: float | None = None,
    responses: str | None = None,
    method: str | None = None,
    noise: bool = False,
    estimate: options.Estimate = False,
    resume: options.Resume = False,
    checkpoint: Annotated[Path, options.ends_in()] | None = None,
    workers: options.Workers | None = None,
    scheduler: options.Scheduler | None = None,
    camera: options.CameraFile | None = None,
    unit: Unit = "mm",
    sensor: int = 0,
    white: Annotated[Path, options.ends_in(".exr")] | None = None,
    aov: str | None = None,
    define: options.Definitions = None,
    variant: options.Variant | None = None,
) -> None:
    """Render what a scene's plenoptic camera records.

    The scene needs a sensor of type [bold]plenoptic[/bold]. The capture is written as float32 OpenEXR, which any EXR
    viewer shows; its header holds the camera and how it was made. A long wave capture keeps a checkpoint next to the
    output, from which the same command continues after Ctrl-C or a crash.

    Parameters
    ----------
    output : FILE.exr
        File to write; not needed with --estimate.
    wavelength : NM
        Wave captures: wavelength in nanometres; for a variant of three channels three, as 611,549,464. Default: the
        scene's, else 633.
    bandwidth : NM
        Wave captures: width of a flat band around each wavelength. Default: one wavelength.
    responses : srgb|FILE.csv
        Wave captures, instead of a wavelength: responses of the film's channels, those of sRGB or a table of
        wavelengths and one or three responses. Default: the scene's; srgb for films of colours in spectral variants.
    method : NAME
        Wave captures: signed_rays, which takes the rays of a ray capture, or points, the plain reference for matte
        scenes, with --spp points for each microlens. Default: the scene's, else signed_rays.
    noise
        Keep the standard deviation of each pixel, too, as layer 'noise' of the file.
    checkpoint : FILE
        Wave captures: file for what is done until the capture is written. Default: FILE.exr.checkpoint.
    sensor
        Which of the scene's sensors, counted from 0; the one that --camera replaces.
    white : FILE.exr
        Write the camera's white image, too, by the capture's model of light and at its wavelengths.
    aov : NAME,NAME,...
        Also write ground truth, next to the capture, as FILE.truth.exr, of each pixel and of each decoded view:
        depth, virtual_depth, position, normal, albedo, shape_index.
    variant : NAME
        Mitsuba variant, for example llvm_ad_rgb or cuda_ad_mono. Default: llvm_ad_rgb if the film records rgb, else
        llvm_ad_mono.

    Examples
    --------
    $ mitsuba-plenoptic render letters -o raw.exr --spp 16
    $ mitsuba-plenoptic render letters -o wave.exr --model wave
    $ mitsuba-plenoptic render still_life --model wave --estimate
    $ mitsuba-plenoptic render my_scene.xml -o raw.exr --camera lytro --white white.exr
    $ mitsuba-plenoptic render still_life -o raw.exr --aov depth,normal,shape_index
    """
    if output is None and not estimate:
        raise typer.BadParameter("name the file to write, or ask for an --estimate", param_hint="--output")
    from ..io import TRUTH_NAME, require_quantities, truth_path, write_capture, write_ground_truth
    from ..runtime import remove_leftovers, require_different, require_writable

    names = None if aov is None else require_quantities(name.strip() for name in aov.split(","))
    from ..scene import estimate_capture, is_wave_capture, refuse_by_rays, render_capture

    parameters = parse_definitions(define)
    replaced = sensor
    sensor = 0 if camera else sensor
    options = {"wavelength": wavelength, "bandwidth": bandwidth, "responses": responses, "method": method}
    wave = {name: value for name, value in options.items() if value is not None}
    if estimate:
        refuse_options("an estimate", noise=noise, resume=resume, checkpoint=checkpoint, white=white, aov=aov)
        with progress_bar("Estimating") as progress:
            loaded = open_scene(scene, parameters, variant, camera, replaced, unit)
            progress(1, 2)
            if not is_wave_capture(loaded, model):
                refuse_by_rays(workers=workers, scheduler=scheduler)
            with batches_on(workers, scheduler) as batch_map:
                cost = estimate_capture(
                    loaded, sensor=sensor, model=model, spp=spp, seed=seed, batch_map=batch_map, **wave
                )
        typer.echo(f"{scene}: about {cost.seconds:.3g} s and {cost.memory / 2**30:.2g} GiB")
        if hint := _shorter(loaded, sensor, spp, method):
            typer.echo(hint)
        return
    assert output is not None
    for path in filter(None, (output, white)):
        require_writable(path)
    truth_file = require_writable(truth_path(output)) if names else None
    require_different(output, white, truth_file)
    with progress_bar("Loading the scene"):
        loaded = open_scene(scene, parameters, variant, camera, replaced, unit)
    remove_leftovers(output)
    by_waves = is_wave_capture(loaded, model)
    if not by_waves:
        refuse_by_rays(resume=resume or None, checkpoint=checkpoint, workers=workers, scheduler=scheduler)
    saved = checkpoint_of(output, resume, checkpoint) if by_waves else None
    with saved or nullcontext(), batches_on(workers, scheduler) as batch_map:
        bar = progress_bar("Rendering", _shorter(loaded, sensor, spp, method))
        with bar as progress, resumable(progress, saved) if saved else nullcontext():
            start = time.perf_counter()
            capture = render_capture(
                loaded,
                sensor=sensor,
                model=model,
                spp=spp,
                seed=seed,
                progress=progress,
                checkpoint=saved,
                batch_map=batch_map,
                noise=noise,
                **wave,
            )
        seconds = time.perf_counter() - start
        if names and truth_file:
            # Brings libraries that take a second to load.
            from ..views import ground_truth

            write_ground_truth(truth_file, ground_truth(loaded, names, sensor=sensor))
            capture.metadata[TRUTH_NAME] = truth_file.name
            typer.echo(f"{truth_file}: ground truth, {', '.join(names)}")
        write_capture(output, capture)
    if white:
        # Brings libraries that take a second to load.
        import numpy as np

        from ..views import capture_white

        shape = np.atleast_3d(capture.image).shape
        with progress_bar("White image") as progress:
            even = np.broadcast_to(capture_white(capture, shape[2], progress), shape).reshape(capture.image.shape)
        write_capture(white, replace(capture, image=even, noise=None, metadata={"scene": "white image"}))
        typer.echo(f"{white}: white image, by {capture.model}s")
    rows, columns = capture.camera.shape
    deviation = "" if capture.noise is None else f", noise {capture.relative_noise:.2%} of the mean"
    typer.echo(f"{output}: capture of {columns} x {rows} pixels, rendered in {seconds:.1f} s{deviation}")


def _shorter(scene: Any, sensor: int, spp: int | None, method: str | None) -> str:
    """Return what makes a capture shorter, if anything does."""
    from ..scene import plenoptic_sensor

    if (method or getattr(scene.integrator(), "method", "")) == "points":
        return "each point is propagated; --method signed_rays takes one to some ray captures"
    count = spp or plenoptic_sensor(scene, sensor).sampler().sample_count()
    return f"--spp {count // 4} instead of {count} takes about a quarter" if count >= 4 else ""


def expose(
    capture: options.CaptureFile,
    *,
    output: Annotated[Path, options.ends_in(".exr", ".png", ".tif", ".tiff")],
    exposure: Annotated[dict[str, Any], options_of("detector.record:expose", "photons", "seed")],
    detector: Annotated[dict[str, Any], options_of("detector.record:Detector")],
) -> None:
    """Add what a real detector does: noise, saturation, digital numbers.

    The sensor is linear after EMVA Standard 1288. The result is a capture in the units of the first, so that every
    command takes it. A name that ends in .png or .tiff keeps the digital numbers instead, in 16 bits, for other
    programs and for 'demosaic'.

    Parameters
    ----------
    output : FILE
        File to write: .exr, or .png or .tiff for digital numbers.

    Examples
    --------
    $ mitsuba-plenoptic expose raw.exr -o noisy.exr --photons 2000
    $ mitsuba-plenoptic expose colours.exr -o bayer.exr --photons 2000 --mosaic RGGB
    $ mitsuba-plenoptic expose colours.exr -o bayer.tiff --photons 2000 --mosaic RGGB
    """
    from ..detector import Detector
    from ..detector import expose as record
    from ..io import read_capture, write_capture, write_raw
    from ..runtime import require_output

    require_output(output, capture)
    exposed = record(read_capture(capture), Detector(**detector), **exposure)
    (write_raw if output.suffix.lower() in RAW_SUFFIXES else write_capture)(output, exposed)
    electrons = detector["quantum_efficiency"] * exposure["photons"]
    saturated, rows, columns = exposed.metadata["exposure"]["saturated_pixels"], *exposed.image.shape[:2]
    typer.echo(
        f"{output}: {electrons:.4g} electrons in a pixel of value 1; a full well is {detector['full_well']:g}; "
        f"{saturated} pixels ({saturated / (rows * columns):.2%}) are saturated"
    )
