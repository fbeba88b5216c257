"""The integrator plugin ``plenoptic_wave``: what a plenoptic camera records by wave optics."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..capture import colour
from ..capture.accuracy import DEFAULT_ACCURACY, check_accuracy
from ..capture.operator import METHODS
from ..capture.patch_plan import Cost
from ..capture.render_gradients import RenderGradients
from ..capture.replay import Replay
from ..capture.sight import Sight
from ..capture.signed_camera import require_parameters
from ..capture.signed_capture import SignedCapture
from ..capture.signed_gradients import LightDerivatives, SignedGradients
from ..capture.signed_rays import SceneLight
from ..capture.spectral import SpectralCapture
from ..capture.wave_capture import WaveCapture
from ..errors import InputError
from ..optics import guards
from ..optics.spectrum import Spectrum
from ..optics.wave_cameras import require_ideal, require_no_aberrations, require_no_glass
from ..runtime.jobs import Job
from .colours import NAME, read_colours
from .films import develop, develop_back, put
from .gradients import accumulate, numbers_and_others, tangent
from .properties import read_choice, read_count, read_flag, read_plain

MOST_RADIATORS = 256
"""Radiators per lens and axis at most."""

MOST_PASSES = 1024
"""Passes at most; their radiators are held together."""

SIGNED_RAYS = "signed_rays"
"""The method that takes all light from the rays of a capture by rays."""

# Integrators that follow light from the emitters and cannot tell the radiance along a ray.
_LIGHT_TRACERS = ("ParticleTracerIntegrator", "AdjointIntegrator")


def make_class() -> type:
    """Define the plugin's class for the active Mitsuba variant, to which its types are bound."""

    class PlenopticWaveIntegrator(mi.SamplingIntegrator):
        r"""Wave capture: the incoherent, non-paraxial wave-optical image on a plenoptic camera's detector.

        .. pluginparameters::

         * - wavelength
           - |float| or |string|
           - Vacuum wavelength in nanometres, 200 to 2500; for variants of three channels three of them, separated by
             commas. (Default: 633; in three channels "611.4, 549.1, 464.3")
         * - bandwidth
           - |float|
           - Full width in nanometres of a flat band around each wavelength. (Default: none, light of one wavelength)
         * - responses
           - |string|
           - Instead of ``wavelength``, what the film's channels answer to: ``srgb``, the colour matching functions of
             CIE 1931 in linear sRGB, or a table of a detector, a CSV file with a wavelength in nanometres and one or
             three responses to a row, below a line of names or without. (Default in spectral variants with a film of
             colours, where no ``wavelength`` is given: ``srgb``)
         * - wavelength_count
           - |int|
           - With ``responses``: at how many wavelengths light is taken, up to 1024; more where the table, or in
             spectral variants tables of the scene, change faster. (Default: 31)
         * - nodes
           - |int|
           - At how many wavelengths point spreads are computed: of each band, or with ``responses`` of all, between
             which they are interpolated. (Default: as many as the sum of some radiators needs for ``accuracy``)
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
             of kernels of single lenses, at the price of a capture by rays; in one wavelength where glasses of a
             ``main_lens`` disperse light. ``full_field``: on all of the array, the
             slow reference. ``auto``: the quicker one of the first two. ``signed_rays``: from the rays of a capture
             by rays, see below. (Default: ``auto``)
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

        Method ``signed_rays`` has no radiators. It follows the rays that a sensor with ``lens_model="parabolic"`` would
        draw, and some beside each lens, into the scene; ``spp`` is the number of rays a pixel, as by rays. What pupil
        and microlenses diffract is in signed coefficients of each ray and in kernels, which depend on the camera alone.
        So light may differ over the pupil and over a lens, and the scene may hold all that the nested integrator
        knows, at the price of a capture by rays. It takes thin main lenses without a wavefront, regular arrays and
        detectors not far from the microlenses' focus, and lines instead of bands and responses.
        ``radiators_per_lens``, ``passes`` and ``occlusion`` do not concern it; ``accuracy`` below 0.005 takes finer
        kernels.

        With a band or responses, one set of radiators serves all wavelengths. In spectral variants light has the
        scene's own spectra, in rgb ones those of D65 times the smoothest reflectances that have the colours, in mono
        ones the same radiance at all wavelengths. With a camera's ``glass`` and ``mla_glass`` each wavelength has its
        own focal lengths.

        Scalar waves and thin elements: no polarisation, and both lenses are thin parabolic phases, whose geometric
        twin is the sensor's ``lens_model="parabolic"``. Objects before a radiator hide parts of the pupil but do
        not diffract. What is seen in mirrors and through glass radiates from where it seems to be. Polarized variants
        compute as if unpolarized.

        The same seed gives the same bits, on any number of threads.

        ``mi.render`` differentiates captures, forward and in reverse, by the numbers that the sensor exposes and by
        what the light depends on: textures, emitters and BSDFs. Radiators, and how their light fills the pupil, are
        held: shapes do not move. ``path`` is replaced by ``prb``, which replays its light paths; with other nested
        integrators, and in scenes with mirrors, glass, masks or media, there are gradients by the camera only.
        Method ``signed_rays`` holds shapes alone: what ``prb``, or ``prbvolpath`` for ``volpath``, differentiates along
        rays it differentiates in any scene, and most of the camera's numbers.

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
            self.colours = read_colours(props)
            self.wavelengths = self.colours.wavelengths
            self.radiators_per_lens = read_count(props, NAME, "radiators_per_lens", 8, maximum=MOST_RADIATORS)
            self.passes = read_count(props, NAME, "passes", 1, maximum=MOST_PASSES)
            self.method = read_choice(props, NAME, "method", ("auto", *METHODS, SIGNED_RAYS))
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
            names, gradients = self._gradients(scene, params, sensor, seed, spp, forward=True)
            with guards.watch():
                change = gradients.forward({name: tangent(sensor, name) for name in names})
            return develop(sensor.film(), change)

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            """Take the gradient of the capture back to that of parameters, for `mi.render`."""
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            shape = *PlenopticCamera.from_sensor(sensor).shape, len(self.wavelengths)
            names, gradients = self._gradients(scene, params, sensor, seed, spp, forward=False)
            with guards.watch():
                found = gradients.backward(develop_back(sensor.film(), grad_in, shape), names)
            for name, gradient in found.items():
                accumulate(sensor, name, gradient)

        def _gradients(
            self, scene: Any, params: Any, sensor: Any, seed: Any, spp: int, forward: bool
        ) -> tuple[tuple[str, ...], RenderGradients | SignedGradients]:
            """Return which of the camera's numbers have gradients, and what differentiates; or refuse."""
            if self.method not in ("auto", "patch", SIGNED_RAYS):
                raise InputError(f"{NAME}: method = {self.method}: it has no gradients; use patch")
            if self.spectrum_of(scene, sensor) is not None:
                raise InputError(f"{NAME}: there are no gradients of captures of bands or responses; leave them out")
            names, others = numbers_and_others(params, sensor)
            camera = PlenopticCamera.from_sensor(sensor)
            camera.require_no_objective("captures by waves are differentiated")
            seed = int(seed[0]) if hasattr(seed, "__len__") else int(seed)
            spp = spp or sensor.sampler().sample_count()
            capture = self._capture(scene, sensor)
            try:
                if isinstance(capture, SignedCapture):
                    require_parameters(camera, names)
                    light = LightDerivatives.of(capture.light, forward) if others or not names else None
                    return names, SignedGradients(capture, light, seed, spp)
                assert isinstance(capture, WaveCapture)
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
            with guards.watch():
                image = capture.compute(seed=seed, spp=spp, job=job or Job(), noise=noise)

            put(film, image, image.shape[2] if noise is False else len(self.wavelengths))
            return film

        def estimate(self, scene: Any, sensor: Any, *, seed: int, spp: int, job: Job) -> Cost:
            """Estimate what `record` takes, from some of the lenses and some of the rays."""
            with guards.watch():
                return self._capture(scene, sensor).estimate(seed=seed, spp=spp, job=job)

        def spectrum_of(self, scene: Any, sensor: Any) -> Spectrum | None:
            """Return the spectrum that a sensor's film records; None if each channel has one wavelength."""
            return self.colours.spectrum_for(sensor.film().base_channels_count(), scene)

        def _capture(self, scene: Any, sensor: Any) -> WaveCapture | SpectralCapture | SignedCapture:
            camera = PlenopticCamera.from_sensor(sensor)
            require_ideal(camera)
            if self.method == SIGNED_RAYS:
                if self.spectrum_of(scene, sensor) is not None:
                    raise InputError(f"{NAME}: method = {SIGNED_RAYS}: it takes no bands and responses yet; use auto")
                light = SceneLight(scene, sensor, self.child, self.wavelengths[0] if mi.is_spectral else None)
                return SignedCapture(camera, light, self.wavelengths, self.accuracy)
            if camera.objective is not None and self.method == "bank":
                raise InputError(f"method = bank: it does not know main_lens = {camera.objective.name}; use patch")
            if self.method == "bank":
                require_no_aberrations(camera)
                require_no_glass(camera, "method bank takes the same focal lengths for all wavelengths; use patch, or")
            spectrum = self.spectrum_of(scene, sensor)
            wavelengths = self.wavelengths if spectrum is None else spectrum.wavelengths
            if mi.is_spectral:
                responses = np.ones((1, 1), np.float32) if spectrum is None else spectrum.matrix()
                colour.require_spectra(scene, wavelengths, responses)
            sight = Sight.of(scene, sensor, self.child, wavelengths if mi.is_spectral else None)
            if camera.objective is not None:
                sight.require_surfaces(camera.objective.name)
            capture = WaveCapture(
                camera=camera,
                sight=sight,
                wavelengths=self.wavelengths,
                radiators_per_lens=self.radiators_per_lens,
                passes=self.passes,
                method=self.method,
                occlusion=self.occlusion,
                accuracy=self.accuracy,
            )
            if spectrum is None:
                return capture
            return SpectralCapture(capture, spectrum, self.colours.upsampling(spectrum), self.colours.total_nodes())

        def parameters(self) -> dict[str, Any]:
            """Its own parameters by name, as ``mi.load_dict`` takes them."""
            return {
                **self.colours.parameters(),
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
