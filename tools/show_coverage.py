"""Print the coverage that `make coverage` measured, and put it into the README: ``python tools/show_coverage.py``.

The README's figure stands between ``<!-- coverage -->`` and ``<!-- /coverage -->``, so that no one writes it by hand.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import coverage

ROOT = Path(__file__).resolve().parent.parent
FIGURE = re.compile(r"(?<=<!-- coverage -->).*?(?=<!-- /coverage -->)")


def with_figure(text: str, percent: float) -> str:
    """Replace the figure in a text that has the marks."""
    return FIGURE.sub(f"{percent:.0f} %", text)


def main() -> int:
    """Print one line; leave a README that already says so as it is."""
    data = coverage.Coverage(config_file=str(ROOT / "pyproject.toml"))
    data.load()
    with (ROOT / "build" / "coverage" / "report.txt").open("w") as report:
        percent = data.report(file=report)
    print(f"coverage: {percent:.1f} % of the lines of mitsuba_plenoptic")
    readme = ROOT / "README.md"
    text = readme.read_text()
    if (changed := with_figure(text, percent)) != text:
        readme.write_text(changed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
