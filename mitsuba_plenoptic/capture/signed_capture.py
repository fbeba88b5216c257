"""A scene's capture by signed rays: its plan, its noise, what it takes."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..io.checkpoints import digest
from ..optics.phase import in_millimetres
from ..optics.phase_space import PhaseSpace
from ..runtime.jobs import Job, Task
from .negatives import Mended
from .noise import PARTS, keep_spread, with_spread
from .patch_plan import Cost
from .signed_rays import SceneLight, SignedRaySum

Sum = TypeVar("Sum", bound=SignedRaySum)

_FINE = 0.005
"""Accuracy below which finer plans are made."""

_DEGREES, _WINDOWS = (4, 6), (9, 13)
"""Degrees of the polynomials and windows of plans, usual and finer ones."""

_SAMPLES = 4
"""Rays a cell of each of the captures from whose spread the noise is found: few correct each other less well."""

_SPOTS = 1.5
"""Distance, in spots of a lens's diffraction, within which chance below zero is made up for."""

_DEFOCUS = 4.0
"""Radians of the microlenses' defocus from which on polynomials are of two degrees more."""

_KEPT = (1.5, 4.0)
"""Cells of the grid over the highest frequency of a lens's diffraction, in cycles: half of them hold it whole, of which
the last quarter is next to nothing; twice as many hold the interference of neighbours, too."""


@dataclass(frozen=True)
class SignedCapture:
    """What is recorded, and how exactly.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera.
    light : SceneLight
        Finds the radiance along rays.
    wavelengths : tuple of float
        Of each channel, in nanometres.
    accuracy : float
        Allowed relative error.
    """

    camera: PlenopticCamera
    light: SceneLight
    wavelengths: tuple[float, ...]
    accuracy: float

    @property
    def _plans(self) -> list[PhaseSpace]:
        fine = self.accuracy < _FINE
        return [_plan(self.camera, wavelength, fine) for wavelength in self.wavelengths]

    @property
    def _parts(self) -> int:
        """Cells of the grid across a pixel."""
        camera = self.camera
        extent = in_millimetres(min(self.wavelengths)) * camera.detector_distance
        highest = float(camera.lattice.aperture_width) / extent * camera.pixel_size
        return math.ceil(_KEPT[self.accuracy < _FINE] * highest)

    def sums(self, spp: int, seed: int, runs: int, kind: Callable[..., Sum]) -> list[Sum]:
        """Return the sums of so many independent captures of equal parts of the rays."""
        return [
            # Neighbouring seeds must not share runs.
            kind(self.camera, self.light, self._plans, parts=self._parts, spp=-(-spp // runs), seed=int(own))
            for own in np.random.SeedSequence([seed, runs]).generate_state(runs)
        ]

    def compute(self, *, seed: int, spp: int, job: Job, noise: bool) -> NDArray[np.float32]:
        """Capture the scene.

        Parameters
        ----------
        seed, spp, job, noise
            As of the integrator's `record`.

        Returns
        -------
        float32 array (rows, columns, channels)
            Pixel values, none negative; with noise twice as many channels, those of the standard deviations last.
        """
        runs = max(2, min(PARTS, spp // _SAMPLES)) if noise else 1
        sums = self.sums(spp, seed, runs, SignedRaySum)
        tasks = [_share(work, runs) for work in sums]
        if noise:
            tasks = [keep_spread(task) for task in tasks]
        channels = len(self.wavelengths)
        shape = (*self.camera.shape, channels * (4 if noise else 1))
        found = sums[0].probe()
        if not found.any():
            warnings.warn(
                "plenoptic_wave: none of some rays meets anything that shines; a nested integrator with "
                "hide_emitters sees no emitters",
                stacklevel=2,
            )
        image = job.run(tasks, shape, sum(task.items for task in tasks), lambda: {"scene_digest": digest(found)})
        if noise:
            image = with_spread(image, runs)
        np.maximum(image[..., channels:], 0, out=image[..., channels:])
        np.sqrt(image[..., channels:], out=image[..., channels:])
        for channel, mended in enumerate(self.mended(image[..., :channels])):
            image[..., channel] = mended.image
        return image

    def mended(self, image: NDArray[np.float32]) -> list[Mended]:
        """Return the channels of an image without what is below zero by chance."""
        extent = in_millimetres(max(self.wavelengths)) * self.camera.detector_distance
        spot = extent / float(self.camera.lattice.aperture_width) / self.camera.pixel_size
        size = 2 * math.ceil(_SPOTS * spot) + 1
        return [Mended(channel, size) for channel in np.moveaxis(image, -1, 0)]

    def estimate(self, *, seed: int, spp: int, job: Job) -> Cost:
        """Estimate what `compute` takes, from some of the rays."""
        (work,) = self.sums(spp, seed, 1, SignedRaySum)
        seconds, memory = work.cost()
        return Cost(0, 0, seconds, memory)


@functools.lru_cache(maxsize=4)
def _plan(camera: PlenopticCamera, wavelength: float, fine: bool) -> PhaseSpace:
    """Return a plan, which several captures of a camera share."""
    plan = PhaseSpace(camera, wavelength, degree=_DEGREES[fine], window=_WINDOWS[fine])
    return replace(plan, degree=plan.degree + 2) if plan.defocus > _DEFOCUS else plan


def _share(work: SignedRaySum, runs: int) -> Task:
    """Return one of some captures of which the mean is taken."""
    return Task(int(work.items.sum()), lambda: work, lambda image: image * np.float32(1 / runs))
