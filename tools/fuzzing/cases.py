"""One generated input, what may become of it, and the judgement."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import signal
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from mitsuba_plenoptic import Capture, InputError, PlenopticCamera
from mitsuba_plenoptic.cli import main

SECONDS = 10
"""Time that one input may take."""


@dataclass
class Case:
    """A generated input.

    Attributes
    ----------
    what : str
        What was done to it, for the report.
    run : callable
        Gives the input to the package and returns what comes out.
    forbidden : bool
        Whether the documentation forbids it, so that it must be refused; else a right result will do as well.
    """

    what: str
    run: Callable[[], Any]
    forbidden: bool = False


class Outcome(NamedTuple):
    """What became of an input: ``refused``, ``fine``, or a finding, with its details."""

    kind: str
    text: str = ""


Generator = Callable[[np.random.Generator, Path], Case]
"""Makes a case from random numbers; the folder is its own, for files, and empty."""


class Refused(Exception):  # noqa: N818 (it is the expected end, not an error)
    """The command refused an input as it should."""


class TooLong(BaseException):
    """The time is over; not an Exception, so that no handler takes it for a damaged file."""


def random_for(seed: int, kind: str, index: int) -> np.random.Generator:
    """Give the random numbers of one case, which depend on nothing else."""
    return np.random.default_rng([seed, zlib.crc32(kind.encode()), index])


def judge(case: Case) -> Outcome:
    """Run a case and say what became of it."""
    try:
        with _time_limit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = case.run()
            wrong = not_finite(result)
    except InputError as error:
        lines = str(error).splitlines()
        if len(lines) != 1 or not str(error).isprintable():
            return Outcome("several lines", repr(str(error)))
        return Outcome("refused", str(error))
    except Refused as refusal:
        return Outcome("refused", str(refusal))
    except TooLong:
        return Outcome("too long", f"more than {SECONDS} s: {''.join(traceback.format_exc().splitlines(True)[-24:])}")
    except BaseException:
        return Outcome("traceback", "".join(traceback.format_exc().splitlines(True)[-6:]))
    if case.forbidden:
        return Outcome("accepted", f"forbidden, but taken; result {type(result).__name__}")
    if wrong:
        return Outcome("not finite", wrong)
    return Outcome("fine")


def command(*arguments: Any) -> None:
    """Run the command as a user does, and see that a refusal is status 2 with one line and nothing else.

    Raises
    ------
    Refused
        If it was.
    """
    output, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(error):
        status = main([str(argument) for argument in arguments])
    said = error.getvalue()
    assert "Traceback" not in said + output.getvalue(), said
    if status == 2:
        told = [line for line in said.splitlines() if ": warning: " not in line]
        assert len(told) == 1 and told[0].startswith("mitsuba-plenoptic: error: "), said
        assert told[0].isprintable(), repr(told[0])
        raise Refused(told[0])
    assert status == 0, f"status {status}: {said}"


def not_finite(value: Any) -> str:
    """Name what is not finite in a result; an empty text if all is."""
    if isinstance(value, np.ndarray):
        bad = value.size - int(np.isfinite(value).sum()) if value.dtype.kind in "fc" else 0
        return f"{bad} of {value.shape} values" if bad else ""
    if isinstance(value, xr.DataArray):
        return not_finite(value.values)
    if isinstance(value, xr.Dataset):
        # A depth may be infinite, where all views agree on that.
        return next((f"{name}: {text}" for name in value if name != "depth" if (text := not_finite(value[name]))), "")
    if isinstance(value, PlenopticCamera):
        may = {"focus_distance", "refocus_range"}
        for name in (name for name in dir(value) if not name.startswith("_") and name not in may):
            number = getattr(value, name)
            if isinstance(number, float) and not math.isfinite(number):
                return f"{name} = {number}"
        return ""
    if isinstance(value, (list, tuple)):
        return next((text for entry in value if (text := not_finite(entry))), "")
    if isinstance(value, Capture) or (dataclasses.is_dataclass(value) and hasattr(value, "image")):
        return not_finite(value.image)
    return ""


@contextlib.contextmanager
def _time_limit() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
