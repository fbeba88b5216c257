r"""The field of one scene point through the whole camera, computed in full: the reference for the other methods.

Behind the main lens, at the pupil point P, a point source at X has the field

.. math:: U(P) = \frac{g}{|P - X|^2} \exp\left(i k \left(|P - X| + \Phi(P)\right)\right)

(the first Rayleigh-Sommerfeld solution of a point source, and the phase of the lens: Goodman, "Introduction to Fourier
Optics", sections 3.5 and 5.1; `lenses.thin` states :math:`\Phi` for both models of a thin lens). The field propagates
to the MLA by its angular spectrum, through the microlenses by :math:`\exp(-i \pi |m - c|^2 / \lambda f_2)` in each
cell, and to the detector by its angular spectrum.

Sampling: while the half widths of pupil and destination together fit the window, no band limit but the evanescent one
is needed (Matsushima and Shimobaba 2009, "Band-limited angular spectrum method"). The pitch represents the steepest
rays. The intensity has twice the field's bandwidth, so the grid is doubled before squaring; a pixel's integral is the
intensity's spectrum times the sinc of the pixel.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..fields import (
    Chain,
    Element,
    FieldWorkspace,
    FreeSpace,
    Hop,
    OpticalSystem,
    Rows,
    Step,
    Watch,
    has_response,
    recorded_amplitude,
    retained_workspace,
    transmission,
)
from ..optics import guards, in_millimetres, power
from ..runtime import BatchMap, Box, Doubles, Field, Floats, Job, Part, PartialSum, active_backend, check_memory, fft
from .arrival import Arrival, FieldGrids, SampledField, arrival, blocks, field_grids
from .field_grid import lens_amplitude
from .pupil_weights import PupilWeights

_FINER = 6
"""Samples of an irregular array along an axis in a sample of the field; they limit the accuracy of its edges."""


@dataclass(frozen=True)
class PointFields:
    """Fields of one scene point in the planes of the camera.

    Attributes
    ----------
    pupil : SampledField
        The field behind the pupil.
    mla : SampledField
        The field before the microlens array.
    detector : SampledField
        The field on the detector.
    """

    pupil: SampledField
    mla: SampledField
    detector: SampledField


def full_field(
    system: OpticalSystem,
    position: Doubles,
    *,
    pupil_weights: PupilWeights | None = None,
    microlenses: bool = True,
    refinement: float = 1.0,
    growth: float = 1.0,
    grids: FieldGrids | None = None,
    incident: SampledField | None = None,
) -> Floats:
    """Return one scene point's intensity integrated over each recorded pixel.

    `refinement` and `growth` are factors on the sampling density and on the window's margins, to test convergence.
    `grids` may be taken from a nearly equal camera, so that differences contain no effect of the grids. `incident` is a
    field on the pupil of a thin lens or a collimator that replaces a far point's light, with its own aperture. It may
    be the light of many far points, for which an ideal thin lens is a parabola in paraxial propagation to the array.
    """
    grids = grids or field_grids(system, position, refinement, growth)
    _, light = arrival(system, position, grids, pupil_weights, incident)
    return intensity(system, grids, light, microlenses)


def point_fields(
    system: OpticalSystem, position: Doubles, *, pupil_weights: PupilWeights | None = None, microlenses: bool = True
) -> PointFields:
    """Return one scene point's field at every plane, propagated as by `full_field`."""
    grids = field_grids(system, position, 1.0, 1.0)
    pupil, light = arrival(system, position, grids, pupil_weights)
    array = Chain(light.links)
    detector = to_detector(system, grids, microlenses)
    with retained_workspace([*array.steps, *detector.steps]) as workspace, fft.resting_drjit():
        mla = workspace.whole(array.forward(workspace.blocks(light.source, light.first), workspace), grids.shape)
        detected = workspace.whole(detector.forward(workspace.blocks(mla), workspace), grids.shape)
    planes = pupil, *(SampledField(samples, grids.origin, grids.pitch) for samples in (mla, detected))
    return PointFields(*(SampledField(active_backend().to_host(p.samples), p.origin, p.pitch) for p in planes))


def intensity(system: OpticalSystem, grids: FieldGrids, light: Arrival, microlenses: bool = True) -> Floats:
    """Return the intensity integrated over each recorded pixel, of light on its way to the array."""
    # The intensity has twice the directions of the field.
    chain = Chain([*light.links, *to_detector(system, grids, microlenses, finer=2).links])
    with retained_workspace(chain.steps) as workspace, fft.resting_drjit():
        field = chain.forward(workspace.blocks(light.source, light.first), workspace)
        # The intensity integrated over each recorded pixel, exactly for the band-limited field on finer samples.
        arrays = active_backend().arrays
        height, width = system.camera.shape
        rows = arrays.empty((2 * grids.count[1], width), np.float32)
        for block, samples in field:
            parts = samples.view(np.float32)
            arrays.multiply(parts, parts, out=parts)
            rows[block] = _along_pixels(parts[:, 0::2] + parts[:, 1::2], grids, width)
        psf = arrays.empty((height, width), np.float32)
        for block in blocks(width):
            psf[:, block] = _along_pixels(arrays.ascontiguousarray(rows[:, block].T), grids, height).T
        return active_backend().to_host(psf)


def to_detector(system: OpticalSystem, grids: FieldGrids, microlenses: bool = True, finer: int = 1) -> Chain:
    """Return the way from the window before the array to the same on the detector, with its samples or finer ones.

    Microlenses are thin phases of direction cosines, whatever the main lens is.
    """
    camera = system.camera
    step = grids.to_detector(finer)
    response = functools.partial(recorded_amplitude, camera) if has_response(camera) else None
    space = FreeSpace(camera.space_behind[0], camera.medium_wavelength(system.wavelength), response=response)
    if not (microlenses and system.microlenses.axes):
        return Chain([Hop(step, space)])
    opened = Apertures(system, step)
    if any(map(any, (camera.mla_jitter, camera.mla_figure_error))):
        lenses = Element(step, samples=_irregular(system, grids))
    else:
        lenses = Element.by_orders(step, system.microlenses, grids.bend)

    def check(watch: Watch) -> None:
        if opened.power > 0:
            guards.check(guards.MICROLENS, 1 - watch.power / opened.power)

    return Chain([opened, Hop(step, space, lenses, check)])


class Apertures:
    """The root of the brightness of the microlenses, before the array: a link that sums the power in their apertures.

    `power` is in units of a sample, of the last field.
    """

    def __init__(self, system: OpticalSystem, step: Step):
        array = system.microlenses
        camera = system.camera
        pitches = np.array([step.x.pitch, step.y.pitch])
        cosine = in_millimetres(system.wavelength) / (2 * step.x.pitch)
        self.step = step
        self.power = 0.0
        self._brightness = self._openings = None
        if camera.mla_transmissions is not None:
            self._brightness = Element(step, lambda x, y: _complex(lens_amplitude(camera, x, y, pitches)))
        if not array.fills:
            self._openings = Element(step, lambda x, y: _complex(array.open_fraction(cosine, x, y)))

    def forward(self, source: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the field behind the brightness."""
        self.power = 0.0
        for rows, samples in self.adjoint(source, workspace):
            if self._openings is None:
                self.power += power(samples)
            else:
                passing = abs(samples) ** 2 * self._openings.factor(rows).real
                self.power += float(passing.sum(dtype=np.float64))
            yield rows, samples

    def adjoint(self, gradient: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the field multiplied by the same real factor."""
        for rows, samples in gradient:
            yield rows, samples if self._brightness is None else samples * self._brightness.factor(rows)


def _complex(values: Any) -> Any:
    """Return real values as the factor of an element."""
    types = fft.array_types(values)
    return types.Complex2f(types.Float(values), 0)


def _irregular(system: OpticalSystem, grids: FieldGrids) -> Field:
    """Return the transmission of an irregular array, without the directions that the grid would alias."""
    types = active_backend().types
    columns, rows = grids.count
    pitch = grids.pitch / _FINER
    shape = (_FINER * rows, _FINER * columns)
    check_memory(40.0 * math.prod(shape), f"irregular array of {columns} x {rows} samples")
    left, top = grids.origin
    row, column = fft.rows_and_columns(types, *shape)
    x = types.Float64(column) * pitch + left
    y = types.Float64(row) * pitch + top
    fine = fft.as_field(fft.pack(transmission(system.camera, system.wavelength, x, y)), shape)
    lam = in_millimetres(system.wavelength)
    with fft.resting_drjit():
        spectrum = fft.fft2(fine)
        down, across = (
            active_backend().arrays.asarray(np.rint(np.fft.fftfreq(size) * size).astype(int))
            for size in (rows, columns)
        )
        cosines = [np.fft.fftfreq(size, grids.pitch) * lam for size in (rows, columns)]
        spectrum = spectrum[down[:, None], across] * active_backend().arrays.asarray(
            np.hypot(cosines[0][:, None], cosines[1]) <= grids.bend
        )
        return fft.fft2(active_backend().arrays.ascontiguousarray(spectrum), inverse=True) / np.float32(_FINER**2)


def _along_pixels(intensity: Floats, grids: FieldGrids, count: int) -> Floats:
    """Return rows of the doubled grid integrated over the recorded pixels: their spectrum times the pixel's sinc."""
    size = intensity.shape[1]
    per_pixel = 2 * grids.per_pixel
    spectrum = fft.rfft(intensity, axis=1)
    pixel = np.sinc(np.fft.rfftfreq(size) * per_pixel) * per_pixel * grids.pitch / 2
    spectrum *= active_backend().arrays.asarray(pixel.astype(np.float32))
    integrals = fft.irfft(spectrum, size, axis=1)
    first = grids.margin * per_pixel + grids.per_pixel
    return integrals[:, first::per_pixel][:, :count]


@dataclass(frozen=True)
class _FullField:
    """The full field of one point, as a batch."""

    system: OpticalSystem
    position: Doubles
    factors: Floats  # of the channels
    pupil_weights: PupilWeights | None

    @property
    def samples(self) -> int:
        """Number of samples on the detector."""
        return math.prod(self.system.camera.shape)

    def prepare(self) -> Callable[[], Part]:
        """Return a function that computes the whole batch."""
        psf = full_field(self.system, self.position, pupil_weights=self.pupil_weights)
        pixels = Part(recorded_pixels(self.system.camera), self.factors[:, None, None] * psf)
        return lambda: pixels


def recorded_pixels(camera: PlenopticCamera) -> Box:
    """Return the recorded pixels as a box within the detector's pixels."""
    return Box(*camera.crop_offset, *camera.crop_size)


class FullFieldPlan:
    """Captures of points by full fields, with the parameters of `PatchPlan`; `accuracy` is not used."""

    def __init__(self, system: OpticalSystem, points: Doubles, pupil_weights: PupilWeights | None, accuracy: float):
        self._system = system
        self._camera = system.camera
        self._points = points
        self._pupil_weights = pupil_weights

    def sum(self, weights: Doubles) -> FullFieldSum:
        """Return the sum, not yet computed, of the point spreads with given weights, (n, channels)."""
        return FullFieldSum(self, weights)

    def batch(self, point: int, factors: Floats) -> _FullField:
        """Return the batch of one point's spread."""
        weights = self._pupil_weights and self._pupil_weights.take(np.array([point]))
        return _FullField(self._system, self._points[point], factors, weights)

    def cost(self, point: int) -> int:
        """Return the number of samples of the field of a point on the detector."""
        return math.prod(field_grids(self._system, self._points[point], 1.0, 1.0).count)

    @property
    def box(self) -> Box:
        """Box of the recorded pixels."""
        return recorded_pixels(self._camera)

    def gather(self, image: Floats, job: Job, done: int, total: int) -> Doubles:
        """Return each point spread's inner product with an image; see `PatchPlan.gather`."""
        unit = np.ones(1, np.float32)
        count = len(self._points)
        batches = (self.batch(point, unit) for point in range(count))
        spreads = (batch_sum.sums[0] for batch_sum in job.each(batches, [1] * count, done, total))
        return np.array([np.tensordot(psf, image, 2) for psf in spreads], np.float64).reshape(-1, image.shape[2])

    def check_memory(self, batch_map: BatchMap, channels: int = 1) -> None:
        """Refuse images too large for the memory. The memory of fields is checked point by point."""
        check_memory(
            8.0 * channels * math.prod(self._camera.shape),
            f"image of {self._camera.shape[1]} x {self._camera.shape[0]} pixels",
        )


class FullFieldSum:
    """A sum of full fields, with the interface of `runtime.batches.LongSum`."""

    def __init__(self, plan: FullFieldPlan, weights: Doubles):
        self._plan, self._weights = plan, weights.astype(np.float32)
        self._lit = np.flatnonzero(weights.any(1))
        self.arrays = np
        self.box = plan.box
        self.channels = weights.shape[1]
        self.items = np.ones(len(self._lit), np.int64)

    def batches(self, first: int) -> Iterator[_FullField]:
        """Yield one batch for each point."""
        return (self._plan.batch(int(point), self._weights[point]) for point in self._lit[first:])

    def image(self, total: PartialSum) -> Floats:
        """Return the total with its channels in the last axis."""
        return np.ascontiguousarray(total.sums.transpose(1, 2, 0))
