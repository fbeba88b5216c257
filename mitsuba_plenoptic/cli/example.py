"""``mitsuba-plenoptic example``: a finished capture to try the other commands on."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from ..choices import Example
from . import options


def example(name: Example, *, output: Annotated[Path, options.ends_in(".exr")] | None = None) -> None:
    """Write a finished capture, with its ground truth next to it, to try the other commands on.

    All are by one camera of 48 x 48 microlenses. The letters are at 210, 240 and 280 mm; white is a luminous wall, for
    [bold]--white[/bold].

    Parameters
    ----------
    name
        Which capture.
    output : FILE.exr
        File to write. Default: named as the capture.

    Examples
    --------
    $ mitsuba-plenoptic example letters-wave -o wave.exr
    """
    from ..io import TRUTH_NAME, examples, truth_path, write_capture, write_ground_truth
    from ..runtime import require_writable

    capture = examples.example(name)
    truth = examples.example_truth(name)
    path = require_writable(output or Path(f"{name}.exr"))
    truth_file = require_writable(truth_path(path))
    write_ground_truth(truth_file, truth)
    write_capture(path, replace(capture, metadata={**capture.metadata, TRUTH_NAME: truth_file.name}))
    rows, columns = capture.camera.shape
    typer.echo(f"{path}: capture of {columns} x {rows} pixels, {capture.model} model; ground truth in {truth_file}")
