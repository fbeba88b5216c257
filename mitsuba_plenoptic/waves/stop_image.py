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

from ..array import Lattice, Lenslet
from ..camera import PlenopticCamera
from ..design import lenses_in_stop, objective_of, pupil_growth
from ..errors import refuse_if
from ..fields import OpticalSystem, opaque_lattice
from ..lenses import FourierLens, main_lens
from ..rays import LensChoice, Passage, Ray, Walk, deflects_cosines
from ..runtime import Array, Box, Doubles, Pair, drjit_array, single_threaded_blas
from .accuracy import FINER, USUAL
from .lens_functions import LegendreProducts
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
    centre: Pair
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
        # Slivers differ less than this from lenses without light.
        index, lit = index[lit > _ALIKE], lit[lit > _ALIKE]
        radius = float(objective_of(camera).blur_diameter(0)) / 2
        along = (np.arange(_SAMPLES) + 0.5) * (2 / _SAMPLES) - 1
        grid = np.meshgrid(along, along)
        uncut = LitPart(plain, (0.0, 0.0), math.inf)
        shapes = [np.asarray(uncut.power(*grid))]
        parts, kind = [uncut], []
        for centre in np.stack(lattice.centre(*index.T), -1).tolist():
            lit_part = LitPart(plain, tuple(centre), radius)
            shape = np.asarray(lit_part.power(*grid))
            apart = [abs(shape - known_shape).sum() / shapes[0].sum() for known_shape in shapes]
            nearest = int(np.argmin(apart))
            if apart[nearest] > _ALIKE:
                nearest = len(parts)
                parts.append(lit_part)
                shapes.append(shape)
            kind.append(nearest)
        refuse_if(
            len(parts) > _MOST_KINDS,
            f"main_lens = {camera.lens_data.label}: the edge of the stop's image cuts lenses to {len(parts) - 1} "
            f"different parts; wave captures take {_MOST_KINDS - 1}: take wider lenses, or one on the axis",
        )
        return cls(index, lit, np.array(kind), parts)


stop_lenses = functools.lru_cache(maxsize=4)(StopLenses.of)
"""Return the kinds of a camera's lenses, cached for further wavelengths and captures."""


class LensDiffraction(PupilDiffraction):
    """Diffraction of the lenses of one kind at one wavelength, as that of cameras without an array."""

    def __init__(
        self,
        camera: PlenopticCamera,
        wavelength: float,
        fine: bool = False,
        shortest: float | None = None,
        # Number of the kind; the first is that of whole lenses.
        kind: int = 0,
    ):
        lenses = stop_lenses(camera)
        lit_part = lenses.parts[kind]
        alone = PlenopticCamera(
            focal_length=camera.reduced_focal_lengths[0],
            aperture_radius=float(camera.lattice.aperture_reach),
            mla_distance=camera.reduced_distance,
            mla_lattice="none",
            detector_width=camera.detector_width,
            resolution=camera.resolution,
        )
        super().__init__(alone, wavelength, fine, shortest, lit_part, _MOST_CELLS)
        refuse_if(
            self.is_coarse,
            f"detector_width = {camera.detector_width:g}: pixels of {camera.pixel_size:.3g} mm are too coarse for the "
            f"diffraction of lenses, which is {self.unit:.3g} mm wide: wave captures of an array in the image of the "
            f"stop need pixels of {_MOST_CELLS * USUAL.airy_cell * self.unit:.2g} mm or less",
        )
        self.camera = camera
        self.system = OpticalSystem(camera, wavelength)
        self.options |= {"kind": kind}
        self.index = lenses.index[lenses.kind == kind]
        self._is_whole = kind == 0
        accuracy = FINER if fine else USUAL
        self._degree = accuracy.lens_degree if self._is_whole else accuracy.pupil_degree
        self._reach = alone.aperture_radius

    @cached_property
    @single_threaded_blas()
    def functions(self) -> Any:
        """Functions of a ray's point on the lens."""
        return LegendreProducts(*spread_points(self._pupil.power), self._degree, self._is_whole)

    def arguments(self, point: Pair, pupil: Pair) -> list:
        """Return the numbers of which a ray's coefficients are polynomials: its point on the lens over the reach."""
        return [coordinate / dr.opaque(mi.Float, self._reach) for coordinate in point]

    @cached_property
    def pixels(self) -> Box:
        """Pixels in the micro-images of these lenses, and around their edges."""
        camera = self.camera
        centre = np.stack(camera.lattice.centre(*self.index.T))
        half = MicroImages.of(camera, 1).half
        corners = [(centre + side * half).T / camera.pixel_size + np.array(camera.resolution) / 2 for side in (-1, 1)]
        margin = math.ceil(self.reach / camera.pixel_size) + 1
        window = Box(*camera.crop_offset, *camera.crop_size).within(margin)
        low = np.maximum(np.floor(corners[0].min(0)), (window.left, window.top))
        high = np.minimum(np.ceil(corners[1].max(0)), (window.left + window.columns, window.top + window.rows))
        return Box.between(low, np.maximum(high, low))


@dataclass(frozen=True)
class MicroImages:
    """Outline of micro-images about the centres of their lenses, in millimetres: a disc in a square."""

    radius: float
    half: float

    @classmethod
    def of(cls, camera: PlenopticCamera, parts: int) -> MicroImages:
        """Return the outline by the field stop, with blur out of focus and what is around pixels at the edge."""
        growth = pupil_growth(camera)
        blur = max(abs(camera.pupil_shift(f2)) for f2 in camera.mla_focal_lengths) / growth
        edge = float(camera.lattice.aperture_reach) * blur + camera.pixel_size * (1 + ORDER / parts) / math.sqrt(2)
        image = float(main_lens(camera).reach) / growth
        square = objective_of(camera).field_stop_shape == "square"
        return cls(image + edge, (image * math.sqrt(0.5) if square else image) + edge)


class StopSampler(DetectorGrid):
    """Sampler of the rays of the pixels of a camera in the Fourier arrangement, through random points of lenses."""

    control_factor = 1.0
    """Part of the control variate that rays subtract."""

    order = 2 * ORDER - 1

    enlargements = (1.0,)

    def __init__(self, camera: PlenopticCamera, plans: Sequence[LensDiffraction], parts: int = 1):
        super().__init__(camera, parts)
        opaque = functools.partial(dr.opaque, mi.Float)
        self.walk = replace(
            Walk.of(camera, plans[0].system.lens),
            lattice=opaque_lattice(camera, mi.Float),
            detector_distance=opaque(camera.detector_distance),
        )
        index = plans[0].index
        self.choice = LensChoice(
            tuple(map(tuple, index.tolist())), [drjit_array(mi.Float, column) for column in index.T], fixed=True
        )
        self._image = MicroImages.of(camera, parts)
        self._stop_radius = objective_of(camera).blur_diameter(0) / 2
        image = min(math.pi * self._image.radius**2, 4 * self._image.half**2)
        # Mean number of lenses of all kinds that light a pixel, in the middle of the detector.
        self.lit_lenses = min(image / camera.lattice.cell_area, float(stop_lenses(camera).area.sum()))

    def lights(self, lenses: CellLenses) -> Any:
        """Return whether light through the lenses can reach the pixels."""
        x, y = (abs(p - c) for p, c in zip(lenses.position, lenses.centre, strict=True))
        radius, half = (dr.opaque(mi.Float, length) for length in (self._image.radius, self._image.half))
        return (dr.hypot(x, y) <= radius) & (dr.maximum(x, y) <= half)

    def lenses(self, pixels: Pixels) -> CellLenses:
        """Return the centres of pixels and of the lenses through which they are lit."""
        position = self._middle(pixels)
        lens = self.walk.lenslet(*self.choice.at(position, pixels.lens))
        return CellLenses(position, lens.centre, lens.height, dr.zeros(mi.UInt32, dr.width(pixels.lens)), lens.gain)

    def power(self, samples: RaySamples) -> Any:
        """Return factors on the radiance of rays: étendue, transmission of lenses, and response of pixels."""
        ray = samples.ray
        power = self._response(ray.aside(ray.m), self.walk.detector_distance) * samples.lens.gain
        if self._camera.mla_medium == 1 and not deflects_cosines(self._camera):
            return power
        return power * self.walk.out_of_array(ray.p, Passage(ray.m, self._lens(samples.lens)))[1]

    def draw(self, pixels: Pixels, pixel: Any, ray_index: Any, cell: Any, seed: Any) -> RaySamples:
        """Return rays drawn for pixels; rays of even and of odd numbers are independent. See `LensSampler.draw`."""
        lenses, index = self.cells(self.lenses(pixels).at(pixel), pixel, cell)
        _, random, chance = self.numbers(pixels, pixel, ray_index, seed, 6)
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
        ray = Ray(
            start, m, field, dr.ones(mi.Float, dr.width(pixel)), in_stop & emerges & (lens.field_inset(*field) >= 0)
        )
        return RaySamples(ray, aside, aside, lenses, chance, pixel, index, ray_index)

    def _lens(self, lenses: CellLenses) -> Any:
        """Return the lenses with their focal lengths."""
        camera = self._camera
        if len(camera.mla_focal_lengths) == 1 and not camera.mla_jitter[1]:
            return Lenslet(lenses.centre, dr.opaque(mi.Float, camera.reduced_focal_lengths[0]), 0.0, lenses.gain)
        return self.walk.lenslet(*self.walk.lattice.cell(*lenses.centre))
