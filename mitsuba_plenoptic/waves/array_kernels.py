r"""Diffraction by the microlens array: the kernels of a capture's images, and the functions over a lens.

Let T be the transmission of the array, relative to the lens that a ray meets. Behind the array, a ray that meets it at
m lands on the detector at an offset p from the ray model's position with the signed density

.. math:: K_a(m, p) = \frac{1}{(\lambda z)^2}
          \int T(m + \xi/2)\, T^*(m - \xi/2)\, e^{-2 \pi i \xi \cdot p / \lambda z}\, d^2\xi.

Pairs of points in two neighbouring lenses are included; they describe the interference of the neighbours' fields. With
functions :math:`a_n` of m chosen for the camera (`lens_functions`), :math:`K_a(m, p) \approx \sum_n a_n(m)
\varphi_n(p)`. Coordinates of microlens points are relative to the centre of the lens.

Fields behind the lenses are those of `array_field`.
"""

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from ..fields import Kind
from ..optics import in_millimetres
from ..runtime import Doubles, Floats, Integers, Pair, Shape, exponents, fft, on_all_cores, single_threaded_blas
from .accuracy import USUAL
from .array_field import LensWaves
from .lens_functions import LensFunctions, of_middles
from .oblique import Oblique, changes, directions, terms


@single_threaded_blas()
def lens_functions(waves: LensWaves, degree: int, tolerance: float, lands_by_point: bool) -> LensFunctions:
    """Return the functions of a ray's point on a lens: at most as many as polynomials of a degree.

    A part `tolerance` of images of random light may be missing. Where rays land by their points, they are polynomials.
    """
    u, v, inside = waves.aperture_grid(USUAL.spectrum_samples if lands_by_point else USUAL.function_samples)
    higher = 0 if lands_by_point or degree == 0 else USUAL.higher_degrees
    scale = float(waves.lattice.aperture_reach)
    polynomials = LensFunctions.polynomials(u[inside], v[inside], degree + higher, scale)
    if not higher:
        return polynomials
    u, v, inside = waves.aperture_grid(waves.samples_of(USUAL.coarse_points))
    # Two directions stand for all rays, with their mean square along each axis; opposite ones have mirror images.
    along, across = np.sqrt(2 * np.mean(np.square(waves.cosines()), axis=0)).tolist()
    images = _images(waves, polynomials, polynomials.functions, np.diag([along, across]))
    allowed = USUAL.missing_functions * tolerance
    return polynomials.best(len(exponents(degree)), allowed, (u[inside], v[inside]), np.concatenate([*images], 1))


@single_threaded_blas()
def oblique_kernels(waves: LensWaves, functions: LensFunctions, degree: int, tolerance: float) -> Oblique:
    """Return combinations of the changes of kernels with the direction of light; see `lens_functions`."""
    cosines = waves.cosines()
    largest = float(np.hypot(*cosines.T).max())
    # Kernels of steep light change with its direction as polynomials of degree 4.
    edge = max(waves.lattice.aperture_reach / kind.distance for kind in waves.kinds)
    is_steep = bool(largest + edge > USUAL.steep)
    images = _images(waves, functions, functions.duals, directions(4 if is_steep else 2) * largest)
    # Small apertures fall between the points of a grid that is as fine for all.
    u, v, inside = waves.aperture_grid(waves.samples_of(USUAL.coarse_points // 2))
    light = functions.light(u[inside], v[inside])
    allowed = USUAL.missing_oblique[is_steep] * tolerance
    most = USUAL.most_oblique * len(exponents(degree))
    return Oblique.best(largest, cosines / largest, images, light, functions.odd, allowed, most)


@single_threaded_blas()
def covariance_of_values(waves: LensWaves, functions: LensFunctions, oblique: Oblique) -> Doubles:
    """Return the covariance of the values of an image's rays, for light with random edges from all directions."""
    u, v, inside = waves.aperture_grid(waves.samples_of(USUAL.coarse_points // 2))
    light = functions.light(u[inside], v[inside])
    across, up = waves.cosines().T / oblique.largest
    expected = np.transpose(terms(across, up, oblique.degree))
    factors = np.einsum("rnk,sk->srn", oblique.factors, expected)
    both = np.concatenate([np.broadcast_to(np.eye(functions.count), (len(expected), *light.shape)), factors], axis=1)
    return np.einsum("sin,nm,sjm->ij", both, light, both, optimize=True) / len(expected)


def _images(waves: LensWaves, polynomials: LensFunctions, coefficients: Doubles, cosines: Doubles) -> Doubles:
    """Return the spectra (directions, n, values) of kernels, as pixels record them, for combinations of polynomials."""
    spectra = []
    turned = waves.camera.microlens.is_parabolic and len(waves.types) == 1
    signs = (-1.0) ** np.sum(polynomials.odd, axis=1)[:, None, None]
    for kind in waves.types:
        scale = in_millimetres(waves.wavelength) * kind.distance
        fine = waves.lattice.pitches[0] / USUAL.pitch_lags
        farthest = min(2 * USUAL.pitch_lags, int(scale / (2 * waves.camera.pixel_size * fine)))
        count = USUAL.coarse_lags
        step = fine * max(1, farthest // count)
        if count * step <= waves.lattice.aperture_width:
            # Half as many are close enough for the aperture, and for the period of kernels.
            count //= 2
            step *= 1 + (farthest > count)
        weights = np.sinc(np.arange(-count, count + 1) * (step * waves.camera.pixel_size / scale))
        transfers: list = []
        for direction in cosines:
            # Behind lenses that are the same turned by half, opposite directions have conjugate integrals, but for the
            # signs of odd functions.
            before = zip(transfers, cosines if turned else [], strict=False)
            if opposite := [transfer for transfer, earlier in before if np.allclose(earlier, -direction)]:
                transfers.append(opposite[0].conj() * signs)
            else:
                options = polynomials, coefficients, direction
                transfers.append(_transfer(waves, count, step, waves.samples_of(USUAL.coarse_points), kind, *options))
        of_kind = np.stack(transfers) * (weights[:, None] * weights)
        spectra += [values.reshape(*of_kind.shape[:2], -1) for values in (of_kind.real, of_kind.imag)]
    return np.concatenate(spectra, axis=2)


@single_threaded_blas()
def sampled_kernels(
    waves: LensWaves, functions: LensFunctions, oblique: Oblique, step: float, samples: tuple[int, int, int], kind: Kind
) -> Doubles:
    """Return kernels (n, k, k) on a grid of width `step`, times the area of a grid cell, with a given sampling.

    First come the functions' kernels, then the oblique ones. Light beyond them is folded back, which conserves energy.
    """
    stride, farthest, count = samples
    lag = waves.lattice.pitches[0] / USUAL.pitch_lags * stride
    transfer = _transfer(waves, farthest, lag, 2 * USUAL.pitch_lags, kind, functions, functions.duals)
    kernels = _placed(waves, transfer, stride, step, count, kind)
    if oblique.count:
        parts = np.einsum("rnk,kd->drn", oblique.kernels, changes(oblique.degree))
        # Coarse pixels resolve few lags.
        coarser = USUAL.oblique_coarser if oblique.degree == 2 and farthest >= USUAL.coarse_lags else 1
        fewer = farthest // coarser, lag * coarser, waves.samples_of(USUAL.coarse_samples)
        transfer = np.sum(
            [
                _transfer(waves, *fewer, kind, functions, functions.duals @ combination.T, (a, b))
                for combination, (a, b) in zip(parts, directions(oblique.degree) * oblique.largest, strict=True)
            ],
            axis=0,
        )
        # Their period is shorter, but not the border of their windows.
        small_count = min(count, count // coarser + USUAL.border // 2)
        small = _placed(waves, transfer, stride * coarser, step, small_count, kind)
        aside = (kernels.shape[1] - small.shape[1]) // 2
        kernels = np.concatenate([kernels, np.pad(small, [(0, 0), (aside, aside), (aside, aside)])])
    # Coarse grids sample so few lags that light would be lost or gained.
    missing = np.eye(len(kernels))[0] - kernels.sum((1, 2))
    return kernels + missing[:, None, None] * (kernels[0] / kernels[0].sum())


def _placed(
    waves: LensWaves, transfer: NDArray[np.complex64], stride: int, step: float, count: int, kind: Kind
) -> Doubles:
    """Return kernels of `count` samples on either side, from transfer functions `stride` steps apart."""
    scale = in_millimetres(waves.wavelength) * kind.distance
    apart = waves.lattice.pitches[0] / USUAL.pitch_lags * stride
    farthest = transfer.shape[1] // 2
    position = np.arange(-count, count + 1) * step
    lags = np.arange(-farthest, farthest + 1) * apart
    # All repetitions of the window add up to 1, so that a kernel has the transfer function at each lag.
    period = scale / apart
    beyond = (np.abs(position) - period / 2) / min(USUAL.border * step, period)
    window = (1 - np.sin(np.pi * np.clip(beyond, -0.5, 0.5))) / 2
    phases = window[:, None] * np.exp(-2j * np.pi * np.outer(position, lags) / scale) * (apart * step / scale)
    return np.einsum("yb,nba,xa->nyx", phases, transfer, phases, optimize=True).real


def cell_kernels(waves: LensWaves, functions: LensFunctions, step: float, reach: float, kind: Kind) -> Doubles:
    """Return kernels between cells of uniform light, for cells that may be larger than the diffraction kernels.

    Neighbours and phases are left out: see `of_middles`.
    """
    lattice = waves.lattice
    scale = in_millimetres(waves.wavelength) * kind.distance
    parts = waves.cell_parts(step, kind)
    count = math.ceil(reach / step)
    fine = step / parts
    far = (count + 1) * parts - 1
    x, y, _ = waves.aperture_grid(USUAL.spectrum_samples)
    along = x[0]
    spacing = x[0, 1] - x[0, 0]
    inside = lattice.in_aperture(x, y)
    u, v = (coordinate / functions.scale for coordinate in lattice.to_frame(x, y))
    # The transforms of samples repeat; behind large lenses they do so within the kernels' reach.
    within = min(far, int(scale / (2 * spacing * fine)))
    phases = np.exp(-2j * np.pi * np.outer(np.arange(-within, within + 1) * fine, along) / scale)
    fields = {(a, b): phases @ np.where(inside, u**a * v**b, 0) @ phases.T for a, b in functions.exponents}
    products = of_middles(functions.exponents, fields)
    kernels = np.einsum("mn,myx->nyx", functions.combined, products) * (spacing * fine / scale) ** 2 / inside.sum()
    kernels = np.pad(kernels, [(0, 0), *[(far - within,) * 2] * 2])
    tent = np.convolve(np.ones(parts), np.ones(parts)) / parts
    for axis in (1, 2):
        kernels = np.apply_along_axis(np.convolve, axis, kernels, tent, "valid")
    return kernels[:, ::parts, ::parts]


def _transfer(
    waves: LensWaves,
    farthest: int,
    lag: float,
    samples: int,
    kind: Kind,
    polynomials: LensFunctions,
    coefficients: Doubles,
    cosines: Pair = (0.0, 0.0),
) -> NDArray[np.complex64]:
    """Return the integrals over a cell of combinations of polynomials, times T T*, at lags along y and x.

    Along either axis there are `farthest` lags on either side, multiples of `lag` in mm, and at least a number of
    samples across the pitch. `coefficients` (polynomials, n) define the combinations. Light has given direction
    cosines.
    """
    lattice = waves.lattice
    # A lag of whole strides moves both points of a pair to points of the grid.
    stride = math.ceil(lag / 2 * samples / lattice.pitches[0] - 1e-6)
    step = lag / 2 / stride
    # Samples count in part up to one beyond the cell, which with them is wider by two samples.
    reach = math.ceil(lattice.cell_reach * (1 / step + 2 / lattice.pitches[0])) + farthest * stride
    along = (np.arange(-reach, reach) + 0.5) * step
    y, x = np.meshgrid(along, along, indexing="ij")
    (x, y), T, share = waves.transmission((x, y), kind, cosines)
    open_ = share > 0
    rows, columns = (np.flatnonzero(open_.any(axis)) for axis in (1, 0))
    top = rows[0]
    bottom = rows[-1] + 1
    left = columns[0]
    width = columns[-1] + 1 - columns[0]
    both = np.hstack([polynomials.functions, polynomials.duals])
    u, v = (coordinate[open_] for coordinate in lattice.to_frame(x, y))
    functions, duals = np.split(polynomials.values(u, v, both), 2)
    # On these samples, too, the integrals of the duals with the functions over the lens are exact.
    measure = share[open_] * np.square(np.abs(T[open_]))
    products = functions @ (measure * duals).T / measure.sum()
    exact = np.linalg.solve(products, polynomials.functions.T @ coefficients)
    weight = np.zeros((coefficients.shape[1], *open_.shape), np.float32)
    weight[:, open_] = share[open_] * (exact.T @ duals)
    weight = weight[:, top:bottom, left : left + width]
    across, up, around = (_symmetry(T, weight, axes) for axes in (2, 1, (1, 2)))
    real = imaginary = np.ones(coefficients.shape[1], bool)
    if around is not None:
        # Opposite points give conjugate products: half of the lens gives the real or the imaginary part.
        real = np.ravel(around > 0)
        imaginary = ~real
        bottom = (top + bottom) // 2
        weight = 2 * weight[:, : bottom - top]
    weight = weight.reshape(len(weight), -1).T
    weights = weight[:, real], weight[:, imaginary]
    count = 2 * farthest + 1
    most = farthest * stride
    # One symmetry gives the lags on one side from those on the other.
    first = 0 if across is None and up is None else farthest
    result = np.zeros((coefficients.shape[1], count, count), np.complex64)
    # Views (column, row, place) of the real and the imaginary part of T, from each column on.
    lines = [
        np.lib.stride_tricks.sliding_window_view(T_part.copy(), width, axis=1).transpose(1, 0, 2)
        for T_part in (T.real, T.imag)
    ]
    lines = [line[left - most : left + most + 1 : stride] for line in lines]
    # 2**17: Products of pairs that are computed at a time, so that these fit into a cache.
    few = max(1, 2**17 // ((bottom - top) * width))

    def integrate(lags: Integers) -> None:
        for lag, start in itertools.product(lags.tolist(), range(first, count, few)):
            columns = slice(start, min(start + few, count))
            b = lag * stride
            shape = columns.stop - start, -1
            after = [line[columns, top + b : bottom + b] for line in lines]
            before = [line[::-1][columns, top - b : bottom - b] for line in lines]
            if real.any():
                product = (after[0] * before[0] + after[1] * before[1]).reshape(shape)
                result.real[real, farthest + lag, columns] = (product @ weights[0]).T
            if imaginary.any():
                product = (after[1] * before[0] - after[0] * before[1]).reshape(shape)
                result.imag[imaginary, farthest + lag, columns] = (product @ weights[1]).T

    on_all_cores(integrate, np.array_split(np.arange(farthest + 1), fft.worker_count()))
    other_side = result[:, farthest:, :farthest:-1]
    if across is not None:
        result[:, farthest:, :farthest] = other_side * across
    elif up is not None:
        result[:, farthest:, :farthest] = other_side.conj() * up
    # The weights are real.
    result[:, :farthest] = result[:, :farthest:-1, ::-1].conj()
    # The normalisation uses the sampled open area, which conserves the energy.
    return result / np.float32(measure.sum())


def _symmetry(T: NDArray, weight: Floats, axis: int | Shape) -> Floats | None:
    """Return 1 for weights that are even, and -1 for odd ones, along axes along which T is even; otherwise None.

    Shapes: the result (n, 1, 1), `weight` (n, rows, columns).
    """
    if not np.abs(T - np.flip(T[None], axis)[0]).max() <= USUAL.mirrored:
        return None
    mirror = np.flip(weight, axis)
    signs = np.where(np.einsum("nij,nij->n", mirror, weight) < 0, np.float32(-1), np.float32(1))[:, None, None]
    error = np.abs(weight - signs * mirror).max((1, 2))
    return signs if (error <= USUAL.mirrored * np.abs(weight).max((1, 2))).all() else None


def displaced(kernels: Doubles) -> list[Doubles]:
    """Return the changes of kernels per cell of displacement, along x, then along y."""
    from scipy.ndimage import convolve1d

    # Kernels end abruptly, and their slopes include these ends: a short filter confines them to their surroundings.
    reach = USUAL.derivative_samples
    steps = np.arange(-reach, reach + 1)
    ideal = np.divide((-1.0) ** steps, steps, out=np.zeros(len(steps)), where=steps != 0)
    wide = np.pad(kernels, [(0, 0), (reach, reach), (reach, reach)])
    window = np.kaiser(len(steps), USUAL.derivative_shape)
    return [convolve1d(wide, -ideal * window, axis, mode="constant") for axis in (2, 1)]
