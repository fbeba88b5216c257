"""Lamps in focus before small pupils, which spread their light over many lenses: wave captures against a closed form.

The light in a square of the array is the integral over frequencies of the spectra of lamp and square times the pupil's
transfer function (Goodman, "Introduction to Fourier Optics", section 6.3). Micro-images there are a pupil's, so that
the detector receives the same light behind the square but for what microlenses spread beyond its edge.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from mitsuba_plenoptic import PlenopticCamera, render_capture

from .. import Row, at_most, case
from ..scenes.light_paths import facing, radiating, scene_of, sensor

WAVELENGTH = 633.0
_PIXELS, _INNER = 16, 3


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
