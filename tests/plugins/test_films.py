"""Films: what captures put into them, and gradients of their images."""

import mitsuba as mi
import numpy as np
import pytest
from scene_cases import film

from mitsuba_plenoptic import InputError, render_capture
from mitsuba_plenoptic.plugins.properties import develop, develop_back


@pytest.mark.parametrize(("variant", "channels"), [("llvm_ad_mono", 1), ("llvm_ad_rgb", 3)])
@pytest.mark.parametrize("pixel_format", ["luminance", "rgb"])
def test_film_forward_and_back(variant, channels, pixel_format):
    """<D x, y> = <x, D' y>."""
    mi.set_variant(variant)
    plate = mi.load_dict(film(7, 5) | {"pixel_format": pixel_format})
    x = np.random.default_rng(0).normal(size=(5, 7, channels)).astype(np.float32)
    made = np.array(develop(plate, x))
    y = np.random.default_rng(1).normal(size=made.shape).astype(np.float32)
    assert np.vdot(made, y) == pytest.approx(np.vdot(x, develop_back(plate, mi.TensorXf(y), x.shape)), rel=1e-5)


@pytest.mark.parametrize(
    ("variant", "plate", "model", "message"),
    [
        ("llvm_ad_mono", {"pixel_format": "luminance_alpha"}, "wave", "film: it has 2 channels; a capture needs"),
        ("llvm_ad_rgb", {"pixel_format": "rgba"}, "wave", "film: it has 4 channels"),
        ("llvm_ad_rgb", {"pixel_format": "rgba"}, "ray", "film: it has 4 channels"),
        ("llvm_ad_rgb", {"pixel_format": "xyz"}, "ray", "film: pixel_format = xyz: a capture needs"),
        (
            "llvm_ad_spectral",
            {"type": "specfilm"},
            "wave",
            "plenoptic_wave: film of type SpecFilm: it must be an hdrfilm",
        ),
    ],
)
def test_films_whose_channels_are_not_those_of_a_capture_are_refused(camera_dict, variant, plate, model, message):
    """Also by `mi.render`: colours would be taken for others, or Mitsuba would find them too few."""
    mi.set_variant(variant)
    sensor = camera_dict(resolution=8)
    if plate.get("type") == "specfilm":
        band = {"type": "regular", "wavelength_min": 500.0, "wavelength_max": 600.0, "values": "1, 1"}
        plate = {
            **plate,
            "width": 8,
            "height": 8,
            "rfilter": {"type": "box"},
            "a": band,
            "b": dict(band),
            "c": dict(band),
        }
        sensor["film"] = plate
    else:
        sensor["film"] |= plate
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "sensor": sensor})
    with pytest.raises(InputError, match=f"^{message}"):
        render_capture(scene, model=model, spp=1)
    if model == "wave":
        with pytest.raises(InputError, match=f"^{message}"):
            mi.load_dict({"type": "plenoptic_wave"}).render(scene, spp=1)
