"""A process that runs cases: reads their names from standard input and tells outcomes on standard output.

It has little memory and refuses early, so that what takes more than it said shows as a finding.
"""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import shutil
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path

from . import arguments, arrays, cameras, exr, light_fields, runs, scenes
from .cases import Case, Generator, judge, random_for

KINDS: dict[str, tuple[int, Generator]] = {
    "EXR: damaged bytes": (14, exr.bytes_case),
    "EXR: changed header": (12, exr.header_case),
    "EXR: changed JSON": (10, exr.json_case),
    "XML: damaged bytes": (8, scenes.bytes_case),
    "XML: forbidden value": (8, scenes.value_case),
    "XML: hostile": (6, scenes.hostile_case),
    "command line": (12, arguments.command_case),
    "Python: camera": (12, cameras.camera_case),
    "Python: array": (8, arrays.array_case),
    "Python: argument": (14, arrays.argument_case),
    "Python: extreme camera": (4, arrays.extreme_case),
    "checkpoint": (5, runs.checkpoint_case),
    "grid of a sweep": (5, runs.grid_case),
    "MAT, HDF5, PNG: damaged bytes": (8, light_fields.bytes_case),
    "MAT, HDF5, PNG: lies": (8, light_fields.lie_case),
}
"""Kinds of input with their shares."""

LIMIT_GIB = 0.5
"""What the package is told that it may take."""

_ADDRESS_SPACE = 12 * 2**30
"""Bytes of addresses that the process can have: libraries and threads reserve some that they never use."""


def _raise(text: str) -> Callable[[], None]:
    def fail() -> None:
        raise RuntimeError(text)

    return fail


def main(seed: int) -> None:
    """Run the cases named on standard input, a line each: kind, tab, index."""
    answers = os.fdopen(os.dup(1), "w")
    # What native code prints would mix with the answers.
    log = Path(os.environ.get("FUZZ_LOG", os.devnull)).open("a")  # noqa: SIM115 (it lasts as long as the process)
    for number in (1, 2):
        os.dup2(log.fileno(), number)
    sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
    faulthandler.enable(log)
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    root = Path(tempfile.mkdtemp(prefix="fuzz-", dir=os.environ.get("FUZZ_FOLDER")))
    os.chdir(root)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        kind, index = line.rstrip("\n").split("\t")
        folder = root / "case"
        folder.mkdir()
        try:
            case = KINDS[kind][1](random_for(seed, kind, int(index)), folder)
        except Exception:
            case = Case("(the generator itself failed)", _raise(traceback.format_exc()))
        print(json.dumps({"what": case.what}), file=answers, flush=True)
        outcome = judge(case)
        shutil.rmtree(folder)
        print(json.dumps({"outcome": outcome.kind, "text": outcome.text}), file=answers, flush=True)
    shutil.rmtree(root)
