"""Phase screens: sampled paths that light gains over the pupil, still or carried along by the wind."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..array import COUNTS, SampledGrid, known_samples, phases, read_samples
from ..errors import (
    WAVEFRONT_UNIT,
    put_checked,
    refuse_if,
    require_count,
    require_number,
    require_numbers,
    suggest_keywords,
)
from ..runtime import Pair, PlainData, known_record

_MILLIMETRES = WAVEFRONT_UNIT * 1e-6
"""Unit of the samples."""


@suggest_keywords
@dataclass(frozen=True, eq=False)
class PhaseScreen(PlainData):
    """The path that light gains over the pupil of the main lens, given by samples, for example of a turbulent layer.

    Between samples it is a bicubic spline, whose gradient deflects rays. The unit is that of the Zernike coefficients
    of `PlenopticCamera`: light of other wavelengths sees the same path. A sample represents the square around it, and
    the squares must cover the pupil.

    Parameters
    ----------
    waves : array (rows, columns), nested lists, or path
        Path at the samples in waves of 633 nm, larger where light is delayed, in rows of rising y and columns of rising
        x of the camera frame; or an NPY, EXR or FITS file of it. FITS needs the extra ``ao``; its ``BUNIT`` may be a
        length (m, mm, um, nm), waves or radians, of ``WAVELEN`` in metres if it is stated.
    width : float
        Distance of the first and the last column in millimetres; rows are as far apart as columns.

    Examples
    --------
    >>> import numpy as np
    >>> import mitsuba_plenoptic as mp
    >>> x, y = np.meshgrid(*2 * [np.linspace(-6, 6, 64)])
    >>> screen = mp.PhaseScreen(0.01 * (x**2 - y**2), width=12)
    >>> mp.PlenopticCamera(phase_screen=screen).phase_screen == screen
    True
    """

    waves: Any
    width: float

    def __post_init__(self) -> None:
        put_checked(
            self, waves=partial(known_samples, units=phases(_MILLIMETRES)), width=partial(require_number, positive=True)
        )

    @property
    def step(self) -> float:
        """Distance of neighbouring samples in millimetres."""
        return self.width / (self.waves.shape[1] - 1)

    @property
    def reach(self) -> float:
        """Radius in millimetres of the largest pupil that the screen covers."""
        return min(self.waves.shape) * self.step / 2

    @cached_property
    def _grid(self) -> SampledGrid:
        # One more sample on each side extends the path, by its slope, to the edges of the outermost squares.
        wider = np.pad(self.waves * _MILLIMETRES, 1, mode="reflect", reflect_type="odd")
        return SampledGrid(wider, self.width + 2 * self.step)

    def path(self, x: Any, y: Any) -> Any:
        """Return the path in millimetres at points of the pupil, NumPy or Dr.Jit arrays.

        Parameters
        ----------
        x, y : array
            Coordinates in the camera frame in millimetres.
        """
        return self._grid.at(x, y)

    def slopes(self, x: Any, y: Any) -> Pair:
        """Return the gradient of `path` in mm per mm, which is the change of direction.

        Parameters
        ----------
        x, y : array
            Coordinates in the camera frame in millimetres.
        """
        return self._grid.slopes(x, y)

    def __repr__(self) -> str:
        rows, columns = self.waves.shape
        return f"PhaseScreen({rows} x {columns} samples, width={self.width!r})"


known_screen = partial(known_record, PhaseScreen, "phase_screen", form="a PhaseScreen, a dictionary")
"""Return a phase screen from any of its forms; None means no screen."""


@suggest_keywords
def frozen_flow(
    waves: Any, *, step: float, width: float, wind: Pair, interval: float, frames: int
) -> Iterator[PhaseScreen]:
    """Yield one phase screen a frame, cut from a larger screen that the wind moves, unchanged, across the pupil.

    This is Taylor's hypothesis (G. I. Taylor 1938, "The spectrum of turbulence"). Between samples the larger screen is
    a bicubic spline. Halfway between the first and the last frame the middle of the larger screen is on the axis.

    Parameters
    ----------
    waves : array (rows, columns), or path
        The larger screen, as for `PhaseScreen`, of any size.
    step : float
        Distance in millimetres of samples, of the screen and of the frames.
    width : float
        Width of the frames' screens in millimetres, about the diameter of the pupil or more.
    wind : (float, float)
        Velocity along x and y of the camera frame in millimetres per second.
    interval : float
        Time between frames in seconds.
    frames : int
        Number of frames.

    Yields
    ------
    PhaseScreen
        The screen of each frame.
    """
    large = read_samples("waves", waves, phases(_MILLIMETRES))
    step, width = (require_number(name, value, positive=True) for name, value in (("step", step), ("width", width)))
    velocity = np.array(require_numbers("wind", wind, count=2))
    interval = require_number("interval", interval, positive=True)
    frames = require_count("frames", frames)
    low, high = COUNTS
    count = math.ceil(min(width / step, 2.0 * high) - 1e-9) + 1
    refuse_if(
        not low <= count <= high, f"width = {width:g}: it must be {low - 1} to {high - 1} times the step of {step:g}"
    )
    with np.errstate(over="ignore"):
        travel = np.abs(velocity) * interval * (frames - 1) / step
    needed = count + travel[::-1]
    refuse_if(
        bool((needed > np.array(large.shape) + 1e-9).any()),
        f"waves of {large.shape[0]} x {large.shape[1]} samples: frames and wind need "
        f"{np.ceil(needed[0]):.6g} x {np.ceil(needed[1]):.6g}",
    )
    grid = SampledGrid(large, (large.shape[1] - 1) * step)
    offsets = (np.arange(count) - (count - 1) / 2) * step
    centres = (-velocity * interval * (frame - (frames - 1) / 2) for frame in range(frames))
    return (PhaseScreen(grid.at(*np.meshgrid(offsets + x, offsets + y)), (count - 1) * step) for x, y in centres)
