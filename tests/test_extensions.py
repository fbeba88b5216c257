"""Extensions can be deleted: the core works without them, and names one that is missing."""

import ast
import importlib
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import textwrap
import venv
from pathlib import Path

import pytest

import mitsuba_plenoptic
from mitsuba_plenoptic import extension
from mitsuba_plenoptic.extension import Extension, installed

PACKAGE = Path(mitsuba_plenoptic.__file__).parent
FOLDER = PACKAGE / "extensions"
SHIPPED = sorted(path.name for path in FOLDER.iterdir() if (path / "__init__.py").exists())


@pytest.mark.parametrize("name", SHIPPED)
def test_an_init_holds_the_record_only(name):
    text, imported, record = ast.parse((FOLDER / name / "__init__.py").read_text()).body
    assert isinstance(text, ast.Expr) and isinstance(imported, ast.ImportFrom) and imported.module == "extension"
    assert isinstance(record, ast.Assign) and record.targets[0].id == "EXTENSION"


def test_all_that_records_name_is_there():
    for package, record in installed().items():
        for module in [*(module for module, _ in record.plugins.values()), *record.methods.values()]:
            importlib.import_module(f"{package}.{module}")
        for kind in ("names", "parameters", "responses", "presets", "hooks", "generators", "displays", "options"):
            for text in getattr(record, kind).values():
                module, _, name = text.partition(":")
                assert hasattr(importlib.import_module(f"{package}.{module}"), name)
        for name, module in record.commands.items():
            assert hasattr(importlib.import_module(f"{package}.{module}"), name.split()[-1])


def test_the_list_of_what_extensions_add_is_complete():
    """So that each is named where it is not installed; responses are parameters, and displays are of the core."""
    added = {name: set() for name in SHIPPED}
    for package, record in installed().items():
        for kind in {*Extension.__dataclass_fields__} - {"responses", "displays"}:
            names = {name.split()[0] if kind == "commands" else name for name in getattr(record, kind)}
            added[package.rpartition(".")[2]] |= names
    for line in (PACKAGE / "__init__.pyi").read_text().splitlines():
        if found := re.match(r"from \.extensions\.(\w+).* import (\w+) as \2$", line):
            added[found[1]].add(found[2])
    assert {name: {*words} for name, words in extension.SHIPPED.items()} == added


# An editable installation would add the folders that the copy lacks.
_ALONE = "import sys; sys.meta_path = [one for one in sys.meta_path if 'editable' not in repr(one).lower()]\n"


@pytest.fixture
def copy(tmp_path):
    """Return a function that copies the package without some extensions, and runs code there."""

    def run(without, code):
        folder = tmp_path / "copy"
        ignored = shutil.ignore_patterns(*without)
        shutil.copytree(PACKAGE, folder / "mitsuba_plenoptic", ignore=ignored)
        shutil.copytree(PACKAGE.parent / "scenes", folder / "mitsuba_plenoptic" / "scenes")
        return subprocess.run(
            [sys.executable, "-c", _ALONE + textwrap.dedent(code)],
            capture_output=True,
            text=True,
            check=False,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(folder)},
        )

    return run


ALONE = """
    import json, pathlib, numpy as np
    import mitsuba_plenoptic as mp
    from mitsuba_plenoptic.cli import main
    assert pathlib.Path(mp.__file__).parent.parent == pathlib.Path.cwd(), mp.__file__
    assert main(["--help"]) == 0 and main(["render", "--help"]) == 0
"""

CORE = """
    scene = mp.load_scene("letters", parameters={"detector_width": 0.128, "resolution": 64, "letter_scale": 0.015625})
    for model in ("ray", "wave"):
        capture = mp.render_capture(scene, model=model, spp=4)
        assert capture.image.shape == (64, 64) and capture.image.sum() > 0
    for method in mp.refocus.METHODS:
        found = mp.reconstruct(capture, 240, method=method, **({"iterations": 2} if method == "deconvolved" else {}))
        assert np.isfinite(found.image).any()
    assert mp.decode(capture).ndim == 4
    point = mp.CaptureOperator(capture.camera, [(0.0, 0.0, 240.0)], wavelength=633.0)
    assert point.forward([1.0]).sum() > 0
"""

ASKED = {
    "mp.PlenopticCamera(photodiode_response='a.json')": "photodiode_response: extension onchip",
    "mp.PlenopticCamera.from_json(json.dumps({'photodiode_response': {}}))": "photodiode_response: extension onchip",
    "mp.PlenopticCamera.preset('phone_quad')": "phone_quad: extension onchip",
    "mp.calibrate": "calibrate: extension calibrate",
    "__import__('mitsuba_plenoptic.torch')": "torch: extension inverse",
    "open_light_field('a.mat')": "a.mat: .mat: extension raw",
    "mp.render_capture(mp.load_scene(small), spp=1)":
        "plenoptic_wave: mla_pitch = 0.004: small lenses: extension onchip",
    "mp.reconstruct(np.ones((32, 32)), 240, camera=camera, method='deconvolved', wavelength=633)":
        "method = deconvolved: extension deconvolution",
    "mp.read_prescription('triplet.zmx')": "triplet.zmx: .zmx: extension lensdesign",
    "mp.CaptureOperator(camera, [(0, 0, 240)], wavelength=633).field([1])": "field: coherent fields: extension laser",
    "mp.refocus.CoherentRefocus": "refocus.CoherentRefocus: extension inverse",
    "mp.load_scene('speckle')": "speckle.xml, line 42, col 6: plenoptic_laser: extension laser",
}  # fmt: skip
"""What asks for an extension, and what is said of it."""

MISSING = f"""
    from mitsuba_plenoptic.views.light_field_files import open_light_field
    camera = mp.PlenopticCamera(resolution=(32, 32), detector_width=0.064)
    assert "photodiode_response" not in camera.to_dict()
    small = {{"type": "scene", "integrator": {{"type": "plenoptic_wave"}}, "light": {{"type": "constant"}},
             "sensor": camera.replace(mla_pitch=0.004, mla_focal_length=0.008, detector_distance=0.008).to_sensor()}}
    for name in ("triplet.zmx", "photo.lfr"):
        open(name, "wb").close()
    for asked, words in {list(ASKED.items())}:
        try:
            eval(asked)
        except (mp.InputError, AttributeError, ImportError) as error:
            assert str(error).rpartition("/")[2] == f"{{words}} is not installed", error
        else:
            raise SystemExit(asked)
    assert [main(["dual", "raw.exr", "-o", "out.exr"]), main(["info", "photo.lfr"])] == [2, 2]
"""


@pytest.mark.slow
def test_without_extensions_a_missing_one_is_named_in_one_line(copy):
    made = copy(["extensions"], ALONE + MISSING)
    assert made.returncode == 0, made.stderr
    assert " calibrate  " not in made.stdout
    assert "mitsuba-plenoptic: error: dual: extension onchip is not installed" in made.stderr
    assert "photo.lfr: .lfr: extension raw is not installed" in made.stderr


# Those that other extensions need; that no further one is imported is a contract of the linter.
@pytest.mark.slow
@pytest.mark.parametrize("name", ["calibrate", "deconvolution", "inverse", "onchip", "raw"])
def test_the_core_works_without_an_extension(copy, name):
    made = copy([name], ALONE + CORE)
    assert made.returncode == 0, made.stderr


@pytest.fixture(scope="module")
def core(tmp_path_factory):
    """Return a copy of what the tests of the core need, without extensions."""
    folder = tmp_path_factory.mktemp("copy") / "core"
    away = ("extensions", "test_extensions.py", "__pycache__", "build", "dist", "*.egg-info", ".*")
    shutil.copytree(PACKAGE.parent, folder, ignore=shutil.ignore_patterns(*away))
    return folder


@pytest.fixture(scope="module")
def core_python(core, tmp_path_factory):
    """Return the Python of an environment with the installed libraries, but without our editable installation."""
    environment = tmp_path_factory.mktemp("environment")
    venv.create(environment, with_pip=False, symlinks=True)
    paths = {"base": str(environment), "platbase": str(environment)}
    own = Path(sysconfig.get_path("purelib", "venv", paths))
    # An environment may have its libraries from another one.
    libraries = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (own / "core.pth").write_text("\n".join([str(core), *libraries]))
    return environment / "bin" / "python"


@pytest.mark.slow
def test_types_are_right_without_extensions(core):
    made = subprocess.run([sys.executable, "-m", "mypy"], cwd=core, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout


SKIPPED_WITHOUT_EXTENSIONS = 50
"""The most tests of a folder that may be left out for want of an extension; they are listed when it is exceeded."""


# Relations, the site and the tools try, show and measure extensions, too.
@pytest.mark.slow
@pytest.mark.parametrize(
    "folder",
    sorted({path.parent.name for path in Path(__file__).parent.glob("*/test_*.py")} - {"docs", "relations", "tools"}),
)
def test_the_suite_of_the_core_passes_without_extensions(folder, core, core_python):
    if not (core / "tests" / folder).is_dir():
        pytest.skip("of extensions")
    command = [core_python, "-m", "pytest", "-q", "-n", "2", "--dist", "loadfile", "-rs", f"tests/{folder}"]
    made = subprocess.run(command, cwd=core, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stdout
    # A line of the summary has its number of tests in brackets.
    skipped = re.findall(r"^SKIPPED \[(\d+)\] (.*extension \w+ is not installed)", made.stdout, flags=re.MULTILINE)
    assert sum(int(number) for number, _ in skipped) <= SKIPPED_WITHOUT_EXTENSIONS, skipped


def test_a_package_of_others_is_an_extension(tmp_path, python):
    """The page on extensions shows a whole one; here the package is installed by its entry point alone."""
    page = (PACKAGE.parent / "docs" / "reference" / "develop" / "extending.md").read_text()
    files = dict(zip(("dust/__init__.py", "dust/parameter.py", "dust/dusty.py", "dust/dust_command.py"),
                     [part.partition("```")[0] for part in page.split("```py\n")[1:]], strict=False))  # fmt: skip
    for name, text in files.items():
        path = tmp_path / "site" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    info = tmp_path / "site" / "dust-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dust\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[mitsuba_plenoptic.extensions]\ndust = dust\n")
    code = """
    import mitsuba as mi, numpy as np
    import mitsuba_plenoptic as mp
    from mitsuba_plenoptic.cli import main
    camera = mp.PlenopticCamera(dust=0.25, resolution=(64, 64), detector_width=0.128)
    assert mp.PlenopticCamera.from_json(camera.to_json()).dust == 0.25
    scene = {"type": "scene", "light": {"type": "constant"}, "sensor": camera.to_sensor()}
    mi.set_variant("llvm_ad_mono")
    clear, dusty = (
        mp.render_capture(mp.load_scene(scene | {"integrator": integrator}), spp=4).image
        for integrator in ({"type": "path"}, {"type": "plenoptic_dusty", "child": {"type": "path"}})
    )
    np.testing.assert_allclose(dusty, 0.75 * clear, rtol=1e-5)
    assert main(["dust", "0.25"]) == 0
    """
    made = python(code, PYTHONPATH=os.pathsep.join([str(tmp_path / "site"), str(PACKAGE.parent)]))
    assert made.returncode == 0, made.stderr
    assert "75 %" in made.stdout
