"""A scene's capture by signed rays: its plan, its noise, what it takes."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..io.checkpoints import digest
from ..optics.phase import in_millimetres
from ..runtime.jobs import Job, Task
from .noise import PARTS, keep_spread, with_spread
from .patch_plan import Cost
from .signed_colours import FINE, Node, SignedColours
from .signed_rays import SceneLight, SignedRaySum

_SAMPLES = 4
"""Rays a cell of each of the captures from whose spread the noise is found: few correct each other less well."""

_SPOTS = 1.5
"""Distance, in spots of a lens's diffraction, within which chance below zero is made up for."""

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
    colours : SignedColours
        What the channels answer to.
    accuracy : float
        Allowed relative error.
    """

    camera: PlenopticCamera
    light: SceneLight
    colours: SignedColours
    accuracy: float

    @cached_property
    def _nodes(self) -> list[Node]:
        return self.colours.planned(self.camera, self.accuracy)

    @property
    def _parts(self) -> int:
        """Cells of the grid across a pixel."""
        camera = self.camera
        if any(node.plan.by_points for node in self._nodes):
            return 1  # kernels of such are integrated over pixels
        extent = in_millimetres(min(node.plan.wavelength for node in self._nodes)) * camera.detector_distance
        highest = float(camera.lattice.aperture_width) / extent * camera.pixel_size
        return math.ceil(_KEPT[self.accuracy < FINE] * highest)

    def _sum(self, spp: int, seed: int) -> SignedRaySum:
        return SignedRaySum(
            self.camera, self.light, self._nodes, self.colours.drawn, parts=self._parts, spp=spp, seed=seed
        )

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
        # Neighbouring seeds must not share runs.
        seeds = np.random.SeedSequence([seed, runs]).generate_state(runs).tolist()
        first = self._sum(-(-spp // runs), seeds[0])
        found, items = first.probe(), int(first.items.sum())
        # What one sum holds is given back before the next.
        del first
        tasks = [Task(items, partial(self._sum, -(-spp // runs), own), partial(_part, runs)) for own in seeds]
        if noise:
            tasks = [keep_spread(task) for task in tasks]
        channels, responses = self.colours.spectrum.channels, self.colours.spectrum.matrix()
        shape = (*self.camera.shape, channels * (3 if noise else 1))
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
        extent = in_millimetres(max(node.plan.wavelength for node in self._nodes)) * self.camera.detector_distance
        spot = extent / float(self.camera.lattice.aperture_width) / self.camera.pixel_size
        for channel in np.flatnonzero(responses.min(1) >= 0).tolist():
            image[..., channel] = _without_negatives(image[..., channel], 2 * math.ceil(_SPOTS * spot) + 1)
        return image

    def estimate(self, *, seed: int, spp: int, job: Job) -> Cost:
        """Estimate what `compute` takes, from some of the rays."""
        seconds, memory = self._sum(spp, seed).cost()
        return Cost(0, 0, seconds, memory)


def _without_negatives(image: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Return an image in which what is below zero, by chance, is taken from the light around it.

    To set it to zero would brighten what is dark, the more the fewer samples there are.
    """
    from scipy.ndimage import uniform_filter

    light = np.maximum(image, 0)
    around = uniform_filter(light, size)
    missing = uniform_filter(light - image, size)
    share = np.divide(missing, around, out=np.zeros_like(image), where=around > 0)
    return np.asarray(light * (1 - np.minimum(share, 1)), np.float32)


def _part(runs: int, image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return what one of some captures adds to their mean."""
    return image * np.float32(1 / runs)
