"""Point spreads and their sums through microlens arrays that are no product of a function of x and one of y."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from wave_cases import HALF, LATTICES, WAVELENGTH, capture, error, scattered, small_camera

from mitsuba_plenoptic import PlenopticCamera, point_spread_function, render_capture
from mitsuba_plenoptic.lattice import turn

SMALL = small_camera()

lattices = pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in ("turned", "gaps", "stretched"))) for n in LATTICES]
)
@pytest.mark.parametrize(
    "position", [(0.2, -0.1, 112.5), pytest.param((-0.1, 0.2, 120.0), marks=pytest.mark.slow)], ids=["blurred", "sharp"]
)
def test_patch_against_full_field(name, position):
    camera = small_camera(**LATTICES[name], **HALF)
    patch, full = (
        point_spread_function(camera, position, wavelength=WAVELENGTH, method=way) for way in ("patch", "full_field")
    )
    assert error(patch, full) < 0.01


@pytest.mark.slow
@lattices
@pytest.mark.parametrize("position", [(-2.6, 2.55, 210.0), (4.25, 1.5, 280.0)])
def test_patch_against_full_field_at_the_rim(lattice, position):
    camera = PlenopticCamera(crop_offset=(1024, 1024), crop_size=(2048, 2048)).replace(**lattice)
    patch, full = (
        point_spread_function(camera, position, wavelength=WAVELENGTH, method=name) for name in ("patch", "full_field")
    )
    assert error(patch, full) < 0.01


def test_a_hexagonal_lattice_is_the_same_after_a_sixth_of_a_turn():
    camera = SMALL.replace(mla_lattice="hexagonal")
    image, again = (capture(c, scattered(5), np.ones(5)) for c in (camera, camera.replace(mla_rotation=60.0)))
    assert error(again, image) < 2e-3


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_scene_and_lattice_turn_together(kind):
    camera, positions = SMALL.replace(mla_lattice=kind, mla_offset=(0.011, 0.0)), scattered(5)
    image = capture(camera, positions, np.ones(5))
    around = camera.replace(mla_rotation=90.0, mla_offset=(0.0, 0.011))
    turned = np.column_stack([*turn(*positions[:, :2].T, 90.0), positions[:, 2]])
    # Rows grow with y and columns with x: from x to y is from columns to rows.
    assert error(capture(around, turned, np.ones(5)), np.rot90(image, -1)) < 1e-3


def test_pupil_weights_do_not_turn_with_the_lattice():
    weights = np.zeros((5, 16, 16), bool)
    weights[:, :, 8:] = True
    image, again = (
        capture(camera, scattered(5), np.ones(5), pupil_weights=weights)
        for camera in (SMALL, SMALL.replace(mla_rotation=90.0))
    )
    assert error(again, image) < 2e-3


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) for name in ("circles", "hexagonal", "turned")]
)
def test_wave_and_ray_captures_hold_the_same_energy(camera_dict, name):
    lattice = {k: ", ".join(map(str, v)) if isinstance(v, tuple) else v for k, v in LATTICES[name].items()}
    wall = {
        "type": "disk",
        "to_world": mi.ScalarTransform4f().translate([0.1, -0.05, 250]).rotate([0, 1, 0], 180).scale(0.4),
        "emitter": {"type": "area", "radiance": 1.0},
    }
    sensor = camera_dict(**lattice)
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "camera": sensor, "wall": wall})
    ray = render_capture(scene, spp=64)
    wave = render_capture(scene, model="wave", method="signed_rays", spp=64)
    assert wave.image.sum() == pytest.approx(ray.image.sum(), rel=0.02)
