"""Thin elements along one axis: what they multiply a field by."""

from __future__ import annotations

import math

import numpy as np

from .. import lattice, rays
from ..camera import PlenopticCamera
from ..propagation.sampling import in_millimetres


def lens_phase(offset: np.ndarray, focal_length: float, wavelength: float) -> np.ndarray:
    r"""Transmission of a thin parabolic lens, :math:`\exp(-i \pi x^2 / \lambda f)`.

    Parameters
    ----------
    offset : float64 array
        Distance from the lens's centre along one axis, in millimetres.
    focal_length : float
        In millimetres; negative for a diverging lens.
    wavelength : float
        In nanometres.

    Returns
    -------
    complex64 array
        Times that of the other axis, it is the lens's transmission.
    """
    turns = offset**2 / (2 * in_millimetres(wavelength) * focal_length)
    return np.exp(-2j * math.pi * turns).astype(np.complex64)


def detector_lens(p: np.ndarray, camera: PlenopticCamera) -> np.ndarray:
    """Index of the lens that each detector coordinate belongs to: the one of the chief ray. float64."""
    return lattice.cell_index(rays.chief_point(p, camera.mla_distance, camera.detector_distance), camera.mla_pitch)


def converging_phase(p: np.ndarray, index: np.ndarray, camera: PlenopticCamera, wavelength: float) -> np.ndarray:
    """Phase with which light at detector coordinates converges to the centres of their lenses; complex64."""
    c = lattice.cell_centre(index, camera.mla_pitch)
    return lens_phase(p - c, camera.detector_distance, wavelength)
