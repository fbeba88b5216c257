"""What several commands share: options, progress bars."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ..errors import InputError
from ..io.captures import MODELS, Capture, read_capture
from ..runtime.batches import BatchMap

Definitions = Annotated[
    list[str] | None,
    typer.Option(
        "-D",
        "--define",
        metavar="NAME=VALUE",
        help="Set a scene parameter, the $NAME in its XML file; repeat for several.",
    ),
]

Variant = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        show_default="llvm_ad_mono",
        help="Mitsuba variant, for example llvm_ad_rgb or cuda_ad_mono.",
    ),
]

Model = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(MODELS),
        show_default="as the scene's integrator has it",
        help="How light propagates through the camera.",
    ),
]

Samples = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        show_default="those of the scene's sampler",
        help="Samples per pixel; by waves, light paths per radiator.",
    ),
]

Seed = Annotated[int, typer.Option(metavar="N", help="Seed of the random numbers.")]

RadiatorsPerLens = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        show_default="the scene's, else 8",
        help="By waves: incoherent point sources per microlens and axis.",
    ),
]

Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Go on from the checkpoint of a wave capture that was stopped; refuse one of another scene, camera or "
        "version.",
    ),
]

# Of commands that always go on where they stood.
ResumeOnly = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Refuse the checkpoint of another scene, camera or version, if the folder holds one, instead of "
        "replacing it.",
    ),
]

Workers = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        show_default="threads of one process",
        help="By waves: sum on so many processes of this machine; the capture has the same bits.",
    ),
]

Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="By waves: sum on the workers of this Dask scheduler, for example tcp://10.0.0.1:8786.",
    ),
]


def load_capture(path: str | Path) -> Capture:
    """Read a capture without the remarks that OpenEXR itself prints about a damaged file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    with native_output_dropped():
        return read_capture(path)


def parse_definitions(definitions: list[str] | None) -> dict[str, str]:
    """Turn ``name=value`` texts into a dictionary.

    Raises
    ------
    InputError
        If a text is not of that form.
    """
    parameters = {}
    for text in definitions or []:
        name, equals, value = text.partition("=")
        if not name or not equals:
            raise InputError(f"-D {text}: write it as -D NAME=VALUE")
        parameters[name] = value
    return parameters


@contextlib.contextmanager
def batches_on(workers: int | None, scheduler: str | None) -> Iterator[BatchMap | None]:
    """Start or reach the workers that are asked for; yields None if none are.

    Raises
    ------
    InputError
        If they cannot be had.
    """
    if workers is None and scheduler is None:
        yield None
        return
    from ..runtime.cluster import Cluster

    with Cluster(workers=workers, scheduler=scheduler) as cluster:
        yield cluster


@contextlib.contextmanager
def native_output_dropped() -> Iterator[None]:
    """Drop what C++ code prints past Python."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [(number, os.dup(number)) for number in (1, 2)]
    try:
        with Path(os.devnull).open("wb") as nowhere:
            for number, _ in saved:
                os.dup2(nowhere.fileno(), number)
        yield
    finally:
        for number, copy in saved:
            os.dup2(copy, number)
            os.close(copy)


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar on standard error, if that is a terminal; yields a callable(done, total)."""
    console = Console(stderr=True)
    columns = (TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(label, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
