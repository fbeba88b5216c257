r"""Volumes from captures by algebraic reconstruction, over any operator that projects voxels and back.

With the operator A, the image I and the light x of the voxels, the multiplicative algebraic reconstruction technique in
its simultaneous form (SMART: Darroch and Ratcliff 1972; for particles Atkinson and Soria 2009, Experiments in Fluids
47, 553) is

.. math:: x \leftarrow x \exp\left(\mu \frac{A^T \ln (I / A x)}{A^T 1}\right)

and the simultaneous iterative reconstruction technique (SIRT: Gilbert 1972, J. Theor. Biol. 36, 105)

.. math:: x \leftarrow \max\left(0, x + \mu \frac{A^T ((I - A x) / A 1)}{A^T 1}\right).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...errors import refuse_if, require_choice, require_count, require_number, suggest_keywords
from ...io import Capture, Checkpoint, digest
from ...runtime import Progress, as_array
from .voxels import VoxelGrid

METHODS = ("mart", "sirt")

_FLOOR = 1e-3
"""Least value of pixels and of their model, over the mean of the image, for MART's logarithm."""

_LEAST_SEEN = 1e-3
"""Light of a voxel on the detector, over that of the best one, below which it stays dark."""


class Projector(Protocol):
    """A linear map from the light of voxels to pixels, with its transpose, such as a `CaptureOperator`."""

    def forward(self, weights: NDArray[np.float64], /) -> NDArray[Any]:
        """Return the image of voxels."""

    def adjoint(self, image: NDArray[np.float32], /) -> NDArray[Any]:
        """Return each voxel's inner product with an image."""


@dataclass(frozen=True)
class Steps:
    """One step of either method."""

    operator: Projector
    image: NDArray[np.float64]
    seen: NDArray[np.float64]
    relaxation: float

    def mart(self, values: NDArray[np.float64], model: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values after a multiplicative step from values with a given image."""
        floor = _FLOOR * float(self.image.mean())
        ratio = np.log(np.maximum(self.image, floor) / np.maximum(model, floor))
        return np.asarray(values * np.exp(self.relaxation * self._averaged(ratio)))

    def sirt(self, values: NDArray[np.float64], model: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values after an additive step from values with a given image."""
        floor = _LEAST_SEEN * float(self.covered.max())
        error = np.where(self.covered > floor, self.image - model, 0) / np.maximum(self.covered, floor)
        return np.maximum(values + self.relaxation * self._averaged(error), 0)

    @cached_property
    def covered(self) -> NDArray[np.float64]:
        """Image of voxels that are all 1."""
        return np.asarray(self.operator.forward(np.ones(len(self.seen))), np.float64)

    def _averaged(self, image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mean of an image over each voxel's pixels, weighted by the voxel's light; 0 for unseen voxels."""
        lit = self.seen > _LEAST_SEEN * float(self.seen.max())
        return np.where(lit, self.operator.adjoint(image.astype(np.float32)), 0) / np.where(lit, self.seen, 1)


@suggest_keywords
def reconstruct_volume(
    operator: Projector,
    capture: Capture | NDArray[np.float32],
    grid: VoxelGrid,
    *,
    method: str = "mart",
    iterations: int = 40,
    relaxation: float = 1.0,
    noise: float | None = None,
    tolerance: float = 0.0,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> xr.DataArray:
    """Return the light of voxels that explains a capture.

    Parameters
    ----------
    operator : CaptureOperator or another projector
        The projection of the grid's voxels: ``CaptureOperator(camera, grid.points, wavelength=550, accuracy=0.05)``.
        An accuracy at which voxels share point spreads is enough for most images.
    capture : Capture or array
        The image.
    grid : VoxelGrid
        The voxels, in the order of the operator's points.
    method : {"mart", "sirt"}
        Multiplicative or additive steps.
    iterations : int
        Steps at most.
    relaxation : float
        Factor on the steps, above 0 and up to 2; MART converges with 1 at most.
    noise : float, optional
        Standard deviation of a pixel. Steps end where the residual is as large.
    tolerance : float
        Steps end where the residual falls by less than this part of itself. Default: they do not.
    progress : callable, optional
        Called with the numbers of steps done and of all.
    checkpoint : Checkpoint, optional
        What is done, to resume from it.

    Returns
    -------
    xarray.DataArray (z, y, x)
        The light of the voxels, with their centres in mm. The attributes are the ``method``, the ``iterations`` made,
        the ``residual`` after the last but one (root mean square, over that of the image), and ``stopped``:
        iterations, noise or tolerance.

    Raises
    ------
    InputError
        If the image is empty, not finite or has another shape, or an argument is out of range.
    """
    require_choice("method", method, METHODS)
    iterations = require_count("iterations", iterations)
    relaxation = require_number("relaxation", relaxation, positive=True, maximum=2)
    tolerance = require_number("tolerance", tolerance, minimum=0, maximum=1)
    image = as_array("capture", capture.image if isinstance(capture, Capture) else capture, np.float64)
    refuse_if(not np.isfinite(image).all(), "capture: its pixels must be finite")
    image = np.maximum(image, 0)
    scale = math.sqrt(float((image**2).mean()))
    refuse_if(scale == 0, "capture: it is dark everywhere, so that there is nothing to reconstruct")
    aim = 0.0 if noise is None else require_number("noise", noise, positive=True) / scale
    seen = np.asarray(operator.adjoint(np.ones(image.shape, np.float32)), np.float64)
    refuse_if(seen.shape != (math.prod(grid.shape),), f"grid of {math.prod(grid.shape)} voxels: the operator's differ")
    refuse_if(seen.max() <= 0, "grid: no light of its voxels reaches the detector")
    steps = Steps(operator, image, seen, relaxation)
    step = steps.mart if method == "mart" else steps.sirt
    facts = {"method": method, "relaxation": relaxation, "grid": vars(grid), "image": digest(image)}
    stored = checkpoint.begin_arrays(**facts) if checkpoint else None
    lit = seen > _LEAST_SEEN * float(seen.max())
    values, residuals = np.where(lit, image.sum() / seen[lit].sum(), 0.0), np.zeros(0)
    if stored:
        values, residuals = stored["values"], stored["residuals"]
    stopped = "iterations"
    while len(residuals) < iterations:
        if progress:
            progress(len(residuals), iterations)
        model = np.asarray(operator.forward(values), np.float64)
        residuals = np.append(residuals, math.sqrt(float(((image - model) ** 2).mean())) / scale)
        if residuals[-1] <= aim:
            stopped = "noise"
        elif tolerance and len(residuals) > 1 and residuals[-1] > (1 - tolerance) * residuals[-2]:
            stopped = "tolerance"
        if stopped != "iterations":
            break
        values = step(values, model)
        if checkpoint:
            checkpoint.save_arrays(partial(dict, values=values, residuals=residuals))
    if progress:
        progress(iterations, iterations)
    return grid.labelled(
        values, method=method, iterations=len(residuals), residual=float(residuals[-1]), stopped=stopped
    )
