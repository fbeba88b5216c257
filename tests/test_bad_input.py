"""Properties of every input: it is taken exactly if the documentation allows it, and refused in one line if not.

The fuzzing of `tools/fuzz.py` goes on from here, to files, scenes and the command line.
"""

from __future__ import annotations

import json
import math

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mitsuba_plenoptic import Capture, Detector, InputError, PlenopticCamera, decode, expose, reconstruct
from mitsuba_plenoptic.errors import require_number

SHORTEST, LONGEST = 1e-9, 1e9
LENGTHS = st.sampled_from(["focal_length", "aperture_radius", "mla_distance", "mla_focal_length", "mla_pitch",
                           "detector_distance", "detector_width"])  # fmt: skip
CAMERA = PlenopticCamera(resolution=(32, 32), detector_width=0.128)
IMAGE = np.linspace(0, 1, 32 * 32, dtype=np.float32).reshape(32, 32)
USES = {
    "capture": lambda image: Capture(image, CAMERA),
    "decode": lambda image: decode(image, camera=CAMERA),
    "refocus": lambda image: reconstruct(image, 240.0, camera=CAMERA),
    "coherent": lambda image: reconstruct(image, 240.0, camera=CAMERA, method="coherent", wavelength=633),
    "white": lambda image: decode(IMAGE, camera=CAMERA, white=image),
}

quick = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)

anything = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.complex_numbers(),
    st.text(),
    st.binary(),
    st.lists(st.floats(), max_size=3),
    st.dictionaries(st.text(max_size=3), st.floats(), max_size=2),
)


class TestNumbers:
    @quick
    @given(anything)
    def test_a_number_is_taken_or_refused_in_one_line(self, value):
        try:
            number = require_number("x", value, positive=True)
        except InputError as error:
            assert str(error).startswith("x = ")
            assert str(error).isprintable()
        else:
            assert math.isfinite(number)
            assert number > 0

    @quick
    @given(anything)
    def test_a_count_is_whole_and_within_its_bounds(self, value):
        try:
            count = PlenopticCamera(mla_seed=value).mla_seed
        except InputError as error:
            assert str(error).isprintable()
        else:
            assert type(count) is int
            assert 0 <= count < 2**32
            assert count == value

    @quick
    @given(st.text())
    def test_a_message_is_one_line_of_printable_characters(self, text):
        said = str(InputError(text))
        assert said.isprintable()
        assert str(InputError(said)) == said
        if text.isprintable():
            assert said == text

    def test_a_message_has_an_end(self):
        assert len(str(InputError("x" * 10**6))) == 1000


class TestCameras:
    @settings(quick, max_examples=200)
    @given(LENGTHS, anything)
    def test_a_length_is_taken_exactly_if_the_documentation_allows_it(self, name, value):
        if value is None and name in (
            "focal_length",
            "aperture_radius",
            "mla_distance",
            "mla_focal_length",
            "detector_distance",
        ):
            return
        if isinstance(value, (list, tuple)) and name in ("mla_focal_length", "mla_pitch"):
            return  # of these a camera may have several
        if isinstance(value, (int, float)) and not isinstance(value, bool) and SHORTEST <= value <= LONGEST:
            assert getattr(PlenopticCamera(**{name: value}), name) == value
        else:
            with pytest.raises(InputError, match=f"^{name} = "):
                PlenopticCamera(**{name: value})

    @quick
    @given(st.floats(SHORTEST, 1e8), st.floats(allow_nan=True))
    def test_a_focus_distance_has_an_image_or_is_refused(self, focal_length, distance):
        try:
            camera = PlenopticCamera(focal_length=focal_length, focus_distance=distance)
        except InputError as error:
            assert "focus_distance" in str(error)
        else:
            assert focal_length <= camera.mla_distance <= LONGEST
            assert distance > focal_length

    @quick
    @given(st.dictionaries(st.text(max_size=5), anything, max_size=3), LENGTHS | st.just("resolution"), anything)
    def test_a_header_makes_a_camera_or_is_refused(self, extra, name, value):
        values = {**PlenopticCamera().to_dict(), **extra, name: value}
        try:
            camera = PlenopticCamera.from_dict(values)
        except InputError as error:
            assert str(error).isprintable()
        else:
            assert set(values) == set(camera.to_dict())
            assert PlenopticCamera.from_dict(json.loads(json.dumps(camera.to_dict()))) == camera


class TestArrays:
    @quick
    @given(st.dictionaries(st.integers(0, IMAGE.size - 1), st.floats(width=32), max_size=5))
    def test_a_capture_is_finite_or_not_made(self, pixels):
        image = np.ones_like(IMAGE)
        image.reshape(-1)[list(pixels)] = list(pixels.values())
        allowed = bool((np.abs(image.astype(np.float64)) <= 1e30).all())
        try:
            capture = Capture(image, CAMERA)
        except InputError as error:
            assert not allowed
            assert "of its pixels are" in str(error)
        else:
            assert allowed
            for result in (reconstruct(capture, 240.0).image, decode(capture).values):
                assert np.isfinite(result).all()

    @quick
    @given(arrays.arrays(arrays.scalar_dtypes(), arrays.array_shapes(max_dims=4, max_side=4)))
    def test_any_array_that_is_no_image_is_refused_by_all(self, array):
        for name in ("capture", "decode", "refocus"):
            with pytest.raises(InputError) as caught:
                USES[name](array)
            assert str(caught.value).isprintable()

    @quick
    @given(st.floats(1e-9, 1), st.floats(1, 1e9), *[st.floats(0, 1e9)] * 2, st.integers(1, 16), st.floats(1e-9, 1e9))
    def test_an_exposure_is_finite_or_refused(self, efficiency, well, dark, noise, bits, photons):
        try:
            detector = Detector(efficiency, well, dark, noise, bits)
            result = expose(Capture(IMAGE, CAMERA), detector, photons=photons)
        except InputError as error:
            assert "must be" in str(error)
        else:
            assert np.isfinite(result.image).all()

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1.1e30, -1e38])
    def test_the_policy_is_the_same_everywhere(self, value):
        """NaN, infinity and what would overflow are refused with their number and the place of the first."""
        image = np.ones_like(IMAGE)
        image[3, 5] = image[4, 4] = value
        words = r"2 of its pixels are .*, the first at \(3, 5.*\): all must be"
        for use in USES.values():
            with pytest.raises(InputError, match=words):
                use(image)
