"""Scene files: damaged XML, forbidden parameters, and what strangers might try."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import load_scene, render_capture

from . import corpus
from .cameras import LENGTHS
from .cases import Case
from .values import NOT_FINITE_TEXTS, NOT_NUMBER_TEXTS, NOT_POSITIVE_TEXTS, OUT_OF_RANGE_TEXTS, mutate, pick

BAD_TEXTS = (*NOT_NUMBER_TEXTS, *NOT_FINITE_TEXTS, *NOT_POSITIVE_TEXTS, *OUT_OF_RANGE_TEXTS)


def _dots() -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", 2, 2, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", head)
        + chunk(b"IDAT", zlib.compress(b"\0\0\xff" * 2))
        + chunk(b"IEND", b"")
    )


def _write(folder: Path, scene: str | bytes) -> Path:
    path = folder / "scene.xml"
    path.write_bytes(scene if isinstance(scene, bytes) else scene.encode("utf-8", "surrogatepass"))
    (folder / "square.ply").write_bytes(corpus.PLY)
    (folder / "dots.png").write_bytes(_dots())
    return path


def _render(path: Path, **options: Any) -> Any:
    scene = load_scene(path, **options)
    return render_capture(scene, spp=1)


def bytes_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a scene, or what it names, with damaged bytes; what still loads must render."""
    path = _write(folder, corpus.SCENE)
    name, whole = pick(
        random, (("scene.xml", corpus.SCENE.encode()),) * 3 + (("square.ply", corpus.PLY), ("dots.png", _dots()))
    )
    data, what = mutate(random, whole)
    (folder / name).write_bytes(data)
    render = random.random() < 0.2
    return Case(f"{name}: {what}", lambda: _render(path) if render else [] if load_scene(path) else None)


def value_case(random: np.random.Generator, folder: Path) -> Case:
    """Make one parameter of the sensor, the film or the integrator that the documentation forbids."""
    way = random.random()
    name, kind = pick(random, LENGTHS), "float"
    text = pick(random, BAD_TEXTS)
    scene = corpus.SCENE
    if way < 0.5:
        if random.random() < 0.3:
            kind = pick(random, ("string", "boolean", "vector", "rgb", "transform"))
            text = {"boolean": "true", "vector": "1, 2, 3", "rgb": "1, 2, 3"}.get(kind, text)
        new = f'<{kind} name="{name}" value="{_quoted(text)}"/>'
        if kind == "transform":
            new = f'<transform name="{name}"><scale value="2"/></transform>'
        scene = _in_sensor(_without(scene, name), new)
    elif way < 0.6:
        bad = (
            '<float name="focus_distance" value="80"/>',
            '<float name="focus_distance" value="-3"/>',
            '<float name="mla_distance" value="120"/><float name="focus_distance" value="240"/>',
            '<string name="lens_model" value="thick"/>',
            '<integer name="lens_model" value="3"/>',
            '<float name="focal_lenght" value="80"/>',
            '<float name="near_clip" value="1"/>',
            '<transform name="to_world"><scale value="2"/></transform>',
            '<transform name="to_world"><scale x="0" y="0" z="0"/></transform>',
            '<transform name="to_world"><matrix value="nan 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform>',
            '<transform name="to_world"><translate x="nan"/></transform>',
            '<transform name="to_world"><translate x="inf"/></transform>',
            '<float name="shutter_open" value="2"/><float name="shutter_close" value="1"/>',
        )
        new = pick(random, bad)
        scene, name, text = _in_sensor(scene, new), "sensor", new
    elif way < 0.8:
        name = pick(random, ("wavelength", "radiators_per_lens", "passes", "method", "occlusion", "accuracy"))
        texts = {
            "method": ("magic", "", "PATCH"),
            "occlusion": ("maybe", "2", ""),
            "wavelength": (*BAD_TEXTS, "1,2,3", "1,2", ",", "0.5", "1e7"),
            "accuracy": ("wide", "nan", "inf", "-0.1", "1", "2"),
        }
        text = pick(
            random, texts.get(name, (*BAD_TEXTS, "2.5", "99999999999999999999", "257" if "rad" in name else "0"))
        )
        kind = {"method": "string", "occlusion": pick(random, ("boolean", "string")), "wavelength": "string"}.get(
            name, pick(random, ("float", "integer", "string"))
        )
        new = f'<integrator type="plenoptic_wave"><{kind} name="{name}" value="{_quoted(text)}"/></integrator>'
        scene = scene.replace(_between(scene, "<integrator", "</integrator>"), new)
        if name == "accuracy" and kind == "integer" and text == "-0.1":
            text = "-1"
    else:
        film = {
            "width": ("0", "-1", "1.5", "wide", "2147483648", "99999999999", "1000000000", "2097152"),
            "height": ("0", "-1", "1.5", "wide", "2147483648", "99999999999", "1000000000", "2097152"),
            "crop_offset_x": ("-1", "17", "99999", "2147483647"),
            "crop_width": ("0", "-1", "17", "99999"),
        }
        name = pick(random, sorted(film))
        text = pick(random, film[name])
        size = '<integer name="crop_width" value="16"/>' if name == "crop_offset_x" else ""
        scene = _without(scene, name).replace(
            '<film type="hdrfilm">', f'<film type="hdrfilm"><integer name="{name}" value="{text}"/>{size}'
        )
    path = _write(folder, scene)
    # What only rendering brings to light is refused then, at the latest.
    return Case(f"{name} ({kind}) = {ascii(text)[:80]}", lambda: _render(path), forbidden=True)


def hostile_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a scene that does what no scene may, or is no scene."""
    what, scene = pick(random, HOSTILE)
    if callable(scene):
        scene = scene(random, folder)
    path = _write(folder, scene)
    if what == "a mesh that claims":
        count = pick(random, ("4000000000", "99999999999999999999", "-5", "1e9", "2147483647"))
        (folder / "square.ply").write_bytes(corpus.PLY.replace(b"vertex 3", f"vertex {count}".encode()))
    elif what == "a picture that claims":
        size = struct.pack(">II", int(pick(random, (10**6, 2**31 - 1))), int(pick(random, (10**6, 2**31 - 1))))
        (folder / "dots.png").write_bytes(_dots().replace(struct.pack(">II", 2, 2), size))
    elif what == "native code":
        (folder / "plugins").mkdir()
        (folder / "plugins" / pick(random, ("evil.so", "path.so", "evil.dylib", "x.so.1"))).write_bytes(b"\x7fELF")
    elif what == "a pipe":
        os.mkfifo(folder / "pipe")
    return Case(what, lambda: _render(path), forbidden=True)


def _deep(random: np.random.Generator, folder: Path) -> str:
    depth = int(pick(random, (65, 100, 1000, 100_000)))
    tag = pick(random, ("bsdf", "shape", "x", "integrator"))
    return corpus.SCENE.replace("<emitter", f'<{tag} type="twosided">' * depth + f"</{tag}>" * depth + "<emitter", 1)


def _laughs(random: np.random.Generator, folder: Path) -> str:
    entities = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 20))
    return f'<!DOCTYPE scene [<!ENTITY l0 "ha">{entities}]>' + corpus.SCENE.partition("?>")[2].replace("$mesh", "&l19;")


def _includes(random: np.random.Generator, folder: Path) -> str:
    way = pick(random, ("itself", "tree", "chain"))
    count = 12
    for level in range(count):
        target = {"itself": "scene.xml", "tree": f"i{level + 1}.xml", "chain": f"i{level + 1}.xml"}[way]
        line = f'<include filename="{target}"/>' * (2 if way == "tree" else 1)
        (folder / f"i{level}.xml").write_text(f'<scene version="3.0.0">{line if level < count - 1 else ""}</scene>')
    return corpus.SCENE.replace("<emitter", '<include filename="i0.xml"/><emitter', 1)


def _type(random: np.random.Generator, folder: Path) -> str:
    bad = (
        "../../evil",
        "/tmp/evil",
        "nosuch",
        "",
        "a b",
        "..",
        "plugins/evil",
        "\\\\server\\share",
        "perspective\u202e",
    )
    name = pick(random, bad)
    return pick(
        random,
        (
            corpus.SCENE.replace('type="constant"', f'type="{name}"'),
            corpus.SCENE.replace('name="kind" value="path"', f'name="kind" value="{name}"'),
            corpus.SCENE.replace("<emitter", f'<alias id="x" as="{name}"/><emitter', 1),
        ),
    )


def _file(random: np.random.Generator, folder: Path) -> str:
    name = pick(random, ("/dev/zero", "/dev/stdin", "/dev/random", "/dev/full", "/nowhere/mesh.ply", "/proc/self/mem",
                         "/", "", "square.ply/x", "x" * 5000, "/dev/tty", "scene.xml"))  # fmt: skip
    return corpus.SCENE.replace('value="square.ply"', f'value="{name}"')


HOSTILE: tuple[tuple[str, Any], ...] = (
    ("nested deep", _deep),
    ("entities that grow", _laughs),
    ("an external entity", '<!DOCTYPE scene [<!ENTITY x SYSTEM "file:///etc/passwd">]><scene>&x;</scene>'),
    ("includes without end", _includes),
    ("a type", _type),
    ("a type", _type),
    ("a file", _file),
    ("a file", _file),
    ("a pipe", corpus.SCENE.replace("square.ply", "pipe")),
    ("a mesh that claims", corpus.SCENE),
    ("a picture that claims", corpus.SCENE),
    ("native code", corpus.SCENE),
    ("no scene", "<html></html>"),
    ("nothing", ""),
    ("no XML", "scene"),
    ("UTF-16", corpus.SCENE.encode("utf-16")),
    ("UTF-32", corpus.SCENE.encode("utf-32")),
    ("not UTF-8", corpus.SCENE.encode() + b"\xff\xfe"),
    ("EBCDIC", corpus.SCENE.replace("utf-8", "cp037").encode()),
    ("a NUL", corpus.SCENE.replace("$mesh", "a\0b")),
    ("two roots", corpus.SCENE + '<scene version="3.0.0"/>'),
    ("no sensor", '<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/></scene>'),
    ("another sensor", corpus.SCENE.replace('type="plenoptic"', 'type="perspective"')),
    ("no version", corpus.SCENE.replace(' version="3.0.0"', "")),
    ("a wrong version", corpus.SCENE.replace("3.0.0", "x.y")),
    ("a light tracer", corpus.SCENE.replace('value="path"', 'value="ptracer"')),
    ("two sensors nested", corpus.SCENE.replace("<sampler", '<sensor type="plenoptic"/><sampler')),
    ("an unknown reference", corpus.SCENE.replace("<emitter", '<ref id="nowhere"/><emitter', 1)),
    ("a parameter without value", corpus.SCENE.replace('"$resolution"', '"$nosuch"')),
    ("many channels", corpus.SCENE.replace('type="$kind"', 'type="aov"').replace(
        '<integer name="max_depth" value="2"/>', '<string name="aovs" value="d:depth"/>')),
    ("a gaussian by waves", corpus.SCENE.replace('type="$kind"', 'type="plenoptic_wave"').replace(
        '<integer name="max_depth" value="2"/>', "").replace('"box"', '"gaussian"')),
    ("radiance NaN", corpus.SCENE.replace('<emitter type="constant"/>',
        '<emitter type="constant"><spectrum name="radiance" value="nan"/></emitter>')),
    ("radiance infinite", corpus.SCENE.replace('<emitter type="constant"/>',
        '<emitter type="constant"><spectrum name="radiance" value="inf"/></emitter>')),
)  # fmt: skip


def _in_sensor(scene: str, new: str) -> str:
    return scene.replace('<sensor type="plenoptic">', f'<sensor type="plenoptic">{new}')


def _without(scene: str, name: str) -> str:
    return "\n".join(line for line in scene.splitlines() if f'name="{name}"' not in line)


def _between(text: str, start: str, end: str) -> str:
    first = text.index(start)
    return text[first : text.index(end) + len(end)]


def _quoted(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
