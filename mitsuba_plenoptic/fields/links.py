"""Links of a chain of fields: from the samples in one plane to those in the next, forward, and adjoint.

Fields are passed from link to link in blocks of rows, from the first row to the last. A link transforms incoming rows,
transposes them into columns, does all work along columns, transposes back and passes on the rows of the next plane.
Only the columns are stored whole; the next link writes its columns where it has read the last one's. Fourier
transforms are done on blocks that stay in the processor's cache; dark rows, and frequencies and destination samples
that are not needed, are left out.

Adjoints are those of inner products over samples, without their areas. The adjoint of free space is free space of the
opposite length between the same samples; that of an element is its conjugate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from ..optics import advance, in_millimetres, parabola, phasor
from ..runtime import Field, active_backend
from .elements import Element
from .steps import AxisStep, Directions, LensAxis, Step
from .watch import Watch
from .workspace import FieldWorkspace, Rows

# Columns that are turned into rows together: more of them would not stay in the first cache.
_TILE = 512


class Link(Protocol):
    """What a field passes on its way, in blocks of rows, such as an element and the free space behind it."""

    @property
    def step(self) -> Step:
        """The step, for which a workspace needs memory."""

    def forward(self, source: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the field behind the link, from the field before it."""

    def adjoint(self, gradient: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the adjoint before the link, from a field behind it."""


@dataclass(frozen=True)
class Chain:
    """Links that a field passes one after another."""

    links: Sequence[Link]

    @property
    def steps(self) -> list[Step]:
        """Steps of all links."""
        return [link.step for link in self.links]

    def forward(self, source: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the field behind the last link."""
        for link in self.links:
            source = link.forward(source, workspace)
        return source

    def adjoint(self, gradient: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the adjoint before the first link."""
        for link in reversed(self.links):
            gradient = link.adjoint(gradient, workspace)
        return gradient


@dataclass(frozen=True)
class FreeSpace:
    """Free space of a length in mm, for a wavelength in nm in it, with propagation by slopes or by cosines.

    With `beyond_paraxial`, only the non-paraxial part. `response` is an amplitude of plane waves, a function of the two
    direction cosines, such as that of pixels behind the space.
    """

    distance: float
    wavelength: float
    paraxial: bool = False
    beyond_paraxial: bool = False
    response: Callable[[Any, Any], Any] | None = None

    @property
    def back(self) -> FreeSpace:
        """Free space from the second plane back to the first."""
        return replace(self, distance=-self.distance)


class Hop:
    """An element, then free space to the destination samples of a step; the carrier is omitted.

    `check` is called with what was watched, before the field goes on.
    """

    def __init__(
        self, step: Step, space: FreeSpace, element: Element | None = None, check: Callable[[Watch], None] | None = None
    ):
        self.step, self._space, self._element, self._check = step, space, element or Element(step), check

    def forward(self, source: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the field at the destination samples, from the field at the source samples."""
        x = self.step.x
        y = self.step.y
        space = self._space
        pitches = (x.window / x.held, y.window / y.held)
        shift = (x.start - x.first, y.start - y.first)
        directions = to_directions(source, self._element, self.step, workspace)
        watch = self._check and Watch(self.step, self._check)

        def advanced() -> Rows:
            for mine, spectrum in watch.watched(directions) if watch else directions:
                yield mine, advance(
                    spectrum, pitches, space.distance, space.wavelength, shift=shift, part=(mine.start, x.held),
                    paraxial=space.paraxial, beyond_paraxial=space.beyond_paraxial, response=space.response,
                )  # fmt: skip

        return from_directions(advanced(), self.step, workspace, watch)

    def adjoint(self, gradient: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the adjoint at the source samples, from a field at the destination samples."""
        x = self.step.x
        y = self.step.y
        scale = x.new_padded * y.new_padded / (x.padded * y.padded)
        for rows, samples in Hop(self.step.reversed, self._space.back).forward(gradient, workspace):
            yield rows, self._element.back(rows, samples, scale)


@dataclass(frozen=True)
class Spectrum:
    """An element, then the field's directions: lines along y of its lowest frequencies, for some along x together.

    Zero frequency comes first on both axes, negative frequencies last. Transforms are divided by their lengths.
    """

    step: Step
    element: Element

    def forward(self, source: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the frequencies, from the field at the source samples."""
        return to_directions(source, self.element, self.step, workspace)

    def adjoint(self, gradient: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the adjoint at the source samples, from a field at the frequencies."""
        scale = 1 / (self.step.x.padded * self.step.y.padded)
        for rows, samples in from_directions(gradient, self.step.reversed, workspace):
            yield rows, self.element.back(rows, samples, scale)


class FromSpectrum:
    """The way back of `Spectrum`, to the destination samples of a step; `check` is called as by `Hop`."""

    def __init__(self, step: Step, check: Callable[[Watch], None]):
        self.step = step
        self._check = check

    def forward(self, source: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the field at the destination samples, from its frequencies."""
        watch = Watch(self.step, self._check)
        return from_directions(watch.watched(source), self.step, workspace, watch)

    def adjoint(self, gradient: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the adjoint at the frequencies, from a field at the destination samples."""
        back = self.step.reversed
        scale = np.float32(back.x.padded * back.y.padded)
        for lines, spectrum in to_directions(gradient, Element(back), back, workspace):
            yield lines, spectrum * scale


class Fresnel:
    """Paraxial free space between two planes as one transform, with the second plane's samples in order.

    The field on the second plane is kept line by line: along its y for each x.
    """

    def __init__(self, step: Directions, onto: tuple[LensAxis, LensAxis], distance: float, wavelength: float):
        wave_path = in_millimetres(wavelength) * distance

        def curved(x: Any, y: Any) -> Any:
            return phasor(parabola(x * x + y * y, -distance, wavelength))

        self.step = step
        self._count = step.x.held
        self._positive = (step.y.held + 1) // 2
        self._spectrum = Spectrum(step, Element.separated(step, curved, (0.0, 0.0)))
        asarray = active_backend().arrays.asarray
        self._along_x, self._along_y = (
            asarray(phasor(samples.samples * (samples.samples / 2 - axis.first) / wave_path))
            * np.float32(math.sqrt(wave_path) / samples.pitch)
            for axis, samples in ((step.x, onto[0]), (step.y, onto[1]))
        )

    def forward(self, source: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield lines of the field on the second plane, in any order, from the field on the first."""
        positive = self._positive
        middle = len(self._along_y) - self._positive
        for mine, rows_of in self._spectrum.forward(source, workspace):
            lines = workspace.array("lines", (workspace.block, rows_of.shape[1]))[: len(rows_of)]
            np.multiply(rows_of[:, :positive], self._along_y[middle:], out=lines[:, middle:])
            np.multiply(rows_of[:, positive:], self._along_y[:middle], out=lines[:, :middle])
            for own, there in _in_order(mine, self._count):
                lines[own] *= self._along_x[there, None]
                yield there, lines[own]

    def adjoint(self, gradient: Rows, workspace: FieldWorkspace) -> Rows:
        """Yield the adjoint on the first plane, from lines of a field on the second."""

        def by_spectrum() -> Rows:
            for there, lines in gradient:
                product = lines * self._along_x[there, None].conj()
                product *= self._along_y.conj()
                product = workspace.libraries.arrays.roll(product, self._positive - product.shape[1], axis=1)
                for own, mine in _in_order(there, self._count, -(self._count // 2)):
                    yield mine, product[own]

        return self._spectrum.adjoint(by_spectrum(), workspace)


def to_directions(source: Rows, element: Element, step: Step, workspace: FieldWorkspace) -> Rows:
    """Yield the lowest frequencies of a field behind an element, as contiguous blocks (some along x, all along y)."""
    x = step.x
    y = step.y
    columns = workspace.columns(step)
    arrays = workspace.libraries.arrays
    rows_of = workspace.array("rows", (workspace.block, x.padded))
    low, high = _lowest(x.padded, x.held)
    end = 0
    for rows, samples in source:
        for lit in element.lit(rows):
            columns[:, end : lit.start] = 0
            end = lit.stop
            rows_cut = rows_of[: end - lit.start]
            element.through(lit, samples[lit.start - rows.start : end - rows.start], rows_cut[:, : x.count])
            rows_cut[:, x.count :] = 0
            rows_cut = workspace.fft(rows_cut)
            columns[: low.stop, lit] = rows_cut[:, low].T
            columns[low.stop :, lit] = rows_cut[:, high].T
    columns[:, end : y.count] = 0
    block = workspace.array("rows", (workspace.block, y.padded))
    spectrum = workspace.array("spectrum", (workspace.block, y.held))
    low, high = _lowest(y.padded, y.held)
    for mine in workspace.runs(x.held):
        rows_cut = block[: mine.stop - mine.start]
        if element.along_y is None:
            rows_cut[:, : y.count] = columns[mine, : y.count]
        else:
            arrays.multiply(columns[mine, : y.count], element.along_y, out=rows_cut[:, : y.count])
        rows_cut[:, y.count :] = 0
        rows_cut = workspace.fft(rows_cut)
        if y.held < y.padded:
            cut = spectrum[: mine.stop - mine.start]
            cut[:, : low.stop] = rows_cut[:, low]
            cut[:, low.stop :] = rows_cut[:, high]
            rows_cut = cut
        yield mine, rows_cut


def from_directions(spectrum: Rows, step: Step, workspace: FieldWorkspace, watch: Watch | None = None) -> Rows:
    """Yield the field at the destination samples of a step, from its lowest frequencies as `to_directions` has them."""
    x = step.x
    y = step.y
    columns = workspace.columns(step)
    for mine, rows_cut in spectrum:
        whole = _from_lowest(rows_cut, y, workspace)
        if watch:
            watch.see_window(whole)
        columns[mine, : y.wanted] = whole[:, : y.wanted]
    if watch:
        watch.check(watch)
    block = workspace.array("next rows", (workspace.block, x.held))
    for rows in workspace.runs(y.wanted):
        rows_cut = block[: rows.stop - rows.start]
        for first in range(0, x.held, _TILE):
            tile = slice(first, min(first + _TILE, x.held))
            rows_cut[:, tile] = columns[tile, rows].T
        yield rows, _from_lowest(rows_cut, x, workspace)[:, : x.wanted]


def _from_lowest(rows_cut: Field, axis: AxisStep, workspace: FieldWorkspace) -> Field:
    """Return rows all over the destination's window, from the rows' lowest frequencies."""
    if axis.held < axis.new_padded:
        low, high = _lowest(axis.new_padded, axis.held)
        wide = workspace.array("wide", (len(rows_cut), axis.new_padded))
        wide[:, low.stop : high.start] = 0
        wide[:, low] = rows_cut[:, : low.stop]
        wide[:, high] = rows_cut[:, low.stop :]
        rows_cut = wide
    return workspace.fft(rows_cut, inverse=True)


def _lowest(size: int, count: int) -> tuple[slice, slice]:
    """Return the slices of the lowest frequencies, nonnegative and negative, in a spectrum with zero first."""
    positive = (count + 1) // 2
    return slice(0, positive), slice(size - (count - positive), size)


def _in_order(lines: slice, count: int, moved: int | None = None) -> Iterator[tuple[slice, slice]]:
    """Yield parts of a run of lines, with their numbers after zero frequency is moved to the middle, or back."""
    first = (lines.start + (count // 2 if moved is None else moved)) % count
    border = min(lines.stop - lines.start, count - first)
    yield slice(0, border), slice(first, first + border)
    if lines.start + border < lines.stop:
        yield slice(border, lines.stop - lines.start), slice(0, lines.stop - lines.start - border)
