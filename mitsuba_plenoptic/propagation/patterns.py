r"""Radiators that share one pattern by the symmetry of the microlens lattice.

Move a scene point so that its image on the MLA moves by one lens: the pattern on the detector stays the same but
for the slightly other tilt of the light, and moves by one micro-image, :math:`D_2 (b + z) / b`. So radiators at the
same distance and at the same place of their lenses need one propagation for a zone of neighbouring lenses.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..rays import conjugate_coordinate

_PLACE_STEP = 2e-3
"""Places in a lens, in lens pitches, that count as the same."""

_DISTANCE_STEP = 1e-5
"""Distances, as logarithms, that count as the same."""

_OFF_LATTICE = 0.38196601
"""Fraction of a step by which the bounds between steps are moved off the places that regular samples take."""


@dataclass(frozen=True)
class Patterns:
    """Patterns, and which radiator takes which.

    Attributes
    ----------
    positions : float64 array (patterns, 3)
        The scene point that each is computed for.
    zone : int array (patterns, 2)
        Zone of lenses, along x and y.
    pattern : int array (n,)
        For each radiator its pattern.
    shift : int array (n, 2)
        For each radiator the lenses, along x and y, from the pattern's place to its own.
    """

    positions: NDArray[np.float64]
    zone: NDArray[np.int64]
    pattern: NDArray[np.int64]
    shift: NDArray[np.int64]


def find_patterns(
    camera: PlenopticCamera, positions: NDArray[np.float64], masks: NDArray[np.bool_] | None, zone: int
) -> Patterns:
    """Find radiators that share patterns.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    positions : float64 array (n, 3)
        Scene points in the camera frame.
    masks : bool array (n, m, m), optional
        Visible cells of the pupil; only equal ones share.
    zone : int
        Lenses along an axis within which patterns are shared.

    Returns
    -------
    Patterns
    """
    X, g = positions[:, :2], positions[:, 2:]
    image = conjugate_coordinate(X, g, camera.mla_distance) / camera.mla_pitch
    lens = np.floor(image + _OFF_LATTICE).astype(np.int64)
    part = np.floor((image - lens) / _PLACE_STEP + _OFF_LATTICE).astype(np.int64)
    distance = np.floor(np.log(g) / _DISTANCE_STEP + _OFF_LATTICE).astype(np.int64)
    zones = lens // zone
    keys = [zones, part, distance]
    if masks is not None:
        packed = np.packbits(masks.reshape(len(masks), -1), axis=1)
        keys.append(np.unique(packed, axis=0, return_inverse=True)[1].reshape(-1, 1))
    _, first, pattern = np.unique(np.hstack(keys), axis=0, return_index=True, return_inverse=True)
    pattern = pattern.reshape(-1)
    # A pattern of several lenses is computed for the zone's middle, a lonely one for its own place.
    lenses = [np.zeros((len(first), 2), np.int64) for _ in range(2)]
    lenses[0][:], lenses[1][:] = np.iinfo(np.int64).max, np.iinfo(np.int64).min
    np.minimum.at(lenses[0], pattern, lens)
    np.maximum.at(lenses[1], pattern, lens)
    middle = (lenses[0] + lenses[1]) // 2
    moved = positions[first]
    moved[:, :2] += (lens[first] - middle) * camera.mla_pitch * moved[:, 2:] / camera.mla_distance
    return Patterns(moved, zones[first], pattern, lens - middle[pattern])
