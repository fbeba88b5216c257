"""``mitsuba-plenoptic dataset``: random scenes from a recipe, captured with ground truth."""

import typer

from ...cli import inputs, options, stopping
from ...runtime import progress_bar


def dataset(
    recipe: options.Existing,
    *,
    output: options.OutputFolder,
    workers: options.Workers | None = None,
    scheduler: options.Scheduler | None = None,
) -> None:
    """Make a data set: random scenes captured by rays and by waves, with ground truth.

    Run it again to resume after it was stopped, or to let it grow to a larger count: the files have the same bits. The
    folder holds shards (HDF5), a data card (README.md) and a preview.

    Parameters
    ----------
    recipe : RECIPE.yaml
        The recipe, YAML or JSON.

    Examples
    --------
    $ mitsuba-plenoptic dataset shapes.yaml -o shapes --workers 2
    """
    # Data sets need libraries that take a second to load.
    from .dataset import make_dataset, read_recipe

    settings = read_recipe(recipe)
    with (
        inputs.batches_on(workers, scheduler) as batch_map,
        progress_bar("Samples") as progress,
        stopping.resumable(progress),
    ):
        data_set = make_dataset(settings, output, batch_map=batch_map, progress=progress)
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    typer.echo(f"{output}: {len(data_set)} samples, {size / 2**20:.0f} MiB, described in {output / 'README.md'}")
