"""Signed rays against exact sums of point spreads, over the blur on the microlens array.

A wall of points, an even grid over some lenses, is captured twice: by signed rays, and point by point with the fields'
squares added (`CaptureOperator`, method "patch", accuracy 0). The walls have about as much edge as area, and so show
more error than a scene. The noise of the rays is found from two captures and subtracted; the light that the reference
itself loses is stated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from cases import relative

from mitsuba_plenoptic import CaptureOperator, Job, PlenopticCamera
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.lenses.telecentric import TelecentricLens
from mitsuba_plenoptic.points.units import brightness_at, brightness_of, radiance_weight
from mitsuba_plenoptic.prescription.lens_data import conjugate_distance
from mitsuba_plenoptic.runtime.batches import SumTask
from mitsuba_plenoptic.waves.phase_space import PhaseSpace
from mitsuba_plenoptic.waves.scheme import plan_of
from mitsuba_plenoptic.waves.signed_rays import SignedRaySum
from mitsuba_plenoptic.waves.spectral_nodes import Node

from .. import Pivot, Row, at_most, case, pick
from ..measures import without_noise, write_comparison
from ..timing import once

WAVELENGTH = 633.0


def _scaled(f_number: float, lens_model: str) -> PlenopticCamera:
    """Return a camera of 10 mm focal length, focused at 64 mm, whose micro-images of ten coarse pixels touch."""
    focal_length, focus_distance, pitch = 10.0, 64.0, 0.04
    distance = conjugate_distance(focal_length, focus_distance)
    depth = pitch * distance * f_number / focal_length
    depth /= 1 - depth / distance
    return PlenopticCamera(
        focal_length=focal_length, aperture_radius=focal_length / f_number / 2, mla_distance=distance,
        mla_pitch=pitch, mla_focal_length=depth, lens_model=lens_model,
        detector_width=10 * pitch * (1 + depth / distance), resolution=(100, 100),
    )  # fmt: skip


SCALED = {f"ideal f{number:g}": _scaled(number, "ideal") for number in (2.0, 2.8, 5.6, 10.0)}
"""Cameras before which full fields correct the sums."""

CAMERAS = {
    "square": PlenopticCamera(),
    "turned": PlenopticCamera(mla_rotation=7.0),
    "hexagonal": PlenopticCamera(mla_lattice="hexagonal", mla_rotation=7.0),
    "three focal lengths": PlenopticCamera(mla_lattice="hexagonal", mla_focal_length=(0.48, 0.512, 0.55)),
    "discs": PlenopticCamera(mla_lattice="hexagonal", mla_aperture="circle", mla_fill=0.5),
    "cells with gaps": PlenopticCamera(mla_fill=0.5),
    "double Gauss f8": PlenopticCamera.preset("paper_double_gauss"),
    "keplerian": PlenopticCamera(
        mla_focal_length=0.384, mla_distance=121.536, detector_distance=0.512, aperture_radius=4.9
    ),
    "f4": PlenopticCamera(aperture_radius=10.0),
    "double Gauss f4": PlenopticCamera.preset("paper_double_gauss").replace(aperture_radius=10.0),
    "Tessar f8": PlenopticCamera(main_lens="tessar", focal_length=80.0, aperture_radius=5.0, mla_distance=120.0),
    "astigmatic": PlenopticCamera(wavefront=(0, 0, 0, 0, 0, 0.3)),
    "defocused": PlenopticCamera(wavefront=(0, 0, 0, 0.4)),
    "comatic": PlenopticCamera(wavefront=(0, 0, 0, 0, 0, 0, 0.2)),
    "objective": PlenopticCamera.preset("lfm"),
    "water": PlenopticCamera.preset("lfm_water"),
    "raytrix": PlenopticCamera.preset("raytrix"),
    "raytrix double Gauss": PlenopticCamera.preset("raytrix_double_gauss"),
    "microlenses f4": PlenopticCamera(mla_focal_length=0.256, detector_distance=0.256, aperture_radius=12.0),
    "microlenses f2": PlenopticCamera(mla_focal_length=0.128, detector_distance=0.128, aperture_radius=12.0),
    "medium": PlenopticCamera(mla_medium=1.5, mla_focal_length=0.768, detector_distance=0.768),
    **{f"parabolic f{number:g}": _scaled(number, "parabolic") for number in (2.0, 2.8, 5.6, 10.0)},
    **SCALED,
    "second": PlenopticCamera(
        focal_length=50.0, aperture_radius=4.0, mla_distance=70.0, mla_focal_length=0.4, mla_pitch=0.05
    ),
}

LIMITS = {
    "square": (0.009, 0.008),
    "hexagonal": (0.006, 0.007),
    "double Gauss f8": (0.008, 0.008),
    "keplerian": (0.007, 0.007),
}
"""Largest difference on the axis and off it, by usual plans, of cameras that have limits of their own."""

FINER, MOST = 0.7, 0.025
"""Part of these limits for finer plans; limit of other cameras."""

EXACT = 0.01, 0.005
"""Limits of `SCALED` by usual and by finer plans, of walls of two lenses and more, by sums that full fields correct."""

ENERGY, ENERGY_OF_PATCHES = 0.005, 0.03
"""Limits of the difference in energy from these sums, and from sums of patches, which lose light."""

SMALL = 0.035
"""Limit for walls of few lenses, which are nearly all edge."""

_CUT, _RAMP = 0.5, 0.06
"""Frequency, in those of a wall's points, at which its spectrum is cut, and half the width of the cut, as a part."""

BLURS = (0.0, 0.5, -1.0, 2.0, -4.5)


@case(
    "phase-space",
    "Signed rays against exact sums of point spreads of a wall, relative L2 over the detector without the rays' noise",
    {
        "camera": "{camera}", "points a lens": "{points}", "cells a pixel": "{cells}",
        "coefficients": "{coefficients}", "MiB": "{memory:.0f}", "planning (s)": "{planning:.0f}",
        "blur (lenses)": "{blur:g}", "signed rays": "{difference:.2%}", "their noise": "{noise:.2%}",
        "energy": "{energy:.4f}", "reference's energy": "{exact_energy:.4f}", "limit": "{limit:.1%}",
        "s": "{seconds:.0f}",
    },
    (at_most("difference", "limit"), at_most("missing", "energy_limit")),
    page="docs/theory/phase_space.md",
    pivot=Pivot("{camera}", "blur of {blur:g} lenses", "{difference:.2%}"),
    quick={"blurs": (0.0,), "lenses": 1, "points": 12, "samples": 512},
)  # fmt: skip
def walls(
    output: Path,
    *,
    cameras: tuple[str, ...] = ("square",),
    blurs: tuple[float, ...] = BLURS,
    finer: bool = False,
    lenses: int = 3,
    points: int = 0,
    samples: int = 1024,
    parts: int = 0,
    margin: int = 4,
    off_axis: float = 0.0,
    full: int = 0,
) -> Iterator[Row]:
    """Compare walls of some lenses, with points across a lens and samples of each pixel.

    What patches lack is taken from ``full`` points across a lens, by full fields, which is the same for all points.

    Blurs are radii in lenses, of either sign; ``off_axis`` is where the wall's centre is, in lenses along x and y. As
    many points and cells across a pixel (``parts``) as a camera needs are taken where none are given.
    """
    for name, camera in pick(CAMERAS, cameras).items():
        per_lens, cells = points or points_of(camera), parts or PhaseSpace.of(camera, WAVELENGTH).parts(finer)
        plan, planning, _ = once(lambda c=camera, n=cells: planned(c, finer, n))
        memory = sum(part.nbytes for part in plan.table) / 2**20
        own = LIMITS.get(name, (MOST, MOST))[off_axis != 0]
        limit = SMALL if lenses < 3 else own * FINER if finer else own
        if name in SCALED and lenses > 1:
            limit = EXACT[finer]
        for blur in blurs:
            (image, exact, noise, whole), seconds, _ = once(
                lambda p=plan, c=camera, b=blur, n=per_lens, k=cells: pair(
                    p, c, b, lenses, n, samples, k, margin, off_axis, full
                )
            )
            yield {
                "camera": name, "points": per_lens, "cells": cells, "coefficients": plan.functions.count,
                "memory": memory, "planning": planning,
                "blur": blur, "difference": without_noise(relative(image, exact), noise), "noise": noise,
                "energy": float(image.sum() / whole), "exact_energy": float(exact.sum() / whole), "limit": limit,
                "missing": abs(float(image.sum() / exact.sum()) - 1),
                "energy_limit": ENERGY if full else ENERGY_OF_PATCHES,
                "seconds": seconds,
            }  # fmt: skip
            write_comparison(output / f"{name}_{blur:g}_signed_exact_difference_times_10.png", image, exact, gain=10)


def points_of(camera: PlenopticCamera) -> int:
    """Return how many points across a lens look as an even wall: a `Wall`'s spectrum is cut beyond the pupil's."""
    cut = 2 * camera.pupil_radius / (WAVELENGTH * 1e-6 * camera.pupil_distance)
    return math.ceil(camera.row_pitch * cut / (_CUT * (1 - _RAMP)))


def planned(camera: PlenopticCamera, finer: bool, parts: int) -> PhaseSpace:
    """Return the plan of captures by a camera, with its kernels."""
    plan = plan_of(camera, WAVELENGTH, finer, WAVELENGTH)
    plan.kernels(camera.pixel_size / parts, plan.reach)
    return plan


def pair(
    plan: PhaseSpace,
    camera: PlenopticCamera,
    blur: float,
    lenses: int,
    points: int,
    samples: int,
    parts: int,
    margin: int,
    off_axis: float,
    full: int = 0,
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return both captures of a wall, the relative noise of the one by signed rays, and the wall's light."""
    wall = Wall(camera, blur, lenses, points, off_axis)
    view = around(camera, wall, margin)
    one, other = (capture(plan, view, wall, samples, parts, seed) for seed in (1, 2))
    exact = reference(view, wall)
    if full:
        few = Wall(camera, blur, lenses, full, off_axis)
        exact += reference(view, few, method="full_field") - reference(view, few)
    return (one + other) / 2, exact, relative(one, other) / 2, float(wall.weight.sum())


class Wall:
    """Points on an even grid of a plane, each of the weight of its cell of the grid in lenses.

    As the pupil passes no frequencies above its diffraction limit, points closer than half a period are for the capture
    the smooth radiance that `radiance` gives.
    """

    def __init__(self, camera: PlenopticCamera, blur: float, lenses: int, per_lens: int, off_axis: float) -> None:
        pitch = camera.row_pitch
        self.blur = abs(blur)
        self._pupil_distance, self._pupil_radius = camera.pupil_distance, camera.pupil_radius
        self._model = camera.lens_model if camera.main_lens is None else None
        lens = camera.objective
        if lens is not None:
            self.distance = blur * pitch / (lens.magnification * math.tan(lens.half_angle))
        else:
            self.distance = 1 / (
                1 / camera.focal_length - (1 - blur * pitch / camera.pupil_radius) / camera.mla_distance
            )
        self.step = pitch / per_lens
        self._scale, self._objective = _scale(camera, self.distance), lens
        self.axis = (np.arange(lenses * per_lens) + 0.5) * self.step - lenses * pitch / 2
        self.centre = off_axis * pitch
        place = np.stack(np.meshgrid(self.axis, self.axis), -1).reshape(-1, 2) + self.centre
        self.points = np.column_stack([place * self._scale, np.full(len(place), self.distance)])
        # What surfaces vignette is dark.
        is_open = brightness_at(OpticalSystem(camera, WAVELENGTH), self.points) / brightness_of(
            camera, main_lens(camera)
        )
        self.weight = radiance_weight(camera, main_lens(camera), self.step**2) * is_open
        # The points' spectrum, cut half-way between what the pupil passes and its first repetition.
        self._fine, count = self.step / 16, 1 << 16
        frequency = np.fft.rfftfreq(count, self._fine)
        cut = _CUT / self.step
        ramp = np.clip((frequency / cut - 1 + _RAMP) / (2 * _RAMP), 0, 1)
        spectrum = np.exp(-2j * np.pi * np.outer(frequency, self.axis)).sum(1) * (0.5 + 0.5 * np.cos(np.pi * ramp))
        line = np.fft.irfft(spectrum, count) * self.step / self._fine
        self._line, self._count = mi.Float(np.roll(line, count // 2)), count

    def light(self, point: tuple[Any, Any, Any], slope: tuple[Any, Any], active: Any, seed: int) -> list[Any]:
        """Return the radiance along rays from the main lens."""
        x, y = ((p + (self.distance - point[2]) * s) / self._scale for p, s in zip(point[:2], slope, strict=True))
        light = self.radiance(x, y) * self._fall(point, x, y)
        if self._objective is not None:
            # Points that radiate evenly in all directions, by the sine condition.
            lens = TelecentricLens(self._objective)
            light *= dr.norm(mi.Vector3f(*slope, 1)) * (math.pi * lens.pupil.radius**2 / lens.passed_power)
        return [dr.select(active, light, 0)]

    def _fall(self, pupil: tuple[Any, Any, Any], x: Any, y: Any) -> Any:
        """Return cos^4 of the angle between a ray from a pupil point and the axis, over its mean over the pupil.

        Points behind thin lenses spread their power over the detector with this factor, which captures of scenes leave
        out by convention. The ray is that in the scene for an ideal lens, which keeps ranges of slopes, and that to the
        array for a parabolic phase, which keeps ranges of direction cosines.
        """
        if self._model is None:
            return 1.0
        scale, b = (self._scale, self.distance) if self._model == "ideal" else (1.0, self._pupil_distance)
        x, y, radius = x * scale, y * scale, self._pupil_radius
        own = dr.square(pupil[0] - x) + dr.square(pupil[1] - y)
        return 1 + 2 * (x * x + y * y + radius * radius / 2 - own) / (b * b)

    def radiance(self, x: Any, y: Any) -> Any:
        """Return the radiance where the line through the main lens's centre meets the array at x and y."""
        result = mi.Float(1)
        for place in (x, y):
            t = (place - self.centre) / self._fine + self._count // 2
            low = dr.floor(t)
            index = mi.UInt(dr.clip(low, 0, self._count - 2))
            result *= dr.lerp(
                dr.gather(mi.Float, self._line, index), dr.gather(mi.Float, self._line, index + 1), t - low
            )
        return result


def _scale(camera: PlenopticCamera, distance: float) -> float:
    """Return what places in a plane of the scene are over those on the array, seen from the pupil's middle."""
    if camera.objective is not None:
        return -1 / camera.objective.magnification
    image = conjugate_distance(camera.focal_length, distance)
    behind = camera.pupil_distance - camera.mla_distance
    return -distance / image * (image + behind) / camera.pupil_distance


def around(camera: PlenopticCamera, wall: Wall, margin: int) -> PlenopticCamera:
    """Return the camera with a detector that is cropped to where the wall's light goes."""
    half = math.ceil(
        (wall.blur + len(wall.axis) * wall.step / camera.row_pitch / 2 + margin) * camera.row_pitch / camera.pixel_size
    )
    centre = round(wall.centre * camera.micro_image_pitch / camera.row_pitch / camera.pixel_size)
    size = 2 * (abs(centre) + half)
    return camera.replace(
        detector_width=size * camera.pixel_size,
        resolution=(size, size),
        crop_offset=(centre + size // 2 - half,) * 2,
        crop_size=(2 * half, 2 * half),
    )


def reference(camera: PlenopticCamera, wall: Wall, method: str = "patch") -> np.ndarray:
    """Add the point spreads."""
    accuracy = 0.0 if method == "patch" else None
    operator = CaptureOperator(camera, wall.points, wavelength=WAVELENGTH, method=method, accuracy=accuracy)
    return np.asarray(operator.forward(wall.weight), dtype=float)


def capture(plan: PhaseSpace, camera: PlenopticCamera, wall: Wall, samples: int, parts: int, seed: int) -> np.ndarray:
    """Capture the wall by signed rays."""
    work = SignedRaySum(camera, wall.light, [Node(plan, (0,), np.ones((1, 1)))], parts=parts, spp=samples, seed=seed)
    items = int(work.items.sum())
    return (
        Job().run([SumTask(items, lambda: work, lambda image: image)], (*camera.shape, 1), items)[..., 0].astype(float)
    )
