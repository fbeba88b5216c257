r"""Derivatives of signed-ray captures with respect to the camera's parameters, with rays fixed in the scene.

On the scene's side of the main lens, a ray is fixed: its pupil point, direction, radiance and étendue. A changed camera
refracts it differently: it meets its microlens at another point m, lands at another position u of the detector, in
cells of the grid, and has another weight, of logarithm f. With primes for derivatives with respect to a parameter, the
capture changes by

.. math:: I' = \sum_n \left[ \varphi_n * \sum_{rays} L\, (f' A_n + m' \cdot \nabla_m A_n + q'\, \partial_q A_n)
          - \nabla \varphi_n * \sum_{rays} L A_n u' + \varphi_n' * \sum_{rays} L A_n \right] ,

where q is the logarithm of the ratio of the pupil's diffraction width to the pitch, the only other quantity on which
the coefficients depend. The rays that the changed camera would draw sample the same light, so this is the derivative of
the camera's capture; how radiance changes between rays need not be known. The part with the mean radiance c has a
constant integral over m: only the landing positions and the density of its rays change. Images of oblique kernels
change with the functions' images, and with the direction in which light meets the microlenses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import Captures, PlenopticCamera, Use, Values, require_support, shortest_parts, with_gradient
from ..detector.noise import known_means
from ..errors import InputError, refuse_if
from ..fields.lens_kinds import LensKinds
from ..lenses.pupil import Pair
from ..optics import rays
from ..rays.random_numbers import chances_of
from ..runtime import drjit_array
from ..scene.radiance import require_finite
from .array_field import Array
from .array_kernels import displaced
from .expansion import OF_KERNELS, kernel_slopes, width_slopes
from .phase_space import PhaseSpace, RayCoefficients
from .pixel_kernels import PixelKernels
from .scheme import Plan
from .signed_colours import mixed
from .signed_draws import Drawn, Kept
from .signed_rays import Lot, NodeLight, SignedRaySum, of_cells

PARAMETERS = with_gradient(Captures.SCENES)
"""Camera parameters with respect to which signed-ray captures have derivatives."""


class Held(NamedTuple):
    """Rays fixed in the scene, as they pass a changed camera."""

    point: Pair  # on the array, from the lens's centre, in the lattice's frame, in which lengths grow with the pitch
    cell: Pair  # on the detector, in cells of the grid from the axis
    measure: Any  # logarithm of the weight of a ray
    density: Any  # logarithm of the density on the detector of rays whose directions fill the lens
    cosines: Pair  # of the light that passes the lens's centre, in the lattice's frame


def parameters_of(camera: PlenopticCamera) -> Values:
    """Return the values of all `PARAMETERS`, each as an array of components."""
    return {name: shortest_parts(camera, name) for name in PARAMETERS}


def require_parameters(camera: PlenopticCamera, names: Iterable[str], by_points: bool) -> None:
    """Refuse parameters with respect to which a signed-ray capture of this camera has no derivative."""
    for name in names:
        require_support(camera, Use.SCENE_DERIVATIVES)
        if name not in PARAMETERS:
            raise InputError(f"{name}: captures by signed rays have derivatives by {', '.join(PARAMETERS)} alone")
        refuse_if(
            name == "mla_pitch" and camera.mla_pitches[0] != camera.mla_pitches[1],
            "mla_pitch: captures by signed rays have no derivative by one of two pitches",
        )
        refuse_if(
            by_points,
            f"{name}: captures by signed rays have derivatives by it near the microlenses' focus alone, and "
            f"detector_distance = {camera.detector_distance:g} is far from it",
        )


class _CameraSum(SignedRaySum):
    """The sum of signed rays, with tables and kernels for derivatives with respect to the camera's parameters."""

    def __init__(self, *arguments: Any, names: Iterable[str], **options: Any) -> None:
        self._names = tuple(names)
        super().__init__(*arguments, **options)
        # Kernels themselves, displaced along x and along y, and each of their changes.
        self._sets = 3 + len(self._of_kernels)

    @cached_property
    def _by_width(self) -> list[RayCoefficients]:
        return [RayCoefficients(node.plan, width_slopes(node.plan)) for node in self._nodes]

    @cached_property
    def _of_kernels(self) -> list[tuple[str, int]]:
        """The parameter components on which kernels depend."""
        start = parameters_of(self._camera)
        return [(name, i) for name in self._names if name in OF_KERNELS for i in range(len(start[name]))]

    def _further_kernels(self, plan: Plan, kind: int) -> list[NDArray[np.float64]]:
        assert isinstance(plan, PhaseSpace)
        own = plan.kernels(self._step, plan.reach, kind)
        # One set for each component, so that forward and reverse approximate the same kernels.
        slopes = {name: kernel_slopes(plan, name, self._step, kind) for name, _ in self._of_kernels}
        return [*displaced(own), *(slopes[name][i] for name, i in self._of_kernels)]


class CameraTangents(_CameraSum):
    """Directional derivative of a capture along changes of the camera's `PARAMETERS`."""

    def __init__(self, *arguments: Any, changes: Values, **options: Any) -> None:
        self._changes = changes
        super().__init__(*arguments, names=changes, **options)
        # All changes of the kernels share one set of values.
        self._sets = 4

    def _kept(self, drawn: Drawn, number: int) -> tuple[Any, ...]:
        return tuple(drawn.kept)

    def _alike(self, nodes: Sequence[int]) -> list[list[int]]:
        return [[number] for number in nodes]

    def _bring(
        self, lot: Lot, met: Any, kept: tuple[Any, ...], lights: list[NodeLight], numbers: Sequence[int]
    ) -> list[list[list[Any]]]:
        """Return each cell's values for each kernel, their slopes and their changes, for each image of one node.

        The changes of the direction cosines of the cells' light are returned as well.
        """
        ((radiance, known, weights),), (number,) = lights, numbers
        (pixel, first, start), (drawn, _) = self._cells_of(met), self._drawn_rays(lot.pixels, lot.key)
        known, weights = of_cells(known, pixel), of_cells(weights, pixel)
        lens, key = dr.gather(mi.UInt32, lot.pixels.number, pixel), lot.key
        table, width = self._coefficients[number], self._by_width[number]
        assert isinstance(table, RayCoefficients)  # others are refused
        _, direction, _ = self._groups[0][0].through_pupil(drawn.pupil, drawn.place, drawn.height)
        with dr.resume_grad():
            varying = varying_parameters(self._camera)
            for name, parts in self._changes.items():
                dr.enable_grad(varying[name])
                for value, part in zip(varying[name], parts, strict=True):
                    dr.set_grad(value, part)
            held = hold(self._camera, varying, drawn, direction, self._step)
            changes = [
                dr.forward_to(value, flags=dr.ADFlag.ClearInterior) if dr.grad_enabled(value) else mi.Float(0)
                for value in (*held.point, *held.cell, held.measure, held.density, *held.cosines)
            ]
        changes = [dr.detach(change) + dr.zeros(mi.Float, dr.width(radiance[0])) for change in changes]
        dr.eval(changes)
        wider = dr.opaque(mi.Float, width_change(self._camera, self._changes))

        def bring(k: Any, brought: list[list[list[Any]]]) -> tuple[Any, list[list[list[Any]]]]:
            ray, even = Kept(*kept).at(first + k), ((start + k) & 1) == 0
            du, dv, dx, dy, measure, density = (dr.gather(mi.Float, change, first + k) for change in changes[:6])
            means = [dr.select(ray.open, dr.select(even, pair[1], pair[0]), 0) for pair in known]
            lights = [dr.gather(mi.Float, light, first + k) for light in radiance]
            nodes = ray.point, ray.inner, chances_of(lens, key ^ ((start + k) << 4)), ray.open
            values, (by_u, by_v), by_width = table(*nodes), table.slopes(*nodes), width(*nodes)
            result = []
            for row, before in zip(weights, brought[0], strict=True):
                mean = mixed(row, means)
                strength = dr.select(ray.open, (mixed(row, lights) - mean) * ray.weight, 0)
                own = [strength * value for value in values]
                change = [
                    strength * (a * measure + u * du + v * dv + q * wider)
                    for a, u, v, q in zip(values, by_u, by_v, by_width, strict=True)
                ]
                own[0] += mean
                change[0] += mean * density
                parts = [*change, *(a * dx for a in own), *(a * dy for a in own), *own]
                result.append([old + part for old, part in zip(before, parts, strict=True)])
            return k + 1, [result]

        # All rays of a cell and a lens have nearly the same direction.
        bent = [dr.gather(mi.Float, change, first) for change in changes[6:]]
        return [[[*values, *bent] for values in images] for images in self._mean_of(bring, dr.width(pixel), numbers)]

    def _combined(self, kernels: list[PixelKernels], values: Array, terms: Array, cosines: Array, number: int) -> Array:
        """Return the images made from all sets of values; see `_bring`."""
        parts, bent = values[..., :-2], values[..., -2:]
        *held, own = self.arrays.split(parts, self._sets, axis=-1)
        changed = (float(self._changes[name][i]) * own for name, i in self._of_kernels)
        given = self.arrays.concatenate([*held, *changed], axis=-1)
        images = super()._combined(kernels, given, terms, cosines, number)
        turned = self.arrays.einsum("atx,xa->tx", self._nodes[number].plan.oblique.slopes(cosines), bent.mean(1))
        images[: len(kernels[0].kernels)] += kernels[0].turned(own, turned)
        return images


class CameraAdjoint(_CameraSum):
    """Gradient of a function of a capture with respect to its camera's `PARAMETERS`."""

    def backward(self, gradient: Sequence[Array]) -> Values:
        """Return the gradient with respect to each parameter component, from gradients by channel (rows, columns)."""
        total = {name: np.zeros(len(value)) for name, value in parameters_of(self._camera).items()}
        for lot, felt in self._back(gradient):
            self._vjp(lot, felt, total)
        return {name: total[name] for name in self._names}

    def _by_direction(self, images: Array, number: int, lot: Lot, some: Any) -> list[list[Any]]:
        """Return the derivatives with respect to the direction of light of the gradients that `_felt` returns."""
        kernels, rows = self._kernels[number][lot.kind][0], self._rows(number, lot.kind)[0]
        own = images[rows, dr.gather(mi.UInt32, lot.some, some).numpy()]
        slopes = self._nodes[number].plan.oblique.slopes(self._cosines(lot, some))
        return [[drjit_array(mi.Float, part.T) for part in kernels.turned_adjoint(own, along)] for along in slopes]

    def _vjp(self, lot: Lot, felt: list[list[Array]], total: Values) -> None:
        """Add the gradients from the rays of a `Lot` of pixels to `total`; see `_back`."""
        drawn, own = self._drawn_rays(lot.pixels, lot.key)
        ((walk, _),), (lanes,) = self._groups, lot.lanes
        radiance = self._light(*self._asked(walk, drawn, own, lanes, lot.seed))
        radiance = [light * self._answer(drawn) for light in radiance]
        seen = dr.select(drawn.open, mi.Float(1), 0)
        require_finite(radiance, seen)
        known, lit = known_means(radiance, seen, dr.width(lot.some), self._together)
        lit = dr.compress(lit)
        if not dr.width(lit):
            return
        together = dr.opaque(mi.UInt32, self._together)
        drawn, own = self._drawn_rays(lot.pixels.take(lit), lot.key)
        _, direction, _ = walk.through_pupil(drawn.pupil, drawn.place, drawn.height)
        sample = dr.arange(mi.UInt32, dr.width(own)) - own * together
        even = (sample & 1) == 0
        points, cell = (drawn.point, drawn.inner, drawn.chance, drawn.open), self._cell_of(own, sample)
        own = dr.gather(mi.UInt32, lit, own)
        lights = [dr.gather(mi.Float, light, own * together + sample, drawn.open) for light in radiance]
        means = [
            dr.select(drawn.open, dr.select(even, *(dr.gather(mi.Float, half, own) for half in pair[::-1])), 0)
            for pair in known
        ]
        by_held, by_width, by_kernels = [mi.Float(0)] * 8, mi.Float(0), [mi.Float(0)] * len(self._of_kernels)
        for number, (node, table, width, totals) in enumerate(
            zip(self._nodes, self._coefficients, self._by_width, felt, strict=True)
        ):
            assert isinstance(table, RayCoefficients)  # others are refused
            values, (by_u, by_v), wider = table(*points), table.slopes(*points), width(*points)
            used, weights = node.mixture(lanes)
            if lanes is not None:
                weights = [[dr.gather(mi.Float, weight, own) for weight in row] for row in weights]
            for row, total_felt in zip(weights, totals, strict=True):
                mean = mixed(row, [means[i] for i in used])
                strength = (mixed(row, [lights[i] for i in used]) - mean) * drawn.weight
                strength = dr.select(drawn.open, strength, 0)
                weighted = [strength * value for value in values]
                weighted[0] += mean
                sets = [
                    [dr.gather(mi.Float, part, cell, drawn.open) for part in each]
                    for each in self._felt(total_felt, number, lot, lit)
                ]
                brought = [
                    *(strength * mixed(parts, sets[0]) for parts in (by_u, by_v)),
                    *(mixed(weighted, sets[each]) for each in (1, 2)),
                    strength * mixed(values, sets[0]),
                    mean * sets[0][0],
                    *(
                        mixed(weighted, [dr.gather(mi.Float, part, cell, drawn.open) for part in each])
                        for each in self._by_direction(total_felt, number, lot, lit)
                    ),
                ]
                by_held = [before + part for before, part in zip(by_held, brought, strict=True)]
                by_width += strength * mixed(wider, sets[0])
                by_kernels = [before + mixed(weighted, each) for before, each in zip(by_kernels, sets[3:], strict=True)]
        sums = [dr.sum(figure) for figure in (by_width, *by_kernels)]
        dr.eval(by_held, sums)
        rays = self._spp * self._passes
        of_width, *of_kernels = (float(figure[0]) / rays for figure in sums)
        for (name, part), figure in zip(self._of_kernels, of_kernels, strict=True):
            total[name][part] += figure
        total["mla_distance"] += of_width / self._camera.mla_distance
        total["mla_pitch"][0] -= of_width / self._camera.mla_pitch
        with dr.resume_grad():
            varying = varying_parameters(self._camera)
            dr.enable_grad([varying[name] for name in self._names])
            held = hold(self._camera, varying, drawn, direction, self._step)
            parts = *held.point, *held.cell, held.measure, held.density, *held.cosines
            dr.backward(dr.sum(mixed(by_held, parts)) / rays)
            gradients = {name: [dr.grad(value) for value in varying[name]] for name in self._names}
            # All in one kernel.
            dr.eval(gradients)
            for name, values in gradients.items():
                total[name] += [float(value[0]) for value in values]


def varying_parameters(camera: PlenopticCamera) -> dict[str, list[Any]]:
    """Return the components of all `PARAMETERS` as Dr.Jit arrays."""
    return {name: [dr.opaque(mi.Float, value) for value in values] for name, values in parameters_of(camera).items()}


def hold(camera: PlenopticCamera, varying: Mapping[str, list[Any]], drawn: Drawn, direction: Pair, step: float) -> Held:
    """Return a camera's drawn rays, with fixed slopes in the scene, traced through a camera of varying `PARAMETERS`.

    `step` is the width in mm of a cell of the detector's grid.
    """
    ((f1,), (b,), (z,), (width,)) = (
        varying[name] for name in ("focal_length", "mla_distance", "detector_distance", "detector_width")
    )
    pitch = varying["mla_pitch"][0] / camera.mla_pitches[0]
    kinds = LensKinds(camera)
    larger = mi.Float(1)
    for index, kind in enumerate(kinds.every):
        focal = varying["mla_focal_length"][kind.lens_type]
        own = focal * (kind.focal_length / camera.mla_focal_lengths[kind.lens_type])
        larger = dr.select(drawn.kind == index, kinds.enlargement(own, b, pitch), larger)
    # Back through the lens: a lens of the opposite focal length undoes the refraction.
    is_ideal = camera.lens_model == "ideal"
    turned = direction if is_ideal else rays.slopes_to_cosines(*direction)
    before = [rays.main_lens_slope(s, P, -f1) for s, P in zip(turned, drawn.pupil, strict=True)]
    slope = before if is_ideal else rays.cosines_to_slopes(*before)
    centres = tuple(
        offset + (q - m - held) * pitch
        for m, q, offset, held in zip(drawn.point, drawn.place, varying["mla_offset"], camera.mla_offset, strict=True)
    )
    aside = [
        (rays.pupil_point(P, t, -b) - centre) / pitch for P, t, centre in zip(drawn.pupil, slope, centres, strict=True)
    ]
    behind = tuple((centre - P) / b for P, centre in zip(drawn.pupil, centres, strict=True))
    cosines = rays.slopes_to_cosines(*camera.lattice.to_frame(*behind))
    if camera.mla_medium != 1:
        behind = rays.refracted(behind, 1 / camera.mla_medium)
    cell = step * width / camera.detector_width
    landed = [(centre + t * (larger * z)) / cell for t, centre in zip(behind, centres, strict=True)]
    u, v = camera.lattice.to_frame(*aside)
    # An ideal lens keeps ranges of slopes, a parabolic phase those of direction cosines.
    square = 0.0 if is_ideal else slope[0] * slope[0] + slope[1] * slope[1]
    grid = 2 * dr.log(width)
    return Held(
        (u, v),
        (landed[0], landed[1]),
        2 * dr.log(z) + 2 * dr.log(mi.Float(1) + square) - 2 * dr.log(pitch) - grid,
        2 * dr.log(z / b) - grid,
        cosines,
    )


def width_change(camera: PlenopticCamera, changes: Values) -> float:
    """Return the relative change of the ratio of the pupil's diffraction width to the pitch."""
    parts = (
        sign * float(changes[name][0]) / value
        for name, sign, value in (("mla_distance", 1, camera.mla_distance), ("mla_pitch", -1, camera.mla_pitch))
        if name in changes
    )
    return sum(parts)
