"""Two installed versions side by side: whether they compute the same numbers, and how long they take.

Everything goes through the command `mitsuba-plenoptic` and the files that it writes, so that any two versions compare,
however different inside. Each version is an environment or the command itself. The same scenes are captured by both
with the same seeds, and both refocus the old version's captures, so that errors do not mix. The differences of a file
are relative to the old file: their L2 norm to its norm, and the largest of them to its largest value. Times are whole
processes, old and new in turn; their ratios are taken pair by pair, and averaged as logarithms. Processor time varies
less than elapsed time where other work runs beside.

    python tools/compare_versions.py OLD NEW [--full] [-o out.md]
    python tools/compare_versions.py OLD NEW --only wave-capture coherent import [--pairs 11] [--quick]

Ends with status 1 if a file differs by more than the tolerance, and with 2 if a command is missing or fails. Between
versions with other numbers of BLAS threads, the files `wave-auto` may differ in their last bits.
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import OpenEXR
from scipy import stats

COMMAND = "mitsuba-plenoptic"


@dataclass(frozen=True)
class Case:
    """A scene as both versions capture and refocus it."""

    scene: str
    parameters: tuple[str, ...]
    distances: tuple[float, ...]
    oversample: int = 1


# A quarter of the default detector's width, with the letters shrunk to match, so that all three are in view.
SMALL_LETTERS = ("resolution=1024", "detector_width=2.048", "letter_scale=0.25")
TURNED_HEXAGONS = ("mla_lattice=hexagonal", "mla_rotation=0.3")
QUARTER_WIDTH = ("resolution=512", "detector_width=1.024")
SMALL_RAYTRIX = ("resolution=340", "rows=256", "detector_width=1.87")
# Sizes keep a comparison of all values within six minutes on two cores.
CASES = {
    "letters": Case("letters", SMALL_LETTERS, (210, 240)),
    "hexagonal": Case("letters", (*SMALL_LETTERS, *TURNED_HEXAGONS), (210, 240)),
    "keplerian": Case("keplerian", QUARTER_WIDTH, (237, 240), oversample=10),
    "raytrix": Case("raytrix", SMALL_RAYTRIX, (367,), oversample=9),
    "still_life": Case("still_life", QUARTER_WIDTH, (215, 240)),
}
# Up to version 1.0 waves had parabolic main lenses, whatever the camera stated.
CAPTURES = {"ray": "--model ray --spp 4", "wave": "--model wave --spp 4 -D lens_model=parabolic"}
# The first word of a name is the capture that is refocused.
RECONSTRUCTIONS = {
    "ray-lens": "--method ray --footprint lens",
    "ray-point": "--method ray --footprint point",
    "wave-lens": "--method ray --footprint lens",
    "wave-coherent": "--method coherent",
    "wave-partial": "--method partial --interleave 2",
    "wave-auto": "--method partial --interleave auto",
}
# What is timed; `import` by the environment's Python, all else by the command.
TIMES = {
    "wave-capture": "render letters -o out.exr --seed 1 --model wave -D lens_model=parabolic",
    "ray-capture": "render letters -o out.exr --seed 1 --model ray --spp 16",
    "still-life-waves": "render still_life -o out.exr --seed 1 --model wave -D lens_model=parabolic",
    "still-life-rays": "render still_life -o out.exr --seed 1 --model ray --spp 16",
    "coherent": "reconstruct wave.exr -o out.exr --method coherent --distance 210",
    "partial": "reconstruct wave.exr -o out.exr --method partial --interleave 2 --distance 210",
    "import": "-c 'import mitsuba_plenoptic'",
    "help": "--help",
}


class CommandError(Exception):
    """A version lacks its command, or the command failed or left nothing readable."""


@dataclass(frozen=True)
class Version:
    """One of the two installations."""

    label: str
    command: Path

    @classmethod
    def find(cls, label: str, path: Path) -> Version:
        """Return the version in an environment's folder, or of the command itself."""
        # Absolute, since commands run in other folders.
        command = (path / "bin" / COMMAND if path.is_dir() else path).absolute()
        if not command.is_file():
            raise CommandError(f"{label}: {path}: there is no {COMMAND}")
        return cls(label, command)

    def run(self, arguments: str, folder: Path, python: bool = False) -> tuple[float, float, str]:
        """Run the command, or its environment's Python; return elapsed and processor seconds and what it printed."""
        # A link to the command may lie outside its environment; the Python beside it is itself a link, which stays.
        program = self.command.resolve().with_name("python") if python else self.command
        # With PYTHONPATH both versions could import the same package.
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        try:
            done = subprocess.run(
                [program, *shlex.split(arguments)], cwd=folder, env=environment,
                stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace",
            )  # fmt: skip
        except OSError as error:
            raise CommandError(f"{self.label}: {program}: {error.strerror}") from None
        seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        processor = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
        shown = f"{self.label}: {program.name} {arguments}"
        if done.returncode:
            reason = (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[-1]
            raise CommandError(f"{shown}: {reason}")
        print(f"{seconds:6.2f} s, processor {processor:6.2f} s  {shown}", file=sys.stderr, flush=True)
        return seconds, processor, done.stdout.strip()


@dataclass(frozen=True)
class Difference:
    """How far the numbers of a new file are from those of the old file."""

    l2: float
    largest: float
    same_bits: bool = False

    def verdict(self, tolerance: float) -> str:
        """Tell whether both measures are within a tolerance; NaN is not."""
        if self.same_bits:
            return "same bits"
        return f"<= {scientific(tolerance)}" if self.l2 <= tolerance and self.largest <= tolerance else "differs"


def scientific(number: float) -> str:
    """Return a number's text, such as 1e-5."""
    return np.format_float_scientific(number, precision=1, trim="-", exp_digits=1) if number else "0"


def channels(path: Path) -> dict[tuple[int, str], np.ndarray]:
    """Read the numbers of a file's parts and channels; not its header, which names versions."""
    try:
        parts = OpenEXR.File(str(path), separate_channels=True).parts
    except RuntimeError as error:
        raise CommandError(str(error)) from None
    return {(i, name): channel.pixels for i, part in enumerate(parts) for name, channel in part.channels.items()}


def difference(old: Path, new: Path) -> Difference:
    """Compare two files; one that is missing, or of other channels, types or sizes, differs without bound."""
    a, b = (channels(path) if path.is_file() else {} for path in (old, new))
    if {key: (x.dtype, x.shape) for key, x in a.items()} != {key: (x.dtype, x.shape) for key, x in b.items()}:
        return Difference(math.inf, math.inf)
    reference = np.concatenate([pixels.ravel() for pixels in a.values()], dtype=np.float64)
    error = np.concatenate([b[key].ravel() for key in a], dtype=np.float64) - reference

    def relative(part: float, whole: float) -> float:
        return 0.0 if part == 0 else math.inf if whole == 0 else part / whole

    return Difference(
        relative(float(np.linalg.norm(error)), float(np.linalg.norm(reference))),
        relative(float(np.abs(error).max()), float(np.abs(reference).max())),
        # Bits, not values: NaN equals itself, and 0 is not -0.
        all(a[key].tobytes() == b[key].tobytes() for key in a),
    )


def compare_values(case: Case, old: Version, new: Version, work: Path) -> Iterator[tuple[str, Difference]]:
    """Capture and refocus a scene by both versions; yield the name and the difference of each file."""
    parameters = options_of("-D", case.parameters)
    commands = {name: f"render {case.scene} -o {name}.exr {how} --seed 1{parameters}" for name, how in CAPTURES.items()}
    for name, how in RECONSTRUCTIONS.items():
        source = name.partition("-")[0]
        capture, distances = f"../../old/{source}/{source}.exr", options_of("--distance", case.distances)
        commands[name] = f"reconstruct {capture} -o {name}.exr {how} --oversample {case.oversample}{distances}"
    for name, command in commands.items():
        # Each step has a folder of its own, since the version chooses its files' names where it writes several.
        folders = {version: work / version.label / name for version in (old, new)}
        for version, folder in folders.items():
            folder.mkdir(parents=True)
            version.run(command, folder)
        files = sorted({path.name for folder in folders.values() for path in folder.glob("*.exr")})
        if not files:
            raise CommandError(f"{COMMAND} {command}: neither version wrote an EXR file")
        for file in files:
            yield file, difference(folders[old] / file, folders[new] / file)


def compare_times(name: str, old: Version, new: Version, pairs: int, small: str, work: Path) -> list[str]:
    """Time one of `TIMES` by both versions in turn; return its row's cells, elapsed times first."""
    if "wave.exr" in TIMES[name] and not (work / "wave.exr").exists():
        old.run(TIMES["wave-capture"].replace("out.exr", "wave.exr") + small, work)
    command = TIMES[name] + (small if "letters" in TIMES[name] else "")

    def seconds(version: Version) -> tuple[float, float]:
        return version.run(command, work, python=name == "import")[:2]

    # The first pair does not count: it fills the caches of files and of compiled kernels.
    times = np.array([[seconds(old), seconds(new)] for _ in range(pairs + 1)])[1:]
    logs = np.log(times[:, 1] / times[:, 0])
    half = stats.t.ppf(0.975, pairs - 1) * logs.std(axis=0, ddof=1) / math.sqrt(pairs)
    low, middle, high = np.exp(logs.mean(axis=0) + np.multiply.outer([-1, 0, 1], half))
    ratios = (cell for k in range(2) for cell in (f"{middle[k]:.3f}", f"{low[k]:.3f} to {high[k]:.3f}"))
    return [name, *(f"{median:.2f} s" for median in np.median(times[..., 0], axis=0)), *ratios]


def options_of(flag: str, values: tuple[object, ...]) -> str:
    """Return an option, given once for each value, as what follows in a command."""
    return "".join(f" {flag} {value}" for value in values)


def compare(arguments: argparse.Namespace, work: Path) -> int:
    """Write the tables row by row, so that a run that is stopped keeps what it found; return the exit status."""

    def write(*cells: str) -> None:
        line = f"| {' | '.join(cells)} |" if cells else ""
        print(line, flush=True)
        if arguments.output:
            with arguments.output.open("a", encoding="utf-8") as file:
                file.write(line + "\n")

    def begin(*columns: str) -> None:
        write()
        write(*columns)
        write(*("---" for _ in columns))

    old, new = Version.find("old", arguments.old), Version.find("new", arguments.new)
    begin("", "command", "version")
    for version in (old, new):
        write(version.label, str(version.command), version.run("--version", work)[-1])

    chosen = arguments.only or [*CASES, *(TIMES if arguments.times else ())]
    status = 0
    if cases := [name for name in CASES if name in chosen]:
        begin("scene", "file", "relative L2", "largest", "verdict")
    for name in cases:
        case = CASES[name]
        if arguments.full:
            case = replace(case, parameters=tuple(text for text in case.parameters if text not in SMALL_LETTERS))
        for file, found in compare_values(case, old, new, work / name):
            verdict = found.verdict(arguments.tolerance)
            write(name, file, scientific(found.l2), scientific(found.largest), verdict)
            status |= verdict == "differs"

    if times := [name for name in TIMES if name in chosen]:
        begin("time", "old, median", "new, median", "new / old", "95 % interval", "processor time", "95 % interval")
    small = options_of("-D", SMALL_LETTERS) if arguments.quick else ""
    for name in times:
        write(*compare_times(name, old, new, arguments.pairs, small, work))
    return status


def main() -> int:
    """Compare, or tell in one line why not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path, help="environment or command; the reference")
    parser.add_argument("new", type=Path, help="environment or command")
    parser.add_argument("-o", "--output", type=Path, help="Markdown file to write, too")
    names = [*CASES, *TIMES]
    parser.add_argument("--only", nargs="+", choices=names, metavar="NAME", help=f"just these of {', '.join(names)}")
    parser.add_argument("--full", action="store_true", help="values of the letters at 4096 x 4096")
    parser.add_argument("--tolerance", type=float, default=1e-5, help="relative difference allowed; default: 1e-5")
    parser.add_argument("--times", action="store_true", help="compare times too")
    parser.add_argument("--pairs", type=int, default=11, help="runs of each version that count; default: 11")
    parser.add_argument("--quick", action="store_true", help="times at 1024 x 1024 instead of 4096 x 4096")
    arguments = parser.parse_args()
    if arguments.pairs < 2:
        parser.error("argument --pairs: an interval needs at least 2")
    if arguments.output:
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text("")
    try:
        with tempfile.TemporaryDirectory() as work:
            return compare(arguments, Path(work))
    except CommandError as error:
        print(f"compare_versions: error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
