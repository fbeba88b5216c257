"""What notebooks show of captures, reconstructions, cameras and the viewer."""

import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, reconstruct

CAMERA = PlenopticCamera(resolution=(64, 32), detector_width=0.256, crop_size=(64, 32))


def test_captures_and_reconstructions_are_pictures():
    capture = Capture(np.ones((32, 64, 3)), CAMERA, (611.0, 549.0, 464.0), "wave")
    text = capture._repr_html_()
    assert text.startswith('<figure><img src="data:image/png;base64,')
    assert "wave model, (611.0, 549.0, 464.0) nm: 64 x 32 pixels; white is 1" in text
    result = reconstruct(Capture(np.ones((32, 64)), CAMERA), [240.0])[0]
    assert "Reconstruction at 240 mm, ray: 4 x 2 bins of 0.128 mm" in result._repr_html_()


def test_cameras_are_their_design_sheet():
    text = CAMERA._repr_html_()
    assert "<td>focal length</td><td>80 mm</td>" in text


def test_the_viewer_is_a_frame():
    page = Capture(np.ones((32, 64)), CAMERA).view(title='"A" & <b>')
    text = page._repr_html_()
    assert text.startswith("<iframe") and text.count("<") == 2 and "&lt;script&gt;" in text
