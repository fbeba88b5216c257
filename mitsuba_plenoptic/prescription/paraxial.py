"""Focal length, principal planes and pupils of a lens, by matrices of rays near the axis.

Heights and reduced angles n u pass a surface of power P by (y, n u - P y), and a thickness t of index n by
(y + t/n n u, n u) (Born and Wolf, "Principles of Optics", section 4.4; Kingslake and Johnson, "Lens Design
Fundamentals", chapter 3).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from ..errors import InputError, refuse_if
from .surfaces import Prescription


@dataclass(frozen=True)
class Paraxial:
    """Numbers of paraxial optics, in millimetres; positions are counted along the axis towards the array.

    Parameters
    ----------
    focal_length : float
        Effective focal length.
    front_principal, entrance_pupil : float
        Places of the front principal plane and of the entrance pupil behind the first vertex.
    rear_principal, exit_pupil : float
        Places of the rear principal plane and of the exit pupil behind the last vertex.
    back_focal : float
        Place of the rear focal point behind the last vertex.
    length : float
        Distance of the last vertex from the first.
    entrance_radius, exit_radius : float
        Radii of the pupils with the stop fully open.
    """

    focal_length: float
    front_principal: float
    rear_principal: float
    back_focal: float
    length: float
    entrance_pupil: float
    exit_pupil: float
    entrance_radius: float
    exit_radius: float


# Checks, pupils and distances of cameras of one prescription ask for it again and again; a result is a few floats.
@functools.lru_cache(maxsize=256)
def paraxial(prescription: Prescription, wavelength: float | None = None) -> Paraxial:
    """Return the paraxial quantities of a lens.

    Parameters
    ----------
    prescription : Prescription
        The lens.
    wavelength : float, optional
        Wavelength in nanometres. Default: the prescription's own.

    Raises
    ------
    InputError
        If the lens does not converge, or a pupil is at infinity.
    """
    indices = [1.0, *prescription.indices(prescription.wavelength if wavelength is None else wavelength)]
    whole, before, after = np.eye(2), np.eye(2), np.eye(2)
    length = 0.0
    for index, surface in enumerate(prescription.surfaces):
        if index == prescription.stop:
            before, after = whole, np.eye(2)
        power = (indices[index + 1] - indices[index]) * surface.curvature
        gap = surface.thickness / indices[index + 1] if index < len(prescription.surfaces) - 1 else 0.0
        length += surface.thickness if gap else 0.0
        step = np.array([[1, gap], [0, 1]]) @ np.array([[1, 0], [-power, 1]])
        whole, after = step @ whole, step @ after
    (A, _), (C, D) = whole
    if not -C > 1e-12:
        text = "infinite" if abs(C) <= 1e-12 else f"{-1 / C:.4g} mm"
        raise InputError(f"main_lens: its focal length is {text}: it must be positive, so that it forms an image")
    refuse_if(
        min(abs(before[0, 0]), abs(after[1, 1])) < 1e-9,
        "main_lens: one of its pupils is at infinity: object- or image-side telecentric lenses are not supported",
    )
    radius = prescription.surfaces[prescription.stop].semi_aperture
    values = (
        -1 / C,
        (D - 1) / C,
        (1 - A) / C,
        -A / C,
        length,
        before[0, 1] / before[0, 0],
        -after[0, 1] / after[1, 1],
        radius / abs(before[0, 0]),
        radius / abs(after[1, 1]),
    )
    refuse_if(not all(map(math.isfinite, values)), "main_lens: its numbers leave what a float holds")
    return Paraxial(*map(float, values))
