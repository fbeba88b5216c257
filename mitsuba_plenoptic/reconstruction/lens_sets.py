"""Sets of lenses to propagate one at a time: which of them hold light, and what their fields are multiplied by."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from ..camera import PlenopticCamera
from ..optics import rays
from ..optics.phase import in_millimetres, parabola, phasor
from ..runtime.fft import Field
from .elements import converging_phase, detector_lens
from .lens_tiles import Tile

# Lenses looked at together for light.
_LIT_BATCH = 512

# Parts of a sample along an axis of which those in the aperture are counted.
_PARTS = 4


@dataclass(frozen=True)
class LensBatch:
    """Some lenses, and their factors of a field; what belongs to one axis is shaped to multiply fields (n, y, x).

    Attributes
    ----------
    bin : (n, 2) int64 array
        Column and row, among the bins of all lenses, of the bin that holds each lens's image.
    aside : (n, 2) float64 array, or None
        How far along x and y the lens's centre lies from the middle of that bin, in bins; None if nowhere.
    centre : (n, 2) float64 array
        Centres in millimetres.
    row, column : int64 arrays (n, samples, 1) and (n, 1, samples)
        Recorded pixel of each sample on the detector.
    source : list of complex64 or bool arrays
        Factors of the converging light at those samples, zero where not the lens's own.
    shift : list of complex64 arrays
        Factors of the spectra that shift them from the pixels to the lenses' centres.
    tilt : list of complex64 arrays
        Factors in the cells along y and along x.
    focal_length : float64 array (n,)
        Of each lens.
    aperture : float32 array (cell, cell), or None
        How much of each sample of a cell the aperture lets through; None if all.
    """

    bin: np.ndarray
    aside: np.ndarray | None
    centre: np.ndarray
    row: np.ndarray
    column: np.ndarray
    source: list[np.ndarray]
    shift: list[Field]
    tilt: list[Field]
    focal_length: np.ndarray
    aperture: np.ndarray | None


@dataclass(frozen=True)
class DetectorSamples:
    """Samples of the detector along an axis that hold the pixels of some lenses; arrays (lenses, samples).

    Attributes
    ----------
    pixel : int64 array
        Recorded pixel of each sample, clipped to the image.
    recorded : bool array
        Whether it is.
    coordinate : float64 array
        Of the sample, in millimetres.
    """

    pixel: np.ndarray
    recorded: np.ndarray
    coordinate: np.ndarray

    @classmethod
    def of(cls, low: np.ndarray, camera: PlenopticCamera, tile: Tile, axis: int) -> DetectorSamples:
        """Take the samples of the lenses whose cells begin at these coordinates of the MLA."""
        offset, size, half = camera.crop_offset[axis], camera.crop_size[axis], camera.resolution[axis] / 2
        edge = rays.chief_detector_point(low, camera.mla_distance, camera.detector_distance)
        pixel = np.floor(edge / camera.pixel_size + half + 1e-9).astype(np.int64)[:, None] + np.arange(tile.pixels)
        parts = (np.arange(tile.subsamples) + 0.5) / tile.subsamples
        coordinate = ((pixel[..., None] + parts).reshape(len(low), -1) - half) * camera.pixel_size
        recorded = (pixel >= offset) & (pixel < offset + size)
        pixel = np.clip(pixel - offset, 0, size - 1)
        pixel, recorded = (np.repeat(values, tile.subsamples, axis=1) for values in (pixel, recorded))
        return cls(pixel, recorded, coordinate)


class LensSet(ABC):
    """The lenses that any recorded pixel belongs to.

    Parameters
    ----------
    tile : Tile
        Sampling.
    index : (lenses, 2) int64 array
        Their indices.

    Attributes
    ----------
    tile : Tile
        Sampling.
    first : (int, int)
        First column and row of bins in which a lens lies, counted from the axis.
    bins : (int, int)
        Columns and rows from there to the last.
    """

    def __init__(self, tile: Tile, index: np.ndarray) -> None:
        self.tile, self._index = tile, index
        self._centre = np.stack(tile.camera.lattice.centre(*index.T.astype(np.float64)), axis=-1)
        place = self._centre / tile.camera.mla_pitch
        bins = np.floor(place).astype(np.int64)
        self._aside = place - bins - 0.5
        self.first = int(bins[:, 0].min()), int(bins[:, 1].min())
        self._bin = bins - np.array(self.first)
        self.bins = int(self._bin[:, 0].max()) + 1, int(self._bin[:, 1].max()) + 1

    def find(self, i: float, j: float) -> int:
        """Place of the lens with these indices."""
        return int(np.flatnonzero((self._index == (int(i), int(j))).all(1))[0])

    @abstractmethod
    def lit(self, image: np.ndarray) -> np.ndarray:
        """Places of the lenses that hold light; int64 (n,)."""

    @abstractmethod
    def batch(self, which: np.ndarray) -> LensBatch:
        """Take some lenses by their places."""


class AlignedLenses(LensSet):
    """Lenses of an upright square lattice, one of which lies on every bin: all is done one axis at a time."""

    def __init__(self, tile: Tile) -> None:
        self._x, self._y = (_LensAxis(tile, axis) for axis in (0, 1))
        j, i = np.meshgrid(self._y.index, self._x.index, indexing="ij")
        super().__init__(tile, np.stack([i.ravel(), j.ravel()], axis=-1))

    def lit(self, image: np.ndarray) -> np.ndarray:
        """Places of the lenses that hold light."""
        by_column = np.stack([image[:, pixel].any(1) for pixel in self._x.owned()], axis=1)
        return np.flatnonzero(np.stack([by_column[pixel].any(0) for pixel in self._y.owned()]))

    def batch(self, which: np.ndarray) -> LensBatch:
        """Take some lenses by their places."""
        x, y = self._x, self._y
        j, i = np.divmod(which, len(x.index))
        return LensBatch(
            bin=self._bin[which],
            aside=None,
            centre=self._centre[which],
            row=y.samples.pixel[j][:, :, None],
            column=x.samples.pixel[i][:, None, :],
            source=[y.source[j][:, :, None], x.source[i][:, None, :]],
            shift=[y.shift[j][:, :, None], x.shift[i][:, None, :]],
            tilt=[y.tilt[j], x.tilt[i]],
            focal_length=np.full(len(which), self.tile.camera.mla_focal_length),
            aperture=None,
        )


class _LensAxis:
    """All aligned lenses along one axis: their indices, their samples of the detector, and their factors."""

    def __init__(self, tile: Tile, axis: int) -> None:
        camera = tile.camera
        # A subsampled pixel at the border of two cells may belong to both.
        edges = np.array([-0.5, 0.5]) * (camera.pixel_size - tile.pitch)
        ends = camera.pixel_coordinates(axis)[[0, -1]] + edges
        first, last = detector_lens(ends, camera, axis).astype(np.int64)
        self.index = np.arange(first, last + 1)
        self.samples = DetectorSamples.of(self.index * camera.mla_pitch, camera, tile, axis)
        p, index = self.samples.coordinate, self.index[:, None].astype(np.float64)
        self._own = (detector_lens(p, camera, axis) == index) & self.samples.recorded
        self.source = converging_phase(p, index, camera, tile.wavelength, axis) * self._own
        centre = camera.lattice.axis_centre(self.index.astype(np.float64), axis)
        self.shift, self.tilt = _shift(centre, p[:, 0], tile), _tilt(centre, tile)

    def owned(self) -> list[np.ndarray]:
        """Return the recorded pixels of each lens."""
        return [pixel[own] for pixel, own in zip(self.samples.pixel, self._own, strict=True)]


class ScatteredLenses(LensSet):
    """Lenses of any lattice, each for itself."""

    def __init__(self, tile: Tile) -> None:
        camera = tile.camera
        ends = np.array([camera.pixel_coordinates(axis)[[0, -1]] for axis in (0, 1)])
        ends += np.array([-0.5, 0.5]) * camera.pixel_size
        low, high = rays.chief_point(ends, camera.mla_distance, camera.detector_distance).T
        half = tile.cell_width / 2
        super().__init__(tile, camera.lattice.lenses_within(tuple(low - half), tuple(high + half)))
        self._aperture = _aperture(tile)

    def lit(self, image: np.ndarray) -> np.ndarray:
        """Places of the lenses near which there is light."""
        lit = np.zeros(len(self._index), bool)
        for start in range(0, len(lit), _LIT_BATCH):
            which = np.arange(start, min(start + _LIT_BATCH, len(lit)))
            x, y = self._samples(which)
            own = y.recorded[:, :, None] & x.recorded[:, None, :]
            lit[which] = (own & (image[y.pixel[:, :, None], x.pixel[:, None, :]] > 0)).any((1, 2))
        return np.flatnonzero(lit)

    def batch(self, which: np.ndarray) -> LensBatch:
        """Take some lenses by their places."""
        tile, camera, centre = self.tile, self.tile.camera, self._centre[which]
        b, z, lattice = camera.mla_distance, camera.detector_distance, camera.lattice
        x, y = self._samples(which)
        i, j = self._index[which].T.astype(np.float64)
        chief_x, chief_y = (rays.chief_point(axis.coordinate, b, z) for axis in (x, y))
        own_i, own_j = lattice.cell(*np.broadcast_arrays(chief_x[:, None, :], chief_y[:, :, None]))
        own = (own_i == i[:, None, None]) & (own_j == j[:, None, None])
        own &= y.recorded[:, :, None] & x.recorded[:, None, :]
        along_x, along_y = (
            phasor(parabola((axis.coordinate - c[:, None]) ** 2, z, tile.wavelength))
            for axis, c in zip((x, y), centre.T, strict=True)
        )
        shift_x, shift_y = (_shift(c, axis.coordinate[:, 0], tile) for axis, c in zip((x, y), centre.T, strict=True))
        lengths = np.array(camera.mla_focal_lengths)
        lens_type = lattice.lens_type(i, j).astype(int) if len(lengths) > 1 else np.zeros(len(which), int)
        return LensBatch(
            bin=self._bin[which],
            aside=self._aside[which],
            centre=centre,
            row=y.pixel[:, :, None],
            column=x.pixel[:, None, :],
            source=[own, along_y[:, :, None], along_x[:, None, :]],
            shift=[shift_y[:, :, None], shift_x[:, None, :]],
            tilt=[_tilt(centre[:, 1], tile), _tilt(centre[:, 0], tile)],
            focal_length=lengths[lens_type],
            aperture=self._aperture,
        )

    def _samples(self, which: np.ndarray) -> tuple[DetectorSamples, DetectorSamples]:
        """Take the samples of the detector along x and y of some lenses."""
        low = self._centre[which] - self.tile.cell_width / 2
        x, y = (DetectorSamples.of(low[:, axis], self.tile.camera, self.tile, axis) for axis in (0, 1))
        return x, y


def lens_set(tile: Tile) -> LensSet:
    """Return the lenses that any recorded pixel of a tile's camera belongs to."""
    return AlignedLenses(tile) if tile.camera.lenses_are_bins else ScatteredLenses(tile)


def _shift(centre: np.ndarray, first: np.ndarray, tile: Tile) -> Field:
    """Return what shifts spectra along an axis from each lens's first pixel sample to the first one of its cell."""
    way = centre + tile.cell[0] - first
    return phasor(np.outer(way, np.fft.fftfreq(tile.padded, tile.pitch)))


def _tilt(centre: np.ndarray, tile: Tile) -> Field:
    """Return what takes out, along an axis, the direction from lenses to the main lens's centre, and its curvature."""
    wave_path = in_millimetres(tile.wavelength) * tile.camera.mla_distance
    return phasor((centre[:, None] * tile.cell + tile.cell**2 / 2) / wave_path)


def _aperture(tile: Tile) -> np.ndarray:
    """Fraction of each sample of a cell that lies in the aperture."""
    parts = ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5) * tile.pitch
    fine = (tile.cell[:, None] + parts).ravel()
    inside = tile.camera.lattice.in_aperture(*np.meshgrid(fine, fine))
    size = tile.cell.size
    return inside.reshape(size, _PARTS, size, _PARTS).mean((1, 3), dtype=np.float32)
