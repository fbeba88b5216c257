"""Inverse problems: least squares with stored spreads against computed ones, and training steps in PyTorch."""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.sparse.linalg import lsqr

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, StoredOperator

from .. import Row, case, figure
from ..measures import relative
from ..timing import once

WAVELENGTH = 633.0

FASTER, MOST_OURS = 50.0, 0.25


def _camera(pixels: int) -> PlenopticCamera:
    return PlenopticCamera(detector_width=0.002 * pixels, resolution=(pixels, pixels))


@case(
    "inverse.lsqr",
    "Least squares with SciPy's lsqr: steps with stored point spreads, their computation included, against steps that "
    "compute them",
    page="docs/howto/inverse_problems.md",
    quick={"pixels": 64},
)
def least_squares(*, points: int = 25, pixels: int = 256, steps: int = 60, computed: int = 3) -> Iterator[Row]:
    """Find the weights of random points from a capture with noise."""
    camera, rng = _camera(pixels), np.random.default_rng(0)
    reach = camera.detector_width  # of points at twice the distance of the microlenses
    positions = np.column_stack([rng.uniform(-reach, reach, (points, 2)), rng.uniform(215, 260, points)])
    weights, options = rng.uniform(0.5, 1, points), {"wavelength": WAVELENGTH, "accuracy": 0}
    plain = CaptureOperator(camera, positions, **options)
    image = plain.forward(weights)  # plans the sums, and compiles the kernels
    noisy = image + rng.normal(size=image.shape) * image.std() / 10

    def solve(operator: CaptureOperator, count: int) -> Any:
        return lsqr(operator.as_linear_operator(), noisy.ravel(), iter_lim=count, atol=0, btol=0, conlim=0)

    found, _, busy = once(lambda: solve(plain, computed))
    each = busy / found[2]
    stored = StoredOperator(camera, positions, **options)
    _, _, making = once(stored.to_sparse)
    solved, _, solving = once(lambda: solve(stored, steps))
    whole = making + steps * solving / solved[2]
    yield figure(f"{computed} steps that compute the spreads, processor time", computed * each, unit="s")
    yield figure("computing and storing the spreads once", making, unit="s")
    yield figure(f"{steps} steps with stored spreads, and computing them", whole, unit="s")
    yield figure(f"times faster, {steps} steps", steps * each / whole, at_least=FASTER if pixels >= 256 else None)
    yield figure("image against that of computed spreads", relative(stored.forward(weights), image), at_most=1e-5)


@case(
    "inverse.training",
    "A training step of a small network on captures by stored spreads in PyTorch: its time, and the part of captures",
    page="docs/howto/inverse_problems.md",
    quick={"pixels": 64, "batch": 4, "across": 4},
    needs=("torch",),
)
def training(*, batch: int = 32, pixels: int = 256, across: int = 16, runs: int = 3) -> Iterator[Row]:
    """Capture planes whose weights are trained together with three convolutions that see the captures."""
    torch: Any = importlib.import_module("torch")
    bridge: Any = importlib.import_module("mitsuba_plenoptic.torch")
    camera = _camera(pixels)
    axis = np.linspace(-0.4, 0.4, across) * camera.detector_width * 2
    x, y = (each.ravel() for each in np.meshgrid(axis, axis))
    operator = StoredOperator(camera, np.column_stack([x, y, np.full(x.size, 240.0)]), wavelength=WAVELENGTH)
    torch.manual_seed(0)
    weights = torch.rand(batch, x.size, requires_grad=True)
    layers = [torch.nn.Conv2d(a, b, 3, padding=1) for a, b in ((1, 8), (8, 8), (8, 1))]
    network = torch.nn.Sequential(layers[0], torch.nn.ReLU(), layers[1], torch.nn.ReLU(), layers[2])
    trained = torch.optim.Adam([weights, *network.parameters()], lr=1e-3)
    spent, forward, adjoint = [0.0], operator.forward, operator.adjoint

    def timed(function: Any) -> Any:
        def call(given: Any) -> Any:
            start = time.perf_counter()
            result = function(given)
            spent[0] += time.perf_counter() - start
            return result

        return call

    operator.forward, operator.adjoint = timed(forward), timed(adjoint)  # type: ignore[method-assign]

    def step() -> None:
        trained.zero_grad()
        captures = bridge.forward(operator, weights)[:, None]
        (network(captures / captures.detach().std()) - 1).square().mean().backward()
        trained.step()

    _, making, _ = once(step)
    taken, ours = [], []
    for _ in range(runs):
        spent[0] = 0.0
        taken.append(once(step)[1])
        ours.append(spent[0])
    middle = int(np.argsort(taken)[runs // 2])
    yield figure(f"first step, with the spreads of {x.size} points", making, unit="s")
    yield figure(f"a step of {batch} captures of {pixels} x {pixels}", taken[middle], unit="s")
    yield figure("fraction of it in captures and their transpose", ours[middle] / taken[middle], at_most=MOST_OURS)
