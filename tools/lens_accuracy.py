"""Measure real main lenses: rays, paths and paraxial numbers against Optiland, the sensor's rays, its speed.

Optiland, another ray tracer, is the extra `lenses`. Every figure is printed with its limit.

    python tools/lens_accuracy.py
    python tools/lens_accuracy.py --speed       also times ray captures of two scenes against those of the thin lens
"""

from __future__ import annotations

import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from accuracy import Row, finish, markdown, options, start
from record_optiland import FIELDS, RAYS, SAMPLES, sample_results

from mitsuba_plenoptic import PlenopticCamera, load_scene, with_camera
from mitsuba_plenoptic.lenses import sequential
from mitsuba_plenoptic.lenses.lens_system import LensSystem
from mitsuba_plenoptic.prescription import Prescription, bundled_prescription, paraxial


def ours(lens: Prescription, peer: Any, wavelength: float, array: Any = np.asarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where our rays meet the peer's image plane (2, n) and their paths from the start, in millimetres."""
    places, slopes = np.array(peer["places"]), np.array(peer["slopes"])
    N = 1 / np.sqrt(1 + np.sum(slopes**2, axis=0))
    start = (*(array(p - 30 * t) for p, t in zip(places, slopes, strict=True)), -30.0)
    # Whether the edges of surfaces would block them is not asked; Optiland's have none.
    (x, y, z), (L, M, N), _, path = sequential.follow(
        sequential.elements(lens, wavelength), start, tuple(array(v) for v in (slopes[0] * N, slopes[1] * N, N))
    )
    left = (peer["image_distance"] - z) / N
    return np.array([x + left * L, y + left * M]), np.array(path + left)


def intercepts_and_paths(lens: Prescription, peer: Any, array: Any = np.asarray) -> list[Row]:
    """Return the largest deviations of a lens's rays from those of `record_optiland.results`, for each wavelength."""
    rows = []
    for wavelength, traced in ((float(key), traced) for key, traced in peer["rays"].items()):
        place, path = ours(lens, peer, wavelength, array)
        rows.append(
            {
                "lens": lens.name,
                "wavelength": wavelength,
                "millimetres": float(np.max(np.abs(place - traced["image"]))),
                "waves": float(np.max(np.abs(path - traced["paths"])) / (wavelength * 1e-6)),
            }
        )
    return rows


def paraxial_numbers(lens: Prescription, peer: Any) -> list[Row]:
    """Return focal length, pupils and F-number beside those of `record_optiland.results`, at its primary wavelength."""
    numbers = paraxial(lens, peer["wavelength"])
    # The peer is stopped down otherwise; its pupils' ratio is the lens's own.
    pairs = {
        "focal length": (numbers.focal_length, peer["focal_length"]),
        "entrance pupil": (numbers.entrance_pupil, peer["entrance_pupil"]),
        "exit pupil": (numbers.exit_pupil - peer["image_distance"], peer["exit_pupil"]),
        "exit over entrance pupil": (
            numbers.exit_radius / numbers.entrance_radius,
            peer["exit_diameter"] / peer["entrance_diameter"],
        ),
        "F-number": (numbers.focal_length / peer["entrance_diameter"], peer["f_number"]),
    }
    return [{"lens": lens.name, "number": number, "ours": a, "optiland": b} for number, (a, b) in pairs.items()]


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
    pairs = [(bundled_prescription(name), sample_results(name)) for name in SAMPLES]
    rays = [row for pair in pairs for row in intercepts_and_paths(*pair)]
    numbers = [row for pair in pairs for row in paraxial_numbers(*pair)]
    singles = [{"lens": name, "millimetres": single_precision(name)} for name in (*SAMPLES, "singlet")]
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
