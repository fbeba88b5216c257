"""Measure what derivatives of a capture of the letters take beside the capture itself, with spreads shared.

    python tools/derivative_benchmark.py                        # 256 x 256 pixels
    python tools/derivative_benchmark.py --pixels 4096          # the full size
    python tools/derivative_benchmark.py --torchoptics FOLDER   # one single-lens propagation, beside torchoptics

Radiators are found once, and weights kept. The image, its reverse derivative by all numbers of the camera and by the
two that are sought most often, and its forward one run in a process each: processor time, time, and the largest memory
above what the process had before. The first run compiles and is not counted where ``--runs`` is above 1. It needs
Linux. Limits: the reverse derivative by all numbers takes at most 4 times the processor time and 3 times the
memory of the image.

``--torchoptics`` times instead one point's light through one lens to a plane, and the gradient of the power there by
the focal length, on one thread: ours on a patch, whose detector has twice as many samples along each axis, and the
autograd of torchoptics with a field as large as the patch, in its own double precision. torchoptics lies in the named
folder. Ratios are printed without a limit. Writes ``derivative_benchmark.json`` to the folder that ``--output``
names; exits with 1 where a limit is not kept.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import accuracy
import numpy as np
from verdict import Verdict

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.capture.scene_light import SceneLight
from mitsuba_plenoptic.capture.scene_points import find_points
from mitsuba_plenoptic.lenses.factory import main_lens
from mitsuba_plenoptic.operator.accuracy import derivative_band_for
from mitsuba_plenoptic.operator.grid import Grid, place
from mitsuba_plenoptic.operator.units import radiance_weight
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.runtime.jobs import Job
from mitsuba_plenoptic.system.optical_system import OpticalSystem

WAVELENGTH = 633.0
TIME, MEMORY = 4.0, 3.0
MODES = ("image", "reverse", "reverse of two", "forward of one")


def main() -> None:
    """Measure and judge."""
    parser = accuracy.options("derivative_benchmark", __doc__)
    parser.add_argument("--pixels", type=int, default=256, help="across the detector of the letters")
    parser.add_argument("--points-per-lens", type=int, default=64)
    parser.add_argument("--accuracy", type=float, default=0.01, help="of captures and derivatives")
    parser.add_argument("--runs", type=int, default=2, help="of which the last is counted")
    parser.add_argument("--torchoptics", type=Path, help="folder that holds torchoptics")
    parser.add_argument("--mode", choices=MODES, help=argparse.SUPPRESS)
    parser.add_argument("--points", type=Path, help=argparse.SUPPRESS)
    arguments = accuracy.start(parser)
    if arguments.mode:
        print(json.dumps(measured(arguments)))
        return
    results = beside_torchoptics(arguments) if arguments.torchoptics else letters(arguments)
    (arguments.output / "derivative_benchmark.json").write_text(json.dumps(results, indent=1) + "\n")
    sys.exit(0 if results["kept"] else 1)


def letters(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run each mode in a process of its own, and judge what they take."""
    size = arguments.pixels / 4096
    camera = mp.PlenopticCamera(detector_width=8.192 * size, resolution=(arguments.pixels,) * 2)
    scene = mp.load_scene(
        "letters",
        parameters={
            "resolution": str(arguments.pixels), "detector_width": str(8.192 * size), "letter_scale": str(size)
        },
    )  # fmt: skip
    points, weights = points_of(scene, camera, arguments.points_per_lens)
    results: dict[str, Any] = {"pixels": arguments.pixels, "points": len(points)}
    print(f"{arguments.pixels} x {arguments.pixels} pixels, {len(points)} points", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "points.npz"
        np.savez(file, points=points, weights=weights)
        for mode in MODES:
            words = [sys.executable, __file__, "--mode", mode, "--points", str(file), "--output", str(arguments.output)]
            words += ["--pixels", str(arguments.pixels), "--accuracy", str(arguments.accuracy)]
            words += ["--runs", str(arguments.runs)]
            found = subprocess.run(words, check=True, capture_output=True, text=True).stdout
            results[mode] = json.loads(found.splitlines()[-1])
            print(mode, results[mode], flush=True)
    verdict, image = Verdict(), results["image"]
    for mode in MODES[1:]:
        ratio = {key: results[mode][key] / image[key] for key in image}
        print(mode, "over the image:", {key: round(value, 2) for key, value in ratio.items()}, flush=True)
        if mode == "reverse":
            verdict.judge("reverse over image, processor time", ratio["processor_seconds"], TIME)
            verdict.judge("reverse over image, memory", ratio["memory"], MEMORY)
    return results | {"kept": verdict.kept}


def points_of(scene: Any, camera: mp.PlenopticCamera, per_lens: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays from each lens first hit what shines, and the light of these points: together 1 for a lens."""
    light = SceneLight(scene, scene.sensors()[0], scene.integrator())
    found = find_points([light], camera, per_lens, seed=0, paths=1)
    return found.positions, found.weights[:, 0] / radiance_weight(camera, main_lens(camera), camera.lattice.cell_area)


def beside_torchoptics(arguments: argparse.Namespace) -> dict[str, Any]:
    """Time the image of one point by one lens, and its gradient by the focal length, on one grid and one thread."""
    camera = mp.PlenopticCamera(
        aperture_radius=2.0, mla_distance=119.5, detector_distance=0.5,
        # one weak microlens about the axis
        mla_focal_length=1e5, mla_pitch=2.0, mla_offset=(1.0, 1.0), detector_width=0.256, resolution=(128, 128),
    )  # fmt: skip
    operator = mp.CaptureOperator(camera, [(0.0, 0.0, 225.0)], wavelength=WAVELENGTH, accuracy=0.02)
    image, job = np.ones(camera.shape, np.float32), Job(batch_map=Threads(1))
    ours = {
        "image": fastest(lambda: operator.forward([1.0], job=job), arguments.runs),
        "gradient": fastest(lambda: operator.gradient([1.0], image, ("focal_length",), job=job), arguments.runs),
    }
    points = np.array(operator.points)
    grid = Grid.of(OpticalSystem(camera, WAVELENGTH), derivative_band_for(0.02, 1), points)
    size, pitch = int(place(grid, points).samples[0]), float(grid.pitch.min())
    theirs = of_torchoptics(arguments.torchoptics, size, pitch, arguments.runs)
    print(f"{size} x {size} samples; ours {ours}, torchoptics {theirs}, in s", flush=True)
    ratio = theirs["gradient"] / ours["gradient"]
    print(
        f"gradient: torchoptics over ours {ratio:.2f}; over the image: ours "
        f"{ours['gradient'] / ours['image']:.1f}, torchoptics {theirs['gradient'] / theirs['image']:.1f}",
        flush=True,
    )
    return {"samples": size, "ours": ours, "torchoptics": theirs, "ratio": ratio, "kept": True}


def of_torchoptics(folder: Path, size: int, pitch: float, runs: int) -> dict[str, float]:
    """Return what a thin lens and the propagation to its focus take torchoptics, and the gradient by autograd."""
    sys.path.insert(0, str(folder))
    import torch
    import torchoptics

    torch.set_num_threads(1)
    torchoptics.set_default_spacing(pitch)
    torchoptics.set_default_wavelength(WAVELENGTH * 1e-6)
    field = torchoptics.Field(torch.ones(size, size, dtype=torch.complex128))

    def image(lens: Any) -> Any:
        return lens(field).propagate_to_z(5.0, propagation_method="ASM").intensity().sum()

    def gradient() -> None:
        lens = torchoptics.elements.Lens(size, torch.nn.Parameter(torch.tensor(80.0, dtype=torch.double)))
        image(lens).backward()
        assert lens.focal_length.grad is not None

    still = torchoptics.elements.Lens(size, 80.0)
    return {"image": fastest(lambda: image(still), runs), "gradient": fastest(gradient, runs)}


def fastest(work: Callable[[], Any], runs: int) -> float:
    """Return the least processor time of some runs, after one that compiles."""
    work()
    found = []
    for _ in range(runs):
        began = time.process_time()
        work()
        found.append(time.process_time() - began)
    return min(found)


def measured(arguments: argparse.Namespace) -> dict[str, float]:
    """Return what one mode takes in this process."""
    stored = np.load(arguments.points)
    points, weights = stored["points"], stored["weights"]
    width = 8.192 * arguments.pixels / 4096
    camera = mp.PlenopticCamera(detector_width=width, resolution=(arguments.pixels,) * 2)
    operator = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=arguments.accuracy)
    image = np.random.default_rng(0).uniform(-1, 1, camera.shape).astype(np.float32)
    work = {
        "image": lambda: operator.forward(weights),
        "reverse": lambda: operator.gradient(weights, image),
        "reverse of two": lambda: operator.gradient(weights, image, ("focal_length", "wavefront")),
        "forward of one": lambda: operator.derivative(weights, {"focal_length": 1.0}),
    }[arguments.mode]
    before = memory("VmRSS")
    for _ in range(arguments.runs):
        began = time.perf_counter(), time.process_time()
        work()
        taken = time.perf_counter() - began[0], time.process_time() - began[1]
    return {"seconds": taken[0], "processor_seconds": taken[1], "memory": memory("VmHWM") - before}


def memory(what: str) -> float:
    """Return what Linux tells of this process's memory, in GiB: resident now (VmRSS), or at most so far (VmHWM)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(what)) / 2**20


if __name__ == "__main__":
    main()
