r"""How much interference between lenses falsifies a coherent reconstruction of a slope of radiance, by theory.

The light of every lens that sees a bin comes from a little beside it: the microlens's diffraction spreads what a
capture by waves records of the pupil, and the same lens spreads any capture on the way back; at the rim of the pupil
light comes from one side only. With :math:`d` the place in the pupil from which light comes, less that to which it
goes, the lens's image of a slope is off by the slope times :math:`d`. Over all lenses that see a bin :math:`d` has no
mean; the sum of their fields weighs it by their phases instead. For N lenses of random phases the pairs
:math:`u_i^* u_j` add

.. math:: \frac{\sum_{i \ne j} \Re(u_i^* u_j d_j)}{\sum_i |u_i|^2}, \qquad
          \text{of variance } \tfrac12 \langle d^2 \rangle,

to the slope's image, and to that of white the same pairs without the :math:`d`, of variance 1 (Goodman, "Speckle
Phenomena in Optics", chapter 3). A bin averages both alike. So the error is the contrast that interference has in the
image of white, times the slope, times the RMS of d over the square root of 2.
"""

from __future__ import annotations

import math

import numpy as np
from diffraction import filtered, intensity_transfer, lens_transfer

from mitsuba_plenoptic import PlenopticCamera


def shift(camera: PlenopticCamera, distance: float, wavelength: float, model: str) -> float:
    """RMS of the shift over the square root of 2, along x, in units of half the field, for a capture by this model."""
    radius = camera.aperture_radius
    P, amplitude = lens_transfer(camera, wavelength)
    inside = np.hypot(P, P[:, None]) <= radius
    light, slope = inside * 1.0, inside * P
    if model == "wave":
        light, slope = (filtered(pupil, intensity_transfer(amplitude)) for pupil in (light, slope))
    root = np.sqrt(light.clip(1e-6))
    field, change = (filtered(values, amplitude) for values in (root, slope / (2 * root)))
    d, power = (2 * change / field - P)[inside], field[inside] ** 2
    to_half_fields = camera.blur_diameter(distance) / radius / (camera.bin_count[0] * camera.mla_pitch)
    return math.sqrt((power * d**2).sum() / power.sum() / 2) * to_half_fields
