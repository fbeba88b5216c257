"""Measure real main lenses: rays, paths and paraxial numbers against Optiland, the sensor's rays, its speed.

Optiland, another ray tracer, is the extra `lenses`. Every figure is printed with its limit.

    python tools/lens_accuracy.py
    python tools/lens_accuracy.py --speed       also times ray captures of two scenes against those of the thin lens
"""

from __future__ import annotations

import math
import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from accuracy import Row, finish, markdown, options, start

from mitsuba_plenoptic import PlenopticCamera, load_scene, with_camera
from mitsuba_plenoptic.optics import sequential
from mitsuba_plenoptic.optics.lens_system import LensSystem
from mitsuba_plenoptic.prescription import bundled_prescription, paraxial

PEERS = {"double_gauss": ("DoubleGauss", 1.0), "cooke_triplet": ("CookeTriplet", 1.0), "tessar": ("TessarLens", 25.4)}
"""Optiland's samples of the bundled lenses, and by how much ours are larger."""

WAVELENGTHS = (486.1327, 587.5618, 656.2725)
RAYS, FIELDS = 20, 5


def peer(name: str) -> tuple[Any, float]:
    """Return Optiland's lens and the scale of ours."""
    from optiland.samples import objectives

    sample, scale = PEERS[name]
    return getattr(objectives, sample)(), scale


def bundles(name: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return places (2, n) in the plane of the first vertex, and slopes, of rays through 0.7 of a lens's open pupil."""
    numbers, random = paraxial(bundled_prescription(name)), np.random.default_rng(seed)
    field = math.tan(math.radians({"double_gauss": 14.0, "cooke_triplet": 20.0, "tessar": 20.5}[name]))
    slopes = np.zeros((2, FIELDS, RAYS))
    slopes[1] = np.linspace(0, field, FIELDS)[:, None]
    radius, angle = 0.7 * np.sqrt(random.random((FIELDS, RAYS))), random.uniform(0, 2 * np.pi, (FIELDS, RAYS))
    pupil = numbers.entrance_radius * radius * np.stack([np.cos(angle), np.sin(angle)])
    return (pupil - numbers.entrance_pupil * slopes).reshape(2, -1), slopes.reshape(2, -1)


def ours(name: str, wavelength: float, array: Any = np.asarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where our rays meet the peer's image plane (2, n) and their paths from the start, in millimetres."""
    lens = bundled_prescription(name)
    places, slopes = bundles(name)
    N = 1 / np.sqrt(1 + np.sum(slopes**2, axis=0))
    start = (*(array(p - 30 * t) for p, t in zip(places, slopes, strict=True)), -30.0)
    # Whether the edges of surfaces would block them is not asked; Optiland's have none.
    (x, y, z), (L, M, N), _, path = sequential.follow(
        sequential.elements(lens, wavelength), start, tuple(array(v) for v in (slopes[0] * N, slopes[1] * N, N))
    )
    left = (image_distance(name) - z) / N
    return np.array([x + left * L, y + left * M]), np.array(path + left)


def image_distance(name: str) -> float:
    """Return the distance of the peer's image plane from the last vertex, in our millimetres."""
    optic, scale = peer(name)
    positions = np.ravel(optic.surfaces.positions)
    return float(positions[-1] - positions[-2]) * scale


def theirs(name: str, wavelength: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the same by Optiland."""
    from optiland.rays import RealRays

    optic, scale = peer(name)
    places, slopes = bundles(name)
    N = 1 / np.sqrt(1 + np.sum(slopes**2, axis=0))
    x, y = (places - 30 * slopes) / scale
    ones = np.ones_like(x)
    rays = RealRays(x, y, -30 / scale * ones, slopes[0] * N, slopes[1] * N, N, ones, wavelength * 1e-3 * ones)
    found = optic.surfaces.trace(rays, skip=1)
    return np.array([found.x, found.y]) * scale, np.array(found.opd) * scale


def intercepts_and_paths(name: str, array: Any = np.asarray) -> list[Row]:
    """Return the largest deviations of a lens's rays from Optiland's, for each wavelength."""
    rows = []
    for wavelength in WAVELENGTHS:
        (place, path), (place_, path_) = ours(name, wavelength, array), theirs(name, wavelength)
        rows.append(
            {
                "lens": name,
                "wavelength": wavelength,
                "millimetres": float(np.max(np.abs(place - place_))),
                "waves": float(np.max(np.abs(path - path_)) / (wavelength * 1e-6)),
            }
        )
    return rows


def paraxial_numbers(name: str) -> list[Row]:
    """Return focal length, pupils and F-number beside Optiland's, at its primary wavelength."""
    optic, scale = peer(name)
    wavelength = float(optic.primary_wavelength) * 1e3
    numbers, parts = paraxial(bundled_prescription(name), wavelength), optic.paraxial
    # The peer is stopped down otherwise; its pupils' ratio is the lens's own.
    pairs = {
        "focal length": (numbers.focal_length, parts.f2() * scale),
        "entrance pupil": (numbers.entrance_pupil, parts.EPL() * scale),
        "exit pupil": (numbers.exit_pupil - image_distance(name), parts.XPL() * scale),
        "exit over entrance pupil": (numbers.exit_radius / numbers.entrance_radius, parts.XPD() / parts.EPD()),
        "F-number": (numbers.focal_length / float(np.ravel(parts.EPD())[0] * scale), parts.FNO()),
    }
    return [
        {"lens": name, "number": number, "ours": float(a), "optiland": float(np.ravel(b)[0])}
        for number, (a, b) in pairs.items()
    ]


def single_precision(name: str) -> float:
    """Return how far, in millimetres in the object plane in focus, the sensor's rays miss those in double precision."""
    lens = LensSystem.of(PlenopticCamera(main_lens=name, focal_length=80, aperture_radius=5))
    random = np.random.default_rng(0)
    places, pupil = random.uniform(-4, 4, (2, 2, 100_000))
    slopes = (pupil - places) / lens.pupil_distance

    def object_points(array: Any) -> tuple[np.ndarray, np.ndarray]:
        point, slope, is_open = lens.trace(tuple(map(array, places)), tuple(map(array, slopes)))
        distance = 240 - point[2]
        return np.array([p + distance * t for p, t in zip(point[:2], slope, strict=True)]), np.array(is_open)

    (single, open_), (double, open__) = object_points(mi.Float), object_points(np.asarray)
    return float(np.max(np.abs(single - double)[:, open_ & open__]))


def rays_per_second(scene: str, lens: str | None, spp: int = 16) -> float:
    """Return the samples per second of a ray capture of a built-in scene of 1024 x 1024 pixels."""
    camera = PlenopticCamera(resolution=(1024, 1024), main_lens=lens, focal_length=80, aperture_radius=5)
    loaded = with_camera(load_scene(scene), camera)
    times = []
    for seed in range(4):
        began = time.perf_counter()
        dr.eval(mi.render(loaded, spp=spp, seed=seed))
        dr.sync_thread()
        times.append(time.perf_counter() - began)
    # The first compiles the kernels.
    return 1024**2 * spp / min(times[1:])


def main() -> None:
    """Measure, print and write."""
    parser = options("lens_accuracy", __doc__)
    parser.add_argument("--speed", action="store_true", help="time ray captures, too")
    arguments = start(parser)
    rays = [row for name in PEERS for row in intercepts_and_paths(name)]
    numbers = [row for name in PEERS for row in paraxial_numbers(name)]
    singles = [{"lens": name, "millimetres": single_precision(name)} for name in (*PEERS, "singlet")]
    results: dict[str, Any] = {"rays": rays, "numbers": numbers, "single": singles}
    texts = [
        f"{RAYS} rays x {FIELDS} fields against Optiland, largest deviation (limits: 1e-6 mm, 0.002 waves)\n",
        markdown(
            {
                "lens": "{lens}",
                "nm": "{wavelength:.1f}",
                "intercept, mm": "{millimetres:.1e}",
                "path, waves": "{waves:.1e}",
            },
            rays,
        ),
        "Paraxial numbers\n",
        markdown({"lens": "{lens}", "": "{number}", "ours": "{ours:.8g}", "Optiland": "{optiland:.8g}"}, numbers),
        "The sensor's rays in single precision, in the object plane (limit: 1e-4 mm)\n",
        markdown({"lens": "{lens}", "mm": "{millimetres:.1e}"}, singles),
    ]
    if arguments.speed:
        speeds = []
        for scene, limit in (("letters", 0.3), ("still_life", 0.7)):
            thin = rays_per_second(scene, None)
            speeds += [
                {
                    "scene": scene,
                    "lens": name,
                    "ratio": rays_per_second(scene, name) / thin,
                    "thin": thin,
                    "limit": limit,
                }
                for name in ("double_gauss", "singlet")
            ]
        results["speed"] = speeds
        texts += [
            "Samples per second of ray captures over those of the thin lens\n",
            markdown(
                {
                    "scene": "{scene}",
                    "lens": "{lens}",
                    "ratio": "{ratio:.2f}",
                    "limit": "{limit}",
                    "thin": "{thin:.3g}/s",
                },
                speeds,
            ),
        ]
    finish(arguments, results, *texts)


if __name__ == "__main__":
    main()
