"""What a capture of a scene depends on, in one record: reports, sweeps and data sets load, identify and render it."""

from __future__ import annotations

import hashlib
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import mitsuba as mi

from .camera import PlenopticCamera
from .errors import naming
from .io import Capture, hash_of
from .plugins.other_camera import with_camera
from .runtime import DEFAULT_VARIANT, Facts, Named, require_size, set_variant
from .scene import LARGEST_SCENE, load_scene, plenoptic_sensor, quiet, render_capture
from .scene_files import scene_path


@dataclass(frozen=True)
class CaptureSpec:
    """Everything that the pixels of a capture depend on, besides the software.

    Attributes
    ----------
    scene : str
        A scene file or a built-in name.
    parameters : mapping of str to str
        Values for the scene's ``$name`` parameters.
    camera : mapping, optional
        Parameters by name of the camera that replaces the scene's, as `PlenopticCamera.to_dict` has them.
    unit : {"mm", "cm", "m"}
        Unit of the scene's lengths.
    model : {"ray", "wave"}, optional
        How light propagates through the camera. Default: as the scene's integrator has it.
    wavelength : float, optional
        Wavelength of wave captures in nanometres. Default: the scene's, else 633.
    spp : int, optional
        Samples per pixel. Default: those of the scene's sampler.
    seed : int
        Seed of the random numbers.
    variant : str
        Mitsuba variant.
    """

    scene: str
    parameters: Mapping[str, str] = field(default_factory=dict)
    camera: Facts | None = None
    unit: str = "mm"
    model: str | None = None
    wavelength: float | None = None
    spp: int | None = None
    seed: int = 0
    variant: str = DEFAULT_VARIANT

    def load(self) -> mi.Scene:
        """Return the scene in the variant, with `camera` in place of its sensor; refuse one without a plenoptic one."""
        set_variant(self.variant)
        # Mitsuba warns that films of colours record luminance, which the variant says.
        with quiet() if mi.is_monochromatic else nullcontext():
            scene = load_scene(self.scene, parameters=self.parameters, unit=self.unit)
        if self.camera is not None:
            return with_camera(scene, PlenopticCamera.from_dict(dict(self.camera)))
        with naming(self.scene):
            plenoptic_sensor(scene)
        return scene

    def by(self, model: str) -> CaptureSpec:
        """Return the specification of the same scene captured by a model of light, for rays without a wavelength."""
        settings = {item.name: getattr(self, item.name) for item in fields(CaptureSpec)}
        return CaptureSpec(**{**settings, "model": model, "wavelength": None if model == "ray" else self.wavelength})

    def fingerprint(self) -> Named:
        """Return plain values that identify the capture: its settings, and a hash of the scene's files."""
        return {**asdict(self), "scene": scene_fingerprint(self.scene, self.parameters)}

    def render(self, scene: mi.Scene | None = None, **options: Any) -> Capture:
        """Return the capture; by model "wave" it is made from signed rays, unless another method is given.

        Parameters
        ----------
        scene : mitsuba.Scene, optional
            The loaded scene. Default: it is loaded.
        **options
            Further arguments of `render_capture`.
        """
        settings: Named = {"model": self.model, "spp": self.spp, "seed": self.seed}
        if self.wavelength is not None:
            settings["wavelength"] = self.wavelength
        if self.model == "wave":
            settings["method"] = "signed_rays"
        return render_capture(self.load() if scene is None else scene, **{**settings, **options})


def scene_fingerprint(scene: str | Path, parameters: Mapping[str, str]) -> str:
    """Return a hash of a scene file, its parameters, and the meshes, textures and scenes it names."""
    path = Path(scene) if Path(scene).is_file() else scene_path(str(scene))
    return hash_of({"files": _content(path, dict(parameters)), "parameters": dict(parameters)})


def _content(path: Path, parameters: dict[str, str]) -> list[tuple[str, str]]:
    """Return the names and hashes of a scene's files; names with parameters get the parameters' values."""
    with path.open("rb") as file:
        hashes = [(path.name, hashlib.file_digest(file, "sha256").hexdigest())]
    if path.suffix.lower() != ".xml":
        return hashes
    try:
        root = ElementTree.fromstring(require_size(path, LARGEST_SCENE).read_bytes())
    except ElementTree.ParseError:
        return hashes
    values = {item.get("name", ""): item.get("value", "") for item in root.iter("default")} | parameters
    names = [item.get("value", "") for item in root.iter("string") if item.get("name") == "filename"]
    names += [item.get("filename", "") for item in root.iter("include")]
    for name in names:
        filled = re.sub(r"\$(\w+)", lambda match: values.get(match.group(1), match.group(0)), name)
        if (path.parent / filled).is_file():
            hashes += _content(path.parent / filled, values)
    return hashes
