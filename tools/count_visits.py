"""Count which files of the package four typical calls visit, and what they construct again and again.

    python tools/count_visits.py

For a ray capture, a wave capture, a coherent reconstruction and a gradient of a small camera a call profiler notes each
function of the package that is entered, in all threads. The last line is JSON: the files visited by each call, and how
often one call makes a main lens, checks a camera or makes a lattice.
"""

from __future__ import annotations

import json
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

BUILT = {
    "thin lenses": ("lenses/thin.py", "__post_init__"),
    "checks": ("camera/plenoptic_camera.py", "require_whole"),
    "lattices": ("array/arrangement.py", "make_lattice"),
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
    # The package's `__getattr__` serves a public name once, which is a part of its import.
    render_capture, operator = mp.render_capture, mp.CaptureOperator
    return {
        "ray capture": lambda: render_capture(scene, model="ray", spp=2),
        "wave capture": lambda: render_capture(scene, model="wave", spp=2),
        "coherent reconstruction": lambda: mp.reconstruct(capture, 240.0, method="coherent", wavelength=WAVELENGTH),
        "gradient": lambda: operator(CAMERA, points, wavelength=WAVELENGTH).gradient(np.ones(len(points)), image),
    }


def main() -> None:
    """Run the command."""
    for file, _ in BUILT.values():
        if not (PACKAGE / file).exists():
            sys.exit(f"tools/count_visits.py: there is no {file}, whose functions BUILT counts")
    rows: dict[str, Any] = {}
    most = 0
    for name, call in calls().items():
        entered = visited(call)
        rows[f"files visited by a {name}"] = sorted({file for file, _ in entered})
        most = max(most, *(entered[key] for key in BUILT.values()))
    print(json.dumps(rows | {"most lenses, checks or lattices made by a call": most}))


if __name__ == "__main__":
    main()
