"""Values of a recipe that differ from sample to sample, drawn by the seed and the sample's number alone.

Each name has random numbers of its own, so that another name more or less in a recipe changes no other value.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError, require_choice, require_known, require_number, shown

_SCALES = ("linear", "log")


def generator(seed: int, index: int, name: str) -> np.random.Generator:
    """Return the random numbers of one name in one sample."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, zlib.crc32(name.encode()))))


@dataclass(frozen=True)
class Between:
    """A number between two, evenly or evenly in its logarithm; with a step one of those that it reaches."""

    low: float
    high: float
    # Whether the logarithm is even.
    log: bool = False
    # Distance of the values there are, counted from `low`.
    step: float | None = None

    def draw(self, random: np.random.Generator) -> float:
        """Draw a value."""
        if self.step is not None:
            value = self.low + self.step * random.integers(math.floor((self.high - self.low) / self.step + 1e-9) + 1)
            return int(value) if float(value).is_integer() else float(value)
        if self.log:
            return float(math.exp(random.uniform(math.log(self.low), math.log(self.high))))
        return float(random.uniform(self.low, self.high))


@dataclass(frozen=True)
class OneOf:
    """One of several values, all as probable."""

    values: tuple[Any, ...]

    def draw(self, random: np.random.Generator) -> Any:
        """Draw a value."""
        return self.values[int(random.integers(len(self.values)))]


def parse(name: str, value: Any) -> Any:
    """Turn what a recipe says about a value into a `Between`, a `OneOf`, or the value itself."""
    if not isinstance(value, Mapping):
        return value
    if set(value) == {"one_of"}:
        choices = value["one_of"]
        if not isinstance(choices, list) or not choices:
            raise InputError(f"{name}: one_of = {shown(choices)}: it must be a list of values")
        return OneOf(tuple(choices))
    require_known(f"{name}: ", value, ("from", "to", "scale", "step", "one_of"))
    if "one_of" in value or not {"from", "to"} <= set(value):
        raise InputError(
            f"{name} = {shown(dict(value))}: a range is {{from: A, to: B}}, a choice {{one_of: [A, B, ...]}}"
        )
    low, high = (require_number(f"{name}: {key}", value[key]) for key in ("from", "to"))
    if not low < high:
        raise InputError(f"{name}: from = {low:g}, to = {high:g}: 'from' must be less than 'to'")
    log = require_choice(f"{name}: scale", value.get("scale", "linear"), _SCALES) == "log"
    if log and low <= 0:
        raise InputError(f"{name}: from = {low:g}: it must be greater than 0 on a scale of logarithms")
    step = require_number(f"{name}: step", value["step"], positive=True) if "step" in value else None
    if log and step is not None:
        raise InputError(f"{name}: step = {step:g}: it is of no use on a scale of logarithms")
    return Between(low, high, log, step)


def draw(values: Mapping[str, Any], seed: int, index: int, prefix: str) -> dict[str, Any]:
    """Draw all values of a section for one sample."""
    return {
        name: value.draw(generator(seed, index, f"{prefix}.{name}")) if isinstance(value, (Between, OneOf)) else value
        for name, value in values.items()
    }
