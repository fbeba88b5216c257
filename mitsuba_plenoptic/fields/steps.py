"""Samples of a field in neighbouring planes: where a step takes them, and where it leads them.

A step is periodic in the window of its source. The source samples lie anywhere in the window, and so do the destination
samples, whose pitch is another one where the lowest frequencies are padded or cut.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..runtime import Array, Shape


@dataclass(frozen=True)
class AxisStep:
    """One axis of a propagation step in mm: source samples, their window, and the next plane's samples.

    The field is zero outside `count` samples from `first` on. The lowest frequencies of the window of `padded` samples
    go to a window of `new_padded` samples, of which `wanted` are taken from `start` on.
    """

    first: float
    pitch: float
    count: int
    padded: int
    new_padded: int
    start: float
    wanted: int

    @property
    def window(self) -> float:
        """Width of the window in millimetres."""
        return self.padded * self.pitch

    @property
    def held(self) -> int:
        """Number of frequencies common to both windows."""
        return min(self.padded, self.new_padded)

    @property
    def new_pitch(self) -> float:
        """Distance between destination samples in millimetres."""
        return self.window / self.new_padded

    @property
    def source(self) -> Array:
        """Coordinates in mm of the source samples, float64 (count,)."""
        return self.first + self.pitch * np.arange(self.count)

    @property
    def destination(self) -> Array:
        """Coordinates in mm of the destination samples, float64 (wanted,)."""
        return self.start + self.new_pitch * np.arange(self.wanted)

    @property
    def reversed(self) -> AxisStep:
        """Step from the destination samples to the source samples."""
        return AxisStep(self.start, self.new_pitch, self.wanted, self.new_padded, self.padded, self.first, self.count)


@dataclass(frozen=True)
class Step:
    """Both axes of one propagation step."""

    x: AxisStep
    y: AxisStep

    @property
    def shape(self) -> Shape:
        """Numbers of rows and columns at the destination."""
        return self.y.wanted, self.x.wanted

    @property
    def columns(self) -> Shape:
        """Number and largest length of the transposed columns, whose memory source and destination share."""
        return self.x.held, max(self.y.count, self.y.wanted)

    @property
    def reversed(self) -> Step:
        """The step from destination to source along both axes."""
        return Step(self.x.reversed, self.y.reversed)

    @property
    def transforms(self) -> tuple[tuple[int, int, bool], ...]:
        """Fourier transforms of the step, in order: their number, length, and whether they are inverse."""
        x = self.x
        y = self.y
        return (
            (y.count, x.padded, False),
            (x.held, y.padded, False),
            (x.held, y.new_padded, True),
            (y.wanted, x.new_padded, True),
        )

    @property
    def transformed(self) -> int:
        """Number of samples that the Fourier transforms of the step process."""
        return sum(count * length for count, length, _ in self.transforms)


@dataclass(frozen=True)
class Directions(Step):
    r"""Final step by one transform, from samples to the field's lowest frequencies.

    From the MLA these are positions on the main lens; from the main lens they are direction cosines, multiples of the
    wavelength over the window. The reversed step leads to the source samples.
    """

    @property
    def transforms(self) -> tuple[tuple[int, int, bool], ...]:
        """Transforms from samples to the spectrum."""
        return super().transforms[:2]


@dataclass(frozen=True)
class LensAxis:
    """Samples of the main lens along one axis: an odd number, with the middle one on the axis, and a pitch in mm."""

    count: int
    pitch: float

    @property
    def samples(self) -> Array:
        """Coordinates in mm of the samples, float64 (count,)."""
        return (np.arange(self.count) - self.count // 2) * self.pitch
