"""Panels of the picture that opens the page on waves as signed rays."""

from __future__ import annotations

from dataclasses import replace

import matplotlib
import mitsuba as mi
import numpy as np
from bench.cases import phase_space as walls

from mitsuba_plenoptic.light.signed_colours import plan_of
from mitsuba_plenoptic.report.images import to_bytes

CAMERA, BLUR, OFF_AXIS, SAMPLES, POINTS = "keplerian", 2.0, 58.0, 1024, 12
"""The wall's camera, its blur and its place in lenses, rays for each cell, and points across a lens."""

SHOWN, GAIN = 96, 25
"""Pixels across the part of the wall's capture that is shown, and the factor on differences."""


def signed(values: np.ndarray, largest: float | None = None) -> np.ndarray:
    """Draw positive values in red and negative ones in blue."""
    colours = matplotlib.colormaps["RdBu_r"](0.5 + values / (2 * (largest or np.abs(values).max())))
    return (255 * colours[..., :3]).astype(np.uint8)


def panels() -> list[list[tuple[str, np.ndarray]]]:
    """Return rows of titles and images: coefficients, kernels, and a wall against its exact sum."""
    mi.set_variant("llvm_ad_mono")
    camera = walls.CAMERAS["square"]
    plan = plan_of(camera, walls.WAVELENGTH, False, walls.WAVELENGTH)
    kernels = plan.kernels(camera.pixel_size / 4, plan.reach)
    middle = slice(kernels.shape[1] // 2 - 40, kernels.shape[1] // 2 + 41)
    functions = plan.functions.count
    return [
        [
            ("First coefficient, P = 0", coefficient(plan, 0.0, 0)),
            ("P = 0.75 R", coefficient(plan, 0.75, 0)),
            ("P = 0.97 R", coefficient(plan, 0.97, 0)),
            ("Second coefficient, P = 0", coefficient(plan, 0.0, 1)),
        ],
        [
            (title, signed(np.cbrt(kernels[number][middle, middle])))
            for title, number in (
                ("First kernel", 0),
                ("Second kernel", 1),
                ("Fourth kernel", 3),
                ("First oblique kernel", functions),
            )
        ],
        wall(),
    ]


def coefficient(plan: walls.PhaseSpace, radius: float, number: int) -> np.ndarray:
    """Draw a coefficient over the 3 x 3 lenses around that of the ray, at a node near a radius of the pupil."""
    node = round((1 - (1 - radius) ** 0.5) * plan.radial)
    place, side = plan.nodes[node], 3 * plan.camera.mla_pitch
    along = [(np.arange(count) + 0.5) * s / count - s / 2 for count, s in zip(place.counts, place.sides, strict=True)]
    inside = [np.flatnonzero(np.abs(each) < side / 2) for each in along]
    shown = np.zeros((240, 240, 3), np.uint8) + 255
    values = plan.table[node][0, ..., number][np.ix_(inside[1], inside[0])]
    size = round(240 * min(1, place.sides[0] / side))
    rows = np.arange(size) * len(values) // size
    shown[(240 - size) // 2 :][:size, (240 - size) // 2 :][:, :size] = signed(values)[np.ix_(rows, rows)]
    return shown


def wall() -> list[tuple[str, np.ndarray]]:
    """Capture a wall far off the axis by signed rays, with and without oblique kernels, and as an exact sum."""
    camera = walls.CAMERAS[CAMERA]
    whole = walls.planned(camera, False, 1)
    given = BLUR, 3, POINTS, SAMPLES, 1, 4, OFF_AXIS
    image, exact, _, _ = walls.pair(whole, camera, *given)
    plain = walls.pair(replace(whole, tolerance=np.inf), camera, *given)[0]
    part = slice((len(exact) - SHOWN) // 2, (len(exact) + SHOWN) // 2)
    image, plain, exact = (each[part, part] for each in (image, plain, exact))
    largest = exact.max()
    return [
        ("Wall, signed rays", to_bytes(np.maximum(image, 0), largest)),
        ("Exact sum of points", to_bytes(np.maximum(exact, 0), largest)),
        (f"Difference x {GAIN}", signed(GAIN * (image - exact), largest)),
        ("Without oblique kernels", signed(GAIN * (plain - exact), largest)),
    ]
