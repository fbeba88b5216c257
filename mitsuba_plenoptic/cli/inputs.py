"""What the options name, checked and made: files to write, cameras, scenes and their parameters, workers."""

from __future__ import annotations

import dataclasses
import logging
import re
import warnings
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..camera import PlenopticCamera
from ..capture.render import plenoptic_sensor
from ..capture.scene import check_scene_file, load_scene, scene_names, scene_path
from ..design import design_warnings
from ..errors import InputError, did_you_mean
from ..io.captures import Capture, read_capture
from ..io.raw import RAW_SUFFIXES, read_raw, scaled_from, tells_detector
from ..plugins.other_camera import with_camera
from ..presets import PRESETS
from ..report.images import Brightness
from ..runtime.batches import BatchMap
from ..runtime.cluster import Cluster
from ..runtime.variant import DEFAULT_VARIANT

if TYPE_CHECKING:
    from ..calibration import LensIndex

_COLOURS = "llvm_ad_rgb"
"""Variant for films that record colours."""

_log = logging.getLogger(__name__)


def load_camera(source: str, parameters: dict[str, str]) -> tuple[PlenopticCamera, LensIndex | None]:
    """Return the camera of a preset, a JSON file or a scene; a file takes precedence over a preset of its name."""
    preset = source in PRESETS and not Path(source).is_file()
    # Some scenes are called as a camera; parameters are theirs.
    preset = preset and not (parameters and source in scene_names())
    if preset or source.lower().endswith((".json", ".js")):
        if parameters:
            raise InputError(f"-D: {source} is no scene, and has no scene parameters; leave it out")
        # Brings libraries that take a while to load.
        from ..calibration import read_camera

        return read_camera(source)
    if source.lower().endswith(".exr"):
        raise InputError(f"{source}: it is an image; a camera is a preset, a JSON file or a scene")
    if not Path(source).exists() and source not in scene_names():
        names = scene_names()
        raise InputError(
            f"{source}: there is no such file, and no camera ({', '.join(PRESETS)}) or built-in scene "
            f"({', '.join(names)}) of that name{did_you_mean(source, [*PRESETS, *names])}"
        )
    sensors = load_scene(source, parameters=parameters).sensors()
    if not sensors:
        raise InputError(f"{source}: it has no sensor; add one of type 'plenoptic'")
    return PlenopticCamera.from_sensor(sensors[0]), None


def read_recorded(path: Path, camera: PlenopticCamera | None, linear: bool, black_level: float = 0) -> Capture:
    """Read a capture, or a raw picture of a known camera; the camera that is given takes the place of a capture's.

    Of a raw picture that tells its camera and detector, as `write_raw` writes it, nothing else is needed.
    """
    if path.suffix.lower() in RAW_SUFFIXES:
        if tells_detector(path):
            found = read_raw(path)
            return found if camera is None else dataclasses.replace(found, camera=camera)
        if camera is None:
            raise InputError(f"{path}: it tells no camera and detector; such a raw picture needs its --camera")
        # Brings libraries that take a while to load.
        from ..lightfield.exchange import read_picture

        return scaled_from(Capture(read_picture(path, linear=linear), camera, None, "ray", {}), black_level)
    found = read_capture(path)
    return found if camera is None else dataclasses.replace(found, camera=camera)


def require_linear(linear: bool, *paths: Path | None) -> None:
    """Refuse --linear where no picture is read whose values could be so."""
    given = [path for path in paths if path is not None]
    if linear and not any(path.suffix.lower() in RAW_SUFFIXES for path in given):
        raise InputError(f"--linear: it is for pictures (.png, .tiff); {given[0]} holds values proportional to light")


def brightness_of(exposure: float | None, percentile: float | None, *paths: Path | None) -> Brightness:
    """Return what becomes white in pictures; refuse the options where none of the files to write is one."""
    named = "--exposure" if exposure is not None else "--percentile" if percentile is not None else None
    given = [path for path in paths if path is not None]
    if named and not any(path.suffix.lower() == ".png" for path in given):
        raise InputError(f"{named}: it is for pictures (.png); {given[0]} keeps the values as they are")
    return Brightness(exposure, percentile)


def named_camera(source: str | None) -> PlenopticCamera | None:
    """Return the camera that an option names, None where it is not given."""
    return None if source is None else load_camera(source, {})[0]


def open_scene(
    scene: str, parameters: dict[str, str], variant: str | None, camera: str | None = None, number: int = 0
) -> Any:
    """Load a scene to be rendered, in the variant of its film's colours unless told, and say what is poor about it."""
    other = named_camera(camera)
    colours = None if variant else _colours_of_film(scene, parameters)
    loaded = load_scene(scene, variant=variant or (_COLOURS if colours else DEFAULT_VARIANT), parameters=parameters)
    if other is not None:
        loaded = with_camera(loaded, other)
    sensor = plenoptic_sensor(loaded, number)
    seen = PlenopticCamera.from_sensor(sensor)
    if colours:
        _log.info("variant %s, as the film records %s; --variant chooses another", _COLOURS, colours)
    for text in design_warnings(seen):
        warnings.warn(text, stacklevel=2)
    box = loaded.bbox()
    if box.valid():
        to_camera = sensor.world_transform().inverse()
        farthest = max(float((to_camera @ box.corner(index)).z[0]) for index in range(8))
        if farthest < seen.focal_length:
            warnings.warn(
                f"the whole scene is nearer than {farthest:.4g} mm, within the main lens's focal length of "
                f"{seen.focal_length:.4g} mm: lengths are taken as millimetres; if the scene's are metres, scale it",
                stacklevel=2,
            )
    return loaded


def _colours_of_film(scene: str, parameters: dict[str, str]) -> str | None:
    """Return the colours that a scene's film records, None if it records none.

    Mitsuba's films record rgb unless told otherwise, and so does the one of a sensor that names none.
    """
    path = Path(scene) if Path(scene).exists() else scene_path(scene)
    text = re.sub(r"<!--.*?-->", "", check_scene_file(path, parameters), flags=re.DOTALL)
    formats = []
    for film in re.findall(r"<film\b[^>]*/>|<film\b.*?</film>", text, re.DOTALL) or ["hdrfilm"]:
        tags = [tag for tag in re.findall(r"<string\b[^>]*>", film) if re.search(r"""name=["']pixel_format["']""", tag)]
        named = [found[1] for tag in tags if (found := re.search(r"""value=["']([^"']*)""", tag))]
        formats += named or (["rgb"] if "hdrfilm" in film else [])
    defaults = dict(re.findall(r"""<default\s+name=["'](\w+)["']\s+value=["']([^"']*)""", text)[::-1]) | parameters
    for name in formats:
        colours = str(defaults.get(name.removeprefix("$"), name)).lower()
        if colours in ("rgb", "rgba"):
            return colours
    return None


def parse_definitions(definitions: list[str] | None) -> dict[str, str]:
    """Turn ``name=value`` texts into a dictionary."""
    parameters = {}
    for text in definitions or []:
        name, equals, value = text.partition("=")
        if not name or not equals:
            raise InputError(f"-D {text}: write it as -D NAME=VALUE")
        parameters[name] = value
    return parameters


def batches_on(workers: int | None, scheduler: str | None) -> AbstractContextManager[BatchMap | None]:
    """Return a context of the workers that are asked for; of None if none are."""
    return nullcontext() if workers is None and scheduler is None else Cluster(workers=workers, scheduler=scheduler)
