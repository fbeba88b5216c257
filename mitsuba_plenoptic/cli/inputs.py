"""What the options name, read or started: captures, light fields, cameras, scene parameters, workers."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import xarray as xr

from ..camera import PlenopticCamera
from ..capture.scene import load_scene
from ..errors import InputError
from ..io.captures import Capture, read_capture
from ..io.files import require_writable
from ..lightfield.exchange import open_light_field
from ..presets import PRESETS
from ..runtime.batches import BatchMap


def require_capture_output(path: Path) -> None:
    """Check, before a long computation, that a capture can be written to a file.

    Raises
    ------
    InputError
        If its name does not end in ``.exr`` or it cannot be written.
    """
    if path.suffix.lower() != ".exr":
        raise InputError(f"{path}: a capture is written as OpenEXR; give a name that ends in .exr")
    require_writable(path)


def load_capture(path: str | Path) -> Capture:
    """Read a capture without the remarks that OpenEXR itself prints about a damaged file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    with _native_output_dropped():
        return read_capture(path)


def load_light_field(source: Path, white: Path | None, view_count: int | None, linear: bool) -> xr.DataArray:
    """Read or decode a light field without the remarks that OpenEXR itself prints about a damaged file.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    with _native_output_dropped():
        return open_light_field(source, white=white, views=view_count, linear=linear)


def load_camera(source: str, parameters: dict[str, str]) -> PlenopticCamera:
    """Return the camera of a preset or of a scene; a file takes precedence over a preset of its name.

    Raises
    ------
    InputError
        If there is no such scene or it has no plenoptic camera.
    """
    if source in PRESETS and not parameters and not Path(source).is_file():
        return PlenopticCamera.preset(source)
    sensors = load_scene(source, parameters=parameters).sensors()
    if not sensors:
        raise InputError(f"{source}: it has no sensor; add one of type 'plenoptic'")
    return PlenopticCamera.from_sensor(sensors[0])


def parse_definitions(definitions: list[str] | None) -> dict[str, str]:
    """Turn ``name=value`` texts into a dictionary.

    Raises
    ------
    InputError
        If a text is not of that form.
    """
    parameters = {}
    for text in definitions or []:
        name, equals, value = text.partition("=")
        if not name or not equals:
            raise InputError(f"-D {text}: write it as -D NAME=VALUE")
        parameters[name] = value
    return parameters


@contextlib.contextmanager
def batches_on(workers: int | None, scheduler: str | None) -> Iterator[BatchMap | None]:
    """Start or reach the workers that are asked for; yields None if none are.

    Raises
    ------
    InputError
        If they cannot be had.
    """
    if workers is None and scheduler is None:
        yield None
        return
    from ..runtime.cluster import Cluster

    with Cluster(workers=workers, scheduler=scheduler) as cluster:
        yield cluster


@contextlib.contextmanager
def _native_output_dropped() -> Iterator[None]:
    """Drop what C++ code prints past Python."""
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [(number, os.dup(number)) for number in (1, 2)]
    try:
        with Path(os.devnull).open("wb") as nowhere:
            for number, _ in saved:
                os.dup2(nowhere.fileno(), number)
        yield
    finally:
        for number, copy in saved:
            os.dup2(copy, number)
            os.close(copy)
