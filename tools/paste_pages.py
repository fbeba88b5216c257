"""Paste the Python and console blocks of the documentation into a plain install: ``python tools/paste_pages.py``.

A page's blocks run in order, each page by itself in an empty folder with the files that it asks to save. A block that
needs an extra says so in its first line, as ``# pip install 'mitsuba-plenoptic[sweep]'`` or ``# pip install pylops``,
and is left out without the extra, as are blocks that need its names. Wrong is what lacks a name, a module, a command or
an option. What lacks only what readers bring, or takes too long, is listed.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import venv
from importlib.util import find_spec
from pathlib import Path

from check_release import page_files

ROOT = Path(__file__).resolve().parent.parent
BLOCK = re.compile(r"^```(?:\{code-(?:block|cell)\} )?(python|console)\n(.*?)^```", flags=re.MULTILINE | re.DOTALL)
NEEDS = re.compile(r".*pip install (?:'[\w-]+\[([\w,]+)\]'|([\w-]+)$)", flags=re.MULTILINE)
WRONG = re.compile(
    r"ModuleNotFoundError|ImportError|NameError|TypeError|AttributeError: module|[Nn]o such (?:option|command)"
    r"|command not found|pip install "
)
EXTRAS = {
    "matlab": "h5py", "calibration": "cv2", "sweep": "h5netcdf", "dataset": "h5py", "particles": "miepython",
    "torch": "torch", "jax": "jax", "lenses": "optiland", "ao": "hcipy", "distributed": "distributed",
}  # fmt: skip
"""A module of each extra, by which it is known to be installed."""


def blocks(text: str) -> list[tuple[str, str]]:
    """Return the language and the content of a page's blocks in their order, without MyST's options."""
    return [(kind, re.sub(r"^(?::\w+:.*\n)+\n*", "", body)) for kind, body in BLOCK.findall(text)]


def lacks(body: str) -> bool:
    """Return whether a block states an extra, or a package, that is not installed."""
    stated = NEEDS.match(body)
    if stated is None:
        return False
    modules = [EXTRAS[extra] for extra in stated[1].split(",")] if stated[1] else [stated[2]]
    return not all(find_spec(module) for module in modules)


def paste(page: Path, limit: int) -> None:
    """Run a page's blocks in the working folder, and print what became of each as a line of JSON."""
    text = page.read_text()
    for name, content in page_files(text).items():
        Path(name).write_text(content)
    names, left_out = {"__name__": "__main__"}, ""
    # Which ends a block with KeyboardInterrupt.
    signal.signal(signal.SIGALRM, signal.default_int_handler)
    for number, (kind, body) in enumerate(blocks(text), 1):
        told = "left out: an extra" if lacks(body) else "ok"
        left_out += body * (told != "ok")
        if told == "ok":
            signal.alarm(limit)
            try:
                if kind == "python":
                    exec(compile(body, f"{page.name}, block {number}", "exec"), names)
                for line in body.splitlines() if kind == "console" else ():
                    if line.startswith("$ ") and "pip install" not in line:
                        done = subprocess.run(["bash", "-c", line[2:]], capture_output=True, text=True, check=False)
                        if done.returncode:
                            raise RuntimeError(f"{line}: {done.stderr.strip()[-300:]}")
            except BaseException as error:
                missing = isinstance(error, NameError) and re.search(rf"\b{error.name}\b", left_out)
                told = "left out: an extra" if missing else f"{type(error).__name__}: {error}"
            finally:
                signal.alarm(0)
        print("\n" + json.dumps([number, kind, told]), flush=True)


def main() -> int:
    """Install the package without extras, and paste the pages."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pages", nargs="*", type=Path, help="pages; all by default")
    parser.add_argument("--python", type=Path, help="an environment's Python; a plain one is made by default")
    parser.add_argument("--limit", type=int, default=60, help="seconds of a block at most")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.inside:
        paste(arguments.pages[0], arguments.limit)
        return 0
    pages = arguments.pages or [
        page for shelf in ("start", "guides") for page in sorted((ROOT / "docs" / shelf).glob("*.md"))
    ]
    wrong = 0
    with tempfile.TemporaryDirectory() as temporary:
        python = arguments.python and arguments.python.absolute()
        if python is None:
            venv.create(f"{temporary}/plain", with_pip=True)
            python = Path(temporary, "plain", "bin", "python")
            subprocess.run([python, "-m", "pip", "install", "--quiet", str(ROOT)], check=True)
        paths = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
        for page in map(Path.absolute, pages):
            with tempfile.TemporaryDirectory() as folder:
                command = [python, __file__, str(page), "--inside", "--limit", str(arguments.limit)]
                run = subprocess.run(
                    command, cwd=folder, env={**os.environ, "PATH": paths}, capture_output=True, text=True, check=False
                )
            lines = [json.loads(line) for line in run.stdout.splitlines() if re.match(r'\[\d+, "(?:py|co)', line)]
            for number, kind, told in lines if run.returncode == 0 else [*lines, [0, "page", run.stderr[-300:]]]:
                fault = bool(WRONG.search(told)) or kind == "page"
                wrong += fault
                if told != "ok":
                    print(f"{page.name}, {kind} block {number}: {'WRONG: ' * fault}{told.strip()}", flush=True)
    print(f"{len(pages)} pages, {wrong} blocks wrong")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
