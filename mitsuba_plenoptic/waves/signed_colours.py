r"""The wavelengths at which signed-ray captures compute diffraction, and the weights of rays at each wavelength.

Coefficients and kernels are computed at a few wavelengths, the nodes. Light of a wavelength between two nodes is
divided between them by linear interpolation; light beyond the outermost nodes goes to the nearest node. Each channel
thus has an image at each node to which it responds, and records the sum of the images' convolutions.

In spectral variants each ray has its own wavelengths, drawn from the channels' responses. The two rays that correct
each other have the same wavelengths, so that light which is uniform over a lens has only the noise of the wavelengths.
From cell to cell the wavelengths follow a sequence that fills the band evenly in any neighbourhood.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..fields.optical_system import OpticalSystem
from ..optics.spectrum import Responses, Spectrum
from ..optics.waves import in_millimetres
from ..rays.random_numbers import even_words
from ..runtime import drjit_array
from .expansion import ExpandedPlan, nearby
from .phase_space import FINE, PhaseSpace
from .scheme import plan_of, plan_type

_PROBED, _LEAST_ERROR = 3.0, 1e-3
"""Ratio of the allowed error of a lens's spot to that of the capture, in which spots overlap; smallest error used."""

_BLUR = 10.0
"""Largest blur from one node to the next, in lenses, over the square root of the capture's error: the error of linear
interpolation grows with the square of the step."""

_TAIL = 0.01
"""Fraction of the responses beyond the outermost node, on either side."""

_MOST_NODES = 32
"""Largest count of nodes of a band, unless `nodes` is given."""

_DENSE = 33
"""Wavelengths at which spots are compared, with linear interpolation between them."""

_SPOTS = (4.0, 4)
"""Half the width of the compared spots in diffraction widths, and samples per diffraction width."""

_COARSE = 4.0
"""Width of pixels over that of spots from which channels may share a node; others are not examined for it."""

_STRATA, _STEPS = 4096, 2**14
"""Strata of equal probability from which wavelengths are drawn, and integration steps by which they are found."""


class Lanes(NamedTuple):
    """Wavelengths in nanometres drawn for cells."""

    wavelengths: list[Any]
    # Index of the stratum in which each lies, and its position there from 0 to 1.
    stratum: list[Any]
    part: list[Any]
    # Reciprocal of the product of their count and the density.
    weight: list[Any]


class DrawnWavelengths:
    """Random wavelengths with the density of the channels' responses, which are stratified."""

    def __init__(self, responses: Responses) -> None:
        steps = np.linspace(responses.low, responses.high, _STEPS + 1)
        density = np.abs(responses.at(steps))
        density = (density / density.sum(1, keepdims=True)).sum(0)
        upto = np.concatenate([[0], np.cumsum(density[1:] + density[:-1])])
        self.edges: NDArray[np.float64] = np.interp(np.linspace(0, 1, _STRATA + 1), upto / upto[-1], steps)
        self._edges = drjit_array(mi.Float, self.edges)

    def draw(self, chance: Any, span: tuple[float, float]) -> Lanes:
        """Draw the wavelengths of the active variant's rays, from a range of the strata, by random numbers."""
        count = dr.size_v(mi.UnpolarizedSpectrum)
        low, high = (dr.opaque(mi.Float, end * _STRATA) for end in span)
        lanes = Lanes([], [], [], [])
        for lane in range(count):
            place = low + (high - low) * (chance + lane) * (1 / count)
            index = dr.minimum(mi.UInt32(place), _STRATA - 1)
            first, last = (dr.gather(mi.Float, self._edges, index + end) for end in (0, 1))
            part = place - mi.Float(index)
            lanes.wavelengths.append(first + part * (last - first))
            lanes.stratum.append(index)
            lanes.part.append(part)
            lanes.weight.append((last - first) * (high - low) * (1 / count))
        return lanes


def chances(columns: Any, index: Any, number: int, seed: int) -> Any:
    """Return random numbers for cells of a grid, evenly spread over neighbouring cells and over passes."""
    row = index // columns
    along, down = (dr.opaque(mi.UInt32, step) for step in even_words(2))
    offset = dr.opaque(mi.UInt32, (number * even_words(1)[0] + seed) % 2**32)
    return mi.Float(((index - row * columns) * along + row * down + offset) >> 8) * 2.0**-24


@dataclass(frozen=True)
class Node:
    """A wavelength at which diffraction is computed, and the light that uses it."""

    # Coefficients and kernels of the camera at this wavelength.
    plan: Any
    # Channels of the capture that have an image at this node.
    channels: tuple[int, ...]
    # Weights of the values of a ray's light in the image of each of these channels, an array (channels, values). For
    # drawn wavelengths, the values are those at the edges of the strata.
    weights: NDArray[np.float64]

    def mixture(self, lanes: Lanes | None = None) -> tuple[list[int], list[list[Any]]]:
        """Return the indices of the values used, and their weights for each channel; by cell, for drawn wavelengths."""
        if lanes is None:
            used = np.flatnonzero(self.weights.any(0)).tolist()
            # Opaque values are kernel inputs, so that other values do not compile the kernels again.
            return used, [[dr.opaque(mi.Float, weight) for weight in row] for row in self.weights[:, used].tolist()]
        made = []
        for row in self.weights:
            table = drjit_array(mi.Float, row)
            made.append(
                [
                    weight * dr.lerp(*(dr.gather(mi.Float, table, index + end) for end in (0, 1)), part)
                    for index, part, weight in zip(lanes.stratum, lanes.part, lanes.weight, strict=True)
                ]
            )
        dr.eval(made)
        return list(range(len(lanes.weight))), made


def mixed(weights: Sequence[Any], values: Sequence[Any]) -> Any:
    """Return the weighted sum of the values."""
    return sum((weight * value for weight, value in zip(weights, values, strict=True)), start=mi.Float(0))


def span(nodes: list[Node]) -> tuple[float, float]:
    """Return the range of strata, within 0 to 1, with wavelengths that contribute to the nodes."""
    lit = np.flatnonzero(np.any([node.weights.any(0) for node in nodes], axis=0))
    return max(int(lit[0]) - 1, 0) / _STRATA, min(int(lit[-1]) + 1, _STRATA) / _STRATA


@dataclass(frozen=True)
class SignedColours:
    """Responses of a capture's channels, by wavelength."""

    # Wavelengths, and the channels' responses.
    spectrum: Spectrum
    # Whether each channel has nodes of its own, as for lines and for bands of one width.
    apart: bool
    # Matrix (values, wavelengths) from the values of a ray's light to its spectrum; None if light has its own spectrum.
    upsampling: NDArray[np.float64] | None
    # Responses of the channels if light has its own spectrum.
    responses: Responses | None = None
    # Count of nodes, for each channel if they are apart; None means as many as `accuracy` needs.
    nodes: int | None = None

    @classmethod
    def lines(cls, wavelengths: tuple[float, ...]) -> SignedColours:
        """Return the responses of channels that each see one wavelength, with one value of light per channel."""
        return cls(Spectrum.lines(*wavelengths), True, np.eye(len(wavelengths)))

    @functools.cached_property
    def drawn(self) -> DrawnWavelengths | None:
        """The distribution from which rays' wavelengths are drawn, or None if light has no spectrum."""
        return None if self.responses is None else DrawnWavelengths(self.responses)

    def places(self, camera: PlenopticCamera, accuracy: float) -> list[float]:
        """Return the wavelengths of the nodes, in nanometres.

        The nodes of a band, or of channels with common nodes, are spaced evenly in the logarithm of the wavelength,
        without the outermost 1 % of the responses on either side; a single node is the mean wavelength. The number of
        nodes is the smallest that gives each channel's microlens spot, as pixels record it, in uniform light to three
        times `accuracy`, and that limits the blur between neighbouring nodes of a dispersive main lens, at the usual
        accuracy to one lens. Where it is 1 for all channels, with pixels far wider than the spots, channels that have
        nodes of their own elsewhere share it, too.
        """
        responses = np.abs(self.spectrum.matrix().astype(np.float64))
        if not self.apart:
            return self._places_for(responses, camera, accuracy)
        if self.nodes is None and camera.has_array:
            wavelength = in_millimetres(max(self.spectrum.wavelengths))
            spot = wavelength * camera.reduced_distance / camera.lattice.aperture_width
            together = self._places_for(responses, camera, accuracy) if camera.pixel_size > _COARSE * spot else []
            if len(together) == 1:
                return together
        return sorted({place for row in responses for place in self._places_for(row[None], camera, accuracy)})

    def _places_for(self, rows: NDArray[np.float64], camera: PlenopticCamera, accuracy: float) -> list[float]:
        """Return the wavelengths of common nodes for channels with given responses (channels, wavelengths)."""
        wavelengths = np.array(self.spectrum.wavelengths)
        order = np.argsort(wavelengths, kind="stable")
        order = order[rows[:, order].any(0)]
        weights = rows[rows.any(1)][:, order]
        if not len(weights):
            return []
        weights = weights / weights.sum(1, keepdims=True)
        if self.nodes is not None:
            return _divided(wavelengths[order], weights, self.nodes)
        given = tuple(wavelengths[order].tolist()), tuple(map(tuple, weights.tolist()))
        return _enough(camera, *given, max(accuracy, _LEAST_ERROR))

    def planned(self, camera: PlenopticCamera, accuracy: float, varying: Sequence[str] = ()) -> list[Node]:
        """Return the nodes, with their plans, which are expanded where parameters are varied."""
        start = nearby(camera, varying, accuracy)
        found, fine = self.shared(start, accuracy), accuracy < FINE
        nodes = []
        for place, channels, weights in found:
            plan = plan_of(start.at_wavelength(place), place, fine, found[0][0], found[-1][0])
            if varying and isinstance(plan, PhaseSpace) and not plan.by_points:
                plan = ExpandedPlan.about(plan, camera.at_wavelength(place))
            nodes.append(Node(plan, channels, weights))
        return nodes

    def shared(
        self, camera: PlenopticCamera, accuracy: float
    ) -> list[tuple[float, tuple[int, ...], NDArray[np.float64]]]:
        """Return each node's wavelength and channels, and the weights of a ray's values in the channels: see `Node`."""
        places = self.places(camera, accuracy)
        found = []
        for number, place in enumerate(places):
            if self.drawn is None or self.responses is None:
                assert self.upsampling is not None
                hat = _hats(np.array(self.spectrum.wavelengths), places)[number]
                weights = (self.spectrum.matrix() * hat) @ self.upsampling.T
            else:
                weights = np.asarray(self.responses.at(self.drawn.edges)) * _hats(self.drawn.edges, places)[number]
            channels = np.flatnonzero(weights.any(1))
            if len(channels):
                found.append((place, tuple(channels.tolist()), weights[channels]))
        return found


def _hats(wavelengths: NDArray[np.float64], places: list[float]) -> NDArray[np.float64]:
    """Return the weights (nodes, wavelengths) of linear interpolation between nodes."""
    return np.stack([np.interp(wavelengths, places, unit) for unit in np.eye(len(places))])


def _divided(wavelengths: NDArray[np.float64], weights: NDArray[np.float64], count: int) -> list[float]:
    """Return `count` nodes for normalised responses (channels, n) at rising wavelengths."""
    weight = weights.mean(0)
    if count == 1 or wavelengths[0] == wavelengths[-1]:
        return [float(weight @ wavelengths)]
    low, high = np.interp((_TAIL, 1 - _TAIL), np.cumsum(weight) - weight / 2, wavelengths).tolist()
    return [float(place) for place in np.geomspace(low, high, count)]


@functools.lru_cache(maxsize=16)
def _enough(
    camera: PlenopticCamera, at: tuple[float, ...], responses: tuple[tuple[float, ...], ...], error: float
) -> list[float]:
    """Return the fewest nodes that satisfy the conditions of `SignedColours.places`.

    `at` are rising wavelengths, and `responses` the channels' normalised responses there.
    """
    if at[0] == at[-1]:
        return [at[0]]
    wavelengths, weights = np.array(at), np.array(responses)
    dense = np.geomspace(wavelengths[0], wavelengths[-1], _DENSE)
    make = plan_type(camera)
    width, coarse = make(camera.at_wavelength(dense[-1]), dense[-1]).widths
    step = width * dense[0] / dense[-1] / _SPOTS[1]
    reach = math.ceil((_SPOTS[0] * width + camera.pixel_size / 2) / step)
    along = np.arange(-reach, reach + 1) * step
    spots = np.stack([make(camera.at_wavelength(each), each).spots(along) for each in dense])
    pixel = max(1, round(camera.pixel_size / step))
    spots = scipy.ndimage.uniform_filter(spots, (0, 0, pixel, pixel), mode="constant").reshape(_DENSE, -1)
    true = weights @ _hats(wavelengths, dense.tolist()).T @ spots
    places: list[float] = []
    for count in range(1, _MOST_NODES + 1):
        places = _divided(wavelengths, weights, count)
        shares = weights @ _hats(wavelengths, places).T @ _hats(np.array(places), dense.tolist()).T
        wrong = np.linalg.norm(shares @ spots - true, axis=1) / np.linalg.norm(true, axis=1)
        apart = places if count > 1 else _divided(wavelengths, weights, 2)
        powers = [_power(camera, place) for place in apart]
        blur = 2 * camera.aperture_radius * camera.mla_distance * np.abs(np.diff(powers)).max()
        if wrong.max() <= _PROBED * error and blur <= _BLUR * math.sqrt(error) * coarse:
            break
    return places


def _power(camera: PlenopticCamera, wavelength: float) -> float:
    """Return the reciprocal, in 1/mm, of the image distance behind the main lens for objects at the focus distance."""
    lens = OpticalSystem(camera.at_wavelength(wavelength), wavelength).lens
    return float(lens.vergence(camera.focus_distance))
