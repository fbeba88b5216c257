"""Captures of scenes by signed rays: plan, noise, and cost."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..io.checkpoints import digest
from ..operator.patch_plan import Cost
from ..optics.phase import in_millimetres
from ..runtime.jobs import Job, SumTask
from .noise import PARTS, Mended, keep_spread, with_spread
from .scene_light import SceneLight
from .signed_colours import FINE, Node, SignedColours
from .signed_rays import SignedRaySum

Sum = TypeVar("Sum", bound=SignedRaySum)

_SAMPLES = 4
"""Samples per pixel of each capture from whose spread the noise is estimated: fewer correct each other less well."""

_SPOTS = 1.5
"""Distance, in diffraction spots of a microlens, within which noise below zero is compensated."""

_KEPT = (1.5, 4.0)
"""Cells of the grid per period of the highest frequency of a microlens's diffraction, at usual and fine accuracy. Two
would resolve it; 1.5 lose the last quarter of frequencies, which is negligible; 4 also resolve the interference of
neighbouring lenses."""


@dataclass(frozen=True)
class SignedCapture:
    """A capture by signed rays: the camera, the light, the channels' responses and the accuracy."""

    camera: PlenopticCamera
    # Radiance along rays.
    light: SceneLight
    # Responses of the channels.
    colours: SignedColours
    accuracy: float

    @cached_property
    def nodes(self) -> list[Node]:
        """Return the nodes, the wavelengths at which diffraction is computed."""
        return self.colours.planned(self.camera, self.accuracy)

    @property
    def _parts(self) -> int:
        """Return the count of grid cells across a pixel."""
        camera = self.camera
        if any(node.plan.by_points for node in self.nodes):
            return 1  # the kernels of these plans are integrated over pixels
        extent = in_millimetres(min(node.plan.wavelength for node in self.nodes)) * camera.detector_distance
        highest = float(camera.lattice.aperture_width) / extent * camera.pixel_size
        return math.ceil(_KEPT[self.accuracy < FINE] * highest)

    def sums(
        self, spp: int, seed: int, runs: int, kind: Callable[..., Sum], light: SceneLight | None = None
    ) -> list[Callable[[], Sum]]:
        """Return functions that construct the sums of `runs` independent captures, which divide the rays equally.

        They are functions so that the memory of one sum is freed before the next is made. The light is the capture's
        own by default.
        """
        return [
            partial(
                kind,
                self.camera,
                light or self.light,
                self.nodes,
                self.colours.drawn,
                parts=self._parts,
                spp=-(-spp // runs),
                seed=own,
            )
            # Captures with neighbouring seeds must not share runs.
            for own in np.random.SeedSequence([seed, runs]).generate_state(runs).tolist()
        ]

    def compute(self, *, seed: int, spp: int, job: Job, noise: bool) -> NDArray[np.float32]:
        """Capture the scene.

        The result has the shape (rows, columns, channels).
        """
        runs = max(2, min(PARTS, spp // _SAMPLES)) if noise else 1
        sums = self.sums(spp, seed, runs, SignedRaySum)
        first = sums[0]()
        found, items = first.probe(), int(first.items.sum())
        del first
        tasks = [SumTask(items, plan, partial(_part, runs)) for plan in sums]
        if noise:
            tasks = [keep_spread(task) for task in tasks]
        channels = self.colours.spectrum.channels
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
        for channel, mended in self.mended(image).items():
            image[..., channel] = mended.image
        return image

    def mended(self, image: NDArray[np.float32]) -> dict[int, Mended]:
        """Return the channels of an image that only noise can make negative, with negative values compensated."""
        extent = in_millimetres(max(node.plan.wavelength for node in self.nodes)) * self.camera.detector_distance
        spot = extent / float(self.camera.lattice.aperture_width) / self.camera.pixel_size
        size = 2 * math.ceil(_SPOTS * spot) + 1
        channels = np.flatnonzero(self.colours.spectrum.matrix().min(1) >= 0).tolist()
        return {channel: Mended(image[..., channel], size) for channel in channels}

    def estimate(self, *, seed: int, spp: int, job: Job) -> Cost:
        """Estimate the cost of `compute` from some of the rays."""
        seconds, memory = self.sums(spp, seed, 1, SignedRaySum)[0]().cost()
        return Cost(0, 0, seconds, memory)


def _part(runs: int, image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the contribution of one of `runs` captures to their mean."""
    return image * np.float32(1 / runs)
