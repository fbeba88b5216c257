"""What the accuracy tools share: their options, and the tables and pictures that they write."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic.report.experiment import agreement
from mitsuba_plenoptic.report.output_files import write_png

Row = dict[str, Any]


def options(
    tool: str, description: str | None, *, spp: int | None = None, reference_spp: int | None = None
) -> argparse.ArgumentParser:
    """Return a tool's parser: where it writes, and those numbers of samples for which a default is given."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out") / tool, help="folder for tables and pictures")
    if spp:
        parser.add_argument("--spp", type=int, default=spp, help="samples per detector pixel")
    if reference_spp:
        parser.add_argument("--reference-spp", type=int, default=reference_spp, help="samples per pixel of `thinlens`")
    parser.set_defaults(tool=tool)
    return parser


def start(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Read the options, make the folder, and choose the variant."""
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")
    return arguments


def finish(arguments: argparse.Namespace, results: object, *texts: str) -> None:
    """Write the results as JSON and texts and tables as Markdown, both named after the tool, and print the latter."""
    text = "\n".join(texts)
    (arguments.output / f"{arguments.tool}.json").write_text(json.dumps(results, indent=1) + "\n")
    (arguments.output / f"{arguments.tool}.md").write_text(text)
    print(text)


def markdown(columns: Mapping[str, str], rows: Iterable[Row]) -> str:
    """Return rows as a table whose columns have a heading and a format each, such as ``"{psnr_db:.1f}"``."""
    lines = [" | ".join(cell.format(**row) for cell in columns.values()) for row in rows]
    return "\n".join(
        [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|", *(f"| {line} |" for line in lines), ""]
    )


def scores(images: Sequence[np.ndarray], references: Sequence[np.ndarray]) -> tuple[float, list[Row]]:
    """Return the one scale that suits all images best, and how well each then agrees with its reference."""
    scale, found = agreement(images, references)
    names = ("psnr_db", "correlation", "scale")
    return scale, [dict(zip(names, (round(psnr, 2), round(c, 5), round(scale, 4)), strict=True)) for psnr, c in found]


def write_comparison(path: Path, image: np.ndarray, reference: np.ndarray) -> None:
    """Write image, reference and their difference, on mid-grey, side by side."""
    peak = float(reference.max())
    write_png(path, np.concatenate([image, reference, 0.5 * peak + (image - reference)], 1), peak=peak)
