"""Give the package thousands of bad inputs, and report what became of each kind.

An input must be refused in one line (`InputError`, or status 2 of the command), or, where a mutation broke no rule,
give a finite result. Anything else is a finding: a traceback, a process that dies, more than 10 seconds, a result that
is not finite, and a value that the documentation forbids but the package takes.

    python tools/fuzz.py -o fuzz --count 10000
    python tools/fuzz.py --replay "EXR: damaged bytes" 17
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from fuzzing.engine import FINE, Report, run, shares


def write_report(folder: Path, report: Report) -> str:
    """Write ``report.md`` and ``report.json``; give the first one's text."""
    counts = report.counts()
    outcomes = [*FINE, *sorted({outcome for count in counts.values() for outcome in count} - set(FINE))]
    lines = [
        "# Bad inputs",
        "",
        f"{len(report.results)} inputs, seed {report.seed}, {report.seconds:.0f} s: {len(report.findings)} findings.",
        "",
        "| kind | inputs | " + " | ".join(outcomes) + " |",
        "|---" * (len(outcomes) + 2) + "|",
    ]
    for kind, count in counts.items():
        cells = [kind, str(count.total()), *(str(count[outcome]) for outcome in outcomes)]
        lines.append(f"| {' | '.join(cells)} |")
    total = sum(counts.values(), start=type(next(iter(counts.values())))())
    lines += [f"| all | {total.total()} | " + " | ".join(str(total[outcome]) for outcome in outcomes) + " |", ""]
    for found in report.findings:
        lines += [
            f"## {found.outcome}: {found.kind} {found.index}",
            "",
            f"{found.what[:1000]}",
            "",
            f'`python tools/fuzz.py --seed {report.seed} --replay "{found.kind}" {found.index}`',
            "",
            "```",
            found.text,
            "```",
            "",
        ]
    text = "\n".join(lines)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.md").write_text(text)
    slowest = sorted(report.results, key=lambda result: -result.seconds)[:20]
    content = {
        "seed": report.seed,
        "seconds": round(report.seconds, 1),
        "counts": counts,
        "findings": [asdict(found) for found in report.findings],
        "slowest": [asdict(result) for result in slowest],
    }
    (folder / "report.json").write_text(json.dumps(content, indent=1) + "\n")
    return text


def main() -> int:
    """Run what the command line asks for; status 1 if there are findings."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=10_000, help="inputs in all (default 10000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=min(os.cpu_count() or 1, 8))
    parser.add_argument("--only", help="kinds whose name holds this")
    parser.add_argument("--replay", nargs=2, metavar=("KIND", "INDEX"), help="run one input and tell all about it")
    parser.add_argument("-o", "--output", type=Path, default=Path("fuzz"), help="folder for the report")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()

    # The package, slow to load, only where cases run.
    if options.worker:
        from fuzzing.worker import main as work

        work(options.seed)
        return 0
    from fuzzing.worker import KINDS, LIMIT_GIB

    if options.replay:
        kind, index = options.replay
        (result,) = run([(kind, int(index))], seed=options.seed, workers=1, memory_gib=LIMIT_GIB).results
        print(f"{result.what}\n{result.outcome} after {result.seconds:.2f} s\n{result.text}")
        return result.outcome not in FINE
    kinds = {kind: share for kind, (share, _) in KINDS.items() if (options.only or "") in kind}
    cases = shares(options.count, kinds)

    def notify(done: int, total: int) -> None:
        if done % 500 == 0 or done == total:
            print(f"{done} of {total}", file=sys.stderr, flush=True)

    report = run(cases, seed=options.seed, workers=options.workers, memory_gib=LIMIT_GIB, notify=notify)
    print(write_report(options.output, report).partition("\n## ")[0])
    for found in report.findings[:50]:
        print(f"{found.outcome}: {found.kind} {found.index}: {found.what[:150]}")
    return bool(report.findings)


if __name__ == "__main__":
    raise SystemExit(main())
