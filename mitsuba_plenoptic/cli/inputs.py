"""What the options name, checked and made: files to write, cameras, scene parameters, workers."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from ..calibration import read_camera
from ..camera import PlenopticCamera
from ..capture.scene import load_scene
from ..errors import InputError
from ..io.files import require_writable
from ..presets import PRESETS
from ..runtime.batches import BatchMap
from ..runtime.cluster import Cluster


def require_capture_output(path: Path) -> None:
    """Check, before a long computation, that a capture can be written to a file, whose name ends in ``.exr``."""
    if path.suffix.lower() != ".exr":
        raise InputError(f"{path}: a capture is written as OpenEXR; give a name that ends in .exr")
    require_writable(path)


def load_camera(source: str, parameters: dict[str, str]) -> PlenopticCamera:
    """Return the camera of a preset, a JSON file or a scene; a file takes precedence over a preset of its name."""
    if source.lower().endswith(".json"):
        return read_camera(source)[0]
    if source in PRESETS and not parameters and not Path(source).is_file():
        return PlenopticCamera.preset(source)
    sensors = load_scene(source, parameters=parameters).sensors()
    if not sensors:
        raise InputError(f"{source}: it has no sensor; add one of type 'plenoptic'")
    return PlenopticCamera.from_sensor(sensors[0])


def named_camera(source: str | None) -> PlenopticCamera | None:
    """Return the camera that an option names, None where it is not given."""
    return None if source is None else read_camera(source)[0]


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
