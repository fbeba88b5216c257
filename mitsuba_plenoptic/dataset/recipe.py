"""The recipe of a data set: which scenes, cameras, light and noise, and how often; from YAML or JSON."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..capture.render import MOST_SAMPLES
from ..capture.scene import scene_path
from ..detector import Detector
from ..errors import InputError, require_choice, require_count, require_known, require_number, shown
from ..io.captures import MODELS
from ..io.ground_truth import QUANTITIES, require_quantities
from ..io.yaml_file import read_yaml
from ..presets import PRESETS
from ..runtime.variant import DEFAULT_VARIANT
from .draws import draw, generator, parse
from .generators import GENERATORS, Light, SceneGenerator

MOST_COUNT = 10**6

_CHECKED = 1000
"""Samples whose numbers are drawn and checked before the first is rendered."""

_KEYS = (
    "name", "count", "seed", "models", "variant", "camera", "scenes", "light", "noise", "ray", "wave", "truth",
    "samples_per_shard",
)  # fmt: skip
_WAVE = ("spp", "wavelength", "method", "accuracy")


@dataclass(frozen=True)
class Source:
    """One kind of scenes."""

    generator: str | None
    # Instead of it, the path of a scene file or the name of a built-in scene.
    scene: str | None
    # How often it is chosen, in proportion to those of the others.
    share: float
    # The generator's settings or the scene's parameters, parsed by `draws.parse`.
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Plan:
    """What is drawn for one sample."""

    index: int
    # Which of the recipe's scenes.
    source: int
    camera: PlenopticCamera
    light: Light
    maker: SceneGenerator | None
    parameters: Mapping[str, str]
    # As for `expose`; None without noise.
    detector: Detector | None
    photons: float | None
    # Of each model, as for `render_capture`.
    options: Mapping[str, Mapping[str, Any]]
    # All drawn values by section, in plain JSON values.
    draws: Mapping[str, Any]


@dataclass(frozen=True)
class Recipe:
    """A data set that can be made again, bit for bit.

    Attributes
    ----------
    name : str
        Title.
    count : int
        Number of samples.
    seed : int
        All randomness of sample k follows from the seed and k.
    models : tuple of str
        ``ray``, ``wave`` or both, of the same scene.
    variant : str
        Mitsuba variant.
    camera, light, noise, ray, wave : dict
        Sections, parsed by `draws.parse`. No noise: None.
    scenes : tuple of Source
        Where scenes come from.
    truth : tuple of str
        Quantities of ground truth.
    samples_per_shard : int
        Samples in one file.
    content : dict
        The recipe as it was given.
    """

    name: str
    count: int
    seed: int
    models: tuple[str, ...]
    variant: str
    camera: Mapping[str, Any]
    scenes: tuple[Source, ...]
    light: Mapping[str, Any]
    noise: Mapping[str, Any] | None
    ray: Mapping[str, Any]
    wave: Mapping[str, Any]
    truth: tuple[str, ...]
    samples_per_shard: int
    content: Mapping[str, Any]

    def plan(self, index: int) -> Plan:
        """Draw what varies for a sample.

        Parameters
        ----------
        index : int
            Number of the sample.

        Raises
        ------
        InputError
            If a value is out of range for what it is of.
        """
        shares = np.cumsum([source.share for source in self.scenes])
        chosen = int(
            np.searchsorted(shares, generator(self.seed, index, "scenes").uniform(0, shares[-1]), side="right")
        )
        number = min(chosen, len(self.scenes) - 1)
        source = self.scenes[number]
        drawn = {
            section: draw(getattr(self, section) or {}, self.seed, index, section)
            for section in ("camera", "light", "noise", *self.models)
        }
        drawn["scene"] = draw(source.values, self.seed, index, f"scenes.{number}")
        numbers = dict(drawn["camera"])
        with _within("camera"):
            camera = PlenopticCamera.from_json(json.dumps(PRESETS[numbers.pop("preset", "paper")] | numbers))
        maker, parameters = None, {}
        if source.generator:
            with _within(f"scenes: generator {source.generator}"):
                maker = GENERATORS[source.generator](**drawn["scene"])
        else:
            parameters = {name: str(value) for name, value in drawn["scene"].items()}
        detector = photons = None
        if self.noise is not None:
            with _within("noise"):
                settings = dict(drawn["noise"])
                photons = require_number("photons", settings.pop("photons"), minimum=1e-9, maximum=1e9)
                detector = Detector(**settings)
        options = {model: drawn[model] for model in self.models}
        light = Light(**drawn["light"])
        return Plan(index, number, camera, light, maker, parameters, detector, photons, options, drawn)

    def check(self) -> None:
        """Draw the first thousand samples, and refuse values that are out of range before anything is rendered."""
        for index in range(min(self.count, _CHECKED)):
            try:
                plan = self.plan(index)
            except InputError as error:
                raise InputError(f"sample {index}: {error}") from None
            for model, options in plan.options.items():
                require_count(f"sample {index}: {model}: spp", options["spp"], maximum=MOST_SAMPLES)


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe from a YAML or JSON file; scenes that it names lie beside it.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        If it is no recipe: one line with the name that is wrong and the rule.
    """
    path = Path(path)
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: a recipe must be a mapping of names, with 'count', 'camera' and 'scenes'")
    try:
        return parse_recipe({"name": path.stem, **content}, path.parent)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def parse_recipe(content: Mapping[str, Any], folder: Path = Path()) -> Recipe:
    """Make a recipe of plain values; scene files that it names lie in the folder.

    Parameters
    ----------
    content : mapping
        What a recipe's file holds.
    folder : path
        Where scene files are looked for.

    Raises
    ------
    InputError
        If it is no recipe.
    """
    _require_names("recipe", content, _KEYS, needed=("count", "camera", "scenes"))
    models = content.get("models", list(MODELS))
    if not isinstance(models, list) or not models or len(set(map(str, models))) < len(models):
        raise InputError(f"models = {shown(models)}: it must be a list of some of {', '.join(MODELS)}")
    for model in models:
        require_choice("models", model, MODELS)
    for section in MODELS:
        if section in content and section not in models:
            raise InputError(f"{section}: models = {shown(models)} has no {section} captures; leave it out")
    camera = _section("camera", content, (*PlenopticCamera().to_dict(), "focus_distance", "preset"))
    if "preset" in camera:
        require_choice("camera: preset", camera["preset"], tuple(PRESETS))
    noise = _section("noise", content, ("photons", *(f.name for f in fields(Detector)))) if "noise" in content else None
    if noise is not None and "photons" not in noise:
        raise InputError("noise: photons is missing: photons that hit a pixel of value 1")
    scenes = content["scenes"]
    if not isinstance(scenes, list) or not scenes:
        raise InputError(f"scenes = {shown(scenes)}: it must be a list of scenes and generators")
    truth = content.get("truth", ["depth", "normal"])
    if not isinstance(truth, list):
        raise InputError(f"truth = {shown(truth)}: it must be a list of some of {', '.join(QUANTITIES)}")
    recipe = Recipe(
        name=str(content.get("name", "dataset")),
        count=require_count("count", content["count"], maximum=MOST_COUNT),
        seed=require_count("seed", content.get("seed", 0), minimum=0, maximum=2**63),
        models=tuple(models),
        variant=str(content.get("variant", DEFAULT_VARIANT)),
        camera=camera,
        scenes=tuple(_source(number, entry, folder) for number, entry in enumerate(scenes)),
        light=_section("light", content, tuple(f.name for f in fields(Light))),
        noise=noise,
        ray={"spp": 16, **_section("ray", content, ("spp",))},
        wave={"spp": 16, "method": "signed_rays", **_section("wave", content, _WAVE)},
        truth=require_quantities(truth) if truth else (),
        samples_per_shard=require_count("samples_per_shard", content.get("samples_per_shard", 50), maximum=10000),
        content=dict(content),
    )
    recipe.check()
    return recipe


def _source(number: int, entry: Any, folder: Path) -> Source:
    """Make one entry of the list of scenes."""
    name = f"scenes: entry {number + 1}"
    if not isinstance(entry, Mapping) or ("generator" in entry) == ("scene" in entry):
        raise InputError(f"{name} = {shown(entry)}: it must have either 'generator' or 'scene'")
    share = require_number(f"{name}: share", entry.get("share", 1), positive=True, maximum=1e9)
    if "generator" in entry:
        kind = require_choice(f"{name}: generator", entry["generator"], tuple(GENERATORS))
        known = tuple(field.name for field in fields(GENERATORS[kind]))  # type: ignore[arg-type]
        _require_names(name, entry, ("generator", "share", *known))
        values = {key: value for key, value in entry.items() if key in known}
        return Source(kind, None, share, {key: parse(f"{name}: {key}", value) for key, value in values.items()})
    _require_names(name, entry, ("scene", "share", "parameters"))
    values = entry.get("parameters", {})
    if not isinstance(values, Mapping):
        raise InputError(f"{name}: parameters = {shown(values)}: they must be values by name")
    scene = str(entry["scene"])
    with _within(name):
        path = folder / scene if (folder / scene).is_file() else scene_path(scene)
    parsed = {str(key): parse(f"{name}: {key}", value) for key, value in values.items()}
    return Source(None, str(path.resolve()), share, parsed)


def _section(name: str, content: Mapping[str, Any], known: tuple[str, ...]) -> dict[str, Any]:
    """Parse a section whose names are known."""
    section = content.get(name, {})
    if not isinstance(section, Mapping):
        raise InputError(f"{name} = {shown(section)}: it must be values by name")
    _require_names(name, section, known)
    return {key: parse(f"{name}: {key}", value) for key, value in section.items()}


def _require_names(name: str, values: Mapping[Any, Any], known: tuple[str, ...], needed: tuple[str, ...] = ()) -> None:
    require_known(f"{name}: ", values, known)
    for key in needed:
        if key not in values:
            raise InputError(f"{name}: {key} is missing")


@contextlib.contextmanager
def _within(what: str) -> Iterator[None]:
    """Say in a message what it is about."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{what}: {error}") from None
