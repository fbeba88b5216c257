"""Derivatives of captures against central differences of the full field and direct sums, and their cost.

The camera is the paper's main lens at half its size before four lenses. Radiators are held. The step of a difference
is such that the image changes by 1 % of its norm, a quarter of that for the wavelength, and the grids of the full
field are those of the middle, 1.5 times as fine and in windows 2.6 times as wide as for images: what steep orders of
the microlenses fold back, and what wraps round a window, changes fastest with the parameters. Where the detector's
width changes the grids grow with it, and where wavelength or pitch do, the count of microlens orders is held.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import ndimage

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, Spectrum
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.arrival import FieldGrids, field_grids
from mitsuba_plenoptic.points.derivatives import brightness_slopes
from mitsuba_plenoptic.points.full_field import full_field

from .. import Pivot, Row, at_most, case, pick
from ..direct_sums import BANDS, spread
from ..measures import relative

WAVELENGTH = 633.0

STEP = 0.01

STEPS = {"wavelength": 0.0025}
"""Steps of differences by parameters whose captures bend sooner, over the norm of the image."""

WINDOW, FINER = 2.6, 1.5
"""Width and fineness of the full field's windows over those for images."""

WALL = {"mla_distance": 0.03, "mla_pitch": 0.08, "detector_distance": 0.08}
"""Limits for a wall, whose derivatives are small differences of large ones."""

WALL_ACCURACY, WALL_STEP = 0.02, 0.004

WHITE = {"mla_pitch": 0.05, "mla_distance": 0.05}
"""Limits, inside micro-images of white, for derivatives over the largest at the micro-images' edges."""

WHITE_PER_LENS, WHITE_EDGE = 12, 2
"""Radiators along a lens, and pixels within the edge of a micro-image that are no part of its inside."""

HALF = PlenopticCamera(
    focal_length=40, aperture_radius=2.5, mla_distance=60, detector_width=0.128, resolution=(64, 64)
)  # fmt: skip

HEXAGONAL = HALF.replace(mla_lattice="hexagonal", mla_fill=0.9)

DOUBLE_GAUSS = HALF.replace(main_lens="double_gauss", mla_distance=60.0)

CASES = {
    # Where four lenses meet on the axis, turning them changes nothing.
    "square, on axis, in focus": (HALF.replace(mla_offset=(0.012, 0.02)), (0.0, 0.0, 120.0)),
    "square, off axis, near": (HALF, (0.03, -0.02, 115.0)),
    "square, off axis, far": (HALF.replace(mla_fill=0.9), (-0.04, 0.03, 126.0)),
    "hexagonal, off axis, near": (HEXAGONAL, (0.03, -0.02, 115.0)),
    "hexagonal, focused, off axis": (
        HEXAGONAL.replace(mla_distance=57.0, detector_distance=0.6), (0.02, 0.03, 124.0)
    ),
    "double Gauss, on axis, in focus": (DOUBLE_GAUSS.replace(mla_offset=(0.012, 0.02)), (0.0, 0.0, 120.0)),
    "double Gauss, turned, off axis, near": (DOUBLE_GAUSS.replace(mla_rotation=9.0), (0.03, -0.02, 115.0)),
    "singlet, off axis, near": (HALF.replace(main_lens="singlet", mla_distance=60.0), (0.03, -0.02, 115.0)),
}  # fmt: skip
"""Cameras and scene points."""

LIMITS = {
    "focal_length": 0.005,
    "aperture_radius": 0.02,
    "mla_distance": 0.005,
    "mla_focal_length": 0.005,
    "mla_pitch": 0.005,
    "mla_rotation": 0.005,
    "mla_offset": 0.005,
    "mla_fill": 0.005,
    "detector_distance": 0.005,
    "detector_width": 0.005,
    "wavelength": 0.005,
}

ABERRATIONS = 36


TABLE = {"case": "{case}", "parameter": "{parameter}", "error": "{error:.2e}", "limit": "{limit:g}"}
JUDGED = (at_most("error", "limit"),)


def difference(camera: PlenopticCamera, point: np.ndarray, name: str, change: Any, step: float) -> np.ndarray:
    """Central difference of the full field."""
    base = field_grids(OpticalSystem(camera, WAVELENGTH), point, FINER, WINDOW)
    sides = []
    for amount in (step, -step):
        changed, wavelength = camera, WAVELENGTH
        if name == "wavelength":
            wavelength += amount
        else:
            values = camera.to_dict()
            present = np.zeros(len(change)) if name == "wavefront" else values[name]
            value = np.asarray(present) + amount * np.asarray(change)
            changed = camera.replace(**{name: value.tolist(), "detector_distance": values["detector_distance"]})
            if name == "detector_distance":
                changed = camera.replace(detector_distance=value.tolist())
        grids = _grown(base, changed.detector_width / camera.detector_width)
        order = wavelength / WAVELENGTH * camera.mla_pitch / changed.mla_pitch
        grids = replace(grids, bend=base.bend * order * (1 + 1e-9))
        sides.append(full_field(OpticalSystem(changed, wavelength), point, grids=grids))
    return (sides[0] - sides[1]) / (2 * step)


def _grown(grids: FieldGrids, factor: float) -> FieldGrids:
    x, y = grids.wide_origin
    return replace(grids, pitch=grids.pitch * factor, wide_origin=(x * factor, y * factor))


@case(
    "derivatives.full-field",
    "Derivatives of captures against central differences of the full field, relative L2 over the detector",
    TABLE,
    JUDGED,
    page="docs/derivatives.md",
    pivot=Pivot("{case}", "{parameter}", "{error:.2%}"),
    quick={"parameters": ("mla_pitch",), "cases": ("square, off axis, near",)},
)
def against_full_field(*, parameters: tuple[str, ...] = (), cases: tuple[str, ...] = ()) -> Iterator[Row]:
    """Compare every named parameter at every point, and 36 aberrations at one."""
    limits = pick({**LIMITS, "wavefront": 0.005}, parameters)
    for name, (camera, place) in pick(CASES, cases).items():
        point = np.array(place)
        operator = CaptureOperator(camera, [point], wavelength=WAVELENGTH, accuracy=0)
        size = float(np.linalg.norm(operator.forward([1.0])))
        changes: list[tuple[str, Any]] = [(each, (0.6, -0.8) if each == "mla_offset" else 1.0) for each in limits]
        if "wavefront" in limits:
            changes.remove(("wavefront", 1.0))
            if name == "square, off axis, near":
                changes += [("wavefront", np.eye(ABERRATIONS)[j].tolist()) for j in range(1, ABERRATIONS)]
        for each, change in changes:
            if each == "mla_fill" and camera.mla_fill == 1:
                continue  # it can only shrink, and has no central difference
            found = operator.derivative([1.0], {each: change})
            step = STEPS.get(each, STEP) * size / float(np.linalg.norm(found))
            label = f"wavefront {change.index(1.0) + 1}" if each == "wavefront" else each
            error = relative(found, difference(camera, point, each, change, step))
            yield {"case": name, "parameter": label, "step": step, "error": error, "limit": limits[each]}


@case(
    "derivatives.wall",
    "Derivatives of a wall of points in the capture's own unit at accuracy 0.02, where changes of single spreads "
    "nearly cancel, against central differences of the full fields",
    TABLE,
    JUDGED,
    page="docs/derivatives.md",
    quick={"across": 2, "parameters": ("mla_pitch",)},
)
def walls(*, across: int = 12, parameters: tuple[str, ...] = ()) -> Iterator[Row]:
    """Measure a wall, by the parameters under which its captures must stay white."""
    place = (np.arange(across) + 0.5) / 2 - across / 4
    x, y = (index.ravel() * HALF.mla_pitch for index in np.meshgrid(place, place))
    points = np.column_stack([-x * 116 / HALF.mla_distance, -y * 116 / HALF.mla_distance, np.full(x.size, 116.0)])
    operator = CaptureOperator(HALF, points, wavelength=WAVELENGTH, accuracy=WALL_ACCURACY)
    weights = np.ones(len(points))
    image = operator.forward(weights).astype(np.float64)
    for name, limit in pick(WALL, parameters).items():
        unit = float(brightness_slopes(HALF, [name])[name].sum()) * image
        found = operator.derivative(weights, {name: 1.0}).astype(np.float64)
        step = WALL_STEP * float(np.linalg.norm(image) / np.linalg.norm(found))
        expected = sum(difference(HALF, point, name, 1.0, step).astype(np.float64) for point in points)
        error = relative(found + unit, expected + unit)
        yield {"case": f"wall of {len(points)} points", "parameter": name, "error": error, "limit": limit}


@case(
    "derivatives.white",
    "Derivatives of a white capture inside its micro-images, where it stays white: RMS over the largest at their edges",
    TABLE,
    JUDGED,
    page="docs/derivatives.md",
    quick={"per_lens": 2},
)
def whites(*, per_lens: int = WHITE_PER_LENS) -> Iterator[Row]:
    """Differentiate by the pitch and the distance of the array."""
    camera = HALF.replace(mla_offset=(HALF.mla_pitch / 2,) * 2, detector_width=HALF.mla_pitch, resolution=(32, 32))
    place = ((np.arange(3 * per_lens) + 0.5) / per_lens - 1.5) * camera.mla_pitch
    x, y = (part.ravel() for part in np.meshgrid(place, place))
    points = np.column_stack([-x * 116 / camera.mla_distance, -y * 116 / camera.mla_distance, np.full(x.size, 116.0)])
    # Finer than from where spreads are shared.
    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0.0039)
    weights = np.ones(len(points))
    image = operator.forward(weights).astype(np.float64)
    lit = image > 0.9 * np.median(image[image > 0.5 * image.max()])
    inside = ndimage.binary_erosion(lit, iterations=WHITE_EDGE)
    for name, limit in WHITE.items():
        # Fewer radiators are no white.
        limit = limit if per_lens >= WHITE_PER_LENS else None
        unit = float(brightness_slopes(camera, [name])[name].sum()) * image
        change = operator.derivative(weights, {name: 1.0}).astype(np.float64) + unit
        error = float(np.sqrt((change[inside] ** 2).mean()) / np.abs(change).max())
        yield {"case": f"white, {inside.sum()} pixels inside", "parameter": name, "error": error, "limit": limit}


@case(
    "derivatives.adjoint",
    "Reverse against forward mode of captures and their derivatives: <A x, y> and <x, A' y>, over |A x| |y|",
    TABLE,
    JUDGED,
    page="docs/derivatives.md",
    quick={"cases": ("square, off axis, near",)},
)
def adjoints(*, cases: tuple[str, ...] = ()) -> Iterator[Row]:
    """Compare two wavelengths of three points, by all parameters."""
    for case_name, (camera, place) in pick(CASES, cases).items():
        rng = np.random.default_rng(1)
        points = np.array(place) + rng.normal(size=(3, 3)) * (0.01, 0.01, 1.0)
        operator = CaptureOperator(camera, points, spectrum=Spectrum.lines(633, 532), accuracy=0.01)
        weights, image = rng.normal(size=(3, 2)), rng.normal(size=(*camera.shape, 2)).astype(np.float32)
        forward, back = operator.forward(weights).astype(np.float64), operator.adjoint(image)
        pairs = [("capture", forward, weights, back, 1e-5)]
        for name, gradient in operator.gradient(weights, image).items():
            change = rng.normal(size=gradient.shape)
            moved = operator.derivative(weights, {name: change}).astype(np.float64)
            pairs.append((f"derivative, {name}", moved, change, gradient, 1e-4))
        for name, moved, change, gradient, limit in pairs:
            scale = float(np.linalg.norm(moved) * np.linalg.norm(image))
            error = float(abs(np.vdot(moved, image) - np.vdot(change, gradient)) / scale)
            yield {"case": case_name, "parameter": name, "error": error, "limit": limit}


@case(
    "derivatives.wavelength",
    "Derivatives by the wavelength against direct sums in double precision, which share no code with captures, for "
    "three steepest directions: the sums move with these, and decide nothing finer",
    {
        "case": "{case}", "image": "{image:.2%}", "sums move by": "{moved:.2%}",
        "captures off the sums": "{captures[0]:.2%}, {captures[1]:.2%}, {captures[2]:.2%}",
        "full field off the sums": "{full_field[0]:.2%}, {full_field[1]:.2%}, {full_field[2]:.2%}",
    },
    (at_most("image", 0.002), at_most("least", "limit")),
    page="docs/derivatives.md",
)  # fmt: skip
def wavelength(*, points: int = 1) -> Iterator[Row]:
    """Measure up to three points before square arrays, by central differences of 0.02 nanometres."""
    step = 0.02
    for name in ("square, off axis, near", "square, on axis, in focus", "square, off axis, far")[:points]:
        camera, place = CASES[name]
        point = np.array(place)
        operator = CaptureOperator(camera, [point], wavelength=WAVELENGTH, accuracy=0)
        image, ours = operator.forward([1.0]), operator.derivative([1.0], {"wavelength": 1.0}).astype(np.float64)
        of_field = STEPS["wavelength"] * float(np.linalg.norm(image) / np.linalg.norm(ours))
        full = difference(camera, point, "wavelength", 1.0, of_field).astype(np.float64)
        sums = []
        for band in BANDS:
            up, down = (spread(camera, point, WAVELENGTH + side * step, band) for side in (1, -1))
            sums.append((up - down) / (2 * step))
        moved = max(relative(one, other) for one, other in itertools.combinations(sums, 2))
        captures = [relative(ours, one) for one in sums]
        yield {
            "case": name, "image": relative(image, spread(camera, point, WAVELENGTH, BANDS[0])), "moved": moved,
            "captures": captures, "full_field": [relative(full, one) for one in sums], "least": min(captures),
            "limit": max(moved, 0.015),
        }  # fmt: skip
