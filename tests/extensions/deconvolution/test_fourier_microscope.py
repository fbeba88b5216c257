"""Fourier microscopes deconvolved: against exact sums of point spreads, closed forms, and beads at known places."""

import math

import mitsuba as mi
import numpy as np
import pytest

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.design import lens_aperture, resolution_limit
from mitsuba_plenoptic.extensions.deconvolution.fourier import FourierResponse
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import radiance_weight

WAVELENGTH = 550.0
LENS = mp.Objective(20, 0.25, arrangement="fourier", fourier_focal_length=50)
SMALL = mp.PlenopticCamera(
    main_lens=LENS, mla_pitch=0.5, mla_focal_length=20.0, mla_offset=(0.25, 0.25), detector_width=1.5,
    resolution=(150, 150),
)  # fmt: skip


BINS = {
    "coarse odd pixels": (SMALL.replace(resolution=(61, 61), detector_width=1.525), 3, -2, 0.02),
    "hexagonal, three focal lengths": (
        SMALL.replace(mla_lattice="hexagonal", mla_offset=(0.1, 0), mla_focal_length=(18.0, 20.0, 23.0)), 1, -2, 0.02
    ),
    "crop": (SMALL.replace(crop_offset=(40, 13), crop_size=(80, 101)), 1, -2, 0.02),
    "warped": (SMALL.replace(mla_warp=(0.02, 0.01, -0.02)), 1, -2, 0.02),
    # Parallax takes the pictures of the outer lenses far beyond the image of the stop.
    "deep": (SMALL.replace(detector_width=5.0, resolution=(250, 250)), 1, 12, -0.9),
}  # fmt: skip
"""Cameras, with the bins a lens, the row of a bin and its depth."""


def response_of(camera, depths, oversample=1):
    return FourierResponse(camera, depths, wavelength=WAVELENGTH, oversample=oversample)


def bin_area(camera, oversample):
    """Of a bin in the native image."""
    return (camera.pixel_size / oversample * camera.mla_distance / camera.detector_distance) ** 2


def exact(camera, oversample, row, column, depth, parts=3):
    """Add exact spreads of even places in a bin, counted as they lie in a lens's picture."""
    columns, rows = (oversample * count for count in camera.bin_count)
    size = camera.bin_size(0) / oversample
    inner = (np.arange(parts) + 0.5) / parts
    x, y = np.meshgrid((column - columns / 2 + inner) * size, (row - rows / 2 + inner) * size)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, depth)])
    operator = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field")
    weight = radiance_weight(camera, main_lens(camera), bin_area(camera, oversample))
    return operator.forward(np.full(len(points), weight / len(points)))


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "crop")) for name in BINS])
def test_every_bin_has_its_exact_spread(name):
    """Even at the border of the field, from spreads of other points than the one that the response knows."""
    camera, oversample, row, depth = BINS[name]
    response = response_of(camera, [depth], oversample)
    values = np.zeros(response.shapes[0], np.float32)
    place = (row % len(values), values.shape[1] // 2 + 3)
    values[place] = 2
    found, expected = response.forward(values), 2 * exact(camera, oversample, *place, depth)
    assert found.sum() == pytest.approx(expected.sum(), rel=5e-3)
    # So few places of a deep bin do not tell the fringes of several lenses' light evenly.
    assert np.linalg.norm(found - expected) < (0.06 if name == "deep" else 0.01) * np.linalg.norm(expected)


def test_an_even_object_reads_1():
    """But for what isotropic light has less of in the middle of the stop than on the mean."""
    response = response_of(SMALL, [0.0])
    image = response.forward(np.ones(response.shapes[0], np.float32))
    alpha = LENS.half_angle
    mean = 2 * (1 - math.cos(alpha)) / math.sin(alpha) ** 2
    growth = LENS.magnification / LENS.last_focal_length
    x = (np.arange(64) + 0.5) / 64 * 0.5 - 0.25
    sine = np.hypot(x, x[:, None]) * growth
    assert image[65:85, 65:85].mean() == pytest.approx((1 / np.sqrt(1 - sine**2)).mean() / mean, rel=0.01)


def test_beads_come_back_to_their_planes_places_and_powers():
    depths, oversample = [-0.06, 0.0, 0.06], 2
    beads = np.array([[0.0083, -0.0041, -0.06], [-0.0112, 0.0067, 0.0], [0.0021, 0.0103, 0.06]])
    powers = np.array([1.0, 0.7, 1.2])
    image = mp.CaptureOperator(SMALL, beads, wavelength=WAVELENGTH, method="full_field").forward(powers)
    capture = mp.Capture(np.maximum(image, 0), SMALL, WAVELENGTH, "wave", {})
    found = mp.reconstruct(capture, depths, method="deconvolved", volume=True, oversample=oversample, iterations=60)
    assert found[0].facts["residual"] < 0.1
    for (X, Y, _), power, plane in zip(beads, powers, found, strict=True):
        assert plane.bin_size == pytest.approx(0.01 * 50 / (20 * 20) / oversample)
        # Pictures have +x to the left and +y up.
        y, x = ((size / 2 - np.arange(size) - 0.5) * plane.bin_size for size in plane.image.shape)
        light = np.nan_to_num(plane.image) * radiance_weight(SMALL, main_lens(SMALL), bin_area(SMALL, oversample))
        near = (np.abs(x - X) < 8 * plane.bin_size) & (np.abs(y - Y)[:, None] < 8 * plane.bin_size)
        mine = light * near
        assert mine.sum() == pytest.approx(power, rel=0.03)
        assert light[~near].sum() < 0.03 * power
        centre = [(mine.sum(0) @ x) / mine.sum(), (mine.sum(1) @ y) / mine.sum()]
        assert np.allclose(centre, [X, Y], atol=0.1 * plane.bin_size)


def test_the_limit_is_where_lenses_pass_nothing():
    """Of a square lens, whose spectrum falls evenly to zero in focus; depth puts lines out before."""
    cutoff = 2 * lens_aperture(SMALL) / (WAVELENGTH * 1e-6)
    limit = resolution_limit(SMALL, 0.0, WAVELENGTH)
    assert (limit.waves, limit.pixels) == pytest.approx((cutoff, 400.0))
    assert not limit.in_focus
    depth = 2 * WAVELENGTH * 1e-6 / lens_aperture(SMALL) ** 2
    assert resolution_limit(SMALL, depth, WAVELENGTH).waves == pytest.approx(cutoff / 2 * (1 - math.sqrt(0.5)))
    assert resolution_limit(SMALL, depth).waves == pytest.approx(1 / (2 * lens_aperture(SMALL) * depth))


@pytest.mark.parametrize("options", [{"method": "incoherent"}, {"method": "deconvolved", "iterations": 5}])
def test_bins_hold_the_radiance_of_a_disc_behind_a_field_stop(options):
    lens = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50, field_stop=2.0)
    camera = mp.PlenopticCamera(
        main_lens=lens, mla_pitch=0.5, mla_focal_length=6.0, detector_width=3, resolution=(120, 120)
    )
    turned = mi.ScalarTransform4f().translate([0.01, 0.02, 0.02]).rotate([0, 1, 0], 180).scale(0.03)
    disc = {"type": "disk", "to_world": turned, "emitter": {"type": "area", "radiance": 1.0}}
    scene = {"type": "scene", "sensor": camera.to_sensor(), "integrator": {"type": "path"}, "disc": disc}
    capture = mp.render_capture(mi.load_dict(scene), model="ray", spp=64)
    found = mp.reconstruct(capture, 0.02, wavelength=WAVELENGTH, **options)
    assert np.nansum(found.image) * found.bin_size**2 == pytest.approx(math.pi * 0.03**2, rel=0.03)
