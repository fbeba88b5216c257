"""Captures by waves of light of many wavelengths: one set of radiators, and point spreads at a few wavelengths."""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError, require_number
from ..optics.fitted_lens import lens_of_rays
from ..optics.lens_system import LensSystem
from ..optics.spectrum import Spectrum
from ..runtime.jobs import Job
from .estimate import estimate_waves
from .operator import CaptureOperator
from .patch_plan import Cost
from .pupil_weights import PupilWeights
from .radiators import Radiators, find_radiators, sample_pairs
from .wave_capture import WaveCapture

_NEIGHBOURS, _DISTANCES = 48, (0.05, 0.95)
"""Radiators of one neighbourhood, whose sum tells how many wavelengths are needed, and which neighbourhoods: those of
the radiators that have so many others nearer to the camera, of all. The point spreads of neighbours overlap, as in the
image, and what changes fast with the wavelength averages out."""

_PROBED = 3.0
"""Allowed error of the sums that are compared, of few points, over that of the image, of many."""

_COUNTS = (1, 2, 4, 6, 8, 10, 12, 16, 24, 32, 48, 64)
"""Nodes that are tried; more would resolve fringes that no detector does."""


def with_enough_nodes(
    camera: PlenopticCamera,
    points: Any,
    spectrum: Spectrum,
    error: float,
    pupil_weights: Any = None,
    *,
    together: bool = False,
) -> Spectrum:
    """Return a spectrum with as few nodes as its point spreads need.

    The count is raised in steps until images of each point, by every channel, change by no more than half of the
    error: the other half is for what is then still left.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    points : array (n, 3)
        Scene points as of `CaptureOperator`, a few that stand for all.
    spectrum : Spectrum
        The wavelengths, as many as light and responses need.
    error : float
        Relative error (L2) of each channel's image that is allowed.
    pupil_weights : optional
        As of `CaptureOperator`.
    together : bool
        Whether the sum of the points is to be so exact, in which what changes fast averages out where spreads overlap,
        or each by itself.

    Returns
    -------
    Spectrum
        The same, or with nodes.

    Raises
    ------
    InputError
        If an argument is out of range.
    """
    error = require_number("error", error, positive=True)
    weights = PupilWeights.of(pupil_weights, len(points))
    points, most = np.asarray(points, np.float64), len(set(spectrum.wavelengths))

    # Of single points nothing is left out; sums are probed as they are captured, and may themselves be in error.
    accuracy = _PROBED * error if together else 0.0

    def images(count: int, recorded: PlenopticCamera) -> list[NDArray[np.float32]]:
        chosen = spectrum.interpolated(count)
        sets = [np.arange(len(points))] if together else np.arange(len(points))[:, None]
        return [
            CaptureOperator(
                recorded,
                points[some],
                spectrum=chosen,
                accuracy=accuracy,
                pupil_weights=None if weights is None else weights.take(some),
                virtual=True,
            ).forward(np.ones((len(some), len(spectrum.wavelengths))))
            for some in sets
        ]

    counts = [count for count in _COUNTS if count < most] + [most] * (most <= _COUNTS[-1])
    last = images(counts[0], camera)
    # What the points light is a small part of a large detector.
    rows, columns = _lit(last)
    recorded = _cropped(camera, rows, columns)
    last = [image[rows, columns] for image in last]
    for count, more in itertools.pairwise(counts):
        finer = images(more, recorded)
        if all(_differ(a, b) <= error / 2 for a, b in zip(last, finer, strict=True)):
            return spectrum.interpolated(count)
        last = finer
    return spectrum.interpolated(counts[-1])


def _lit(images: list[NDArray[np.float32]]) -> tuple[slice, slice]:
    """Return rows and columns that hold all light of some images, or all where there is none."""
    lit = np.any([image.any(2) for image in images], axis=0)
    found = [np.flatnonzero(lit.any(axis)) for axis in (1, 0)]
    rows, columns = (slice(int(some[0]), int(some[-1]) + 1) if len(some) else slice(None) for some in found)
    return rows, columns


def _cropped(camera: PlenopticCamera, rows: slice, columns: slice) -> PlenopticCamera:
    """Return the camera that records those rows and columns of its image alone."""
    (left, right, _), (top, bottom, _) = (
        some.indices(count) for some, count in zip((columns, rows), camera.crop_size, strict=True)
    )
    offset = camera.crop_offset[0] + left, camera.crop_offset[1] + top
    return camera.replace(crop_offset=offset, crop_size=(right - left, bottom - top))


def _differ(image: NDArray[np.float32], reference: NDArray[np.float32]) -> float:
    """Return the relative difference (L2) of the channel that differs most."""
    norms = np.sqrt(np.sum(np.square(reference, dtype=np.float64), axis=(0, 1)))
    change = np.sqrt(np.sum(np.square(image - reference, dtype=np.float64), axis=(0, 1)))
    return float(np.max(change[norms > 0] / norms[norms > 0], initial=0.0))


def neighbours(camera: PlenopticCamera, positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return some radiators, near and far, whose images lie beside each other.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    positions : float64 array (n, 3)
        The radiators in the camera frame; there must be one.
    """
    lens = lens_of_rays(camera)
    # For who is a neighbour of whom, real lenses need not be traced.
    images = positions[:, :2] / positions[:, 2:] if isinstance(lens, LensSystem) else lens.images(positions)
    order = np.argsort(lens.vergence(positions[:, 2]), kind="stable")
    found = set()
    for part in _DISTANCES:
        apart = images - images[order[int(part * (len(order) - 1))]]
        found.update(np.argsort((apart**2).sum(1), kind="stable")[:_NEIGHBOURS].tolist())
    return np.array(sorted(found), np.int64)


@dataclass(frozen=True)
class SpectralCapture:
    """A wave capture of which each channel records many wavelengths.

    Attributes
    ----------
    capture : WaveCapture
        Camera, scene, and how radiators are found.
    spectrum : Spectrum
        What the channels answer to.
    upsampling : float64 array (channels of light, wavelengths), or None
        From the radiance to its spectrum; None if it has a value for each wavelength.
    nodes : int, or None
        At how many wavelengths point spreads are computed; None: as `with_enough_nodes` finds.
    """

    capture: WaveCapture
    spectrum: Spectrum
    upsampling: NDArray[np.float64] | None
    nodes: int | None

    def compute(self, *, seed: int, spp: int, job: Job, noise: bool) -> NDArray[np.float32]:
        """Sum all radiators of all passes.

        Parameters
        ----------
        seed, spp, job, noise
            As of the integrator's `record`.

        Returns
        -------
        float32 array (rows, columns, channels)
            Pixel values; where all responses are positive none is negative.

        Raises
        ------
        InputError
            If the noise is asked for, which is not known, or the method is bank.
        """
        if noise:
            raise InputError("noise: of captures of bands or responses it is not known; leave it out")
        self._check()
        sets = self.capture.radiators("patch", seed, spp)
        spectrum = self._with_nodes(sets[0])
        operators = [self._operator(radiators, spectrum) for radiators in sets]
        total = sum(len(operator.points) * operator.sums for operator in operators)
        if total == 0:
            warnings.warn(
                "plenoptic_wave: no ray from the pupil meets anything that shines; a nested integrator with "
                "hide_emitters sees no emitters",
                stacklevel=2,
            )
        tasks = itertools.chain.from_iterable(
            operator.tasks(self._weights(radiators), job) for operator, radiators in zip(operators, sets, strict=True)
        )
        shape = (*self.capture.camera.shape, spectrum.channels)
        image = job.run(tasks, shape, total, partial(self._facts, sets, spectrum, seed))
        if np.min(spectrum.responses) >= 0:
            # What interpolation leaves below zero is not light; colours outside of a gamut are.
            np.maximum(image, 0, out=image)
        return image

    def estimate(self, *, seed: int, spp: int, job: Job) -> Cost:
        """Estimate what `compute` takes, from some of the lenses and some of the rays."""
        self._check()
        capture = self.capture
        cost = estimate_waves(
            capture.camera,
            partial(find_radiators, capture.sight, capture.camera, seed=seed),
            lambda radiators: self._operator(radiators, self._with_nodes(radiators)),
            job,
            pairs=sample_pairs(capture.radiators_per_lens, np.zeros(4)),
            spp=spp,
            occlusion=capture.occlusion,
        )
        passes = capture.passes
        return replace(
            cost, radiators=cost.radiators * passes, patterns=cost.patterns * passes, seconds=cost.seconds * passes
        )

    def _check(self) -> None:
        if self.capture.method == "bank":
            raise InputError("method = bank: it records light of one wavelength a channel; use patch")

    def _operator(self, radiators: Radiators, spectrum: Spectrum) -> CaptureOperator:
        capture = self.capture
        return CaptureOperator(
            capture.camera,
            radiators.positions,
            spectrum=spectrum,
            method="patch" if capture.method == "auto" else capture.method,
            accuracy=capture.accuracy,
            pupil_weights=radiators.pupil_weights,
            virtual=True,
        )

    def _with_nodes(self, radiators: Radiators) -> Spectrum:
        """Return the spectrum with nodes: as many as given, or as radiators near, far and between need."""
        if self.nodes is not None:
            return self.spectrum.interpolated(self.nodes)
        count, error = len(radiators.positions), self.capture.accuracy
        if count == 0 or error == 0 or self.capture.method == "full_field":
            return self.spectrum
        some, weights = neighbours(self.capture.camera, radiators.positions), radiators.pupil_weights
        chosen = None if weights is None else weights.take(some)
        return with_enough_nodes(
            self.capture.camera, radiators.positions[some], self.spectrum, error, chosen, together=True
        )

    def _weights(self, radiators: Radiators) -> NDArray[np.float64]:
        """Return the weights (n, wavelengths) of radiators."""
        spectra = radiators.radiance if self.upsampling is None else radiators.radiance @ self.upsampling
        return self.capture.scale(radiators) * spectra

    def _facts(self, sets: list[Radiators], spectrum: Spectrum, seed: int) -> dict[str, Any]:
        """Return by what a capture is known as the same."""
        return {**self.capture.facts(sets, seed), "nodes": spectrum.nodes, "responses": spectrum.responses}
