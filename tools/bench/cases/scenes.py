"""Wave captures of scenes whose light does not come straight from matte things, and of matte scenes point by point."""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from cases import (
    MIRROR,
    PANES,
    TRANSPARENT,
    bars_through,
    by_signed_rays,
    captures,
    card_before,
    contrast,
    energy,
    facing,
    half_lit,
    in_fog,
    lamp_behind_glass,
    lit_mirror,
    plastic,
    radiating,
    relative,
    scene_of,
    sensor,
    slanted,
    spot_filtered,
    square_behind,
)

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, reconstruct, render_capture, scene_path, with_camera

from .. import Row, at_most, case, pick
from ..measures import mean_of_seeds, without_noise, write_comparison
from ..timing import once


def glass_sphere(angle: float = 20.0, lenses: int = 8) -> Any:
    """Return the scene of a glass sphere that shows a lamp by reflection on the axis, at this angle of incidence."""
    tilt = math.radians(angle)
    centre = [20 * math.sin(tilt), 0.0, 240 + 20 * math.cos(tilt)]
    place = [-200 * math.sin(2 * tilt), 0.0, 240 - 200 * math.cos(2 * tilt)]
    sphere = {"type": "sphere", "center": centre, "radius": 20.0, "bsdf": {"type": "dielectric"}}
    lamp = {"type": "sphere", "center": place, "radius": 3.0, **radiating(100.0)}
    return scene_of(sensor(lenses, 16), sphere=sphere, lamp=lamp)


def _row(name: str, measured: float, aim: float, limit: float) -> Row:
    stated = f"{aim:.3f} +- {limit:g}" if aim else f"{limit:g}"
    return {"name": name, "measured": measured, "stated": stated, "off": abs(measured - aim), "limit": limit}


def _energy(name: str, by_rays: Capture, by_waves: Capture) -> Row:
    return _row(f"{name}: energy, waves over rays", energy(by_rays, by_waves), 1.0, 0.015)


def sky_behind_a_card() -> Iterator[Row]:
    """Refocus a black card, in focus at 1000 mm, before skies, and look at the third bin from its edge."""
    even = mi.Bitmap(np.ones((4, 8, 3), np.float32))
    for name, sky in (("constant", {"type": "constant"}), ("envmap", {"type": "envmap", "bitmap": even})):
        by_rays, by_waves = captures(card_before(sky=sky))
        columns = reconstruct(by_waves, 1000.0).image[4:-4].mean(axis=0)
        yield _row(f"black card before {name}: third bin inside it", float(columns[len(columns) // 2 - 3]), 0.0, 0.03)
        yield _energy(f"black card before {name}", by_rays, by_waves)


def transparent_cards() -> Iterator[Row]:
    """Put cards that change nothing before a square."""
    without = by_signed_rays(square_behind()).image
    for name, card in TRANSPARENT.items():
        behind = by_signed_rays(square_behind(card)).image
        yield _row(f"square behind {name}: relative L2", relative(behind, without), 0.0, 0.02)


def bars_seen_through() -> Iterator[Row]:
    """Refocus bars at the distance where they seem to be, directly and through many things."""
    direct: tuple[float, float] | None = None
    for way in ("directly", "mirror", *PANES, "slab", "fog"):
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
