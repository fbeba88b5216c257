"""Joint design: parameters of the camera trained together with a small network that finds depths from wave captures.

Two points at one depth and random places shine before the middle of the array. A network of one convolution by lens and
two dense layers finds the depth from the raw pixels of one capture, with photon and read noise. Gradients by the
camera's parameters are those of wave captures. One camera is trained with all parameters and one with the paper's
opening, so that the gain of a larger opening, which collects more light, is separate from that of the lenses' distances
and the wavefront; for the same reason the paper's camera is judged with the opening of the trained one, too.

For each of these cameras a network is then trained alone, from the start and in the same way. All are judged on other
points with other noise, in captures as in training and in captures by the full field, which shares no point spreads or
patches with them. Each seed has points, noise and networks of its own. Cameras and errors are stored for each seed: a
run that was stopped resumes.
"""

from __future__ import annotations

import importlib
import json
import math
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import CaptureOperator, PhysicsWarning, PlenopticCamera, StoredOperator, render_capture

from .. import Row, case

LENSES, PIXELS, WAVELENGTH, ACCURACY = 6, 12, 633.0, 0.02

NEAREST, FARTHEST = 232.8, 247.2
"""Depths of the points, evenly in their inverse; in focus is 240."""

TOGETHER, ASIDE = 2, 0.06
"""Points in a capture, and how far from the axis their images are at most."""

JOINT_PHOTONS, READ_NOISE = 300.0, 2.0
"""Photons of a point through the paper's opening on the detector, and electrons."""

JOINT_LARGEST = 7.5
"""Radius of the opening, at most: micro-images then touch."""

JOINT_TERMS = 8
"""Aberrations that are trained: Noll's terms from the fourth, defocus."""

RATE, NETWORK_RATE, BATCH, NOISES = 0.05, 2e-3, 16, 4


@case(
    "joint-design",
    "Depth from single wave captures: the paper's camera with a network, and a camera trained together with one",
    {
        "camera": "{what}", "radius of the opening (mm)": "{radius}", "RMS error (mm)": "{error}",
        "by full fields": "{full}", "single seeds": "{each}",
    },
    page="docs/guides/inverse_problems.md",
    quick={"seeds": 1, "steps": 2, "captures": 32, "judged": 16, "full": 2, "epochs": 2},
    needs=("torch",),
)  # fmt: skip
def joint_design(
    output: Path,
    *,
    seeds: int = 5,
    steps: int = 60,
    captures: int = 600,
    judged: int = 200,
    full: int = 6,
    epochs: int = 60,
) -> Iterator[Row]:
    """Train cameras, and judge them with networks trained alone; the cameras are saved as files."""
    settings = captures, judged, full, epochs
    cameras: dict[str, list[PlenopticCamera]] = {}
    found: dict[str, list[tuple[float, float]]] = {}
    for seed in range(seeds):
        for what, camera in cameras_of(seed, steps, output).items():
            cameras.setdefault(what, []).append(camera)
            stored = output / f"errors_{seed}_{_word(what)}.json"
            asked = {"camera": json.loads(camera.to_json()), "seed": seed, "settings": list(settings)}
            known = json.loads(stored.read_text()) if stored.exists() else {}
            if {name: known.get(name) for name in asked} != asked:
                known = asked | {"errors": errors(camera, seed, *settings)}
                stored.write_text(json.dumps(known))
            found.setdefault(what, []).append(tuple(known["errors"]))
    yield {"what": "the middle depth for all", "radius": "", "error": f"{guess():.2f}", "full": "", "each": ""}
    for what, values in found.items():
        plain, checked = ([each[kind] for each in values] for kind in (0, 1))
        radii = [camera.aperture_radius for camera in cameras[what]]
        yield {
            "what": what, "error": spread(plain), "full": spread(checked), "values": values,
            "radius": f"{min(radii):.1f}" + (f" to {max(radii):.1f}" if max(radii) > min(radii) else ""),
            "cameras": [camera.to_dict() for camera in cameras[what]],
            "each": ", ".join(f"{value:.2f}" for value in plain),
        }  # fmt: skip


def cameras_of(seed: int, steps: int, folder: Path) -> dict[str, PlenopticCamera]:
    """Return the cameras that are compared, of which the trained ones are read from their files if they are there."""
    paper = PlenopticCamera(detector_width=0.064 * LENSES, resolution=(LENSES * PIXELS, LENSES * PIXELS))
    trained = {}
    for what, opening in (("trained, the paper's opening", False), ("trained", True)):
        file = folder / f"camera_{seed}_{steps}_{_word(what)}.json"
        if not file.exists():
            file.write_text(train_camera(paper, seed, steps, opening).to_json())
        trained[what] = PlenopticCamera.from_json(file.read_text())
        require_renders(trained[what])
    wider = paper.replace(aperture_radius=trained["trained"].aperture_radius)
    return {"the paper's": paper, "the paper's, the trained opening": wider, **trained}


def _word(what: str) -> str:
    """Return a name for files."""
    return re.sub(r"\W+", "_", what)


def spread(values: list[float]) -> str:
    """Return a mean with the standard deviation of single values."""
    return f"{np.mean(values):.2f}" + (f" +- {np.std(values, ddof=1):.2f}" if len(values) > 1 else "")


def guess() -> float:
    """Return the RMS error in depth of the middle of the range."""
    return math.sqrt(1 / 3) * in_millimetres(1.0)


def in_millimetres(error: float) -> float:
    """Return an error in units of half the range of inverse depths, in millimetres of depth in focus."""
    return error * (1 / NEAREST - 1 / FARTHEST) / 2 * 240.0**2


def points(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points of some captures, their weights (captures, points), and the depths from -1 to 1."""
    depth = rng.uniform(-1, 1, count)
    inverse = (1 / NEAREST + 1 / FARTHEST) / 2 + depth * (1 / NEAREST - 1 / FARTHEST) / 2
    g = np.repeat(1 / inverse, TOGETHER)
    position = np.column_stack([-rng.uniform(-ASIDE, ASIDE, (len(g), 2)) * g[:, None] / 120.0, g])
    weights = np.zeros((count, len(g)), np.float32)
    weights[np.repeat(np.arange(count), TOGETHER), np.arange(len(g))] = rng.uniform(0.3, 1, len(g))
    return position, weights, depth.astype(np.float32)


def network(seed: int) -> Any:
    """Return a network from captures to depths."""
    torch: Any = importlib.import_module("torch")
    torch.manual_seed(seed)
    layers = torch.nn
    return layers.Sequential(
        layers.Conv2d(1, 16, PIXELS, stride=PIXELS), layers.ReLU(), layers.Flatten(),
        layers.Linear(16 * LENSES**2, 64), layers.ReLU(), layers.Linear(64, 1), layers.Flatten(0),
    )  # fmt: skip


def seen(images: Any, radius: Any, generator: Any) -> Any:
    """Return what the network gets of captures: their photons with noise, of even variance."""
    torch: Any = importlib.import_module("torch")
    electrons = (images * (JOINT_PHOTONS * (radius / 5.0) ** 2)).clamp(min=0)
    noise = torch.randn(images.shape, generator=generator)
    recorded = electrons + (electrons + READ_NOISE**2).sqrt() * noise
    return (recorded.clamp(min=0) + READ_NOISE**2).sqrt()[:, None] - READ_NOISE


def parameters(theta: Any, opening: bool) -> dict[str, Any]:
    """Return the camera's parameters from numbers of order one; all 0 is the paper's camera.

    The opening changes with them or not.
    """
    torch: Any = importlib.import_module("torch")
    return {
        "focal_length": 80.0 * (1 + 0.01 * theta[0]),
        "mla_distance": 120.0 * (1 + 0.01 * theta[1]),
        "mla_focal_length": 0.512 * (0.1 * theta[2]).exp(),
        "detector_distance": 0.512 * (0.1 * theta[3]).exp(),
        "aperture_radius": JOINT_LARGEST * torch.sigmoid(math.log(2) + 0.5 * opening * theta[4]),
        "wavefront": torch.cat([torch.zeros(3), 0.3 * theta[5:]]),
    }


def train_camera(paper: PlenopticCamera, seed: int, steps: int, opening: bool) -> PlenopticCamera:
    """Train the camera's parameters together with a network."""
    torch: Any = importlib.import_module("torch")
    bridge: Any = importlib.import_module("mitsuba_plenoptic.torch")
    rng, generator = np.random.default_rng([1, seed]), torch.Generator().manual_seed(seed)
    model, theta = network(seed), torch.zeros(5 + JOINT_TERMS, requires_grad=True)
    groups = [{"params": [theta], "lr": RATE}, {"params": model.parameters(), "lr": NETWORK_RATE}]
    optimizer = torch.optim.Adam(groups)
    for _ in range(steps):
        position, weights, depth = points(rng, BATCH)
        values = parameters(theta, opening)

        def make(camera: PlenopticCamera, position: np.ndarray = position) -> CaptureOperator:
            return CaptureOperator(camera, position, wavelength=WAVELENGTH, accuracy=ACCURACY)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PhysicsWarning)
            images = bridge.capture(make, paper, values, torch.from_numpy(weights))
            pixels = seen(images.repeat(NOISES, 1, 1), values["aperture_radius"], generator)
            optimizer.zero_grad()
            (model(pixels) - torch.from_numpy(depth).repeat(NOISES)).square().mean().backward()
        optimizer.step()
    with torch.no_grad():
        return paper.replace(**{name: value.tolist() for name, value in parameters(theta, opening).items()})


def some(camera: PlenopticCamera, rng: np.random.Generator, count: int, method: str = "patch") -> tuple[Any, Any]:
    """Return some captures without noise, (captures, rows, columns), and their depths."""
    torch: Any = importlib.import_module("torch")
    bridge: Any = importlib.import_module("mitsuba_plenoptic.torch")
    position, weights, depth = points(rng, count)
    accuracy = {"accuracy": ACCURACY} if method == "patch" else {}
    operator = StoredOperator(camera, position, wavelength=WAVELENGTH, method=method, **accuracy)
    return bridge.forward(operator, torch.from_numpy(weights)), torch.from_numpy(depth)


def errors(
    camera: PlenopticCamera, seed: int, captures: int, judged: int, full: int, epochs: int
) -> tuple[float, float]:
    """Train a network alone for a camera; return its RMS errors for other captures, and for those by the full field."""
    torch: Any = importlib.import_module("torch")
    rng, generator = np.random.default_rng([2, seed]), torch.Generator().manual_seed(1000 + seed)
    radius, model = camera.aperture_radius, network(100 + seed)
    images, depths = some(camera, rng, captures)
    optimizer = torch.optim.Adam(model.parameters(), lr=NETWORK_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, epochs)
    for _ in range(epochs):
        for chosen in torch.randperm(len(images), generator=generator).split(BATCH):
            optimizer.zero_grad()
            found = model(seen(images[chosen], radius, generator))
            (found - depths[chosen]).square().mean().backward()
            optimizer.step()
        schedule.step()

    def error(images: Any, depths: Any) -> float:
        with torch.no_grad():
            off = [model(seen(images, radius, generator)) - depths for _ in range(NOISES)]
        return in_millimetres(float(torch.cat(off).square().mean().sqrt()))

    unseen = np.random.default_rng([3, seed])
    return error(*some(camera, unseen, judged)), error(*some(camera, unseen, full, "full_field"))


def require_renders(camera: PlenopticCamera) -> None:
    """Render a wave capture of a wall by a camera; raise an error if it is dark."""
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 240]).rotate([0, 1, 0], 180)}
    wall |= {"emitter": {"type": "area", "radiance": 1.0}}
    described = {"type": "scene", "integrator": {"type": "path"}, "sensor": camera.to_sensor(), "wall": wall}
    capture = render_capture(mi.load_dict(described), model="wave", wavelength=WAVELENGTH, spp=4)
    if not capture.image.mean() > 0.1:
        raise ValueError(f"the trained camera captures a wall of radiance 1 with a mean of {capture.image.mean():g}")
