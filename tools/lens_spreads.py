"""Measure a real main lens's point spread by waves against Optiland's `HuygensPSF`, which sums over traced rays.

Optiland is the extra `lenses`. The bare lens is taken, without microlenses: the intensity on their plane.

    python tools/lens_spreads.py
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.interpolate
from accuracy import Row, finish, markdown, options, start
from record_optiland import image_distance, sample

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.operator.point_spread import point_fields
from mitsuba_plenoptic.prescription import bundled_prescription, paraxial

WAVELENGTH = 633.0
F_NUMBER = 8.0
FAR = 1e9
PIXEL = 0.5e-3
WINDOW = 96
"""Places across the compared window, and their distance in millimetres."""


def theirs(name: str, angle: float, rays: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Optiland's spread (y, x), and the place of its middle in millimetres."""
    from optiland.psf import HuygensPSF

    optic, scale = sample(name)
    assert scale == 1
    optic.set_aperture(aperture_type="EPD", value=paraxial(bundled_prescription(name)).focal_length / F_NUMBER)
    field = (0.0, angle / float(optic.fields.max_field))
    psf = HuygensPSF(optic, field, WAVELENGTH * 1e-3, num_rays=rays, image_size=WINDOW, pixel_pitch=PIXEL)
    # Its strategy's way to choose the middle, and the places around it.
    x, y, _ = psf._get_image_coordinates()
    x, y = np.asarray(x), np.asarray(y)
    return np.asarray(psf.psf), np.array([x, y])


def ours(name: str, angle: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return our intensity at places of Optiland's image plane, whose y is turned."""
    lens = bundled_prescription(name)
    numbers = paraxial(lens)
    middle = (float(x.mean()), -float(y.mean()))
    # A detector that reaches as far as the image, of which a few pixels are recorded around it.
    half, pixel = math.ceil(2 + np.max(np.abs(middle))), 2e-3
    count = round(2 * half / pixel)
    first = [round((m + half) / pixel) - 64 for m in middle]
    camera = PlenopticCamera(
        main_lens=lens,
        aperture_radius=numbers.focal_length / F_NUMBER / 2,
        mla_distance=image_distance(*sample(name)) - numbers.rear_principal,
        detector_width=count * pixel,
        resolution=(count, count),
        crop_offset=(first[0], first[1]),
        crop_size=(128, 128),
    )
    field = point_fields(camera, (0.0, FAR * math.tan(math.radians(angle)), FAR), wavelength=WAVELENGTH).mla
    axes = [field.origin[axis] + field.pitch * np.arange(field.samples.shape[1 - axis]) for axis in (0, 1)]
    near = [np.abs(values - m) < 0.1 for values, m in zip(axes, middle, strict=True)]
    intensity = np.abs(field.samples[np.ix_(near[1], near[0])]) ** 2
    spline = scipy.interpolate.RectBivariateSpline(axes[1][near[1]], axes[0][near[0]], intensity, kx=5, ky=5)
    return spline.ev(-y, x)


def comparison(name: str, angle: float, rays: int = 256) -> Row:
    """Return how far our spread is from Optiland's, and how much that moves with a quarter of its rays."""
    psf, (x, y) = theirs(name, angle, rays)
    coarse, _ = theirs(name, angle, rays // 2)
    found = ours(name, angle, x, y)
    scale = float(np.sum(found * psf) / np.sum(psf * psf))

    def distance(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.linalg.norm(a - b) / np.linalg.norm(b))

    return {
        "lens": name,
        "angle": angle,
        "difference": distance(found / scale, psf),
        "convergence": distance(coarse / coarse.sum(), psf / psf.sum()),
        "peak": float(found.max() / found.sum() / (psf.max() / psf.sum()) - 1),
    }


def main() -> None:
    """Measure, print and write."""
    arguments = start(options("lens_spreads", __doc__))
    rows: list[dict[str, Any]] = [comparison("double_gauss", 0.0), comparison("double_gauss", 2.0)]
    heads = {
        "lens": "{lens}",
        "degrees": "{angle:g}",
        "relative L2 (limit 1 %)": "{difference:.2%}",
        "Optiland at half as many rays": "{convergence:.2%}",
        "peak over the window's light": "{peak:+.2%}",
    }
    finish(
        arguments,
        rows,
        f"Bare lens at f/{F_NUMBER:g} and {WAVELENGTH:g} nm against HuygensPSF\n",
        markdown(heads, rows),
    )


if __name__ == "__main__":
    main()
