"""Scenes from captures: textured planes fitted to raw micro-images with the wave model and the ray model.

The scene is Mitsuba's: a wall and shapes in front of it, all emitters with random textures, at depths that are not
those of the planes. Wave captures of it from several positions, with the noise of a detector, are explained by planes
once with each model. Judged are views that no capture saw: pinholes, rendered of the scene by Mitsuba's `perspective`
and `path`, and of the planes by the same pinholes. A third fit explains ray captures with the ray model, which is what
light without diffraction would allow.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

from mitsuba_plenoptic import Detector, PlenopticCamera, expose, render_capture
from mitsuba_plenoptic.fitting import Layers, fit_layers

from .. import Row, case

WAVELENGTH = 633.0


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
