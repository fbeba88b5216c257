r"""Corners of checkerboards to a fraction of a pixel, in many small pictures at once.

About its corner a blurred checkerboard is

.. math:: I(x) = A + B\, \mathrm{erf}\frac{n_1 \cdot (x - p)}{\sigma}\, \mathrm{erf}\frac{n_2 \cdot (x - p)}{\sigma}

with the normals n of both edges: exact for a Gaussian blur and edges at right angles, and for any blur that half a turn
leaves as it is the corner p is met, since the formula and the picture then have the same point of symmetry. All seven
numbers are fitted by least squares (Levenberg and Marquardt).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import erf

_STEPS = 12
_BLOCK = 2048

# Blur in pixels that a fit starts with, and that it stays within.
_BLUR = 1.2
_LEAST_BLUR, _MOST_BLUR = 0.3, 6.0

# Radius of the window about a corner: so many pixels at least, and this fraction of the micro-image's radius at most.
_LEAST_WINDOW, _WINDOW = 2.0, 0.6

# A corner moves by no more than this from where it was looked for, in pixels.
_FARTHEST = 3.0


@dataclass(frozen=True)
class Saddles:
    """What was found about each place: arrays of one row each."""

    # Column and row; the centre of the first pixel is 0; (n, 2).
    place: np.ndarray
    # Standard deviation of the place along its worse direction, from what the fit leaves; (n,).
    deviation: np.ndarray
    # Half the difference between light and dark squares; (n,).
    contrast: np.ndarray
    # Radius of the blur, 1.4 of its standard deviations; (n,).
    blur: np.ndarray


def find_saddles(
    image: np.ndarray,
    weight: np.ndarray,
    place: np.ndarray,
    angles: np.ndarray,
    centre: np.ndarray,
    *,
    radius: float,
    even: float,
    seen: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Saddles:
    """Refine corners, each within a window of its micro-image.

    Shapes: `image`, `weight` (rows, columns), `place` (n, 2), `angles` (n, 2), `centre` (n, 2).
    """
    blocks = np.array_split(np.arange(len(place)), max(1, -(-len(place) // _BLOCK)))
    parts = []
    for rows in blocks:
        shift = None if seen is None else partial(seen, rows)
        parts.append(_fit(image, weight, place[rows], angles[rows], centre[rows], radius, even, shift))
    return Saddles(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _fit(
    image: np.ndarray,
    weight: np.ndarray,
    place: np.ndarray,
    angles: np.ndarray,
    centre: np.ndarray,
    radius: float,
    even: float,
    seen: Callable[[np.ndarray], np.ndarray] | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    n = len(place)
    # Cut off at the rim of the micro-image alone, a window would draw the corner to one side.
    reach = (radius - np.hypot(*(place - centre).T)).clip(_LEAST_WINDOW, _WINDOW * radius)[:, None]
    half = int(np.ceil(_WINDOW * radius))
    steps = np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 2), axis=-1).reshape(-1, 2)
    pixel = np.round(place).astype(int)[:, None] + steps
    x, y = (pixel[:, :, axis].clip(0, image.shape[1 - axis] - 1) for axis in (0, 1))
    arm = pixel - centre[:, None]
    shown = pixel if seen is None else pixel + seen(arm)
    # A window with a soft rim that is symmetrical about the corner, without what is beyond the evenly lit part.
    distance = np.hypot(*np.moveaxis(shown - place[:, None], 2, 0))
    w = weight[y, x] * (reach + 0.5 - distance).clip(0, 1)
    w *= np.hypot(*np.moveaxis(arm, 2, 0)) < even
    w *= (pixel == np.stack([x, y], axis=-1)).all(2)
    value = image[y, x]
    enough = w.sum(1) > 12
    p = np.concatenate([place, angles, np.full((n, 1), np.log(_BLUR))], axis=1)
    p, linear, square, information = _descend(shown, value, w, p, place)
    degrees = np.maximum(w.sum(1) - 7, 1)
    covariance = np.linalg.pinv(information[:, :2, :2]) * (square / degrees)[:, None, None]
    deviation = np.sqrt(np.linalg.eigvalsh(covariance)[:, 1].clip(0))
    deviation = np.where(enough & (np.hypot(*(p[:, :2] - place).T) < _FARTHEST), deviation, np.inf)
    return p[:, :2], deviation, np.abs(linear[:, 1]), np.exp(p[:, 4])


def _descend(
    pixel: np.ndarray, value: np.ndarray, w: np.ndarray, p: np.ndarray, place: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Minimise over place, angles and blur; level and contrast follow from them at each step (variable projection)."""
    linear, square, jacobian, left = _model(pixel, value, w, p)
    damping = np.full(len(p), 1e-2)
    low, high = np.log([_LEAST_BLUR, _MOST_BLUR])
    for _ in range(_STEPS):
        matrix = np.einsum("npa,np,npb->nab", jacobian, w, jacobian, optimize=True)
        slope = np.einsum("npa,np,np->na", jacobian, w, left, optimize=True)
        scale = np.einsum("naa->na", matrix) + 1e-12
        damped = matrix + (damping[:, None] * scale)[:, :, None] * np.eye(5)
        step = np.linalg.solve(damped, slope[:, :, None])[:, :, 0]
        new = p + step.clip(-1, 1)
        new[:, :2] = place + (new[:, :2] - place).clip(-_FARTHEST, _FARTHEST)
        new[:, 4] = new[:, 4].clip(low, high)
        tried = _model(pixel, value, w, new)
        better = tried[1] < square
        p = np.where(better[:, None], new, p)
        damping = np.where(better, damping / 5, damping * 5).clip(1e-6, 1e6)
        linear = np.where(better[:, None], tried[0], linear)
        square = np.where(better, tried[1], square)
        jacobian = np.where(better[:, None, None], tried[2], jacobian)
        left = np.where(better[:, None], tried[3], left)
    information = np.einsum("npa,np,npb->nab", jacobian, w, jacobian, optimize=True)
    return p, linear, square, information


def _model(
    pixel: np.ndarray, value: np.ndarray, w: np.ndarray, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return level and contrast, the weighted sum of squares, derivatives by the numbers p, and what is left."""
    arm = pixel - p[:, None, :2]
    blur = np.exp(p[:, 4])[:, None]
    edges = []
    for angle in (p[:, 2, None], p[:, 3, None]):
        cosine, sine = np.cos(angle), np.sin(angle)
        t = (cosine * arm[:, :, 1] - sine * arm[:, :, 0]) / blur
        # By t; by the angle; along both axes.
        edges.append((erf(t), 2 / np.sqrt(np.pi) * np.exp(-t * t), t, arm, cosine, sine))
    product = edges[0][0] * edges[1][0]
    weights = w.sum(1) + 1e-30
    mean, mean_value = (w * product).sum(1) / weights, (w * value).sum(1) / weights
    about = product - mean[:, None]
    contrast = (w * about * value).sum(1) / ((w * about * about).sum(1) + 1e-30)
    level = mean_value - contrast * mean
    left = value - level[:, None] - contrast[:, None] * product
    jacobian = np.zeros((*product.shape, 5))
    for own, (other, (_, bell, t, _, cosine, sine)) in enumerate(zip(edges[::-1], edges, strict=True)):
        by_t = contrast[:, None] * bell * other[0]
        jacobian[:, :, 0] += by_t * sine / blur
        jacobian[:, :, 1] -= by_t * cosine / blur
        jacobian[:, :, 2 + own] = by_t * -(sine * arm[:, :, 1] + cosine * arm[:, :, 0]) / blur
        jacobian[:, :, 4] -= by_t * t
    # What level and contrast make up for is no information.
    for base in (np.ones_like(product), about):
        part = np.einsum("np,np,npa->na", w, base, jacobian) / ((w * base * base).sum(1) + 1e-30)[:, None]
        jacobian -= base[:, :, None] * part[:, None]
    return np.stack([level, contrast], axis=-1), (w * left * left).sum(1), jacobian, left
