"""The bank of kernels of one type of lenses, and how much of each kernel a ray brings."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...optics.phase import in_millimetres
from ...runtime.blas import single_threaded_blas
from ...runtime.fft import resting_drjit
from ..pixels import PixelIntegrals
from ..turned_samples import TurnedSamples
from .blend import blur_limits
from .learning import Learner
from .patterns import LensPatterns
from .table import Coordinates, Table

_CORE, _SPOTS = 20, 60
"""Widths of the kernels' core, by which coefficients are found, and of all of them, beyond a lens's geometric spot.

In units of :math:`\\lambda z / D_2`, a lens's diffraction.
"""

_PIXELS_PER_SPOT = 1.25
"""Samples across the spot of a lens at least."""

_LEFT = 0.3
"""Error of the patterns that are learnt from over the allowed error of sums over many points."""


@dataclass(frozen=True, eq=False)
class LensBank:
    """Kernels of one type of lenses at one wavelength, and the table of their coefficients.

    Attributes
    ----------
    kernels : float32 array (rank, k, k)
        Fractions of a lens's power on each sample; the ray through the lens's centre arrives in the middle one.
    pitch : float
        Distance of the samples, in millimetres: a pixel, or a whole part of one.
    arrival : float
        Distance behind the array at which the ray meets that middle one, in millimetres; see `LensPatterns.arrival`.
    table : Table
        The coefficients.
    origin : tuple
        What it is made of.
    """

    kernels: NDArray[np.float32]
    pitch: float
    arrival: float
    table: Table
    origin: tuple[Any, ...]

    def __reduce__(self) -> tuple[Any, ...]:
        """Make it anew in another process, once, rather than send it with every batch."""
        return _learn, self.origin

    @property
    def rank(self) -> int:
        """Number of kernels."""
        return len(self.kernels)

    @property
    def widest(self) -> float:
        """Distance from the axis, in the pupil, beyond which there is no light of any point, in millimetres."""
        return self.table.coordinates.widest

    @classmethod
    def learn(
        cls,
        camera: PlenopticCamera,
        wavelength: float,
        accuracy: float,
        vergences: tuple[float, float],
        lens_type: int = 0,
        pitch: float | None = None,
        blank: bool = False,
    ) -> LensBank:
        """Make the bank of a camera, or return it if it is among the last few that were made.

        Parameters
        ----------
        camera : PlenopticCamera
            The camera; only its optics and the size of its pixels matter.
        wavelength : float
            Wavelength in nanometres.
        accuracy : float
            Allowed relative error of a sum over many points.
        vergences : (float, float)
            Least and greatest vergence 1 / b' of the images of points, in 1/mm.
        lens_type : int
            Which of the types of lenses of a multi-focus array.
        pitch : float, optional
            Distance of the kernels' samples, a whole part of a pixel; banks that are used together must share it.
            Default: `finest_pitch` at this wavelength.
        blank : bool
            Whether to leave kernels and coefficients zero, which is quicker: enough to tell what a capture takes.
        """
        optics = camera.replace(
            detector_width=camera.pixel_size,
            resolution=(1, 1),
            crop_offset=(0, 0),
            crop_size=(1, 1),
            mla_offset=(0.0, 0.0),
            lens_model="ideal",
        )
        pitch = pitch or finest_pitch(camera, (wavelength,))
        return _learn(optics, wavelength, accuracy, vergences, lens_type, pitch, blank)

    def coefficients(self, Px: Any, Py: Any, vergence: Any, active: Any = True) -> list[Any]:
        """Return how much of each kernel a point's light brings through a lens.

        Parameters
        ----------
        Px, Py : Float arrays of Dr.Jit
            Where the ray from the point to the lens's centre passes the pupil, in the camera's frame; beyond its rim,
            too.
        vergence : Float array of Dr.Jit
            Vergence of the point's image, in 1/mm.
        active : bool or Bool array of Dr.Jit
            Whether they are wanted; where not, they are zero.

        Returns
        -------
        list of Float arrays
            Of a full lens's power as rays bring it; zero where the rim is too far.
        """
        return self.table.at(Px, Py, vergence, active)

    def reach(self, vergence: Any) -> Any:
        """Return how far beyond the pupil's rim, in millimetres, pupil points still have light."""
        return self.table.coordinates.reach(vergence)


# Products of matrices round otherwise on another number of threads, and captures must not depend on who makes them.
@functools.lru_cache(maxsize=8)
@single_threaded_blas()
def _learn(
    camera: PlenopticCamera,
    wavelength: float,
    accuracy: float,
    vergences: tuple[float, float],
    lens_type: int,
    pitch: float,
    blank: bool,
) -> LensBank:
    origin = camera, wavelength, accuracy, vergences, lens_type, pitch, blank
    diffraction, defocused = _spot(camera, wavelength, lens_type)
    coordinates = Coordinates.between(camera, wavelength, vergences, blur_limits(accuracy)[0])
    core = LensPatterns(camera, wavelength, _CORE * diffraction + 2 * defocused, lens_type)
    width = _SPOTS * diffraction + 2 * defocused
    fields, distance = coordinates.fields()
    learner = Learner(core, fields, coordinates.nodes(distance), coordinates.shape)
    with resting_drjit():
        cores, mixing = learner.kernels(_LEFT * accuracy)
        if blank:
            across = 2 * _half(width, pitch) + 1
            kernels = np.zeros((len(cores), across, across), np.float32)
            table = Table.blank(coordinates, len(cores))
        else:
            wide = LensPatterns(camera, wavelength, width, lens_type)
            kernels = _on_grid(learner.wider(mixing, wide), wide.pitch, pitch, camera.mla_rotation)
            table = Table.finer(coordinates, learner.coefficients(cores))
    return LensBank(kernels, pitch, core.arrival, table, origin)


def finest_pitch(camera: PlenopticCamera, wavelengths: tuple[float, ...]) -> float:
    """Return the distance of samples, a whole part of a pixel, that holds the spots of all lenses and wavelengths."""
    types = range(len(camera.mla_focal_lengths))
    spot = min(math.hypot(*_spot(camera, wavelength, type_)) for wavelength in wavelengths for type_ in types)
    return camera.pixel_size / math.ceil(camera.pixel_size * _PIXELS_PER_SPOT / spot)


def _spot(camera: PlenopticCamera, wavelength: float, lens_type: int) -> tuple[float, float]:
    """Return the widths of a lens's spot on the detector by diffraction, and by the detector's defocus."""
    lattice, z = camera.lattice, camera.detector_distance
    diffraction = in_millimetres(wavelength) * z / min(lattice.aperture_widths)
    return diffraction, float(lattice.aperture_width) * abs(1 - z / camera.mla_focal_lengths[lens_type])


def _on_grid(kernels: NDArray[np.float32], fine: float, pitch: float, rotation: float) -> NDArray[np.float32]:
    """Turn kernels from the frame of the lattice to the camera's, and integrate them over squares of another grid."""
    n = kernels.shape[-1]
    origin = -(n // 2) * fine
    turned = TurnedSamples((n, n), (fine, fine), (origin, origin), rotation, fine, (origin, origin), (n, n))
    half = _half(n * fine, pitch)
    edge = -(half + 0.5) * pitch
    integrals = PixelIntegrals((n, n), (fine, fine), (origin, origin), pitch, (edge, edge), (2 * half + 1,) * 2)
    result = np.empty((len(kernels), 2 * half + 1, 2 * half + 1), np.float32)
    for target, kernel in zip(result, kernels, strict=True):
        upright = turned.forward(kernel) if rotation else kernel
        target[...] = integrals.forward(upright / np.float32(fine**2))
    return result


def _half(width: float, pitch: float) -> int:
    """Return the samples on either side of the middle one that lie within a width."""
    return math.floor(width / (2 * pitch) - 0.5)
