r"""The microlens lattice as a thin phase element, cut off at a highest direction.

Along one axis the lattice is periodic, so it splits a plane wave into orders, :math:`\lambda / D_2` apart in
direction cosine:

.. math:: t(x) = \sum_q c_q \, e^{2 \pi i q x / D_2}, \qquad
          c_q = \frac{1}{D_2} \int_\mathrm{cell} e^{-i \pi (x - c)^2 / \lambda f_2} \, e^{-2 \pi i q x / D_2} dx,

a Fresnel integral (Goodman, "Introduction to Fourier Optics", section 4.2.2, for the integrals). Samples of t
itself would fold its steep orders, which come from the edges of the cells, back into the band of a grid; the sum
over the orders that the grid holds does not.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from .sampling import in_millimetres

_TABLE_LENGTH = 2**14


def orders(camera: PlenopticCamera, wavelength: float, count: int) -> NDArray[np.complex128]:
    """Amplitudes of the orders -count ... count along one axis; a corner of four cells lies at x = 0.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    count : int
        Highest order.

    Returns
    -------
    complex128 array (2 count + 1,)
    """
    pitch = camera.mla_pitch
    area = in_millimetres(wavelength) * camera.mla_focal_length
    q = np.arange(-count, count + 1)
    shift = area * q / pitch
    scale = math.sqrt(2 / area)
    sines, cosines = scipy.special.fresnel(np.stack([shift - pitch / 2, shift + pitch / 2]) * scale)
    integral = (cosines[1] - cosines[0]) - 1j * (sines[1] - sines[0])
    centred = integral / (scale * pitch) * np.exp(1j * math.pi * area * (q / pitch) ** 2)
    return centred * np.where(q % 2, -1, 1)


def transmission_table(camera: PlenopticCamera, wavelength: float, cosine: float) -> NDArray[np.complex64]:
    """One period of the transmission along one axis, of the orders up to a direction cosine.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    cosine : float
        Largest direction cosine, relative to that of the incident light, that is kept.

    Returns
    -------
    complex64 array (length + 1,)
        Samples from x = 0 to x = pitch, both included; `length` is a power of two.
    """
    count = int(cosine * camera.mla_pitch / in_millimetres(wavelength))
    length = max(_TABLE_LENGTH, 2 ** math.ceil(math.log2(64 * max(count, 1))))
    spectrum = np.zeros(length, np.complex128)
    spectrum[np.arange(-count, count + 1)] = orders(camera, wavelength, count)
    period = np.fft.ifft(spectrum) * length
    return np.append(period, period[0]).astype(np.complex64)


def transmission(
    camera: PlenopticCamera, table: NDArray[np.complex64], x: NDArray[np.floating[Any]]
) -> NDArray[np.complex64]:
    """Transmission along one axis at any places, interpolated from `transmission_table`."""
    places = x / camera.mla_pitch
    places = (places - np.floor(places)) * (len(table) - 1)
    index = np.minimum(places.astype(int), len(table) - 2)
    part = (places - index).astype(np.float32)
    return table[index] * (1 - part) + table[index + 1] * part
