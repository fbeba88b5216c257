r"""Patterns that one microlens makes on the detector of the light of one scene point, with its neighbours.

A lens takes of the detector's intensity what its own light :math:`u_l` and all light u have in common,
:math:`\mathrm{Re}(u_l^* u)`: over all lenses this adds up to :math:`|u|^2`, and the light that joins across the border
of two lenses is in it. Both fields are taken from the array to the detector by one Fourier transform about the place
where the ray through the lens's centre meets it, with the path :math:`\sqrt{z^2 + \mu^2}` from each place of the lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...optics.main_lens import main_lens
from ...optics.microlenses import transmission, upright
from ...optics.phase import in_millimetres, phasor
from ...optics.sampling import fast_length
from ...runtime.backend import array_module, backend
from ...runtime.fft import as_field, fft2, pack, unpack
from ...runtime.indexing import split
from .radial import RadialFields, axial_ray

_COHERENCE = 7
"""Widths :math:`\\lambda b / D_1` beyond the lens's cell in which the light of other lenses is faded out."""

_WINDOW = 1.45
"""Width of the window on the array over the farthest distance of two places whose light is taken together."""

_FINE = 8
"""Samples of hard edges in each sample of the window, along an axis."""


@dataclass(frozen=True)
class Nodes:
    """Lenses and the light on them, one each: arrays of shape (n,).

    Attributes
    ----------
    field : int array
        Number of the field of `RadialFields`.
    distance : float64 array
        Distance of its scene point.
    radius : float64 array
        Radius on the pupil of the ray through the lens's centre, in millimetres; beyond the rim, too.
    angle : float64 array
        Angle of that pupil point in the frame of the lattice.
    """

    field: NDArray[np.int64]
    distance: NDArray[np.float64]
    radius: NDArray[np.float64]
    angle: NDArray[np.float64]

    def take(self, which: Any) -> Nodes:
        """Return some of them."""
        return Nodes(self.field[which], self.distance[which], self.radius[which], self.angle[which])


class LensPatterns:
    """Patterns of one type of lenses, in the frame of the lattice.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    width : float
        Width of the patterns on the detector, in millimetres; what goes farther is left out.
    lens_type : int
        Which of the types of lenses of a multi-focus array.

    Attributes
    ----------
    samples : int
        Samples across a pattern.
    pitch : float
        Their distance on the detector, in millimetres. Sample `samples` // 2 lies where the ray arrives.
    window : complex64 array (2, samples, samples)
        What the array, faded out, and what the lens alone do to the light about the lens's centre.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float, width: float, lens_type: int = 0) -> None:
        self._camera, self._wavelength = upright(camera).replace(mla_offset=(0.0, 0.0)), wavelength
        coherence = in_millimetres(wavelength) * camera.mla_distance / camera.aperture_diameter
        cell = camera.lattice.cell_reach
        self._fade = cell, cell + _COHERENCE * coherence
        self._step = in_millimetres(wavelength) * camera.detector_distance / width
        self.samples = fast_length(_WINDOW * sum(self._fade) / self._step, 2)
        self.pitch = width / self.samples
        self.window = self._transmission(lens_type)
        self._power = self._step**2 / self.samples**2 / float(camera.lattice.lens_area)

    def _transmission(self, lens_type: int) -> NDArray[np.complex64]:
        """Return the `window`, without what it scatters beyond the patterns' width."""
        camera, n = self._camera, self.samples
        types, lattice = array_module(), camera.lattice
        fine, count = self._step / _FINE, n * _FINE
        _, row, column = split(types, dr.arange(types.UInt32, count * count), count, count)
        x, y = ((types.Float64(index) - (count // 2 - 0.5)) * fine for index in (column, row))
        square = x * x + y * y
        z = camera.detector_distance
        low, high = self._fade
        fade = dr.clip((high - dr.sqrt(square)) / (high - low), 0, 1)
        path = square / (dr.sqrt(square + z * z) + z) / in_millimetres(self._wavelength)
        own = (float(lens_type), 0.0)
        cx, cy = lattice.centre(*own)
        everything = transmission(camera, self._wavelength, x + cx, y + cy) * phasor(path)
        i, j = lattice.cell(x + cx, y + cy)
        alone = dr.select((i == own[0]) & (j == own[1]), everything, 0)
        faded = everything * types.Float(fade * fade * (3 - 2 * fade))
        order = np.fft.fftfreq(n, 1 / n).astype(np.int64)
        # the fine samples lie half of one beside those of the window
        beside = np.exp(-1j * math.pi * order / count) / _FINE
        result = np.empty((2, n, n), np.complex64)
        for target, field in zip(result, (faded, alone), strict=True):
            spectrum = fft2(backend().to_host(as_field(pack(field), (count, count))))[np.ix_(order, order)]
            target[...] = fft2((spectrum * beside * beside[:, None]).astype(np.complex64), inverse=True)
        # what edges scatter beyond the width is given back
        area = float(np.vdot(result[1], result[0]).real) * self._step**2
        result *= math.sqrt(float(lattice.lens_area) / area)
        sign = 1 - 2 * (np.arange(n) % 2)
        return result * (sign * sign[:, None])

    @property
    def arrival(self) -> float:
        r"""Distance behind the array at which straight rays meet the spots, in millimetres.

        In oblique light of slope s, the path from a place :math:`\mu` of the lens to the detector has the coma
        :math:`\mu^2 (\mu \cdot s) / 2 z^2`, which the patterns leave out. Its tilt moves the spot outwards by
        :math:`s \langle\mu^4\rangle / 2 z \langle\mu^2\rangle`, means over the lens.
        """
        place = (np.arange(self.samples) - self.samples // 2) * self._step
        square, z = place**2 + place[:, None] ** 2, self._camera.detector_distance
        power = np.abs(self.window[1].astype(np.complex128)) ** 2
        return float(z + (power * square**2).sum() / (power * square).sum() / (2 * z))

    def compute(self, fields: RadialFields, nodes: Nodes) -> NDArray[np.float32]:
        """Compute the patterns of some nodes.

        Returns
        -------
        float32 array (n, samples, samples)
            Parts of the power of a lens that is lit as by rays: their sum over the plane is 1 away from the rim.
        """
        u = self._light(fields, nodes)
        together = fft2(u * self.window[0])
        together *= fft2(u * self.window[1]).conj()
        return together.real * np.float32(self._power)

    def _light(self, fields: RadialFields, nodes: Nodes) -> NDArray[np.complex64]:
        """Return the field on the array about each lens without the tilt of its ray, (n, samples, samples)."""
        types, n, lam = array_module(), self.samples, in_millimetres(self._wavelength)
        lens = main_lens(self._camera)
        place, modulus = axial_ray(lens, nodes.radius, nodes.distance)
        slope = (place - nodes.radius) / lens.pupil_distance
        cosine = slope / np.sqrt(1 + slope * slope)
        curvature = fields.curvature[nodes.field]
        size = fields.samples.shape[1]
        pattern, row, column = split(types, dr.arange(types.UInt32, len(place) * n * n), n, n)

        def value(numbers: NDArray[Any], kind: Any = types.Float64) -> Any:
            return dr.gather(kind, kind(np.ascontiguousarray(numbers)), pattern)

        x, y = ((types.Float64(index) - n // 2) * self._step for index in (column, row))
        towards = x * value(np.cos(nodes.angle)) + y * value(np.sin(nodes.angle))
        m = value(place)
        square = x * x + y * y + 2 * m * towards
        r = dr.sqrt(m * m + square)
        waves = square * value(curvature / (2 * lam)) - towards * value(cosine / lam)
        at = dr.minimum(types.Float(r * (1 / fields.step)), size - 1.001)
        index = types.UInt32(at)
        part = at - types.Float(index)
        words = types.UInt64(fields.samples.astype(np.complex64).reshape(-1).view(np.uint64))
        first = value(nodes.field.astype(np.uint32), types.UInt32) * size + index
        low, high = (unpack(dr.gather(types.UInt64, words, first + step)) for step in (0, 1))
        field = (low + (high - low) * part) * phasor(waves) * types.Float(value(1 / modulus))
        return np.asarray(as_field(pack(field), (len(place), n, n)))
