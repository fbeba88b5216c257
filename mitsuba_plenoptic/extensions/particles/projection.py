r"""Voxels onto pixels: by waves on points that share point spreads from lens to lens, and by rays.

Point spreads repeat from lens to lens of the array (see `points.accuracy`), but the voxels of a rectangular grid are
imaged to other places of the lenses in each plane, and hardly any two share one. So the point spread of a voxel is
interpolated between the four nearest of points that lie regularly on the lenses of the plane's image, by bilinear
weights W, and these share spreads: the operator is :math:`A W`, and its adjoint :math:`W^T A^T`.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import scipy
from numpy.typing import ArrayLike

from ...camera import PlenopticCamera, Use, require_support
from ...errors import refuse_if, require_count, require_number, require_wavelength, suggest_keywords
from ...fields import OpticalSystem
from ...lenses import inverse_distance
from ...linear import LinearMap
from ...points import CaptureOperator
from ...runtime import POINTS, Doubles, Floats, Job, Progress, as_array, counted
from ..inverse.point_rays import PointRays
from ..inverse.stored import StoredOperator
from .seeding import Window
from .voxels import VoxelGrid


@suggest_keywords
class VoxelProjector(LinearMap):
    """The image that a camera records of a volume's voxels by waves, as a linear function of their light.

    Parameters
    ----------
    camera, grid : PlenopticCamera, VoxelGrid
        The camera, and voxels that it sees beyond the focus of its main lens.
    wavelength, window : float, Window, optional
        Wavelength in vacuum, in nanometres, and the window between the camera and the voxels.
    per_lens : int
        Points to a microlens along an axis between which point spreads are interpolated.
    accuracy : float
        Allowed relative error of the points' images, see `CaptureOperator`.
    budget : float, optional
        Memory in GiB in which all point spreads are stored, so that only the first product computes them. Default: they
        are computed in each product.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> from mitsuba_plenoptic import particles
    >>> camera = mp.PlenopticCamera(detector_width=0.256, resolution=(64, 64))
    >>> grid = particles.VoxelGrid((-0.1, -0.1, 238), (0.1, 0.1, 242), (2, 3, 3))
    >>> projector = particles.VoxelProjector(camera, grid, wavelength=550)
    >>> image = projector.forward([1.0] * 18)
    >>> image.shape, projector.adjoint(image).shape
    ((64, 64), (18,))
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        grid: VoxelGrid,
        *,
        wavelength: float,
        window: Window | None = None,
        per_lens: int = 4,
        accuracy: float = 0.1,
        budget: float | None = None,
    ):
        require_support(camera, Use.POINTS)
        wavelength = require_wavelength(wavelength)
        per_lens = require_count("per_lens", per_lens, maximum=32)
        window = window or Window()
        grid.before(camera, window)
        self.points = points = window.apparent(grid.points, camera, wavelength)
        lens = OpticalSystem(camera, wavelength).waves_of(points)
        basis = np.array(camera.lattice.basis)
        steps = (lens.images(points) - np.array(camera.mla_offset)) @ np.linalg.inv(basis) * per_lens
        plane = np.repeat(np.arange(grid.shape[0]), len(points) // grid.shape[0])
        low = np.floor(steps).astype(np.int64)
        corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])[:, None]
        weights = np.abs(1 - corners - (steps - low)).prod(-1).ravel()
        keys = np.column_stack([np.tile(plane, 4), (low + corners).reshape(-1, 2)])
        nodes, index = np.unique(keys, axis=0, return_inverse=True)
        entries = weights, (index.reshape(-1), np.tile(np.arange(len(points)), 4))
        self._spread = scipy.sparse.csr_array(entries, shape=(len(nodes), len(points)))
        inverse = inverse_distance(lens, points.reshape(grid.shape[0], -1, 3)[:, 0])[nodes[:, 0]]
        # A little aside, so that points at the borders of lenses belong to one of them alike.
        places = (nodes[:, 1:] + 1e-6) / per_lens @ basis + np.array(camera.mla_offset)
        at = lens.points(places, inverse)
        kind = CaptureOperator if budget is None else partial(StoredOperator, budget=budget)
        self.operator = kind(camera, at, wavelength=wavelength, accuracy=accuracy)
        super().__init__((len(points),), camera.shape)
        self.camera = camera
        self.grid = grid

    def forward(self, weights: ArrayLike, *, job: Job | None = None) -> Floats:
        """Return the image (rows, columns) of voxels with the given light, (n,)."""
        return self.operator.forward(self._spread @ as_array("weights", weights, POINTS), job=job)

    def adjoint(self, image: ArrayLike, *, job: Job | None = None) -> Doubles:
        """Return each voxel's inner product with an image, (n,)."""
        return self._spread.T @ self.operator.adjoint(image, job=job)


@suggest_keywords
class RayProjector(LinearMap):
    """The image that a camera records of a volume's voxels by rays, without diffraction, as a stored matrix.

    Parameters
    ----------
    camera, grid : PlenopticCamera, VoxelGrid
        The camera, and voxels that it sees beyond the focus of its main lens, each a point at its centre.
    wavelength, window : float, Window, optional
        Wavelength in vacuum, in nanometres, and the window between the camera and the voxels.
    budget : float
        Memory in GiB that the matrix may take.
    progress : callable, optional
        Called with the numbers of voxels done and of all.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        grid: VoxelGrid,
        *,
        wavelength: float,
        window: Window | None = None,
        budget: float = 4.0,
        progress: Progress | None = None,
    ):
        require_support(camera, Use.POINT_RAYS)
        wavelength = require_wavelength(wavelength)
        budget = require_number("budget", budget, positive=True)
        window = window or Window()
        grid.before(camera, window)
        system = OpticalSystem(camera, wavelength)
        self.points = points = window.apparent(grid.points, camera, wavelength)
        columns = []
        entries = 0
        for point in counted(np.split(points, len(points)), progress):
            spread = PointRays(camera, point, wavelength).image(system, np.ones(1)).astype(np.float32)
            columns.append(scipy.sparse.csc_array(spread.reshape(-1, 1)))
            entries += columns[-1].nnz
            # Of 8 bytes each; joined, they take as much again.
            refuse_if(
                16 * entries > budget * 2**30, f"budget = {budget:g} GiB: the matrix takes more; take fewer voxels"
            )
        super().__init__((len(points),), camera.shape)
        self.camera = camera
        self.grid = grid
        self._matrix = scipy.sparse.hstack(columns, format="csc")

    def forward(self, weights: ArrayLike) -> Floats:
        """Return the image (rows, columns) of voxels with the given light, (n,)."""
        weights = as_array("weights", weights, POINTS, dtype=np.float32, shape=self._matrix.shape[1:])
        return (self._matrix @ weights).reshape(self.image_shape)

    def adjoint(self, image: ArrayLike) -> Floats:
        """Return each voxel's inner product with an image, (n,)."""
        image = as_array("image", image, dtype=np.float32, shape=self.image_shape)
        return self._matrix.T @ image.ravel()
