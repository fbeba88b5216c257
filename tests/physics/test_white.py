"""A white scene is as bright by waves as by rays, for every kind of camera, and its light field reads 1."""

import dataclasses
import gc

import numpy as np
import pytest
from cameras import CAMERAS, sky, white

from mitsuba_plenoptic import PlenopticCamera, Vignetting, decode, render_capture
from mitsuba_plenoptic.array import Conic
from mitsuba_plenoptic.views import capture_white, micro_images, model_white, white_pixels


@pytest.mark.parametrize(
    ("name", "pixels"), [("square", 64), pytest.param("three focal lengths", 128, marks=pytest.mark.slow)]
)
def test_views_of_a_white_scene_by_waves_read_one(name, pixels):
    calls, camera = [], CAMERAS[name].replace(resolution=(pixels, pixels))
    capture = render_capture(white(camera), spp=16, model="wave")
    lf = decode(capture, progress=lambda *work: calls.append(work))
    assert calls and calls[-1][0] == calls[-1][1]
    # A file with an equal camera, read when the first capture is gone.
    twin = dataclasses.replace(capture, camera=type(camera).from_dict(camera.to_dict()))
    del capture
    gc.collect()
    calls.clear()
    images = micro_images(twin)
    decode(twin, progress=lambda *work: calls.append(work))
    assert not calls
    for values, weight in ((lf.values.mean((2, 3)), lf.weight.values.min((2, 3))), (images.values, images.weight)):
        assert values[weight > 0].mean() == pytest.approx(1, abs=0.002)
    # By a white image of rays, up to 1.26, and more.
    assert np.abs(lf.values.mean((2, 3))[lf.weight.values.min((2, 3)) > 0] - 1).max() < 0.05


NARROWING = Vignetting([0.9, 0.1, 0, -0.3, 0, -0.3], scale=0.2, ellipse_y=[0.05], apodisation_2=[-0.3])
KEPLERIAN = {
    "detector_width": 0.25, "mla_pitch": 0.125, "mla_focal_length": 0.5, "detector_distance": 0.7,
    "mla_distance": 60, "focal_length": 50, "aperture_radius": 6.25,
}  # fmt: skip
GAUSS = {"vignetting": None, "main_lens": "double_gauss", "focal_length": 80, "aperture_radius": 8}


@pytest.mark.parametrize(
    "changes",
    [
        {"mla_medium": 1.5, "pixel_response": (0.0, 1.0, 8.0, 0.5), "mla_absorption": 0.5},
        *(
            pytest.param(changes, marks=pytest.mark.slow)
            for changes in (
                {"vignetting": None, "mla_cra": (0.0, 0.0, 0.03, 0.4, 0.06, 0.3)},
                {"mla_lattice": "hexagonal"},
                KEPLERIAN | {"mla_lattice": "hexagonal", "mla_focal_length": (0.45, 0.5, 0.55), "mla_tilt": (2.0, 1.0)},
                GAUSS | {"mla_fill": 0.8},
                {"aperture_image": [[0, 1, 1, 0], [1, 0.3, 0, 1], [1, 0, 0, 1], [0, 1, 1, 0]]},
            )
        ),
    ],
)
def test_white_by_rays_has_little_noise(changes):
    """The root mean square error is below 0.2 % of the level; the product of differences has no noise of captures."""
    camera = PlenopticCamera(**{"detector_width": 0.1024, "resolution": (48, 40), "vignetting": NARROWING, **changes})
    captures = [sky(camera, 2**14, seed=seed) for seed in (0, 1)]
    little_noise(white_pixels(camera), captures, 0.004 if "aperture_image" in changes else 0.002)


def little_noise(found, captures, limit):
    found = found.astype(float)
    error = np.mean(np.prod([found - capture for capture in captures], axis=0)[found > 0.01 * found.max()])
    assert error < (limit * np.quantile(found, 0.95)) ** 2
    assert found.mean() == pytest.approx(np.mean(captures, dtype=float), rel=5e-4)


@pytest.mark.parametrize("change", [{"lens_model": "parabolic"}, {"mla_shape": Conic(0.288), "mla_focal_length": None}])
@pytest.mark.parametrize("medium", [1.0, 1.5])
def test_lenses_that_turn_cosines_have_the_light_of_the_pupil(change, medium):
    """Rays from even points of a detector in air would bring 4 % more through lenses of f/3."""
    values = {"mla_pitch": 0.19, "mla_focal_length": 0.576, "detector_distance": 0.576, "mla_distance": 60.0}
    values |= {"mla_medium": medium, "aperture_radius": 10.0, "focal_length": 40.0} | change
    period = 0.19 * (1 + 0.576 / medium / 60)
    camera = PlenopticCamera(**values, detector_width=8 * period, resolution=(128, 128))
    inner = camera.replace(crop_offset=(16, 16), crop_size=(96, 96))
    for image in (sky(inner, 256), white_pixels(inner)):
        assert image.mean() == pytest.approx(np.pi * 10**2 / (16 * camera.pupil_step) ** 2, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"mla_jitter": (0.001, 0.0), "mla_transmissions": [[0.6, 1.0], [0.9, 0.7]], "mla_absorption": 0.5},
        GAUSS | {"mla_lattice": "hexagonal", "mla_fill": 0.8},
    ],
)
def test_white_by_waves_has_little_noise(changes, monkeypatch):
    # Where rays were random, as few as for a large detector.
    monkeypatch.setattr(model_white, "_RAYS", 0)
    camera = PlenopticCamera(**{"detector_width": 0.1024, "resolution": (48, 40), "vignetting": NARROWING, **changes})
    captures = [render_capture(white(camera), model="wave", spp=2**10, seed=seed) for seed in (1, 2)]
    little_noise(capture_white(captures[0], 1)[..., 0], [capture.image for capture in captures], 0.002)


@pytest.mark.slow
def test_rays_that_turn_back_in_a_lens_tell_no_edge():
    size = {"mla_pitch": 0.19, "detector_width": 3.04, "resolution": (96, 96)}
    camera = PlenopticCamera(main_lens="phone", focal_length=4.14, focus_distance=200, **size)
    length = 0.49 * camera.mla_pitch * camera.pupil_distance / camera.pupil_radius
    white = white_pixels(camera := camera.replace(mla_focal_length=length, detector_distance=length))
    assert white[48, 48] < 1e-3 and white.mean() == pytest.approx(sky(camera, 64).mean(), rel=0.003)


def test_the_medium_is_deeper_behind_lenses_that_a_tilt_raises():
    """By rays and in white images, as by waves; left of the axis the array is nearer to the detector."""
    tilted = PlenopticCamera(
        detector_width=4.096, resolution=(256, 256), mla_pitch=0.256, mla_focal_length=2.048, mla_tilt=(2.0, 0.0)
    )
    clear, dimmed = ((sky(c, 64), white_pixels(c)) for c in (tilted, tilted.replace(mla_absorption=0.5)))
    # At x = +-1.28 mm.
    for plain, dim in zip(clear, dimmed, strict=True):
        left, right = (dim[:, s].sum() / plain[:, s].sum() for s in (slice(32, 64), slice(192, 224)))
        assert right / left == pytest.approx(np.exp(-0.5 * 2 * 1.28 * np.tan(np.deg2rad(2.0))), abs=0.005)
