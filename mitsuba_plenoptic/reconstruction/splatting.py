r"""Pixels summed over bins on any lattice.

A pixel p of the lens with centre c goes to the place u(c) of the bins, through the point P(c) of the pupil. Through
another point c + d of its lens it goes to u(c) + a d, with the same a for all pixels of one type of lens, so that its
footprint is the lens's aperture, enlarged by a, or the pixel's own square where that is wider. Pixels are therefore
first counted on a grid finer than the bins, one for each type of lens; what such a sample gives to each of the bins
about it is then the same in every bin. Everything is summed in a fixed order, so that the result is the same bit for
bit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.fft

from ..camera import PlenopticCamera
from ..design import lens_footprint, pixel_footprint
from ..optics import rays
from ..runtime.limits import require_memory
from .real_lens import traced_places

# Samples of the fine grid across a lens pitch; at least so many across a bin.
_FINE = 16
_LEAST = 4

# Bins across a footprint up to which it is applied bin by bin; beyond that FFTs are faster.
_MOST_TAPS = 9

# Pixels followed at once: few enough to stay in the cache.
_BLOCK = 2**16


def splat(
    image: np.ndarray, camera: PlenopticCamera, distance: float, radius: float, *, footprint: str, oversample: int
) -> np.ndarray:
    """Follow one ray a pixel back to the object plane and sum the pixels that go to each bin.

    Parameters
    ----------
    image : (rows, columns, channels) float32 array
        The capture.
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance.
    radius : float
        Pupil radius: pixels whose ray misses it are left out.
    footprint : {"lens", "point"}
        Whether a pixel is spread over what its whole lens sees, or goes to one bin.
    oversample : int
        Bins per lens pitch.

    Returns
    -------
    (rows, columns, channels) float64 array
        Sum of the pixels by bin.
    """
    plan = Splat.of(camera, distance, radius, footprint, oversample, image.shape[2])
    values = image.reshape(-1, image.shape[2])[plan.pixel]
    (down, across), margin = plan.size, plan.margin
    total = np.zeros((image.shape[2], down + 2 * margin, across + 2 * margin))
    for mine, taps in plan.types():
        first = margin - taps.shape[0] // 2
        for out, weights in zip(total, values.T, strict=True):
            samples = np.bincount(plan.place[mine], weights=weights[mine], minlength=down * across * plan.fine**2)
            part = _spread(samples.reshape(down, across, plan.fine**2), taps)
            out[first : first + part.shape[0], first : first + part.shape[1]] += part
    total = total[:, 2 * margin : down, 2 * margin : across]
    return np.moveaxis(total, 0, -1)


@dataclass(frozen=True)
class Splat:
    """Where the pixels go, and what they cover there.

    Attributes
    ----------
    fine : int
        Fine samples across a bin.
    footprints : list of (taps, taps, fine, fine) arrays
        Of each type of lens.
    margin : int
        Bins beyond each border in which pixels are counted that reach across it.
    size : (int, int)
        Rows and columns of bins with these.
    place, lens_type, pixel : int arrays
        Of the pixels that land there: sample, counted bin by bin, type of lens, and flat index.
    """

    fine: int
    footprints: list[np.ndarray]
    margin: int
    size: tuple[int, int]
    place: np.ndarray
    lens_type: np.ndarray
    pixel: np.ndarray

    @classmethod
    def of(
        cls, camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int, channels: int
    ) -> Splat:
        """Follow the rays of a camera's pixels; arguments as of `splat`."""
        focal_lengths = camera.mla_focal_lengths
        fine, footprints = 1, [np.ones((1, 1, 1, 1))] * len(focal_lengths)
        if footprint == "lens":
            fine = max(_LEAST, -(-_FINE // oversample))
            step = camera.mla_pitch / (oversample * fine)
            footprints = [_in_bins(_footprint(camera, distance, f2, step), fine) for f2 in focal_lengths]
        # Pixels that land in bins beyond the border may still reach across it.
        margin = max(taps.shape[0] // 2 for taps in footprints)
        columns, rows = (count * oversample for count in camera.bin_count)
        across, down = columns + 2 * margin, rows + 2 * margin
        require_memory(
            # Counted samples, bins, and what is known of every pixel while those of a block are joined.
            down * across * (24.0 * fine**2 + 8.0 * (channels + 2)) + 100.0 * camera.shape[0] * camera.shape[1],
            f"{columns} x {rows} bins with footprints of {2 * margin + 1} of them",
        )
        landing = _landing(camera, distance, radius, oversample, fine, (down, across))
        return cls(fine, footprints, margin, (down, across), *landing)

    def types(self) -> Iterator[tuple[slice | np.ndarray, np.ndarray]]:
        """Yield for each type of lens which of the pixels are its, and its footprint."""
        for number, taps in enumerate(self.footprints):
            yield slice(None) if len(self.footprints) == 1 else np.flatnonzero(self.lens_type == number), taps


def _spread(samples: np.ndarray, footprint: np.ndarray) -> np.ndarray:
    """Spread the light of every fine sample over the bins around its own.

    Parameters
    ----------
    samples : (rows, columns, fine**2) float64 array
        Light in the fine samples of each bin.
    footprint : (taps, taps, fine, fine) array
        From `_in_bins`.

    Returns
    -------
    (rows + taps - 1, columns + taps - 1) float64 array
        Light of the bins, from `taps // 2` before the first.
    """
    taps = footprint.shape[0]
    footprint = footprint.reshape(taps, taps, -1)
    rows, columns = samples.shape[0] + taps - 1, samples.shape[1] + taps - 1
    if taps <= _MOST_TAPS:
        spread = np.zeros((rows, columns))
        for y, x in np.ndindex(taps, taps):
            spread[y : y + samples.shape[0], x : x + samples.shape[1]] += samples @ footprint[y, x]
        return spread
    shape = [scipy.fft.next_fast_len(size, real=True) for size in (rows, columns)]
    spectrum = sum(
        scipy.fft.rfft2(samples[..., fine], shape) * scipy.fft.rfft2(footprint[..., fine], shape)
        for fine in range(footprint.shape[2])
    )
    return scipy.fft.irfft2(spectrum, shape)[:rows, :columns]


def _footprint(camera: PlenopticCamera, distance: float, mla_focal_length: float, step: float) -> np.ndarray:
    """Draw what a pixel covers, its lens's view or its own square, whichever is wider: odd size, the sum is 1."""
    scale, pixel = lens_footprint(camera, distance, mla_focal_length), pixel_footprint(camera, distance)
    if scale * camera.lattice.aperture_width >= pixel:
        return camera.lattice.aperture_image(step, scale)
    half = max(0, math.ceil((pixel / step - 1) / 2))
    require_memory(16.0 * (2 * half + 1.0) ** 2, f"footprint of {2 * half + 1:.3g} samples across")
    side = np.ones(2 * half + 1)
    if half:
        side[[0, -1]] = (pixel / step - (2 * half - 1)) / 2
    return np.outer(side, side) / side.sum() ** 2


def _in_bins(blur: np.ndarray, fine: int) -> np.ndarray:
    """Return what falls into each bin of a footprint that is centred in each of the fine samples of one of them.

    Parameters
    ----------
    blur : (size, size) array
        The footprint in fine samples, about its middle; the sum is 1.
    fine : int
        Fine samples across a bin.

    Returns
    -------
    (taps, taps, fine, fine) array
        For the bins from `taps // 2` before to as many after, and rows and columns of samples.
    """
    half = blur.shape[0] // 2
    place = np.arange(fine) + np.arange(-half, half + 1)[:, None]
    reach = -(-half // fine)
    taps = np.arange(-reach, reach + 1)
    # Whether a sample of the footprint lies in the bin: (taps, size, fine).
    there = (place // fine == taps[:, None, None]).astype(np.float64)
    return np.einsum("iyr,yx,jxc->ijrc", there, blur, there, optimize=True)


def _landing(
    camera: PlenopticCamera, distance: float, radius: float, oversample: int, fine: int, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the pixels whose ray passes the pupil and lands on the bins.

    Parameters
    ----------
    camera, distance, radius, oversample
        As for `splat`.
    fine : int
        Fine samples across a bin.
    shape : (int, int)
        Rows and columns of bins; their middle is on the axis.

    Returns
    -------
    place, lens_type, pixel : int arrays
        Sample, counted bin by bin, type of lens, and flat index of each pixel.
    """
    if not camera.lens_data.is_thin:
        return _traced_landing(camera, distance, oversample, fine, shape)
    lattice, columns = camera.lattice, camera.crop_size[0]
    # All along the ray is linear in the pixel and the lens's centre.
    of_pixel = np.array(rays.follow_back(1.0, 0.0, 0.0, distance, camera))
    of_lens = np.array(rays.follow_back(0.0, 1.0, 1.0, distance, camera))
    scale = oversample / camera.mla_pitch
    px, rows = camera.pixel_coordinates(0), camera.pixel_coordinates(1)
    several = len(camera.mla_focal_lengths) > 1
    found = []
    height = max(1, _BLOCK // columns)
    for first in range(0, rows.size, height):
        py = rows[first : first + height, None]
        i, j = lattice.cell(*(rays.chief_point(p, camera.mla_distance, camera.detector_distance) for p in (px, py)))
        cx, cy = lattice.centre(i, j)
        Px, Py = (of_pixel[0] * p + of_lens[0] * c for p, c in ((px, cx), (py, cy)))
        lit = np.flatnonzero(Px**2 + Py**2 <= radius**2)
        i, j, cx, cy, qx, qy = (
            np.broadcast_to(values, (py.size, columns)).reshape(-1)[lit] for values in (i, j, cx, cy, px, py)
        )
        x, y = (
            (of_pixel[1] * p + of_lens[1] * c) * scale + size / 2
            for p, c, size in ((qx, cx, shape[1]), (qy, cy, shape[0]))
        )
        lens_type = lattice.lens_type(i, j).astype(np.int8) if several else np.zeros(lit.size, np.int8)
        inside, place = _samples(x, y, fine, shape)
        found.append([values[inside] for values in (place, lens_type, lit + first * columns)])
    place, lens_type, pixel = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return place, lens_type, pixel


def _samples(x: np.ndarray, y: np.ndarray, fine: int, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return which places, counted in bins, lie on the bins, and the samples that all would have."""
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    sample = np.floor((y - row) * fine).astype(np.int64) * fine + np.floor((x - column) * fine).astype(np.int64)
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    return inside, (row * shape[1] + column) * fine**2 + sample


def _traced_landing(
    camera: PlenopticCamera, distance: float, oversample: int, fine: int, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Do what `_landing` does, by rays traced through a real main lens."""
    scale, columns = oversample / camera.mla_pitch, camera.crop_size[0]
    b, z, types = camera.pupil_distance, camera.detector_distance, len(camera.mla_focal_lengths)
    found = []
    for rows, x, y, is_lit in traced_places(camera, distance):
        lit = np.flatnonzero(is_lit)
        inside, place = _samples(x[lit] * scale + shape[1] / 2, y[lit] * scale + shape[0] / 2, fine, shape)
        lit, place = lit[inside], place[inside]
        lens_type = np.zeros(lit.size, np.int8)
        if types > 1:
            px, py = camera.pixel_coordinates(0)[lit % columns], camera.pixel_coordinates(1)[rows][lit // columns]
            own = camera.lattice.cell(*(rays.chief_point(p, b, z) for p in (px, py)))
            lens_type = camera.lattice.lens_type(*own).astype(np.int8)
        found.append([place, lens_type, lit + rows.start * columns])
    place, lens_type, pixel = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return place, lens_type, pixel
