"""What a capture is estimated to take."""

import time

import pytest

from mitsuba_plenoptic import estimate_capture, load_scene, render_capture


@pytest.fixture(autouse=True)
def short_trials():
    """Leave the trials as long as they are."""


@pytest.mark.slow
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
