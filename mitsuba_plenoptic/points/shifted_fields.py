r"""Point spreads in the Fourier arrangement: one full field for each depth, at the places of all points there.

The array stands in the image of the stop. There a point (X, Y, d) has the field of the point (0, 0, d) times a plane
wave of the direction cosines :math:`M X / f_F`. All lenses together are one thin screen there, and free space behind it
propagates a tilted wave to the same intensity, shifted by :math:`z M X / f_F` (Goodman, "Introduction to Fourier
Optics", section 4.2; exact for small directions, as behind an objective). So all points of a depth have the same point
spread, and their image is a convolution (Guo, Liu, Hua, Li, Jia 2019, "Fourier light-field microscopy", Optics Express
27, 25573).

The spread is divided into the spots behind single lenses, as the field stop cuts the light through each. Spots
are sampled twice as finely as their lines need, and cubic splines move them to the points: errors of about 0.1 %.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy.fft import irfft2, rfft2
from scipy.interpolate import BSpline
from scipy.ndimage import spline_filter
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from ..camera import PlenopticCamera
from ..design import lens_directions, objective_of
from ..errors import refuse_if
from ..fields import OpticalSystem
from ..lenses import FourierLens
from ..optics import in_millimetres
from ..runtime import Doubles, Floats, Integers, Job, Part, Shape
from .full_fields import FullFieldPlan, FullFieldSum, full_field, recorded_pixels
from .pupil_weights import PupilWeights

_SPLINE = BSpline.basis_element([-2, -1, 0, 1, 2], extrapolate=False)


class ShiftedPlan(FullFieldPlan):
    """Captures of points by shifted full fields, with the parameters of `PatchPlan`."""

    def __init__(self, system: OpticalSystem, points: Doubles, pupil_weights: PupilWeights | None, accuracy: float):
        super().__init__(system, points, pupil_weights, accuracy)
        camera, lens = system.camera, objective_of(system.camera)
        refuse_if(pupil_weights is not None, "pupil_weights: spreads of method patch are shared there; use full_field")
        deepest = float(np.abs(points[:, 2]).max(initial=0))
        if lens.field_stop is not None:
            # Light of the point on the axis that no point sends through the field stop is left out.
            farthest = lens.magnification * float(np.abs(points[:, :2]).max(initial=0))
            lens = replace(lens, field_stop=1.5 * (lens.field_stop + farthest), field_stop_shape="square")
        self._fine = fine_camera(camera.replace(main_lens=lens), system.wavelength, deepest, samples=2)
        self._spots: dict[float, Spots] = {}

    def sum(self, weights: Doubles) -> ShiftedSum:
        """Return the sum, not yet computed, of the point spreads with given weights, (n, channels)."""
        return ShiftedSum(self, weights)

    def gather(self, image: Floats, job: Job, done: int, total: int) -> Doubles:
        """Return each point spread's inner product with an image; see `PatchPlan.gather`."""
        channels = np.ascontiguousarray(np.moveaxis(image, 2, 0), np.float32)
        result = np.zeros((len(self._points), len(channels)))
        layers = self.layers(np.arange(len(self._points)))
        batches = (_Layer(self, points, channels, True) for points in layers)
        for points, products in zip(layers, job.each(batches, [*map(len, layers)], done, total), strict=True):
            result[points] = products
        return result

    def layers(self, points: Integers) -> list[Integers]:
        """Return numbers of points divided by depth."""
        depths = self._points[points, 2]
        return [points[depths == depth] for depth in np.unique(depths)]

    def layer(self, points: Integers) -> ShiftedLayer:
        """Return the convolution of points of one depth, whose spots are computed on first use."""
        depth = float(self._points[points[0], 2])
        spots = self._spots.get(depth)
        if spots is None:
            spots = Spots.of(self._system, self._fine, depth)
            # Bytes of spots that a plan keeps for further sums.
            if sum(layer.values.nbytes for layer in self._spots.values()) < 2**31:
                self._spots[depth] = spots
        return ShiftedLayer(self._system, spots, self._points[points, :2])


class ShiftedSum(FullFieldSum):
    """A sum of shifted full fields, depth by depth."""

    def __init__(self, plan: ShiftedPlan, weights: Doubles):
        super().__init__(plan, weights)
        self._layers = plan.layers(self._lit)
        self.items = np.array([*map(len, self._layers)], np.int64)

    def batches(self, first: int) -> Iterator:
        """Yield one batch for each depth."""
        return (_Layer(self._plan, points, self._weights[points], False) for points in self._layers[first:])


@dataclass(frozen=True)
class _Layer:
    """The points of one depth, as a batch: the image of their weights, or their products with an image."""

    plan: Any
    points: Integers
    values: Any
    is_adjoint: bool

    @property
    def samples(self) -> int:
        """Number of recorded pixels."""
        return int(self.plan.box.columns * self.plan.box.rows)

    def prepare(self) -> Callable[[], Any]:
        """Return a function that convolves; full fields are computed here."""
        layer = self.plan.layer(self.points)
        if self.is_adjoint:
            return lambda: layer.adjoint(self.values)
        return lambda: Part(self.plan.box, layer.forward(self.values))


@dataclass(frozen=True, eq=False)
class Spots:
    """The light of a point on the axis behind each lens of the stop's image, in parts of pixels."""

    # Parts across a pixel.
    parts: int
    # First column and row (lenses, 2) of each spot, in pixels of the detector.
    corner: Integers
    # Coefficients (lenses, rows, columns) of cubic splines through the light of parts.
    values: Floats
    # Place (lenses, 2) in mm in the native image plane where a lens's light passes, and the width of this light.
    passage: Doubles
    width: Doubles

    @classmethod
    def of(cls, system: OpticalSystem, fine: PlenopticCamera, depth: float) -> Spots:
        """Return the spots of a depth."""
        camera, lens = system.camera, objective_of(system.camera)
        bound = OpticalSystem(fine.at_wavelength(system.wavelength), system.wavelength)
        spread = full_field(bound, np.array([0.0, 0.0, depth]))
        directions = lens_directions(camera)
        passage = -lens.magnification * depth * directions.slope
        place = directions.middle + camera.reduced_distance / lens.last_focal_length * passage
        parts = round(camera.pixel_size / fine.pixel_size)
        columns, rows = (size // parts for size in fine.resolution)
        place = place / camera.pixel_size + np.array([columns, rows]) / 2
        # Light belongs to the nearest spot, pixel by pixel.
        x, y = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
        _, nearest = cKDTree(place).query(np.stack([x, y], -1))
        pixel = np.floor(place).astype(np.int64)
        aside = np.abs(np.stack([x, y], -1).astype(np.int64) - pixel[nearest]).max(-1)
        light = np.cumsum(np.bincount(aside.ravel(), spread.reshape(rows, parts, columns, parts).sum((1, 3)).ravel()))
        # Part of the light that may fall beyond spots.
        half = int(np.searchsorted(light, (1 - 1e-3) * light[-1]))
        spread, nearest = np.pad(spread, half * parts), np.pad(nearest, half, constant_values=-1)
        size = 2 * half + 1
        values = np.empty((len(place), size * parts, size * parts), np.float32)
        for number, (left, top) in enumerate(pixel):
            own = nearest[top : top + size, left : left + size] == number
            spot = spread[top * parts : (top + size) * parts, left * parts : (left + size) * parts]
            values[number] = spline_filter(spot * own.repeat(parts, 0).repeat(parts, 1), mode="grid-constant")
        margin = (columns - camera.resolution[0]) // 2, (rows - camera.resolution[1]) // 2
        corner = (pixel - half - margin).astype(np.int64)
        # The derivative of tan(theta) by the position on the array.
        steepness = (1 + (directions.slope**2).sum(1)) ** 1.5 / (lens.immersion * lens.last_focal_length)
        width = abs(depth) * lens.magnification**2 * camera.lattice.aperture_width * steepness
        return cls(parts, corner, values, passage, width)


class ShiftedLayer:
    """The linear function from weights of points of one depth to the image of their shifted spots.

    The field stop cuts light before lenses spread it: where it cuts that of a point through a lens, the spot is darker.
    """

    def __init__(self, system: OpticalSystem, spots: Spots, positions: Doubles):
        camera, lens = system.camera, objective_of(system.camera)
        self._camera, self._spots, self._lens = camera, spots, cast(FourierLens, system.lens)
        # Millimetres in the native image plane for a pixel.
        self._native = camera.pixel_size * lens.last_focal_length / camera.reduced_distance
        box, size = recorded_pixels(camera), spots.values.shape[1] // spots.parts
        # Points beyond send no light to recorded pixels.
        stop = self._lens.window.radius + spots.width.max() + np.abs(spots.passage).max()
        low = np.maximum((np.array([box.left, box.top]) - spots.corner - size).min(0), -stop / self._native)
        high = np.minimum(
            (np.array([box.left + box.columns, box.top + box.rows]) - spots.corner).max(0), stop / self._native
        )
        shift = positions * (lens.magnification / self._native)
        # Light of the slope s travels z s / sqrt(1 - s^2) across: to third order, for the mean slope a in a lens.
        slope = positions * (lens.magnification / lens.last_focal_length / camera.mla_medium)
        outer = np.square(camera.lattice.aperture_grid(32)).sum(0).mean()
        bent = outer / min(camera.mla_focal_lengths) ** 2
        shift = shift * (1 + (slope**2).sum(1, keepdims=True) / 2 + bent)
        near = ((shift > low) & (shift < high)).all(1)
        shift = np.clip(shift, low, high)
        # Pixels of a grid of shifts that holds those of all points, and of the convolution with spots.
        self._origin = np.floor(shift.min(0)).astype(np.int64) - 2
        self._grid = np.ceil(shift.max(0)).astype(np.int64) + 3 - self._origin
        self._shape = tuple(((self._grid + size) * spots.parts)[::-1].tolist())
        columns, rows = (self._grid * spots.parts).tolist()
        place = (shift - self._origin) * spots.parts
        nodes = np.floor(place).astype(np.int64)[:, :, None] + np.arange(-1, 3)
        factors = _SPLINE(nodes - place[:, :, None]) * near[:, None, None]
        index = nodes[:, 1, :, None] * columns + nodes[:, 0, None, :]
        values = factors[:, 1, :, None] * factors[:, 0, None, :]
        starts = np.arange(0, index.size + 1, 16)
        self._points = csr_array((values.ravel(), index.ravel(), starts), (len(shift), rows * columns))

    def forward(self, weights: Doubles) -> Floats:
        """Return the image (channels, rows, columns) of weights (points, channels)."""
        parts = self._spots.parts
        columns, rows = self._grid * parts
        shifts = (self._points.T @ weights).T.reshape(-1, rows, columns).astype(np.float32)
        image = np.pad(np.zeros((len(shifts), *self._camera.shape), np.float32), self._margins)
        for number, window in self._windows():
            spectrum = rfft2(shifts * self._passed(number), self._shape)
            light = irfft2(spectrum * rfft2(self._spots.values[number], self._shape), self._shape)
            height, width = (length // parts for length in self._shape)
            image[window] += light.reshape(-1, height, parts, width, parts).sum((2, 4))
        (_, (top, _), (left, _)), (height, width) = self._margins, self._camera.shape
        return image[:, top : top + height, left : left + width]

    def adjoint(self, image: Floats) -> Doubles:
        """Return the products (points, channels) of the points' spots with an image (channels, rows, columns)."""
        parts = self._spots.parts
        columns, rows = self._grid * parts
        shifts = np.zeros((len(image), rows, columns), np.float32)
        image = np.pad(image, self._margins)
        for number, window in self._windows():
            spectrum = rfft2(image[window].repeat(parts, 1).repeat(parts, 2))
            light = irfft2(spectrum * rfft2(self._spots.values[number], self._shape).conj(), self._shape)
            shifts += self._passed(number) * light[:, :rows, :columns]
        return np.asarray(self._points @ shifts.reshape(len(image), -1).T, np.float64)

    @property
    def _margins(self) -> list[Shape]:
        """Pixels around an image, as wide as the convolution."""
        return [(0, 0), *((length // self._spots.parts,) * 2 for length in self._shape)]

    def _windows(self) -> Iterator[tuple[int, Any]]:
        """Yield the lenses that light the image, and the window of the convolution in the image with its margins."""
        box, (_, (height, _), (width, _)) = recorded_pixels(self._camera), self._margins
        for number, corner in enumerate(self._origin + self._spots.corner):
            left, top = (corner - (box.left, box.top) + (width, height)).tolist()
            if 0 < left < box.columns + width and 0 < top < box.rows + height:
                yield number, np.s_[:, top : top + height, left : left + width]

    def _passed(self, number: int) -> Any:
        """Return the part of a lens's light that passes the field stop, for the shifts of the grid."""
        stop = self._lens.objective.field_stop
        if stop is None:
            return np.float32(1)
        x, y = (
            (np.arange(count) / self._spots.parts + origin) * self._native + passage
            for count, origin, passage in zip(
                self._grid * self._spots.parts, self._origin, self._spots.passage[number], strict=True
            )
        )
        width = max(self._spots.width[number], self._native / self._spots.parts)
        return (self._lens.field_inset(x, y[:, None]) / width + 0.5).clip(0, 1).astype(np.float32)


def fine_camera(
    camera: PlenopticCamera,
    wavelength: float,
    deepest: float,
    bins: int = 1,
    samples: int = 1,
    beyond: float = math.inf,
) -> PlenopticCamera:
    r"""Return a camera that records the light of points on the axis, with parts of pixels that resolve the light.

    The intensity behind a lens of the width w has no lines finer than :math:`\lambda z / 2 w`. A part is at most a line
    over `samples`, and a pixel has a multiple of `bins` of them. `deepest` is the largest depth of the points in
    millimetres, and `beyond` the micro-images recorded beyond the detector's borders.
    """
    p, lens = camera.pixel_size, objective_of(camera)
    z = camera.reduced_distance
    finest = in_millimetres(wavelength) * z / (2 * camera.lattice.aperture_width)
    parts = bins * max(1, math.ceil(samples * p / bins / finest))
    moved = lens.view_scale(z) * deepest * math.tan(lens.half_angle)
    if lens.field_stop is not None:
        moved = min(moved, lens.field_stop * z / lens.last_focal_length)
    # Light of the outermost lenses goes 2 lens pitches beyond the image of the stop.
    lit = math.ceil((lens.blur_diameter(0) + 4 * max(camera.mla_pitches) + 2 * moved) / p)
    # As many pixels more on one side as on the other.
    window = [
        int(min(size + 2 * beyond * count, lit + (lit - size) % 2))
        for size, count in zip(camera.resolution, camera.bin_count, strict=True)
    ]
    columns, rows = (parts * size for size in window)
    return camera.replace(
        resolution=(columns, rows), detector_width=window[0] * p, crop_offset=(0, 0), crop_size=(columns, rows)
    )
