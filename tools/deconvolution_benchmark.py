"""Time deconvolution at full size: planning, one application of the response and of its adjoint, and memory.

The paper's camera, 4096 x 4096 pixels, a plane at 253 mm, four bins a lens. Wall-clock and processor time, the best of
three, and the peak memory of the process. Exits with 1 if forward and adjoint together take more than 20 s of
wall-clock time, or the process more than 8 GiB.

    python tools/deconvolution_benchmark.py --output out [--distance 253] [--oversample 4]
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from typing import TypeVar

import accuracy
import numpy as np

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.reconstruction.deconvolution.response import Response

Result = TypeVar("Result")

MOST_SECONDS, MOST_MEMORY = 20.0, 8.0
COLUMNS = {"step": "{step}", "wall (s)": "{wall:.1f}", "processor (s)": "{processor:.1f}", "peak (GiB)": "{peak:.2f}"}


def timed(step: str, work: Callable[[], Result], rows: list[accuracy.Row], repeats: int = 3) -> Result:
    """Do some work a few times, and note the best."""
    times = []
    for _ in range(repeats):
        wall, processor = time.perf_counter(), time.process_time()
        result = work()
        times.append((time.perf_counter() - wall, time.process_time() - processor))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    rows.append({"step": step, "wall": min(times)[0], "processor": min(times)[1], "peak": peak / 2**30})
    print(accuracy.markdown(COLUMNS, rows[-1:]).splitlines()[-1], flush=True)
    return result


def main() -> int:
    """Time the steps, and judge them."""
    parser = accuracy.options("deconvolution_benchmark", __doc__)
    parser.add_argument("--distance", type=float, default=253.0)
    parser.add_argument("--oversample", type=int, default=4)
    given = accuracy.start(parser)
    rows: list[accuracy.Row] = []
    options = {"wavelength": 633.0, "oversample": given.oversample}
    response = timed("plan", lambda: Response(PlenopticCamera(), [given.distance], **options), rows, 1)
    values = np.random.default_rng(0).random(response.planes[0].shape).astype(np.float32)
    image = timed("forward", lambda: response.forward([values]), rows)
    timed("adjoint", lambda: response.adjoint(image), rows)
    accuracy.finish(given, rows, accuracy.markdown(COLUMNS, rows))
    return int(rows[1]["wall"] + rows[2]["wall"] > MOST_SECONDS or rows[2]["peak"] > MOST_MEMORY)


if __name__ == "__main__":
    raise SystemExit(main())
