"""The names that cases are written in: the package's own, whole files and captures, and ways to damage them.

Every case runs in an empty folder of its own, which is the current one; files are made there and named by their names.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import math
import re
import tempfile
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from struct import pack
from typing import Any
from unittest import mock
from xml.sax.saxutils import quoteattr

import h5py
import mitsuba as mi
import numpy as np
import OpenEXR
import scipy.io

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, Checkpoint, InputError, PlenopticCamera, decode, load_scene, render_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.extensions.raw import exchange
from mitsuba_plenoptic.views import white_image

from .texts import TEXTS

SCENE = """<?xml version="1.0" encoding="utf-8"?>
<scene version="3.0.0">
    <default name="resolution" value="16"/>
    <default name="samples" value="1"/>
    <integrator type="path"/>
    <sensor type="plenoptic">
        <float name="detector_width" value="0.128"/>
        <sampler type="independent"><integer name="sample_count" value="$samples"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resolution"/>
            <integer name="height" value="$resolution"/>
            <string name="pixel_format" value="luminance"/>
            <string name="component_format" value="float32"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <shape type="ply">
        <string name="filename" value="square.ply"/>
        <bsdf type="diffuse"><texture type="bitmap" name="reflectance">
            <string name="filename" value="dots.png"/>
        </texture></bsdf>
    </shape>
    <emitter type="constant"/>
</scene>
"""
PLY = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
-50 -50 240
50 -50 240
0 50 240
3 0 2 1
"""
GRID = b"samples: [1, 2]\ndistance: [210.0, 2.8e2]\n"
GRID_MODEL = {"HSpacing": 16.0, "VSpacing": 16.0, "HOffset": 8.0, "VOffset": 8.0, "Rot": 0.0, "UMax": 4.0, "VMax": 4.0,
              "FirstPosShiftRow": 5.0, "Orientation": "horz"}  # fmt: skip
ONES = np.ones((3, 3, 4, 4, 2), np.uint8)
SENSOR = '<float name="detector_width" value="0.128"/>'
FILM = '<integer name="width" value="$resolution"/>'

# Four lenses of sixteen pixels along each axis.
CAMERA = PlenopticCamera(resolution=(64, 64), detector_width=0.256)
SMALL_CAMERA = PlenopticCamera(resolution=(32, 32), detector_width=0.128)

# Whole commands, to which one word more is added.
RENDER = ("render", "white", "-o", "out.exr", "-Dresolution=256")
REFOCUS = ("reconstruct", "grey.exr", "-o", "out.exr", "--distance=240")
EXPOSE = ("expose", "grey.exr", "-o", "out.exr", "--photons=1000")
COMPARE = ("compare", "letters", "-o", "out", "-Dresolution=256", "--distance=240", "--spp=1")


class Accepted(Exception):  # noqa: N818 (the package made the error)
    """The package took what the documentation forbids."""


def forbidden(result: Any) -> None:
    """Mark a case that must be refused, so that nothing ever comes here."""
    raise Accepted(f"forbidden, but taken: the result is {type(result).__name__}")


@cache
def capture(channels: int = 1) -> Capture:
    """Make a textured white image."""
    image = white_image(CAMERA) * np.random.default_rng(0).random((64, 64), dtype=np.float32)
    if channels == 3:
        image = np.stack([image, image / 2, image / 4], axis=-1)
    return Capture(image, CAMERA, 633.0, "wave", {"seed": 0, "scene": "white.xml"})


def image(**changes: Any) -> np.ndarray:
    """Return the capture's pixels, some of them changed: ``image(at=(3, 4), to=nan)``."""
    pixels = capture().image.copy()
    if changes:
        pixels[changes["at"]] = changes["to"]
    return pixels


def noise(camera: PlenopticCamera) -> np.ndarray:
    """Make what a camera might have recorded."""
    return np.random.default_rng(0).random(camera.shape, dtype=np.float32)


def far(camera: PlenopticCamera, focal_lengths: float) -> float:
    """Return a distance that the camera can be focused on, given in focal lengths."""
    return max(min(focal_lengths * camera.focal_length, 1e9), math.nextafter(camera.focal_length, 2e9))


def design(camera: PlenopticCamera, wavelength: str) -> list[Any]:
    """Write a camera and read it, and print all that follows from it."""
    assert PlenopticCamera.from_dict(json.loads(json.dumps(camera.to_dict()))) == camera
    mp.write_capture("raw.exr", Capture(noise(camera), camera))
    return [camera, command("info", "raw.exr", "--wavelength", wavelength)]


def light_field(channels: int = 1) -> Any:
    """Decode the capture."""
    return decode(capture(channels))


def command(*arguments: str) -> str:
    """Run the command as a user does, beside the capture ``grey.exr``, and return what it prints.

    Raises
    ------
    InputError
        If it refuses: status 2, one line on standard error and no file left behind.
    """
    if not Path("grey.exr").exists():
        file("grey.exr")
    before = set(Path().iterdir())
    output, error = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(error):
        status = main(arguments)
    said = error.getvalue()
    if status == 0:
        return output.getvalue()
    told = [line for line in said.splitlines() if ": warning: " not in line and not re.search(r": \d+ s$", line)]
    assert status == 2 and len(told) == 1 and told[0].startswith("mitsuba-plenoptic: error: "), f"{status}: {said}"
    assert told[0].isprintable(), told
    left = set(Path().iterdir()) - before
    assert not left, f"left {left}"
    raise InputError(told[0])


@cache
def files() -> dict[str, bytes]:
    """Whole files by name, made through the command and the library."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        mp.write_capture("colour.exr", capture(3))
        mp.write_capture("grey.exr", capture())
        command("reconstruct", "grey.exr", "-o", "refocused.exr", "--distance", "240")
        command("views", "grey.exr", "-o", "views.exr", "--count", "2")
        plain = {"Y": np.ones((64, 64), np.float32)}
        OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION}, plain).write("foreign.exr")
        for precision in ("uint8", "uint16", "single"):
            exchange.write_lftoolbox(f"{precision}.mat", light_field(3), precision=precision)
        exchange.write_mosaic("views.png", light_field(), layout="views")
        exchange.write_mosaic("lenses.eslf.png", light_field(3), layout="lenses")
        Path(hdf5(**_version_7())).rename("version7.mat")
        png("dots.png", 2, 2, data=b"\0\0\xff" * 2)
        Path("scene.xml").write_text(SCENE)
        Path("square.ply").write_bytes(PLY)
        Path("grid.yaml").write_bytes(GRID)
        Path("stopped.checkpoint").write_bytes(_stopped()[0])
        return {path.name: path.read_bytes() for path in Path().iterdir()}


def file(name: str) -> str:
    """Put a whole file here."""
    return holding(name, files()[name])


def damaged(name: str, edits: list[tuple[int, int, bytes]]) -> str:
    """Put a file here with some of its bytes replaced: place, number of bytes, and what comes there."""
    data = files()[name]
    for place, count, new in edits:
        place %= max(len(data), 1)
        data = data[:place] + new + data[place + count :]
    return holding(name, data)


def read_as(name: str, content: bytes | None = None, edits: Sequence[tuple[int, int, bytes]] = ()) -> None:
    """Read a file of text by the reader of its name, or as a camera and a scene at the command.

    It holds a whole text, other content, or a text with bytes replaced, as for `damaged`.
    """
    text, reader = TEXTS[name]
    data = text.encode() if content is None else content
    for place, count, new in edits:
        place %= max(len(data), 1)
        data = data[:place] + new + data[place + count :]
    reader(holding(name, data))


def holding(name: str, content: str | bytes) -> str:
    """Put a file here that holds a text."""
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))
    return name


def read(name: str) -> list[Any]:
    """Read a capture, refocus and decode it."""
    capture = mp.read_capture(name)
    return [capture, mp.reconstruct(capture, far(capture.camera, 3)), decode(capture)]


def _channels(name: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    opened = OpenEXR.File(file(name), separate_channels=True)
    return opened.header(), {channel.name: channel.pixels for channel in opened.channels().values()}


def relabelled(name: str, text: str | None = None, **facts: Any) -> str:
    """Put a capture here whose JSON is another text, or has other values or lacks those that are ``...``."""
    header, channels = _channels(name)
    known = {key: value for key, value in (json.loads(header["mitsuba_plenoptic"]) | facts).items() if value is not ...}
    header["mitsuba_plenoptic"] = json.dumps(known, default=repr, skipkeys=True) if text is None else text
    OpenEXR.File(header, channels).write(name)
    return name


def poisoned(name: str, place: tuple[int, int], value: float) -> str:
    """Put a capture here, one of whose pixels is another number."""
    header, channels = _channels(name)
    next(iter(channels.values()))[place] = value
    OpenEXR.File(header, channels).write(name)
    return name


def lying(name: str, attribute: str, kind: str | None, data: bytes | None) -> str:
    """Put an OpenEXR file here, one of whose attributes has another type or value, or is missing if both are None."""
    old = files()[name]
    found = re.search(rb"(?s)(?<=\0)?" + attribute.encode() + rb"\0(\w+)\0(....)", old)
    assert found
    end = found.end() + int.from_bytes(found[2], "little")
    told, value = (kind or found[1].decode()).encode(), old[found.end() : end] if data is None else data
    entry = attribute.encode() + b"\0" + told + b"\0" + len(value).to_bytes(4, "little") + value
    new = old[: found.start()] + (b"" if kind is data is None else entry) + old[end:]
    # The offsets of the four chunks move along with the header's length.
    offsets = np.frombuffer(old, "<i8", 4, _table(old))
    place = _table(old) + len(new) - len(old)
    return holding(name, new[:place] + (offsets + (len(new) - len(old))).tobytes() + new[place + 32 :])


def _table(data: bytes) -> int:
    """Where the table of chunks begins: behind the header."""
    place = 8
    while data[place]:
        place = data.index(b"\0", data.index(b"\0", place) + 1) + 1
        place += 4 + int.from_bytes(data[place : place + 4], "little")
    return place + 1


def misplaced(name: str, place: int, new: bytes) -> str:
    """Put an OpenEXR file here with other bytes in its table of chunks, or in the first chunk behind it."""
    place += _table(files()[name])
    return damaged(name, [(place, len(new), new)])


def channels(*names: str, kind: int = 2, every: int = 1) -> bytes:
    """Pack a list of channels as OpenEXR does."""
    return b"".join(name.encode() + b"\0" + pack("<4i", kind, 0, every, every) for name in names) + b"\0"


def matlab(**variables: Any) -> str:
    """Put a MATLAB file of version 5 here."""
    scipy.io.savemat("light.mat", variables, do_compression=True)
    return "light.mat"


def hdf5(new: dict[str, Any] | None = None, **variables: Any) -> str:
    """Put a MATLAB file of version 7.3 here, HDF5 after a text of 512 bytes, or one with a `new`, empty light field."""
    with h5py.File("light.mat", "w", userblock_size=512) as opened:
        if new:
            opened.create_dataset("LF", dtype=np.uint8, **new)
        for name, value in variables.items():
            opened[name] = value
    with Path("light.mat").open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    return "light.mat"


def _version_7() -> dict[str, Any]:
    numbers = np.transpose((light_field(3).values * 65535).astype(np.uint16))
    grid = {
        f"LensletGridModel/{name}": np.array([[value]]) for name, value in GRID_MODEL.items() if name != "Orientation"
    }
    grid["LensletGridModel/Orientation"] = np.array([[ord(c)] for c in "horz"], dtype=np.uint16)
    return {"LF": numbers, "MaxLum": np.ones((1, 1)), **grid}


def open_views(name: str) -> Any:
    """Open a picture of as many views as the light field has."""
    return exchange.open_light_field(name, views=light_field().sizes["u"])


def png(name: str, columns: int, rows: int, depth: int = 8, colour: int = 0, data: bytes = b"", text: int = 0) -> str:
    """Put a PNG picture here whose header claims a size, with compressed text of so many bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return pack(">I", len(data)) + kind + data + pack(">I", zlib.crc32(kind + data))

    content = chunk(b"IHDR", pack(">IIBBBBB", columns, rows, depth, colour, 0, 0, 0))
    content += chunk(b"zTXt", b"a\0\0" + zlib.compress(b"\0" * text)) if text else b""
    content += chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return holding(name, b"\x89PNG\r\n\x1a\n" + content)


def scene(*changes: tuple[str, str], beside: object = None) -> str:
    """Put the scene here with texts replaced; files that were put here before, `beside`, take the place of its own."""
    text = SCENE
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    for name, content in {**files(), "scene.xml": text}.items():
        if name in ("square.ply", "dots.png", "scene.xml") and not Path(name).exists():
            holding(name, content)
    return "scene.xml"


def element(kind: str, name: str, value: str) -> str:
    """Write a parameter of a plugin."""
    return f"<{kind} name={quoteattr(name)} value={quoteattr(value)}/>"


def sensor(kind: str, name: str, value: str) -> tuple[str, str]:
    """Set a parameter of the sensor."""
    return SENSOR, element(kind, name, value) + (SENSOR if name != "detector_width" else "")


def waves(kind: str, name: str, value: str) -> tuple[str, str]:
    """Propagate light as waves, and set a parameter of that."""
    return 'type="path"/>', f'type="plenoptic_wave">{element(kind, name, value)}</integrator>'


def nested(tag: str, depth: int) -> str:
    """Put elements into each other."""
    return f'<{tag} type="twosided">' * depth + f"</{tag}>" * depth + "<emitter"


def laughs(depth: int) -> str:
    """Write a scene with entities that are ten times as long as the one before."""
    entities = "".join(f'<!ENTITY l{i + 1} "{f"&l{i};" * 10}">' for i in range(depth))
    return f'<!DOCTYPE scene [<!ENTITY l0 "ha">{entities}]>{SCENE.partition("?>")[2]}'.replace(
        "square.ply", f"&l{depth};"
    )


def includes(targets: str) -> None:
    """Put scenes here, each of which includes others; the last is empty."""
    for level in range(12):
        names = targets.format(level + 1).split() if level < 11 else []
        lines = "".join(f'<include filename="{name}.xml"/>' for name in names)
        holding(f"i{level}.xml", f'<scene version="3.0.0">{lines}</scene>')


def growing(depth: int) -> str:
    """Write YAML with lists that hold the one before ten times."""
    return "x0: &x0 [1, 1]\n" + "".join(f"x{i + 1}: &x{i + 1} [{f'*x{i}, ' * 10}]\n" for i in range(depth))


def sweep(*arguments: str) -> str:
    """Run a sweep of the scene."""
    return command("sweep", scene(), "-o", "out.nc", *arguments)


def render(*changes: tuple[str, str], beside: object = None) -> Capture:
    """Render the scene with texts replaced; what only rendering brings to light is refused then."""
    return render_capture(load_scene(scene(*changes, beside=beside)), spp=1)


def wall(camera: PlenopticCamera, distance: float) -> Any:
    """Make a scene with a small shining square before a camera."""
    mi.set_variant("llvm_ad_mono")
    size = min(camera.detector_width * distance / camera.mla_distance / 8, 1e6)
    place = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], 180).scale(size)
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": camera.to_sensor(),
        "wall": {"type": "rectangle", "to_world": place, "light": {"type": "area", "radiance": 1.0}},
    }
    try:
        return mi.load_dict(scene)
    except RuntimeError as error:
        # Mitsuba passes on what a plugin's constructor raises as a text.
        told = str(error).strip().splitlines()[-1]
        if "InputError: " not in told:
            raise
        raise InputError(told.split("InputError: ", 1)[1]) from None


@cache
def _wall() -> Any:
    return wall(CAMERA, 240.0)


def _render_waves(checkpoint: Checkpoint) -> np.ndarray:
    return render_capture(_wall(), model="wave", method="points", spp=4, checkpoint=checkpoint).image


@cache
def _stopped() -> tuple[bytes, np.ndarray]:
    """Return the checkpoint of a capture by waves that is nearly done, and the whole image."""
    # The clock jumps, so that a checkpoint is due at every opportunity.
    with mock.patch("time.monotonic", side_effect=itertools.count(0, 1000).__next__), Checkpoint("wave") as checkpoint:
        image = _render_waves(checkpoint)
        return Path("wave").read_bytes(), image


def resume(name: str) -> np.ndarray:
    """Resume the capture by waves from a checkpoint; all the bits of the whole run must come out."""
    with Checkpoint(name, "resume") as checkpoint:
        image = _render_waves(checkpoint)
    assert np.array_equal(image, _stopped()[1]), "resumed to other bits"
    return image


def lying_checkpoint(**changes: Any) -> str:
    """Put a checkpoint here whose header has other values, or one number of whose arrays is another."""
    with np.load(io.BytesIO(files()["stopped.checkpoint"]), allow_pickle=False) as archive:
        arrays = dict(archive)
    header = json.loads(str(arrays.pop("header")))
    for name, value in changes.items():
        if name in arrays:
            arrays[name].reshape(-1)[arrays[name].size // 2] = value
        else:
            header[name] = value
    with Path("stopped.checkpoint").open("wb") as file:
        np.savez(file, header=json.dumps(header), **arrays)
    return "stopped.checkpoint"
