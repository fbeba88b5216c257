"""Least squares for the pupil over the field, from the pixels of a white picture's micro-images.

The numbers of `micro_image.PupilNumbers` are polynomials of the lens's place. Gauss-Newton steps compare the pixels of
lenses with the model at the middle of a zone of the field, corrected for each lens (to first order where its pupil is
nearly that of the zone), and leave the brightness of each lens free (variable projection: G. Golub and V. Pereyra 2003,
"Separable nonlinear least squares").
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ...camera import PlenopticCamera
from ...runtime import Array, Named, Progress, Sizes, Triple, exponents, monomials
from .micro_image import NUMBERS, SHAPE, MicroImageModel, PupilNumbers
from .white_frames import WhiteFrame

ZONE_LENSES = 24
"""Lenses of a zone that a fit uses."""

_REPEATS = 12
_BINS = 2
"""Bins of mean micro-images along a pixel."""


class FieldNumbers:
    """Polynomials over the field whose values are the numbers of `PupilNumbers` at a place."""

    def __init__(self, size: Sizes, lenses: int, start: PupilNumbers, zero: tuple[str, ...] = ()):
        """Start with the same numbers everywhere, on a picture of columns and rows, of degrees that lenses allow.

        Numbers named as `zero` stay so.
        """
        self.middle = (np.array(size) - 1) / 2
        self.scale = max(size) / 2
        # A polynomial has at most a quarter as many coefficients as there are lenses.
        most = next(degree for degree in (4, 3, 2, 1, 0) if 4 * len(exponents(degree)) <= max(lenses, 4))
        # Numbers that are missing here are the same everywhere.
        degrees = {"radius": 4, "ellipse_x": 4, "ellipse_y": 4, "centre_x": 3, "centre_y": 3}
        degrees |= {"slope_x": 2, "slope_y": 2, "apodisation_2": 2, "stray": 2}
        self.degrees = {name: -1 if name in zero else min(degrees.get(name, 0), most) for name in NUMBERS}
        self.coefficients = {name: np.zeros(len(exponents(degree))) for name, degree in self.degrees.items()}
        for name in NUMBERS:
            self.coefficients[name][:1] = getattr(start, name)

    @classmethod
    def of(cls, middle: Array, scale: float, coefficients: dict[str, Array]) -> FieldNumbers:
        """Return polynomials about a middle in pixels, of places over a scale, with known coefficients."""
        field = cls((1, 1), 0, PupilNumbers(1.0))
        field.middle = middle
        field.scale = scale
        field.coefficients = coefficients
        return field

    @property
    def number(self) -> Array:
        """Index in `NUMBERS` of each coefficient, in their order."""
        return np.repeat(np.arange(len(NUMBERS)), [len(self.coefficients[name]) for name in NUMBERS])

    def terms(self, position: Array) -> Array:
        """Return the monomial of each coefficient at places (n, 2), which run from -1 to 1 along the longer side."""
        x, y = ((position - self.middle) / self.scale).T
        terms = monomials(x, y, exponents(4))
        return np.stack([term for name in NUMBERS for term in terms[: len(self.coefficients[name])]], axis=-1)

    def values(self, position: Array) -> Array:
        """Return the numbers (n, 11) at places (n, 2) in pixels."""
        coefficients = np.concatenate([self.coefficients[name] for name in NUMBERS])
        return self.terms(position) @ (coefficients[:, None] * (self.number[:, None] == np.arange(len(NUMBERS))))

    def split(self, values: Array) -> dict[str, Array]:
        """Return values of all coefficients by the names of their numbers."""
        return {name: values[self.number == index] for index, name in enumerate(NUMBERS)}

    def deviations(self, equations: Array, generator: np.random.Generator) -> dict[str, Array]:
        """Return the coefficients' standard deviations from lenses drawn again, by normal equations of lenses."""
        count = len(equations)
        resampled = (generator.multinomial(count, np.full(count, 1 / count)) for _ in range(100))
        changes = [solved(np.tensordot(times, equations, 1)) for times in resampled]
        return self.split(np.std(changes, axis=0))


def solved(equations: Array, damping: float = 0.0) -> Array:
    """Return the change of coefficients that solves damped normal equations (n, n + 1)."""
    scale = np.sqrt(np.maximum(equations[:, :-1].diagonal(), 1e-12))
    normal = equations[:, :-1] / np.outer(scale, scale) + (damping + 1e-10) * np.eye(len(scale))
    return np.linalg.solve(normal, equations[:, -1] / scale) / scale


def zones_of(
    position: Array, chosen: Array, most: int = 0, generator: np.random.Generator | None = None
) -> list[Array]:
    """Return chosen lenses at places (n, 2) by squares of the field, at most a number of each, drawn at random."""
    low = position[chosen].min(0)
    width = np.ptp(position[chosen], axis=0).max()
    count = int(np.clip(np.sqrt(chosen.sum() / ZONE_LENSES), 1, 8))
    index = ((position - low) / width * count).astype(int).clip(0, count - 1) @ [1, count]
    zones = [np.flatnonzero(chosen & (index == zone)) for zone in np.unique(index[chosen])]
    if generator is None:
        return zones
    return [generator.choice(lenses, most, replace=False) if len(lenses) > most else lenses for lenses in zones]


@dataclass(frozen=True)
class LensPixels:
    """Pixels (n,) of lenses, lens by lens, each at the lens whose cell the pixel is in, beside the model."""

    # Number of each lens's first pixel, and of all, (lenses + 1,).
    first: Array
    # Offsets in pixels from the image of the lens's place.
    x: Array
    y: Array
    # 0 for pixels that lie off the model, as of dust.
    weight: Array
    # Recorded value over the model's, (lenses,).
    brightness: Array
    # Recorded values over the brightness, less the model.
    residual: Array
    # Derivatives (n, numbers) by the numbers, less what a change of brightness explains.
    slopes: Array

    def equations(self, terms: Array, number_index: Array) -> Array:
        """Return each lens's normal equations (lenses, n, n + 1) for coefficients with terms (lenses, n)."""
        root = np.sqrt(self.weight)[:, None]
        design = np.concatenate([self.slopes * root, self.residual[:, None] * root], axis=1)
        products = np.stack([some.T @ some for some in np.split(design, self.first[1:-1])])
        normal = products[:, number_index[:, None], number_index] * (terms[:, :, None] * terms[:, None, :])
        return np.concatenate([normal, (products[:, number_index, -1] * terms)[:, :, None]], axis=2)


@dataclass(frozen=True)
class Judgement:
    """Agreement of a white picture with the model.

    Attributes
    ----------
    residual : float
        Root mean square of recorded less simulated pixels, over the light in the middle of each micro-image.
    systematic : float
        What of the residual is equal for the lenses of a zone, an eighth of the field's side, root mean square.
    structure : float
        Root mean square of what neighbouring pixels of the residual share, which noise of single pixels is not.
    mean_image : float
        Root mean square of the mean over all lenses of recorded less simulated micro-images.
    outliers : float
        Part of the pixels that dust or defects keep from counting.
    difference : (n, n) array
        The mean over all lenses of recorded less simulated micro-images, in bins of half a pixel.
    place, brightness : (lenses, 2) and (lenses,) arrays
        Places of single micro-images in pixels, as they agree best with the model, and light in their middle.
    """

    residual: float
    systematic: float
    structure: float
    mean_image: float
    outliers: float
    difference: Array
    place: Array
    brightness: Array

    @property
    def scatter(self) -> float:
        """What of the residual differs from lens to lens, root mean square."""
        return float(np.sqrt(max(self.residual**2 - self.systematic**2, 0)))


def pixels_of_cells(camera: PlenopticCamera, position: Array, good: Array) -> Triple:
    """Return lens, column and row of each good pixel in the cells of lenses whose micro-images are at places (n, 2)."""
    lattice = camera.lattice.regular
    to_array = camera.pixel_size / camera.image_growth
    half = int(np.ceil(lattice.cell_reach / to_array)) + 1
    pixel = np.rint(position)[..., None] + np.arange(-half, half + 1)
    x, y = ((pixel - position[..., None]) * to_array + np.reshape(lattice.centre(0.0, 0.0), (2, 1))).swapaxes(0, 1)
    inside = (pixel >= 0) & (pixel < np.reshape(good.shape[::-1], (2, 1)))
    i, j = lattice.cell(x[:, None], y[..., None])
    lens, row, column = np.nonzero((i == 0) & (j == 0) & inside[:, :1] & inside[:, 1, :, None])
    column, row = (pixel[lens, axis, index].astype(int) for axis, index in enumerate((column, row)))
    usable = good[row, column]
    return lens[usable], column[usable], row[usable]


@dataclass(frozen=True)
class WhiteRecording:
    """A white picture, the camera with the regular array that it shows, and the model of its micro-images."""

    frame: WhiteFrame
    camera: PlenopticCamera
    model: MicroImageModel

    def pixels(self, position: Array) -> tuple[Array, Array, Array, Array]:
        """Return numbers of lenses' first pixels (lenses + 1,), and values and offsets x and y of good pixels (n,).

        Places are (lenses, 2).
        """
        lens, column, row = pixels_of_cells(self.camera, position, self.frame.good)
        x, y = (pixel - middle for pixel, middle in zip((column, row), position[lens].T, strict=True))
        return np.searchsorted(lens, np.arange(len(position) + 1)), self.frame.light[row, column], x, y

    def beside(self, position: Array, field: FieldNumbers) -> LensPixels:
        """Return the pixels of a zone's lenses at places (n, 2) beside the model."""
        first, value, x, y = self.pixels(position)
        lens = np.repeat(np.arange(len(position)), np.diff(first))
        at_lens = field.values(position)
        at_zone = field.values(position.mean(0)[None])[0]
        numbers = PupilNumbers(*at_zone)
        models = self.model.splines(x, y) @ np.column_stack([image.ravel() for image in self.model.expanded(numbers)])
        slopes = models[:, 1:]
        change = at_lens - at_zone
        image = models[:, 0] + (slopes * change[lens]).sum(1)
        # Where rims move by more than a tenth of a pixel within the zone, first order is not enough.
        for far in np.flatnonzero(np.abs(change[:, :5]) @ [1, numbers.radius, numbers.radius, 1, 1] > 0.1):
            pixels = slice(*first[far : far + 2])
            image[pixels] = self.model.at(self.model.samples(PupilNumbers(*at_lens[far])), x[pixels], y[pixels])
        weight = np.ones(len(value))
        for _ in range(2):
            power = np.maximum(np.bincount(lens, weight * image * image, len(position)), 1e-9)
            brightness = np.bincount(lens, weight * image * value, len(position)) / power
            residual = value / np.maximum(brightness, 1e-9)[lens] - image
            spread = max(1.4826 * float(np.median(np.abs(residual[weight > 0]))), 0.005)
            weight = (np.abs(residual) < 6.0 * spread).astype(np.float64)
        weighted = (weight * image)[:, None] * slopes
        explained = np.stack([some.sum(0) for some in np.split(weighted, first[1:-1])]) / power[:, None]
        slopes = slopes - explained[lens] * image[:, None]
        return LensPixels(first, x, y, weight, brightness, residual, slopes)

    def fit(self, position: Array, zones: list[Array], field: FieldNumbers, show: Progress) -> Array:
        """Fit the polynomials to the lenses of zones; return normal equations (lenses, n, n + 1) of each lens."""
        best = np.inf
        damping = 0.0
        equations = np.zeros(0)
        before = field.coefficients
        for repeat in range(_REPEATS):
            normals = []
            square = 0.0
            count = 0.0
            for zone, lenses in enumerate(zones):
                show(repeat * len(zones) + zone, _REPEATS * len(zones))
                pixels = self.beside(position[lenses], field)
                normals.append(pixels.equations(field.terms(position[lenses]), field.number))
                square += pixels.weight @ pixels.residual**2
                count += pixels.weight.sum()
            error = np.sqrt(square / count)
            settled = abs(best - error) < 1e-4 * best
            if error < best:
                equations = np.concatenate(normals)
                before = field.coefficients
                best = error
                damping = damping / 10
            else:
                damping = max(10 * damping, 1e-3)
            if settled:
                break
            change = field.split(solved(equations.sum(0), damping))
            field.coefficients = {name: before[name] + change[name] for name in NUMBERS}
            field.coefficients["blur"] = np.abs(field.coefficients["blur"])  # its sign says nothing
        field.coefficients = before
        show(1, 1)
        return equations

    def fit_shape(self, position: Array, zones: list[Array], field: FieldNumbers) -> None:
        """Fit the model's shape, which all lenses have alike, to the mean residual of zones' lenses.

        A third of these lenses chooses how many coefficients map and outline have: more must lower the residual by a
        twentieth.
        """
        pixels = [self.beside(position[lenses], field) for lenses in zones]
        bins = np.concatenate([self.bins(some) for some in pixels])
        residual = np.concatenate([some.residual for some in pixels])
        mean = np.bincount(bins, residual) / np.maximum(np.bincount(bins), 1)
        # Dust is on single lenses: it is off the others' residual.
        off = np.abs(residual - mean[bins])
        clean = off < 6.0 * max(1.4826 * float(np.median(off)), 0.005)
        choosing = np.concatenate(
            [np.repeat(np.arange(len(n)) % 3 == 0, n) for n in (np.diff(p.first) for p in pixels)]
        )
        groups = (clean & ~choosing, clean & choosing)
        weights, sums = (
            np.array([np.bincount(bins[group], values[group], self.side**2) for group in groups])
            for values in (np.ones(len(bins)), residual)
        )
        lit = np.flatnonzero(weights.min(0) > 0)
        weights = weights[:, lit]
        sums = sums[:, lit]
        row, column = np.divmod(lit, self.side)
        splines = self.model.splines((column - self.side // 2) / _BINS, (row - self.side // 2) / _BINS)
        numbers = PupilNumbers(*field.values(position[np.concatenate(zones)]).mean(0))
        images = self.model.expanded(numbers) + self.model.shape_slopes(numbers)
        design = np.stack([splines @ image.ravel() for image in images], axis=-1)
        best = np.inf
        for terms, waves in product((0, 3, 7, 12, 18, 25), range(0, 29, 2)):
            # With the brightness and the numbers of the field.
            some = design[:, np.r_[: 12 + terms, 37 : 37 + waves]]
            equations = [some.T @ np.column_stack([some * w[:, None], r]) for w, r in zip(weights, sums, strict=True)]
            # Damped: micro-images that overlap do not tell all.
            misfit = sums[1] / weights[1] - some @ solved(equations[0], 1e-3)
            error = float(np.sqrt((weights[1] * misfit**2).sum()))
            if error < 0.95 * best:
                best = error
                change = np.split(solved(equations[0] + equations[1], 1e-3), [12, 12 + terms])
        for name, step in zip(NUMBERS, change[0][1:], strict=True):
            field.coefficients[name][:1] += step
        coefficients: Named = dict(zip(SHAPE, change[1:], strict=True))
        self.model.shape = replace(self.model.shape, **coefficients)

    @property
    def side(self) -> int:
        """Bins along a side of mean micro-images."""
        return 2 * _BINS * int(np.ceil(self.model.reach)) + 1

    def bins(self, pixels: LensPixels) -> Array:
        """Return the bin in the mean micro-image of each pixel."""
        column, row = (np.rint(_BINS * offsets).astype(int) + self.side // 2 for offsets in (pixels.x, pixels.y))
        return row * self.side + column

    def judged(self, position: Array, zones: list[Array], field: FieldNumbers, show: Progress) -> Judgement:
        """Return how well zones' lenses at places (n, 2) agree with the model."""
        moved = np.full(position.shape, np.nan)
        brightness = np.full(len(position), np.nan)
        totals = np.zeros((2, self.side**2))
        sums = np.zeros(5)
        centres = [NUMBERS.index(name) for name in ("centre_x", "centre_y")]
        for zone, lenses in enumerate(zones):
            show(zone, len(zones))
            pixels = self.beside(position[lenses], field)
            normals = pixels.equations(np.ones((len(lenses), 2)), np.array(centres))
            shift = np.linalg.solve(normals[:, :, :2] + 1e-9 * np.eye(2), normals[:, :, 2:])[..., 0]
            moved[lenses] = position[lenses] + field.values(position[lenses])[:, centres] + shift
            brightness[lenses] = pixels.brightness
            counts = pixels.weight > 0
            bins = self.bins(pixels)[counts]
            residual = pixels.residual[counts]
            count, total, square = (np.bincount(bins, residual**power, self.side**2) for power in (0.0, 1.0, 2.0))
            pairs = counts[1:] & counts[:-1] & (np.abs(np.diff(pixels.x) - 1) < 1e-6) & (np.diff(pixels.y) == 0)
            shared = (pixels.residual[1:] * pixels.residual[:-1])[pairs].sum()
            totals += count, total
            # The mean's square less its expectation for residuals that are independent.
            repeated = count > 1
            mean = total[repeated] / count[repeated]
            variance = (square[repeated] - count[repeated] * mean**2).clip(0) / (count[repeated] - 1)
            common = (count[repeated] * mean**2 - variance).sum()
            sums += square.sum(), common, (~counts).sum(), shared, pairs.sum()
        show(1, 1)
        squares, common, dust, shared, pair_count = sums.tolist()
        pixel_count = totals[0].sum()
        mean = totals[1] / np.maximum(totals[0], 1)
        return Judgement(
            residual=float(np.sqrt(squares / pixel_count)),
            systematic=float(np.sqrt(max(common / pixel_count, 0))),
            structure=float(np.sqrt(max(shared / max(pair_count, 1), 0))),
            mean_image=float(np.sqrt((totals[0] * mean**2).sum() / pixel_count)),
            outliers=dust / (pixel_count + dust),
            difference=mean.reshape(self.side, self.side),
            place=moved,
            brightness=brightness,
        )
