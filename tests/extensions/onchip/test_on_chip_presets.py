"""Presets of cameras: methods that know regular arrays take those whose lenses are aligned to chief rays."""

import numpy as np
import pytest

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.fitting import View
from mitsuba_plenoptic.points.units import brightness_of
from mitsuba_plenoptic.refocus import RayRefocus

ON_CHIP = ("full_frame_dual", "phone_quad", "phone_quad_bayer")
LENSES = 5


def around(name, part):
    """Return the crop of five by five lenses at a part of the half diagonal, and the middle lens's indices."""
    camera = mp.PlenopticCamera.preset(name)
    half = np.array(camera.resolution) // 2
    index = (part * half / 2).astype(int)
    corner = half + 2 * index - (LENSES - 1)
    return camera.replace(crop_offset=tuple(corner.tolist()), crop_size=(2 * LENSES, 2 * LENSES)), index


@pytest.mark.parametrize("name", ON_CHIP)
def test_regular_lenses_are_where_the_aligned_ones_are(name):
    camera, index = around(name, part := 0.95)
    i, j = (np.array([-2.0, 0.0, 2.0]) + start for start in index)
    place, near = camera.lattice.regular.centre(i, j), camera.regular.lattice.centre(i, j)
    assert not camera.regular.mla_cra
    shift = np.array(camera.lattice.centre(i, j)) - place
    assert np.max(np.abs(shift)) > part * 2e-4
    for regular_place, aligned, aside in zip(near, place, shift, strict=True):
        assert regular_place == pytest.approx(aligned + aside, abs=2e-6)


@pytest.mark.parametrize("name", ON_CHIP[:2])
def test_points_are_captured_as_banks_have_them(name):
    camera, index = around(name, 0.9)
    (i, j), distance = index, 0.98 * camera.focus_distance
    middle = np.array(camera.lattice.regular.centre(float(i), float(j)))
    lens = np.array(camera.lattice.centre(float(i), float(j)))
    point = (*(-lens * distance / camera.mla_distance).tolist(), distance)
    operator = mp.CaptureOperator(camera, [point], wavelength=550, accuracy=0)
    field = [tuple(middle.tolist())]
    bank = mp.psf_bank(camera, [distance], field, layout=(2, 2), model="wave", size=LENSES)[0, 0]
    image = operator.forward([1.0]).reshape(LENSES, 2, LENSES, 2).transpose(1, 3, 0, 2)
    assert image.sum() > 0.2
    assert np.linalg.norm(image - bank.values) < 0.01 * np.linalg.norm(image)


@pytest.mark.filterwarnings("ignore:fit")
def test_methods_of_regular_arrays_take_aligned_presets():
    """Small crops, as full presets need much memory; the smallest results tell that light arrives."""
    camera, _ = around("phone_quad", 0.5)
    regular, distance = camera.regular, camera.focus_distance
    place = np.array([camera.pixel_coordinates(axis).mean() for axis in (0, 1)])
    points = [(*(-place * distance / camera.mla_distance).tolist(), distance)]
    operator = mp.CaptureOperator(camera, points, wavelength=550)
    image = operator.forward([1.0])
    assert image == pytest.approx(mp.CaptureOperator(regular, points, wavelength=550).forward([1.0]))
    assert operator.gradient([1.0], image)["detector_distance"] != 0
    system = OpticalSystem(regular, 550)
    view = View(brightness_of(regular, system.lens) * image, points, [1.0], noise=1e-3)
    fit = mp.fit(camera, view, "mla_focal_length", wavelength=550, accuracy=0.01, steps=2)
    assert fit.camera.mla_focal_length == pytest.approx(camera.mla_focal_length, rel=1e-3)
    assert not fit.camera.mla_cra
    even = np.ones(camera.shape, np.float32)
    assert mp.decode(even, camera=camera).shape[2:] == (LENSES, LENSES)
    assert RayRefocus(camera, distance).camera == regular


def test_dual_pixels_whose_spots_are_wider_than_a_pixel_are_told():
    camera = mp.PlenopticCamera.preset("phone_quad")
    wavelength = 550 * mp.design.mla_fresnel_number(camera, 550) / 0.49
    (warning,) = mp.design.design_warnings(camera, wavelength)
    assert "their Fresnel number is 0.49" in warning
