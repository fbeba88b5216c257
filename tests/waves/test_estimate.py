"""What a capture is estimated to take."""

import time

import pytest

from mitsuba_plenoptic import estimate_capture, load_scene, render_capture
from mitsuba_plenoptic.runtime import progress
from mitsuba_plenoptic.scene import capture


@pytest.mark.slow
@pytest.mark.parametrize("model", ["ray", "wave"])
def test_the_time_is_about_right(model, monkeypatch):
    monkeypatch.setattr(progress, "SETTLED", 0.2)
    monkeypatch.setattr(capture, "_RAYS_PER_PASS", 2**19)
    monkeypatch.setattr("mitsuba_plenoptic.waves.signed_rays._LANES", 2**19)
    scene = load_scene("letters", parameters={"resolution": "512"})
    render_capture(scene, spp=2, model=model)  # compiles the kernels
    # Other work on the machine counts in neither.
    monkeypatch.setattr(time, "monotonic", time.process_time)
    start = time.process_time()
    estimate = estimate_capture(scene, spp=64, model=model).seconds
    middle = time.process_time()
    render_capture(scene, spp=64, model=model)
    taken = time.process_time() - middle
    assert middle - start < 0.7 * taken
    assert taken / 2 < estimate < 2 * taken
