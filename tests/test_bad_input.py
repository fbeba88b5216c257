"""Properties of every input: it is taken exactly if the documentation allows it, and refused in one line if not."""

import itertools
import json
import math
from pathlib import Path
from unittest import mock

import hypothesis.extra.numpy as arrays
import numpy as np
import OpenEXR
import pytest
from cameras import SMALL_SENSOR, write_scene
from foreign_files import png
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.internal.conjecture import providers
from PIL import Image

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.array.shape import known_shape
from mitsuba_plenoptic.calibration import read_camera
from mitsuba_plenoptic.camera.aperture import known_image
from mitsuba_plenoptic.camera.phase_screen import known_screen
from mitsuba_plenoptic.dataset import read_recipe
from mitsuba_plenoptic.extensions.calibrate.observations import read_centres, read_foreign_centres
from mitsuba_plenoptic.extensions.onchip.photodiode_response import known_response
from mitsuba_plenoptic.extensions.raw.hci import read_hci
from mitsuba_plenoptic.extensions.studio.sweep import stated_grid
from mitsuba_plenoptic.optics.spectrum import read_responses
from mitsuba_plenoptic.prescription.lens_file import read_lens, read_prescription

SHORTEST, LONGEST = 1e-9, 1e9
LENGTHS = st.sampled_from(["focal_length", "aperture_radius", "mla_distance", "mla_focal_length", "mla_pitch",
                           "detector_distance", "detector_width"])  # fmt: skip
CAMERA = mp.PlenopticCamera(resolution=(32, 32), detector_width=0.128)
IMAGE = np.linspace(0, 1, 32 * 32, dtype=np.float32).reshape(32, 32)
USES = {
    "capture": lambda image: mp.Capture(image, CAMERA),
    "decode": lambda image: mp.decode(image, camera=CAMERA),
    "refocus": lambda image: mp.reconstruct(image, 240.0, camera=CAMERA),
    "coherent": lambda image: mp.reconstruct(image, 240.0, camera=CAMERA, method="coherent", wavelength=633),
    "white": lambda image: mp.decode(IMAGE, camera=CAMERA, white=image),
}

quick = settings(max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)

anything = st.one_of(
    *(st.none(), st.booleans(), st.integers(), st.floats(), st.complex_numbers(), st.text(), st.binary()),
    st.lists(st.floats(), max_size=3),
    st.dictionaries(st.text(max_size=3), st.floats(), max_size=2),
)


@pytest.fixture(autouse=True, scope="module")
def no_constants_of_the_package():
    """Have none of the package's constants among the draws, which Hypothesis finds by reading every module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(providers, "_get_local_constants", lambda: providers._local_constants, raising=False)
        yield


def refused_or_done(call):
    """Return what a call gives, or None where it refuses in one line; anything else fails."""
    try:
        return call()
    except mp.InputError as error:
        assert str(error).isprintable()


class TestNumbers:
    @quick
    @given(anything)
    def test_a_count_is_whole_and_within_its_bounds(self, value):
        camera = refused_or_done(lambda: mp.PlenopticCamera(mla_seed=value))
        if camera is not None:
            assert type(camera.mla_seed) is int and 0 <= camera.mla_seed < 2**32 and camera.mla_seed == value

    @quick
    @given(st.text())
    def test_a_message_is_one_line_of_printable_characters(self, text):
        said = str(mp.InputError(text))
        assert said.isprintable() and str(mp.InputError(said)) == said
        assert said == text or not text.isprintable()
        assert len(str(mp.InputError("x" * 10**6))) == 1000


class TestCameras:
    @settings(quick, max_examples=150)
    @given(LENGTHS, anything)
    def test_a_length_is_taken_exactly_if_the_documentation_allows_it(self, name, value):
        # Some follow from others, and of some a camera may have several.
        assume(value is not None or name in ("mla_pitch", "detector_width"))
        assume(not isinstance(value, list) or name not in ("mla_focal_length", "mla_pitch"))
        if isinstance(value, (int, float)) and not isinstance(value, bool) and SHORTEST <= value <= LONGEST:
            assert getattr(mp.PlenopticCamera(**{name: value}), name) == value
        else:
            with pytest.raises(mp.InputError, match=f"^{name} = "):
                mp.PlenopticCamera(**{name: value})

    @quick
    @given(st.floats(SHORTEST, 1e8), st.floats(allow_nan=True))
    def test_a_focus_distance_has_an_image_or_is_refused(self, focal_length, distance):
        try:
            camera = mp.PlenopticCamera(focal_length=focal_length, focus_distance=distance)
        except mp.InputError as error:
            assert "focus_distance" in str(error)
        else:
            assert focal_length <= camera.mla_distance <= LONGEST
            assert distance > focal_length

    @quick
    @given(st.dictionaries(st.text(max_size=5), anything, max_size=3), LENGTHS | st.just("resolution"), anything)
    def test_a_header_makes_a_camera_or_is_refused(self, extra, name, value):
        values = {**mp.PlenopticCamera().to_dict(), **extra, name: value}
        camera = refused_or_done(lambda: mp.PlenopticCamera.from_dict(values))
        if camera is not None:
            assert set(values) == set(camera.to_dict())
            assert mp.PlenopticCamera.from_dict(json.loads(json.dumps(camera.to_dict()))) == camera


class TestArrays:
    @quick
    @given(arrays.arrays(arrays.scalar_dtypes(), arrays.array_shapes(max_dims=4, max_side=4)))
    def test_any_array_that_is_no_image_is_refused_by_all(self, array):
        for name in ("capture", "decode", "refocus"):
            assert refused_or_done(lambda use=USES[name]: use(array)) is None

    @quick
    @given(st.floats(1e-9, 1), st.floats(1, 1e9), *[st.floats(0, 1e9)] * 2, st.integers(1, 16), st.floats(1e-9, 1e9))
    def test_an_exposure_is_finite_or_refused(self, efficiency, well, dark, noise, bits, photons):
        try:
            detector = mp.Detector(efficiency, well, dark, noise, bits)
            result = mp.expose(mp.Capture(IMAGE, CAMERA), detector, photons=photons)
        except mp.InputError as error:
            assert "must be" in str(error)
        else:
            assert np.isfinite(result.image).all()

    @pytest.mark.parametrize("value", [math.nan, -math.inf, 1.1e30])
    def test_the_policy_is_the_same_everywhere(self, value):
        """NaN, infinity and what would overflow are refused with their number and the place of the first."""
        image = np.ones_like(IMAGE)
        image[3, 5] = image[4, 4] = value
        words = r"2 of its pixels are .*, the first at \(3, 5.*\): all must be"
        for use in USES.values():
            with pytest.raises(mp.InputError, match=words):
                use(image)
        image[3, 5] = image[4, 4] = 9e29
        assert np.isfinite(USES["refocus"](image).image).all() and np.isfinite(USES["decode"](image).values).all()


LENSES = Path(mp.__file__).parent / "prescription" / "lenses"
OPTILAND = Path(__file__).parent / "optiland_records"
BALL = [
    {"radius": 50, "thickness": 5, "semi_aperture": 6, "stop": True, "glass": 1.5},
    {"radius": -50, "semi_aperture": 6},
]
RECIPE = """name: few
count: 2
models: [ray]
camera: {detector_width: 0.256, resolution: [64, 64], focus_distance: {from: 230, to: 250}}
scenes:
  - {generator: shapes, objects: {from: 3, to: 6, step: 1}}
"""
RESPONSE = {"angles_x": [-1, 0, 1], "angles_y": [-1, 1], "responses": [[[[1, 1, 1], [1, 1, 1]]]]}
HCI = (
    "[extrinsics]\nnum_cams_x = 2\nnum_cams_y = 2\n[mitsuba_plenoptic]\nwhite = 1.5\nchannels = 1\ncamera = "
    + mp.PlenopticCamera(resolution=(64, 64), detector_width=0.256).to_json().replace("\n ", " ").replace("\n}", "}")
)


def read_views(path):
    """Read a folder of the 4D Light Field Benchmark from its text and four pictures, which are put beside it."""
    for number in range(4):
        Image.new("RGB", (4, 4)).save(path.parent / f"input_Cam{number:03d}.png")
    return read_hci(path.parent)


TEXTS = {
    "camera.json": (CAMERA.to_json(), read_camera),
    "lens.yaml": (LENSES.joinpath("double_gauss.yaml").read_text(), read_prescription),
    "lens.json": (json.dumps({"name": "Ball", "surfaces": BALL}), read_lens),
    "design.zmx": ((OPTILAND / "asphere.zmx").read_text(), read_prescription),
    "design.seq": ((OPTILAND / "double_gauss.seq").read_text(), read_prescription),
    "screen.json": (json.dumps({"waves": [[0, 0.1, 0, 0.2]] * 4, "width": 10}), known_screen),
    "aperture.json": (json.dumps({"transmission": [[0, 0.5], [1, 0.25]]}), known_image),
    "shape.json": (json.dumps({"form": "conic", "curvature_radius": 0.26, "conic": 0}), known_shape),
    "response.json": (json.dumps(RESPONSE), lambda path: known_response("pixel_response", path)),
    "responses.csv": ("# nm, response\n400, 0.2\n500, 0.9\n600, 0.4\n", read_responses),
    "centres.csv": ("k,l,u,v\n0,0,8.0,8.0\n1,0,24.0,8.0\n", read_centres),
    "centres.json": (json.dumps({"mic_list": [[8.0, 8.0, 0, 0], [8.0, 24.0, 0, 1]]}), read_foreign_centres),
    "recipe.yaml": (RECIPE, read_recipe),
    "varied.yaml": ("samples: [1, 2]\ndistance: [210.0, 2.8e2]\n", lambda path: stated_grid(path, [])),
    "parameters.cfg": (HCI, read_views),
}
"""Whole files of text and their readers, by the names of the files."""


PLACES = st.integers(0, 2047) | st.integers(0, 2**20)
WORDS = [number.to_bytes(4, "little") for number in (0, 1, 65536, 2**30, 2**31 - 1, 2**31, 2**32 - 1)]
INSERTED = [b"\xff", b"\0", b"\xed\xa0\x80", b"\xe2\x82", b"\x1b[2J", b"9" * 5000]
EDITS = st.one_of(
    st.tuples(PLACES, st.just(1), st.binary(min_size=1, max_size=1)),
    st.tuples(PLACES, st.just(4), st.sampled_from(WORDS)),
    st.tuples(PLACES, st.integers(0, 64), st.binary(max_size=64)),
    st.tuples(PLACES, st.just(2**30), st.just(b"")),
    st.tuples(PLACES, st.just(0), st.sampled_from(INSERTED)),
    st.tuples(st.just(0), st.just(0), st.sampled_from([b"\xff\xfe", b"\xfe\xff", b"\xef\xbb\xbf", b"\r", b"\x1f\x8b"])),
)
"""Damage to a file: where, how many bytes go, and what comes in their place."""


def damaged(data, edits):
    """Return the bytes of a file after its damage."""
    for place, count, new in edits:
        place %= max(len(data), 1)
        data = data[:place] + new + data[place + count :]
    return data


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("bad")


class TestFiles:
    @pytest.mark.parametrize("name", TEXTS)
    def test_whole_texts_are_read_and_other_encodings_at_most_refused(self, folder, name):
        text, reader = TEXTS[name]
        (folder / name).write_text(text)
        assert reader(folder / name) is not None
        for encoding in ("utf-16", "utf-32", "cp037", "utf-7"):
            (folder / name).write_bytes(text.encode(encoding))
            refused_or_done(lambda: reader(folder / name))

    @pytest.mark.parametrize("name", TEXTS)
    @settings(quick, max_examples=15)
    @given(edits=st.lists(EDITS, min_size=1, max_size=4))
    def test_a_damaged_text_is_read_or_refused_in_one_line(self, folder, name, edits):
        text, reader = TEXTS[name]
        (folder / name).write_bytes(damaged(text.encode(), edits))
        refused_or_done(lambda: reader(folder / name))

    @quick
    @given(edits=st.lists(EDITS, min_size=1, max_size=4))
    def test_a_damaged_capture_is_finite_or_refused(self, folder, edits):
        mp.write_capture(folder / "raw.exr", mp.Capture(IMAGE, CAMERA))
        (folder / "raw.exr").write_bytes(damaged((folder / "raw.exr").read_bytes(), edits))
        capture = refused_or_done(lambda: mp.read_capture(folder / "raw.exr"))
        if capture is not None:
            assert capture.image.shape[:2] == capture.camera.shape and np.isfinite(capture.image).all()

    @quick
    @given(st.sampled_from(["camera", "kind", "model", "metadata", "wavelength"]), anything)
    def test_the_facts_of_a_capture_are_right_or_refused(self, folder, name, value):
        mp.write_capture(folder / "raw.exr", mp.Capture(IMAGE, CAMERA))
        opened = OpenEXR.File(str(folder / "raw.exr"), separate_channels=True)
        facts = json.loads(opened.header()["mitsuba_plenoptic"]) | {name: value}
        header = opened.header() | {"mitsuba_plenoptic": json.dumps(facts, default=repr)}
        OpenEXR.File(header, {key: one.pixels for key, one in opened.channels().items()}).write(str(folder / "raw.exr"))
        capture = refused_or_done(lambda: mp.read_capture(folder / "raw.exr"))
        if name in ("camera", "kind"):
            assert capture is None

    @pytest.mark.slow
    @quick
    @given(edits=st.lists(EDITS, min_size=1, max_size=4))
    def test_a_damaged_checkpoint_leads_to_the_same_bits_or_is_refused(self, folder, edits):
        operator = mp.CaptureOperator(CAMERA, [(0, 0, 240), (0.1, 0, 230), (0, 0.1, 250)], wavelength=633)
        path = folder / "wave.checkpoint"
        path.unlink(missing_ok=True)
        # The clock jumps, so that a checkpoint is due at every opportunity.
        jumping = mock.patch("time.monotonic", side_effect=itertools.count(0, 1000).__next__)

        def summed(existing):
            with mp.Checkpoint(path, existing) as checkpoint:
                image = operator.forward([1.0, 2.0, 3.0], job=mp.Job(keeper=checkpoint))
                return image, path.read_bytes()

        with jumping:
            whole, data = summed("refuse")
        path.write_bytes(damaged(data, edits))
        resumed = refused_or_done(lambda: summed("resume"))
        assert resumed is None or np.array_equal(resumed[0], whole)

    @pytest.mark.parametrize("sizes", [(0, 1), (2**31 - 1, 1)])
    def test_a_picture_that_lies_about_its_size_is_refused(self, folder, sizes):
        (folder / "input_Cam000.png").write_bytes(png(*sizes))
        (folder / "parameters.cfg").write_text(HCI)
        assert refused_or_done(lambda: read_hci(folder)) is None


@quick
@given(edits=st.lists(EDITS, min_size=1, max_size=4))
def test_a_damaged_scene_is_captured_or_refused(folder, edits):
    scene = write_scene(folder, sensor=SMALL_SENSOR)
    scene.write_bytes(damaged(scene.read_bytes(), edits))
    capture = refused_or_done(lambda: mp.render_capture(mp.load_scene(scene), spp=1))
    assert capture is None or np.isfinite(capture.image).all()
