r"""The wavelengths at which signed-ray captures compute diffraction, and the weights of rays at each wavelength.

Coefficients and kernels are computed at a few wavelengths, the nodes of `Spectrum.interpolated`. Light of other
wavelengths is divided among the nodes by the polynomial through them. Each channel thus has an image at each node, and
records the sum of the images' convolutions.

In spectral variants each ray has its own wavelengths, drawn from the channels' responses, over which the mean square of
a node's share is its weight in Gauss's rule: sharing adds no noise to speak of. The two rays that correct
each other have the same wavelengths, so that light which is uniform over a lens has only the noise of the wavelengths.
From cell to cell the wavelengths follow a sequence that fills the band evenly in any neighbourhood.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from .accuracy import USUAL
from .expansion import ExpandedPlan, nearby
from .phase_space import FINE, PhaseSpace
from .scheme import Plan, plan_of, plan_type

_STRATA = 4096
"""Strata of equal probability from which wavelengths are drawn."""


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
        steps = np.linspace(responses.low, responses.high, USUAL.density_steps + 1)
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

    def groups(self, camera: PlenopticCamera, accuracy: float) -> list[tuple[list[int], Spectrum]]:
        """Return channels that have nodes in common, with their spectrum and nodes; channels without responses lack.

        Nodes are those of Gauss's rule for the responses. Their number is the smallest that gives each channel's
        microlens spot, as pixels record it, in uniform light to three times `accuracy`, and that limits the blur
        between neighbouring nodes of a dispersive main lens, at the usual accuracy to 1.3 lenses. Where it is 1 for all
        channels, with pixels far wider than the spots, channels that have nodes of their own elsewhere share it, too.
        """
        lit = np.flatnonzero(self.spectrum.matrix().any(1)).tolist()
        if not self.apart:
            return [(lit, self._noded(lit, camera, accuracy))]
        if self.nodes is None and camera.has_array:
            wavelength = in_millimetres(max(self.spectrum.wavelengths))
            spot = wavelength * camera.reduced_distance / camera.lattice.aperture_width
            if camera.pixel_size > USUAL.shared_pixel * spot:
                together = self._noded(lit, camera, accuracy)
                if len(together.computed) == 1:
                    return [(lit, together)]
        return [([channel], self._noded([channel], camera, accuracy)) for channel in lit]

    def _noded(self, channels: list[int], camera: PlenopticCamera, accuracy: float) -> Spectrum:
        """Return the spectrum of some channels, with nodes."""
        spectrum = replace(self.spectrum, responses=tuple(self.spectrum.responses[channel] for channel in channels))
        if self.nodes is not None:
            return spectrum.interpolated(self.nodes)
        return _enough(camera, spectrum, max(accuracy, USUAL.least_spot_error))

    def planned(self, camera: PlenopticCamera, accuracy: float, varying: Sequence[str] = ()) -> list[Node]:
        """Return the nodes, with their plans, which are expanded where parameters are varied."""
        start = nearby(camera, varying, accuracy)
        shared = self.shared(start, accuracy)
        shortest, longest = shared[0][0], shared[-1][0]

        def plans(beside_far: bool) -> list[Plan]:
            return [
                plan_of(start.at_wavelength(node), node, accuracy < FINE, shortest, longest, beside_far)
                for node, _, _ in shared
            ]

        # Dispersing microlenses may be in focus at some nodes alone.
        made = plans(False)
        if len({plan.by_points for plan in made}) > 1:
            made = plans(True)
        nodes = []
        for plan, (wavelength, channels, weights) in zip(made, shared, strict=True):
            if varying and isinstance(plan, PhaseSpace) and not plan.by_points:
                plan = ExpandedPlan.about(plan, camera.at_wavelength(wavelength))
            nodes.append(Node(plan, channels, weights))
        return nodes

    def shared(
        self, camera: PlenopticCamera, accuracy: float
    ) -> list[tuple[float, tuple[int, ...], NDArray[np.float64]]]:
        """Return each node's wavelength and channels, and the weights of a ray's values in the channels: see `Node`."""
        if self.drawn is None or self.responses is None:
            wavelengths = np.array(self.spectrum.wavelengths)
            matrix: NDArray[Any] = self.spectrum.matrix()
        else:
            wavelengths = self.drawn.edges
            matrix = np.asarray(self.responses.at(wavelengths))
        weights: dict[float, NDArray[np.float64]] = {}
        for channels, spectrum in self.groups(camera, accuracy):
            for node, share in zip(spectrum.computed, spectrum.shares(wavelengths), strict=True):
                weights.setdefault(node, np.zeros(matrix.shape))[channels] = matrix[channels] * share
        if self.upsampling is not None:
            weights = {node: values @ self.upsampling.T for node, values in weights.items()}
        shared = []
        for node, values in sorted(weights.items()):
            lit = np.flatnonzero(values.any(1))
            shared.append((node, tuple(lit.tolist()), values[lit]))
        return shared


@functools.lru_cache(maxsize=16)
def _enough(camera: PlenopticCamera, spectrum: Spectrum, error: float) -> Spectrum:
    """Return a spectrum with the fewest nodes that satisfy the conditions of `SignedColours.groups`."""
    responses = np.abs(np.array(spectrum.responses))
    wavelengths = np.array(spectrum.wavelengths)
    lit = wavelengths[responses.any(0)]
    if lit.min() == lit.max():
        return spectrum.interpolated(1)
    weights = responses / responses.sum(1, keepdims=True)
    dense = np.geomspace(lit.min(), lit.max(), USUAL.dense_wavelengths)
    make = plan_type(camera)
    width, coarse = make(camera.at_wavelength(dense[-1]), dense[-1]).widths
    step = width * dense[0] / dense[-1] / USUAL.spot_samples
    reach = math.ceil((USUAL.spot_width * width + camera.pixel_size / 2) / step)
    along = np.arange(-reach, reach + 1) * step
    spots = np.stack([make(camera.at_wavelength(wavelength), wavelength).spots(along) for wavelength in dense])
    pixel = max(1, round(camera.pixel_size / step))
    spots = scipy.ndimage.uniform_filter(spots, (0, 0, pixel, pixel), mode="constant").reshape(len(dense), -1)

    def at(places: Any) -> Any:
        return np.stack([np.interp(places, dense, unit) for unit in np.eye(len(dense))], axis=-1) @ spots

    true = weights @ at(wavelengths)
    noded = spectrum
    for count in range(1, USUAL.most_nodes + 1):
        noded = spectrum.interpolated(count)
        wrong = np.linalg.norm(weights @ noded.shares().T @ at(noded.computed) - true, axis=1)
        apart = noded if count > 1 else spectrum.interpolated(2)
        powers = [_power(camera, node) for node in apart.computed]
        blur = 2 * camera.aperture_radius * camera.mla_distance * np.abs(np.diff(powers)).max()
        good = (wrong / np.linalg.norm(true, axis=1)).max() <= USUAL.spot_error * error
        if good and blur <= USUAL.node_blur * math.sqrt(error) * coarse:
            break
    return noded


def _power(camera: PlenopticCamera, wavelength: float) -> float:
    """Return the reciprocal, in 1/mm, of the image distance behind the main lens for objects at the focus distance."""
    lens = OpticalSystem(camera.at_wavelength(wavelength), wavelength).lens
    return float(lens.vergence(camera.focus_distance))
