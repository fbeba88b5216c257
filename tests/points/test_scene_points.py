"""Captures of matte scenes point by point, against closed forms, rays, signed rays, and one another."""

import math

import mitsuba as mi
import numpy as np
import pytest
from cameras import error
from cases import facing, radiating, scene_of, sensor

from mitsuba_plenoptic import InputError, PlenopticCamera, render_capture
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import radiance_weight

BLACK = {"type": "diffuse", "reflectance": 0.0}


def camera(lenses=4, pixels=16, **parameters):
    return sensor(lenses, pixels, lens_model="parabolic", **parameters)


def wall(distance=240.0, **extra):
    return facing(distance, 60.0, **(extra or radiating()))


def striped(period):
    """Describe an emitter of upright stripes over a square of 4 mm."""
    values = np.where(np.arange(2 * round(4 / period)) % 2, 1.0, 0.2).astype(np.float32)[None, :, None]
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.repeat(values, 2, 0)), "raw": True, "filter_type": "nearest"}
    return {"emitter": {"type": "area", "radiance": texture}, "bsdf": BLACK}


def by_points(scene, spp=32, **options):
    return render_capture(scene, model="wave", method="points", spp=spp, **options)


def by_signed_rays(scene, spp=256, **options):
    options |= {"model": "wave", "method": "signed_rays", "spp": spp}
    return np.mean([render_capture(scene, seed=seed, **options).image for seed in (0, 1)], axis=0)


@pytest.mark.slow
def test_surfaces_are_seen_as_by_signed_rays():
    scene = scene_of(camera(), card=facing(240.0, 2.0, **striped(0.4)))
    points, rays = by_points(scene, 64).image, by_signed_rays(scene)
    assert error(points, rays) < 0.03
    assert points.sum() == pytest.approx(rays.sum(), rel=0.005)


@pytest.mark.slow
def test_the_light_of_a_small_lamp_is_that_of_its_area():
    radius = 0.05
    scene = scene_of(camera(8), lamp={**facing(240.0, radius, **radiating(3.0)), "type": "disk"})
    image = by_points(scene, 128).image
    seen = scene.sensors()[0].camera
    whole = 3 * radiance_weight(seen, main_lens(seen), math.pi * (radius / 2) ** 2)
    # The detector loses what lenses diffract far.
    assert image.sum() == pytest.approx(whole, rel=0.04)


@pytest.mark.slow
def test_lenses_shifted_to_chief_rays_are_seen_as_by_signed_rays():
    """Apart from the light, as signed rays' apertures keep their size where cells, which points see, shrink."""
    count, height = 1664, 2.5
    seen = PlenopticCamera(
        detector_width=0.004 * count, resolution=(count, count), crop_offset=(count // 2 + 609, count // 2 - 16),
        crop_size=(32, 32), lens_model="parabolic", mla_cra=(0, 0, 2.5, 2, 5, 5),
    )  # fmt: skip
    card = facing(240.0, 2.0, (-2 * height, 0.0), **striped(0.4))
    scene, unshifted = (scene_of(each.to_sensor(), card=card) for each in (seen, seen.replace(mla_cra=())))
    points, rays = by_points(scene, 32).image, by_signed_rays(scene)
    # The area of the cell that lies there, over that of a regular one.
    shifts = seen.lattice.displacement
    (x, _), step = shifts.regular(height, 0.0), 0.03
    radial = (shifts.smooth(x + step, 0.0)[0] - shifts.smooth(x - step, 0.0)[0]) / (2 * step)
    shrunk = (1 + radial) * (1 + shifts.smooth(x, step)[1] / step)
    assert points.sum() / rays.sum() == pytest.approx(shrunk, rel=0.015)
    assert error(points / shrunk, rays) < 0.035
    assert error(by_signed_rays(unshifted), rays) > 0.1


def test_a_lit_matte_surface_is_as_bright_as_by_rays():
    lit = {
        "plane": facing(240.0, 20.0, bsdf={"type": "diffuse", "reflectance": 0.7}),
        "light": {"type": "point", "position": [10.0, 20.0, 100.0], "intensity": 2e4},
    }
    scene = scene_of(camera(), **lit)
    by_rays = render_capture(scene, model="ray", spp=64).image
    # Rays of parabolic microlenses are a little too bright, and the detector's rim gets light from beyond it.
    assert by_points(scene).image.sum() == pytest.approx(by_rays.sum(), rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_spectral"])
def test_colours_are_those_of_rays(variant):
    mi.set_variant(variant)
    described = camera(2)
    described["film"]["pixel_format"] = "rgb"
    light = {"type": "rgb", "value": [1.0, 0.5, 0.2]}
    scene = scene_of(described, wall=wall(emitter={"type": "area", "radiance": light}, bsdf=BLACK))
    by_rays = render_capture(scene, model="ray", spp=64).image.mean((0, 1))
    options = {} if mi.is_rgb else {"responses": "srgb", "nodes": 2}
    assert by_points(scene, 16, **options).image.mean((0, 1)) == pytest.approx(by_rays, rel=0.02)


def test_the_noise_is_refused():
    with pytest.raises(InputError, match="noise: method = points"):
        by_points(scene_of(camera(2), wall=wall()), noise=True)
