"""Captures of other lattices and irregular arrays, by rays."""

import math

import mitsuba as mi
import numpy as np
import pytest
from cameras import LATTICES, disk, sky, white
from cases import scene_of

from mitsuba_plenoptic import PlenopticCamera, design, render_capture
from tools.bench.cases.arrays import centroids

HEXAGONAL = {"mla_lattice": "hexagonal"}
STRETCHED = LATTICES["stretched"] | {"mla_rotation": 13.0, "mla_offset": (0.021, -0.008)}
REGULAR = PlenopticCamera(resolution=(512, 512), detector_width=1.024)
SMALL = REGULAR.replace(resolution=(64, 64), detector_width=0.128)


def mean_of(image):
    """Return the mean under a window, under which the pattern of the lenses averages out."""
    window = np.hanning(len(image) + 2)[1:-1]
    return window @ image.astype(np.float64) @ window / window.sum() ** 2


def model_centres(camera):
    """Micro-image centres in pixels of the recorded image, written out: lenses turned, moved and projected."""
    steps = np.arange(-200, 201.0)
    i, j = (axis.ravel() for axis in np.meshgrid(steps, steps))
    if camera.mla_lattice == "square":
        u, v = i + 0.5, j + 0.5
    else:
        u, v = i + 0.5 * (j % 2), math.sqrt(0.75) * j
    angle = math.radians(camera.mla_rotation)
    u, v = u * camera.mla_pitches[0], v * camera.mla_pitches[1]
    x = math.cos(angle) * u - math.sin(angle) * v + camera.mla_offset[0]
    y = math.sin(angle) * u + math.cos(angle) * v + camera.mla_offset[1]
    scale = (camera.mla_distance + camera.detector_distance) / camera.mla_distance / camera.pixel_size
    return np.stack([x, y], axis=-1) * scale + np.array(camera.resolution) / 2 - camera.crop_offset


@pytest.mark.parametrize("lattice", [{}, STRETCHED], ids=str)
def test_micro_images_stand_where_the_lattice_says(lattice):
    camera = PlenopticCamera(**lattice, crop_offset=(4000, 100), crop_size=(96, 96))
    centres = model_centres(camera)
    centres = centres[((centres > 14) & (centres < 96 - 14)).all(1)]
    assert len(centres) >= 4
    assert np.abs(centroids(sky(camera, 256), centres) - centres).max() < 0.1


@pytest.mark.parametrize(
    "changes",
    [
        {"aperture_radius": 10.0},
        {"mla_fill": 0.6, "mla_rotation": 20.0},
        {**HEXAGONAL, "mla_aperture": "circle", "aperture_radius": 9.0},
        {**STRETCHED, "mla_fill": 0.9},
    ],
    ids=str,
)
def test_mean_of_a_white_capture_is_the_closed_form(changes):
    camera = REGULAR.replace(resolution=(256, 256), **changes)
    area = math.prod(camera.mla_pitches) * (math.sqrt(0.75) if camera.mla_lattice == "hexagonal" else 1)
    by_hand = math.pi * (camera.aperture_radius * 0.512 / 120.512) ** 2 / area
    assert design.white_mean(camera) == pytest.approx(by_hand, rel=1e-6)
    assert mean_of(sky(camera, 256)) == pytest.approx(by_hand, rel=5e-3)


@pytest.mark.parametrize(
    ("corner", "more"),
    [
        (3200, {}),
        (1600, {"mla_lattice": "square", "mla_medium": 1.5, "aperture_radius": 2.2}),
        # Lenses whose own margin is small, but whose positions scatter.
        (1600, {"mla_jitter": (0.001, 0.0), "aperture_radius": 1.2}),
    ],
    ids=str,
)
def test_all_light_behind_fast_parabolic_lenses_is_found(corner, more):
    """Weights make rays that are even over the detector even over the pupil, in air and in a medium."""
    crop = {"crop_offset": (corner, corner), "crop_size": (80, 80)}
    camera = PlenopticCamera.preset("lytro").replace(lens_model="parabolic", **crop, **more)
    # A warning of missed light fails the test.
    assert mean_of(sky(camera, 128)) == pytest.approx(design.white_mean(camera), rel=0.012)


def test_opaque_gaps_swallow_what_is_focused_on_them():
    """A small source in focus, imaged 0.02 mm from a lens's centre, is within a lens, but not within half of one."""

    def brightness(x, fill):
        # The lens at the axis's upper right has its centre at 0.032 mm on both axes.
        scene = scene_of(SMALL.replace(mla_fill=fill).to_sensor(), source=disk([-2 * x, -2 * 0.032, 240], 2e-3))
        return render_capture(scene, spp=2048, seed=1).image.sum()

    assert brightness(0.052, 0.5) == 0
    assert brightness(0.052, 1.0) > 0
    # The mean over a quarter of the lens that holds all of the light is four times as much.
    assert brightness(0.032, 0.5) / brightness(0.032, 1.0) == pytest.approx(4, rel=0.1)


def test_indices_of_lenses_that_floats_cannot_hold():
    """Lenses of several focal lengths; an index of a type beyond their table ended in a segmentation fault."""
    camera = PlenopticCamera(
        focal_length=1e-9, aperture_radius=1e-9, mla_distance=1e9, mla_focal_length=(0.512, 0.6144, 0.4655),
        mla_pitch=1.5e-8, detector_distance=0.512, detector_width=1e9, resolution=(63, 1), mla_fill=0.16,
        mla_lattice="hexagonal",
    )  # fmt: skip
    assert sky(camera, 1).shape == (1, 63)


def test_focal_lengths_scatter():
    """Micro-images of lenses out of focus widen: the blur of each lens is that of a camera with its focal length."""
    camera = SMALL.replace(mla_jitter=(0.0, 0.08))
    found = sky(camera, 1024)
    for i, j in ((-1, -1), (0, -1), (-1, 0), (0, 0)):
        focal_length = float(camera.lenslet(np.array([i]), np.array([j])).focal_length[0])
        alone = sky(SMALL.replace(mla_focal_length=focal_length, detector_distance=0.512), 1024)
        own = np.s_[32 * (j + 1) : 32 * (j + 2), 32 * (i + 1) : 32 * (i + 2)]
        assert np.abs(found[own] - alone[own]).mean() < 4e-3
    assert np.abs(found - sky(SMALL, 1024)).mean() > 6e-3


@pytest.mark.parametrize(
    "more",
    [
        {"mla_jitter": (0.004, 0.0)},
        # Micro-images overlap.
        pytest.param({"mla_jitter": (0.002, 0.05), "aperture_radius": 8.0}, marks=pytest.mark.slow),
        {"aperture_radius": 8.0, "mla_pitch": (0.05, 0.07), "mla_rotation": 12.0},
    ],
    ids=str,
)
def test_noise_and_light_of_many_candidates(more):
    """A pixel that sees only a white wall has no noise, and the mean is the closed form."""
    camera = REGULAR.replace(**more)
    scene = white(camera)
    assert len(scene.sensors()[0]._rays.choice.lenses) > 1
    images = np.stack([np.array(mi.render(scene, spp=16, seed=seed))[..., 0] for seed in range(6)])
    assert mean_of(images.mean(0)) == pytest.approx(design.white_mean(camera), rel=2e-3)
    # Without knowledge of the lenses that light a pixel, more than half have a deviation of 0.1 to 0.5.
    assert np.median(images.std(0)) == 0
