r"""The wavelengths of a capture, and the response of each detector channel to them.

A channel records :math:`\int S(\lambda) L(\lambda) \, psf(\lambda) \, d\lambda`. The integral is a sum over
Gauss-Legendre nodes, of which n integrate polynomials up to the degree 2 n - 1 exactly (Abramowitz and Stegun,
"Handbook of Mathematical Functions", 25.4.29). Sums over many points change slowly with the wavelength, even where
light and responses change quickly. Point spreads may then be computed at a few nodes, and interpolated at all other
wavelengths by the polynomial through the nodes (Berrut and Trefethen 2004, "Barycentric Lagrange interpolation").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ..errors import InputError, put, refuse_if, require_count, require_number, require_wavelength, suggest_keywords
from ..runtime import Doubles, Floats, as_array, read_table

MOST_WAVELENGTHS = 1024
"""Largest number of wavelengths of a spectrum."""

RGB_WAVELENGTHS = (611.4, 549.1, 464.3)
"""Dominant wavelengths of the sRGB primaries (IEC 61966-2-1) in nanometres, for variants of three channels."""

WAVELENGTHS = 31
"""Default number of wavelengths for smooth responses: about one every 10 nm of the visible range."""


Table = tuple[Doubles, Doubles]
"""Wavelengths in nanometres and values of a spectrum, linear between them and 0 outside."""


@suggest_keywords
@dataclass(frozen=True)
class Spectrum:
    """Wavelengths in nanometres, with the response of each detector channel to them.

    Parameters
    ----------
    wavelengths : tuple of float
        Wavelengths in nanometres.
    responses : tuple of tuples of float
        The response of each channel to each wavelength.
    nodes : tuple of float
        Wavelengths at which point spreads are computed; at all others they are interpolated, see `interpolated`.
        Default: point spreads are computed at each wavelength.
    """

    wavelengths: tuple[float, ...]
    responses: tuple[tuple[float, ...], ...]
    nodes: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        refuse_if(not self.wavelengths, "spectrum: it must have a wavelength")
        put(self, wavelengths=tuple(require_wavelength(value) for value in self.wavelengths))
        rule = "they must be numbers, as many for every channel"
        shape = None, len(self.wavelengths)
        as_array("spectrum: responses", self.responses, ("channel", "wavelength"), rule=rule, shape=shape)
        put(self, nodes=tuple(require_wavelength(value, "spectrum: node") for value in self.nodes))
        refuse_if(len(set(self.nodes)) < len(self.nodes), f"spectrum: nodes = {self.nodes}: they must be different")

    @classmethod
    def lines(cls, *wavelengths: float) -> Spectrum:
        """Return a spectrum of single wavelengths, with one channel for each.

        Parameters
        ----------
        *wavelengths : float
            Wavelengths in nanometres.
        """
        return cls(tuple(wavelengths), tuple(map(tuple, np.eye(len(wavelengths)).tolist())))

    @classmethod
    def band(cls, centre: float, width: float, count: int) -> Spectrum:
        """Return the spectrum of a flat band of one channel, whose responses sum to 1.

        Parameters
        ----------
        centre, width : float
            Middle and full width in nanometres.
        count : int
            Number of Gauss-Legendre nodes; `points.spectral.with_enough_nodes` finds a sufficient number.
        """
        return cls.bands((centre,), width, count)

    @classmethod
    def bands(cls, centres: Sequence[float], width: float, count: int) -> Spectrum:
        """Return the spectrum of flat bands of equal width, with one channel for each, as `band` does.

        Parameters
        ----------
        centres : sequence of float
            Centres in nanometres.
        width : float
            Full width in nanometres.
        count : int
            Number of wavelengths of each band.
        """
        half = require_number("spectrum: width", width, positive=True) / 2
        count = require_count("spectrum: count", count, maximum=MOST_WAVELENGTHS)
        nodes, weights = np.polynomial.legendre.leggauss(count)
        wavelengths = [float(centre + half * node) for centre in centres for node in nodes]
        responses = np.kron(np.eye(len(centres)), weights / 2)
        return cls(tuple(wavelengths), tuple(map(tuple, responses.tolist())))

    @classmethod
    def smooth(
        cls,
        responses: Callable[[Doubles], Doubles],
        low: float,
        high: float,
        count: int = WAVELENGTHS,
        tables: Sequence[Table] = (),
    ) -> Spectrum:
        """Return a spectrum of responses that are functions of the wavelength, with weights of a quadrature.

        Parameters
        ----------
        responses : callable
            From wavelengths (n,) in nanometres to responses (channels, n) per nanometre.
        low, high : float
            Shortest and longest wavelength, in nanometres.
        count : int
            Number of Gauss-Legendre nodes; it is increased if tables require it.
        tables : sequence of pairs of arrays
            Wavelengths and values of spectra, such as light and reflectances, whose products with the responses must be
            integrated accurately, too; they are linear between the wavelengths and 0 outside.

        Raises
        ------
        InputError
            If more than 1024 wavelengths would be needed.
        """
        count = require_count("spectrum: count", count, maximum=MOST_WAVELENGTHS)
        wavelengths, weights = _nodes(responses, low, high, count, tables)
        values = np.asarray(responses(wavelengths)) * weights
        return cls(tuple(wavelengths.tolist()), tuple(map(tuple, values.tolist())))

    @classmethod
    def sensor(cls, path: str | Path | Doubles, count: int = WAVELENGTHS, tables: Sequence[Table] = ()) -> Spectrum:
        """Return a spectrum from a table of a detector's responses, interpolated linearly between rows.

        Each channel is divided by its integral, so that light of radiance 1 at every wavelength reads 1 in each.

        Parameters
        ----------
        path : path, or array (rows, 1 + channels)
            A CSV file whose rows are a wavelength in nanometres and the response of every channel, by rising
            wavelength, after an optional line of names; or the array that `read_responses` returns for such a file.
        count : int
            Number of wavelengths; it is increased if the table or `tables` require it.
        tables : sequence of pairs of arrays
            As for `smooth`.
        """
        table = path if isinstance(path, np.ndarray) else read_responses(path)
        wavelengths = table[:, 0]
        columns = table[:, 1:].T
        spectrum = cls.smooth(
            partial(interpolated, wavelengths, columns),
            float(wavelengths[0]),
            float(wavelengths[-1]),
            count,
            [(wavelengths, np.ones(len(wavelengths))), *tables],
        )
        return spectrum.balanced("responses" if isinstance(path, np.ndarray) else str(path))

    def balanced(self, where: str = "spectrum") -> Spectrum:
        """Return the spectrum with the responses of every channel divided by their sum.

        Parameters
        ----------
        where : str
            Name of the spectrum in error messages.
        """
        sums = np.array(self.responses).sum(axis=1)
        if not np.all(sums > 0):
            channel = int(np.argmax(~(sums > 0)))
            raise InputError(
                f"{where}: channel {channel + 1}: its responses sum to {sums[channel]:g}: it must be above 0"
            )
        return replace(self, responses=tuple(map(tuple, (np.array(self.responses) / sums[:, None]).tolist())))

    def interpolated(self, count: int) -> Spectrum:
        """Return the spectrum with point spreads computed at a few wavelengths, the Gauss nodes for the responses.

        The nodes are dense where the sum of the responses is large. Sums over the wavelengths are exact for polynomials
        up to about twice as many degrees as nodes (Golub and Welsch 1969, "Calculation of Gauss quadrature rules").

        Parameters
        ----------
        count : int
            Number of nodes. If at most this many wavelengths have a response, each of these becomes a node.
        """
        count = require_count("spectrum: nodes", count, maximum=MOST_WAVELENGTHS)
        weights = np.abs(np.array(self.responses))
        sums = weights.sum(axis=1, keepdims=True)
        lit = np.divide(weights, sums, out=np.zeros_like(weights), where=sums > 0).sum(0)
        bright = {wavelength for wavelength, weight in zip(self.wavelengths, lit, strict=True) if weight > 0}
        if count >= len(bright):
            return replace(self, nodes=() if len(bright) in (0, len(set(self.wavelengths))) else tuple(sorted(bright)))
        # The nodes of the Gauss rule for weights at given positions: zeros of the orthogonal polynomial. The zeros are
        # the eigenvalues of the matrix of the polynomials' recurrence, which Lanczos's iteration computes, with
        # repeated orthogonalisation for stability.
        wavelengths = np.array(self.wavelengths)
        middle = (wavelengths.max() + wavelengths.min()) / 2
        half = np.ptp(wavelengths) / 2
        x = (wavelengths - middle) / half
        basis_rows = [np.sqrt(lit / lit.sum())]
        for _ in range(count - 1):
            new = x * basis_rows[-1]
            for _again in range(2):
                for old in basis_rows:
                    new = new - (old @ new) * old
            basis_rows.append(new / np.linalg.norm(new))
        basis = np.array(basis_rows)
        return replace(self, nodes=tuple((middle + half * np.linalg.eigvalsh((basis * x) @ basis.T)).tolist()))

    @property
    def computed(self) -> tuple[float, ...]:
        """Wavelengths at which diffraction is computed: the nodes, or all wavelengths if there are none."""
        return self.nodes or tuple(sorted(set(self.wavelengths)))

    def shares(self, wavelengths: Doubles | None = None) -> Doubles:
        """Return the values (nodes, wavelengths) of each node's Lagrange polynomial, by default at all wavelengths.

        Parameters
        ----------
        wavelengths : array (n,), optional
            Other wavelengths in nanometres.
        """
        nodes = np.array(self.computed)
        at = np.array(self.wavelengths) if wavelengths is None else wavelengths
        factors = np.ones((len(nodes), len(at)))
        for index, node in enumerate(nodes):
            for neighbour in np.delete(nodes, index):
                factors[index] *= (at - neighbour) / (node - neighbour)
        return factors

    def centroids(self) -> tuple[float, ...]:
        """Return the mean wavelength of each channel, weighted by the magnitude of its responses."""
        weights = np.abs(np.array(self.responses))
        total = weights.sum(axis=1)
        means = weights @ np.array(self.wavelengths) / np.where(total > 0, total, 1)
        return tuple(np.round(np.where(total > 0, means, np.mean(self.wavelengths)), 9).tolist())

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.responses)

    def matrix(self) -> Floats:
        """Return the responses as an array (channels, wavelengths)."""
        return np.array(self.responses, np.float32)


def read_responses(path: str | Path) -> Doubles:
    """Read a detector's table; each row holds a wavelength in nanometres and the response of every channel."""
    table = read_table(path)
    refuse_if(
        table.shape[1] < 2 or len(table) < 2 or np.any(np.diff(table[:, 0]) <= 0),
        f"{path}: it must have two rows or more, of a wavelength and responses, by rising wavelength",
    )
    for wavelength in table[[0, -1], 0].tolist():
        require_wavelength(wavelength, f"{path}: wavelength")
    return table


def _nodes(
    responses: Callable[[Doubles], Doubles], low: float, high: float, count: int, tables: Sequence[Table]
) -> tuple[Doubles, Doubles]:
    """Return nodes and weights of a quadrature over wavelengths that is fine enough to integrate tables accurately.

    A Gauss-Legendre rule is subdivided, each time where the product of a response and a table with the largest error
    has its sharpest bend, until all products are accurate. The reference is a sum of three nodes in each interval
    between the rows of all tables and a grid of half a nanometre.
    """

    def products(at: Doubles) -> Doubles:
        spectra = np.stack([np.interp(at, *table, left=0, right=0) for table in tables])
        return (np.asarray(responses(at)) * spectra[:, None]).reshape(-1, len(at))

    def rule(first: float, last: float) -> tuple[Doubles, Doubles]:
        share = (last - first) / (high - low)
        nodes, weights = np.polynomial.legendre.leggauss(max(2, math.ceil(count * share)) if share < 1 else count)
        return (first + last) / 2 + (last - first) / 2 * nodes, weights * (last - first) / 2

    if not tables:
        return rule(low, high)
    # Step in nanometres of the wavelengths, besides the tables' own, at which quadratures of tables are checked.
    rows = np.concatenate([np.linspace(low, high, math.ceil((high - low) / 0.5) + 1), *(x for x, _ in tables)])
    edges = np.unique(rows[(rows >= low) & (rows <= high)])
    nodes, weights = np.polynomial.legendre.leggauss(3)
    half = np.diff(edges)[:, None] / 2
    fine = products((edges[:-1, None] + half + half * nodes).ravel()).reshape(-1, len(half), 3) @ weights * half[:, 0]
    upto = np.hstack([np.zeros((len(fine), 1)), np.cumsum(fine, axis=1)])
    # The error of each table's products is relative to its largest product with any channel.
    largest = np.abs(fine).sum(axis=1).reshape(len(tables), -1).max(axis=1, keepdims=True)
    largest = np.broadcast_to(largest, (len(tables), len(fine) // len(tables))).ravel()
    turns = np.abs(np.diff(np.diff(products(edges), axis=1) / np.diff(edges), axis=1))

    def errors(first: int, last: int) -> Doubles:
        nodes, weights = rule(edges[first], edges[last])
        wrong = np.abs(products(nodes) @ weights - upto[:, last] + upto[:, first])
        return np.divide(wrong, largest, out=np.zeros_like(wrong), where=largest > 0)

    parts = {(0, len(edges) - 1): errors(0, len(edges) - 1)}
    # 4e-3: Largest allowed relative error of a channel's integral over a table.
    while (total := np.sum(list(parts.values()), axis=0)).max() > 4e-3:
        worst = int(np.argmax(total))
        divisible = [interval for interval in parts if interval[1] - interval[0] > 1]
        if not divisible or len(parts) > MOST_WAVELENGTHS // 2:
            break
        first, last = max(divisible, key=lambda interval: parts[interval][worst])
        between = first + 1 + int(np.argmax(turns[worst, first : last - 1]))
        del parts[first, last]
        parts |= {interval: errors(*interval) for interval in ((first, between), (between, last))}
    rules = [rule(edges[first], edges[last]) for first, last in sorted(parts)]
    wavelengths, quadrature = (np.concatenate(columns) for columns in zip(*rules, strict=True))
    refuse_if(
        len(wavelengths) > MOST_WAVELENGTHS,
        f"spectrum: the spectra of the scene and the responses need more than {MOST_WAVELENGTHS} wavelengths: "
        "sample them more coarsely",
    )
    return wavelengths, quadrature


def interpolated(wavelengths: Doubles, columns: Iterable[Doubles], at: Doubles) -> Doubles:
    """Return the columns of a table, interpolated linearly at given wavelengths."""
    return np.stack([np.interp(at, wavelengths, column) for column in columns])
