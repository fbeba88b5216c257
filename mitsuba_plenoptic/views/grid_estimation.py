"""Location of micro-images if only a white image of a camera is known."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import scipy.ndimage

from ..array import Lattice
from ..errors import refuse_if
from ..runtime import Array, Pair, Triple, as_pixels, exponents, monomials, single_threaded_blas
from .grid import LensGrid, covering_grid, lattice_rows, reduced

# Part of a step by which a wave may miss a wave of a lattice.
_HELD = 0.1

# Bins along the cell of a lattice that the image's middle is laid over.
_CELL = 24

NO_LATTICE = "white: no regular lattice of micro-images is seen in it"


@single_threaded_blas()
def estimate_lens_grid(white: Array, like: Lattice | None = None) -> LensGrid:
    """Return pitches, rotation and offset of a square, rectangular or hexagonal array, found in a white image.

    The spectrum of the image's middle gives the lattice to a fraction of a pixel per lens. From there the middles
    of the micro-images are fitted by least squares, first about the middle, then further and further out. A hexagonal
    array may be stretched. After
    D. G. Dansereau, O. Pizarro and S. B. Williams, "Decoding, calibration and rectification for lenslet-based
    plenoptic cameras" (2013), who fit a grid to the local maxima.

    Parameters
    ----------
    white : (rows, columns[, channels]) array
        A picture of something evenly white. Micro-images must be brighter than the gaps between them.
    like : Lattice, optional
        Lattice whose rows the grid's are to follow. Default: rows are nearest to horizontal.

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
    pixels = as_pixels("white", white)
    refuse_if(
        pixels.ndim not in (2, 3) or min(pixels.shape[:2]) < 16 or not pixels.size,
        f"white of shape {pixels.shape}: it must be an image, 16 x 16 or larger",
    )
    image = pixels.astype(np.float32, copy=False)
    if image.ndim == 3:
        image = image.mean(axis=2)
    vectors, origin = _guess(image)
    return covering_grid(image.shape, *_fit(image, origin, reduced(vectors), like))


def _guess(image: Array) -> Pair:
    """Return two lattice vectors (rows, in pixels) and one centre: the lattice whose discs explain the image best.

    Where micro-images overlap, waves of the lattice vanish from the spectrum, the fundamental one at 1.22 pitches of a
    square array. So lattices are spanned by sums and differences of the highest peaks, too, and are tried.
    """
    central, _ = _middle(image, 1024)
    height, width = central.shape
    window = np.hanning(height + 2)[1:-1, None] * np.hanning(width + 2)[1:-1]
    spectrum = np.abs(np.fft.fftshift(np.fft.fft2((central - (central * window).sum() / window.sum()) * window)))
    middle = np.array([height // 2, width // 2])
    down, across = (np.arange(n) - m for n, m in zip(spectrum.shape, middle, strict=True))
    # Slow changes of brightness over the image are not the lattice.
    spectrum[(np.abs(down)[:, None] <= 3) & (np.abs(across) <= 3)] = 0
    noise = np.median(spectrum)
    # A lattice's highest peak stands out from the median of the spectrum by far more than that of noise, about 5.
    refuse_if(not spectrum.max() > 20 * noise, NO_LATTICE)
    peak = (spectrum == scipy.ndimage.maximum_filter(spectrum, 7)) & (spectrum > 6 * noise)
    # One of each pair of opposite peaks, away from the border, where a parabola has no room.
    peak &= (down[:, None] > 0) | ((down[:, None] == 0) & (across > 0))
    peak[[0, -1]] = peak[:, [0, -1]] = False
    highest = sorted(np.argwhere(peak), key=lambda index: -spectrum[tuple(index)])[:8]
    waves = np.array([(_refined(spectrum, index) - middle)[::-1] / [width, height] for index in highest])
    refuse_if(len(waves) < 2, NO_LATTICE)
    first, second = np.array(list(itertools.combinations(waves, 2))).swapaxes(0, 1)
    pairs = np.array(list(itertools.combinations(np.concatenate([waves, first + second, first - second]), 2)))
    # Cells that are neither too flat nor too small, and at least four along the image; the smallest come first.
    density = np.abs(np.linalg.det(pairs))
    oblique = density > 0.3 * np.hypot(*pairs[:, 0].T) * np.hypot(*pairs[:, 1].T)
    pairs = pairs[oblique & (density < 1 / 6) & (density > 16 / (height * width))]
    pairs = pairs[np.argsort(-np.abs(np.linalg.det(pairs)))]
    # They hold most of what is seen of the lattice.
    steps = waves @ np.linalg.inv(pairs)
    power = [spectrum[tuple(index)] ** 2 for index in highest]
    explains = (np.abs(steps - steps.round()).max(2) < _HELD) @ power > 0.5 * np.sum(power)
    tried: list[Array] = []
    for vectors in np.linalg.inv(pairs[explains]).swapaxes(1, 2):
        # The same lattice has other vectors, which are whole sums of these.
        sums = [vectors @ np.linalg.inv(earlier) for earlier in tried]
        if not any(
            np.abs(candidate - candidate.round()).max() < _HELD and abs(np.linalg.det(candidate)) < 1.5
            for candidate in sums
        ):
            tried.append(reduced(vectors))
        if len(tried) == 12:
            break
    refuse_if(not tried, NO_LATTICE)
    best, vectors = max(
        ((Discs.of(image, candidate), candidate) for candidate in tried), key=lambda pair: pair[0].explained
    )
    return vectors, best.centre


@dataclass(frozen=True)
class Discs:
    """Lattice of evenly bright discs that explains an image best, for given lattice vectors.

    Where discs overlap, their light adds.

    Attributes
    ----------
    explained : float
        Variance of the image's middle that the discs explain.
    centre : (2,) array
        The centre nearest to the image's middle, to a few per cent of the pitch.
    radius, pitch : float
        Radius of the discs, and distance of the nearest centres, in pixels.
    vectors : (2, 2) array
        The lattice vectors in pixels.
    size : (2,) array
        Columns and rows of the image.
    """

    explained: float
    centre: Array
    radius: float
    pitch: float
    vectors: Array
    size: Array

    @classmethod
    def of(cls, image: Array, vectors: Array) -> Discs:
        """Return the discs that explain the mean of an image's cells best."""
        central, start = _middle(image, 384)
        rows, columns = central.shape
        inverse = np.linalg.inv(vectors)
        y = (np.arange(rows) + start[1] + 0.5)[:, None]
        x = np.arange(columns) + start[0] + 0.5
        u, v = (np.floor((x * inverse[0, k] + y * inverse[1, k]) % 1 * _CELL).astype(int) % _CELL for k in (0, 1))
        cell = (u * _CELL + v).ravel()
        size = (_CELL, _CELL)
        count = np.bincount(cell, minlength=_CELL**2).reshape(size)
        light = np.bincount(cell, (central - central.mean()).ravel(), _CELL**2).reshape(size)
        steps = np.arange(_CELL) / _CELL
        cell_point = steps[:, None, None] * vectors[0] + steps[:, None] * vectors[1]
        around = np.mgrid[-1:3, -1:3].reshape(2, -1).T @ vectors
        distance = np.hypot(*np.moveaxis(cell_point - around[:, None, None], -1, 0))
        pitch = min(math.hypot(*step) for step in (*vectors, vectors.sum(0), vectors[0] - vectors[1]))
        radii = np.arange(0.1, 1.42, 0.05) * pitch / 2
        discs = (radii[:, None, None, None] + 0.5 - distance).clip(0, 1).sum(1)
        # Sums over all displacements of the discs at once.
        counts = np.fft.rfft2(count)
        lights = np.fft.rfft2(light)
        even, square = (np.fft.rfft2(values).conj() for values in (discs, discs**2))
        common, sums, squares = (
            np.fft.irfft2(spectrum, size) for spectrum in (lights * even, counts * even, counts * square)
        )
        power = np.maximum(squares - sums**2 / central.size, 1e-6 * central.size)
        explained = common.clip(0) ** 2 / power / central.size
        best = np.unravel_index(explained.argmax(), explained.shape)
        first = (np.array(best[1:]) + 0.5) / _CELL
        image_size = np.array(image.shape[::-1])
        centre = (first + np.round(image_size / 2 @ inverse - first)) @ vectors
        return cls(float(explained[best]), centre, float(radii[best[0]]), pitch, vectors, image_size)

    @property
    def reach(self) -> int:
        """Pixels on each side of a centre that `measured` looks at, a pixel aside."""
        return math.ceil(max(self.radius + self._rim, self.pitch / 2)) + 1

    @property
    def _rim(self) -> float:
        return max(0.1 * self.pitch, 2.5)

    def measured(self, patches: Triple, centres: Array) -> Pair:
        """Return the middles of micro-images about centres, and their brightness.

        Brightness that rises over a micro-image displaces its centroid. Where light I has risen by g u at u, and its
        middle lies at e, a round window w has the moment sum(w u I) = g (B - A / 12) + e A with A the sum of
        (w + |u| w' / 2) I, B that of w u^2 I / 2; a pixel, of variance 1/12 along each axis, blurs what has risen. Two
        windows, the rim and what lies within, give g, which is smooth over the picture.
        """
        x, y, patch = patches
        dx = (x + 0.5 - centres[:, 0, None])[:, None, :]
        dy = (y + 0.5 - centres[:, 1, None])[:, :, None]
        distance = np.hypot(dx, dy)
        # Where the image's border cuts one side, the other does not count either.
        room = np.minimum(centres, self.size - centres)[:, :, None, None]
        counts = (room[:, 0] - abs(dx)).clip(0, 1) * (room[:, 1] - abs(dy)).clip(0, 1)
        # To a few per cent of the radius.
        if self.radius < 0.51 * self.pitch:
            # What is nearer to another centre is another's light.
            for step in (*self.vectors, self.vectors.sum(0), self.vectors[0] - self.vectors[1]):
                length = math.hypot(*step)
                counts *= (length / 2 + 0.5 - abs(dx * step[0] + dy * step[1]) / length).clip(0, 1)
            # The darkest pixel is too dark in noise.
            dark = int(0.03 * abs(np.linalg.det(self.vectors)))
            cell = np.where(counts > 0, patch, np.inf).reshape(len(patch), -1)
            patch = patch - np.partition(cell, dark)[:, dark, None, None]
        light = ((self.pitch / 2 + 0.5 - distance).clip(0, 1) * patch).sum((1, 2))
        sums = []
        for edge in (max(self.radius - self._rim, 0.0), self.radius):
            phase = 0.5 * np.pi * ((distance - edge) / self._rim).clip(0, 1)
            seen = np.cos(phase) ** 2 * counts * patch
            falls = 0.5 * np.pi / self._rim * np.sin(2 * phase) * counts * patch
            moved = (seen - distance * falls / 2).sum((1, 2))
            risen = (seen * distance**2).sum((1, 2)) / 2 - moved / 12
            sums.append((np.stack([(seen * dx).sum((1, 2)), (seen * dy).sum((1, 2))]), risen, moved))
        inner, inner_risen, inner_moved = sums[0]
        rim, risen, moved = (beyond - within for within, beyond in zip(*sums, strict=True))
        # Of fifth degree over the micro-images.
        column, row = ((centres - centres.mean(0)) / self.size).T
        terms = np.array(monomials(column, row, exponents(5)))
        # Lenses that the main lens leaves dark have no middle.
        lit = moved > 0.01 * np.median(moved)
        moved = np.where(lit, moved, 1.0)
        rows = terms * (inner_risen - inner_moved * risen / moved) * lit
        rise = terms.T @ np.linalg.lstsq(rows.T, ((inner - inner_moved * rim / moved) * lit).T)[0]
        shift = (rim.T - rise * risen[:, None]) / moved[:, None] * lit[:, None]
        return centres + shift.clip(-1, 1), light


def _middle(image: Array, side: int) -> Pair:
    """Return an image's middle of at most side x side pixels, and its first column and row."""
    size = np.minimum(image.shape[::-1], side)
    left, top = start = (np.array(image.shape[::-1]) - size) // 2
    return image[top : top + size[1], left : left + size[0]].astype(np.float64), start


def _refined(spectrum: Array, position: Array) -> Array:
    """Return the position of a peak between samples, by a parabola through logarithms."""
    result = position.astype(np.float64)
    for axis in (0, 1):
        step = np.eye(2, dtype=int)[axis]
        before, at, after = (math.log(max(spectrum[tuple(position + k * step)], 1e-300)) for k in (-1, 0, 1))
        bend = before - 2 * at + after
        result[axis] += 0.5 * (before - after) / bend if bend < 0 else 0
    return result


def _fit(image: Array, origin: Array, vectors: Array, like: Lattice | None) -> tuple[Array, Array, bool]:
    """Return the lattice fitted to the micro-images' middles, first about the middle and then everywhere."""
    size = np.array(image.shape[::-1])
    discs = Discs.of(image, vectors)
    radius = discs.pitch / 2
    # The fit grows from this many lenses about the middle, doubling, and is then repeated until it stands still.
    reach = 4
    farthest = math.ceil(math.hypot(*size) / (2 * radius))
    repeats = 0
    while repeats < 12:
        index = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1).T
        centres = origin + index @ vectors
        inside = ((centres > radius + 1) & (centres < size - radius - 1)).all(1)
        refuse_if(inside.sum() < 16, f"white of shape {image.shape}: at least 4 x 4 whole micro-images are needed")
        index = index[inside]
        centres = centres[inside]
        # Of the light within a disc about each centre.
        blocks = np.array_split(centres, -(-len(centres) // 2048))
        of_blocks = (discs.measured(pixels_around(image, block, discs.reach), block) for block in blocks)
        measured, light = (np.concatenate(parts) for parts in zip(*of_blocks, strict=True))
        clear = light > 0.1 * np.median(light)
        moved = np.hypot(*(measured - centres).T)
        clear &= moved < 3 * np.median(moved[clear]) + 0.5
        origin, *new = np.linalg.lstsq(np.column_stack([np.ones(clear.sum()), index[clear]]), measured[clear])[0]
        change = np.abs(new - vectors).max() * reach
        vectors = np.array(new)
        if reach < farthest:
            reach = min(2 * reach, farthest)
        else:
            repeats += 1
            if change < 1e-4:
                break
    refuse_if(np.median(moved[clear]) > 0.2 * radius, NO_LATTICE)
    # Directions of rows through the lattice count as the same if they part by no more of a lens at the image's corners.
    rows, shifted = lattice_rows(vectors, 0.02 / farthest, like)
    steps = np.round(np.linalg.solve(rows.T, (index[clear] @ vectors).T).T * 2) / 2
    return *_rows_at_right_angles(steps, measured[clear]), shifted


def pixels_around(image: Array, centres: Array, half: int) -> Triple:
    """Return the columns (n, k) and rows (n, k) of the pixels around each centre, and their values (n, k, k)."""
    window = np.arange(-half, half + 1)
    base = np.floor(centres).astype(np.int64)
    x, y = (base[:, axis, None] + window for axis in (0, 1))
    rows, columns = image.shape
    patch = image[y.clip(0, rows - 1)[:, :, None], x.clip(0, columns - 1)[:, None, :]]
    return x, y, patch.astype(np.float64, copy=False)


def _rows_at_right_angles(steps: Array, measured: Array) -> Pair:
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
