r"""Kernels on the grid of pixels, and images of pixels made from the coefficients of rays in cells.

Rays are collected in cells, p across a pixel. The coefficients at each place of a cell in its pixel have a kernel on
the grid of pixels: the cells' kernel summed over a pixel. The products of a pixel's coefficients with the terms by
which kernels change with the direction of light (`oblique`) also have kernels; the direction is that of the pixel's
centre. All these kernels resemble each other, because a pixel does not distinguish where light lands in it. Responses
of pixels are therefore projected onto a few patterns, the principal components in random light (Jolliffe, "Principal
component analysis", section 3.5), and there is one image for each pattern. The first pattern is the response to uniform
light, which is exact; light of a response that the other patterns lack is added to the first, so that all light is
kept.
"""

import itertools
from collections.abc import Sequence

import numpy as np
import scipy

from ..runtime import Doubles, Floats, backend_of, on_cuda, single_threaded_blas
from .accuracy import USUAL
from .oblique import Oblique, moved


class PixelKernels:
    """Kernels of pixel images, and the computation of pixel images from coefficients, for one kind of lenses."""

    @single_threaded_blas()
    def __init__(
        self,
        # Kernels (values, k, k) of cells: those of the functions over a lens, and oblique ones.
        kernels: Doubles,
        oblique: Oblique,
        # Count of cells across a pixel.
        parts: int,
        # Changes (places, 2) of the direction cosines, over the largest, from a pixel's centre to those of its cells.
        steps: Doubles,
        # Order of the B-splines over cells by which rays are collected in addition to pixels; 0 for none.
        order: int,
        # Covariance of the values in random light, and the part of images of such light that may be missing.
        covariance: Doubles,
        tolerance: float,
        # Whether light that patterns lack is added to the first. Derivatives of kernels have hardly any light in sum.
        keeps_light: bool,
    ):
        by_place = _by_places(_sharpened(kernels, order), parts)
        responses = by_place.reshape(-1, by_place.shape[2] * by_place.shape[3])
        if parts == 1:
            patterns = responses
            factors = np.eye(len(responses))
        else:
            patterns = _patterns(by_place, covariance, tolerance)
            factors = responses @ patterns.T
            if keeps_light:
                factors[:, 0] += (responses - factors @ patterns).sum(1) / patterns[0].sum()
        self.kernels = patterns.reshape(-1, *by_place.shape[2:]).astype(np.float32)
        functions = len(kernels) - oblique.count
        factors = factors.reshape(*by_place.shape[:2], -1)
        # Oblique kernels are for sums of products of the functions' coefficients and terms.
        at_places = np.array([moved(step, oblique.degree)[1:] for step in steps])
        products = np.einsum(
            "rnt,rpk,pts,sj->jknp", oblique.factors, factors[functions:], at_places, oblique.basis, optimize=True
        )
        products = products.reshape(*products.shape[:2], -1)
        direct = np.moveaxis(factors[:functions], 2, 0).reshape(len(self.kernels), -1) + products[0]
        # Sums of coefficients whose products with a term matter: the principal components of their part of images.
        alike = USUAL.alike_cells + (1 - USUAL.alike_cells) * np.eye(by_place.shape[1])
        root = np.kron(_root(covariance[:functions, :functions]), _root(alike))
        decompositions = [np.linalg.svd(factor @ root, full_matrices=False)[:2] for factor in products[1:]]
        square = np.square([values for _, values in decompositions])
        least = np.argsort(square, axis=None)
        in_all = np.square(root.T @ factors[:functions].reshape(len(root), -1)).sum()
        missing = np.cumsum(square.flat[least]) <= (USUAL.missing_products * tolerance) ** 2 * in_all
        self._term, component = np.divmod(np.sort(least[~missing]), square.shape[1])
        of_sums = np.array([decompositions[k][0][:, column] for k, column in zip(self._term, component, strict=True)])
        of_sums = of_sums.reshape(-1, len(self.kernels))
        sums = np.einsum("rk,rkx->rx", of_sums, products[1 + self._term])
        # Factors (images and sums, places * functions), and factors (images, sums) of the products.
        both = np.concatenate([direct, sums]).reshape(-1, functions, by_place.shape[1])
        self._shape = by_place.shape[1], functions
        self._factors = np.moveaxis(both, 1, 2).reshape(len(both), -1).astype(np.float32)
        self._of_sums = of_sums.T.astype(np.float32)

    def combined(self, values: Floats, terms: Floats) -> Floats:
        """Return the images (n, pixels) made from coefficients (pixels, places, functions) of light of some directions.

        `terms` (terms, pixels) are the terms of the direction in which light meets the lenses.
        """
        asarray = backend_of(values).arrays.asarray
        count = len(self.kernels)
        both = asarray(self._factors) @ values.reshape(len(values), -1).T
        images = both[:count]
        sums = both[count:]
        if len(sums):
            sums *= terms[asarray(self._term)]
            images += asarray(self._of_sums) @ sums
        return images

    def turned(self, values: Floats, terms: Floats) -> Floats:
        """Return the part of the images that is proportional to the terms of direction; see `combined`."""
        asarray = backend_of(values).arrays.asarray
        sums = asarray(self._factors[len(self.kernels) :]) @ values.reshape(len(values), -1).T
        return asarray(asarray(self._of_sums) @ (terms[asarray(self._term)] * sums))

    @single_threaded_blas()
    def adjoint(self, images: Floats, terms: Floats) -> Floats:
        """Return the adjoint of `combined`, applied to images: coefficients (pixels, places, functions)."""
        both = np.concatenate([images, terms[self._term] * (self._of_sums.T @ images)])
        return (both.T @ self._factors).reshape(-1, *self._shape)

    @single_threaded_blas()
    def turned_adjoint(self, images: Floats, terms: Floats) -> Floats:
        """Return the adjoint of `turned`, applied to images: coefficients (pixels, places, functions)."""
        sums = terms[self._term] * (self._of_sums.T @ images)
        return (sums.T @ self._factors[len(self.kernels) :]).reshape(-1, *self._shape)

    def portions(self, ends: Sequence[int]) -> list[slice]:
        """Return slices of pixels, from one of the ends to the next, whose coefficients fit into caches or memory."""
        # 2**25 and 2**19: Count of coefficients that are combined at a time by a device, and by processors with caches.
        size = max(1, (2**25 if on_cuda() else 2**19) // max(self._factors.shape))
        return [
            slice(start, min(start + size, last))
            for first, last in itertools.pairwise(ends)
            for start in range(first, last, size)
        ]


def _root(covariance: Doubles) -> Doubles:
    """Return a matrix whose product with its transpose is a covariance."""
    values, vectors = np.linalg.eigh(covariance)
    return vectors * np.sqrt(np.maximum(values, 0))


def _patterns(kernels: Doubles, covariance: Doubles, tolerance: float) -> Doubles:
    """Return the fewest orthonormal patterns (n, pixels) that leave a part `tolerance` of images in random light.

    `kernels` have the shape (values, places, k, k), and `covariance` is the covariance of the values.
    """
    # Light that is the same for all cells of a pixel.
    even = kernels[0].sum(0).ravel()
    # Derivatives of kernels by the focal length of another kind of lenses are 0.
    first = (even / (np.linalg.norm(even) or 1.0))[None]
    # Of all light, that which differs from cell to cell needs the most patterns.
    random = np.tensordot(_root(covariance), kernels, (0, 0)).reshape(-1, even.size)
    in_all = np.square(random).sum()
    random -= (random @ first.T) @ first
    by_rows = len(random) < even.size
    removed, vectors = np.linalg.eigh(random @ random.T if by_rows else random.T @ random)
    needed = np.cumsum(np.maximum(removed, 0)) > tolerance**2 * in_all
    others = vectors[:, needed].T
    if by_rows:
        others = others @ random / np.sqrt(removed[needed])[:, None]
    return np.concatenate([first, others[::-1]])


def _sharpened(kernels: Doubles, order: int) -> Doubles:
    r"""Return kernels with spectra over :math:`\mathrm{sinc}^{order}`, the smoothing by a B-spline of this order."""
    if order == 0:
        return kernels
    wide = np.pad(kernels, [(0, 0), (USUAL.sharpened, USUAL.sharpened), (USUAL.sharpened, USUAL.sharpened)])
    rows, columns = wide.shape[1:]
    size = scipy.fft.next_fast_len(rows), scipy.fft.next_fast_len(columns, real=True)
    sharp = [
        np.sinc(frequency(n)) ** -order
        for n, frequency in zip(size, (scipy.fft.fftfreq, scipy.fft.rfftfreq), strict=True)
    ]
    spectra = scipy.fft.rfft2(wide, size) * (sharp[0][:, None] * sharp[1])
    sharpened = scipy.fft.irfft2(spectra, size)[:, :rows, :columns]
    return sharpened


def _by_places(kernels: Doubles, parts: int) -> Doubles:
    """Return cells' kernels summed over pixels, (values, places, k, k), for each place of a cell in its pixel."""
    count = kernels.shape[1] // 2
    reach = -(-count // parts)
    sums = np.zeros((len(kernels), parts, parts, 2 * reach + 1, 2 * reach + 1))
    wide = np.pad(kernels, [(0, 0), *[(reach * parts + parts - 1 - count,) * 2] * 2])
    extent = (2 * reach + 1) * parts
    for row, column in np.ndindex(parts, parts):
        top = parts - 1 - row
        left = parts - 1 - column
        shifted = wide[:, top : top + extent, left : left + extent]
        sums[:, row, column] = shifted.reshape(len(kernels), 2 * reach + 1, parts, 2 * reach + 1, parts).sum((2, 4))
    return sums.reshape(len(kernels), parts**2, 2 * reach + 1, 2 * reach + 1)
