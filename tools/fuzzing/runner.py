"""Draws cases from strategies, has them evaluated in processes that may die or hang, and shrinks what is found."""

from __future__ import annotations

import multiprocessing
import queue
import random
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from hypothesis import Phase, find, settings
from hypothesis.errors import NoSuchExample

from .parts import Code
from .verdict import FINE, PATIENCE, Verdict, serve

SECONDS = 40.0
"""Processor time that one case may take."""

# A process that imports the package on a busy machine.
_START = 120.0
# The time and the number of evaluations that shrinking a finding may take.
_SHRINKING = 30.0, 300


class Kind(NamedTuple):
    """A kind of input: its name, how many there are of it in proportion to others, and where cases come from."""

    name: str
    weight: int
    cases: Code


@dataclass
class Finding:
    """A case that should not end as it does, as small as it could be made."""

    kind: str
    case: str
    outcome: str
    details: str
    count: int = 1


@dataclass
class Report:
    """What became of all cases."""

    seed: int
    seconds: float = 0.0
    counts: dict[str, Counter[str]] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    slowest: list[tuple[float, str]] = field(default_factory=list)


class Worker:
    """A process that evaluates cases one after the other, and is replaced when one of them ends it."""

    def __init__(self, seconds: float = SECONDS) -> None:
        self._seconds = seconds
        self._log = tempfile.NamedTemporaryFile(prefix="fuzz-", suffix=".log")  # noqa: SIM115 (it lasts as long as this)
        self._start()

    def judge(self, case: str) -> Verdict:
        """Evaluate a case, and find out how the process ended if it did."""
        try:
            self._connection.send(case)
            # A second for what the process itself writes about where it was.
            if self._connection.poll(PATIENCE * self._seconds + 1):
                verdict: Verdict = self._connection.recv()
                return verdict
            outcome, place = "too long", "it does not come back"
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode or 0
            outcome, place = "crash", signal.Signals(-code).name if code < 0 else f"status {code}"
            if code == -signal.SIGPROF:
                outcome, place = "too long", f"more than {self._seconds:g} s of processor time"
        log = self._read_log().partition("\nExtension modules:")[0]
        self.close()
        self._start()
        return Verdict(outcome, f"{place}\n{log[-3000:]}".strip(), place)

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, self._log.name, self._seconds), daemon=True)
        self._process.start()
        # Only the process itself keeps its end open, so that its death shows.
        theirs.close()
        try:
            if self._connection.poll(_START):
                self._connection.recv()
                return
        except EOFError:
            pass
        raise RuntimeError(f"a process did not start:\n{self._read_log()}")

    def _read_log(self) -> str:
        return Path(self._log.name).read_text(errors="replace")

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._connection.close()


def draw(kind: Kind, count: int, seed: int) -> dict[str, str]:
    """Draw different cases, fewer where a kind has not so many; each with the seed of the round that it comes from."""
    drawn: dict[str, str] = {}
    for turn in range(count):
        if len(drawn) < count:
            round_seed = f"{seed} {kind.name} {turn}"
            _search(kind, round_seed, lambda case, seed=round_seed: bool(drawn.setdefault(case, seed)) and False)
    return dict(list(drawn.items())[:count])


def _search(kind: Kind, seed: str, condition: Callable[[str], bool]) -> str | None:
    """Draw a round of cases, the same for the same seed, until one meets a condition; return the smallest that does."""
    # In a longer round Hypothesis goes on with variants of the cases that it has drawn, many of them nearly the same.
    chosen = settings(max_examples=10, phases=[Phase.generate, Phase.shrink], database=None, deadline=None)
    try:
        return find(kind.cases, condition, settings=chosen, random=random.Random(seed))
    except NoSuchExample:
        return None


def fuzz(
    kinds: Sequence[Kind],
    count: int,
    seed: int,
    *,
    workers: int = 1,
    seconds: float = SECONDS,
    notify: Callable[[int], None] = lambda done: None,
) -> Report:
    """Evaluate cases of several kinds, and shrink those that are findings.

    Parameters
    ----------
    kinds : sequence of Kind
        What to draw from.
    count : int
        Number of cases in all; fewer where a kind has not so many.
    seed : int
        Draws others.
    workers : int
        Number of processes.
    seconds : float
        Processor time that one case may take.
    notify : callable
        Told how many cases are done.
    """
    report, start = Report(seed), time.perf_counter()
    idle: queue.Queue[Worker] = queue.Queue()
    with ThreadPoolExecutor(workers) as pool:
        everyone = list(pool.map(Worker, [seconds] * workers))
    for worker in everyone:
        idle.put(worker)

    def judge(case: str) -> tuple[Verdict, float]:
        worker = idle.get()
        begun = time.perf_counter()
        try:
            return worker.judge(case), time.perf_counter() - begun
        finally:
            idle.put(worker)

    total = sum(kind.weight for kind in kinds)
    drawn: list[tuple[Kind, str, str, Future[tuple[Verdict, float]]]] = []
    with ThreadPoolExecutor(workers) as pool:
        for kind in kinds:
            cases = draw(kind, -(-count * kind.weight // total), seed)
            drawn += [(kind, case, turn, pool.submit(judge, case)) for case, turn in cases.items()]
        for done, (*_, future) in enumerate(drawn, 1):
            future.result()
            notify(done)
    report.slowest = sorted(((future.result()[1], case) for _, case, _, future in drawn), reverse=True)[:20]
    verdicts = {case: future.result()[0] for _, case, _, future in drawn}
    found: dict[tuple[Kind, str, str], list[tuple[str, str]]] = {}
    for kind, case, turn, _ in drawn:
        outcome, _, place = verdicts[case]
        report.counts.setdefault(kind.name, Counter())[outcome] += 1
        if outcome not in FINE:
            found.setdefault((kind, outcome, place), []).append((case, turn))
    for (kind, outcome, place), cases in found.items():
        first, turn = cases[0]
        smallest = _shrink(kind, turn, (outcome, place), everyone[0], verdicts) or first
        report.findings.append(Finding(kind.name, smallest, outcome, verdicts[smallest].details, len(cases)))
    for worker in everyone:
        worker.close()
    report.seconds = time.perf_counter() - start
    return report


def _shrink(kind: Kind, seed: str, wanted: tuple[str, str], worker: Worker, verdicts: dict[str, Verdict]) -> str | None:
    """Draw a round again, up to the first case that ends as wanted, and make that one small."""
    seconds, evaluations = _SHRINKING
    end, most = time.perf_counter() + seconds, len(verdicts) + evaluations

    def condition(case: str) -> bool:
        if case not in verdicts:
            if time.perf_counter() > end or len(verdicts) > most:
                return False
            verdicts[case] = worker.judge(case)
        return (verdicts[case].outcome, verdicts[case].place) == wanted

    return _search(kind, seed, condition)
