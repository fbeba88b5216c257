"""Centres of micro-images from a white image, found lens by lens.

`views.estimate_lens_grid` finds the lattice. Each micro-image is then located by its light within two discs with soft
rims, which follow it until both agree, so that the centre of a symmetrical micro-image is found wherever it lies
between pixels (as by the windowed centroid of E. Bertin's SExtractor, 2011), and however brightness rises over it.

Dust on the array or the detector darkens part of a micro-image and displaces its centroid. Such centres are doubtful:
they lie off their neighbours' lattice, or their light differs from that of the neighbours.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...array import Lattice
from ...errors import refuse_if
from ...io import Capture, require_demosaiced
from ...runtime import Array, as_array, single_threaded_blas
from ...views import Discs, LensGrid, estimate_lens_grid, pixels_around
from .adjustment import OUTLIER, rms
from .array_fit import lattice_index
from .observations import DOUBTFUL_COLUMN, Table, write_table

# Lenses on each side of one that it is compared with.
_NEIGHBOURS = 4


@dataclass(frozen=True)
class Centres:
    """Centres of micro-images, with residuals from a regular grid.

    Attributes
    ----------
    grid : LensGrid
        The regular grid that fits the centres best.
    lens : (n, 2) int array
        Index of each lens along its row, and its row, counted from the grid's first.
    pixel : (n, 2) array
        Column and row; the centre of the first pixel is 0.
    light : (n,) array
        Light of each micro-image relative to the brightest; it falls with vignetting.
    residuals : (n, 2) array
        Centres minus the grid's centres in pixels: displacements of lenses, tilt and distortion.
    doubtful : (n,) bool array
        Centres that dust or a defect may have displaced: their position or their light differs from that of their
        neighbours by more than six deviations.
    """

    grid: LensGrid
    lens: Array
    pixel: Array
    light: Array
    residuals: Array
    doubtful: Array

    @property
    def error(self) -> float:
        """RMS distance of the centres from the regular grid, in pixels."""
        return rms(self.residuals)

    def table(self, name: str) -> Table:
        """Return the centres as a table like that of `read_centres`."""
        k, l = self.lens.T  # noqa: E741
        u, v = self.pixel.T
        return Table(name, {"k": k, "l": l, "u": u, "v": v, DOUBTFUL_COLUMN: self.doubtful.astype(int)})


@single_threaded_blas()
def find_centres(*whites: Capture | Array, like: Lattice | None = None) -> Centres:
    """Return the centre of each micro-image in a white image.

    Parameters
    ----------
    *whites : captures or (rows, columns[, channels]) arrays
        Pictures of something evenly white, with values proportional to light: one, or several of one camera at several
        apertures, over which the centres are averaged.
    like : Lattice, optional
        Lattice whose rows are counted. Default: rows are nearest to horizontal.

    Raises
    ------
    InputError
        If a picture shows no lattice of micro-images or is a mosaic of colours, or they differ in size.
    """
    for white in whites:
        if isinstance(white, Capture):
            require_demosaiced(white)
    images = [as_array("white", getattr(white, "image", white)) for white in whites]
    sizes = {image.shape[:2] for image in images}
    refuse_if(len(sizes) != 1, f"white images: they have {len(sizes)} sizes of pictures: one is needed, of one camera")
    grid = estimate_lens_grid(images[0], like)
    images = [image.mean(axis=2) if image.ndim == 3 else image for image in images]
    first = grid.centres()
    radius = grid.nearest_distance / 2
    inside = ((first > radius + 1) & (first < np.array(images[0].shape[::-1]) - radius - 1)).all(-1)
    lens = np.indices(grid.shape)[::-1, inside].T
    start = first[inside]
    vectors = first[[0, 1], [1, 0]] - first[0, 0]
    blocks = np.array_split(start, -(-len(start) // 2048))
    measured = []
    for image in images:
        discs = Discs.of(image, vectors)
        centred = []
        for centre in blocks:
            patches = pixels_around(image, centre, discs.reach + 1)
            # Until centres stand still.
            for _ in range(6):
                centre, light = discs.measured(patches, centre)
            centred.append((centre, light))
        measured.append([np.concatenate(values) for values in zip(*centred, strict=True)])
    centres, lights = map(np.stack, zip(*measured, strict=True))
    centre = centres.mean(0)
    light = lights.mean(0)
    # Micro-images fainter than this fraction of the median have no centre of their own.
    kept_lenses = (lights > 0.1 * np.median(lights, axis=1, keepdims=True)).all(0)
    kept_lenses &= np.hypot(*(centre - start).T) < radius / 2
    lens = lens[kept_lenses]
    centre = centre[kept_lenses]
    light = light[kept_lenses]
    matrix = np.column_stack([np.ones(len(lens)), lattice_index(grid, lens)])
    residuals = centre - matrix @ np.linalg.lstsq(matrix, centre)[0]
    light = light / light.max()
    # Which centres differ from their neighbours in place or light by more than is usual.
    values = np.concatenate([residuals, np.log(light)[:, None]], axis=1)
    differs = values - _local_medians(lens, values)
    apart = np.stack([np.hypot(*differs[:, :2].T) / 1.17741, np.abs(differs[:, 2]) / 0.67449], axis=-1)
    typical = np.maximum(_local_medians(lens, apart), np.median(apart, axis=0))
    beyond = apart > OUTLIER * typical
    beyond[:, 1] &= np.abs(differs[:, 2]) > 0.02
    return Centres(grid, lens, centre - 0.5, light, residuals, beyond.any(1))


def _local_medians(lens: Array, values: Array) -> Array:
    """Return the medians of values (n, m) over the neighbours of each lens."""
    column, row = (lens - lens.min(0) + _NEIGHBOURS).T
    side = 2 * _NEIGHBOURS + 1
    medians = np.empty_like(values)
    array = np.full((row.max() + side, column.max() + side), np.nan)
    for index, column_values in enumerate(values.T):
        array[row, column] = column_values
        around = np.lib.stride_tricks.sliding_window_view(array, (side, side))[row - _NEIGHBOURS, column - _NEIGHBOURS]
        medians[:, index] = np.nanmedian(around.reshape(len(values), -1), axis=1)
    return medians


def write_centres(path: str | Path, centres: Centres) -> None:
    """Write centres as a CSV file for `calibrate`."""
    write_table(path, centres.table("centres"))
