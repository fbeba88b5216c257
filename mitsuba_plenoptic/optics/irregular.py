r"""Arrays as they are made: lenses that stand and bend light a little off, each by numbers of its own.

A lens with the indices (i, j) is displaced along x and along y, and its focal length multiplied by 1 plus a number, by
normal deviates that follow from its indices and a seed alone, so that one lens is the same wherever it is looked at.
Deviates are cut at three standard deviations.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera

MOST_DEVIATIONS = 3.0
"""Standard deviations that no lens leaves."""


def irregularities(camera: PlenopticCamera, i: Any, j: Any) -> tuple[Any, Any, Any]:
    """Return by how much lenses are displaced along x and y, in millimetres, and the factors on their focal lengths.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, whose `mla_jitter` and `mla_seed` count.
    i, j : int array or Dr.Jit float array
        Indices of the lenses in the lattice.
    """
    place, focal = camera.mla_jitter
    x, y, f = (_deviate(_words(i), _words(j), camera.mla_seed, number) for number in range(3))
    return place * x, place * y, 1 + focal * f


def _words(index: Any) -> Any:
    """Return indices as whole numbers of 32 bits, modulo 2^32."""
    if not dr.is_array_v(index):
        return np.asarray(index, np.int64).astype(np.uint32)
    return dr.uint32_array_t(type(index))(dr.int32_array_t(type(index))(index))


def _deviate(i: Any, j: Any, seed: int, number: int) -> Any:
    """Return a normal deviate, by the method of Box and Muller (1958), cut at `MOST_DEVIATIONS`."""
    first, second = (_uniform(i, j, 2 * number + part, seed) for part in (0, 1))
    if dr.is_array_v(first):
        value = dr.sqrt(-2 * dr.log(first)) * dr.cos(2 * math.pi * second)
        return dr.clip(value, -MOST_DEVIATIONS, MOST_DEVIATIONS)
    return np.clip(np.sqrt(-2 * np.log(first)) * np.cos(2 * math.pi * second), -MOST_DEVIATIONS, MOST_DEVIATIONS)


def _uniform(i: Any, j: Any, number: int, seed: int) -> Any:
    """Return numbers evenly spread between 0 and 1, neither included."""
    bits = _mix(_mix(_mix(i ^ _mix_int(seed)) ^ j) ^ (0x9E3779B9 * (number + 1) & 0xFFFFFFFF)) >> 9
    if dr.is_array_v(bits):
        return (dr.float32_array_t(type(bits))(bits) + 0.5) * 2.0**-23
    return (bits.astype(np.float64) + 0.5) * 2.0**-23


def _mix(word: Any) -> Any:
    """Return a word of which every bit depends on all of the given (Wellons 2018, "Prospecting for hash functions")."""
    word = word ^ (word >> 16)
    word = word * type(word)(0x7FEB352D) if dr.is_array_v(word) else word * np.uint32(0x7FEB352D)
    word = word ^ (word >> 15)
    word = word * type(word)(0x846CA68B) if dr.is_array_v(word) else word * np.uint32(0x846CA68B)
    return word ^ (word >> 16)


def _mix_int(word: int) -> int:
    """Return `_mix` of one number."""
    return int(_mix(np.array([word], np.uint32))[0])
