"""Command lines that break a rule: each must end with status 2 and one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from . import corpus
from .cameras import LENGTHS
from .cases import Case, command
from .values import NOT_FINITE_TEXTS, NOT_NUMBER_TEXTS, NOT_POSITIVE_TEXTS, OUT_OF_RANGE_TEXTS, mutate, pick

NUMBERS = (*NOT_NUMBER_TEXTS, *NOT_FINITE_TEXTS, *NOT_POSITIVE_TEXTS)
LENGTH_TEXTS = (*NUMBERS, *OUT_OF_RANGE_TEXTS)
COUNTS = (*NUMBERS, "1.5", "9" * 30, "9" * 5000, "-99999999999", "1e3", "99999999999")
NOT_FILES = (
    "nosuch.exr",
    "",
    ".",
    "/",
    "/dev/null",
    "\0",
    "x" * 5000,
    "nowhere/raw.exr",
    "\u202e.exr",
    "-",
    "\ud800.exr",
)
NOT_OUTPUTS = ("", ".", "/", "out", "out.jpg", "nowhere/out.exr", "/dev/full", "x" * 5000 + ".exr", "raw.exr/out.exr",
               "\0.exr", "out.EXE", "/proc/out.exr", "folder.exr")  # fmt: skip
SEEDS = (*NOT_NUMBER_TEXTS, "-1", "4294967296", "1.5", "9" * 400)


def command_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a command, one of whose arguments is forbidden."""
    (folder / "folder.exr").mkdir()
    raw = folder / "raw.exr"
    raw.write_bytes(corpus.files()["grey.exr"])
    make = pick(random, (_render, _render, _reconstruct, _reconstruct, _light_field, _light_field, _expose, _convert,
                         _info, _compare, _usage, _damaged))  # fmt: skip
    arguments = [str(argument) for argument in make(random, folder, raw)]

    def run() -> Any:
        before = _names(folder)
        try:
            command(*arguments)
        finally:
            left = _names(folder) - before
            assert not left, f"left {left}"

    told = " ".join(ascii(argument.replace(str(folder), "F"))[1:-1][:60] for argument in arguments)
    return Case(told, run, forbidden=True)


def _names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def _render(random: np.random.Generator, folder: Path, raw: Path) -> list[Any]:
    whole: dict[str, Any] = {"-o": folder / "out.exr", "--spp": 1, "-D": "resolution=256"}
    scene: Any = "white"
    bad: dict[str, Any] = pick(
        random,
        (
            {"-o": _output(random, folder)},
            {"--spp": pick(random, COUNTS)},
            {"--seed": pick(random, SEEDS)},
            {"--model": pick(random, ("magic", "", "RAY", "\x1b[0m"))},
            {"--model": "wave", "--wavelength": pick(random, (*LENGTH_TEXTS, "0.1", "1,2,3", ",", "1e7"))},
            {"--model": "wave", "--radiators-per-lens": pick(random, (*COUNTS, "257"))},
            {"--model": "ray", "--wavelength": "633"},
            {"--variant": pick(random, ("nosuch", "scalar_rgb", "cuda_ad_mono", "llvm_ad_mono "))},
            {"-D": f"{pick(random, LENGTHS)}={pick(random, LENGTH_TEXTS)}"},
            {"-D": f"resolution={pick(random, (*NUMBERS, '1.5', '99999999999', '1048577', '65536'))}"},
            {"-D": f"spp={pick(random, (*NOT_NUMBER_TEXTS, *NOT_POSITIVE_TEXTS[:2], '1.5'))}", "--spp": None},
            {"-D": pick(random, ("", "resolution", "=", "=3", "nosuch=1", "\0=1", "$x=1", "\x1b=1"))},
            {"scene": pick(random, ("nosuch", "", ".", "../scenes/nosuch", "letters.xml", "\0", "x" * 5000, "/dev/zero",
                                    "/dev/null", "\x1b[2J", "raw.exr"))},
        ),
    )  # fmt: skip
    scene = bad.pop("scene", scene)
    if scene == "raw.exr":
        scene = raw
    return ["render", scene, *_options({**whole, **bad})]


def _reconstruct(random: np.random.Generator, folder: Path, raw: Path) -> list[Any]:
    whole: dict[str, Any] = {"-o": folder / "out.exr", "--distance": 240}
    bad = pick(
        random,
        (
            {"-o": _output(random, folder)},
            {"--distance": pick(random, (*LENGTH_TEXTS, "80", "79.9"))},
            {"--method": pick(random, ("magic", "", "RAY"))},
            {"--footprint": pick(random, ("magic", ""))},
            {"--method": "partial", "--interleave": pick(random, (*COUNTS, "AUTO", "\u0663\u0663\u0663", "\u00b2"))},
            {"--oversample": pick(random, (*COUNTS, "100000", "99999999"))},
            {"--method": "coherent", "--wavelength": pick(random, (*LENGTH_TEXTS, "0.5", "1e7"))},
            {"--variant": pick(random, ("nosuch", "scalar_rgb_"))},
            {"capture": _not_file(random, folder)},
        ),
    )
    capture = bad.pop("capture", raw)
    return ["reconstruct", capture, *_options({**whole, **bad})]


def _light_field(random: np.random.Generator, folder: Path, raw: Path) -> list[Any]:
    name = pick(random, ("views", "epi", "stack", "depth"))
    whole: dict[str, Any] = {"-o": folder / "out.exr"}
    if name == "stack":
        whole["--distance"] = 240
    own = {
        "views": ({"--count": pick(random, (*COUNTS, "1000"))},),
        "epi": (
            {"--axis": pick(random, ("diagonal", ""))},
            {"--at": pick(random, (*NOT_NUMBER_TEXTS, *NOT_FINITE_TEXTS))},
            {"--through": pick(random, (*NOT_NUMBER_TEXTS, *NOT_FINITE_TEXTS))},
        ),
        "stack": (
            {"--distance": pick(random, (*NOT_NUMBER_TEXTS, *NOT_POSITIVE_TEXTS, "80", "nan", "1e300"))},
            {"--method": "magic"},
        ),
        "depth": (
            {"--near": pick(random, (*NUMBERS, "80", "1e300"))},
            {"--far": pick(random, (*NOT_NUMBER_TEXTS, *NOT_POSITIVE_TEXTS, "nan", "81"))},
            {"--planes": pick(random, (*COUNTS, "2", "1025"))},
        ),
    }[name]
    shared = (
        {"-o": _output(random, folder)},
        {"source": _not_file(random, folder)},
        {"--view-count": pick(random, (*COUNTS, "3"))},
        {"--white": _not_file(random, folder)},
    )
    bad = pick(random, (*own, *own, *shared))
    source = bad.pop("source", raw)
    return [name, source, *_options({**whole, **bad})]


def _expose(random: np.random.Generator, folder: Path, raw: Path) -> list[Any]:
    positive = (*LENGTH_TEXTS[:-2], "1e300", "1e-300")
    not_negative = (*NOT_NUMBER_TEXTS, *NOT_FINITE_TEXTS, "-1", "1e300")
    bad = pick(
        random,
        (
            {"-o": _output(random, folder)},
            {"--photons": pick(random, positive)},
            {"--quantum-efficiency": pick(random, (*positive, "1.01"))},
            {"--full-well": pick(random, (*positive, "0.5"))},
            {"--dark-electrons": pick(random, not_negative)},
            {"--read-noise": pick(random, not_negative)},
            {"--bits": pick(random, (*COUNTS, "17"))},
            {"--gain": pick(random, positive)},
            {"--black-level": pick(random, (*NOT_NUMBER_TEXTS, "-1", "4095", "1.5", "9" * 5000))},
            {"--seed": pick(random, (*NOT_NUMBER_TEXTS, "-1", "1.5"))},
            {"capture": _not_file(random, folder)},
        ),
    )
    capture = bad.pop("capture", raw)
    return ["expose", capture, *_options({"-o": folder / "out.exr", "--photons": 1000, **bad})]


def _convert(random: np.random.Generator, folder: Path, raw: Path) -> list[Any]:
    bad: dict[str, Any] = pick(
        random,
        (
            {"-o": folder / pick(random, ("out", "out.exr", "out.jpg", "nowhere/out.mat", "folder.exr", ".mat/x.mat"))},
            {"source": _not_file(random, folder)},
            {"--view-count": pick(random, (*COUNTS, "3"))},
            {"--white": _not_file(random, folder)},
        ),
    )
    source = bad.pop("source", raw)
    return ["convert", source, *_options({"-o": folder / "out.mat", **bad})]


def _info(random: np.random.Generator, folder: Path, raw: Path) -> list[Any]:
    wavelength = pick(random, (*LENGTH_TEXTS, "0.5", "1e7"))
    length = f"{pick(random, LENGTHS)}={pick(random, LENGTH_TEXTS)}"
    return pick(
        random,
        (
            ["info", raw, "--wavelength", wavelength],
            ["info", _not_file(random, folder)],
            ["info", "letters", "-D", length],
            ["info", pick(random, ("nosuch", "/dev/zero", "x" * 5000, "\0", "a\nb"))],
        ),
    )


def _compare(random: np.random.Generator, folder: Path, raw: Path) -> list[Any]:
    whole: dict[str, Any] = {"-o": folder / "out", "--distance": 240, "--spp": 1, "-D": "resolution=256"}
    bad = pick(
        random,
        (
            {"--distance": pick(random, NUMBERS)},
            {"--wavelength": pick(random, (*LENGTH_TEXTS, "0.5", "1e7"))},
            {"--radiators-per-lens": pick(random, COUNTS)},
            {"--spp": pick(random, NUMBERS)},
            {"--variant": pick(random, ("nosuch", "llvm_ad_rgb", ""))},
            {"-o": raw},
            {"-D": pick(random, ("resolution", "nosuch=1", "mla_pitch=nan"))},
        ),
    )
    return ["compare", "letters", *_options({**whole, **bad})]


def _usage(random: np.random.Generator, folder: Path, raw: Path) -> list[Any]:
    bad: tuple[list[Any], ...] = (
        ["nosuch"],
        ["render"],
        ["render", "white"],
        ["reconstruct", raw, "-o", folder / "out.exr"],
        ["render", "white", "-o", folder / "out.exr", "--nosuch"],
        ["render", "white", "extra", "-o", folder / "out.exr"],
        ["--nosuch"],
        ["views", "-o"],
        ["\x1b[31m"],
        ["ren der"],
        ["info"],
        ["info", "letters", "--wavelength"],
        ["reproduce", "-o", raw],
        ["reproduce", "-o", folder / "out", "--preset", "magic"],
        ["doctor", "extra"],
        ["expose", raw, "-o", folder / "out.exr"],
    )
    return pick(random, bad)


def _damaged(random: np.random.Generator, folder: Path, raw: Path) -> list[Any]:
    """Make a capture cut short, which no command may take."""
    data = corpus.files()["grey.exr"]
    damaged = folder / "damaged.exr"
    damaged.write_bytes(data[: int(random.integers(len(data) - 1))])
    out = folder / "out.exr"
    return pick(
        random,
        (
            ["reconstruct", damaged, "-o", out, "--distance", 240],
            ["views", damaged, "-o", out],
            ["expose", damaged, "-o", out, "--photons", 100],
            ["info", damaged],
            ["convert", damaged, "-o", folder / "out.mat"],
            ["depth", damaged, "-o", out],
        ),
    )


def _output(random: np.random.Generator, folder: Path) -> Any:
    name = pick(random, NOT_OUTPUTS)
    return name if name.startswith("/") or name in ("", ".") else folder / name


def _not_file(random: np.random.Generator, folder: Path) -> Any:
    if random.random() < 0.2:
        path = folder / "text.exr"
        path.write_bytes(mutate(random, b"this is no image at all" * 20)[0])
        return path
    name = pick(random, NOT_FILES)
    return name if name.startswith("/") or name in ("", ".", "-", "\0") else folder / name


def _options(values: dict[str, Any]) -> list[Any]:
    # With "=", so that a value that begins with a hyphen is a value.
    return [
        f"{name}={value}" if name.startswith("--") else f"{name}{value}"
        for name, value in values.items()
        if value is not None
    ]
