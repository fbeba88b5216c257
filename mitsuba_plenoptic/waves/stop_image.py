r"""Diffraction and rays of an array in the image of the stop: each lens is an ordinary camera.

Light of a scene point arrives at a lens of the Fourier arrangement as one nearly plane wave. Its micro-image therefore
is that of a camera without an array whose pupil is the part of the lens in the stop's image (`pupil_diffraction`):
rays land by their own points of the lens, and one kernel a function spreads them. Lenses with equal parts are of one
kind. Rays are cut at the field stop, which itself diffracts nothing here.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..array import Lattice
from ..camera import PlenopticCamera
from ..design import lenses_in_stop, pupil_growth
from ..errors import refuse_if
from ..fields import OpticalSystem, opaque_lattice
from ..lenses import FourierLens
from ..rays import LensChoice, Passage, Ray, Walk, chances_of, low_discrepancy
from ..runtime import Array, Doubles, Pair, drjit_array, single_threaded_blas
from .accuracy import FINER, USUAL
from .lens_functions import LegendreProducts
from .oblique import Oblique
from .pupil_diffraction import PupilDiffraction
from .pupil_samples import spread_points
from .ray_sampler import ORDER, CellLenses, DetectorGrid, Pixels, RaySamples, tent

_MOST_KINDS = 32
"""Most kinds of lenses."""

_ALIKE = 0.01
"""Part of a lens by which the lit parts of lenses of one kind may differ."""

_SAMPLES = 64
"""Samples across a lens by which lit parts are compared."""

_MOST_CELLS = 8
"""Most cells across a pixel."""


@dataclass(frozen=True)
class LitPart:
    """The part of a lens that the stop's image lights, over the greatest distance of its points from the centre."""

    lattice: Lattice
    # Centre of the lens, and radius of the stop's image, in millimetres.
    centre: tuple[float, float]
    stop_radius: float

    def power(self, x: Any, y: Any) -> Any:
        """Return 1 at points of the part, and 0 elsewhere."""
        across, up = (coordinate * float(self.lattice.aperture_reach) for coordinate in (x, y))
        in_stop = np.hypot(across + self.centre[0], up + self.centre[1]) <= self.stop_radius
        return np.where(in_stop & self.lattice.in_aperture(across, up), 1.0, 0.0)


@dataclass(frozen=True)
class StopLenses:
    """The kinds of the lenses that the stop's image lights."""

    # Indices (lenses, 2) of the lenses, the lit part of the area of each, the kind of each, and the part of each kind.
    index: Array
    area: Doubles
    kind: Array
    parts: list[LitPart]

    @classmethod
    def of(cls, camera: PlenopticCamera) -> StopLenses:
        """Return the lenses of a camera; refuse more kinds than captures take."""
        lattice = camera.lattice
        plain = replace(lattice, displacement=None)
        index, lit = lenses_in_stop(camera)
        radius = float(camera.main_lens.blur_diameter(0)) / 2
        along = (np.arange(_SAMPLES) + 0.5) * (2 / _SAMPLES) - 1
        grid = np.meshgrid(along, along)
        whole = LitPart(plain, (0.0, 0.0), math.inf)
        shapes = [np.asarray(whole.power(*grid))]
        parts, kind = [whole], []
        for centre in np.stack(lattice.centre(*index.T), -1).tolist():
            part = LitPart(plain, tuple(centre), radius)
            shape = np.asarray(part.power(*grid))
            apart = [abs(shape - other).sum() / shapes[0].sum() for other in shapes]
            nearest = int(np.argmin(apart))
            if apart[nearest] > _ALIKE:
                nearest = len(parts)
                parts.append(part)
                shapes.append(shape)
            kind.append(nearest)
        refuse_if(
            len(parts) > _MOST_KINDS,
            f"main_lens = {camera.lens_data.label}: the edge of the stop's image cuts lenses to {len(parts) - 1} "
            f"different parts; wave captures take {_MOST_KINDS - 1}: take wider lenses, or an array in the axis",
        )
        return cls(index, lit, np.array(kind), parts)


stop_lenses = functools.lru_cache(maxsize=4)(StopLenses.of)
"""Return the kinds of a camera's lenses, cached for further wavelengths and captures."""


class LensDiffraction(PupilDiffraction):
    """Diffraction of the lit part of a lens at one wavelength."""

    tolerance = 0.002
    combines = True

    def __init__(self, alone: PlenopticCamera, wavelength: float, fine: bool, shortest: float | None, part: LitPart):
        """Take the lens and the detector behind it as a camera without an array."""
        super().__init__(alone, wavelength, fine, shortest, part, _MOST_CELLS)
        refuse_if(
            self.is_coarse,
            f"detector_width = {alone.detector_width:g}: pixels of {alone.pixel_size:.3g} mm are too coarse for the "
            f"diffraction of lenses, which is {self.unit:.3g} mm wide: wave captures of an array in the image of the "
            f"stop need pixels of {_MOST_CELLS * USUAL.airy_cell * self.unit:.2g} mm or less",
        )
        self._symmetric = math.isinf(part.stop_radius)
        accuracy = FINER if fine else USUAL
        self._degree = accuracy.lens_degree if self._symmetric else accuracy.pupil_degree

    @cached_property
    @single_threaded_blas()
    def functions(self) -> Any:
        """Functions of a ray's point on the lens."""
        return LegendreProducts(*spread_points(self._pupil.power), self._degree, self._symmetric)


class StopImage:
    """Diffraction of a camera in the Fourier arrangement at one wavelength: a `PupilDiffraction` for each kind."""

    lands_by_point = True
    """Every ray lands by its own point, and its coefficients are polynomials."""

    def __init__(self, camera: PlenopticCamera, wavelength: float, fine: bool = False, shortest: float | None = None):
        self.camera = camera
        self.wavelength = wavelength
        self.options: dict[str, Any] = {"fine": fine, "shortest": shortest}
        self.system = OpticalSystem(camera, wavelength)
        self.lenses = stop_lenses(camera)
        # A lens and the detector behind it.
        alone = PlenopticCamera(
            focal_length=camera.reduced_focal_lengths[0],
            aperture_radius=float(camera.lattice.aperture_reach),
            mla_distance=camera.reduced_distance,
            mla_lattice="none",
            detector_width=camera.detector_width,
            resolution=camera.resolution,
        )
        self.kinds: list[LensDiffraction] = [
            LensDiffraction(alone, wavelength, fine, shortest, part) for part in self.lenses.parts
        ]
        self.reach = self.kinds[0].reach
        self.widths = self.kinds[0].widths

    def parts(self, fine: bool) -> int:
        """Return the number of cells of the grid across a pixel."""
        return self.kinds[0].parts(fine)

    def of_kind(self, kind: int) -> LensDiffraction:
        """Return the diffraction of a kind of lenses."""
        return self.kinds[kind]

    @property
    def oblique(self) -> Oblique:
        """Changes of the kernels with the direction of light, of which there are none."""
        return self.kinds[0].oblique

    def spots(self, places: Doubles) -> Doubles:
        """Return the point spread function of a whole lens in focus, as `PupilDiffraction.spots`."""
        return self.kinds[0].spots(places)

    def kernels(self, step: float, reach: float, kind: int = 0) -> Doubles:
        """Return the kernels of a kind of lenses, as `PupilDiffraction.kernels`."""
        return self.kinds[kind].kernels(step, reach)


class StopSampler(DetectorGrid):
    """Sampler of the rays of the pixels of a camera in the Fourier arrangement, through random points of lenses."""

    control_factor = 1.0
    """Part of the control variate that rays subtract."""

    order = 2 * ORDER - 1

    def __init__(self, camera: PlenopticCamera, plans: Sequence[StopImage], parts: int = 1) -> None:
        super().__init__(camera, parts)
        opaque = functools.partial(dr.opaque, mi.Float)
        self.walk = replace(
            Walk.of(camera, plans[0].system.lens),
            lattice=opaque_lattice(camera, mi.Float),
            detector_distance=opaque(camera.detector_distance),
        )
        self.choice = LensChoice.of_points([camera])
        lenses = plans[0].lenses
        self.enlargements = [1.0] * len(lenses.parts)
        # Kinds of the lenses in the rectangle of indices around them, with a border of lenses without light.
        self._first = lenses.index.min(0) - 1
        table = np.full(lenses.index.max(0) - self._first + 2, len(lenses.parts))
        table[tuple((lenses.index - self._first).T)] = lenses.kind
        self._columns, self._rows = table.shape
        self._kinds = drjit_array(mi.UInt32, table.T.ravel())
        # Radius in mm of a micro-image, with what is around its edge: pixels, and blur of lenses out of focus.
        growth = pupil_growth(camera)
        blur = max(abs(camera.pupil_shift(f2)) for f2 in camera.mla_focal_lengths) / growth
        edge = float(camera.lattice.aperture_reach) * blur + camera.pixel_size * (1 + ORDER / parts) / math.sqrt(2)
        self._radius = float(plans[0].system.lens.reach) / growth + edge
        self._side = math.inf
        if camera.main_lens.field_stop_shape == "square":
            self._side = (self._radius - edge) / math.sqrt(2) + edge
        self._stop_radius = camera.main_lens.blur_diameter(0) / 2
        area = min(math.pi * self._radius**2, 4 * self._side**2)
        # Mean number of lenses that light a pixel, in the middle of the detector.
        self.lit_lenses = min(area / camera.lattice.cell_area, float(lenses.area.sum()))

    def lights(self, lenses: CellLenses) -> Any:
        """Return whether light through the lenses can reach the pixels."""
        x, y = (abs(p - c) for p, c in zip(lenses.position, lenses.centre, strict=True))
        radius, side = (dr.opaque(mi.Float, length) for length in (self._radius, self._side))
        near = (dr.hypot(x, y) <= radius) & (dr.maximum(x, y) <= side)
        return near & (lenses.kind < len(self.enlargements))

    def lenses(self, pixels: Pixels) -> CellLenses:
        """Return the centres of pixels and of the lenses through which they are lit."""
        x, y = self._middle(pixels)
        _, cell = self.walk.chief_cell((x, y))
        i, j = self.choice.at(cell, pixels.lens)
        lens = self.walk.lenslet(i, j)
        column, row = (
            dr.clip(mi.Int32(index) - int(first), 0, size - 1)
            for index, first, size in zip((i, j), self._first, (self._columns, self._rows), strict=True)
        )
        kind = dr.gather(mi.UInt32, self._kinds, mi.UInt32(row * self._columns + column))
        return CellLenses((x, y), lens.centre, lens.height, kind, lens.gain)

    def cosines(self, pixels: Pixels) -> Pair:
        """Return direction cosines on which no kernel depends."""
        nothing = dr.zeros(mi.Float, dr.width(pixels.index))
        return nothing, nothing

    def cosine_steps(self, kind: int) -> Doubles:
        """Return the changes (places, 2) of `cosines` from a pixel's centre to its cells."""
        return np.zeros((self._parts**2, 2))

    def power(self, samples: RaySamples) -> Any:
        """Return factors on the radiance of rays: étendue, transmission of lenses, and response of pixels."""
        ray = samples.ray
        slope = [m - p for m, p in zip(ray.m, ray.p, strict=True)]
        passage = Passage(ray.m, self._lens(samples.lens))
        _, even, _ = self.walk.out_of_array(ray.p, passage)
        return self._response(dr.hypot(*slope), self.walk.detector_distance) * samples.lens.gain * even

    def draw(self, pixels: Pixels, pixel: Any, ray_index: Any, cell: Any, seed: Any) -> RaySamples:
        """Return rays drawn for pixels; rays of even and of odd numbers are independent. See `LensSampler.draw`."""
        lenses, index = self.cells(self.lenses(pixels).at(pixel), pixel, cell)
        lane = dr.gather(mi.UInt32, pixels.number, pixel)
        random = low_discrepancy(lane, seed ^ ((ray_index & 1) << 3), ray_index >> 1, 6)
        # Sums of two numbers with the density of a B-spline of order 2.
        start = tuple(
            p + (tent(a) + tent(b)) * self._step
            for p, a, b in zip(lenses.position, random[2:4], random[4:], strict=True)
        )
        aside = self.walk.lattice.aperture_point(*random[:2])
        m = tuple(c + step for c, step in zip(lenses.centre, aside, strict=True))
        slope, _, emerges = self.walk.out_of_array(start, Passage(m, self._lens(lenses)))
        lens = self.walk.lens
        assert isinstance(lens, FourierLens)
        field = tuple(lens.window.point(at, t) for at, t in zip(m, slope, strict=True))
        in_stop = dr.square(m[0]) + dr.square(m[1]) <= dr.opaque(mi.Float, self._stop_radius**2)
        ray = Ray(start, m, field, dr.ones(mi.Float, dr.width(pixel)), in_stop & emerges & lens.in_field(*field))
        chance = chances_of(lane, seed ^ (ray_index << 4))
        return RaySamples(ray, aside, aside, lenses, chance, pixel, index, ray_index)

    def _lens(self, lenses: CellLenses) -> Any:
        """Return the lenses with their focal lengths."""
        return self.walk.lenslet(*self.walk.lattice.cell(*lenses.centre))
