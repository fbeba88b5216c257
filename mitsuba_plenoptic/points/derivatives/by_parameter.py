"""The camera parameters with respect to which captures are differentiated, as Dr.Jit arrays with gradients."""

from collections.abc import Iterable
from functools import cache, partial
from typing import Any, cast

import drjit as dr
import numpy as np

from ...array import make_lattice
from ...camera import Captures, PlenopticCamera, change_of, parts_of, size_of, with_gradient
from ...errors import WAVEFRONT_UNIT, InputError, did_you_mean, require_number, short_repr
from ...fields import OpticalSystem, VaryingArrayFactor
from ...lenses import LENS_NUMBERS, FittedLens, Wavefront, open_area_slopes, zernike
from ...optics import in_millimetres
from ...runtime import Doubles, active_backend, array_module, drjit_array, is_zero, turn
from ..field_grid import Grid
from ..patch_factors import Elements
from ..units import brightness, detector_brightness


def varying_path(coefficients: Any, radius: float, x: Any, y: Any) -> Any:
    """Return the path that changes of coefficients add at points of the pupil: zero, but with gradients."""
    return dr.custom(_VaryingPath, coefficients, radius, dr.detach(x), dr.detach(y))


class _VaryingPath(dr.CustomOp):
    """A sum of Zernike polynomials whose coefficients are zero, but carry changes."""

    def eval(self, coefficients: Any, radius: float, x: Any, y: Any) -> Any:
        self._count = len(coefficients)
        self._radius = radius
        self._points = (x, y)
        return dr.zeros(type(x), dr.width(x))

    def forward(self) -> None:
        changes = np.asarray(self.grad_in("coefficients").numpy(), np.float64)
        kind = type(self._points[0])
        some = [dr.opaque(kind, change) for change in changes[: np.flatnonzero(changes).max(initial=-1) + 1].tolist()]
        self.set_grad_out(Wavefront(some, self._radius).path(*self._points) + dr.zeros(kind, dr.width(self._points[0])))

    def backward(self) -> None:
        libraries = active_backend()
        gradient, x, y = map(libraries.from_drjit, (self.grad_out(), *self._points))
        # The sums over the samples of each polynomial times the gradient of the path, from the sums of powers.
        polynomials = [zernike(j) for j in range(1, self._count + 1)]
        size = max(len(polynomial) for polynomial in polynomials)
        moments = libraries.arrays.zeros((size, size))
        # Samples for which powers are computed together, on a device and in a core's cache.
        step = 2**22 if libraries.is_cuda else 2**14
        for first in range(0, len(gradient), step):
            block = slice(first, first + step)
            across, up = (
                libraries.arrays.vander(values[block] / self._radius, size, increasing=True).T for values in (x, y)
            )
            moments += (across * gradient[block]) @ up.T
        moments = libraries.to_host(moments)
        unit = in_millimetres(WAVEFRONT_UNIT)
        gradient_of = np.array([unit * float((moments[: len(some), : len(some)] * some).sum()) for some in polynomials])
        self.set_grad_in("coefficients", drjit_array(type(self.grad_in("coefficients")), gradient_of))

    def name(self) -> str:
        return "aberrations"


WAVELENGTH = "wavelength"
"""By it captures can be differentiated like by the parameters of the camera."""

DIFFERENTIABLE = (*with_gradient(Captures.POINTS), WAVELENGTH)
"""Parameters of a camera, and the wavelength, by which captures can be differentiated."""

MOVES = ("detector_width", "mla_rotation", "wavelength")
"""Those that move the pixels against the samples of the light."""


def values_of(camera: PlenopticCamera, wavelength: float, name: str) -> Doubles:
    """Return the present components of a parameter: two pitches, each focal length, 36 aberrations or more."""
    if name == WAVELENGTH:
        return np.array([wavelength])
    parts = parts_of(camera, name)
    return np.pad(parts, (0, size_of(camera, name) - len(parts)))


def check_names(camera: PlenopticCamera, names: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names of a camera's differentiable parameters, all of them for None; refuse other names."""
    of_camera = [name for name in DIFFERENTIABLE if len(values_of(camera, 1.0, name))]
    names = of_camera if names is None else (names,) if isinstance(names, str) else tuple(names)
    for name in names:
        if name not in DIFFERENTIABLE:
            raise InputError(
                f"{short_repr(name)}: it is none of the parameters with a derivative: {', '.join(DIFFERENTIABLE)}"
                f"{did_you_mean(name, DIFFERENTIABLE)}"
            )
        if name not in of_camera:
            camera.require_array(name)
    return tuple(names)


def check_changes(camera: PlenopticCamera, changes: Any) -> dict[str, Doubles]:
    """Return changes of parameters by name, with all components as in `values_of`; refuse other parameters."""
    if not isinstance(changes, dict):
        raise InputError(f"changes = {short_repr(changes)}: they must be numbers by name")
    check_names(camera, changes)
    checked = {}
    for name, change in changes.items():
        size = len(values_of(camera, 1.0, name))
        parts = np.array(
            [require_number(name, component) for component in np.ravel(np.asarray(change, object)).tolist()]
        )
        checked[name] = parts if name == WAVELENGTH else change_of(camera, name, parts)
        if len(checked[name]) != size:
            raise InputError(f"{name} = {short_repr(change)}: its change must be {size} number{'s' * (size > 1)}")
    return checked


def light_slopes(system: OpticalSystem, names: Iterable[str], points: Doubles) -> dict[str, Doubles]:
    """Return the derivatives of the logarithm of `units.brightness_at` with respect to each parameter.

    The arrays are (components, points).
    """
    parameters = VaryingParameters(system.camera, 1.0, names)
    # As if the pupil scaled with the aperture, which it does not in a real main lens.
    value = dr.log(parameters.brightness(system.camera))
    if dr.grad_enabled(value):
        dr.backward(value)
    by_name = {name: np.tile(slope[:, None], len(points)) for name, slope in parameters.gradients().items()}
    lens = system.waves_of(points)
    if lens.is_uniform:
        return by_name
    changed = [name for name in by_name if name in LENS_NUMBERS]
    return by_name | {name: open_area_slopes(cast(FittedLens, lens), name, points)[None] for name in changed}


class VaryingParameters:
    """A camera's parameters and the wavelength as Dr.Jit arrays; the parameters in `names` carry gradients."""

    def __init__(self, camera: PlenopticCamera, wavelength: float, names: Iterable[str]):
        self.types = array_module().ad
        self._parameters = {}
        self._varies = set(names)
        for name in DIFFERENTIABLE:
            fixed = name not in self._varies and name != WAVELENGTH
            values = parts_of(camera, name) if fixed else values_of(camera, wavelength, name)
            self._parameters[name] = [dr.opaque(self.types.Float64, value) for value in values.tolist()]
            if name in self._varies:
                dr.enable_grad(self._parameters[name])

    def elements(self, grid: Grid, lanes: int) -> Elements:
        """Return the elements of the camera in the frame of a grid, with gradients.

        Each varying parameter is repeated in several lanes, so that one kernel scatters the gradients of all of them.
        Single values would need one kernel each, which would recompute everything.
        """
        first = dr.zeros(self.types.UInt32, lanes)
        get = {
            name: [dr.gather(self.types.Float64, component, first) for component in parts]
            if name in self._varies and name != "wavefront"
            else parts
            for name, parts in self._parameters.items()
        }
        (wavelength,), distance = get["wavelength"], *(get["detector_distance"] or [0.0])
        angle = get["mla_rotation"][0] if "mla_rotation" in self._varies else grid.rotation
        # The array stays where it is in the frame of the grid, and the scene turns.
        turned = angle - dr.opaque(self.types.Float64, grid.rotation) if "mla_rotation" in self._varies else 0.0

        def lens() -> Any:
            constant = [dr.detach(coefficient) for coefficient in get["wavefront"][: len(grid.camera.wavefront)]]
            values = {name: get[name][0] for name in ("focal_length", "aperture_radius", "mla_distance", "wavelength")}
            return grid.lens.varying(values | {"wavefront": constant}, self._varies, turned)

        def array(cosine: float) -> list[VaryingArrayFactor]:
            if not grid.microlenses.axes:
                return []
            x, y = get["mla_offset"]
            if not is_zero(angle):
                x, y = turn(x, y, -angle if dr.is_array_v(angle) else dr.opaque(self.types.Float64, -angle))
            lattice = self._lattice(get, grid.camera, (x, y))
            factors = grid.microlenses.factors(cosine)
            lengths = [length / grid.camera.mla_medium for length in get["mla_focal_length"]]
            return [VaryingArrayFactor(factor, lattice, lengths, wavelength) for factor in factors]

        growth = wavelength / grid.wavelength if "wavelength" in self._varies else 1.0
        aberration = None
        if "wavefront" in self._varies:
            aberration = partial(varying_path, dr.concat(self._parameters["wavefront"]), grid.camera.pupil_radius)
        return Elements(cache(lens), cache(array), wavelength, distance, turned, growth, aberration)

    def brightness(self, camera: PlenopticCamera) -> Any:
        """Return `units.brightness` as a function of these parameters."""
        get = self._parameters
        pixel = get["detector_width"][0] / camera.resolution[0]
        if not get["detector_distance"]:
            return detector_brightness(get["mla_distance"][0], pixel)
        lattice = self._lattice(get, camera, (0.0, 0.0))
        return brightness(lattice, get["aperture_radius"][0], get["detector_distance"][0] / camera.mla_medium, pixel)

    def _lattice(self, get: dict[str, list], camera: PlenopticCamera, offset: Any) -> Any:
        """Return the upright lattice with an offset."""
        pitches = tuple(get["mla_pitch"])
        fill = get["mla_fill"][0]
        return make_lattice(camera.mla_lattice, pitches, offset=offset, aperture=camera.mla_aperture, fill=fill)

    def set_tangents(self, changes: dict[str, Doubles]) -> None:
        """Set the direction in which the parameters change."""
        for name, change in changes.items():
            for value, tangent in zip(self._parameters[name], change.tolist(), strict=True):
                dr.set_grad(value, tangent)

    def gradients(self) -> dict[str, Doubles]:
        """Return the gradients accumulated so far, by parameter."""
        return {
            name: np.array([float(dr.grad(value)[0]) for value in self._parameters[name]])
            for name in sorted(self._varies)
        }
