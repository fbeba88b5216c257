"""Time and memory, side by side with what they are measured against: the figures quoted in the README.

Things compared are timed in turn in the same run, so that their ratios hold on a noisy machine; the table gives medians
over the runs. Written as Markdown and JSON. Libraries compared with: `pip install -e '.[peers]'`.

    python tools/benchmark.py --output out/benchmark [--only steps --only sharing] [--runs 5]
    python tools/benchmark.py --only reconstructions --old ../version-0.1
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import platform
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import scipy
from benchmarks import captures, gpu, growth, point_spreads, reconstructions, shares, steps, workers
from benchmarks.table import markdown

from mitsuba_plenoptic.runtime.fft import worker_count


def main() -> None:
    """Run the sections and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/benchmark"))
    parser.add_argument("--runs", type=int, default=5, help="counted runs of each")
    parser.add_argument(
        "--size", type=int, action="append", help="of the steps and detectors; default: 1024, 2048, 4096, 8192"
    )
    parser.add_argument("--memory", type=float, default=8.0, help="GiB that one library's step may take; default: 8")
    parser.add_argument(
        "--scene", action="append", default=[], choices=point_spreads.SCENES,
        help="of sharing: its whole capture instead of parts and estimates; takes up to an hour",
    )  # fmt: skip
    parser.add_argument(
        "--old", type=Path, help="folder of an older version with its .venv, whose reconstructions are timed, too"
    )
    parser.add_argument("--resolution", type=int, default=4096, help="pixels across the detector of ray captures")
    sections = {
        "steps": lambda: steps.run(sizes, arguments.runs, arguments.memory),
        "gpu": lambda: gpu.run([size for size in sizes if size >= 1024], arguments.runs),
        "point-spreads": lambda: [
            *point_spreads.bare(arguments.runs),
            *point_spreads.adjoint(arguments.runs),
            *point_spreads.peers(),
        ],
        "sharing": lambda: (
            [row for scene in arguments.scene for row in point_spreads.whole(scene)]
            or [*point_spreads.sharing(), *point_spreads.estimates()]
        ),
        "workers": lambda: workers.run(arguments.runs),
        "captures": lambda: [
            *captures.samples_per_second(arguments.resolution, arguments.runs),
            *captures.command(arguments.resolution, 16),
        ],
        "reconstructions": lambda: reconstructions.run(arguments.runs, arguments.old),
        "shares": shares.run,
        "growth": lambda: growth.run(sizes, arguments.runs),
    }
    parser.add_argument("--only", action="append", choices=sections, help="a section; default: all")
    arguments = parser.parse_args()
    sizes = arguments.size or [1024, 2048, 4096, 8192]
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")
    versions = {"python": platform.python_version(), "numpy": np.__version__, "scipy": scipy.__version__}
    machine = {"threads": worker_count(), **versions, "mitsuba": mi.__version__}
    texts, results = [", ".join(f"{name} {value}" for name, value in machine.items()) + "\n"], {}
    for name in arguments.only or sections:
        start = time.perf_counter()
        rows = list(sections[name]())
        texts.append(f"## {name}\n\n{markdown(rows)}")
        results[name] = [dataclasses.asdict(row) for row in rows]
        print(f"{texts[-1]}({time.perf_counter() - start:.0f} s)\n", flush=True)
        # After every section, so that what has been measured is not lost.
        (arguments.output / "benchmark.md").write_text("\n".join(texts))
        (arguments.output / "benchmark.json").write_text(json.dumps({"machine": machine, "rows": results}, indent=1))


if __name__ == "__main__":
    main()
