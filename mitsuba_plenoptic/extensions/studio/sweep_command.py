"""``mitsuba-plenoptic sweep``: a scene over a grid of cameras and wavelengths."""

from pathlib import Path
from typing import Annotated

import typer

from ... import choices
from ...cli import inputs, options, stopping
from ...errors import refuse_if


def sweep(
    scene: options.Scene,
    *,
    output: Annotated[Path, options.ends_in(".nc")],
    grid: options.Existing | None = None,
    vary: Annotated[list[str], options.assigned("--vary", "NAME=VALUE,VALUE,...")] | None = None,
    model: choices.Model | None = None,
    method: options.Method | None = None,
    spp: options.Count | None = None,
    seed: options.Seed = 0,
    resume: options.Resume = False,
    workers: options.Workers | None = None,
    scheduler: options.Scheduler | None = None,
    camera: options.CameraFile | None = None,
    unit: choices.Unit = "mm",
    define: options.Definitions = None,
    variant: options.Variant | None = None,
) -> None:
    """Render a scene over a grid of cameras and wavelengths, refocus to distances.

    Writes one labelled dataset, which xarray opens. Every point is stored in a folder next to it (FILE.points): a sweep
    that was stopped, or whose grid has grown, computes only what is missing.

    Parameters
    ----------
    output : FILE.nc
        NetCDF file to write.
    grid : FILE.yaml
        The grid: names, each with a list of numbers.
    vary : NAME=V1,V2,...
        One name of the grid and its values: a $NAME of the scene, a parameter of the camera or of its data sheet,
        'wavelength' in nanometres, or 'distance' to refocus to; repeat for several.
    method
        How captures are refocused. Default: ray.

    Examples
    --------
    $ mitsuba-plenoptic sweep letters -o sweep.nc --vary aperture_radius=3,4,5
      --vary distance=210,240,280
    $ mitsuba-plenoptic sweep letters -o colours.nc --model wave
      --vary wavelength=450,550,633 --workers 4
    $ mitsuba-plenoptic sweep letters -o sweep.nc --grid sweep.yaml
    """
    # Datasets need libraries that take a second to load, which other commands need not wait for.
    from ...camera import MATCHED, PARAMETERS
    from ...capture_spec import CaptureSpec
    from ...runtime import DEFAULT_VARIANT
    from .sweep import check_grid, prepare, stated_grid

    checked = check_grid(stated_grid(grid, vary or []))
    refuse_if(
        method is not None and "distance" not in checked,
        "--method: nothing is refocused without a 'distance' in the grid; leave it out",
    )
    parameters = inputs.parse_definitions(define)
    stated = None
    if camera is not None:
        of_camera = {name for name in checked if name in (*PARAMETERS, *MATCHED)}
        stated = inputs.stated_camera(camera) if of_camera else inputs.camera_instead(camera, scene, parameters)
        inputs.require_in_use(scene, parameters)
        inputs.require_in_use(
            scene, {name: f"{values[0]:g}" for name, values in checked.items() if name not in of_camera}, "grid:"
        )
    spec = CaptureSpec(
        scene=scene,
        unit=unit,
        parameters=parameters,
        camera=stated,
        model=model,
        spp=spp,
        seed=seed,
        variant=variant or DEFAULT_VARIANT,
    )
    with stopping.stage_lines(resume) as stages:
        compute = prepare(spec, checked, output, method or "ray", stages, workers=workers, scheduler=scheduler)
        with inputs.batches_on(workers, scheduler) as batch_map:
            dataset = compute(batch_map)
    axes = " x ".join(f"{len(values)} {name}" for name, values in checked.items())
    typer.echo(f"{output}: {', '.join(str(name) for name in dataset.data_vars)} over {axes}")
