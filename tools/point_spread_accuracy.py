"""Measure how far the point spreads by patches are from the full field, and the full field from its own limit.

Writes ``point_spread_accuracy.md`` and ``.json`` to the folder that ``--output`` names. Every figure has a limit; where
one is beyond, the exit status is 1.
"""

from __future__ import annotations

import itertools
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

import accuracy
import numpy as np

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.operator.full_field import full_field
from mitsuba_plenoptic.operator.operator import CaptureOperator
from mitsuba_plenoptic.operator.point_spread import point_spread_function
from mitsuba_plenoptic.operator.pupil_weights import PupilWeights
from mitsuba_plenoptic.system.optical_system import OpticalSystem

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

PATCH_LIMIT = 0.0035
FULL_FIELD_LIMIT = 0.002

SMALL = PAPER.replace(detector_width=0.512, resolution=(256, 256))
EXTREMES = {
    "aperture_radius 2": (SMALL.replace(aperture_radius=2), (0.06, -0.05, 215)),
    "aperture_radius 0.5": (SMALL.replace(aperture_radius=0.5), (0.06, -0.05, 215)),
    "0.25 um pixels": (PAPER.replace(detector_width=0.256, resolution=(1024, 1024)), (0.1, -0.05, 230)),
    "Fresnel number 0.3 by focal length": (
        PAPER.replace(mla_focal_length=5.4, detector_distance=5.4, detector_width=1.024, resolution=(512, 512)),
        (0.06, -0.05, 240),
    ),
    "Fresnel number 0.3 by pitch": (
        PAPER.replace(mla_pitch=0.02, detector_width=0.4, resolution=(200, 200)), (0.06, -0.05, 230)
    ),
}  # fmt: skip
"""Cameras, each with a scene point whose single spread is judged."""

GAPPED = {
    "square lenses": {},
    "hexagonal lattice": {"mla_lattice": "hexagonal"},
    "discs": {"mla_aperture": "circle"},
}
FILLS = (0.5, 0.25, 0.1)


@dataclass(frozen=True)
class Figure:
    """A measured error and the largest one that is allowed, both relative."""

    name: str
    error: float
    limit: float


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
    found = [
        Case(f"{name} {g:g}", PAPER, _scene_point(PAPER, *place, g), 633.0)
        for g in (210.0, 240.0, 280.0)
        for name, place in places.items()
    ]
    rng = np.random.default_rng(7)
    for number in range(5):
        x, y = rng.uniform(-3.7, 3.7, 2)
        point = _scene_point(PAPER, x, y, rng.uniform(200, 300))
        found.append(Case(f"random {number + 1}", PAPER, point, 633.0))
    for name, x, y, g in (("axis", 0, 0, 175), ("mid-field", 1.1, -0.9, 150), ("corner", -2.1, 2.1, 200)):
        found.append(Case(f"second camera, {name} {g}", SECOND, _scene_point(SECOND, x, y, g), 532.0))
    return found


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
        finer = full_field(OpticalSystem(case.camera, case.wavelength), point, refinement=2)
        wider = full_field(OpticalSystem(case.camera, case.wavelength), point, growth=1.4)
        result |= {"finer": _difference(full, finer), "wider": _difference(full, wider)}
    return result


def _refined(camera: PlenopticCamera, position: Any) -> np.ndarray:
    """Full field on a finer grid in a wider window, by the paper's wavelength."""
    return full_field(OpticalSystem(camera, 633.0), np.array(position), refinement=1.4, growth=1.2)


def extremes() -> list[Figure]:
    """Single spreads of accuracy 0 by cameras that demand more of the grids than the paper's."""
    figures = []
    for name, (camera, position) in EXTREMES.items():
        reference = _refined(camera, position)
        for method, limit in (("full_field", 0.003), ("patch", 0.005)):
            spread = point_spread_function(camera, position, wavelength=633.0, method=method)
            figures.append(Figure(f"{name}, {method}", _difference(spread, reference), limit))
    return figures


def gapped() -> list[Figure]:
    """Add a dozen points by microlenses with opaque gaps, at the default accuracy of many radiators."""
    g = np.linspace(226.0, 252.0, 12)
    points = np.column_stack([0.1 * np.cos(3 * g), 0.1 * np.sin(3 * g), g])
    # Few radiators would get a finer grid, since what is cut of each does not average out.
    many = np.tile(points, (50, 1))
    figures = []
    for (name, parameters), fill in itertools.product(GAPPED.items(), FILLS):
        camera = PAPER.replace(detector_width=0.256, resolution=(128, 128), mla_fill=fill, **parameters)
        references = [_refined(camera, point) for point in points]
        reference, full = sum(references), full_field(OpticalSystem(camera, 633.0), points[0])
        patch = CaptureOperator(camera, many, wavelength=633.0).forward(np.full(len(many), 1 / 50))
        figures.append(Figure(f"{name}, mla_fill {fill:g}, full_field", _difference(full, references[0]), 0.003))
        figures.append(Figure(f"{name}, mla_fill {fill:g}, patch", _difference(patch, reference), 0.01))
    return figures


def hidden_pupils() -> list[Figure]:
    """Pupils of which cells are hidden, against a full field of half the pitch."""
    place = np.arange(16)
    masks = {"half": (place >= 8) & (place >= 0)[:, None], "quarter": (place >= 8) & (place >= 8)[:, None]}
    figures = []
    for (name, mask), g in itertools.product(masks.items(), (225.0, 240.0)):
        weights, point = mask[None], np.array([0.06, -0.05, g])
        reference, full = (
            full_field(
                OpticalSystem(SMALL, 633.0), point, pupil_weights=PupilWeights.of(weights, 1), refinement=refinement
            )
            for refinement in (2, 1)
        )
        patch = CaptureOperator(SMALL, [point], wavelength=633.0, accuracy=0, pupil_weights=weights).forward([1.0])
        figures.append(Figure(f"{name} of the pupil at {g:g}, full_field", _difference(full, reference), 0.002))
        figures.append(Figure(f"{name} of the pupil at {g:g}, patch", _difference(patch, reference), 0.003))
    return figures


def main() -> None:
    """Measure all cases and write the tables."""
    arguments = accuracy.start(accuracy.options("point_spread_accuracy", __doc__))
    results: dict[str, Any] = {
        "patch": [measure(case) for case in cases()],
        "full_field": [measure(case) for case in convergence()],
    }
    figures = [Figure(row["name"] + ", patch", row["error"], PATCH_LIMIT) for row in results["patch"]]
    for key in ("finer", "wider"):
        figures += [Figure(f"{row['name']}, {key}", row[key], FULL_FIELD_LIMIT) for row in results["full_field"]]
    harder = extremes() + gapped() + hidden_pupils()
    results["harder"] = [asdict(figure) for figure in harder]
    beyond = [figure for figure in figures + harder if not figure.error <= figure.limit]
    accuracy.finish(
        arguments,
        results,
        "# Accuracy of point spreads\n",
        "Relative L2 of pixel integrals over the recorded detector.\n",
        accuracy.markdown(PATCH, results["patch"]),
        "## Convergence of the full field\n",
        accuracy.markdown(FULL_FIELD, results["full_field"]),
        "## Extreme cameras, gaps between microlenses, hidden parts of the pupil\n",
        accuracy.markdown({"case": "{name}", "error": "{error:.2%}", "limit": "{limit:.2%}"}, results["harder"]),
        *(f"beyond its limit of {figure.limit:.2%}: {figure.name}, {figure.error:.3%}" for figure in beyond),
    )
    if beyond:
        sys.exit(1)


if __name__ == "__main__":
    main()
