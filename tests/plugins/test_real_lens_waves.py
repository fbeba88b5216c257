"""Scenes through real main lenses by waves: against rays, and against the thin lens."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import disk

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, reconstruct, render_capture

WAVELENGTH = 633.0


def with_lens(lens, lenses=12, **numbers):
    """A camera like the paper's with few lenses."""
    values = {"focal_length": 80, "aperture_radius": 5, "focus_distance": 240}
    values |= {"detector_width": 0.064 * lenses, "resolution": (32 * lenses, 32 * lenses)}
    return PlenopticCamera(main_lens=lens, **(values | numbers))


def scene_of(camera, *things):
    shapes = {f"shape{number}": thing for number, thing in enumerate(things)}
    return mi.load_dict({"type": "scene", "camera": camera.to_sensor(), "integrator": {"type": "direct"}} | shapes)


@pytest.mark.slow
def test_a_scene_is_that_by_rays_and_that_of_the_thin_lens():
    """A disk, partly hidden by another nearer one, refocused to where it stands."""
    images = {}
    for lens in (None, "double_gauss"):
        camera = with_lens(lens, 10)
        scene = scene_of(camera, disk((0.1, 0.05, 236), 0.45), disk((-0.35, 0.1, 225), 0.2))
        for model, options in (("ray", {}), ("wave", {"wavelength": WAVELENGTH})):
            capture = render_capture(scene, model=model, spp=32, **options)
            images[lens, model] = np.nan_to_num(reconstruct(capture, 236.0).image)
    real = images["double_gauss", "ray"]
    assert np.corrcoef(real.ravel(), images[None, "ray"].ravel())[0, 1] > 0.999
    wave = images["double_gauss", "wave"]
    assert np.corrcoef(wave.ravel(), real.ravel())[0, 1] > 0.995
    assert np.corrcoef(wave.ravel(), images[None, "wave"].ravel())[0, 1] > 0.999
    # In the middle of the disk its radiance is there; waves lose what the edges of micro-images send aside.
    assert np.median(real[real > 0.5]) == pytest.approx(1, abs=0.02)
    assert wave.sum() == pytest.approx(images[None, "wave"].sum(), rel=0.03)


@pytest.mark.slow
def test_rays_and_waves_agree_in_energy_in_the_corner():
    """To 1.5 %, where surfaces take half of the light."""
    crop = {"crop_offset": (3808, 96), "crop_size": (192, 192)}
    wide = {"focal_length": 16, "aperture_radius": 1.55, "focus_distance": np.inf, "mla_focal_length": 0.3}
    camera = PlenopticCamera(main_lens="cooke_triplet", **wide, **crop)
    scene = scene_of(camera, {"type": "constant"})
    rays = render_capture(scene, spp=256).image
    waves = render_capture(scene, model="wave", wavelength=WAVELENGTH, spp=256).image
    assert waves.mean() == pytest.approx(rays.mean(), rel=0.015)


@pytest.mark.parametrize(
    "array",
    [pytest.param({"mla_pitch": 0.4, "mla_focal_length": 2.08}, marks=pytest.mark.slow), {"mla_lattice": "none"}],
    ids=["array", "ordinary"],
)
def test_light_ends_where_the_field_of_the_lens_ends(array):
    """Along a radius of a film wider than the field, of 18.3 mm; the pupil closes to a sliver there."""
    wide = {"focal_length": 50, "aperture_radius": 5, "focus_distance": 1000, "detector_width": 52}
    wide |= {"resolution": (650, 650), "crop_offset": (450, 315), "crop_size": (200, 20)}
    camera = PlenopticCamera(main_lens="double_gauss", **wide, **array)
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
        main_lens="cooke_triplet",
        focal_length=16,
        aperture_radius=1.55,
        focus_distance=np.inf,
        mla_focal_length=0.3,
        crop_offset=(3800, 140),
        crop_size=(128, 128),
    )
    capture = render_capture(scene_of(camera, {"type": "constant"}), spp=64)
    assert capture.image.mean() < 0.4
    image = reconstruct(capture, np.inf).image
    inside = image[np.isfinite(image)]
    assert inside.size > 9
    assert np.abs(inside - 1).max() < 0.03


@pytest.mark.slow
def test_the_sum_of_many_points_is_that_of_each():
    """Points that share spreads, in and out of focus and off the axis, against those that share none."""
    camera = with_lens("double_gauss", 16, crop_offset=(128, 128), crop_size=(256, 256))
    rng = np.random.default_rng(0)
    points = np.column_stack([*rng.uniform(-0.5, 0.5, (2, 600)), rng.choice([225.0, 240.0, 260.0], 600)])
    weights = rng.random(600)
    shared, exact = (
        CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=accuracy).forward(weights)
        for accuracy in (0.01, 0.0)
    )
    assert np.linalg.norm(shared - exact) < 0.02 * np.linalg.norm(exact)
