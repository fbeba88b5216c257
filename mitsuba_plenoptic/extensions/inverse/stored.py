"""The wave camera as a sparse matrix: point spreads are computed once and stored."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy

from ...camera import PlenopticCamera
from ...detector import SHARP
from ...errors import refuse_if, require_number
from ...optics import guards
from ...points import CaptureOperator, SpectralSum, mix
from ...runtime import Array, Doubles, Job, one_at_a_time, require_memory
from .spreads import FullFieldSpreads, PatchSpreads


class StoredOperator(CaptureOperator):
    """`CaptureOperator` that computes its point spreads once and stores them, one set per wavelength.

    `forward` and `adjoint` are then products with a sparse matrix, for any number of columns of weights or channels of
    an image. Point spreads are computed at the first product, by the executor of its `job`; checkpoints are not
    written. Derivatives by camera parameters compute the fields anew, as in `CaptureOperator`.

    Parameters
    ----------
    camera, points, **options
        As for `CaptureOperator`.
    budget : float
        Memory in GiB that the spreads may take, and twice that while they are computed. More is refused before any of
        them is computed.
    dtype : {"float32", "float64"}
        Type of the stored spreads and of the images. The spreads have the accuracy of single precision in both, but
        the products with "float64" are linear to double precision.

    Raises
    ------
    InputError
        If an input has a wrong shape or value, or at the first product, if the spreads take more memory than the
        budget.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> camera = mp.PlenopticCamera(detector_width=0.128, resolution=(64, 64))
    >>> points = [(0.0, 0.0, 236.0), (0.05, 0.02, 240.0)]
    >>> mp.StoredOperator(camera, points, wavelength=633).to_sparse().shape
    (4096, 2)
    """

    def __init__(
        self, camera: PlenopticCamera, points: Any, *, budget: float = 1.0, dtype: Any = "float32", **options: Any
    ):
        super().__init__(camera, points, **options)
        self._budget = require_number("budget", budget, positive=True)
        refuse_if(dtype not in ("float32", "float64"), f"dtype = {dtype!r}: it must be float32 or float64")
        self.dtype = np.dtype(dtype)
        self._matrices: dict[float, Any] = {}

    def _image(self, weights: Doubles, job: Job) -> Array:
        """Return the image (rows, columns, channels) of checked weights (n, columns)."""
        matrices = self._computed(job)
        _, matrix = self._channels.mixing(weights.shape[1])
        pixels = np.zeros((math.prod(self.camera.shape), len(matrix)), self.dtype)
        for spectral_sum in self._channels.parts(weights.shape[1]):
            pixels += mix(
                matrices[spectral_sum.wavelength] @ (weights @ spectral_sum.before).astype(self.dtype),
                spectral_sum.after,
            )
        return pixels.reshape(*self.camera.shape, -1)

    def _products(self, image: Array, parts: Iterator[SpectralSum], job: Job) -> Iterator[tuple[SpectralSum, Array]]:
        """Yield the products (n, k) of an image (rows, columns, channels) with the point spreads of each sum."""
        matrices = self._computed(job)
        pixels = image.reshape(-1, image.shape[2])
        for spectral_sum in parts:
            yield spectral_sum, matrices[spectral_sum.wavelength].T @ mix(pixels, spectral_sum.after.T)

    @one_at_a_time
    def to_sparse(self, *, job: Job | None = None) -> Any:
        """Return the operator as a sparse matrix between flat arrays.

        Parameters
        ----------
        job : Job, optional
            As for `forward`.

        Returns
        -------
        scipy.sparse.csc_array
            The matrix, (pixels, n). With a spectrum it is (pixels * channels, n * wavelengths): rows are the entries of
            an image (rows, columns, channels), columns those of weights (n, wavelengths). Changes of the matrix do not
            change the operator.

        Raises
        ------
        InputError
            If the spreads take more memory than the budget, or the matrix would need too much memory.
        """
        for name, sharp in SHARP.items():
            value = getattr(self.camera, name)
            refuse_if(value != sharp, f"{name} = {value}: matrices have the sharp spreads only; leave it out")
        matrices = self._computed(job)
        parts = list(self._channels.parts(1))
        mixed = [spectral_sum.after @ spectral_sum.before.T for spectral_sum in parts]
        entries = sum(
            matrices[spectral_sum.wavelength].nnz * mixture.size
            for spectral_sum, mixture in zip(parts, mixed, strict=True)
        )
        require_memory(2.0 * entries * (self.dtype.itemsize + 8), "sparse matrix of all channels and wavelengths")
        if len(parts) == mixed[0].size == 1:
            return matrices[parts[0].wavelength] * self.dtype.type(mixed[0].item())
        return sum(
            scipy.sparse.kron(matrices[spectral_sum.wavelength], mixture.astype(self.dtype), format="csc")
            for spectral_sum, mixture in zip(parts, mixed, strict=True)
        )

    @one_at_a_time
    def to_dense(self, *, job: Job | None = None) -> Array:
        """Return the operator as a dense matrix between flat arrays.

        Parameters
        ----------
        job : Job, optional
            As for `forward`.

        Returns
        -------
        array
            The entries of `to_sparse`.
        """
        wavelengths, matrix = self._channels.mixing(1)
        rows = math.prod(self.camera.shape) * len(matrix)
        columns = len(self.points) * len(wavelengths)
        require_memory(float(self.dtype.itemsize) * rows * columns, f"dense matrix of {rows} x {columns}")
        return self.to_sparse(job=job).toarray()

    def _computed(self, job: Job | None) -> dict[float, Any]:
        """Return the matrix (pixels, n) of each wavelength, computed on first use if all matrices fit the budget."""
        if self._matrices:
            return self._matrices
        job = job or Job()
        wavelengths = list(dict.fromkeys(spectral_sum.wavelength for spectral_sum in self._channels.parts(1)))
        plans = self._plans.made_by({"patch": PatchSpreads, "full_field": FullFieldSpreads}[self._method])
        entry = self.dtype.itemsize + 4
        count = len(self.points)
        needed = sum(plans.checked(wavelength, job, 1).pixels for wavelength in wavelengths) * entry / 2**30
        refuse_if(
            needed > self._budget,
            f"budget = {self._budget:g} GiB: the spreads of {count} points at {len(wavelengths)} "
            f"wavelength{'s' * (len(wavelengths) > 1)} take {needed:.3g} GiB; CaptureOperator stores none",
        )
        with guards.watch():
            self._matrices = {
                wavelength: self._matrix(plans.at(wavelength).spreads(job, done * count, len(wavelengths) * count))
                for done, wavelength in enumerate(wavelengths)
            }
        return self._matrices

    def _matrix(self, spreads: Any) -> Any:
        """Return a matrix (pixels, n) with point spreads as its columns."""
        index = np.arange(math.prod(self.camera.shape), dtype=np.int32).reshape(self.camera.shape)
        empty = np.zeros(0, np.int32), np.zeros(0, self.dtype)
        columns = [empty] * len(self.points)
        for spread in spreads:
            column = index[spread.window].ravel(), spread.pixels.ravel().astype(self.dtype, copy=False)
            for point in spread.points.tolist():
                columns[point] = column
        rows, values = (np.concatenate([column[k] for column in columns] or [empty[k]]) for k in (0, 1))
        starts = np.cumsum([0, *(len(column[0]) for column in columns)])
        return scipy.sparse.csc_array((values, rows, starts), shape=(index.size, len(columns)))
