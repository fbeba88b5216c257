"""The sensor plugin ``plenoptic``: the ray model of a plenoptic camera."""

import itertools
import math
import sys
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PARAMETERS, Captures, Form, PlenopticCamera, film_numbers, with_sensor_parameters
from ..detector import DetectorOperator, behind_detector
from ..errors import InputError, refuse_if
from ..extension import entries, place
from ..lenses import main_lens
from ..optics import second_leg
from ..rays import LensRays, sampler_of
from ..runtime import Named, Numbers, Pair, Triple, count_lanes, require_unfrozen
from ..scene import meet_moved, refuse_light_tracing, world_ray
from .properties import read_camera, require_read

if TYPE_CHECKING:
    from ..lenses import RealLens

NAME = "plenoptic"


_BOX = '<rfilter type="box"/>'


def make_class() -> type:
    """Return the plugin's class, defined for the active Mitsuba variant, to which its types are bound."""

    class PlenopticSensor(mi.Sensor):
        r"""Plenoptic (light-field) camera: main lens, microlens array, detector.

        .. pluginparameters::

         * - CAMERA
         * - to_world
           - |transform|
           - Camera to world, without scale. The camera looks along +z, +x is left and +y is up.
             (Default: identity)
           - |exposed|, |differentiable|, |discontinuous|
         * - shutter_open, shutter_close
           - |float|
           - Shutter interval, as for every sensor. (Default: 0)
           - |exposed|
         * - (Nested plugin)
           - :paramtype:`film`
           - Its size is the detector's resolution. Its filter must be ``box``: a wider one smears the
             micro-images.

        All lengths are in scene units, which are taken as millimetres. Several values are given as text separated by
        commas, such as "0.064, 0.06"; a pair may also be a point or vector, whose z must be 0. A ray starts at a
        detector point :math:`p`, passes a point :math:`m` of a microlens of centre :math:`c` with slope
        :math:`t = (m - p)/z - (m - c)/f_2`, meets the main lens in :math:`P = m + b t` and leaves it with slope
        :math:`t - P/f_1`. If :math:`P` is outside the main lens, nothing is traced and the weight is zero.
        The value of a pixel is the mean radiance over its lens's aperture, so that a scene of radiance 1 reads 1
        inside the micro-images, however much of its cell a lens fills; there is no :math:`\cos^4` falloff. Light
        that crosses into a neighbour's micro-image is found by drawing among all lenses that can light a pixel.

        With the default ``detector_distance`` this is an unfocused camera: ``mla_distance`` is the image distance of
        objects in focus. With any other, the camera is focused: the microlenses image the main lens's image at
        :math:`a` before the array, :math:`1/a + 1/z = 1/f_2`, or behind it. The capture is then sharp at the object
        distance whose image is :math:`b - a` from the main lens. The scenes ``keplerian``, ``galilean`` and ``raytrix``
        are such cameras.

        With ``mla_lattice`` ``none`` this is an ordinary camera: a ray starts at a detector point and passes a random
        point of the exit pupil. The value of a pixel is the integral of the radiance over the open exit pupil, divided
        by the pupil's paraxial area: less than the mean where a ``main_lens`` vignettes, more where its pupil grows.

        If a camera disperses light, by ``glass``, ``mla_glass`` or the glasses of ``main_lens``, each ray follows the
        path of one wavelength: in rgb variants that of one channel, drawn evenly (611.4, 549.1 or 464.3 nm, the
        dominant wavelengths of the primaries of sRGB), in spectral variants the first of its four. The ray contributes
        nothing to the other channels, and its weight is three or four times as high: colours take three or four times
        as many samples. In mono variants light has the wavelength of the line d, or the ``main_lens``'s own.

        The capture has the orientation of a ``perspective`` sensor's image. Gradients flow through the ``path``
        and ``direct`` integrators, but the pupil's moving edge contributes none: the gradient is that of the
        light inside the micro-images. Gradients of wave captures, through ``plenoptic_wave``, include the edges.

        .. tabs::
            .. code-tab:: xml

                <sensor type="plenoptic">
                    <float name="focal_length" value="80"/>
                    <float name="aperture_radius" value="5"/>
                    <float name="focus_distance" value="240"/>
                    <film type="hdrfilm">
                        <integer name="width" value="4096"/>
                        <integer name="height" value="4096"/>
                        <rfilter type="box"/>
                        <string name="component_format" value="float32"/>
                    </film>
                </sensor>

            .. code-tab:: python

                'type': 'plenoptic',
                'focal_length': 80.0,
                'aperture_radius': 5.0,
                'focus_distance': 240.0,
                'film': {
                    'type': 'hdrfilm', 'width': 4096, 'height': 4096,
                    'rfilter': {'type': 'box'}, 'component_format': 'float32',
                }
        """

        __doc__ = with_sensor_parameters(__doc__ or "")
        _rays: Any = None

        def __init__(self, props: Any):
            for name in ("near_clip", "far_clip"):
                if name in props:
                    raise InputError(
                        f"{NAME}: {name} = {props[name]:g}: this camera has no clipping planes, its rays start "
                        "at the main lens; remove the parameter"
                    )
            # Only objects are read here: Mitsuba refuses as unknown only the parameters that were never read.
            objects = [name for name in props.keys() if props.type(name) == mi.Properties.Type.Object]  # noqa: SIM118
            film_name = next((name for name in objects if isinstance(props[name], mi.Film)), None)
            # Of films with bands of their own, what the integrator hands on is known to C++ alone.
            if film_name is not None and not mi.has_flag(props[film_name].flags(), mi.FilmFlags.Special):
                props[film_name] = behind_detector(props[film_name])
            super().__init__(props)
            film = self.film()
            if not film.rfilter().is_box_filter():
                fault = f"the film's filter {film.rfilter().class_name()} smears the micro-images into each other"
                line = _BOX if film_name else f'<film type="hdrfilm"> {_BOX} </film>'
                raise InputError(f"{NAME}: {fault if film_name else 'it has no film'}; add the line {line}")
            camera, self.stated = read_camera(props, NAME, film)
            self._given = camera
            require_read(props, NAME)
            parameters = _parameters_of(camera)
            # Parameters that are empty, set by the main lens, or of an array that is not there, are not exposed.
            self._numbers = [
                name
                for name, value in parameters.items()
                if PARAMETERS[name].gradients and value not in ((), None) and name not in camera.lens_data.sets
            ]
            for name, value in parameters.items():
                if name in self._numbers:
                    # In its shortest form, as an array that can carry gradients.
                    kind = mi.Point2f if PARAMETERS[name].form is Form.PLACE else mi.Float
                    value = kind(PARAMETERS[name].plain(value))
                setattr(self, name, value)
            self.m_needs_sample_3 = True
            self._update()

        def traverse(self, callback: Any) -> None:
            """Expose the parameters to `mi.traverse`."""
            super().traverse(callback)
            differentiable = mi.ParamFlags.Differentiable
            edges = mi.ParamFlags.Discontinuous
            callback.put("to_world", self.m_to_world, differentiable | edges)
            for name in self._numbers:
                gradients = PARAMETERS[name].gradients
                flags = differentiable | edges if Captures.EDGES in gradients else differentiable
                by_rays = Captures.RAYS in gradients
                callback.put(name, getattr(self, name), flags if by_rays else mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: list[str] | None = None) -> None:
            """Check changed parameters and apply them."""
            super().parameters_changed(keys or [])
            self._update()

        def _update(self) -> None:
            require_unfrozen(f"{NAME}: params.update()")
            refuse_if(
                not np.isfinite(self.world_transform().matrix.numpy()).all(),
                f"{NAME}: to_world: its numbers must be finite",
            )
            refuse_if(
                dr.any(self.world_transform().has_scale()),
                f"{NAME}: to_world: it must not scale; give lengths in scene units instead",
            )
            numbers = {name: getattr(self, name) for name in self._numbers}
            # Opaque values are kernel inputs, so that changing one does not compile the kernels again.
            dr.make_opaque(*numbers.values())
            # Read here and not while rays are traced, as symbolic code can not read the parameters.
            self._plain = _parameters_of(self._given)
            for name, value in numbers.items():
                plain = _plain(value, self._plain[name])
                self._plain[name] = plain[0] if PARAMETERS[name].form is Form.NUMBER else plain
            self._rays = sampler_of(self.camera, numbers)
            self._second_leg = second_leg(self.pixel_response, self.mla_absorption or 0.0)
            tables = (
                place(package, text)(getattr(self, name))
                for package, name, text in entries("responses")
                if getattr(self, name) is not None
            )
            self._table = next(tables, None)
            is_coloured = self._rays.dispersion is not None or (self._table is not None and not mi.is_monochromatic)
            detector = DetectorOperator.of(self.camera)
            film = self.film()
            if hasattr(film, "stand_before"):
                film.stand_before(detector, self.detector_width, is_coloured)
            else:
                needed = "an hdrfilm behind detector_blur, pixel_crosstalk or stray_light"
                refuse_if(not detector.is_identity, f"{NAME}: film of type {film.class_name()}: it must be {needed}")

        @property
        def camera(self) -> PlenopticCamera:
            """Return the camera with the current values of the parameters."""
            return PlenopticCamera(**self._plain, **film_numbers(self.film()))

        def _on_detector(self, film_sample: Any) -> Pair:
            """Return the detector points of film samples, which are fractions of the crop window."""
            film = self.film()
            pixel = self.detector_width / film.size()[0]
            x, y = (
                (film_sample[axis] * film.crop_size()[axis] + film.crop_offset()[axis] - 0.5 * film.size()[axis])
                * pixel
                for axis in (0, 1)
            )
            return x, y

        def crosstalk_missed(self) -> float:
            """Return the fraction of light through lenses that are not sampled, estimated from a sample of rays."""
            random = mi.PCG32(size=2**16)
            film_sample, lens_sample = (
                mi.Point2f(random.next_float32(), random.next_float32()) for _ in ("film", "lens")
            )
            return self._rays.missed(self._on_detector(film_sample), lens_sample)

        def chief_ray(self, film_sample: Any) -> Pair:
            """Return the ray from a film position through the centre of its lens or pupil, and whether it passes.

            The position is a fraction of the crop window, as in `sample_ray`.
            """
            point, slope, open_ = self._rays.chief(self._on_detector(film_sample))
            return mi.RayDifferential3f(world_ray(self, point, slope)), open_

        def pupil_ray(self, pupil: Pair, position: Pair) -> Pair:
            """Return the ray through points of the microlens array and the pupil, and whether it is transmitted."""
            point, slope, open_ = self._rays.walk.through_pupil(pupil, position)
            return mi.RayDifferential3f(world_ray(self, point, slope)), open_

        def _sample(
            self, time: Any, wavelength_sample: Any, film_sample: Any, lens_sample: Any, active: Any, differential: bool
        ) -> Triple:
            if self._rays is None:
                # Calls are traced for each sensor that there is: also for a refused one that its exception holds.
                return dr.zeros(mi.RayDifferential3f), dr.zeros(mi.Spectrum), dr.zeros(mi.Float)
            wavelengths, weight = self.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f), wavelength_sample, active)
            rays = self._rays
            width = self.detector_width / self.film().size()[0]
            dispersion = None
            passage = None
            if rays.dispersion is not None:
                dispersion, lens_sample, share = rays.dispersion.draw(lens_sample, wavelengths)
                rays = dispersion.refracting(rays)
                # In polarized variants weights are Mueller matrices.
                weight = weight * mi.Spectrum(share)
            px, py = self._on_detector(film_sample)
            if self._table is not None:
                sample, side, behind = cast(LensRays, rays).sample_pupil((px, py), width, lens_sample)
                passing = self._table(side, behind, wavelengths) * sample.weight
                weight = weight * mi.Spectrum(passing)
                passing = dr.mean(passing, axis=0)
            else:
                sample, passage = rays.sample((px, py), lens_sample, dispersion)
                behind = self._second_leg(*rays.second_leg(sample))
                weight = weight * sample.weight * behind
                passing = sample.weight * behind
            point = sample.origin
            slope = sample.slope
            open_ = sample.valid & active
            ray = world_ray(self, point, slope)
            # A ray of zero length hits nothing: it is cheap, and the depth and normals of dark pixels remain 0.
            ray.maxt = dr.select(open_, dr.largest(mi.Float), 0)
            ray.time = time
            ray.wavelengths = wavelengths
            if differential:
                ray = mi.RayDifferential3f(ray)
            if differential and passage is not None:
                to_world = self.world_transform()
                for name, dx, dy in (("x", width, 0), ("y", 0, width)):
                    if rays.walk.camera.lens_data.traced_surfaces:
                        # Tracing the offset rays surface by surface would cost three times as much.
                        beside, slope_beside = cast("RealLens", rays.walk.lens).beside(
                            point, slope, *rays.steps(dx, dy)
                        )
                    else:
                        beside, slope_beside, _ = rays.trace((px + dx, py + dy), passage)
                    setattr(ray, f"o_{name}", to_world @ mi.Point3f(*beside))
                    setattr(ray, f"d_{name}", to_world @ dr.normalize(mi.Vector3f(*slope_beside, 1)))
                ray.has_differentials = True
            return ray, dr.select(open_, weight, 0), dr.select(open_, passing, 0)

        def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Pair:
            """Return a random ray and its weight, from positions on the crop window (`sample2`) and on the lens."""
            return self._sample(time, sample1, sample2, sample3, active, differential=False)[:2]

        def sample_ray_differential(
            self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
        ) -> Pair:
            """Return a random ray with differentials: rays from the next pixels through the same lens point."""
            if self._rays is None:
                return self._sample(time, sample1, sample2, sample3, active, differential=True)[:2]
            caller = sys._getframe(1).f_locals
            # Integrators do not tell sensors what they render.
            meet_moved(caller.get("scene"), self)
            kinds = {kind.__name__ for kind in type(caller.get("self")).__mro__}
            # Mitsuba's integrators in Python that do not differentiate by the sensor's rays.
            for name in self._numbers if kinds & {"RBIntegrator", "PathProjectiveIntegrator"} else ():
                refuse_if(
                    dr.grad_enabled(getattr(self, name)),
                    f"{NAME}: {name}: prb, prbvolpath and the like hold the sensor's rays and have no gradient by it; "
                    "use path, volpath, direct or plenoptic_wave",
                )
            samples = time, sample1, sample2, sample3
            film = self.film()
            growth = 1.0
            if getattr(film, "redraws", False):
                with dr.suspend_grad():
                    passing = self._sample(*samples, active, differential=False)[2]
                    samples, growth = film.draw_again(passing, samples)
            ray, weight, _ = self._sample(*samples, active, differential=True)
            count_lanes(dr.width(sample2))
            return ray, weight * growth

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            """Refuse light tracing, as a scene point sees the detector through many lenses at once."""
            refuse_light_tracing()

        def projection_transform(self) -> Any:
            """Refuse integrators that project moving edges of shapes onto the film, as many lenses see each of them."""
            raise InputError(
                f"{NAME}: prb_projective and direct_projective cannot project edges of moving shapes through the "
                "lenses; use path or direct, which leave out what edges change, or differences of captures"
            )

        def bbox(self) -> Any:
            """Return the bounds of the main lens, or of its first surface, where all rays start."""
            to_world = self.world_transform()
            camera = self.camera
            field = math.hypot(camera.detector_width, camera.detector_height) / 2 + max(camera.mla_pitches or (0.0,))
            entrance = main_lens(camera).entrance
            radius = entrance.radius + entrance.growth * field
            box = mi.ScalarBoundingBox3f()
            for x, y, z in itertools.product((-radius, radius), (-radius, radius), entrance.depths):
                corner = to_world @ mi.Point3f(x, y, z)
                box.expand(mi.ScalarPoint3f([float(corner[i][0]) for i in range(3)]))
            return box

        def to_string(self) -> str:
            """Return the description of the camera that Mitsuba prints."""
            lines = [f"  {name} = {value}," for name, value in self.camera.to_dict().items()]
            return "\n".join(["PlenopticSensor[", *lines, f"  film = {self.film().class_name()}", "]"])

    return PlenopticSensor


def _parameters_of(camera: PlenopticCamera) -> Named:
    """Return the camera parameters that the film does not determine."""
    return {name: value for name, value in camera.arguments().items() if PARAMETERS[name].form is not Form.FILM}


def _plain(values: Any, written: float | Numbers) -> list[float]:
    """Return single-precision values as first given, or as their shortest decimals: 0.512 for 0.5120000243."""
    numbers = np.ravel(written).tolist()
    # Points and vectors come in single precision.
    in_double = {np.float32(number): number for number in numbers if float(np.float32(number)) != number}
    return [in_double.get(value, float(str(value))) for value in np.ravel(dr.detach(values)).astype(np.float32)]
