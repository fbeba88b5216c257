"""Estimates of reconstructions: they leave the work as soon as its speed is known, and state its memory."""

import re

import pytest
from cameras import HALF, WAVELENGTH, small_camera

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import estimate_reconstruction, reconstruct
from mitsuba_plenoptic.refocus import api
from mitsuba_plenoptic.runtime import progress
from mitsuba_plenoptic.views import capture_white, white_image

WAVES = {"wavelength": WAVELENGTH}
DECONVOLVED = pytest.param("deconvolved", {"iterations": 3} | WAVES, marks=pytest.mark.needs_extension("deconvolution"))


@pytest.fixture(scope="module")
def capture():
    camera = small_camera(8, **HALF)
    return mp.Capture(white_image(camera), camera)


@pytest.mark.parametrize(("method", "options"), [("coherent", WAVES), DECONVOLVED])
def test_an_estimate_ends_before_the_reconstruction_does(capture, method, options, monkeypatch):
    """With a speed known from the first results on, no method by waves may reach its end."""
    monkeypatch.setattr(progress, "SETTLED", 0.0)
    ended = []
    whole = api._refocused
    monkeypatch.setattr(api, "_refocused", lambda *given: (whole(*given), ended.append(True))[0])
    cost = estimate_reconstruction(capture, 105.0, method=method, **options)
    assert not ended
    assert cost.seconds > 0 and cost.memory > 0


def test_short_work_is_done_for_its_estimate(capture, monkeypatch):
    monkeypatch.setattr(progress, "SETTLED", 1e9)
    assert 0 < estimate_reconstruction(capture, [105.0, 120.0]).seconds < 1e3


@pytest.mark.parametrize(
    ("method", "options"),
    [("ray", {}), pytest.param(*DECONVOLVED.values, marks=[*DECONVOLVED.marks, pytest.mark.slow])],
)
def test_the_memory_of_an_estimate_is_what_is_refused(capture, method, options, monkeypatch):
    # What is kept for the camera needs its memory once.
    reconstruct(capture, 105.0, method=method, **options)
    needed = estimate_reconstruction(capture, 105.0, method=method, **options).memory
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", f"{1.01 * needed / 2**30:.9f}")
    reconstruct(capture, 105.0, method=method, **options)
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", f"{0.99 * needed / 2**30:.9f}")
    with pytest.raises(mp.InputError, match="GiB"):
        reconstruct(capture, 105.0, method=method, **options)


def test_fields_take_strips_where_memory_is_short(capture, monkeypatch):
    monkeypatch.setattr(progress, "SETTLED", 0.0)
    needed = estimate_reconstruction(capture, 105.0, method="coherent", **WAVES).memory
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", f"{0.99 * needed / 2**30:.9f}")
    assert estimate_reconstruction(capture, 105.0, method="coherent", **WAVES).memory < 0.99 * needed


def test_long_work_says_its_time_and_memory(monkeypatch, caplog):
    caplog.set_level("INFO", logger="mitsuba_plenoptic")
    camera = small_camera(4, **HALF)
    white = mp.Capture(white_image(camera), camera)
    reconstruct(white, 115.0, method="coherent", white=white, **WAVES)
    assert "takes about" not in caplog.text
    monkeypatch.setattr(progress, "SETTLED", 0.0)
    monkeypatch.setattr(api, "_LONG", 0.0)
    reconstruct(white, 115.0, method="coherent", white=white, **WAVES)
    assert re.search(r"method coherent takes about \S+ s and \S+ GiB; method ray", caplog.text)
    assert caplog.text.count("takes about") == 1


def test_whites_of_even_arrays_report_while_they_are_fitted():
    camera = mp.PlenopticCamera(resolution=(128, 128), detector_width=0.512)
    seen = []
    capture_white(mp.Capture(white_image(camera), camera, 550.0, "wave"), 1, lambda done, of: seen.append(done / of))
    assert seen == sorted(seen) and seen[-3:] == [0.5, 0.75, 1.0]


def test_the_command_prints_time_and_memory_and_writes_nothing(capture, tmp_path, run, complaint):
    path = tmp_path / "raw.exr"
    mp.write_capture(path, capture)
    arguments = ["reconstruct", path, "--distance", "105", "--method", "coherent", "--wavelength", "633"]
    said = run(*arguments, "-o", tmp_path / "out.png", "--estimate")
    assert re.search(r"raw\.exr: about \S+ (s|min) and \S+ GiB\n$", said)
    assert list(tmp_path.iterdir()) == [path]
    assert "--estimate" in complaint(*arguments)
