"""Commands that run whole experiments: ``compare``, ``sweep``, ``dataset``, and ``reproduce`` for the paper."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import refuse_if, require_count
from ..runtime.progress import in_words, is_quiet, moving_bar, plain_lines, progress_bar
from .choices import METHODS
from .inputs import (
    CameraFile,
    Definitions,
    Model,
    OutputFolder,
    PositiveDistances,
    Samples,
    Scene,
    Scheduler,
    Seed,
    Unit,
    Variant,
    Workers,
    batches_on,
    named_camera,
    numeric,
    output_option,
    parse_definitions,
    require_in_use,
)
from .judging import COUNTED, WAVELENGTH, one_of
from .stopping import Resume, resumable

if TYPE_CHECKING:
    from rich.progress import TaskID

    from ..report.stage_store import StageOptions


def compare(
    scene: Scene,
    output: OutputFolder,
    distance: PositiveDistances,
    wavelength: Annotated[float, numeric("Wavelength in nanometres.", unit="NM"), WAVELENGTH] = 633.0,
    spp: Annotated[int, numeric("Samples per pixel, by rays and by waves."), COUNTED] = 16,
    resume: Resume = False,
    camera: CameraFile = None,
    unit: Unit = "mm",
    define: Definitions = None,
    variant: Annotated[
        str, typer.Option(metavar="NAME", help="Mitsuba variant of one colour: llvm_ad_mono or cuda_ad_mono.")
    ] = "llvm_ad_mono",
) -> None:
    """Capture a scene by rays and by waves, refocus it by every method, and compare.

    Writes figures, captures and reconstructions, all results and report.html,
    which shows them in a browser. Both captures have the same main lens, which
    the scene's lens_model states. A run that was stopped resumes where it was.

    [bold]Examples:[/bold]

      mitsuba-plenoptic compare chart -o chart --distance 210 --distance 240

      mitsuba-plenoptic compare still_life -o still_life --distance 215
      --distance 258 -D resolution=2048 -D detector_width=4.096

      mitsuba-plenoptic compare my_scene.xml -o out --camera lytro --distance 300
    """
    from ..light.render_capture import MOST_SAMPLES

    # Figures need libraries that take a second to load, which other commands need not wait for.
    from ..report.comparison import compare as compute
    from ..report.experiment import Settings
    from ..report.metrics import ssim_text

    parameters = parse_definitions(define)
    settings = Settings(
        scene=scene,
        unit=unit,
        distances=tuple(sorted(set(distance))),
        parameters=parameters,
        camera=_instead(camera, scene, parameters),
        camera_name=camera,
        wavelength=wavelength,
        spp=require_count("spp", spp, maximum=MOST_SAMPLES),
        noise=spp > 1,
        variant=variant,
    )
    with stage_lines(resume) as stages:
        results = compute(settings, output, stages=stages)
    found = results["captures"]
    similarity = ssim_text(found["ssim"])
    typer.echo(f"Rays against waves: {found['psnr']:.1f} dB, SSIM {similarity}, energy {found['energy']:.3f}")
    found = found["difference"]
    if found["all"]["noise"] is None:
        typer.echo("Noise: not known of one sample; use --spp 2 or more")
    elif found["all"]["noise_alone"]:
        typer.echo(f"They differ by {found['all']['measured']:.2%}, which noise alone explains; use more --spp")
    else:
        typer.echo(
            f"They differ by {found['all']['measured']:.2%}: noise {found['all']['noise']:.2%}, diffraction "
            f"{found['all']['true']:.2%} ({found['middle']['true']:.2%} in the middle of micro-images, "
            f"{found['rim']['true']:.2%} at their rim)"
        )
    typer.echo(f"{output / 'report.html'}: open it in a browser")


def sweep(
    scene: Scene,
    output: Annotated[Path, output_option("FILE.nc", "NetCDF file to write.")],
    grid: Annotated[
        Path | None, typer.Option(metavar="FILE.yaml", help="The grid: names, each with a list of numbers.")
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=V1,V2,...",
            help="One name of the grid and its values: a $NAME of the scene, 'wavelength' in nanometres, or "
            "'distance' to refocus to; repeat for several.",
        ),
    ] = None,
    model: Model = None,
    method: Annotated[
        str | None,
        typer.Option(metavar="|".join(METHODS), show_default="ray", help="How captures are refocused."),
        one_of(METHODS),
    ] = None,
    spp: Samples = None,
    seed: Seed = 0,
    resume: Resume = False,
    workers: Workers = None,
    scheduler: Scheduler = None,
    camera: CameraFile = None,
    unit: Unit = "mm",
    define: Definitions = None,
    variant: Variant = None,
) -> None:
    """Render a scene over a grid of cameras and wavelengths, refocus to distances.

    Writes one labelled dataset, which xarray opens. Every point is stored in a
    folder next to it (FILE.points): a sweep that was stopped, or whose grid has
    grown, computes only what is missing.

    [bold]Examples:[/bold]

      mitsuba-plenoptic sweep letters -o sweep.nc --vary aperture_radius=3,4,5
      --vary distance=210,240,280

      mitsuba-plenoptic sweep letters -o colours.nc --model wave
      --vary wavelength=450,550,633 --workers 4

      mitsuba-plenoptic sweep letters -o sweep.nc --grid sweep.yaml
    """
    # Datasets need libraries that take a second to load, which other commands need not wait for.
    from ..extensions.studio.sweep import SweepSettings, check_grid, merge_grids, parse_grid, prepare, read_grid
    from ..runtime.backend import DEFAULT_VARIANT

    wanted = check_grid(merge_grids(read_grid(grid) if grid else {}, parse_grid(vary or [])))
    refuse_if(
        method is not None and "distance" not in wanted,
        "--method: nothing is refocused without a 'distance' in the grid; leave it out",
    )
    parameters = parse_definitions(define)
    settings = SweepSettings(
        scene=scene,
        unit=unit,
        parameters=parameters,
        camera=_instead(camera, scene, parameters, {name: f"{values[0]:g}" for name, values in wanted.items()}),
        model=model,
        spp=spp,
        seed=seed,
        method=method or "ray",
        variant=variant or DEFAULT_VARIANT,
    )
    with stage_lines(resume) as stages:
        compute = prepare(settings, wanted, output, stages, workers=workers, scheduler=scheduler)
        with batches_on(workers, scheduler) as batch_map:
            dataset = compute(batch_map)
    axes = " x ".join(f"{len(values)} {name}" for name, values in wanted.items())
    typer.echo(f"{output}: {', '.join(str(name) for name in dataset.data_vars)} over {axes}")


def _instead(
    source: str | None, scene: str, parameters: dict[str, str], varied: dict[str, str] | None = None
) -> dict[str, Any] | None:
    """Return the parameters of the camera that replaces a scene's, None where none is named."""
    camera = named_camera(source)
    if camera is None:
        return None
    require_in_use(scene, parameters)
    require_in_use(scene, varied or {}, "grid:")
    return camera.to_dict()


def dataset(
    recipe: Annotated[Path, typer.Argument(metavar="RECIPE.yaml", help="The recipe, YAML or JSON.")],
    output: OutputFolder,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N", show_default="this process", help="Number of processes of this machine to render on."
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Render on the workers of this Dask scheduler, which must see the output and the scenes under the "
            "same names.",
        ),
    ] = None,
) -> None:
    """Make a data set: random scenes captured by rays and by waves, with ground truth.

    Run it again to resume after it was stopped, or to let it grow to a larger
    count: the files have the same bits. The folder holds shards (HDF5), a data
    card (README.md), a preview, and checksums.

    [bold]Example:[/bold]

      mitsuba-plenoptic dataset shapes.yaml -o shapes --workers 2
    """
    # Data sets need libraries that take a second to load.
    from ..extensions.data.dataset import make_dataset, read_recipe

    wanted = read_recipe(recipe)
    with batches_on(workers, scheduler) as batch_map, progress_bar("Samples") as progress, resumable(progress):
        made = make_dataset(wanted, output, batch_map=batch_map, progress=progress)
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    typer.echo(f"{output}: {len(made)} samples, {size / 2**20:.0f} MiB, described in {output / 'README.md'}")


def reproduce(
    output: OutputFolder,
    preset: Annotated[
        str,
        typer.Option(
            metavar="quick|paper",
            help="A detector of half the width with letters of half the size, or the paper's 4096 x 4096 pixels.",
        ),
    ] = "quick",
    resume: Resume = False,
) -> None:
    """Compute the paper's figures, timing and conclusions again.

    Writes figures, captures and reconstructions, all results and report.html,
    which shows them in a browser. Valid results that the folder already
    holds are reused: a run that was stopped resumes where it was, even within
    the wave capture.

    [bold]Examples:[/bold]

      mitsuba-plenoptic reproduce -o demo

      mitsuba-plenoptic reproduce --preset paper -o paper
    """
    # Figures need libraries that take a second to load, which other commands need not wait for.
    from ..extensions.paper.reproduction import reproduce as compute

    with stage_lines(resume) as stages:
        results = compute(output, preset=preset, stages=stages)
    for claim in results["claims"]:
        typer.echo(f"{claim['verdict']:<15} {claim['statement']}")
    typer.echo(f"{output / 'report.html'}: open it in a browser")


@contextlib.contextmanager
def stage_lines(resume: bool) -> Iterator[StageOptions]:
    """Print a line for each stage that is done, and show the progress of the current one."""
    from ..report.stage_store import StageOptions

    with moving_bar() as bar, plain_lines("starting") as line, resumable():
        tasks: dict[str, TaskID] = {}

        def notify(name: str, done: int, total: int) -> None:
            line.label = name.replace("_", " ")
            line(done, total)
            if name not in tasks:
                tasks[name] = bar.add_task(line.label, total=1)
            bar.update(tasks[name], completed=done, total=total or 1)

        def finished(name: str, seconds: float, was_there: bool) -> None:
            if name in tasks:
                bar.remove_task(tasks.pop(name))
            if not is_quiet():
                bar.console.print(f"{name.replace('_', ' '):<28} {'reused' if was_there else in_words(seconds)}")

        yield StageOptions(notify, finished, resume)
