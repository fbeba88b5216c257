"""Films: what captures put into them, and gradients of their images."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import film

from mitsuba_plenoptic.plugins.wave_base import develop, develop_back


@pytest.mark.parametrize(("variant", "channels"), [("llvm_ad_mono", 1), ("llvm_ad_rgb", 3)])
@pytest.mark.parametrize("pixel_format", ["luminance", "rgb"])
def test_film_forward_and_back(variant, channels, pixel_format):
    """<D x, y> = <x, D' y>, whatever the image is."""
    mi.set_variant(variant)
    plate = mi.load_dict(film(7, 5) | {"pixel_format": pixel_format})
    x = np.random.default_rng(0).normal(size=(5, 7, channels)).astype(np.float32)
    image = np.ones_like(x)
    made = np.array(develop(plate, image, x))
    y = np.random.default_rng(1).normal(size=made.shape).astype(np.float32)
    assert np.vdot(made, y) == pytest.approx(np.vdot(x, develop_back(plate, image, mi.TensorXf(y))), rel=1e-5)
