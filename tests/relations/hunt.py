"""Try relations on random cameras for a time: python tests/relations/hunt.py SECONDS SEED, or RELATION:SEED:OPTIONS.

A line a failure, with what repeats it; at the end, what was computed. The exit status is 1 where a relation fails.
"""

import itertools
import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path

os.environ.setdefault("DRJIT_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path += [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "optiland_records" / "stand_in")]

import mitsuba_plenoptic  # noqa: F401  chooses LLVM before Dr.Jit loads

import mitsuba as mi  # isort: skip

mi.set_variant("llvm_ad_mono")
import of_captures  # noqa: E402, F401
import of_points  # noqa: E402, F401
from camera_draws import OPTIONS, Draw  # noqa: E402
from relation import RELATIONS, TooLongError, draw_of, judged, shrunk  # noqa: E402

GRACE = 10.0
"""Seconds after the end that a draw, or a failure that loses options, may take."""

LONGEST = 60.0
"""Seconds that one draw may take."""


def stop(*_):
    raise TooLongError


def again(name, draw):
    """Return the word by which a draw of a relation is judged again."""
    return f"{name}:{draw.seed}:{','.join(draw.options)}"


def hunt(seconds, seed):
    """Return how many draws fail; print them, and at the end what was computed."""
    end = time.monotonic() + seconds
    signal.signal(signal.SIGALRM, stop)
    verdicts, spent, options, pairs = Counter(), Counter(dict.fromkeys(RELATIONS, 0.0)), Counter(), Counter()
    for number in itertools.count(seed * 10**6):
        if time.monotonic() > end:
            break
        name = min(RELATIONS, key=lambda each: spent[each])
        relation, start = RELATIONS[name], time.monotonic()
        signal.setitimer(signal.ITIMER_REAL, min(LONGEST, end + GRACE - start))
        outcome = judged(relation, draw_of(relation, number))
        signal.setitimer(signal.ITIMER_REAL, 0)
        if outcome.verdict == "fails":
            outcome = shrunk(relation, outcome, end + GRACE)
            print(f"{again(name, outcome.draw)}  {outcome.words}  {outcome.draw.parameters}", flush=True)
        spent[name] += time.monotonic() - start
        verdicts[name, outcome.verdict] += 1
        if outcome.verdict == "computed":
            options.update(outcome.draw.options)
            pairs.update(itertools.combinations(outcome.draw.options, 2))
    report(verdicts, spent, options, pairs)
    return sum(count for (_, verdict), count in verdicts.items() if verdict == "fails")


def report(verdicts, spent, options, pairs):
    """Print what became of each relation's draws, and which options and pairs of them were computed."""
    for name in RELATIONS:
        counts = {verdict: count for (each, verdict), count in verdicts.items() if each == name}
        print(f"{name}: {', '.join(f'{count} {verdict}' for verdict, count in counts.items())}; {spent[name]:.0f} s")
    print("computed: " + ", ".join(f"{name} {options[name]}" for name in OPTIONS))
    print(f"pairs of options computed: {len(pairs)}; five times: {sum(n >= 5 for n in pairs.values())}")


if __name__ == "__main__":
    if ":" in sys.argv[1]:
        name, seed, options = sys.argv[1].split(":")
        outcome = judged(RELATIONS[name], Draw(int(seed), options.split(",") if options else []))
        print(outcome.verdict, outcome.words, outcome.draw.parameters)
        sys.exit(outcome.verdict == "fails")
    sys.exit(bool(hunt(float(sys.argv[1]), int(sys.argv[2]))))
