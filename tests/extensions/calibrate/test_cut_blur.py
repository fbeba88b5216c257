"""Corners whose blur the pupil cuts, summed ray by ray over a lens, are met where the lens's centre sees them."""

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.extensions.calibrate.blur import CutBlur
from mitsuba_plenoptic.extensions.calibrate.boards import find_saddles

CAMERA = PlenopticCamera.preset("raytrix").replace(mla_aperture="circle")
COUNT, SIDE = 20, 23
RADIUS = CAMERA.micro_image_diameter / 2 / CAMERA.pixel_size


def micro_images(kind, distance, place, angles):
    """Draw micro-images, side by side, of corners seen at places from their middle; and white ones.

    Rays from pixels through points of the lens are refracted and followed to the pupil, and to the plane in which the
    main lens images the corner, at this distance before the array.
    """
    b, z, size = CAMERA.mla_distance, CAMERA.detector_distance, CAMERA.pixel_size
    f, generator = np.array(CAMERA.mla_focal_lengths)[kind], np.random.default_rng(5)
    points = generator.uniform(-1, 1, (800, 2))
    lens = points[np.hypot(*points.T) < 1] * CAMERA.lattice.aperture_width / 2
    image, white = np.zeros((2, SIDE, SIDE * COUNT))
    axis = np.arange(SIDE) - SIDE // 2
    for number, (corner, (first, second)) in enumerate(zip(place, angles, strict=True)):
        # The image of the corner, which the centre of the lens shows at its place.
        middle = -corner * size * distance / z
        for row, column in np.ndindex(SIDE, SIDE):
            pixel = (np.array([axis[column], axis[row]]) + generator.uniform(-0.5, 0.5, lens.shape)) * size
            slope = (lens - pixel) / z - lens / f
            open_ = np.hypot(*(lens + b * slope).T) < CAMERA.aperture_radius
            x, y = (lens + distance * slope - middle)[open_].T * (-z / distance / size)
            light = np.sign(np.cos(first) * y - np.sin(first) * x) * np.sign(np.cos(second) * y - np.sin(second) * x)
            white[row, number * SIDE + column] = open_.mean()
            image[row, number * SIDE + column] = (0.5 + 0.4 * light).sum() / len(lens)
    return image, white


@pytest.mark.parametrize(("kind", "ratio"), [pytest.param(0, -0.2, marks=pytest.mark.slow), (1, -0.15)])
def test_corners_are_met_in_spite_of_the_rim(kind, ratio):
    # z/a; the disparity is that of neighbouring lenses in the array's plane, over the pitch of micro-images.
    over = CAMERA.detector_distance / CAMERA.mla_distance
    generator = np.random.default_rng(3)
    bearing, arm = generator.uniform(0, 2 * np.pi, COUNT), generator.uniform(0.35, 0.6, COUNT) * RADIUS
    place = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1) * arm[:, None]
    angles = generator.uniform(0, 0.5, (COUNT, 1)) + np.array([0, 1.5])
    image, white = micro_images(kind, CAMERA.detector_distance / ratio, place, angles)
    weight = np.where(white > 0.25 * white.max(), white, 0)
    centre = np.stack([np.arange(COUNT) * SIDE + SIDE // 2, np.full(COUNT, SIDE // 2)], axis=-1).astype(float)
    given = weight, centre + place + generator.uniform(-0.5, 0.5, place.shape), angles, centre
    cut, kinds = CutBlur(CAMERA), np.full(COUNT, kind)
    defocus = cut.defocus(kinds, np.full(COUNT, (ratio - over) / (1 + over)))
    assert defocus == pytest.approx(1 - CAMERA.detector_distance / CAMERA.mla_focal_lengths[kind] + ratio)
    outwards = []
    for seen in (None, lambda rows, arms: cut.displaced(kinds[rows], defocus[rows], arms)):
        found = find_saddles(image / np.maximum(white, 1e-9), *given, radius=RADIUS, even=RADIUS, displacement=seen)
        good = np.isfinite(found.deviation)
        assert good.sum() > 0.7 * COUNT
        miss = (found.position - centre - place)[good]
        outwards.append(float(((miss * place[good]).sum(1) / arm[good]).mean()))
    plain, mended = outwards
    assert abs(plain) > 0.15
    assert abs(mended) < 0.3 * abs(plain)
