"""Designs of cameras by their own figures, judged by what the search did not see.

Joint design: parameters of the camera trained together with a small network that finds depths from wave captures.

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import CaptureOperator, PhysicsWarning, PlenopticCamera, StoredOperator, render_capture
from mitsuba_plenoptic.optimisation import DepthInformation, RefocusedContrast, maximise
from mitsuba_plenoptic.report.images import write_png

from .. import Row, case, figure

SCAN = np.linspace(0.42, 0.66, 25)
"""Microlens focal lengths, in millimetres."""

FREQUENCIES = (0.3, 0.6, 0.9)

PHOTONS, BACKGROUND = 10000.0, 1.0

OTHER_PHOTONS, OTHER_BACKGROUND = 4000.0, 4.0

SEEN = (232.0, 234.0, 236.0, 238.0, 240.0, 242.0, 244.0, 246.0, 248.0)

UNSEEN = (233.0, 235.0, 237.0, 239.0, 241.0, 243.0, 245.0, 247.0)
"""Distances of points by which wavefronts are sought and judged, in millimetres.

They lie about the plane in focus, where a camera without aberrations resolves depth worst.
"""

TERMS = range(5, 12)
"""Aberrations that vary, by Noll's numbers: astigmatism to spherical."""

LARGEST = 1.0
"""Waves of each, at most."""


@dataclass(frozen=True)
class Setting:
    """A camera, and the points before it."""

    camera: PlenopticCamera
    scale: float

    @classmethod
    def of(cls, half: bool) -> Setting:
        """Return that of the paper, of a small detector, or with half of its main lens."""
        scale, lenses = (0.5, 10) if half else (1.0, 16)
        camera = PlenopticCamera(
            focal_length=80 * scale,
            aperture_radius=5 * scale,
            mla_distance=120 * scale,
            detector_distance=0.512,
            detector_width=0.064 * lenses,
            resolution=(32 * lenses,) * 2,
        )
        return cls(camera, scale)

    def points(self, distances: tuple[float, ...], seed: int) -> np.ndarray:
        """Return a point at each distance, whose image lies anywhere in the lenses about the axis."""
        g = self.scale * np.array(distances)
        image = np.random.default_rng(seed).uniform(-0.064, 0.064, (len(g), 2))
        return np.column_stack([-image * g[:, None] / self.camera.mla_distance, g])


@case(
    "designs.focal-length",
    "The microlens focal length of most contrast of points refocused between 220 and 260 mm, sought from random "
    "starts, against a scan",
    page="docs/guides/designing.md",
    quick={"starts": 1, "half": True, "scan": 7},
)
def focal_length(output: Path, *, starts: int = 10, half: bool = False, scan: int = 25) -> Iterator[Row]:
    """Search and scan; ``half`` takes the main lens at half its size and distances, which costs a fourth."""
    setting, low, high = Setting.of(half), float(SCAN[0]), float(SCAN[-1])
    measure = RefocusedContrast(setting.camera, setting.points((220.0, 230.0, 250.0, 260.0), 1), FREQUENCIES)

    def best_of(values: np.ndarray) -> int:
        return int(np.argmax([measure.value(setting.camera.replace(mla_focal_length=f)) for f in values.tolist()]))

    coarse = np.linspace(low, high, scan)
    best = best_of(coarse)
    fine = np.linspace(coarse[max(best - 1, 0)], coarse[min(best + 1, scan - 1)], 21)
    found = float(fine[best_of(fine)])
    yield figure("best of the scan", found, unit="mm")
    for start in np.random.default_rng(2).uniform(low, high, starts).tolist():
        design = maximise(measure, setting.camera.replace(mla_focal_length=start), {"mla_focal_length": (low, high)})
        end = design.values["mla_focal_length"]
        yield figure(f"from {start:.4f} mm, off the scan's best", abs(end / found - 1), at_most=0.005)
    draw(
        output / "contrast.png",
        [measure.refocused(setting.camera.replace(mla_focal_length=f)) for f in (low, found)],
    )


@case(
    "designs.wavefront",
    "Aberrations of the main lens, tilt and defocus left out, by which captures resolve most of the depth of points "
    "between 232 and 248 mm, judged by full fields with another noise",
    page="docs/guides/designing.md",
    quick={"starts": 1, "half": True, "steps": 1, "draws": 300},
)
def wavefront(output: Path, *, starts: int = 3, half: bool = False, steps: int = 12, draws: int = 300) -> Iterator[Row]:
    """Seek from random starts near no aberration, where the slopes vanish by symmetry.

    Estimated depths of noisy captures must keep to their bounds. For points that the search did not see the gain is
    stated without a limit.
    """
    setting = Setting.of(half)
    plain = setting.camera.replace(wavefront=(0.0,) * max(TERMS))
    measure = DepthInformation(setting.points(SEEN, 3), PHOTONS, background=BACKGROUND, method="patch")
    rng, bounds = np.random.default_rng(4), {f"wavefront.{term}": (-LARGEST, LARGEST) for term in TERMS}
    designs = []
    for _ in range(starts):
        coefficients = np.zeros(max(TERMS))
        coefficients[TERMS[0] - 1 :] = rng.uniform(-0.3, 0.3, len(TERMS))
        start = plain.replace(wavefront=tuple(coefficients.tolist()))
        designs.append(maximise(measure, start, bounds, steps=steps))
    design = max(designs, key=lambda design: design.figure)
    # A search that is cut short gains nothing.
    whole = 1.0 if steps >= 12 else None
    ratio = np.exp(measure.value(plain) - design.figure)
    yield figure("own figure, deviation after over before", ratio, at_most=whole)
    for which, distances, seed in (("points of the search", SEEN, 3), ("other points", UNSEEN, 5)):
        other = DepthInformation(
            setting.points(distances, seed), OTHER_PHOTONS, background=OTHER_BACKGROUND, method="full_field"
        )
        spreads = []
        for name, camera in (("before", plain), ("after", design.camera)):
            spreads.append(estimates(other, camera, draws))
            off = abs(np.mean((spreads[-1] / other.deviations(camera)) ** 2) - 1)
            yield figure(f"full fields, {which}, {name}: squared spread over bound, off 1", off, at_most=0.15)
        gain = np.exp(np.mean(np.log(spreads[1] / spreads[0])))
        limit = whole if distances is SEEN else None
        yield figure(f"full fields, {which}: spread of depths after over before", gain, at_most=limit)
    draw(output / "spreads.png", [list(measure.expected(camera)[0])[::4] for camera in (plain, design.camera)])


def estimates(measure: DepthInformation, camera: PlenopticCamera, draws: int) -> np.ndarray:
    """Return the standard deviations of depths, estimated by one step of scoring from captures with other noise."""
    rng, found = np.random.default_rng(6), []
    for image, *slopes in zip(*measure.expected(camera), strict=True):
        noise = np.maximum(image, 0) + OTHER_BACKGROUND
        rows = np.stack([*slopes, image]).reshape(4, -1) / np.sqrt(noise.ravel())
        solve = np.linalg.solve(rows @ rows.T, rows)[2] / np.sqrt(noise.ravel())
        found.append(float((rng.poisson(noise.ravel(), (draws, noise.size)) @ solve).std()))
    return np.array(found)


def draw(path: Path, rows: list[list[np.ndarray]]) -> None:
    """Write images side by side, each by its own peak."""
    write_png(
        path, np.vstack([np.hstack([np.maximum(image, 0) / image.max() for image in row]) for row in rows]) ** 0.5
    )


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
