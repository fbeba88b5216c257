"""The integrator plugin ``plenoptic_wave``: wave captures of plenoptic cameras."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import Captures, PlenopticCamera, Use, has_small_lenses, is_supported, require_support, with_gradient
from ..detector import SHARP
from ..errors import InputError, naming, refuse_if, require_accuracy, require_choice, require_number, short_repr
from ..extension import hook
from ..optics import MOST_WAVELENGTHS, WAVELENGTHS, Spectrum, Table, colour, guards, interpolated, read_responses
from ..runtime import Doubles, Job, Named
from ..scene import LightDerivatives, SceneLight, require_wave_film
from ..waves import (
    DEFAULT_ACCURACY,
    SignedCapture,
    SignedGradients,
    WavelengthSampler,
    check_screen,
    require_parameters,
)
from .properties import read_count, read_plain
from .wave_base import NAME, asked_for, developed, make_base, put, read_wavelengths

if TYPE_CHECKING:
    from ..points import PointsCapture


def numbers_and_others(params: Any, sensor: Any) -> tuple[tuple[str, ...], bool]:
    """Return the names of camera parameters that carry gradients, and whether scene parameters carry any.

    Parameters with respect to which captures have no derivative are refused.
    """
    names = []
    others = False
    for key, (_, _, node, _) in {} if params is None else params.properties.items():
        if not dr.grad_enabled(params[key]):
            continue
        name = key.rsplit(".", 1)[-1]
        # Attributes of shapes, such as colours and opacities, move nothing.
        moves = isinstance(node, mi.Shape) and not (node.has_attribute(name) or name == "vertex_texcoords")
        if moves or name == "to_world":
            reason = (
                "places of shapes and cameras are held; differentiate captures by rays, through the sensor plenoptic"
            )
            raise InputError(f"plenoptic_wave: {key}: it has no gradient: {reason}")
        if isinstance(node, (mi.Sensor, mi.Film)):
            refuse_if(
                name not in with_gradient(Captures.POINTS),
                f"plenoptic_wave: {key}: captures by waves have no derivative by it",
            )
            if node is sensor:
                names.append(name)
        else:
            others = True
    return tuple(names), others


SIGNED_RAYS = "signed_rays"
"""The method that computes the wave capture from the radiance along rays."""

POINTS = "points"
"""The reference method: points of matte surfaces, each of which is propagated separately."""

SRGB = "srgb"
"""The responses of linear sRGB, in place of the name of a file."""

SHARED = 32
"""Count of wavelengths of a band whose light is distributed to the nodes of signed rays."""


def make_class() -> type:
    """Return the plugin's class, defined for the active Mitsuba variant, to which its types are bound."""

    class PlenopticWaveIntegrator(make_base()):  # type: ignore[misc]
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
           - Instead of ``wavelength``, the responses of the film's channels: ``srgb``, the colour matching functions of
             CIE 1931 in linear sRGB, or a CSV file with the responses of a detector. Each row has a wavelength in
             nanometres and one or three responses; a first line of names is optional. (Default in spectral variants
             with a colour film, if no ``wavelength`` is given: ``srgb``)
         * - wavelength_count
           - |int|
           - With ``responses``: count of wavelengths at which light is sampled, up to 1024; more are used where the
             table, or in spectral variants tables of the scene, change faster. (Default: 31)
         * - nodes
           - |int|
           - Count of wavelengths at which diffraction is computed, for each band, or with ``responses`` in total (by
             ``signed_rays`` for each channel, if no two responses overlap); light between two of them is distributed to
             both. (Default: as many as ``accuracy`` needs)
         * - method
           - |string|
           - ``signed_rays``: computed from the radiance along rays. ``points``: matte surfaces point by point, the slow
             reference. (Default: ``signed_rays``)
         * - accuracy
           - |float|
           - Allowed error of the capture (relative, L2). Below 0.005 ``signed_rays`` takes finer kernels; ``points``
             shares point spreads among points of nearly the same wavefront, and at 0 shares nothing. (Default: 0.01)
         * - (Nested plugin)
           - :paramtype:`integrator`
           - Finds the radiance along rays, like ``path`` or ``direct``. (Default: ``path``)

        Light from different scene points is mutually incoherent. Its phase-space density before the pupil is therefore
        the radiance along rays, which the pupil and the microlenses diffract by kernels in closed form. A thin main
        lens refracts them as the sensor's ``lens_model`` states, microlenses as thin phases do. Some rays are drawn
        outside of each lens's aperture; ``spp`` is their count per pixel, as in a ray capture. Diffraction is described
        by signed coefficients of each ray and by kernels, which depend only on the camera. So the scene may contain all
        that the nested integrator renders, and the cost is similar to that of a ray capture. A scene of radiance 1
        reads 1 inside wide micro-images, less the fourth power of the cosine behind the microlenses: 0.5 % for
        microlenses of f/8.

        Behind lenses of less than 20 wavelengths, such as on-chip lenses over two by two photodiodes, captures use the
        responses of photodiodes to rays, computed from non-paraxial fields in the medium `mla_medium`. Only rays that
        pass the pupil are drawn, as many as a ray capture of ``spp`` has of them, and pixels may be negative by noise.
        Upright square lattices of one pitch and type are supported, in mono and rgb variants, without gradients.

        All main lenses and arrays of the sensor are supported, except the Fourier arrangement of microscopes, and
        detectors far from the microlenses' focus whose pixels are finer than the pupil's diffraction. With bands and
        responses, kernels are computed at the wavelengths of the ``nodes``, between which light is interpolated
        linearly; in spectral variants each ray has wavelengths of its own, whatever the scene. With a dispersive main
        lens each node has rays of its own.

        Method ``points`` is the reference for signed rays. From each microlens, ``spp`` rays in a pattern (lens point,
        pupil point) that is the same for all lenses find the ``spp`` points where they first hit matte or emitting
        surfaces. Shadow rays find the part of the pupil that each point sees, and the field of each is propagated
        separately (`CaptureOperator`, method ``patch``); intensities add. For each point 64 light paths are averaged,
        so that their noise is small compared with the error of a pattern of few points. The time grows with ``spp``:
        64 points per lens reproduce white walls in focus to 0.5 %; out of focus several hundred are needed, or the mean
        over seeds. At an accuracy of 0 each point takes some 10 ms. Gloss, glass, mirrors, masks, instances, media,
        environments, moving scenes and objectives are refused by name. This method has no gradients and no noise
        estimate.

        With a band or responses, one set of rays serves all wavelengths. In spectral variants light has the scene's own
        spectra, in rgb variants those of D65 times the smoothest reflectances that have the colours, and in mono
        variants the same radiance at all wavelengths. With a camera's ``glass`` and ``mla_glass`` each wavelength has
        its own focal lengths.

        Waves are scalar and elements thin: there is no polarisation. The sensor's ``lens_model`` says of a thin main
        lens, by rays and by waves, whether it is stigmatic (``ideal``) or a parabolic phase with its aberrations
        (``parabolic``); microlenses are thin phases under both names. Objects of the scene do not diffract. Polarized
        variants compute as if unpolarized.

        The same seed gives the same bits, with any thread count, except on CUDA.

        ``mi.render`` differentiates captures by ``signed_rays``, forward and in reverse, with respect to textures,
        emitters, BSDFs and attributes of shapes, such as colours of vertices and the ``sh_coeffs`` and ``opacities`` of
        ``ellipsoids``, and in reverse also to media, but not to the places of shapes. ``path`` is replaced by ``prb``,
        and ``volpath`` by ``prbvolpath``, which replay their light paths; other nested integrators have no gradients
        for the scene. There are gradients for the sensor's ``focal_length``, ``mla_distance``, ``mla_focal_length``,
        ``mla_pitch``, ``mla_offset``, ``detector_distance`` and ``detector_width`` if the main lens is thin, without
        aberrations, distortion and glass, and the array is regular and near the microlenses' focus. Spectral variants
        have gradients only in reverse. A capture with such gradients takes its kernels from those of a camera nearby,
        by expansion, which changes it by less than a tenth of ``accuracy``.

        .. tabs::
            .. code-tab:: xml

                <integrator type="plenoptic_wave">
                    <float name="wavelength" value="633"/>
                    <integrator type="path"/>
                </integrator>

            .. code-tab:: python

                'type': 'plenoptic_wave',
                'wavelength': 633.0,
                'child': {'type': 'path'}
        """

        plugin = NAME

        def __init__(self, props: Any):
            super().__init__(props)
            self._read_spectrum(props)
            self.method = require_choice(
                f"{NAME}: method", read_plain(props, "method", SIGNED_RAYS), (SIGNED_RAYS, POINTS)
            )
            self.accuracy = require_accuracy(read_plain(props, "accuracy", DEFAULT_ACCURACY), f"{NAME}: accuracy")
            self.read_child(props)

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            """Return the change of the capture along the parameters' tangents, for `mi.render`."""
            sensor, seed, spp = asked_for(scene, sensor, seed, spp)
            names, gradients = self._gradients(scene, params, sensor, seed, spp, forward=True)
            tangents = {name: np.ravel(np.array(dr.grad(getattr(sensor, name)), np.float64)) for name in names}
            with guards.watch():
                change = gradients.forward(tangents)
            light, image = developed(sensor.film(), gradients.compensated[0])
            dr.set_grad(light, mi.TensorXf(change))
            return dr.forward_to(image)

        def render_backward(
            self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0
        ) -> None:
            """Add the gradients of parameters, from the gradient with respect to the capture, for `mi.render`."""
            sensor, seed, spp = asked_for(scene, sensor, seed, spp)
            names, gradients = self._gradients(scene, params, sensor, seed, spp, forward=False)
            with guards.watch():
                light, image = developed(sensor.film(), gradients.compensated[0])
                dr.backward(dr.sum(image * grad_in, axis=None))
                by_name = gradients.backward(np.array(dr.grad(light)), names)
            for name, gradient in by_name.items():
                value = getattr(sensor, name)
                dr.accum_grad(value, type(value)(gradient.tolist()))

        def _gradients(
            self, scene: Any, params: Any, sensor: Any, seed: int, spp: int, forward: bool
        ) -> tuple[tuple[str, ...], SignedGradients]:
            """Return the camera parameters with gradients, and the capture's derivatives; refuse unsupported ones."""
            refuse_if(
                self.method != SIGNED_RAYS, f"{NAME}: method = {self.method}: it has no gradients; use {SIGNED_RAYS}"
            )
            names, others = numbers_and_others(params, sensor)
            capture = self._signed(scene, sensor)
            if not capture.has_gradients:
                pitch = f"{NAME}: mla_pitch = {capture.camera.row_pitch:g}"
                raise InputError(f"{pitch}: captures behind lenses of a few wavelengths have no gradients")
            with naming(NAME):
                require_parameters(capture.camera, names, any(node.plan.lands_by_point for node in capture.nodes))
                light = LightDerivatives.of(capture.light, forward) if others or not names else None
            return names, SignedGradients(capture, light, seed, spp)

        def record(
            self, scene: Any, sensor: Any, *, seed: int, spp: int, job: Job | None = None, noise: bool = False
        ) -> Any:
            """Return the film that holds the computed capture."""
            # Other sensors are refused before their films.
            PlenopticCamera.from_sensor(sensor)
            film = sensor.film()
            require_wave_film(film)
            with guards.watch():
                capture = self._capture(scene, sensor)
                image = capture.compute(seed=seed, spp=spp, job=job or Job(), noise=noise)
            put(film, image, image.shape[2] // (2 if noise else 1))
            return film

        def spectrum_of(self, scene: Any, sensor: Any) -> Spectrum | None:
            """Return the spectrum that a sensor's film records; None if each channel has one wavelength."""
            # Signed rays draw their wavelengths, so they miss no line; in rgb and mono variants spectra are smooth.
            tables = colour.tables_of(scene) if self.method == POINTS and mi.is_spectral else []
            return self._spectrum(sensor.film().base_channels_count(), tables)

        def _capture(self, scene: Any, sensor: Any) -> SignedCapture | PointsCapture:
            if self.method == SIGNED_RAYS:
                return self._signed(scene, sensor)
            from ..points import PointsCapture, require_matte

            # The film records what the detector makes of the light.
            camera = PlenopticCamera.from_sensor(sensor).replace(**SHARP)
            require_support(camera, Use.SCENE_POINTS)
            spectrum = self.spectrum_of(scene, sensor)
            upsampling = None
            if mi.is_spectral:
                wavelengths = self.wavelengths if spectrum is None else spectrum.wavelengths
                responses = np.ones((1, 1), np.float32) if spectrum is None else spectrum.matrix()
                colour.require_spectra(scene, wavelengths, responses)
            require_matte(scene, sensor, self.child)
            if spectrum is None:
                spectrum = Spectrum.lines(*self.wavelengths)
            else:
                upsampling = None if mi.is_spectral else self._upsampling(spectrum)
                if self.nodes is not None:
                    bands = 1 if self.bandwidth is None else len(self.wavelengths)
                    spectrum = spectrum.interpolated(self.nodes * bands)
            traced = spectrum.wavelengths if mi.is_spectral else (None,)
            lights = [SceneLight(scene, sensor, self.child, wavelength) for wavelength in traced]
            return PointsCapture(camera, lights, spectrum, upsampling, self.accuracy)

        def _signed(self, scene: Any, sensor: Any) -> SignedCapture:
            spectrum = self.spectrum_of(scene, sensor)
            conversion: Doubles | WavelengthSampler
            if spectrum is None:
                spectrum = Spectrum.lines(*self.wavelengths)
                conversion = np.eye(len(self.wavelengths))
            elif mi.is_spectral:
                conversion = WavelengthSampler(self._table())
            else:
                conversion = self._upsampling(spectrum)
            if mi.is_spectral:
                colour.require_spectra(scene, spectrum.wavelengths, spectrum.matrix())
            light = SceneLight(scene, sensor, self.child, self.wavelengths[0] if mi.is_spectral else None)
            camera = PlenopticCamera.from_sensor(sensor)
            require_support(camera, Use.SCENES)
            if camera.phase_screen is not None:
                check_screen(camera, min(spectrum.wavelengths))
            arguments = camera, light, spectrum, conversion, self.nodes, self.accuracy
            if has_small_lenses(camera, max(spectrum.wavelengths)):
                return hook("small lenses", f"{NAME}: mla_pitch = {camera.row_pitch:g}")(*arguments)
            # Derivatives that are refused are so when they are asked for.
            varying: tuple[str, ...] = ()
            if is_supported(camera, Use.SCENE_DERIVATIVES):
                with dr.resume_grad():
                    varying = tuple(
                        name for name in with_gradient(Captures.POINTS) if dr.grad_enabled(getattr(sensor, name, None))
                    )
            return SignedCapture(*arguments, varying)

        def _read_spectrum(self, props: Any) -> None:
            """Read wavelengths, bands and responses."""
            self.wavelengths = read_wavelengths(props)
            self.has_wavelengths = "wavelength" in props
            self.bandwidth = read_plain(props, "bandwidth", None)
            if self.bandwidth is not None:
                self.bandwidth = require_number(f"{NAME}: bandwidth", self.bandwidth, positive=True)
            self.responses = read_plain(props, "responses", None)
            self.wavelength_count = read_count(props, NAME, "wavelength_count", WAVELENGTHS, maximum=MOST_WAVELENGTHS)
            self.nodes = read_count(props, NAME, "nodes", 0, maximum=MOST_WAVELENGTHS) if "nodes" in props else None
            # Rows of the file of responses: a wavelength and the response of each channel.
            self.file_table: Doubles | None = None
            if self.bandwidth is not None:
                for wavelength in self.wavelengths:
                    require_number(f"{NAME}: bandwidth", self.bandwidth, maximum=wavelength)
            if self.responses is None:
                if not mi.is_spectral:
                    refuse_if(
                        "wavelength_count" in props,
                        f"{NAME}: wavelength_count = {self.wavelength_count}: of use with responses only",
                    )
                    refuse_if(
                        self.nodes is not None and self.bandwidth is None,
                        f"{NAME}: nodes = {self.nodes}: of use with bandwidth or responses only",
                    )
                return
            refuse_if(
                not isinstance(self.responses, str),
                f"{NAME}: responses = {short_repr(self.responses)}: it must be srgb or the name of a file",
            )
            for name in ("wavelength", "bandwidth"):
                refuse_if(name in props, f"{NAME}: responses, {name}: give one of the two")
            if self.responses == SRGB:
                refuse_if(
                    not (mi.is_rgb or mi.is_spectral),
                    f"{NAME}: responses = srgb: variant {mi.variant()} has no colours; use an rgb or spectral one",
                )
                return
            self.responses = str(mi.file_resolver().resolve(self.responses))
            self.file_table = read_responses(self.responses)
            Spectrum.sensor(self.file_table, self.wavelength_count)
            channels = self.file_table.shape[1] - 1
            refuse_if(
                channels not in (1, 3), f"{NAME}: responses = {self.responses}: {channels} channels: it must be 1 or 3"
            )

        def _spectrum(self, channels: int, tables: Sequence[Table]) -> Spectrum | None:
            """Return the spectrum of a film with `channels`; None if each channel of light has one wavelength.

            `tables` are spectra of the scene whose products with the responses must be integrated accurately.
            """
            if self.file_table is not None:
                columns = self.file_table.shape[1] - 1
                # A luminance film accepts three channels, too, but would add them up as if they were colours.
                refuse_if(
                    columns not in (1, channels),
                    f"responses = {self.responses}: {columns} channels, and the film has {channels}: use pixel_format "
                    "rgb",
                )
                return Spectrum.sensor(self.file_table, self.wavelength_count, tables)
            if self.bandwidth is not None:
                # 8: Default count of wavelengths of a band; point spreads may be computed at fewer.
                count = SHARED if self.method == SIGNED_RAYS else self.nodes or 8
                if tables:
                    ends, flat = self._table().T
                    response = partial(interpolated, ends, [flat])
                    return Spectrum.smooth(response, float(ends[0]), float(ends[1]), count, tables)
                return Spectrum.bands(self.wavelengths, self.bandwidth, count)
            if self.responses == SRGB or (mi.is_spectral and channels == 3 and not self.has_wavelengths):
                return colour.srgb(self.wavelength_count, tables)
            return None

        def _table(self) -> Doubles:
            """Return the responses as rows of a wavelength and the response of each channel per nanometre."""
            if self.file_table is not None:
                wavelengths = self.file_table[:, 0]
                columns = self.file_table[:, 1:]
                return np.column_stack([wavelengths, columns / np.trapezoid(columns, wavelengths, axis=0)])
            if self.bandwidth is not None:
                (centre,) = self.wavelengths
                half = self.bandwidth / 2
                return np.array([[centre - half, 1 / self.bandwidth], [centre + half, 1 / self.bandwidth]])
            return colour.srgb_table()

        def _upsampling(self, spectrum: Spectrum) -> Doubles:
            """Return the matrix (channels of light, wavelengths) from radiance to spectra in mono and rgb variants."""
            if self.bandwidth is not None:
                of_band = np.ones(len(spectrum.wavelengths) // len(self.wavelengths))
                return np.asarray(np.kron(np.eye(len(self.wavelengths)), of_band), np.float64)
            if not mi.is_rgb:
                return np.ones((1, len(spectrum.wavelengths)))
            colour.require_upsampled(spectrum)
            basis = colour.upsampling(spectrum.wavelengths)
            if self.responses != SRGB:
                return basis
            # Sums over wavelengths approximate integrals; the matrix is corrected so that grey remains exactly grey.
            return np.asarray(np.linalg.solve(basis @ spectrum.matrix().astype(np.float64).T, basis))

        def parameters(self) -> Named:
            """Return the parameters of this integrator by name, as for ``mi.load_dict``."""
            parameters: Named = {}
            if self.responses is not None:
                parameters |= {"responses": self.responses, "wavelength_count": self.wavelength_count}
            elif self.has_wavelengths or not mi.is_spectral:
                parameters["wavelength"] = ", ".join(f"{wavelength:g}" for wavelength in self.wavelengths)
            for name in ("bandwidth", "nodes"):
                if getattr(self, name) is not None:
                    parameters[name] = getattr(self, name)
            return parameters | {"method": self.method, "accuracy": self.accuracy}

    return PlenopticWaveIntegrator
