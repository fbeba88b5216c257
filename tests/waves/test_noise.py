"""The noise of captures: how it is kept and told; relations compare it with the spread of seeds."""

import mitsuba as mi
import numpy as np
import pytest
from cases import facing, scene_of

import mitsuba_plenoptic as mp


def test_what_does_not_vary_has_no_noise_and_one_sample_tells_none(camera_dict):
    wall = facing(240.0, 1.0, emitter={"type": "area", "radiance": 1.0})
    scene = scene_of(camera_dict(resolution=32, detector_width=0.128), wall=wall)
    # At the rim of the pupil chance decides.
    assert (mp.render_capture(scene, spp=3, noise=True).noise == 0).mean() > 0.4
    for model in ("ray", "wave"):
        with pytest.raises(mp.InputError, match="spp = 1: "):
            mp.render_capture(scene, model=model, spp=1, noise=True)


@pytest.mark.parametrize("channels", [(), (3,)])
def test_noise_survives_the_disk_and_not_an_exposure(tmp_path, camera_dict, channels):
    camera = mi.load_dict(camera_dict(resolution=64)).camera
    image, noise = np.random.default_rng(0).random((2, 64, 64, *channels), dtype=np.float32)
    mp.write_capture(tmp_path / "raw.exr", mp.Capture(image, camera, noise=noise))
    read = mp.read_capture(tmp_path / "raw.exr")
    np.testing.assert_array_equal(read.image, image)
    np.testing.assert_array_equal(read.noise, noise)
    assert read.relative_noise == pytest.approx(np.sqrt((noise.astype(float) ** 2).mean()) / image.mean())
    assert mp.expose(read, mp.Detector(), photons=100.0).noise is None
    for bad in (noise[:5], -noise):
        with pytest.raises(mp.InputError, match="noise"):
            mp.Capture(image, camera, noise=bad)
