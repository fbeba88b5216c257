r"""Sampling of the fields in back-propagation: rules for pitches and windows, and the choice of grids.

From detector to MLA, light is propagated by the angular spectrum, whose windows are periodic. From the MLA over the
distance b to the main lens there are two steps: free space is the paraxial transfer function times the non-paraxial
rest,

.. math:: e^{i k b (\sqrt{1 - s^2} - 1)} = e^{-i k b s^2 / 2} \; e^{i k b (\sqrt{1 - s^2} - 1 + s^2 / 2)} .

The second factor displaces light by only :math:`b s^3 / 2` and is applied in the plane of the MLA. The first one is a
single Fourier transform of the field times :math:`\exp(i \pi m^2 / \lambda b)`, with :math:`P / \lambda b` as the
frequency (Goodman, "Introduction to Fourier Optics", section 4.2): it needs samples for the light that goes to the main
lens, but none between the two planes. The rules:

- *Pitch*: a grid of pitch d holds a range :math:`\lambda / d` of direction cosines. On the detector they are those of
  the light that converges to the MLA. Behind a microlens, light of other directions must not be taken for light to the
  main lens; that is a matter of the directions from one lens, as all light at a place comes from the same one. On the
  main lens, whose phase comes first, the directions are those of the light to the object plane.
- *Window*: light leaves a grid in all directions that the grid holds. The window is wide enough that what wraps
  round falls outside the part of the next plane that is used.

Fields too large for the memory are propagated to the main lens in strips of the detector, and added there.

The last step, to an object plane, is one Fourier transform over the pupil. In the direction of the point X, with the
cosines :math:`s = X / |X|`, a wave from the pupil point P lags behind the wave from the pupil's centre by

.. math:: |P - X| - |X| = -s \cdot P + \frac{P^2 - (s \cdot P)^2}{2 |X|} + \dots

The first term is the Fourier kernel; the second one is evaluated on the axis, so that it is the same for all points,
and vanishes at infinity. This neglects :math:`3 \theta^2 P^2 / 4 g` at the angle :math:`\theta` from the axis, a sixth
of a wave at the edge of the paper's field; the error does not grow with the distance.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import j0, j1

from ..camera import PlenopticCamera
from ..errors import refuse_if
from ..fields import AxisStep, Directions, LensAxis, Step, bend
from ..optics import guards, in_millimetres, rays
from ..runtime import Array, Pair, Shape, check_memory, fft, work_limit

Span = Shape
Window = tuple[Span, Span]
"""First and past-the-last pixel of the full detector, in x and in y."""

GUARD = 1.05
"""Directions held over those that geometry needs, for the light that edges diffract."""

_MOST_TRANSFORMED = 2**35
"""Samples that one field's transforms go through, at most: some 100 times those of 4096 x 4096 pixels of the paper.

More takes many minutes.
"""

_STRIPS_MEMORY = 5.5 * 2**30
FIELD_MEMORY = 7 * 2**30
"""Bytes of fields from which on strips are taken, and beyond which a reconstruction is refused.

The whole process takes up to 2 GiB more than the fields.
"""

_DIRECTION_SAMPLES = 2.5
_FINE_DIRECTION_SAMPLES = 5.0
"""Samples of direction cosines over those that the field of a full pupil has, for one bin per lens and for finer ones.

The power has twice as many as the field. With the cubic integrals of `direction_bins` bins are within 0.2 % RMS of
those from many more samples; ten bins per lens, each as narrow as two samples, would be 2 % off with the fewer ones.
"""


OBJECT_MARGIN = 6.0
"""Bins around the geometric image in which light is retained; beyond three the edge of the pupil diffracts 0.5 %."""


@dataclass(frozen=True)
class Strip:
    """Rows of lit pixels propagated together to the main lens, where all strips have the same samples.

    The step `beyond_paraxial` stays in the plane of the MLA; `to_main_lens` is the paraxial transform from there.
    """

    rows: slice
    to_mla: Step
    beyond_paraxial: Step
    to_main_lens: Directions

    @property
    def steps(self) -> tuple[Step, ...]:
        """All steps of the strip, in their order."""
        return self.to_mla, self.beyond_paraxial, self.to_main_lens


@dataclass(frozen=True)
class FieldPlan:
    """Field samples across a pixel, the detector's strips, and the steps from the main lens to object planes.

    `pupil` are the main lens's samples along x and y, `bins` the bins along x and y of each object plane.
    """

    subsamples: int
    strips: tuple[Strip, ...]
    pupil: tuple[LensAxis, LensAxis]
    to_objects: tuple[Directions, ...]
    bins: Shape

    @property
    def steps(self) -> tuple[Step, ...]:
        """All steps of the plan."""
        return (*(step for strip in self.strips for step in strip.steps), *self.to_objects)

    @property
    def transformed(self) -> int:
        """Number of samples that the Fourier transforms of all steps process."""
        return sum(step.transformed for step in self.steps)

    @property
    def memory(self) -> float:
        """Bytes of the arrays that exist at once: the columns of a step, the field at the main lens, and the sums.

        Each plane keeps its sums along x, a mask of those that are cut, and its sums along both axes.
        """
        columns = max(math.prod(step.columns) for step in self.steps)
        across, rows = self.bins
        sums = sum(9.0 * step.y.new_padded * across + 24.0 * rows * across for step in self.to_objects)
        return 8.0 * (columns + self.pupil[0].count * self.pupil[1].count) + sums


def field_subsamples(camera: PlenopticCamera, wavelength: float) -> int:
    r"""Return the number of field samples across a pixel of the detector.

    The range of direction cosines must include a whole cell's converging light, :math:`D_2 (b + z) / 2 b z` on both
    sides of the chief ray, at the rim. On the MLA it must include, in addition to the light that the main lens accepts
    from one lens, the deflection of this light to one side, so that it is not aliased into the accepted light.
    """
    b = camera.mla_distance
    z = camera.reduced_distance
    half_field = max(camera.detector_width, camera.detector_height) / 2
    converging = max(camera.mla_pitches) * (b + z) / (2 * b * z)
    accepted = camera.aperture_radius / b
    most = max(2 * (half_field / b + converging), converging + bend(camera) + accepted)
    # 1.2: As `GUARD`, on the detector, where the borders of pixels diffract more.
    return math.ceil(camera.pixel_size * 1.2 * most / in_millimetres(wavelength))


def plan(
    camera: PlenopticCamera, wavelength: float, distances: Sequence[float], lit: Window, oversample: int = 1
) -> FieldPlan:
    """Return the grids for a capture and object distances, with as few strips as the memory allows."""
    rows = lit[1][1] - lit[1][0]
    count = 1
    chosen = _plan(camera, wavelength, distances, lit, oversample, 1)
    while chosen.memory > min(_STRIPS_MEMORY, work_limit(chosen.memory)) and 2 * count <= rows:
        count *= 2
        finer = _plan(camera, wavelength, distances, lit, oversample, count)
        if finer.memory >= chosen.memory:
            break
        chosen = finer
    return chosen


def _plan(
    camera: PlenopticCamera, wavelength: float, distances: Sequence[float], lit: Window, oversample: int, count: int
) -> FieldPlan:
    """Return the plan of grids for a given number of strips."""
    subsamples = field_subsamples(camera, wavelength)
    pitch = camera.pixel_size / subsamples
    across = detector_step(camera, wavelength, 0, lit[0], pitch)
    borders = [lit[1][0] + (lit[1][1] - lit[1][0]) * index // count for index in range(count + 1)]
    spans = list(itertools.pairwise(borders))
    down = [detector_step(camera, wavelength, 1, span, pitch) for span in spans]
    on_array = []
    pupil = []
    to_objects = []
    for axis, steps in enumerate(([across], down)):
        ways, samples, directions = _main_lens_steps(camera, wavelength, distances, axis, lit[axis], steps, oversample)
        on_array.append(ways)
        pupil.append(samples)
        to_objects.append(directions)
    strips = [
        Strip(
            slice(low - lit[1][0], high - lit[1][0]),
            Step(across, detector),
            Step(on_array[0][0][0], beyond),
            Directions(on_array[0][0][1], to_main_lens),
        )
        for (low, high), detector, (beyond, to_main_lens) in zip(spans, down, on_array[1], strict=True)
    ]
    # The transform to the main lens has turned rows into columns, and the next one turns these back.
    objects = tuple(Directions(y, x) for x, y in zip(*to_objects, strict=True))
    columns, rows = (bins * oversample for bins in camera.bin_count)
    return FieldPlan(subsamples, tuple(strips), (pupil[0], pupil[1]), objects, (columns, rows))


def check_pupil_diffraction(camera: PlenopticCamera, wavelength: float, distance: float, margin: float) -> None:
    """Check how much light the pupil diffracts more than `margin` bins beyond a lens's image, where it would wrap.

    The part J0(v)^2 + J1(v)^2 of an Airy pattern lies outside a radius r, v = 2 pi R r / (lambda b) on the array.
    """
    reach = camera.blur_diameter(distance) / 2 + margin * camera.row_pitch
    edge = 2 * math.pi * camera.aperture_radius * reach / (in_millimetres(wavelength) * camera.mla_distance)
    guards.check(guards.OBJECT, float(j0(edge) ** 2 + j1(edge) ** 2))


def require_feasible(field_plan: FieldPlan) -> None:
    """Refuse a plan that needs too much memory or too much work."""
    label = f"camera with {field_plan.subsamples} field samples a pixel; its wave reconstruction"
    check_memory(field_plan.memory, label, most=FIELD_MEMORY)
    refuse_if(
        field_plan.transformed > _MOST_TRANSFORMED,
        f"{label}: {field_plan.transformed:.2g} samples would be transformed, at most {_MOST_TRANSFORMED:.2g} are",
    )


def detector_step(
    camera: PlenopticCamera, wavelength: float, axis: int, lit: Span, pitch: float, beside: int = 0
) -> AxisStep:
    """Return the step from pixels to the cells of their lenses; light that leaves these cells misses the pupil.

    The window has room for all directions on both sides. `beside` are more samples beside the cells.
    """
    count = round((lit[1] - lit[0]) * camera.pixel_size / pitch)
    first = (lit[0] - camera.resolution[axis] / 2) * camera.pixel_size + pitch / 2
    spread = math.ceil(camera.reduced_distance * in_millimetres(wavelength) / (2 * pitch) / pitch)
    low, high = _cells(camera, rays.chief_point(camera, first + pitch * np.array([0, count - 1.0])), axis)
    wanted = math.ceil((high - low) / pitch - 1e-6) + 2 * beside  # the width of cells is often a multiple of the pitch
    start = (low + high) / 2 - (wanted - 1) / 2 * pitch
    # Few pixels may belong to wide cells.
    padded = fft.fast_length(max(count + 2 * spread, wanted))
    return AxisStep(first, pitch, count, padded, padded, float(start), wanted)


def _main_lens_steps(
    camera: PlenopticCamera,
    wavelength: float,
    distances: Sequence[float],
    axis: int,
    lit: Span,
    detector: Sequence[AxisStep],
    oversample: int,
) -> tuple[list[tuple[AxisStep, AxisStep]], LensAxis, list[AxisStep]]:
    """Return the two steps from the MLA, in strips, to the main lens, and the steps to the object planes."""
    b = camera.mla_distance
    radius = camera.aperture_radius
    wave = in_millimetres(wavelength)
    half_mla = max(abs(end) for step in detector for end in (step.destination[0], step.destination[-1]))
    # 0.5: Diffraction orders of a lens held beyond the directions to the main lens. Without them edges become
    # ripples; what is cut off of these should be in directions that miss.
    steepest = (radius + half_mla) / b + 0.5 * wave / min(camera.mla_pitches)
    beside = max(camera.mla_pitches)
    count = max(step.wanted for step in detector)
    ways = [_beyond_paraxial(step, count, b, steepest, beside, wave) for step in detector]

    # The samples of the main lens hold the directions of what leaves it for the object planes.
    extents = [object_extent(camera, distance, axis, lit) for distance in distances]
    leaving = GUARD * max(max(map(abs, light)) for light, _ in extents)
    length = fft.fast_length(max(2 * b * leaving / ways[0].new_pitch, *(way.wanted for way in ways)))
    pitch = wave * b / (length * ways[0].new_pitch)
    half = min(math.ceil(radius / pitch), (length - 1) // 2)
    count = 2 * half + 1
    onto = [AxisStep(way.start, way.new_pitch, way.wanted, length, count, way.start, way.wanted) for way in ways]

    samples = _DIRECTION_SAMPLES if oversample == 1 else _FINE_DIRECTION_SAMPLES
    padded = fft.fast_length(max(samples * 2 * radius / pitch, count))
    cosine = wave / (padded * pitch)
    most = [min(math.ceil(max(map(abs, extent)) / cosine) + 2, (padded - 1) // 2) for _, extent in extents]
    start = -half * pitch
    directions = [AxisStep(start, pitch, count, padded, 2 * half_count + 1, start, count) for half_count in most]
    return list(zip(ways, onto, strict=True)), LensAxis(count, pitch), directions


def _beyond_paraxial(
    on_array: AxisStep, count: int, distance: float, steepest: float, beside: float, wave: float
) -> AxisStep:
    """Return the step in the MLA plane that displaces light, with directions up to the steepest one.

    The window has room for `count` samples, and for light up to `beside` mm beside them.
    """
    # Farthest towards the corner of the directions.
    # Square of the cosine to the axis from which on light is followed no farther aside.
    displaced = distance * steepest * (1 / math.sqrt(max(1 - 2 * steepest**2, 1e-3)) - 1)
    pitch = on_array.pitch
    more = 2 * (displaced + beside)
    padded = fft.fast_length(count + more / pitch)
    new_padded = min(fft.fast_length(padded * pitch * 2 * steepest / wave), padded)
    new_pitch = padded * pitch / new_padded
    samples = min(math.ceil((on_array.wanted * pitch + more) / new_pitch), new_padded)
    middle = on_array.start + (on_array.wanted - 1) / 2 * pitch
    start = middle - (samples - 1) / 2 * new_pitch
    return AxisStep(on_array.start, pitch, on_array.wanted, padded, new_padded, start, samples)


def _cells(camera: PlenopticCamera, ends: Array, axis: int) -> Pair:
    """Return the range of the cells that contain all points between two coordinates on the MLA."""
    lattice = camera.lattice
    if lattice.axis_aligned:
        pitch = camera.mla_pitches[axis]
        low, high = lattice.axis_cell(ends, axis) * pitch + np.array([0, pitch])
        return float(low + lattice.offset[axis]), float(high + lattice.offset[axis])
    reach = lattice.cell_reach
    # A point is no farther than that from its centre, nor the cell's edge from the centre.
    return float(ends[0] - 2 * reach), float(ends[1] + 2 * reach)


def object_extent(camera: PlenopticCamera, distance: float, axis: int, lit: Span) -> tuple[Pair, Pair]:
    """Return two ranges of slopes from the main lens's centre: of light of lit pixels, and of light in bins.

    Both are equal if all light goes to bins.
    """
    b = camera.mla_distance
    spread = camera.blur_diameter(distance) / 2 / b + OBJECT_MARGIN * camera.row_pitch / b
    edges = (np.array(lit) - camera.resolution[axis] / 2) * camera.pixel_size
    high, low = -rays.chief_point(camera, edges) / b
    light = (float(low) - spread, float(high) + spread)
    half_field = camera.bin_count[axis] / 2 * camera.row_pitch / b
    return light, (min(max(light[0], -half_field), half_field), max(min(light[1], half_field), -half_field))
