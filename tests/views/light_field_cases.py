"""Cameras that the tests of light fields share."""

import numpy as np
import pytest
from cameras import OTHER
from scipy.ndimage import gaussian_filter, map_coordinates

from mitsuba_plenoptic import PlenopticCamera

PAPER = PlenopticCamera(detector_width=1.024, resolution=(512, 512))
SQUARE = {
    "paper": PAPER,
    "crop": PAPER.replace(resolution=(500, 400), crop_offset=(70, 33), crop_size=(300, 290)),
    "other": PlenopticCamera(**OTHER, detector_distance=0.42, detector_width=1.0, resolution=(400, 300)),
}
LATTICES = {
    "hexagonal": {"mla_lattice": "hexagonal"},
    "hexagonal, upright": {"mla_lattice": "hexagonal", "mla_rotation": 90.0, "mla_aperture": "circle"},
    "turned": {"mla_rotation": 17.0, "mla_offset": (0.021, -0.008)},
    "moved": {"mla_offset": (0.021, -0.008)},
    "rectangular": {"mla_pitch": (0.064, 0.058)},
    "hexagonal, stretched": {"mla_lattice": "hexagonal", "mla_pitch": (0.058, 0.064), "mla_rotation": 7.0},
}
CAMERAS = SQUARE | {
    name: PlenopticCamera(detector_width=1.28, resolution=(640, 512), **lattice) for name, lattice in LATTICES.items()
}

square_cameras = pytest.mark.parametrize("camera", SQUARE.values(), ids=SQUARE)
all_cameras = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)


def of_square_lenses(pixels, lenses, focused=None, **changes):
    """Give a camera at f/4 whose micro-images touch, sharp so many detector distances before its array or unfocused."""
    z = pixels * 0.01 * 62.5 / 12.5
    changes |= {"mla_focal_length": z if focused is None else 1 / (1 / z + 1 / (focused * z))}
    return PlenopticCamera(
        focal_length=50.0, aperture_radius=6.25, mla_distance=62.5, detector_distance=z,
        mla_pitch=pixels * 0.01 * 62.5 / (62.5 + z), detector_width=pixels * lenses * 0.01,
        resolution=(pixels * lenses, pixels * lenses), **changes,
    )  # fmt: skip


def straight_rays(camera, radiance, lens_gain=lambda i, j: 1.0):
    """Capture by rays through 16 points of each lens, and of 4 of each pixel; radiance (x, y, slopes) at the pupil."""
    generator = np.random.default_rng(0)
    b, z, n, lattice = camera.mla_distance, camera.detector_distance, camera.mla_medium, camera.lattice
    rise = np.tan(np.deg2rad(camera.mla_tilt))
    total = np.zeros(camera.shape)
    for index in range(64):
        inside = np.array([index // 32, index // 16 % 2]) / 2 + 0.25 - 0.5
        p = np.meshgrid(*(camera.pixel_coordinates(axis) + inside[axis] * camera.pixel_size for axis in (0, 1)))
        chief = [q * b / (b + z / n) for q in p]
        i, j = lattice.cell(*(q * (1 - (rise[0] * chief[0] + rise[1] * chief[1]) / b) for q in chief))
        centre = lattice.centre(i, j)
        h = rise[0] * centre[0] + rise[1] * centre[1]
        jitter = generator.random((2, *centre[0].shape))
        aside = lattice.aperture_point(*((index // step % 4 + jitter[axis]) / 4 for axis, step in enumerate((4, 1))))
        m = [c + at for c, at in zip(centre, aside, strict=True)]
        behind = [(q - s) / (z + h) for q, s in zip(m, p, strict=True)]
        t = [n * (slope - at / camera.mla_focal_length) for slope, at in zip(behind, aside, strict=True)]
        P = [place + (b - h) * slope for place, slope in zip(m, t, strict=True)]
        on_pupil = [q / camera.aperture_radius for q in P]
        light = lens_gain(i.astype(int), j.astype(int)) * camera.aperture.power(*on_pupil)
        if camera.vignetting is not None:
            light = light * camera.vignetting.power(*on_pupil, *m)
        if camera.pixel_response:
            angle = np.rad2deg(np.arctan(np.hypot(*behind)))
            light = light * np.interp(angle, camera.pixel_response[::2], camera.pixel_response[1::2])
        total += light * radiance(*P, *(s - q / camera.focal_length for s, q in zip(t, P, strict=True)))
    return (total / 64).astype(np.float32)


def blobs(distance, size, coarseness=0.75):
    """Give the radiance of a plane with random blobs, which have a standard deviation in lenses of a size."""
    pattern = gaussian_filter(np.random.default_rng(9).normal(size=(512, 512)), 8 * coarseness, mode="wrap")
    pattern = (0.5 + 0.15 * pattern / pattern.std()).clip(0.02, 1.5)

    def radiance(x, y, slope_x, slope_y):
        at = (y + distance * slope_y, x + distance * slope_x)
        return map_coordinates(pattern, [place * 8 / size for place in at], order=1, mode="grid-wrap")

    return radiance


def fall_off_of(camera, corner):
    """Give a factor of pixels that falls from 1 on the axis to that of the corners."""
    x, y = (camera.pixel_coordinates(axis) for axis in (0, 1))
    square = x**2 + y[:, None] ** 2
    return np.exp(np.log(corner) * square / square.max())
