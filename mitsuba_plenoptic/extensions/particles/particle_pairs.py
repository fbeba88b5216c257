"""Generator of data sets: pairs of captures of particles in a random flow."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np

from ...camera import PlenopticCamera
from ...errors import put_checked, refuse_if, require_choice, require_number
from ...io import Capture
from ...runtime import Array, Facts, Named
from .flows import FLOWS, Flow, Vortex
from .particle_images import ParticleImages
from .seeding import ParticleVolume, Seeding, Window
from .sequence import particle_sequence


@dataclass(frozen=True)
class ParticlePairs:
    """Particles in a light sheet and a random flow, captured twice."""

    flow: str = "hill"
    # Distances between which they are. Default: a twentieth of the distance in focus to either side. With an
    # objective they are depths beyond the native object plane, and must be given.
    near: float | None = None
    far: float | None = None
    # Particles over the microlenses on which the volume is imaged.
    per_lens: float = 0.05
    # Median diameter in micrometres, and standard deviation of its logarithm.
    diameter: float = 10.0
    spread: float = 0.0
    # Largest displacement over the width of a microlens, imaged into the volume's middle.
    displacement: float = 1.0

    def __post_init__(self) -> None:
        put_checked(
            self,
            flow=partial(require_choice, choices=[name for name in FLOWS if name != "file"]),
            near=require_number,
            far=require_number,
            displacement=partial(require_number, positive=True, maximum=1e3),
        )
        self._seeding()

    def _seeding(self) -> Seeding:
        return Seeding(per_lens=self.per_lens, diameter=self.diameter, spread=self.spread)

    @property
    def meanings(self) -> dict[str, str]:
        """What the arrays besides the captures are, by name."""
        second = {f"{model}_next": f"the second capture by {model}s" for model in ("ray", "wave")}
        exposed = {f"{name}_exposed": f"{words}, with the noise of a detector" for name, words in second.items()}
        return {
            **second,
            **exposed,
            "particle_position": "positions of the particles at both captures, mm; NaN outside the volume",
            "particle_displacement": "displacements until the next capture and after it, mm",
            "particle_diameter": "diameters, micrometres",
        }

    def _random_flow(self, volume: ParticleVolume, largest: float, random: np.random.Generator) -> Flow:
        """Return a flow at a random place and of random orientation, with a given largest velocity."""
        kind = FLOWS[self.flow]
        # Velocities are proportional to the first one; the second one of a vortex is its size.
        names = [field.name for field in fields(kind)]
        values: Named = {}
        if self.flow == "uniform":
            values["speed"] = tuple(random.normal(size=3))
        else:
            values["centre"] = tuple(random.uniform(volume.lower, volume.upper))
            axes = random.permutation(list("xyz")).tolist()
            values |= dict(zip([name for name in names if name in ("along", "across", "axis")], axes, strict=False))
        if issubclass(kind, Vortex):
            # Size of a vortex over the smallest extent of the volume.
            values[names[1]] = random.uniform(0.2, 0.5) * float(volume.size.min())
        trial = kind(**values)
        places = random.uniform(volume.lower, volume.upper, (4000, 3))
        factor = largest / float(np.linalg.norm(trial.velocity(places), axis=1).max())
        return replace(trial, **{names[0]: (factor * np.array(getattr(trial, names[0]))).tolist()})

    def captures(
        self, camera: PlenopticCamera, options: Mapping[str, Facts], random: np.random.Generator
    ) -> tuple[dict[str, Capture], dict[str, Array]]:
        """Return both captures by each model, and the particles."""
        refuse_if(
            camera.objective is not None and None in (self.near, self.far),
            f"main_lens = {camera.lens_data.label}: give near and far, in mm beyond the native object plane",
        )
        near = 0.95 * camera.focus_distance if self.near is None else self.near
        far = 1.05 * camera.focus_distance if self.far is None else self.far
        refuse_if(not near < far, f"near = {near:g}, far = {far:g}: they must follow one another")
        # 0.8: Part of the field of view that the volume fills.
        extents = np.array([camera.detector_width, camera.detector_height])
        width, height = 0.8 * extents / 2 * camera.bin_size(near) / camera.row_pitch
        volume = ParticleVolume((-width, -height, near), (width, height, far))
        middle = Window(near, Seeding.medium).seen(volume.centre[2], camera)
        flow = self._random_flow(volume, self.displacement * camera.bin_size(middle), random)
        seed = int(random.integers(2**32))
        truth = particle_sequence(camera, volume, self._seeding(), flow, interval=1.0, seed=seed)
        frames: dict[str, Capture] = {}
        for model, chosen in options.items():
            given = {name: chosen[name] for name in ("wavelength", "accuracy") if name in chosen}
            images = ParticleImages(truth, model=model, **{"wavelength": 550.0} | given)
            frames |= {model: images.capture(0), f"{model}_next": images.capture(1)}
        inside = truth["inside"].values[..., None] == 1
        arrays = {
            "particle_position": np.where(inside, truth["position"], np.nan),
            "particle_displacement": np.where(inside, truth["displacement"], np.nan),
            "particle_diameter": truth["diameter"].values,
        }
        return frames, {name: values.astype(np.float32) for name, values in arrays.items()}
