"""Measure whether captures by waves are right where light does not come straight from matte things.

Prints each measure with its limit, exits with 1 if one is beyond it, and writes ``any_scene_accuracy.md`` and ``.json``
to the folder that ``--output`` names. The accuracy of small and gapped lenses and of extreme cameras is measured by
``point_spread_accuracy.py`` and ``lattice_accuracy.py``.

    python tools/any_scene_accuracy.py --output out/any_scene_accuracy [--only mirror --only fog]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from any_scenes import (
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
from when_do_rays_fail import diffract

from mitsuba_plenoptic import load_scene, reconstruct


@dataclass(frozen=True)
class Row:
    """A measure with what is aimed at, and by how much it may differ from that."""

    name: str
    measured: float
    aim: float
    limit: float

    @property
    def passes(self) -> bool:
        """Whether it is within the limit."""
        return abs(self.measured - self.aim) <= self.limit


def _energy(name: str, by_rays: Any, by_waves: Any) -> Row:
    return Row(f"{name}: energy, waves over rays", energy(by_rays, by_waves), 1.0, 0.015)


def _difference(image: Any, reference: Any) -> float:
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def sky_behind_a_card() -> Iterator[Row]:
    """Refocus a black card, in focus at 1000 mm, before skies, and look at the third bin from its edge."""
    for name, sky in (("constant", {"type": "constant"}), ("envmap", {"type": "envmap", "bitmap": _even_sky()})):
        by_rays, by_waves = captures(card_before(sky=sky))
        columns = reconstruct(by_waves, 1000.0).image[4:-4].mean(axis=0)
        yield Row(f"black card before {name}: third bin inside it", float(columns[len(columns) // 2 - 3]), 0.0, 0.03)
        yield _energy(f"black card before {name}", by_rays, by_waves)


def _even_sky() -> Any:
    return mi.Bitmap(np.ones((4, 8, 3), np.float32))


def transparent_cards() -> Iterator[Row]:
    """Put cards that change nothing before a square."""
    without = by_signed_rays(square_behind()).image
    for name, card in TRANSPARENT.items():
        behind = by_signed_rays(square_behind(card)).image
        yield Row(f"square behind {name}: relative L2", _difference(behind, without), 0.0, 0.02)


def bars_seen_through() -> Iterator[Row]:
    """Refocus bars at the distance where they seem to be, directly and through many things."""
    direct: tuple[float, float] | None = None
    for way in WAYS:
        by_rays, by_waves = captures(bars_through(way))
        rays, waves = (contrast(capture, 300.0) for capture in (by_rays, by_waves))
        direct = direct or (rays, waves)
        yield Row(f"bars, {way}: contrast", waves, direct[1] * rays / direct[0], 0.03)
        yield _energy(f"bars, {way}", by_rays, by_waves)


def energies() -> Iterator[Row]:
    """Compare the sums of captures by rays and by waves."""
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
        yield Row(f"edge of a plane at 5 degrees{' behind a ' + pane if pane else ''}: lenses aside", shift, 0.0, 0.04)


def highlights() -> Iterator[Row]:
    """Compare the peak of a glass sphere's highlight, refocused near it."""
    # The sphere reflects 4 % of the light paths.
    by_rays, by_waves = captures(glass_sphere(), spp=1024)
    peaks = [float(reconstruct(capture, 250.0).image.max()) for capture in (by_rays, by_waves)]
    yield Row("glass sphere: peak of its highlight, waves over rays", peaks[1] / peaks[0], 1.0, 0.15)
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
        yield Row(name, _difference(mirrored, direct), 0.0, 0.02)
        by_rays, by_waves = captures(half_lit(rough, angle))
        # What lies beyond the detector blurs into its rim.
        inner = (slice(16, -16), slice(16, -16))
        expected = diffract(by_rays.image, by_rays.camera)[inner]
        difference = _difference(by_waves.image[inner], expected)
        yield Row(f"half-lit rough conductor, {angle:g} degrees: relative L2", difference, 0.0, 0.08)


GROUPS: dict[str, Callable[[], Iterator[Row]]] = {
    "sky": sky_behind_a_card,
    "cards": transparent_cards,
    "bars": bars_seen_through,
    "energy": energies,
    "highlight": highlights,
    "slanted": slanted_edges,
    "pupil": radiance_over_the_pupil,
}


def main() -> int:
    """Measure all, or some groups, and return whether one is beyond its limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/any_scene_accuracy"))
    parser.add_argument("--only", action="append", choices=GROUPS, help="measure this group; repeat for several")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_mono")
    rows: list[Row] = []
    lines = ["| what | measured | limit | |", "|---|---|---|---|"]
    print(*lines, sep="\n")
    for group in arguments.only or GROUPS:
        for row in GROUPS[group]():
            rows.append(row)
            limit = f"{row.aim:.3f} +- {row.limit:g}" if row.aim else f"{row.limit:g}"
            lines.append(f"| {row.name} | {row.measured:.3f} | {limit} | {'' if row.passes else 'FAILS'} |")
            print(lines[-1], flush=True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "any_scene_accuracy.md").write_text("\n".join(lines) + "\n")
    (arguments.output / "any_scene_accuracy.json").write_text(json.dumps([asdict(row) for row in rows], indent=1))
    return int(not all(row.passes for row in rows))


if __name__ == "__main__":
    sys.exit(main())
