"""Evaluates cases in a process of its own, and says what became of each."""

from __future__ import annotations

import contextlib
import dataclasses
import faulthandler
import math
import os
import re
import resource
import signal
import tempfile
import traceback
import warnings
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

FINE = ("refused", "fine")
"""Outcomes that are no findings."""

PATIENCE = 6
"""How many times the processor time that a case may take it is waited for: other processes take time, too."""

# The package is told that it may take little memory, so that what takes more than it said shows as a finding.
_ENVIRONMENT = {
    "MITSUBA_PLENOPTIC_MEMORY": "0.5",
    "DRJIT_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
# Libraries and threads reserve addresses that they never use.
_ADDRESS_SPACE = 12 * 2**30


class Verdict(NamedTuple):
    """What became of a case.

    Attributes
    ----------
    outcome : str
        ``refused`` or ``fine``; or ``accepted``, ``several lines``, ``exception``, ``not finite``, ``wrong shape``,
        ``crash`` or ``too long``.
    details : str
        The refusal, or what tells of the finding.
    place : str
        What findings with the same cause have in common.
    """

    outcome: str
    details: str = ""
    place: str = ""


def serve(connection: Connection, log: str, seconds: float) -> None:
    """Evaluate the cases that come over a connection, until it is closed.

    Whatever native code prints, and where the process was when it died or had taken so many seconds of processor time,
    goes to the file `log`.
    """
    os.environ.update(_ENVIRONMENT)
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    output = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(output, 1)
    os.dup2(output, 2)
    faulthandler.enable()
    # Writes where the process is, and then lets the signal end it, whatever native code is at work.
    faulthandler.register(signal.SIGPROF, chain=True)
    # Only here, since the package reads the environment when it is imported.
    from . import workbench

    names = {"nan": math.nan, "inf": math.inf, "os": os, **_public(workbench.mp), **_public(workbench.mp.lightfield),
             **_public(workbench.exchange), **vars(workbench)}  # fmt: skip
    workbench.files()
    connection.send("ready")
    with tempfile.TemporaryDirectory() as root, contextlib.suppress(EOFError):
        while True:
            case = connection.recv()
            os.truncate(log, 0)
            signal.setitimer(signal.ITIMER_PROF, seconds)
            faulthandler.dump_traceback_later(PATIENCE * seconds)
            with tempfile.TemporaryDirectory(dir=root) as folder, contextlib.chdir(folder):
                verdict = judge(case, names)
            faulthandler.cancel_dump_traceback_later()
            signal.setitimer(signal.ITIMER_PROF, 0)
            connection.send(verdict)


def _public(module: Any) -> dict[str, Any]:
    return {name: getattr(module, name) for name in module.__all__}


def judge(case: str, names: dict[str, Any]) -> Verdict:
    """Evaluate a case and say what became of it."""
    from mitsuba_plenoptic import InputError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fault = flaw(eval(case, names))
    except InputError as error:
        told = str(error)
        return Verdict("refused", told) if told.isprintable() else Verdict("several lines", repr(told))
    except names["Accepted"] as error:
        return Verdict("accepted", str(error))
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        place = f"{type(error).__name__} in {Path(frames[-1].filename).name}, line {frames[-1].lineno}"
        return Verdict("exception", "".join(traceback.format_exception(error)[-6:]).strip()[-3000:], place)
    return fault or Verdict("fine")


def flaw(value: Any) -> Verdict | None:
    """Find what is wrong with a result: numbers that are not finite, an image of another shape than its camera's."""
    if isinstance(value, (list, tuple)):
        return next((fault for entry in value if (fault := flaw(entry))), None)
    if isinstance(value, str):
        return Verdict("not finite", value) if re.search(r"\bnan\b", value) else None
    if hasattr(value, "data_vars"):
        # A depth may be infinite, where all views agree on that.
        return flaw([array.values for name, array in value.data_vars.items() if name != "depth"])
    if dataclasses.is_dataclass(value) and hasattr(value, "image"):
        image, wanted = value.image, value.camera.shape
        # A reconstruction has its own size, in bins.
        if image.ndim not in (2, 3) or not image.size or (not hasattr(value, "bin_size") and image.shape[:2] != wanted):
            return Verdict("wrong shape", f"an image of shape {image.shape} of a camera of {wanted} pixels")
        # Bins that no light can come from are NaN, but not all of them.
        marked = hasattr(value, "bin_size") and not (image != image).all()
        return flaw(image[image == image] if marked else image)
    if dataclasses.is_dataclass(value):
        # A camera may be focused to infinity.
        numbers = {name: getattr(value, name) for name in dir(value) if name not in ("focus_distance", "refocus_range")}
        wrong = [f"{name} = {number}" for name, number in numbers.items()
                 if isinstance(number, float) and not math.isfinite(number)]  # fmt: skip
        return Verdict("not finite", ", ".join(wrong)) if wrong else None
    array = getattr(value, "values", value)
    if hasattr(array, "dtype") and array.dtype.kind in "fc":
        import numpy as np

        bad = array.size - int(np.isfinite(array).sum())
        return Verdict("not finite", f"{bad} of {array.shape} values") if bad else None
    return Verdict("not finite", str(value)) if isinstance(value, float) and not math.isfinite(value) else None
