"""White pictures of microscopes in the Fourier arrangement, rendered by rays: known cameras are found again."""

from dataclasses import replace

import numpy as np
import pytest
from cameras import sky

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.extensions.calibrate.calibration import fit_stop

LENS = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=90, field_stop=3.8)
KNOWN = mp.PlenopticCamera(
    main_lens=LENS, mla_pitch=0.9, mla_focal_length=10, mla_lattice="hexagonal", detector_width=5.4,
    resolution=(216, 216),
)  # fmt: skip


@pytest.mark.parametrize(
    ("known", "changes", "lens"),
    [
        (KNOWN, {"mla_pitch": 0.905, "mla_rotation": -3.7, "mla_offset": (0.2, -0.31)}, {"numerical_aperture": 0.47}),
        (
            KNOWN.replace(mla_lattice="square", main_lens=replace(LENS, field_stop_shape="square")),
            {"mla_pitch": 0.89, "mla_rotation": 2.1, "crop_offset": (21, 8), "crop_size": (190, 202)},
            {"field_stop": 3.55},
        ),
    ],
)
def test_a_microscope_is_found_from_its_white_picture(known, changes, lens):
    true = known.replace(main_lens=replace(known.main_lens, **lens), **changes)
    white = np.random.default_rng(0).poisson(sky(true, 64) * 500.0)
    white[10:180:40, 15::40], white[30:180:40, 15::40] = 30000, 0
    fit = fit_stop(white, known)
    found = fit.camera
    assert found.mla_pitch == pytest.approx(true.mla_pitch, rel=3e-4)
    assert found.mla_rotation == pytest.approx(true.mla_rotation, abs=0.02)
    assert found.main_lens.numerical_aperture == pytest.approx(true.main_lens.numerical_aperture, rel=1e-3)
    assert found.main_lens.field_stop == pytest.approx(true.main_lens.field_stop, rel=2e-3)
    # The camera sees the lenses, and the middle of the stop, where they are.
    places = [
        np.stack(camera.lattice.centre(*mp.design.lenses_in_stop(true)[0].T.astype(float)), -1) / camera.pixel_size
        + np.array(camera.resolution) / 2
        - camera.crop_offset
        for camera in (found, true)
    ]
    apart = np.hypot(*(places[0][:, None] - places[1]).T).min(0)
    assert np.sort(apart)[: len(apart) // 2].max() < 0.05
    axis = np.array(found.resolution) / 2 - found.crop_offset
    assert np.allclose(axis, np.array(true.resolution) / 2 - true.crop_offset, atol=0.4)
    assert fit.residual < 0.06


def test_what_shows_no_micro_images_is_refused():
    with pytest.raises(mp.InputError, match="alike"):
        fit_stop(np.ones((216, 216)), KNOWN)
    with pytest.raises(mp.InputError, match="finite"):
        fit_stop(np.where(np.eye(216), np.nan, 1), KNOWN)
    with pytest.raises(mp.InputError, match="no white picture"):
        fit_stop(np.random.default_rng(0).random((108, 108)), KNOWN)
    with pytest.raises(mp.InputError, match="field_stop"):
        fit_stop(np.eye(216), KNOWN.replace(main_lens=replace(LENS, field_stop=None)))
