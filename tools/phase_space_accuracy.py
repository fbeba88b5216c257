"""Signed rays against exact sums of point spreads, over the blur on the microlens array.

A wall of points, an even grid over some lenses, is captured twice: by signed rays, and point by point
with the fields' squares added (`CaptureOperator`, method "patch", accuracy 0). The walls have about as much edge as
area, and so show more error than a scene. Rays follow the parabolic lenses that waves pass. The noise of the rays is
found from two captures and subtracted; the light that the reference itself loses is printed. Writes a table and
pictures.

    python tools/phase_space_accuracy.py --output out/phase_space [--degree 4] [--cameras square discs] [--blurs 0 2]
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.capture.signed_colours import Node
from mitsuba_plenoptic.capture.signed_rays import SignedRaySum
from mitsuba_plenoptic.lenses.factory import main_lens
from mitsuba_plenoptic.lenses.telecentric import TelecentricLens
from mitsuba_plenoptic.operator.units import brightness_at, brightness_of, radiance_weight
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.runtime.jobs import Job, Task
from mitsuba_plenoptic.system.optical_system import OpticalSystem
from mitsuba_plenoptic.system.phase_space import PhaseSpace
from mitsuba_plenoptic.thin_lens import conjugate_distance

WAVELENGTH = 633.0
CAMERAS = {
    "square": PlenopticCamera(),
    "turned": PlenopticCamera(mla_rotation=7.0),
    "hexagonal": PlenopticCamera(mla_lattice="hexagonal", mla_rotation=7.0),
    "discs": PlenopticCamera(mla_lattice="hexagonal", mla_aperture="circle", mla_fill=0.5),
    "cells with gaps": PlenopticCamera(mla_fill=0.5),
    "double Gauss f8": PlenopticCamera.preset("paper_double_gauss"),
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
    "second": PlenopticCamera(
        focal_length=50.0, aperture_radius=4.0, mla_distance=70.0, mla_focal_length=0.4, mla_pitch=0.05
    ),
}
BLURS = (0.0, 0.5, -1.0, 2.0, -4.5)


def main() -> int:
    """Compare, and write table and pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/phase_space"))
    parser.add_argument("--cameras", nargs="+", default=["square"], choices=list(CAMERAS))
    parser.add_argument("--blurs", nargs="+", type=float, default=list(BLURS), help="radius in lenses, of either sign")
    parser.add_argument("--degree", type=int, default=4)
    parser.add_argument("--window", type=int, default=9)
    parser.add_argument("--radial", type=int, default=12)
    parser.add_argument("--lenses", type=int, default=3, help="across the wall")
    parser.add_argument("--points", type=int, default=16, help="points of the wall across a lens")
    parser.add_argument("--samples", type=int, default=1024, help="rays from each cell of the grid")
    parser.add_argument("--parts", type=int, default=1, help="cells of the grid across a pixel")
    parser.add_argument("--margin", type=int, default=4, help="lenses about the wall and its blur")
    parser.add_argument("--off-axis", type=float, default=0.0, help="of the wall's centre, in lenses along x and y")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")
    lines = [
        "| camera | blur (lenses) | signed rays | their noise | energy | reference's energy | time (s) |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in arguments.cameras:
        camera = CAMERAS[name]
        start = time.perf_counter()
        plan = PhaseSpace(camera, WAVELENGTH, degree=arguments.degree, window=arguments.window, radial=arguments.radial)
        plan.kernels(camera.pixel_size / arguments.parts, 2.5 * camera.mla_pitch)
        size = sum(part.nbytes for part in plan.table) / 2**20
        print(
            f"{name}: {len(plan.exponents)} coefficients, {size:.0f} MiB, {time.perf_counter() - start:.0f} s",
            flush=True,
        )
        for blur in arguments.blurs:
            start = time.perf_counter()
            wall = Wall(camera, blur, arguments.lenses, arguments.points, arguments.off_axis)
            view = around(camera, wall, arguments.margin)
            exact = reference(view, wall)
            image, other = (capture(plan, view, wall, arguments.samples, arguments.parts, seed) for seed in (1, 2))
            noise = error(image, other) / 2
            image = (image + other) / 2
            whole = wall.weight.sum()
            lines.append(
                f"| {name} | {blur:g} | {math.sqrt(max(error(image, exact) ** 2 - noise**2, 0)):.2%} | {noise:.2%} "
                f"| {image.sum() / whole:.4f} | {exact.sum() / whole:.4f} "
                f"| {time.perf_counter() - start:.0f} |"
            )
            print(lines[-1], flush=True)
            np.save(arguments.output / f"{name}_{blur:g}.npy", [image, exact])
            peak = float(exact.max())
            picture = np.concatenate([image, exact, 0.5 * peak + 10 * (image - exact)], axis=1)
            write_png(arguments.output / f"{name}_{blur:g}_signed_exact_difference_times_10.png", picture, peak=peak)
    (arguments.output / "phase_space_accuracy.md").write_text("\n".join(lines) + "\n")
    return 0


class Wall:
    """Points on an even grid of a plane, each of the weight of its cell of the grid in lenses.

    As the pupil passes no frequencies above its diffraction limit, points closer than half a period are for the capture
    the smooth radiance that `radiance` gives.
    """

    def __init__(self, camera: PlenopticCamera, blur: float, lenses: int, per_lens: int, off_axis: float) -> None:
        pitch = camera.mla_pitch
        self.blur = abs(blur)
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
        cut = 0.5 / self.step
        ramp = np.clip((frequency - 0.94 * cut) / (0.12 * cut), 0, 1)
        spectrum = np.exp(-2j * np.pi * np.outer(frequency, self.axis)).sum(1) * (0.5 + 0.5 * np.cos(np.pi * ramp))
        line = np.fft.irfft(spectrum, count) * self.step / self._fine
        self._line, self._count = mi.Float(np.roll(line, count // 2)), count

    def light(self, point: tuple[Any, Any, Any], slope: tuple[Any, Any], active: Any, seed: int) -> list[Any]:
        """Return the radiance along rays from the main lens."""
        x, y = ((p + (self.distance - point[2]) * s) / self._scale for p, s in zip(point[:2], slope, strict=True))
        light = self.radiance(x, y)
        if self._objective is not None:
            # Points that radiate evenly in all directions, by the sine condition.
            lens = TelecentricLens(self._objective)
            light *= dr.norm(mi.Vector3f(*slope, 1)) * (math.pi * lens.pupil_radius**2 / lens.passed_power)
        return [dr.select(active, light, 0)]

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
        (wall.blur + len(wall.axis) * wall.step / camera.mla_pitch / 2 + margin) * camera.mla_pitch / camera.pixel_size
    )
    centre = round(wall.centre * camera.micro_image_pitch / camera.mla_pitch / camera.pixel_size)
    size = 2 * (abs(centre) + half)
    return camera.replace(
        detector_width=size * camera.pixel_size,
        resolution=(size, size),
        crop_offset=(centre + size // 2 - half,) * 2,
        crop_size=(2 * half, 2 * half),
    )


def reference(camera: PlenopticCamera, wall: Wall) -> np.ndarray:
    """Add the point spreads."""
    operator = CaptureOperator(camera, wall.points, wavelength=WAVELENGTH, accuracy=0.0)
    return np.asarray(operator.forward(wall.weight), dtype=float)


def capture(plan: PhaseSpace, camera: PlenopticCamera, wall: Wall, samples: int, parts: int, seed: int) -> np.ndarray:
    """Capture the wall by signed rays."""
    work = SignedRaySum(camera, wall.light, [Node(plan, (0,), np.ones((1, 1)))], parts=parts, spp=samples, seed=seed)
    items = int(work.items.sum())
    return Job().run([Task(items, lambda: work, lambda image: image)], (*camera.shape, 1), items)[..., 0].astype(float)


def error(image: np.ndarray, exact: np.ndarray) -> float:
    """Return the relative difference in the L2 norm."""
    return float(np.linalg.norm(image - exact) / np.linalg.norm(exact))


if __name__ == "__main__":
    raise SystemExit(main())
