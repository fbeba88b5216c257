"""Do waves predict the pixels of a real light field better than rays? The runs that answer it, and the answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache, cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from ...camera import PlenopticCamera, Use, require_support
from ...errors import put, refuse_if, require_wavelength
from ...io import Cache, Progress, digest
from ...linear import dark_variance
from ..calibrate.photon_transfer import PhotonTransfer, photon_transfer
from ..calibrate.white_fit import fit_white
from ..calibrate.white_frames import WhiteFrame, single_channel
from .array_part import ArrayPart, CameraModel, PartPixels
from .point_patterns import depths_of, plane_of
from .projector import VolumeProjection
from .volume_fit import VolumeFit, fit_volume
from .withheld import TESTS, Ratio, Withheld, by_lens, misfit

LIGHTS = ("waves", "rays")
CAMERAS = ("fitted", "known")

STRENGTHS = (0.001, 0.005, 0.02)
"""Strengths of the prior, of which pixels that are withheld for it choose."""

SEEDS = 3
"""Draws of withheld pixels."""

ITERATIONS = 30
"""Steps of each fit."""

BAND = 15.0
"""Nanometres by which the wavelength is changed."""


@dataclass(frozen=True)
class Pictures:
    """Pictures of a real camera, of one size: a light field, something evenly white, and no light."""

    light_field: np.ndarray
    white: np.ndarray
    dark: np.ndarray

    def __post_init__(self) -> None:
        shape = single_channel("white", self.white).shape
        for name in ("light_field", "white", "dark"):
            label = name.replace("_", " ")
            picture = single_channel(label, getattr(self, name))
            refuse_if(
                picture.shape != shape,
                f"{label} of shape {picture.shape}: it must have the pixels of the white picture, {shape}",
            )
            put(self, **{name: picture})

    @cached_property
    def noise(self) -> PhotonTransfer:
        """Gain and noise of the sensor."""
        return photon_transfer(self.white, self.dark)

    @cached_property
    def electrons(self) -> np.ndarray:
        """Electrons of the light field's pixels, flat."""
        return np.asarray(((self.light_field - self.dark) / self.noise.gain).ravel())

    @cached_property
    def good(self) -> np.ndarray:
        """Pixels, flat, that are neither saturated nor defective."""
        light = self.light_field
        return np.asarray((WhiteFrame.of(self.white, self.dark).good & (light < light.max())).ravel())


@dataclass(frozen=True)
class Answer:
    """Results of a study.

    Attributes
    ----------
    ratios : dict
        By camera (fitted, known) and test (pixels, lenses): residuals by waves and by rays, see `Ratio`.
    relative : dict
        By camera, light and test: root mean square of differences over that of the recorded pixels.
    strengths : dict
        By light and test: the strength that withheld pixels chose.
    stray : dict
        By light: part of a lens's mean light that is spread over the lens, of the fitted camera.
    controls : dict
        By the light that simulated the picture: residuals of withheld pixels.
    wavelengths : dict
        Residual of withheld pixels by waves, by wavelength in nanometres.
    """

    ratios: dict[str, dict[str, Ratio]]
    relative: dict[str, dict[str, dict[str, float]]]
    strengths: dict[str, dict[str, float]]
    stray: dict[str, float]
    controls: dict[str, Ratio]
    wavelengths: dict[float, float]

    @property
    def sound(self) -> bool:
        """Whether the test tells pictures simulated by waves from those simulated by rays."""
        return all(ratio.better == light for light, ratio in self.controls.items())

    @property
    def verdict(self) -> str:
        """A sentence that says which light predicts better, and by how much, or that the test cannot tell."""
        if not self.sound:
            return "The test cannot tell simulated pictures by rays from those by waves: it says nothing."
        said = []
        for test in TESTS:
            ratio = self.ratios["fitted"][test]
            by = f"{ratio.ratio:.3f} times (95 %: {ratio.low:.3f} to {ratio.high:.3f})"
            better = {"neither": "neither is better"}.get(ratio.better, f"{ratio.better} are better")
            said.append(f"of withheld {test}, {better}: the residual by rays is {by} that by waves")
        return "In predictions " + "; ".join(said) + "."

    def to_plain(self) -> dict[str, Any]:
        """Return all as plain values, with the verdict."""
        ratios = {
            camera: {test: asdict(ratio_of_test) for test, ratio_of_test in some.items()}
            for camera, some in self.ratios.items()
        }
        plain = {"ratios": ratios, "relative": self.relative, "strengths": self.strengths, "stray": self.stray}
        controls = {light: asdict(ratio) for light, ratio in self.controls.items()}
        wavelengths = {f"{value:g}": residual for value, residual in self.wavelengths.items()}
        return plain | {"controls": controls, "wavelengths": wavelengths, "verdict": self.verdict}


class Setup(NamedTuple):
    """A camera, fitted or as it is known, and its light: waves, of the study's wavelength or another one, or rays."""

    camera: str
    light: str
    wavelength: float | None = None


class Study:
    """The runs of a study, each a stage on disk.

    Parameters
    ----------
    pictures : Pictures
        The pictures.
    camera : PlenopticCamera
        The camera as it is known.
    wavelength : float
        Wavelength in nanometres, 15 nm or more within the range of wavelengths.
    box : (float, float, float, float)
        Left, top, right and bottom of the part of the picture, in pixels.
    stages : Cache
        Where runs are stored.
    """

    def __init__(
        self,
        pictures: Pictures,
        camera: PlenopticCamera,
        wavelength: float,
        box: tuple[float, float, float, float],
        stages: Cache,
    ) -> None:
        require_support(camera, Use.POINTS | Use.RAY_SPREADS | Use.ROUND_PUPILS)
        for side in (-BAND, BAND):
            require_wavelength(wavelength + side, f"wavelength = {wavelength:g}, which is also tried {side:+g} nm off")
        self.pictures = pictures
        self.camera = camera
        self.wavelength = wavelength
        self.box = box
        self.stages = stages
        # What is found once serves all runs; a projection takes so much memory that the last one alone is kept.
        self.model, self.predicted, self.volume = cache(self._model), cache(self._predicted), cache(self._volume)
        self.simulated, self.strength = cache(self._simulated), cache(self._strength)
        self.part = cache(lambda setup: ArrayPart(self.model(setup), self._pixels))
        self.withheld = cache(lambda seed: Withheld.drawn(self._pixels, self.pictures.good[self._pixels.pixel], seed))
        self.projector = lru_cache(1)(self._projector)

    # -- cameras ---------------------------------------------------------------------------------

    def _model(self, setup: Setup) -> CameraModel:
        """Return a camera's model, fitted to the white picture or as it is known."""
        if setup.camera == "known":
            return self.model(setup._replace(camera="fitted")).as_known(self.camera)
        length = None if setup.light == "rays" else setup.wavelength or self.wavelength

        def fitted(progress: Progress) -> dict[str, Any]:
            pictures = self.pictures
            fit = fit_white(pictures.white, self.camera, dark=pictures.dark, wavelength=length, progress=progress)
            return CameraModel.fitted(fit).to_plain()

        name = "_".join(["camera", setup.light, *([] if setup.wavelength is None else [f"{setup.wavelength:g}nm"])])
        # A fit serves all parts of the picture.
        inputs = [digest(self.pictures.white, self.pictures.dark), self.camera.to_dict()]
        return CameraModel.of(self.stages.facts(name, [inputs, length], fitted))

    @cached_property
    def _given(self) -> list[Any]:
        """What all stages depend on."""
        pictures = self.pictures
        return [digest(pictures.light_field, pictures.white, pictures.dark), self.camera.to_dict(), list(self.box)]

    @cached_property
    def _pixels(self) -> PartPixels:
        """The pixels of the part, by the lattice that waves find."""
        return PartPixels.of(self.model(Setup("fitted", "waves")), self.box)

    def _projector(self, setup: Setup) -> VolumeProjection:
        """Return the projection of a volume, whose planes are those of the known camera, on the part."""
        part = self.part(setup)
        return VolumeProjection(part, [plane_of(part, depth) for depth in depths_of(self.camera)])

    # -- runs ------------------------------------------------------------------------------------

    def _predicted(self, setup: Setup, seed: int, strength: float, simulated: str | None) -> np.ndarray:
        """Return the light of all pixels of the part (m,) that a fit to those not withheld predicts.

        `simulated` names the light by which the picture is simulated instead of recorded.
        """
        mask = self.withheld(seed).used

        def fitted(progress: Progress) -> tuple[np.ndarray, dict[str, Any]]:
            fit = self._fit(setup, self.electrons(simulated), mask, strength, progress)
            return fit.predicted[None], {"stray_light": fit.stray}

        words = [setup.camera, setup.light, f"seed_{seed}", f"{strength:g}"]
        words += [f"of_{simulated}"] if simulated else []
        words += [f"{setup.wavelength:g}nm"] if setup.wavelength else []
        inputs = [self._given, self.wavelength, ITERATIONS, words]
        return self.stages.image("_".join(words), inputs, fitted)[0].ravel()

    def _volume(self, light: str) -> tuple[np.ndarray, float]:
        """Return the volume that all pixels together give with the fitted camera, and the stray light."""
        setup = Setup("fitted", light)

        def fitted(progress: Progress) -> tuple[np.ndarray, dict[str, Any]]:
            mask = self.pictures.good[self._pixels.pixel]
            strength = self.strength(light, "pixels")
            fit = self._fit(setup, self.electrons(None), mask, strength, progress)
            return np.append(fit.volume.ravel(), np.float32(fit.stray))[None], {}

        inputs = [self._given, self.wavelength, ITERATIONS]
        flat = self.stages.image(f"volume_{light}", inputs, fitted)[0].ravel()
        return flat[:-1].reshape(self.projector(setup).source_shape), float(flat[-1])

    def _fit(
        self,
        setup: Setup,
        electrons: np.ndarray,
        used: np.ndarray,
        strength: float,
        progress: Callable[[int, int], None],
    ) -> VolumeFit:
        return fit_volume(
            self.projector(setup),
            electrons,
            used,
            dark_variance=self.dark_variance,
            strength=strength,
            iterations=ITERATIONS,
            progress=progress,
        )

    @property
    def dark_variance(self) -> float:
        """Variance of a dark pixel in electrons squared, with that of rounding."""
        noise = self.pictures.noise
        return dark_variance(noise.read_noise, noise.gain)

    def electrons(self, simulated: str | None) -> np.ndarray:
        """Return the electrons of the part's pixels, recorded, or simulated by a light."""
        if simulated is not None:
            return self.simulated(simulated)
        return np.asarray(self.pictures.electrons[self._pixels.pixel], np.float32)

    def _simulated(self, light: str) -> np.ndarray:
        """Return the electrons of a picture of the volume that rays or waves find, simulated with noise."""
        volume, stray = self.volume(light)
        projector = self.projector(Setup("fitted", light))
        direct, glow = projector.forward(volume)
        expected = np.maximum(direct + stray * glow, 0).astype(np.float64)
        generator = np.random.default_rng(0)
        noisy = generator.poisson(expected) + generator.normal(0, self.dark_variance**0.5, len(expected))
        return np.asarray(noisy, np.float32)

    def _strength(self, light: str, test: str) -> float:
        """Return the strength that the pixels withheld for it choose, with the fitted camera."""
        chosen = self.withheld(0).choosing[test]
        electrons = self.electrons(None)

        def residual(strength: float) -> float:
            predicted = self.predicted(Setup("fitted", light), 0, strength, None)
            return float(misfit(electrons, predicted, self.dark_variance)[chosen].sum())

        return min(STRENGTHS, key=residual)

    # -- the answer ------------------------------------------------------------------------------

    def squares(self, setup: Setup, test: str, seed: int, simulated: str | None = None) -> np.ndarray:
        """Return sums by lens of squared differences over noise of withheld pixels, and the pixels' number."""
        predicted = self.predicted(setup, seed, self.strength(setup.light, test), simulated)
        values = misfit(self.electrons(simulated), predicted, self.dark_variance)
        return by_lens(values, self.withheld(seed).tested[test], self._pixels)

    def relative(self, setup: Setup, test: str) -> float:
        """Return the root mean square of withheld differences over that of the recorded pixels."""
        electrons = self.electrons(None)
        totals = np.zeros(2)
        for seed in range(SEEDS):
            chosen = self.withheld(seed).tested[test]
            away = electrons - self.predicted(setup, seed, self.strength(setup.light, test), None)
            totals += [float((some[chosen] ** 2).sum(dtype=np.float64)) for some in (away, electrons)]
        return float(np.sqrt(totals[0] / totals[1]))

    def answer(self) -> Answer:
        """Run what has not been run, and return the answer."""
        squares: dict[tuple[str, str, str], np.ndarray] = {}
        strengths = {}
        volumes = {}
        # All runs of one projection follow each other.
        for light in LIGHTS:
            strengths[light] = {test: self.strength(light, test) for test in TESTS}
            volumes[light] = self.volume(light)
            self.simulated(light)
            for camera in CAMERAS:
                for test in TESTS:
                    sums_of_seeds = [self.squares(Setup(camera, light), test, seed) for seed in range(SEEDS)]
                    squares[camera, light, test] = np.sum(sums_of_seeds, axis=0)
        relative = {
            camera: {light: {test: self.relative(Setup(camera, light), test) for test in TESTS} for light in LIGHTS}
            for camera in CAMERAS
        }
        ratios = {
            camera: {test: Ratio.of(*(squares[camera, light, test] for light in LIGHTS)) for test in TESTS}
            for camera in CAMERAS
        }
        control = {
            (light, of): self.squares(Setup("fitted", light), "pixels", 0, of) for light in LIGHTS for of in LIGHTS
        }
        near = {}
        for length in (self.wavelength - BAND, self.wavelength, self.wavelength + BAND):
            another_wavelength = None if length == self.wavelength else length
            sums = self.squares(Setup("fitted", "waves", another_wavelength), "pixels", 0)
            near[length] = float(np.sqrt(sums[0].sum() / sums[1].sum()))
        return Answer(
            ratios=ratios,
            relative=relative,
            strengths=strengths,
            stray={light: stray for light, (_, stray) in volumes.items()},
            controls={of: Ratio.of(*(control[light, of] for light in LIGHTS)) for of in LIGHTS},
            wavelengths=near,
        )
