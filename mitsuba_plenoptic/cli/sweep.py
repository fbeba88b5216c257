"""``mitsuba-plenoptic sweep``: captures and reconstructions over a grid of parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .. import reconstruction
from ..errors import InputError
from ..runtime.variant import DEFAULT_VARIANT
from .inputs import batches_on, parse_definitions
from .options import Definitions, Model, ResumeOnly, Samples, Scene, Scheduler, Seed, Variant, Workers, output_option
from .terminal import stage_lines


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
        typer.Option(metavar="|".join(reconstruction.METHODS), show_default="ray", help="How captures are refocused."),
    ] = None,
    spp: Samples = None,
    seed: Seed = 0,
    resume: ResumeOnly = False,
    workers: Workers = None,
    scheduler: Scheduler = None,
    define: Definitions = None,
    variant: Variant = None,
) -> None:
    """Render a scene over a grid of cameras and wavelengths, refocus to distances.

    Writes one labelled dataset, which xarray opens. Every point is kept in a
    folder beside it (FILE.points): a sweep that was stopped, or whose grid has
    grown, computes only what is missing.

    [bold]Examples:[/bold]

      mitsuba-plenoptic sweep letters -o sweep.nc --vary aperture_radius=3,4,5
      --vary distance=210,240,280

      mitsuba-plenoptic sweep letters -o colours.nc --model wave
      --vary wavelength=450,550,633 --workers 4

      mitsuba-plenoptic sweep letters -o sweep.nc --grid sweep.yaml
    """
    # Datasets need libraries that take a second to load, which other commands need not wait for.
    from ..report.sweep import SweepSettings, check_grid, merge_grids, parse_grid, read_grid
    from ..report.sweep import sweep as compute

    wanted = check_grid(merge_grids(read_grid(grid) if grid else {}, parse_grid(vary or [])))
    if method is not None and "distance" not in wanted:
        raise InputError("--method: nothing is refocused without a 'distance' in the grid; leave it out")
    settings = SweepSettings(
        scene=scene,
        parameters=parse_definitions(define),
        model=model,
        spp=spp,
        seed=seed,
        method=method or "ray",
        variant=variant or DEFAULT_VARIANT,
    )
    with batches_on(workers, scheduler) as batch_map, stage_lines(resume) as stages:
        dataset = compute(settings, wanted, output, batch_map=batch_map, stages=stages)
    axes = " x ".join(f"{len(values)} {name}" for name, values in wanted.items())
    typer.echo(f"{output}: {', '.join(str(name) for name in dataset.data_vars)} over {axes}")
