r"""Captures of a radiance of 1 by signed rays, without random numbers.

Such light is alike where the pupil's diffraction displaces a ray to, so that :math:`\int L A_n\, dm = \int L a_n\, dm`:
a sum over cells of the lens, of the mean light of rays that pass them from around a cell of the detector's grid.
"""

from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..rays import STAR, lens_cells, light_of_cells
from ..runtime import Box, Doubles, Flags, Shape, drjit_array, interleaved
from .ray_sampler import CellLenses, LensSampler
from .signed_capture import SignedCapture
from .signed_rays import CellMeans, RayBatch, SignedRaySum

_WIDE = 9.0
_CELLS_OF_SCALE = 25.0
_WITHIN = 4
"""Most cells along a lens, cells along the scale of vignetting, and points along a cell for the means of functions."""


class WhiteCapture(SignedCapture):
    """The capture of a radiance of 1; where light changes fast over a lens, or there is no array, by random rays."""

    @property
    def kind(self) -> type[SignedRaySum]:
        """The sum of cells of lenses where there is one, otherwise that of random rays."""
        if self.camera.lens_data.images_stop:
            return super().kind
        is_steep = bool(self.camera.pixel_response) and not self.nodes[0].plan.lands_by_point
        return WhiteSum if self.camera.has_array and not is_steep else SignedRaySum


class WhiteSum(SignedRaySum):
    """The sum of a `WhiteCapture`, computed by blocks of the detector."""

    def _far(self, box: Box) -> Flags:
        """Return a mask of no pixel: those drawn at random of the far ones would be all that is random."""
        return np.zeros((box.rows, box.columns), bool)

    def estimate(self, batch: RayBatch, only: int | None = None) -> list[CellMeans | None]:
        """Return each node's mean values over the rays of the cells of a batch."""
        sampler = self._sampler
        lane = dr.arange(mi.UInt32, dr.width(batch.index) * self._parts**2)
        pixel = lane // self._parts**2
        lenses, _ = sampler.cells(sampler.lenses(batch.pixels).at(pixel), pixel, lane - pixel * self._parts**2)
        values = [[mi.Float(0)] * factors.shape[1] for factors in self._factors]
        tables = [drjit_array(mi.Float, factors.ravel()) for factors in self._factors]
        for number in range(len(self._factors[0])):
            light = self._light_through(lenses, *divmod(number, self._lens_cells[0]))
            for sums, table in zip(values, tables, strict=True):
                first = dr.opaque(mi.UInt32, number * len(sums))
                sums[:] = [
                    dr.fma(light, dr.gather(mi.Float, table, first + n), before) for n, before in enumerate(sums)
                ]
            # One kernel serves all cells of the lens.
            dr.eval(values)
        means: list[CellMeans | None] = []
        for node, sums in zip(self._nodes, values, strict=True):
            images = [interleaved([value * weight for value in sums]) for weight in node.weights.sum(1).tolist()]
            means.append(CellMeans(batch.index, sampler.cosines(batch.pixels), images))
        dr.eval([tuple(of_node) for of_node in means if of_node])
        return means

    def _light_through(self, lenses: CellLenses, down: int, across: int) -> Any:
        """Return the mean light of rays from around cells of the detector through a cell of their lenses."""
        sampler = self._sampler
        assert isinstance(sampler, LensSampler)  # of an array
        middle = [dr.opaque(mi.Float, value + 0.5) for value in (across, down)]
        width = dr.opaque(mi.Float, self._step)
        rays = []
        for s, t, *aside in STAR.tolist():
            if not sampler.lands_by_point:
                # The density of rays about a cell is a B-spline of order 2.
                s, t, *aside = s + aside[0], t + aside[1], 0.0, 0.0
            position = lenses.position[0] + s * width, lenses.position[1] + t * width
            cell = ((at + off) / size for at, off, size in zip(middle, aside, self._lens_cells, strict=True))
            point = self._camera.lattice.aperture_point(*cell)
            rays.append(sampler.outline(sampler.through(position, point, lenses)))
        return mi.Float(light_of_cells(rays))

    @cached_property
    def _lens_cells(self) -> Shape:
        """Numbers of cells of a lens along both sides of `aperture_point`."""
        camera = self._camera
        most = _WIDE / 2 if camera.lattice.aperture == "circle" else _WIDE
        wide = 4.0 if camera.mla_absorption else 0.0
        if self._nodes[0].plan.lands_by_point:
            wide = most
        elif camera.vignetting is not None:
            # Outlines move by about the pupil's radius over their scale.
            scale = min(camera.vignetting.scale, camera.detector_width / 2)
            wide = max(wide, min(most, _CELLS_OF_SCALE * max(camera.mla_pitches) / scale))
        return lens_cells(camera.lattice, wide) if wide else (1, 1)

    @cached_property
    def _factors(self) -> list[Doubles]:
        """For each node, the means (cells, functions) of the functions over the cells of a lens, over their number."""
        lattice = self._camera.lattice
        across, down = self._lens_cells
        along = ((np.arange(count * _WITHIN) + 0.5) / (count * _WITHIN) for count in self._lens_cells)
        u, v = lattice.to_frame(*lattice.aperture_point(*np.meshgrid(*along)))
        factors = []
        for functions in (node.plan.functions for node in self._nodes):
            values = np.moveaxis(functions.values(u, v, functions.functions), 0, -1)
            # The mean of the first function is 1, that of others 0.
            values[..., 1:] -= values[..., 1:].mean((0, 1))
            sums = values.reshape(down, _WITHIN, across, _WITHIN, -1).sum((1, 3))
            factors.append(sums.reshape(across * down, -1) / u.size)
        return factors
