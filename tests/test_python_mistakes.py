"""What Python functions say of a wrong argument: one line with its name, not an error from within."""

from __future__ import annotations

import numpy as np
import pytest
from scene_cases import letters

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Capture, InputError, PlenopticCamera

CAMERA = PlenopticCamera(resolution=(64, 64), detector_width=0.128)
IMAGE = np.ones((64, 64), np.float32)


@pytest.fixture(scope="module")
def scene():
    return mp.load_scene("letters", parameters=letters(2))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distance": [[210, 220], [230]]}, "distance = .*: it must be a number or several"),
        ({"distance": np.array([[210.0, 220.0]])}, "it must be a number"),
        ({"distance": {210, 220}}, "it must be a number"),
        ({"relay": "no"}, "relay = 'no': it must be True or False"),
        ({"accelerate": 0}, "accelerate = 0: it must be True or False"),
        ({"volume": None}, "volume = None: it must be True or False"),
    ],
)
def test_reconstruct(options, message):
    with pytest.raises(InputError, match=message):
        mp.reconstruct(IMAGE, **({"distance": 240} | options), camera=CAMERA, method="coherent", wavelength=633)


def test_what_is_no_capture_or_no_plain_data_is_not_written(tmp_path):
    path = tmp_path / "raw.exr"
    with pytest.raises(InputError, match="capture of type ndarray: it must be a Capture"):
        mp.write_capture(path, IMAGE)
    for fact in ({1, 2}, np.ones(3)):
        with pytest.raises(InputError, match=r"raw\.exr: what is told about the image must be plain data"):
            mp.write_capture(path, Capture(IMAGE, CAMERA, metadata={"fact": fact}))
    assert list(tmp_path.iterdir()) == []


def test_scenes_and_cameras(scene):
    with pytest.raises(InputError, match=r"parameters = \['resolution'\]: they must be values by name"):
        mp.load_scene("letters", parameters=["resolution"])
    with pytest.raises(InputError, match="camera = 'paper': it must be a PlenopticCamera"):
        mp.with_camera(scene, "paper")
    with pytest.raises(InputError, match=r"scene of type str: it must be a mitsuba\.Scene"):
        mp.with_camera("letters", CAMERA)
    with pytest.raises(InputError, match="wavelength: a value of type list is none that plugins take"):
        mp.render_capture(scene, model="wave", wavelength=[633, 500])


def test_numbers_of_cameras():
    with pytest.raises(InputError, match="distance = 0"):
        CAMERA.defocus(0)
    for number in (mp.design.refocus_range, mp.design.spot_radius, mp.design.mla_fresnel_number):
        with pytest.raises(InputError, match="wavelength = -5: it must be greater than 0"):
            number(CAMERA, -5)


def test_a_name_is_no_camera():
    for work in (
        lambda: mp.decode(IMAGE, camera="paper"),
        lambda: mp.point_spread_function("paper", (0, 0, 240), wavelength=633),
        lambda: Capture(IMAGE, "paper"),
    ):
        with pytest.raises(InputError, match="camera = 'paper': it must be a PlenopticCamera"):
            work()
    with pytest.raises(InputError, match="start = 'raytrix': it must be a PlenopticCamera"):
        mp.calibrate({}, None, "raytrix")
    with pytest.raises(InputError, match="main_lens: the camera has none with surfaces"):
        mp.LensSystem.of(CAMERA)


def test_captures_that_do_not_suit():
    capture = Capture(IMAGE, CAMERA)
    exposed = mp.expose(capture, mp.Detector(), photons=100)
    with pytest.raises(InputError, match="capture: a detector has recorded it already"):
        mp.expose(exposed, mp.Detector(), photons=100)
    other = Capture(IMAGE, CAMERA.replace(mla_pitch=0.05))
    for work in (mp.decode, mp.lightfield.micro_images):
        with pytest.raises(InputError, match=r"white: its camera has mla_pitch = 0\.05, that of the capture 0\.064"):
            work(capture, white=other)
        work(capture, white=Capture(IMAGE, CAMERA))
    mosaic = mp.expose(Capture(np.ones((64, 64, 3)), CAMERA), mp.Detector(mosaic="RGGB"), photons=100)
    with pytest.raises(InputError, match="mosaic = RGGB"):
        mp.decode(capture, white=mosaic)


def test_checkpoints():
    with pytest.raises(InputError, match="existing = 'maybe': it must be one of refuse, resume, resume_if_same"):
        mp.Checkpoint("run.checkpoint", "maybe")
