"""A scene's capture point by point: the plain reference by which other wave captures are judged."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..io.checkpoints import digest
from ..operator.operator import CaptureOperator
from ..operator.patch_plan import Cost
from ..optics.spectrum import Spectrum
from ..runtime.jobs import Job
from .scene_light import SceneLight
from .scene_points import ScenePoints, find_points


@dataclass(frozen=True)
class PointsCapture:
    """What is recorded, and how exactly."""

    camera: PlenopticCamera
    # Find the radiance along rays; their channels, one after another, are those of the light.
    lights: Sequence[SceneLight]
    # Wavelengths, and what the channels answer to.
    spectrum: Spectrum
    # From the radiance to its spectrum; None if it has a value for each wavelength; (channels of light, wavelengths).
    upsampling: NDArray[np.float64] | None
    # As of `CaptureOperator`.
    accuracy: float

    def compute(self, *, seed: int, spp: int, job: Job, noise: bool) -> NDArray[np.float32]:
        """Capture the scene.

        The result has the shape (rows, columns, channels).
        """
        if noise:
            raise InputError("noise: method = points does not state it; compare seeds, or use signed_rays")
        points = find_points(self.lights, self.camera, spp, seed=seed)
        if not len(points.positions):
            warnings.warn("plenoptic_wave: no ray from the pupil meets anything that shines", stacklevel=2)
        operator = self._operator(points)
        image = job.run(
            operator.tasks(self._weights(points), job),
            (*self.camera.shape, self.spectrum.channels),
            len(points.positions) * operator.sums,
            lambda: self._facts(points),
        )
        if np.min(self.spectrum.responses) >= 0:
            # What interpolation leaves below zero is not light; colours outside of a gamut are.
            np.maximum(image, 0, out=image)
        return image

    def estimate(self, *, seed: int, spp: int, job: Job) -> Cost:
        """Estimate what `compute` takes beside the tracing of rays, from all points and some of their spreads."""
        points = find_points(self.lights, self.camera, spp, seed=seed, paths=1)
        return replace(self._operator(points).estimate(job), points=len(points.positions))

    def _operator(self, points: ScenePoints) -> CaptureOperator:
        return CaptureOperator(
            self.camera,
            points.positions,
            spectrum=self.spectrum,
            method="patch",
            accuracy=self.accuracy,
            pupil_weights=points.pupil_weights,
        )

    def _weights(self, points: ScenePoints) -> NDArray[np.float64]:
        return points.weights if self.upsampling is None else points.weights @ self.upsampling

    def _facts(self, points: ScenePoints) -> dict[str, Any]:
        """Return by what a capture is known as the same."""
        pupil = points.pupil_weights
        masks: list[NDArray[Any]] = [] if pupil is None else [pupil.table, pupil.index, pupil.slant]
        return {
            "points": len(points.positions),
            "scene_digest": digest(points.positions, points.weights, *masks),
            "responses": self.spectrum.responses,
        }
