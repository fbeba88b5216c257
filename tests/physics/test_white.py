"""A white scene is as bright by waves as by rays, for every kind of camera."""

import pytest
from cameras import CAMERAS, white

from mitsuba_plenoptic import render_capture

WAVES = (
    "square", "medium", "stretched", "three focal lengths", "circles", "gaps", "focused", "sphere", "warped",
    "unequal lenses", "vignetted", "apodised", "blurred", "ordinary", "microscope", "real",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", WAVES)
def test_scenes(name):
    scene = white(CAMERAS[name])
    rays, waves = (
        render_capture(scene, model=model, spp=spp).image.mean() for model, spp in (("ray", 256), ("wave", 16))
    )
    assert waves == pytest.approx(rays, rel=0.015)
