"""Weights of points at each wavelength, the image channels that record them, and the plans of all wavelengths."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, cast

import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError, refuse_if
from ..fields import OpticalSystem
from ..optics import Spectrum
from ..runtime import POINTS, Array, Doubles, Floats, Job, Numbers, Shape, as_array, require_all
from .pupil_weights import PupilWeights


@dataclass(frozen=True)
class SpectralSum:
    """A sum of point spreads at one wavelength, of which several make an image."""

    wavelength: float  # in nanometres
    before: Doubles  # factors on the columns of the weights, (columns, k)
    after: Floats  # factors from the sum's channels to those of the image, (channels, k)

    def reduced(self, weights: Doubles, errors: Doubles) -> SpectralSum:
        """Return the sum with the fewest columns of weights; one column if all points have one spectrum.

        Spectra that change little between nodes give channels with nearly proportional weights, while every column
        costs one addition for each copy.

        `errors` are the allowed root sum square errors of the weights in each channel of the image.
        """
        channels = weights @ self.before
        # The order is fixed, because a checkpoint of a sum in progress refers to these very columns.
        powers, vectors = np.linalg.eigh(np.einsum("ni,nj->ij", channels, channels))
        left = np.cumsum(np.maximum(powers, 0) * (self.after.astype(np.float64) @ vectors) ** 2, axis=1)
        dropped = int(np.argmin(np.append(np.all(np.sqrt(left) <= errors[:, None], axis=0), False)))
        retained = vectors[:, min(dropped, len(vectors) - 1) :]
        if retained.shape[1] == len(vectors):
            return self
        return SpectralSum(self.wavelength, self.before @ retained, (self.after @ retained).astype(np.float32))


class WeightChannels:
    """Wavelengths of the columns of weights, from one wavelength or a spectrum, and the image channels."""

    def __init__(self, wavelength: float | None, spectrum: Spectrum | None):
        self._wavelength = wavelength
        self.spectrum = spectrum

    @property
    def light(self) -> Any:
        """Wavelength or spectrum of the light, as plain data."""
        return self._wavelength if self.spectrum is None else asdict(self.spectrum)

    @property
    def sums(self) -> int:
        """Number of sums of point spreads in an image: one for each distinct wavelength, or each node."""
        return 1 if self.spectrum is None else len(self.spectrum.computed)

    def mixing(self, columns: int) -> tuple[Numbers, Floats]:
        """Return each weight column's wavelength, and the matrix (channels, columns) from columns to channels."""
        if self.spectrum is None:
            return (cast(float, self._wavelength),) * columns, np.eye(columns, dtype=np.float32)
        return self.spectrum.wavelengths, self.spectrum.matrix()

    def parts(self, columns: int) -> Iterator[SpectralSum]:
        """Yield the sums that make an image, for `columns` columns of weights (the channels, without a spectrum)."""
        wavelengths, matrix = self.mixing(columns)
        if self.spectrum is None or not self.spectrum.nodes:
            for wavelength, some in groups(wavelengths):
                yield SpectralSum(wavelength, np.eye(len(wavelengths))[:, some], matrix[:, some])
            return
        channels, columns = matrix.shape
        for node, share in zip(self.spectrum.nodes, self.spectrum.shares(), strict=True):
            if channels <= columns:
                before = share[:, None] * matrix.T.astype(np.float64)
                yield SpectralSum(node, before, np.eye(channels, dtype=np.float32))
            else:
                yield SpectralSum(node, np.diag(share), matrix)

    def reduced_parts(self, weights: Doubles, accuracy: float) -> Iterator[SpectralSum]:
        """Yield the sums for weights (n, columns), simplified at nodes within an allowed error."""
        _, matrix = self.mixing(weights.shape[1])
        total = np.sqrt(np.square(weights @ matrix.T.astype(np.float64)).sum(0))
        # A tenth of the accuracy is for simplified spectra; 1e-6 is the rounding error of single precision.
        errors = max(0.1 * accuracy, 1e-6) / self.sums * total
        for spectral_sum in self.parts(weights.shape[1]):
            yield (
                spectral_sum.reduced(weights, errors)
                if self.spectrum is not None and self.spectrum.nodes
                else spectral_sum
            )

    def check_image(self, image: Any, shape: Shape, dtype: Any = np.float32) -> Array:
        """Return an image of shape (rows, columns, ...) as (rows, columns, channels); refuse other shapes."""
        rule = "it must be numbers, (rows, columns) or (rows, columns, channels)"
        pixels = as_array("image", image, dtype=dtype, rule=rule)
        rows, columns = shape
        refuse_if(
            pixels.ndim not in (2, 3) or pixels.shape[:2] != (rows, columns) or not np.isfinite(pixels).all(),
            f"image of shape {pixels.shape}: it must be finite and have {rows} rows, {columns} columns",
        )
        channels = pixels.reshape(rows, columns, -1)
        if self.spectrum is not None and channels.shape[2] != self.spectrum.channels:
            raise InputError(f"image of shape {pixels.shape}: the spectrum has {self.spectrum.channels} channels")
        return channels

    def check_weights(self, weights: Any, count: int) -> Doubles:
        """Return the weights of `count` points as an array (count, columns); refuse anything else."""
        rule = f"they must be numbers, ({count},) or ({count}, channels)"
        factors = as_array("weights", weights, POINTS, rule=rule)
        refuse_if(
            factors.ndim not in (1, 2) or len(factors) != count or (factors.ndim == 2 and factors.shape[1] == 0),
            f"weights of shape {factors.shape}: it must be ({count},) or ({count}, channels)",
        )
        require_all("weights", factors, np.isfinite(factors), "finite")
        wavelengths = 1 if self.spectrum is None else len(self.spectrum.wavelengths)
        if factors.ndim == 1:
            return np.repeat(factors[:, None], wavelengths, axis=1)
        if self.spectrum is not None and factors.shape[1] != wavelengths:
            raise InputError(f"weights of shape {factors.shape}: the spectrum has {wavelengths} wavelengths")
        return factors


class WavelengthPlans:
    """The plans of some points at each wavelength, computed on first use."""

    def __init__(
        self,
        make: Callable,
        camera: PlenopticCamera,
        points: Doubles,
        pupil_weights: PupilWeights | None,
        accuracy: float,
        systems: dict[float, OpticalSystem],
    ):
        self._make = make
        self._camera = camera
        self._systems = systems
        self._planned_for = points, pupil_weights, accuracy
        self._plans: dict[float, Any] = {}

    def made_by(self, make: Callable) -> WavelengthPlans:
        """Return the plans made by another function for the same points."""
        return WavelengthPlans(make, self._camera, *self._planned_for, self._systems)

    def system_at(self, wavelength: float) -> OpticalSystem:
        """Return the camera's optical system at a wavelength."""
        if wavelength not in self._systems:
            self._systems[wavelength] = OpticalSystem(self._camera.at_wavelength(wavelength), wavelength)
        return self._systems[wavelength]

    def at(self, wavelength: float) -> Any:
        """Return the plan of a wavelength."""
        if wavelength not in self._plans:
            self._plans[wavelength] = self._make(self.system_at(wavelength), *self._planned_for)
        return self._plans[wavelength]

    def checked(self, wavelength: float, job: Job, channels: int) -> Any:
        """Return the plan at a wavelength; refuse a plan that needs too much memory."""
        plan = self.at(wavelength)
        plan.check_memory(job.workers, channels)
        return plan


def mix(image: Array, matrix: Floats) -> Array:
    """Return an image (..., channels) with its channels mixed by a matrix (new channels, channels)."""
    return image if np.array_equal(matrix, np.eye(len(matrix))) else image @ matrix.T


def groups(wavelengths: Numbers) -> Iterator[tuple[float, list[int]]]:
    """Yield each distinct wavelength and its columns, which share point spreads."""
    for wavelength in dict.fromkeys(wavelengths):
        yield wavelength, [column for column, candidate in enumerate(wavelengths) if candidate == wavelength]
