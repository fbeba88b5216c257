"""Location of micro-images if only a white image of a camera is known."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy.ndimage

from ..errors import InputError, refuse_if
from ..runtime.backend import as_pixels
from .lens_grid import LensGrid, covering_grid, lattice_rows, reduced

# Side of the middle part of the image whose spectrum gives the first guess.
_CROP = 1024

# Peaks of the spectrum lower than this fraction of the highest are not taken for the lattice's.
_PEAK = 0.2

# A lattice's highest peak stands out from the median of the spectrum by far more than that of noise, about 5.
_CONTRAST = 20

# The fit grows from this many lenses about the middle, doubling, and is then repeated until it stands still.
_FIRST_REACH = 4
_REPEATS = 12

# Directions of rows through the lattice count as the same if they part by no more of a lens at the image's corners.
_SAME = 0.02

# Micro-images measured at once.
_BLOCK = 2048


def estimate_lens_grid(white: np.ndarray) -> LensGrid:
    """Return pitches, rotation and offset of a square, rectangular or hexagonal array, found in a white image.

    The spectrum of the image's middle gives the lattice to a fraction of a pixel per lens. From there the centroids
    of the micro-images are fitted by least squares, first about the middle, then further and further out. A hexagonal
    array may be stretched. After
    D. G. Dansereau, O. Pizarro and S. B. Williams, "Decoding, calibration and rectification for lenslet-based
    plenoptic cameras" (2013), who fit a grid to the local maxima.

    Parameters
    ----------
    white : (rows, columns[, channels]) array
        A picture of something evenly white. Micro-images must be brighter than the gaps between them.

    Returns
    -------
    LensGrid
        All lenses with a micro-image centred in the image, in whole rows and columns; a rotated lattice has some lenses
        beyond the image.

    Raises
    ------
    InputError
        If the array is not an image, or shows no lattice of at least 4 x 4 micro-images.
    """
    given = as_pixels("white", white)
    refuse_if(
        given.ndim not in (2, 3) or min(given.shape[:2]) < 16 or not given.size,
        f"white of shape {given.shape}: it must be an image, 16 x 16 or larger",
    )
    image = given.astype(np.float32, copy=False)
    if image.ndim == 3:
        image = image.mean(axis=2)
    vectors, origin = _guess(image)
    return covering_grid(image.shape, *_fit(image, origin, reduced(vectors)))


def _guess(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two lattice vectors (rows, in pixels) and one centre, read off the spectrum of the image's middle."""
    rows, columns = image.shape
    height, width = min(rows, _CROP), min(columns, _CROP)
    top, left = (rows - height) // 2, (columns - width) // 2
    part = image[top : top + height, left : left + width].astype(np.float64)
    window = np.hanning(height + 2)[1:-1, None] * np.hanning(width + 2)[1:-1]
    part = (part - (part * window).sum() / window.sum()) * window
    spectrum = np.abs(np.fft.fftshift(np.fft.fft2(part)))
    middle = np.array([height // 2, width // 2])
    down, across = (np.arange(n) - m for n, m in zip(spectrum.shape, middle, strict=True))
    # Slow changes of brightness over the image are not the lattice.
    spectrum[(np.abs(down)[:, None] <= 3) & (np.abs(across) <= 3)] = 0
    peak = (spectrum == scipy.ndimage.maximum_filter(spectrum, 5)) & (spectrum > _PEAK * spectrum.max())
    refuse_if(
        not spectrum.max() > _CONTRAST * np.median(spectrum), "white: no regular lattice of micro-images is seen in it"
    )
    # One of each pair of opposite peaks, away from the border, where a parabola has no room.
    half_plane = (down[:, None] > 0) | ((down[:, None] == 0) & (across > 0))
    peak[[0, -1]] = peak[:, [0, -1]] = False
    found = np.argwhere(peak & half_plane)
    frequencies = np.array([_refined(spectrum, position) - middle for position in found]).reshape(-1, 2)
    frequencies = frequencies[:, ::-1] / [width, height]
    frequencies = frequencies[np.argsort((frequencies**2).sum(1))]
    for second in frequencies[1:]:
        first = frequencies[0]
        if abs(first[0] * second[1] - first[1] * second[0]) > 0.5 * math.hypot(*first) * math.hypot(*second):
            break
    else:
        raise InputError("white: no regular lattice of micro-images is seen in it")
    chosen = np.stack([first, second])
    # The phase of a wave of the lattice is zero at a centre.
    x, y = np.arange(width) + left + 0.5, np.arange(height) + top + 0.5
    waves = [np.exp(-2j * math.pi * f[1] * y) @ part @ np.exp(-2j * math.pi * f[0] * x) for f in chosen]
    origin = np.linalg.solve(chosen, -np.angle(waves) / (2 * math.pi))
    vectors = np.linalg.inv(chosen).T
    # The centre nearest to the image's middle.
    steps = np.round(np.linalg.solve(vectors.T, np.array([columns, rows]) / 2 - origin))
    return vectors, origin + steps @ vectors


def _refined(spectrum: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the position of a peak between samples, by a parabola through logarithms."""
    result = position.astype(np.float64)
    for axis in (0, 1):
        step = np.eye(2, dtype=int)[axis]
        before, at, after = (math.log(max(spectrum[tuple(position + k * step)], 1e-300)) for k in (-1, 0, 1))
        bend = before - 2 * at + after
        result[axis] += 0.5 * (before - after) / bend if bend < 0 else 0
    return result


def _fit(image: np.ndarray, origin: np.ndarray, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return the lattice fitted to the micro-images' centroids, first about the middle and then everywhere."""
    size = np.array(image.shape[::-1])
    radius = min(math.hypot(*step) for step in (*vectors, vectors.sum(0))) / 2
    reach = _FIRST_REACH
    whole = math.ceil(math.hypot(*size) / (2 * radius))
    repeats = 0
    while repeats < _REPEATS:
        index = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
        centres = origin + index @ vectors
        inside = ((centres > radius + 1) & (centres < size - radius - 1)).all(1)
        refuse_if(inside.sum() < 16, f"white of shape {image.shape}: at least 4 x 4 whole micro-images are needed")
        index, centres = index[inside], centres[inside]
        # Of the light within a disc about each centre.
        of_blocks = (
            centroids(
                pixels_around(image, block, math.ceil(radius) + 1),
                block,
                lambda distance: (radius + 0.5 - distance).clip(0, 1),
            )
            for block in np.array_split(centres, -(-len(centres) // _BLOCK))
        )
        measured, light = (np.concatenate(parts) for parts in zip(*of_blocks, strict=True))
        used = light > 0.1 * np.median(light)
        moved = np.hypot(*(measured - centres).T)
        used &= moved < 3 * np.median(moved[used]) + 0.5
        origin, *new = np.linalg.lstsq(np.column_stack([np.ones(used.sum()), index[used]]), measured[used])[0]
        change = np.abs(new - vectors).max() * reach
        vectors = np.array(new)
        if reach < whole:
            reach = min(2 * reach, whole)
        else:
            repeats += 1
            if change < 1e-4:
                break
    refuse_if(np.median(moved[used]) > 0.2 * radius, "white: no regular lattice of micro-images is seen in it")
    rows, shifted = lattice_rows(vectors, _SAME / whole)
    steps = np.round(np.linalg.solve(rows.T, (index[used] @ vectors).T).T * 2) / 2
    return *_rows_at_right_angles(steps, measured[used]), shifted


def pixels_around(image: np.ndarray, centres: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the columns (n, k) and rows (n, k) of the pixels around each centre, and their values (n, k, k)."""
    window = np.arange(-half, half + 1)
    base = np.floor(centres).astype(np.int64)
    x, y = (base[:, axis, None] + window for axis in (0, 1))
    rows, columns = image.shape
    patch = image[y.clip(0, rows - 1)[:, :, None], x.clip(0, columns - 1)[:, None, :]]
    return x, y, patch.astype(np.float64, copy=False)


def centroids(
    patches: tuple[np.ndarray, np.ndarray, np.ndarray],
    centres: np.ndarray,
    weight_at: Callable[[np.ndarray], np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Return centroids of patches above their darkest pixels, weighted by distance, and their brightness."""
    x, y, patch = patches
    dx, dy = x + 0.5 - centres[:, 0, None], y + 0.5 - centres[:, 1, None]
    weight = weight_at(np.hypot(dx[:, None, :], dy[:, :, None]))
    lit = (patch - np.where(weight > 0, patch, np.inf).min(axis=(1, 2), keepdims=True)) * weight
    light = lit.sum(axis=(1, 2))
    shift = np.stack([(lit.sum(1) * dx).sum(1), (lit.sum(2) * dy).sum(1)], axis=1)
    return centres + shift / np.where(light > 0, light, 1)[:, None], light


def _rows_at_right_angles(steps: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return origin, rotation and spacings fitted to centres at given steps along and across the rows."""
    matrix = np.column_stack([np.ones(len(steps)), steps])
    origin, first, second = np.linalg.lstsq(matrix, measured)[0]
    # Both fitted steps determine the rotation, the one with the longer lever arm better.
    arms = (steps**2).sum(0) * [first @ first, second @ second]
    angles = np.array([math.atan2(first[1], first[0]), math.atan2(-second[0], second[1])])
    angle = float(arms @ angles / arms.sum())
    unit = np.array([math.cos(angle), math.sin(angle)])
    normal = np.array([-unit[1], unit[0]])
    return origin, np.array([unit * (first @ unit), normal * (second @ normal)])
