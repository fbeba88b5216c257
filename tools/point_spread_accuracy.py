"""Measure how far the point spreads by patches are from the full field, and the full field from its own limit.

python tools/point_spread_accuracy.py --output out
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import accuracy
import numpy as np

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.capture.full_field import full_field
from mitsuba_plenoptic.capture.point_spread import point_spread_function

PAPER = PlenopticCamera()
SECOND = PlenopticCamera(
    focal_length=50, aperture_radius=4, mla_distance=70, mla_focal_length=0.4, mla_pitch=0.05,
    detector_width=5, resolution=(2000, 2000),
)  # fmt: skip

PATCH = {
    "point": "{name}",
    "position (mm)": "({position[0]:.2f}, {position[1]:.2f}, {position[2]:.1f})",
    "patch - full field": "{error:.2%}",
    "power, full field": "{power:.4f}",
    "power, patch": "{patch_power:.4f}",
}
FULL_FIELD = {
    "point": "{name}",
    "grid halved": "{finer:.3%}",
    "window grown by 1.4": "{wider:.3%}",
    "patch - full field": "{error:.3%}",
}


@dataclass(frozen=True)
class Case:
    """A camera, a scene point and a wavelength; with a crop, also the convergence of the full field."""

    name: str
    camera: PlenopticCamera
    position: tuple[float, float, float]
    wavelength: float
    converge: bool = False


def _scene_point(camera: PlenopticCamera, x: float, y: float, g: float) -> tuple[float, float, float]:
    """Scene point whose image is at (x, y) on the MLA."""
    return (-x * g / camera.mla_distance, -y * g / camera.mla_distance, g)


def cases() -> list[Case]:
    """Axis, mid-field and corner at three distances, random points, and a second camera."""
    places = {"axis": (0.0, 0.0), "mid-field": (2.0, -1.7), "corner": (-3.6, 3.6)}
    points = [(f"{name} {g:g}", PAPER, *place, g) for g in (210.0, 240.0, 280.0) for name, place in places.items()]
    rng = np.random.default_rng(7)
    points += [(f"random {i + 1}", PAPER, *rng.uniform(-3.7, 3.7, 2), rng.uniform(200, 300)) for i in range(5)]
    for name, x, y, g in (("axis", 0, 0, 175), ("mid-field", 1.1, -0.9, 150), ("corner", -2.1, 2.1, 200)):
        points.append((f"second camera, {name} {g}", SECOND, x, y, g))
    return [
        Case(name, camera, _scene_point(camera, x, y, g), 633.0 if camera is PAPER else 532.0)
        for name, camera, x, y, g in points
    ]


def convergence() -> list[Case]:
    """Points at which the full field is repeated on a finer grid and in a wider window, on crops around them."""
    found = []
    for camera, wavelength, x, y, g in (
        (PAPER, 633.0, 0.0, 0.0, 240.0), (PAPER, 633.0, 1.5, -1.2, 240.0), (PAPER, 633.0, 0.2, 0.1, 210.0),
        (PAPER, 633.0, -1.5, 1.5, 280.0), (SECOND, 532.0, 0.5, 0.4, 175.0), (SECOND, 532.0, 0.5, 0.4, 150.0),
    ):  # fmt: skip
        p, (columns, rows) = camera.pixel_size, camera.resolution
        size = round(1.4 / p)
        corner = (round(columns / 2 + x / p - size / 2), round(rows / 2 + y / p - size / 2))
        crop = camera.replace(crop_offset=corner, crop_size=(size, size))
        name = f"{'paper' if camera is PAPER else 'second'} ({x:g}, {y:g}) {g:g}"
        found.append(Case(name, crop, _scene_point(camera, x, y, g), wavelength, converge=True))
    return found


def _difference(image: np.ndarray, reference: np.ndarray) -> float:
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def measure(case: Case) -> accuracy.Row:
    """Relative L2 of the patch against the full field over all recorded pixels, and the time of each."""
    start = time.perf_counter()
    full = point_spread_function(case.camera, case.position, wavelength=case.wavelength, method="full_field")
    middle = time.perf_counter()
    patch = point_spread_function(case.camera, case.position, wavelength=case.wavelength)
    result: accuracy.Row = {
        "name": case.name,
        "position": case.position,
        "error": _difference(patch, full),
        "power": float(full.sum()),
        "patch_power": float(patch.sum()),
        "seconds": middle - start,
        "patch_seconds": time.perf_counter() - middle,
    }
    if case.converge:
        point = np.array(case.position)
        finer = full_field(case.camera, point, case.wavelength, refinement=2)
        wider = full_field(case.camera, point, case.wavelength, growth=1.4)
        result |= {"finer": _difference(full, finer), "wider": _difference(full, wider)}
    return result


def main() -> None:
    """Measure all cases and write the tables."""
    arguments = accuracy.start(accuracy.options("point_spread_accuracy", __doc__))
    results = {"patch": [measure(case) for case in cases()], "full_field": [measure(case) for case in convergence()]}
    accuracy.finish(
        arguments,
        results,
        "# Accuracy of point spreads\n",
        "Relative L2 of pixel integrals over the recorded detector.\n",
        accuracy.markdown(PATCH, results["patch"]),
        "## Convergence of the full field\n",
        accuracy.markdown(FULL_FIELD, results["full_field"]),
    )


if __name__ == "__main__":
    main()
