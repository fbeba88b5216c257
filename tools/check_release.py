"""Build wheel and sdist, and try the wheel as a new reader does: ``python tools/check_release.py [--keep FOLDER]``.

The wheel is made from the sdist, so that both are complete. It is installed into a fresh environment, and there, in an
empty folder, the commands of the documentation's start page run, read from the page itself, on the files that it tells
to save.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "start.md"


def page_files(text: str) -> dict[str, str]:
    """Return the files that a page tells to save: its blocks of code with a caption."""
    blocks = re.findall(r"^```\{code-block\} \w+\n:caption: (\S+)\n\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    return dict(blocks)


def page_commands(text: str) -> list[str]:
    """Return the commands of a page, in their order."""
    blocks = re.findall(r"^```console\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    return [line[2:] for block in blocks for line in block.splitlines() if line.startswith("$ ")]


def build(folder: Path) -> Path:
    """Build sdist and wheel into a folder; return the wheel."""
    subprocess.run([sys.executable, "-m", "build", "--outdir", str(folder), str(ROOT)], check=True)
    (wheel,) = folder.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    for part, kinds in (("scenes", ("*.xml", "*.png", "*.hdr")), ("scenes/meshes", ("*.ply", "*.xml"))):
        for path in (path for kind in kinds for path in (ROOT / part).glob(kind)):
            if f"mitsuba_plenoptic/{part}/{path.name}" not in names:
                raise SystemExit(f"{wheel.name}: {part}/{path.name} is missing")
    return wheel


def run_page(wheel: Path, folder: Path) -> None:
    """Do in a fresh environment what the start page says; each command must write the files that it names."""
    text = PAGE.read_text()
    environment = folder / "environment"
    venv.create(environment, with_pip=True, clear=True)
    here = folder / "empty"
    here.mkdir()
    for name, content in page_files(text).items():
        (here / name).write_text(content)
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    clean["PATH"] = f"{environment / 'bin'}{os.pathsep}{clean['PATH']}"
    for command in page_commands(text):
        words = shlex.split(command)
        if words[:2] == ["pip", "install"]:
            words = [
                "python",
                "-m",
                "pip",
                "install",
                "--quiet",
                *(str(wheel) if w == "mitsuba-plenoptic" else w for w in words[2:]),
            ]
        print(f"$ {command}", flush=True)
        subprocess.run(words, check=True, cwd=here, env=clean)
        if "-o" in words:
            output = Path(words[words.index("-o") + 1])
            if not list(here.glob(f"{output.stem}*{output.suffix}")):
                raise SystemExit(f"{command}: it wrote no {output}")


def main() -> int:
    """Build, and try what was built."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keep", type=Path, help="folder for wheel and sdist, if they are to be kept")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        wheel = build(folder / "dist")
        run_page(wheel, folder)
        if arguments.keep:
            shutil.copytree(folder / "dist", arguments.keep, dirs_exist_ok=True)
    print("wheel and sdist are complete, and the start page works")
    return 0


if __name__ == "__main__":
    sys.exit(main())
