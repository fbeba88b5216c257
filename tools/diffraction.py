r"""What the diffraction of the microlenses leaves of a wall's radiance in a capture by waves, by rays and their spread.

With :math:`\kappa = 1 + b/g - b/f_1`, the lens at c sees the place x of a plane (in coordinates of its image on the
array) through the pupil point P where :math:`c = x + \kappa P`. Its diffraction spreads the light of each pupil point
P' over others by :math:`K(P - P')`, the squared transform of its aperture at the scale of :math:`\lambda b`. So what
rays take for light of x came from :math:`x + \kappa (P - P')`, and a bin that is divided by white reads

.. math:: \frac{\sum_P \sum_{P'} K(P - P') \, L(x + \kappa (P - P'))}{\sum_P \sum_{P'} K(P - P')},

P over the pupil points that lenses on the detector see x through, P' over the pupil. Nothing of the package's own
propagation is used but the aperture's picture.
"""

from __future__ import annotations

import numpy as np
import walls

from mitsuba_plenoptic import PlenopticCamera

SAMPLES = 768
"""Across a plane of eight radii around the pupil."""


def lens_transfer(camera: PlenopticCamera, wavelength: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates across the pupil's plane, and a lens's aperture as a filter of fields in it.

    A frequency over the pupil is a place in the lens.
    """
    pitch = 8 * camera.aperture_radius / SAMPLES
    place = (np.arange(SAMPLES) - (SAMPLES - 1) / 2) * pitch
    lens = camera.lattice.aperture_image(wavelength * 1e-6 * camera.mla_distance / (SAMPLES * pitch), 1.0)
    amplitude = np.zeros((SAMPLES, SAMPLES))
    amplitude[: len(lens), : len(lens)] = lens / lens.max()
    return place, np.roll(amplitude, (-(len(lens) // 2),) * 2, (0, 1))


def intensity_transfer(amplitude: np.ndarray) -> np.ndarray:
    """Return the filter of intensities that belongs to one of fields."""
    spectrum = np.fft.fft2(np.abs(np.fft.ifft2(amplitude)) ** 2)
    return np.asarray(spectrum / spectrum[0, 0])


def filtered(values: np.ndarray, transfer: np.ndarray) -> np.ndarray:
    """Apply a filter."""
    return np.fft.ifft2(np.fft.fft2(values) * transfer).real


def expected(camera: PlenopticCamera, distance: float, wavelength: float, wall: str) -> np.ndarray:
    """Return what each bin of a wall reads, (rows, columns), by a capture with waves that rays refocus."""
    b, (columns, rows) = camera.mla_distance, camera.bin_count
    kappa = 1 + b / distance - b / camera.focal_length
    P, amplitude = lens_transfer(camera, wavelength)
    inside = (np.hypot(P, P[:, None]) <= camera.aperture_radius) * 1.0
    spread = np.fft.ifft2(intensity_transfer(amplitude)).real
    # Around the origin of the kernel, which is in the corner.
    shift = np.fft.ifftshift(P - P[SAMPLES // 2])
    half = np.array([columns, rows]) * camera.mla_pitch / 2
    seen = [
        np.abs((np.arange(count) + 0.5) * camera.mla_pitch - end + kappa * P[:, None]) <= end
        for count, end in zip((columns, rows), half, strict=True)
    ]
    white = filtered(inside, np.fft.fft2(spread)) * inside
    image = np.empty((rows, columns))
    for column in range(columns):
        x = (column + 0.5) * camera.mla_pitch - half[0]
        # The image on the array is upside down, and a wall's radiance rises to the left of a picture.
        radiance = walls.radiance(-(x + kappa * shift) / half[0], wall)
        light = filtered(inside, np.fft.fft2(spread * radiance)) * inside
        across = seen[0][:, column]
        image[:, column] = (light[:, across].sum(1) @ seen[1]) / (white[:, across].sum(1) @ seen[1])
    return image
