r"""The wavelengths at which signed-ray captures compute diffraction, and the weights of rays at each wavelength.

Coefficients and kernels are computed at a few wavelengths, the nodes of `Spectrum.interpolated`. Light of other
wavelengths is divided among the nodes by the polynomial through them. Each channel thus has an image at each node, and
records the sum of the images' convolutions.

In spectral variants each ray has its own wavelengths, drawn from the channels' responses, over which the mean square of
a node's share is its weight in Gauss's rule: sharing adds no noise to speak of. The two rays that correct
each other have the same wavelengths, so that light which is uniform over a lens has only the noise of the wavelengths.
From cell to cell the wavelengths follow a sequence that fills the band evenly in any neighbourhood.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.ndimage

from ..camera import PlenopticCamera
from ..fields import OpticalSystem
from ..optics import Spectrum, in_millimetres, interpolated
from ..rays import even_words
from ..runtime import Doubles, Pair, Sizes, drjit_array
from .accuracy import USUAL
from .scheme import diffraction_of

_STRATA = 4096
"""Strata of equal probability from which wavelengths are drawn."""


class RayWavelengths(NamedTuple):
    """Wavelengths in nanometres of rays, one list entry for each value of their light."""

    wavelengths: list
    # Index of the stratum in which each lies, and its position there from 0 to 1.
    stratum: list
    position: list
    # Reciprocal of the product of their count and the density.
    weight: list


class WavelengthSampler:
    """Random wavelengths, stratified, with the density of the channels' responses."""

    def __init__(self, table: Doubles):
        """Take the responses, (rows, 1 + channels): each row has a wavelength in nanometres and them per nanometre."""
        responses = functools.partial(interpolated, table[:, 0], table[:, 1:].T)
        steps = np.linspace(table[0, 0], table[-1, 0], USUAL.density_steps + 1)
        density = np.abs(responses(steps))
        density = (density / density.sum(1, keepdims=True)).sum(0)
        upto = np.concatenate([[0], np.cumsum(density[1:] + density[:-1])])
        self.edges = np.interp(np.linspace(0, 1, _STRATA + 1), upto / upto[-1], steps)
        self.responses = responses(self.edges)
        self._edges = drjit_array(mi.Float, self.edges)

    def draw(self, chance: Any, span: Pair) -> RayWavelengths:
        """Draw the wavelengths of the active variant's rays, from a range of the strata, by random numbers."""
        count = dr.size_v(mi.UnpolarizedSpectrum)
        low, high = (dr.opaque(mi.Float, end * _STRATA) for end in span)
        rays = RayWavelengths([], [], [], [])
        for lane in range(count):
            quantile = low + (high - low) * (chance + lane) * (1 / count)
            index = dr.minimum(mi.UInt32(quantile), _STRATA - 1)
            first, last = (dr.gather(mi.Float, self._edges, index + end) for end in (0, 1))
            position = quantile - mi.Float(index)
            rays.wavelengths.append(first + position * (last - first))
            rays.stratum.append(index)
            rays.position.append(position)
            rays.weight.append((last - first) * (high - low) * (1 / count))
        return rays


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
    channels: Sizes
    # Weights of the values of a ray's light in the image of each of these channels, an array (channels, values). For
    # drawn wavelengths, the values are those at the edges of the strata.
    weights: Doubles

    def mixture(self, rays: RayWavelengths | None = None) -> tuple[list[int], list]:
        """Return the indices of the values used, and their weights for each channel; by cell, for drawn wavelengths."""
        if rays is None:
            indices = np.flatnonzero(self.weights.any(0)).tolist()
            # Opaque values are kernel inputs, so that other values do not compile the kernels again.
            return indices, [
                [dr.opaque(mi.Float, weight) for weight in row] for row in self.weights[:, indices].tolist()
            ]
        mixtures = []
        for row in self.weights:
            table = drjit_array(mi.Float, row)
            mixtures.append(
                [
                    weight * dr.lerp(*(dr.gather(mi.Float, table, index + end) for end in (0, 1)), position)
                    for index, position, weight in zip(rays.stratum, rays.position, rays.weight, strict=True)
                ]
            )
        dr.eval(mixtures)
        return list(range(len(rays.weight))), mixtures


def mixed(weights: Sequence, values: Sequence) -> Any:
    """Return the weighted sum of the values."""
    return sum((weight * value for weight, value in zip(weights, values, strict=True)), start=mi.Float(0))


def span(nodes: list[Node]) -> Pair:
    """Return the range of strata, within 0 to 1, with wavelengths that contribute to the nodes."""
    lit = np.flatnonzero(np.any([node.weights.any(0) for node in nodes], axis=0))
    return max(int(lit[0]) - 1, 0) / _STRATA, min(int(lit[-1]) + 1, _STRATA) / _STRATA


def node_spectra(
    camera: PlenopticCamera, spectrum: Spectrum, accuracy: float, count: int | None = None
) -> list[tuple[list[int], Spectrum]]:
    """Return the channels that have nodes in common, with their spectrum and nodes; channels without responses lack.

    Channels no two of which answer to one wavelength, as those of lines and bands, have nodes of their own. Nodes are
    those of Gauss's rule for the responses. By default, their number is the smallest that gives each channel's
    microlens spot, as pixels record it, in uniform light to three times `accuracy`, and that limits the blur between
    neighbouring nodes of a dispersive main lens, at the usual accuracy to 1.3 lenses. Where it is 1 for all channels,
    with pixels far wider than the spots, channels that have nodes of their own elsewhere share it, too.
    """

    def noded(channels: list[int]) -> Spectrum:
        of_channels = replace(spectrum, responses=tuple(spectrum.responses[channel] for channel in channels))
        if count is not None:
            return of_channels.interpolated(count)
        return _enough(camera, of_channels, max(accuracy, USUAL.least_spot_error))

    responses = spectrum.matrix() != 0
    lit = np.flatnonzero(responses.any(1)).tolist()
    if responses.sum(0).max() > 1:
        return [(lit, noded(lit))]
    if count is None and camera.has_array:
        wavelength = in_millimetres(max(spectrum.wavelengths))
        spot = wavelength * camera.reduced_distance / camera.lattice.aperture_width
        if camera.pixel_size > USUAL.shared_pixel * spot:
            together = noded(lit)
            if len(together.computed) == 1:
                return [(lit, together)]
    return [([channel], noded([channel])) for channel in lit]


@functools.lru_cache(maxsize=16)
def _enough(camera: PlenopticCamera, spectrum: Spectrum, error: float) -> Spectrum:
    """Return a spectrum with the fewest nodes that satisfy the conditions of `node_spectra`."""
    responses = np.abs(np.array(spectrum.responses))
    wavelengths = np.array(spectrum.wavelengths)
    lit = wavelengths[responses.any(0)]
    if lit.min() == lit.max():
        return spectrum.interpolated(1)
    weights = responses / responses.sum(1, keepdims=True)
    dense = np.geomspace(lit.min(), lit.max(), USUAL.dense_wavelengths)
    of_dense = [diffraction_of(camera.at_wavelength(wavelength), wavelength) for wavelength in dense]
    width, coarse = of_dense[-1].widths
    step = width * dense[0] / dense[-1] / USUAL.spot_samples
    reach = math.ceil((USUAL.spot_width * width + camera.pixel_size / 2) / step)
    along = np.arange(-reach, reach + 1) * step
    spots = np.stack([of_one.spots(along) for of_one in of_dense])
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
        systems = [OpticalSystem(camera.at_wavelength(node), node) for node in apart.computed]
        # Reciprocals, in 1/mm, of the image distances behind the main lens for objects at the focus distance.
        powers = [float(system.lens.vergence(camera.focus_distance)) for system in systems]
        blur = 2 * camera.aperture_radius * camera.mla_distance * np.abs(np.diff(powers)).max()
        good = (wrong / np.linalg.norm(true, axis=1)).max() <= USUAL.spot_error * error
        if good and blur <= USUAL.node_blur * math.sqrt(error) * coarse:
            break
    return noded
