r"""Sampling of the fields in back-propagation: the rules for pitches and windows, and the choice of grids.

Detector to MLA and MLA to main lens go by the angular spectrum, whose windows are periodic. The rules:

- *Pitch*: a grid of pitch d holds direction cosines up to :math:`\lambda / 2d`. Light between a point of one plane
  and a point of the next has the direction that the two points give, and nothing else is needed.
- *Window*: light leaves a grid in all directions that the grid holds. The window is wide enough that what wraps
  round falls outside the part of the next plane that is used.

What does not fit into memory goes up to the main lens in strips of the detector, whose fields are added there.

The last step, to an object plane, is one Fourier transform over the pupil. In the direction of the point X, with the
cosines :math:`s = X / |X|`, a wave from the pupil point P is behind that from the pupil's centre by

.. math:: |P - X| - |X| = -s \cdot P + \frac{P^2 - (s \cdot P)^2}{2 |X|} + \dots

The first term is the transform's, the next one is taken on the axis, so that it is the same for all points; at infinity
it vanishes. This neglects :math:`3 \theta^2 P^2 / 4 g` at the angle :math:`\theta` from the axis, a sixth of a wave at
the edge of the paper's field; nothing grows with the distance.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..camera import PlenopticCamera
from ..errors import refuse_if
from ..optics import rays
from ..optics.waves import in_millimetres
from ..runtime.fft import fast_length
from ..runtime.limits import memory_limit, require_memory
from ..system.microlenses import bend

Span = tuple[int, int]
Window = tuple[Span, Span]
"""First and past-the-last pixel of the full detector, in x and in y."""

GUARD = 1.05
"""Directions held over those that geometry needs, for the light that edges diffract."""

_MOST_TRANSFORMED = 2**35
"""Samples that one field's transforms go through, at most: some 100 times those of 4096 x 4096 pixels of the paper.

More takes many minutes.
"""

_STRIPS_MEMORY, _MEMORY = 5.5 * 2**30, 7 * 2**30
"""Bytes of fields from which on strips are taken, and beyond which a reconstruction is refused.

The whole process takes up to 2 GiB more than the fields.
"""

_DIRECTION_SAMPLES, _FINE_DIRECTION_SAMPLES = 2.5, 5.0
"""Samples of direction cosines over those that the field of a full pupil has, for one bin per lens and for finer ones.

The power has twice as many as the field. With the cubic integrals of `direction_bins` bins are within 0.2 % RMS of
those from many more samples; ten bins per lens, each as narrow as two samples, would be 2 % off with the fewer ones.
"""

OBJECT_MARGIN = 6.0
"""Bins around the geometric image in which light is retained; beyond three the edge of the pupil diffracts 0.5 %."""


@dataclass(frozen=True)
class AxisStep:
    """One axis of a propagation step, lengths in millimetres: its source samples, their window, and the next plane's.

    The field is zero beyond `count` samples from `first` on. Of the frequencies of the window of `padded` samples the
    lowest go to one of `new_padded` samples, `wanted` of which are taken from `start` on.
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
        """Width of the window."""
        return self.padded * self.pitch

    @property
    def held(self) -> int:
        """Frequencies that both windows have."""
        return min(self.padded, self.new_padded)

    @property
    def new_pitch(self) -> float:
        """Distance between destination samples."""
        return self.window / self.new_padded

    @property
    def source(self) -> np.ndarray:
        """Coordinates of the source samples, float64 (count,)."""
        return self.first + self.pitch * np.arange(self.count)

    @property
    def destination(self) -> np.ndarray:
        """Coordinates of the destination samples, float64 (wanted,)."""
        return self.start + self.new_pitch * np.arange(self.wanted)

    @property
    def reversed(self) -> AxisStep:
        """The step from the destination samples to the source samples."""
        return AxisStep(self.start, self.new_pitch, self.wanted, self.new_padded, self.padded, self.first, self.count)


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
        """Count and largest length of the transposed columns, whose memory source and destination share."""
        return self.x.held, max(self.y.count, self.y.wanted)

    @property
    def reversed(self) -> Step:
        """The step back."""
        return Step(self.x.reversed, self.y.reversed)

    @property
    def transforms(self) -> tuple[tuple[int, int, bool], ...]:
        """Fourier transforms of the step, in order: their count, their length, and whether they are inverse."""
        x, y = self.x, self.y
        return (
            (y.count, x.padded, False),
            (x.held, y.padded, False),
            (x.held, y.new_padded, True),
            (y.wanted, x.new_padded, True),
        )


@dataclass(frozen=True)
class Directions(Step):
    r"""The last step, from samples of the main lens to the lowest direction cosines; it ends at the spectrum.

    Cosines are multiples of the wavelength over the window. The step back leads to the samples of the main lens.
    """

    @property
    def transforms(self) -> tuple[tuple[int, int, bool], ...]:
        """The transforms to the spectrum."""
        return super().transforms[:2]


@dataclass(frozen=True)
class Strip:
    """Rows of the lit pixels that go to the main lens together; its samples are the same for all strips."""

    rows: slice
    to_mla: Step
    to_main_lens: Step


@dataclass(frozen=True)
class FieldPlan:
    """Field samples across a pixel, the strips of the detector, and the steps from the main lens to object planes."""

    subsamples: int
    strips: tuple[Strip, ...]
    to_objects: tuple[Directions, ...]

    @property
    def main_lens(self) -> Step:
        """A step to the samples of the main lens."""
        return self.strips[0].to_main_lens

    @property
    def steps(self) -> tuple[Step, ...]:
        """All steps."""
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


def field_subsamples(camera: PlenopticCamera, wavelength: float) -> int:
    r"""Field samples across a pixel on the detector.

    The pitch must hold the converging light of a whole cell, :math:`D_2 (b + z) / 2 b z` from the chief ray, and on
    the MLA the microlens's bend besides the light that the main lens accepts, so that what is bent beyond the grid's
    directions does not come back among those.
    """
    b, z = camera.mla_distance, camera.reduced_distance
    half_field = max(camera.detector_width, camera.detector_height) / 2
    converging = half_field / b + max(camera.mla_pitches) * (b + z) / (2 * b * z)
    accepted = (camera.aperture_radius + half_field) / b + bend(camera)
    return math.ceil(2 * camera.pixel_size * max(converging, accepted) / in_millimetres(wavelength))


def plan(
    camera: PlenopticCamera, wavelength: float, distances: Sequence[float], lit: Window, oversample: int = 1
) -> FieldPlan:
    """Choose the grids for one capture and some object distances: as few strips as memory allows."""
    rows = lit[1][1] - lit[1][0]
    count, made = 1, _plan(camera, wavelength, distances, lit, oversample, 1)
    while made.memory > min(_STRIPS_MEMORY, memory_limit()) and 2 * count <= rows:
        count *= 2
        finer = _plan(camera, wavelength, distances, lit, oversample, count)
        if finer.memory >= made.memory:
            break
        made = finer
    return made


def field_memory() -> float:
    """Return the bytes that the fields of a reconstruction may take."""
    return min(_MEMORY, memory_limit())


def _plan(
    camera: PlenopticCamera, wavelength: float, distances: Sequence[float], lit: Window, oversample: int, count: int
) -> FieldPlan:
    """Choose the grids for a given count of strips."""
    subsamples = field_subsamples(camera, wavelength)
    pitch = camera.pixel_size / subsamples
    across = _detector_step(camera, wavelength, 0, lit[0], pitch)
    borders = [lit[1][0] + (lit[1][1] - lit[1][0]) * index // count for index in range(count + 1)]
    spans = list(itertools.pairwise(borders))
    down = [_detector_step(camera, wavelength, 1, span, pitch) for span in spans]
    to_main_lens, to_objects = [], []
    for axis, steps in enumerate(([across], down)):
        ways, directions = _main_lens_steps(camera, wavelength, distances, axis, lit[axis], steps, oversample)
        to_main_lens.append(ways)
        to_objects.append(directions)
    strips = [
        Strip(slice(low - lit[1][0], high - lit[1][0]), Step(across, detector), Step(to_main_lens[0][0], way))
        for (low, high), detector, way in zip(spans, down, to_main_lens[1], strict=True)
    ]
    return FieldPlan(subsamples, tuple(strips), tuple(Directions(x, y) for x, y in zip(*to_objects, strict=True)))


def require_feasible(made: FieldPlan) -> None:
    """Refuse a plan that needs more memory than is allowed, or one of too much work."""
    what = f"camera with {made.subsamples} field samples a pixel; its wave reconstruction"
    require_memory(made.memory, what, limit=field_memory())
    refuse_if(
        made.transformed > _MOST_TRANSFORMED,
        f"{what}: {made.transformed:.2g} samples would be transformed, at most {_MOST_TRANSFORMED:.2g} are",
    )


def _detector_step(camera: PlenopticCamera, wavelength: float, axis: int, lit: Span, pitch: float) -> AxisStep:
    """Plan the step from pixels to the cells of their own lenses; light that leaves these cells misses the pupil.

    All directions are included, and the window has room for them on both sides.
    """
    b, z = camera.mla_distance, camera.reduced_distance
    count = round((lit[1] - lit[0]) * camera.pixel_size / pitch)
    first = (lit[0] - camera.resolution[axis] / 2) * camera.pixel_size + pitch / 2
    spread = math.ceil(z * in_millimetres(wavelength) / (2 * pitch) / pitch)
    low, high = _cells(camera, rays.chief_point(first + pitch * np.array([0, count - 1.0]), b, z), axis)
    wanted = math.ceil((high - low) / pitch - 1e-6)  # the width of cells is often a multiple of the pitch
    start = (low + high) / 2 - (wanted - 1) / 2 * pitch
    # Few pixels may belong to wide cells.
    padded = fast_length(max(count + 2 * spread, wanted))
    return AxisStep(first, pitch, count, padded, padded, float(start), wanted)


def _main_lens_steps(
    camera: PlenopticCamera,
    wavelength: float,
    distances: Sequence[float],
    axis: int,
    lit: Span,
    detector: Sequence[AxisStep],
    oversample: int,
) -> tuple[list[AxisStep], list[AxisStep]]:
    """Plan the steps from the MLA, in strips, to the main lens, and from there to the object planes."""
    b, radius, wave = camera.mla_distance, camera.aperture_radius, in_millimetres(wavelength)
    half_mla = max(abs(end) for step in detector for end in (step.destination[0], step.destination[-1]))
    extents = [object_extent(camera, distance, axis, lit) for distance in distances]
    # Directions that come to the main lens, and that leave it.
    steepest = GUARD * max([(radius + half_mla) / b, *(max(map(abs, light)) for light, _ in extents)])
    count = max(step.wanted for step in detector)
    pitch = detector[0].pitch
    padded = fast_length(max((half_mla + b * steepest + radius) / pitch, count))
    new_padded = min(fast_length(padded * pitch / (wave / (2 * steepest))), padded)
    new_pitch = padded * pitch / new_padded
    wanted = min(math.ceil(2 * radius / new_pitch) + 1, new_padded)
    start = -(wanted - 1) / 2 * new_pitch
    ways = [AxisStep(step.start, pitch, step.wanted, padded, new_padded, start, wanted) for step in detector]

    samples = _DIRECTION_SAMPLES if oversample == 1 else _FINE_DIRECTION_SAMPLES
    length = fast_length(max(samples * 2 * radius / new_pitch, wanted))
    cosine = wave / (length * new_pitch)
    most = [min(math.ceil(max(map(abs, seen)) / cosine) + 2, (length - 1) // 2) for _, seen in extents]
    directions = [AxisStep(start, new_pitch, wanted, length, 2 * count + 1, start, wanted) for count in most]
    return ways, directions


def _cells(camera: PlenopticCamera, ends: np.ndarray, axis: int) -> tuple[float, float]:
    """Extent of the cells that hold what lies between two coordinates of the MLA plane."""
    lattice = camera.lattice
    if lattice.axis_aligned:
        pitch = camera.mla_pitches[axis]
        low, high = lattice.axis_cell(ends, axis) * pitch + np.array([0, pitch])
        return float(low + lattice.offset[axis]), float(high + lattice.offset[axis])
    reach = lattice.cell_reach
    # A point is no farther than that from its centre, nor the cell's edge from the centre.
    return float(ends[0] - 2 * reach), float(ends[1] + 2 * reach)


def object_extent(
    camera: PlenopticCamera, distance: float, axis: int, lit: Span
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the ranges of slopes, from the main lens's centre, of the light of lit pixels and of that in bins.

    The two are equal if all of the light goes to bins.
    """
    b = camera.mla_distance
    spread = camera.blur_diameter(distance) / 2 / b + OBJECT_MARGIN * camera.mla_pitch / b
    edges = (np.array(lit) - camera.resolution[axis] / 2) * camera.pixel_size
    high, low = -rays.chief_point(edges, b, camera.reduced_distance) / b
    light = (float(low) - spread, float(high) + spread)
    half_field = camera.bin_count[axis] / 2 * camera.mla_pitch / b
    return light, (min(max(light[0], -half_field), half_field), max(min(light[1], half_field), -half_field))
