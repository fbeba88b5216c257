"""Rays drawn for captures with photodiode responses, and the tables of the responses in Dr.Jit."""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...rays import Walk, chances_of, low_discrepancy
from ...runtime import Pair, drjit_array
from .plane_waves import NEAR
from .response_tables import PhotodiodeResponses, TableWindow


class Aimed(NamedTuple):
    """Rays drawn for lenses, with their sampling weights."""

    pupil: Pair
    # Points on the array in the camera frame.
    place: Pair
    open: Any
    # Indices of the samples of the near and far tables of each wavelength, in the first cell of their windows.
    near: list
    far: list
    # Nodes of the wavelength for which lenses of the far window are drawn, counted over zones.
    node: Any


class Tables:
    """The response tables of all wavelengths on the device of the active variant."""

    def __init__(self, camera: PlenopticCamera, plans: Sequence[PhotodiodeResponses]):
        self.camera = camera
        self.plans = plans
        self.count = plans[0].count
        self._packets = -(-(self.count**2) // 4)
        self._index = [drjit_array(mi.Int, plan.table.nodes) for plan in plans]

        def packed(table: NDArray[np.float16]) -> Any:
            """Return a table (zones, nodes, y, x, photodiodes) in packets of four, and a node without response."""
            flat = table.reshape(-1, *table.shape[2:])
            flat = np.pad(flat, [(0, 1), (0, 0), (0, 0), (0, 4 * self._packets - self.count**2)])
            return drjit_array(mi.UInt32, np.ascontiguousarray(flat).view(np.uint32))

        # The windows and tables of each wavelength.
        self.near = [(plan.near, packed(plan.table.near)) for plan in plans]
        self.far = [(plan.far, packed(plan.table.far)) for plan in plans]
        self._means = [[drjit_array(mi.Float, column) for column in plan.table.means.T] for plan in plans]
        # Lenses of the far window are drawn for the wavelength with the widest one.
        self._widest = widest = max(range(len(plans)), key=lambda number: plans[number].far.lenses)
        quantiles = _quantiles(plans[widest])
        self._quantiles = quantiles.shape[1]
        self._drawn = drjit_array(mi.UInt32, quantiles)
        # Number of lenses, on each side of a lens, whose rays light the lens's photodiodes.
        self.margin = plans[widest].far.lenses // 2

    def draw(self, index: Pair, lens: Any, half: Any, ray_index: Any, seed: Any) -> Aimed:
        """Return rays drawn for lenses of given lattice indices; the rays of the two halves are independent."""
        system = self.plans[0].system
        random = low_discrepancy(lens, seed ^ (half * 8), ray_index, 4)
        chances = [chances_of(lens, seed ^ ((2 * ray_index + half) << 5) ^ word) for word in (24, 25, 26)]
        pupil = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(random[0], random[1])) * float(system.lens.reach)
        centre = self.camera.lattice.centre(*index)
        slope = [-system.lens.pupil.slope(P, c) for P, c in zip(pupil, centre, strict=True)]
        chief = [-system.lens.pupil.slope(0.0, c) for c in centre]
        cosine, middle = (dr.rsqrt(1 + dr.square(t[0]) + dr.square(t[1])) for t in (slope, chief))
        inner = Walk.of(system.camera, system.lens).round_pupil(tuple(pupil), centre)
        is_open = dr.square(inner[0]) + dr.square(inner[1]) <= system.camera.pupil_radius**2
        zone = self._zone(index, chances[0][:2])
        widest_node = mi.UInt32(0)
        near: list = []
        far: list = []
        for number_of, (plan, table) in enumerate(zip(self.plans, self._index, strict=True)):
            n = 2 * plan.across + 1
            column, row = (
                mi.Int(dr.floor((t * cosine - c * middle) / plan.step + plan.across + chance))
                for t, c, chance in zip(slope, chief, chances[0][2:], strict=True)
            )
            within = (dr.minimum(column, row) >= 0) & (dr.maximum(column, row) < n)
            node = dr.gather(mi.Int, table, mi.UInt(row * n + column), within)
            is_open &= within & (node >= 0)
            nodes = plan.table.near.shape[1]
            node = dr.select(is_open, mi.UInt(node) + zone * nodes, len(plan.zones) * nodes)
            widest_node = node if number_of == self._widest else widest_node
            for window, offsets, indices in ((plan.near, chances[1][:2], near), (plan.far, chances[1][2:], far)):
                x, y = (
                    mi.UInt(dr.floor(r * window.samples + offset))
                    for r, offset in zip(random[2:], offsets, strict=True)
                )
                indices.append((node * window.across + y) * window.across + x)
        point = tuple(c + (r - 0.5) * self.camera.row_pitch for c, r in zip(centre, random[2:], strict=True))
        return Aimed(tuple(pupil), point, is_open, near, far, widest_node)

    def drawn(self, node: Any, random: Any) -> tuple[Pair, Any]:
        """Return cells of the far window drawn at random for nodes, and the reciprocal probabilities of the cells."""
        window = self.plans[self._widest].far
        quantiles = self._quantiles
        entry = dr.gather(
            mi.UInt32, self._drawn, node * quantiles + mi.UInt32(dr.minimum(random * quantiles, quantiles - 1))
        )
        cell = entry >> 16
        row = cell // window.lenses
        position = tuple(mi.Int(coordinate) + window.first for coordinate in (cell - row * window.lenses, row))
        return position, quantiles / mi.Float(entry & 0xFFFF)

    def values(self, table: tuple[TableWindow, Any], first: Any, cell: Pair) -> list:
        """Return the responses of the photodiodes of one lens to rays drawn for a lens in a window around it."""
        window, packets = table
        column, row = (coordinate - window.first for coordinate in cell)
        index = first + mi.UInt32(row * window.samples) * window.across + mi.UInt32(column * window.samples)
        # Lenses are drawn for the widest of the far windows.
        within = (dr.minimum(column, row) >= 0) & (dr.maximum(column, row) < window.lenses)
        result = []
        for packet in range(self._packets):
            words = dr.gather(mi.Vector2u, packets, index * self._packets + packet, within)
            for half in (half for word in words for half in (word << 16, word)):
                # From half precision, whose exponents are biased by 15, to single precision, by 127.
                bits = ((half & 0x7FFF0000) >> 3) | (half & 0x80000000)
                result.append(dr.reinterpret_array(mi.Float, bits) * 2.0**112)
        return result[: self.count**2]

    def zone_means(self, node_index: int, index: Pair) -> list:
        """Return the mean responses of the photodiodes of lenses, interpolated between zones."""
        positions = (self._along(axis, numbers) for axis, numbers in enumerate(index))
        right, high = (position - dr.floor(position) for position in positions)
        left, low = (1 - aside for aside in (right, high))
        shares = {(0.0, 0.0): left * low, (0.0, 1.0): left * high, (1.0, 0.0): right * low, (1.0, 1.0): right * high}
        corners = [(self._zone(index, chance), share) for chance, share in shares.items()]
        return [
            sum((dr.gather(mi.Float, mean, zone) * share for zone, share in corners), mi.Float(0))
            for mean in self._means[node_index]
        ]

    def _along(self, axis: int, index: Any) -> Any:
        """Return fractional indices, among the zones along an axis, of lenses with given lattice indices."""
        zones = self.plans[0].zones.y if axis else self.plans[0].zones.x
        if len(zones) == 1:
            return mi.Float(0)
        scale = (len(zones) - 1) / (zones[-1] - zones[0])
        return dr.clip((mi.Float(index) - float(zones[0])) * float(scale), 0, len(zones) - 1)

    def _zone(self, index: Pair, chance: Pair) -> Any:
        """Return, for each lens, one of the surrounding zones, drawn at random."""
        zones = self.plans[0].zones
        x, y = (
            mi.UInt(dr.minimum(dr.floor(self._along(axis, numbers) + offset), count - 1))
            for axis, (numbers, offset, count) in enumerate(
                zip(index, chance, (len(zones.x), len(zones.y)), strict=True)
            )
        )
        return y * len(zones.x) + x


@functools.lru_cache(maxsize=2)
def _quantiles(plan: PhotodiodeResponses) -> NDArray[np.uint32]:
    """Return quantiles of the distribution over the far window's cells for each node, (nodes of all zones + 1, n).

    The density of a cell is about the magnitude of its responses. Each quantile holds the index of a cell, and in its
    lower 16 bits the number of quantiles of this cell.
    """
    window = plan.far
    lenses = window.lenses
    # More than there are cells.
    count = 1 << math.ceil(math.log2(2 * lenses**2))
    low = -window.first - NEAR // 2
    nodes = plan.table.far.reshape(-1, *plan.table.far.shape[2:])
    result = np.full((len(nodes) + 1, count), 1, np.uint32)
    for node, values in enumerate(nodes):
        square = np.square(values[:-1, :-1], dtype=np.float32).mean(-1)
        density = np.sqrt(square.reshape(lenses, window.samples, lenses, window.samples).mean((1, 3)))
        density[low : low + NEAR, low : low + NEAR] = 0
        # Each cell has one quantile at least.
        share = density.ravel() / max(float(density.sum()), 1e-30)
        upto = np.round(np.cumsum(share) * (count - lenses**2))
        counts = 1 + np.diff(upto, prepend=0).astype(np.uint32)
        counts[-1] += count - counts.sum()
        result[node] = np.repeat((np.arange(lenses**2, dtype=np.uint32) << 16) | counts, counts)
    return result
