"""Point spreads by patches against the full field, and the full field against its own limit."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator

import numpy as np
from cases import relative

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, point_spread_function
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.points.full_fields import full_field

from .. import Row, at_most, case
from ..timing import peak_memory

Point = tuple[float, float, float]

PAPER = PlenopticCamera()

SECOND = PlenopticCamera(
    focal_length=50, aperture_radius=4, mla_distance=70, mla_focal_length=0.4, mla_pitch=0.05,
    detector_width=5, resolution=(2000, 2000),
)  # fmt: skip


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


def blurred(camera: PlenopticCamera, places: np.ndarray, lenses: float) -> np.ndarray:
    """Return scene points (n, 3) with images about places (n, 2) on the array, blurred over some lenses."""
    image = camera.mla_distance / (1 + lenses * camera.row_pitch / camera.aperture_diameter)
    g = 1 / (1 / camera.focal_length - 1 / image)
    return np.column_stack([-places * g / camera.mla_distance, np.full(len(places), g)])


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
    needs=("miepython",),
    quick={"count": 200},
)  # fmt: skip
def particles(*, count: int = 10000) -> Iterator[Row]:
    """Particles in the paper's field of view."""
    from mitsuba_plenoptic import particles as pt
    from mitsuba_plenoptic.extensions.particles.particle_images import scattered_light

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
