r"""Partitions of the microlenses into subsets that are propagated separately, for a verdict about the paper.

A partition is an array of labels, one per lens; lenses of equal labels share a coherent wave. Its rows and columns are
the lattice indices j and i of the lenses of recorded pixels, so that for a square array it is arranged like the
micro-images in the capture. In staggered or rotated lattices some labels belong to no recorded lens.

Which lenses interfere
----------------------
Two lenses interfere where their images overlap: the pixels of both, followed back by rays through the centres of their
lenses, come to the same bins. With the light :math:`I_1, I_2` of the two in each bin the overlap is
:math:`\sum \sqrt{I_1 I_2} / \sqrt{\sum I_1 \sum I_2}` (the coefficient of Bhattacharyya), 1 for equal images and 0 for
separate ones. An image is enlarged by one bin on each side, for the width of the lens and for diffraction.

The strength of the interference is known, too. The light of all lenses leaves the array in phase. From a lens with
centre c it comes to the bin x (both on the array) by the pupil point :math:`(c - x) / \kappa`, where :math:`\kappa = 1
+ b/g - b/f_1`, with the phase

.. math:: \phi_c(x) = \frac{\pi}{\lambda b} \left( |c|^2 - \frac{|x - c|^2}{\kappa} \right)

up to a phase common to all lenses. The fringes of two lenses :math:`\Delta` apart have the period :math:`|\kappa|
\lambda b / \Delta`, so that a bin of the width D averages them to :math:`\mathrm{sinc}(D \Delta_x / \kappa \lambda b)
\, \mathrm{sinc}(D \Delta_y / \kappa \lambda b)` of their contrast. Neighbours in a row interfere most, neighbours along
a diagonal less, as their fringes are averaged along both axes. As phases are quadratic in c, the pairs of a regular
subset may also add in phase and interfere more than those of a denser one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ...camera import PlenopticCamera
from ...io.captures import Capture
from ...light.walk import follow_back
from ...optics import rays
from ...optics.waves import in_millimetres
from ...refocus import reconstruct
from ...runtime.limits import require_memory

Labels = NDArray[np.int64]

_OVERLAP = 0.01
"""Overlap up to which two images count as separate."""

_LIT = 1e-3
"""Light of a lens over that of the brightest from which on it is coloured by itself."""

_SAMPLES, _LEAST_SAMPLES = 24, 4
"""Bins in which the interference of white is computed; the fewer, the more lenses' images overlap there."""

_PAIRS = 1e8
"""Pairs of lenses that are summed in all bins together, unless those of the least bins are more."""

_ROWS = 256
"""Rows of pixels that are followed back together."""


@dataclass(frozen=True)
class LensArray:
    """The lenses of the recorded pixels, in rows and columns by lattice indices j and i."""

    camera: PlenopticCamera
    first: tuple[int, int]
    shape: tuple[int, int]

    @classmethod
    def of(cls, camera: PlenopticCamera) -> LensArray:
        """Return the array of lenses of all pixels, bounded by the lenses of pixels at the border."""
        x, y = (_chief_points(camera, axis) for axis in (0, 1))
        border = (x, y[[0, -1], None]), (x[[0, -1], None], y)
        found = [camera.lattice.cell(*np.broadcast_arrays(*side)) for side in border]
        i, j = (np.concatenate([side[axis].ravel() for side in found]).astype(int) for axis in (0, 1))
        first = int(i.min()), int(j.min())
        return cls(camera, first, (int(j.max()) - first[1] + 1, int(i.max()) - first[0] + 1))

    def at(self, i: NDArray[Any], j: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return row and column of lenses with given lattice indices, or of the nearest lens inside the array."""
        indices = zip((j, i), self.first[::-1], self.shape, strict=True)
        row, column = (np.clip(index.astype(np.int64) - first, 0, size - 1) for index, first, size in indices)
        return row, column

    def of_pixels(self, labels: NDArray[Any]) -> NDArray[Any]:
        """Return each recorded pixel's value, (rows, columns), from one value per lens."""
        camera, lattice = self.camera, self.camera.lattice
        x, y = (_chief_points(camera, axis) for axis in (0, 1))
        if lattice.axis_aligned:
            row, column = self.at(lattice.axis_cell(x, 0), lattice.axis_cell(y, 1))
            return labels[np.ix_(row, column)]
        found = np.empty(camera.shape, labels.dtype)
        for first in range(0, len(y), _ROWS):
            rows = slice(first, first + _ROWS)
            found[rows] = labels[self.at(*lattice.cell(*np.broadcast_arrays(x, y[rows, None])))]
        return found

    @property
    def centres(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Coordinates x and y of the lenses' centres, as flat arrays."""
        row, column = (index.ravel().astype(np.float64) for index in np.indices(self.shape))
        x, y = self.camera.lattice.centre(column + self.first[0], row + self.first[1])
        return x, y


def _chief_points(camera: PlenopticCamera, axis: int) -> NDArray[np.float64]:
    """Return the array positions of the chief rays of recorded columns (axis 0) or rows (axis 1)."""
    points = rays.chief_point(camera.pixel_coordinates(axis), camera.pupil_distance, camera.reduced_distance)
    return np.asarray(points)


def blocks(camera: PlenopticCamera, count: int) -> Labels:
    """Return labels of `count` x `count` contiguous blocks of lenses."""
    shape = LensArray.of(camera).shape
    row, column = (np.arange(size) * count // size for size in shape)
    return np.asarray(row[:, None] * count + column, np.int64)


def sublattice(camera: PlenopticCamera, distance: float, subsets: int, wavelength: float) -> Labels:
    """Return labels of the sublattice (and its shifted copies) that interferes least in a white image.

    Every sublattice with one of `subsets` lenses is tried. Far out of focus this takes seconds. The main lens is thin.
    """
    lenses = LensArray.of(camera)
    row, column = np.indices(lenses.shape)
    i, j = column + lenses.first[0], row + lenses.first[1]
    steps, basis = list(_sublattices(subsets)), np.array(camera.lattice.basis)
    predicted = np.round(sublattice_interference(camera, distance, wavelength, steps), 6)
    # Where no images overlap, as in focus, the lenses of a subset shall be far apart.
    best = min(range(len(steps)), key=lambda k: (predicted[k], -_shortest(steps[k], basis)))
    return _sublattice_labels(i, j, steps[best])


def coloured(capture: Capture, distance: float) -> Labels:
    """Return colours of lenses such that the images of lit lenses of one colour do not overlap at a distance.

    Lenses are coloured one by one, from the middle of the lit ones outwards, each with the first free colour. Lenses
    with less than a thousandth of the brightest one's light get no new colours. The main lens must be thin.
    """
    lenses = LensArray.of(capture.camera)
    return _separate(_light_in_bins(capture, lenses, distance), np.array(lenses.centres)).reshape(lenses.shape)


def refocused(capture: Capture, distances: Sequence[float], labels: Labels) -> dict[float, NDArray[Any]]:
    """Return images by distance: the summed intensities of one coherent wave for each label of lenses."""
    of_pixels, sums = LensArray.of(capture.camera).of_pixels(labels), dict.fromkeys(distances, np.zeros(()))
    mask = of_pixels.reshape(of_pixels.shape + (1,) * (capture.image.ndim - 2))
    for label in np.unique(labels):
        part = replace(capture, image=np.where(mask == label, capture.image, np.float32(0)))
        for plane in reconstruct(part, distances, method="coherent"):
            sums[plane.distance] = sums[plane.distance] + plane.image
    return sums


def _sublattices(index: int) -> Iterator[tuple[int, int, int]]:
    """Yield the sublattices of an index as (along, across, shift): steps (along, 0) and (shift, across) in i and j."""
    for along in range(1, index + 1):
        if index % along == 0:
            yield from ((along, index // along, shift) for shift in range(along))


def _sublattice_labels(i: NDArray[Any], j: NDArray[Any], step: tuple[int, int, int]) -> Labels:
    """Return labels of the sublattices that lenses of given indices belong to."""
    along, across, shift = step
    return np.asarray(j % across * along + (i - shift * (j // across)) % along, np.int64)


def _shortest(step: tuple[int, int, int], basis: NDArray[np.float64]) -> float:
    """Return the least distance between two lenses of a sublattice."""
    along, across, shift = step
    reach = np.arange(-along * across, along * across + 1)
    m, n = np.meshgrid(reach, reach)
    away = np.hypot(*np.moveaxis(np.stack([m * along + n * shift, n * across], -1) @ basis, -1, 0))
    return float(away[away > 0].min())


def sublattice_interference(
    camera: PlenopticCamera, distance: float, wavelength: float, steps: Sequence[tuple[int, int, int]]
) -> NDArray[np.float64]:
    """Return the predicted interference of each sublattice in a white image: root mean square over the mean."""
    lattice, pitch, b = camera.lattice, camera.mla_pitch, camera.mla_distance
    wave_path, kappa = in_millimetres(wavelength) * b, camera.defocus(distance)
    blur = abs(kappa) * camera.aperture_radius
    pairs = (np.pi * (blur / pitch + 1) ** 2 * pitch**2 / lattice.cell_area) ** 2
    require_memory(48.0 * pairs, f"pairs of lenses whose images overlap, at a blur of {2 * blur:g} mm")
    samples = int(np.clip(_PAIRS / pairs, _LEAST_SAMPLES, _SAMPLES))
    field = np.random.default_rng(0).uniform(-0.5, 0.5, (samples, 2)) * pitch * np.array(camera.bin_count)
    squares = np.zeros(len(steps))
    for x, y in (np.floor(field / pitch) + 0.5) * pitch:
        around = blur + pitch
        i, j = lattice.lenses_within((x - around, y - around), (x + around, y + around)).T
        cx, cy = lattice.centre(i.astype(np.float64), j.astype(np.float64))
        # The part of the lens whose image holds the bin.
        light = np.clip((blur - np.hypot(cx - x, cy - y)) / pitch + 0.5, 0, 1)
        i, j, cx, cy, light = (values[light > 0] for values in (i, j, cx, cy, light))
        if not (kappa and light.size):
            continue
        turns = (cx**2 + cy**2 - ((x - cx) ** 2 + (y - cy) ** 2) / kappa) / (2 * wave_path)
        waves = np.sqrt(light) * np.exp(2j * np.pi * turns)
        added = (waves[:, None] * waves.conj()).real / light.sum()
        for centre in (cx, cy):
            added *= np.sinc((centre[:, None] - centre) * (pitch / (kappa * wave_path)))
        np.fill_diagonal(added, 0)
        for number, step in enumerate(steps):
            labels = _sublattice_labels(i, j, step)
            squares[number] += float(added[labels[:, None] == labels].sum()) ** 2 / samples
    return np.sqrt(squares)


def _light_in_bins(capture: Capture, lenses: LensArray, distance: float) -> csr_matrix:
    """Return each lens's light in each bin of an object plane, (lenses, bins), with its image enlarged by one bin."""
    camera, lattice, pitch = lenses.camera, lenses.camera.lattice, lenses.camera.mla_pitch
    image = np.maximum(np.atleast_3d(capture.image), 0).sum(-1)
    px, py = (camera.pixel_coordinates(axis) for axis in (0, 1))
    x, y = (_chief_points(camera, axis) for axis in (0, 1))
    entries: list[tuple[NDArray[Any], ...]] = []
    for start in range(0, len(py), _ROWS):
        row, column = np.nonzero(image[start : start + _ROWS])
        row += start
        i, j = lattice.cell(x[column], y[row])
        ends = [
            follow_back(p, c, c, distance, camera)
            for p, c in zip((px[column], py[row]), lattice.centre(i, j), strict=True)
        ]
        passes = np.hypot(*(P for P, _ in ends)) <= camera.lit_radius
        u, v = (np.floor(place[passes] / pitch).astype(np.int64) for _, place in ends)
        lens = np.ravel_multi_index(lenses.at(i[passes], j[passes]), lenses.shape)
        entries.append((lens, u, v, image[row[passes], column[passes]]))
    lens, u, v, value = (np.concatenate(part) for part in zip(*entries, strict=True))
    u, v = (index - index.min(initial=0) + 1 for index in (u, v))
    width, height = (int(index.max(initial=0)) + 2 for index in (u, v))
    count = int(np.prod(lenses.shape))
    narrow = csr_matrix((value.astype(np.float64), (lens, v * width + u)), (count, width * height)).tocoo()
    around = [dv * width + du for dv in (-1, 0, 1) for du in (-1, 0, 1)]
    index = np.tile(narrow.row, 9), np.concatenate([narrow.col + step for step in around])
    return csr_matrix((np.tile(narrow.data / 9, 9), index), narrow.shape)


def _common(light: csr_matrix) -> csr_matrix:
    """Return, for all pairs of lenses, the sum over bins of the square root of the product of their light."""
    reach = light.getnnz(1).max(initial=0)
    # Images that overlap have centres within twice their width.
    require_memory(12.0 * light.shape[0] * 4 * reach, f"overlaps of {light.shape[0]} lenses' images of {reach} bins")
    root = light.sqrt()
    common = (root @ root.T).tocsr()
    common.setdiag(0)
    common.eliminate_zeros()
    return common


def _separate(light: csr_matrix, centres: NDArray[np.float64]) -> Labels:
    """Return labels of lit lenses, each the first colour without an overlapping lens; dim lenses come last.

    Lenses are taken from the middle outwards, which needs fewer colours than row by row.
    """
    power = np.asarray(light.sum(1)).ravel()
    common, labels, scale = _common(light), np.full(len(power), -1), np.sqrt(power)
    lit = (power >= _LIT * power.max(initial=0)) & (power > 0)
    which = np.flatnonzero(lit)
    away = centres[:, which] - centres[:, which].mean(1, keepdims=True) if which.size else centres[:, which]
    for lens in which[np.argsort(np.hypot(*away), kind="stable")]:
        part = slice(*common.indptr[lens : lens + 2])
        others = common.indices[part]
        taken = labels[others[common.data[part] > _OVERLAP * scale[lens] * scale[others]]]
        free = np.ones(len(taken) + 1, bool)
        free[taken[(taken >= 0) & (taken < len(free))]] = False
        labels[lens] = np.argmax(free)
    colours = int(labels.max(initial=0)) + 1
    for lens in np.flatnonzero(~lit):
        part = slice(*common.indptr[lens : lens + 2])
        mine = labels[common.indices[part]]
        in_common = np.bincount(mine[mine >= 0], common.data[part][mine >= 0], colours)
        labels[lens] = np.argmin(in_common)
    return labels
