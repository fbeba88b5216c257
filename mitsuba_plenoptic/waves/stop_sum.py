"""Wave captures of an array in the image of the stop: a sum over the kinds of lenses."""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..errors import refuse_if
from ..runtime import Array
from .convolution import Block
from .signed_rays import SignedRaySum
from .spectral_nodes import Node
from .stop_image import LensDiffraction, stop_lenses


class StopSum:
    """The sum of a capture over the kinds of lenses, each a `SignedRaySum` of its own pixels; a `batches.LongSum`."""

    def __init__(self, camera: PlenopticCamera, light: Any, nodes: Sequence[Node], *arguments: Any, **options: Any):
        """Take what a `SignedRaySum` takes, with nodes whose plans are those of whole lenses."""
        self._sums = []
        for kind in range(len(stop_lenses(camera).parts)):
            of_kind = [replace(node, plan=lens_diffraction(node.plan, kind)) for node in nodes]
            if of_kind[0].plan.pixels.columns and of_kind[0].plan.pixels.rows:
                self._sums.append(SignedRaySum(camera, light, of_kind, *arguments, **options))
        refuse_if(not self._sums, f"crop_offset = {camera.crop_offset}: no lens sends light to the recorded pixels")
        self.box, self.channels, self.arrays = self._sums[0].box, self._sums[0].channels, self._sums[0].arrays
        self.items = np.concatenate([of_kind.items for of_kind in self._sums])
        self.image, self.probe = self._sums[0].image, self._sums[0].probe

    @property
    def traced(self) -> Any:
        """Called with the count of items whose rays have been traced since the last call."""
        return self._sums[0].traced

    @traced.setter
    def traced(self, report: Any) -> None:
        for of_kind in self._sums:
            of_kind.traced = report

    def batches(self, first: int) -> Iterator[Block]:
        """Yield the images of the blocks from index `first`, kind by kind."""
        for of_kind in self._sums:
            if first < len(of_kind.items):
                yield from of_kind.batches(max(first, 0))
            first -= len(of_kind.items)

    def propagate(self, gradient: Sequence[Array]) -> Iterator[None]:
        """Propagate a gradient kind by kind, as `SignedRaySum.propagate`."""
        for of_kind in self._sums:
            yield from of_kind.propagate(gradient)


@functools.lru_cache(maxsize=128)
def lens_diffraction(plan: LensDiffraction, kind: int) -> LensDiffraction:
    """Return the diffraction of a kind of lenses at the wavelength of a plan, cached for further captures."""
    options = plan.options
    return LensDiffraction(plan.camera, plan.wavelength, options["fine"], options["shortest"], kind)
