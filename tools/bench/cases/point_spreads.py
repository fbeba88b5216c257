"""Point spreads by patches against the full field, and the full field against its own limit."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, point_spread_function
from mitsuba_plenoptic import particles as pt
from mitsuba_plenoptic.extensions.particles.particle_images import scattered_light
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.full_field import full_field
from mitsuba_plenoptic.points.pupil_weights import PupilWeights

from .. import Row, at_most, case
from ..measures import relative
from ..timing import peak_memory

Point = tuple[float, float, float]

PAPER = PlenopticCamera()

SECOND = PlenopticCamera(
    focal_length=50, aperture_radius=4, mla_distance=70, mla_focal_length=0.4, mla_pitch=0.05,
    detector_width=5, resolution=(2000, 2000),
)  # fmt: skip

SMALL = PAPER.replace(detector_width=0.512, resolution=(256, 256))

EXTREMES = {
    "aperture_radius 2": (SMALL.replace(aperture_radius=2), (0.06, -0.05, 215)),
    "aperture_radius 0.5": (SMALL.replace(aperture_radius=0.5), (0.06, -0.05, 215)),
    "0.25 um pixels": (PAPER.replace(detector_width=0.256, resolution=(1024, 1024)), (0.1, -0.05, 230)),
    "Fresnel number 0.3 by focal length": (
        PAPER.replace(mla_focal_length=5.4, detector_distance=5.4, detector_width=1.024, resolution=(512, 512)),
        (0.06, -0.05, 240),
    ),
    "Fresnel number 0.3 by pitch": (
        PAPER.replace(mla_pitch=0.02, detector_width=0.4, resolution=(200, 200)), (0.06, -0.05, 230)
    ),
}  # fmt: skip
"""Cameras, each with a scene point whose single spread is judged."""

GAPPED = {
    "square lenses": {},
    "hexagonal lattice": {"mla_lattice": "hexagonal"},
    "discs": {"mla_aperture": "circle"},
}

FILLS = (0.5, 0.25, 0.1)


@case(
    "point-spreads.patch",
    "Point spreads by patches against the full field, relative L2 of pixel integrals over the detector",
    {
        "point": "{name}", "position (mm)": "({position[0]:.2f}, {position[1]:.2f}, {position[2]:.1f})",
        "patch - full field": "{error:.2%}", "power, full field": "{power:.4f}", "power, patch": "{patch_power:.4f}",
    },
    (at_most("error", 0.0035),),
    page="docs/theory/accuracy.md",
    quick={"count": 1},
)  # fmt: skip
def patch(*, count: int = 17) -> Iterator[Row]:
    """Axis, mid-field and corner at three distances, random points, and a second camera; the first ones of these."""
    for name, camera, position, wavelength in itertools.islice(points(), count):
        full, quick = (
            point_spread_function(camera, position, wavelength=wavelength, method=method)
            for method in ("full_field", "patch")
        )
        yield {
            "name": name, "position": position, "error": relative(quick, full), "power": float(full.sum()),
            "patch_power": float(quick.sum()),
        }  # fmt: skip


def _scene_point(camera: PlenopticCamera, x: float, y: float, g: float) -> Point:
    """Scene point whose image is at (x, y) on the microlens array."""
    return (-x * g / camera.mla_distance, -y * g / camera.mla_distance, g)


def points() -> Iterator[tuple[str, PlenopticCamera, Point, float]]:
    """Names, cameras, positions and wavelengths."""
    places = {"axis": (0.0, 0.0), "mid-field": (2.0, -1.7), "corner": (-3.6, 3.6)}
    for g, (name, place) in itertools.product((210.0, 240.0, 280.0), places.items()):
        yield f"{name} {g:g}", PAPER, _scene_point(PAPER, *place, g), 633.0
    rng = np.random.default_rng(7)
    for number in range(5):
        x, y = rng.uniform(-3.7, 3.7, 2)
        yield f"random {number + 1}", PAPER, _scene_point(PAPER, x, y, rng.uniform(200, 300)), 633.0
    for name, x, y, g in (("axis", 0, 0, 175), ("mid-field", 1.1, -0.9, 150), ("corner", -2.1, 2.1, 200)):
        yield f"second camera, {name} {g}", SECOND, _scene_point(SECOND, x, y, g), 532.0


@case(
    "point-spreads.full-field",
    "The full field against itself on a finer grid and in a wider window, on crops around points",
    {
        "point": "{name}", "grid halved": "{finer:.3%}", "window grown by 1.4": "{wider:.3%}",
        "patch - full field": "{error:.3%}",
    },
    (at_most("finer", 0.002), at_most("wider", 0.002)),
    page="docs/theory/accuracy.md",
    quick={"count": 1, "side": 0.3},
)  # fmt: skip
def convergence(*, count: int = 6, side: float = 1.4) -> Iterator[Row]:
    """Compare crops of a side in millimetres."""
    for camera, wavelength, x, y, g in (
        (PAPER, 633.0, 0.0, 0.0, 240.0), (PAPER, 633.0, 1.5, -1.2, 240.0), (PAPER, 633.0, 0.2, 0.1, 210.0),
        (PAPER, 633.0, -1.5, 1.5, 280.0), (SECOND, 532.0, 0.5, 0.4, 175.0), (SECOND, 532.0, 0.5, 0.4, 150.0),
    )[:count]:  # fmt: skip
        p, (columns, rows) = camera.pixel_size, camera.resolution
        size = round(side / p)
        corner = (round(columns / 2 + x / p - size / 2), round(rows / 2 + y / p - size / 2))
        crop = camera.replace(crop_offset=corner, crop_size=(size, size))
        point = np.array(_scene_point(camera, x, y, g))
        full, quick = (
            point_spread_function(crop, point, wavelength=wavelength, method=method)
            for method in ("full_field", "patch")
        )
        yield {
            "name": f"{'paper' if camera is PAPER else 'second'} ({x:g}, {y:g}) {g:g}",
            "finer": relative(full, full_field(OpticalSystem(crop, wavelength), point, refinement=2)),
            "wider": relative(full, full_field(OpticalSystem(crop, wavelength), point, growth=1.4)),
            "error": relative(quick, full),
        }


@case(
    "point-spreads.harder",
    "Extreme cameras, gaps between microlenses and hidden parts of the pupil, against refined full fields; points by "
    "fast lenses of coarse pixels, alone and among many, against accuracy 0",
    {"case": "{name}", "error": "{error:.2%}", "limit": "{limit:.2%}"},
    (at_most("error", "limit"),),
    quick={"count": 2},
)
def harder(*, count: int = 200) -> Iterator[Row]:
    """Compare both methods, then accuracies."""
    found = itertools.chain(extremes(), hidden_pupils(), gapped(), accuracies())
    for name, error, limit in itertools.islice(found, count):
        yield {"name": name, "error": error, "limit": limit}


Figure = tuple[str, float, float]
"""A name, a relative error, and the largest one allowed."""


def _refined(camera: PlenopticCamera, position: Any) -> np.ndarray:
    """Full field on a finer grid in a wider window, by the paper's wavelength."""
    return full_field(OpticalSystem(camera, 633.0), np.array(position), refinement=1.4, growth=1.2)


def extremes() -> Iterator[Figure]:
    """Single spreads of accuracy 0 by cameras that demand more of the grids than the paper's."""
    for name, (camera, position) in EXTREMES.items():
        reference = _refined(camera, position)
        for method, limit in (("full_field", 0.003), ("patch", 0.005)):
            spread = point_spread_function(camera, position, wavelength=633.0, method=method)
            yield f"{name}, {method}", relative(spread, reference), limit


def gapped() -> Iterator[Figure]:
    """Add a dozen points by microlenses with opaque gaps, at the default accuracy of many radiators."""
    g = np.linspace(226.0, 252.0, 12)
    points = np.column_stack([0.1 * np.cos(3 * g), 0.1 * np.sin(3 * g), g])
    # Few radiators would get a finer grid, since what is cut of each does not average out.
    many = np.tile(points, (50, 1))

    for (name, parameters), fill in itertools.product(GAPPED.items(), FILLS):
        camera = PAPER.replace(detector_width=0.256, resolution=(128, 128), mla_fill=fill, **parameters)
        references = [_refined(camera, point) for point in points]
        reference, full = sum(references), full_field(OpticalSystem(camera, 633.0), points[0])
        patch = CaptureOperator(camera, many, wavelength=633.0).forward(np.full(len(many), 1 / 50))
        yield f"{name}, mla_fill {fill:g}, full_field", relative(full, references[0]), 0.003
        yield f"{name}, mla_fill {fill:g}, patch", relative(patch, reference), 0.01


def hidden_pupils() -> Iterator[Figure]:
    """Pupils of which cells are hidden, against a full field of half the pitch."""
    place = np.arange(16)
    masks = {"half": (place >= 8) & (place >= 0)[:, None], "quarter": (place >= 8) & (place >= 8)[:, None]}

    for (name, mask), g in itertools.product(masks.items(), (225.0, 240.0)):
        weights, point = mask[None], np.array([0.06, -0.05, g])
        reference, full = (
            full_field(
                OpticalSystem(SMALL, 633.0), point, pupil_weights=PupilWeights.of(weights, 1), refinement=refinement
            )
            for refinement in (2, 1)
        )
        patch = CaptureOperator(SMALL, [point], wavelength=633.0, accuracy=0, pupil_weights=weights).forward([1.0])
        yield f"{name} of the pupil at {g:g}, full_field", relative(full, reference), 0.002
        yield f"{name} of the pupil at {g:g}, patch", relative(patch, reference), 0.003


FAST = [
    *itertools.product(((1.8, 5), (2, 7), (2.8, 10), (4, 7), (10, 7)), ["square"], (0, 2), [0]),
    *itertools.product(((2, 7), (10, 7)), ["hexagonal"], [0], [0]),
    *itertools.product(((2, 7), (10, 7)), ["square"], [2], [20]),
]
"""F-numbers and pixels of 5 micrometres a lens, lattices, blurs and distances from the axis in lenses."""


def blurred(camera: PlenopticCamera, places: np.ndarray, lenses: float) -> np.ndarray:
    """Return scene points (n, 3) with images about places (n, 2) on the array, blurred over some lenses."""
    image = camera.mla_distance / (1 + lenses * camera.mla_pitch / camera.aperture_diameter)
    g = 1 / (1 / camera.focal_length - 1 / image)
    return np.column_stack([-places * g / camera.mla_distance, np.full(len(places), g)])


def accuracies() -> Iterator[Figure]:
    """Single points alone, and a hundred alone and among so many that less diffracted light is kept."""
    rng = np.random.default_rng(1)
    for (f_number, pixels), lattice, blur, beside in FAST:
        whole = PlenopticCamera.matched(
            f_number=f_number, lenses=96, pixels_per_lens=pixels, pixel_size=0.005, focal_length=50,
            focus_distance=320, mla_lattice=lattice,
        )  # fmt: skip
        middle = np.array(whole.resolution) // 2 + np.array([beside * pixels, 0])
        side = round((17 + 1.6 * blur) * pixels)
        camera = whole.replace(crop_offset=tuple((middle - side // 2).tolist()), crop_size=(side, side))
        places = rng.uniform(-2.5, 2.5, (520, 2)) + np.array([beside, 0])
        points, weights = blurred(camera, places * camera.mla_pitch, blur), rng.uniform(0.5, 1, 100)
        among = np.pad(weights, (0, len(points) - 100))

        def image(points: np.ndarray, weights: Any, accuracy: float, camera: Any = camera) -> np.ndarray:
            return CaptureOperator(camera, points, wavelength=550, accuracy=accuracy).forward(weights)

        single, exact = image(points[:1], [1.0], 0), image(points[:100], weights, 0)
        for accuracy in (0.05, 0.01):
            name = f"f/{f_number:g}, {pixels} pixels, {lattice}, blur {blur}, {beside} lenses off axis, {accuracy:g}"
            yield f"{name}, one", relative(image(points[:1], [1.0], accuracy), single), accuracy
            yield f"{name}, a hundred", relative(image(points[:100], weights, accuracy), exact), accuracy
            yield f"{name}, a hundred among many", relative(image(points, among, accuracy), exact), accuracy


@case(
    "point-spreads.particles",
    "Particles of 10 micrometres by waves, 2048 x 2048 pixels, 550 nm, depths to a blur of eight lenses; the error is "
    "that of the first hundred against point spreads of their own, relative L2",
    {
        "particles": "{particles}", "time (s)": "{seconds:.0f}", "peak memory (GiB)": "{memory:.2f}",
        "error": "{error:.2%}",
    },
    (at_most("seconds", 60), at_most("memory", 2), at_most("error", 0.01)),
    page="docs/guides/particles.md",
    quick={"count": 200},
)  # fmt: skip
def particles(*, count: int = 10000) -> Iterator[Row]:
    """Particles in the paper's field of view."""
    camera = PAPER.replace(resolution=(2048, 2048))
    box = pt.ParticleVolume((-7, -7, 217.7), (7, 7, 267.4))
    truth = pt.particle_sequence(camera, box, pt.Seeding(count=count), pt.Uniform((0, 0, 0)), interval=1, frames=1)
    start = time.perf_counter()
    pt.ParticleImages(truth, wavelength=550).capture(0)
    seconds, memory = time.perf_counter() - start, peak_memory()
    few = truth.copy(deep=True)
    few["inside"][:, 100:] = 0
    # The others stay, without light, so that the band of directions is that of many.
    light = scattered_light(truth, 0, 550.0, camera)
    powers, amplitudes = light.followed(0.01)
    weights = np.where(np.arange(len(light.positions)) < 100, powers / powers.sum(0).mean(), 0).ravel()
    points = np.tile(light.positions, (len(powers), 1))
    operator = CaptureOperator(camera, points, wavelength=550, pupil_weights=amplitudes)
    exact = pt.ParticleImages(few, wavelength=550, accuracy=0).capture(0)
    scale = powers.sum(0)[:100].mean() / powers.sum(0).mean()
    error = relative(operator.forward(weights), scale * exact.image)
    yield {"particles": len(light.positions), "seconds": seconds, "memory": memory, "error": error}
