"""Fits of cameras to captures by rays, judged by the noise that was added."""

import mitsuba as mi
import numpy as np
import pytest
from wave_cases import HALF, small_camera

from mitsuba_plenoptic import InputError, fit, render_capture
from mitsuba_plenoptic.fitting import RayView, View
from mitsuba_plenoptic.plugins.other_camera import with_camera

TRUE = small_camera(4, **HALF, detector_distance=0.512)
PHOTONS = 2000.0


@pytest.fixture
def wall():
    """Return a white wall."""
    turned = mi.ScalarTransform4f().translate([0.0, 0.0, 125.0]).rotate([0, 1, 0], 180).scale(5.0)
    shape = {"type": "disk", "to_world": turned, "emitter": {"type": "area", "radiance": 1.0}}
    return mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": 1}, "wall": shape})


def test_numbers_are_found_by_rays_within_their_deviations(wall):
    """The capture's rays are others than the model's, and both are many."""
    image = render_capture(with_camera(wall, TRUE), model="ray", spp=1024, seed=7).image
    seen = np.random.default_rng(3).poisson(image * PHOTONS) / PHOTONS
    start = TRUE.replace(mla_pitch=0.0642, mla_offset=(0.0006, -0.0004), detector_distance=0.515)
    names = "mla_pitch", "mla_offset", "detector_distance"
    found = fit(start, RayView(seen, wall, spp=512), names, photons=PHOTONS)
    true = {"mla_pitch": 0.064, "mla_offset.1": 0.0, "mla_offset.2": 0.0, "detector_distance": 0.512}
    errors = [(found.values[name] - value) / found.deviations[name] for name, value in true.items()]
    assert max(map(abs, errors)) < 4
    assert found.deviations["mla_offset.1"] < 1e-4
    assert found.deviations["mla_pitch"] < 5e-5
    assert found.chi_square == pytest.approx(1, abs=0.15)


def test_mistakes_by_rays(wall):
    image = np.ones(TRUE.shape)
    with pytest.raises(InputError, match="scene of type int"):
        RayView(image, 3)
    with pytest.raises(InputError, match="one channel"):
        RayView(np.ones((4, 4, 3)), wall)
    with pytest.raises(InputError, match="views of RayView, View: they must be all"):
        fit(TRUE, [RayView(image, wall), View(image, [(0, 0, 120.0)], [1.0])], "mla_pitch", photons=1.0)
    dark = mi.load_dict({"type": "scene", "integrator": {"type": "path"}})
    with pytest.raises(InputError, match="mla_pitch: the captures tell nothing of it"):
        fit(TRUE, RayView(image, dark, spp=1), "mla_pitch", photons=10.0)
