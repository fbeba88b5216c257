r"""How finely and how widely the fields of a back-propagation are sampled: plain numbers, one axis at a time.

Every propagation step goes by the angular spectrum, and its window is periodic. The rules:

- *Pitch*: a grid of pitch d holds direction cosines up to :math:`\lambda / 2d`. Light between a point of one plane
  and a point of the next has the direction that the two points give, and nothing else is needed.
- *Window*: light leaves a grid in all directions that the grid holds. The window is wide enough that what wraps
  round falls outside the part of the next plane that is used.

A step pads its source with zeros to the window, and cuts the spectrum to the directions that the next plane needs:
this resamples the field exactly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import rays
from ..optics.microlenses import bend
from ..optics.phase import in_millimetres
from ..optics.sampling import check_memory, fast_length
from ..runtime.limits import largest_fitting

Span = tuple[int, int]
Window = tuple[Span, Span]
"""First and past-the-last pixel of the full detector, in x and in y."""

GUARD = 1.05
"""Directions held over those that geometry needs, for the light that edges diffract."""

_MOST_TRANSFORMED = 2**33
"""Samples that one field's transforms go through, at most: some 25 times those of 4096 x 4096 pixels of the paper.

More takes minutes, for distances so near the focal length, or so large, that their windows are mostly dark.
"""

OBJECT_MARGIN = 6.0
"""Bins around the geometric image in which light is kept: the pupil's edge diffracts half a percent beyond three."""


@dataclass(frozen=True)
class AxisStep:
    """One axis of one propagation step, from samples in one plane to samples in the next.

    Attributes
    ----------
    first, pitch : float
        Coordinate of the first source sample and the distance between samples, in millimetres.
    count : int
        Source samples; the field is zero elsewhere.
    padded : int
        Samples across the window.
    kept : int
        Lowest frequencies of the window that are kept.
    start : float
        Coordinate of the first destination sample, in millimetres.
    wanted : int
        Destination samples.
    """

    first: float
    pitch: float
    count: int
    padded: int
    kept: int
    start: float
    wanted: int

    @property
    def window(self) -> float:
        """Width of the window in millimetres."""
        return self.padded * self.pitch

    @property
    def new_pitch(self) -> float:
        """Distance between destination samples in millimetres."""
        return self.window / self.kept

    @property
    def source(self) -> np.ndarray:
        """Coordinates of the source samples, float64 (count,)."""
        return self.first + self.pitch * np.arange(self.count)

    @property
    def destination(self) -> np.ndarray:
        """Coordinates of the destination samples, float64 (wanted,)."""
        return self.start + self.new_pitch * np.arange(self.wanted)


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
        """How many columns rows are turned into, and what they hold at most: source and destination share them."""
        return self.x.kept, max(self.y.count, self.y.wanted)

    @property
    def transforms(self) -> tuple[tuple[int, int, bool], ...]:
        """Fourier transforms of the step, in order: how many, of how many samples, and whether inverse."""
        x, y = self.x, self.y
        return (
            (y.count, x.padded, False),
            (x.kept, y.padded, False),
            (x.kept, y.kept, True),
            (y.wanted, x.kept, True),
        )


@dataclass(frozen=True)
class Plan:
    """Field samples across a pixel, and the steps from detector to MLA, to the main lens, and to each object plane."""

    subsamples: int
    to_mla: Step
    to_main_lens: Step
    to_objects: tuple[Step, ...]

    @property
    def steps(self) -> tuple[Step, ...]:
        """All of them."""
        return self.to_mla, self.to_main_lens, *self.to_objects

    @property
    def transformed(self) -> int:
        """Samples that the Fourier transforms of all steps go through."""
        return sum(count * length for step in self.steps for count, length, _ in step.transforms)

    @property
    def memory(self) -> float:
        """Bytes of the arrays that are alive at once: the columns of a step, and the field at the main lens."""
        columns = max(math.prod(step.columns) for step in self.steps)
        return 8.0 * (columns + math.prod(self.to_main_lens.shape))


def field_subsamples(camera: PlenopticCamera, wavelength: float) -> int:
    r"""Field samples across a pixel on the detector.

    The pitch must hold the converging light of a whole cell, :math:`D_2 (b + z) / 2 b z` from the chief ray, and on
    the MLA the microlens's bend beside the light that the main lens accepts, so that what is bent beyond the grid's
    directions does not come back among those.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    """
    b, z = camera.mla_distance, camera.detector_distance
    half_field = max(camera.detector_width, camera.detector_height) / 2
    converging = half_field / b + max(camera.mla_pitches) * (b + z) / (2 * b * z)
    accepted = (camera.aperture_radius + half_field) / b + bend(camera)
    return math.ceil(2 * camera.pixel_size * max(converging, accepted) / in_millimetres(wavelength))


def plan(camera: PlenopticCamera, wavelength: float, distances: Sequence[float], lit: Window) -> Plan:
    """Choose the grids for one capture and some object distances.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    distances : sequence of floats
        Object distances.
    lit : ((int, int), (int, int))
        First and past-the-last pixel of the full detector that may be lit, in x and in y.
    """
    subsamples = field_subsamples(camera, wavelength)
    axes = [_axis_steps(camera, wavelength, distances, axis, lit[axis], subsamples) for axis in (0, 1)]
    (x1, x2, xs), (y1, y2, ys) = axes
    return Plan(subsamples, Step(x1, y1), Step(x2, y2), tuple(Step(x, y) for x, y in zip(xs, ys, strict=True)))


def require_feasible(
    made: Plan, camera: PlenopticCamera, wavelength: float, distances: Sequence[float], lit: Window
) -> None:
    """Refuse a plan that needs more than 4 GiB, and say how many lit pixels would fit; or one of too much work.

    Raises
    ------
    InputError
        If it does.
    """

    def fitting(limit: float) -> str | None:
        def memory(count: int) -> float:
            first = [max((low + high) // 2 - count // 2, 0) for low, high in lit]
            x, y = ((start, start + count) for start in first)
            return plan(camera, wavelength, distances, (x, y)).memory

        count = largest_fitting(memory, limit, min(end - first for first, end in lit))
        return f"a window of {count} x {count} lit pixels" if count else None

    what = f"camera with {made.subsamples} field samples a pixel; its wave reconstruction"
    check_memory(made.memory, what, fitting)
    if made.transformed > _MOST_TRANSFORMED:
        raise InputError(
            f"{what}: {made.transformed:.2g} samples would be transformed, at most {_MOST_TRANSFORMED:.2g} are"
        )


def _axis_steps(
    camera: PlenopticCamera,
    wavelength: float,
    distances: Sequence[float],
    axis: int,
    lit: Span,
    subsamples: int,
) -> tuple[AxisStep, AxisStep, list[AxisStep]]:
    b, z, radius = camera.mla_distance, camera.detector_distance, camera.aperture_radius
    wave = in_millimetres(wavelength)

    # Detector to MLA: every direction is kept, and the window leaves room for them on both sides. Light that leaves
    # the cells of the lit pixels' own lenses misses the pupil.
    pitch = camera.pixel_size / subsamples
    count = (lit[1] - lit[0]) * subsamples
    first = (lit[0] - camera.resolution[axis] / 2) * camera.pixel_size + pitch / 2
    spread = math.ceil(z * wave / (2 * pitch) / pitch)
    low, high = _cells(camera, rays.chief_point(first + pitch * np.array([0, count - 1.0]), b, z), axis)
    wanted = math.ceil((high - low) / pitch - 1e-6)  # whole cells often are whole numbers of samples
    start = (low + high) / 2 - (wanted - 1) / 2 * pitch
    # Few pixels may belong to wide cells.
    padded = fast_length(max(count + 2 * spread, wanted))
    detector = AxisStep(first, pitch, count, padded, padded, float(start), wanted)

    # MLA to main lens.
    half_mla = max(abs(low), abs(high))
    ends = [object_extent(camera, g, axis, detector) for g in distances]
    slopes = [(radius + half_mla) / b]
    slopes += [(radius + max(map(abs, light))) / g for g, (light, _) in zip(distances, ends, strict=True)]
    steepest = GUARD * max(slopes)
    main_lens = _fast_step(
        detector.start,
        pitch,
        wanted,
        window=half_mla + b * steepest + radius,
        new_pitch=wave / (2 * steepest),
        destination=(-radius, radius),
    )

    # Main lens to object planes: only light aimed at the image of a lens comes through.
    objects = []
    for slope, (light, kept) in zip(slopes[1:], ends, strict=True):
        objects.append(
            _fast_step(
                main_lens.start,
                main_lens.new_pitch,
                main_lens.wanted,
                window=max(light[1] - kept[0], kept[1] - light[0], 2 * radius),
                new_pitch=wave / (2 * GUARD * slope),
                destination=kept,
            )
        )
    return detector, main_lens, objects


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
    camera: PlenopticCamera, distance: float, axis: int, detector: AxisStep
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Where the light of the lit lenses arrives in an object plane, and the part of it that lies on bins."""
    bin_size = camera.bin_size(distance)
    spread = camera.blur_diameter(distance) / 2 * distance / camera.mla_distance + OBJECT_MARGIN * bin_size
    edges = detector.first + np.array([-0.5, detector.count - 0.5]) * detector.pitch
    mla = rays.chief_point(edges, camera.mla_distance, camera.detector_distance)
    high, low = -mla * distance / camera.mla_distance
    light = (float(low) - spread, float(high) + spread)
    half_field = camera.bin_count[axis] / 2 * bin_size
    return light, (max(light[0], -half_field), min(light[1], half_field))


def _fast_step(
    first: float,
    pitch: float,
    count: int,
    *,
    window: float,
    new_pitch: float,
    destination: tuple[float, float],
) -> AxisStep:
    """Round a window and a pitch to lengths that are transformed fast."""
    padded = fast_length(max(window / pitch, count))
    kept = min(fast_length(padded * pitch / new_pitch), padded)
    new_pitch = padded * pitch / kept
    wanted = min(math.ceil((destination[1] - destination[0]) / new_pitch) + 1, kept)
    start = (destination[0] + destination[1]) / 2 - (wanted - 1) / 2 * new_pitch
    return AxisStep(float(first), pitch, count, padded, kept, start, wanted)
