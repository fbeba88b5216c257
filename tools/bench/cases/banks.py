"""Point spreads from the kernels of signed rays (method "bank") against exact ones, in error and in time."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.points.accuracy import DEFAULT_ACCURACY

from .. import Row, at_least, at_most, case, pick
from ..measures import relative
from .phase_space import CAMERAS, WAVELENGTH, Wall, around, reference

PLACES = ((0.13, 0.21), (0.4, -0.33), (-0.27, 0.45))
"""Images of the single points on a lens, in pitches from its corner."""


@case(
    "point-spreads.bank",
    "Walls of points and single points by the kernels of signed rays against exact point spreads, relative L2",
    {
        "camera": "{camera}", "blur (lenses)": "{blur:g}", "lenses off the axis": "{off_axis:g}",
        "wall": "{wall:.2%}", "energy": "{energy:.4f}", "exact energy": "{exact_energy:.4f}",
        "single spreads": "{single:.1%}", "single spreads, finer": "{finer:.1%}",
    },
    (at_most("wall", 0.015), at_most("energy", 1.005), at_least("energy", 0.995)),
    page="docs/theory/phase_space.md",
    quick={"blurs": (2.0,), "lenses": 1},
)  # fmt: skip
def bank(
    *,
    cameras: tuple[str, ...] = ("square",),
    blurs: tuple[float, ...] = (0.0, 0.5, 2.0, 8.0),
    lenses: int = 3,
    points: int = 12,
    margin: int = 4,
    off_axis: float = 0.0,
) -> Iterator[Row]:
    """Compare walls of some lenses, with points across a lens."""
    for name, camera in pick(CAMERAS, cameras).items():
        for blur in blurs:
            wall = Wall(camera, blur, lenses, points, off_axis)
            view = around(camera, wall, margin)
            made = CaptureOperator(view, wall.points, wavelength=WAVELENGTH, method="bank")
            image = made.forward(wall.weight).astype(float)
            exact = reference(view, wall)
            usual, finer = (_single(view, wall, accuracy) for accuracy in (DEFAULT_ACCURACY, 0.0))
            yield {
                "camera": name, "blur": blur, "off_axis": off_axis, "wall": relative(image, exact),
                "energy": float(image.sum() / wall.weight.sum()),
                "exact_energy": float(exact.sum() / wall.weight.sum()), "single": usual, "finer": finer,
            }  # fmt: skip


def _single(camera: PlenopticCamera, wall: Wall, accuracy: float) -> float:
    """Return the mean difference of single spreads of points in the plane of a wall."""
    image = np.array(PLACES) * camera.mla_pitch + wall.centre
    scale = wall.points[0, :2] / (wall.axis[0] + wall.centre)
    points = np.column_stack([image * scale, np.full(len(image), wall.distance)])
    found = []
    for point in points:
        made, exact = (
            CaptureOperator(camera, [point], wavelength=WAVELENGTH, **chosen).forward([1.0])
            for chosen in ({"method": "bank", "accuracy": accuracy}, {"accuracy": 0})
        )
        found.append(relative(made.astype(float), exact.astype(float)))
    return float(np.mean(found))


@case(
    "speed.bank",
    "Sums of random points of random blur by the kernels of signed rays and by patches: seconds of a sum, all planned",
    {
        "blur (lenses)": "{low:g} to {high:g}", "points": "{count}", "bank (s)": "{bank:.1f}",
        "patch at 0.01 (s)": "{patch:.1f}", "patch at 0 (s)": "{exact:.1f}", "patch at 0 over bank": "{ratio:.1f}",
        "difference": "{difference:.2%}",
    },
    page="docs/theory/phase_space.md",
    quick={"count": 10},
)  # fmt: skip
def speed(
    *, blurs: tuple[float, ...] = (4.0, 15.0), count: int = 1000, lenses: int = 64, runs: int = 1
) -> Iterator[Row]:
    """Time points before and behind the focus, on both sides of each lens's field, of random weights."""
    camera = PlenopticCamera(detector_width=0.064 * lenses, resolution=(32 * lenses,) * 2)
    random = np.random.default_rng(0)
    blur = random.uniform(*blurs, count) * random.choice([-1, 1], count)
    part = 1 - blur * camera.mla_pitch / camera.aperture_radius
    distance = 1 / (1 / camera.focal_length - part / camera.mla_distance)
    half = camera.detector_width / 2 - blurs[1] * camera.mla_pitch
    place = random.uniform(-half, half, (count, 2))
    points = np.column_stack([place * (-distance / camera.mla_distance)[:, None], distance])
    weights, seconds, images = random.random(count), {}, {}
    for name, options in {
        "bank": {"method": "bank"}, "patch": {}, "exact": {"accuracy": 0}
    }.items():  # fmt: skip
        operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, virtual=True, **options)
        # Plans and compiles the kernels.
        operator.forward((np.arange(count) < 8) * weights)
        taken = []
        for _ in range(runs):
            start = time.perf_counter()
            images[name] = operator.forward(weights).astype(float)
            taken.append(time.perf_counter() - start)
        seconds[name] = min(taken)
    yield {
        "low": blurs[0], "high": blurs[1], "count": count, **seconds, "ratio": seconds["exact"] / seconds["bank"],
        "difference": relative(images["bank"], images["exact"]),
    }  # fmt: skip
