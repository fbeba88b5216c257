"""Try relations on random cameras for a time: python tests/relations/hunt.py SECONDS SEED, or RELATION:SEED:OPTIONS.

A line a failure, with what repeats it; at the end, what was computed, and what less than five times: of several runs
together if COUNTS in the environment names a file to which they add. The exit status is 1 where a relation fails.
"""

import importlib
import itertools
import os
import signal
import sys
import time
from contextlib import contextmanager
from functools import partial
from pathlib import Path

os.environ.setdefault("DRJIT_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path += [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "optiland_records" / "stand_in")]

import numpy as np

import mitsuba_plenoptic  # noqa: F401  chooses LLVM before Dr.Jit loads

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

mi.set_variant("llvm_ad_mono")
from camera_draws import Draw  # noqa: E402
from coverage_of_draws import Tally  # noqa: E402
from relation import RELATIONS, TooLongError, draw_of, judged, shrunk  # noqa: E402

for kind in ("captures", "extensions", "files", "images", "maps", "microscopes", "models", "points", "sensors"):
    importlib.import_module(f"of_{kind}")

GRACE = 10.0
"""Seconds after the end that a draw, or a failure that loses options, may take."""

LONGEST = 60.0
"""Seconds of processor time that one draw may take, so that other work on the machine ends none."""


def stop(*_):
    raise TooLongError


@contextmanager
def limited(end):
    """End a draw after its processor time, or where the hunt ends."""
    try:
        signal.setitimer(signal.ITIMER_PROF, LONGEST)
        signal.setitimer(signal.ITIMER_REAL, max(end - time.monotonic(), 0.1))
        yield
    finally:
        for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
            signal.setitimer(timer, 0)


def again(name, draw):
    """Return the word by which a draw of a relation is judged again."""
    return f"{name}:{draw.seed}:{','.join(draw.options)}"


def hunt(seconds, seed):
    """Return how many draws fail; print them, and at the end what was computed."""
    end = time.monotonic() + seconds
    for name in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(name, stop)
    tally = Tally()
    # In an order of the seed's own, so that short hunts do not try the same relations.
    spent = dict.fromkeys(np.random.default_rng(seed).permutation(list(RELATIONS)).tolist(), 0.0)
    for number in itertools.count(seed * 10**6):
        if time.monotonic() > end:
            break
        # Relations of what was computed least have five times the time of others.
        name = min(spent, key=lambda each: spent[each] / (5 if tally.wants(RELATIONS[each]) else 1))
        relation, start = RELATIONS[name], time.process_time()
        with limited(end + GRACE):
            outcome = judged(relation, draw_of(relation, number, partial(tally.times, relation)))
        if outcome.verdict == "fails":
            outcome = shrunk(relation, outcome, end + GRACE)
            print(f"{again(name, outcome.draw)}  {outcome.words}  {outcome.draw.parameters}", flush=True)
        # Arrays of all sizes would be kept for reuse.
        dr.flush_malloc_cache()
        spent[name] += time.process_time() - start
        tally.add(relation, outcome)
    print(f"{sum(spent.values()):.0f} s of processor time")
    tally.report()
    return tally.failures


if __name__ == "__main__":
    if ":" in sys.argv[1]:
        name, seed, options = sys.argv[1].split(":")
        outcome = judged(RELATIONS[name], Draw(int(seed), options.split(",") if options else []))
        print(outcome.verdict, outcome.words, outcome.draw.parameters)
        sys.exit(outcome.verdict == "fails")
    sys.exit(bool(hunt(float(sys.argv[1]), int(sys.argv[2]))))
