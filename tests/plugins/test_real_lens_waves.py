"""Scenes through real main lenses by waves: against rays, and against the thin lens."""

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import PlenopticCamera, reconstruct, render_capture

WAVELENGTH = 633.0


def scene_of(camera, *things):
    shapes = {f"shape{number}": thing for number, thing in enumerate(things)}
    return mi.load_dict({"type": "scene", "camera": camera.to_sensor(), "integrator": {"type": "direct"}} | shapes)


def test_light_ends_where_the_field_of_the_lens_ends():
    """Along a radius of a film wider than the field, of 18.3 mm; the pupil closes to a sliver there."""
    wide = {"focal_length": 50, "aperture_radius": 5, "focus_distance": 1000, "detector_width": 52}
    wide |= {"resolution": (650, 650), "crop_offset": (450, 320), "crop_size": (200, 10)}
    camera = PlenopticCamera(main_lens="double_gauss", mla_lattice="none", **wide)
    scene = scene_of(camera, {"type": "constant"})
    # Means over five lenses, 2 mm.
    rays, waves = (
        render_capture(scene, spp=64, **options).image.mean(0).reshape(8, 25).mean(1)
        for options in ({}, {"model": "wave", "wavelength": WAVELENGTH})
    )
    assert rays[0] > 0.7 and 0 < rays[4] < 0.02 < rays[3] and rays[5:].max() == 0
    assert np.abs(waves - rays).max() < 0.02
    assert np.abs(waves[5:]).max() < 1e-4


def test_white_is_one_where_surfaces_take_half_of_the_light():
    """Bins of a corner by rays: the traced white divides what is missing."""
    camera = PlenopticCamera(
        main_lens="cooke_triplet", focal_length=16, aperture_radius=1.55, focus_distance=np.inf, mla_focal_length=0.3,
        crop_offset=(3800, 140), crop_size=(128, 128),
    )  # fmt: skip
    capture = render_capture(scene_of(camera, {"type": "constant"}), spp=64)
    assert capture.image.mean() < 0.4
    image = reconstruct(capture, np.inf).image
    inside = image[np.isfinite(image)]
    assert inside.size > 9
    assert np.abs(inside - 1).max() < 0.03
