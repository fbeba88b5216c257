"""Results of the public interface for every kind of camera, to compare two versions of the package number by number.

    python tools/goldens.py write OUT.npz [--only PATTERN]
    python tools/goldens.py compare OLD.npz NEW.npz

`write` computes every legal combination of a microlens array, a main lens and a task with the package that Python
imports, and stores the results in one file. `compare` prints a row for each result that differs: equal bits are
expected where statements only moved; 1e-6 in relative L2 is allowed for sums in another order, and 1e-4 for what
iterates. The exit status is 1 where a difference is larger, or where a result is missing.
"""

from __future__ import annotations

import argparse
import re
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import mitsuba_plenoptic as mp  # noqa: E402

WAVELENGTH = 550.0
ITERATING = ("deconvolved", "fit", "calibrate")
LENSES = 6

ARRAYS: dict[str, dict[str, Any]] = {
    "square": {},
    "hexagonal": {"mla_lattice": "hexagonal"},
    "turned": {"mla_rotation": 7.0, "mla_offset": (0.01, -0.02), "mla_fill": 0.9},
    "rectangular": {"mla_pitch": (0.064, 0.05)},
    "three focal lengths": {"mla_lattice": "hexagonal", "mla_focal_length": (0.44, 0.512, 0.6)},
    "focused": {"mla_distance": 112.0, "detector_distance": 0.6},
}
MAIN_LENSES: dict[str, dict[str, Any]] = {
    "thin": {},
    "aberrated": {"wavefront": (0.0, 0.0, 0.0, 0.0, 0.1, 0.05)},
    "double Gauss": {"main_lens": "double_gauss", "focus_distance": 240.0},
    "Tessar": {"main_lens": "tessar", "focus_distance": 240.0},
    "objective": {"main_lens": mp.Objective(20.0, 0.4)},
    "dispersion": {"glass": "N-BK7"},
}


def camera_of(array: str, lens: str) -> mp.PlenopticCamera:
    """Return the small camera of a combination."""
    numbers = {"detector_width": 0.064 * LENSES, "resolution": (16 * LENSES,) * 2} | MAIN_LENSES[lens] | ARRAYS[array]
    if lens == "objective":
        own = {"mla_pitch": 0.15, "mla_focal_length": 3.75, "detector_width": 0.15 * LENSES}
        special = {
            "rectangular": {"mla_pitch": (0.15, 0.12)},
            "three focal lengths": {"mla_focal_length": (3.3, 3.75, 4.2)},
            "focused": {"detector_distance": 4.2},
        }
        numbers |= own | special.get(array, {})
        numbers.pop("mla_distance", None)
    if "focus_distance" in numbers:
        numbers.pop("mla_distance", None)
    return mp.PlenopticCamera(**numbers)


def points_of(camera: mp.PlenopticCamera) -> np.ndarray:
    """Return some points near the object side's focus."""
    rng = np.random.default_rng(3)
    if camera.objective is not None:
        return rng.uniform(-1, 1, (6, 3)) * (0.015, 0.015, 0.004)
    focus = 240.0 if camera.prescription is not None else 1 / (1 / camera.focal_length - 1 / camera.mla_distance)
    g = focus * rng.uniform(0.92, 1.08, 6)
    return np.column_stack([rng.uniform(-0.15, 0.15, (6, 2)) * -g[:, None] / camera.mla_distance, g])


def scene_of(camera: mp.PlenopticCamera) -> Any:
    """Return a scene: a textured card, slightly turned, before the camera."""
    rng = np.random.default_rng(5)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(rng.random((16, 16, 3), np.float32)), "filter_type": "nearest"}
    depth, width = (0.0, 0.06) if camera.objective is not None else (points_of(camera)[:, 2].mean(), 1.2)
    T = mi.ScalarTransform4f
    card = T().translate([0, 0, float(depth)]).rotate([0, 1, 0], 180 + 10).scale(width)
    return mi.load_dict({
        "type": "scene", "integrator": {"type": "path"},
        "sensor": camera.to_sensor() | {"sampler": {"type": "independent", "sample_count": 4}},
        "card": {"type": "rectangle", "to_world": card, "emitter": {"type": "area", "radiance": texture}},
    }, optimize=False)  # fmt: skip


def operator_tasks(camera: mp.PlenopticCamera, full: bool) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield the sums of points, and their derivatives."""
    points, rng = points_of(camera), np.random.default_rng(7)
    weights = rng.uniform(0.5, 1.5, len(points))
    for method in ("patch", "full_field") if full else ("patch",):
        sums = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, method=method)
        yield f"{method} forward", lambda sums=sums: sums.forward(weights)
        image = rng.random((camera.resolution[1], camera.resolution[0]), np.float32)
        yield f"{method} adjoint", lambda sums=sums, image=image: sums.adjoint(image)
    if not full:
        return
    sums = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0.0)
    image = rng.random((camera.resolution[1], camera.resolution[0]), np.float32)
    yield "jvp", lambda: sums.derivative(weights, {"mla_focal_length": 1.0, "detector_distance": 0.5})
    yield "vjp", lambda: sums.gradient(weights, image)


def scene_tasks(camera: mp.PlenopticCamera) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield captures of a scene, and what is made of them."""
    kept: dict[str, mp.Capture] = {}

    def capture(model: str) -> Any:
        kept[model] = mp.render_capture(scene_of(camera), model=model, spp=4, seed=1)
        return kept[model].image

    yield "ray capture", lambda: capture("ray")
    yield "wave capture", lambda: capture("wave")
    distance = float(points_of(camera)[:, 2].mean()) * 0.97

    def refocused(model: str, **how: Any) -> Any:
        waves = {"wavelength": WAVELENGTH} if how.get("method", "ray") != "ray" else {}
        return mp.reconstruct(kept[model], distance, **waves, **how).image

    methods: dict[str, dict[str, Any]] = {
        "ray lens": {"footprint": "lens"},
        "ray point": {"footprint": "point"},
        "coherent": {"method": "coherent"},
        "partial 2": {"method": "partial", "interleave": 2},
        "partial auto": {"method": "partial", "interleave": "auto"},
        "deconvolved": {"method": "deconvolved", "iterations": 3},
    }
    for name, how in methods.items():
        yield f"reconstruct {name}", lambda how=how: refocused("wave", **how)
    yield "reconstruct ray", lambda: refocused("ray")
    yield "decode", lambda: np.asarray(mp.decode(kept["ray"]))
    yield "expose", lambda: mp.expose(kept["ray"], mp.Detector(), photons=500.0, seed=2).image


def other_tasks() -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield what is computed for one camera only."""
    camera = camera_of("square", "thin")
    points = points_of(camera)
    yield "point spread", lambda: mp.point_spread_function(camera, points[0], wavelength=WAVELENGTH)
    yield (
        "figures",
        lambda: np.array(
            [
                mp.design.image_f_number(camera),
                mp.design.mla_f_number(camera),
                mp.design.pixel_footprint(camera, 200.0),
                mp.design.spot_radius(camera, 200.0),
                *mp.design.refocus_range(camera),
            ]
        ),
    )

    def fitted() -> Any:
        from mitsuba_plenoptic.fitting import View

        moved = camera.replace(mla_focal_length=0.52)
        image = mp.CaptureOperator(moved, points, wavelength=WAVELENGTH, accuracy=0.0).forward(np.ones(len(points)))
        seen = View(image, points, np.ones(len(points)), noise=float(image.max()) / 100)
        found = mp.fit(camera, seen, ["mla_focal_length"], wavelength=WAVELENGTH)
        return np.array([found.camera.mla_focal_length])

    yield "fit", fitted
    for lens in MAIN_LENSES:
        for array in ARRAYS:
            yield f"file {array} {lens}", lambda a=array, b=lens: text(sorted(camera_of(a, b).to_dict().items()))


def text(value: Any) -> np.ndarray:
    """Return the text of a value as an array of bytes."""
    return np.frombuffer(str(value).encode(), np.uint8)


def results(only: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield every result with its name; what is refused is stored as the text of its refusal."""

    def computed(name: str, task: Callable[[], Any]) -> Iterator[tuple[str, np.ndarray]]:
        if not re.search(only, name):
            return
        start = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                value = task()
        except (mp.InputError, mp.PhysicsError) as error:
            value = text(f"refused: {error}")
        except (KeyError, AttributeError) as error:  # what an earlier refusal left out
            value = text(f"error: {error!r}")
        except Exception:
            traceback.print_exc()
            value = text("exception")
        print(f"{time.perf_counter() - start:6.2f} s  {name}", file=sys.stderr, flush=True)
        for key, part in value.items() if isinstance(value, dict) else [("", value)]:
            yield f"{name} {key}".strip(), np.asarray(part)

    for lens in MAIN_LENSES:
        for array in ARRAYS:
            label = f"{array} | {lens}"
            try:
                camera = camera_of(array, lens)
                tasks = [*operator_tasks(camera, array in ("square", "three focal lengths"))]
            except (mp.InputError, mp.PhysicsError) as error:
                yield label, text(f"refused: {error}")
                continue
            for name, task in [*tasks, *scene_tasks(camera)]:
                yield from computed(f"{label} | {name}", task)
    for name, task in other_tasks():
        yield from computed(name, task)


def compare(old: Path, new: Path) -> int:
    """Print what differs, and return the exit status."""
    a, b = np.load(old), np.load(new)
    worst, same = 0, 0
    for name in a.files:
        if name not in b.files:
            print(f"missing   {name}")
            worst = 1
            continue
        x, y = a[name], b[name]
        if x.shape == y.shape and x.dtype == y.dtype and x.tobytes() == y.tobytes():
            same += 1
            continue
        if x.dtype == np.uint8:
            print(f"text      {name}: {x.tobytes().decode()[:150]} -> {y.tobytes().decode(errors='replace')[:150]}")
            worst = 1
            continue
        if x.shape != y.shape:
            print(f"shape     {name}: {x.shape} -> {y.shape}")
            worst = 1
            continue
        known = np.isfinite(x)
        error = np.linalg.norm((y - x)[known]) / max(np.linalg.norm(x[known]), 1e-300)
        limit = 1e-4 if any(word in name for word in ITERATING) else 1e-6
        bad = not error <= limit or (known != np.isfinite(y)).any()
        worst |= bad
        print(f"{'DIFFERS' if bad else 'rounding'}  {name}: {error:.1e}")
    added = set(b.files) - set(a.files)
    print(f"{same} results of {len(a.files)} have the same bits; {len(added)} are new")
    return int(worst)


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=("write", "compare"))
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--only", default="", help="regular expression that the names of results hold")
    given = parser.parse_args()
    if given.what == "compare":
        return compare(*given.files)
    np.savez_compressed(given.files[0], **dict(results(given.only)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
