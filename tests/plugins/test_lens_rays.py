"""Captures through real main lenses, by rays and by waves: traced pupils, files and names, and where light ends."""

import json

import mitsuba as mi
import numpy as np
import pytest
from cameras import white

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import PlenopticCamera, render_capture

WIDE = {"main_lens": "cooke_triplet", "focal_length": 16, "focus_distance": np.inf, "mla_focal_length": 0.3}
"""Light falls by a third to the corner, as the beam is cut by the outer surfaces."""


def pupil_of(camera, lens_centre):
    """Solid slope area in which light reaches a lens's centre, and the middle of these slopes."""
    lens = mp.LensSystem.of(camera)
    half = 1.6 * camera.pupil_radius / lens.pupil.distance
    axis = (np.arange(-400, 400) + 0.5) * (half / 400)
    tx, ty = (t.ravel() for t in np.meshgrid(axis, axis))
    tx, ty = tx - lens_centre[0] / lens.pupil.distance, ty - lens_centre[1] / lens.pupil.distance
    _, _, is_open = lens.trace(tuple(np.full_like(tx, c) for c in lens_centre), (tx, ty))
    return np.count_nonzero(is_open) * (axis[1] - axis[0]) ** 2, (tx[is_open].mean(), ty[is_open].mean())


@pytest.mark.parametrize("lens_index", [(40, 30), (60, -59)], ids=["field", "corner"])
def test_a_micro_image_is_the_traced_pupil(lens_index):
    """Its area to 0.5 %, its middle to 0.1 pixel, with the light that surfaces take away."""
    camera = mp.PlenopticCamera(**WIDE, aperture_radius=1.55)
    centre = tuple((index + 0.5) * camera.mla_pitch for index in lens_index)
    area, middle = pupil_of(camera, centre)
    assert lens_index == (40, 30) or area < 0.85 * pupil_of(camera, (0.0, 0.0))[0]
    z, pixel = camera.detector_distance, camera.pixel_size
    place = [(c - z * t) / pixel + 2048 for c, t in zip(centre, middle, strict=True)]
    half = round(camera.micro_image_pitch / pixel / 2)
    offset = tuple(round(p) - half for p in place)
    cropped = camera.replace(crop_offset=offset, crop_size=(2 * half, 2 * half))
    image = np.array(mi.render(white(cropped), spp=256))[..., 0]
    assert image.max() == pytest.approx(1, abs=1e-5)
    # Slope t of a lens lights the detector at c - z t.
    assert image.sum() * pixel**2 == pytest.approx(area * z**2, rel=5e-3)
    x = np.arange(2 * half) + 0.5
    assert image.sum(0) @ x / image.sum() + offset[0] == pytest.approx(place[0], abs=0.1)
    assert image.sum(1) @ x / image.sum() + offset[1] == pytest.approx(place[1], abs=0.1)


def test_xml_takes_a_file_a_name_or_text(tmp_path):
    lens = mp.read_prescription("tessar")
    (tmp_path / "mine.yaml").write_text(json.dumps(lens.to_plain()))
    for value in ("mine.yaml", "tessar.yaml", "tessar", json.dumps(lens.to_plain()).replace('"', "&quot;")):
        (tmp_path / "scene.xml").write_text(
            f'<scene version="3.0.0"><sensor type="plenoptic"><string name="main_lens" value="{value}"/>'
            '<float name="focus_distance" value="400"/>'
            '<film type="hdrfilm"><rfilter type="box"/></film></sensor></scene>'
        )
        camera = mp.PlenopticCamera.from_sensor(mp.load_scene(str(tmp_path / "scene.xml")).sensors()[0])
        assert camera.main_lens == lens and camera.focus_distance == pytest.approx(400)


@pytest.mark.slow
def test_light_ends_where_the_field_of_the_lens_ends():
    """Along a radius of a film wider than the field, of 18.3 mm; the pupil closes to a sliver there."""
    wide = {"focal_length": 50, "aperture_radius": 5, "focus_distance": 1000, "detector_width": 52}
    wide |= {"resolution": (650, 650), "crop_offset": (450, 320), "crop_size": (200, 10)}
    scene = white(PlenopticCamera(main_lens="double_gauss", mla_lattice="none", **wide))
    # Means over five lenses, 2 mm.
    rays, waves = (
        render_capture(scene, spp=64, **options).image.mean(0).reshape(8, 25).mean(1)
        for options in ({}, {"model": "wave", "wavelength": 633.0})
    )
    assert rays[0] > 0.7 and 0 < rays[4] < 0.02 < rays[3] and rays[5:].max() == 0
    assert np.abs(waves - rays).max() < 0.02
    assert np.abs(waves[5:]).max() < 1e-4
