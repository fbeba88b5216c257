"""Scenes whose light differs over the pupil, or within a lens: captures by signed rays against those by rays.

Quarters of micro-images, and channels of colour, are compared with a capture by rays that is convolved with the
diffraction of a microlens. What the pupil's diffraction adds is small but at edges in focus, so that each scene has a
limit of its own. Prints each measure, exits with 1 if one is beyond its limit, and writes a table.

    python tools/signed_rays_scenes.py --output out/signed_rays_scenes [--only pane --only lamps]
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from any_scenes import facing, radiating, scene_of, sensor
from when_do_rays_fail import diffract

from mitsuba_plenoptic import render_capture

LENSES, PIXELS = 16, 16
RAYS, WAVES = 1024, 256
"""Samples a pixel."""

BLACK = {"type": "diffuse", "reflectance": 0.0}


def camera(lenses: int = LENSES, colours: bool = False, **parameters: Any) -> dict[str, Any]:
    """Describe the paper's camera with fewer lenses and coarser pixels, of parabolic lenses."""
    made = sensor(lenses, PIXELS, lens_model="parabolic", **parameters)
    if colours:
        made["film"]["pixel_format"] = "rgb"
    return made


def wall(distance: float = 240.0, **extra: Any) -> dict[str, Any]:
    """Describe a wall that fills the view."""
    return facing(distance, 60.0, **(extra or radiating()))


def filtered(part: Any, **extra: Any) -> dict[str, Any]:
    """Describe a pane close to the lens that lets a part of the light through."""
    return facing(1.0, (10.0, 20.0), (10.0, 0.0), bsdf={"type": "mask", "opacity": 1 - part, "nested": BLACK}, **extra)


def pattern(period: float, size: float, low: float = 0.0) -> dict[str, Any]:
    """Describe a texture of upright stripes over a rectangle of half the width `size`, from `low` to 1."""
    count = 2 * round(2 * size / period)
    values = np.where(np.arange(count) % 2, 1.0, low).astype(np.float32)[None, :, None]
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.repeat(values, 2, 0)),
        "raw": True,
        "filter_type": "nearest",
    }


def coloured_panes() -> Any:
    """Return a scene with a red and a blue filter before the halves of the pupil."""
    panes = {}
    for side, colour in ((1, [1.0, 0.1, 0.0]), (-1, [0.0, 0.1, 1.0])):
        glass = {"type": "thindielectric", "int_ior": 1.0 + 1e-6}
        glass["specular_transmittance"] = {"type": "rgb", "value": colour}
        panes[f"pane_{side}"] = facing(1.0, (10.0, 20.0), (10.0 * side, 0.0), bsdf=glass)
    return scene_of(camera(colours=True), **panes, wall=wall())


def lamps_in_metal() -> Any:
    """Return a scene of a slightly rough metal that mirrors a red and a blue lamp."""
    metal = {"type": "roughconductor", "material": "none", "alpha": 0.005, "distribution": "ggx"}
    objects = {"metal": facing(240.0, 30.0, bsdf=metal)}
    for side, colour in ((1, [4.0, 0.0, 0.0]), (-1, [0.0, 0.0, 4.0])):
        emitter = {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": colour}}, "bsdf": BLACK}
        T = mi.ScalarTransform4f()
        to_world = T.translate([1.6 * side, 0, -40]) @ T.scale([1.4, 3, 1])
        objects[f"lamp_{side}"] = {"type": "rectangle", "to_world": to_world, **emitter}
    return scene_of(camera(colours=True), **objects)


def nine_lamps() -> Any:
    """Return a scene of nine lamps in focus, each a sixth of a lens wide."""
    return scene_of(
        camera(),
        **{
            f"lamp_{i}_{j}": facing(240.0, 0.01, (0.47 * i, 0.41 * j), **radiating(100.0))
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        },
    )


def floor() -> Any:
    """Return a scene of a radiating floor 1 mm below the axis."""
    T = mi.ScalarTransform4f()
    to_world = T.translate([0, -1, 250]) @ T.rotate([1, 0, 0], -90) @ T.scale([60, 150, 1])
    return scene_of(camera(), floor={"type": "rectangle", "to_world": to_world, **radiating()})


def dirt() -> Any:
    """Return a scene behind a dirty pane, of spots as large as a fifth of the pupil."""
    values = np.random.default_rng(1).choice([0.0, 0.6], (16, 16, 1), p=[0.6, 0.4]).astype(np.float32)
    opacity = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": "nearest"}
    pane = facing(12.0, 16.0, bsdf={"type": "mask", "opacity": opacity, "nested": BLACK})
    return scene_of(camera(), pane=pane, wall=wall(280.0))


def fog_around() -> Any:
    """Return a scene in which the camera stands in fog."""
    fog = {"type": "homogeneous", "sigma_t": 0.003, "albedo": 0.8}
    made = camera()
    made["medium"] = fog
    half = facing(240.0, (20.0, 60.0), (20.0, 0.0), **radiating())
    return scene_of(made, {"type": "volpath", "max_depth": 8}, wall=half, sky={"type": "constant", "radiance": 0.1})


SCENES: dict[str, tuple[Callable[[], Any], float]] = {
    "pane over half of the pupil": (lambda: scene_of(camera(), pane=filtered(0.3), wall=wall()), 0.01),
    "glass over half of the pupil": (
        lambda: scene_of(
            camera(),
            pane=facing(1.0, (10.0, 20.0), (10.0, 0.0), bsdf={"type": "thindielectric", "int_ior": 3.0}),
            wall=wall(),
        ),
        0.01,
    ),
    "stripes of four lenses in focus before a wall": (
        lambda: scene_of(
            camera(),
            pane=facing(240.0, 4.096, bsdf={"type": "mask", "opacity": pattern(0.512, 4.096), "nested": BLACK}),
            wall=wall(262.0),
        ),
        0.05,
    ),
    "red and blue panes": (coloured_panes, 0.015),
    "red and blue lamps in rough metal": (lamps_in_metal, 0.03),
    "nine lamps of a sixth of a lens": (nine_lamps, 0.25),
    "floor": (floor, 0.05),
    "dirty pane": (dirt, 0.03),
    "camera in fog": (fog_around, 0.03),
    "texture finer than a lens": (
        lambda: scene_of(
            camera(),
            card=facing(240.0, 4.0, **{"bsdf": BLACK, "emitter": {"type": "area", "radiance": pattern(0.09, 4.0)}}),
        ),
        0.08,
    ),
    "hair": (
        lambda: scene_of(camera(), hair=facing(30.0, (0.4, 20.0), (1.1, 0.0), bsdf=BLACK), wall=wall(250.0)),
        0.03,
    ),
    "lamp through a glass ball": (
        lambda: scene_of(
            camera(),
            ball={"type": "sphere", "center": [0.2, 0.1, 236.0], "radius": 1.5, "bsdf": {"type": "dielectric"}},
            wall=facing(300.0, (2.0, 30.0), (3.0, 0.0), **radiating()),
        ),
        0.05,
    ),
}
"""Each with its limit on the relative difference of quarters of micro-images, beyond the noise."""

FILLS = {
    "cells filled by 0.5": {"mla_fill": 0.5},
    "cells filled by 0.3": {"mla_fill": 0.3},
    "discs filled by 0.5": {"mla_fill": 0.5, "mla_aperture": "circle"},
    "hexagons": {"mla_lattice": "hexagonal"},
}
for _name, _parameters in FILLS.items():
    SCENES[f"white wall, {_name}"] = (
        lambda parameters=_parameters: scene_of(camera(**parameters), wall=wall()),  # type: ignore[misc]
        0.01,
    )


def quarters(image: np.ndarray) -> np.ndarray:
    """Average quarters of the micro-images of the inner lenses, for each channel."""
    half = PIXELS // 2
    rows = image.shape[0] // half
    image = image.reshape(rows, half, rows, half, -1).mean((1, 3))
    return np.asarray(image[4:-4, 4:-4], dtype=float)


def measure(scene: Any) -> dict[str, float]:
    """Capture a scene by rays and by waves, twice each, and compare."""
    found: dict[str, list[np.ndarray]] = {"ray": [], "wave": []}
    for seed in (0, 1):
        by_rays = render_capture(scene, model="ray", spp=RAYS, seed=seed)
        colours = np.atleast_3d(by_rays.image)
        found["ray"].append(
            np.stack([diffract(colours[..., n], by_rays.camera) for n in range(colours.shape[2])], axis=-1)
        )
        by_waves = render_capture(scene, model="wave", method="signed_rays", spp=WAVES, seed=seed, wavelength=633.0)
        found["wave"].append(np.atleast_3d(by_waves.image))
    r, w = ([quarters(image) for image in images] for images in found.values())
    mean_r, mean_w = (r[0] + r[1]) / 2, (w[0] + w[1]) / 2
    size = float(np.linalg.norm(mean_r))
    noise = math.hypot(*(float(np.linalg.norm(pair[0] - pair[1])) / 2 for pair in (r, w))) / size
    difference = float(np.linalg.norm(mean_w - mean_r)) / size
    return {
        "difference": math.sqrt(max(difference**2 - noise**2, 0)),
        "noise": noise,
        "energy": float(mean_w.sum() / mean_r.sum()),
    }


def main() -> int:
    """Measure all, or some scenes, and return whether one is beyond its limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/signed_rays_scenes"))
    parser.add_argument("--only", action="append", help="measure the scenes whose names hold this; repeat for several")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    lines = ["| scene | quarters of micro-images | noise | energy | limit | |", "|---|---|---|---|---|---|"]
    print(*lines, sep="\n")
    failed = False
    for name, (make, limit) in SCENES.items():
        if arguments.only and not any(part in name for part in arguments.only):
            continue
        row = measure(make())
        beyond = row["difference"] > limit or abs(row["energy"] - 1) > 0.01 + 3 * row["noise"]
        failed |= beyond
        lines.append(
            f"| {name} | {row['difference']:.2%} | {row['noise']:.2%} | {row['energy']:.4f} | {limit:.0%} "
            f"| {'FAILS' if beyond else ''} |"
        )
        print(lines[-1], flush=True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "signed_rays_scenes.md").write_text("\n".join(lines) + "\n")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
