"""Brightness of single lenses: exactly that of rays, and of waves of a lens whose neighbours are as bright."""

import json

import numpy as np
import pytest
from cameras import sky

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views.white import white_image

TABLE = np.array([[0.5, 1.0, 1.0, 1.0], [1.0, 1.0, 0.8, 1.0], [1.0, 1.25, 1.0, 1.0], [1.0, 1.0, 1.0, 0.9]])

PLAIN = mp.PlenopticCamera(resolution=(64, 64), detector_width=0.256)
"""Of 4 x 4 lenses with 16 x 16 pixels, as many as the table."""

CAMERA = PLAIN.replace(mla_transmissions=TABLE)


def test_tables_are_around_the_axis_and_rows_rise():
    """Row and column of the capture grow with y and x of the camera frame, as do those of the table."""
    assert CAMERA.mla_transmissions.first == (-2, -2)
    plain, found = (sky(camera, 16) for camera in (PLAIN, CAMERA))
    assert found == pytest.approx(plain * np.kron(TABLE, np.ones((16, 16))), abs=1e-6)
    assert white_image(CAMERA) == pytest.approx(white_image(PLAIN) * np.kron(TABLE, np.ones((16, 16))), abs=1e-6)


def test_waves_have_the_same_light_behind_each_lens():
    small = PLAIN.replace(resolution=(32, 32), detector_width=0.128)
    plain, found = (sky(small.replace(mla_transmissions=table), 16, "wave") for table in (None, TABLE[1:3, 1:3]))
    # A twentieth of the light is diffracted into other lenses' pixels.
    light = found.reshape(2, 16, 2, 16).sum((1, 3)) / plain.reshape(2, 16, 2, 16).sum((1, 3))
    assert light == pytest.approx(TABLE[1:3, 1:3], abs=0.02)


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
        assert mp.PlenopticCamera(mla_transmissions=tmp_path / name).mla_transmissions == CAMERA.mla_transmissions
    with pytest.raises(mp.InputError, match=r"mla_transmissions = LensTransmissions"):
        mp.CaptureOperator(CAMERA, [(0, 0, 240)], wavelength=633).derivative([1.0], {"mla_distance": 1.0})
