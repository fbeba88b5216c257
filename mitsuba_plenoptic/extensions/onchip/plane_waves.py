r"""Responses of photodiodes under lenses of a few wavelengths to pairs of directions, and to rays.

Let :math:`U_s(p)` be the field at the detector of a plane wave with the transverse direction cosines s. It passes the
lenses, which are periodic, and then a medium of index n by its orders without the paraxial approximation:

.. math:: U_s(p) = e^{i k s \cdot p} \sum_m c_m e^{2 \pi i m \cdot p / D_2 + i z k_z(s, m)}, \qquad
          k_z^2 = n^2 k^2 - |k s + 2 \pi m / D_2|^2 .

A photodiode j responds to pairs of directions by :math:`R_j(s, s') = \int_j U_s U_{s'}^* d^2p`. Before the pupil,
incoherent light has the radiance L(s, x) along rays, so that the photodiode records

.. math:: \int\!\!\int L(s, x)\, W_j(s, x)\, d^2s\, d^2x, \qquad W_j(s, x) = \frac{1}{\lambda^2} \int
          O_s(\sigma)\, R_j(s + \sigma/2, s - \sigma/2)\, e^{-i k \sigma \cdot x}\, d^2\sigma,

where :math:`O_s` is 1 if the pupil passes both directions, otherwise 0. The function W is real and signed, and its
integral over x is :math:`R_j(s, s)`. This module computes :math:`U_s`; `response_tables` tabulates W.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera, Use, require_support
from ...errors import refuse_if
from ...fields import OpticalSystem
from ...optics import in_millimetres
from ...rays import Walk
from ...runtime import Doubles, Flags, Integers, Shape, drjit_array, single_threaded_blas

NEAR = 5
"""Lenses across the window of the near table."""

_STEPS = (14.0, 20.0)
"""Least steps of direction cosines from the middle to the edge of the pupil, at usual and fine accuracy."""

_POINTS = 16
"""Gauss-Legendre nodes of a photodiode along each axis."""


def pixels_per_lens(camera: PlenopticCamera) -> int:
    """Return the number of pixels across a lens; refuse cameras that photodiode responses do not describe."""
    require_support(camera, Use.SMALL_LENSES)
    refuse_if(
        any(size % 2 for size in camera.resolution),
        f"resolution = {camera.resolution}: for waves behind lenses of a few wavelengths it must be even",
    )
    count = round(camera.row_pitch / camera.pixel_size)
    farthest = 0.0
    for axis in (0, 1):
        # The pixels of the first and of the last lens, from the lens's regular position.
        index = np.array(lens_range(camera, count, axis)) - [0, 1]
        aside = (index + 0.5) * (max(count, 1) * camera.pixel_size - camera.row_pitch) - camera.mla_offset[axis]
        farthest = max(farthest, float(np.abs(aside).max()))
    refuse_if(
        count < 1 or farthest > camera.row_pitch / 2,
        f"mla_pitch = {camera.row_pitch:g}: lenses of {camera.row_pitch / camera.pixel_size:.4g} pixels shift by "
        f"{farthest:.3g} mm from their pixels; for waves behind lenses of a few wavelengths a lens must stay within "
        "half a pitch of its own pixels",
    )
    return count


def lens_range(camera: PlenopticCamera, count: int, axis: int) -> Shape:
    """Return the range of lattice indices of the lenses with recorded pixels along an axis: first, and last plus 1."""
    first = camera.crop_offset[axis] - camera.resolution[axis] // 2
    return first // count, -(-(first + camera.shape[1 - axis]) // count)


def displacement(camera: PlenopticCamera, count: int, x: Any, y: Any) -> list:
    """Return the positions of the centres of lenses' pixels relative to the lenses' centres, by lattice indices."""
    width = count * camera.pixel_size
    return [(index + 0.5) * width - c for index, c in zip((x, y), camera.lattice.centre(x, y), strict=True)]


@dataclass(frozen=True)
class Zones:
    """Detector positions at which responses are tabulated: an even grid over the recorded lenses."""

    # Lattice indices of the lenses at the zones, along x and y.
    x: Doubles
    y: Doubles

    @classmethod
    def of(cls, camera: PlenopticCamera, count: int) -> Zones:
        """Return the zones of a camera with `count` pixels across a lens."""
        axes = []
        ranges = [lens_range(camera, count, axis) for axis in (0, 1)]
        # 9: Lenses along each axis whose positions over their pixels are compared.
        aside = displacement(camera, count, *np.meshgrid(*(np.linspace(first, last - 1, 9) for first, last in ranges)))
        for axis, (first, last) in enumerate(ranges):
            moved = np.ptp(aside[axis]) * camera.mla_medium / camera.detector_distance
            turned = (last - 1 - first) * camera.row_pitch / camera.pupil_distance
            # 0.03: Largest difference of direction cosines between zones.
            steps = math.ceil(max(moved, turned) / 0.03 - 0.2)
            middle = (first + last - 1) / 2
            axes.append(np.linspace(first, last - 1, steps + 1) if steps > 0 else np.array([middle]))
        return cls(*axes)

    def __len__(self) -> int:
        return len(self.x) * len(self.y)


class PlaneWaveResponses:
    """Responses of the photodiodes under one lens, one per pixel, to plane waves of one wavelength in nanometres."""

    lands_by_point = False

    def __init__(self, camera: PlenopticCamera, wavelength: float, *, fine: bool = False):
        """Plan tables of direction cosines, whose steps are smaller if `fine`."""
        self.camera = camera
        self.wavelength = wavelength
        # Count of pixels across a lens, and zones of the detector, with a response table at each corner.
        self.count = pixels_per_lens(camera)
        self.zones = Zones.of(camera, self.count)
        self.system = OpticalSystem(camera, wavelength)
        # Largest difference of direction cosines between light through the pupil and through the pupil's centre.
        radius = float(self.system.lens.reach)
        self.reach = radius / math.hypot(camera.pupil_distance, radius)
        # Width on the array, in lenses, of the diffraction by the pupil: lambda N / D2.
        self.width = in_millimetres(wavelength) / (2 * self.reach * camera.row_pitch)
        # Steps of the table between the direction cosines of neighbouring pairs in the near table, and one step.
        self.stride = max(1, round(_STEPS[fine] * self.width / NEAR))
        self.step = in_millimetres(wavelength) / (2 * NEAR * self.stride * camera.row_pitch)
        # Count of nodes of the table from its middle to its edge, along one direction cosine.
        self.across = math.ceil(self.reach / self.step) + 1

    @cached_property
    def _orders(self) -> tuple[Integers, NDArray[np.complex128]]:
        """Diffraction orders of the lenses along an axis, and their amplitudes (orders along y, orders along x)."""
        camera = self.camera
        most = math.ceil(camera.mla_medium * camera.row_pitch / in_millimetres(self.wavelength)) + 2
        order = np.arange(-most, most + 1)
        samples = 1024  # of a lens along an axis
        x = ((np.arange(samples) + 0.5) / samples - 0.5) * camera.row_pitch
        waves = np.exp(-2j * math.pi * np.outer(order, x) / camera.row_pitch)
        waves *= (np.abs(x) <= camera.mla_fill * camera.row_pitch / 2) / samples
        phase = camera.microlens.waves(x, x[:, None], self.wavelength)
        return order, waves @ np.exp(2j * math.pi * phase) @ waves.T

    def chief(self, x: float, y: float) -> list[float]:
        """Return the direction cosines, at a lens by its lattice indices, of the light from the pupil's centre."""
        pupil = self.system.lens.pupil
        slope = [-float(pupil.slope(0.0, float(c))) for c in self.camera.lattice.centre(x, y)]
        return [component / math.sqrt(1 + slope[0] ** 2 + slope[1] ** 2) for component in slope]

    def is_open(self, x: float, y: float, along: Doubles) -> Flags:
        """Return a mask of the pairs of direction cosines, relative to the chief ray, that pass the pupil to a lens."""
        chief = self.chief(x, y)
        centre = [float(c) for c in self.camera.lattice.centre(x, y)]
        sy, sx = np.meshgrid(chief[1] + along, chief[0] + along, indexing="ij")
        cosine = np.sqrt(np.maximum(1 - sx**2 - sy**2, 1e-6))
        lens = self.system.lens
        pupil = tuple(
            drjit_array(mi.Float, lens.pupil.point(c, -s / cosine)) for c, s in zip(centre, (sx, sy), strict=True)
        )
        inner = Walk.of(self.camera, lens).round_pupil(pupil, tuple(mi.Float(c) for c in centre))
        square = sum(coordinate.numpy().astype(float) ** 2 for coordinate in inner)
        return (square <= self.camera.pupil_radius**2).reshape(sx.shape)

    @single_threaded_blas()
    def modes(self, x: float, y: float, diode: int) -> NDArray[np.complex64]:
        """Return functions of the direction cosines, (modes, n, n), whose products add up to the response to pairs."""
        camera = self.camera
        k = 2 * math.pi / in_millimetres(self.wavelength)
        pixel = camera.pixel_size
        index = camera.mla_medium
        order, amplitude = self._orders
        # Of the complex wave number in the medium; its imaginary part, which absorbs, is small.
        square = (index * k) ** 2 + 1j * index * k * camera.mla_absorption
        far = self.across + 3
        # Index x, y of a lens give its pixels' displacement.
        shift = displacement(camera, self.count, x, y)
        nodes, weights = np.polynomial.legendre.leggauss(_POINTS)
        row, column = divmod(diode, self.count)
        py, px = (
            ((nodes + 1) / 2 + side - self.count / 2) * pixel + s for side, s in ((row, shift[1]), (column, shift[0]))
        )
        sx, sy = (chief + np.arange(-far, far + 1) * self.step for chief in self.chief(x, y))
        waves_x, waves_y = (np.exp(2j * math.pi * np.outer(order, p) / camera.row_pitch) for p in (px, py))
        kx, ky = (k * s[:, None] + 2 * math.pi * order / camera.row_pitch for s in (sx, sy))
        fields = np.empty((len(sy), len(sx), _POINTS**2), np.complex64)
        for row_order, ky_of_row in enumerate(ky):
            kz = np.sqrt(square - ky_of_row[:, None] ** 2 - kx[:, None, :] ** 2)
            along_x = (
                amplitude * np.exp(1j * camera.detector_distance * kz)
            ) @ waves_x  # (x, order along y, point along x)
            field = np.matmul(waves_y.T, along_x)
            field *= np.exp(1j * k * (sy[row_order] * py[None, :, None] + sx[:, None, None] * px))
            fields[row_order] = field.reshape(len(sx), -1)
        fields *= np.sqrt(np.outer(weights, weights).ravel() * pixel**2 / 4).astype(np.float32)
        flat = fields.reshape(-1, _POINTS**2)
        energy, vectors = np.linalg.eigh(flat.conj().T @ flat)
        # 1e-5: Energy of a mode, relative to the strongest one, below which it is left out.
        modes = flat @ vectors[:, energy > 1e-5 * energy[-1]]
        return np.ascontiguousarray(modes.T.reshape(-1, len(sy), len(sx)))
