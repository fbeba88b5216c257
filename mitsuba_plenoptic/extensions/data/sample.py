"""One sample of a data set: captures of a scene by one camera, ground truth, and all parameters drawn for it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...camera import PlenopticCamera
from ...capture_spec import CaptureSpec
from ...detector import expose
from ...io import Capture, GroundTruth, versions
from ...plugins.other_camera import with_camera
from ...runtime import Array, Named, Progress, set_variant
from ...scene import load_scene, render_capture
from ...views import ground_truth
from .dual_samples import pictures_of, truth_of_lenses
from .generators import CaptureGenerator
from .recipe import Recipe, SamplePlan, generator

VIEWS = "views_"
"""Before the names of quantities of the decoded views; those without it are of the pixels."""

EXPOSED = "_exposed"
"""After the name of a model: its capture with the noise of a detector."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample: its arrays, its camera and everything drawn for it.

    Attributes
    ----------
    index : int
        Index of the sample in the data set.
    arrays : dict
        Float32 arrays by name: captures (rows, columns[, 3]) ``ray``, ``wave``, ``ray_exposed``, ``wave_exposed``;
        ground truth of the pixels such as ``depth`` and ``normal`` (rows, columns[, 3]); and of the decoded views such
        as ``views_depth`` (v, u, t, s[, 3]), as `GroundTruth` has them. With `photodiodes` also their pictures, such as
        ``ray_left``, and of each lens ``sharp``, ``lens_depth`` and ``blur_radius``.
    facts : dict
        Plain JSON values: ``version``, ``camera``, ``to_world``, ``shapes``, ``scene``, ``draws``, and in ``captures``
        the metadata and the wavelength of each.
    """

    index: int
    arrays: dict[str, Array]
    facts: Named

    @property
    def camera(self) -> PlenopticCamera:
        """Camera of the sample."""
        return PlenopticCamera.from_dict(self.facts["camera"])

    def capture(self, model: str, *, exposed: bool = False) -> Capture:
        """Return the sample's capture by one light model, for `decode` and `reconstruct`.

        Parameters
        ----------
        model : {"ray", "wave"}
            The light model of the capture.
        exposed : bool
            Whether with the noise of a detector.
        """
        return self.capture_called(model + EXPOSED * exposed, model)

    def capture_called(self, name: str, model: str) -> Capture:
        """Return the capture of a name."""
        about = self.facts["captures"][name]
        return Capture(self.arrays[name], self.camera, about["wavelength"], model, about["metadata"])

    @property
    def truth(self) -> GroundTruth:
        """Ground truth of the sample, for `decode`."""
        views = {name.removeprefix(VIEWS): array for name, array in self.arrays.items() if name.startswith(VIEWS)}
        return GroundTruth(
            camera=self.camera,
            pixels={name: self.arrays[name] for name in views},
            views=views,
            shapes=tuple(self.facts["shapes"]),
            to_world=np.array(self.facts["to_world"], np.float64),
        )


def open_sample(recipe: Recipe, plan: SamplePlan) -> Any:
    """Return the scene of a sample, loaded or generated, with the sample's camera; None for what is no scene."""
    source = recipe.scenes[plan.source]
    # Before the generator, whose textures are arrays of the variant.
    set_variant(recipe.variant)
    if isinstance(plan.maker, CaptureGenerator):
        return None
    if plan.maker:
        random = random_of_scene(recipe, plan)
        scene = load_scene(plan.maker.scene(plan.camera, plan.light, random))
        scene.set_id(str(source.generator))
        return with_camera(scene, plan.camera)
    camera = plan.camera.to_dict()
    return CaptureSpec(str(source.scene), plan.parameters, camera, source.unit, variant=recipe.variant).load()


def random_of_scene(recipe: Recipe, plan: SamplePlan) -> np.random.Generator:
    """Return the random numbers of a sample's scene, which do not depend on what else is drawn."""
    return generator(recipe.seed, plan.index, f"scenes.{plan.source}")


def make_sample(recipe: Recipe, index: int, progress: Progress | None = None) -> Sample:
    """Return a rendered sample, whose bits depend on the recipe and the index alone.

    Parameters
    ----------
    recipe : Recipe
        The recipe.
    index : int
        Number of the sample.
    progress : callable, optional
        Called with the finished and the total amount of its captures' work.
    """
    plan = recipe.plan(index)
    scene = open_sample(recipe, plan)
    arrays: dict[str, Array] = {}
    about = {}

    def seed(name: str) -> int:
        return int(generator(recipe.seed, index, f"seed.{name}").integers(2**32))

    if isinstance(plan.maker, CaptureGenerator):
        captures, arrays = plan.maker.captures(plan.camera, plan.options, random_of_scene(recipe, plan))
        kind = recipe.scenes[plan.source].generator
        meanings = plan.maker.meanings
    else:
        options = plan.options
        captures = {}
        for before, model in enumerate(recipe.models):

            def report(done: int, total: int, before: int = before) -> None:
                if progress:
                    progress(before * total + done, len(recipe.models) * total)

            captures[model] = render_capture(scene, model=model, seed=seed(model), progress=report, **options[model])
        kind = scene.id()
        meanings = {}
    for name in list(captures):
        if plan.detector and plan.photons is not None:
            exposed = name + EXPOSED
            captures[exposed] = expose(captures[name], plan.detector, photons=plan.photons, seed=seed(exposed))
    for name, capture in sorted(captures.items()):
        arrays[name] = capture.image
        if recipe.photodiodes:
            arrays |= pictures_of(capture, recipe.photodiodes, name)
        about[name] = {"wavelength": capture.wavelength, "metadata": capture.metadata}
    if recipe.photodiodes:
        arrays |= truth_of_lenses(scene, plan.options[recipe.models[0]]["spp"], seed("sharp"))
    truth = ground_truth(scene, recipe.truth) if recipe.truth else None
    facts: Named = {
        "camera": plan.camera.to_dict(),
        "scene": kind,
        "draws": dict(plan.draws),
        "captures": about,
        "shapes": [],
        "to_world": np.eye(4).tolist(),
    }
    if meanings:
        facts["arrays"] = meanings
    if truth:
        facts |= {"shapes": list(truth.shapes), "to_world": truth.to_world.tolist()}
        arrays |= truth.pixels | {VIEWS + name: array for name, array in truth.views.items()}
    return Sample(index, arrays, versions.stamped(facts))
