"""Memory: estimated before it is taken, and refused with what would fit."""

import re
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController

from mitsuba_plenoptic import InputError, PlenopticCamera, decode, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.runtime.limits import single_threaded_blas
from mitsuba_plenoptic.views import LensGrid

VARIABLE = "MITSUBA_PLENOPTIC_MEMORY"

FAR_LESS_THAN_THE_WORK = 20.0
"""Seconds of processor time, which other work on the machine does not lengthen; a refusal takes some hundredths."""


@pytest.fixture(autouse=True)
def sixteen_gib(monkeypatch):
    monkeypatch.setenv(VARIABLE, "16")


@pytest.fixture
def camera():
    return PlenopticCamera(resolution=(64, 64), detector_width=0.256)


def test_the_limit_is_a_fraction_of_the_machine_unless_the_variable_says_another(camera, monkeypatch):
    monkeypatch.delenv(VARIABLE)
    with pytest.raises(InputError) as caught:
        reconstruct(np.ones((64, 64), np.float32), 240.0, camera=camera, oversample=10**6)
    assert 0.25 < float(re.search(r"at most ([\d.]+) GiB", str(caught.value))[1]) < 2**20


@pytest.mark.parametrize("model", ["ray", "wave"])
def test_a_camera_of_200_gib_is_refused_before_any_work(model, tmp_path, capfd):
    start = time.process_time()
    words = ["render", "white", "-o", str(tmp_path / "raw.exr"), "--model", model, "-D", "resolution=51800"]
    assert main(words) == 2 and time.process_time() - start < FAR_LESS_THAN_THE_WORK
    said = capfd.readouterr().err
    assert "51800 x 51800 pixels: it would need 200 GiB of memory, at most 16 GiB" in said
    # What it says would fit does, and not much more would.
    fitting = int(said.partition("allowed; ")[2].split()[0])
    assert 0.95 < 80 * fitting**2 / (16 * 2**30) <= 1
    assert [line.split()[1] for line in said.splitlines()] == ["warning:", "error:"]  # the pixels are tiny, too
    assert list(tmp_path.iterdir()) == []


def test_what_is_said_to_fit_fits(camera, monkeypatch):
    image = np.ones((64, 64), np.float32)
    monkeypatch.setenv(VARIABLE, "0.01")
    with pytest.raises(InputError, match="would fit") as caught:
        reconstruct(image, 240.0, camera=camera, oversample=1500)
    fitting = int(str(caught.value).partition("oversample = ")[2].split()[0])
    assert reconstruct(image, 240.0, camera=camera, oversample=fitting).image.shape == (4 * fitting, 4 * fitting)
    with pytest.raises(InputError, match="would need"):
        reconstruct(image, 240.0, camera=camera, oversample=fitting + 1)


@pytest.mark.slow
def test_the_estimate_of_rays_is_that_of_what_is_allocated(camera, python):
    """Bins are counted from the arrays that come out; the estimate must not be below them."""
    # In a process of its own that ends while it traces: CPython may crash where tracing stops while Dr.Jit's threads
    # still free memory.
    script = """
    import os, sys, tracemalloc
    import numpy as np
    from mitsuba_plenoptic import PlenopticCamera, reconstruct
    camera, image = PlenopticCamera.from_json(sys.argv[1]), np.ones((64, 64), np.float32)
    reconstruct(image, 240.0, camera=camera)
    tracemalloc.start()
    results = reconstruct(image, [210.0, 240.0], camera=camera, oversample=64)
    print(tracemalloc.get_traced_memory()[1], sum(result.image.nbytes for result in results), flush=True)
    os._exit(0)
    """
    taken, kept = map(int, python(script, camera.to_json()).stdout.split())
    assert kept <= taken
    bins = (4 * 64) ** 2
    # The sums of the capture and of white, the rays that reach, what is usual of white, and the image; and the sums of
    # white of both planes, in double precision, which stay for the next image.
    assert taken < 4 * bins * 5 + 4 * (bins + 64 * 4 * 64) + 2 * 8 * bins + 2**19


def wave_capture(**options):
    scene = load_scene("white", parameters={"resolution": "32", "detector_width": "0.128"})
    return render_capture(scene, model="wave", **options)


@pytest.mark.parametrize(
    ("work", "words"),
    [
        (
            lambda image, camera: reconstruct(
                image, 240.0, camera=camera.replace(detector_width=80, mla_pitch=2.5), method="coherent", wavelength=633
            ),
            "wave reconstruction: it would need",
        ),
        (lambda image, camera: wave_capture(method="points", spp=10**7), "spp = "),
        (lambda image, camera: LensGrid((1e-2, 1e-2), (0, 0), (10**6, 10**6)).centres(), "1000000 x 1000000 lenses"),
        (lambda image, camera: decode(image, white=image, grid=LensGrid((0.5, 0.5), (0, 0), (10**5, 10**5))), "lenses"),
        (
            lambda image, camera: decode(image, camera=camera.replace(mla_pitch=0.25, aperture_radius=20000.0)),
            "white image",
        ),
    ],
)
def test_every_kind_of_work_estimates_first(work, words, camera):
    start = time.process_time()
    with pytest.raises(InputError, match=words):
        work(np.ones((64, 64), np.float32), camera)
    assert time.process_time() - start < FAR_LESS_THAN_THE_WORK


def test_overlapping_threads_leave_the_linear_algebra_its_threads():
    """Contexts that end in another order than by nesting, as those of threads do."""

    def counts():
        return [each["num_threads"] for each in ThreadpoolController().info() if each["user_api"] == "blas"]

    first, second = single_threaded_blas(), single_threaded_blas()
    with ThreadpoolController().limit(limits=2, user_api="blas"), ThreadPoolExecutor(1) as pool:
        pool.submit(first.__enter__).result()
        second.__enter__()
        pool.submit(first.__exit__, None, None, None).result()
        assert set(counts()) == {1}
        second.__exit__(None, None, None)
        assert set(counts()) == {2}
        assert pool.submit(single_threaded_blas()(counts)).result() == [1] * len(counts())
