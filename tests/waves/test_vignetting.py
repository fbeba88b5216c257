"""Vignetting and the brightness of single lenses: by rays, by waves, and in white images."""

import json

import numpy as np
import pytest
import scipy.ndimage
from cameras import sky

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, PlenopticCamera, Vignetting, reconstruct
from mitsuba_plenoptic.views import white_image

VIGNETTING = Vignetting(
    radius=[0.95, 0.0, 0.0, -0.15, 0.02, -0.1], scale=0.6, ellipse_x=[0.03, 0.02, 0.0], ellipse_y=[0.02],
    slope_x=[0.1, 0.1, 0.0], slope_y=[-0.05], apodisation_2=[-0.2], apodisation_4=[0.05],
    transmission=[0.1, -0.1, 0.05, 0, 0.2, 0, -0.1], harmonics=[0.02, -0.03, 0.0, 0.02],
)  # fmt: skip

# The detector is in the image of the pupil, so that a pixel sees one place of it through the whole lens.
CAMERA = PlenopticCamera(
    focal_length=50, aperture_radius=3.5, mla_distance=60, mla_focal_length=1.2, detector_distance=60 / 49,
    mla_pitch=0.15, detector_width=1.2, resolution=(240, 160), vignetting=VIGNETTING,
)  # fmt: skip


def expected(camera):
    """Transmission at the pupil points that pixels see through the centres of their lenses."""
    x, y = np.meshgrid(camera.pixel_coordinates(0), camera.pixel_coordinates(1))
    b, z, pitch = camera.mla_distance, camera.detector_distance, camera.mla_pitch
    cx, cy = ((np.floor(value * b / (b + z) / pitch) + 0.5) * pitch for value in (x, y))
    pupil = [(c - (p - c) * b / z) / camera.pupil_radius for p, c in ((x, cx), (y, cy))]
    return (np.hypot(*pupil) <= 1) * camera.vignetting.power(*pupil, cx, cy)


def test_micro_images_are_the_transmission_of_the_pupil():
    wanted, white, rays = expected(CAMERA), white_image(CAMERA), sky(CAMERA, 64)
    # Away from the rim, which moves over a lens, a pixel's mean is its middle's value.
    inside = scipy.ndimage.binary_erosion(wanted > 0, iterations=3)
    assert inside.mean() > 0.3
    assert np.abs(white - wanted)[inside].max() < 0.02
    assert np.sqrt((rays - wanted)[inside].var()) < 0.01
    assert white.mean() == pytest.approx(wanted.mean(), rel=0.005)
    # Lenses at the border see a smaller pupil.
    assert wanted[:61, :61].mean() < 0.85 * wanted[49:110, 89:150].mean()


def test_waves_have_the_vignetting_of_rays():
    waves, white = sky(CAMERA, 32, "wave", wavelength=550.0), white_image(CAMERA)
    assert waves.mean() == pytest.approx(white.mean(), rel=0.01)
    # Diffraction blurs rims by a pixel.
    blocks = [image.reshape(16, 10, 24, 10).mean((1, 3)) for image in (waves, white)]
    assert np.sqrt(((blocks[0] - blocks[1]) ** 2).mean()) < 0.02 * blocks[1].mean()
    plain = white_image(CAMERA.replace(vignetting=None)).reshape(16, 10, 24, 10).mean((1, 3))
    assert np.sqrt(((blocks[0] - plain) ** 2).mean()) > 0.1 * plain.mean()


@pytest.mark.parametrize(
    ("outline", "turned"),
    [({"radius": [0.7]}, {}), ({"radius": [0.8, 0.2, 0], "scale": 0.3}, {"mla_tilt": (0.3, -0.2)})],
)
def test_light_that_an_outline_keeps_out_is_not_missing_from_refocused_images(outline, turned):
    """Ray captures of white; coherent images of the even camera's white are 0.98 to 1.02 as well."""
    camera = PlenopticCamera(resolution=(256, 256), detector_width=0.512, vignetting=outline, **turned)
    white = Capture(white_image(camera), camera, wavelength=633.0)
    for method, distance, most in (("ray", 240, 0.01), ("ray", 225, 0.02), ("coherent", 240, 0.04)):
        assert np.abs(reconstruct(white, distance, method=method).image - 1).max() < most
        divided = reconstruct(white, distance, method=method, white=white).image
        assert divided == pytest.approx(np.ones_like(divided), abs=1e-3)


TABLE = np.array([[0.5, 1.0, 1.0, 1.0], [1.0, 1.0, 0.8, 1.0], [1.0, 1.25, 1.0, 1.0], [1.0, 1.0, 1.0, 0.9]])

PLAIN = mp.PlenopticCamera(resolution=(64, 64), detector_width=0.256)
"""Of 4 x 4 lenses with 16 x 16 pixels, as many as the table."""

UNEQUAL = PLAIN.replace(mla_transmissions=TABLE)


def test_tables_are_around_the_axis_and_rows_rise():
    """Row and column of the capture grow with y and x of the camera frame, as do those of the table."""
    assert UNEQUAL.mla_transmissions.first == (-2, -2)
    plain, found = (sky(camera, 16) for camera in (PLAIN, UNEQUAL))
    assert found == pytest.approx(plain * np.kron(TABLE, np.ones((16, 16))), abs=1e-6)
    assert white_image(UNEQUAL) == pytest.approx(white_image(PLAIN) * np.kron(TABLE, np.ones((16, 16))), abs=1e-6)


def test_rows_of_hexagonal_lattices_are_straight():
    """A column of the table is nearly upright: lens (i, j) has the column i + floor(j / 2)."""
    camera = mp.PlenopticCamera(mla_lattice="hexagonal")
    j = np.arange(-4, 5.0)
    i = -np.floor(j / 2)
    x, _ = camera.lattice.centre(i, j)
    assert x.max() == pytest.approx(camera.mla_pitch / 2)
    table = mp.LensTransmissions(np.tile([0.5, 0.6, 0.7], (9, 1)), first=(-1, -4))
    assert table.at(camera.lattice, i, j) == pytest.approx(np.full(9, 0.6))
    assert table.at(camera.lattice, i + 7, j) == pytest.approx(np.ones(9))


def test_files_and_refusals(tmp_path):
    np.save(tmp_path / "gains.npy", TABLE)
    (tmp_path / "gains.json").write_text(json.dumps({"values": TABLE.tolist(), "first": [-2, -2]}))
    for name in ("gains.npy", "gains.json"):
        assert mp.PlenopticCamera(mla_transmissions=tmp_path / name).mla_transmissions == UNEQUAL.mla_transmissions
    with pytest.raises(mp.InputError, match=r"mla_transmissions = LensTransmissions"):
        mp.CaptureOperator(UNEQUAL, [(0, 0, 240)], wavelength=633).derivative([1.0], {"mla_distance": 1.0})
