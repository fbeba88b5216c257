"""The points of a sweep: each one's capture and reconstructions, computed or taken from what is kept."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ...bounds import require_wavelength
from ...camera import PlenopticCamera
from ...capture.render import is_wave_capture, render_capture
from ...errors import InputError, argument, refuse_if, require_choice, require_number
from ...io.captures import Capture
from ...io.checkpoints import Checkpoint
from ...io.yaml_file import read_yaml
from ...reconstruction import METHODS
from ...runtime.batches import BatchMap
from ...runtime.variant import DEFAULT_VARIANT
from ...thin_lens import image_distance
from ..experiment import load_with_sensor, refocused
from ..stage_store import Progress, StageStore, scene_fingerprint

# Names that are not parameters of the scene.
WAVELENGTH, DISTANCE = "wavelength", "distance"

Grid = Mapping[str, Sequence[float]]

_MOST_POINTS = 100_000


def read_grid(path: Path) -> dict[str, list[Any]]:
    """Read a grid from YAML: names, each with a list of numbers, or with one."""
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: it must hold names, each with a list of numbers, such as 'wavelength: [532, 633]'")
    return {name: value if isinstance(value, list) else [value] for name, value in content.items()}


def parse_grid(texts: Iterable[str]) -> dict[str, list[Any]]:
    """Turn texts ``name=1,2,3`` into a grid."""
    grids = []
    for text in texts:
        name, equals, values = text.partition("=")
        refuse_if(not name or not equals, f"--vary {text}: write it as --vary NAME=VALUE,VALUE,...")
        grids.append({name: [part.strip() for part in values.split(",")] if values.strip() else []})
    return merge_grids(*grids)


def merge_grids(*grids: Mapping[str, list[Any]]) -> dict[str, list[Any]]:
    """Join grids that have no name in common."""
    merged: dict[str, list[Any]] = {}
    for grid in grids:
        for name in grid:
            refuse_if(name in merged, f"grid: {name} is given twice")
        merged |= grid
    return merged


def check_grid(grid: Mapping[Any, Any]) -> dict[str, tuple[float, ...]]:
    """Return a grid, neither empty nor too large, with its values as finite numbers of which none comes twice."""
    checked: dict[str, tuple[float, ...]] = {}
    for name, values in grid.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise InputError(f"grid: {name!r} is not a name")
        refuse_if(not len(values), f"grid: {name} has no values")
        checked[name] = tuple(_number(name, value) for value in values)
        for value, count in Counter(checked[name]).items():
            refuse_if(count > 1, f"grid: {name} = {value:g} is given twice")
    refuse_if(not checked, "grid: it is empty; give at least one name with values")
    count = math.prod(len(values) for values in checked.values())
    refuse_if(count > _MOST_POINTS, f"grid: it has {count} points; at most {_MOST_POINTS} are allowed")
    return checked


def _number(name: str, value: Any) -> float:
    if isinstance(value, (list, tuple, dict)):
        raise InputError(f"grid: {name} holds a {type(value).__name__}: it must be a number")
    if isinstance(value, str):
        with contextlib.suppress(ValueError):
            value = float(value)
    return require_number(f"grid: {name}", value)


@dataclass(frozen=True)
class SweepSettings:
    """What all points of a sweep have in common.

    Attributes
    ----------
    scene : str
        A scene file or a built-in name.
    parameters : mapping
        Values for the scene's ``$name`` parameters that do not vary.
    model, spp, seed
        As for `render_capture`; by model "wave" captures are made from signed rays.
    method : str
        Of the reconstructions.
    variant : str
        Mitsuba variant.
    """

    scene: str
    parameters: Mapping[str, str] = field(default_factory=dict)
    model: str | None = None
    spp: int | None = None
    seed: int = 0
    method: str = "ray"
    variant: str = DEFAULT_VARIANT


class Points:
    """The points of a grid: captures, and of each the reconstructions."""

    def __init__(self, settings: SweepSettings, grid: Grid, store: StageStore) -> None:
        self.settings, self.store = settings, store
        self.distances = grid.get(DISTANCE, ())
        self.axes = {name: values for name, values in grid.items() if name != DISTANCE}

    def __iter__(self) -> Iterator[dict[str, float]]:
        for values in itertools.product(*self.axes.values()):
            yield dict(zip(self.axes, values, strict=True))

    def parameters(self, point: dict[str, float]) -> dict[str, str]:
        """Values for the scene's parameters."""
        varied = {name: _text(value) for name, value in point.items() if name != WAVELENGTH}
        for name in varied:
            if name in self.settings.parameters:
                raise InputError(f"grid: {name} varies and is set by {argument('parameters')} too")
        return {**self.settings.parameters, **varied}

    def check(self) -> None:
        """Make every camera once, before the work, and see that they record images of one size."""
        require_choice("method", self.settings.method, METHODS)
        for wavelength in self.axes.get(WAVELENGTH, ()):
            require_wavelength(wavelength)
        sizes: dict[tuple[tuple[str, str], ...], tuple[int, ...]] = {}
        for point in self:
            parameters = self.parameters(point)
            if (key := tuple(parameters.items())) in sizes:
                continue
            scene = load_with_sensor(self.settings.scene, parameters)
            if self.store.resume and not is_wave_capture(scene, self.settings.model):
                raise InputError(f"{argument('resume')}: a ray capture keeps no checkpoint; leave it out")
            camera = PlenopticCamera.from_sensor(scene.sensors()[0])
            sizes[key] = camera.shape + camera.bin_count * bool(self.distances)
            for distance in self.distances:
                image_distance(camera.focal_length, distance, name=DISTANCE)
            first = next(iter(sizes.values()))
            if sizes[key] != first:
                changed = ", ".join(f"{name} = {value:g}" for name, value in point.items())
                raise InputError(
                    f"grid: with {changed} images have {_size(sizes[key])}, with the first values {_size(first)}: one "
                    "dataset holds images of one size"
                )

    def compute(self, batch_map: BatchMap | None) -> Iterator[tuple[Capture, list[np.ndarray]]]:
        """Yield each capture with its reconstructions, from the store where they are there."""
        method = {"method": self.settings.method}
        for point in self:
            capture, key = self._capture(point, batch_map)
            names = {distance: f"refocused{_name({**point, DISTANCE: distance})}" for distance in self.distances}
            yield capture, [refocused(self.store, name, capture, key, at, method) for at, name in names.items()]

    def _capture(self, point: dict[str, float], batch_map: BatchMap | None) -> tuple[Capture, str]:
        settings, parameters = self.settings, self.parameters(point)
        options: dict[str, Any] = {"model": settings.model, "spp": settings.spp, "seed": settings.seed}
        if WAVELENGTH in point:
            options["wavelength"] = point[WAVELENGTH]
        if settings.model == "wave":
            options["method"] = "signed_rays"
        inputs = {"scene": scene_fingerprint(settings.scene, parameters), "variant": settings.variant, **options}

        def make(progress: Progress, checkpoint: Checkpoint) -> Capture:
            scene = load_with_sensor(settings.scene, parameters)
            keeper = checkpoint if is_wave_capture(scene, settings.model) else None
            return render_capture(scene, progress=progress, checkpoint=keeper, batch_map=batch_map, **options)

        return self.store.capture(
            f"capture{_name(point)}",
            inputs,
            make,
        )


def _size(size: tuple[int, ...]) -> str:
    rows, columns, *bins = size
    return f"{columns} x {rows} pixels" + (f" and {bins[0]} x {bins[1]} bins" if bins else "")


def _name(point: dict[str, float]) -> str:
    return "".join(f",{name}={_text(value)}" for name, value in point.items())


def _text(value: float) -> str:
    return str(int(value)) if value == int(value) else repr(value)
