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
            of_kind = [
                replace(
                    node,
                    plan=_diffraction(node.plan.camera, node.plan.wavelength, **node.plan.options | {"kind": kind}),
                )
                for node in nodes
            ]
            pixels = of_kind[0].plan.pixels
            if pixels.columns and pixels.rows:
                self._sums.append(SignedRaySum(camera, light, of_kind, *arguments, **options))
        refuse_if(not self._sums, f"crop_offset = {camera.crop_offset}: no lens sends light to the recorded pixels")
        first = self._sums[0]
        self.box, self.channels, self.arrays = first.box, first.channels, first.arrays
        self.items = np.concatenate([of_kind.items for of_kind in self._sums])
        self.image, self.probe = first.image, first.probe

    def batches(self, first: int) -> Iterator[Block]:
        """Yield the images of the blocks from index `first`, kind by kind."""
        for of_kind in self._sums:
            yield from of_kind.batches(max(first, 0))
            first -= len(of_kind.items)

    def propagate(self, gradient: Sequence[Array]) -> Iterator[None]:
        """Propagate a gradient kind by kind, as `SignedRaySum.propagate`."""
        for of_kind in self._sums:
            yield from of_kind.propagate(gradient)


_diffraction = functools.lru_cache(maxsize=128)(LensDiffraction)
"""Return the diffraction of a kind of lenses, cached for further captures."""
