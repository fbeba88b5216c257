r"""Irregular arrays: displaced lenses of uneven focal lengths, tilted arrays, shifts to chief rays, figure errors.

The lens with the indices (i, j) is displaced along x and y, and its focal length is scaled, by normal deviates. These
depend only on the indices and a seed, so that a lens is the same in all computations. Deviates are clipped at three
standard deviations.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..array import MOST_DEVIATIONS
from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import in_millimetres
from ..runtime import Doubles, Pair
from .accuracy import ACCURACY


class Kind(NamedTuple):
    """Microlenses treated as equal, with one set of kernels."""

    # Index of the design focal length of the lens.
    lens_type: int
    # Focal length and distance to the detector of these lenses, in millimetres, reduced by the index of the medium.
    focal_length: float
    distance: float


@dataclass(frozen=True)
class LensKinds:
    """The kinds of a camera's microlenses, which are the same for all wavelengths."""

    camera: PlenopticCamera

    def __post_init__(self) -> None:
        count = len(self._ratios) * len(self._heights) * len(self.camera.mla_focal_lengths)
        if count > ACCURACY.most_kinds:
            # The error names the parameter that causes more kinds.
            name = "mla_jitter" if len(self._ratios) > len(self._heights) else "mla_tilt"
            raise InputError(
                f"{name} = {getattr(self.camera, name)}: a wave capture would need {count} kinds of microlenses, and "
                f"takes {ACCURACY.most_kinds} at most; make it smaller"
            )

    @cached_property
    def every(self) -> list[Kind]:
        """All kinds: combinations of heights, focal length factors and lens types."""
        camera = self.camera
        return [
            Kind(kind, f2 * ratio, camera.reduced_distance + height / camera.mla_medium)
            for height, ratio, (kind, f2) in itertools.product(
                self._heights, self._ratios, enumerate(camera.reduced_focal_lengths)
            )
        ]

    def enlargement(self, focal_length: Any, mla_distance: Any = None, scale: Any = 1.0) -> Any:
        r"""Return the mean enlargement of a kind's micro-images, relative to micro-images by rays through lens centres.

        Lenses turn direction cosines, so that slopes behind a lens grow faster than in proportion. Behind the point m
        of a lens of power n/f, in the light of one pupil point, areas grow by :math:`(1 - m^2 / f^2)^{-2}` in a medium
        of index n. The brightness falls by the reciprocal, whose mean over the lens is taken. `scale` enlarges the
        lenses; the focal length is reduced.
        """
        camera = self.camera
        distance = camera.pupil_distance if mla_distance is None else mla_distance
        square = (scale * (1 / focal_length - camera.lens_data.converges / distance) / camera.mla_medium) ** 2
        second, fourth = self._moments
        return (1 - 2 * second * square + fourth * square * square) ** -0.5

    @cached_property
    def _moments(self) -> Pair:
        """Means, over a lens's aperture, of the second and fourth power of the distance from its centre."""
        x, y = self.camera.lattice.aperture_grid(ACCURACY.moment_samples)
        square = x * x + y * y
        return float(square.mean()), float((square**2).mean())

    def number(self, i: Any, j: Any, height: Any) -> Any:
        """Return the index of each lens's kind."""
        camera = self.camera
        types = len(self.camera.mla_focal_lengths)
        kind = mi.UInt32(camera.lattice.lens_type(i, j)) if types > 1 else mi.UInt32(0)
        if len(self._ratios) > 1:
            kind += types * _nearest(camera.focal_factor(i, j), self._ratios)
        if len(self._heights) > 1:
            kind += types * len(self._ratios) * _nearest(height, self._heights)
        return kind

    @property
    def _phase(self) -> float:
        """Phase in radians at a lens's edge per unit of wavefront curvature in 1/mm."""
        return math.pi * float(self.camera.lattice.aperture_reach) ** 2 / in_millimetres(ACCURACY.kind_wavelength)

    @cached_property
    def _ratios(self) -> Doubles:
        """Factors on the focal lengths, one per kind."""
        most = MOST_DEVIATIONS * self.camera.mla_jitter[1]
        # The detector's distance replaces the focal lengths, which depend on the wavelength, as the kinds must not.
        return 1 + _steps(most, ACCURACY.kind_step / self._phase * self.camera.reduced_distance)

    @cached_property
    def _heights(self) -> Doubles:
        """Heights in mm of the lenses of a tilted array, one per kind."""
        camera = self.camera
        across, up = (math.tan(math.radians(abs(angle))) for angle in camera.mla_tilt)
        most = across * camera.detector_width / 2 + up * camera.detector_height / 2
        n = camera.mla_medium
        return _steps(most, ACCURACY.kind_step / self._phase * n * (camera.reduced_distance - most / n) ** 2)


def _steps(most: float, widest: float) -> Doubles:
    """Return the centres of equal steps, each at most `widest` wide, from -most to most."""
    count = max(1, math.ceil(2 * most / widest)) if most else 1
    return most * ((2 * np.arange(count) + 1) / count - 1)


def _nearest(value: Any, steps: Sequence[float] | Doubles) -> Any:
    """Return the index of the step nearest to each value."""
    first, width, last = (dr.opaque(mi.Float, float(n)) for n in (steps[0], steps[1] - steps[0], len(steps) - 1))
    return mi.UInt32(dr.clip(dr.floor((value - first) / width + 0.5), 0, last))
