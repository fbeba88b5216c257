"""The integrator plugin ``plenoptic_wave``: what a plenoptic camera records by wave optics."""

from __future__ import annotations

import itertools
import logging
import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..capture.accuracy import DEFAULT_ACCURACY, check_accuracy
from ..capture.bank import LensBank, finest_pitch, near_weight
from ..capture.choice import bank_is_quicker
from ..capture.estimate import estimate_waves
from ..capture.lens_rays import LensRaySum
from ..capture.noise import PARTS, keep_spread, keep_variances, with_halves, with_spread
from ..capture.operator import METHODS, CaptureOperator
from ..capture.patch_plan import Cost
from ..capture.radiators import Radiators, find_radiators, sample_pairs
from ..capture.sight import Sight
from ..errors import InputError, shown
from ..io.checkpoints import digest
from ..optics import guards
from ..optics.main_lens import main_lens, require_ideal
from ..optics.spectrum import Spectrum
from ..runtime.jobs import Job, Task
from .properties import read_choice, read_count, read_flag, read_plain

NAME = "plenoptic_wave"

_log = logging.getLogger(__name__)

DEFAULT_WAVELENGTH = 633.0

MOST_RADIATORS = 256
"""Radiators per lens and axis at most."""

MOST_PASSES = 1024
"""Passes at most; their radiators are held together."""

# Dominant wavelengths of the sRGB primaries (IEC 61966-2-1), for variants of three channels.
RGB_WAVELENGTHS = (611.4, 549.1, 464.3)

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
        not diffract. A mirror image or a refracted one radiates from the mirror or the glass. Polarized variants
        compute as if unpolarized.

        The same seed gives the same bits, on any number of threads.

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
            camera = PlenopticCamera.from_sensor(sensor)
            require_ideal(camera)
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
                image = self._capture(scene, sensor, camera, seed, spp, job or Job(), noise)

            channels = len(self.wavelengths)
            film.prepare([f"noise.{channel}" for channel in range(channels * noise)])
            rows, columns = camera.shape
            block = np.ones((rows, columns, 4 + image.shape[2] - channels), dtype=np.float32)
            block[..., :3] = image[..., :channels]
            block[..., 4:] = image[..., channels:]
            film.put_block(mi.ImageBlock(mi.TensorXf(block), film.crop_offset()))
            return film

        def _capture(
            self, scene: Any, sensor: Any, camera: PlenopticCamera, seed: int, spp: int, job: Job, noise: bool
        ) -> np.ndarray:
            """Sum all radiators of all passes: (rows, columns, 1 or 3) pixel values, none negative.

            With noise there are as many channels of their standard deviations.
            """
            random = np.random.default_rng(seed)
            # The first pass is not shifted: it is the best single set.
            shifts = [np.zeros(4), *random.random((self.passes - 1, 4))]
            seeds = np.random.SeedSequence(seed).generate_state(self.passes)
            sight = self._sight(scene, sensor)
            method = self._chosen(camera, sight, seed)
            sets = [
                self._find(sight, camera, method)(
                    sample_pairs(self.radiators_per_lens, shift),
                    spp=spp,
                    seed=int(pass_seed) >> 1,
                    occlusion=self.occlusion,
                )
                for shift, pass_seed in zip(shifts, seeds, strict=True)
            ]
            # Columns of the weights: the capture's channels, and what tells the noise of each.
            columns = self.wavelengths + tuple(np.repeat(self.wavelengths, 1 + PARTS)) if noise else self.wavelengths
            operators = [self._operator(camera, radiators, method, columns) for radiators in sets]
            rays = []
            if method == "bank":
                runs = min(PARTS, spp * self.passes) if noise else 1
                rays = [
                    self._lens_rays(sight, camera, seed=int(run_seed), spp=spp * self.passes // runs, part=1 / runs)
                    # Neighbouring seeds must not share runs.
                    for run_seed in np.random.SeedSequence([seed, runs]).generate_state(runs)
                ]
            total = sum(len(operator.points) * operator.sums for operator in operators)
            if total == 0 and not rays:
                warnings.warn(
                    f"{NAME}: no ray from the pupil meets anything that shines; a nested integrator with "
                    "hide_emitters sees no emitters",
                    stacklevel=2,
                )
            if method != "full_field" and total:
                self._estimate(operators[0], job)
            channels = len(self.wavelengths)
            shape = (*camera.shape, channels * (1 + noise * (3 if rays else 1)))
            generator = np.random.default_rng((seed, PARTS)) if noise else None
            items = total + sum(task.items for task in rays)
            if noise:
                rays = [keep_spread(task, channels) for task in rays]
            tasks = itertools.chain(self._tasks(operators, sets, job, generator, shape[2]), rays)
            image = job.run(tasks, shape, items, partial(_facts, sets))
            if noise and rays:
                image = with_spread(image, channels, len(rays))
            # What interpolation leaves below zero between the samples is not light.
            np.maximum(image, 0, out=image)
            np.sqrt(image[..., channels:], out=image[..., channels:])
            return image

        def _sight(self, scene: Any, sensor: Any) -> Sight:
            return Sight.of(scene, sensor, self.child, self.wavelengths[0] if mi.is_spectral else None)

        def _chosen(self, camera: PlenopticCamera, sight: Sight, seed: int) -> str:
            """Return the method that is used; by the bank's rays, everything hides what is behind it."""
            if self.method != "auto":
                return self.method
            per_lens = self.passes * self.radiators_per_lens**2
            quicker = self.occlusion and bank_is_quicker(camera, sight, per_lens, self.accuracy, seed)
            return "bank" if quicker else "patch"

        def _find(self, sight: Sight, camera: PlenopticCamera, method: str) -> Callable[..., Radiators]:
            """Return `find_radiators` of a scene, for the light that needs exact point spreads."""

            def near(vergence: np.ndarray) -> np.ndarray:
                return np.asarray(near_weight(camera, vergence, self.accuracy))

            return partial(find_radiators, sight, camera, weight=near if method == "bank" else None)

        def _lens_rays(self, sight: Sight, camera: PlenopticCamera, *, seed: int, spp: int, part: float = 1.0) -> Task:
            """Return a part of the sum that records by rays through the lenses' centres what is out of focus."""
            between = sight.vergences(main_lens(camera))
            types = range(len(camera.mla_focal_lengths))
            pitch = finest_pitch(camera, self.wavelengths)
            banks = [
                [LensBank.learn(camera, wavelength, self.accuracy, between, type_, pitch) for type_ in types]
                for wavelength in self.wavelengths
            ]
            work = LensRaySum(camera, sight, banks, accuracy=self.accuracy, spp=spp, seed=seed)
            return Task(int(work.items.sum()), lambda: work, lambda image: image * np.float32(part))

        def estimate(self, scene: Any, sensor: Any, *, seed: int, spp: int, job: Job) -> Cost:
            """Estimate what `record` takes, from some of the lenses."""
            camera, sight = PlenopticCamera.from_sensor(sensor), self._sight(scene, sensor)
            method = self._chosen(camera, sight, seed)
            with guards.watch():
                cost = estimate_waves(
                    camera,
                    partial(self._find(sight, camera, method), seed=seed),
                    partial(self._operator, camera, method=method, columns=self.wavelengths),
                    job,
                    pairs=sample_pairs(self.radiators_per_lens, np.zeros(4)),
                    spp=spp,
                    occlusion=self.occlusion,
                )
            return replace(
                cost,
                radiators=cost.radiators * self.passes,
                patterns=cost.patterns * self.passes,
                seconds=cost.seconds * self.passes,
            )

        def _operator(
            self, camera: PlenopticCamera, radiators: Radiators, method: str, columns: tuple[float, ...]
        ) -> CaptureOperator:
            # What the bank records is left out of the radiators.
            return CaptureOperator(
                camera,
                radiators.positions,
                spectrum=Spectrum.lines(*columns),
                method="patch" if method == "bank" else method,
                accuracy=self.accuracy,
                pupil_weights=radiators.pupil_weights,
            )

        def _estimate(self, operator: CaptureOperator, job: Job) -> None:
            """Report what is to come, or refuse it if memory would not do."""
            cost = operator.estimate(job)
            _log.info(
                "%d radiators, %d point spreads, about %.0f s and %.1f GiB",
                cost.radiators * self.passes,
                cost.patterns * self.passes,
                cost.seconds * self.passes,
                cost.memory / 2**30,
            )

        def _tasks(
            self,
            operators: list[CaptureOperator],
            sets: list[Radiators],
            job: Job,
            noise: np.random.Generator | None,
            channels: int,
        ) -> Iterator[Task]:
            """Yield the sums of all passes; what an operator has planned goes when its pass is done."""
            for radiators in sets:
                operator = operators.pop(0)
                scale = self._scale(operator.camera) / radiators.fraction[:, None]
                weights = scale * radiators.radiance
                if noise is None:
                    yield from operator.tasks(weights, job)
                    continue
                deviations = scale * np.sqrt(radiators.variance)
                halves = [with_halves(column, noise) for column in deviations.T]
                groups = [
                    [channel for channel, other in enumerate(self.wavelengths) if other == wavelength]
                    for wavelength in dict.fromkeys(self.wavelengths)
                ]
                tasks = operator.tasks(np.hstack([weights, *halves]), job)
                for task, own in zip(tasks, groups, strict=True):
                    yield keep_variances(task, own, len(self.wavelengths), channels)

        def _scale(self, camera: PlenopticCamera) -> float:
            """Return the weight of a radiator of radiance 1 that lands wholly in the sampled lenses."""
            b, z, lattice = camera.mla_distance, camera.detector_distance, camera.lattice
            cell = lattice.cell_area / self.radiators_per_lens**2
            pupil = math.pi * camera.aperture_radius**2
            return float(cell * pupil * z**2 / (b**2 * lattice.lens_area * camera.pixel_size**2 * self.passes))

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


def _facts(sets: list[Radiators]) -> dict[str, Any]:
    """Return by what a capture is known as the same: its radiators."""
    arrays: list[np.ndarray | None] = []
    for radiators in sets:
        weights = radiators.pupil_weights
        arrays += [radiators.positions, radiators.radiance, radiators.fraction]
        arrays += [None, None] if weights is None else [weights.table, weights.index]
    return {"radiators": sum(len(radiators.positions) for radiators in sets), "scene_digest": digest(*arrays)}


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
