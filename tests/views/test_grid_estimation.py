"""Finding the micro-images of a white image whose lattice is unknown."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.views import LensGrid, estimate_lens_grid, lens_grid, white_image

ROOT3 = math.sqrt(3)


def distances(found, truth, shape):
    """Distance of every true centre within the image from the nearest one found, and of each found from a true one."""
    ours, theirs = (grid.centres().reshape(-1, 2) for grid in (found, truth))
    seen = theirs[((theirs > 0) & (theirs < shape[::-1])).all(1)]
    inner = ours[((ours > 5) & (ours < np.array(shape[::-1]) - 5)).all(1)]
    return cKDTree(ours).query(seen)[0], cKDTree(theirs).query(inner)[0]


GRIDS = {
    "square": LensGrid((16.317, 16.317), (-23.3, -17.2), (70, 70), math.radians(0.3)),
    "hexagonal, upright": LensGrid((17.1 * ROOT3, 17.1 / 2), (-23.3, -17.2), (140, 45), math.radians(-0.3), 0),
    "rectangular": LensGrid((17.0, 15.5), (-60.0, 17.3), (90, 80), math.radians(-3.0)),
    "hexagonal, upright, hardly stretched": LensGrid(
        (17.1 * ROOT3, 1.003 * 17.1 / 2), (-23.3, -17.2), (140, 45), math.radians(-3.0), 0
    ),
    "hexagonal, tall": LensGrid((20.0, 1.3 * 20.0 * ROOT3 / 2), (-95.3, -17.2), (60, 60), math.radians(-5.0), 1),
}


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
def test_centres_of_an_unknown_lattice(grid):
    # A micro-image is 10.7 pixels wide. The picture is darker towards its corners and noisy.
    image = white_image(PlenopticCamera(detector_width=3.2, resolution=(800, 720)), grid)
    y, x = (np.linspace(-1, 1, n) for n in image.shape)
    image = 900 * image * (1 - 0.15 * (x**2 + y[:, None] ** 2)) + 40
    image += np.random.default_rng(0).normal(0, 20, image.shape)
    missed, spurious = distances(estimate_lens_grid(image), grid, image.shape)
    assert len(missed) > 1000
    assert np.sqrt(np.mean(missed**2)) < 0.05
    # Not a denser lattice that happens to hold the true one.
    assert spurious.max() < 0.1


@pytest.mark.parametrize(
    ("diameter", "lattice", "rotation", "pitch"),
    [
        (0.8, "hexagonal", 8.0, 12.5),
        (1.1, "square", 1.3, 8.3),
        # Here the fundamental wave vanishes, beyond it is negative.
        (1.22, "square", 14.0, 19.23),
        (1.25, "hexagonal", 3.0, 12.5),
    ],
)
def test_lattices_of_micro_images_that_overlap(diameter, lattice, rotation, pitch):
    """Not the lattice of the gaps, turned by 45 degrees and finer by the root of two."""
    wide = PlenopticCamera(mla_lattice=lattice, mla_rotation=rotation, mla_offset=(0.017, -0.023))
    scale = diameter / wide.micro_image_diameter * wide.micro_image_pitch
    step = wide.micro_image_pitch / pitch
    camera = wide.replace(
        aperture_radius=wide.aperture_radius * scale, resolution=(340, 300), detector_width=340 * step
    )
    image = np.random.default_rng(0).poisson(4000 * white_image(camera).clip(0)) + 300.0
    found = estimate_lens_grid(image)
    assert found.nearest_distance == pytest.approx(pitch, rel=1e-3)
    sides = 4 if lattice == "square" else 12
    assert abs((math.degrees(found.rotation) - rotation + 180 / sides) % (360 / sides) - 180 / sides) < 0.02
    missed, spurious = distances(found, lens_grid(camera), image.shape)
    assert max(missed.max(), spurious.max()) < 0.1


def test_colour_pictures_count_by_their_mean():
    white = white_image(PlenopticCamera(detector_width=0.512, resolution=(256, 256)))
    grey, colour = estimate_lens_grid(white), estimate_lens_grid(white[..., None] * [0.5, 1.0, 1.5])
    assert colour.offset == pytest.approx(grey.offset, abs=1e-3)
