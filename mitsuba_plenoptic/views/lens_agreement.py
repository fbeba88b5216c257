r"""Agreement of the micro-images of neighbouring lenses of a focused camera on the distance of each bin.

Micro-images hold detail finer than the pitch of the lenses, so that views, with one sample per lens, are aliased. What
a lens shows at the view u, a neighbour k lens pitches from it shows at :math:`u + k / \delta`, for the disparity
:math:`\delta` in lenses per view: samples are interpolated within micro-images, never between lenses (Perwass and
Wietzke 2012). Neighbours are lenses of any lattice and of any type: in a multi-focus array the nearest neighbours have
other types.

A sample near the rim of its micro-image receives light only through a part of its lens, whose mean point :math:`\bar m`
lies beside the lens's centre. If the lens is out of focus, the sample shows what a sample through the centre shows
:math:`\bar m (\kappa / \Delta P + 1 / (\delta D_2))` views away: the difference on the detector between the pencils
through both points, with :math:`\kappa` of `PlenopticCamera.pupil_shift` and the step :math:`\Delta P` of the pupil
from view to view. The recorded place of a sample is found iteratively, as its mean point is not known before; with the
mean point at the nominal place, depths of a camera of three focal lengths were 1 % off.
"""

import itertools
import math
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from ..camera import PlenopticCamera, Use, require_support
from ..optics.rays import second_leg
from ..runtime import Array, Pair
from .grid import array_places
from .lens_images import MicroImages

# Neighbouring bins that share their evidence: standard deviation of the Gaussian window.
_WINDOW = 1.0

# Micro-images are smoothed by these weights along both axes: without it, interpolation smooths what moves by half a
# pixel more than what moves by a whole one, and planes of such moves would agree better.
_SMOOTH = (0.25, 0.5, 0.25)

# Where, in pixels along an axis, the light of a sample was recorded: by the weights of linear interpolation about the
# centre of its micro-image and of the pixel, which have a variance of 1/4 together.
_SPREAD = (0.125, 0.75, 0.125)


# Parts along rows and columns into which an array is divided whose lenses are tilted, or seen unevenly.
_ZONES = 6

# Times by which lenses may be farther apart than neighbours, the part of their width by which micro-images may then be
# moved, and by how much farther than the first such plane neighbours must agree best.
_FARTHER = (2, 4)
_MOVED = 0.6
_BEYOND = 1.2


# Errors of the light of lenses alike, and of several focal lengths, as fractions, and bins that share them: standard
# deviation of a window. Measured on slopes of light, whose best plane noise draws to where lenses share less: behind
# three focal lengths by 5 % with 64 samples a pixel, by 0.5 % with 1024.
_UNEVEN = (0.002, 0.015)
_SHARED = 2.0


class LensComparison:
    """The micro-images of a capture, for comparison plane by plane."""

    def __init__(self, images: MicroImages):
        require_support(images.camera, Use.ROUND_PUPILS)
        self._images = images
        # Smoothed within micro-images, weighted by the part of the pupil that samples see.
        total = images.values * images.weight[..., None]
        weight = images.weight
        for axis in (2, 3):
            total = scipy.ndimage.convolve1d(total, _SMOOTH, axis=axis, mode="constant")
            weight = scipy.ndimage.convolve1d(weight, _SMOOTH, axis=axis, mode="constant")
        self._values = np.divide(total, weight[..., None], out=np.zeros_like(total), where=weight[..., None] > 0)
        self._noise = _noise_of(images)
        self._steps = tuple(np.arange(size) - (size - 1) / 2 for size in images.weight.shape[2:])

    def disagreement(self, slope: float, apart: int = 1) -> tuple[Array, Array, Array, Array, Array]:
        """Return the unexplained fraction of the variance between neighbouring lenses, moved for a disparity.

        The results are those of `agreement.ViewComparison`; the ratio is NaN where no lenses can be compared. The
        variance of a bin's samples is to be explained; the variance between lenses `apart` times as far apart as
        neighbours stays unexplained.
        """
        shape = self._images.bins.shape
        # In focus on the array, or seen in one direction alone, nothing is seen by two lenses.
        if slope == 0 or min(self._images.weight.shape[2:]) < 3:
            return np.full(shape, np.nan), np.full(shape, np.nan), *np.zeros((3, *shape))
        values, opened = self._straightened(slope)
        squares, counts, sums, sums_of_squares = np.zeros((4, *opened.shape), dtype=np.float32)
        views = opened.shape[2:]
        for block, neighbours, vector in self._pairs(apart):
            move = vector / slope
            if np.any(np.abs(move) > np.array(views[::-1]) - 2):
                continue
            (v, next_v, fv), (u, next_u, fu) = (_overlap(views[1 - axis], move[axis]) for axis in (1, 0))

            target = (*block, v, u)
            both = (_moved(opened[(*neighbours, next_v, next_u)], fv, fu) > 1 - 1e-3) * opened[target]
            first = values[target]
            second = _moved(values[(*neighbours, next_v, next_u)], fv, fu)
            apart_by = second - first
            # The difference of two has twice the variance of each.
            squares[target] += np.einsum("...c,...c->...", apart_by, apart_by) * (both / (2 * apart_by.shape[4]))
            mean = (first + second).mean(axis=4) / 2
            sums[target] += mean * both
            sums_of_squares[target] += np.square(mean) * both
            counts[target] += both
        bins = self._bins_of(slope)
        sums_of_bins = [
            np.bincount(bins.ravel(), samples.ravel(), minlength=math.prod(shape) + 1)[:-1].reshape(shape)
            for samples in (squares, counts, sums, sums_of_squares, counts * self._noise[..., None, None])
        ]
        total, count_near, first, second, noise = scipy.ndimage.gaussian_filter(
            sums_of_bins, (0, _WINDOW, _WINDOW), mode="nearest"
        )
        many = np.maximum(count_near, 1)
        variance = total / many
        # The mean of two has half of the variance by which both differ, and all of that which they share.
        total_variance = np.maximum(second / many - np.square(first / many), 0) + variance / 2
        ratio = np.divide(variance, total_variance, out=np.ones_like(total_variance), where=total_variance > 0)
        ratio, total_variance = np.where(count_near >= 5.0, (ratio, total_variance), np.nan).astype(np.float32)
        # Independent samples in a window for each comparison in a bin: found on even fields of noise, of which the
        # ratio of variances then varies as much as the number of samples says. Of its thirteen comparisons smoothing
        # leaves the noise of two independent.
        return ratio, total_variance, 8.0 * count_near, 2.0 * count_near, np.minimum(noise / many, variance)

    def compare_farther(self, measured: Array, slopes: Array) -> None:
        """Compare lenses farther apart where these see the same: there neighbours agree on many planes nearly as well.

        What `disagreement` gave for all planes, (5, planes, rows, columns), is replaced. How far apart lenses are is
        chosen once for each bin, as a distance that grew from plane to plane would look like a minimum before the end
        of the search. On nearer planes, which have too little in common for these lenses and where neighbours saw no
        point, the disagreement is raised to continue that of these.
        """
        # Disparity from which on neighbours move by less than the width of a micro-image.
        nearest = max(np.abs(vector).max() for *_, vector in self._pairs(1)) / min(self._images.weight.shape[2:])
        for apart in _FARTHER:
            energy = np.log(np.nan_to_num(measured[0], nan=1.0))
            best = np.abs(slopes[scipy.ndimage.gaussian_filter(energy, (0, 2.0, 2.0)).argmin(axis=0)])
            far = np.abs(slopes) * _MOVED >= apart * nearest
            row, column = np.nonzero(best * _MOVED >= _BEYOND * apart * nearest)
            if not row.size:
                continue
            new = np.stack([self.disagreement(float(slope), apart) for slope in slopes[far]], axis=1)[:, :, row, column]
            for side in (slopes < 0, slopes > 0):
                if (far & side).any():
                    first = np.where(far & side, np.abs(slopes), np.inf).argmin()
                    step = new[0, np.count_nonzero(far[:first])] / measured[0, first, row, column]
                    measured[0, np.flatnonzero(~far & side)[:, None], row, column] *= np.fmax(step, 1)
            measured[:, np.flatnonzero(far)[:, None], row, column] = new

    def moved_by_errors(self) -> Array:
        """Return how far errors of lenses' light may move what agrees best, in inverse disparities, of each bin.

        Errors move an even slope by their size over the slope, and texture, which rises and falls, hardly at all.
        """
        values = self._values.mean(axis=4)
        gradients = np.stack(np.gradient(values, axis=(2, 3)))
        inside = scipy.ndimage.minimum_filter(self._images.weight >= 0.5, (1, 1, 3, 3), mode="constant", cval=0)
        sums = np.zeros((5, *self._images.bins.shape))
        # Of each lens, where it stands.
        column, row = np.rint(self._images.places.T).astype(int).clip(0, np.reshape(sums.shape[:0:-1], (2, 1, 1)) - 1)
        for total, samples in zip(sums, (1.0, values, *gradients, np.square(gradients).sum(axis=0)), strict=True):
            np.add.at(total, (row, column), (samples * inside).sum(axis=(2, 3)).T)
        count, light, down, across, squares = scipy.ndimage.gaussian_filter(sums, (0, _SHARED, _SHARED))
        slope = np.hypot(down, across)
        # Noise makes up most of the squares where texture is weak.
        squares = np.maximum(0.2 * squares * count, np.square(slope)) + 1e-300
        apart = math.sqrt(np.mean([vector @ vector for *_, vector in self._pairs(1)]))
        return _UNEVEN[bool(self._images.types.any())] * light * slope / (squares * apart)

    def _pairs(self, apart: int) -> list[tuple[tuple[slice, slice], tuple[slice, slice], Array]]:
        """Each pair of neighbouring lenses once, as blocks of lenses, blocks of neighbours, and their offset.

        The offset is in pitches of the bins, along columns and rows. Lenses are `apart` times as far apart.
        """
        grid = self._images.grid
        bins = self._images.bins
        rows, columns = grid.shape
        rotation = np.array([[math.cos(grid.rotation), -math.sin(grid.rotation)],
                         [math.sin(grid.rotation), math.cos(grid.rotation)]])  # fmt: skip
        reach = 2.0 * grid.nearest_distance * (1 + 1e-6)
        down_most, across_most = (math.ceil(reach / spacing) for spacing in grid.spacing[::-1])
        pairs = []
        for down, step in itertools.product(range(down_most + 1), range(-across_most - 1, across_most + 2)):
            # From shifted rows to others, lenses of the same column stand half a step back.
            between = 0.5 if grid.shifted_rows is not None and down % 2 == 1 else 0.0
            way = np.array([(step + between) * grid.spacing[0], down * grid.spacing[1]])
            if math.hypot(*way) > reach or (down == 0 and step <= 0):
                continue
            staggered = grid.shifted_rows is not None and apart * down % 2 == 1
            for first in (0, 1) if staggered else (0,):
                shift = 0.0 if not staggered else (-0.5 if first == grid.shifted_rows else 0.5)
                across = round(apart * (step + between) - shift)
                if apart * down >= rows or abs(across) >= columns:
                    continue
                every = 2 if staggered else 1
                left = max(0, -across)
                right = min(columns, columns - across)
                block = (slice(first, rows - apart * down, every), slice(left, right))
                neighbours = (slice(first + apart * down, rows, every), slice(left + across, right + across))
                pairs.append((block, neighbours, rotation @ way * apart / bins.spacing))
        return pairs

    def _straightened(self, slope: float) -> Pair:
        """Return samples at the positions where a pencil through the lens's centre would show them, and a mask."""
        images = self._images
        values = np.empty_like(self._values)
        weight = np.empty_like(images.weight)
        position = np.indices(images.weight.shape[2:], dtype=np.float64)
        last = position[:, -1:, -1:]
        camera = images.camera
        for here, kappa, mean, inwards in self._rims:
            views = kappa / camera.pupil_step + 1 / (slope * camera.row_pitch)
            # What each sample shows belongs so far from it, the other way; `at` shows what belongs at a place.
            away = mean * views - inwards
            at = position
            # Repetitions to find where a straightened sample was recorded. With lenses out of focus by half of their
            # width each change is at most 0.7 of the last one.
            for _ in range(12):
                at = position + [scipy.ndimage.map_coordinates(offset, at, order=1, mode="nearest") for offset in away]
            inside = np.all((at >= 0) & (at <= last), axis=0)[..., None]
            cell = at.clip(0, last - 1).astype(np.int64)
            offset = (at - cell).clip(0, 1).astype(np.float32)
            for source, target in ((self._values, values), (images.weight[..., None], weight[..., None])):
                of_type = source[here]
                fv, fu = (fraction[..., None] for fraction in offset)
                upper, lower = (
                    of_type[:, cell[0] + down, cell[1]] * (1 - fu) + of_type[:, cell[0] + down, cell[1] + 1] * fu
                    for down in (0, 1)
                )
                target[here] = (upper * (1 - fv) + lower * fv) * inside
        # Samples that see less than half of the pupil are noise for the most part, more of it on some planes than on
        # others: with a third, depths of weak texture in noise were 1.4 % off.
        return values, (weight >= 0.5).astype(np.float32)

    @cached_property
    def _rims(self) -> list[tuple[Array, float, Array, Array]]:
        """Effects of the pupil's rim on the samples of lenses alike: which, their kappa, and two arrays (2, v, u).

        The first is the mean point, in mm, of the part of the lens through which a sample sees the pupil; the second is
        the displacement in pixels of the sample's recorded light: inwards, as less light comes from where less of the
        lens is open, or pixels prefer it less. Both are along v and u.
        """
        camera = self._images.camera
        rims = []
        v, u = (np.append(np.append(step[0] - 1, step), step[-1] + 1) * camera.pupil_step for step in self._steps)
        offset = np.arange(-1, 2)
        types = self._images.types
        uneven = camera.pixel_response or camera.mla_absorption or any(camera.mla_tilt)
        row, column = np.indices(types.shape) * _ZONES // np.reshape(types.shape, (2, 1, 1)) * bool(uneven)
        kinds = (types * _ZONES + row) * _ZONES + column
        for kind in np.unique(kinds):
            here = kinds == kind
            # Samples that take part in smoothing.
            there = (self._images.weight[here] > 0).any(axis=0)
            middle = array_places(camera, self._images.grid.centres()[here].mean(axis=0))
            f2 = camera.mla_focal_lengths[kind // _ZONES**2]
            point, open_, kappa = light_of_lens(camera, f2, middle, -u, -v[:, None])
            sums = [open_.sum(axis=2), *((open_ * point[axis]).sum(axis=2) for axis in (1, 0))]
            count, *moments = (_weighted(total, _SPREAD, _SPREAD)[1:-1, 1:-1] * there for total in sums)
            off = [
                _weighted(sums[0], *kernels)[1:-1, 1:-1] * there
                for kernels in ((_SPREAD * offset, _SPREAD), (_SPREAD, _SPREAD * offset))
            ]
            off = [
                _weighted(inner, _SMOOTH, _SMOOTH) + _weighted(count, *kernels)
                for inner, kernels in zip(off, ((_SMOOTH * offset, _SMOOTH), (_SMOOTH, _SMOOTH * offset)), strict=True)
            ]
            open_weight = np.maximum(_weighted(count, _SMOOTH, _SMOOTH), 1e-6)
            mean = np.stack([_weighted(moment, _SMOOTH, _SMOOTH) for moment in moments]) / open_weight
            rims.append((here, kappa, mean, np.stack(off) / open_weight))
        return rims

    def _bins_of(self, slope: float) -> Array:
        """Return the index of the central view's bin that each sample shows; the number of bins if there is none."""
        shape = self._images.bins.shape
        column, row = np.moveaxis(self._images.places, 2, 0)
        down, across = self._steps
        rows = np.rint(row[:, :, None] - down * slope).astype(np.int64)[..., None]
        columns = np.rint(column[:, :, None] - across * slope).astype(np.int64)[:, :, None]
        inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
        return np.where(inside, rows * shape[1] + columns, math.prod(shape))


def light_of_lens(camera: PlenopticCamera, f2: float, place: Array, x: Array, y: Array) -> tuple[Array, Array, float]:
    """Return points of a lens (2, n), in mm from its centre, the light through them, and its kappa.

    The light (..., n), to which pixels respond, is that of samples which see the pupil point (x, y) through the centre.
    """
    right, up = camera.lattice.aperture_grid(32)
    height = camera.array_height(*place)
    kappa = camera.pupil_shift(f2, height)
    x = x[..., None]
    y = y[..., None]
    light = np.hypot(x + kappa * right, y + kappa * up) < camera.aperture_radius
    if camera.pixel_response or camera.mla_absorption:
        depth = camera.detector_distance + height
        near = depth / camera.mla_medium / (camera.pupil_distance - height)
        counts = second_leg(camera.pixel_response, camera.mla_absorption or 0.0, np.ndarray)
        light = light * counts(np.hypot(right + (x - place[0]) * near, up + (y - place[1]) * near), depth)
    return np.stack([right, up]), light, kappa


def _noise_of(images: MicroImages) -> Array:
    """Return the variance of noise in the smoothed samples of each lens: second differences hold little texture."""
    bent = images.values
    inside = images.weight > 0
    for axis in (2, 3):
        bent = scipy.ndimage.correlate1d(bent, (1, -2, 1), axis=axis)
        inside = scipy.ndimage.minimum_filter1d(inside, 3, axis=axis, mode="constant")
    power = (np.square(bent).mean(axis=4) * inside).sum(axis=(2, 3)) / np.maximum(inside.sum(axis=(2, 3)), 1)
    # Sums of squares of both kernels, as samples were interpolated between pixels; a tenth is averaged out again where
    # neighbours are moved by a fraction of a view.
    between = np.square((images.grid.centres() - 0.5) % 1 - 0.5)
    return np.asarray(0.9 * power * ((0.3125 + 0.25 * between) / (1 + 20 * between)).prod(axis=2), np.float32)


def _weighted(samples: Array, down: Any, across: Any) -> Array:
    """Return weighted sums of samples along both axes; beyond them is nothing."""
    samples = scipy.ndimage.correlate1d(samples * 1.0, down, axis=0, mode="constant")
    return scipy.ndimage.correlate1d(samples, across, axis=1, mode="constant")


def _moved(samples: Array, fv: np.float32, fu: np.float32) -> Array:
    """Return samples (rows, columns, v, u, ...) interpolated by fractions of a view; each axis has one view fewer."""
    samples = samples[:, :, :-1] + fv * (samples[:, :, 1:] - samples[:, :, :-1])
    return samples[:, :, :, :-1] + fu * (samples[:, :, :, 1:] - samples[:, :, :, :-1])


def _overlap(views: int, move: float) -> tuple[slice, slice, np.float32]:
    """Return views with a partner `move` views on, the partners' integer views, and the fraction between them."""
    steps = math.floor(move)
    first = max(0, -steps)
    last = min(views, views - 1 - steps)
    return slice(first, last), slice(first + steps, last + steps + 1), np.float32(move - steps)
