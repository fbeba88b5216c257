"""Samples of the fields of a back-propagation: plain numbers, one axis at a time; `planning` chooses them.

Detector to MLA and MLA to main lens go by the angular spectrum, whose windows are periodic: a step pads its source with
zeros to the window, and cuts the spectrum to the directions that the next plane needs. This resamples the field
exactly. The last step, to an object plane, is one Fourier transform over the pupil.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class AxisStep:
    """One axis of one propagation step, from samples in one plane to samples in the next.

    Attributes
    ----------
    first, pitch : float
        Coordinate of the first source sample and the distance between samples, in millimetres.
    count : int
        Source samples; the field is zero elsewhere.
    padded : int
        Samples across the window.
    kept : int
        Lowest frequencies of the window that are kept.
    start : float
        Coordinate of the first destination sample, in millimetres.
    wanted : int
        Destination samples.
    """

    first: float
    pitch: float
    count: int
    padded: int
    kept: int
    start: float
    wanted: int

    @property
    def window(self) -> float:
        """Width of the window in millimetres."""
        return self.padded * self.pitch

    @property
    def new_pitch(self) -> float:
        """Distance between destination samples in millimetres."""
        return self.window / self.kept

    @property
    def source(self) -> np.ndarray:
        """Coordinates of the source samples, float64 (count,)."""
        return self.first + self.pitch * np.arange(self.count)

    @property
    def destination(self) -> np.ndarray:
        """Coordinates of the destination samples, float64 (wanted,)."""
        return self.start + self.new_pitch * np.arange(self.wanted)


@dataclass(frozen=True)
class Step:
    """Both axes of one propagation step."""

    x: AxisStep
    y: AxisStep

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns at the destination."""
        return self.y.wanted, self.x.wanted

    @property
    def sample_area(self) -> float:
        """Area of a destination sample in square millimetres."""
        return self.x.new_pitch * self.y.new_pitch

    @property
    def columns(self) -> tuple[int, int]:
        """How many columns rows are turned into, and what they hold at most: source and destination share them."""
        return self.x.kept, max(self.y.count, self.y.wanted)

    @property
    def transforms(self) -> tuple[tuple[int, int, bool], ...]:
        """Fourier transforms of the step, in order: how many, of how many samples, and whether inverse."""
        x, y = self.x, self.y
        return (
            (y.count, x.padded, False),
            (x.kept, y.padded, False),
            (x.kept, y.kept, True),
            (y.wanted, x.kept, True),
        )


@dataclass(frozen=True)
class AxisDirections:
    """One axis of the last step, from samples of the main lens to direction cosines.

    Attributes
    ----------
    first, pitch, count
        Samples of the main lens, as `AxisStep` has them.
    padded : int
        Length of the transform.
    kept : int
        Lowest direction cosines that are kept, an odd number, zero in their middle.
    step : float
        From one direction cosine to the next.
    """

    first: float
    pitch: float
    count: int
    padded: int
    kept: int
    step: float

    @property
    def source(self) -> np.ndarray:
        """Coordinates of the samples of the main lens, float64 (count,)."""
        return self.first + self.pitch * np.arange(self.count)


@dataclass(frozen=True)
class Directions:
    """Both axes of the last step."""

    x: AxisDirections
    y: AxisDirections

    @property
    def columns(self) -> tuple[int, int]:
        """How many columns rows are turned into, and what they hold at most."""
        return self.x.kept, self.y.count

    @property
    def transforms(self) -> tuple[tuple[int, int, bool], ...]:
        """Fourier transforms of the step, as `Step` has them."""
        return (self.y.count, self.x.padded, False), (self.x.kept, self.y.padded, False)


@dataclass(frozen=True)
class Strip:
    """Rows of the detector that go up to the main lens together.

    Attributes
    ----------
    rows : slice
        Of the lit pixels.
    to_mla, to_main_lens : Step
        The way; the samples of the main lens are the same for all strips.
    """

    rows: slice
    to_mla: Step
    to_main_lens: Step


@dataclass(frozen=True)
class Plan:
    """Field samples across a pixel, the strips of the detector, and the steps from the main lens to object planes."""

    subsamples: int
    strips: tuple[Strip, ...]
    to_objects: tuple[Directions, ...]

    @property
    def main_lens(self) -> Step:
        """A step to the samples of the main lens."""
        return self.strips[0].to_main_lens

    @property
    def steps(self) -> tuple[Step | Directions, ...]:
        """All of them."""
        return (*(step for strip in self.strips for step in (strip.to_mla, strip.to_main_lens)), *self.to_objects)

    @property
    def transformed(self) -> int:
        """Samples that the Fourier transforms of all steps go through."""
        return sum(count * length for step in self.steps for count, length, _ in step.transforms)

    @property
    def memory(self) -> float:
        """Bytes of the arrays that are alive at once: the columns of a step, and the field at the main lens."""
        columns = max(math.prod(step.columns) for step in self.steps)
        return 8.0 * (columns + math.prod(self.main_lens.shape))
