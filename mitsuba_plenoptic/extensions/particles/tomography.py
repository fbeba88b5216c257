"""Volumes from captures by algebraic reconstruction, SMART or SIRT, over any operator that projects voxels and back."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...errors import refuse_if, require_choice, require_count, require_number, suggest_keywords
from ...io import Capture, Checkpoint, digest
from ...linear import LinearMap, Sirt, Smart, SolverState, StopRule, relative_residual, solve
from ...runtime import Progress, as_pixels
from .seeding import Window
from .voxels import VoxelGrid

_METHODS = {"mart": Smart, "sirt": Sirt}


@suggest_keywords
def reconstruct_volume(
    operator: LinearMap,
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
    operator : CaptureOperator, VoxelProjector, RayProjector or another `LinearMap`
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
        the ``residual`` after them (root mean square, over that of the image), and ``stopped``: iterations, noise or
        tolerance.
    """
    require_choice("method", method, _METHODS)
    iterations = require_count("iterations", iterations)
    relaxation = require_number("relaxation", relaxation, positive=True, maximum=2)
    tolerance = require_number("tolerance", tolerance, minimum=0, maximum=1)
    refuse_if(getattr(operator, "grid", grid) != grid, f"grid of shape {grid.shape}: it is not the operator's")
    pixels = capture
    if isinstance(capture, Capture):
        pixels = capture.image
        refuse_if(
            capture.camera != getattr(operator, "camera", capture.camera),
            "capture: its camera is not the operator's; give its image alone to reconstruct it with that",
        )
    image = np.maximum(as_pixels("capture", pixels, np.float64), 0)
    scale = math.sqrt(float((image**2).mean()))
    refuse_if(scale == 0, "capture: it is dark everywhere, so that there is nothing to reconstruct")
    aim = 0.0 if noise is None else require_number("noise", noise, positive=True) / scale
    steps = _METHODS[method](operator, image, relaxation)
    voxels = math.prod(grid.shape)
    refuse_if(steps.light.shape != (voxels,), f"grid of {voxels} voxels: the operator's differ")
    if isinstance(capture, Capture) and "window" in capture.metadata.get("particles", {}):
        window = Window(**capture.metadata["particles"]["window"])
        seen = window.seen(grid.points[:, 2], capture.camera)
        points = getattr(operator, "points", None)
        refuse_if(
            points is not None and not np.allclose(points[:, 2], seen, 1e-9),
            f"capture: it is through {window}; give the projector that window, or the operator its apparent points",
        )
    refuse_if(steps.light.max() <= 0, "grid: no light of its voxels reaches the detector")
    facts = {"method": method, "relaxation": relaxation, "grid": vars(grid), "image": digest(image)}
    solution = solve(
        steps,
        iterations=iterations,
        stop=StopRule(relative_residual, aim, 1, 1 - tolerance if tolerance else math.inf),
        state=SolverState.of(checkpoint.begin_arrays(**facts) or {} if checkpoint else {}, (voxels,)),
        save=(lambda state: checkpoint.save_arrays(state.arrays)) if checkpoint else None,
        progress=progress,
    )
    return grid.labelled(
        solution.values,
        method=method,
        iterations=solution.iterations,
        residual=relative_residual(image, solution.model),
        stopped=solution.stopped or "iterations",
    )
