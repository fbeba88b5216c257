"""Make a benchmark of captures with ground truth, answer its tasks, and score the answers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ...cli.inputs import OutputFolder, Scheduler, Seed, Workers, batches_on, output_option
from ...cli.stopping import resumable
from ...errors import refuse_if, require_choice
from ...runtime.progress import progress_bar

if TYPE_CHECKING:
    from .score import TableLine


benchmark = typer.Typer(
    help=__doc__,
    rich_markup_mode="rich",
)

BenchmarkFolder = Annotated[Path, typer.Argument(metavar="BENCHMARK", help="A folder that 'benchmark make' wrote.")]


@benchmark.command()
def make(
    output: OutputFolder,
    seed: Seed = 0,
    size: Annotated[
        str, typer.Option(metavar="small|full", help="16 x 16 lenses and few samples, to try it, or 64 x 64 lenses.")
    ] = "full",
    scene: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", show_default="all ten", help="One of the scenes; repeat for several."),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
) -> None:
    """Make the benchmark: ten scenes by five cameras, captured by rays and by waves.

    Run it again to resume after it was stopped: the files have the same bits.
    The folder holds shards (HDF5), a data card (README.md), a contact sheet and
    checksums.

    [bold]Example:[/bold]

      mitsuba-plenoptic benchmark make -o bench
    """
    # Data sets need libraries that take a second to load.
    from .benchmark import SCENES, SIZES, benchmark_recipe, make_benchmark

    wanted = benchmark_recipe(seed, scene or tuple(SCENES), SIZES[require_choice("size", size, SIZES)])
    with batches_on(workers, scheduler) as batch_map, progress_bar("Samples") as progress, resumable(progress):
        made = make_benchmark(wanted, output, batch_map=batch_map, progress=progress)
    bytes_ = sum(path.stat().st_size for path in output.rglob("*") if path.is_file())
    typer.echo(f"{output}: {len(made)} samples, {bytes_ / 2**20:.0f} MiB, described in {output / 'README.md'}")


@benchmark.command()
def run(
    baseline: Annotated[str, typer.Argument(metavar="plain|ray|coherent|partial|deconvolved", help="The method.")],
    made: BenchmarkFolder,
    output: OutputFolder,
    capture: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME", show_default="all", help="Kind of captures, such as wave_dim; repeat for several."
        ),
    ] = None,
) -> None:
    """Answer the benchmark's tasks by a method of this package.

    [bold]Example:[/bold]

      mitsuba-plenoptic benchmark run ray bench -o answers/ray --capture wave
    """
    from .benchmark import CAPTURES, Benchmark, run_baseline

    with progress_bar("Captures") as progress:
        run_baseline(baseline, Benchmark(made), output, capture or CAPTURES, progress=progress)
    typer.echo(f"{output}: {sum(1 for _ in output.rglob('*.npy'))} answers")


@benchmark.command("score")
def score_answers(
    made: BenchmarkFolder,
    answers: Annotated[list[Path], typer.Argument(metavar="ANSWERS...", help="Folders of answers.")],
    output: Annotated[Path, output_option("FILE.json", "File to write all scores to.")],
) -> None:
    """Score folders of answers, print their means with ranks, and write all scores.

    A folder has a file SCENE/CAMERA/CAPTURE/TASK.npy (or .nc, .exr) for each
    capture. For each task the table has the means over scenes and cameras of
    its main score, and in brackets the rank: of 'depth' the fraction of bins
    that are more than 3 % off, of 'refocus' and 'views' the peak signal-to-noise
    ratio in decibels.

    [bold]Example:[/bold]

      mitsuba-plenoptic benchmark score bench answers/ray answers/mine -o scores.json
    """
    from ...io.checkpoints import write_json
    from ...runtime.files import require_writable
    from .benchmark import Benchmark, score, table

    require_writable(output, ".json")
    names = [folder.name for folder in answers]
    refuse_if(len(set(names)) < len(names), f"ANSWERS: their names are {', '.join(names)}: each must be another")
    found = Benchmark(made)
    scored = {folder.name: score(found, folder) for folder in answers}
    lines = table(scored)
    for text in _rows(lines, names):
        typer.echo(text)
    content = {
        "benchmark": found.manifest["recipe"],
        "means": [{**vars(line)} for line in lines],
        "scores": scored,
    }
    write_json(output, _without_nan(content))


def _rows(lines: list[TableLine], names: list[str]) -> list[str]:
    """Return the lines of a table, laid out in columns."""
    from .benchmark import TASKS

    texts = [["task", "captures", "cameras", *names]]
    for line in lines:
        main = TASKS[line.task].main
        cells = [f"{line.means[name][main]:.3g} ({line.ranks[name]})" if name in line.ranks else "-" for name in names]
        texts.append([f"{line.task} ({main})", line.capture, line.split, *cells])
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in texts]


def _without_nan(value: Any) -> Any:
    """Return a value with NaN replaced by None, since JSON has no NaN."""
    if isinstance(value, dict):
        return {name: _without_nan(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_without_nan(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value


@benchmark.command()
def export(
    made: BenchmarkFolder,
    output: OutputFolder,
    capture: Annotated[str, typer.Option(metavar="NAME", help="Kind of captures, such as wave_dim.")] = "ray",
) -> None:
    """Write decoded views in the format of the 4D Light Field Benchmark (HCI), for programs that read it.

    [bold]Example:[/bold]

      mitsuba-plenoptic benchmark export bench -o hci --capture wave
    """
    from .benchmark import Benchmark, export_hci

    written = export_hci(Benchmark(made), output, capture)
    typer.echo(f"{output}: {len(written)} light fields")
