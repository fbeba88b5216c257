"""Sampling of rays for wave captures by ordinary cameras: from pixels, through random points of the pupil.

Rays start at points of the detector around their cell. In front of coarse pixels, whose kernels tell nothing of where
in a pixel light arrives, rays start where the light comes from before the pupil diffracts it: at their point of the
pixel, less a random displacement with the density of the point spread function.
"""

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..rays import CHIEF, Ray, Walk
from ..runtime import Doubles, Pair
from .fitted_pupil import CLOSED
from .pupil_diffraction import PupilDiffraction
from .ray_sampler import ORDER, CellLenses, DetectorGrid, Pixels, RaySamples, tent


class PupilSampler(DetectorGrid):
    """Sampler of the rays of the pixels of a camera without a microlens array, whose one lens is the main lens."""

    choice = CHIEF
    lit_lenses = 1.0
    enlargements = (1.0,)

    control_factor = 1.0
    """Part of the control variate that rays subtract."""

    def __init__(self, camera: PlenopticCamera, plans: Sequence[PupilDiffraction], parts: int = 1):
        super().__init__(camera, parts)
        self._plan = min(plans, key=lambda plan: plan.wavelength)
        self.walk = Walk(camera, self._plan.system.lens)
        self._open = camera.aperture.draws()
        self.order = 0 if self._plan.is_coarse else 2 * ORDER - 1
        # Distributions over cells of a square of the point spread function, with the width of a cell in mm, and of rays
        # through closed parts, each with the count of cells across.
        if self._plan.is_coarse:
            spread, step = self._plan.spread
            self._spread = _distribution(spread), len(spread), dr.opaque(mi.Float, step)
        closed = self._plan.fitted.closed if self._plan.fitted else None
        self._closed = None if closed is None else (_distribution(closed), len(closed))

    def lights(self, lenses: CellLenses) -> Any:
        """Return whether light can reach the pixels."""
        return dr.full(mi.Bool, True, dr.width(lenses.kind))

    def lenses(self, pixels: Pixels) -> CellLenses:
        """Return the centres of pixels, which are their own lenses' centres."""
        position = self._middle(pixels)
        return CellLenses(position, position, 0.0, dr.zeros(mi.UInt32, dr.width(pixels.index)))

    def power(self, samples: RaySamples) -> Any:
        """Return factors on the radiance of rays: response of pixels, and the disc's power over an open pupil's.

        The disc is that from which pupil points are drawn.
        """
        ray = samples.ray
        share = self._camera.aperture.share * (self.walk.lens.reach / self._camera.pupil_radius) ** 2
        return self._response(ray.aside(ray.P), mi.Float(self._camera.pupil_distance)) * dr.opaque(mi.Float, share)

    def draw(self, pixels: Pixels, pixel: Any, ray_index: Any, cell: Any, seed: Any) -> RaySamples:
        """Return rays drawn for pixels; rays of even and of odd numbers are independent. See `LensSampler.draw`."""
        lenses, index = self.cells(self.lenses(pixels).at(pixel), pixel, cell)
        _, random, chance = self.numbers(pixels, pixel, ray_index, seed, 6)
        if self._plan.is_coarse:
            x, y = self._displacement(random[4:])
            aside = (random[2] - 0.5) * self._step - x, (random[3] - 0.5) * self._step - y
        else:
            # Sums of two numbers with the density of a B-spline of order 2.
            aside = tuple((tent(a) + tent(b)) * self._step for a, b in zip(random[2:4], random[4:], strict=True))
        start = tuple(p + step for p, step in zip(lenses.position, aside, strict=True))
        x, y = self._in_pupil(*random[:2])
        pupil = x * self.walk.lens.reach, y * self.walk.lens.reach
        round_pupil = self.walk.round_pupil(pupil, start)
        valid = dr.square(round_pupil[0]) + dr.square(round_pupil[1]) <= self._camera.pupil_radius**2
        ray = Ray(start, start, pupil, dr.ones(mi.Float, dr.width(pixel)), valid)
        lenses = lenses._replace(height=0.0)
        return RaySamples(ray, round_pupil, start, lenses, chance, pixel, index, ray_index)

    def _in_pupil(self, first: Any, second: Any) -> Pair:
        """Return random points of the pupil over its radius: a part of them may be in closed parts."""
        if self._closed is None:
            x, y = self._open(mi.Point2f(first, second))
            return x, y
        is_closed = first < CLOSED
        sample = mi.Point2f(dr.select(is_closed, first / CLOSED, (first - CLOSED) / (1 - CLOSED)), second)
        density, count = self._closed
        cell, _, within = density.sample(sample)
        coordinates = [(mi.Float(index) + r) * (2 / count) - 1 for index, r in zip(cell, within, strict=True)]
        x, y = (
            dr.select(is_closed, closed, opened) for closed, opened in zip(coordinates, self._open(sample), strict=True)
        )
        return x, y

    def _displacement(self, random: Sequence) -> Pair:
        """Return random displacements in mm with the density of the point spread function."""
        density, count, step = self._spread
        cell, _, within = density.sample(mi.Point2f(*random))
        # Numbers at the borders of cells are placed in empty ones, where the part within is 0 / 0.
        within = [dr.select(dr.isfinite(r), r, 0.5) for r in within]
        x, y = ((mi.Float(index) + r - count / 2) * step for index, r in zip(cell, within, strict=True))
        return x, y


def _distribution(density: Doubles) -> Any:
    return mi.DiscreteDistribution2D(density.astype(np.float32))
