"""Do waves predict the pixels of a real light field better than rays? The runs that answer it, and the answer."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache

import numpy as np

from ...camera import PlenopticCamera, Use, require_support
from ...errors import put, refuse_if, require_wavelength
from ...io import Cache, digest
from ...runtime import Array, Named, Pair, Progress
from ..calibrate.photon_transfer import SensorNoise
from ..calibrate.white_fit import fit_white
from ..calibrate.white_frames import WhiteFrame, black_level, clipped, stuck
from .array_part import ArrayPart, CameraModel, PartPixels
from .point_patterns import distances_of, plane_of
from .projector import SceneProjection
from .scene_fit import fit_scene
from .withheld import FEWEST, TESTS, Ratio, Withheld, by_lens, misfit

LIGHTS = ("waves", "rays")

STRENGTHS = (0.001, 0.005, 0.02)
"""Strengths of the prior, of which pixels that are withheld for it choose."""

SEEDS = 3
"""Draws of withheld pixels."""

ITERATIONS = 30
"""Steps of each fit."""

_SEARCHED = (0.25, 1.25)
_SEARCH_STEPS = 10
_MOST_PLANES = 3
"""Planes that a search tries, as `distances_of` takes them; steps with each; and planes at most."""


@dataclass(frozen=True)
class Pictures:
    """Pictures of a real camera, as `sensor_pictures`: something evenly white, a light field, and no light or None.

    `good` are the pixels, flat, that are neither saturated nor defective.
    """

    white: Array
    light_field: Array
    dark: Array | None
    good: Array = field(init=False)

    def __post_init__(self) -> None:
        good = WhiteFrame.of(self.white, self.dark).good
        noise = self.noise.dark_variance**0.5
        bright = float(np.quantile(self.electrons, 0.999))
        refuse_if(
            bright < 5.0 * noise,
            f"light field: bright pixels hold {bright:.3g} electrons, at a noise of {noise:.3g}: it has no light",
        )
        dead, hot = stuck(self.electrons.reshape(good.shape), noise)
        put(self, good=(good & ~(clipped("light field", self.light_field) | dead | hot)).ravel())

    @cached_property
    def noise(self) -> SensorNoise:
        """Gain and noise of the sensor."""
        return SensorNoise.of(self.white, self.dark, self.light_field)

    @cached_property
    def electrons(self) -> Array:
        """Electrons of the light field's pixels, flat."""
        light = self.light_field - (0 if self.dark is None else self.dark)
        return ((light - black_level(light)) / self.noise.gain).ravel()

    @cached_property
    def key(self) -> str:
        """Hash of the white and the dark picture."""
        return digest(self.white, *([] if self.dark is None else [self.dark]))


@dataclass(frozen=True)
class Answer:
    """Results of a study.

    Attributes
    ----------
    ratios : dict
        By test (pixels, lenses): residuals by waves and by rays, see `Ratio`.
    relative : dict
        By light and test: root mean square of differences over that of the recorded pixels.
    strengths : dict
        By light and test: the strength of the prior that withheld pixels chose.
    stray : dict
        By light: part of a lens's mean light that is spread over the lens.
    controls : dict
        By the light that simulated the picture: residuals of withheld pixels.
    distances : list
        Distances of the scene's planes in millimetres.
    noise : str
        Where the noise of the pixels comes from.
    """

    ratios: dict[str, Ratio]
    relative: dict[str, dict[str, float]]
    strengths: dict[str, dict[str, float]]
    stray: dict[str, float]
    controls: dict[str, Ratio]
    distances: list[float]
    noise: str

    @property
    def verdict(self) -> str:
        """A sentence that says which light predicts better, and by how much, or that the test cannot tell."""
        if not all(ratio.better == light for light, ratio in self.controls.items()):
            return "The test cannot tell simulated pictures by rays from those by waves: it says nothing."
        pixels = self.ratios["pixels"]
        # Residual over noise, of withheld pixels, up to which a model explains a picture.
        if not np.minimum(pixels.waves, pixels.rays) < 10.0:
            return (
                "Neither waves nor rays explain the picture: of withheld pixels, the residual is "
                f"{pixels.waves:.1f} and {pixels.rays:.1f} times the noise. Are planes and camera right?"
            )
        said = [
            f"of withheld {test}, {ratio.better} {'is' if ratio.better == 'neither' else 'are'} better: the residual "
            f"by rays is {ratio.ratio:.3f} times (95 %: {ratio.low:.3f} to {ratio.high:.3f}) that by waves"
            for test, ratio in self.ratios.items()
        ]
        return "In predictions " + "; ".join(said) + "."


class Study:
    """The runs of a study, each a stage on disk.

    Parameters
    ----------
    pictures : Pictures
        The pictures.
    camera : PlenopticCamera
        The camera as it is known.
    wavelength : float
        Wavelength in nanometres.
    box : (float, float, float, float)
        Left, top, right and bottom of the part of the picture, in pixels.
    planes : sequence of float
        Distances of the scene's planes in millimetres, see `Plane`; none: all behind an objective, otherwise a search.
    stages : Cache
        Where runs are stored.
    """

    def __init__(
        self,
        pictures: Pictures,
        camera: PlenopticCamera,
        wavelength: float,
        box: tuple[float, float, float, float],
        planes: Sequence[float],
        stages: Cache,
    ):
        require_support(camera, Use.POINTS | Use.RAY_SPREADS | Use.ROUND_PUPILS)
        require_wavelength(wavelength)
        objective = camera.objective
        refuse_if(
            not camera.has_array
            or camera.lens_data.images_stop
            or (objective is None and not camera.lens_data.is_thin),
            "camera: light fields are predicted behind thin lenses, and objectives with the array in their image",
        )
        nearest = min(planes, default=np.inf)
        least = camera.focal_length if objective is None else -np.inf
        refuse_if(nearest <= least, f"plane = {nearest:g}: it must be beyond the focal length, {least:g} mm")
        refuse_if(len(set(planes)) < len(planes), f"plane = {list(planes)}: none may be given twice")
        left, top, right, bottom = box
        self._size = (right - left) * (bottom - top)
        pitch, _ = camera.lattice.pitches
        image = (camera.micro_image_pitch / camera.pixel_size) ** 2 * camera.lattice.row_distance / pitch
        lenses = self._size / image
        refuse_if(lenses < FEWEST, f"part: it shows {lenses:.0f} lenses: at least {FEWEST} are needed to withhold 10 %")
        self.pictures = pictures
        self.camera = camera
        self.wavelength = wavelength
        self.box = box
        self.stages = stages
        self._planes = list(planes) or ([] if objective is None else distances_of(camera))
        # What is found once serves all runs; a projection takes so much memory that the last one alone is kept.
        self.model, self.predicted, self.scene = cache(self._model), cache(self._predicted), cache(self._scene)
        self.simulated, self.strength = cache(self._simulated), cache(self._strength)
        self.part = cache(lambda light: ArrayPart(self.model(light), self._pixels))
        self.withheld = cache(lambda seed: Withheld.drawn(self._pixels, self.pictures.good[self._pixels.pixel], seed))
        self.projector = lru_cache(1)(
            lambda light: SceneProjection(self.part(light), [plane_of(self.part(light), g) for g in self.distances])
        )

    # -- cameras and planes ----------------------------------------------------------------------

    def _model(self, light: str) -> CameraModel:
        """Return a camera's model, fitted to the white picture."""
        pictures = self.pictures
        length = None if light == "rays" else self.wavelength

        def fitted(progress: Progress) -> Named:
            fit = fit_white(pictures.white, self.camera, dark=pictures.dark, wavelength=length, progress=progress)
            return CameraModel.fitted(fit).to_plain()

        # A fit serves all parts of the picture.
        inputs = [pictures.key, self.camera.to_dict(), length]
        return CameraModel.of(self.stages.facts(f"camera_{light}", inputs, fitted))

    @cached_property
    def _given(self) -> list:
        """What all stages depend on."""
        return [
            digest(self.pictures.light_field),
            self.pictures.key,
            self.camera.to_dict(),
            list(self.box),
            self.wavelength,
            ITERATIONS,
            self._planes,
        ]

    @cached_property
    def _pixels(self) -> PartPixels:
        """The pixels of the part, by the lattice that waves find."""
        return PartPixels.of(self.model("waves"), self.box)

    @cached_property
    def distances(self) -> list[float]:
        """Distances of the scene's planes, in millimetres.

        A search fits each plane alone, by rays, and takes one after the other that explains most, lens by lens.
        """
        if self._planes:
            return self._planes

        def found(progress: Progress) -> Named:
            tried = distances_of(self.camera, *_SEARCHED)
            used = self.withheld(0).used
            electrons = self.electrons(None)
            misfits = []
            for done, distance in enumerate(tried):
                progress(done, len(tried))
                projector = SceneProjection(self.part("rays"), [plane_of(self.part("rays"), distance)])
                fit = fit_scene(projector, electrons, used, self.dark_variance, STRENGTHS[0], _SEARCH_STEPS)
                misfits.append(by_lens(misfit(electrons, fit.predicted, self.dark_variance), used, self._pixels)[0])
            left = np.full(len(misfits[0]), np.inf)
            chosen: list[float] = []
            while len(chosen) < _MOST_PLANES:
                totals = np.minimum(left, misfits).sum(1)
                best = int(totals.argmin())
                # 0.03: Part of the misfit that a plane must explain beyond those before it.
                if totals[best] > (1 - 0.03) * left.sum():
                    break
                left = np.minimum(left, misfits[best])
                chosen.append(tried[best])
            return {"distances": chosen}

        return list(self.stages.facts("search", [self._given, _SEARCHED], found)["distances"])

    # -- runs ------------------------------------------------------------------------------------

    def _predicted(self, light: str, seed: int, strength: float, simulated: str | None) -> Array:
        """Return the light of all pixels of the part (m,) that a fit to those not withheld predicts.

        `simulated` names the light by which the picture is simulated instead of recorded.
        """
        mask = self.withheld(seed).used

        def fitted(progress: Progress) -> tuple[Array, Named]:
            electrons = self.electrons(simulated)
            fit = fit_scene(self.projector(light), electrons, mask, self.dark_variance, strength, ITERATIONS, progress)
            return fit.predicted[None], {"stray_light": fit.stray}

        words = [light, f"seed_{seed}", f"{strength:g}"] + ([f"of_{simulated}"] if simulated else [])
        return self.stages.image("_".join(words), [self._given, self.distances], fitted)[0].ravel()

    def _scene(self, light: str) -> tuple[Array, float]:
        """Return the scene that all pixels together give, and the stray light."""

        def fitted(progress: Progress) -> tuple[Array, Named]:
            mask = self.pictures.good[self._pixels.pixel]
            electrons = self.electrons(None)
            strength = self.strength(light, "pixels")
            fit = fit_scene(self.projector(light), electrons, mask, self.dark_variance, strength, ITERATIONS, progress)
            return np.append(fit.scene.ravel(), np.float32(fit.stray))[None], {}

        flat = self.stages.image(f"scene_{light}", [self._given, self.distances], fitted)[0].ravel()
        return flat[:-1].reshape(self.projector(light).source_shape), float(flat[-1])

    @property
    def dark_variance(self) -> float:
        """Variance of a dark pixel in electrons squared, with that of rounding."""
        return self.pictures.noise.dark_variance

    def electrons(self, simulated: str | None) -> Array:
        """Return the electrons of the part's pixels, recorded, or simulated by a light."""
        if simulated is not None:
            return self.simulated(simulated)
        return np.asarray(self.pictures.electrons[self._pixels.pixel], np.float32)

    def _simulated(self, light: str) -> Array:
        """Return the electrons of a picture of the scene that rays or waves find, simulated with noise."""
        scene, stray = self.scene(light)
        direct, glow = self.projector(light).forward(scene)
        expected = np.maximum(direct + stray * glow, 0).astype(np.float64)
        generator = np.random.default_rng(0)
        noisy = generator.poisson(expected) + generator.normal(0, self.dark_variance**0.5, len(expected))
        return np.asarray(noisy, np.float32)

    def _strength(self, light: str, test: str) -> float:
        """Return the strength that the pixels withheld for it choose."""
        electrons = self.electrons(None)

        def residual(strength: float) -> float:
            predicted = (self.predicted(light, seed, strength, None) for seed in range(SEEDS))
            values = (misfit(electrons, some, self.dark_variance) for some in predicted)
            return sum(float(some[self.withheld(seed).choosing[test]].sum()) for seed, some in enumerate(values))

        return min(STRENGTHS, key=residual)

    # -- the answer ------------------------------------------------------------------------------

    def squares(self, light: str, test: str, seed: int, simulated: str | None = None) -> Array:
        """Return sums by lens of squared differences over noise of withheld pixels, and the pixels' number."""
        predicted = self.predicted(light, seed, self.strength(light, test), simulated)
        values = misfit(self.electrons(simulated), predicted, self.dark_variance)
        return by_lens(values, self.withheld(seed).tested[test], self._pixels)

    def relative(self, light: str, test: str) -> float:
        """Return the root mean square of withheld differences over that of the recorded pixels."""
        electrons = self.electrons(None)
        totals = np.zeros(2)
        for seed in range(SEEDS):
            chosen = self.withheld(seed).tested[test]
            away = electrons - self.predicted(light, seed, self.strength(light, test), None)
            totals += [np.linalg.norm(some[chosen]) ** 2 for some in (away, electrons)]
        return float(np.sqrt(totals[0] / totals[1]))

    def work(self) -> list[float]:
        """Return the work of each stage of `answer`, in their order."""

        def run(planes: Sequence[float], steps: int = ITERATIONS) -> Pair:
            blurs = [self.camera.blur_diameter(plane) / self.camera.row_pitch for plane in planes]
            products = sum(16 * (blur + 2) ** 2 for blur in blurs)
            # Seconds of one machine, for the ratio of stages' work: per point of a plane; per pixel and step of a run,
            # and per product of a pixel with an element in it; below, per pixel of a white picture.
            return 64 * 0.04 * len(blurs), steps * self._size * (1e-7 + 8e-11 * products)

        tried = [] if self._planes else distances_of(self.camera, *_SEARCHED)
        search = [sum(map(sum, (run([plane], _SEARCH_STEPS) for plane in tried)))] if tried else []
        points, runs = run(self._planes or [self.camera.focus_distance] * _MOST_PLANES)
        of_light = [points + runs, *[runs] * (len(STRENGTHS) * SEEDS)]
        camera = 1e-5 * self.pictures.white.size
        return [camera, camera, *search, *of_light, *of_light, runs, runs, points + runs, runs]

    def fit_cameras(self) -> None:
        """Fit the camera to the white picture by both lights."""
        self.stages.expect(self.work())
        for light in LIGHTS:
            self.model(light)

    def answer(self) -> Answer:
        """Run what `fit_cameras` has not run, and return the answer."""
        squares = {}
        # All runs of one projection follow each other.
        for light in LIGHTS:
            for test in TESTS:
                squares[light, test] = np.sum([self.squares(light, test, seed) for seed in range(SEEDS)], axis=0)
            self.simulated(light)
        control = {(light, of): self.squares(light, "pixels", 0, of) for light in reversed(LIGHTS) for of in LIGHTS}
        return Answer(
            ratios={test: Ratio.of(*(squares[light, test] for light in LIGHTS)) for test in TESTS},
            relative={light: {test: self.relative(light, test) for test in TESTS} for light in LIGHTS},
            strengths={light: {test: self.strength(light, test) for test in TESTS} for light in LIGHTS},
            stray={light: self.scene(light)[1] for light in LIGHTS},
            controls={of: Ratio.of(*(control[light, of] for light in LIGHTS)) for of in LIGHTS},
            distances=self.distances,
            noise=self.pictures.noise.source,
        )
