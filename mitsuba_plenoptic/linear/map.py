"""Linear maps between arrays, which are linear operators of SciPy between flat arrays."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator

from ..errors import refuse_if


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

    def __init__(self, source_shape: tuple[int, ...], image_shape: tuple[int, ...], dtype: Any = np.float32) -> None:
        super().__init__(dtype, (math.prod(image_shape), math.prod(source_shape)))
        self.source_shape = source_shape
        self.image_shape = image_shape

    def forward(self, source: Any, /) -> NDArray[Any]:
        """Return the image of light."""
        raise NotImplementedError

    def adjoint(self, image: Any, /) -> NDArray[Any]:
        """Return the transpose of `forward`, applied to an image."""
        raise NotImplementedError

    def matvec(self, x: Any) -> Any:
        """Return the image of flat light, flat; light of another length is refused."""
        return super().matvec(self._checked(x))

    def matmat(self, X: Any) -> Any:
        """Return the images of several columns of flat light; columns of another length are refused."""
        return super().matmat(self._checked(X))

    def rmatvec(self, x: Any) -> Any:
        """Return the transpose's image of a flat image; one of another length is refused."""
        return self.T.matvec(x)

    def rmatmat(self, X: Any) -> Any:
        """Return the transpose's images of several columns of flat images; of another length they are refused."""
        return self.T.matmat(X)

    def _checked(self, flat: Any) -> NDArray[Any]:
        flat = np.asanyarray(flat)
        rule = f"it must have {self.shape[1]} numbers, those of shape {self.source_shape}"
        refuse_if(flat.shape[:1] != self.shape[1:], f"flat array of shape {flat.shape}: {rule}")
        return flat

    def _transpose(self) -> LinearMap:
        return _Transpose(self)

    def _matvec(self, source: NDArray[Any]) -> NDArray[Any]:
        return self.forward(source.reshape(self.source_shape)).ravel()

    def _rmatvec(self, image: NDArray[Any]) -> NDArray[Any]:
        return self.adjoint(image.reshape(self.image_shape)).ravel()


class _Transpose(LinearMap):
    """The transpose of a map, from images to arrays of light."""

    def __init__(self, direct: LinearMap) -> None:
        super().__init__(direct.image_shape, direct.source_shape, direct.dtype)
        self.forward = direct.adjoint  # type: ignore[method-assign]
        self.adjoint = direct.forward  # type: ignore[method-assign]
        self._matmat, self._rmatmat = direct._rmatmat, direct._matmat
