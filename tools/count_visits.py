"""Count which files of the package four typical calls visit, and what they construct again and again.

    python tools/count_visits.py [--files] [--calls]

For a ray capture, a wave capture, a coherent reconstruction and a gradient of a small camera a call profiler notes each
function of the package that is entered, in all threads. The table lists the files visited, with their limits, and how
often main lenses, checks of the camera and lattices were made, of which each should be made at most three times.
`--files` lists the files too, `--calls` the functions that were called most often. The exit status is 1 where a limit
is exceeded.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import mitsuba_plenoptic as mp  # noqa: E402

PACKAGE = Path(mp.__file__).parent
CAMERA = mp.PlenopticCamera(detector_width=0.064 * 4, resolution=(64, 64))
WAVELENGTH = 550.0
MOST_BUILT = 3

FILES = {"ray capture": 30, "wave capture": 35, "coherent reconstruction": 30, "gradient": 40}
"""Files that each of the calls may visit."""

BUILT = {
    "thin lenses": ("lenses/thin.py", "__post_init__"),
    "checks": ("camera/plenoptic_camera.py", "require_whole"),
    "lattices": ("lattice/base.py", "make_lattice"),
}
"""What is counted, by the file and the name of the function that makes it."""


def visited(call: Callable[[], Any]) -> Counter[tuple[str, str]]:
    """Return how often each function of the package is entered, by its file and its name."""
    found: Counter[tuple[str, str]] = Counter()
    folder = str(PACKAGE) + "/"

    def note(frame: Any, event: str, argument: object) -> None:
        code = frame.f_code
        # What is imported late runs a module, which is no visit.
        if event == "call" and code.co_filename.startswith(folder) and code.co_name != "<module>":
            found[code.co_filename.removeprefix(folder), code.co_name] += 1

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return found


def calls() -> dict[str, Callable[[], Any]]:
    """Return the calls that are looked at; what they share is made beforehand."""
    card = mi.ScalarTransform4f().translate([0, 0, 240]).rotate([0, 1, 0], 180)
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": CAMERA.to_sensor(),
        "card": {"type": "rectangle", "to_world": card, "emitter": {"type": "area"}},
    })  # fmt: skip
    image = np.random.default_rng(1).random((*CAMERA.shape, 1), np.float32)
    capture = mp.Capture(image, CAMERA)
    points = np.column_stack([np.linspace(-0.1, 0.1, 4), np.zeros(4), np.full(4, 235.0)])
    mp.reconstruct(capture, 240.0, method="ray")  # imports what comes late
    return {
        "ray capture": lambda: mp.render_capture(scene, model="ray", spp=2),
        "wave capture": lambda: mp.render_capture(scene, model="wave", spp=2),
        "coherent reconstruction": lambda: mp.reconstruct(capture, 240.0, method="coherent", wavelength=WAVELENGTH),
        "gradient": lambda: mp.CaptureOperator(CAMERA, points, wavelength=WAVELENGTH).gradient(
            np.ones(len(points)), image
        ),
    }


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--files", action="store_true", help="list the files that each call visits")
    parser.add_argument("--calls", action="store_true", help="list the functions that each call enters most often")
    given = parser.parse_args()
    exceeded = False
    print(f"{'':26}{'files':>6}{'limit':>6}" + "".join(f"{name:>13}" for name in BUILT))
    for name, call in calls().items():
        found = visited(call)
        files = sorted({file for file, _ in found})
        built = [found[key] for key in BUILT.values()]
        exceeded |= len(files) > FILES[name] or max(built) > MOST_BUILT
        print(f"{name:26}{len(files):6}{FILES[name]:6}" + "".join(f"{count:13}" for count in built))
        if given.files:
            print("".join(f"    {file}\n" for file in files), end="")
        if given.calls:
            for (file, function), count in found.most_common(20):
                print(f"    {count:6} {file}: {function}")
    return int(exceeded)


if __name__ == "__main__":
    sys.exit(main())
