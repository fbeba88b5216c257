"""Captures and refocused images of other lattices, irregular arrays and responses by angle, by rays."""

import math

import mitsuba as mi
import numpy as np
import pytest
from cameras import disk, sky, white
from cases import scene_of

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import PlenopticCamera, design
from mitsuba_plenoptic.views import white_image
from tools.bench.cases.arrays import centroids

ROOT3 = math.sqrt(3)
HEXAGONAL = {"mla_lattice": "hexagonal"}
RECTANGULAR = {"mla_pitch": "0.064, 0.058"}
STRETCHED = {**HEXAGONAL, "mla_pitch": "0.058, 0.064"}
ROTATED = {"mla_rotation": 13.0, "mla_offset": "0.021, -0.008"}
MULTI_FOCUS = {**HEXAGONAL, "mla_focal_length": "0.47, 0.512, 0.56", "detector_distance": 0.512}


def white_capture(sensor, spp):
    return mp.render_capture(scene_of(sensor, sky={"type": "constant"}), spp=spp)


def model_centres(camera):
    """Micro-image centres in pixels of the recorded image, written out: lenses turned, moved and projected."""
    steps = np.arange(-200, 201.0)
    i, j = (axis.ravel() for axis in np.meshgrid(steps, steps))
    if camera.mla_lattice == "square":
        u, v = i + 0.5, j + 0.5
    else:
        u, v = i + 0.5 * (j % 2), ROOT3 / 2 * j
    angle = math.radians(camera.mla_rotation)
    u, v = u * camera.mla_pitches[0], v * camera.mla_pitches[1]
    x = math.cos(angle) * u - math.sin(angle) * v + camera.mla_offset[0]
    y = math.sin(angle) * u + math.cos(angle) * v + camera.mla_offset[1]
    scale = (camera.mla_distance + camera.detector_distance) / camera.mla_distance / camera.pixel_size
    return np.stack(
        [axis * scale + camera.resolution[k] / 2 - camera.crop_offset[k] for k, axis in enumerate((x, y))], axis=-1
    )


@pytest.mark.parametrize("lattice", [{}, {**HEXAGONAL, **ROTATED}, RECTANGULAR, {**STRETCHED, **ROTATED}], ids=str)
def test_micro_images_stand_where_the_lattice_says(camera_dict, lattice):
    crop = {"crop_offset_x": 4000, "crop_offset_y": 100, "crop_width": 96, "crop_height": 96}
    capture = white_capture(camera_dict(resolution=4096, detector_width=8.192, film=crop, **lattice), spp=256)
    centres = model_centres(capture.camera)
    centres = centres[((centres > 14) & (centres < 96 - 14)).all(1)]
    assert len(centres) >= 4
    assert np.abs(centroids(capture.image, centres) - centres).max() < 0.1


@pytest.mark.parametrize(
    "lattice",
    [
        {"aperture_radius": 10.0},
        {"mla_fill": 0.6, "mla_rotation": 20.0},
        {**HEXAGONAL, "mla_aperture": "circle", "aperture_radius": 9.0},
        MULTI_FOCUS,
        {**RECTANGULAR, "mla_aperture": "circle"},
        {**STRETCHED, "mla_rotation": 20.0, "mla_fill": 0.9},
    ],
    ids=str,
)
def test_mean_of_a_white_capture_is_the_closed_form_and_the_computed_one(camera_dict, lattice):
    capture = white_capture(camera_dict(resolution=256, **lattice), spp=256)
    camera = capture.camera
    # Under this window the pattern of the lenses averages out.
    window = np.hanning(258)[1:-1]
    mean = window @ capture.image.astype(np.float64) @ window / window.sum() ** 2
    assert mean == pytest.approx(mp.design.white_mean(camera), rel=5e-3)
    area = math.prod(camera.mla_pitches) * (ROOT3 / 2 if camera.mla_lattice == "hexagonal" else 1)
    by_hand = math.pi * (camera.aperture_radius * 0.512 / 120.512) ** 2 / area
    assert mp.design.white_mean(camera) == pytest.approx(by_hand, rel=1e-6)
    inner = (slice(20, -20), slice(20, -20))
    difference = (white_image(camera) - capture.image)[inner]
    assert abs(difference.mean()) < 2e-3
    if camera.aperture_radius == 5:
        assert np.sqrt(np.mean(difference**2)) < 0.03


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
    camera = mp.PlenopticCamera.preset("lytro").replace(lens_model="parabolic", **crop, **more)
    # A warning of missed light fails the test.
    capture = white_capture(camera.to_sensor(), 128)
    window = np.hanning(82)[1:-1]
    mean = window @ capture.image.astype(np.float64) @ window / window.sum() ** 2
    assert mean == pytest.approx(mp.design.white_mean(camera), rel=0.012)


def test_opaque_gaps_swallow_what_is_focused_on_them(camera_dict):
    """A small source in focus, imaged 0.02 mm from a lens's centre, is within a lens, but not within half of one."""

    def brightness(x, fill):
        # The lens at the axis's upper right has its centre at 0.032 mm on both axes.
        source = disk([-2 * x, -2 * 0.032, 240], 2e-3)
        scene = scene_of(camera_dict(resolution=64, detector_width=0.128, mla_fill=fill), source=source)
        return mp.render_capture(scene, spp=2048, seed=1).image.sum()

    assert brightness(0.052, 0.5) == 0
    assert brightness(0.052, 1.0) > 0
    # The mean over a quarter of the lens that holds all of the light is four times as much.
    assert brightness(0.032, 0.5) / brightness(0.032, 1.0) == pytest.approx(4, rel=0.1)


def test_indices_of_lenses_that_floats_cannot_hold():
    """Lenses of several focal lengths; an index of a type beyond their table ended in a segmentation fault."""
    camera = mp.PlenopticCamera(
        focal_length=1e-9, aperture_radius=1e-9, mla_distance=1e9, mla_focal_length=(0.512, 0.6144, 0.4655),
        mla_pitch=1.5e-8, detector_distance=0.512, detector_width=1e9, resolution=(63, 1), mla_fill=0.16,
        mla_lattice="hexagonal",
    )  # fmt: skip
    assert white_capture(camera.to_sensor(), 1).image.shape == (1, 63)


REGULAR = PlenopticCamera(resolution=(512, 512), detector_width=1.024)
SMALL = REGULAR.replace(resolution=(64, 64), detector_width=0.128)


def test_micro_images_lie_behind_displaced_lenses():
    """The middle of each is the chief ray through its lens's centre, c (b + z) / b, to 0.03 pixels."""
    camera = REGULAR.replace(mla_jitter=(0.002, 0.0), mla_seed=5)
    image = sky(camera, 64)
    misses, shifts = [], []
    for i in range(-6, 6):
        for j in range(-6, 6):
            lens = camera.lenslet(np.array([i]), np.array([j]))
            regular = (np.array([i, j]) + 0.5) * camera.mla_pitch
            centre = np.concatenate(lens.centre)
            expected, nominal = (
                c * (1 + camera.detector_distance / camera.mla_distance) / camera.pixel_size + 256
                for c in (centre, regular)
            )
            # The micro-image is 21 pixels wide and its neighbour 32 away.
            low = np.rint(nominal).astype(int) - 14
            part = image[low[1] : low[1] + 28, low[0] : low[0] + 28]
            place = [np.sum(part * (np.arange(28) + 0.5)[None, :]), np.sum(part * (np.arange(28) + 0.5)[:, None])]
            misses.append(np.array(place) / part.sum() + low - expected)
            shifts.append(expected - nominal)
            assert lens.focal_length == camera.mla_focal_length
    assert np.abs(misses).max() < 0.03
    assert np.std(shifts) == pytest.approx(0.002 * (1 + 0.512 / 120) / 0.002, rel=0.15)


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
    window = np.outer(np.hanning(514)[1:-1], np.hanning(514)[1:-1])
    assert np.average(images.mean(0), weights=window) == pytest.approx(design.white_mean(camera), rel=2e-3)
    # Without knowledge of the lenses that light a pixel, more than half have a deviation of 0.1 to 0.5.
    assert np.median(images.std(0)) == 0


def test_pixels_that_answer_to_angles():
    """White pixels have the response at their angles of incidence, averaged over the lens."""
    pairs = (0.0, 1.0, 10.0, 0.2)
    camera = REGULAR.replace(pixel_response=pairs, resolution=(32, 32), detector_width=0.064, mla_offset=(0.032, 0.032))
    image = sky(camera, 2048)
    x = camera.pixel_coordinates(0)
    m = (np.arange(400) + 0.5) / 400 * 0.064 - 0.032
    for column in (16, 20, 24):
        # A pixel of the middle row; places on the lens by a plain sum.
        dx, dy = np.meshgrid(m - x[column], m - x[16])
        angle = np.degrees(np.arctan(np.hypot(dx, dy) / 0.512))
        expected = np.interp(angle, pairs[::2], pairs[1::2]).mean()
        assert image[16, column] == pytest.approx(expected, rel=0.01)
