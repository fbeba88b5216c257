"""The points of a sweep: each one's capture and reconstructions, computed or taken from what is kept."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...bounds import require_wavelength
from ...camera import PlenopticCamera
from ...capture.render import is_wave_capture, render_capture
from ...errors import InputError, argument, require_choice
from ...io.captures import Capture
from ...io.checkpoints import Checkpoint
from ...reconstruction import METHODS
from ...runtime.batches import BatchMap
from ...runtime.variant import DEFAULT_VARIANT
from ...thin_lens import image_distance
from ..experiment import load_with_sensor, refocused
from ..stage_store import Progress, StageStore, scene_fingerprint
from .grid import DISTANCE, WAVELENGTH, Grid


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
