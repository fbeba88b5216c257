r"""Voxels onto pixels: by waves on points that share point spreads from lens to lens, and by rays.

Point spreads repeat from lens to lens of the array (see `points.accuracy`), but the voxels of a rectangular grid are
imaged to other places of the lenses in each plane, and hardly any two share one. So the point spread of a voxel is
interpolated between the four nearest of points that lie regularly on the lenses of the plane's image, by bilinear
weights W, and these share spreads: the operator is :math:`A W`, and its adjoint :math:`W^T A^T`.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from ...camera import PlenopticCamera, Use, require_support
from ...errors import refuse_if, require_accuracy, require_count, require_number, require_wavelength, suggest_keywords
from ...fields import OpticalSystem
from ...lenses import inverse_distance
from ...linear import LinearMap
from ...points import CaptureOperator
from ...runtime import POINTS, Doubles, Job, Progress, as_array, counted
from ..inverse.point_rays import PointRays
from ..inverse.stored import StoredOperator
from .seeding import ParticleVolume
from .voxels import VoxelGrid


@suggest_keywords
class VoxelProjector(LinearMap):
    """The image that a camera records of a volume's voxels by waves, as a linear function of their light.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    grid : VoxelGrid
        The voxels.
    wavelength : float
        Wavelength in nanometres.
    per_lens : int
        Points to a microlens along an axis between which point spreads are interpolated.
    accuracy : float
        Allowed relative error of the points' images, see `CaptureOperator`.
    budget : float, optional
        Memory in GiB in which all point spreads are stored, so that only the first product computes them. Default: they
        are computed in each product.

    Raises
    ------
    InputError
        If an argument is out of range, or a voxel is not beyond the focus of the main lens.

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
        per_lens: int = 4,
        accuracy: float = 0.1,
        budget: float | None = None,
    ) -> None:
        require_support(camera, Use.POINTS)
        wavelength = require_wavelength(wavelength)
        per_lens = require_count("per_lens", per_lens, maximum=32)
        ParticleVolume(grid.lower, grid.upper).before(camera)
        points = grid.points
        lens = OpticalSystem(camera, wavelength).waves_of(points)
        basis = np.array(camera.lattice.basis)
        steps = (lens.images(points) - np.array(camera.mla_offset)) @ np.linalg.inv(basis) * per_lens
        plane = np.repeat(np.arange(grid.shape[0]), len(points) // grid.shape[0])
        low = np.floor(steps).astype(np.int64)
        beyond = steps - low
        corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
        keys = [np.column_stack([plane, low + corner]) for corner in corners]
        weights = [np.abs(1 - corner - beyond).prod(1) for corner in corners]
        nodes, index = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
        voxels = np.tile(np.arange(len(points)), 4)
        entries = np.concatenate(weights), (index.reshape(-1), voxels)
        self._spread = scipy.sparse.csr_array(entries, shape=(len(nodes), len(points)))
        inverse = inverse_distance(lens, points.reshape(grid.shape[0], -1, 3)[:, 0])[nodes[:, 0]]
        # A little aside, so that points at the borders of lenses belong to one of them alike.
        places = (nodes[:, 1:] + 1e-6) / per_lens @ basis + np.array(camera.mla_offset)
        at = lens.points(places, inverse)
        accuracy = require_accuracy(accuracy)
        self.points: CaptureOperator = (
            CaptureOperator(camera, at, wavelength=wavelength, accuracy=accuracy)
            if budget is None
            else StoredOperator(camera, at, wavelength=wavelength, accuracy=accuracy, budget=budget)
        )
        super().__init__((len(points),), camera.shape)

    def forward(self, weights: ArrayLike, *, job: Job | None = None) -> NDArray[np.float32]:
        """Return the image (rows, columns) of voxels with the given light, (n,)."""
        return self.points.forward(self._spread @ as_array("weights", weights, np.float64, POINTS), job=job)

    def adjoint(self, image: ArrayLike, *, job: Job | None = None) -> Doubles:
        """Return each voxel's inner product with an image, (n,)."""
        return np.asarray(self._spread.T @ self.points.adjoint(image, job=job))


@suggest_keywords
class RayProjector(LinearMap):
    """The image that a camera records of a volume's voxels by rays, without diffraction, as a stored matrix.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    grid : VoxelGrid
        The voxels, each a point at its centre.
    wavelength : float
        Wavelength in nanometres.
    budget : float
        Memory in GiB that the matrix may take.
    progress : callable, optional
        Called with the numbers of voxels done and of all.

    Raises
    ------
    InputError
        If the budget is too small, an argument is out of range, or a voxel is not beyond the main lens's focus.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        grid: VoxelGrid,
        *,
        wavelength: float,
        budget: float = 4.0,
        progress: Progress | None = None,
    ) -> None:
        require_support(camera, Use.POINT_RAYS)
        wavelength = require_wavelength(wavelength)
        budget = require_number("budget", budget, positive=True)
        ParticleVolume(grid.lower, grid.upper).before(camera)
        system = OpticalSystem(camera, wavelength)
        points = grid.points
        pixels = []
        values = []
        size = 0
        for point in counted(np.split(points, len(points)), progress):
            spread = PointRays(camera, point, wavelength).image(system, np.ones(1)).ravel()
            pixels.append(np.flatnonzero(spread).astype(np.int32))
            values.append(spread[pixels[-1]].astype(np.float32))
            size += pixels[-1].nbytes + values[-1].nbytes
            # Joined, they take as much again.
            refuse_if(2 * size > budget * 2**30, f"budget = {budget:g} GiB: the matrix takes more; take fewer voxels")
        entries = np.concatenate(values), np.concatenate(pixels), np.cumsum([0, *map(len, pixels)])
        super().__init__((len(points),), camera.shape)
        self._matrix = scipy.sparse.csc_array(entries, shape=self.shape)

    def forward(self, weights: ArrayLike) -> NDArray[np.float32]:
        """Return the image (rows, columns) of voxels with the given light, (n,)."""
        return np.asarray(self._matrix @ as_array("weights", weights, np.float32, POINTS)).reshape(self.image_shape)

    def adjoint(self, image: ArrayLike) -> NDArray[np.float32]:
        """Return each voxel's inner product with an image, (n,)."""
        image = as_array("image", image, np.float32)
        refuse_if(image.shape != self.image_shape, f"image of shape {image.shape}: the camera has {self.image_shape}")
        return np.asarray(self._matrix.T @ image.ravel())
