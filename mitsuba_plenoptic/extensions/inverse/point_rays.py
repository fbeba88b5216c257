"""The parameters that a fit varies, and the expected captures of known light by a camera, by the wave or ray model."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np

from ...array import make_lattice
from ...camera import CameraVector, PlenopticCamera, Use, require_support
from ...errors import refuse_if, short_repr
from ...fields import OpticalSystem
from ...lenses import MainLens, convergence
from ...points import CaptureOperator, PupilWeights, brightness_at, check_positions, derivatives
from ...rays import Passage, Walk
from ...runtime import Doubles, Pair, array_module, check_memory, drjit_array, one_at_a_time
from .fit_light import View


def vector_of(camera: PlenopticCamera, names: Iterable[str] | str) -> CameraVector:
    """Return the vector of the fitted parameters; the piston of aberrations is left out.

    A name is a parameter's name, or the label of one of its components, as ``wavefront.5``. Parameters that have no
    derivative, or do not apply to the camera, are refused.
    """
    given = (names,) if isinstance(names, str) else tuple(names)
    wholes = {name: str(name).partition(".")[0] for name in given}
    chosen = derivatives.check_names(camera, dict.fromkeys(wholes.values()))
    refuse_if(
        derivatives.WAVELENGTH in chosen, "wavelength: it is no parameter of a camera; give it, and fit the others"
    )
    refuse_if(not chosen, f"names = {short_repr(given)}: name at least one of {', '.join(derivatives.DIFFERENTIABLE)}")
    vector = CameraVector.by_names(camera, chosen)
    for name, whole in wholes.items():
        known = [each.label for each in vector.components if each.name == whole]
        refuse_if(name not in (whole, *known), f"{short_repr(name)}: the camera has {', '.join(known)}")
    return vector.keep(each.label for each in vector.components if each.name in wholes or each.label in wholes)


class WaveModel:
    """Expected captures of views by a camera in the wave model."""

    def __init__(
        self,
        camera: PlenopticCamera,
        views: list[View],
        wavelength: float,
        # Tolerance as in `CaptureOperator`.
        accuracy: float,
    ):
        self._camera = camera
        self._views = views
        self._system = OpticalSystem(camera.at_wavelength(wavelength), wavelength)
        self._operators = [
            CaptureOperator(
                camera,
                view.points,
                wavelength=wavelength,
                accuracy=accuracy,
                pupil_weights=view.pupil_weights,
                virtual=view.virtual,
                system=self._system,
            )
            for view in views
        ]
        pairs = zip(self._operators, views, strict=True)
        self._weights = [operator.powers(view.weights) for operator, view in pairs]

    def images(self) -> Doubles:
        """Return the expected pixels of all views, (views, rows, columns)."""
        pairs = zip(self._operators, self._weights, strict=True)
        return np.stack([operator.forward(weights) for operator, weights in pairs]).astype(np.float64)

    def derivatives(self, vector: CameraVector, images: Doubles) -> Doubles:
        """Return the derivatives of `images` with respect to the vector, (parameters, views, rows, columns)."""
        directions = vector.of(self._camera).directions()
        rows = []
        for view, operator, weights, image in zip(self._views, self._operators, self._weights, images, strict=True):
            slopes = derivatives.light_slopes(self._system, vector.names, view.points)
            growth = [change @ slopes[name] for direction in directions for name, change in direction.items()]
            grown = [
                # If the weights of all points grow equally, the image is scaled; otherwise it is computed anew.
                each[0] * image if (each == each[0]).all() else operator.forward(each * weights)
                for each in growth
            ]
            rows.append(operator.jacobian(weights, directions) + np.stack(grown))
        return np.stack(rows, 1).astype(np.float64)


_STEPS_OF_COUNTS = 2
"""Steps, to each doubling, of how many rays lie across the pupil: few kernels are compiled."""


class PointRays:
    """Rays of points, whose counts are planned for one camera and used for all similar cameras."""

    def __init__(
        self,
        camera: PlenopticCamera,
        # Incoherent points (x, y, z) in the camera frame, in millimetres, an array (n, 3).
        points: Doubles,
        # Wavelength in nanometres, on which rays through real main lenses depend.
        wavelength: float,
        # Relative power over the pupil.
        pupil_weights: PupilWeights | None = None,
    ):
        require_support(camera, Use.POINT_RAYS)
        points = check_positions(points, camera, virtual=True)
        self._points = points
        self._pupil_weights = pupil_weights
        lens = OpticalSystem(camera, wavelength).waves_of(points)
        on_array, on_detector = (2 * float(lens.pupil.radius) * abs(scale) for scale in _scales(camera, lens, points))
        pixels = on_detector / camera.pixel_size
        lenses = on_array / min(camera.mla_pitches)
        # 4 rays across a pixel, or 96 across a micro-image that is so large that one ray a pixel shows its edge well
        # enough; 12 across a microlens, and 16 across the pupil at least.
        sharp = np.clip(4.0 * pixels, 16.0, np.maximum(96.0, pixels))
        steps = np.ceil(_STEPS_OF_COUNTS * np.log2(np.maximum(sharp, 12.0 * lenses)))
        self._across = np.ceil(2 ** (steps / _STEPS_OF_COUNTS)).astype(int)
        most = int(self._across.max(initial=0))
        # Of 100 bytes each.
        check_memory(100 * float(most) ** 2, f"points by {most} x {most} rays")

    @one_at_a_time
    def image(self, system: OpticalSystem, weights: Doubles) -> Doubles:
        """Return the image (rows, columns) of weighted points, from the fraction of each point's light in each pixel.

        Shapes: `weights` (n,).
        """
        camera = system.camera
        lens = system.waves_of(self._points)
        image = dr.zeros(array_module().Float64, math.prod(camera.shape))
        for across in np.unique(self._across).tolist():
            which = np.flatnonzero(self._across == across)
            # Rays that are followed at once, unless a point has more.
            together = max(1, 2**22 // across**2)
            for first in range(0, len(which), together):
                some = which[first : first + together]
                own = None if self._pupil_weights is None else self._pupil_weights.take(some)
                _Bundles(camera, lens, self._points[some], across, own).add(image, weights[some])
                dr.eval(image)
        return image.numpy().reshape(camera.shape)


def _scales(camera: PlenopticCamera, lens: MainLens, points: Doubles) -> Pair:
    """Return the displacements of rays, on the array and on the detector, per displacement on the pupil."""
    b = float(lens.pupil.distance)
    z = camera.reduced_distance
    on_array = 1 - b * np.array([float(convergence(lens, g)) for g in points[:, 2]])
    bends = [1 + z / b - z / f2 for f2 in camera.reduced_focal_lengths]
    return on_array, np.max([abs(on_array * bend - z / b) for bend in bends], axis=0)


@dataclass(frozen=True)
class _Bundles:
    """Bundles of rays from a few points through an even grid of the pupil to the detector."""

    camera: PlenopticCamera
    lens: MainLens
    # The points (x, y, z), an array (n, 3).
    points: Doubles
    across: int
    # Relative power over the pupil.
    weights: PupilWeights | None

    def add(self, image: Any, factors: Doubles) -> None:
        """Add the weighted light of the rays to the pixels, in a flat image."""
        types = array_module()
        side = self.across
        Float64 = types.Float64
        index = dr.arange(types.UInt32, len(self.points) * side * side)
        which = index // (side * side)
        within = index - which * (side * side)

        def value(numbers: Doubles) -> Any:
            return dr.gather(Float64, drjit_array(Float64, numbers), which)

        # One pixel beyond the edge on either side.
        radius = self._number(self.lens.pupil.radius)
        step = radius * (2 / (side - 2))
        pupil = tuple((Float64(part) + (0.5 - side / 2)) * step for part in (within % side, within // side))
        light = self._walk.lens.bind(self.points, which)
        point = tuple(value(part) for part in self.points.T)
        power = light.amplitude(pupil, point) ** 2 * dr.clip(light.inside(pupil) / step + 0.5, 0, 1)
        if self.weights is not None:
            power *= Float64(self.weights.at(which, pupil[0], pupil[1], radius, step)[0])
        whole = dr.block_sum(power, side * side)
        power *= dr.gather(Float64, drjit_array(Float64, factors) / dr.select(whole > 0, whole, 1), which)
        position = light.land(pupil, point)
        on_array, on_detector = (value(abs(scale)) * step for scale in _scales(self.camera, self.lens, self.points))
        for (i, j), fraction in self._lenses(position, on_array):
            landed, weight = self._walk.onto_detector(pupil, Passage(position, self._walk.lenslet(i, j)))
            # In a medium squares are smaller than by the reduced distance.
            self._detect(image, landed, on_detector * weight**-0.25, power * fraction)

    @staticmethod
    def _number(value: Any) -> Any:
        """Return a value that Dr.Jit does not build into kernels, so that compiled kernels serve other values."""
        return dr.opaque(array_module().Float64, float(value))

    @cached_property
    def _walk(self) -> Walk:
        """The walk of rays through camera elements with opaque values."""
        camera = self.camera
        number = self._number
        lattice = make_lattice(
            camera.mla_lattice,
            tuple(map(number, camera.mla_pitches)),
            rotation=number(camera.mla_rotation),
            offset=tuple(map(number, camera.mla_offset)),
        )
        lengths = drjit_array(array_module().Float64, np.array(camera.mla_focal_lengths))
        dr.make_opaque(lengths)
        medium = camera.mla_medium if camera.mla_medium == 1 else number(camera.mla_medium)
        return Walk(camera, self.lens.opaque(number), lattice, lengths, number(camera.detector_distance), medium)

    def _lenses(self, position: Pair, width: Any) -> list[tuple[Pair, Any]]:
        """Return the lenses that rays hit, and the fraction of each ray's light that each of them receives."""
        lattice = self._walk.lattice
        plain = self.camera.lattice
        cell = lattice.cell(*position)
        u, v = lattice.to_frame(position[0] - lattice.offset[0], position[1] - lattice.offset[1])
        u = u / lattice.pitches[0]
        v = v / lattice.row_distance
        # Least width, in pitches, over which borders of lenses fade: in focus all rays meet in one point.
        fade = dr.maximum(width / dr.minimum(*lattice.pitches), 1e-3)

        def away(i: Any, j: Any) -> Pair:
            cu, cv = lattice.unit_centre(i, j)
            return u - cu, (v - cv) * lattice.row_ratio

        x, y = away(*cell)
        found = []
        # Distance from a cell, in pitches, of the centres of all lenses that it touches.
        for step in plain.neighbours(0.75 * max(plain.pitches)).tolist():
            lens = cell[0] + step[0], cell[1] + step[1]
            dx, dy = away(*lens)
            across, up = np.subtract(lattice.unit_centre(*step), lattice.unit_centre(0, 0))
            apart = max(math.hypot(across, up * lattice.row_ratio), 1e-9)
            # Cells are what is nearest to their centres: this is twice the distance from the border of two.
            beyond = (dx * dx + dy * dy - x * x - y * y) / apart
            found.append((lens, dr.maximum(1 - beyond / fade, 0)))
        whole = sum((fraction for _, fraction in found), 0.0)
        return [(lens, fraction / whole) for lens, fraction in found]

    def _detect(self, image: Any, position: Pair, width: Any, power: Any) -> None:
        """Add squares of light around positions on the detector to the pixels that they cover."""
        camera = self.camera
        rows, columns = camera.shape
        size = self._number(camera.pixel_size)
        half = dr.minimum(dr.maximum(width / size, 1e-3), 1) / 2
        sides = []
        for axis, q in enumerate(position):
            pixel = q / size + (camera.resolution[axis] / 2 - camera.crop_offset[axis])
            first = dr.floor(pixel - half)
            # The fraction of the square beyond the border of the two pixels.
            beyond = dr.clip((pixel + half - first - 1) / (2 * half), 0, 1)
            sides.append([(first, 1 - beyond), (first + 1, beyond)])
        for (column, across), (row, down) in itertools.product(*sides):
            lit = power * across * down
            seen = (column >= 0) & (column < columns) & (row >= 0) & (row < rows) & (lit > 0)
            dr.scatter_reduce(dr.ReduceOp.Add, image, lit, array_module().UInt32(row * columns + column), seen)


def check_numbers(vector: CameraVector) -> None:
    """Refuse parameters on which the rays of points do not depend."""
    refuse_if("mla_fill" in vector.names, "mla_fill: rays from points know no gaps between lenses; use the wave model")


class RayModels:
    """Ray models of cameras near one camera, for which the counts of rays are planned."""

    def __init__(self, camera: PlenopticCamera, views: Sequence[View], wavelength: float):
        self._views = views
        self._wavelength = wavelength
        self._rays = [
            PointRays(camera, view.points, wavelength, PupilWeights.of(view.pupil_weights, len(view.points)))
            for view in views
        ]

    def at(self, camera: PlenopticCamera) -> RayModel:
        """Return the ray model of a camera near the planned one."""
        return RayModel(self, camera)

    def images(self, camera: PlenopticCamera) -> Doubles:
        """Return the expected pixels of all views, (views, rows, columns)."""
        system = OpticalSystem(camera, self._wavelength)
        return np.stack(
            [
                rays.image(system, brightness_at(system, view.points) * view.weights)
                for rays, view in zip(self._rays, self._views, strict=True)
            ]
        )


@dataclass(frozen=True, eq=False)
class RayModel:
    """Expected captures of views by a camera in the ray model; see `RayModels.at`."""

    models: RayModels
    camera: PlenopticCamera

    def images(self) -> Doubles:
        """Return the expected pixels of all views, (views, rows, columns)."""
        return self.models.images(self.camera)

    def derivatives(self, vector: CameraVector, images: Doubles) -> Doubles:
        """Return the derivatives of `images`, an array (parameters, views, rows, columns), by central differences."""
        own = vector.of(self.camera)
        x = own.values
        # Change of a parameter to either side for its derivative, in `scales`: less than bright captures resolve. Over
        # longer ones dark pixels next to edges of the light seem to change with a parameter that does not light them.
        steps = 1e-4 * own.scales
        rows = np.empty((len(x), *images.shape))
        for index, step in enumerate(steps.tolist()):
            sides = (x + side * step * (np.arange(len(x)) == index) for side in (1, -1))
            more, less = (self.models.images(own.at(side)) for side in sides)
            rows[index] = (more - less) / (2 * step)
        return rows

    def slopes(self, vector: CameraVector, steps: Doubles, distance: Callable[[Doubles], float]) -> Doubles:
        """Return mean slopes of captures over one deviation along some directions, (parameters, views, rows, columns).

        Captures have kinks: where the light's edge meets dark pixels, the slope is large on one side and 0 on the
        other. Along each of `steps` (directions, parameters), which are deviations by the derivatives, slopes are taken
        on the side on which captures change less, over the length at which the `distance` of captures is 1.
        """
        own = vector.of(self.camera)
        images = self.images()
        moved = np.empty_like(steps)
        rows = np.empty((len(steps), *images.shape))
        for index, step in enumerate(steps):
            sides = [(side * step, self.models.images(own.at(own.values + side * step))) for side in (1, -1)]
            nearest, changed = min(sides, key=lambda side: distance(side[1]))
            # 2: How often the length over which slopes are averaged is corrected.
            for _ in range(2):
                most = 1 / np.linalg.norm(nearest / own.scales)
                nearest = nearest * min(1 / max(distance(changed), 1e-9), most)
                changed = self.models.images(own.at(own.values + nearest))
            moved[index] = nearest
            rows[index] = changed - images
        return np.tensordot(np.linalg.inv(moved), rows, 1)
