"""Boards in the views of an unfocused camera: whether stated deviations are true."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsuba_plenoptic.extensions.calibrate.board_model import NAMES

from .. import Row, case, figure

sys.path.append(str(Path(__file__).parents[3] / "tests" / "extensions" / "calibrate"))


@case(
    "boards.deviations",
    "Errors of a camera fitted to noisy corners in views, over their stated deviations",
    quick={"fits": 4},
)
def deviations(*, fits: int = 200) -> Iterator[Row]:
    """Fit cameras that differ by as much as is assumed, to corners and centres with noise."""
    import view_cases

    errors = np.array([view_cases.normalised_errors(seed) for seed in range(fits)])
    enough = fits >= 200
    yield figure("mean squared error over the variance", (errors**2).mean(), at_most=1.1 if enough else None)
    for name, scatter, bias in zip(NAMES, errors.std(0), errors.mean(0), strict=True):
        yield figure(f"{name}: scatter", scatter, at_most=1.2 if enough else None)
        yield figure(f"{name}: bias", abs(bias), at_most=0.25 if enough else None)
