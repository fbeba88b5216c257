"""Properties of every input, and a slice of the fuzzing (`make fuzz` runs ten thousand and more)."""

from __future__ import annotations

import importlib.util
import json
import math
import sys
from pathlib import Path

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mitsuba_plenoptic import (
    Capture,
    Detector,
    InputError,
    PlenopticCamera,
    decode,
    design,
    expose,
    read_capture,
    reconstruct,
    write_capture,
)
from mitsuba_plenoptic.bounds import LONGEST, SHORTEST
from mitsuba_plenoptic.errors import printable, require_count, require_number
from mitsuba_plenoptic.report.design_sheet import design_sheet

TOOLS = Path(__file__).parents[1] / "tools"
LENGTHS = (
    "focal_length",
    "aperture_radius",
    "mla_distance",
    "mla_focal_length",
    "mla_pitch",
    "detector_distance",
    "detector_width",
)
SMALL = PlenopticCamera(resolution=(32, 32), detector_width=0.128)

quick = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)

lengths = st.floats(SHORTEST, LONGEST)
cameras = st.builds(
    lambda numbers, size, model: PlenopticCamera(**numbers, resolution=size, lens_model=model),
    st.fixed_dictionaries(dict.fromkeys(LENGTHS, lengths)),
    st.tuples(st.integers(1, 5000), st.integers(1, 5000)),
    st.sampled_from(("ideal", "parabolic")),
)
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


def is_length(value):
    """The documentation's rule, said anew."""
    if isinstance(value, (bool, str, bytes, complex)) or not isinstance(value, (int, float)):
        return False
    return SHORTEST <= value <= LONGEST


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
    @given(anything, st.integers(-5, 5), st.integers(6, 100))
    def test_a_count_is_whole_and_within_its_bounds(self, value, low, high):
        try:
            count = require_count("x", value, minimum=low, maximum=high)
        except InputError as error:
            assert str(error).isprintable()
        else:
            assert type(count) is int
            assert low <= count <= high
            assert count == value

    @quick
    @given(st.text())
    def test_a_message_is_one_line_of_printable_characters(self, text):
        assert printable(text).isprintable()
        assert str(InputError(text)).isprintable()
        assert printable(printable(text)) == printable(text)
        if text.isprintable():
            assert printable(text) == text

    def test_a_message_has_an_end(self):
        assert len(str(InputError("x" * 10**6))) == 1000


class TestCameras:
    @quick
    @given(cameras, st.floats(1, 1e6))
    def test_whatever_is_allowed_gives_finite_numbers(self, camera, wavelength):
        for name in dir(camera):
            value = getattr(camera, name)
            if isinstance(value, float) and name != "focus_distance":
                assert math.isfinite(value), name
        assert PlenopticCamera.from_dict(json.loads(json.dumps(camera.to_dict()))) == camera
        assert not any("nan" in row.value for row in design_sheet(camera, wavelength))
        design.design_warnings(camera, wavelength)

    @settings(quick, max_examples=200)
    @given(st.sampled_from(LENGTHS), anything)
    def test_a_length_is_taken_exactly_if_the_documentation_allows_it(self, name, value):
        if value is None and name in ("mla_distance", "detector_distance"):
            return
        if is_length(value):
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
    @given(
        st.dictionaries(st.text(max_size=5), anything, max_size=3), st.sampled_from((*LENGTHS, "resolution")), anything
    )
    def test_a_header_makes_a_camera_or_is_refused(self, extra, name, value):
        values = {**PlenopticCamera().to_dict(), **extra, name: value}
        try:
            camera = PlenopticCamera.from_dict(values)
        except InputError as error:
            assert str(error).isprintable()
        else:
            assert set(values) == set(camera.to_dict())


class TestArrays:
    @quick
    @given(st.dictionaries(st.integers(0, 32 * 32 - 1), st.floats(width=32), max_size=5))
    def test_a_capture_is_finite_or_not_made(self, pixels):
        image = np.ones((32, 32), np.float32)
        image.reshape(-1)[list(pixels)] = list(pixels.values())
        allowed = bool((np.abs(image.astype(np.float64)) <= 1e30).all())
        try:
            capture = Capture(image, SMALL)
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
        for use in (
            lambda: Capture(array, SMALL),
            lambda: reconstruct(array, 240.0, camera=SMALL),
            lambda: decode(array, camera=SMALL),
        ):
            with pytest.raises(InputError) as caught:
                use()
            assert str(caught.value).isprintable()

    @quick
    @given(
        st.floats(1e-9, 1),
        st.floats(1, 1e9),
        st.floats(0, 1e9),
        st.floats(0, 1e9),
        st.integers(1, 16),
        st.floats(1e-9, 1e9),
    )
    def test_an_exposure_is_finite_or_refused(self, efficiency, well, dark, noise, bits, photons):
        image = np.linspace(0, 1, 32 * 32, dtype=np.float32).reshape(32, 32)
        try:
            detector = Detector(efficiency, well, dark, noise, bits)
            result = expose(Capture(image, SMALL), detector, photons=photons)
        except InputError as error:
            assert "must be" in str(error)
        else:
            assert np.isfinite(result.image).all()

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1.1e30, -1e38])
    def test_the_policy_is_the_same_everywhere(self, value, tmp_path):
        """NaN, infinity and what would overflow are refused with their number and the place of the first."""
        image = np.ones((32, 32), np.float32)
        image[3, 5] = image[4, 4] = value
        words = r"2 of its pixels are .*, the first at \(3, 5.*\): all must be"
        for use in (
            lambda: Capture(image, SMALL),
            lambda: reconstruct(image, 240.0, camera=SMALL),
            lambda: reconstruct(image, 240.0, camera=SMALL, method="coherent", wavelength=633),
            lambda: decode(image, camera=SMALL),
            lambda: decode(np.ones((32, 32)), camera=SMALL, white=image),
        ):
            with pytest.raises(InputError, match=words):
                use()


class TestHeaders:
    @quick
    @given(st.binary(max_size=400))
    def test_any_bytes_after_the_magic_number_are_refused(self, data):
        path = Path(self.folder) / "any.exr"
        for start in (b"", b"\x76\x2f\x31\x01\x02\x00\x00\x00"):
            path.write_bytes(start + data)
            with pytest.raises(InputError) as caught:
                read_capture(path)
            assert str(caught.value).startswith(str(path))

    @quick
    @given(st.integers(0, 10**6), st.binary(min_size=1, max_size=8))
    def test_a_capture_with_other_bytes_is_itself_or_refused(self, place, data):
        path = Path(self.folder) / "raw.exr"
        image = np.linspace(0, 1, 32 * 32, dtype=np.float32).reshape(32, 32)
        write_capture(path, Capture(image, SMALL))
        whole = path.read_bytes()
        place %= len(whole)
        path.write_bytes((whole[:place] + data + whole[place + len(data) :])[: len(whole)])
        try:
            capture = read_capture(path)
        except InputError as error:
            assert str(error).isprintable()
        else:
            assert np.isfinite(capture.image).all()
            assert capture.image.shape[:2] == capture.camera.shape

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        type(self).folder = str(tmp_path)


class TestFuzzing:
    @pytest.fixture
    def fuzz(self):
        """The tool as a module."""
        spec = importlib.util.spec_from_file_location("fuzz", TOOLS / "fuzz.py")
        module = importlib.util.module_from_spec(spec)
        sys.path.insert(0, str(TOOLS))
        try:
            spec.loader.exec_module(module)
            from fuzzing import worker

            yield module, worker
        finally:
            sys.path.remove(str(TOOLS))

    def test_a_slice_of_it_finds_nothing(self, fuzz, tmp_path):
        tool, worker = fuzz
        kinds = {kind: share for kind, (share, _) in worker.KINDS.items() if "extreme" not in kind}
        report = tool.run(tool.shares(300, kinds), seed=8, workers=1, memory_gib=worker.LIMIT_GIB)
        text = tool.write_report(tmp_path, report)
        assert not report.findings, text
        assert len(report.results) >= 300
        # Not everything is refused: some damage is harmless, and gives a result.
        assert {result.outcome for result in report.results} == {"refused", "fine"}
        assert "| all | " in (tmp_path / "report.md").read_text()
        assert json.loads((tmp_path / "report.json").read_text())["findings"] == []

    def test_what_it_starts_from_is_whole(self, fuzz, tmp_path):
        """Else everything would be refused, and nothing shown."""
        from fuzzing import corpus, exr, scenes

        for name in ("grey.exr", "colour.exr"):
            data = corpus.files()[name]
            (tmp_path / name).write_bytes(exr._put_together(*exr._take_apart(data)))
            assert read_capture(tmp_path / name).image.any()
        from mitsuba_plenoptic.lightfield.exchange import open_light_field

        for name in ("uint8.mat", "single.mat", "version7.mat", "views.png", "lenses.eslf.png"):
            (tmp_path / name).write_bytes(corpus.files()[name])
            views = corpus.light_field().sizes["u"] if name.endswith(".png") else None
            assert open_light_field(tmp_path / name, views=views).shape[:4] == corpus.light_field().shape
        assert scenes._render(scenes._write(tmp_path, corpus.SCENE)).image.any()

    @pytest.mark.parametrize(
        ("run", "outcome"),
        [
            ("lambda: None", "accepted"),
            ("lambda: 1 / 0", "traceback"),
            ("lambda: (_ for _ in ()).throw(InputError('no'))", "refused"),
        ],
    )
    def test_it_knows_a_finding_when_it_sees_one(self, fuzz, run, outcome):
        from fuzzing.cases import Case, judge

        assert judge(Case("x", eval(run, {"InputError": InputError}), forbidden=True)).kind == outcome

    def test_it_knows_what_is_not_finite(self, fuzz):
        from fuzzing.cases import Case, judge

        assert judge(Case("x", lambda: [np.array([1.0, math.nan])])).kind == "not finite"
        assert judge(Case("x", lambda: np.array([1.0]))).kind == "fine"

    def test_it_survives_a_process_that_dies_or_hangs(self, fuzz, monkeypatch):
        tool, _ = fuzz
        import fuzzing.engine as engine

        monkeypatch.setattr(engine, "SECONDS", 1)
        monkeypatch.setattr(engine, "_GRACE", 1)
        cases = [("die", 0), ("hang", 0), ("fine", 0)]
        monkeypatch.setattr(engine.sys, "executable", str(_stand_in(TOOLS, self.folder)))
        results = {result.kind: result for result in tool.run(cases, seed=0, workers=1, memory_gib=1).results}
        assert results["die"].outcome == "crash"
        assert "SIGSEGV" in results["die"].text
        assert results["hang"].outcome == "too long"
        assert results["fine"].outcome == "fine"

    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path):
        type(self).folder = tmp_path


def _stand_in(tools, folder):
    """Write a program that answers as a worker does, dies, or hangs."""
    path = folder / "worker"
    path.write_text(
        f"#!{sys.executable}\n"
        "import os, signal, sys, time, json\n"
        "print('ready', flush=True)\n"
        "for line in sys.stdin:\n"
        "    kind = line.split(chr(9))[0]\n"
        "    print(json.dumps({'what': kind}), flush=True)\n"
        "    if kind == 'die': os.kill(os.getpid(), signal.SIGSEGV)\n"
        "    if kind == 'hang': time.sleep(60)\n"
        "    print(json.dumps({'outcome': 'fine', 'text': ''}), flush=True)\n"
    )
    path.chmod(0o755)
    return path
