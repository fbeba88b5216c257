"""The integrator plugin ``plenoptic_wave``: what a plenoptic camera records by wave optics."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..capture.accuracy import DEFAULT_ACCURACY, check_accuracy
from ..capture.operator import METHODS
from ..capture.patch_plan import Cost
from ..capture.render_gradients import RenderGradients
from ..capture.replay import Replay
from ..capture.sight import Sight
from ..capture.wave_capture import WaveCapture
from ..errors import InputError, shown
from ..optics import guards
from ..optics.main_lens import require_ideal, require_round
from ..optics.spectrum import RGB_WAVELENGTHS
from ..runtime.jobs import Job
from .films import develop, develop_back, put
from .gradients import accumulate, numbers_and_others, tangent
from .properties import read_choice, read_count, read_flag, read_plain

NAME = "plenoptic_wave"

DEFAULT_WAVELENGTH = 633.0

MOST_RADIATORS = 256
"""Radiators per lens and axis at most."""

MOST_PASSES = 1024
"""Passes at most; their radiators are held together."""

# Integrators that follow light from the emitters and cannot tell the radiance along a ray.
_LIGHT_TRACERS = ("ParticleTracerIntegrator", "AdjointIntegrator")


def make_class() -> type:
    """Define the plugin's class for the active Mitsuba variant, to which its types are bound."""

    class PlenopticWaveIntegrator(mi.SamplingIntegrator):
        r"""Wave capture: the incoherent, non-paraxial wave-optical image on a plenoptic camera's detector.

        .. pluginparameters::

         * - wavelength
           - |float| or |string|
           - Vacuum wavelength in nanometres, 1 to 1e6; for variants of three channels three of them, separated by
             commas. (Default: 633; in three channels "611.4, 549.1, 464.3")
         * - radiators_per_lens
           - |int|
           - Radiators per microlens and axis, up to 256; the time grows with its square. (Default: 8)
         * - passes
           - |int|
           - How often the whole set of radiators is drawn, shifted, and averaged, up to 1024. (Default: 1)
         * - method
           - |string|
           - ``patch``: each radiator's field on the part of the microlens array that it lights. ``bank``: so near
             focus only; beyond some lenses of blur, by one ray from each pixel through each lens's centre and a bank
             of kernels of single lenses, at the price of a capture by rays. ``full_field``: on all of the array, the
             slow reference. ``auto``: the quicker one of the first two. (Default: ``auto``)
         * - occlusion
           - |bool|
           - Whether objects before a radiator hide a part of the pupil from it; method ``bank`` asks for it.
             (Default: true)
         * - accuracy
           - |float|
           - Error of the capture (relative, L2) that ``patch`` may make for speed, by sharing point spreads among
             radiators of nearly the same wavefront and by cutting light that diffracts far. 0: nothing is shared.
             (Default: 0.01)
         * - (Nested plugin)
           - :paramtype:`integrator`
           - Finds the radiance of the radiators, like ``path`` or ``direct``. (Default: ``path``)

        Light from different scene points is mutually incoherent: the detector image is the sum over radiators
        of weight times :math:`|\text{field}|^2`, integrated over each pixel. Radiators are found by rays from the
        pupil into the scene, of which the nested integrator finds the radiance, so that every scene works that
        Mitsuba renders; ``spp`` light paths are averaged for each. With a cell of area :math:`A_c` of the
        microlens array to a radiator, a pixel gets

        .. math:: L \frac{A_c A_{pupil} z^2}{b^2 A_{lens} A_{pixel} f} \, psf

        where :math:`psf` is the fraction of the power through the visible pupil that lands in the pixel and
        :math:`f` the fraction of the visible pupil whose rays land in the sampled part of the array. The pixel's
        unit is that of the sensor by rays: a scene of radiance 1 reads 1 inside wide micro-images.

        Scalar waves and thin elements: no polarisation, and both lenses are thin parabolic phases, whose geometric
        twin is the sensor's ``lens_model="parabolic"``. Objects before a radiator hide parts of the pupil but do
        not diffract. What is seen in mirrors and through glass radiates from where it seems to be. Polarized variants
        compute as if unpolarized.

        The same seed gives the same bits, on any number of threads.

        ``mi.render`` differentiates captures, forward and in reverse, by the numbers that the sensor exposes and by
        what the light depends on: textures, emitters and BSDFs. Radiators, and how their light fills the pupil, are
        held: shapes do not move. ``path`` is replaced by ``prb``, which replays its light paths; with other nested
        integrators, and in scenes with mirrors, glass, masks or media, there are gradients by the camera only.

        .. tabs::
            .. code-tab:: xml

                <integrator type="plenoptic_wave">
                    <float name="wavelength" value="633"/>
                    <integer name="radiators_per_lens" value="8"/>
                    <integrator type="path"/>
                </integrator>

            .. code-tab:: python

                'type': 'plenoptic_wave',
                'wavelength': 633.0,
                'radiators_per_lens': 8,
                'child': {'type': 'path'}
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.wavelengths = _read_wavelengths(props)
            self.radiators_per_lens = read_count(props, NAME, "radiators_per_lens", 8, maximum=MOST_RADIATORS)
            self.passes = read_count(props, NAME, "passes", 1, maximum=MOST_PASSES)
            self.method = read_choice(props, NAME, "method", ("auto", *METHODS))
            self.occlusion = read_flag(props, NAME, "occlusion", True)
            if self.method == "bank" and not self.occlusion:
                raise InputError(f"{NAME}: occlusion = false: by method bank, objects hide what is behind them")
            self.accuracy = check_accuracy(read_plain(props, "accuracy", DEFAULT_ACCURACY), f"{NAME}: accuracy")
            nested = [value for _, value in props.objects()]
            if len(nested) > 1:
                raise InputError(f"{NAME}: {len(nested)} nested plugins: it takes one integrator")
            self.child = nested[0] if nested else mi.load_dict({"type": "path"})
            kind = self.child.class_name() if hasattr(self.child, "class_name") else type(self.child).__name__
            if not isinstance(self.child, mi.SamplingIntegrator) or kind in _LIGHT_TRACERS:
                raise InputError(f"{NAME}: nested {kind}: it cannot tell the radiance along a ray; use path or direct")

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            """Render the capture; `spp` is the number of light paths for each radiator."""
            if isinstance(sensor, int):
                sensor = scene.sensors()[sensor]
            seed = int(seed[0]) if hasattr(seed, "__len__") else int(seed)
            spp = spp or sensor.sampler().sample_count()
            film = self.record(scene, sensor, seed=seed, spp=spp)
            return film.develop() if develop else None

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            """Return the change of the capture with the tangents of parameters, for `mi.render`."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            names, gradients = self._gradients(scene, params, sensor, seed, spp)
            with guards.watch():
                change = gradients.forward({name: tangent(sensor, name) for name in names})
            return develop(sensor.film(), change)

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            """Take the gradient of the capture back to that of parameters, for `mi.render`."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            names, gradients = self._gradients(scene, params, sensor, seed, spp)
            shape = *PlenopticCamera.from_sensor(sensor).shape, len(self.wavelengths)
            with guards.watch():
                found = gradients.backward(develop_back(sensor.film(), grad_in, shape), names)
            for name, gradient in found.items():
                accumulate(sensor, name, gradient)

        def _gradients(
            self, scene: Any, params: Any, sensor: Any, seed: Any, spp: int
        ) -> tuple[tuple[str, ...], RenderGradients]:
            """Return which of the camera's numbers have gradients, and what differentiates; or refuse."""
            if self.method not in ("auto", "patch"):
                raise InputError(f"{NAME}: method = {self.method}: it has no gradients; use patch")
            names, others = numbers_and_others(params, sensor)
            seed = int(seed[0]) if hasattr(seed, "__len__") else int(seed)
            spp = spp or sensor.sampler().sample_count()
            capture = self._capture(scene, sensor)
            try:
                replay = Replay.of(capture.sight, spp, seed) if others else None
            except InputError as error:
                raise InputError(f"{NAME}: {error}") from None
            return names, RenderGradients(capture, seed, spp, replay)

        def record(
            self, scene: Any, sensor: Any, *, seed: int, spp: int, job: Job | None = None, noise: bool = False
        ) -> Any:
            """Compute the capture, and return the film that holds it.

            Parameters
            ----------
            scene, sensor
                The scene and its plenoptic sensor.
            seed : int
                Seed of the random numbers.
            spp : int
                Light paths for each radiator.
            job : Job, optional
                Who computes, who is told of the progress, where the work is kept. Default: threads of this process.
            noise : bool
                Whether the standard deviation of the pixels is computed, too: the film then has it as extra channels,
                one for each wavelength.
            """
            capture = self._capture(scene, sensor)
            film = sensor.film()
            if not film.rfilter().is_box_filter():
                raise InputError(
                    f"{NAME}: the film's filter is {film.rfilter().class_name()}: pixels are integrated exactly, "
                    'use <rfilter type="box"/>'
                )
            if mi.is_spectral and film.base_channels_count() > 1:
                raise InputError(
                    f"{NAME}: variant {mi.variant()} records one wavelength, and the film has the colours of many: use "
                    "pixel_format luminance, or an rgb variant"
                )
            with guards.watch():
                image = capture.compute(seed=seed, spp=spp, job=job or Job(), noise=noise)

            put(film, image, len(self.wavelengths))
            return film

        def estimate(self, scene: Any, sensor: Any, *, seed: int, spp: int, job: Job) -> Cost:
            """Estimate what `record` takes, from some of the lenses and some of the rays."""
            with guards.watch():
                return self._capture(scene, sensor).estimate(seed=seed, spp=spp, job=job)

        def _capture(self, scene: Any, sensor: Any) -> WaveCapture:
            camera = PlenopticCamera.from_sensor(sensor)
            require_ideal(camera)
            if self.method == "bank":
                require_round(camera)
            return WaveCapture(
                camera=camera,
                sight=Sight.of(scene, sensor, self.child, self.wavelengths[0] if mi.is_spectral else None),
                wavelengths=self.wavelengths,
                radiators_per_lens=self.radiators_per_lens,
                passes=self.passes,
                method=self.method,
                occlusion=self.occlusion,
                accuracy=self.accuracy,
            )

        def parameters(self) -> dict[str, Any]:
            """Its own parameters by name, as ``mi.load_dict`` takes them."""
            return {
                "wavelength": ", ".join(f"{wavelength:g}" for wavelength in self.wavelengths),
                "radiators_per_lens": self.radiators_per_lens,
                "passes": self.passes,
                "method": self.method,
                "occlusion": self.occlusion,
                "accuracy": self.accuracy,
            }

        def to_string(self) -> str:
            """Describe the integrator."""
            lines = [f"  {name} = {value}," for name, value in self.parameters().items()]
            return "\n".join(["PlenopticWaveIntegrator[", *lines, f"  child = {self.child}", "]"])

    return PlenopticWaveIntegrator


def _read_wavelengths(props: Any) -> tuple[float, ...]:
    """Take one wavelength, or one a channel, for the active variant."""
    value = props.get("wavelength", None)
    if value is None:
        return RGB_WAVELENGTHS if mi.is_rgb else (DEFAULT_WAVELENGTH,)
    parts = value.split(",") if isinstance(value, str) else list(value) if hasattr(value, "__len__") else [value]
    try:
        parts = [float(part) if isinstance(part, str) else part for part in parts]
    except ValueError:
        raise InputError(
            f"{NAME}: wavelength = {shown(value)}: it must be nanometres, or three of them separated by commas"
        ) from None
    wavelengths = tuple(require_wavelength(part, f"{NAME}: wavelength") for part in parts)
    if len(wavelengths) == 1 and mi.is_rgb:
        wavelengths *= 3
    channels = 3 if mi.is_rgb else 1
    if len(wavelengths) != channels:
        raise InputError(
            f"{NAME}: wavelength = {shown(value)}: variant {mi.variant()} has {channels} channel{'s' * (channels > 1)}"
        )
    return wavelengths
