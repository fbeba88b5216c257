"""How well a comparison tells noise from diffraction, from few samples and from many.

Two captures of the letters by rays, of different seeds, must differ by noise alone. Of the Cornell box, sixty times its
size and seen through a plenoptic camera at its corner between the tall box and the back wall, the difference of ray and
wave capture without noise (all pixels, the middle of micro-images, their rim) must be the same from few samples as from
many, to a tenth.

    python tools/difference_accuracy.py --output out [--lenses 12] [--samples 16 1024]
"""

from __future__ import annotations

import sys
from typing import Any

import accuracy
import mitsuba as mi

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, render_capture
from mitsuba_plenoptic.report.measurements import capture_difference, middle_of_micro_images

COLUMNS = {
    "captures": "{captures}", "pixels": "{pixels}", "samples": "{samples}", "measured": "{measured:.2%}",
    "noise": "{noise:.2%}", "without noise": "{true:.2%}", "noise alone": "{noise_alone}",
}  # fmt: skip

_SIZE = 60.0
"""Times the size of Mitsuba's Cornell box, whose walls are 2 apart: millimetres for a camera of an 80 mm lens."""

_AGREEMENT = 0.1


def main() -> int:
    """Capture, compare, and write the table; 1 if a verdict is wrong."""
    parser = accuracy.options("difference_accuracy", __doc__)
    parser.add_argument("--lenses", type=int, default=12)
    parser.add_argument("--samples", type=int, nargs="*", default=[16, 1024])
    arguments = accuracy.start(parser)
    few = min(arguments.samples)
    letters = load_scene("letters", parameters={"resolution": "384", "detector_width": "0.768"})
    rows = differences("letters, rays twice", few, *(rays(letters, few, seed) for seed in (0, 1)))
    right = all(row["noise_alone"] for row in rows)
    box = cornell_box(arguments.lenses)
    for samples in arguments.samples:
        wave = render_capture(box, model="wave", method="signed_rays", wavelength=633.0, spp=samples, noise=True)
        rows += differences("Cornell box, rays and waves", samples, rays(box, samples, 0), wave)
    figures = {
        pixels: [row["true"] for row in rows if row["captures"].startswith("Cornell") and row["pixels"] == pixels]
        for pixels in ("all", "middle", "rim")
    }
    right &= all(abs(value / found[-1] - 1) <= _AGREEMENT for found in figures.values() for value in found)
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, rows))
    return int(not right)


def rays(scene: Any, samples: int, seed: int) -> Capture:
    """Capture by rays, with noise."""
    return render_capture(scene, model="ray", spp=samples, seed=seed, noise=True)


def differences(captures: str, samples: int, a: Capture, b: Capture) -> list[accuracy.Row]:
    """Compare over all pixels, in the middle of micro-images and at their rim."""
    middle = middle_of_micro_images(a.camera)
    return [
        {"captures": captures, "pixels": name, "samples": samples, **capture_difference(a, b, pixels).to_dict()}
        for name, pixels in {"all": None, "middle": middle, "rim": ~middle}.items()
    ]


def cornell_box(lenses: int) -> Any:
    """Load Mitsuba's Cornell box with a plenoptic camera before it."""
    camera = PlenopticCamera(detector_width=0.064 * lenses, resolution=(32 * lenses,) * 2, lens_model="parabolic")
    larger = mi.ScalarTransform4f().scale(_SIZE)
    box = mi.cornell_box()
    for part in box.values():
        if isinstance(part, dict) and part.get("type") in ("rectangle", "cube"):
            part["to_world"] = larger @ part["to_world"]
    # The edge of the tall box, before the back wall.
    place = mi.ScalarTransform4f().look_at(origin=[0, 0, 3.9 * _SIZE], target=[-0.05 * _SIZE, 0, -_SIZE], up=[0, 1, 0])
    return mi.load_dict(box | {"sensor": camera.to_sensor() | {"to_world": place}})


if __name__ == "__main__":
    sys.exit(main())
