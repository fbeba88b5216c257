"""Lamps in focus: light of wave captures against closed forms, before small pupils and by few samples.

Small pupils spread light over many lenses. The light in a square of the array is the integral over frequencies of the
spectra of lamp and square times the pupil's transfer function (Goodman, "Introduction to Fourier Optics", section 6.3).
Micro-images there are a pupil's, so that the detector receives the same light behind the square but for what
microlenses spread beyond its edge.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import PlenopticCamera, render_capture

from .. import Row, at_most, case
from ..scenes.light_paths import facing, radiating, scene_of, sensor

WAVELENGTH = 633.0
_PIXELS = 16

STARS, STAR_LENSES, STAR_PIXELS, MARGIN = 400, 12, 20, 3.5
"""Stars of a sky, lenses across the detector, pixels across a lens, and lenses beside the stars."""


@case(
    "lamps",
    "Light of a small lamp in focus on the detector by waves, over the closed form, before pupils that diffract widely",
    {
        "pupil": "f/{f_number:g}", "Airy radius (lenses)": "{airy:.2g}", "closed form, of all light": "{part:.3f}",
        "detector": "{whole:.4f} ± {whole_error:.4f}", "closed form, nine lenses": "{inner_part:.3f}",
        "nine lenses": "{inner:.4f} ± {inner_error:.4f}",
    },
    (at_most("excess", "limit"),),
    page="docs/theory/phase_space.md",
    quick={"f_numbers": (60.0,), "samples": 32.0, "seeds": 2},
)  # fmt: skip
def lamps(
    *,
    f_numbers: tuple[float, ...] = (12.0, 30.0, 60.0, 120.0, 240.0, 600.0),
    lenses: int = 14,
    size: float = 2.0,
    samples: float = 512.0,
    seeds: int = 4,
) -> Iterator[Row]:
    """Capture a square lamp over a lens's centre; ``size`` is that of its image in lenses.

    Samples are those of a pixel at f/12. Their number grows with the square of the f-number, as lit pixels get fewer.
    """
    for number in f_numbers:
        radius = 120 / number / 2
        camera = PlenopticCamera(
            detector_width=0.064 * lenses, resolution=(_PIXELS * lenses,) * 2, aperture_radius=radius
        )
        pitch, b, scale = camera.mla_pitch, camera.mla_distance, camera.focus_distance / camera.mla_distance
        place, half = -pitch / 2 * scale, size * pitch / 2 * scale
        scene = scene_of(
            sensor(lenses, _PIXELS, aperture_radius=radius),
            lamp=facing(camera.focus_distance, half, (place, place), **radiating()),
        )
        images = [
            render_capture(
                scene, model="wave", wavelength=WAVELENGTH, spp=round(samples * (number / 12) ** 2), seed=seed
            ).image
            for seed in range(seeds)
        ]
        # A lens full of light has that of the pupil's image on the detector.
        light = size**2 * math.pi / 4 * (2 * radius * camera.detector_distance / (b * camera.pixel_size)) ** 2
        middle = (lenses // 2 - 1) * _PIXELS, (lenses // 2 + 2) * _PIXELS
        found = {}
        for name, images_of, box in (
            ("", images, (-lenses / 2, lenses / 2)),
            ("inner_", [image[middle[0] : middle[1], middle[0] : middle[1]] for image in images], (-1.0, 2.0)),
        ):
            part = _light_in(box, size, 2 * radius * pitch / (WAVELENGTH * 1e-6 * b))
            ratios = [float(image.sum(dtype=float)) / light / part for image in images_of]
            found[f"{name}part"] = part
            found["inner" if name else "whole"] = float(np.mean(ratios))
            found["inner_error" if name else "whole_error"] = float(np.std(ratios, ddof=1)) / math.sqrt(seeds)
        yield {
            "f_number": number, "airy": 1.22 * WAVELENGTH * 1e-6 * b / (2 * radius) / pitch, **found,
            "excess": abs(found["whole"] - 1), "limit": 0.01 + 3 * found["whole_error"],
        }  # fmt: skip


def _light_in(box: tuple[float, float], size: float, cut: float, count: int = 2000) -> float:
    """Return the part of a square lamp's light, centred at (1/2, 1/2), in a box along both axes; lengths in lenses."""
    frequency = (np.arange(count) + 0.5) / count * cut
    part = np.minimum(np.hypot(frequency, frequency[:, None]) / cut, 1)
    transfer = 2 / np.pi * (np.arccos(part) - part * np.sqrt(1 - part**2))
    width, aside = box[1] - box[0], (box[0] + box[1]) / 2 - 0.5
    along = np.sinc(width * frequency) * width * np.sinc(size * frequency) * np.cos(2 * np.pi * frequency * aside)
    return float(4 * (along @ transfer @ along) * (cut / count) ** 2)


def sky() -> tuple[Any, float]:
    """Return a scene of stars of random places and sizes in focus, and its light, the sum of its capture's pixels.

    A micro-image of uniform radiance 1 has pi / 4 (D1 z / b)^2 of the detector's area, and stars their part of it.
    """
    random = np.random.default_rng(1)
    pitch, step = 0.128, 1e-4
    half = (STAR_LENSES / 2 - MARGIN) * pitch
    places, sizes = random.uniform(-half, half, (STARS, 2)), random.uniform(0.002, 0.012, STARS)
    scene = scene_of(
        sensor(STAR_LENSES, STAR_PIXELS),
        **{
            f"star_{i}": facing(240.0, float(size), (float(x), float(y)), **radiating())
            for i, ((x, y), size) in enumerate(zip(places, sizes, strict=True))
        },
    )
    # Stars may overlap: their union, on a fine grid.
    axis = np.arange(-half - 0.02, half + 0.02, step)
    covered = np.zeros((len(axis),) * 2, bool)
    for place, size in zip(places, sizes, strict=True):
        rows, columns = (slice(*np.searchsorted(axis, [p - size, p + size])) for p in place)
        covered[rows, columns] = True
    lenses = covered.sum() * (step / pitch) ** 2
    return scene, lenses * math.pi / 4 * (10 * 0.512 / (120 * 0.064 / STAR_PIXELS)) ** 2


def light_of_stars(scene: Any, light: float, spp: int, seeds: int, noise: bool) -> tuple[float, float, float]:
    """Return the mean of captures' light over their stars' light, its standard error, and the least pixel."""
    images = [
        # Counts of samples share no seeds.
        render_capture(scene, model="wave", spp=spp, seed=10_000 * spp + seed, noise=noise).image
        for seed in range(seeds)
    ]
    found = [image.sum(dtype=float) / light for image in images]
    return float(np.mean(found)), float(np.std(found, ddof=1)) / math.sqrt(seeds), float(np.min(images))


@case(
    "stars",
    "Light of 400 small stars by waves over the closed form, by few and by many samples of a pixel",
    {"option noise": "{noise}", "samples": "{samples}", "light": "{mean:.4f} ± {error:.4f}", "seeds": "{seeds}"},
    (at_most("excess", "limit"),),
    page="docs/theory/phase_space.md",
    quick={"samples": (1, 16), "noisy": (2,), "scale": 0.05},
)  # fmt: skip
def stars(
    *,
    samples: tuple[int, ...] = (1, 4, 16, 64, 256, 1024),
    noisy: tuple[int, ...] = (2, 16, 128, 1024),
    scale: float = 1.0,
) -> Iterator[Row]:
    """Capture the same stars by counts of samples, without and with the option noise; ``scale`` is that of the seeds.

    The noise option compares two halves of a capture's samples, which one sample does not have.
    """
    mi.set_variant("llvm_ad_mono")
    scene, light = sky()
    for noise, counts in ((False, samples), (True, noisy)):
        for spp in counts:
            seeds = max(3, round(scale * max(20, 160 / math.sqrt(spp))))
            mean, error, _ = light_of_stars(scene, light, spp, seeds, noise)
            yield {
                "noise": "yes" if noise else "no", "samples": spp, "mean": mean, "error": error, "seeds": seeds,
                "excess": abs(mean - 1), "limit": min(0.01, 3.5 * error) if scale >= 1 else 3.5 * error,
            }  # fmt: skip
