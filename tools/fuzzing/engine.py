"""Cases spread over processes, which may die or hang, and what became of them all."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from .cases import SECONDS

FINE = ("refused", "fine")
"""Outcomes that are no findings."""

# Beyond the time limit within the process, which native code does not hear of.
_GRACE = 5
_START = 120


@dataclass
class Result:
    """What became of one case."""

    kind: str
    index: int
    what: str
    outcome: str
    text: str
    seconds: float


@dataclass
class Report:
    """What became of all of them."""

    seed: int
    seconds: float = 0.0
    results: list[Result] = field(default_factory=list)

    @property
    def findings(self) -> list[Result]:
        """Those that should not be."""
        return [result for result in self.results if result.outcome not in FINE]

    def counts(self) -> dict[str, Counter[str]]:
        """Outcomes of each kind."""
        counted: dict[str, Counter[str]] = {}
        for result in self.results:
            counted.setdefault(result.kind, Counter())[result.outcome] += 1
        return counted


def shares(count: int, kinds: dict[str, int]) -> list[tuple[str, int]]:
    """Name so many cases, of each kind its share, one kind after the other."""
    total = sum(kinds.values())
    return [(kind, index) for kind, share in kinds.items() for index in range(-(-count * share // total))]


def run(
    cases: list[tuple[str, int]],
    *,
    seed: int,
    workers: int,
    memory_gib: float,
    notify: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Run cases in processes.

    Parameters
    ----------
    cases : list of (kind, index)
        What to run.
    seed : int
        Seed of all of them.
    workers : int
        Number of processes.
    memory_gib : float
        What the package is told that it may take.
    notify : callable
        Told how many are done of how many.
    """
    report, lock = Report(seed), threading.Lock()
    start = time.perf_counter()
    # Dealt out one by one, so that slow kinds spread over all.
    waiting = iter(list(cases))

    def take() -> Iterator[tuple[str, int]]:
        while True:
            with lock:
                case = next(waiting, None)
            if case is None:
                return
            yield case

    def serve(folder: str) -> None:
        process: _Process | None = None
        for kind, index in take():
            if process is None:
                process = _Process(seed, folder, memory_gib)
            result = process.case(kind, index)
            if not process.is_alive:
                process = None
            with lock:
                report.results.append(result)
                notify(len(report.results), len(cases))
        if process is not None:
            process.close()

    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        threads = [threading.Thread(target=serve, args=(folder,)) for _ in range(workers)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    report.results.sort(key=lambda result: (result.kind, result.index))
    report.seconds = time.perf_counter() - start
    return report


class _Process:
    """One process that runs cases."""

    def __init__(self, seed: int, folder: str, memory_gib: float) -> None:
        environment = {
            **os.environ,
            "MITSUBA_PLENOPTIC_MEMORY": str(memory_gib),
            "FUZZ_FOLDER": folder,
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        tools = Path(__file__).parents[1]
        self._child = subprocess.Popen(
            [sys.executable, str(tools / "fuzz.py"), "--worker", "--seed", str(seed)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
        )
        self.is_alive = True
        self._buffer = b""
        if self._read(_START) != b"ready":
            raise RuntimeError("a worker did not start")

    def case(self, kind: str, index: int) -> Result:
        """Run one case, and find out how the process ended if it did."""
        assert self._child.stdin is not None
        start = time.perf_counter()
        self._child.stdin.write(f"{kind}\t{index}\n".encode())
        self._child.stdin.flush()
        what, line = "?", self._read(SECONDS + _GRACE)
        if line is not None:
            what = json.loads(line)["what"]
            line = self._read(SECONDS + _GRACE)
        seconds = time.perf_counter() - start
        if line is not None:
            told = json.loads(line)
            return Result(kind, index, what, told["outcome"], told["text"], seconds)
        self.is_alive = False
        code = self._child.poll()
        if seconds > SECONDS + _GRACE:
            self._child.kill()
            self._child.wait()
            return Result(kind, index, what, "too long", "killed: native code did not come back", seconds)
        code = self._child.wait()
        died = signal.Signals(-code).name if code < 0 else f"status {code}"
        return Result(kind, index, what, "crash", f"the process died: {died}", seconds)

    def close(self) -> None:
        """Let the process end."""
        assert self._child.stdin is not None
        self._child.stdin.close()
        self._child.wait(30)

    def _read(self, seconds: float) -> bytes | None:
        """Give a line of the process, or None if it dies or takes longer."""
        assert self._child.stdout is not None
        end = time.perf_counter() + seconds
        with selectors.DefaultSelector() as selector:
            selector.register(self._child.stdout, selectors.EVENT_READ)
            while b"\n" not in self._buffer:
                if not selector.select(max(0, end - time.perf_counter())):
                    return None
                data = os.read(self._child.stdout.fileno(), 65536)
                if not data:
                    return None
                self._buffer += data
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line
