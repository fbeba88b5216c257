"""Agreement of the views of a light field on the distance of each bin."""

import numpy as np
import scipy
import xarray as xr

from ..runtime import Array, Pair
from .coordinates import camera_of, channel_planes, grid_of, view_places, view_steps, wavelength_of
from .pupil_means import light_of_views, texture_of
from .refocusing import moved

# Neighbouring bins that share their evidence: standard deviation of the Gaussian window. Moved views spread it further.
_WINDOW = 0.85

# Steps between the nearest views without a common pixel. They differ by noise, and by little else near the right plane.
_APART = 2

# Samples that see at least this much of the pupil, and of the light of the middle, are compared. The others see the
# pupil much nearer to its middle than their coordinate says.
LEAST = 0.9


class ViewComparison:
    """Comparison of the views of a light field, shifted for a disparity; see `lens_agreement.LensComparison`."""

    def __init__(self, lf: xr.DataArray):
        self._lf = lf
        self._texture = texture_of(lf)
        # Along u and along v, (2, v, u).
        self._steps = view_places(lf)
        self._spread = spread_of_samples(lf, 0), spread_of_samples(lf, 1)
        weight = lf["weight"].values
        white, seen = (lf.coords.get(name, lf["weight"]).sum(("t", "s")).values for name in ("white", "weight"))
        with np.errstate(divide="ignore", invalid="ignore"):
            brightness = np.log(white / seen)
        self._compared = np.ones(seen.shape, bool)
        if self._is_decoded:
            self._camera = camera_of(lf)
            self._views = tuple(tuple(view_steps(lf, axis).tolist()) for axis in "uv")
            # Of light of a lens alone, and of all lenses.
            whole, even = (self._light(0.0, wavelength_of(lf), texture)[0] for texture in (1e-3, 1e3))
            brightness -= np.log(even / self._light(0.0, None, 1e3)[0])
            self._compared = (np.median(weight, axis=(2, 3)) >= LEAST) & (whole >= LEAST * whole.max())
        # Steps by which the mean points of views are nearer to brighter ones; stated slopes are means.
        self._brighter = np.zeros_like(self._steps)
        whole_view = np.ones((*seen.shape, 1, 1), np.float32)
        if "slope_x" in lf.coords:
            whole_view = weight.max(axis=(2, 3), keepdims=True)
            self._compared = whole_view[..., 0, 0] > 0
        elif min(seen.shape) >= 3:
            with np.errstate(invalid="ignore"):
                rises = np.ma.masked_invalid(np.gradient(brightness, edge_order=2)[::-1])
            for axis, (spread, rise) in enumerate(zip(self._spread, rises, strict=True)):
                self._brighter[axis] = spread * np.expand_dims(rise.mean(axis).filled(0), axis)
        enough = (weight >= LEAST * whole_view) & self._compared[..., None, None]
        self._weight = enough.astype(np.float32)

    def narrowed(self, slope: float) -> float:
        """Return the fraction by which blur brings the mean points of views nearer to the middle, for a disparity."""
        views = self._steps * self._compared
        return float(-(self._moved_by(slope) * views).sum() / max(np.square(views).sum(), 1))

    @property
    def _is_decoded(self) -> bool:
        """Whether views are samples between pixels of a known camera; views of other origin are of pupil points."""
        attributes = self._lf.attrs
        return bool(attributes.get("camera") and attributes.get("grid")) and min(self._lf.shape[:2]) >= 3

    def _light(self, slope: float, wavelength: float | None, texture: float) -> Pair:
        """Return the light of the views by the camera, and its sums; see `light_of_views`."""
        return light_of_views(self._camera, wavelength, self._spread, texture, slope or 1e-9, *self._views)

    def _moved_by(self, slope: float) -> Array:
        """Return by how many steps (2, v, u) blur moves the mean points of the views that are compared."""
        if not self._is_decoded:
            return np.zeros_like(self._steps)
        light, sums = self._light(slope, wavelength_of(self._lf), self._texture)
        return (sums / light - self._steps) * self._compared

    def _places(self, slope: float) -> Array:
        """Return the mean points, along u and along v, at which views see the pupil, in views from the centre."""
        places = self._steps + self._brighter
        for axis, moved_by in enumerate(self._moved_by(slope)):
            of_line = moved_by.sum(axis, keepdims=True)
            places[axis] += of_line / np.maximum(self._compared.sum(axis, keepdims=True), 1)
        return places

    def disagreement(self, slope: float) -> tuple[Array, Array, Array, Array, Array]:
        """Return the unexplained fraction of the variance between views that are shifted for one disparity.

        Returned, each (t, s), are that ratio, from 0 to 1, which noise alone reaches, NaN where too few views see a
        bin; the variance to be explained; the number of samples, over which 1 is the variance of the ratio of pure
        noise; the number of samples whose noise is independent; and the variance of noise, half of the mean square of
        the differences between views that are two steps apart.

        The variance to be explained is that of the views in each bin, which is left unexplained, plus that of their
        mean among neighbouring bins. Interpolation reduces both alike. Where the ratio for the upper, lower, left or
        right half of the pupil is less than half as large, twice that ratio counts: next to an occluder's edge, one
        half of the pupil sees past it.
        """
        variance, mean, count, noise = self._moved_views(slope)
        count_near, parts, means, squares = (
            scipy.ndimage.gaussian_filter(moment, (0, _WINDOW, _WINDOW), mode="nearest")
            for moment in (count, count * variance, count * mean, count * np.square(mean))
        )
        parts, means, squares = (moment / np.maximum(count_near, 1e-6) for moment in (parts, means, squares))
        # Fraction of the views that must see a bin: few agree by chance.
        parts[count < 0.25 * count.max((1, 2), keepdims=True)] = np.nan
        # Views that have the noise of one: decoding interpolates them between the same pixels.
        independent = np.maximum(count_near / 2.0, 1)
        # Noise, too, leaves a variance in means.
        total_variance = parts + np.maximum(squares - np.square(means) - parts / independent, 0)
        ratio = np.divide(parts, total_variance, out=np.ones_like(parts), where=~(total_variance <= 0))
        # What half of the pupil leaves unexplained counts so many times: with half a baseline wrong depths stand out
        # less.
        ratio[1:] *= 2.0
        samples = np.square(independent) * (2 * np.pi * _WINDOW**2)
        best = np.argmin(np.where(np.isnan(ratio), np.inf, ratio), axis=0)[None]
        ratio, samples = (np.take_along_axis(moment, best, 0)[0] for moment in (ratio, samples))
        squares, pairs = scipy.ndimage.gaussian_filter(noise, (0, _WINDOW, _WINDOW), mode="nearest")
        return (
            ratio,
            total_variance[0],
            samples,
            np.sqrt(samples * (2 * np.pi * _WINDOW**2)),
            np.minimum(squares / np.maximum(pairs, 1e-6), parts[0]),
        )

    def _moved_views(self, slope: float) -> tuple[Array, Array, Array, Array]:
        """Return variance, mean and number of the views that see each bin, shifted for one disparity.

        Each is (5, t, s): of the whole pupil and of its upper, lower, left and right half, averaged over the channels.
        Samples at the pupil's edge are left out. Added are (2, t, s) sums of squares of noise, and how many they are.
        """
        lf = self._lf
        places = self._places(slope)
        variance, mean, views = np.zeros((3, 5, *lf.shape[2:4]), dtype=np.float32)
        noise = np.zeros((2, *lf.shape[2:4]), dtype=np.float32)
        for plane in channel_planes(lf):
            # Counts, sums of values and of their squares over each quadrant of the pupil.
            sums = np.zeros((2, 2, 3, *lf.shape[2:4]), dtype=np.float64)
            for row, row_weight, *of_row in zip(plane, self._weight, *places, strict=True):
                passed = []
                for view, view_weight, across, down in zip(row, row_weight, *of_row, strict=True):
                    if not view_weight.any():
                        continue
                    total, view_open = (
                        moved(moved(pixels, down * slope, axis=0), across * slope, axis=1)
                        for pixels in (view * view_weight, view_weight)
                    )
                    values = total / np.maximum(view_open, 0.5)
                    # Between a bin and none the values are of places within the field, which moved depths by 1 %.
                    view_open = np.maximum(4 * view_open - 3, 0)
                    moments = view_open * np.stack([np.ones_like(values), values, np.square(values)])
                    passed.append((values, view_open))
                    if len(passed) > _APART:
                        earlier = passed[-1 - _APART][0]
                        both = view_open * passed[-1 - _APART][1]
                        noise += np.stack([both * np.square(values - earlier) / 2, both])
                    # A view on a dividing line belongs to both of its sides by half.
                    for j, vertical in enumerate(_sides(down)):
                        for i, horizontal in enumerate(_sides(across)):
                            if vertical * horizontal:
                                sums[j, i] += np.float32(vertical * horizontal) * moments
            count, total, square = np.stack([sums.sum((0, 1)), *sums.sum(1), *sums.sum(0)], 1)
            level = total / np.maximum(count, 1e-6)
            variance += np.maximum(square / np.maximum(count, 1e-6) - level**2, 0)
            mean += level
            views += count
        channels = lf.sizes.get("c", 1)
        return variance / channels, mean / channels, views / channels, noise


def finer_stripes(image: Array, moved: Array) -> Array:
    """Return the probability (rows, columns) that an all-in-focus image shows stripes finer than two lenses.

    If a texture has a single frequency f, in cycles per lens, a view with one sample per lens is the same for the
    frequency 1 - f, which moves differently from view to view: the depth at which views agree is then not the true one.
    A lens averages over its width, so that the coarser stripes have a contrast of at most sinc(f), the finer ones of at
    most sinc(1 - f). If all complex amplitudes up to these are equally likely beforehand, an amplitude possible for
    both belongs to the finer stripes with a probability of sinc(f)^2 / (sinc(f)^2 + sinc(1 - f)^2), 1/2 or more. A
    texture of many frequencies agrees only at its depth; but on other lattices interpolation between lenses adds
    frequencies to finer stripes. Finer stripes are recognised by their mean frequency, above that of any other texture
    in views shifted by more than a lens (`moved`).
    """
    if min(image.shape) < 3:
        return np.zeros(image.shape)
    image = image.astype(np.float64)
    detail = image - scipy.ndimage.gaussian_filter(image, 4.0)
    bent = -scipy.ndimage.laplace(detail)
    # At the border the Laplacian is not known.
    inner = np.pad(np.ones((image.shape[0] - 2, image.shape[1] - 2)), 1)
    # Bins that show the texture of a bin: standard deviation of a Gaussian window.
    power, bend, steepness, mean = (
        scipy.ndimage.gaussian_filter(moment * inner, 3.0, mode="constant")
        for moment in (np.square(detail), detail * bent, np.square(bent), image)
    )
    counted = scipy.ndimage.gaussian_filter(inner, 3.0, mode="constant")
    tiny = np.finfo(np.float64).tiny
    # Only of a single frequency is the Laplacian proportional to the image.
    single = bend / np.sqrt(power * steepness + tiny)
    frequency = np.arccos((1 - bend / (2 * power + tiny)).clip(-1, 1)) / (2 * np.pi)
    contrast = np.sqrt(2 * power * counted) / np.maximum(mean, tiny)
    coarser = np.sinc(frequency)
    finer = np.sinc(1 - frequency)
    # Mean frequency of a texture, in cycles per lens, in the mean of views that were moved: interpolation leaves what
    # is broad below the first, found up to 0.28, stripes as fine as a lens stay above the second.
    fine = np.where(moved, (frequency - 0.33) / (0.37 - 0.33), 0)
    # Correlation of a texture with its Laplacian: at most the first where it has many frequencies, above the second
    # where it has but one. Smooth random textures were found between 0.55 and 0.9, stripes above 0.92.
    aliased = np.maximum((single - 0.88) / (0.96 - 0.88), fine).clip(0, 1)
    # What is dark or has no frequency is far above 1.3, and must not overflow.
    ratio = np.minimum(contrast, 1e3) / np.maximum(finer, 1e-6)
    possible = aliased * ((1.3 - ratio) / 0.3).clip(0, 1)
    return possible * np.square(coarser) / (np.square(coarser) + np.square(finer))


def spread_of_samples(lf: xr.DataArray, across: int) -> float:
    """Return the variance of a sample's light along an axis in squared pixels: between two pixels, and within each."""
    grid = grid_of(lf)
    between = 0.2 if grid is None else (grid.centres()[..., across] - 0.5) % 1
    return float(np.mean(between * (1 - between)) + 1 / 12)


def _sides(step: float) -> Pair:
    """Return the fraction of a view that lies on the low and on the high side of the pupil's middle."""
    high = float(np.clip(step + 0.5, 0, 1))
    return 1 - high, high
