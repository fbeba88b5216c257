"""Time deconvolution at full size: planning, one application of the response and of its adjoint, and memory.

The paper's camera, 4096 x 4096 pixels, a plane at 253 mm, four bins a lens. Wall-clock and processor time, the best of
three, and the peak memory of the process. Then the same of 1, 2 and 4 planes between 253 and 262 mm on a quarter of the
detector's width, forward and adjoint together. Exits with 1 if forward and adjoint together take more than 20 s of
wall-clock time, the process more than 8 GiB, or four planes more than 1.4 times the processor time of one each.

    python tools/deconvolution_benchmark.py --output out [--distance 253] [--oversample 4] [--resolution 4096]
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import accuracy
import numpy as np
from verdict import Verdict

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.reconstruction.deconvolution.response import Response

Result = TypeVar("Result")

MOST_SECONDS, MOST_MEMORY, MOST_GROWTH = 20.0, 8.0, 1.4
PLANES = (253.0, 256.0, 259.0, 262.0)
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
    parser.add_argument("--resolution", type=int, default=4096, help="pixels across, of 2 um")
    given = accuracy.start(parser)
    rows: list[accuracy.Row] = []
    camera = PlenopticCamera(detector_width=2e-3 * given.resolution, resolution=(given.resolution, given.resolution))

    def planned(planes: Sequence[float], part: PlenopticCamera) -> Response:
        return Response(part, planes, wavelength=633.0, oversample=given.oversample)

    response = timed("plan", lambda: planned([given.distance], camera), rows, 1)
    values = np.random.default_rng(0).random(response.planes[0].shape).astype(np.float32)
    image = timed("forward", lambda: response.forward([values]), rows)
    timed("adjoint", lambda: response.adjoint(image), rows)
    pixels = given.resolution // 4
    quarter = PlenopticCamera(detector_width=2e-3 * pixels, resolution=(pixels, pixels))
    for count in (1, 2, 4):
        several = planned(PLANES[:count], quarter)
        lit = [np.ones(plane.shape, np.float32) for plane in several.planes]

        def both(several: Response = several, lit: list[np.ndarray] = lit) -> object:
            return several.adjoint(several.forward(lit))

        timed(f"forward and adjoint of {count}, {pixels} pixels", both, rows)
    accuracy.finish(given, rows, accuracy.markdown(COLUMNS, rows))
    verdict = Verdict()
    verdict.judge("forward and adjoint", rows[1]["wall"] + rows[2]["wall"], MOST_SECONDS, "s")
    verdict.judge("memory", rows[-1]["peak"], MOST_MEMORY, "GiB")
    verdict.judge("four planes over four times one", rows[-1]["processor"] / 4 / rows[3]["processor"], MOST_GROWTH)
    return int(not verdict.kept)


if __name__ == "__main__":
    raise SystemExit(main())
