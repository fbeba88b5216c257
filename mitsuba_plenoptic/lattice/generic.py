"""The few operations that floats, NumPy arrays and Dr.Jit arrays call by different names."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np


def module_of(value: Any) -> Any:
    """Return the module whose functions take `value`: Dr.Jit or NumPy."""
    return dr if dr.is_array_v(value) else np


def floor(value: Any) -> Any:
    """Return the largest integer that is not greater, as a float."""
    return module_of(value).floor(value)


def select(condition: Any, yes: Any, no: Any) -> Any:
    """Return `yes` where the condition holds, `no` elsewhere."""
    return dr.select(condition, yes, no) if dr.is_array_v(condition) else np.where(condition, yes, no)


def minimum(a: Any, b: Any) -> Any:
    """Return the smaller of two numbers."""
    return dr.minimum(a, b) if dr.is_array_v(a) else min(a, b)


def maximum(a: Any, b: Any) -> Any:
    """Return the greater of two numbers."""
    return dr.maximum(a, b) if dr.is_array_v(a) else max(a, b)


def is_zero(value: Any) -> bool:
    """Whether a number is plain and zero, so that what it multiplies can be left out."""
    return isinstance(value, (int, float)) and value == 0


def turn(x: Any, y: Any, degrees: Any) -> tuple[Any, Any]:
    """Turn positions counter-clockwise about the axis; floats, NumPy arrays or Dr.Jit arrays."""
    if is_zero(degrees):
        return x, y
    angle = degrees * (math.pi / 180)
    # A number of NumPy would turn Dr.Jit's arrays into its own.
    module = dr if dr.is_array_v(angle) else math
    cosine, sine = module.cos(angle), module.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y
