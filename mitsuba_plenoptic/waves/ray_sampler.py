"""Sampling of rays for signed-ray captures: from detector cells, through points around lenses and of the pupil.

Points around microlenses are drawn with a density close to that of the rays' light. At each node of a plan's table the
window around a lens is divided into strips, and each strip into cells; all cells receive equally many rays. Cells are
narrow where the first coefficient, which contains a ray's light, is large.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..fields import LensKinds, opaque_lattice
from ..optics import in_millimetres, second_leg
from ..rays import LensChoice, Ray, Walk, chances_of, low_discrepancy
from ..runtime import Box, Doubles, Floats, Pair, drjit_array, quotient
from .phase_space import PhaseSpace, TableNodes

_AIRY = 1024
"""Steps of the Airy pattern's energy table."""

ORDER = 2
"""Order of the B-spline that is the density of detector points drawn around a cell: it suppresses aliasing of
frequencies that the grid cannot represent."""

_CELLS = 64
"""Number of strips of a window, and of cells of a strip."""


@dataclass(frozen=True)
class Pixels:
    """Pixels of the detector, each paired with a lens."""

    # A rectangle of pixels.
    box: Box
    # Indices in the rectangle, row by row.
    index: Any
    # Indices of the lenses, or of the lens of all pixels, among those of `LensChoice`.
    lens: Any

    @property
    def number(self) -> Any:
        """A distinct number for each pair of a pixel and a lens."""
        return self.lens * dr.opaque(mi.UInt32, self.box.rows * self.box.columns) + self.index

    def take(self, indices: Any) -> Pixels:
        """Return a selection of the pairs of a pixel and a lens."""
        index, lens = (dr.gather(mi.UInt32, numbers, indices) for numbers in (self.index, self.lens))
        return replace(self, index=index, lens=lens)


class CellLenses(NamedTuple):
    """Detector cells or pixels, and the lenses through which they see the pupil."""

    # Centres of the cells or pixels, and of the lenses.
    position: Pair
    centre: Pair
    # Distance by which the lenses are nearer to the main lens than the lens on the axis.
    height: Any
    kind: Any
    # Relative brightness of the lenses.
    gain: Any = 1.0

    def at(self, pixel: Any) -> CellLenses:
        """Return those of some pixels, by index, computed once for all of their rays."""
        dr.eval(*self)
        position, centre = (
            tuple(dr.gather(mi.Float, value, pixel) for value in pair) for pair in (self.position, self.centre)
        )
        height, gain = (dr.gather(mi.Float, mi.Float(value), pixel) for value in (self.height, self.gain))
        return CellLenses(position, centre, height, dr.gather(mi.UInt32, mi.UInt32(self.kind), pixel), gain)


class RaySamples(NamedTuple):
    """Rays drawn for cells of the detector.

    The weight of a ray is the reciprocal of the density of its points, relative to the aperture.
    """

    ray: Ray
    # Their points on the round pupil that is equivalent to the pupil.
    round_pupil: Pair
    # Their points on the array, from the centres of the lenses, before the pupil's diffraction displaces the light.
    lens_point: Pair
    lens: CellLenses
    # Random numbers by which each ray takes one of the table nodes around it.
    chance: tuple[Any, Any, Any, Any]
    # Indices of their pixels and of their cells, and their numbers in the pixels.
    pixel: Any
    cell: Any
    number: Any


class DetectorGrid:
    """The grid of pixels, and of their cells, from which rays are drawn."""

    def __init__(self, camera: PlenopticCamera, parts: int):
        self._camera = camera
        self._parts = parts
        # Width of a cell in millimetres.
        self._step = camera.pixel_size / parts
        # Opaque values are kernel inputs, so that other values do not compile the kernels again.
        self._pixel, self._cell = (dr.opaque(mi.Float, width) for width in (camera.pixel_size, self._step))
        self._response = second_leg(camera.pixel_response or (), camera.mla_absorption or 0.0)

    def _middle(self, pixels: Pixels) -> Pair:
        """Return the centres of pixels."""
        camera = self._camera
        columns = dr.opaque(mi.UInt32, pixels.box.columns)
        left, top = (dr.opaque(mi.Int32, corner) for corner in (pixels.box.left, pixels.box.top))
        middles = [dr.opaque(mi.Float, 0.5 - 0.5 * size) for size in camera.resolution]
        row = quotient(pixels.index, pixels.box.columns)
        x, y = (
            (mi.Float(mi.Int32(index) + low) + middle) * self._pixel
            for middle, index, low in zip(middles, (pixels.index - row * columns, row), (left, top), strict=True)
        )
        return x, y

    def cosines(self, pixels: Pixels) -> Pair:
        """Return direction cosines on which no kernel depends."""
        nothing = dr.zeros(mi.Float, dr.width(pixels.index))
        return nothing, nothing

    def cosine_steps(self, kind: int) -> Doubles:
        """Return the changes (places, 2) of `cosines` from a pixel's centre to its cells."""
        return np.zeros((self._parts**2, 2))

    def cells(self, lenses: CellLenses, pixel: Any, cell: Any) -> tuple[CellLenses, Any]:
        """Return cells of some numbers in pixels, row by row, with the pixels' lenses, and their numbers among all."""
        row = quotient(cell, self._parts)
        x, y = (
            p + (mi.Float(index) + dr.opaque(mi.Float, 0.5 - self._parts / 2)) * self._cell
            for p, index in zip(lenses.position, (cell - row * dr.opaque(mi.UInt32, self._parts), row), strict=True)
        )
        return lenses._replace(position=(x, y)), pixel * dr.opaque(mi.UInt32, self._parts**2) + cell

    def numbers(self, pixels: Pixels, pixel: Any, ray_index: Any, seed: Any, count: int) -> tuple[Any, Any, Any]:
        """Return keys of pixels, and random numbers and chances of rays; even and odd rays' are independent."""
        lane = dr.gather(mi.UInt32, pixels.number, pixel)
        random = low_discrepancy(lane, seed ^ ((ray_index & 1) << 3), ray_index >> 1, count)
        return lane, random, chances_of(lane, seed ^ (ray_index << 4))


class LensSampler(DetectorGrid):
    """Sampler of the rays of a camera's detector cells.

    The rays of a pixel and a lens are numbered, cell by cell. Rays of even numbers, and rays of odd numbers, each
    follow a sequence that fills the lens evenly.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        plans: Sequence[PhaseSpace],
        # Count of cells across a pixel.
        parts: int = 1,
    ):
        super().__init__(camera, parts)
        lens = plans[0].system.lens
        waves = plans[0].waves
        opaque = functools.partial(dr.opaque, mi.Float)
        self._lattice = opaque_lattice(camera, mi.Float)
        self.walk = replace(
            Walk.of(camera, lens),
            lens=lens.opaque(opaque),
            lattice=self._lattice,
            detector_distance=opaque(camera.detector_distance),
        )
        self.kinds = LensKinds(camera)
        # With these plans the pupil point of a ray follows from its own point of the lens, not from the lens's centre.
        self.lands_by_point = plans[0].lands_by_point
        # Part of the control variate that rays subtract: the integral of coefficients is known where all rays of a cell
        # and a lens pass one point of the pupil.
        self.control_factor = 0.0 if self.lands_by_point else 1.0
        # Order of the B-splines by which rays are collected in addition to cells.
        self.order = 0 if self.lands_by_point else ORDER - 1
        self._pupil_shifts = drjit_array(
            mi.Float, np.array([waves.convergence(kind) * camera.pupil_distance for kind in waves.kinds])
        )
        # Factors by which micro-images are larger than those by rays through lens centres, for each kind of lenses.
        # Where rays land by their own points, the aberrations of a lens widen its spots, too.
        self.enlargements = [
            1.0 if self.lands_by_point else self.kinds.enlargement(kind.focal_length) for kind in waves.kinds
        ]
        self._longest = max(plans, key=lambda plan: plan.wavelength)
        # Half the width in mm, in the pupil's plane, of the image of a pixel and of what is around its cells.
        half = camera.pixel_size * (parts + ORDER - 1) / parts / 2 * camera.pupil_distance / camera.reduced_distance
        # Snell's law spreads them most at the corner, along the radius.
        corner = lens.pupil.slope(0.0, math.hypot(camera.detector_width, camera.detector_height) / 2)
        half *= (1 + (1 - camera.mla_medium**-2) * corner**2) ** 1.5
        # Radius in mm there that contains all rays.
        radius = lens.reach
        if self.lands_by_point:
            radius += float(camera.lattice.aperture_reach) * float(dr.max(dr.abs(self._pupil_shifts))[0])
        self._seen_by_pixels = radius, half
        # The lenses that can light a pixel, by the distance on the array of rays from one detector point to the pupil's
        # middle and its widest point.
        self.choice = LensChoice.of_pixels(camera, radius + half * math.sqrt(2), max(self.enlargements))

    @cached_property
    def _points(self) -> LensPoints:
        """Distribution of points around lenses for the longest wavelength, which is diffracted most."""
        return LensPoints(self._longest)

    def lights(self, lenses: CellLenses) -> Any:
        """Return whether light through the lenses can reach the pixels."""
        radius, half = (dr.opaque(mi.Float, length) for length in self._seen_by_pixels)
        # What lies outside the pupil of the square that is the image of a pixel and of what is around its cells.
        x, y = (dr.maximum(dr.abs(P) - half, 0) for P in self.seen(lenses.position, lenses))
        return dr.square(x) + dr.square(y) <= dr.square(radius)

    @property
    def lit_lenses(self) -> float:
        """Mean number of lenses that light a pixel, counted in the middle of the detector."""
        return _lit_lenses(self._camera, self._longest, self._parts)

    def lenses(self, pixels: Pixels) -> CellLenses:
        """Return the centres of pixels and of the lenses through which they are lit."""
        x, y = self._middle(pixels)
        _, cell = self.walk.chief_cell((x, y))
        i, j = self.choice.at(cell, pixels.lens)
        lens = self.walk.lenslet(i, j)
        return CellLenses((x, y), lens.centre, lens.height, self.kinds.number(i, j, lens.height), lens.gain)

    def seen(self, detector: Pair, lenses: CellLenses, point: Pair | None = None) -> Pair:
        """Return the pupil points whose light lands on detector points, as a mean over a lens or from its points."""
        centre = lenses.centre
        offset = self._chief(detector, lenses)
        # The points where light would land through the centres of the lenses are rounded as positions are.
        back = tuple(c - (c + step) for c, step in zip(centre, offset, strict=True))
        slopes, _ = self.walk.through_centre(back, lenses.height)
        pupil = tuple(self.walk.lens.pupil.point(c, t, lenses.height) for c, t in zip(centre, slopes, strict=True))
        if point is None or not self.lands_by_point:
            return pupil
        growth = dr.gather(mi.Float, self._pupil_shifts, lenses.kind)
        return tuple(P + growth * m for P, m in zip(pupil, point, strict=True))

    def power(self, samples: RaySamples) -> Any:
        """Return factors on the radiance of rays: étendue, transmission of pupil and lenses, and response of pixels."""
        inside, factor = self.outline(samples)
        return dr.select(inside >= 0, factor, 0.0)

    def through(self, position: Pair, point: Pair, lenses: CellLenses) -> RaySamples:
        """Return rays from detector points to what these see of the pupil, through points of lenses."""
        pupil = self.seen(position, lenses, point)
        passed = tuple(c + m for c, m in zip(lenses.centre, point, strict=True))
        ray = Ray(position, passed, pupil, mi.Float(1), mi.Bool(True))
        return RaySamples(ray, self.walk.round_pupil(pupil, lenses.centre), point, lenses, 4 * (None,), 0, 0, 0)

    def outline(self, samples: RaySamples) -> Pair:
        """Return how far rays are inside the pupil's edges, over its radius, and `power` as if edges were wider."""
        ray = samples.ray
        lens = samples.lens
        lattice = self._lattice
        offset = tuple(-p for p in self._chief(ray.p, lens))
        factor = self.walk.through_centre(offset, lens.height)[1] * lens.gain
        x, y = (P / dr.opaque(mi.Float, self._camera.pupil_radius) for P in samples.round_pupil)
        inside, passed = self._camera.pupil_outline((x, y), ray.m)
        # The path behind the lens starts within its aperture.
        u, v = lattice.to_frame(*samples.lens_point)
        across, up = lattice.aperture_widths
        x, y = lattice.from_frame(dr.clip(u, -across / 2, across / 2), dr.clip(v, -up / 2, up / 2))
        aside = dr.hypot(x - (ray.p[0] - lens.centre[0]), y - (ray.p[1] - lens.centre[1]))
        return inside, self._response(aside, self.walk.detector_distance + lens.height) * factor * passed

    def _chief(self, detector: Pair, lenses: CellLenses) -> Pair:
        """Return where light of detector points would land through the lens centres, from these."""
        if len(self.enlargements) > 1:
            larger = dr.gather(mi.Float, drjit_array(mi.Float, np.array(self.enlargements)), lenses.kind)
        else:
            larger = dr.opaque(mi.Float, self.enlargements[0])
        x, y = ((p - c) / larger for c, p in zip(lenses.centre, detector, strict=True))
        return x, y

    def cosines(self, pixels: Pixels) -> Pair:
        """Return the direction cosines, in the lattice frame, with which the light of pixels meets the array."""
        lenses = self.lenses(pixels)
        u, v = self._lattice.to_frame(*self._chief(lenses.position, lenses))
        # In the medium behind the lenses the sine is smaller by its index.
        scale = self._camera.mla_medium * dr.rsqrt(
            dr.square(self.walk.detector_distance + lenses.height) + u * u + v * v
        )
        return u * scale, v * scale

    def cosine_steps(self, kind: int) -> Doubles:
        """Return the changes (places, 2) of `cosines` from a pixel's centre to its cells, near the middle of a lens."""
        camera = self._camera
        along = (np.arange(self._parts) - (self._parts - 1) / 2) * self._step
        y, x = (coordinate.ravel() for coordinate in np.meshgrid(along, along, indexing="ij"))
        scale = camera.mla_medium / (camera.detector_distance * self.enlargements[kind])
        return np.column_stack(camera.lattice.to_frame(x, y)) * scale

    def draw(self, pixels: Pixels, pixel: Any, ray_index: Any, cell: Any, seed: Any) -> RaySamples:
        """Return rays drawn for pixels; rays of even and of odd numbers are independent.

        For each ray, `pixel` is the index of its pixel, `ray_index` its index among the rays of the pixel, and `cell`
        the index of its cell in the pixel.
        """
        lenses, index = self.cells(self.lenses(pixels).at(pixel), pixel, cell)
        lattice = self._lattice
        lane, random, chance = self.numbers(pixels, pixel, ray_index, seed, 4)
        within = [r - 0.5 if self.lands_by_point else tent(r) for r in random[2:]]
        x, y = (p + r * self._cell for p, r in zip(lenses.position, within, strict=True))
        if self.lands_by_point:
            # Diffraction at the whole pupil displaces light on the array by the Airy pattern.
            first, second = (mi.sample_tea_float32(lane, seed ^ (ray_index << 4) ^ word) for word in (11, 12))
            energy = first * (_AIRY - 1)
            low = mi.UInt32(energy)
            ends = (dr.gather(mi.Float, self._airy, step) for step in (low, low + 1))
            radius = dr.lerp(*ends, energy - low)
            sine, cosine = dr.sincos(2 * math.pi * second)
            point = lattice.aperture_point(*random[:2])
            aside = (radius * cosine, radius * sine)
            weight = dr.ones(mi.Float, dr.width(ray_index))
            pupil = self.seen((x, y), lenses, point)
            round_pupil = self.walk.round_pupil(pupil, lenses.centre)
        else:
            pupil = self.seen((x, y), lenses)
            round_pupil = self.walk.round_pupil(pupil, lenses.centre)
            aside = (0.0, 0.0)
            point, weight = self._points.draw(round_pupil, chance, random[:2])
        limit = dr.opaque(mi.Float, self._camera.pupil_radius**2)
        valid = dr.square(round_pupil[0]) + dr.square(round_pupil[1]) <= limit
        position = tuple(c + m - step for c, m, step in zip(lenses.centre, point, aside, strict=True))
        ray = Ray((x, y), position, pupil, weight, valid)
        return RaySamples(ray, round_pupil, point, lenses, chance, pixel, index, ray_index)

    @cached_property
    def _airy(self) -> Any:
        """Radii that encircle even steps of the Airy pattern's energy (Born and Wolf, section 8.5.2)."""
        from scipy.special import j0, j1

        camera = self._camera
        # 0.3 % of the energy lies beyond 200 units of lambda b / 2 pi R.
        v = np.linspace(0, 200.0, 1 << 14)
        energy = 1 - j0(v) ** 2 - j1(v) ** 2
        radius = np.interp(np.linspace(0, energy[-1], _AIRY), energy, v)
        wavelength = in_millimetres(self._longest.wavelength)
        unit = wavelength * camera.pupil_distance / (2 * math.pi * camera.pupil_radius)
        return drjit_array(mi.Float, radius * unit)


@functools.lru_cache(maxsize=16)
def _lit_lenses(camera: PlenopticCamera, plan: PhaseSpace, parts: int) -> float:
    """Return `LensSampler.lit_lenses`, cached for further captures of the camera."""
    sampler = LensSampler(camera, [plan], parts)
    # 256: Largest side in pixels of the square on which lenses that light a pixel are counted.
    side = min(256, *camera.resolution)
    left, top = ((size - side) // 2 for size in camera.resolution)
    box = Box(left, top, side, side)
    pixels = dr.arange(mi.UInt32, side * side)
    dr.eval(pixels)
    return sum(dr.width(index) for of_kind in lit(sampler, box, pixels) for index, _ in of_kind) / side**2


def lit(sampler: Any, box: Box, pixels: Any, has_rays: Any = True) -> list[list[Pair]]:
    """Return, for each kind of lenses, arrays of the indices of pixels, among some, and of the lenses lighting them.

    Only pixels of a mask are returned.
    """
    kinds: list[list[Pair]] = [[] for _ in sampler.enlargements]
    width = dr.width(pixels)
    count = len(sampler.choice.lenses)
    # 2**22: Approximate count of pairs of a pixel and a lens of which those with light are selected at once.
    together = max(1, min(count, 2**22 // width))
    for first in range(0, count, together):
        lane = dr.arange(mi.UInt32, width * min(together, count - first))
        lens = quotient(lane, width)
        index = lane - lens * dr.opaque(mi.UInt32, width)
        lens += dr.opaque(mi.UInt32, first)
        lenses = sampler.lenses(Pixels(box, dr.gather(mi.UInt32, pixels, index), lens))
        lights = sampler.lights(lenses)
        if has_rays is not True:
            lights &= dr.gather(mi.Bool, has_rays, index)
        masks = [lights & (lenses.kind == kind) for kind in range(len(kinds))]
        dr.eval(index, lens, masks)
        for of_kind, mask in zip(kinds, masks, strict=True):
            if dr.width(chosen := dr.compress(mask)):
                of_kind.append((dr.gather(mi.UInt32, index, chosen), dr.gather(mi.UInt32, lens, chosen)))
    return kinds


def tent(value: Any) -> Any:
    """Return numbers with the density 1 - |t|, a B-spline of order 2, from uniform random numbers."""
    return dr.select(value < 0.5, dr.sqrt(2 * value) - 1, 1 - dr.sqrt(2 * (1 - value)))


class LensPoints:
    """Sampler of points around lenses, for rays with the coefficients of a plan's table."""

    def __init__(self, plan: PhaseSpace):
        self._lattice = opaque_lattice(plan.camera, mi.Float)
        self._area = dr.opaque(mi.Float, float(plan.waves.lattice.lens_area))
        self._nodes = TableNodes(plan)
        # Plans that are expanded about one plan share the edges, as points may have any density.
        rows, columns = _edges(plan.start)
        first = np.cumsum([0] + [len(nodes) for nodes in plan.table])[:-1]
        self._first = drjit_array(mi.UInt32, first)
        self._sides = [drjit_array(mi.Float, sides) for sides in np.array([node.sides for node in plan.nodes]).T]
        self._rows, self._columns = (drjit_array(mi.Float, edges) for edges in (rows, columns))

    def draw(self, pupil: Pair, chance: Any, random: Any) -> tuple[Pair, Any]:
        """Return points around lenses for rays to pupil points, and the reciprocals of their density over a lens."""
        lattice = self._lattice
        Pu, Pv = lattice.to_frame(*pupil)
        _, radial = self._nodes.along(Pu, Pv, chance[0])
        index = dr.gather(mi.UInt32, self._first, radial) + self._nodes.around(Pu, Pv, radial, chance[1])
        offsets = []
        weight = 1 / self._area
        for axis, edges in ((1, self._rows), (0, self._columns)):
            ray_index = mi.UInt32(random[axis] * _CELLS)
            index = index * _CELLS + ray_index
            low, high = dr.gather(mi.Vector2f, edges, index)
            side = dr.gather(mi.Float, self._sides[axis], radial)
            offsets.append(dr.lerp(low, high, random[axis] * _CELLS - mi.Float(ray_index)) * side)
            weight *= (high - low) * side * _CELLS
        v, u = (dr.select(P < 0, -offset, offset) for P, offset in zip((Pv, Pu), offsets, strict=True))
        return lattice.from_frame(u, v), weight


@functools.lru_cache(maxsize=8)
def _edges(plan: PhaseSpace) -> list[Floats]:
    """Return the two edges of each strip of all nodes, and of each cell, in widths of the windows, as flat arrays."""
    divisions = [divided(density) for nodes in plan.table for density in densities_of(nodes[..., 0])]
    edges = (np.array(of_axis, np.float32) - np.float32(0.5) for of_axis in zip(*divisions, strict=True))
    # A ray reads both edges at once.
    return [np.stack([of_axis[..., :-1], of_axis[..., 1:]], axis=-1).ravel() for of_axis in edges]


def densities_of(values: Floats) -> Doubles:
    """Return the sampling densities over windows (n, rows, columns) of a coefficient, which may be negative."""
    square = np.square(values, dtype=np.float32)
    # Between samples a ray takes one of the nearest ones.
    for axis in (1, 2):
        pairs = square + np.roll(square, 1, axis)
        square = pairs + np.roll(pairs, -1, axis)
    root = np.sqrt(square)
    # 0.05: Part of the mean density that is added, as other coefficients may be nonzero where the first is 0.
    return (root + 0.05 * root.mean((1, 2), keepdims=True)).astype(np.float64)


def divided(density: Doubles) -> Pair:
    """Return the edges that divide a window into parts over which a piecewise constant density has equal integrals.

    The edges are those of the strips, (n + 1,), and of the cells in each strip, (n, n + 1).
    """
    rows, columns = density.shape
    upto = np.concatenate([np.zeros((1, columns)), np.cumsum(density, axis=0)])
    steps = np.linspace(0, 1, _CELLS + 1)
    total = upto.sum(1)
    edges = np.interp(steps * total[-1], total, np.arange(rows + 1))
    low = np.minimum(edges.astype(int), rows - 1)
    strips = np.diff(upto[low] + (edges - low)[:, None] * density[low], axis=0)
    sums = np.concatenate([np.zeros((_CELLS, 1)), np.cumsum(strips, axis=1)], axis=1)
    # All strips in one interpolation, each two units after the one before.
    behind = 2.0 * np.arange(_CELLS)[:, None]
    column = np.broadcast_to(np.arange(columns + 1.0), sums.shape)
    cells = np.interp((steps + behind).ravel(), (sums / sums[:, -1:] + behind).ravel(), column.ravel())
    return edges / rows, cells.reshape(_CELLS, -1) / columns
