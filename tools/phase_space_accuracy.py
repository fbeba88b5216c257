"""Signed rays against exact sums of point spreads, over the blur on the microlens array.

A wall of points, an even grid over some lenses, is captured three times: by signed rays, by rays, and point by point
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
from mitsuba_plenoptic.optics import rays
from mitsuba_plenoptic.optics.main_lens import main_lens
from mitsuba_plenoptic.optics.phase_space import PhaseSpace
from mitsuba_plenoptic.report.images import write_png

WAVELENGTH = 633.0
CAMERAS = {
    "square": PlenopticCamera(),
    "turned": PlenopticCamera(mla_rotation=7.0),
    "hexagonal": PlenopticCamera(mla_lattice="hexagonal", mla_rotation=7.0),
    "discs": PlenopticCamera(mla_lattice="hexagonal", mla_aperture="circle", mla_fill=0.5),
    "cells with gaps": PlenopticCamera(mla_fill=0.5),
    "second": PlenopticCamera(
        focal_length=50.0, aperture_radius=4.0, mla_distance=70.0, mla_focal_length=0.4, mla_pitch=0.05
    ),
}
BLURS = (0.0, 0.5, -1.0, 2.0, -4.5)
GRID = 0.5
"""Step of the kernels' grid in pixels."""

STEPS = 1.1347241384015194 ** -np.arange(1.0, 6.0)
"""Steps of an additive sequence that fills five dimensions evenly: powers of 1 over the root of x^6 = x + 1."""

BOXES = ((1.25, 0.9, 0.35), (2.0, 0.07, 0.4), (0.0, 0.03, 0.25))
"""Boxes about a lens from which rays are drawn: width in apertures, or 0 for the window; parts of the rays, and those
near the rim of the pupil."""


def main() -> int:
    """Compare, and write table and pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/phase_space"))
    parser.add_argument("--cameras", nargs="+", default=["square"], choices=list(CAMERAS))
    parser.add_argument("--blurs", nargs="+", type=float, default=list(BLURS), help="radius in lenses, of either sign")
    parser.add_argument("--degree", type=int, default=4)
    parser.add_argument("--window", type=int, default=9)
    parser.add_argument("--lenses", type=int, default=3, help="across the wall")
    parser.add_argument("--points", type=int, default=16, help="points of the wall across a lens")
    parser.add_argument("--samples", type=int, default=1024, help="rays from each cell of the kernels' grid")
    parser.add_argument("--margin", type=int, default=4, help="lenses about the wall and its blur")
    parser.add_argument("--off-axis", type=float, default=0.0, help="of the wall's centre, in lenses along x and y")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")
    lines = [
        "| camera | blur (lenses) | signed rays | their noise | energy | reference's energy | rays | time (s) |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in arguments.cameras:
        camera = CAMERAS[name]
        start = time.perf_counter()
        plan = PhaseSpace(camera, WAVELENGTH, degree=arguments.degree, window=arguments.window)
        plan.kernels(GRID * camera.pixel_size, 2.5 * camera.mla_pitch)
        size = plan.table.nbytes / 2**20
        print(
            f"{name}: {len(plan.exponents)} coefficients, {size:.0f} MiB, {time.perf_counter() - start:.0f} s",
            flush=True,
        )
        for blur in arguments.blurs:
            start = time.perf_counter()
            wall = Wall(camera, blur, arguments.lenses, arguments.points, arguments.off_axis)
            view = around(camera, wall, arguments.margin)
            exact = reference(view, wall)
            (image, plain), (other, _) = (capture(plan, view, wall, arguments.samples, seed) for seed in (1, 2))
            noise = error(image, other) / 2
            image = (image + other) / 2
            whole = wall.weight.sum()
            lines.append(
                f"| {name} | {blur:g} | {math.sqrt(max(error(image, exact) ** 2 - noise**2, 0)):.2%} | {noise:.2%} "
                f"| {image.sum() / whole:.4f} | {exact.sum() / whole:.4f} | {error(plain, exact):.1%} "
                f"| {time.perf_counter() - start:.0f} |"
            )
            print(lines[-1], flush=True)
            np.save(arguments.output / f"{name}_{blur:g}.npy", [image, exact, plain])
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
        lens, pitch = main_lens(camera), camera.mla_pitch
        self.blur = abs(blur)
        self.distance = 1 / (1 / camera.focal_length - (1 - blur * pitch / lens.pupil_radius) / camera.mla_distance)
        self.step = pitch / per_lens
        self.axis = (np.arange(lenses * per_lens) + 0.5) * self.step - lenses * pitch / 2
        self.centre = off_axis * pitch
        place = np.stack(np.meshgrid(self.axis, self.axis), -1).reshape(-1, 2) + self.centre
        scale = -self.distance / camera.mla_distance
        self.points = np.column_stack([place * scale, np.full(len(place), self.distance)])
        self.weight = np.full(len(place), (self.step / pitch) ** 2)
        # The points' spectrum, cut half-way between what the pupil passes and its first repetition.
        self._fine, count = self.step / 16, 1 << 16
        frequency = np.fft.rfftfreq(count, self._fine)
        cut = 0.5 / self.step
        ramp = np.clip((frequency - 0.94 * cut) / (0.12 * cut), 0, 1)
        spectrum = np.exp(-2j * np.pi * np.outer(frequency, self.axis)).sum(1) * (0.5 + 0.5 * np.cos(np.pi * ramp))
        line = np.fft.irfft(spectrum, count) * self.step / self._fine
        self._line, self._count = mi.Float(np.roll(line, count // 2)), count

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


def around(camera: PlenopticCamera, wall: Wall, margin: int) -> PlenopticCamera:
    """Return the camera with a detector that is cropped to where the wall's light goes."""
    half = math.ceil(
        (wall.blur + len(wall.axis) * wall.step / camera.mla_pitch / 2 + margin) * camera.mla_pitch / camera.pixel_size
    )
    centre = round(wall.centre * (1 + camera.detector_distance / camera.mla_distance) / camera.pixel_size)
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


def capture(
    plan: PhaseSpace, camera: PlenopticCamera, wall: Wall, samples: int, seed: int = 5
) -> tuple[np.ndarray, np.ndarray]:
    """Capture the wall by signed rays and by rays, in units of the wall's weight."""
    f1, b, z, f2 = camera.focal_length, camera.mla_distance, camera.detector_distance, camera.mla_focal_length
    lattice, step = plan.lattice, camera.pixel_size * GRID
    shape = tuple(round(count / GRID) for count in reversed(camera.crop_size))
    corner = [
        (offset - count / 2) * camera.pixel_size
        for offset, count in zip(camera.crop_offset, camera.resolution, strict=True)
    ]
    radius = float(main_lens(camera).pupil_radius)
    # Cells of the grid that light of a lens may reach through some point of the window, lens by lens.
    reach = z / b * (radius + max(plan.window_size))
    low, high = corner[0] - reach, corner[0] + shape[1] * step + reach
    low_y, high_y = corner[1] - reach, corner[1] + shape[0] * step + reach
    span = math.ceil(2 * (high - low + high_y - low_y) / lattice.nearest_distance)
    middle = lattice.cell(corner[0] + shape[1] * step / 2, corner[1] + shape[0] * step / 2)
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(-span, span + 1.0), np.arange(-span, span + 1.0)))
    cx, cy = lattice.centre(i + middle[0], j + middle[1])
    kept = (cx > low) & (cx < high) & (cy > low_y) & (cy < high_y)
    cx, cy = cx[kept], cy[kept]
    lit = math.ceil(reach / step) + 1
    du, dv = (grid.ravel() for grid in np.meshgrid(np.arange(-lit, lit + 1), np.arange(-lit, lit + 1)))
    near = du**2 + dv**2 <= (lit + 1) ** 2
    column = np.floor((cx * (1 + z / b) - corner[0]) / step)[:, None] + du[near]
    row = np.floor((cy * (1 + z / b) - corner[1]) / step)[:, None] + dv[near]
    kept = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    lens = np.nonzero(kept)[0]
    column, row = column[kept], row[kept]
    cx, cy = mi.Float(cx[lens]), mi.Float(cy[lens])
    px, py = (
        mi.Float((column + 0.5) * step + corner[0] - cx.numpy()),
        mi.Float((row + 0.5) * step + corner[1] - cy.numpy()),
    )
    coefficients = plan.bind()
    # Points of the window, most of them about the lens, but near the pupil's rim, where it spreads rays far.
    width = 2 * lattice.aperture_reach if lattice.aperture == "circle" else max(lattice.aperture_widths)
    at_rim = dr.square(px - cx * (z / b)) + dr.square(py - cy * (z / b)) > (0.88 * radius * z / b) ** 2
    parts = [dr.select(at_rim, rim, other) for _, other, rim in BOXES]
    sides = [(scale * width,) * 2 if scale else plan.window_size for scale, _, _ in BOXES]
    chance = mi.PCG32(size=len(lens), initstate=seed)
    shift = [chance.next_float32() for _ in STEPS]
    sums = [dr.zeros(mi.Float, len(lens)) for _ in range(len(plan.exponents) + 1)]
    dr.eval(shift, parts)
    cell_x, cell_y = px, py
    for index in range(samples):
        r = [
            fraction(start + dr.opaque(mi.Float, (index * alpha) % 1))
            for start, alpha in zip(shift, STEPS, strict=True)
        ]
        px, py = cell_x + (r[3] - 0.5) * step, cell_y + (r[4] - 0.5) * step
        first, second = r[2] < parts[0], r[2] < parts[0] + parts[1]
        u, v = (
            (r[k] - 0.5) * dr.select(first, sides[0][k], dr.select(second, sides[1][k], sides[2][k])) for k in range(2)
        )
        density = mi.Float(0)
        for part, side in zip(parts, sides, strict=True):
            held = (dr.abs(u) <= side[0] / 2) & (dr.abs(v) <= side[1] / 2)
            density += dr.select(held, part / (side[0] * side[1]), 0)
        mx, my = lattice.from_frame(u, v)
        # By direction cosines, as parabolic phase elements turn rays.
        # What the pupil spreads into the lens passes it, and lands, as a ray through its nearest point does.
        nx, ny = lattice.from_frame(
            *(dr.clip(s, -side / 2, side / 2) for s, side in zip((u, v), lattice.aperture_widths, strict=True))
        )
        tx, ty = (nx - px) / z, (ny - py) / z
        beam = 1 + tx * tx + ty * ty
        tx, ty = rays.slopes_to_cosines(tx, ty)
        tx, ty = tx - nx / f2, ty - ny / f2
        # Area on the pupil over that on the detector, in units of (b / z)^2: light is neither lost nor gained.
        beam = dr.square(beam * (1 - tx * tx - ty * ty))
        tx, ty = rays.cosines_to_slopes(tx, ty)
        P = rays.pupil_point(cx + nx, tx, b), rays.pupil_point(cy + ny, ty, b)
        sx, sy = rays.slopes_to_cosines((P[0] - cx - mx) / b, (P[1] - cy - my) / b)
        sx, sy = rays.cosines_to_slopes(sx - P[0] / f1, sy - P[1] / f1)
        X, Y = P[0] + wall.distance * sx, P[1] + wall.distance * sy
        radiance = wall.radiance(-X * b / wall.distance, -Y * b / wall.distance) / (density * beam)
        active = (P[0] ** 2 + P[1] ** 2 <= radius**2) & (radiance != 0)
        jitter = tuple(chance.next_float32() for _ in range(4))
        values = coefficients((mx, my), P, jitter, active)
        own = lattice.in_aperture(mx, my) & active
        for n, value in enumerate([*values, dr.select(own, mi.Float(1), 0)]):
            sums[n] = dr.fma(dr.select(active, value, 0), radiance, sums[n])
        dr.eval(sums, chance)
    scale = (b / z) ** 2 * step**2 / (math.pi * radius**2 * camera.mla_pitch**2 * samples)
    place = (row * shape[1] + column).astype(int)
    images = (
        np.stack([np.bincount(place, np.asarray(s, float), shape[0] * shape[1]).reshape(shape) for s in sums]) * scale
    )
    return develop(plan, images[:-1], step), pixels(images[-1])


def develop(plan: PhaseSpace, images: np.ndarray, step: float) -> np.ndarray:
    """Convolve the images with their kernels, and add them into pixels."""
    kernels = plan.kernels(step, 2.5 * plan.camera.mla_pitch)
    half = kernels.shape[1] // 2
    size = [side + 2 * half for side in images.shape[1:]]
    spectrum = sum(np.fft.rfft2(i, size) * np.fft.rfft2(k, size) for i, k in zip(images, kernels, strict=True))
    whole = np.fft.irfft2(spectrum, size)
    return pixels(whole[half : half + images.shape[1], half : half + images.shape[2]])


def pixels(image: np.ndarray) -> np.ndarray:
    """Add the cells of a grid into pixels."""
    per = round(1 / GRID)
    return image.reshape(image.shape[0] // per, per, image.shape[1] // per, per).sum((1, 3))


def fraction(value: Any) -> Any:
    """Return what is left of a number without its whole part."""
    return value - dr.floor(value)


def error(image: np.ndarray, exact: np.ndarray) -> float:
    """Return the relative difference in the L2 norm."""
    return float(np.linalg.norm(image - exact) / np.linalg.norm(exact))


if __name__ == "__main__":
    raise SystemExit(main())
