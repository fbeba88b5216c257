r"""Partitions of the microlenses into the subsets that partially coherent reconstruction propagates one by one.

A partition is an array of labels, one for each lens; lenses of equal labels share a coherent wave. Its rows and columns
are the lattice indices j and i of the lenses that the recorded pixels belong to, so that of a square array it is
arranged like the micro-images in the capture. Of staggered or turned lattices some labels belong to no recorded lens.

Which lenses interfere
----------------------
The light of a lens with centre c comes to the bin x (both on the array) from the pupil point
:math:`P = (c - x) / \kappa`, with :math:`\kappa = 1 + b/g - b/f_1`. Two lenses interfere where their images overlap:
the pixels of both, followed back by rays through the centres of their lenses, come to the same bins. With the light
:math:`I_1, I_2` of the two in each bin the interference is at most :math:`2 \sum \sqrt{I_1 I_2}`, and the overlap
:math:`\sum \sqrt{I_1 I_2} / \sqrt{\sum I_1 \sum I_2}` (the coefficient of Bhattacharyya) is 1 for equal images and 0 for
separate ones. An image is enlarged by one bin on each side, for the width of the lens and for diffraction.

Their pupil points are :math:`\Delta c / \kappa` apart, so that the fringes have the period
:math:`\kappa \lambda b / \Delta c` on the array, and a bin of the width D averages their contrast to
:math:`\mathrm{sinc}(D \Delta c_x / \kappa \lambda b) \, \mathrm{sinc}(D \Delta c_y / \kappa \lambda b)`. Neighbours in a
row, whose fringes are the widest, interfere most; neighbours along a diagonal less, as their fringes are averaged along
both axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..errors import InputError, refuse_if, require_count, short_repr
from ..io.captures import Capture
from ..lattice.base import Lattice
from ..optics import rays
from ..optics.waves import in_millimetres
from ..runtime.limits import require_memory
from .methods import as_capture, require_distances

Labels = NDArray[np.int64]

_OVERLAP = 0.01
"""Overlap up to which two images count as separate."""

_LIT = 1e-3
"""Light of a lens over that of the brightest from which on it is coloured by itself."""

_LEAST_CONTRAST = 0.02
"""Contrast that fringes have at least, since the light of a lens is not even within a bin."""

_SWEEPS = 10
"""Passes over all lenses, at most, in which each may change its subset."""

_ROWS = 256
"""Rows of pixels that are followed back together."""


@dataclass(frozen=True)
class LensArray:
    """The lenses that recorded pixels belong to: rows and columns by their lattice indices j and i."""

    camera: PlenopticCamera
    first: tuple[int, int]
    shape: tuple[int, int]

    @classmethod
    def of(cls, camera: PlenopticCamera) -> LensArray:
        """Find the lenses of the pixels at the border, among which are those of the least and greatest indices."""
        x, y = (_chief_points(camera, axis) for axis in (0, 1))
        border = (x, y[[0, -1], None]), (x[[0, -1], None], y)
        found = [camera.lattice.cell(*np.broadcast_arrays(*side)) for side in border]
        i, j = (np.concatenate([side[axis].ravel() for side in found]).astype(int) for axis in (0, 1))
        first = int(i.min()), int(j.min())
        return cls(camera, first, (int(j.max()) - first[1] + 1, int(i.max()) - first[0] + 1))

    def at(self, i: NDArray[Any], j: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the row and the column in the array of lenses with these lattice indices, the nearest one beyond it."""
        indices = zip((j, i), self.first[::-1], self.shape, strict=True)
        row, column = (np.clip(index.astype(np.int64) - first, 0, size - 1) for index, first, size in indices)
        return row, column

    def of_pixels(self, labels: NDArray[Any]) -> NDArray[Any]:
        """Return the value of each recorded pixel's lens, an array (rows, columns)."""
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
        """Coordinates x and y of the centres, flat arrays."""
        row, column = (index.ravel().astype(np.float64) for index in np.indices(self.shape))
        x, y = self.camera.lattice.centre(column + self.first[0], row + self.first[1])
        return x, y


def _chief_points(camera: PlenopticCamera, axis: int) -> NDArray[np.float64]:
    """Return where the chief rays of the recorded columns (axis 0) or rows (axis 1) pass the array."""
    points = rays.chief_point(camera.pixel_coordinates(axis), camera.pupil_distance, camera.detector_distance)
    return np.asarray(points)


def interleaved(camera: PlenopticCamera, period: int) -> Labels:
    """Label every `period`-th lens along both axes alike, as ``interleave=period`` does: `period` squared subsets.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    period : int
        Count of lenses from one of a subset to the next.

    Returns
    -------
    int64 array (rows, columns)
        A label for each lens.

    Raises
    ------
    InputError
        If the period is not at least 1.
    """
    period = require_count("period", period)
    lenses = LensArray.of(camera)
    row, column = (index + first for index, first in zip(np.indices(lenses.shape), lenses.first[::-1], strict=True))
    return np.asarray(row % period * period + column % period, np.int64)


def blocks(camera: PlenopticCamera, count: int) -> Labels:
    """Divide the array into `count` x `count` contiguous blocks of lenses.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    count : int
        Count of blocks along each axis.

    Returns
    -------
    int64 array (rows, columns)
        A label for each lens.

    Raises
    ------
    InputError
        If the count is not from 1 to the lenses along an axis.
    """
    shape = LensArray.of(camera).shape
    count = require_count("count", count, maximum=min(shape))
    row, column = (np.arange(size) * count // size for size in shape)
    return np.asarray(row[:, None] * count + column, np.int64)


def coloured(
    capture: Capture | NDArray[Any],
    distance: float,
    subsets: int | None = None,
    *,
    camera: PlenopticCamera | None = None,
    wavelength: float | None = None,
) -> Labels:
    """Colour the lit lenses of a capture, so that the images of lenses of one colour overlap little at a distance.

    Parameters
    ----------
    capture : Capture or (rows, columns[, channels]) array
        The capture. A plain array needs `camera`.
    distance : float
        Object distance in scene units.
    subsets : int, optional
        Count of colours: the interference that remains within them is made as small as a greedy search finds. Default:
        as many as a greedy colouring needs for no two lit lenses of one colour to overlap.
    camera : PlenopticCamera, optional
        The camera of a plain array.
    wavelength : float, optional
        In nanometres. Default: that of the capture; of several the longest, which has the widest fringes.

    Returns
    -------
    int64 array (rows, columns)
        A label for each lens.

    Raises
    ------
    InputError
        If there is no camera or no wavelength, the main lens is not thin, or an argument is out of range.
    """
    capture = as_capture(capture, camera)
    camera = capture.camera
    camera.require_thin("lenses are coloured", instead="give labels of your own")
    (distance,) = require_distances([distance], camera)
    given: Any = capture.wavelength if wavelength is None else wavelength
    refuse_if(given is None, "wavelength = None: the capture has none; give wavelength")
    wave = max(require_wavelength(value) for value in np.atleast_1d(given))
    lenses = LensArray.of(camera)
    light = _light_in_bins(capture, lenses, distance)
    if subsets is None:
        labels = _separate(light)
    else:
        labels = _least_interference(light, lenses, distance, wave, require_count("subsets", subsets))
    return labels.reshape(lenses.shape)


def require_partition(partition: Any, camera: PlenopticCamera) -> Labels:
    """Return labels of all lenses, numbered from 0 without gaps."""
    shape = LensArray.of(camera).shape
    try:
        labels = np.asarray(partition)
    except ValueError:
        raise InputError(f"partition = {short_repr(partition)}: it must be an array of integers") from None
    refuse_if(labels.shape != shape, f"partition of shape {labels.shape}: it must be that of the lenses, {shape}")
    refuse_if(labels.dtype.kind not in "iu", f"partition of type {labels.dtype}: it must hold integers")
    return np.unique(labels, return_inverse=True)[1].reshape(shape)


def _light_in_bins(capture: Capture, lenses: LensArray, distance: float) -> csr_matrix:
    """Return the light of each lens in each bin of an object plane, (lenses, bins), its image enlarged by one bin."""
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
            rays.follow_back(p, c, c, distance, camera)
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
    """Return the sums of the square roots of the light of two lenses in the same bins, for all pairs."""
    reach = light.getnnz(1).max(initial=0)
    # Images that overlap have centres within twice their width.
    require_memory(12.0 * light.shape[0] * 4 * reach, f"overlaps of {light.shape[0]} lenses' images of {reach} bins")
    root = light.sqrt()
    common = (root @ root.T).tocsr()
    common.setdiag(0)
    common.eliminate_zeros()
    return common


def _separate(light: csr_matrix) -> Labels:
    """Colour lit lenses one after the other by the first colour of which no lens overlaps; the dim ones last."""
    power = np.asarray(light.sum(1)).ravel()
    common, labels = _common(light), np.full(len(power), -1)
    lit = power >= _LIT * power.max(initial=0)
    scale = np.sqrt(power)
    for lens in np.flatnonzero(lit & (power > 0)):
        part = slice(*common.indptr[lens : lens + 2])
        others = common.indices[part]
        near = others[common.data[part] > _OVERLAP * scale[lens] * scale[others]]
        labels[lens] = _first_free(labels[near])
    return _with_least(labels, common)


def _first_free(taken: Labels) -> int:
    """Return the least label that is not taken; -1 takes nothing."""
    free = np.ones(len(taken) + 2, bool)
    free[taken[taken < len(free) - 1] + 1] = False
    free[0] = False
    return int(np.argmax(free)) - 1


def _least_interference(
    light: csr_matrix, lenses: LensArray, distance: float, wavelength: float, subsets: int
) -> Labels:
    """Give each lens the colour with whose lenses it interferes least, until no lens changes."""
    camera = lenses.camera
    pairs = _common(light).tocoo()
    period = abs(camera.defocus(distance)) * in_millimetres(wavelength) * camera.mla_distance
    contrast = np.ones(pairs.nnz)
    for centre in lenses.centres:
        apart = (centre[pairs.row] - centre[pairs.col]) * camera.mla_pitch
        contrast *= np.sinc(apart / period) if period > 0 else apart == 0
    pairs.data *= np.maximum(abs(contrast), _LEAST_CONTRAST)
    common = pairs.tocsr()
    labels = np.full(common.shape[0], -1)
    for _ in range(_SWEEPS):
        before = labels.copy()
        for lens in range(len(labels)):
            labels[lens] = _best(lens, labels, common, subsets)
        if (labels == before).all():
            break
    return labels


def _with_least(labels: Labels, common: csr_matrix) -> Labels:
    """Label the lenses that have no label yet by the colour with whose lenses they have least in common."""
    subsets = int(labels.max(initial=0)) + 1
    for lens in np.flatnonzero(labels < 0):
        labels[lens] = _best(lens, labels, common, subsets)
    return labels


def _best(lens: int, labels: Labels, common: csr_matrix, subsets: int) -> int:
    part = slice(*common.indptr[lens : lens + 2])
    mine = labels[common.indices[part]]
    known = mine >= 0
    return int(np.argmin(np.bincount(mine[known], common.data[part][known] ** 2, subsets)))
