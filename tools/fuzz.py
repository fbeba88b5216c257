"""Give the package thousands of bad inputs, and report what became of each kind.

An input must be refused in one line (`InputError`, or status 2 of the command), or, where it breaks no rule, give a
finite result of the right shape. Anything else is a finding: another exception, a process that dies or takes more than
forty seconds, numbers that are not finite, and a value that the documentation forbids but the package takes.

    python tools/fuzz.py -o fuzz --count 10000
    python tools/fuzz.py --replay "forbidden(Detector(bits=17))"
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import sys
from collections import Counter
from pathlib import Path

from fuzzing.cases import KINDS
from fuzzing.runner import Report, Worker, fuzz
from fuzzing.verdict import FINE


def write_report(folder: Path, report: Report) -> str:
    """Write ``report.md`` and ``report.json``; return what the first one says before the findings."""
    total = sum(report.counts.values(), Counter())
    outcomes = [*FINE, *sorted(set(total) - set(FINE))]
    lines = [
        "# Bad inputs",
        "",
        f"{total.total()} inputs, seed {report.seed}, {report.seconds:.0f} s: {len(report.findings)} findings.",
        "",
        f"| kind | inputs | {' | '.join(outcomes)} |",
        "|---" * (len(outcomes) + 2) + "|",
    ]
    for kind, count in [*report.counts.items(), ("all", total)]:
        lines.append(f"| {kind} | {count.total()} | {' | '.join(str(count[outcome]) for outcome in outcomes)} |")
    summary = "\n".join([*lines, ""])
    lines = [summary]
    for found in report.findings:
        lines += [f"## {found.outcome}: {found.kind}, {found.count} inputs", "", "```", found.details, "```", ""]
        lines += ["```sh", f"python tools/fuzz.py --replay {shlex.quote(found.case)}", "```", ""]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.md").write_text("\n".join(lines))
    content = {**vars(report), "findings": [vars(found) for found in report.findings]}
    (folder / "report.json").write_text(json.dumps(content, indent=1) + "\n")
    return summary


def main() -> int:
    """Run what the command line asks for; status 1 if there are findings."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=10_000, help="inputs in all (default 10000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=min(os.cpu_count() or 1, 8))
    parser.add_argument("--only", default="", help="kinds whose name holds this")
    parser.add_argument("--replay", metavar="CASE", help="evaluate one case of a report and print all about it")
    parser.add_argument("-o", "--output", type=Path, default=Path("fuzz"), help="folder for the report")
    options = parser.parse_args()
    if options.replay:
        worker = Worker()
        verdict = worker.judge(options.replay)
        worker.close()
        print(f"{verdict.outcome}\n{verdict.details}".strip())
        return verdict.outcome not in FINE

    def notify(done: int) -> None:
        if done % 500 == 0:
            print(f"{done} of {options.count}", file=sys.stderr, flush=True)

    kinds = [kind for kind in KINDS if options.only in kind.name]
    report = fuzz(kinds, options.count, options.seed, workers=options.workers, notify=notify)
    print(write_report(options.output, report))
    for found in report.findings:
        print(f"{found.outcome}, {found.count} of {found.kind}: {found.case[:200]}")
    return bool(report.findings)


if __name__ == "__main__":
    raise SystemExit(main())
