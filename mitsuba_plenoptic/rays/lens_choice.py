"""The lenses that light a pixel: those of which rays draw one, and those through which signed rays see the pupil.

Both are steps in the lattice's indices from the lens of the pixel's chief ray. `design.crosstalk_neighbours` finds them
by slopes; lenses that deflect direction cosines light pixels farther outside, which `cosine_limits` adds.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..array import MOST_DEVIATIONS
from ..camera import PlenopticCamera
from ..design import crosstalk_neighbours, crosstalk_reach, pupil_growth
from ..errors import refuse_if
from ..lenses import chief_points, main_lens
from ..runtime import Array, Pair, Shape, drjit_array
from .tracer import Walk, deflects_cosines

_SECTORS = 12
"""Directions in which the reach of light behind lenses that deflect direction cosines is stated."""

_LENS_POINTS = 9
_ANGLES = 16
"""Points across a lens, and angles around the pupil and the field, from which this reach is computed."""

_FIELD_STEPS = 8
"""Steps of the distance from the axis in which it is tabulated."""

_MOST_LENSES = 2**12
"""Most lenses that may light a pixel of a wave capture; each takes kernels and rays of its own."""


@dataclass(frozen=True)
class LensChoice:
    """The lenses around a chief ray's lens that can light a point or a pixel."""

    # Steps in the lattice's indices, of which the first is the chief ray's own lens, or the indices of `fixed` lenses,
    # and their two columns for kernels.
    lenses: tuple[Shape, ...]
    steps: Sequence = ()
    # Distances from the chief ray's point within which the centres of lenses are tried, as of `cosine_limits`, by steps
    # of the distance from the axis, and the width of a step; None where all lenses are tried.
    limits: Any = None
    step: Any = 1.0
    # Change of the limits per relative change of a lens's focal length.
    defocus: Any = 0.0
    # Whether all points are lit by the same lenses: those of the Fourier arrangement that the stop's image lights.
    fixed: bool = False
    # Whether the limits are along either axis, for a square field stop.
    square: bool = False

    @classmethod
    def of_points(cls, cameras: Sequence[PlenopticCamera], beyond: float = 0.0) -> LensChoice:
        """Return the lenses that light detector points of a camera, given at the wavelengths that need the most."""
        camera = cameras[0]
        reach = max(crosstalk_reach(of_wavelength) for of_wavelength in cameras)
        across = camera.lattice.aperture_reach * camera.pupil_distance
        # Change of the reach per relative change of a lens's power.
        defocus = max(
            float(across / min(of_wavelength.reduced_focal_lengths) / pupil_growth(of_wavelength))
            for of_wavelength in cameras
        )
        # Displaced lenses are nearer, and irregular ones move their light, by at most this distance.
        beyond += camera.nearer(reach) + MOST_DEVIATIONS * camera.mla_jitter[1] * defocus
        lenses = max((crosstalk_neighbours(of_wavelength, beyond=beyond) for of_wavelength in cameras), key=len)
        limits = np.full(_SECTORS, reach)
        step = 1.0
        if deflects_cosines(camera):
            corner = math.hypot(*(np.abs(camera.pixel_coordinates(axis)).max() for axis in (0, 1)))
            radius = float(main_lens(camera).pupil.chief(corner + camera.pixel_size, camera.reduced_distance))
            radii = np.linspace(0, radius, _FIELD_STEPS + 1)
            step = radius / _FIELD_STEPS
            limits = np.max([cosine_limits(of_wavelength, radii) for of_wavelength in cameras], axis=0)
            # A step has the limits of both of its ends.
            limits = np.maximum(limits[:-1], limits[1:])
            lenses = max(lenses, camera.lattice.neighbours(limits.max() + beyond), key=len)
        fixed = square = False
        if camera.lens_data.images_stop:
            from ..design import lenses_in_stop, objective_of

            lit, _ = lenses_in_stop(camera)
            refuse_if(not len(lit), "camera: no lens lies in the image of the stop; take narrower lenses")
            if fixed := len(lit) < len(lenses):
                lenses = lit
            if square := objective_of(camera).field_stop_shape == "square":
                # Half of the square's side, where the reach has half of its diagonal.
                limits = limits - (1 - math.sqrt(0.5)) * main_lens(camera).reach / pupil_growth(camera)
        # Most rays through lenses that cannot light a point would miss the pupil, and the others would be noisier.
        # 64: Largest number of lenses of which those that can light a point are counted for each ray.
        checks = 1 < len(lenses) <= 64
        numbers = [drjit_array(mi.Float, values) for values in (*lenses.T, limits, step, defocus)]
        dr.make_opaque(numbers)
        choice = cls(tuple(map(tuple, lenses.tolist())), numbers[:2], *(numbers[2:] if checks else ()))
        return replace(choice, fixed=fixed, square=square)

    @classmethod
    def of_pixels(cls, camera: PlenopticCamera, radius: float, enlargement: float) -> LensChoice:
        """Return the lenses of which the light of a pupil of some radius, with a pixel's image, reaches pixels."""
        reach = radius / pupil_growth(camera) * enlargement
        lenses = camera.lattice.neighbours(reach + camera.nearer(reach))
        many = f"aperture_radius = {camera.aperture_radius:g}: {len(lenses)} lenses may light a pixel"
        refuse_if(len(lenses) > _MOST_LENSES, f"{many}; waves of scenes are captured through at most {_MOST_LENSES}")
        return cls(tuple(map(tuple, lenses.tolist())), [drjit_array(mi.Float, column) for column in lenses.T])

    def at(self, chief: Pair, lens_number: Any) -> Pair:
        """Return the indices of lenses by their numbers, from those of the chief rays' lenses."""
        i, j = (dr.gather(mi.Float, step, lens_number) for step in self.steps)
        return (i, j) if self.fixed else (chief[0] + i, chief[1] + j)

    def is_near(self, walk: Walk, chief: Pair, i: Any, j: Any) -> Any:
        """Return whether lenses are close enough to the chief rays' points to be tried."""
        if self.limits is None:
            return mi.Bool(True)
        x, y = (c - p for c, p in zip(walk.lattice.centre(i, j), chief, strict=True))
        # The angle between the directions towards the lens and away from the axis.
        angle = abs(dr.atan2(x * chief[1] - y * chief[0], x * chief[0] + y * chief[1]))
        sector = dr.minimum(dr.floor(angle * (_SECTORS / math.pi)), _SECTORS - 1)
        row = dr.floor(dr.minimum(dr.hypot(*chief) / self.step, dr.width(self.limits) // _SECTORS - 1))
        limit = dr.gather(mi.Float, self.limits, mi.UInt32(row * _SECTORS + sector))
        if walk.camera.mla_jitter[1]:
            limit += abs(1 - 1 / walk.camera.focal_factor(i, j)) * self.defocus
        return (dr.maximum(abs(x), abs(y)) if self.square else dr.hypot(x, y)) <= limit

    def draw(self, walk: Walk, pixel: Pair, sample: Any) -> tuple[Pair, Any, Any, Any]:
        """Return a random lens for each point, the unused rest of the sample, its number, and how many were tried."""
        chief, cell = walk.chief_cell(pixel)
        count = len(self.lenses)
        within = mi.Float(sample)
        if count == 1:
            return cell, within, mi.UInt32(0), mi.Float(1)
        tried = mi.Float(count)
        near = []
        if self.limits is not None:
            near = [self.is_near(walk, chief, *self.at(cell, mi.UInt32(index))) for index in range(count)]
            if not self.fixed:
                # Rounding must not leave a point without its own lens.
                near[0] = mi.Bool(True)
            tried = dr.maximum(sum((dr.select(mask, 1, 0) for mask in near), mi.Float(0)), 1)
        scaled = within * tried
        chosen = dr.minimum(dr.floor(scaled), tried - 1)
        drawn = mi.UInt32(chosen)
        passed = mi.Float(0)
        for index, is_tried in enumerate(near):
            drawn = dr.select(is_tried & (passed == chosen), index, drawn)
            passed += dr.select(is_tried, 1, 0)
        return self.at(cell, drawn), scaled - chosen, drawn, tried


CHIEF = LensChoice(((0, 0),))
"""The chief ray's lens alone."""


def cosine_limits(camera: PlenopticCamera, radii: Array) -> Array:
    """Return how far from the chief ray's point cosine-deflecting lenses light a pixel, in mm, (radii, sectors).

    Slopes, by which `design.crosstalk_neighbours` follows rays, fall short of the light through the edges of such
    lenses. This is the greatest distance of a lens, at a distance from the axis, from the chief ray's point, among rays
    from the pupil's rim. Sectors divide the angles from 0 to 180 degrees between the directions towards the lens and
    away from the axis.
    """
    lens = main_lens(camera)
    z = camera.detector_distance
    n = camera.mla_medium
    s, t = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0, 1, _LENS_POINTS)] * 2))
    offset = np.stack(camera.lattice.aperture_point(s, t))[:, :, None, None]
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    around = np.stack([np.cos(angle), np.sin(angle)])
    pupil = lens.reach * around[:, None, :, None]
    # Cells and the pupil look alike from opposite sides of the field.
    away = around[:, None, None, : _ANGLES // 2]
    limits = np.zeros((len(radii), _SECTORS))
    for (row, radius), f2 in itertools.product(enumerate(radii), camera.reduced_focal_lengths):
        slope = lens.window.slope(pupil, radius * away + offset)
        cosine = slope / np.sqrt(1 + (slope**2).sum(0))
        behind = (cosine - np.stack(camera.microlens.deflection(camera.lattice, offset[0], offset[1], f2))) / n
        square = (behind**2).sum(0)
        # The rest is reflected totally.
        passes = square < 1
        position = radius * away + offset - z * behind / np.sqrt(np.where(passes, 1 - square, 1))
        towards = radius * away - np.stack(chief_points(lens, (position[0], position[1]), z, n))
        distance = np.hypot(*towards) * passes
        sector = np.arccos(np.clip((towards * away).sum(0) / np.maximum(distance, 1e-12), -1, 1)) * (_SECTORS / np.pi)
        np.maximum.at(limits[row], np.minimum(sector.astype(int), _SECTORS - 1), distance)
    # Points between the samples reach into neighbouring sectors, and a little farther.
    padded = np.pad(limits, [(0, 0), (1, 1)], mode="edge")
    # 1.03: Factor on it for points between the samples.
    return 1.03 * np.max([padded[:, i : i + _SECTORS] for i in range(3)], axis=0)
