"""What PyTorch's and JAX's modules share: what functions of arrays keep between calls."""

import gc
import weakref

import numpy as np
from cameras import WAVELENGTH, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator
from mitsuba_plenoptic.array_functions import CameraCapture, Latest

CAMERA = small_camera(2)
POINTS = scattered(3, image=0.05)


def test_functions_that_forget_keep_no_operator_and_give_the_same_values():
    operators = []

    def make(camera):
        made = CaptureOperator(camera, POINTS, wavelength=WAVELENGTH, accuracy=0)
        operators.append(weakref.ref(made))
        return made

    function = Latest(CameraCapture(make, CAMERA, ["mla_distance"]), np.copy, np.array_equal, np.asarray)
    given = np.ones((2, 3)), np.array(CAMERA.mla_distance)
    assert function.shape((2, 3)) == (2, *CAMERA.shape)
    first = function.at(given).value.copy()
    assert function.at(given).value is function.at(given).value
    assert len(operators) == 2  # one for the shape, one for the value
    function.forget()
    gc.collect()
    assert not any(each() for each in operators)
    np.testing.assert_array_equal(function.at(given).value, first)
