"""Real main lenses against Optiland, another ray tracer, and waves through them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np
import scipy.interpolate

from mitsuba_plenoptic import (
    LensSystem,
    PlenopticCamera,
    Prescription,
    estimate_capture,
    load_scene,
    point_spread_function,
    render_capture,
    with_camera,
)
from mitsuba_plenoptic.lenses import sequential
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.point_spread import point_fields
from mitsuba_plenoptic.prescription import bundled_prescription, paraxial

from ...record_optiland import SAMPLES, image_distance, sample, sample_results
from .. import Row, at_least, at_most, case, pick
from ..measures import relative
from ..timing import once, paired

WAVELENGTH = 633.0


def traced(lens: Prescription, peer: Any, wavelength: float, array: Any = np.asarray) -> tuple[np.ndarray, np.ndarray]:
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
    for wavelength, peers in ((float(key), peers) for key, peers in peer["rays"].items()):
        place, path = traced(lens, peer, wavelength, array)
        rows.append(
            {
                "lens": lens.name,
                "wavelength": wavelength,
                "millimetres": float(np.max(np.abs(place - peers["image"]))),
                "waves": float(np.max(np.abs(path - peers["paths"])) / (wavelength * 1e-6)),
            }
        )
    return rows


@case(
    "lenses.rays",
    "Rays through lenses against Optiland (20 rays, 5 fields), largest deviation of intercepts and paths",
    {"lens": "{lens}", "nm": "{wavelength:.1f}", "intercept (mm)": "{millimetres:.1e}", "path (waves)": "{waves:.1e}"},
    (at_most("millimetres", 1e-6), at_most("waves", 0.002)),
    page="docs/guides/main_lenses.md",
    needs=("optiland",),
)
def rays() -> Iterator[Row]:
    """Trace the bundled lenses."""
    for name in SAMPLES:
        yield from intercepts_and_paths(bundled_prescription(name), sample_results(name))


def paraxial_numbers(lens: Prescription, peer: Any) -> list[Row]:
    """Return focal length, pupils and F-number, and those of `record_optiland.results`, at its primary wavelength."""
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


@case(
    "lenses.paraxial",
    "Paraxial figures of lenses against Optiland's",
    {"lens": "{lens}", "": "{number}", "ours": "{ours:.8g}", "Optiland": "{optiland:.8g}", "relative": "{off:.1e}"},
    (at_most("off", 1e-7),),
    page="docs/guides/main_lenses.md",
    needs=("optiland",),
)
def paraxial_figures() -> Iterator[Row]:
    """Compare focal lengths and pupils."""
    for name in SAMPLES:
        for row in paraxial_numbers(bundled_prescription(name), sample_results(name)):
            yield {**row, "off": abs(row["ours"] / row["optiland"] - 1)}


@case(
    "lenses.single-precision",
    "How far the sensor's rays, in single precision, miss those in double precision in the object plane in focus",
    {"lens": "{lens}", "mm": "{millimetres:.1e}"},
    (at_most("millimetres", 1e-4),),
    page="docs/guides/main_lenses.md",
    quick={"rays": 1000},
)
def single_precision(*, rays: int = 100_000) -> Iterator[Row]:
    """Trace random rays."""
    for name in (*SAMPLES, "singlet"):
        lens = LensSystem.of(PlenopticCamera(main_lens=name, focal_length=80, aperture_radius=5))
        places, pupil = np.random.default_rng(0).uniform(-4, 4, (2, 2, rays))
        slopes = (pupil - places) / lens.pupil_distance

        def object_points(array: Any, lens: Any = lens, places: Any = places, slopes: Any = slopes) -> Any:
            point, slope, is_open = lens.trace(tuple(map(array, places)), tuple(map(array, slopes)))
            distance = 240 - point[2]
            return np.array([p + distance * t for p, t in zip(point[:2], slope, strict=True)]), np.array(is_open)

        (single, one), (double, other) = object_points(mi.Float), object_points(np.asarray)
        yield {"lens": name, "millimetres": float(np.max(np.abs(single - double)[:, one & other]))}


@case(
    "lenses.speed",
    "Samples per second of ray captures through lenses over those of the thin lens",
    {"scene": "{scene}", "lens": "{lens}", "ratio": "{ratio:.2f}", "thin": "{thin:.3g}/s"},
    (at_least("ratio", "limit"),),
    page="docs/guides/main_lenses.md",
    quick={"resolution": 256, "runs": 1},
)
def speed(*, resolution: int = 1024, spp: int = 16, runs: int = 5) -> Iterator[Row]:
    """Render built-in scenes in turn."""
    for scene, limit in (("letters", 0.3), ("still_life", 0.7)):
        works = {}
        for name in (None, "double_gauss", "singlet"):
            camera = PlenopticCamera(
                resolution=(resolution, resolution), main_lens=name, focal_length=80, aperture_radius=5
            )
            loaded = with_camera(load_scene(scene), camera)
            works[name or "thin"] = lambda loaded=loaded: np.array(mi.render(loaded, spp=spp))
        timings = paired(works, runs)
        thin = resolution**2 * spp / timings["thin"].seconds
        for name in ("double_gauss", "singlet"):
            yield {
                "scene": scene,
                "lens": name,
                "ratio": 1 / timings[name].ratio,
                "thin": thin,
                "limit": limit if resolution >= 1024 else None,
            }


F_NUMBER = 8.0

FAR = 1e9

PIXEL = 0.5e-3

WINDOW = 96
"""Places across the compared window, and their distance in millimetres."""


def theirs(name: str, angle: float, rays: int, window: int = WINDOW) -> tuple[np.ndarray, np.ndarray]:
    """Return Optiland's spread (y, x), and the place of its middle in millimetres."""
    from optiland.psf import HuygensPSF

    optic, scale = sample(name)
    assert scale == 1
    optic.set_aperture(aperture_type="EPD", value=paraxial(bundled_prescription(name)).focal_length / F_NUMBER)
    field = (0.0, angle / float(optic.fields.max_field))
    psf = HuygensPSF(optic, field, WAVELENGTH * 1e-3, num_rays=rays, image_size=window, pixel_pitch=PIXEL)
    # Its strategy's way to choose the middle, and the places around it.
    x, y, _ = psf._get_image_coordinates()
    x, y = np.asarray(x), np.asarray(y)
    return np.asarray(psf.psf), np.array([x, y])


def spread(name: str, angle: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return our intensity at places of Optiland's image plane, whose y is turned."""
    lens = bundled_prescription(name)
    numbers = paraxial(lens)
    middle = (float(x.mean()), -float(y.mean()))
    # A detector that reaches as far as the image, of which a few pixels are recorded around it.
    half, pixel = math.ceil(2 + np.max(np.abs(middle))), 2e-3
    count = round(2 * half / pixel)
    first = [round((m + half) / pixel) - 64 for m in middle]
    camera = PlenopticCamera(
        main_lens=lens,
        aperture_radius=numbers.focal_length / F_NUMBER / 2,
        mla_distance=image_distance(*sample(name)) - numbers.rear_principal,
        detector_width=count * pixel,
        resolution=(count, count),
        crop_offset=(first[0], first[1]),
        crop_size=(128, 128),
    )
    field = point_fields(camera, (0.0, FAR * math.tan(math.radians(angle)), FAR), wavelength=WAVELENGTH).mla
    axes = [field.origin[axis] + field.pitch * np.arange(field.samples.shape[1 - axis]) for axis in (0, 1)]
    near = [np.abs(values - m) < 0.1 for values, m in zip(axes, middle, strict=True)]
    intensity = np.abs(field.samples[np.ix_(near[1], near[0])]) ** 2
    spline = scipy.interpolate.RectBivariateSpline(axes[1][near[1]], axes[0][near[0]], intensity, kx=5, ky=5)
    return spline.ev(-y, x)


@case(
    "lenses.spread",
    "The bare double Gauss's point spread against Optiland's `HuygensPSF`, which sums over traced rays",
    {
        "lens": "{lens}", "degrees": "{angle:g}", "relative L2": "{difference:.2%}",
        "Optiland with half as many rays": "{convergence:.2%}", "peak over the window's light": "{peak:+.2%}",
    },
    (at_most("difference", 0.01),),
    page="docs/guides/main_lenses.md",
    needs=("optiland",),
)  # fmt: skip
def spreads(*, rays: int = 256, angles: tuple[float, ...] = (0.0, 2.0)) -> Iterator[Row]:
    """Compare intensities on the plane of the microlenses."""
    name = "double_gauss"
    for angle in angles:
        psf, (x, y) = theirs(name, angle, rays)
        coarse, _ = theirs(name, angle, rays // 2)
        found = spread(name, angle, x, y)
        scale = float(np.sum(found * psf) / np.sum(psf * psf))
        yield {
            "lens": name, "angle": angle, "difference": relative(found / scale, psf),
            "convergence": relative(coarse / coarse.sum(), psf / psf.sum()),
            "peak": float(found.max() / found.sum() / (psf.max() / psf.sum()) - 1),
        }  # fmt: skip


LENSES = {"double_gauss": 5.0, "cooke_triplet": 7.0, "tessar": 7.0, "singlet": 5.0}
"""Lenses at 80 mm, and the radii of their entrance pupils."""

POINTS = ((0.0, 0.0, 240.0), (5.6, -5.5, 210.0), (-8.0, 3.0, 280.0), (7.0, 6.5, 240.0))

WIDE = {"main_lens": "cooke_triplet", "focal_length": 16, "aperture_radius": 1.55, "mla_focal_length": 0.3}
"""A camera whose corners get half of the light of the middle."""


def behind(name: str | None, radius: float = 5.0, **numbers: Any) -> PlenopticCamera:
    """Return the paper's camera with another main lens."""
    return PlenopticCamera(main_lens=name, focal_length=80, aperture_radius=radius, focus_distance=240, **numbers)


@case(
    "lenses.wave-fit",
    "The path of points all over the paper's detector, at 200 to 300 mm, against its fit",
    {"lens": "{lens}", "RMS (waves)": "{waves:.1e}", "seconds": "{seconds:.1f}"},
    (at_most("waves", 0.01),),
    page="docs/guides/main_lenses.md",
    quick={"names": ("singlet",)},
)
def wave_fit(*, names: tuple[str, ...] = ()) -> Iterator[Row]:
    """Fit each lens."""
    corner = np.array([(x, y, g) for x in (-11.0, 11.0) for y in (-11.0, 11.0) for g in (200.0, 300.0)])
    for name, radius in pick(LENSES, names).items():
        lens, seconds, _ = once(lambda n=name, r=radius: OpticalSystem(behind(n, r), WAVELENGTH).waves_of(corner))
        yield {"lens": name, "waves": lens.fitted.error, "seconds": seconds}


@case(
    "lenses.chief-rays",
    "By how many pixels chief rays of the fit miss where rays traced from the array come from",
    {"lens": "{lens}", "pixels": "{pixels:.1e}"},
    (at_most("pixels", 0.1),),
    page="docs/guides/main_lenses.md",
    quick={"names": ("singlet",)},
)
def chief_rays(*, names: tuple[str, ...] = ()) -> Iterator[Row]:
    """Compare random points."""
    for name, radius in pick(LENSES, names).items():
        camera, random = behind(name, radius), np.random.default_rng(0)
        points = np.column_stack([*random.uniform(-7, 7, (2, 200)), random.uniform(210, 280, 200)])
        x, y = OpticalSystem(camera, WAVELENGTH).waves_of(points).images(points).T
        point, slope, _ = LensSystem.of(camera, WAVELENGTH).ray((0 * x, 0 * y), (x, y))
        # How far from the point the ray passes in its plane, as an image on the array.
        off = [
            p + (points[:, 2] - point[2]) * t - points[:, axis]
            for axis, p, t in zip((0, 1), point[:2], slope, strict=True)
        ]
        worst = float(np.max(np.hypot(*off) * camera.mla_distance / points[:, 2]))
        yield {"lens": name, "pixels": worst / camera.pixel_size}


@case(
    "lenses.patch",
    "Patches against full fields behind the double Gauss, relative L2",
    {"point": "{point}", "difference": "{difference:.2%}"},
    (at_most("difference", 0.005),),
    page="docs/guides/main_lenses.md",
    quick={"count": 1},
)
def patch(*, count: int = len(POINTS), size: int = 512) -> Iterator[Row]:
    """Compare around the image of each point."""
    for point in POINTS[:count]:
        image = np.array([-X / point[2] * 120 for X in point[:2]])
        first = np.clip(np.round((image + 4.096) / 0.002).astype(int) - size // 2, 0, 4096 - size)
        camera = behind("double_gauss", crop_offset=(int(first[0]), int(first[1])), crop_size=(size, size))
        exact, quick = (
            point_spread_function(camera, point, wavelength=WAVELENGTH, method=method).astype(np.float64)
            for method in ("full_field", "patch")
        )
        yield {"point": str(point), "difference": relative(quick, exact)}


@case(
    "lenses.energy",
    "Energy of wave captures over ray captures, of six lenses across of a white scene",
    {"lens": "{lens}", "lenses from the axis": "{place}", "waves over rays": "{energy:+.2%}"},
    (at_most("off", 0.015),),
    page="docs/guides/main_lenses.md",
    quick={"count": 1},
)
def energy(*, count: int = 6) -> Iterator[Row]:
    """Compare three places behind the double Gauss, and of a camera whose corners get half of the middle's light."""
    spots = [(name, place) for name in ("double_gauss", "wide") for place in ((0, 0), (40, 0), (58, -58))]
    for name, place in spots[:count]:
        crop = {"crop_offset": tuple(2048 + 32 * index - 96 for index in place), "crop_size": (192, 192)}
        wide = name == "wide"
        camera = PlenopticCamera(**WIDE, focus_distance=np.inf, **crop) if wide else behind(name, **crop)
        scene = mi.load_dict({
            "type": "scene", "camera": camera.to_sensor(), "white": {"type": "constant"},
            "integrator": {"type": "direct"},
        })  # fmt: skip
        ray = render_capture(scene, spp=256).image
        wave = render_capture(scene, model="wave", wavelength=WAVELENGTH, spp=64).image
        found = float(wave.mean() / ray.mean() - 1)
        yield {"lens": name, "place": str(place), "energy": found, "off": abs(found)}


@case(
    "lenses.letters",
    "Wave captures of the letters through lenses: time against that of the thin lens, and the estimate",
    {
        "lens": "{lens}", "estimate (s)": "{estimate:.1f}", "s": "{seconds:.1f}",
        "times the thin lens's": "{ratio:.2f}",
    },
    (at_most("ratio", 3.0),),
    page="docs/guides/main_lenses.md",
    quick={"resolution": 128, "runs": 1},
)  # fmt: skip
def letters(*, resolution: int = 1024, runs: int = 3) -> Iterator[Row]:
    """Capture in turn."""
    scenes = {}
    for name in (None, "double_gauss", "tessar"):
        camera = behind(name, resolution=(resolution, resolution), detector_width=0.002 * resolution)
        scene = load_scene("letters", parameters={"letter_scale": str(resolution / 4096)})
        scenes[name or "thin"] = with_camera(scene, camera)
    options = {"model": "wave", "wavelength": WAVELENGTH}
    timings = paired({name: lambda s=scene: render_capture(s, **options) for name, scene in scenes.items()}, runs)
    for name, timing in timings.items():
        estimate = estimate_capture(scenes[name], **options).seconds
        row = {"lens": name, "estimate": estimate, "seconds": timing.seconds}
        yield row if name == "thin" else {**row, "ratio": timing.ratio}
