"""Reconstruction by waves behind real main lenses: against the thin lens, and of points and scenes that are known."""

import numpy as np
import pytest
from cameras import WAVELENGTH, small_camera, thin_as_real

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, reconstruct
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.refocus.conjugates import RealConjugates
from mitsuba_plenoptic.refocus.lens_by_lens import reconstruct_lens_by_lens
from mitsuba_plenoptic.refocus.wave_methods import reconstruct_subsets
from tools.bench.cases import lens_models

METHODS = {"partial": {"interleave": "auto"}, "deconvolved": {"iterations": 10}}


def real_camera(lens="double_gauss", lenses=12, **numbers):
    """The paper's camera at half its size behind a real lens, with few lenses."""
    values = {"focal_length": 40, "aperture_radius": 2.5, "focus_distance": 120}
    values |= {"detector_width": 0.064 * lenses, "resolution": (32 * lenses, 32 * lenses)}
    return PlenopticCamera(main_lens=lens, **(values | numbers))


def test_phases_for_many_points_are_stigmatic_behind_ideal_lenses_only():
    """On the axis and in the corner of the field: parabolic lenses have their aberrations of the third order."""
    rows = list(lens_models.fields(f_numbers=(2.0, 10.0), blurs=(0.0,), places=(0.0, 1.0)))
    assert len(rows) == 8
    for row in rows:
        found = [row[name] for name in ("whole", "single", "laser")]
        if row["model"] == "ideal":
            assert max(found) < 1e-4
            assert row["axial"] > 2 or not row["degrees"]
        elif row["f_number"] == "10":
            camera = lens_models.camera_of(10.0)
            assert found[1] == found[2] == pytest.approx(third_order(camera, row["degrees"]), rel=0.03)


def third_order(camera, degrees):
    """Return the largest aberration in waves over the pupil of a thin parabolic lens, of a point off the axis."""
    g, b, f = camera.focus_distance, camera.mla_distance, camera.focal_length
    s, turn = np.tan(np.radians(degrees)), np.linspace(0, 2 * np.pi, 49)
    radius = np.linspace(0, camera.aperture_radius, 9)[:, None]
    square, along = radius**2, radius * np.cos(turn) * s
    path = -(square**2) / 8 * (1 / g**3 + 1 / b**3) + square * along / 2 * (1 / g**2 - 1 / b**2)
    path -= along**2 / (2 * f) + square * s**2 / (4 * f)
    return abs(path).max() / (lens_models.WAVELENGTH * 1e-6)


def test_the_thin_lens_by_the_way_of_real_ones_gives_its_reconstructions():
    """Light within the pupil, whose edge is drawn otherwise: in and out of focus."""
    camera = small_camera(4, mla_distance=118.0, lens_model="parabolic")
    x, y = camera.pixel_coordinates(0), camera.pixel_coordinates(1)[:, None]
    pitch = camera.micro_image_pitch
    inner = np.hypot(x % pitch - pitch / 2, y % pitch - pitch / 2) < 0.35 * camera.micro_image_diameter
    image = (inner * np.random.default_rng(0).uniform(0.5, 1, inner.shape)).astype(np.float32)
    real = RealConjugates(camera, thin_as_real(camera, 0.06, (1 / 290, 1 / 205)), WAVELENGTH, 1.0)
    for distance in (210.0, 280.0):
        assert real.distance(distance) == pytest.approx(distance)
        own, other = (
            reconstruct_lens_by_lens(image, camera, [distance], WAVELENGTH, oversample=2, conjugates=given)[0]
            for given in (None, real)
        )
        assert np.linalg.norm(other - own) < 2e-4 * np.linalg.norm(own)


def of_point(camera, place, distance):
    """Return the capture of a point that bins have at this place."""
    point = [(*(-place * distance / camera.mla_distance), distance)]
    capture = CaptureOperator(camera, point, wavelength=WAVELENGTH).forward(np.ones((1, 1)))[..., 0]
    return np.maximum(capture, 0)  # rounding


@pytest.mark.parametrize(
    "method", [pytest.param(method, marks=[pytest.mark.slow] * (method != "partial")) for method in METHODS]
)
def test_a_point_comes_back_to_its_place(method):
    """Out of focus, where the pupils' places stretch the image: bins count from the principal planes."""
    camera, distance, place = real_camera(), 108.0, np.array([0.144, -0.08])
    capture = of_point(camera, place, distance)
    options = {"camera": camera, "method": method, "wavelength": WAVELENGTH, **METHODS[method]}
    image = np.nan_to_num(reconstruct(capture, distance, **options).image)
    x = y = (np.arange(12) - 5.5) * 0.064
    light = np.where(np.hypot(x - place[0], y[:, None] - place[1]) < 0.15, image, 0)
    found = np.array([(light * x).sum(), (light * y[:, None]).sum()]) / light.sum()
    # Deconvolution puts it into the one bin that it lies in.
    assert np.hypot(*(found - place)) < (0.4 if method == "deconvolved" else 0.02) * 0.064
    assert light.sum() > 0.97 * image.sum()


@pytest.mark.slow
def test_zones_follow_the_aberrations_over_the_field():
    """A singlet's path changes so much over the field that one path for all of it blurs what is off the axis."""
    camera = real_camera("singlet", 48, crop_offset=(1216, 1216), crop_size=(320, 320), aperture_radius=4)
    g = 120.0
    capture = of_point(camera, np.array([1.31, 1.28]), g)
    real = RealConjugates.of(OpticalSystem(camera, WAVELENGTH), [g], 1)
    assert len(list(real.zones(real.distance(g)))) > 1
    width = {}
    for name, blur in (("zones", real.blur), ("one", 100.0)):
        used = RealConjugates(real.camera, real.lens, WAVELENGTH, blur)
        at = [used.distance(g)]
        total = reconstruct_subsets(capture, used.camera, at, WAVELENGTH, oversample=8, conjugates=used)[0]
        width[name] = total.max() / total.sum()
    assert width["zones"] > 1.1 * width["one"]
