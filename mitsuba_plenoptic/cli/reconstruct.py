"""``mitsuba-plenoptic reconstruct`` and ``sheet``: refocused images from a capture, and figures that compare them."""

from __future__ import annotations

import math
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..choices import PICTURES, VOLUMES
from ..errors import refuse_if
from ..refocus_options import Option, all_options
from ..runtime import in_words, progress_bar
from . import options
from .inputs import batches_on, drawing_of, named_camera, refuse_options, require_in_sight, require_linear, require_png
from .stopping import checkpoint_of, resumable

if TYPE_CHECKING:
    from ..camera import PlenopticCamera
    from ..io import Capture


def _method_options() -> dict[str, Any]:
    """Return an option of the command for each argument that only some methods take."""
    command_options = {}
    for name, option in all_options().items():
        flag = bool in option.types
        kind = str | None if str in option.types else option.types[0] | None
        command_options[name] = Annotated[
            kind,
            typer.Option(
                *([f"--{name}/--no-{name}" if option.default else f"--{name}"] if flag else []),
                metavar=option.metavar or (None if flag or option.choices else "N"),
                show_default=name if flag and option.default else not flag and option.shown_default,
                help=option.text,
                rich_help_panel=options.WAVES if option.waves else options.EXPERT,
            ),
        ]
    return command_options


def reconstruct(
    capture: options.CaptureFile,
    *,
    distance: options.Distances,
    output: Annotated[Path, options.ends_in(*PICTURES, *VOLUMES)] | None = None,
    method: options.Method = "ray",
    wavelength: Annotated[options.Wavelengths, options.WAVES] | None = None,
    camera: options.CameraFile | None = None,
    linear: bool = False,
    oversample: options.Count = 1,
    white: options.Existing | None = None,
    resume: options.Resume = False,
    workers: options.Workers | None = None,
    scheduler: options.Scheduler | None = None,
    estimate: options.Estimate = False,
    variant: options.Variant | None = None,
    picture: options.Picture,
    of_method: Annotated[dict[str, Any], _method_options()],
) -> None:
    """Refocus a capture to one or several distances.

    A reconstruction has one bin per microlens by default, and the orientation of an ordinary photograph. The distance
    may be inf. Pictures of one run share one scale, so that their brightness compares. Bins that no light can reach, at
    the borders of a crop, are NaN in OpenEXR and black in a picture. A raw picture (.png or .tiff) of a real camera
    needs its [bold]--camera[/bold].

    Parameters
    ----------
    output : FILE
        File to write, not needed with --estimate: float32 OpenEXR if it ends in .exr, an 8-bit picture if in .png.
        With several distances each goes into a file of its own: out.exr becomes out_210.exr and so on. All go into
        one labelled figure if it ends in .pdf, and into one volume with voxel sizes if in .tif (ImageJ), .ome.tif
        (OME) or .zarr.
    method
        How light is followed back: by rays, as one coherent wave, or as one wave for each interleaved subset of
        lenses; or by this camera's point spreads: incoherent weighs the capture with that of each bin, deconvolved
        finds the plane whose capture it is.
    wavelength : NM
        Of waves: wavelength in nanometres; of three channels three, as 611,549,464. Default: the capture's.
    oversample
        Bins per microlens along each axis; info prints what suits.

    Examples
    --------
    $ mitsuba-plenoptic reconstruct raw.exr -o out.png --distance 240
    $ mitsuba-plenoptic reconstruct raw.exr -o out.exr --distance 210 --distance 240
    $ mitsuba-plenoptic reconstruct raw.exr -o out.png --method partial --distance 280
    $ mitsuba-plenoptic reconstruct raw.exr --method deconvolved --distance 280 --estimate
    $ mitsuba-plenoptic reconstruct raw.exr -o out.tif --method deconvolved --volume --distance 220 --distance 260
    $ mitsuba-plenoptic reconstruct raw.tiff -o out.png --distance 600 --camera camera.json --linear
    """
    if output is None and not estimate:
        raise typer.BadParameter("name the file to write, or ask for an --estimate", param_hint="--output")
    camera_of_option = require_in_sight(capture, named_camera(camera), *distance)
    require_linear(linear, capture, white)

    # Brings libraries that take a while to load.
    from .. import refocus as reconstruction
    from ..refocus import registered, require_volume_path, used_by
    from ..report import reconstruction_paths, write_reconstructions
    from ..runtime import GIB, require_output

    chosen = registered(method)
    if estimate:
        refuse_options("an estimate", resume=resume, workers=workers, scheduler=scheduler)
    # Those that the command alone knows, too, so that there is one note on all.
    arguments = used_by(
        chosen,
        white=white,
        wavelength=wavelength and options.wavelengths_of(wavelength),
        **{name: _value_of(option, of_method[name]) for name, option in all_options().items()},
        resume=resume or None,
        workers=workers,
        scheduler=scheduler,
    )
    white, resume, workers, scheduler = (arguments.pop(name) for name in ("white", "resume", "workers", "scheduler"))
    arguments |= {"method": method, "oversample": oversample}
    if estimate or output is None:
        with progress_bar("Estimating") as progress:
            recorded, reference = _recorded(capture, white, camera_of_option, linear, variant)
            progress(1, 3)
            cost = reconstruction.estimate_reconstruction(recorded, distance, white=reference, **arguments)
        typer.echo(f"{capture}: about {in_words(cost.seconds)} and {cost.memory / GIB:.2g} GiB")
        return
    as_volume = output.suffix.lower() in VOLUMES
    drawing = drawing_of(picture, output)
    paths = [] if as_volume else reconstruction_paths(output, distance, drawing)
    if as_volume:
        require_volume_path(output, distance)
    written = paths or [output]
    for path in written:
        require_output(path, capture, white)
    recorded, reference = _recorded(capture, white, camera_of_option, linear, variant)
    saved = checkpoint_of(output, bool(resume)) if chosen.long else None
    with saved or nullcontext(), batches_on(workers, scheduler) as batch_map:
        with progress_bar("Refocusing") as progress, resumable(progress, saved) if saved else nullcontext():
            results = reconstruction.reconstruct(
                recorded,
                distance,
                white=reference,
                progress=progress,
                checkpoint=saved,
                batch_map=batch_map,
                **arguments,
            )
        if as_volume:
            volume = reconstruction.Volume.of(results)
            reconstruction.write_volume(output, volume)
            planes, rows, columns = volume.values.shape[:3]
            typer.echo(f"{output}: volume of {columns} x {rows} x {planes} voxels, {volume.voxel_size:.4g} mm wide")
        else:
            write_reconstructions(paths, results, recorded.metadata, drawing)
    for path, result in zip(paths if len(paths) == len(results) else [output] * len(results), results, strict=True):
        rows, columns = result.image.shape[:2]
        where = "rad at infinity" if math.isinf(result.distance) else f"mm at {result.distance:g} mm"
        typer.echo(f"{path}: {columns} x {rows} bins of {result.bin_size:.4g} {where}{_described(result.facts)}")
    if any(result.facts.get("residual", 0) > 0.25 and not result.facts["stopped_by_noise"] for result in results):
        typer.echo("much of the capture is left: planes that hold the light may be missing")


def sheet(
    results: list[options.Existing],
    *,
    output: Annotated[Path, options.ends_in(".pdf", ".png")],
    distance: list[float] | None = None,
    exposure: float | None = None,
    percentile: float | None = None,
    dpi: options.Dpi | None = None,
) -> None:
    """Lay reconstructions out in one figure: a row a method and capture, a column a distance.

    All share one scale. They must be by one camera.

    Parameters
    ----------
    results : RESULT.exr...
        Files that 'reconstruct' wrote, in any order.
    output : FILE
        Figure to write, .pdf or .png.
    distance : MM
        Show the results at this distance alone; repeat for several. Default: all.

    Examples
    --------
    $ mitsuba-plenoptic sheet ray_210.exr ray_240.exr partial_210.exr partial_240.exr -o sheet.pdf
    $ mitsuba-plenoptic sheet *.exr -o sheet.png --distance 210 --distance 240
    """
    from ..refocus import read_reconstruction
    from ..report import images
    from ..runtime import require_output

    require_output(output, *results)
    require_png(dpi, output)
    read = [read_reconstruction(path) for path in results]
    there = sorted({result.distance for result in read})
    for value in distance or ():
        refuse_if(
            value not in there,
            f"distance = {value:g}: no result is refocused there, but to {', '.join(f'{at:g}' for at in there)}",
        )
    read = [result for result in read if not distance or result.distance in distance]
    # Brings Matplotlib, which takes a while to load.
    from ..report import plots

    white = images.Brightness(exposure, percentile).peak([result.image for result in read])
    plots.contact_sheet(read, white).save(output, dpi)
    methods, distances = ({getattr(result, name) for result in read} for name in ("method", "distance"))
    typer.echo(f"{output}: {len(read)} images (methods: {len(methods)}, distances: {len(distances)})")


def _recorded(
    capture: Path, white: Path | None, camera: PlenopticCamera | None, linear: bool, variant: str | None
) -> tuple[Capture, Capture | None]:
    """Return a capture and its white reference, after setting the variant."""
    from ..io import read_capture
    from ..runtime import set_variant

    recorded = read_capture(capture, camera=camera, linear=linear)
    reference = None if white is None else read_capture(white, camera=camera, linear=linear)
    set_variant(variant)
    return recorded, reference


def _value_of(option: Option, value: Any) -> Any:
    """Return the value of a command's option as the library takes it, None if not given; the library checks words."""
    if bool in option.types:
        # A flag that is off by default cannot be given as off.
        return value if option.default else value or None
    short = isinstance(value, str) and value.isdecimal() and len(value) < 10
    return int(value) if short and int in option.types else value


def _described(facts: dict[str, Any]) -> str:
    """Return facts in words: the resolution outside the range of refocusing; of a deconvolution how it ended."""
    if "iterations" not in facts:
        if facts.get("in_range", True):
            return ""
        return f"; outside the range of refocusing, {facts['samples_per_lens']:.2g} samples per lens"
    ended = "stopped by the noise" if facts["stopped_by_noise"] else "as many as were to be made"
    near = "; in focus, where finer bins add little" if facts["in_focus"] else ""
    return (
        f"; {facts['iterations']} iterations, {ended}, {facts['residual']:.2%} of the capture left; resolution limit "
        f"{facts['resolution_limit']:.3g} line pairs/mm{near}"
    )
