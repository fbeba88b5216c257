"""What a capture is estimated to take."""

from __future__ import annotations

import logging
import time

import mitsuba as mi
import pytest

from mitsuba_plenoptic import InputError, PlenopticCamera, estimate_capture, load_scene, render_capture
from mitsuba_plenoptic.capture.choice import bank_is_better
from mitsuba_plenoptic.capture.sight import Sight


@pytest.mark.parametrize("name", ["letters", pytest.param("still_life", marks=pytest.mark.slow)])
def test_by_waves_a_fraction_of_the_lenses_tells_of_all(name, monkeypatch):
    scene = load_scene(name, parameters={"resolution": "512", "detector_width": "4.096", "mla_pitch": "0.064"})
    options = {"model": "wave", "spp": 1, "radiators_per_lens": 2}
    monkeypatch.setattr("mitsuba_plenoptic.capture.estimate._PATHS", 2**40)
    whole = estimate_capture(scene, **options)
    monkeypatch.setattr("mitsuba_plenoptic.capture.estimate._PATHS", 2**12)
    monkeypatch.setattr("mitsuba_plenoptic.capture.estimate._SECONDS", 1e-3)
    part = estimate_capture(scene, **options)
    assert part.radiators == pytest.approx(whole.radiators, rel=0.1)
    assert part.patterns == pytest.approx(whole.patterns, rel=0.4)
    assert part.seconds > 0 and part.memory > 0


def test_by_waves_what_little_there_is_is_counted_exactly(caplog):
    scene = load_scene("letters", parameters={"resolution": "256", "detector_width": "1.024", "letter_scale": "0.2"})
    options = {"model": "wave", "spp": 1, "radiators_per_lens": 4}
    cost = estimate_capture(scene, **options)
    with caplog.at_level(logging.INFO, logger="mitsuba_plenoptic"):
        render_capture(scene, **options)
    assert f"{cost.radiators} radiators, {cost.patterns} point spreads" in caplog.text


def test_by_rays_the_time_is_about_right():
    scene = load_scene("still_life", parameters={"resolution": "512"})
    render_capture(scene, spp=2)  # compiles the kernels
    # Other work on the machine counts in neither.
    clock, time.perf_counter = time.perf_counter, time.process_time
    try:
        estimate = estimate_capture(scene, spp=16).seconds
        start = time.perf_counter()
        render_capture(scene, spp=16)
        taken = time.perf_counter() - start
    finally:
        time.perf_counter = clock
    assert estimate == pytest.approx(taken, rel=0.5)


def test_what_would_be_refused_is_refused():
    with pytest.raises(InputError, match=r"batch_map: a ray capture does not take it"):
        estimate_capture(load_scene("letters"), batch_map=lambda batches: iter(()))
    with pytest.raises(InputError, match="spp = 0"):
        estimate_capture(load_scene("letters"), spp=0)


@pytest.mark.parametrize("sky", [True, False])
def test_a_small_detector_before_a_sky_is_the_banks(sky, camera_dict):
    """Patches of the sky would be refused, however few radiators there are; without it patches are the quicker way."""
    card = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 240]).scale(0.2),
        "emitter": {"type": "area", "radiance": 1.0},
    }
    lights = {"card": card} | ({"sky": {"type": "constant"}} if sky else {})
    camera = camera_dict(resolution=64, detector_width=0.128)
    scene = load_scene({"type": "scene", "integrator": {"type": "path"}, "camera": camera, **lights})
    sensor = scene.sensors()[0]
    plenoptic = PlenopticCamera.from_sensor(sensor)
    sight = Sight.of(scene, sensor, scene.integrator(), None)
    assert bank_is_better(plenoptic, sight, 633.0, 1, 0.01, 0) == sky
    assert not bank_is_better(plenoptic, sight, 633.0, 1, 0.0, 0)
