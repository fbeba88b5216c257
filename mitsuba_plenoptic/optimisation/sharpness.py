"""How sharp refocused images of points are."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError, did_you_mean, refuse_if, require_count, require_number
from ..reconstruction import RayRefocus
from .spreads import DESIGN_ACCURACY, Gradient, Spreads, require_held

VARYING = ("mla_focal_length", "mla_fill", "wavefront")
"""Numbers that refocusing by rays does without."""


class RefocusedContrast:
    r"""Mean contrast of points that are refocused by rays: their modulation transfer over a range of depths.

    .. math:: \frac{1}{n m} \sum_{r, \nu} \frac{|\sum_j b_{rj} \, e^{-2 \pi i \nu \cdot x_j}|}{\sum_j b_{rj}}

    with the bins b of each point r, refocused to its own distance, and frequencies :math:`\nu` along x and along y.
    Refocusing is that of one camera, and held.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera whose refocusing is used. Others may differ from it in ``mla_focal_length``, ``mla_fill`` and
        ``wavefront``.
    points : array (n, 3)
        Scene points (X, Y, g) in the camera frame, in millimetres.
    frequencies : sequence of float
        In line pairs per bin of one lens, at most half of `oversample`.
    wavelength : float
        In nanometres.
    oversample : int
        Bins per lens along each axis.
    accuracy, method
        As of `CaptureOperator`.

    Raises
    ------
    InputError
        If an input has a wrong value.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        points: Any,
        frequencies: Sequence[float],
        *,
        wavelength: float = 633.0,
        oversample: int = 4,
        accuracy: float = DESIGN_ACCURACY,
        method: str = "patch",
    ) -> None:
        self._camera, self._spreads = camera, Spreads(points, wavelength, accuracy, method)
        count = require_count("oversample", oversample)
        given = [require_number("frequencies", frequency, positive=True) for frequency in frequencies]
        if not given or max(given) > count / 2:
            raise InputError(f"frequencies = {tuple(given)}: give some, at most {count / 2:g}, half of oversample")
        self._refocus = [RayRefocus(camera, g, oversample=count) for g in self._spreads.points[:, 2].tolist()]
        waves = []
        for size in reversed(camera.bin_count):
            place = (np.arange(size * count) + 0.5) / count
            waves.append(np.exp(-2j * np.pi * np.array(given)[:, None] * place))
        self._along_y, self._along_x = waves

    def value(self, camera: PlenopticCamera) -> float:
        """Return the mean contrast of a camera."""
        return self._contrast(self._images(camera))[0]

    def gradient(self, camera: PlenopticCamera, names: Iterable[str]) -> tuple[float, Gradient]:
        """Return the mean contrast, and its derivatives by numbers of the camera, by name.

        Parameters
        ----------
        camera : PlenopticCamera
            The camera.
        names : iterable of str
            The numbers.

        Raises
        ------
        InputError
            If refocusing depends on a number.
        """
        names = tuple(names)
        for name in names:
            if name not in VARYING:
                raise InputError(
                    f"{name}: refocusing is held, of numbers that vary: {', '.join(VARYING)}"
                    f"{did_you_mean(name, VARYING)}"
                )
        value, slopes = self._contrast(self._images(camera))
        return value, self._spreads.gradient(camera, slopes, names)

    def refocused(self, camera: PlenopticCamera) -> list[NDArray[np.float32]]:
        """Return the refocused image of each point."""
        pairs = zip(self._refocus, self._images(camera), strict=True)
        return [refocus.forward(image) for refocus, image in pairs]

    def _images(self, camera: PlenopticCamera) -> NDArray[np.float64]:
        held = [name for name in camera.to_dict() if name not in VARYING]
        require_held(self._camera, camera, held)
        return self._spreads.images(camera)

    def _contrast(self, images: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Return the mean contrast, and its gradient by the spreads."""
        total, gradients = 0.0, []
        number = len(images) * (len(self._along_x) + len(self._along_y))
        for refocus, image in zip(self._refocus, images, strict=True):
            bins = refocus.forward(image.astype(np.float32)).astype(np.float64)
            light, slope = bins.sum(), np.zeros_like(bins)
            refuse_if(not light > 0, "points: one of them sends no light to the recorded pixels")
            for amplitudes, waves, across in (
                (self._along_x @ bins.sum(0), self._along_x, False),
                (self._along_y @ bins.sum(1), self._along_y, True),
            ):
                for amplitude, wave in zip(amplitudes, waves, strict=True):
                    size = abs(amplitude)
                    total += size / light
                    along = (amplitude.conjugate() * wave).real / max(size, 1e-300) / light
                    slope += (along[:, None] if across else along) - size / light**2
            gradients.append(refocus.adjoint(slope / number))
        return total / number, np.stack(gradients)
