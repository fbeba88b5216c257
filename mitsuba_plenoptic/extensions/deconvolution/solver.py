r"""Richardson and Lucy's iteration, plain or accelerated, stopped by the noise or after a given number of steps.

.. math:: x \leftarrow \frac{x}{A^T 1} \, A^T \frac{y + \beta}{A x + \beta}

(Richardson 1972, J. Opt. Soc. Am. 62, 55; Lucy 1974, Astron. J. 79, 745). The iteration keeps x positive and raises the
likelihood of Poisson counts. :math:`\beta` is the variance of a dark pixel over the value of one electron: with it a
Poisson law describes photon and read noise together (Snyder, Hammoud and White 1993, J. Opt. Soc. Am. A 10, 1014).

Accelerated, each step starts from a point extrapolated along the last one by Nesterov's momentum (1983, Soviet Math.
Dokl. 27, 372; for this iteration Wang and Miller 2014, IEEE Trans. Image Process. 23, 848),

.. math:: z_k = x_k + \frac{m}{m + 3} (x_k - x_{k-1}),

but at least half of :math:`x_k`, where m counts the steps since one pointed against the way made, where it restarts
(O'Donoghue and Candès 2015, Found. Comput. Math. 15, 715). Extrapolation by what the last two steps have in common
(Biggs and Andrews 1997, Appl. Opt. 36, 1766) overshoots here: well resolved lines swing to a contrast of 1.2 and back
for a hundred steps.

The iteration stops where the residual, weighted by the variances of the pixels, is as large as noise: the discrepancy
principle (Morozov 1966; for Poisson counts Bertero et al. 2010, Inverse Problems 26, 105004). Further steps would fit
the noise. It also stops where the excess of the residual over noise hardly falls any more.

A penalty P of weight :math:`\lambda` on x, such as its total variation (see `variation`), divides each step (Green
1990, IEEE Trans. Med. Imaging 9, 84; Dey et al. 2006, Microscopy Research and Technique 69, 260):

.. math:: x \leftarrow \frac{x}{A^T 1 \, (1 + \lambda \nabla P(x))} \, A^T \frac{y + \beta}{A x + \beta}
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...errors import refuse_if, refusing

Values = list[NDArray[np.float32]]
"""Radiance of the bins of each plane."""

_LEAST_LIT = 0.005
"""Light of a white scene in a pixel, over that of the brightest one, below which the pixel is left out."""

_FLOOR = 1e-4
"""Least addition to every pixel and its model, over the mean of those that are lit, so that all are above 0."""

_LEAST_SEEN = 1e-4
"""Light of a bin on the detector, over that of the best one, below which it is taken for dark."""

_HALVED = np.float32(0.5)
"""Least fraction of a bin that an extrapolation leaves: steps multiply, so that a bin at 0 would stay there."""

_SPAN, _LEAST_FALL = 10, 0.95
"""Steps in which what is above the noise must fall below this fraction of itself."""

Misfit = Callable[[NDArray[np.float32], NDArray[np.float32]], float]
"""From pixels and what they should be to the squared residual over that of noise alone."""


class Linear(Protocol):
    """A linear map from the radiance of bins to pixels, with its transpose."""

    def forward(self, values: Values) -> NDArray[np.float32]:
        """Return the pixels lit by bins of given radiance."""

    def adjoint(self, image: NDArray[np.float32]) -> Values:
        """Return, for each bin, the pixels weighted by the bin's light."""


@dataclass(frozen=True, eq=False)
class PlaneEstimates:
    """Planes found by an iteration, with facts about it."""

    values: Values
    seen: Values
    iterations: int
    residual: float
    stopped: bool


class Penalty(Protocol):
    """A penalty on the radiance of bins, in addition to the fit of the image."""

    def gradient(self, values: Values, inside: list[NDArray[np.bool_]]) -> Values:
        """Return the derivatives of the penalty by the bins, 0 for bins that are not inside."""


@dataclass
class State:
    """State of an iteration: all data on which the next steps depend."""

    found: Values
    last: Values
    momentum: int = 0
    done: int = 0
    misfits: list[float] = field(default_factory=lambda: [np.inf])


def richardson_lucy(
    response: Linear,
    image: NDArray[np.float32],
    *,
    iterations: int,
    accelerate: bool = True,
    misfit: Misfit | None = None,
    shift: float = 0.0,
    penalty: tuple[Penalty, float] | None = None,
    state: State | None = None,
    keep: Callable[[State], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> PlaneEstimates:
    """Return the radiance of bins that explains an image, by Richardson and Lucy's iteration."""
    step = RichardsonLucyStep(response, image, shift)
    if not step.total:
        dark = [np.zeros_like(part) for part in step.seen]
        return PlaneEstimates(dark, step.seen, 0, float(image.any()), False)
    if state is None:
        start = step.start()
        state = State(start, start)
    scale = float(np.linalg.norm(image))
    while True:
        point = state.found
        if accelerate and state.momentum:
            along = np.float32(state.momentum / (state.momentum + 3))
            point = [np.maximum(x + along * (x - y), _HALVED * x) for x, y in zip(state.found, state.last, strict=True)]
        model = response.forward(point)
        if misfit is not None:
            state.misfits = [*state.misfits[-_SPAN:], misfit(image, model)]
        above = [value - 1 for value in state.misfits[-1 - _SPAN :]]
        stopped = above[-1] <= 0 or (len(above) > _SPAN and above[-1] > _LEAST_FALL * above[0])
        if stopped or state.done == iterations:
            break
        new = step.scaled(point, response.adjoint(step.ratio(model)))
        if penalty is not None:
            slopes = penalty[0].gradient(point, step.inside)
            new = [part / (1 + np.float32(penalty[1]) * slope) for part, slope in zip(new, slopes, strict=True)]
        if accelerate:
            along_way = sum(
                float(np.vdot(part - start, part - last))
                for part, start, last in zip(new, point, state.found, strict=True)
            )
            state.momentum = 0 if along_way < 0 else state.momentum + 1
        state.last, state.found = state.found, new
        state.done += 1
        if keep:
            keep(state)
        if progress:
            progress(state.done / iterations)
    return PlaneEstimates(point, step.seen, state.done, float(np.linalg.norm(image - model)) / scale, stopped)


class RichardsonLucyStep:
    """The constant quantities of an iteration, and the parts of a step."""

    def __init__(self, response: Linear, image: NDArray[np.float32], shift: float = 0.0) -> None:
        self.total = float(np.maximum(image, 0).sum(dtype=np.float64))
        floor = _FLOOR / max(1, int((image > 0).sum()))
        # Added to every pixel and its model; and how much it grows with the light of the image.
        self.shift = np.float32(max(shift, floor * self.total))
        self.shift_slope = floor if shift < floor * self.total else 0.0
        self.given = np.maximum(image + self.shift, 0)
        light = response.adjoint(np.ones_like(image))
        best = max(float(part.max()) for part in light)
        # Light of the bins over that of the best one, and the mask of those that are not dark.
        self.seen: Values = [np.asarray(np.maximum(part, 0) / best, np.float32) for part in light]
        self.inside = [part > _LEAST_SEEN for part in self.seen]
        self.weight = [
            np.where(mask, 1 / np.maximum(part * best, 1e-30), 0).astype(np.float32)
            for part, mask in zip(self.seen, self.inside, strict=True)
        ]
        # Pixels that hardly any light of bins reaches explain nothing: interpolation may leave less than none there.
        white = response.forward([np.asarray(mask, np.float32) for mask in self.inside])
        self.lit = white > _LEAST_LIT * white.max()
        # The light that all bins send to the detector at radiance 1.
        self.sent = sum(
            float((part * mask).sum(dtype=np.float64)) for part, mask in zip(light, self.inside, strict=True)
        )

    def start(self) -> Values:
        """Return bins of uniform radiance that send as much light as the image has."""
        level = np.float32(self.total / self.sent)
        return [np.where(mask, level, np.float32(0)) for mask in self.inside]

    def ratio(self, model: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the recorded image divided by the model's image, both shifted by the dark variance."""
        return np.where(self.lit, self.given / (np.maximum(model, 0) + self.shift), np.float32(1))

    def scaled(self, point: Values, back: Values) -> Values:
        """Return bins multiplied by the adjoint of a ratio, divided by the bins' light."""
        parts = zip(point, back, self.weight, strict=True)
        return [z * np.maximum(part, 0) * gain for z, part, gain in parts]


@dataclass(frozen=True, eq=False)
class Solved:
    """Result of deconvolution for one channel of one plane."""

    image: NDArray[np.float32]
    iterations: int
    residual: float
    stopped: bool


@dataclass
class Work:
    """The state of a deconvolution: the channels and planes already solved, and the current iteration.

    A checkpoint stores this state as arrays.
    """

    solved: list[Solved] = field(default_factory=list)
    state: State | None = None

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> Work:
        """Return the work stored in arrays by name; empty work for no arrays."""
        with refusing("checkpoint: it is damaged:", KeyError, ValueError):
            solved = [
                Solved(arrays[f"image.{index}"], int(done), float(left), bool(stopped))
                for index, (done, left, stopped) in enumerate(arrays.get("solved", np.zeros((0, 3))))
            ]
            if "misfits" not in arrays:
                return cls(solved)
            planes = range(sum(name.startswith("found.") for name in arrays))
            found, last = ([arrays[f"{name}.{plane}"] for plane in planes] for name in ("found", "last"))
            done, momentum = arrays["counts"].astype(int).tolist()
            return cls(solved, State(found, last, momentum, done, arrays["misfits"].tolist()))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the state as arrays by name."""
        counts = [[one.iterations, one.residual, one.stopped] for one in self.solved]
        images = {f"image.{index}": one.image for index, one in enumerate(self.solved)}
        arrays: dict[str, NDArray[Any]] = {"solved": np.array(counts, np.float64).reshape(-1, 3), **images}
        if self.state is None:
            return arrays
        planes = {"found": self.state.found, "last": self.state.last}
        arrays |= {f"{name}.{plane}": part for name, parts in planes.items() for plane, part in enumerate(parts)}
        counted = np.array([self.state.done, self.state.momentum], np.float64)
        return arrays | {"misfits": np.array(self.state.misfits), "counts": counted}

    def take_state(self, shapes: Sequence[tuple[int, int]]) -> State | None:
        """Return the state of the unfinished iteration, only once; refuse a state with bins of other shapes."""
        state, self.state = self.state, None
        for values in [] if state is None else [state.found, state.last]:
            refuse_if(
                [part.shape for part in values] != list(shapes),
                "checkpoint: it is damaged: its bins are not those of this reconstruction",
            )
        return state
