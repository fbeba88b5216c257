"""Measure derivatives of wave captures through `mi.render`, both ways, against differences with radiators held.

    python tools/render_gradient_accuracy.py [--lenses 8] [--radiators-per-lens 3]

The scene is that of the letters, made small before 64 lenses behind half the paper's main lens at half its distances,
with a card beside them that shines by four by four texels. The light changes through a texture and through radiance,
whose differences are those of captures that are rendered anew: nothing but the light changes between them. The
camera's numbers change all at once, against central differences of the full field of every radiator, on grids that are
held. Reverse is compared with forward.

``--anew`` renders so many pairs of captures, too, whose radiators are found anew on both sides, at places that differ
from pair to pair: the mean of their differences must agree with that of the derivatives, whose radiators are held,
within the noise that the pairs show. Printed is the mean over squares of pixels of the squared difference over its
variance, beside what it is for Gaussian noise; and the same if the derivatives are left out, which tells what the
comparison is worth. A difference is then mostly of radiators that come and go at edges, rarely and much: steps must be
so large that these are many. Writes ``render_gradient_accuracy.md`` and ``.json`` to the folder that
``--output`` names; exits with 1 where an error is beyond its limit.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import accuracy
import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.capture.full_field import full_field
from mitsuba_plenoptic.capture.full_field_grids import field_grids
from mitsuba_plenoptic.capture.units import brightness_of

WAVELENGTH = 633.0
LIMIT, TRANSPOSE = 0.01, 1e-4
WINDOW = 1.4
"""Width of the full field's windows over that for images, as of `derivative_accuracy`."""

MESHES = Path(__file__).resolve().parents[1] / "scenes" / "meshes"
LETTERS = {"eight": (2.8, 105.0), "f": (0.0, 120.0), "hash": (-2.8 * 140 / 105, 140.0)}
"""Places of the letters before as many lenses as the paper's, across and along."""

TEXTURE, RADIANCE = "card.emitter.radiance.data", "f.emitter.radiance.value"
STEPS = {
    "focal_length": 1e-3,
    "mla_distance": 1.5e-3,
    "mla_focal_length": 1e-4,
    "mla_pitch": 5e-6,
    "mla_rotation": 0.005,
    "mla_offset": [1.5e-5, -1e-5],
    "detector_distance": 1e-4,
}
"""By how much the camera's numbers change."""


def scene_of(lenses: int, radiators: int, passes: int = 0) -> Any:
    """Return the scene before so many lenses across; by several passes with spreads that are shared."""
    transform, scale = mi.ScalarTransform4f(), lenses / 128
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {
            "type": "plenoptic_wave", "radiators_per_lens": radiators, "accuracy": 0.02 if passes else 0.0,
            "method": "patch", "passes": max(passes, 1),
            "child": {"type": "path", "max_depth": 2},
        },
        "camera": {
            "type": "plenoptic",
            "focal_length": 40.0, "aperture_radius": 2.5, "mla_distance": 60.0,
            "detector_width": 0.064 * lenses,
            "film": {
                "type": "hdrfilm", "width": 32 * lenses, "height": 32 * lenses, "pixel_format": "luminance",
                "component_format": "float32", "filter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": 1},
        },
        "card": {
            "type": "rectangle",
            "to_world": transform.translate([0.1, -0.2, 125.0]).rotate([0, 1, 0], 180).scale(0.1),
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {
                "type": "area",
                "radiance": {
                    "type": "bitmap", "raw": True,
                    "bitmap": mi.Bitmap(np.random.default_rng(1).uniform(0.2, 1, (4, 4, 1)).astype(np.float32)),
                },
            },
        },
    }  # fmt: skip
    for name, (x, g) in LETTERS.items():
        scene[name] = {
            "type": "ply",
            "filename": str(MESHES / f"{name}.ply"),
            "face_normals": True,
            "to_world": transform.translate([0, 0, g]).scale([scale, scale, 1]).translate([x, 0, 0]),
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {"type": "area", "radiance": 1.0},
        }
    return mi.load_dict(scene)


def forward(scene: Any, directions: dict[str, Any], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the image and its derivative along changes of parameters."""
    params, amount = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(amount)
    for key, direction in directions.items():
        kind = type(params[key])
        params[key] = kind(params[key]) + amount * kind(direction)
    params.update()
    dr.forward(amount, dr.ADFlag.ClearEdges)
    image = mi.render(scene, params, seed=seed)
    return np.array(dr.detach(image), np.float64), np.array(dr.forward_to(image), np.float64)


def backward(scene: Any, keys: list[str], gradient: np.ndarray) -> dict[str, np.ndarray]:
    """Return the gradients of parameters from that of the image."""
    params = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params) * mi.TensorXf(gradient.astype(np.float32)), axis=None))
    return {key: np.array(dr.grad(params[key]), np.float64) for key in keys}


def light_difference(scene: Any, key: str, direction: Any, step: float) -> np.ndarray:
    """Return the difference of captures whose light differs."""
    params, sides = mi.traverse(scene), []
    start = type(params[key])(params[key])
    for side in (step, -step):
        params[key] = start + side * type(start)(direction)
        params.update()
        sides.append(np.array(mi.render(scene), np.float64))
    params[key] = start
    params.update()
    return (sides[0] - sides[1]) / (2 * step)


def camera_difference(scene: Any) -> np.ndarray:
    """Return the difference of full fields of all radiators, with all numbers of the camera changed at once."""
    capture = scene.integrator()._capture(scene, scene.sensors()[0])
    camera: PlenopticCamera = capture.camera
    (radiators,) = capture.radiators("patch", 0, 1)
    weights = (capture.scale(radiators) * radiators.radiance)[:, 0]
    total = 0.0
    for number, (weight, place) in enumerate(zip(weights, radiators.positions, strict=True)):
        # The letters hide parts of the pupil from each other.
        seen = None if radiators.pupil_weights is None else radiators.pupil_weights.take(np.array([number]))
        grids = field_grids(camera, place, WAVELENGTH, 1.0, WINDOW)
        for side in (1, -1):
            changes = {name: np.add(getattr(camera, name), np.multiply(side, step)) for name, step in STEPS.items()}
            moved = camera.replace(**{name: value.tolist() for name, value in changes.items()})
            growth = side / 2 * weight * brightness_of(moved) / brightness_of(camera)
            # The count of orders is held: a jump of it would be divided by the step.
            held = replace(grids, bend=grids.bend * camera.mla_pitch / moved.mla_pitch * (1 + 1e-9))
            total += growth * full_field(moved, place, WAVELENGTH, grids=held, pupil_weights=seen).astype(np.float64)
        print(f"{number + 1} of {len(weights)} radiators", flush=True)
    return np.asarray(total)


ANEW, BIN, NOISY, TOLD = 10.0, 4, 1.5, 3.0
"""Steps, over `STEPS`, of captures that are rendered anew; pixels across a square; most and least of the squares."""


def against_noise(lenses: int, radiators: int, pairs: int) -> tuple[float, float]:
    """Compare the derivatives with differences of captures that are rendered anew.

    Returns
    -------
    float, float
        Mean squared difference over its variance, over that of Gaussian noise; the same without the derivatives.
    """
    camera = {f"camera.{name}": step for name, step in STEPS.items()}
    found, expected = [], []
    for seed in range(pairs):
        change = _second_pass(lambda scene, seed: forward(scene, camera, seed)[1], lenses, radiators, seed)
        sides = [
            _second_pass(lambda scene, seed, side=side: moved_capture(scene, side, seed), lenses, radiators, seed)
            for side in (ANEW, -ANEW)
        ]
        found.append(change)
        expected.append((sides[0] - sides[1]) / (2 * ANEW))
        print(f"{seed + 1} of {pairs} pairs", flush=True)
    rows = [np.stack(expected) - np.stack(found), np.stack(expected)]
    binned = [row.reshape(pairs, lenses * 32 // BIN, BIN, lenses * 32 // BIN, BIN).sum((2, 4)) for row in rows]
    variance = binned[0].var(0, ddof=1) / pairs
    lit = variance > 1e-6 * variance.max()
    gaussian = (pairs - 1) / (pairs - 3)
    of_difference, of_all = (float((row.mean(0)[lit] ** 2 / variance[lit]).mean() / gaussian) for row in binned)
    return of_difference, of_all


def _second_pass(record: Any, lenses: int, radiators: int, seed: int) -> np.ndarray:
    """Return what the second of two passes records alone: the first has the same radiators whatever the seed."""
    both, first = (record(scene_of(lenses, radiators, passes), seed) for passes in (2, 1))
    return np.asarray(2 * both - first)[..., 0]


def moved_capture(scene: Any, amount: float, seed: int) -> np.ndarray:
    """Render a capture of the camera whose numbers are changed by so many steps."""
    params = mi.traverse(scene)
    for name, step in STEPS.items():
        kind = type(params[f"camera.{name}"])
        params[f"camera.{name}"] = kind(params[f"camera.{name}"]) + amount * kind(step)
    params.update()
    return np.array(mi.render(scene, seed=seed), np.float64)


def error(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the relative L2 difference."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def main() -> None:
    """Measure, and write the table."""
    parser = accuracy.options("render_gradient_accuracy", __doc__)
    parser.add_argument("--lenses", type=int, default=8, help="lenses across the detector")
    parser.add_argument("--radiators-per-lens", type=int, default=3, help="radiators per lens along each axis")
    parser.add_argument("--anew", type=int, default=0, help="pairs of captures whose radiators are found anew")
    arguments = accuracy.start(parser)
    rng, size = np.random.default_rng(2), (arguments.lenses, arguments.radiators_per_lens)
    texels = mi.TensorXf(rng.uniform(-0.2, 0.2, (4, 4, 1)).astype(np.float32))
    camera = {f"camera.{name}": step for name, step in STEPS.items()}
    cases: dict[str, dict[str, Any]] = {"texture": {TEXTURE: texels}, "radiance": {RADIANCE: 1.0}, "camera": camera}
    rows = []
    for case, directions in cases.items():
        image, change = forward(scene_of(*size), directions)
        if case == "camera":
            expected = camera_difference(scene_of(*size))[..., None]
        else:
            ((key, direction),) = directions.items()
            expected = light_difference(scene_of(*size), key, direction, 0.1)
        rows.append({"case": f"{case}, forward", "error": error(change, expected), "limit": LIMIT})
        print(f"{case}: changes the image by {np.linalg.norm(change) / np.linalg.norm(image):.3%}", flush=True)
        gradient = rng.normal(size=image.shape)
        found = backward(scene_of(*size), list(directions), gradient)
        back = sum(np.vdot(np.ravel(found[key]), np.ravel(np.array(step))) for key, step in directions.items())
        off = abs(np.vdot(change, gradient) - back) / (np.linalg.norm(change) * np.linalg.norm(gradient))
        rows.append({"case": f"{case}, reverse against forward", "error": float(off), "limit": TRANSPOSE})
        print(rows[-2:], flush=True)
    if arguments.anew:
        off, told = against_noise(*size, arguments.anew)
        case = "camera, rendered anew: squared difference over its variance"
        rows.append({"case": case, "error": off, "limit": NOISY})
        rows.append({"case": f"the least of it over {TOLD:g}, without derivatives", "error": TOLD / told, "limit": 1.0})
        print(rows[-2:], flush=True)
    for row in rows:
        row["verdict"] = "kept" if row["error"] <= row["limit"] else "beyond"
    columns = {"case": "{case}", "error": "{error:.2e}", "limit": "{limit:g}", "": "{verdict}"}
    accuracy.finish(arguments, rows, "# Derivatives through mi.render\n", accuracy.markdown(columns, rows))
    sys.exit(any(row["verdict"] == "beyond" for row in rows))


if __name__ == "__main__":
    main()
