"""``mitsuba-plenoptic dataset``: from a recipe to captures with ground truth."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated

import typer

from ..runtime.progress import progress_bar
from .inputs import batches_on
from .options import OutputFolder

_log = logging.getLogger(__name__)


def dataset(
    recipe: Annotated[Path, typer.Argument(metavar="RECIPE.yaml", help="The recipe, YAML or JSON.")],
    output: OutputFolder,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", show_default="this process", help="Render on so many processes of this machine."),
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

    Run it again to go on after it was stopped, or to let it grow to a larger
    count: the files have the same bits. The folder holds shards (HDF5), a data
    card (README.md), a preview, and checksums.

    [bold]Example:[/bold]

      mitsuba-plenoptic dataset shapes.yaml -o shapes --workers 2
    """
    # Data sets need libraries that take a second to load.
    from ..dataset import make_dataset, read_recipe

    wanted = read_recipe(recipe)
    with batches_on(workers, scheduler) as batch_map, progress_bar("Samples") as progress:
        try:
            made = make_dataset(wanted, output, batch_map=batch_map, progress=progress)
        except KeyboardInterrupt:
            _log.info("stopped at %.0f %%: the same command goes on", 100 * progress.fraction)
            raise
    size = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    typer.echo(f"{output}: {len(made)} samples, {size / 2**20:.0f} MiB, described in {output / 'README.md'}")
