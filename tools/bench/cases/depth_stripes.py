"""Depth maps of stripes to which nothing was fitted: other phases, directions, distances and periods."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import numpy as np

from .. import Pivot, Row, at_least, case, pick
from ..scenes.depth import CAMERAS, STRIPES
from .depth import NEAR_BY, captured, estimated, exposed, judged, rates, shown_rates

PHOTONS = (0, 500)


@case(
    "depth.stripes",
    "Depths stated of stripes that several planes explain alike, on captures by which nothing was chosen: of all bins, "
    "those with a stated depth, of these those within 1 %, and of the depths stated with a confidence above 0.9 those "
    "within 1 % (all in %)",
    {
        "scene": "{scene}", "camera": "{camera}", "photons": "{photons}", "stated": "{stated:.0%}",
        "right of these": "{right:.0%}", "confidence above 0.9": "{sure:.0%}",
        "right of these sure": "{sure_right:.0%}", "confidence: rate (bins)": "{tenths}",
    },
    (at_least("sure_right", 0.85),),
    page="docs/theory/depth.md",
    pivot=Pivot(
        "{scene}", "{camera}", "{stated_percent}, {right_percent}, {sure_percent}", lambda row: row["camera"] != "all"
    ),
    quick={"scenes": ("stripes of 2 lenses",), "cameras": ("focused",)},
)  # fmt: skip
def stripes(*, scenes: tuple[str, ...] = (), cameras: tuple[str, ...] = (), captures: str = "") -> Iterator[Row]:
    """Record two cards with stripes, one before the other, without noise and with 500 photons in a pixel of value 1.

    ``captures`` is a folder for rendered captures, which are read from there again.
    """
    mi.set_log_level(mi.LogLevel.Error)
    confidence, right = [], []
    for name in pick(STRIPES, scenes):
        for camera in pick(CAMERAS, cameras):
            capture, known = captured(name, camera, Path(captures) if captures else None, "held out")
            for photons in PHOTONS:
                found = estimated(exposed(capture, photons, 9), known)
                inside = np.isfinite(found["truth"])
                confidence.append(found["confidence"][inside])
                right.append(np.abs(found["guess"] / found["truth"] - 1)[inside] < NEAR_BY)
                row = judged(found, None)
                row["right_percent"] = "-" if row["right"] is None else f"{100 * row['right']:.0f}"
                yield {"scene": name, "camera": camera, "photons": photons or "no noise", **row}
    tenths = rates(np.concatenate(confidence), np.concatenate(right), np.zeros(sum(map(len, right))))
    yield {"scene": "all", "camera": "all", "tenths": shown_rates(tenths)}
