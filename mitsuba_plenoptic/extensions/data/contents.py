"""The contents of the benchmark: cameras, noise and sizes, and how each sample is made.

A benchmark is a data set (`dataset.make_dataset`) with a sample for each scene and camera. Noiseless captures are
called ``ray`` and ``wave``, noisy ones ``ray_bright``, ``ray_dim`` and so on.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ...camera import PlenopticCamera
from ...errors import refuse_if, require_choice, require_count, short_repr
from ...io.captures import MODELS, Capture
from ...light.detector import Detector, expose
from ...report.experiment import photograph, photographic_sensor, thin_lens_image
from ...runtime.backend import DEFAULT_VARIANT
from .dataset import DataSet, Recipe, Sample, make_sample
from .generators import Illumination
from .recipe import SamplePlan, Source, generator
from .sample import VIEWS, open_sample
from .scenes import GLASS, SCENES, WHITE, Frame, SceneMaker

VERSION = 1
"""Version of the scenes and cameras, and of how they are scored."""

WAVELENGTH = 633.0

PITCH = 0.064
"""Pitch of the reference camera in millimetres, of whose lenses a size counts the number across the field."""

CAMERAS: dict[str, dict[str, Any]] = {
    "square": {"aperture_radius": 6.5},
    "hexagonal": {"aperture_radius": 6.5, "mla_lattice": "hexagonal"},
    "focused": {
        "aperture_radius": 5.5,
        "mla_distance": 127.0,
        "mla_pitch": 0.096,
        "mla_focal_length": 0.8,
        "detector_distance": 1.0,
    },
    "square_other": {"aperture_radius": 5.0, "focus_distance": 250.0, "mla_focal_length": 0.6},
    "hexagonal_other": {
        "aperture_radius": 6.0,
        "mla_lattice": "hexagonal",
        "mla_pitch": 0.056,
        "mla_focal_length": 0.448,
        "mla_rotation": 5.0,
    },
}
"""Parameters of the cameras. Their `lens_model` is ``ideal``: rays and waves differ by no aberrations."""

HELD_OUT = ("square_other", "hexagonal_other")
"""Cameras that are not to be used in training."""

NOISE = {"bright": 4000.0, "dim": 200.0}
"""Photons that hit a pixel of radiance 1, by names of noise levels."""

CAPTURES = tuple(f"{model}{suffix}" for model in MODELS for suffix in ("", *(f"_{name}" for name in NOISE)))

DISTANCES = (226.0, 240.0, 258.0)
"""Distances in millimetres to which captures are to be refocused."""

PUPIL_POINTS = ((0.0, 0.0), (0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
"""Points of the pupil, x and y over its radius, from which the views are that are to be found."""

FINER = 2
"""Pixels of these views per bin, along each axis."""


@dataclass(frozen=True)
class Size:
    """Numbers of lenses and pixels of a benchmark's captures.

    Attributes
    ----------
    lenses : int
        Lenses of the camera ``square`` across the field.
    pixels : int
        Number of pixels per lens, along each axis.
    spp, truth_spp : int
        Samples per pixel of captures, and of the pictures that are the truth.
    """

    lenses: int
    pixels: int
    spp: int
    truth_spp: int


SIZES = {"small": Size(16, 12, 16, 64), "full": Size(64, 12, 64, 512)}


@dataclass(frozen=True)
class BenchmarkRecipe(Recipe):
    """A benchmark that can be made again, bit for bit: all scenes, each by all cameras, in this order."""

    def plan(self, index: int) -> SamplePlan:
        """Return the plan of a sample: its scene and its camera."""
        number, which = divmod(index, len(self.content["cameras"]))
        name, size = self.content["scenes"][number], Size(**self.content["size"])
        parameters = dict(self.content["cameras"][which])
        camera = parameters.pop("name")
        width = size.lenses * PITCH
        reference = PlenopticCamera(**CAMERAS["square"])
        seed = int(generator(self.seed, 0, f"scene.{name}").integers(2**63))
        maker = SceneMaker(name, seed, Frame(width / reference.mla_distance, size.lenses))
        split = "held_out" if camera in HELD_OUT else "training"
        draws = {"scene": name, "camera": camera, "split": split, "distances": list(DISTANCES)}
        pixels = size.lenses * size.pixels
        return SamplePlan(
            index, number, PlenopticCamera(detector_width=width, resolution=(pixels, pixels), **parameters),
            Illumination(), maker, {}, None, None, {"ray": dict(self.ray), "wave": dict(self.wave)}, draws,
        )  # fmt: skip


def benchmark_recipe(
    seed: int = 0, scenes: Iterable[str] = tuple(SCENES), size: Size = SIZES["full"]
) -> BenchmarkRecipe:
    """Return the recipe of a benchmark by seed, scenes and size.

    Parameters
    ----------
    seed : int
        The scenes' textures, positions and noise follow from it.
    scenes : sequence of str
        Names of scenes.
    size : Size
        Size of the captures.

    Raises
    ------
    InputError
        If a scene is unknown or there is none.
    """
    seed = require_count("seed", seed, minimum=0, maximum=2**63)
    names = [require_choice("scenes", name, SCENES) for name in scenes]
    refuse_if(not names or len(set(names)) < len(names), f"scenes = {short_repr(names)}: name at least one, each once")
    # In the order of the list of scenes, and the white one last.
    names = [*sorted(names, key=list(SCENES).index), WHITE]
    content = {
        "benchmark": VERSION,
        "seed": seed,
        "scenes": names,
        "size": asdict(size),
        "cameras": [{"name": name, **parameters} for name, parameters in CAMERAS.items()],
        "noise": NOISE,
    }
    return BenchmarkRecipe(
        name="mitsuba_plenoptic benchmark",
        count=len(names) * len(CAMERAS),
        seed=seed,
        models=MODELS,
        variant=DEFAULT_VARIANT,
        camera={},
        scenes=tuple(Source(name, None, 1.0, {}) for name in names),
        light={},
        noise=None,
        photodiodes=None,
        ray={"spp": size.spp},
        wave={"spp": size.spp, "method": "signed_rays", "wavelength": WAVELENGTH},
        truth=("depth", "virtual_depth", "normal", "shape_index"),
        samples_per_shard=len(CAMERAS),
        content=content,
    )


def make_entry(recipe: Recipe, index: int) -> Sample:
    """Return a sample of the benchmark: captures, exposed captures, ground truth, and the true pictures."""
    plan = recipe.plan(index)
    made = make_sample(recipe, index)
    arrays, captures = dict(made.arrays), dict(made.facts["captures"])
    for model in recipe.models:
        for level, photons in recipe.content["noise"].items():
            name = f"{model}_{level}"
            seed = int(generator(recipe.seed, index, f"seed.{name}").integers(2**32))
            exposed = expose(made.capture(model), Detector(), photons=photons, seed=seed)
            arrays[name] = exposed.image
            captures[name] = {"wavelength": exposed.wavelength, "metadata": exposed.metadata}
    scene, camera = open_sample(recipe, plan), plan.camera
    spp = recipe.content["size"]["truth_spp"]
    refocused = [thin_lens_image(scene, camera, distance, spp) for distance in DISTANCES]
    views = [view_image(scene, camera, (x, y), spp) for x, y in PUPIL_POINTS]
    arrays |= {"target_refocus": np.stack(refocused), "target_views": np.stack(views)}
    arrays = {name: np.asarray(array, np.float32) for name, array in arrays.items()}
    return Sample(index, arrays, {**made.facts, "captures": captures})


def view_image(scene: Any, camera: PlenopticCamera, point: tuple[float, float], spp: int) -> np.ndarray:
    """Return the sharp view from a point of the pupil, with the plane in focus where the central view has it."""
    size = np.array(camera.bin_count)
    x, y = (coordinate * camera.aperture_radius for coordinate in point)
    width, height = size * camera.bin_size(camera.focus_distance)
    to_world = np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)
    to_world[:3, 3] += to_world[:3, :2] @ [x, y]
    columns, rows = (int(count) for count in size * FINER)
    sensor = photographic_sensor(
        scene, camera, (columns, rows), type="perspective", to_world=mi.ScalarTransform4f(to_world),
        principal_point_offset_x=x / width, principal_point_offset_y=y / height,
    )  # fmt: skip
    return photograph(scene, sensor, spp)


class Benchmark(DataSet):
    """A benchmark, read from its folder.

    Parameters
    ----------
    folder : path
        The folder of `make_benchmark` or ``mitsuba-plenoptic benchmark make``.
    fields : sequence of str, optional
        Names of the arrays to read. Default: all.

    Raises
    ------
    InputError
        If the folder holds no benchmark, or one of another version.
    """

    def __init__(self, folder: str | Path, fields: Sequence[str] | None = None) -> None:
        super().__init__(folder, fields)
        recipe = self.manifest.get("recipe")
        version = recipe.get("benchmark") if isinstance(recipe, dict) else None
        refuse_if(version is None, f"{folder}: it holds a data set that is no benchmark")
        refuse_if(version != VERSION, f"{folder}: it is version {short_repr(version)}: this program reads {VERSION}")
        self.scenes = [name for name in self.manifest["recipe"]["scenes"] if name != WHITE]
        self.cameras = [camera["name"] for camera in self.manifest["recipe"]["cameras"]]

    def entries(self) -> list[int]:
        """Return the indices of the samples that are scored, which excludes those of the white scene."""
        return list(range(len(self.scenes) * len(self.cameras)))

    def name(self, index: int) -> tuple[str, str]:
        """Return the names of a sample's scene and camera."""
        scene, camera = divmod(index, len(self.cameras))
        return self.scenes[scene], self.cameras[camera]

    def white(self, index: int, model: str) -> Capture:
        """Return the white capture, without noise, of a sample's camera.

        Parameters
        ----------
        index : int
            Index of the sample.
        model : {"ray", "wave"}
            Model of the light.
        """
        return self[len(self.entries()) + index % len(self.cameras)].capture(model)


def model_of(name: str) -> str:
    """Return the light model, ``ray`` or ``wave``, of a capture named in `CAPTURES`."""
    return name.partition("_")[0]


def capture_of(sample: Sample, name: str) -> Capture:
    """Return a capture of a sample by its name, one of `CAPTURES`."""
    return sample.capture_called(name, model_of(name))


def central_truth(sample: Sample) -> dict[str, np.ndarray]:
    """Return the ground truth of the central view's bins by quantity, and where they show ``glass``."""
    found = {}
    for name, array in sample.arrays.items():
        if name.startswith(VIEWS):
            found[name.removeprefix(VIEWS)] = array[array.shape[0] // 2, array.shape[1] // 2]
    transparent = [number + 1 for number, name in enumerate(sample.facts["shapes"]) if name.startswith(GLASS)]
    return {**found, "glass": np.isin(found["shape_index"], transparent)}
