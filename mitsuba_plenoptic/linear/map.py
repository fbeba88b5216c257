"""Linear maps between arrays, which are linear operators of SciPy between flat arrays."""

import math
from typing import Any

import numpy as np
from scipy.sparse.linalg import LinearOperator

from ..runtime import Array, Sizes


class LinearMap(LinearOperator):
    """A linear map from arrays of light to images, with its transpose: a `scipy.sparse.linalg.LinearOperator`.

    A subclass defines `forward` and `adjoint`. Between flat arrays SciPy's solvers take it, and PyLops; sums, products,
    ``@`` and ``.T`` are SciPy's.

    Parameters
    ----------
    source_shape : tuple of int
        Shape of the arrays that `forward` takes.
    image_shape : tuple of int
        Shape of the arrays that `adjoint` takes.
    dtype : dtype
        Type of the images.
    """

    def __init__(self, source_shape: Sizes, image_shape: Sizes, dtype: Any = np.float32):
        super().__init__(dtype, (math.prod(image_shape), math.prod(source_shape)))
        self.source_shape = source_shape
        self.image_shape = image_shape

    def forward(self, source: Any, /) -> Array:
        """Return the image of light."""
        raise NotImplementedError

    def adjoint(self, image: Any, /) -> Array:
        """Return the transpose of `forward`, applied to an image."""
        raise NotImplementedError

    def _matvec(self, source: Array) -> Array:
        return self.forward(source.reshape(self.source_shape)).ravel()

    def _rmatvec(self, image: Array) -> Array:
        return self.adjoint(image.reshape(self.image_shape)).ravel()
