"""Fits of small cameras' parameters to captures with noise, whose spread must be as stated.

Fits of a camera of 16 x 16 lenses to noisy captures of white and of letters, again and again, at accuracy 0.

The data are a wall and the three letters, whose brightest pixels get some photons, with Poisson noise by a seed.
Pitch, offset and angle of the array, its distance, that of the detector and both focal lengths are fitted together. The
captures' derivatives are computed once, at the true camera, and stored; with them held, each fit proceeds by
Gauss-Newton steps of which each takes one capture (chord iterations). These end at the same camera as steps with
derivatives of their own do, up to the square of what the noise changes.

Most fits start within two deviations of the true camera. Some start as one would who knows little: 2 % off
in every length, by 1 degree and 0.3 pitches; the lattice is then found in the white capture, `fitting.coarse_fit` finds
a camera by rays, and the same steps follow. They must end where the fit of the same noise from near ends.

Over so few seeds the mean of the squared errors is known to the square root of 2 / seeds only (0.22 for 40). The first
step from the true camera, which takes no capture, is therefore found for a thousand noises, the fits' own among them,
too; the fits must end where this step does, and its squared errors are what those of many fits would be.

Scenes from captures: textured planes fitted to raw micro-images with the wave model and the ray model.

The scene is Mitsuba's: a wall and shapes in front of it, all emitters with random textures, at depths that are not
those of the planes. Wave captures of it from several positions, with the noise of a detector, are explained by planes
once with each model. Judged are views that no capture saw: pinholes, rendered of the scene by Mitsuba's `perspective`
and `path`, and of the planes by the same pinholes. A third fit explains ray captures with the ray model, which is what
light without diffraction would allow.
"""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from mitsuba_plenoptic import CaptureOperator, Detector, PlenopticCamera, expose, fit, render_capture
from mitsuba_plenoptic.extensions.inverse.fit_light import Pixels
from mitsuba_plenoptic.extensions.inverse.fit_result import summary
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays, WaveModel, vector_of
from mitsuba_plenoptic.fitting import Fit, Layers, PixelNoise, View, coarse_fit, fit_layers, lattice_from_white
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.units import brightness_of

from .. import Row, at_most, case
from ..scenes.letters import letter_points

WAVELENGTH = 633.0


@case(
    "fits.spread",
    "Fits of captures with other noise again and again: squared errors over stated variances, and stated deviations "
    "over the Cramer-Rao bound of the true camera",
    {
        "parameter": "{parameter}", "deviation": "{deviation:.3g}", "mean square over variance": "{square:.3f}",
        "mean error over deviation": "{mean:+.3f}", "deviation over bound, least and most": "{least:.3f}, {most:.3f}",
        "chi-square per pixel": "{chi_square:.3f}",
    },
    (at_most("square_off", 0.25), at_most("bound_off", 0.2)),
    page="docs/guides/fitting.md",
    quick={"seeds": 1, "points": 2, "accuracy": 0.1},
)  # fmt: skip
def spread(
    *,
    lenses: int = 2,
    points: int = 6,
    seeds: int = 40,
    photons: float = 2000.0,
    model: str = "wave",
    accuracy: float = 0.0,
    off: float = 0.005,
    parameters: tuple[str, ...] = ("mla_pitch", "mla_offset", "detector_distance"),
) -> Iterator[Row]:
    """Fit points at several distances; each fit starts off by the given part of the lengths."""
    side = 0.064 * lenses
    camera = PlenopticCamera(
        detector_width=side, resolution=(32 * lenses,) * 2, focal_length=40.0, aperture_radius=2.5, mla_distance=60.0
    )
    rng = np.random.default_rng(0)
    g = rng.uniform(112, 128, points)
    places = np.column_stack([rng.uniform(-0.4, 0.4, (points, 2)) * side * -g[:, None] / 60, g])
    if model == "ray":
        image = PointRays(camera, places, WAVELENGTH).image(OpticalSystem(camera, WAVELENGTH), np.ones(points))
    else:
        operator = CaptureOperator(camera, places, wavelength=WAVELENGTH, accuracy=accuracy)
        image = operator.forward(np.ones(points)).astype(np.float64)
    image *= brightness_of(camera, main_lens(camera))
    weights = np.full(points, 1 / image.max())
    image /= image.max()
    common = {"wavelength": WAVELENGTH, "photons": photons, "accuracy": accuracy, "model": model}
    # A fit of what the true camera records without noise ends there, and states the bound.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that chi-square is 0
        bound = fit(camera, View(image, places, weights), parameters, **common)
    fits = []
    for seed in range(seeds):
        noise = np.random.default_rng(seed + 1)
        counted = noise.poisson(np.maximum(image, 0) * photons) / photons
        away = {
            "mla_pitch": camera.mla_pitch * (1 + noise.uniform(-1, 1) * off),
            "mla_offset": tuple(noise.uniform(-0.3, 0.3, 2) * off * camera.mla_pitch),
        }
        # Parameters that are not fitted are right.
        start = camera.replace(**{name: value for name, value in away.items() if name in parameters})
        fits.append(fit(start, View(counted, places, weights), parameters, **common))
    for name, deviation in bound.deviations.items():
        errors = np.array([(each.values[name] - bound.values[name]) / each.deviations[name] for each in fits])
        stated = np.array([each.deviations[name] for each in fits]) / deviation
        square = float((errors**2).mean())
        yield {
            "parameter": name,
            "deviation": deviation,
            "square": square,
            "mean": errors.mean(),
            "least": stated.min(),
            "most": stated.max(),
            "chi_square": np.mean([each.chi_square for each in fits]),
            # Of so few seeds nothing follows.
            "square_off": abs(square - 1) if seeds >= 40 else None,
            "bound_off": float(np.abs(stated - 1).max()),
        }


NAMES = (
    "mla_pitch", "mla_offset", "mla_rotation", "mla_distance", "detector_distance", "mla_focal_length", "focal_length"
)  # fmt: skip

WALL = 110.0
"""Distance of the wall, whose points are blurred over three to four lenses."""

STEPS, BIAS_STEPS, FAR_STEPS = 2, 4, 8

NOISES = 1000

Array = NDArray[np.float64]


@case(
    "fits.noise",
    "Fits of 16 x 16 lenses to noisy captures of a wall and letters at accuracy 0; errors and steps in deviations",
    {
        "parameter": "{parameter}", "deviation": "{deviation:.3g}", "mean square over variance": "{square:.2f}",
        "of first steps": "{first:.2f}", "fits from first steps": "{apart:.3f}", "mean": "{mean:+.2f}",
        "variance over bound": "{variance[0]:.3f} to {variance[1]:.3f}", "last step": "{last:.3f}",
        "from afar": "{far:.3f}", "bias": "{bias:+.2f}",
    },
    (
        at_most("square_off", 0.25),
        at_most("first_off", 0.25),
        at_most("apart", 0.25),
        at_most("variance_off", 0.2),
        at_most("last", 0.05),
        at_most("far", 0.05),
    ),
    page="docs/guides/fitting.md",
    quick={"lenses": 4, "seeds": 2, "far": 0, "derivatives": 0.05},
)  # fmt: skip
def noise(
    output: Path,
    *,
    lenses: int = 16,
    pixels: int = 8,
    seeds: int = 40,
    far: int = 2,
    photons: float = 2000.0,
    derivatives: float = 0.004,
    noises: int = NOISES,
    minutes: float = 35.0,
) -> Iterator[Row]:
    """Fit as many seeds as the minutes allow; a further run continues behind those that are stored.

    ``far`` of them are also fitted from afar, ``derivatives`` is the accuracy of the derivatives. The bias is that of
    data from other points at default accuracy.
    """
    began = time.monotonic()
    camera = PlenopticCamera(
        focal_length=40.0, aperture_radius=2.5, mla_distance=60.0, mla_rotation=0.3, mla_offset=(0.01, -0.017),
        detector_width=0.064 * lenses, resolution=(pixels * lenses,) * 2,
    )  # fmt: skip
    study = Study(camera, [wall(camera, 1), letters(lenses, 1)], photons)
    study.differentiate(derivatives, output)
    stored = output / "fits.json"
    known = json.loads(stored.read_text()) if stored.exists() else {}
    fits: list[dict[str, Any]] = known["fits"][:seeds] if known.get("key") == study.key else []
    # Along the directions that are separated, so that none starts further off than the data resolve.
    root = study.unit[:, None] * np.array(
        [[part * one.deviation for part in one.parts.values()] for one in study.stated(study.images).directions]
    ).T  # fmt: skip
    for seed in range(len(fits), seeds):
        if time.monotonic() - began > 60 * minutes:
            break
        near = study.true + root @ np.random.default_rng(1000 + seed).uniform(-2, 2, len(study.true))
        fits.append(study.settle(near, study.noisy(seed + 1), STEPS))
        stored.write_text(json.dumps({"key": study.key, "fits": fits}))
    bias = study.settle(study.true, study.recorded([wall(camera, 3), letters(lenses, 2)]), BIAS_STEPS)["error"]
    afar = [
        far_difference(study, study.noisy(seed + 1), np.random.default_rng(2000 + seed), found)
        for seed, found in enumerate(fits[:far])
    ]
    first, deviations = study.first_steps(max(noises, len(fits))), study.deviations(study.images)
    errors, variances, last = (np.array([each[key] for each in fits]) for key in ("error", "variance", "last"))
    for number, label in enumerate(study.labels):
        square, of_first = float((errors[:, number] ** 2).mean()), float((first[:, number] ** 2).mean())
        variance = variances[:, number]
        yield {
            "parameter": label,
            "deviation": deviations[number],
            "square": square,
            "square_off": abs(square - 1) if len(fits) >= 40 else None,
            "first": of_first,
            "first_off": abs(of_first - 1),
            "apart": float(np.abs(errors - first[: len(fits)])[:, number].max()),
            "mean": errors[:, number].mean(),
            "variance": [variance.min(), variance.max()],
            "variance_off": float(np.abs(variance - 1).max()),
            "last": float(last[:, number].max()),
            "far": max((each[number] for each in afar), default=None),
            "bias": bias[number],
            "seeds": len(fits),
        }


def wall(camera: PlenopticCamera, per_lens: int) -> tuple[Array, Array]:
    """Return points of a wall, `per_lens` to a lens along an axis, two lenses beyond the detector's border."""
    step = camera.detector_width / round(camera.detector_width / camera.mla_pitch) / per_lens
    half = round(camera.detector_width / 2 / step) + 2 * per_lens
    place = (np.arange(-half, half) + 0.63) * step
    x, y = (-part.ravel() * WALL / camera.mla_distance for part in np.meshgrid(place, place))
    return np.column_stack([x, y, np.full(x.size, WALL)]), np.full(x.size, 1.0 / per_lens**2)


def letters(lenses: int, per_lens: int) -> tuple[Array, Array]:
    """Return points of the letters, `per_lens` to a lens along an axis, for the paper's camera at half its size."""
    side = 0.128 * lenses
    camera = PlenopticCamera(detector_width=side, resolution=(64 * lenses,) * 2)
    points, weights = letter_points(camera, side / 8.192, per_lens**2)
    return points / 2, weights


class Study:
    """What the fits have in common: the true camera, its captures, the light, and its derivatives.

    Parameters
    ----------
    camera : PlenopticCamera
        The true one.
    lights : list of pairs
        Points and weights of each view.
    photons : float
        Of the brightest pixel of each.
    """

    def __init__(self, camera: PlenopticCamera, lights: list[tuple[Array, Array]], photons: float) -> None:
        self.camera, self.photons = camera, photons
        self.vector = vector_of(camera, NAMES)
        self.labels = self.vector.labels
        self.true, self.unit = self.vector.values, self.vector.scales
        self.lights = lights
        # In units in which the brightest pixel of each view is 1.
        self._tops = [1.0] * len(lights)
        self._tops = [float(image.max()) for image in self.expected(self.true)]
        self.images = self.expected(self.true)

    def views(self, images: Array, lights: list[tuple[Array, Array]]) -> list[View]:
        """Return views of some images, with the light in their units."""
        given = zip(images, lights, self._tops, strict=True)
        return [View(image, points, weights / top) for image, (points, weights), top in given]

    def expected(self, x: Array) -> Array:
        """Return what the camera with these parameters records at accuracy 0."""
        camera = self.vector.at(x)
        blank = np.zeros((len(self.lights), *camera.shape))
        return WaveModel(camera, self.views(blank, self.lights), WAVELENGTH, 0.0).images()

    def recorded(self, lights: list[tuple[Array, Array]]) -> Array:
        """Return captures of other points, whose total power is the same, at default accuracy."""
        images = []
        for (points, weights), (_, own), top in zip(lights, self.lights, self._tops, strict=True):
            operator = CaptureOperator(self.camera, points, wavelength=WAVELENGTH)
            scale = brightness_of(self.camera, main_lens(self.camera)) / top * float(own.sum() / weights.sum())
            images.append(scale * operator.forward(weights))
        return np.stack(images).astype(np.float64)

    def noisy(self, seed: int) -> Array:
        """Return the true captures with the noise of photons."""
        rng = np.random.default_rng(seed)
        return rng.poisson(np.maximum(self.images, 0) * self.photons) / self.photons

    def differentiate(self, accuracy: float, folder: Path) -> None:
        """Find the derivatives at the true camera, in `scales`, or take those that are stored."""
        file = folder / "derivatives.npz"
        key = [self.camera.to_dict(), accuracy, [len(points) for points, _ in self.lights], NAMES]
        self.key = json.dumps([*key, self.photons])
        if file.exists() and str(np.load(file)["key"]) == self.key:
            self.slopes = np.load(file)["slopes"]
            return
        model = WaveModel(self.camera, self.views(self.images, self.lights), WAVELENGTH, accuracy)
        self.slopes = model.derivatives(self.vector, self.images) * self.unit[:, None, None, None]
        np.savez(file, key=self.key, slopes=self.slopes)

    def _rows(self, images: Array) -> tuple[Array, Pixels]:
        """Return the weighted derivatives, (pixels, parameters), and the noise that fits weight by."""
        pixels = Pixels.of(self.views(images, self.lights), images, PixelNoise(self.photons))
        return (self.slopes / pixels.weight).reshape(len(self.labels), -1).T, pixels

    def stated(self, images: Array, residuals: Array | None = None) -> Fit:
        """Return what a fit states that ends at such pixels, with these weighted residuals."""
        rows, pixels = self._rows(images)
        limits = self.vector.limits(None)
        left = np.zeros(len(rows)) if residuals is None else residuals
        return summary(self.camera, self.labels, self.true, self.unit, limits, rows, left, pixels, 1)

    def deviations(self, images: Array) -> Array:
        """Return the stated standard deviations of the parameters."""
        return np.array(list(self.stated(images).deviations.values()))

    def first_steps(self, seeds: int) -> Array:
        """Return the step from the true camera for each noise over the stated deviations, (seeds, parameters)."""
        rows, pixels = self._rows(self.images)
        inverse = self.unit[:, None] * np.linalg.pinv(rows) / self.deviations(self.images)[:, None]
        noises = (self.noisy(seed + 1) - self.images for seed in range(seeds))
        return np.stack([inverse @ (noise / pixels.weight).ravel() for noise in noises])

    def settle(self, x: Array, seen: Array, steps: int) -> dict[str, Any]:
        """Go to where, by the derivatives that are held, the squared residuals are least."""
        for _ in range(steps):
            images = self.expected(x)
            rows, pixels = self._rows(images)
            residuals = ((seen - images) / pixels.weight).ravel()
            step = self.unit * np.linalg.lstsq(rows, residuals, rcond=None)[0]
            x = x + step
        found = self.stated(images, residuals - rows @ (step / self.unit))
        stated = np.array(list(found.deviations.values()))
        return {
            "x": x.tolist(),
            "error": ((x - self.true) / stated).tolist(),
            "variance": ((stated / self.deviations(self.images)) ** 2).tolist(),
            "last": np.abs(step / stated).tolist(),
            "chi_square": found.chi_square,
        }


def far_difference(study: Study, images: Array, rng: np.random.Generator, near: dict[str, Any]) -> list[float]:
    """Fit from afar, and return how far from the fit from near it ends, over the deviations."""
    off: dict[str, Any] = {
        name: getattr(study.camera, name) * (1 + rng.choice((-0.02, 0.02)))
        for name in ("mla_pitch", "mla_distance", "detector_distance", "mla_focal_length", "focal_length")
    }
    away = 0.3 * study.camera.mla_pitch * rng.choice((-1, 1), 2)
    off["mla_offset"] = tuple((np.array(study.camera.mla_offset) + away).tolist())
    off["mla_rotation"] = study.camera.mla_rotation + rng.choice((-1, 1))
    start = lattice_from_white(study.camera.replace(**off), images[0])
    views = study.views(images, study.lights)
    coarse = study.vector.of(coarse_fit(start, views, NAMES, wavelength=WAVELENGTH)).values
    settled = study.settle(coarse, images, FAR_STEPS)
    difference = np.array(settled["x"]) - np.array(near["x"])
    return np.abs(difference / study.deviations(study.images)).tolist()


PITCH, PIXELS, F_NUMBER, FILL, MLA_DISTANCE = 0.016, 8, 8.0, 0.7, 120.0

MIDDLE, NEAREST, FARTHEST = 240.0, 237.0, 243.0
"""The distance in focus, and the depths of the scene."""

ASIDE, VIEWS_ASIDE = 6.0, 4.0
"""Distance of the captures, and of the unseen views, from the axis."""

VIEWS, VIEW_PIXELS, VIEW_WIDTH, VIEW_SPP = 8, 32, 0.4, 64

FITS = {"wave model": ("wave", "wave"), "ray model": ("wave", "ray"), "ray model of ray captures": ("ray", "ray")}
"""Models of the captures and of the fit."""

PHOTONS = 2000.0


@case(
    "radiance-fits",
    "PSNR (dB) of 8 unseen views of textured planes fitted to raw captures, over seeds",
    {"planes fitted with": "{what}", "PSNR (dB)": "{psnr}", "single seeds": "{each}", "one scale for all": "{scaled}"},
    page="docs/guides/inverse_problems.md",
    quick={"seeds": 1, "lenses": 6, "rounds": 2, "positions": 2},
)
def radiance_fits(
    *, seeds: int = 5, lenses: int = 16, positions: int = 5, planes: int = 6, rounds: int = 15, spp: int = 16
) -> Iterator[Row]:
    """Fit the scenes of some seeds with both models, and judge unseen views."""
    found = [fits_of(seed, lenses, positions, planes, rounds, spp) for seed in range(seeds)]
    for what in (*FITS, "one grey"):
        plain, scaled = ([each[what][kind] for each in found] for kind in (0, 1))
        each = ", ".join(f"{value:.1f}" for value in plain)
        yield {
            "what": what,
            "values": plain,
            "psnr": with_deviation(plain),
            "scaled": with_deviation(scaled),
            "each": each,
        }


def with_deviation(values: list[float]) -> str:
    """Return a mean with the standard deviation of single values."""
    return f"{np.mean(values):.1f}" + (f" +- {np.std(values, ddof=1):.1f}" if len(values) > 1 else "")


def camera_of(lenses: int) -> PlenopticCamera:
    """Return the camera: microlenses of f/8 that are hardly wider than their diffraction."""
    return PlenopticCamera(
        mla_pitch=PITCH, mla_focal_length=F_NUMBER * PITCH, aperture_radius=FILL * MLA_DISTANCE / F_NUMBER / 2,
        detector_width=lenses * PITCH, resolution=(lenses * PIXELS, lenses * PIXELS), lens_model="parabolic",
    )  # fmt: skip


def texture(rng: np.random.Generator, width: float) -> dict[str, Any]:
    """Return a random pattern with details of one to three lenses in the object."""
    texels = 64
    size = rng.uniform(1, 3) * 2 * PITCH / width * texels / 2.5
    field = gaussian_filter(rng.normal(size=(texels, texels)), size, mode="wrap")
    pattern = np.clip(rng.uniform(0.3, 0.7) + 0.25 * field / field.std(), 0.02, 1).astype(np.float32)
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(pattern[..., None])}


def scene_of(rng: np.random.Generator, width: float) -> dict[str, Any]:
    """Describe a wall and shapes in front of it, all of which shine."""
    transform = mi.ScalarTransform4f

    def shape(kind: str, x: float, y: float, z: float, size: float, turned: float) -> dict[str, Any]:
        placed = transform().translate([x, y, z]) @ transform().rotate([0, 1, 0], 180)
        placed = placed @ transform().rotate([0, 0, 1], turned) @ transform().scale(size / 2)
        emitter = {"type": "area", "radiance": texture(rng, size)}
        return {"type": kind, "to_world": placed, "emitter": emitter, "bsdf": {"type": "diffuse", "reflectance": 0.0}}

    scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": 2}}
    scene["wall"] = shape("rectangle", 0, 0, FARTHEST, 1.6 * width, 0)
    for index in range(4):
        x, y = rng.uniform(-0.3, 0.3, 2) * width
        z, size, turned = rng.uniform(NEAREST, FARTHEST - 1), rng.uniform(0.2, 0.4) * width, rng.uniform(0, 90)
        scene[f"shape{index}"] = shape(("rectangle", "disk")[index % 2], x, y, z, size, turned)
    return scene


def around(count: int, radius: float, start: float = 0.0) -> list[Any]:
    """Return cameras on a circle around the axis that look at its middle."""
    angles = start + 2 * math.pi * np.arange(count) / count
    return [
        mi.ScalarTransform4f().look_at(
            origin=[radius * math.cos(a), radius * math.sin(a), 0], target=[0, 0, MIDDLE], up=[0, 1, 0]
        )
        for a in angles
    ]


def views(scene: Any, integrator: Any, width: float) -> np.ndarray:
    """Render what pinholes see that no capture was made from."""
    fov = math.degrees(2 * math.atan(width / 2 / MIDDLE))
    film = {"type": "hdrfilm", "width": VIEW_PIXELS, "height": VIEW_PIXELS, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "luminance", "component_format": "float32"}
    made = []
    for pose in around(VIEWS, VIEWS_ASIDE, 0.2):
        pinhole = mi.load_dict({"type": "perspective", "fov": fov, "to_world": pose, "film": film})
        made.append(np.array(integrator.render(scene, pinhole, seed=0, spp=VIEW_SPP))[..., 0])
    return np.stack(made)


def fits_of(
    seed: int, lenses: int, positions: int, planes: int, rounds: int, spp: int
) -> dict[str, tuple[float, float]]:
    """Return the PSNR of the unseen views of one scene by each fit and by one grey, plain and with the best scale."""
    rng, camera = np.random.default_rng([7, seed]), camera_of(lenses)
    width = camera.detector_width * MIDDLE / MLA_DISTANCE
    described = scene_of(rng, width)
    poses = [*around(1, 0.0), *around(positions - 1, ASIDE)]
    captures: dict[str, list[Any]] = {"ray": [], "wave": []}
    for index, pose in enumerate(poses):
        scene = mi.load_dict(described | {"sensor": camera.to_sensor(pose)})
        for model, options in (("ray", {}), ("wave", {"wavelength": WAVELENGTH})):
            made = render_capture(scene, model=model, spp=64, seed=100 * seed + index, **options)
            captures[model].append(expose(made, Detector(), photons=PHOTONS, seed=100 * seed + index))
    truth = views(scene, scene.integrator(), VIEW_WIDTH / 0.512 * width)
    depths = np.linspace(NEAREST - 0.5, FARTHEST + 0.5, planes).tolist()
    # Wide enough for what all cameras see, with a texel or two more than there are lenses' halves.
    widths = [1.5 * width] * planes
    texels = 3 * lenses
    level = float(np.mean([capture.image.mean() for capture in captures["wave"]])) / (math.pi / 4 * FILL**2)
    opacity = np.full((planes, texels, texels), 0.2)
    opacity[-1] = 1
    start = Layers(depths, widths, np.full(opacity.shape, level), opacity)
    found = {"one grey": scores(np.full_like(truth, truth.mean()), truth)}
    for what, (by, model) in FITS.items():
        layers = fit_layers(captures[by], poses, start, model=model, rounds=rounds, spp=spp, seed=seed)
        seen = layers.scene(camera.to_sensor())
        found[what] = scores(views(seen, seen.integrator(), VIEW_WIDTH / 0.512 * width), truth)
    return found


def scores(images: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the mean PSNR of images, whose radiance is at most 1, in dB, and that with the one best scale."""
    scale = float((images * truth).sum() / (images * images).sum())
    plain, scaled = (np.square(factor * images - truth).mean(axis=(1, 2)) for factor in (1.0, scale))
    return float(np.mean(-10 * np.log10(plain))), float(np.mean(-10 * np.log10(scaled)))
