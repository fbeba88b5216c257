"""Strategies for the parts of cases, by the names that patterns call them by, and patterns made into strategies."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Any

from hypothesis import assume
from hypothesis import strategies as st

Code = st.SearchStrategy[str]
"""A strategy for texts of Python expressions."""

SHORTEST, LONGEST = 1e-9, 1e9
"""Lengths that the documentation allows."""

# Lengths of a camera, about as the paper has them.
_LENGTHS = {
    "focal_length": 80.0,
    "aperture_radius": 5.0,
    "mla_distance": 120.0,
    "mla_focal_length": 0.512,
    "mla_pitch": 0.064,
    "detector_distance": 0.512,
    "detector_width": 0.128,
}


def pattern(text: str) -> Code:
    """Make a strategy of a pattern: ``$name`` stands for a part, ``<<a | b>>`` for one of several patterns."""
    pieces = re.split(r"(<<.*?>>|\$\w+)", text)
    return st.tuples(*map(_piece, pieces)).map("".join)


def _piece(text: str) -> Code:
    if text.startswith("<<"):
        return st.one_of([pattern(choice) for choice in text[2:-2].split(" | ")])
    return PARTS[text[1:]] if text.startswith("$") else st.just(text)


def cases(patterns: Iterable[str]) -> Code:
    """Make a strategy of several patterns; what follows an exclamation mark is forbidden."""
    return st.one_of([pattern(f"forbidden({text[2:]})" if text.startswith("! ") else text) for text in patterns])


def _code(values: st.SearchStrategy[Any]) -> Code:
    return values.map(ascii)


def _among(texts: Iterable[str]) -> Code:
    return _code(st.sampled_from(list(texts)))


def _is_number(text: str) -> bool:
    """Whether Python takes a text for a number; command line and scene files then may."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _is_slow(camera: dict[str, Any]) -> bool:
    """Whether the white image of a camera honestly takes seconds: wide micro-images, far out of focus."""
    b, z, f2, pitch = (camera[name] for name in ("mla_distance", "detector_distance", "mla_focal_length", "mla_pitch"))
    columns, rows = camera["resolution"]
    pixel = camera["detector_width"] / columns
    smear = pitch * abs(1 + b / z - b / f2) * z / b / pixel
    work = max(2 * camera["aperture_radius"] * z / b / pixel + smear, 1) * max(smear, 1)
    # Beyond the upper bound it is refused.
    return 1e7 < columns * rows * (pixel / pitch * work) ** 2 < 1e12


@st.composite
def _cameras(draw: st.DrawFn) -> str:
    """Cameras of allowed numbers, near the paper's or anywhere within the bounds."""
    spread = draw(st.sampled_from((0.02, 0.1, 0.3, 1.0, 5.0, 20.0)))
    factors = st.floats(-2 * spread, 2 * spread).map(math.exp)
    values: dict[str, Any] = {
        name: min(max(length * draw(factors), SHORTEST), LONGEST) for name, length in _LENGTHS.items()
    }
    values["resolution"] = size = draw(st.tuples(st.integers(1, 96), st.integers(1, 96)))
    assume(not _is_slow(values))
    if draw(st.booleans()):
        values["crop_offset"] = left, top = tuple(draw(st.integers(0, length - 1)) for length in size)
        values["crop_size"] = draw(st.tuples(st.integers(1, size[0] - left), st.integers(1, size[1] - top)))
    if draw(st.booleans()):
        pitches = st.floats(-3, 3).map(lambda count: min(max(values["mla_pitch"] * count, -LONGEST), LONGEST))
        values["mla_rotation"] = draw(st.floats(-360, 360))
        values["mla_offset"] = draw(st.tuples(pitches, pitches))
        values["mla_aperture"] = draw(st.sampled_from(("cell", "circle")))
        values["mla_fill"] = draw(st.floats(1e-3, 1))
        if draw(st.booleans()):
            values["mla_lattice"], f2 = "hexagonal", values["mla_focal_length"]
            three = (f2, min(f2 * 1.2, LONGEST), max(f2 / 1.1, SHORTEST))
            values["mla_focal_length"] = draw(st.sampled_from((f2, three)))
    values["lens_model"] = draw(st.sampled_from(("ideal", "parabolic")))
    return f"PlenopticCamera({', '.join(f'{name}={value!r}' for name, value in values.items())})"


# Damage: at a place (most of what matters is at the beginning of a file), so many bytes are replaced with others.
_WORDS = [number.to_bytes(4, order) for number in (1, 65536, 2**30, 2**31 - 1, 2**31, 2**32 - 1)
          for order in ("little", "big")]  # fmt: skip
_PLACES = st.integers(0, 2047) | st.integers(0, 2**20)
_EDITS = st.one_of(
    st.tuples(_PLACES, st.just(1), st.binary(min_size=1, max_size=1)),
    st.tuples(_PLACES, st.just(4), st.sampled_from([bytes(4), *_WORDS])),
    st.tuples(_PLACES, st.integers(0, 64), st.binary(max_size=64)),
    st.tuples(_PLACES, st.just(2**30), st.just(b"")),
)
_EDGES = (-(2**31), -(10**9), -64, -1, 0, 1, 7, 8, 31, 62, 64, 127, 4095, 65535, 2**24, 10**9, 2**31 - 1)
_ATTRIBUTES = ("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "mitsuba_plenoptic")
# As `texts` has them, which needs the package.
_TEXTS = (
    "camera.json", "lens.yaml", "lens.json", "design.zmx", "design.seq", "screen.json", "aperture.json", "shape.json",
    "response.json", "responses.csv", "centres.csv", "centres.json", "recipe.yaml", "varied.yaml", "dataset.json",
)  # fmt: skip

PARTS: dict[str, Code] = {
    "camera": _cameras(),
    "length": st.sampled_from(sorted(_LENGTHS)),
    "far": st.floats(-9, 9).map(lambda power: f"far(c, {1 + math.exp(power)})"),
    "nm": _code(st.floats(0, 6).map(lambda power: 10**power)),
    "few": _code(st.integers(1, 4)),
    "value": _code(st.floats(-1e30, 1e30)),
    "pixel": _code(st.tuples(st.integers(0, 63), st.integers(0, 63))),
    "place": _code(st.integers(0, 2000)),
    "bytes": _code(st.binary(min_size=1, max_size=99)),
    "edits": _code(st.lists(_EDITS, min_size=1, max_size=4)),
    "edge": _code(st.sampled_from(_EDGES)),
    "size": _code(st.integers(20_000, 2**31 - 1)),
    "exr": _among(("grey.exr", "colour.exr")),
    "attribute": _among(_ATTRIBUTES),
    "text": _among(_TEXTS),
    # Python values.
    "any_text": _code(st.text(max_size=5)),
    "not_whole": _code(st.floats(1e-9, 1e9).filter(lambda number: not number.is_integer())),
    "not_negative": _code(st.floats(max_value=-1e-9, allow_infinity=False)),
    "too_small": _code(st.floats(0, SHORTEST, exclude_min=True, exclude_max=True)),
    "too_large": _code(st.floats(LONGEST, exclude_min=True, allow_infinity=False) | st.just(10**20)),
    "too_bright": _code(st.floats(1.01e30, 3e38) | st.floats(-3e38, -1.01e30)),
    # Texts of the command line and of scene files.
    "word_text": _code(st.text(max_size=5).filter(lambda text: not _is_number(text)))
    | _among(("wide", "1,5,2,3", "0x10", "1e", "--", "nan nan", "x" * 5000)),
    "infinite_text": _among(("nan", "inf", "-inf", "1e999", "-1e999", "NaN", "infinity")),
    "low_text": _among(("0", "-0.0")) | _code(st.floats(max_value=-1e-30, allow_infinity=False).map(repr)),
    "high_text": _among(("1e300",)) | _code(st.floats(1e10, 1e30).map(repr)),
    "name_text": _among(("", "RAY", "\x1b[0m")) | _code(st.text(max_size=5).map("x{}".format)),
}
_NOT_NUMBER = "$any_text | b'1' | [] | {} | [1.0, 2.0] | () | {'a': 1} | object() | 1j | True | np.ones(2)"
_NOT_FINITE = "nan | inf | -inf | np.float32('nan') | np.float64('inf') | 10**400 | -(10**400)"
_NOT_POSITIVE = "0 | 0.0 | np.int64(-3) | -(10**30) | $not_negative"
# Each made of those before it.
for _name, _choices in {
    "not_number": _NOT_NUMBER,
    "not_finite": _NOT_FINITE,
    "not_positive": _NOT_POSITIVE,
    "not_place": "$not_number | $not_finite",
    "not_length": "$not_place | $not_positive | $too_large",
    "not_count": "$not_place | $not_positive | $not_whole | None",
    "not_amount": "$not_place | $not_negative | $too_large | None",
    "not_name": "None | 1 | [] | nan | 'RAY' | b'ray' | $any_text + 'x'",
    "not_distance": "$not_positive | $too_large | nan | -inf | '240' | None | 1j | True | {} | [] | [80.0] | 79.9 "
    "| [240.0, nan] | [240.0, 'x'] | [[240.0]]",
    "not_wavelength": "$not_positive | $not_finite | '633' | None | [] | [633.0, 500.0] | True | {} | 1e-3 | 1e7",
    "not_pair": "4096 | () | (1,) | (1, 2, 3) | 'ab' | (64, '64') | (64, None) | (10**400, 64) | {'a': 1} | (True, 64) "
    "| ($not_whole, 5) | (5, $not_finite)",
    "wrong": "$length=$not_length | $length=$too_small | mla_rotation=$not_place | mla_rotation=400.0 | mla_fill=-1 "
    "| focus_distance=$not_positive | focus_distance=80.0 | lens_model=$not_name | resolution=$not_pair "
    "| crop_size=(0, 5) | crop_size=$not_pair | crop_offset=$not_pair | crop_offset=(4097, 1) | mla_lattice='round' "
    "| mla_lattice=None | mla_aperture='square' | mla_fill=1.0001 | mla_fill=1e-5 | mla_offset=3 | mla_offset=(1, nan) "
    "| mla_offset=(0, 1e10) | mla_focal_length=(0.5, 0.6, 0.7) | mla_focal_length=() "
    "| mla_lattice='hexagonal', mla_focal_length=(0.5, -0.6, 0.7)",
    "number_text": "$word_text | $infinite_text | $low_text",
    "length_text": "$number_text | $high_text | '1e-300'",
    "count_text": "$number_text | '1.5' | '9' * 30 | '9' * 5000 | '99999999999'",
    "amount_text": "$word_text | $infinite_text | '-1' | '1e300'",
    "seed_text": "$word_text | '-1' | '1.5'",
    "wavelength_text": "$length_text | '0.5' | '1e7'",
    "grid_name": "'HSpacing' | 'VSpacing' | 'HOffset' | 'VOffset' | 'Rot' | 'UMax' | 'VMax' | 'FirstPosShiftRow'",
    "use": "(lambda i: Capture(i, CAMERA)) | (lambda i: reconstruct(i, 240, camera=CAMERA)) "
    "| (lambda i: reconstruct(i, 240, camera=CAMERA, method='coherent', wavelength=633)) "
    "| (lambda i: reconstruct(i, [210, 240], camera=CAMERA, method='partial', wavelength=633)) "
    "| (lambda i: decode(i, camera=CAMERA)) "
    "| (lambda i: decode(capture(), white=i)) | (lambda i: expose(Capture(i, CAMERA), Detector(), photons=100)) "
    "| estimate_lens_grid",
    "light_field_use": "(lambda lf: refocus(lf, 240)) | (lambda lf: depth_map(lf, 200, 300, planes=3)) "
    "| (lambda lf: shift_and_add(lf, 0)) | view | (lambda lf: pick_views(lf, 1)) | epipolar_image "
    "| (lambda lf: FourierRefocuser(lf, 0.1)) | (lambda lf: write_mosaic('x.png', lf)) "
    "| (lambda lf: write_lftoolbox('x.mat', lf))",
    "file": "'nosuch.exr' | '' | '.' | '/' | '/dev/null' | '\\0' | 'x' * 5000 | 'nowhere/raw.exr' | '\\u202e.exr' "
    "| '\\ud800.exr' | '-' | holding('text.exr', $bytes)",
    "output": "'' | '.' | '/' | 'out' | 'out.jpg' | 'nowhere/out.exr' | '/dev/full' | 'x' * 5000 + '.exr' | '\\0.exr' "
    "| 'out.EXE' | '/proc/out.exr' | os.mkdir('folder.exr') or 'folder.exr' | file('grey.exr') + '/out.exr'",
}.items():
    PARTS[_name] = pattern(f"<<{_choices}>>")
