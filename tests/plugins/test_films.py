"""Films: what captures put into them, and gradients of their images."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import film

from mitsuba_plenoptic.plugins.wave_base import developed


@pytest.mark.parametrize(("variant", "channels"), [("llvm_ad_mono", 1), ("llvm_ad_rgb", 3)])
@pytest.mark.parametrize("pixel_format", ["luminance", "rgb"])
def test_film_forward_and_back(variant, channels, pixel_format):
    """<D x, y> = <x, D' y>, whatever the image is."""
    mi.set_variant(variant)
    plate = mi.load_dict(film(7, 5) | {"pixel_format": pixel_format})
    x = np.random.default_rng(0).normal(size=(5, 7, channels)).astype(np.float32)
    light, image = developed(plate, np.ones_like(x))
    dr.set_grad(light, mi.TensorXf(x))
    change = np.array(dr.forward_to(image))
    y = np.random.default_rng(1).normal(size=change.shape).astype(np.float32)
    light, image = developed(plate, np.ones_like(x))
    dr.backward(dr.sum(image * mi.TensorXf(y), axis=None))
    assert np.vdot(change, y) == pytest.approx(np.vdot(x, dr.grad(light)), rel=1e-5)
