"""What tests of waves share: small cameras of many kinds, points before them, and how far two images are apart."""

import numpy as np

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.lenses.fitted_lens import FittedLens
from mitsuba_plenoptic.lenses.pupil_fit import PupilRays, Pupils, fit_pupil
from mitsuba_plenoptic.lenses.thin import ThinLens

WAVELENGTH = 633.0

LATTICES = {
    "hexagonal": {"mla_lattice": "hexagonal"},
    "turned": {"mla_rotation": 7.0, "mla_offset": (0.01, -0.02)},
    "circles": {"mla_lattice": "hexagonal", "mla_rotation": 11.0, "mla_aperture": "circle", "mla_fill": 0.95},
    "gaps": {"mla_fill": 0.8},
    "rectangular": {"mla_pitch": (0.064, 0.05)},
    "stretched": {"mla_lattice": "hexagonal", "mla_pitch": (0.056, 0.07), "mla_rotation": 4.0},
    "three focal lengths": {
        "mla_lattice": "hexagonal", "mla_focal_length": (0.44, 0.512, 0.6), "mla_offset": (0.013, 0.0)
    },
}  # fmt: skip
"""Microlens arrays beside the square one."""

CAMERAS = {
    "square": {},
    "hexagonal, turned": {"mla_lattice": "hexagonal", "mla_rotation": 7.0, "mla_offset": (0.01, -0.02)},
    "rectangular": {"mla_pitch": (0.064, 0.05), "mla_offset": (0.0, 0.013)},
    "focused": {"mla_distance": 112.0, "detector_distance": 0.6},
    "turned, cropped": {
        "mla_rotation": -13.0, "mla_fill": 0.9, "detector_distance": 0.48,
        "crop_offset": (40, 60), "crop_size": (150, 101),
    },
}  # fmt: skip
"""Cameras that differ from the small one in all that the operator depends on."""

OTHER = {"focal_length": 50, "aperture_radius": 4, "mla_distance": 70, "mla_focal_length": 0.4, "mla_pitch": 0.05}
"""A camera whose numbers are others than the paper's throughout."""

HALF = {"focal_length": 40, "aperture_radius": 2.5, "mla_distance": 60}
"""The paper's main lens at half its size: the same micro-images and angles, and fields of a quarter of the samples."""


def small_camera(lenses=8, **parameters):
    """Return the paper's camera with so many lenses across."""
    return PlenopticCamera(detector_width=0.064 * lenses, resolution=(32 * lenses,) * 2, **parameters)


def places_of(bins, camera, oversample):
    """Return the middles of a response's bins on the array, (rows, columns, 2)."""
    rows, columns = np.indices(bins.shape)
    index = np.stack([columns, rows], -1) + bins.first + 0.5
    return (index - np.array(camera.bin_count) * oversample / 2) * (camera.mla_pitch / oversample)


def scattered(count, seed=0, distances=(225.0, 255.0), image=0.2):
    """Return scene points with their images anywhere within a distance from the axis."""
    rng = np.random.default_rng(seed)
    g = rng.uniform(*distances, count)
    return np.column_stack([rng.uniform(-image, image, (count, 2)) * -g[:, None] / 120.0, g])


def in_every_lens(camera, lenses, distance, per_lens=1, offset=0.0):
    """Return scene points at the same places of neighbouring lenses, by steps along the vectors of the lattice."""
    steps = (np.arange(lenses * per_lens) + 0.5) / per_lens - lenses / 2 + offset
    i, j = (index.ravel() for index in np.meshgrid(steps, steps))
    place = np.array(camera.lattice.centre(0.0, 0.0)) + np.stack([i, j], -1) @ np.array(camera.lattice.basis)
    return np.column_stack([place * -distance / camera.mla_distance, np.full(len(place), distance)])


def capture(camera, points, weights, *, wavelength=WAVELENGTH, job=None, **options):
    """Sum point spreads."""
    return CaptureOperator(camera, points, wavelength=wavelength, **options).forward(weights, job=job)


def error(image, reference):
    """Return the relative difference, in the L2 norm."""
    return np.linalg.norm(image - reference) / np.linalg.norm(reference)


def thin_as_real(camera, field, nearness):
    """Return the thin main lens of a camera, fitted over its pupil as a real one is."""
    thin = ThinLens(camera.focal_length, camera.aperture_radius, camera.mla_distance, "parabolic")

    def rays(field, nearness, entrance):
        distance = 1 / nearness
        point = (np.zeros_like(field), field * distance, distance)
        pupil = tuple(entrance)
        path = thin.path(pupil, point, WAVELENGTH) * WAVELENGTH * 1e-6
        amplitude = thin.amplitude(pupil, point) * distance
        stops = (entrance**2).sum(0)[None] / thin.pupil_radius**2
        return PupilRays(field, nearness, entrance, entrance, path, amplitude, stops)

    pupils = Pupils(0.0, 1.0, 1 / camera.focal_length)
    fitted = fit_pupil(rays, pupils, camera.aperture_radius, field, nearness, WAVELENGTH, good=1e-8)
    assert fitted.error < 1e-7
    return FittedLens(thin, camera.aperture_radius, fitted)
