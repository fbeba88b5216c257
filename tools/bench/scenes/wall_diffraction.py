r"""What the microlenses' diffraction and the lenses' interference leave of a wall's radiance, by theory.

Diffraction: with :math:`\kappa = 1 + b/g - b/f_1`, the lens at c sees the position x of a plane (in coordinates of its
image on the array) through the pupil point P where :math:`c = x + \kappa P`. Its diffraction spreads the light of each
pupil point P' over others by :math:`K(P - P')`, the squared transform of its aperture at the scale of
:math:`\lambda b`. So rays take light of :math:`x + \kappa (P - P')` for light of x, and a bin divided by white reads

.. math:: \frac{\sum_P \sum_{P'} K(P - P') \, L(x + \kappa (P - P'))}{\sum_P \sum_{P'} K(P - P')},

P over the pupil points that lenses on the detector see x through, P' over the pupil.

Interference: the light of every lens that sees a bin comes from a position slightly beside it, as the microlens's
diffraction spreads what a wave capture records of the pupil, and spreads any capture on the return; at the rim of the
pupil light comes from one side only. With :math:`d` the difference of both positions in the pupil, the lens's image of
a slope is off by the slope times :math:`d`. Over all lenses that see a bin :math:`d` has no mean; the sum of their
fields weights it by their phases instead. For N lenses of random phases the pairs :math:`u_i^* u_j` add

.. math:: \frac{\sum_{i \ne j} \Re(u_i^* u_j d_j)}{\sum_i |u_i|^2}, \qquad
          \text{of variance } \tfrac12 \langle d^2 \rangle,

to the slope's image, and to that of white the same pairs without the :math:`d`, of variance 1 (Goodman, "Speckle
Phenomena in Optics", chapter 3). A bin averages both alike. So the error is the contrast that interference has in the
image of white, times the slope, times the RMS of d over the square root of 2.

Nothing of the package's own propagation is used but the picture of a microlens's aperture.
"""

from __future__ import annotations

import math

import cases
import numpy as np

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
    half = np.array([columns, rows]) * camera.row_pitch / 2
    seen = [
        np.abs((np.arange(count) + 0.5) * camera.row_pitch - end + kappa * P[:, None]) <= end
        for count, end in zip((columns, rows), half, strict=True)
    ]
    white = filtered(inside, np.fft.fft2(spread)) * inside
    image = np.empty((rows, columns))
    for column in range(columns):
        x = (column + 0.5) * camera.row_pitch - half[0]
        # The image on the array is upside down, and a wall's radiance rises to the left of a picture.
        radiance = cases.wall_radiance(-(x + kappa * shift) / half[0], wall)
        light = filtered(inside, np.fft.fft2(spread * radiance)) * inside
        across = seen[0][:, column]
        image[:, column] = (light[:, across].sum(1) @ seen[1]) / (white[:, across].sum(1) @ seen[1])
    return image


def interference_shift(camera: PlenopticCamera, distance: float, wavelength: float, model: str) -> float:
    """Return the RMS of d over the square root of 2, along x, in units of half the field, for a capture by a model."""
    radius = camera.aperture_radius
    P, amplitude = lens_transfer(camera, wavelength)
    inside = np.hypot(P, P[:, None]) <= radius
    light, slope = inside * 1.0, inside * P
    if model == "wave":
        light, slope = (filtered(pupil, intensity_transfer(amplitude)) for pupil in (light, slope))
    root = np.sqrt(light.clip(1e-6))
    field, change = (filtered(values, amplitude) for values in (root, slope / (2 * root)))
    d, power = (2 * change / field - P)[inside], field[inside] ** 2
    to_half_fields = camera.blur_diameter(distance) / radius / (camera.bin_count[0] * camera.row_pitch)
    return math.sqrt((power * d**2).sum() / power.sum() / 2) * to_half_fields
