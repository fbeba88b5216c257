"""Arrays aligned to chief rays, crosstalk of pixels, and tables of photodiodes' responses."""

import json
import math

import mitsuba as mi
import numpy as np
import pytest
from cameras import sky
from cases import facing, radiating, scene_of
from refusals import refused
from scipy.interpolate import RegularGridInterpolator

from mitsuba_plenoptic import PlenopticCamera, render_capture
from mitsuba_plenoptic.extensions.onchip.photodiode_response import PhotodiodeResponse

CAMERA = PlenopticCamera(
    focal_length=6.8, aperture_radius=6.8 / 3.6, focus_distance=1000.0, mla_focal_length=0.0045, mla_pitch=0.0024,
    detector_width=0.0384, resolution=(32, 32),
)  # fmt: skip
"""A telephone's camera, f/1.8, of 16 x 16 lenses above 2 x 2 pixels."""


# -- chief rays --------------------------------------------------------------------------------------


def test_a_linear_chief_ray_angle_is_a_smaller_pitch():
    """Tangents proportional to the height; the lenses' widths differ by z / (b + z)."""
    far = CAMERA.replace(resolution=(4000, 4000), detector_width=4.8, crop_offset=(3800, 1980), crop_size=(16, 32))
    b, z = far.mla_distance, far.detector_distance
    heights = np.linspace(0, 3.5, 60)
    pairs = np.stack([heights, np.degrees(np.arctan(heights / (b + z)))], axis=1).ravel()
    cameras = (far.replace(mla_cra=pairs), far.replace(mla_pitch=0.0024 * b / (b + z)), far)
    aligned, smaller, plain = (sky(camera, 256) for camera in cameras)
    assert np.abs(aligned - smaller).mean() < 0.003
    # Without either, the micro-images lie 0.8 pixels aside.
    assert np.abs(plain - smaller).mean() > 0.05


def test_shifts_of_more_than_a_pitch():
    """A steep chief ray, through a stop far outside of the axis: the light comes back into its own pixels."""
    camera = CAMERA.replace(resolution=(4000, 4000), detector_width=4.8, crop_offset=(3800, 1984), crop_size=(16, 32))
    shift = camera.detector_distance * math.tan(math.radians(60))
    assert shift > 3 * camera.mla_pitch
    image = sky(camera.replace(mla_cra=(0.0, 0.0, 1.0, 60.0, 4.0, 60.0)), 1024).sum(axis=0)
    same = sky(camera.replace(mla_offset=(-shift, 0.0)), 1024).sum(axis=0)
    assert camera.pixel_coordinates(0).min() > 2 and np.abs(image - same).max() < 0.02 * same.max()


@pytest.mark.slow
def test_waves_shift_lenses_as_rays_do():
    """Mean columns of micro-images of large lenses, which diffraction widens little, aside of those without a shift."""
    camera = PlenopticCamera(resolution=(512, 512), detector_width=8.192, crop_offset=(480, 248), crop_size=(16, 16))
    aligned = camera.replace(mla_cra=(0.0, 0.0, 5.0, 3.0))
    shots = [(aligned, "ray"), (aligned, "wave"), (camera, "wave")]
    rays, waves, plain = (sky(each, 256, model).reshape(16, 4, 4).mean((0, 1)) for each, model in shots)
    assert waves.sum() == pytest.approx(rays.sum(), rel=0.01)
    assert np.abs(waves - rays).max() < 0.05
    assert np.abs(waves - plain).max() > 0.3


# -- tables of responses -----------------------------------------------------------------------------


def halves_of(camera, edge=1e-4):
    """The response of photodiodes that see the quarters of an endless pupil, sharply."""
    angle = math.degrees(math.atan(edge))
    steps = [-40.0, -angle, angle, 40.0]
    left, up = np.meshgrid([0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 1.0, 1.0])
    quarters = [[(1 - up) * left, (1 - up) * (1 - left)], [up * left, up * (1 - left)]]
    return {"angles_x": steps, "angles_y": steps, "responses": np.array(quarters)[::-1].tolist()}


def test_the_table_of_ideal_lenses_gives_the_ideal_capture():
    """A lamp out of focus; pixels at larger x and y see the opposite quarter of the pupil."""
    lamp = facing(500.0, 2.0, (3.0, 2.0), **radiating())
    camera = CAMERA.replace(focus_distance=700.0, resolution=(64, 64), detector_width=0.0768)
    camera = camera.replace(aperture_radius=0.95 * camera.aperture_radius, mla_offset=(0.0, 0.0))
    b, z = camera.mla_distance, camera.detector_distance
    camera = camera.replace(mla_pitch=0.0024 * b / (b + z))
    # Capture rows and columns grow with x and y, and a pixel at larger x sees smaller x of the pupil.
    sensors = camera.to_sensor(), camera.replace(photodiode_response=halves_of(camera)).to_sensor()
    plain, tabled = (render_capture(scene_of(each, "direct", lamp=lamp), spp=2048).image for each in sensors)
    assert plain.max() > 0.3
    assert tabled.sum() == pytest.approx(plain.sum(), rel=0.01)
    assert np.linalg.norm(tabled - plain) < 0.06 * np.linalg.norm(plain)


def test_polarized_variants_record_the_same_light_by_tables():
    """Their weights are Mueller matrices, by which a response of one channel could not be multiplied."""
    images = []
    for variant in ("llvm_ad_mono", "llvm_ad_mono_polarized"):
        mi.set_variant(variant)
        images.append(sky(CAMERA.replace(photodiode_response=halves_of(CAMERA)), 2))
    assert images[0].max() > 0
    np.testing.assert_allclose(images[1], images[0], rtol=1e-5)


def test_responses_by_angle_and_wavelength():
    """White light of three channels through a photodiode of four pixels, against the mean over the pupil."""
    mi.set_variant("llvm_ad_rgb")
    angles, wavelengths = [-20.0, -5.0, 8.0, 20.0], [450.0, 550.0, 650.0]
    table = np.random.default_rng(0).random((1, 1, 3, 4, 4))
    given = {"angles_x": angles, "angles_y": angles, "wavelengths": wavelengths, "responses": table.tolist()}
    camera = CAMERA.replace(photodiode_response=given)
    assert PlenopticCamera.from_json(camera.to_json()) == camera
    sensor = camera.to_sensor()
    image = render_capture(scene_of(sensor, "direct", sky={"type": "constant"}), spp=256).image.mean(axis=(0, 1))
    radius, turn = np.sqrt((np.arange(400) + 0.5) / 400), 2 * np.pi * (np.arange(400) + 0.5) / 400
    slope = camera.aperture_radius / camera.mla_distance * radius[:, None]
    x, y = (np.degrees(np.arctan(slope * each(turn))) for each in (np.cos, np.sin))
    seen = (camera.pixel_size * camera.mla_distance / camera.detector_distance) ** 2
    for value, wavelength in zip(image, (611.4, 549.1, 464.3), strict=True):
        grid = RegularGridInterpolator((wavelengths, angles, angles), table[0, 0])
        mean = grid(np.stack([np.full(x.shape, wavelength), y, x], axis=-1)).mean()
        assert value == pytest.approx(mean / 4 * np.pi * camera.aperture_radius**2 / seen, rel=0.01)


def test_a_response_in_a_file(tmp_path):
    table = halves_of(CAMERA)
    path = tmp_path / "response.json"
    path.write_text(json.dumps(table))
    camera = CAMERA.replace(photodiode_response=path)
    assert camera.photodiode_response == PhotodiodeResponse(**table)
    assert PlenopticCamera.from_sensor(mi.load_dict(camera.to_sensor())) == camera


TABLE = halves_of(CAMERA)
HALVES = {"photodiode_response": TABLE}

test_mistakes = refused(
    (lambda: CAMERA.replace(mla_cra=(0, 0, 1)), "mla_cra = .*pairs"),
    (lambda: CAMERA.replace(mla_cra=(1, 0, 2, 3)), "heights"),
    (lambda: CAMERA.replace(mla_cra=(0, 1, 2, 3)), "first pair"),
    (lambda: CAMERA.replace(mla_cra=(0, 0, 2, 85)), "mla_cra = 85"),
    (lambda: CAMERA.replace(pixel_crosstalk=0.3), "pixel_crosstalk = 0.3"),
    (lambda: CAMERA.replace(photodiode_response=TABLE | {"angles_x": [3, 2, 1, 0]}), "angles_x = "),
    (lambda: CAMERA.replace(photodiode_response={"angles_x": [0, 1]}), "photodiode_response: angles_y"),
    (lambda: CAMERA.replace(photodiode_response="{"), "photodiode_response: .*JSON"),
    (lambda: CAMERA.replace(**HALVES, mla_pitch=0.0036), "2 x 2"),
    (lambda: CAMERA.replace(photodiode_response=TABLE | {"responses": [[1]]}), r"responses of shape \(1, 1\)"),
    (lambda: sky(CAMERA.replace(**HALVES), 2, "wave"), "photodiode_response"),
    (lambda: CAMERA.replace(**HALVES, mla_absorption=1.0), "mla_absorption = 1"),
)
