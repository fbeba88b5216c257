"""What a camera is expected to record of known scenes by rays, and its derivatives by differences.

Edges of micro-images move with the numbers of a camera, which no derivative of the light along single rays tells. So
captures of the same random numbers are compared, with steps by which the image changes a little.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..capture.render import render_capture
from ..errors import InputError, require_count
from ..plugins.other_camera import with_camera
from .light import checked_image, checked_noise
from .model import Number, changed, scales, values

_CHANGE = 0.04
"""Relative change of the captures, in the L2 norm, by a step."""

_FIRST = 0.02
"""The step that is tried first, in units of `Fit.scales`."""

_MOST = 20.0
"""By how many times a step may differ from the first one."""


@dataclass(frozen=True)
class RayView:
    """A capture by rays, and the scene that it shows.

    Parameters
    ----------
    image : array (rows, columns)
        The capture.
    scene : mitsuba.Scene
        What it shows, with the camera's place as that of the first sensor; of a variant of one channel.
    noise : float or array (rows, columns), optional
        Standard deviation of the pixels. Default: what `fit` is told of photons.
    spp : int
        Rays to each pixel of the model. Their noise must lie well below that of the capture, as nothing is allowed for
        it.
    seed : int
        Of the random numbers, which are the same for all cameras.

    Raises
    ------
    InputError
        If an input has a wrong shape or value.
    """

    image: NDArray[np.float32]
    scene: Any
    noise: Any = None
    spp: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        image = checked_image(self.image)
        if not isinstance(self.scene, mi.Scene):
            raise InputError(f"scene of type {type(self.scene).__name__}: it must be a mitsuba.Scene")
        if mi.is_rgb or mi.is_spectral:
            raise InputError(f"variant {mi.variant()}: a camera is fitted to images of one channel; use a mono variant")
        for name, value in (
            ("image", image),
            ("noise", checked_noise(self.noise, image)),
            ("spp", require_count("spp", self.spp)),
            ("seed", require_count("seed", self.seed, minimum=0)),
        ):
            object.__setattr__(self, name, value)


class RayModel:
    """What a camera is expected to record of some views; see `model.Model`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    views : list of RayView
        The scenes.
    """

    def __init__(self, camera: PlenopticCamera, views: list[RayView]) -> None:
        self._camera, self._views = camera, views

    def images(self) -> NDArray[np.float64]:
        """Return the expected pixels of all views, (views, rows, columns)."""
        return np.stack([_render(view, self._camera) for view in self._views])

    def derivatives(self, numbers: list[Number], images: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of `images` by numbers, (numbers, views, rows, columns)."""
        start, units = values(self._camera, numbers), scales(self._camera, numbers)
        return np.stack([self._by(numbers, start, index, units, images) for index in range(len(numbers))])

    def _by(
        self,
        numbers: list[Number],
        start: NDArray[np.float64],
        index: int,
        units: NDArray[np.float64],
        images: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the difference by one number, over the step."""

        def moved(step: float) -> NDArray[np.float64]:
            place = start.copy()
            place[index] += step
            return RayModel(changed(self._camera, numbers, place), self._views).images()

        first = _FIRST * float(units[index])
        # Apertures that fill their cells can only shrink.
        full = numbers[index].name == "mla_fill" and start[index] + _MOST * first > 1
        change = np.linalg.norm(moved(-first) - images) / np.linalg.norm(images)
        if not change:
            return np.zeros_like(images)
        step = first * float(np.clip(_CHANGE / change, 1 / _MOST, _MOST))
        if full:
            return (images - moved(-step)) / step
        return (moved(step) - moved(-step)) / (2 * step)


def _render(view: RayView, camera: PlenopticCamera) -> NDArray[np.float64]:
    """Return a capture by a camera, with the view's random numbers."""
    scene = with_camera(view.scene, camera)
    return render_capture(scene, model="ray", spp=view.spp, seed=view.seed).image.astype(np.float64)
