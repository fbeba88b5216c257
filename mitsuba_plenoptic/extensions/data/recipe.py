"""The recipe of a data set: which scenes, cameras, light and noise, and how often; from YAML or JSON."""

import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from ... import choices
from ...camera import MATCHED, PARAMETERS, PlenopticCamera
from ...detector import Detector
from ...errors import (
    InputError,
    naming,
    refuse_if,
    require_choice,
    require_count,
    require_known,
    require_number,
    short_repr,
)
from ...io import require_quantities
from ...presets import PRESETS
from ...runtime import DEFAULT_VARIANT, Facts, Named, Shape, read_yaml
from ...scene import MOST_SAMPLES, UNITS
from ...scene_files import scene_path
from ..onchip.halves import require_layout
from ..onchip.photodiode_response import require_pixel_pairs
from .generators import CaptureGenerator, Illumination, SceneGenerator, generator_called

_KEYS = (
    "name", "count", "seed", "models", "variant", "camera", "scenes", "light", "noise", "ray", "wave", "truth",
    "photodiodes", "samples_per_shard",
)  # fmt: skip


@dataclass(frozen=True)
class Source:
    """One source of scenes in a recipe, with its frequency."""

    generator: str | None
    # Instead of it, the path of a scene file or the name of a built-in scene.
    scene: str | None
    # How often it is chosen, in proportion to those of the others.
    share: float
    # The generator's settings or the scene's parameters, parsed by `parse`.
    values: Facts
    # Of the scene's lengths.
    unit: str = "mm"


@dataclass(frozen=True)
class SamplePlan:
    """The random parameters of one sample."""

    index: int
    # Which of the recipe's scenes.
    source: int
    camera: PlenopticCamera
    light: Illumination
    maker: SceneGenerator | CaptureGenerator | None
    parameters: Mapping[str, str]
    # As for `expose`; None without noise.
    detector: Detector | None
    photons: float | None
    # Of each model, as for `render_capture`.
    options: Mapping[str, Facts]
    # All drawn values by section, in plain JSON values.
    draws: Facts


@dataclass(frozen=True)
class Recipe:
    """The recipe of a data set, which can be made again, bit for bit.

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
        Sections, parsed by `parse`. No noise: None.
    scenes : tuple of Source
        Sources of the scenes.
    truth : tuple of str
        Quantities of ground truth.
    photodiodes : (int, int), optional
        Photodiodes of a lens along x and along y, for pictures of each; None for other cameras.
    samples_per_shard : int
        Samples in one file.
    content : dict
        The recipe as given.
    """

    name: str
    count: int
    seed: int
    models: tuple[str, ...]
    variant: str
    camera: Facts
    scenes: tuple[Source, ...]
    light: Facts
    noise: Facts | None
    ray: Facts
    wave: Facts
    truth: tuple[str, ...]
    photodiodes: Shape | None
    samples_per_shard: int
    content: Facts

    def plan(self, index: int) -> SamplePlan:
        """Return the plan of a sample: everything that varies, drawn at random.

        Parameters
        ----------
        index : int
            Number of the sample.
        """
        shares = np.cumsum([source.share for source in self.scenes])
        chosen = int(
            np.searchsorted(shares, generator(self.seed, index, "scenes").uniform(0, shares[-1]), side="right")
        )
        source_index = min(chosen, len(self.scenes) - 1)
        source = self.scenes[source_index]
        draws = {
            section: draw(getattr(self, section) or {}, self.seed, index, section)
            for section in ("camera", "light", "noise", *self.models)
        }
        draws["scene"] = draw(source.values, self.seed, index, f"scenes.{source_index}")
        numbers = dict(draws["camera"])
        with naming("camera"):
            camera = PlenopticCamera.from_json(json.dumps(PRESETS[numbers.pop("preset", "paper")] | numbers))
            if self.photodiodes:
                require_pixel_pairs(camera)
            if self.truth:
                camera.require_array("truth")
        maker = None
        parameters = {}
        if source.generator:
            with naming(f"scenes: generator {source.generator}"):
                maker = generator_called("generator", source.generator)(**draws["scene"])
            of_scenes = {"truth": self.truth, "photodiodes": self.photodiodes, "light": self.light}
            for name in (name for name, value in of_scenes.items() if value and isinstance(maker, CaptureGenerator)):
                empty = "; give an empty list" if name == "truth" else "; leave it out"
                raise InputError(f"{name}: scenes: generator {source.generator} makes no scenes{empty}")
        else:
            parameters = {name: str(value) for name, value in draws["scene"].items()}
        detector = photons = None
        if self.noise is not None:
            with naming("noise"):
                settings = dict(draws["noise"])
                photons = require_number("photons", settings.pop("photons"), minimum=1e-9, maximum=1e9)
                detector = Detector(**settings)
        options = {model: draws[model] for model in self.models}
        light = Illumination(**draws["light"])
        return SamplePlan(index, source_index, camera, light, maker, parameters, detector, photons, options, draws)

    def check(self) -> None:
        """Draw the first thousand samples, and refuse values out of range before anything is rendered."""
        for index in range(min(self.count, 1000)):
            with naming(f"sample {index}"):
                plan = self.plan(index)
            for model, options in plan.options.items():
                require_count(f"sample {index}: {model}: spp", options["spp"], maximum=MOST_SAMPLES)


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe from a YAML or JSON file; scenes that it names lie in the same folder."""
    path = Path(path)
    content = read_yaml(path)
    refuse_if(
        not isinstance(content, dict),
        f"{path}: a recipe must be a mapping of names, with 'count', 'camera' and 'scenes'",
    )
    with naming(path):
        return parse_recipe({"name": path.stem, **content}, path.parent)


def parse_recipe(content: Facts, folder: Path = Path()) -> Recipe:
    """Return the recipe described by plain values; scene files named in it lie in the folder.

    Parameters
    ----------
    content : mapping
        Content of a recipe's file.
    folder : path
        Folder in which scene files are looked for.
    """
    require_known("recipe: ", content, _KEYS)
    for key in ("count", "camera", "scenes"):
        refuse_if(key not in content, f"recipe: {key} is missing")
    models = content.get("models", list(choices.MODELS))
    refuse_if(
        not isinstance(models, list) or not models or len(set(map(str, models))) < len(models),
        f"models = {short_repr(models)}: it must be a list of some of {', '.join(choices.MODELS)}",
    )
    for model in models:
        require_choice("models", model, choices.MODELS)
    for section in choices.MODELS:
        refuse_if(
            section in content and section not in models,
            f"{section}: models = {short_repr(models)} has no {section} captures; leave it out",
        )
    camera = _section("camera", content, (*PARAMETERS, *MATCHED, "preset"))
    if "preset" in camera:
        require_choice("camera: preset", camera["preset"], tuple(PRESETS))
    noise = _section("noise", content, ("photons", *(f.name for f in fields(Detector)))) if "noise" in content else None
    refuse_if(
        noise is not None and "photons" not in noise, "noise: photons is missing: photons that hit a pixel of value 1"
    )
    scenes = _list_of("scenes and generators", "scenes", content["scenes"])
    quantities = f"some of {', '.join(choices.QUANTITIES)}"
    truth = _list_of(quantities, "truth", content.get("truth", ["depth", "normal"]), least=0)
    photodiodes = None
    if "photodiodes" in content:
        with naming("photodiodes"):
            photodiodes = require_layout(content["photodiodes"])
    recipe = Recipe(
        name=str(content.get("name", "dataset")),
        count=require_count("count", content["count"], maximum=(10**6)),
        seed=require_count("seed", content.get("seed", 0), minimum=0, maximum=2**63),
        models=tuple(models),
        variant=str(content.get("variant", DEFAULT_VARIANT)),
        camera=camera,
        scenes=tuple(_source(index, entry, folder) for index, entry in enumerate(scenes)),
        light=_section("light", content, tuple(f.name for f in fields(Illumination))),
        noise=noise,
        ray={"spp": 16, **_section("ray", content, ("spp",))},
        wave={
            "spp": 16,
            "method": "signed_rays",
            **_section("wave", content, ("spp", "wavelength", "method", "accuracy")),
        },
        truth=require_quantities(truth) if truth else (),
        photodiodes=photodiodes,
        samples_per_shard=require_count("samples_per_shard", content.get("samples_per_shard", 50), maximum=10000),
        content=dict(content),
    )
    recipe.check()
    return recipe


def _source(index: int, entry: Any, folder: Path) -> Source:
    """Return one scene source of a recipe from its plain values."""
    name = f"scenes: entry {index + 1}"
    refuse_if(
        not isinstance(entry, Mapping) or ("generator" in entry) == ("scene" in entry),
        f"{name} = {short_repr(entry)}: it must have either 'generator' or 'scene'",
    )
    share = require_number(f"{name}: share", entry.get("share", 1), positive=True, maximum=1e9)
    if "generator" in entry:
        kind = entry["generator"]
        settings = tuple(field.name for field in fields(generator_called(f"{name}: generator", kind)))
        require_known(f"{name}: ", entry, ("generator", "share", *settings))
        values = {key: value for key, value in entry.items() if key in settings}
        return Source(kind, None, share, {key: parse(f"{name}: {key}", value) for key, value in values.items()})
    require_known(f"{name}: ", entry, ("scene", "share", "parameters", "unit"))
    parameters = _values_by_name(f"{name}: parameters", entry.get("parameters", {}))
    scene = str(entry["scene"])
    with naming(name):
        path = folder / scene if (folder / scene).is_file() else scene_path(scene)
    parsed = {str(key): parse(f"{name}: {key}", value) for key, value in parameters.items()}
    unit = require_choice(f"{name}: unit", entry.get("unit", "mm"), UNITS)
    return Source(None, str(path.resolve()), share, parsed, unit)


def _section(name: str, content: Facts, names: tuple[str, ...]) -> Named:
    """Return the parsed values of a section of a recipe; refuse unknown names."""
    section = _values_by_name(name, content.get(name, {}))
    require_known(f"{name}: ", section, names)
    return {key: parse(f"{name}: {key}", value) for key, value in section.items()}


def _values_by_name(name: str, values: Any) -> Facts:
    """Return a mapping; refuse anything else."""
    refuse_if(not isinstance(values, Mapping), f"{name} = {short_repr(values)}: it must be values by name")
    return values


def _list_of(what: str, name: str, values: Any, least: int = 1) -> list:
    """Return a list of at least so many entries; refuse anything else."""
    refuse_if(
        not isinstance(values, list) or len(values) < least,
        f"{name} = {short_repr(values)}: it must be a list of {what}",
    )
    return values


def generator(seed: int, index: int, name: str) -> np.random.Generator:
    """Return the random generator of one named quantity in one sample."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index, zlib.crc32(name.encode()))))


@dataclass(frozen=True)
class Between:
    """A uniform or log-uniform distribution between two bounds, optionally of steps counted from the lower one."""

    low: float
    high: float
    # Whether the logarithm is even.
    log: bool = False
    # Distance of the values there are, counted from `low`.
    step: float | None = None

    def draw(self, random: np.random.Generator) -> float:
        """Return a random value between the bounds."""
        if self.step is not None:
            value = self.low + self.step * random.integers(math.floor((self.high - self.low) / self.step + 1e-9) + 1)
            return int(value) if float(value).is_integer() else float(value)
        if self.log:
            return float(math.exp(random.uniform(math.log(self.low), math.log(self.high))))
        return float(random.uniform(self.low, self.high))


@dataclass(frozen=True)
class OneOf:
    """One of several values, with equal probabilities."""

    values: tuple

    def draw(self, random: np.random.Generator) -> Any:
        """Return one of the values at random."""
        return self.values[int(random.integers(len(self.values)))]


def parse(name: str, value: Any) -> Any:
    """Return the `Between`, `OneOf` or plain value that an entry of a recipe describes."""
    if not isinstance(value, Mapping):
        return value
    if set(value) == {"one_of"}:
        return OneOf(tuple(_list_of("values", f"{name}: one_of", value["one_of"])))
    require_known(f"{name}: ", value, ("from", "to", "scale", "step", "one_of"))
    refuse_if(
        "one_of" in value or not {"from", "to"} <= set(value),
        f"{name} = {short_repr(dict(value))}: a range is {{from: A, to: B}}, a choice {{one_of: [A, B, ...]}}",
    )
    low, high = (require_number(f"{name}: {key}", value[key]) for key in ("from", "to"))
    refuse_if(not low < high, f"{name}: from = {low:g}, to = {high:g}: 'from' must be less than 'to'")
    log = require_choice(f"{name}: scale", value.get("scale", "linear"), ("linear", "log")) == "log"
    refuse_if(log and low <= 0, f"{name}: from = {low:g}: it must be greater than 0 on a scale of logarithms")
    step = require_number(f"{name}: step", value["step"], positive=True) if "step" in value else None
    if log and step is not None:
        raise InputError(f"{name}: step = {step:g}: it is of no use on a scale of logarithms")
    # Double precision counts to 2^53.
    refuse_if(
        not high - low < (math.inf if step is None else 2.0**53 * step),
        f"{name}: from = {low:g}, to = {high:g}: a range must be finite and have at most 9e+15 steps",
    )
    return Between(low, high, log, step)


def draw(values: Facts, seed: int, index: int, prefix: str) -> Named:
    """Return values drawn at random for one sample, by their names in a section."""
    return {
        name: value.draw(generator(seed, index, f"{prefix}.{name}")) if isinstance(value, (Between, OneOf)) else value
        for name, value in values.items()
    }
