"""Point spreads and their sums through microlens arrays that are no product of a function of x and one of y."""

import numpy as np
import pytest
from cameras import LATTICES, WAVELENGTH, capture, error, scattered, small_camera

from mitsuba_plenoptic import PlenopticCamera, point_spread_function
from mitsuba_plenoptic.runtime import turn

SMALL = small_camera()

lattices = pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)


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
