"""Measure waves through real main lenses: their fit, patches against full fields, energy against rays, time and places.

What is beyond its limit is named at the end, and the exit status is then 1.

    python tools/lens_waves.py                       (about ten minutes on two quiet cores)
    python tools/lens_waves.py --only fit patch      (some of it)
    python tools/lens_waves.py --only letters --resolution 4096
"""

from __future__ import annotations

import sys
import time
from typing import Any

import mitsuba as mi
import numpy as np
from accuracy import Row, finish, markdown, options, start

from mitsuba_plenoptic import (
    PlenopticCamera,
    estimate_capture,
    load_scene,
    point_spread_function,
    render_capture,
    with_camera,
)
from mitsuba_plenoptic.lenses.lens_system import LensSystem
from mitsuba_plenoptic.system.optical_system import OpticalSystem

WAVELENGTH = 633.0
LENSES = {"double_gauss": 5.0, "cooke_triplet": 7.0, "tessar": 7.0, "singlet": 5.0}
"""Lenses at 80 mm, and the radii of their entrance pupils."""

POINTS = ((0.0, 0.0, 240.0), (5.6, -5.5, 210.0), (-8.0, 3.0, 280.0), (7.0, 6.5, 240.0))
WIDE = {"main_lens": "cooke_triplet", "focal_length": 16, "aperture_radius": 1.55, "mla_focal_length": 0.3}
"""A camera whose corners get half of the light of the middle."""

LIMITS = {"waves": 0.01, "patch": 0.005, "energy": 0.015, "places": 0.1, "times": 3.0}


def behind(name: str | None, radius: float = 5.0, **numbers: Any) -> PlenopticCamera:
    """Return the paper's camera with another main lens."""
    return PlenopticCamera(main_lens=name, focal_length=80, aperture_radius=radius, focus_distance=240, **numbers)


def fit(name: str) -> Row:
    """Return how well the path of points all over the paper's detector is fitted, at 200 to 300 mm."""
    corner = np.array([(x, y, g) for x in (-11.0, 11.0) for y in (-11.0, 11.0) for g in (200.0, 300.0)])
    began = time.perf_counter()
    lens = OpticalSystem(behind(name, LENSES[name]), WAVELENGTH).waves_of(corner)
    return {"lens": name, "waves": lens.fitted.error, "seconds": time.perf_counter() - began}  # type: ignore[attr-defined]


def patch(point: tuple[float, float, float]) -> Row:
    """Return how far the patch of a point is from its full field, around its image behind the double Gauss."""
    size = 512
    image = np.array([-X / point[2] * 120 for X in point[:2]])
    first = np.clip(np.round((image + 4.096) / 0.002).astype(int) - size // 2, 0, 4096 - size)
    camera = behind("double_gauss", crop_offset=(int(first[0]), int(first[1])), crop_size=(size, size))
    exact, quick = (
        point_spread_function(camera, point, wavelength=WAVELENGTH, method=method).astype(np.float64)
        for method in ("full_field", "patch")
    )
    return {"point": str(point), "patch": float(np.linalg.norm(quick - exact) / np.linalg.norm(exact))}


def energy(name: str, lens: tuple[int, int]) -> Row:
    """Return the energy by waves over that by rays of six lenses across, around one of a white scene."""
    crop = {"crop_offset": tuple(2048 + 32 * index - 96 for index in lens), "crop_size": (192, 192)}
    camera = behind(name, **crop) if name == "double_gauss" else PlenopticCamera(**WIDE, focus_distance=np.inf, **crop)
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": camera.to_sensor(),
            "white": {"type": "constant"},
            "integrator": {"type": "direct"},
        }
    )
    rays = render_capture(scene, spp=256).image
    waves = render_capture(scene, model="wave", wavelength=WAVELENGTH, spp=64).image
    return {"lens": name, "place": str(lens), "energy": float(waves.mean() / rays.mean() - 1)}


def places(name: str) -> Row:
    """Return by how many pixels chief rays of the fit miss where rays traced from the array come from."""
    camera, random = behind(name, LENSES[name]), np.random.default_rng(0)
    points = np.column_stack([*random.uniform(-7, 7, (2, 200)), random.uniform(210, 280, 200)])
    lens = OpticalSystem(camera, WAVELENGTH).waves_of(points)
    x, y = lens.images(points).T
    point, slope, _ = LensSystem.of(camera, WAVELENGTH).ray((0 * x, 0 * y), (x, y))
    # How far from the point the ray passes in its plane, brought back to the array, in pixels.
    off = [
        p + (points[:, 2] - point[2]) * t - points[:, axis] for axis, p, t in zip((0, 1), point[:2], slope, strict=True)
    ]
    worst = float(np.max(np.hypot(*off) * camera.mla_distance / points[:, 2])) / camera.pixel_size
    return {"lens": name, "places": worst}


def letters(name: str | None, resolution: int) -> Row:
    """Return the time that the letters take by waves, and what is estimated."""
    camera = behind(name, resolution=(resolution, resolution), detector_width=0.002 * resolution)
    parameters = {"letter_scale": str(resolution / 4096)}
    scene = with_camera(load_scene("letters", parameters=parameters), camera)
    cost = estimate_capture(scene, model="wave", wavelength=WAVELENGTH)
    began = time.perf_counter()
    render_capture(scene, model="wave", wavelength=WAVELENGTH)
    return {
        "lens": name or "thin",
        "estimate": cost.seconds,
        "seconds": time.perf_counter() - began,
    }


def main() -> None:
    """Measure, print and write."""
    parser = options("lens_waves", __doc__)
    kinds = ("fit", "places", "patch", "energy", "letters")
    parser.add_argument("--only", nargs="+", choices=kinds, default=kinds, help="what is measured")
    parser.add_argument("--resolution", type=int, default=1024, help="pixels across the letters")
    arguments = start(parser)
    results: dict[str, list[Row]] = {}
    texts: list[str] = []

    def tell(kind: str, title: str, columns: dict[str, str], rows: list[Row]) -> None:
        results[kind] = rows
        texts.extend((title + "\n", markdown(columns, rows)))

    if "fit" in arguments.only:
        columns = {"lens": "{lens}", "waves RMS (limit 0.01)": "{waves:.1e}", "seconds": "{seconds:.1f}"}
        tell("fit", "Path of rays left out of the fit", columns, [fit(name) for name in LENSES])
    if "places" in arguments.only:
        columns = {"lens": "{lens}", "pixels (limit 0.1)": "{places:.1e}"}
        tell("places", "Chief rays against rays traced from the array", columns, [places(name) for name in LENSES])
    if "patch" in arguments.only:
        columns = {"point": "{point}", "relative L2 (limit 0.5 %)": "{patch:.2%}"}
        tell("patch", "Patch against full field, double Gauss", columns, [patch(point) for point in POINTS])
    if "energy" in arguments.only:
        columns = {
            "lens": "{lens}",
            "lenses from the axis": "{place}",
            "waves over rays (limit 1.5 %)": "{energy:+.2%}",
        }
        spots = [(name, lens) for name in ("double_gauss", "wide") for lens in ((0, 0), (40, 0), (58, -58))]
        tell("energy", "Energy of a white scene", columns, [energy(*spot) for spot in spots])
    if "letters" in arguments.only:
        columns = {"lens": "{lens}", "estimate (s)": "{estimate:.1f}", "s": "{seconds:.1f}"}
        columns["times the thin lens's (limit 3)"] = "{times:.2f}"
        # The first one compiles the kernels.
        letters(None, 128)
        rows = [letters(name, arguments.resolution) for name in (None, "double_gauss", "tessar")]
        rows = [row | {"times": row["seconds"] / rows[0]["seconds"]} for row in rows]
        tell("letters", f"Letters of {arguments.resolution} pixels by waves", columns, rows)
    finish(arguments, results, *texts)
    bad = [
        f"{kind}: {row}"
        for kind, rows in results.items()
        for row in rows
        for name, limit in LIMITS.items()
        if name in row and not abs(row[name]) <= limit
    ]
    if bad:
        sys.exit("beyond the limit: " + "; ".join(bad))


if __name__ == "__main__":
    main()
