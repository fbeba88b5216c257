"""Results of the public interface for every kind of camera, to compare two versions of the package number by number.

    python tools/goldens.py OLD NEW [--short | --only PATTERN]

OLD and NEW are commits, or folders of worktrees with what is not committed. Each version computes the same tasks in a
process of its own: captures, reconstructions by every method, sums of points and derivatives of every kind of array,
main lens, preset and variant. A table has a line for each row, and below it stands each result that differs. `--short`
takes some rows, in less than five minutes; `--only` those whose names match. Nothing is stored.

Equal bits are expected where statements only moved; 1e-6 in relative L2 is allowed for sums in another order, and 1e-4
for what iterates. The exit status is 1 where a difference is larger, or where a result is missing. Only public names
are called.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")
import mitsuba_plenoptic as mp  # noqa: E402

ROOT = Path(__file__).parents[1]
WAVELENGTH = 550.0
ITERATING = ("deconvolved", "fit")
LENSES = 4

ARRAYS: dict[str, dict[str, Any]] = {
    "square": {},
    "hexagonal": {"mla_lattice": "hexagonal"},
    "turned": {"mla_pitch": (0.064, 0.05), "mla_rotation": 7.0, "mla_offset": (0.01, -0.02), "mla_fill": 0.9},
    "three focal lengths": {"mla_lattice": "hexagonal", "mla_focal_length": (0.44, 0.512, 0.6)},
    "focused": {"mla_distance": 112.0, "detector_distance": 0.6},
}
MAIN_LENSES: dict[str, dict[str, Any]] = {
    "thin": {"aperture_radius": 2.0},
    "aberrated": {"aperture_radius": 2.0, "wavefront": (0.0, 0.0, 0.0, 0.0, 0.1, 0.05)},
    "dispersive": {"aperture_radius": 2.0, "glass": {"index": 1.5168, "abbe": 64.17}},
    "double Gauss": {"main_lens": "double_gauss", "focus_distance": 240.0},
    "Tessar": {"main_lens": "tessar", "focus_distance": 240.0},
    "objective": {"main_lens": mp.Objective(20.0, 0.4)},
}
IRREGULAR: dict[str, dict[str, Any]] = {
    "jittered": {"mla_jitter": (0.002, 0.0)},
    "tilted": {"mla_tilt": (0.5, -0.3)},
    "spherical": {"mla_shape": {"form": "conic", "curvature_radius": 0.26, "conic": 0}},
    "none": {"mla_lattice": "none", "resolution": (48, 48), "detector_width": 0.256},
    "six blades": {"aperture_blades": 6},
    "blurred": {"detector_blur": 0.001, "pixel_crosstalk": 0.02},
}
"""Other arrays, pupils and pixels, behind a thin main lens."""

VARIANTS = {"mono": "llvm_ad_mono", "spectral": "llvm_ad_spectral"}
"""Beside rgb, in which all other rows are."""

SHORT = (
    r"^(square|hexagonal|focused) \| thin|^square \| (dispersive|double Gauss|objective|mono)|^(jittered|none) "
    r"|on-chip|other results"
)
"""Rows of the short set."""

BEHIND_OBJECTIVE: dict[str, dict[str, Any]] = {
    "turned": {"mla_pitch": (0.15, 0.12)},
    "three focal lengths": {"mla_focal_length": (3.3, 3.75, 4.2)},
    "focused": {"detector_distance": 4.2},
}
"""Numbers of the arrays at the larger pitch that suits the objective."""

ON_CHIP = mp.PlenopticCamera(
    focal_length=6.8, aperture_radius=6.8 / 3.6, focus_distance=1000.0, mla_focal_length=0.0045, mla_pitch=0.0024,
    detector_width=0.0192, resolution=(16, 16),
)  # fmt: skip
"""A telephone's camera of 8 x 8 lenses above 2 x 2 pixels."""

PRESETS = (
    "paper", "lytro", "raytrix", "paper_double_gauss", "raytrix_double_gauss", "lfm", "lfm_water", "telescope",
    "shack_hartmann", "full_frame_50mm", "phone", "full_frame_dual", "phone_quad", "phone_quad_bayer",
)  # fmt: skip

Tasks = Iterator[tuple[str, Callable[[], Any]]]


def camera_of(array: str, lens: str) -> mp.PlenopticCamera:
    """Return the small camera of a row."""
    numbers = {"detector_width": 0.064 * LENSES, "resolution": (12 * LENSES,) * 2} | MAIN_LENSES[lens]
    numbers |= (ARRAYS | IRREGULAR)[array]
    if lens == "objective":
        numbers |= {"mla_pitch": 0.15, "mla_focal_length": 3.75, "detector_width": 0.15 * LENSES}
        numbers |= BEHIND_OBJECTIVE.get(array, {})
    if lens in ("double Gauss", "Tessar", "objective"):
        numbers.pop("mla_distance", None)
    return mp.PlenopticCamera(**numbers)


def points_of(camera: mp.PlenopticCamera) -> np.ndarray:
    """Return some points near the object side's focus."""
    rng = np.random.default_rng(3)
    if camera.objective is not None:
        return rng.uniform(-1, 1, (4, 3)) * (0.015, 0.015, 0.004)
    focus = 240.0 if camera.prescription is not None else 1 / (1 / camera.focal_length - 1 / camera.mla_distance)
    g = focus * rng.uniform(0.96, 1.04, 4)
    return np.column_stack([rng.uniform(-0.1, 0.1, (4, 2)) * -g[:, None] / camera.mla_distance, g])


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


def sums_of(camera: mp.PlenopticCamera, **options: Any) -> mp.CaptureOperator:
    """Return the sum of a camera's points."""
    return mp.CaptureOperator(camera, points_of(camera), wavelength=WAVELENGTH, **options)


def point_tasks(camera: mp.PlenopticCamera) -> Tasks:
    """Yield sums of points, their derivatives, and a realisation of laser light."""
    weights = np.random.default_rng(7).uniform(0.5, 1.5, 4)
    image = np.random.default_rng(8).random(camera.resolution[::-1], np.float32)
    change = {"mla_focal_length": 1.0, "detector_distance": 0.5}
    yield "forward", lambda: sums_of(camera).forward(weights)
    yield "adjoint", lambda: sums_of(camera).adjoint(image)
    yield "jvp", lambda: sums_of(camera).derivative(weights, change)
    yield "vjp", lambda: sums_of(camera).gradient(weights, image)
    yield "laser", lambda: mp.laser.coherent_capture(sums_of(camera, method="full_field"), weights, modes=1, seed=1)


def scene_tasks(camera: mp.PlenopticCamera) -> Tasks:
    """Yield captures of a scene, and what is made of them."""
    kept: dict[str, mp.Capture] = {}
    distance = float(points_of(camera)[:, 2].mean()) * 0.97

    def capture(model: str) -> Any:
        kept[model] = mp.render_capture(scene_of(camera), model=model, spp=4, seed=1)
        return kept[model].image

    def refocused(model: str, **how: Any) -> Any:
        waves = {"wavelength": WAVELENGTH} if how.get("method", "ray") != "ray" else {}
        return mp.reconstruct(kept[model], distance, **waves, **how).image

    methods: dict[str, dict[str, Any]] = {
        "ray lens": {"footprint": "lens"},
        "ray point": {"footprint": "point"},
        "coherent": {"method": "coherent"},
        "partial 2": {"method": "partial", "interleave": 2},
        "partial auto": {"method": "partial", "interleave": "auto"},
        "incoherent": {"method": "incoherent"},
        "deconvolved": {"method": "deconvolved", "iterations": 3},
    }
    yield "ray capture", lambda: capture("ray")
    yield "wave capture", lambda: capture("wave")
    for name, how in methods.items():
        yield f"reconstruct {name}", lambda how=how: refocused("wave", **how)
    yield "reconstruct ray", lambda: refocused("ray")
    yield "decode", lambda: np.asarray(mp.decode(kept["ray"]))
    yield "expose", lambda: mp.expose(kept["ray"], mp.Detector(), photons=500.0, seed=2).image
    yield "camera file", lambda: text(sorted(camera.to_dict().items()))


def on_chip_tasks() -> Tasks:
    """Yield captures of photodiodes under lenses of a few wavelengths, and of tables of their responses."""
    scene = {
        "type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"},
        "lamp": {"type": "sphere", "center": [0, 0, 700], "radius": 0.8, "light": {"type": "area", "radiance": 5.0}},
    }  # fmt: skip
    angles = [-20.0, -5.0, 8.0, 20.0]
    responses = np.random.default_rng(0).random((1, 1, 4, 4)).tolist()
    table = ON_CHIP.replace(photodiode_response={"angles_x": angles, "angles_y": angles, "responses": responses})

    def capture(camera: mp.PlenopticCamera, model: str) -> mp.Capture:
        return mp.render_capture(mi.load_dict(scene | {"sensor": camera.to_sensor()}), model=model, spp=8, seed=1)

    yield "ray capture", lambda: capture(ON_CHIP, "ray").image
    yield "wave capture", lambda: capture(ON_CHIP, "wave").image
    yield "table", lambda: capture(table, "ray").image
    yield "halves", lambda: np.asarray(mp.dual_pixel(capture(ON_CHIP, "ray")))
    wider = ON_CHIP.replace(detector_width=0.0768, resolution=(64, 64))
    yield "bank", lambda: mp.psf_bank(wider, [700.0]).values


def preset_tasks(name: str) -> Tasks:
    """Yield captures by the middle of a preset's detector, and a point spread."""
    camera = mp.PlenopticCamera.preset(name)
    size = min(48, *camera.resolution)
    offset = tuple((length - size) // 2 for length in camera.resolution)
    camera = camera.replace(crop_offset=offset, crop_size=(size, size))
    scene = {"type": "scene", "integrator": {"type": "path"}, "sky": {"type": "constant"}, "sensor": camera.to_sensor()}

    def capture(model: str) -> Any:
        return mp.render_capture(mi.load_dict(scene, optimize=False), model=model, spp=4, seed=1).image

    yield "ray capture", lambda: capture("ray")
    yield "wave capture", lambda: capture("wave")
    yield "camera file", lambda: text(sorted(camera.to_dict().items()))


def variant_tasks(variant: str) -> Tasks:
    """Yield captures of a scene in another variant."""
    camera = camera_of("square", "dispersive")

    def capture(model: str) -> Any:
        mi.set_variant(variant)
        try:
            return mp.render_capture(scene_of(camera), model=model, spp=4, seed=1).image
        finally:
            mi.set_variant("llvm_ad_rgb")

    yield "ray capture", lambda: capture("ray")
    yield "wave capture", lambda: capture("wave")


def laser_tasks() -> Tasks:
    """Yield a capture of a wall in laser light."""
    camera = mp.PlenopticCamera(
        focal_length=40, aperture_radius=1.25, mla_distance=60, detector_width=0.128, resolution=(32, 32)
    )
    wall = mi.ScalarTransform4f().translate([0, 0, 120]).rotate([0, 1, 0], 180).scale(20)
    scene = {
        "type": "scene",
        "integrator": {"type": "plenoptic_laser", "lasers": "laser", "points_per_spot": 2.0},
        "sensor": camera.to_sensor(),
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": {"type": "diffuse"}},
        "laser": {"type": "point", "position": [0, 0, 20], "intensity": {"type": "spectrum", "value": 1e4}},
    }

    def capture() -> Any:
        mi.set_variant("llvm_ad_mono")
        image = mp.render_capture(mi.load_dict(scene, optimize=False), seed=1).image
        mi.set_variant("llvm_ad_rgb")
        return image

    yield "laser capture", capture


def other_tasks() -> Tasks:
    """Yield what is computed for one camera only."""
    camera = camera_of("square", "thin")
    points = points_of(camera)
    design = mp.design
    whole = mp.CaptureOperator(camera, points[:1], wavelength=WAVELENGTH, method="full_field")
    exact = mp.CaptureOperator(camera, points[:1], wavelength=WAVELENGTH, accuracy=0.0)
    yield "full field", lambda: whole.forward([1.0])
    yield "exact jvp", lambda: exact.derivative([1.0], {"detector_distance": 1.0})
    yield "exact vjp", lambda: exact.gradient([1.0], whole.forward([1.0]))
    yield "point spread", lambda: mp.point_spread_function(camera, points[0], wavelength=WAVELENGTH)
    yield "f-numbers", lambda: np.array([design.image_f_number(camera), design.mla_f_number(camera)])
    yield "sizes", lambda: np.array([design.pixel_footprint(camera, 200.0), design.spot_radius(camera, 200.0)])
    yield "range", lambda: np.array(design.refocus_range(camera))

    def fitted() -> Any:
        image = mp.point_spread_function(camera.replace(mla_focal_length=0.52), points[0], wavelength=WAVELENGTH)
        seen = mp.fitting.View(image, points[:1], [1.0], noise=float(image.max()) / 100)
        return np.array([mp.fit(camera, seen, ["mla_focal_length"], wavelength=WAVELENGTH).camera.mla_focal_lengths[0]])

    yield "fit", fitted


def text(value: Any) -> np.ndarray:
    """Return the text of a value as an array of bytes."""
    return np.frombuffer(str(value).encode(), np.uint8)


def rows() -> Iterator[tuple[str, Callable[[], Tasks]]]:
    """Yield each row's name, and what yields its tasks."""
    for lens in MAIN_LENSES:
        for array in ARRAYS:

            def tasks(array: str = array, lens: str = lens) -> Tasks:
                camera = camera_of(array, lens)
                yield from point_tasks(camera)
                yield from scene_tasks(camera)

            yield f"{array} | {lens}", tasks
    for array in IRREGULAR:

        def irregular(array: str = array) -> Tasks:
            camera = camera_of(array, "thin")
            yield from point_tasks(camera)
            yield from scene_tasks(camera)

        yield f"{array} | thin", irregular
    for name in PRESETS:
        yield f"its own | preset {name}", lambda name=name: preset_tasks(name)
    for name, variant in VARIANTS.items():
        yield f"square | {name}", lambda variant=variant: variant_tasks(variant)
    yield "2 x 2 pixels a lens | on-chip", on_chip_tasks
    yield "square | laser light", laser_tasks
    yield "square | other results", other_tasks


def results(only: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield every result with its name; what is refused is stored as the text of its refusal."""

    def computed(name: str, task: Callable[[], Any]) -> Any:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return task()
        except (mp.InputError, mp.PhysicsError) as error:
            return text(f"refused: {error}")
        except RuntimeError as error:  # what a plugin refuses, with Mitsuba's traceback before it
            return text(f"refused: {str(error).strip().splitlines()[-1]}")
        except KeyError as error:  # the capture that was refused
            return text(f"nothing: {error!r}")

    for row, tasks in rows():
        if not re.search(only, row):
            continue
        start, count = time.process_time(), 0
        for name, task in tasks():
            value = computed(name, task)
            for key, part in value.items() if isinstance(value, dict) else [("", value)]:
                count += 1
                yield f"{row} | {name} {key}".strip(), np.asarray(part)
        print(f"{time.process_time() - start:6.1f} s  {count:3} results  {row}", file=sys.stderr, flush=True)


def difference(x: np.ndarray, y: np.ndarray) -> float | str:
    """Return the relative L2 difference of two results, or what makes them incomparable."""
    if x.dtype == np.uint8 or y.dtype == np.uint8:
        old, new = (v.tobytes().decode() if v.dtype == np.uint8 else f"an array {v.shape}" for v in (x, y))
        return f"{old} -> {new}"
    if x.shape != y.shape or (np.isfinite(x) != np.isfinite(y)).any():
        return f"shape or unknown values: {x.shape} -> {y.shape}"
    known = np.isfinite(x)
    return float(np.linalg.norm((y - x)[known]) / max(np.linalg.norm(x[known]), 1e-300))


def compare(old: Path, new: Path) -> int:
    """Print the table and what differs, and return the exit status."""
    table: dict[str, list[tuple[str, float]]] = {}
    wrong = []
    with np.load(old) as a, np.load(new) as b:
        wrong += [f"missing: {name}" for name in a.files if name not in b.files]
        for name in (name for name in a.files if name in b.files):
            x, y = a[name], b[name]
            row, _, task = name.rpartition(" | ")
            same = x.shape == y.shape and x.dtype == y.dtype and x.tobytes() == y.tobytes()
            error = 0.0 if same else difference(x, y)
            table.setdefault(row, []).append(
                (task, np.inf if isinstance(error, str) else max(error, 0 if same else 1e-99))
            )
            if isinstance(error, str) or error > (1e-4 if any(word in task for word in ITERATING) else 1e-6):
                wrong.append(f"{name}: {error if isinstance(error, str) else f'{error:.1e}'}")
    print("| array | main lens | results | same bits | largest difference |\n| --- | --- | ---: | ---: | --- |")
    for row, found in table.items():
        task, worst = max(found, key=lambda each: each[1])
        same = sum(error == 0 for _, error in found)
        print(f"| {row} | {len(found)} | {same} | {f'{worst:.1e}, {task}' if worst else 'none'} |")
    print(f"\n{len(wrong)} results differ by more than 1e-6, or 1e-4 for {' and '.join(ITERATING)}", *wrong, sep="\n")
    return int(bool(wrong))


def written(version: str, only: str, folder: Path) -> Path:
    """Compute the results of a commit or a worktree, and return their file."""
    there, out = folder / version.replace("/", "-"), folder / f"{version.replace('/', '-')}.npz"
    if Path(version).is_dir():
        there = Path(version).resolve()
    else:
        command = ["git", "worktree", "add", "--detach", str(there), version]
        subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    try:
        command = [sys.executable, __file__, version, version, "--only", only, "--write", str(out)]
        subprocess.run(command, env=os.environ | {"PYTHONPATH": str(there)}, check=True)
    finally:
        if there.parent == folder:
            subprocess.run(["git", "worktree", "remove", "--force", str(there)], cwd=ROOT, check=True)
    return out


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("old", metavar="OLD")
    parser.add_argument("new", metavar="NEW")
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument("--short", action="store_true", help="some rows, in less than five minutes")
    chosen.add_argument("--only", default="", metavar="PATTERN", help="rows whose names match a regular expression")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    only = SHORT if options.short else options.only
    if options.write:
        print(f"results of {Path(mp.__file__).parent}", file=sys.stderr)
        np.savez_compressed(options.write, **dict(results(only)))
        return 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        old, new = (folder / side for side in ("old", "new"))
        old.mkdir()
        new.mkdir()
        return compare(written(options.old, only, old), written(options.new, only, new))


if __name__ == "__main__":
    sys.exit(main())
