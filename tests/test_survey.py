"""Every preset by every method: which of them refuse, by the name of what they do not support, and light elsewhere."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import sky

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import refocus
from mitsuba_plenoptic.presets import PRESETS

MICROSCOPES = {"lfm", "lfm_water"}
REAL = {"paper_double_gauss", "raytrix_double_gauss"}
WAVELENGTH = 550.0


def cropped(name):
    """Return a preset's camera with the pixels of two by two lenses about the axis."""
    camera = mp.PlenopticCamera.preset(name)
    width = round(2 * camera.mla_pitch / camera.pixel_size)
    corner = tuple((count - width) // 2 for count in camera.resolution)
    return camera.replace(crop_offset=corner, crop_size=(width, width))


def operator(camera, distance, **options):
    return mp.CaptureOperator(camera, [(0.0, 0.0, distance)], wavelength=WAVELENGTH, **options)


def refocused(camera, distance, method, **options):
    """Return the bins of an even capture that has light."""
    if method != "ray":
        options["wavelength"] = WAVELENGTH
    image = mp.reconstruct(np.ones(camera.shape, np.float32), distance, camera=camera, method=method, **options).image
    return image[np.isfinite(image)]


METHODS = {
    "rays": lambda c, g: sky(c, 4),
    "signed rays": lambda c, g: sky(c, 4, "wave"),
    "forward": lambda c, g: operator(c, g).forward([1.0]),
    "adjoint": lambda c, g: operator(c, g).adjoint(np.ones(c.shape, np.float32)),
    "gradient": lambda c, g: operator(c, g).gradient([1.0], np.ones(c.shape, np.float32))["detector_distance"],
    "coherent field": lambda c, g: operator(c, g).field([1.0]).power,
    "full field": lambda c, g: mp.point_spread_function(c, (0, 0, g), wavelength=WAVELENGTH, method="full_field"),
    "ray": lambda c, g: refocused(c, g, "ray"),
    "coherent": lambda c, g: refocused(c, g, "coherent"),
    "partial": lambda c, g: refocused(c, g, "partial"),
    "partial, auto": lambda c, g: refocused(c, g, "partial", interleave="auto"),
    "incoherent": lambda c, g: refocused(c, g, "incoherent"),
    "deconvolved": lambda c, g: refocused(c, g, "deconvolved", iterations=2),
    "RayRefocus": lambda c, g: refocus.RayRefocus(c, g).forward(np.ones(c.shape, np.float32)),
    "CoherentRefocus": lambda c, g: refocus.CoherentRefocus(c, g, WAVELENGTH).forward(np.ones(c.shape, np.float32)),
}

NEEDS = {
    "coherent field": "laser",
    "incoherent": "deconvolution",
    "deconvolved": "deconvolution",
    "RayRefocus": "inverse",
    "CoherentRefocus": "inverse",
}
QUICK = ("forward", "ray")

LENS, MEMORY = "main_lens = ", "GiB of memory"
FIELDS = "use method partial with interleave auto"

REFUSED = {
    **{(name, method): LENS for name in MICROSCOPES for method in ("gradient", "coherent field", "RayRefocus")},
    **{(name, method): LENS for name in MICROSCOPES for method in ("ray", "coherent", "partial", "partial, auto")},
    **{(name, "coherent field"): LENS for name in REAL},
    **{(name, "CoherentRefocus"): LENS for name in REAL | MICROSCOPES},
    **{(name, method): MEMORY for name in ("lytro", "full_frame_dual") for method in ("coherent field", "full field")},
    **{("raytrix_double_gauss", method): FIELDS for method in ("coherent", "partial")},
    **{("full_frame_dual", method): MEMORY for method in ("coherent", "partial", "partial, auto", "CoherentRefocus")},
}
"""What is refused, and the words by which."""


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize(
    "name", [name for name in PRESETS if name != "shack_hartmann" and PRESETS[name].get("mla_lattice") != "none"]
)
@pytest.mark.parametrize(
    "method",
    [
        pytest.param(
            name,
            marks=[
                *(() if name in QUICK else [pytest.mark.slow]),
                *([pytest.mark.needs_extension(NEEDS[name])] if name in NEEDS else []),
            ],
        )
        for name in METHODS
    ],
)
def test_a_preset_is_refused_by_name_or_gives_light(name, method):
    mi.set_variant("llvm_ad_mono")
    camera = cropped(name)
    distance = 0.01 if name in MICROSCOPES else min(camera.focus_distance, 1e9)
    if words := REFUSED.get((name, method)):
        with pytest.raises(mp.InputError, match=words):
            METHODS[method](camera, distance)
        return
    result = np.asarray(METHODS[method](camera, distance), float)
    assert np.isfinite(result).all()
    assert np.abs(result).sum() > 0


@pytest.mark.needs_extension("inverse")
def test_refocusing_by_rays_names_the_collimator():
    camera = mp.PlenopticCamera.preset("shack_hartmann")
    with pytest.raises(mp.InputError, match="main_lens = collimator: refocused images by method ray refuse it"):
        refocus.RayRefocus(camera, 1e6)
    with pytest.raises(mp.InputError, match="main_lens = collimator"):
        mp.decode(np.ones(camera.shape, np.float32), camera=camera)
