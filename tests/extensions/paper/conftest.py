"""The paper's experiment at a size and with stand-ins that take seconds."""

import dataclasses

import pytest
from cameras import letters
from scipy.ndimage import gaussian_filter

from mitsuba_plenoptic import Capture, capture_spec
from mitsuba_plenoptic.extensions.paper import readings
from mitsuba_plenoptic.extensions.paper import reproduction as reproductions
from mitsuba_plenoptic.report import experiment as experiments
from mitsuba_plenoptic.report.experiment import Settings


@pytest.fixture(scope="session")
def tiny():
    small = letters(16) | {"lens_model": "parabolic"}
    return Settings("letters", small, spp=4, distances=(210.0, 240.0, 280.0), slider=(225.0,), truth_spp=64, pdf=False)


@pytest.fixture
def quick_waves(monkeypatch, tiny):
    """Stand in for the wave steps, which take long, by blurred rays; lists which stages were computed."""
    render, refocus = capture_spec.render_capture, experiments.reconstruct
    calls = []

    def render_capture(scene, *, model, spp, progress=None, **wave):
        calls.append("capture_points" if wave.get("method") == "points" else f"capture_{model}")
        # By which a capture by waves goes on where a run was stopped.
        assert ("checkpoint" in wave) == (model == "wave")
        capture = render(scene, model="ray", spp=spp, progress=progress)
        if model == "ray":
            return capture
        blurred = gaussian_filter(capture.image, 1.0)
        return Capture(blurred, capture.camera, wave["wavelength"], "wave", capture.metadata)

    def reconstruct(capture, distances, **options):
        return [refocused(capture, distance, **options) for distance in distances]

    def refocused(capture, distance, *, method, footprint="lens", **others):
        calls.append(f"{method}_{distance:g}")
        return picture(capture, distance, method=method, footprint=footprint, **others)

    def picture(capture, distance, *, method, footprint="lens", interleave=None, relay=None, **_):
        # The white of a capture by waves would be by waves, and is not.
        capture = dataclasses.replace(capture, model="ray", wavelength=None)
        smooth = refocus(capture, distance, method="ray", footprint=footprint)
        if method == "ray" or interleave == "auto":
            return smooth
        point = refocus(capture, distance, method="ray", footprint="point")
        mesh = 1.0 if method == "coherent" else 0.25
        return dataclasses.replace(smooth, image=smooth.image + mesh * (point.image - smooth.image))

    monkeypatch.setattr(capture_spec, "render_capture", render_capture)
    monkeypatch.setattr(experiments, "reconstruct", reconstruct)
    monkeypatch.setattr(readings, "reconstruct", picture)
    seconds = {"ray": 0.5, "coherent": 5.0, "partial": 15.0}
    monkeypatch.setattr(reproductions, "processor_seconds", lambda capture, distance: seconds)
    monkeypatch.setattr(reproductions, "plain_seconds", lambda camera, distance: 20.0)
    monkeypatch.setitem(reproductions.PRESETS, "quick", dataclasses.replace(tiny, points=4))
    return calls
