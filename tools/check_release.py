"""Build sdist and wheel from a fresh clone, install the wheel into an empty environment, and run the start page there.

    python tools/check_release.py [--keep FOLDER] [--everywhere]

The clone has neither tags nor history. Both distributions are built straight from it, and the wheel a second time from
the sdist; they must hold every file of the repository that belongs there. The environment holds nothing but the wheel
and its dependencies. In a folder outside the clone, on the files that the documentation's start page gives, the
commands of that page are run, then the Python code of the README. With ``--everywhere`` wheel and sdist are installed
into empty environments of every Python that pyproject.toml names and PATH offers, and each refocuses a capture.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "start" / "index.md"
README = ROOT / "README.md"
TRIAL = """
import mitsuba_plenoptic as mp
capture = mp.example("letters-wave")
assert mp.reconstruct(capture, 240, method="coherent").image.max() > 0
"""
"""What a new installation must be able to do."""

CLONE = "."
"""The argument of the start page's ``pip install``."""


def page_files(text: str) -> dict[str, str]:
    """Return the files that a page asks the reader to save: its blocks of code with a caption."""
    blocks = re.findall(r"^```\{code-block\} \w+\n:caption: (\S+)\n\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    return dict(blocks)


def page_commands(text: str) -> list[str]:
    """Return the commands of a page, in their order."""
    blocks = re.findall(r"^```console\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    return [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def page_code(text: str) -> str:
    """Return the Python code of a page, all of its blocks or cells together."""
    blocks = re.findall(r"^```(?:\{code-cell\} )?python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    return "\n".join(blocks)


def clone(folder: Path) -> list[str]:
    """Make a clone without history of the files that git does not ignore, committed or not; return their names."""
    git = ["git", "--git-dir", str(folder / ".git")]
    subprocess.run(["git", "init", "--quiet", str(folder)], check=True)
    subprocess.run([*git, "--work-tree", str(ROOT), "add", "--all"], check=True, cwd=ROOT)
    subprocess.run(["git", "checkout-index", "--all"], check=True, cwd=folder)
    listed = subprocess.run([*git, "ls-files", "-z"], check=True, capture_output=True, text=True)
    return listed.stdout.split("\0")[:-1]


def build(source: Path, folder: Path, *kinds: str) -> list[Path]:
    """Build the distributions ``--sdist`` or ``--wheel`` from a folder, each straight from it."""
    command = [sys.executable, "-m", "build", *kinds, "--outdir", str(folder), str(source)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{done.stdout}\n{' '.join(command)}: exit status {done.returncode}")
    return sorted(folder.iterdir())


def check_files(tracked: list[str], wheel: Path, sdist: Path, second: Path) -> None:
    """Compare the files of a wheel, of an sdist and of the wheel built from that with those of the repository."""
    packed = _contents(wheel)
    places = {re.sub(r"^scenes/", "mitsuba_plenoptic/scenes/", name) for name in tracked}
    expected = {name for name in places if name.startswith("mitsuba_plenoptic/")}
    _require_equal(wheel.name, {name for name in packed if ".dist-info/" not in name}, expected)
    with tarfile.open(sdist) as archive:
        names = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    # Hidden files are for git and for services, and setuptools adds files of its own.
    _require_equal(sdist.name, names & set(tracked), {name for name in tracked if not name.startswith(".")})
    if packed != _contents(second):
        raise SystemExit(f"{wheel.name}: built from the sdist it has other files than built from the clone")


def _contents(wheel: Path) -> dict[str, bytes]:
    """Return the files of a wheel by their names."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _require_equal(name: str, found: set[str], expected: set[str]) -> None:
    """Stop where a distribution lacks files, or has others."""
    if found != expected:
        lists = f"missing {sorted(expected - found)}, not expected {sorted(found - expected)}"
        raise SystemExit(f"{name}: its files are not those of the repository: {lists}")


def run_pages(wheel: Path, folder: Path) -> None:
    """Follow the start page and the README in an empty environment; each command must write the files that it names."""
    text = PAGE.read_text()
    environment = folder / "environment"
    venv.create(environment, with_pip=True, clear=True)
    here = folder / "elsewhere"
    here.mkdir()
    for name, content in page_files(text).items():
        (here / name).write_text(content)
    (here / "readme.py").write_text(page_code(README.read_text()))
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    clean["PATH"] = f"{environment / 'bin'}{os.pathsep}{clean['PATH']}"
    for command in [*page_commands(text), "python readme.py"]:
        words = shlex.split(command)
        if words[:2] == ["pip", "install"]:
            words = ["pip", "install", "--quiet", *(str(wheel) if word == CLONE else word for word in words[2:])]
        print(f"$ {command}", flush=True)
        subprocess.run(words, check=True, cwd=here, env=clean)
        if "-o" in words:
            output = Path(words[words.index("-o") + 1])
            if not list(here.glob(f"{output.stem}*{output.suffix}")):
                raise SystemExit(f"{command}: it wrote no {output}")


def try_everywhere(distributions: list[Path], folder: Path) -> None:
    """Install wheel and sdist with each Python of the classifiers that is on PATH, and refocus a capture."""
    stated = re.findall(r"Programming Language :: Python :: (3\.\d+)", (ROOT / "pyproject.toml").read_text())
    for number in stated:
        program = shutil.which(f"python{number}")
        # Version managers put programs on PATH that only say that their version is not active.
        command = [program or "", "-c", "import venv"]
        if program is None or subprocess.run(command, capture_output=True, check=False).returncode:
            print(f"Python {number}: not on PATH, not tried")
            continue
        for distribution in distributions:
            environment = folder / "trial"
            subprocess.run([program, "-m", "venv", "--clear", str(environment)], check=True)
            python = str(environment / "bin" / "python")
            subprocess.run([python, "-m", "pip", "install", "--quiet", str(distribution)], check=True)
            subprocess.run([python, "-c", TRIAL], check=True, cwd=folder)
            print(f"Python {number}: {distribution.name} works", flush=True)


def main() -> int:
    """Build, and try what was built."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, help="folder for wheel and sdist, if they are to be kept")
    parser.add_argument("--everywhere", action="store_true", help="try every Python that pyproject.toml names")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        tracked = clone(folder / "clone")
        wheel, sdist = build(folder / "clone", folder / "dist", "--sdist", "--wheel")
        shutil.unpack_archive(sdist, folder / "unpacked")
        (second,) = build(next((folder / "unpacked").iterdir()), folder / "second", "--wheel")
        check_files(tracked, wheel, sdist, second)
        run_pages(wheel, folder)
        if arguments.everywhere:
            try_everywhere([wheel, sdist], folder)
        if arguments.keep:
            shutil.copytree(folder / "dist", arguments.keep, dirs_exist_ok=True)
    print(f"{wheel.name} and {sdist.name} are complete; the start page and the README's Python code work")
    return 0


if __name__ == "__main__":
    sys.exit(main())
