"""Sampling of rays for wave captures by ordinary cameras: from pixels, through random points of the pupil.

Rays start at points of the detector around their cell. In front of coarse pixels, whose kernels tell nothing of where
in a pixel light arrives, rays start where the light comes from before the pupil diffracts it: at their point of the
pixel, less a random displacement with the density of the point spread function.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lenses.pupil import Pair
from ..rays.random_numbers import chances_of, even_numbers
from ..rays.tracer import PupilWalk
from .fitted_pupil import CLOSED
from .pupil_diffraction import PupilDiffraction
from .signed_draws import ORDER, Aims, DetectorGrid, Drawn, Pixels, tent


class PixelDraws(DetectorGrid):
    """Sampler of the rays of the pixels of a camera without a microlens array."""

    def __init__(self, camera: PlenopticCamera, plans: Sequence[PupilDiffraction], parts: int = 1) -> None:
        super().__init__(camera, parts)
        self._plan = min(plans, key=lambda plan: plan.wavelength)
        self.walk = PupilWalk(camera, self._plan.system.lens)
        self.by_points = False
        self.enlargements = [1.0]
        self._open = camera.aperture.draws()
        self.order = 0 if self._plan.is_coarse else 2 * ORDER - 1

    @property
    def candidates(self) -> NDArray[np.int64]:
        """A single lens, the main lens."""
        return np.zeros((1, 2), np.int64)

    @property
    def lit_lenses(self) -> float:
        """Number of lenses that light a pixel."""
        return 1.0

    def lights(self, aims: Aims) -> Any:
        """Return whether light can reach the pixels."""
        return dr.full(mi.Bool, True, dr.width(aims.kind))

    def aims(self, pixels: Pixels) -> Aims:
        """Return the centres of pixels, which are their own lenses' centres."""
        middle = self._middle(pixels)
        return Aims(middle, middle, 0.0, dr.zeros(mi.UInt32, dr.width(pixels.index)))

    def cosines(self, pixels: Pixels) -> Pair:
        """Return direction cosines on which no kernel depends."""
        nothing = dr.zeros(mi.Float, dr.width(pixels.index))
        return nothing, nothing

    def turns(self, kind: int) -> NDArray[np.float64]:
        """Return the changes (places, 2) of `cosines` from a pixel's centre to its cells."""
        return np.zeros((self._parts**2, 2))

    def evenness(self, drawn: Drawn) -> Any:
        """Return the power through the disc from which pupil points are drawn over that through an open pupil."""
        share = self._camera.aperture.share * (self.walk.lens.reach / self._camera.pupil_radius) ** 2
        return dr.opaque(mi.Float, share)

    def crossed(self, drawn: Drawn) -> Pair:
        """Return the lateral path of light between pupil and detector, and its depth."""
        aside = dr.hypot(*(P - m for P, m in zip(drawn.pupil, drawn.detector, strict=True)))
        return aside, mi.Float(self._camera.pupil_distance)

    def draw(self, pixels: Pixels, own: Any, sample: Any, place: Any, seed: Any) -> Drawn:
        """Return rays drawn for pixels; rays of even and of odd numbers are independent. See `Draws.draw`."""
        aims = self._cells(self.aims(pixels).at(own), place)
        pixel = dr.gather(mi.UInt32, pixels.number, own)
        random = even_numbers(pixel, seed ^ ((sample & 1) << 3), sample >> 1, 6)
        if self._plan.is_coarse:
            x, y = self._displacement(random[4:])
            aside = (random[2] - 0.5) * self._step - x, (random[3] - 0.5) * self._step - y
        else:
            # Sums of two numbers with the density of a B-spline of order 2.
            aside = tuple((tent(a) + tent(b)) * self._step for a, b in zip(random[2:4], random[4:], strict=True))
        start = tuple(p + step for p, step in zip(aims.middle, aside, strict=True))
        x, y = self._in_pupil(*random[:2])
        pupil = x * self.walk.lens.reach, y * self.walk.lens.reach
        inner = self.walk.inner(pupil, start)
        is_open = dr.square(inner[0]) + dr.square(inner[1]) <= self._camera.pupil_radius**2
        chance = chances_of(pixel, seed ^ (sample << 4))
        return Drawn(
            pupil, inner, start, start, start, 0.0, aims.kind, dr.ones(mi.Float, dr.width(own)), chance, is_open
        )

    def _in_pupil(self, first: Any, second: Any) -> Pair:
        """Return random points of the pupil over its radius: a part of them may be in closed parts."""
        if self._closed is None:
            x, y = self._open(mi.Point2f(first, second))
            return x, y
        is_closed = first < CLOSED
        sample = mi.Point2f(dr.select(is_closed, first / CLOSED, (first - CLOSED) / (1 - CLOSED)), second)
        density, count = self._closed
        cell, _, within = density.sample(sample)
        places = [(mi.Float(index) + part) * (2 / count) - 1 for index, part in zip(cell, within, strict=True)]
        x, y = (dr.select(is_closed, place, other) for place, other in zip(places, self._open(sample), strict=True))
        return x, y

    @cached_property
    def _closed(self) -> tuple[Any, int] | None:
        """The distribution of rays through closed parts over cells of the square, and the cells across it."""
        if self._plan.fitted is None or (closed := self._plan.fitted.closed) is None:
            return None
        return mi.DiscreteDistribution2D(closed.astype(np.float32)), len(closed)

    def _displacement(self, random: Sequence[Any]) -> Pair:
        """Return random displacements in mm with the density of the point spread function."""
        density, count, step = self._spread
        cell, _, within = density.sample(mi.Point2f(*random))
        # Numbers at the borders of cells are placed in empty ones, where the part within is 0 / 0.
        within = [dr.select(dr.isfinite(part), part, 0.5) for part in within]
        x, y = ((mi.Float(index) + part - count / 2) * step for index, part in zip(cell, within, strict=True))
        return x, y

    @cached_property
    def _spread(self) -> tuple[Any, int, Any]:
        """The point spread function as a distribution over cells of a square, their count across, and width in mm."""
        spread, step = self._plan.spread
        return mi.DiscreteDistribution2D(spread.astype(np.float32)), len(spread), dr.opaque(mi.Float, step)
