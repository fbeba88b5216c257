"""What a main lens does to an image by itself, for the fields, pupil and image plane of its designer or of the reader.

The modulation transfer function is the autocorrelation of the light of one point on the exit pupil, over the direction
cosines in which it reaches the point's image (Goodman, "Introduction to Fourier Optics", section 6.3). The light is
that of the wave captures: traced path and amplitude, within the edges of all surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..camera import PlenopticCamera
from ..errors import refuse_if
from ..lenses import FAR, main_lens, sequential
from ..optics import in_millimetres
from ..prescription import Prescription, conjugate_distance, paraxial
from ..runtime import Doubles
from .lens_drawing import chief

FREQUENCIES = (10, 30, 50)
"""Frequencies of the modulation transfer function, in cycles per millimetre of the image."""


def behind_lens(
    lens: Prescription, pupil: float = 0.0, fields: Sequence[float] = ()
) -> tuple[PlenopticCamera, float, dict[float, float]]:
    """Return a camera in the image plane of a lens, the object's distance, and the fields' image heights by angle.

    Parameters
    ----------
    lens : Prescription
        The lens. Without its designer's image plane, the paraxial one of the object is taken.
    pupil : float
        Diameter in millimetres of the entrance pupil; 0: the designer's. The stop opens to where the ray from the axis
        at the edge of this pupil crosses it.
    fields : sequence of float
        Angles in degrees. Default: the designer's, or else 0; of one or two, 0, 0.7 and 1 times the largest.

    Returns
    -------
    tuple
        The camera without an array, its detector's corner at the largest height; the distance from the front principal
        plane, and the heights of chief rays on the image plane, both in millimetres.

    Raises
    ------
    InputError
        If there is no image behind the lens.
    """
    numbers = paraxial(lens)
    from_pupil = lens.object_distance + numbers.entrance_pupil
    opening = numbers.entrance_radius
    if pupil := pupil or lens.pupil_diameter:
        slope = pupil / 2 / from_pupil
        start = 0.0, pupil / 2 - numbers.entrance_pupil * slope, 0.0
        N = 1 / math.hypot(1, slope)
        before = [sequential.widened(surface, math.inf) for surface in sequential.elements(lens, lens.wavelength)]
        (_, edge, _), *_ = sequential.follow(before[: lens.stop + 1], start, (0.0, slope * N, N))
        # A stop that the file makes smaller than its pupil needs gives way.
        surfaces = list(lens.surfaces)
        full = max(surfaces[lens.stop].semi_aperture, abs(edge))
        opening *= abs(edge) / surfaces[lens.stop].semi_aperture
        surfaces[lens.stop] = replace(surfaces[lens.stop], semi_aperture=full)
        lens = replace(lens, surfaces=tuple(surfaces))
    angles = fields or lens.fields or (0.0,)
    angles = tuple(sorted({fraction * max(angles) for fraction in (0.0, 0.7, 1.0)} if len(angles) < 3 else angles))
    distance = lens.object_distance + numbers.front_principal
    array = lens.image_distance - numbers.rear_principal
    if not lens.image_distance:
        array = conjugate_distance(numbers.focal_length, distance)
    refuse_if(
        not max(-numbers.rear_principal, numbers.exit_pupil - numbers.rear_principal) < array < math.inf,
        f"image plane {array + numbers.rear_principal:.4g} mm behind the last vertex: no detector can stand there, "
        "as it must be finite, behind the lens and its exit pupil",
    )
    camera = PlenopticCamera(
        main_lens=lens, aperture_radius=opening, mla_distance=array, mla_lattice="none", detector_width=array
    )
    scale = 1.0 if math.isinf(distance) else from_pupil / distance
    heights = {}
    for angle in angles:
        slope = scale * math.tan(math.radians(angle))
        height = array * slope
        step = 1.0
        for _ in range(30 if slope else 0):
            step = -slope / chief(camera, None, height, distance)[0]
            height *= step
        refuse_if(
            not abs(step - 1) < 1e-6, f"field of {angle:g} degrees: no chief ray of it was found in the image plane"
        )
        heights[angle] = height
    width = max(math.sqrt(2) * height, 1e-3 * array)
    return camera.replace(detector_width=width), distance, heights


def transfer(
    camera: PlenopticCamera, height: float, distance: float, frequencies: tuple[int, ...] = FREQUENCIES
) -> Doubles:
    """Return the modulation transfer function of a real main lens for one point, at the prescription's wavelength.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a real main lens; the image is taken where its detector or array stands.
    height : float
        Distance from the axis, in millimetres, of the point's chief ray on the image.
    distance : float
        Distance of the object plane in millimetres; may be infinite.
    frequencies : tuple of int
        Cycles per millimetre of the image.

    Returns
    -------
    float64 array (2, n)
        Contrast of lines across (tangential) and along (sagittal) the direction to the axis.
    """
    g = min(distance, FAR)
    point = np.array([0.0, g * chief(camera, None, height, distance)[0], g])
    lens = main_lens(camera)
    light = lens.waves_of_one(point)
    wavelength = in_millimetres(lens.light)
    reach = light.pupil.distance
    slopes = (light.bundle[0] - [0.0, height]) / reach
    cosines = slopes / np.sqrt(1 + (slopes**2).sum(1, keepdims=True))
    # Rays of the fit are sparse, and the pupil may reach a little beyond them.
    low = cosines.min(0) - 0.05 * np.ptp(cosines, 0)
    high = cosines.max(0) + 0.05 * np.ptp(cosines, 0)
    # All frequencies are shifts by whole samples, so that only differences of the path need to be sampled finely.
    step = wavelength * math.gcd(*frequencies)
    divided = math.ceil(200 * step / float(min(high - low)))
    alpha, beta = np.meshgrid(*(np.arange(start, end, step / divided) for start, end in zip(low, high, strict=True)))
    away = reach / np.sqrt(1 - alpha**2 - beta**2)
    pupil = alpha * away, height + beta * away
    path = (light.length(pupil) + away - math.hypot(reach, height)) / wavelength
    field = light.amplitude(pupil, point) * away**2 * light.is_open(pupil) * np.exp(2j * math.pi * path)
    contrasts = []
    for turned in (field, field.T):
        shifts = [frequency // math.gcd(*frequencies) * divided for frequency in frequencies]
        contrasts.append([abs(np.vdot(turned[:-shift], turned[shift:])) for shift in shifts])
    return np.array(contrasts) / np.vdot(field, field).real
