r"""Digital adaptive optics: an object, and the wavefront of each zone of its field, from one capture.

A capture of zones z whose points have the weights :math:`w_z`, behind wavefronts of the Zernike terms :math:`a_z`, is

.. math:: I = \sum_z A(a_z) \, w_z .

Both are unknown (blind deconvolution). Steps of Richardson and Lucy's method, which change the weights and keep them
positive, alternate with steps of a fit, which change the terms (see `zone_search`).

A tilt of the wavefront is equivalent to a shift of the object, and defocus to another object distance: one capture
cannot separate them, so these terms are held fixed. Nor can it separate a wavefront from an object without structure,
or show details of the object that the camera does not resolve.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera, require_camera
from ...errors import InputError, refuse_if, require_accuracy, require_count, require_wavelength, suggest_keywords
from ...fields.optical_system import OpticalSystem
from ...points.units import brightness_at
from ..deconvolution.solver import PlaneEstimates, State, Values, richardson_lucy
from ..inverse.fitting import PixelNoise
from ..inverse.stored import StoredOperator
from .zone_search import COUNTS, Search, Zone, known_zones, require_fitted, terms_of

Array = NDArray[np.float64]

_FIT_STEPS = 4
"""Cameras that are tried at most for a zone in a turn."""

_LEAST_FALL = 0.99
"""Part of the misfit's excess over noise below which it must fall in a turn, or the turns end."""


@dataclass(frozen=True, eq=False)
class CorrectedObject:
    """An object and the wavefronts found together with it.

    Attributes
    ----------
    weights : list of float64 arrays (n,)
        Weights of the points of each zone, as for `fitting.View`.
    cameras : list of PlenopticCamera
        Camera of each zone, with its ``wavefront``.
    misfits : list of float
        Mean squared residual of a pixel over its variance, before each turn of the wavefronts and at the end; 1 is
        noise alone.
    explained : bool
        Whether the last misfit is as small as noise. Otherwise further turns did not help, or none were left.
    """

    weights: list[Array]
    cameras: list[PlenopticCamera]
    misfits: list[float]
    explained: bool


@suggest_keywords
def deconvolve_zones(
    cameras: Sequence[PlenopticCamera],
    image: Any,
    zones: Zone | Sequence[Zone],
    *,
    wavelength: float = 633.0,
    noise: PixelNoise = COUNTS,
    accuracy: float = 0.01,
    iterations: int = 200,
) -> CorrectedObject:
    """Return the weights of the points of zones with known wavefronts.

    Parameters
    ----------
    cameras : sequence of PlenopticCamera
        Camera of each zone, with its ``wavefront``.
    image : array (rows, columns)
        Capture.
    zones : Zone, or sequence of Zone
        Parts of the field, each with its points; their weights do not matter.
    wavelength : float
        Wavelength in nanometres.
    noise : PixelNoise
        Noise of the capture.
    accuracy : float
        As for `CaptureOperator`.
    iterations : int
        Most of Richardson's and Lucy's steps, which end where the residual is as small as noise.

    Returns
    -------
    CorrectedObject

    Raises
    ------
    InputError
        If an input has a wrong shape or value.
    """
    zones = known_zones(zones)
    refuse_if(
        not isinstance(cameras, Sequence) or len(cameras) != len(zones),
        f"cameras: give one for each zone, in a list; there are {len(zones)} zones",
    )
    search = Search(
        require_camera(cameras[0], "cameras"), image, require_wavelength(wavelength), _counted(noise),
        require_accuracy(accuracy),
    )  # fmt: skip
    for camera in cameras:
        refuse_if(
            require_camera(camera, "cameras").shape != search.image.shape,
            f"cameras: one of them records {camera.shape}, not the image's {search.image.shape}",
        )
    zone_sum = _ZoneSum(search, cameras, zones)
    found = zone_sum.improve(None, noise, require_count("iterations", iterations), accelerate=True)
    misfit = _misfit(search, zone_sum.forward(found.values))
    return CorrectedObject([np.asarray(part, np.float64) for part in found.values], [*cameras], [misfit], found.stopped)


@suggest_keywords
def digital_adaptive_optics(
    camera: PlenopticCamera,
    image: Any,
    zones: Zone | Sequence[Zone],
    *,
    modes: int = 15,
    held: int = 4,
    wavelength: float = 633.0,
    noise: PixelNoise = COUNTS,
    accuracy: float = 0.01,
    turns: int = 20,
    iterations: int = 10,
    progress: Callable[[int, int], None] | None = None,
) -> CorrectedObject:
    """Return an unknown object and the unknown wavefront of each zone of the field, both estimated from one capture.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a thin main lens; the search starts at its ``wavefront`` in all zones.
    image : array (rows, columns)
        Capture.
    zones : Zone, or sequence of Zone
        Parts of the field, each with the points where its object may have light. The object starts with the same light
        everywhere.
    modes : int
        Number of Zernike terms, up to 66.
    held : int
        Terms up to this one stay as they are in `camera`: the default is piston, tilts and defocus.
    wavelength : float
        Wavelength in nanometres.
    noise : PixelNoise
        Noise of the capture. Default: the noise of pixels that are counted electrons.
    accuracy : float
        As for `CaptureOperator`.
    turns : int
        Largest number of turns that improve the wavefronts. Turns end earlier where the residual is as small as noise,
        or its excess falls by less than a hundredth.
    iterations : int
        Richardson's and Lucy's steps in each turn.
    progress : callable, optional
        Called with the number of turns made and the largest possible number.

    Returns
    -------
    CorrectedObject

    Raises
    ------
    InputError
        If an input has a wrong shape or value.
    """
    require_fitted(camera)
    zones = known_zones(zones)
    count = require_count("modes", modes, minimum=2, maximum=66)
    first = require_count("held", held, minimum=1, maximum=count - 1) + 1
    turns, iterations = require_count("turns", turns), require_count("iterations", iterations)
    search = Search(camera, image, require_wavelength(wavelength), _counted(noise), require_accuracy(accuracy))
    names = [f"wavefront.{term}" for term in range(first, count + 1)]
    start = camera.replace(wavefront=tuple(terms_of(camera, max(count, len(camera.wavefront))).tolist()))
    cameras, misfits = [start] * len(zones), []
    state: State | None = None
    for turn in range(turns + 1):
        zone_sum = _ZoneSum(search, cameras, zones)
        found = zone_sum.improve(state, noise, iterations, accelerate=False)
        state = State(found.values, found.values)
        misfits.append(_misfit(search, zone_sum.forward(found.values)))
        weights = [np.asarray(part, np.float64) for part in found.values]
        explained = misfits[-1] <= 1
        stuck = turn > 0 and misfits[-1] - 1 > _LEAST_FALL * (misfits[-2] - 1)
        if explained or stuck or turn == turns:
            break
        known = [Zone(zone.points, own) for zone, own in zip(zones, weights, strict=True)]
        light = np.array([own.sum() for own in weights])
        expected = [search.expected(own, zone) for own, zone in zip(cameras, known, strict=True)]
        for which, zone in enumerate(known):
            fitted, _ = search.turn(cameras[which], zone, names, expected, light, which, None, steps=_FIT_STEPS)
            cameras = [fitted.camera if index == which else own for index, own in enumerate(cameras)]
            expected[which] = search.expected(fitted.camera, zone)
        if progress:
            progress(turn + 1, turns)
    return CorrectedObject(weights, cameras, misfits, explained)


class _ZoneSum:
    """The sum of the captures of all zones, a linear function of the weights of their points."""

    def __init__(self, search: Search, cameras: Sequence[PlenopticCamera], zones: Sequence[Zone]) -> None:
        self._search = search
        self._matrices: list[NDArray[np.float32]] = []
        for camera, zone in zip(cameras, zones, strict=True):
            stored = StoredOperator(
                camera, zone.points, wavelength=search.wavelength, accuracy=search.accuracy, dtype="float32"
            )
            system = OpticalSystem(stored.camera.at_wavelength(search.wavelength), search.wavelength)
            matrix = stored.to_dense() * brightness_at(system, zone.points).astype(np.float32)
            refuse_if(not matrix.any(), f"zones: the detector records no light of zone {len(self._matrices)}")
            self._matrices.append(matrix)

    def forward(self, values: Values) -> NDArray[np.float32]:
        """Return the image of given weights."""
        total = sum(matrix @ own for matrix, own in zip(self._matrices, values, strict=True))
        return np.asarray(total, np.float32).reshape(self._search.image.shape)

    def adjoint(self, image: NDArray[np.float32]) -> Values:
        """Return, for each point, the sum over pixels weighted by the point's light in each pixel."""
        return [matrix.T @ image.ravel() for matrix in self._matrices]

    def improve(self, state: State | None, noise: PixelNoise, iterations: int, *, accelerate: bool) -> PlaneEstimates:
        """Make some Richardson-Lucy steps, fewer if the residual falls to the noise."""
        image = np.asarray(self._search.image, np.float32)
        return richardson_lucy(
            self,
            image,
            iterations=iterations,
            accelerate=accelerate,
            misfit=lambda image, model: _misfit(self._search, model),
            shift=noise.dark_variance / noise.electrons,
            state=state,
        )


def _misfit(search: Search, model: NDArray[np.float32]) -> float:
    """Return the mean squared residual divided by the variance."""
    expected = np.asarray(model, np.float64)
    return float((((search.image - expected) / search.deviations(expected)) ** 2).mean())


def _counted(noise: Any) -> PixelNoise:
    if not isinstance(noise, PixelNoise):
        raise InputError(f"noise of type {type(noise).__name__}: it must be a PixelNoise")
    return noise
