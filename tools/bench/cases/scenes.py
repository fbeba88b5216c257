"""Wave captures of scenes whose light does not come straight from matte things, or differs over the pupil.

Lamps in focus: light of wave captures against closed forms, before small pupils and by few samples.

Small pupils spread light over many lenses. The light in a square of the array is the integral over frequencies of the
spectra of lamp and square times the pupil's transfer function (Goodman, "Introduction to Fourier Optics", section 6.3).
Micro-images there are a pupil's, so that the detector receives the same light behind the square but for what
microlenses spread beyond its edge.
"""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, reconstruct, render_capture, scene_path, with_camera
from mitsuba_plenoptic.report.metrics import capture_difference, middle_of_micro_images, rounded

from .. import Row, at_most, case, pick
from ..measures import mean_of_seeds, relative, spot_filtered, without_noise, write_comparison
from ..scenes import pupil_light
from ..scenes.light_paths import (
    MIRROR,
    TRANSPARENT,
    WAYS,
    bars_through,
    by_signed_rays,
    captures,
    card_before,
    contrast,
    energy,
    facing,
    glass_sphere,
    half_lit,
    in_fog,
    lamp_behind_glass,
    lit_mirror,
    plastic,
    radiating,
    scene_of,
    sensor,
    slanted,
    square_behind,
)
from ..timing import once


def _row(name: str, measured: float, aim: float, limit: float) -> Row:
    stated = f"{aim:.3f} +- {limit:g}" if aim else f"{limit:g}"
    return {"name": name, "measured": measured, "stated": stated, "off": abs(measured - aim), "limit": limit}


def _energy(name: str, by_rays: Capture, by_waves: Capture) -> Row:
    return _row(f"{name}: energy, waves over rays", energy(by_rays, by_waves), 1.0, 0.015)


def sky_behind_a_card() -> Iterator[Row]:
    """Refocus a black card, in focus at 1000 mm, before skies, and look at the third bin from its edge."""
    for name, sky in (("constant", {"type": "constant"}), ("envmap", {"type": "envmap", "bitmap": _even_sky()})):
        by_rays, by_waves = captures(card_before(sky=sky))
        columns = reconstruct(by_waves, 1000.0).image[4:-4].mean(axis=0)
        yield _row(f"black card before {name}: third bin inside it", float(columns[len(columns) // 2 - 3]), 0.0, 0.03)
        yield _energy(f"black card before {name}", by_rays, by_waves)


def _even_sky() -> Any:
    return mi.Bitmap(np.ones((4, 8, 3), np.float32))


def transparent_cards() -> Iterator[Row]:
    """Put cards that change nothing before a square."""
    without = by_signed_rays(square_behind()).image
    for name, card in TRANSPARENT.items():
        behind = by_signed_rays(square_behind(card)).image
        yield _row(f"square behind {name}: relative L2", relative(behind, without), 0.0, 0.02)


def bars_seen_through() -> Iterator[Row]:
    """Refocus bars at the distance where they seem to be, directly and through many things."""
    direct: tuple[float, float] | None = None
    for way in WAYS:
        by_rays, by_waves = captures(bars_through(way))
        rays, waves = (contrast(capture, 300.0) for capture in (by_rays, by_waves))
        direct = direct or (rays, waves)
        yield _row(f"bars, {way}: contrast", waves, direct[1] * rays / direct[0], 0.03)
        yield _energy(f"bars, {way}", by_rays, by_waves)


def energies() -> Iterator[Row]:
    """Compare the sums of ray and wave captures."""
    scenes: dict[str, Callable[[], Any]] = {
        "absorbing fog": in_fog,
        "lamp behind glass": lambda: lamp_behind_glass(False),
        "lamp behind glass, hide_emitters": lambda: lamp_behind_glass(True),
        "mirror with max_depth 2": lambda: lit_mirror(2),
        "smooth plastic": plastic,
        "half-visible pupils": _half_hidden_wall,
        "rim of the field": _rim,
    }
    for name, make in scenes.items():
        yield _energy(name, *captures(make(), spp=256))
    vitrine = load_scene("vitrine", parameters={"resolution": "256", "detector_width": "1.024"})
    yield _energy("vitrine", *captures(vitrine, spp=256))


def _half_hidden_wall() -> Any:
    edge = facing(200.0, 10.0, (10.0, 0.0), bsdf={"type": "diffuse", "reflectance": 0.0})
    return scene_of(sensor(16, 16), edge=edge, wall=facing(280.0, 30.0, **radiating()))


def _rim() -> Any:
    """Return the scene of a wall at the corner of the paper's whole detector."""
    camera = sensor(128, 16)
    camera["film"] |= {"crop_offset_x": 0, "crop_offset_y": 0, "crop_width": 256, "crop_height": 256}
    return scene_of(camera, wall=facing(225.0, 30.0, **radiating()))


def slanted_edges() -> Iterator[Row]:
    """Edges out of focus of a plane at 5 degrees, by lenses of which it lies aside of where rays see it."""
    for pane in (None, "transparent mask"):
        rays, waves = (each.image.reshape(16, 16, -1).mean(axis=(1, 2))[3:11] for each in captures(slanted(pane)))
        shift = abs(float((waves - rays).sum() / rays.max()))
        yield _row(f"edge of a plane at 5 degrees{' behind a ' + pane if pane else ''}: lenses aside", shift, 0.0, 0.04)


def highlights() -> Iterator[Row]:
    """Compare the peak of a glass sphere's highlight, refocused near it."""
    # The sphere reflects 4 % of the light paths.
    by_rays, by_waves = captures(glass_sphere(), spp=1024)
    peaks = [float(reconstruct(capture, 250.0).image.max()) for capture in (by_rays, by_waves)]
    yield _row("glass sphere: peak of its highlight, waves over rays", peaks[1] / peaks[0], 1.0, 0.15)
    yield _energy("glass sphere", by_rays, by_waves)


def radiance_over_the_pupil() -> Iterator[Row]:
    """Compare micro-images of half-lit pupils.

    Those of a mirror with what it shows seen directly, those of a rough metal with rays, blurred by the microlenses'
    diffraction.
    """
    rough = {"type": "roughconductor", "material": "none", "alpha": 0.005}
    for angle in (0.0, 30.0, 90.0):
        mirrored, direct = (by_signed_rays(half_lit(bsdf, angle)).image for bsdf in (MIRROR, None))
        name = f"half-lit mirror, {angle:g} degrees, against the lamp seen directly: relative L2"
        yield _row(name, relative(mirrored, direct), 0.0, 0.02)
        by_rays, by_waves = captures(half_lit(rough, angle))
        # What lies beyond the detector blurs into its rim.
        inner = (slice(16, -16), slice(16, -16))
        expected = spot_filtered(by_rays.image, by_rays.camera)[inner]
        difference = relative(by_waves.image[inner], expected)
        yield _row(f"half-lit rough conductor, {angle:g} degrees: relative L2", difference, 0.0, 0.08)


GROUPS: dict[str, Callable[[], Iterator[Row]]] = {
    "sky": sky_behind_a_card,
    "cards": transparent_cards,
    "bars": bars_seen_through,
    "energy": energies,
    "highlight": highlights,
    "slanted": slanted_edges,
    "pupil": radiance_over_the_pupil,
}


@case(
    "scenes.light-paths",
    "Wave captures of skies, transparent cards, mirrors, glass, fog and hidden pupils against ray captures",
    {"what": "{name}", "measured": "{measured:.3f}", "limit": "{stated}"},
    (at_most("off", "limit"),),
    page="docs/reference/models.md",
    quick={"only": ("cards",)},
)
def light_paths(*, only: tuple[str, ...] = ()) -> Iterator[Row]:
    """Measure the groups."""
    for group in pick(GROUPS, only).values():
        yield from group()


@case(
    "scenes.pupil-light",
    "Scenes whose light differs over the pupil or within a lens, by signed rays, against ray captures convolved with a "
    "microlens's diffraction: quarters of micro-images, without noise",
    {
        "scene": "{scene}", "quarters of micro-images": "{difference:.2%}", "noise": "{noise:.2%}",
        "energy": "{energy:.4f}", "limit": "{limit:.0%}",
    },
    (at_most("difference", "limit"), at_most("energy_off", "energy_limit")),
    page="docs/theory/phase_space.md",
    variant="llvm_ad_rgb",
    quick={"only": ("floor",), "ray_spp": 64, "wave_spp": 16},
)  # fmt: skip
def pupil_light_scenes(*, only: tuple[str, ...] = (), ray_spp: int = 1024, wave_spp: int = 256) -> Iterator[Row]:
    """Capture each scene in both models, twice each."""
    for name, (make, limit) in pick(pupil_light.SCENES, only).items():
        scene = make()

        def rays(seed: int, scene: Any = scene) -> np.ndarray:
            taken = render_capture(scene, model="ray", spp=ray_spp, seed=seed)
            channels = np.moveaxis(np.atleast_3d(taken.image), 2, 0)
            return pupil_light.quarters(np.stack([spot_filtered(each, taken.camera) for each in channels], -1))

        def waves(seed: int, scene: Any = scene) -> np.ndarray:
            options = {"model": "wave", "method": "signed_rays", "wavelength": 633.0}
            return pupil_light.quarters(np.atleast_3d(render_capture(scene, spp=wave_spp, seed=seed, **options).image))

        (ray, ray_noise), (wave, wave_noise) = mean_of_seeds(rays, 2), mean_of_seeds(waves, 2)
        noise, total = math.hypot(ray_noise, wave_noise), float(wave.sum() / ray.sum())
        yield {
            "scene": name, "difference": without_noise(relative(wave, ray), noise), "noise": noise, "energy": total,
            "limit": limit, "energy_off": abs(total - 1), "energy_limit": 0.01 + 3 * noise,
        }  # fmt: skip


PIXELS = 32
"""Pixels of a lens at full resolution."""

REFLECTANCES = {"roughplastic": "diffuse_reflectance", "roughconductor": "specular_reflectance"}
"""What the colour of materials that become matte is called."""


def letters() -> Any:
    """Return the letters."""
    return load_scene("letters", variant="llvm_ad_mono")


def matte_still_life() -> Any:
    """Return the still life, its gloss taken away."""
    path = scene_path("still_life")
    tree = ElementTree.parse(path)
    for material in tree.iter("bsdf"):
        name = REFLECTANCES.get(material.get("type", ""))
        if name is None:
            continue
        material.set("type", "diffuse")
        for item in list(material):
            if item.get("name") == name:
                item.set("name", "reflectance")
            else:
                material.remove(item)
    for item in tree.iter("string"):
        if item.get("name") == "filename":
            item.set("value", str(path.parent / item.get("value", "")))
    with tempfile.TemporaryDirectory() as folder:
        matte = Path(folder) / "matte.xml"
        tree.write(matte)
        return load_scene(matte, variant="llvm_ad_mono")


SCENES = {
    "letters, the F in focus": (letters, (58, 55)),
    "letters, the 8 at 210 mm": (letters, (30, 71)),
    "letters, the # at 280 mm": (letters, (93, 63)),
    "matte still life": (matte_still_life, (56, 64)),
}
"""Each with the lens in the middle of its crop."""


@case(
    "scenes.points",
    "Signed rays against points, each propagated by itself; the difference (relative L2) is without the noise of both",
    {
        "scene": "{scene}", "difference": "{difference:.2%}", "noise of points": "{points_noise:.2%}",
        "of signed rays": "{rays_noise:.2%}", "energy": "{energy:.4f}", "s, points": "{points_seconds:.0f}",
        "s, signed rays": "{rays_seconds:.0f}",
    },
    (at_most("difference", 0.01),),
    page="docs/theory/phase_space.md",
    quick={"only": ("F in focus",), "lenses": 4, "points": 16, "rays": 32},
)  # fmt: skip
def points_against_signed_rays(
    output: Path,
    *,
    only: tuple[str, ...] = (),
    lenses: int = 8,
    points: int = 64,
    rays: int = 256,
    accuracy: float = 0.003,
    seeds: int = 2,
) -> Iterator[Row]:
    """Compare parts of whole scenes, seen by some lenses; energy is that of points over that of signed rays.

    At full size, 32 lenses, 256 points, accuracy 0 and four seeds, it takes hours.
    """
    for name, (load, middle) in pick(SCENES, only).items():
        first = tuple(PIXELS * (index - lenses // 2) for index in middle)
        camera = PlenopticCamera(lens_model="parabolic", crop_offset=first, crop_size=(PIXELS * lenses,) * 2)
        scene = with_camera(load(), camera)
        found: Row = {"scene": name}
        images = {}
        for method, spp, error in (("rays", rays, 0.001), ("points", points, accuracy)):
            options = {"method": "points" if method == "points" else "signed_rays", "spp": spp, "accuracy": error}

            def capture(seed: int, options: dict[str, Any] = options, scene: Any = scene) -> np.ndarray:
                return render_capture(scene, model="wave", seed=seed, **options).image

            (images[method], noise), seconds, _ = once(lambda capture=capture: mean_of_seeds(capture, seeds))
            found |= {f"{method}_noise": noise, f"{method}_seconds": seconds / seeds}
        apart = relative(images["points"], images["rays"])
        found["difference"] = without_noise(apart, found["points_noise"], found["rays_noise"])
        yield found | {"energy": float(images["points"].sum() / images["rays"].sum())}
        file = "".join(c if c.isalnum() else "_" for c in name)
        write_comparison(output / f"{file}_difference_times_10.png", images["points"], images["rays"], gain=10)


@case(
    "scenes.noise",
    "How well a comparison separates noise from diffraction: two ray captures of the letters differ by noise alone, "
    "and ray and wave capture of the Cornell box by the same from few samples as from many",
    {
        "captures": "{captures}", "pixels": "{pixels}", "samples": "{samples}", "measured": "{measured:.2%}",
        "noise": "{noise:.2%}", "without noise": "{true:.2%}", "noise alone": "{noise_alone}",
        "off that of most samples": "{off:.1%}",
    },
    (at_most("off", 0.1), at_most("not_noise", 0)),
    page="docs/theory/accuracy.md",
    quick={"lenses": 8, "samples": (256, 64)},
)  # fmt: skip
def noise(*, lenses: int = 12, samples: tuple[int, ...] = (1024, 16)) -> Iterator[Row]:
    """Compare all pixels, the middle of micro-images and their rim; the first of the samples should be the most."""
    few = min(samples)
    letters = load_scene("letters", parameters={"resolution": "384", "detector_width": "0.768"})
    for row in differences("letters, rays twice", few, *(_rays(letters, few, seed) for seed in (0, 1))):
        yield {**row, "not_noise": int(not row["noise_alone"])}
    box, most = cornell_box(lenses), {}
    for count in samples:
        wave = render_capture(box, model="wave", method="signed_rays", wavelength=633.0, spp=count, noise=True)
        for row in differences("Cornell box, rays and waves", count, _rays(box, count, 0), wave):
            if count == max(samples):
                most[row["pixels"]] = row["true"]
                yield row
            else:
                yield {**row, "off": abs(row["true"] / most[row["pixels"]] - 1)}


def _rays(scene: Any, samples: int, seed: int) -> Capture:
    """Capture by _rays, with noise."""
    return render_capture(scene, model="ray", spp=samples, seed=seed, noise=True)


def differences(captures: str, samples: int, a: Capture, b: Capture) -> list[Row]:
    """Compare over all pixels, in the middle of micro-images and at their rim."""
    middle = middle_of_micro_images(a.camera)
    return [
        {"captures": captures, "pixels": name, "samples": samples, **rounded(capture_difference(a, b, pixels))}
        for name, pixels in {"all": None, "middle": middle, "rim": ~middle}.items()
    ]


_SIZE = 60.0
"""Times the size of Mitsuba's Cornell box, whose walls are 2 apart: millimetres for a camera of an 80 mm lens."""


def cornell_box(lenses: int) -> Any:
    """Load Mitsuba's Cornell box with a plenoptic camera before it."""
    camera = PlenopticCamera(detector_width=0.064 * lenses, resolution=(32 * lenses,) * 2, lens_model="parabolic")
    larger = mi.ScalarTransform4f().scale(_SIZE)
    box = mi.cornell_box()
    for part in box.values():
        if isinstance(part, dict) and part.get("type") in ("rectangle", "cube"):
            part["to_world"] = larger @ part["to_world"]
    # The edge of the tall box, before the back wall.
    place = mi.ScalarTransform4f().look_at(origin=[0, 0, 3.9 * _SIZE], target=[-0.05 * _SIZE, 0, -_SIZE], up=[0, 1, 0])
    return mi.load_dict(box | {"sensor": camera.to_sensor() | {"to_world": place}})


WAVELENGTH = 633.0
_PIXELS = 16

STARS, STAR_LENSES, STAR_PIXELS, MARGIN = 400, 12, 20, 3.5
"""Stars of a sky, lenses across the detector, pixels across a lens, and lenses beside the stars."""


@case(
    "lamps",
    "Light of a small lamp in focus on the detector by waves, over the closed form, before pupils that diffract widely",
    {
        "pupil": "f/{f_number:g}", "Airy radius (lenses)": "{airy:.2g}", "closed form, of all light": "{part:.3f}",
        "detector": "{whole:.4f} ± {whole_error:.4f}", "closed form, nine lenses": "{inner_part:.3f}",
        "nine lenses": "{inner:.4f} ± {inner_error:.4f}",
    },
    (at_most("excess", "limit"),),
    page="docs/theory/phase_space.md",
    quick={"f_numbers": (60.0,), "samples": 32.0, "seeds": 2},
)  # fmt: skip
def lamps(
    *,
    f_numbers: tuple[float, ...] = (12.0, 30.0, 60.0, 120.0, 240.0, 600.0),
    lenses: int = 14,
    size: float = 2.0,
    samples: float = 512.0,
    seeds: int = 4,
) -> Iterator[Row]:
    """Capture a square lamp over a lens's centre; ``size`` is that of its image in lenses.

    Samples are those of a pixel at f/12. Their number grows with the square of the f-number, as lit pixels get fewer.
    """
    for number in f_numbers:
        radius = 120 / number / 2
        camera = PlenopticCamera(
            detector_width=0.064 * lenses, resolution=(_PIXELS * lenses,) * 2, aperture_radius=radius
        )
        pitch, b, scale = camera.mla_pitch, camera.mla_distance, camera.focus_distance / camera.mla_distance
        place, half = -pitch / 2 * scale, size * pitch / 2 * scale
        scene = scene_of(
            sensor(lenses, _PIXELS, aperture_radius=radius),
            lamp=facing(camera.focus_distance, half, (place, place), **radiating()),
        )
        images = [
            render_capture(
                scene, model="wave", wavelength=WAVELENGTH, spp=round(samples * (number / 12) ** 2), seed=seed
            ).image
            for seed in range(seeds)
        ]
        # A lens full of light has that of the pupil's image on the detector.
        light = size**2 * math.pi / 4 * (2 * radius * camera.detector_distance / (b * camera.pixel_size)) ** 2
        middle = (lenses // 2 - 1) * _PIXELS, (lenses // 2 + 2) * _PIXELS
        found = {}
        for name, images_of, box in (
            ("", images, (-lenses / 2, lenses / 2)),
            ("inner_", [image[middle[0] : middle[1], middle[0] : middle[1]] for image in images], (-1.0, 2.0)),
        ):
            part = _light_in(box, size, 2 * radius * pitch / (WAVELENGTH * 1e-6 * b))
            ratios = [float(image.sum(dtype=float)) / light / part for image in images_of]
            found[f"{name}part"] = part
            found["inner" if name else "whole"] = float(np.mean(ratios))
            found["inner_error" if name else "whole_error"] = float(np.std(ratios, ddof=1)) / math.sqrt(seeds)
        yield {
            "f_number": number, "airy": 1.22 * WAVELENGTH * 1e-6 * b / (2 * radius) / pitch, **found,
            "excess": abs(found["whole"] - 1), "limit": 0.01 + 3 * found["whole_error"],
        }  # fmt: skip


def _light_in(box: tuple[float, float], size: float, cut: float, count: int = 2000) -> float:
    """Return the part of a square lamp's light, centred at (1/2, 1/2), in a box along both axes; lengths in lenses."""
    frequency = (np.arange(count) + 0.5) / count * cut
    part = np.minimum(np.hypot(frequency, frequency[:, None]) / cut, 1)
    transfer = 2 / np.pi * (np.arccos(part) - part * np.sqrt(1 - part**2))
    width, aside = box[1] - box[0], (box[0] + box[1]) / 2 - 0.5
    along = np.sinc(width * frequency) * width * np.sinc(size * frequency) * np.cos(2 * np.pi * frequency * aside)
    return float(4 * (along @ transfer @ along) * (cut / count) ** 2)


def sky() -> tuple[Any, float]:
    """Return a scene of stars of random places and sizes in focus, and its light, the sum of its capture's pixels.

    A micro-image of uniform radiance 1 has pi / 4 (D1 z / b)^2 of the detector's area, and stars their part of it.
    """
    random = np.random.default_rng(1)
    pitch, step = 0.128, 1e-4
    half = (STAR_LENSES / 2 - MARGIN) * pitch
    places, sizes = random.uniform(-half, half, (STARS, 2)), random.uniform(0.002, 0.012, STARS)
    scene = scene_of(
        sensor(STAR_LENSES, STAR_PIXELS),
        **{
            f"star_{i}": facing(240.0, float(size), (float(x), float(y)), **radiating())
            for i, ((x, y), size) in enumerate(zip(places, sizes, strict=True))
        },
    )
    # Stars may overlap: their union, on a fine grid.
    axis = np.arange(-half - 0.02, half + 0.02, step)
    covered = np.zeros((len(axis),) * 2, bool)
    for place, size in zip(places, sizes, strict=True):
        rows, columns = (slice(*np.searchsorted(axis, [p - size, p + size])) for p in place)
        covered[rows, columns] = True
    lenses = covered.sum() * (step / pitch) ** 2
    return scene, lenses * math.pi / 4 * (10 * 0.512 / (120 * 0.064 / STAR_PIXELS)) ** 2


def light_of_stars(scene: Any, light: float, spp: int, seeds: int, noise: bool) -> tuple[float, float, float]:
    """Return the mean of captures' light over their stars' light, its standard error, and the least pixel."""
    images = [
        # Counts of samples share no seeds.
        render_capture(scene, model="wave", spp=spp, seed=10_000 * spp + seed, noise=noise).image
        for seed in range(seeds)
    ]
    found = [image.sum(dtype=float) / light for image in images]
    return float(np.mean(found)), float(np.std(found, ddof=1)) / math.sqrt(seeds), float(np.min(images))


@case(
    "stars",
    "Light of 400 small stars by waves over the closed form, by few and by many samples of a pixel",
    {"option noise": "{noise}", "samples": "{samples}", "light": "{mean:.4f} ± {error:.4f}", "seeds": "{seeds}"},
    (at_most("excess", "limit"),),
    page="docs/theory/phase_space.md",
    quick={"samples": (1, 16), "noisy": (2,), "scale": 0.05},
)  # fmt: skip
def stars(
    *,
    samples: tuple[int, ...] = (1, 4, 16, 64, 256, 1024),
    noisy: tuple[int, ...] = (2, 16, 128, 1024),
    scale: float = 1.0,
) -> Iterator[Row]:
    """Capture the same stars by counts of samples, without and with the option noise; ``scale`` is that of the seeds.

    The noise option compares two halves of a capture's samples, which one sample does not have.
    """
    mi.set_variant("llvm_ad_mono")
    scene, light = sky()
    for noise, counts in ((False, samples), (True, noisy)):
        for spp in counts:
            seeds = max(3, round(scale * max(20, 160 / math.sqrt(spp))))
            mean, error, _ = light_of_stars(scene, light, spp, seeds, noise)
            yield {
                "noise": "yes" if noise else "no", "samples": spp, "mean": mean, "error": error, "seeds": seeds,
                "excess": abs(mean - 1), "limit": min(0.01, 3.5 * error) if scale >= 1 else 3.5 * error,
            }  # fmt: skip
