"""Sums of point spreads on two worker processes against one process."""

from __future__ import annotations

import numpy as np

from mitsuba_plenoptic.runtime.batches import BatchMap, Threads
from mitsuba_plenoptic.runtime.cluster import Cluster
from mitsuba_plenoptic.runtime.jobs import Job

from .point_spreads import ScenePoints
from .table import Row, side_by_side

_PARAMETERS = {"resolution": "1024", "detector_width": "2.048", "letter_scale": "0.125"}
_WORKERS = 2


def run(runs: int) -> list[Row]:
    """Sum the letters at an eighth of their size on one thread, on two, and on two processes of one thread each."""
    points = ScenePoints.of("letters", _PARAMETERS)
    images = {}

    def add(name: str, batch_map: BatchMap) -> None:
        images[name] = points.operator().forward(points.weights, job=Job(batch_map=batch_map))

    with Cluster(workers=_WORKERS) as cluster:
        timings = side_by_side(
            {
                "processes": lambda: add("processes", cluster),
                "thread": lambda: add("thread", Threads(1)),
                "threads": lambda: add("threads", Threads(_WORKERS)),
            },
            runs,
        )
    same = all(np.array_equal(image, images["thread"]) for image in images.values())
    note = f"the bits are {'the same' if same else 'NOT the same'}"
    return [
        Row(
            f"letters, {points}, sum on {_WORKERS} processes", "s",
            timings["processes"].seconds, against, timings[name].seconds, timings[name].ratio, None, note,
        )
        for name, against in (("thread", "one process, one thread"), ("threads", f"one process, {_WORKERS} threads"))
    ]  # fmt: skip
