"""White walls and ramps, refocused at their own distance by every method: every bin that is reached, to the border.

A wall of radiance 1 and one whose radiance rises from 0.5 to 1.5 across the field stand at a distance, or are the sky;
they are captured by rays and by waves through square and hexagonal lattices. Each capture is refocused to the wall by
every method, ray captures by rays without a white reference, all others with the capture of the white wall as one, and
the worst bin is compared with the radiance that is known. Bins that are NaN are not reached; their part is told.

A camera far out of focus sees a plane through the diffraction of its microlenses: at infinity the paper's lens blurs it
over nine bins, with tails of sinc squared that reach beyond the ramp's ends, where the radiance is even. That is so
before any reconstruction, by every method alike. So there are two columns: against the radiance, and against what
diffraction leaves of it (`seen`); captures by waves are judged by the second one. Both are the same for rays.

    python tools/reconstruction_accuracy.py --output out [--lenses 24] [--distances 210 inf] [--models ray]
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from typing import Any

import accuracy
import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, reconstruct, render_capture

LIMITS = {"ray": 0.02, "wave": 0.03}
LATTICES: dict[str, dict[str, Any]] = {"square": {}, "hexagonal": {"mla_lattice": "hexagonal"}}
RAYS: dict[str, dict[str, Any]] = {"ray": {"method": "ray"}}
WAVES: dict[str, dict[str, Any]] = {
    "coherent": {"method": "coherent"},
    "K = 2": {"method": "partial", "interleave": 2},
    "auto": {"method": "partial", "interleave": "auto"},
}
COLUMNS = {
    "lattice": "{lattice}",
    "lenses": "{lenses}",
    "g (mm)": "{distance:g}",
    "capture": "{model}",
    "method": "{method}",
    "wall": "{wall}",
    "worst bin": "{worst_of_radiance:.4f}",
    "after diffraction": "{worst:.4f}",
    "limit": "{limit:g}",
    "not reached": "{unreached:.1%}",
    "s": "{seconds:.1f}",
}

_TEXELS = 8192
_WALL = 1.9
"""Half width of a wall over that of the field: the radiance of a ramp stays above zero."""


def main() -> int:
    """Capture, refocus, compare, and write the table; 1 if a bin is beyond its limit."""
    parser = accuracy.options("reconstruction_accuracy", __doc__)
    parser.add_argument("--lenses", type=int, nargs="*", default=[24, 128])
    parser.add_argument("--pixels", type=int, default=32, help="pixels across a lens")
    parser.add_argument("--distances", type=float, nargs="*", default=[150.0, 210.0, 280.0, 1000.0, math.inf])
    parser.add_argument("--lattices", nargs="*", choices=LATTICES, default=list(LATTICES))
    parser.add_argument("--models", nargs="*", choices=LIMITS, default=list(LIMITS))
    parser.add_argument("--methods", nargs="*", choices=[*RAYS, *WAVES], default=[*RAYS, *WAVES])
    parser.add_argument("--wall-spp", type=int, default=64, help="samples per pixel by rays, paths by waves")
    arguments = accuracy.start(parser)
    rows = []
    for lenses, lattice, distance, model in itertools.product(
        arguments.lenses, arguments.lattices, arguments.distances, arguments.models
    ):
        camera = PlenopticCamera(
            detector_width=0.064 * lenses, resolution=(arguments.pixels * lenses,) * 2, **LATTICES[lattice]
        )
        captures = {wall: capture(camera, distance, wall, model, arguments.wall_spp) for wall in ("white", "ramp")}
        for method in arguments.methods:
            for row in compare(camera, distance, captures, method):
                rows.append({"lattice": lattice, "lenses": lenses, "model": model, **row})
                print(accuracy.markdown(COLUMNS, rows[-1:]).splitlines()[-1], flush=True)
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, rows))
    return int(any(row["worst"] > row["limit"] for row in rows))


def compare(camera: PlenopticCamera, distance: float, captures: dict[str, Capture], method: str) -> list[accuracy.Row]:
    """Refocus the captures of both walls by one method, and find the worst bin of each."""
    model = captures["white"].model
    needed = method not in RAYS or model == "wave"
    found = []
    for wall, taken in captures.items():
        start = time.process_time()
        image = reconstruct(
            taken,
            distance,
            wavelength=None if method in RAYS else 633.0,
            white=captures["white"] if needed else None,
            **(RAYS | WAVES)[method],
        ).image
        known = seen(camera, wall, None)
        expected = seen(camera, wall, distance) if model == "wave" else known
        found.append(
            {
                "distance": distance,
                "method": method + (", white reference" if needed else ""),
                "wall": wall,
                "worst_of_radiance": float(np.nanmax(np.abs(image - known))),
                "worst": float(np.nanmax(np.abs(image - expected))),
                "limit": LIMITS[model],
                "unreached": float(np.isnan(image).mean()),
                "seconds": time.process_time() - start,
            }
        )
    return found


def seen(camera: PlenopticCamera, wall: str, distance: float | None) -> np.ndarray:
    """Radiance of the wall in each column of bins, after the diffraction of the microlenses if a distance is given."""
    columns, parts, far = camera.bin_count[0], 16, 64
    # In units of half the field; +x, to which the radiance rises, is left.
    slope = -((np.arange(columns * parts * far) + 0.5) / parts - columns * far / 2) / (columns / 2)
    radiance = _radiance(np.clip(slope, -_WALL, _WALL), wall)
    if distance is not None:
        b, pitch = camera.mla_distance, camera.mla_pitch
        # Light of one direction is spread by lambda / D2, which b (1 / f1 - 1 / b - 1 / g) makes the scene's.
        turned = b * abs(1 / camera.focal_length - 1 / b - 1 / distance)
        frequency = np.fft.rfftfreq(slope.size, 1 / parts) * 633e-6 * b / pitch * turned / pitch
        radiance = np.fft.irfft(np.fft.rfft(radiance) * _transfer(camera, frequency), slope.size)
    return radiance.reshape(-1, parts).mean(1)[columns * (far - 1) // 2 :][:columns]


def _transfer(camera: PlenopticCamera, frequency: np.ndarray) -> np.ndarray:
    """Incoherent transfer function of a microlens along x, over the frequency in units of its cut-off."""
    shape = camera.lattice.aperture_image(camera.mla_pitch / 65, 1.0)
    lines = np.abs(np.fft.rfft(shape, 16 * shape.shape[1], axis=1)) ** 2
    overlap = np.fft.irfft(lines.sum(0))[: shape.shape[1]]
    return np.interp(frequency * 65, np.arange(overlap.size), overlap / overlap[0], right=0.0)


def capture(camera: PlenopticCamera, distance: float, wall: str, model: str, spp: int) -> Capture:
    """Capture a wall, or for an infinite distance a sky."""
    half = camera.bin_count[0] / 2 * camera.mla_pitch / camera.mla_distance
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": camera.to_sensor(),
        "wall": _sky(half, wall) if math.isinf(distance) else _wall(half, distance, wall),
    }
    options = {"wavelength": 633.0} if model == "wave" else {}
    return render_capture(mi.load_dict(scene), model=model, spp=spp if model == "ray" else 1, **options)


def _wall(half: float, distance: float, wall: str) -> dict[str, Any]:
    size = _WALL * half * distance
    slope = _WALL * ((np.arange(512) + 0.5) / 256 - 1)
    turned = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], 180).scale([size, size, 1])
    # A rectangle that is turned to the camera has its u along -x.
    return {
        "type": "rectangle",
        "to_world": turned,
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
        "emitter": {"type": "area", "radiance": _texture(-slope, wall)},
    }


def _sky(half: float, wall: str) -> dict[str, Any]:
    angle = 2 * math.pi * (np.arange(_TEXELS) + 0.5) / _TEXELS
    # Mitsuba's longitude runs from -z by +x; ahead is +z.
    slope = np.clip(np.where(np.cos(angle) < 0, -np.tan(angle) / half, 0), -_WALL, _WALL)
    return {"type": "envmap", "bitmap": _bitmap(np.tile(_radiance(slope, wall), (64, 1)))}


def _radiance(slope: np.ndarray, wall: str) -> np.ndarray:
    """Radiance at a place in units of half the field."""
    return 1 + 0.5 * slope if wall == "ramp" else np.ones_like(slope)


def _texture(slope: np.ndarray, wall: str) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": _bitmap(np.tile(_radiance(slope, wall), (4, 1))), "raw": True}


def _bitmap(values: np.ndarray) -> Any:
    return mi.Bitmap(np.repeat(values[..., None], 3, axis=2).astype(np.float32))


if __name__ == "__main__":
    sys.exit(main())
