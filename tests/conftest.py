"""Shared scenes and cameras for the tests."""

import gc
import os
import shutil
import subprocess
import sys
import textwrap
import warnings
from pathlib import Path

# Glasses by name need Optiland, an extra of 800 MB: where it is not installed, what was recorded of it stands in.
sys.path.append(str(Path(__file__).parent / "optiland_records" / "stand_in"))

# Two test processes share the cores: pools of Dr.Jit and of linear algebra would start as many threads in each, and the
# latter wait for one another by counting. Pages of 2 MB, which NumPy asks for, are filled with zeros each time.
os.environ.setdefault("DRJIT_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")

import pytest

import mitsuba_plenoptic  # chooses LLVM before Dr.Jit loads

import mitsuba as mi  # isort: skip
import numpy as np  # isort: skip
from mitsuba_plenoptic import Capture, PlenopticCamera, decode, read_capture, write_capture  # isort: skip
from mitsuba_plenoptic.extension import installed  # isort: skip
from mitsuba_plenoptic.views import white_image  # isort: skip
import cases  # isort: skip


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Look for no garbage while modules are imported, nor later among what they hold, which takes seconds."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error):
    """End the run when a test process dies: others would go on for minutes."""
    if error:
        pytest.exit(f"test process {node.gateway.id} died: {error}", returncode=3)


def pytest_runtest_setup(item):
    """Skip a test of the core that needs an extension where this one is not installed."""
    for marker in item.iter_markers("needs_extension"):
        for name in marker.args:
            if f"mitsuba_plenoptic.extensions.{name}" not in installed():
                pytest.skip(f"extension {name} is not installed")


@pytest.fixture(autouse=True)
def mono_variant():
    """Give every test the same variant, whatever the one before it set."""
    mi.set_variant("llvm_ad_mono")


@pytest.fixture(autouse=True)
def guarded_physics():
    """Fail where a guard of the physics warns, unless the test says that it should."""
    warnings.simplefilter("error", mitsuba_plenoptic.PhysicsWarning, append=True)


@pytest.fixture(autouse=True)
def no_progress_lines(monkeypatch):
    """Keep the plain lines of progress, which come with time, out of what commands print in tests."""
    monkeypatch.setattr("mitsuba_plenoptic.runtime.progress.FIRST_LINE", float(2**20))


@pytest.fixture
def coarse_figures(monkeypatch):
    """Draw figures with a quarter of the dots to the inch, which is most of the time that they take."""
    from mitsuba_plenoptic.report import plots

    monkeypatch.setattr(plots, "DPI", plots.DPI // 4)
    monkeypatch.setattr(plots, "PRINT_DPI", plots.PRINT_DPI // 4)


@pytest.fixture
def camera_dict():
    """Describe a small plenoptic sensor: 16 x 16 lenses of the paper's camera."""

    def make(resolution=512, detector_width=1.024, film=None, **parameters):
        return {
            "type": "plenoptic",
            "detector_width": detector_width,
            "film": cases.film(resolution, resolution) | (film or {}),
            "sampler": {"type": "independent", "sample_count": 16},
            **parameters,
        }

    return make


@pytest.fixture
def python():
    """Run code in a fresh process."""

    def run(code, *arguments, **environment):
        return subprocess.run(
            [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)],
            capture_output=True,
            text=True,
            check=False,
            timeout=600,
            cwd=Path(__file__).parents[1],
            env=os.environ | environment,
        )

    return run


@pytest.fixture
def run(capfd):
    """Run the command, see that it succeeds, and return what it prints."""

    def run(*arguments):
        assert mitsuba_plenoptic.cli.main([str(argument) for argument in arguments]) == 0
        return capfd.readouterr().out

    return run


@pytest.fixture
def complaint(capfd):
    """Run the command, see that it takes it as a user's mistake, and return the one line that it says."""

    def complaint(*arguments):
        capfd.readouterr()
        assert mitsuba_plenoptic.cli.main([str(argument) for argument in arguments]) == 2
        output, error = capfd.readouterr()
        assert error.startswith("mitsuba-plenoptic: error: ")
        assert error.count("\n") == 1, error
        assert "Traceback" not in output + error
        return error.removeprefix("mitsuba-plenoptic: error: ").rstrip("\n")

    return complaint


@pytest.fixture
def mistake(raw, tmp_path, complaint):
    """See that a command line is a user's mistake, that what is said has some words, and that nothing is written."""

    def mistake(line, words):
        said = complaint(*line.format(raw=raw, out=tmp_path / "out").split())
        assert all(part in said for part in words.split(".*")), said
        assert list(tmp_path.iterdir()) == []

    return mistake


@pytest.fixture(scope="session")
def raw(tmp_path_factory):
    """Render a small capture of the letters once."""
    path = tmp_path_factory.mktemp("capture") / "raw.exr"
    assert mitsuba_plenoptic.cli.main(["render", "letters", "-o", str(path), "--spp", "4", "-D", "resolution=256"]) == 0
    return path


@pytest.fixture(scope="session")
def shot(tmp_path_factory):
    """Write a capture of random light once."""
    camera = PlenopticCamera(detector_width=0.512, resolution=(128, 128))
    image = np.random.default_rng(0).random(camera.shape, dtype=np.float32) * white_image(camera)
    path = tmp_path_factory.mktemp("capture") / "raw.exr"
    write_capture(path, Capture(image, camera))
    return path


@pytest.fixture(scope="session")
def lf(shot):
    return decode(read_capture(shot))


CHROMIUM = (
    "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking "
    "disable-component-update disable-sync"
)
"""Options of the browser in which pages are opened."""


@pytest.fixture
def browser(tmp_path):
    """Return a function that opens a page in a headless Chromium of some width, or skip where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not program or not driver:
        pytest.skip("no Chromium with its chromedriver was found")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in [*CHROMIUM.split(), f"user-data-dir={tmp_path / 'browser'}"]:
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    page = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))

    def open_page(path, width=1280, height=900):
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        page.get(path.as_uri())
        return page

    yield open_page
    page.quit()
