"""What is done of several deconvolutions, in a checkpoint: the finished images, and the iteration under way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...io.checkpoints import Checkpoint
from .solver import State


@dataclass(frozen=True, eq=False)
class Solved:
    """One channel of one plane.

    Attributes
    ----------
    image : float32 array (rows, columns)
        Radiance; NaN where no light can come from.
    iterations, residual, stopped
        As of `solver.Solution`.
    """

    image: NDArray[np.float32]
    iterations: int
    residual: float
    stopped: bool


class Kept:
    """What an earlier process has done, and what this one adds to it.

    Parameters
    ----------
    checkpoint : Checkpoint, optional
        The file; without one nothing is kept.
    facts : dict
        What the results are computed from.

    Attributes
    ----------
    solved : list of Solved
        What is finished, in order.
    """

    def __init__(self, checkpoint: Checkpoint | None, facts: dict[str, Any]) -> None:
        self._checkpoint = checkpoint
        arrays = (checkpoint.begin_arrays(**facts) if checkpoint else None) or {}
        try:
            self.solved = [
                Solved(arrays[f"image.{number}"], int(done), float(left), bool(stopped))
                for number, (done, left, stopped) in enumerate(arrays.get("solved", np.zeros((0, 3))))
            ]
            self._state = _state(arrays) if "misfits" in arrays else None
        except (KeyError, ValueError) as error:
            raise InputError(f"checkpoint: it is damaged: {error}") from None

    def state(self, shapes: Sequence[tuple[int, int]]) -> State | None:
        """Return where the iteration under way was stopped, once; refuse one of bins of other shapes."""
        state, self._state = self._state, None
        for values in [] if state is None else [state.found, state.last]:
            if [part.shape for part in values] != list(shapes):
                raise InputError("checkpoint: it is damaged: its bins are not those of this reconstruction")
        return state

    def keep(self, state: State) -> None:
        """Keep what is done, if it is time to."""
        if self._checkpoint:
            self._checkpoint.save_arrays(lambda: self._solved_arrays() | _arrays(state))

    def _solved_arrays(self) -> dict[str, NDArray[Any]]:
        told = [[one.iterations, one.residual, one.stopped] for one in self.solved]
        images = {f"image.{number}": one.image for number, one in enumerate(self.solved)}
        return {"solved": np.array(told, np.float64).reshape(-1, 3), **images}


def _arrays(state: State) -> dict[str, NDArray[Any]]:
    """Name the arrays of a state."""
    counts = np.array([state.done, state.momentum], np.float64)
    found: dict[str, NDArray[Any]] = {"misfits": np.array(state.misfits), "counts": counts}
    named = {"found": state.found, "last": state.last}
    return found | {f"{name}.{plane}": part for name, parts in named.items() for plane, part in enumerate(parts)}


def _state(arrays: dict[str, NDArray[Any]]) -> State:
    """Take a state from its arrays."""
    planes = sum(name.startswith("found.") for name in arrays)
    found, last = ([arrays[f"{name}.{plane}"] for plane in range(planes)] for name in ("found", "last"))
    done, momentum = arrays["counts"].astype(int).tolist()
    return State(found, last, momentum, done, arrays["misfits"].tolist())
