"""The paper's statements on a light field as a real camera records it, here a simulated one of 8 x 8 lenses."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from test_recording import CAMERA, recorded

from mitsuba_plenoptic.extensions.paper import real_light
from mitsuba_plenoptic.extensions.paper.recording import Recording, Shape
from mitsuba_plenoptic.io import StageOptions
from mitsuba_plenoptic.report import window_sharpness

SHAPES = {
    "near": {"distance": 390, "region": [1, 1, 3, 6], "even": [1, 2, 2, 4]},
    "far": {"distance": 408, "region": [3, 1, 3, 6], "edge": [4, 2, 2, 4]},
}


STORE = SimpleNamespace(capture=lambda name, inputs, make: (make(None, None), ""))


def folder_of(folder):
    """Write the pictures of an even sheet that ends behind the fifth lens, in eight bits."""
    recording = recorded(moved=(0.3, -0.2), width=16.0, counts=60)
    for name, picture in (("light", recording.light), ("white", recording.white)):
        Image.fromarray(np.rint(1.5 * picture).clip(0, 255).astype(np.uint8)).save(folder / f"{name}.png")
    (folder / "camera.json").write_text(CAMERA.to_json())
    (folder / "shapes.json").write_text(json.dumps(SHAPES))
    return folder


@pytest.mark.slow
def test_real_light_is_judged_beside_its_control(tmp_path):
    said = []
    stages = StageOptions(finished=lambda name, *_: said.append(name))
    results = real_light.reproduce_real(tmp_path / "out", folder_of(tmp_path), stages=stages)
    assert said[-1] == f"quality, {len(said)} of {len(said)}"
    assert results["alignment"]["moved"] == pytest.approx((0.3, -0.2), abs=0.05)
    real, control = (results[name] for name in ("real", "control"))
    assert [claim["statement"] for claim in real["claims"]] == [claim["statement"] for claim in control["claims"]]
    assert len(real["claims"]) == 10
    near, far = real["quality"]
    # No plane explains light that ends with a lens, so that some is left beside; noise alone is 0.012.
    assert near["grid"] < 0.01
    assert near["unexplained"] < 0.03
    assert 0 < far["width_mm"] < 0.3
    assert "0.3" in (tmp_path / "out" / "report.html").read_text()


def test_the_control_shows_a_plane_where_it_was_found(monkeypatch):
    """Upright: the bright corner of the texture is the image's."""
    camera = CAMERA.replace(mla_rotation=0.0)
    shape = Shape(391.0, {"region": (1.0, 2.0, 4.0, 5.0)})
    black = np.zeros(camera.shape, np.float32)
    image = np.zeros((64, 64), np.float32)
    image[16:36, 8:24] = 1
    by_waves = real_light.render_capture
    monkeypatch.setattr(real_light, "render_capture", lambda scene, **_: by_waves(scene, model="ray", spp=4))
    control = real_light._control(Recording(black, black + 1, camera, {"a": shape}), {"a": image}, STORE, 550.0, 1e4)
    found = real_light.reconstruct(control.light, 391.0, camera=camera).image
    assert np.nanmean(found[2:4, 1:3]) > 0.6
    assert np.nanmean(found[5:7, 1:5]) < 0.1
    assert np.nanmean(found[2:5, 4:]) < 0.2


@pytest.mark.slow
def test_an_edge_within_a_lens_is_found_where_it_is():
    """Few steps find it at the border of a lens, four bins away."""
    image = np.full((64, 64), 0.9, np.float32)
    image[:, 36:] = 0.2
    blank = np.ones(CAMERA.shape, np.float32)
    recording = Recording(blank, blank, CAMERA, {"a": Shape(408.0, {"region": (0.0, 0.0, 8.0, 8.0)})})
    control = real_light._control(recording, {"a": image}, STORE, 550.0, 1e4)
    found = real_light._deconvolved(control.capture(550.0), control.white, 408.0)
    assert 16 + window_sharpness(found[20:44, 16:56].astype(np.float64)).column == pytest.approx(35.5, abs=1)
