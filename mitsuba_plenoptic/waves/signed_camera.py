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

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import Captures, PlenopticCamera, Use, Values, require_support, shortest_parts, with_gradient
from ..errors import InputError, refuse_if
from ..fields import LensKinds
from ..optics import rays
from ..rays import Walk
from ..runtime import Array, Doubles, Pair, drjit_array
from .array_kernels import displaced
from .expansion import OF_KERNELS, ExpandedPlan, width_slopes
from .phase_space import PhaseSpace, RayCoefficients
from .pixel_kernels import PixelKernels
from .ray_sampler import RaySamples
from .scheme import Plan
from .signed_rays import CellMeans, SignedRaySum
from .spectral_nodes import mixed

PARAMETERS = with_gradient(Captures.SCENES)
"""Camera parameters with respect to which signed-ray captures have derivatives."""


class FixedRays(NamedTuple):
    """Rays fixed in the scene, as they pass a changed camera."""

    point: Pair  # on the array, from the lens's centre, in the lattice's frame, in which lengths grow with the pitch
    cell: Pair  # on the detector, in cells of the grid from the axis
    measure: Any  # logarithm of the weight of a ray
    density: Any  # logarithm of the density on the detector of rays whose directions fill the lens
    width: Any  # logarithm of the ratio of the pupil's diffraction width to the pitch
    cosines: Pair  # of the light that passes the lens's centre, in the lattice's frame


def parameters_of(camera: PlenopticCamera) -> Values:
    """Return the values of all `PARAMETERS`, each as an array of components."""
    return {name: shortest_parts(camera, name) for name in PARAMETERS}


def require_parameters(camera: PlenopticCamera, names: Iterable[str], lands_by_point: bool) -> None:
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
            lands_by_point,
            f"{name}: captures by signed rays have derivatives by it near the microlenses' focus alone, and "
            f"detector_distance = {camera.detector_distance:g} is far from it",
        )


class CameraSum(SignedRaySum):
    """The change of a capture with the camera's `PARAMETERS`, as it follows from the changes of each ray.

    Subclasses say what a change is: a number, along given changes of the parameters, or a zero with the gradient of a
    parameter.
    """

    _sets = 4
    """Values for the kernels themselves, displaced along x and along y, and for all of their changes."""

    def __init__(self, *arguments: Any, names: Iterable[str], **options: Any):
        self._names = tuple(names)
        super().__init__(*arguments, **options)
        self._by_width = [RayCoefficients(node.plan, width_slopes(node.plan.start)) for node in self._nodes]
        with dr.resume_grad():
            self._varying = self._varied()

    def _varied(self) -> dict[str, list]:
        """Return the camera's `PARAMETERS` with gradients enabled for those by which the capture is differentiated."""
        varying = varying_parameters(self._camera)
        dr.enable_grad([varying[name] for name in self._names])
        return varying

    def _change(self, value: Any) -> Any:
        """Return the change of a value that depends on the varying parameters."""
        raise NotImplementedError

    @cached_property
    def _of_kernels(self) -> list[tuple[str, int]]:
        """The parameter components on which kernels depend."""
        start = parameters_of(self._camera)
        return [(name, i) for name in self._names if name in OF_KERNELS for i in range(len(start[name]))]

    def _further_kernels(self, plan: Plan, kind: int) -> list[Doubles]:
        assert isinstance(plan, PhaseSpace)
        kernels = plan.kernels(self._step, plan.reach, kind)
        # One set for each component, so that forward and reverse approximate the same kernels.
        expanded = plan if isinstance(plan, ExpandedPlan) else ExpandedPlan.about(plan, plan.camera)
        slopes = {name: expanded.kernel_slopes(name, self._step, kind) for name, _ in self._of_kernels}
        return [*displaced(kernels), *(slopes[name][i] for name, i in self._of_kernels)]

    def _arguments(self, samples: RaySamples, walk: Walk, node_index: int) -> list:
        """Return the arguments of the coefficients of rays, and the rays' changes."""
        _, slope, _ = walk.through_pupil(samples.ray.P, samples.ray.m, samples.lens.height)
        with dr.resume_grad():
            fixed = follow_fixed(self._camera, self._varying, samples, slope, self._step)
            # Each of them for each ray, whose gradients are thus summed exactly.
            quantities = *fixed.point, *fixed.cell, fixed.measure, fixed.density, fixed.width, *fixed.cosines
            changes = [self._change(value) + dr.zeros(mi.Float, dr.width(samples.number)) for value in quantities]
        return [*samples.lens_point, *samples.round_pupil, *samples.chance, samples.ray.valid, *changes]

    def _values(self, node_index: int, arguments: list) -> list[tuple[list, Any]]:
        """Return the changes of a ray's coefficients, these times its displacements on the detector, and themselves."""
        x, y, X, Y, *chance = arguments[:8]
        valid, du, dv, dx, dy, measure, density, width = arguments[8:16]
        ray = ((x, y), (X, Y), tuple(chance), valid)
        table = self._coefficients[node_index]
        assert isinstance(table, RayCoefficients)  # others are refused
        values = table(*ray)
        by_u, by_v = table.slopes(*ray)
        by_width = self._by_width[node_index](*ray)
        change = [
            a * measure + u * du + v * dv + q * width for a, u, v, q in zip(values, by_u, by_v, by_width, strict=True)
        ]
        return [(change, density), ([a * dx for a in values], dx), ([a * dy for a in values], dy), (values, None)]

    def _cell_means(self, pixels: Any, of_rays: list, *light: Any) -> list[list]:
        """Return the mean values, and the changes of the direction cosines of the cells' light."""
        _, first, _ = self._cells_of(pixels)
        # All rays of a cell and a lens have nearly the same direction.
        bent = [dr.gather(mi.Float, change, first) for change in of_rays[-2:]]
        images = super()._cell_means(pixels, of_rays, *light)
        return [[[*values, *bent] for values in of_node] for of_node in images]


class CameraTangents(CameraSum):
    """Directional derivative of a capture along changes of the camera's `PARAMETERS`."""

    def __init__(self, *arguments: Any, changes: Values, **options: Any):
        self._changes = changes
        super().__init__(*arguments, names=changes, **options)

    def _varied(self) -> dict[str, list]:
        varying = super()._varied()
        for name, components in self._changes.items():
            for value, component in zip(varying[name], components, strict=True):
                dr.set_grad(value, component)
        return varying

    def _change(self, value: Any) -> Any:
        change = dr.forward_to(value, flags=dr.ADFlag.ClearInterior) if dr.grad_enabled(value) else mi.Float(0)
        return dr.detach(change)

    def _combined(
        self, kernels: list[PixelKernels], values: Array, terms: Array, cosines: Array, node_index: int
    ) -> Array:
        """Return the images made from all sets of values; see `_values`."""
        sets = values[..., :-2]
        bent = values[..., -2:]
        *others, coefficients = self.arrays.split(sets, self._sets, axis=-1)
        changed = (float(self._changes[name][i]) * coefficients for name, i in self._of_kernels)
        sets = self.arrays.concatenate([*others, *changed], axis=-1)
        images = super()._combined(kernels, sets, terms, cosines, node_index)
        turned = self.arrays.einsum("atx,xa->tx", self._nodes[node_index].plan.oblique.slopes(cosines), bent.mean(1))
        images[: len(kernels[0].kernels)] += kernels[0].turned(coefficients, turned)
        return images


class CameraAdjoint(CameraSum):
    """Gradient of a function of a capture with respect to its camera's `PARAMETERS`."""

    def backward(self, gradient: Sequence[Array]) -> Values:
        """Return the gradient with respect to each parameter component, from gradients by channel (rows, columns)."""
        for _ in self.propagate(gradient):
            pass
        with dr.resume_grad():
            gradients = {name: [dr.grad(value) for value in self._varying[name]] for name in self._names}
        return {name: np.array([float(value[0]) for value in values]) for name, values in gradients.items()}

    def _change(self, value: Any) -> Any:
        return value - dr.detach(value)

    def _product(self, images: Array, values: list, node_index: int, kind: int, node: CellMeans) -> Any:
        """Return the product of adjoint images with those of `CameraTangents._combined`, with gradients."""
        oblique = self._nodes[node_index].plan.oblique
        cosines = np.array([cosine.numpy() for cosine in node.cosines])
        terms = oblique.terms(cosines)
        kernels = self._kernels[node_index][kind]
        rows = self._rows[node_index][kind]
        dr.eval(values)
        count = (len(values) - 2) // self._sets
        coefficients = np.stack([dr.detach(value).numpy() for value in values[-2 - count : -2]], axis=-1)
        coefficients = coefficients.reshape(len(cosines.T), self._parts**2, count)
        adjoint = [of_set.adjoint(images[of_rows], terms) for of_set, of_rows in zip(kernels, rows, strict=True)]
        bent = [
            np.einsum("xpn,xpn->x", coefficients, kernels[0].turned_adjoint(images[rows[0]], slopes))
            for slopes in oblique.slopes(cosines)
        ]
        # The changes of direction are means over the cells of a pixel.
        of_bent = np.repeat(np.stack(bent, axis=-1)[:, None] / self._parts**2, self._parts**2, axis=1)
        of_values = np.concatenate([*adjoint[:3], 0 * coefficients, of_bent], axis=-1)
        columns = of_values.reshape(-1, len(values)).T
        total = dr.sum(mixed([drjit_array(mi.Float, column) for column in columns], values))
        for (name, i), of_kernel in zip(self._of_kernels, adjoint[3:], strict=True):
            # Opaque, so that other values do not compile the kernels again.
            product = dr.opaque(mi.Float, float(np.vdot(coefficients, of_kernel)))
            total += self._change(self._varying[name][i]) * product
        return total


def varying_parameters(camera: PlenopticCamera) -> dict[str, list]:
    """Return the components of all `PARAMETERS` as Dr.Jit arrays."""
    return {name: [dr.opaque(mi.Float, value) for value in values] for name, values in parameters_of(camera).items()}


def follow_fixed(
    camera: PlenopticCamera, varying: Mapping[str, list], samples: RaySamples, slope: Pair, step: float
) -> FixedRays:
    """Return rays of a camera, whose slopes in the scene are fixed, in a camera of varying `PARAMETERS`.

    `step` is the width in mm of a cell of the detector's grid.
    """
    ((f1,), (b,), (z,), (width,)) = (
        varying[name] for name in ("focal_length", "mla_distance", "detector_distance", "detector_width")
    )
    pitch = varying["mla_pitch"][0] / camera.mla_pitches[0]
    ray = samples.ray
    kinds = LensKinds(camera)
    larger = mi.Float(1)
    for index, kind in enumerate(kinds.every):
        focal = varying["mla_focal_length"][kind.lens_type]
        of_kind = focal * (kind.focal_length / camera.mla_focal_lengths[kind.lens_type])
        larger = dr.select(samples.lens.kind == index, kinds.enlargement(of_kind, b, pitch), larger)
    # Back through the lens: a lens of the opposite focal length undoes the refraction.
    is_ideal = camera.lens_model == "ideal"
    turned = slope if is_ideal else rays.slopes_to_cosines(*slope)
    unturned = [rays.main_lens_slope(s, P, -f1) for s, P in zip(turned, ray.P, strict=True)]
    before = unturned if is_ideal else rays.cosines_to_slopes(*unturned)
    centres = tuple(
        offset + (q - m - start) * pitch
        for m, q, offset, start in zip(samples.lens_point, ray.m, varying["mla_offset"], camera.mla_offset, strict=True)
    )
    aside = [(rays.pupil_point(P, t, -b) - centre) / pitch for P, t, centre in zip(ray.P, before, centres, strict=True)]
    behind = tuple((centre - P) / b for P, centre in zip(ray.P, centres, strict=True))
    cosines = rays.slopes_to_cosines(*camera.lattice.to_frame(*behind))
    if camera.mla_medium != 1:
        behind = rays.refracted(behind, 1 / camera.mla_medium)
    cell = step * width / camera.detector_width
    landed = [(centre + t * (larger * z)) / cell for t, centre in zip(behind, centres, strict=True)]
    u, v = camera.lattice.to_frame(*aside)
    # An ideal lens keeps ranges of slopes, a parabolic phase those of direction cosines.
    square = 0.0 if is_ideal else before[0] * before[0] + before[1] * before[1]
    grid = 2 * dr.log(width)
    return FixedRays(
        (u, v),
        (landed[0], landed[1]),
        2 * dr.log(z) + 2 * dr.log(mi.Float(1) + square) - 2 * dr.log(pitch) - grid,
        2 * dr.log(z / b) - grid,
        dr.log(b / pitch),
        cosines,
    )
