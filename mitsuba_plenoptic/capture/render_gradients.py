"""Derivatives of captures by waves: with respect to the camera's numbers, and to the light of its radiators."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .derivatives import light_slopes
from .operator import CaptureOperator
from .radiators import Radiators
from .replay import Replay
from .wave_capture import WaveCapture

Numbers = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class RenderGradients:
    """The derivatives of a capture by waves, with the radiators held, and how the light of each fills the pupil.

    Attributes
    ----------
    capture : WaveCapture
        The capture; what it would do by a bank is done by exact point spreads.
    seed, spp
        As of its `compute`.
    replay : Replay, optional
        What differentiates the radiators' light; None: it is held.
    """

    capture: WaveCapture
    seed: int
    spp: int
    replay: Replay | None

    def forward(self, changes: Numbers) -> NDArray[np.float32]:
        """Return the change of the capture, (rows, columns, channels).

        Parameters
        ----------
        changes : dict
            Of the camera's numbers, by name. The tangents of the scene's parameters are Dr.Jit's.
        """
        camera = self.capture.camera
        image = np.zeros((*camera.shape, len(self.capture.wavelengths)), np.float32)
        for radiators, operator, scale in self._passes():
            weights, slopes = scale * radiators.radiance, self._slopes(radiators, changes)
            change = sum((change @ slopes[name] for name, change in changes.items()), np.zeros(1))[:, None] * weights
            if self.replay is not None:
                change = change + scale * self.replay.forward(radiators)
            image += operator.forward(change)
            if changes:
                image += operator.derivative(weights, changes)
        return image

    def backward(self, gradient: NDArray[np.float32], names: tuple[str, ...]) -> Numbers:
        """Return the gradients of the camera's numbers; those of the scene's parameters are added to Dr.Jit's.

        Parameters
        ----------
        gradient : float32 array (rows, columns, channels)
            Of a figure with respect to the capture.
        names : tuple of str
            Of the numbers.
        """
        total: Numbers = {name: np.zeros(1) for name in names}
        for radiators, operator, scale in self._passes():
            weights, back = scale * radiators.radiance, operator.adjoint(gradient)
            if names:
                found = operator.gradient(weights, gradient, names)
                figures, slopes = (back * weights).sum(axis=1), self._slopes(radiators, names)
                total = {name: total[name] + found[name] + slopes[name] @ figures for name in names}
            if self.replay is not None:
                self.replay.backward(radiators, scale * back)
        return total

    def _slopes(self, radiators: Radiators, names: Iterable[str]) -> Numbers:
        """Return the relative changes of the radiators' light, (parts, n) by name."""
        # What of a lens is open hardly depends on the wavelength.
        return light_slopes(self.capture.camera, names, radiators.positions, self.capture.wavelengths[0])

    def _passes(self) -> Iterator[tuple[Radiators, CaptureOperator, NDArray[np.float64]]]:
        """Yield the radiators of each pass, their operator and the weights of radiance 1."""
        with dr.suspend_grad():
            sets = self.capture.radiators("patch", self.seed, self.spp, dark=self.replay is not None)
        for radiators in sets:
            yield (
                radiators,
                self.capture.operator(radiators, "patch", self.capture.wavelengths),
                self.capture.scale(radiators),
            )
