"""Captures of matte scenes point by point, against closed forms, rays, signed rays, and one another."""

import math

import mitsuba as mi
import numpy as np
import pytest
from cameras import error
from cases import facing, radiating, scene_of, sensor

from mitsuba_plenoptic import Checkpoint, InputError, PlenopticCamera, estimate_capture, render_capture
from mitsuba_plenoptic.io import checkpoints
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import radiance_weight

BLACK = {"type": "diffuse", "reflectance": 0.0}


def camera(lenses=4, pixels=16, **parameters):
    return sensor(lenses, pixels, lens_model="parabolic", **parameters)


def wall(distance=240.0, **extra):
    return facing(distance, 60.0, **(extra or radiating()))


def striped(period):
    """Describe an emitter of upright stripes over a square of 4 mm."""
    count = 2 * round(4 / period)
    values = np.where(np.arange(count) % 2, 1.0, 0.2).astype(np.float32)[None, :, None]
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.repeat(values, 2, 0)), "raw": True, "filter_type": "nearest"}
    return {"emitter": {"type": "area", "radiance": texture}, "bsdf": BLACK}


def by_points(scene, spp=32, **options):
    return render_capture(scene, model="wave", method="points", spp=spp, **options)


def by_signed_rays(scene, spp=256, **options):
    captures = [
        render_capture(scene, model="wave", method="signed_rays", spp=spp, seed=seed, **options) for seed in (0, 1)
    ]
    return np.mean([capture.image for capture in captures], axis=0)


@pytest.mark.parametrize(
    "objects, changes, limit",
    [
        pytest.param({"wall": lambda: wall()}, {}, 0.01, marks=pytest.mark.slow),
        ({"card": lambda: facing(240.0, 2.0, **striped(0.4))}, {}, 0.03),
        pytest.param(
            {"card": lambda: facing(240.0, 2.0, **striped(0.4))},
            {"mla_transmissions": [[0.5, 1.0, 1.0, 1.0], [1.0, 0.7, 1.0, 0.8], [1.0, 1.2, 1.0, 0.6]]},
            0.03,
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"card": lambda: facing(240.0, 2.0, **striped(0.4))},
            {"vignetting": {"radius": [0.95], "slope_x": [0.1], "apodisation_2": [-0.3]}},
            0.03,
            marks=pytest.mark.slow,
        ),
    ],
    ids=["white wall", "texture", "unequal lenses", "vignetting"],
)
def test_surfaces_are_seen_as_by_signed_rays(objects, changes, limit):
    seen = PlenopticCamera(detector_width=0.256, resolution=(64, 64), lens_model="parabolic", **changes)
    scene = scene_of(seen.to_sensor(), **{name: make() for name, make in objects.items()})
    points, rays = by_points(scene, 64).image, by_signed_rays(scene)
    assert error(points, rays) < limit
    assert points.sum() == pytest.approx(rays.sum(), rel=0.005)


def test_the_light_of_a_small_lamp_is_that_of_its_area():
    radius = 0.05
    scene = scene_of(camera(8), lamp={**facing(240.0, radius, **radiating(3.0)), "type": "disk"})
    image = by_points(scene, 256).image
    seen = scene.sensors()[0].camera
    whole = 3 * radiance_weight(seen, main_lens(seen), math.pi * (radius / 2) ** 2)
    # The detector loses what lenses diffract far.
    assert image.sum() == pytest.approx(whole, rel=0.04)


def test_what_covers_half_of_the_pupil_darkens_halves_of_micro_images():
    card = facing(10.0, (10.0, 20.0), (10.0, 0.0), bsdf=BLACK)
    scene = scene_of(camera(), card=card, wall=wall())
    points, rays = by_points(scene, 64).image, by_signed_rays(scene)
    # The border of the shadow is soft, and the pupil that it leaves open diffracts.
    assert error(points, rays) < 0.04
    assert points.sum() == pytest.approx(rays.sum(), rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pairs", "limit"), [((0, 0, 2.5, 2, 5, 5), 0.035), ((0, 0, 5, 52), 0.06)], ids=["kink", "a tenth nearer"]
)
def test_lenses_shifted_to_chief_rays_are_seen_as_by_signed_rays(pairs, limit):
    """Apart from the light, as signed rays' apertures keep their size where cells, which points see, shrink."""
    count, height = 1664, 2.5
    seen = PlenopticCamera(
        detector_width=0.004 * count, resolution=(count, count), crop_offset=(count // 2 + 609, count // 2 - 16),
        crop_size=(32, 32), lens_model="parabolic", mla_cra=pairs,
    )  # fmt: skip
    card = facing(240.0, 2.0, (-2 * height, 0.0), **striped(0.4))
    scene, unshifted = (scene_of(each.to_sensor(), card=card) for each in (seen, seen.replace(mla_cra=())))
    points, rays = by_points(scene, 32).image, by_signed_rays(scene)
    # The area of the cell that lies there, over that of a regular one.
    shifts = seen.lattice.displacement
    (x, _), step = shifts.regular(height, 0.0), 0.03
    radial = (shifts.smooth(x + step, 0.0)[0] - shifts.smooth(x - step, 0.0)[0]) / (2 * step)
    tangential = shifts.smooth(x, step)[1] / step
    shrunk = (1 + radial) * (1 + tangential)
    assert points.sum() / rays.sum() == pytest.approx(shrunk, rel=0.015)
    assert error(points / shrunk, rays) < limit
    assert error(by_signed_rays(unshifted), rays) > 0.1


@pytest.mark.slow
def test_crops_record_what_the_whole_does():
    # Blurred by two lenses: much of the light of points beside the crop lands beyond the lenses that are sampled.
    scene = scene_of(camera(8, 8), wall=wall(254.0))
    whole = by_points(scene, 64, accuracy=0.02).image[24:40, 24:48]
    cropped = camera(8, 8)
    cropped["film"] |= {"crop_offset_x": 24, "crop_offset_y": 24, "crop_width": 24, "crop_height": 16}
    part = by_points(scene_of(cropped, wall=wall(254.0)), 64, accuracy=0.02).image
    assert error(part, whole) < 0.02
    assert part.sum() == pytest.approx(whole.sum(), rel=0.01)


def test_a_lit_matte_surface_is_as_bright_as_by_rays():
    lit = {
        "plane": facing(240.0, 20.0, bsdf={"type": "diffuse", "reflectance": 0.7}),
        "light": {"type": "point", "position": [10.0, 20.0, 100.0], "intensity": 2e4},
    }
    scene = scene_of(camera(), **lit)
    by_rays = render_capture(scene, model="ray", spp=64).image
    # Rays of parabolic microlenses are a little too bright, and the detector's rim gets light from beyond it.
    assert by_points(scene).image.sum() == pytest.approx(by_rays.sum(), rel=0.01)


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", pytest.param("llvm_ad_spectral", marks=pytest.mark.slow)])
def test_colours_are_those_of_rays(variant):
    mi.set_variant(variant)
    described = camera(2)
    described["film"]["pixel_format"] = "rgb"
    light = {"type": "rgb", "value": [1.0, 0.5, 0.2]}
    scene = scene_of(described, wall=wall(emitter={"type": "area", "radiance": light}, bsdf=BLACK))
    by_rays = render_capture(scene, model="ray", spp=64).image.mean((0, 1))
    for options in ({"responses": "srgb", "nodes": 2}, *([{}] if mi.is_rgb else [])):
        assert by_points(scene, 16, **options).image.mean((0, 1)) == pytest.approx(by_rays, rel=0.02)


@pytest.mark.slow
def test_slanted_surfaces_fill_the_pupil_by_lamberts_law():
    T = mi.ScalarTransform4f()
    to_world = T.translate([0, 0, 240]) @ T.rotate([0, 1, 0], 86) @ T.rotate([0, 1, 0], 180) @ T.scale(60.0)
    scene = scene_of(camera(), floor={"type": "rectangle", "to_world": to_world, **radiating()})
    points, rays = by_points(scene, 64, accuracy=0.05).image, by_signed_rays(scene)
    assert points.sum() == pytest.approx(rays.sum(), rel=0.01)
    half = [np.hsplit(image.reshape(64, 4, 16)[:, 1:3].sum((0, 1)), 2) for image in (points, rays)]
    ratios = [float(left.sum() / right.sum()) for left, right in half]
    # Of one radiance, it fills micro-images evenly, though points are found and shine unevenly over the pupil.
    assert ratios[0] == pytest.approx(ratios[1], rel=0.02)


@pytest.mark.slow
def test_light_behind_a_real_main_lens_is_as_bright_as_by_rays():
    scene = scene_of(
        sensor(4, 16, main_lens="double_gauss", focal_length=80.0, focus_distance=1000.0), wall=wall(1000.0)
    )
    by_rays = render_capture(scene, model="ray", spp=64).image
    assert by_points(scene, accuracy=0.05).image.sum() == pytest.approx(by_rays.sum(), rel=0.01)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits_also_after_a_stop(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoints, "INTERVAL", 0.0)
    scene = scene_of(camera(1), card=facing(250.0, 2.0, **striped(0.4)))
    once = by_points(scene, 2).image
    assert np.array_equal(by_points(scene, 2).image, once)
    assert not np.array_equal(by_points(scene, 2, seed=1).image, once)

    def stop(done, total):
        if done > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), Checkpoint(tmp_path / "kept", "refuse") as kept:
        by_points(scene, 2, checkpoint=kept, progress=stop)
    with Checkpoint(tmp_path / "kept", "resume") as kept:
        assert np.array_equal(by_points(scene, 2, checkpoint=kept).image, once)


def test_the_noise_is_refused_and_the_cost_estimated(monkeypatch):
    scene = scene_of(camera(2), wall=wall())
    with pytest.raises(InputError, match="noise: method = points does not state it"):
        by_points(scene, noise=True)
    monkeypatch.setattr("mitsuba_plenoptic.runtime.progress.SETTLED", 0.0)
    monkeypatch.setattr("mitsuba_plenoptic.points.patch_plan.PatchSum.image", lambda *_: pytest.fail("not abandoned"))
    cost = estimate_capture(scene, model="wave", method="points", spp=8)
    assert 0 < cost.seconds < 600
    assert 0 < cost.memory < 2**32


def test_black_scenes_are_black_and_said_to_be():
    with pytest.warns(UserWarning, match="no ray from the pupil meets anything that shines"):
        image = by_points(scene_of(sensor(2, 8), card=wall(bsdf=BLACK))).image
    assert not image.any()
