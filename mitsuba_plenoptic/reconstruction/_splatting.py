r"""Pixels summed over bins on any lattice, and how much of a white scene each bin would get.

A pixel p of the lens with centre c goes to the place u(c) of the bins, through the point P(c) of the pupil. Through
another point c + d of its lens it goes to u(c) + a d, with the same a for all pixels of one kind of lens, so that its
footprint is the lens's aperture, enlarged by a, or the pixel's own square where that is wider. Pixels are therefore
first counted on a grid finer than the bins, one for each kind of lens, and the grid is then convolved with the
footprint. Everything is summed in a fixed order, so that the result is the same bit for bit.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.signal

from .. import rays
from ..camera import PlenopticCamera
from ..depth_of_field import lens_footprint, pixel_footprint
from ..pupil import PupilShare

# Samples of the fine grid across a lens pitch; at least so many across a bin.
_FINE = 16
_LEAST = 4

# Pixels followed at once.
_BLOCK = 2**20


def splat(
    image: np.ndarray, camera: PlenopticCamera, distance: float, radius: float, *, footprint: str, oversample: int
) -> tuple[np.ndarray, np.ndarray]:
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
    light : (rows, columns, channels) float64 array
        Sum of the pixels by bin.
    white : (rows, columns) float64 array
        The same of a white capture.
    """
    lattice, bins = camera.lattice, [count * oversample for count in camera.bin_count]
    fine = 1 if footprint == "point" else max(_LEAST, -(-_FINE // oversample))
    step = camera.mla_pitch / (oversample * fine)
    blurs = [np.ones((1, 1))] * len(camera.mla_focal_lengths)
    if footprint == "lens":
        pixel = pixel_footprint(camera, distance)
        scales = (lens_footprint(camera, distance, f2) for f2 in camera.mla_focal_lengths)
        blurs = [
            lattice.aperture_image(step, scale) if scale * lattice.aperture_width > pixel else _square(pixel / step)
            for scale in scales
        ]
    # Pixels that land beyond the bins may still reach into them.
    margin = max(blur.shape[0] // 2 for blur in blurs)
    columns, rows = (count * fine + 2 * margin for count in bins)

    place, kind, pixel, share = _landing(camera, distance, radius, step, margin, (rows, columns))
    values = image.reshape(-1, image.shape[2])[pixel]
    total = np.zeros((bins[1], bins[0], image.shape[2] + 1))
    for number, blur in enumerate(blurs):
        mine = slice(None) if len(blurs) == 1 else np.flatnonzero(kind == number)
        for channel, weights in enumerate((*values.T, share)):
            grid = np.bincount(place[mine], weights=weights[mine], minlength=rows * columns).reshape(rows, columns)
            if blur.size > 1:
                grid = scipy.signal.oaconvolve(grid, blur, mode="same")
            inner = grid[margin : rows - margin, margin : columns - margin]
            total[..., channel] += inner.reshape(bins[1], fine, bins[0], fine).sum(axis=(1, 3))
    return total[..., :-1], total[..., -1]


def _square(width: float) -> np.ndarray:
    """Draw a square of some width in samples: their shares of its area, of odd size."""
    half = math.ceil((width - 1) / 2) if width > 1 else 0
    share = np.ones(2 * half + 1)
    share[[0, -1]] = (width - (2 * half - 1)) / 2 if half else 1
    return np.outer(share, share) / share.sum() ** 2


def _landing(
    camera: PlenopticCamera, distance: float, radius: float, step: float, margin: int, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Find the pixels whose ray passes the pupil and lands on the fine grid.

    Parameters
    ----------
    camera, distance, radius
        As for `splat`.
    step : float
        Spacing of the grid in the MLA plane; its middle is on the axis.
    margin : int
        Samples of the grid that are left and right of, above and below the bins.
    shape : (int, int)
        Rows and columns of the grid.

    Returns
    -------
    place, kind, pixel : int arrays
        Sample of the grid, kind of lens, and flat index of each pixel.
    share : float32 array
        What each pixel reads of a white scene.
    """
    lattice, columns = camera.lattice, camera.crop_size[0]
    shares = [PupilShare(camera, kind) for kind in range(len(camera.mla_focal_lengths))]
    px, rows = camera.pixel_coordinates(0), camera.pixel_coordinates(1)
    found = []
    height = max(1, _BLOCK // columns)
    for first in range(0, rows.size, height):
        py = rows[first : first + height, None]
        i, j = lattice.cell(*(rays.chief_point(p, camera.mla_distance, camera.detector_distance) for p in (px, py)))
        (Px, x), (Py, y) = (
            rays.follow_back(p, c, c, distance, camera) for p, c in zip((px, py), lattice.centre(i, j), strict=True)
        )
        across, down = np.floor(x / step + shape[1] / 2), np.floor(y / step + shape[0] / 2)
        kept = (Px**2 + Py**2 <= radius**2) & (across >= 0) & (across < shape[1]) & (down >= 0) & (down < shape[0])
        row, column = np.nonzero(kept)
        kind = np.zeros(row.size, dtype=np.int8)
        if len(shares) > 1:
            kind = np.broadcast_to(lattice.lens_kind(i, j), kept.shape)[row, column].astype(np.int8)
        Px, Py, across, down = (np.broadcast_to(values, kept.shape)[row, column] for values in (Px, Py, across, down))
        share = np.empty(row.size, dtype=np.float32)
        for number, pupil in enumerate(shares):
            share[kind == number] = pupil(Px[kind == number], Py[kind == number])
        found.append(((down * shape[1] + across).astype(np.int64), kind, (row + first) * columns + column, share))
    place, kind, pixel, share = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return place, kind, pixel, share
