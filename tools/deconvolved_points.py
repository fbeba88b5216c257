"""Measure where deconvolution puts points, and with what power, over the field of the paper's camera.

Two points of different powers, between bins, lie in a plane and are recorded by a window of the 4096 x 4096 detector:
in its middle, at its edge and in its corner, where the main lens's aberrations are largest. Captures are exact point
spreads (accuracy 0). Every plane is deconvolved alone, without noise. Place is the mean of the light around a point
over bins, power that light.

Writes ``deconvolved_points.md`` and ``.json``. Exits with 1 if a point is more than 0.1 bins from its place, or its
power more than 3 % off.

    python tools/deconvolved_points.py --output out [--planes 13 -30] [--windows middle corner]
"""

from __future__ import annotations

import math

import accuracy
import numpy as np
from verdict import Verdict

from mitsuba_plenoptic import Capture, CaptureOperator, PlenopticCamera, reconstruct
from mitsuba_plenoptic.lenses.factory import main_lens
from mitsuba_plenoptic.operator.units import radiance_weight

WAVELENGTH = 633.0
PLANES = (-30.0, -13.0, 13.0, 20.0, 30.0, 40.0)
WINDOWS = {"middle": (0.0, 0.0), "edge": (0.9, 0.0), "corner": (0.9, 0.9)}
"""Middles of the windows, over half of the detector."""

PLACES, POWERS = np.array([[0.085, -0.07], [-0.092, 0.081]]), np.array([2000.0, 1000.0])
"""On the array, from the middle of the window, in millimetres."""

NEAR = 2.5
"""Bins around a point whose light is its own."""

PLACE, POWER = 0.1, 0.03
COLUMNS = {
    "d (mm)": "{d:+g}",
    "window": "{window}",
    "bins a lens": "{oversample}",
    "place (bins)": "{place:.3f}",
    "power": "{power:.4f}",
    "left of the capture": "{residual:.2%}",
}


def window(distance: float, where: tuple[float, float]) -> PlenopticCamera:
    """Return the paper's camera with the window that holds the light of the points."""
    camera = PlenopticCamera()
    reach = camera.blur_diameter(distance) + 2 * float(np.abs(PLACES).max()) + 4 * camera.mla_pitch
    size = math.ceil(reach / camera.pixel_size)
    width, height = camera.resolution
    left, top = (
        min(total - size, max(0, round(total / 2 * (1 + part) - size / 2)))
        for total, part in zip((width, height), where, strict=True)
    )
    return camera.replace(crop_offset=(left, top), crop_size=(size, size))


def rows(d: float, name: str, iterations: int) -> list[accuracy.Row]:
    """Return place and power of each point of a plane."""
    distance = PlenopticCamera().focus_distance + d
    camera = window(distance, WINDOWS[name])
    offset, size = np.array(camera.crop_offset), np.array(camera.crop_size)
    b, z = camera.mla_distance, camera.detector_distance
    # On the array, where chief rays to the middle of the window go through it.
    middle = (offset + size / 2 - np.array(camera.resolution) / 2) * camera.pixel_size * b / (b + z)
    places = middle + PLACES
    points = np.column_stack([-places * distance / b, np.full(len(places), distance)])
    image = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0).forward(POWERS)
    capture = Capture(np.maximum(image, 0), camera, WAVELENGTH, "wave", {})
    # About two bins a line pair of the plane's limit.
    oversample = 4 if abs(d) < 20 else 3
    found = reconstruct(capture, distance, method="deconvolved", oversample=oversample, iterations=iterations)
    light = np.nan_to_num(found.image.astype(np.float64))
    pitch = camera.mla_pitch / oversample
    light *= radiance_weight(camera, main_lens(camera), pitch**2)
    y, x = ((np.arange(count) - (count - 1) / 2) * pitch for count in light.shape)
    made = []
    for place, power in zip(places, POWERS, strict=True):
        near = np.hypot(x - place[0], (y - place[1])[:, None]) < NEAR * pitch
        own = light * near
        mean = np.array([own.sum(0) @ x, own.sum(1) @ y]) / own.sum()
        row = {"d": d, "window": name, "oversample": oversample, "residual": found.facts["residual"]}
        made.append(
            row | {"place": float(np.hypot(*(mean - place))) / pitch, "power": float(own.sum() / power)},
        )
    return made


def main() -> int:
    """Measure, print and judge."""
    parser = accuracy.options("deconvolved_points", __doc__)
    parser.add_argument("--planes", type=float, nargs="*", default=PLANES, help="distances from the plane in focus")
    parser.add_argument("--windows", nargs="*", choices=WINDOWS, default=list(WINDOWS))
    parser.add_argument("--iterations", type=int, default=60)
    given = accuracy.start(parser)
    found: list[accuracy.Row] = []
    for d in given.planes:
        for name in given.windows:
            made = rows(d, name, given.iterations)
            found += made
            print(*accuracy.markdown(COLUMNS, made).splitlines()[2:], sep="\n", flush=True)
    verdict = Verdict()
    verdict.judge("place", max(row["place"] for row in found), PLACE, "bins ")
    verdict.judge("power", max(abs(row["power"] - 1) for row in found), POWER)
    accuracy.finish(given, found, accuracy.markdown(COLUMNS, found))
    return int(not verdict.kept)


if __name__ == "__main__":
    raise SystemExit(main())
