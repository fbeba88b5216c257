r"""How a copy of a point spread changes, compared with the spread that it is a copy of.

A copy is :math:`\delta` away on the microlens array, a whole number of lenses, and on the detector
:math:`\kappa \delta` away, :math:`\kappa = (b + z) / b`. As the camera changes, its lenses move by more than those of
the spread, and so does the image of its point, which stays where it is in the scene. What a spread shows of a lattice
that is moved by o, relative to the point and the detector, is its change by ``mla_offset``; what it shows of a point
whose image moves is this and a shift. So a copy's change has two terms more,

.. math:: dI_\delta = dI + (A \delta) \cdot \partial_o I + (B \delta) \cdot \nabla I,

with these matrices A and B, in the frame of the lattice:

- a pitch :math:`D_2` stretches the lattice: :math:`A = dD_2 / D_2` along its axis;
- a change of b moves all images: :math:`A = B = -db / b`; of z all micro-images: :math:`B = -dz / b`;
- where the lattice turns by :math:`\theta`, the scene turns the other way in its frame, images turn with it but not the
  copies: A is the turn by a right angle times :math:`d\theta`, and B is :math:`\kappa A`;
- with the wavelength the grid grows about the axis: :math:`B = \kappa \, d\lambda / \lambda`.

In all else a copy changes as its spread does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...runtime.batches import Box
from ..tile import Copies

MOVED_LENSES = ("mla_pitch", "mla_distance", "mla_rotation")
"""Numbers by which the lattice moves against the points: A is not zero."""

SHIFTED_COPIES = ("mla_distance", "mla_rotation", "detector_distance", "wavelength")
"""Numbers by which copies shift: B is not zero."""

MOVED_COPIES = ("mla_pitch", *SHIFTED_COPIES)
"""Numbers by which copies change otherwise than their spreads."""


def copy_slopes(camera: PlenopticCamera, wavelength: float, name: str) -> NDArray[np.float64]:
    """Return A and B for a change by 1 of each component of a number of `MOVED_COPIES`.

    The result is (components, 2, 2, 2): for each component A and B, each as (x and y of the move, x and y of the copy's
    position). Degrees and nanometres are the units of ``mla_rotation`` and ``wavelength``.
    """
    one, none = np.eye(2), np.zeros((2, 2))
    growth, b = camera.micro_image_pitch / camera.mla_pitch, camera.mla_distance
    if name == "mla_pitch":
        along = [np.diag(one[axis]) / camera.mla_pitches[axis] for axis in (0, 1)]
        return np.array([[moved, none] for moved in along])
    if name == "mla_distance":
        return np.array([[-one / b, -one / b]])
    if name == "detector_distance":
        return np.array([[none, -one / b]])
    if name == "mla_rotation":
        turn = math.pi / 180 * np.array([[0.0, -1.0], [1.0, 0.0]])
        return np.array([[turn, growth * turn]])
    return np.array([[none, growth / wavelength * one]])


Window = tuple[slice, slice]
"""Rows and columns of a box of the grid."""

_BLOCK = 2**18
"""Samples that are gathered at a time: they fit into a core's own cache."""


@dataclass(frozen=True)
class SpreadCopies(Copies):
    """Where and how strongly a point spread is recorded, and how its copies change."""

    places: NDArray[np.float64]  # (copies, 2): the shifts on the microlens array, in millimetres
    moving: bool  # whether what they show of a lattice that moves against their points is counted

    def summed(self, sums: int) -> SpreadCopies:
        """Return them with the weights as often as sums are asked for: for three, those times the places come next."""
        factors = [np.ones(len(self.places)), *self.places.T][:sums]
        weights = np.hstack([self.weights * factor[:, None].astype(np.float32) for factor in factors])
        return replace(self, weights=weights)

    def windows(self, corner: NDArray[np.int64], samples: int, box: Box, finer: int) -> list[Window]:
        """Return what each copy of a patch takes of a box of the grid, which is finer than the patches."""
        start = finer * (corner + self.shifts) - np.array([box.left, box.top])
        size = finer * samples
        return [(slice(y, y + size), slice(x, x + size)) for x, y in start.tolist()]


def gathered(tile: Any, windows: list[Window], copies: SpreadCopies, moments: bool, arrays: Any) -> list[Any]:
    """Add up, over the copies, what a tile has in their windows, with their weights.

    The tile (channels, rows, columns) is on the box of the windows. With `moments` two more sums follow, with the
    weights times the copies' x and times their y.
    """
    along = [np.ones(len(windows)), *copies.places.T] if moments else [np.ones(len(windows))]
    which, channels = np.nonzero(copies.weights)
    factors = arrays.asarray((np.array(along)[:, which] * copies.weights[which, channels]).astype(np.float32))
    rows, columns = (part.stop - part.start for part in windows[0])
    result = arrays.empty((len(along), rows, columns), np.float32)
    block = max(1, _BLOCK // max(1, len(which) * columns))
    for first in range(0, rows, block):
        last = min(rows, first + block)
        held = arrays.empty((len(which), last - first, columns), np.float32)
        for part, copy, channel in zip(held, which.tolist(), channels.tolist(), strict=True):
            window_rows, window_columns = windows[copy]
            part[...] = tile[channel, window_rows.start + first : window_rows.start + last, window_columns]
        result[:, first:last] = (factors @ held.reshape(len(which), -1)).reshape(len(along), last - first, columns)
    return list(result)
