"""Halves of dual pixels in a medium: even scenes and points by rays and by waves, against sums of rays and of waves."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from mitsuba_plenoptic import PlenopticCamera, design, dual_pixel, psf_bank, render_capture

from .. import Row, at_most, case

WAVELENGTH = 550.0

LENSES = 12
"""Lenses across the recorded window."""

SAMPLES = 64
"""Samples across a lens for waves."""

AROUND = 17
"""Lenses across the window of a star's waves."""


def window(angle: float, **changes: Any) -> tuple[PlenopticCamera, tuple[float, float]]:
    """Return a telephone's camera that records lenses around a chief-ray angle in degrees, and the place of one."""
    camera = PlenopticCamera.preset("phone_quad").replace(**changes)
    width, height = camera.resolution
    across = round(camera.mla_distance * math.tan(math.radians(angle)) / camera.mla_pitch)
    camera = camera.replace(
        crop_offset=(width // 2 + 2 * across - LENSES, height // 2 - LENSES), crop_size=(2 * LENSES, 2 * LENSES)
    )
    return camera, ((across + 0.5) * camera.mla_pitch, 0.5 * camera.mla_pitch)


def left_of_even(camera: PlenopticCamera, model: str, spp: int) -> tuple[float, float]:
    """Return the part of an even scene's light in the left halves, and its light over the closed form by ideal rays."""
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant"},
        "camera": camera.to_sensor(),
    })  # fmt: skip
    wavelength = {"wavelength": WAVELENGTH} if model == "wave" else {}
    halves = dual_pixel(render_capture(scene, model=model, spp=spp, **wavelength)).values[0, :, 2:-2, 2:-2]
    left, right = halves.mean((1, 2), dtype=float)
    return left / (left + right), (left + right) / 4 / design.white_mean(camera)


def left_of_point(camera: PlenopticCamera, field: tuple[float, float], model: str) -> float:
    """Return the part of the light of a point in focus in its left half."""
    bank = psf_bank(camera, [1000.0], [field], model=model, wavelength=WAVELENGTH, size=9)
    left, right = bank.sum(("t", "s")).values.ravel()
    return float(left / (left + right))


def _through(camera: PlenopticCamera, field: tuple[float, float], count: int) -> tuple[Any, ...]:
    """Return the lens's distance from its pixels' middle, points of it, and the direction cosines of its light."""
    n, b = camera.mla_medium, camera.mla_distance
    # The chief ray's way in the medium, by Snell's law.
    height = math.hypot(*field)
    way = 0.0
    for _ in range(20):
        sine = math.sin(math.atan((height - way) / b)) / n
        way = camera.detector_distance * sine / math.sqrt(1 - sine * sine)
    shift = np.array(field) * (way / height)
    u = qmc.Sobol(4, seed=0).random(count)
    d = (u[:, :2] - 0.5) * camera.mla_pitch
    radius, angle = camera.aperture_radius * np.sqrt(u[:, 2]), 2 * np.pi * u[:, 3]
    slope = (np.array(field) - shift + d - np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)) / b
    return shift, d, slope / np.sqrt(1 + (slope**2).sum(1, keepdims=True))


def left_by_cosines(camera: PlenopticCamera, field: tuple[float, float], count: int = 2**17) -> float:
    """Return the left half's part of the light of all points of the pupil through all of a lens, ray by ray.

    The lens turns direction cosines, and Snell's law holds behind it.
    """
    shift, d, cosine = _through(camera, field, count)
    behind = (cosine - d * (camera.mla_medium / camera.mla_focal_length)) / camera.mla_medium
    landed = d - shift + camera.detector_distance * behind / np.sqrt(1 - (behind**2).sum(1, keepdims=True))
    return float((np.floor(landed[:, 0] / camera.pixel_size) % 2 == 1).mean())


def left_by_waves(camera: PlenopticCamera, field: tuple[float, float], count: int = 2**9) -> float:
    """Return the same for plane waves through the array of lenses, which are thin phases, and exact propagation."""
    shift, _, cosine = _through(camera, field, count)
    n, k = camera.mla_medium, 2e6 * math.pi / WAVELENGTH
    x = ((np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5) * camera.mla_pitch
    along = np.exp(-0.5j * k * n * x**2 / camera.mla_focal_length)
    orders = np.fft.fft2(np.outer(along, along))
    step = np.fft.fftfreq(SAMPLES, 1 / SAMPLES) * (2 * math.pi / k / camera.mla_pitch)
    # Samples move from those of the lens to those of its pixels.
    moved = np.exp(1j * k * (step[:, None] * shift[1] + step * shift[0]))
    total: NDArray[np.float64] = np.zeros(SAMPLES)
    for sx, sy in cosine:
        square = n * n - (sx + step) ** 2 - (sy + step[:, None]) ** 2
        axial = np.where(square > 0, np.exp(1j * k * camera.detector_distance * np.sqrt(np.abs(square))), 0)
        total += (np.abs(np.fft.ifft2(orders * axial * moved)) ** 2).sum(0)
    return float(total[: SAMPLES // 2].sum() / total.sum())


def left_of_star(camera: PlenopticCamera, field: tuple[float, float], count: int = 2**12) -> float:
    """Return the same for a point whose image by the main lens is a lens's centre: these waves are coherent."""
    shift, *_ = _through(camera, field, 1)
    centre = np.array(field) - shift
    n, k, pitch = camera.mla_medium, 2e6 * math.pi / WAVELENGTH, camera.mla_pitch
    u = qmc.Sobol(2, seed=0).random(count)
    radius, angle = camera.aperture_radius * np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    slope, chief = (centre - pupil) / camera.mla_distance, centre / camera.mla_distance
    cosine = slope / np.sqrt(1 + (slope**2).sum(1, keepdims=True))
    base = chief / math.sqrt(1 + chief @ chief)
    across = SAMPLES // 2
    x = ((np.arange(AROUND * across) + 0.5) / across - AROUND / 2) * pitch
    waves = [np.exp(1j * k * np.outer(x, cosine[:, axis] - base[axis])) for axis in (0, 1)]
    # Equal powers from equal areas of the pupil.
    arriving = (waves[1] * (1 - (cosine**2).sum(1))) @ waves[0].T
    inner = x - np.round(x / pitch) * pitch
    along = np.exp(-0.5j * k * n * inner**2 / camera.mla_focal_length)
    step = np.fft.fftfreq(len(x), 1 / len(x)) * (2 * math.pi / k / (AROUND * pitch))
    square = n * n - (base[0] + step) ** 2 - (base[1] + step[:, None]) ** 2
    axial = np.where(square > 0, np.exp(1j * k * camera.detector_distance * np.sqrt(np.abs(square))), 0)
    moved = np.exp(1j * k * (step[:, None] * shift[1] + step * shift[0]))
    light = (np.abs(np.fft.ifft2(np.fft.fft2(arriving * np.outer(along, along)) * axial * moved)) ** 2).sum(0)
    return float(light.reshape(AROUND, 2, -1)[:, 0].sum() / light.sum())


@case(
    "dual-pixels.medium",
    "Part of the light in the left halves of a telephone by the chief-ray angle: lenses are aligned by Snell's law",
    {
        "angle": "{angle:g}°", "ideal rays": "{ideal:.3f}", "a point": "{ideal_point:.3f}",
        "parabolic rays": "{parabolic:.3f}", "their sum": "{parabolic_sum:.3f}", "its point": "{parabolic_point:.3f}",
        "waves": "{wave:.3f}", "sum of waves": "{wave_sum:.3f}", "a star": "{wave_point:.3f}",
        "its sum": "{star_sum:.3f}", "light": "{ideal_light:.4f}, {parabolic_light:.4f}, {wave_light:.4f}",
    },
    (
        at_most("off", 0.01), at_most("off_parabolic", 0.005), at_most("off_wave", 0.005),
        at_most("off_light", 0.005),
    ),
    page="docs/theory/rays.md",
    quick={"angles": (30.0,)},
)  # fmt: skip
def medium(*, angles: tuple[float, ...] = (8.0, 20.0, 30.0, 35.0), spp: int = 16384) -> Iterator[Row]:
    """Compare the halves, and the light over that of the closed form."""
    mi.set_variant("llvm_ad_mono")
    for angle in angles:
        row: Row = {"angle": angle}
        for name in ("ideal", "parabolic"):
            camera, field = window(angle, lens_model=name)
            row[name], row[f"{name}_light"] = left_of_even(camera, "ray", spp)
            row[f"{name}_point"] = left_of_point(camera, field, "ray")
        row["parabolic_sum"] = left_by_cosines(camera, field)
        camera, field = window(angle)
        row["wave"], row["wave_light"] = left_of_even(camera, "wave", spp // 16)
        row["wave_sum"], row["wave_point"] = left_by_waves(camera, field), left_of_point(camera, field, "wave")
        row["star_sum"] = left_of_star(camera, field)
        row["off"] = max(abs(row[name] - 0.5) for name in ("ideal", "ideal_point"))
        row["off_parabolic"] = abs(row["parabolic"] - row["parabolic_sum"])
        row["off_wave"] = max(abs(row["wave"] - row["wave_sum"]), abs(row["wave_point"] - row["star_sum"]))
        row["off_light"] = max(abs(row[f"{name}_light"] - 1) for name in ("ideal", "parabolic", "wave"))
        yield row
