"""Cases of Python: cameras, arrays and arguments that break a rule, and odd ones that do not."""

from __future__ import annotations

import math
from typing import Any

from hypothesis import assume
from hypothesis import strategies as st

from .values import (
    LENGTHS,
    LONGEST,
    NOT_COUNTS,
    NOT_FINITE,
    NOT_LENGTHS,
    NOT_NAMES,
    NOT_NUMBERS,
    NOT_POSITIVE,
    NOT_WHOLE,
    PAPER,
    SHORTEST,
    TOO_LARGE,
    TOO_SMALL,
    WAVELENGTHS,
    Code,
    among,
    call,
    code,
    forbidden,
    one_wrong,
)

NOT_PAIRS = (
    among("4096", "()", "(1,)", "(1, 2, 3)", "'ab'", "(64, '64')", "(64, None)", "(10**400, 64)", "{'a': 1}", "(True, 64)")
    | call("", NOT_WHOLE, st.just("5"))
    | call("", st.just("5"), NOT_FINITE)
)
NOT_LATTICES = among(
    "mla_lattice='round'", "mla_lattice=None", "mla_lattice=[]", "mla_aperture='square'", "mla_aperture=1",
    "mla_fill=0.0", "mla_fill=-1", "mla_fill=1.0001", "mla_fill=1e-5", "mla_offset=3", "mla_offset='1, 2'",
    "mla_offset=(1, nan)", "mla_offset=(1, 2, 3)", "mla_offset=(0, 1e10)", "mla_focal_length=(0.5, 0.6, 0.7)",
    "mla_focal_length=()", "mla_lattice='hexagonal', mla_focal_length=(0.5, 0.6)",
    "mla_lattice='hexagonal', mla_focal_length=(0.5, -0.6, 0.7)",
    "mla_lattice='hexagonal', mla_focal_length=(0.5, None, 0.7)",
)  # fmt: skip
# One parameter, as a keyword, that no camera can have.
WRONG_PARAMETER = st.one_of(
    st.builds("{}={}".format, LENGTHS, NOT_LENGTHS | TOO_SMALL),
    st.builds("{}={}".format, LENGTHS, NOT_LENGTHS | TOO_SMALL),
    st.builds("{}={}".format, among("mla_rotation", "mla_fill"), NOT_NUMBERS | NOT_FINITE | among("400.0", "-361")),
    st.builds("focus_distance={}".format, NOT_POSITIVE | TOO_LARGE | among("nan", "'240'", "80.0", "79.0")),
    st.builds("lens_model={}".format, NOT_NAMES),
    st.builds("{}={}".format, among("resolution", "crop_size"), NOT_PAIRS | among("(0, 5)", "(5, 0)")),
    st.builds("crop_offset={}".format, NOT_PAIRS | among("(-1, 5)", "(4097, 1)", "(2**20, 2**20)")),
    NOT_LATTICES,
)
BAD_CAMERAS = forbidden(
    st.builds("PlenopticCamera({})".format, WRONG_PARAMETER)
    | st.builds("CAMERA.replace({})".format, WRONG_PARAMETER)
    | st.builds("PlenopticCamera.from_dict({{**CAMERA.to_dict(), **dict({})}})".format, WRONG_PARAMETER)
    | st.builds("PlenopticCamera.from_dict({{**CAMERA.to_dict(), {}: 1.0}})".format, code(st.text(max_size=5)))
)


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
def cameras(draw: st.DrawFn) -> str:
    """Cameras of allowed numbers, near the paper's or anywhere within the bounds."""
    spread = draw(st.sampled_from((0.02, 0.1, 0.3, 1.0, 5.0, 20.0)))
    factors = st.floats(-2 * spread, 2 * spread).map(math.exp)
    values: dict[str, Any] = {
        name: min(max(length * draw(factors), SHORTEST), LONGEST) for name, length in PAPER.items()
    }
    values["resolution"] = size = draw(st.tuples(st.integers(1, 96), st.integers(1, 96)))
    assume(not _is_slow(values))
    if draw(st.integers(0, 2)) == 2:
        values["crop_offset"] = left, top = tuple(draw(st.integers(0, length - 1)) for length in size)
        values["crop_size"] = draw(st.tuples(st.integers(1, size[0] - left), st.integers(1, size[1] - top)))
    if draw(st.booleans()):
        offset = st.floats(-3, 3).map(lambda pitches: min(max(values["mla_pitch"] * pitches, -LONGEST), LONGEST))
        values |= {
            "mla_rotation": draw(st.floats(-360, 360)),
            "mla_offset": draw(st.tuples(offset, offset)),
            "mla_aperture": draw(st.sampled_from(("cell", "circle"))),
            "mla_fill": draw(st.floats(1e-3, 1)),
        }
        if draw(st.booleans()):
            values["mla_lattice"] = "hexagonal"
            f2 = values["mla_focal_length"]
            values["mla_focal_length"] = draw(st.sampled_from((f2, (f2, min(f2 * 1.2, LONGEST), max(f2 / 1.1, SHORTEST)))))
    values["lens_model"] = draw(st.sampled_from(("ideal", "parabolic")))
    return f"PlenopticCamera({', '.join(f'{name}={value!r}' for name, value in values.items())})"


def _with_camera(text: str, **others: Code) -> Code:
    """Cases in which a camera is `c`."""
    return st.builds(
        lambda camera, **drawn: f"(lambda c: {text.format(**drawn)})({camera})", camera=cameras(), **others
    )


DISTANCES = code(st.floats(-9, 9).map(lambda power: 1 + math.exp(power)))
CAMERAS = BAD_CAMERAS | _with_camera(
    "[c, PlenopticCamera.from_dict(json.loads(json.dumps(c.to_dict()))) == c or 1 / 0, "
    "write_capture('raw.exr', Capture(random_image(c), c)), command('info', 'raw.exr', '--wavelength', '{w}')]",
    w=WAVELENGTHS,
)
# A distance counts from the focal length on, in focal lengths; w is a wavelength.
EXTREME_CAMERAS = st.one_of(
    *(
        _with_camera(text, d=DISTANCES.map("min({} * c.focal_length, 1e9)".format), w=WAVELENGTHS, n=code(st.integers(1, 4)))
        for text in (
            "white_image(c)",
            "render_capture(wall(c, {d}), spp=1)",
            "render_capture(wall(c, {d}), model='wave', spp=1, radiators_per_lens=1)",
            "decode(random_image(c), camera=c)",
            "focal_stack(decode(random_image(c), camera=c), [{d}])",
            "depth_map(decode(random_image(c), camera=c), planes=3)",
            "reconstruct(random_image(c), {d}, camera=c, oversample={n})",
            "reconstruct(random_image(c), {d}, camera=c, footprint='point')",
            "reconstruct(random_image(c), {d}, camera=c, method='coherent', wavelength={w})",
            "reconstruct(random_image(c), {d}, camera=c, method='partial', interleave={n}, wavelength={w})",
            "reconstruct(random_image(c), {d}, camera=c, method='partial', interleave='auto', wavelength={w})",
            "point_spread_function(c, (0.0, 0.0, {d}), wavelength={w})",
            "point_spread_function(c, (0.0, 0.0, {d}), wavelength={w}, method='full_field')",
        )
    )
)

_USES = (
    "Capture({}, CAMERA)",
    "reconstruct({}, 240.0, camera=CAMERA)",
    "reconstruct({}, 240.0, camera=CAMERA, method='coherent', wavelength=633.0)",
    "reconstruct({}, [210, 240], camera=CAMERA, method='partial', wavelength=633.0)",
    "decode({}, camera=CAMERA)",
    "expose(Capture({}, CAMERA), Detector(), photons=100)",
    "estimate_lens_grid({})",
)


def _used(images: Code, *uses: str) -> Code:
    return st.builds(lambda use, image: use.format(image), st.sampled_from((*_USES, *uses)), images)


_WHITE = "decode(capture(), white={})"
_PIXELS = code(st.tuples(st.integers(0, 63), st.integers(0, 63)))
_NOT_PIXELS = NOT_FINITE.filter(lambda value: "10" not in value) | among("3e38") | code(
    st.floats(1.01e30, 3e38) | st.floats(-3e38, -1.01e30)
)
_NOT_IMAGES = among(
    "image()[:5]", "image()[None]", "image()[..., None, None]", "np.zeros((64, 64, 2))", "np.zeros((64, 64, 0))",
    "np.zeros(0)", "image().astype(complex)", "image().astype(bool)", "image().astype(str)", "image().astype(object)",
    "'image'", "3", "{}", "[[1, 2], [3]]", "np.zeros((64, 64), 'M8[s]')", "np.zeros((64, 64), [('a', 'f4')])",
    "np.zeros((64, 63))", "np.full((64, 64), 1e300)", "[['a'] * 64] * 64",
)  # fmt: skip
_ODD_IMAGES = (
    among("np.zeros((64, 64))", "image() * 1e-38", "np.asfortranarray(image())[::-1, ::-1]", "-image()", "capture(3).image",
          "np.eye(64) * 9e29")
    | st.builds("(image() * 100).astype({!r})".format, st.sampled_from(("u1", "i2", "u8", ">f4", "f2", "f8")))
    | st.builds("image(at={}, to={})".format, _PIXELS, code(st.floats(-1e30, 1e30)))
)  # fmt: skip
ARRAYS = (
    forbidden(_used(st.builds("image(at={}, to={})".format, _PIXELS, _NOT_PIXELS), _WHITE))
    | forbidden(_used(_NOT_IMAGES, _WHITE) | _used(st.just("None")))
    | _used(_ODD_IMAGES, _WHITE)
)

_NOT_DISTANCES = (
    among("'240'", "b'2'", "None", "object()", "1j", "True", "{'a': 1}", "[]", "[80.0]", "[240.0, nan]", "[240.0, 'x']",
          "79.9", "[[240.0]]")
    | NOT_FINITE
    | NOT_POSITIVE
    | TOO_LARGE
)  # fmt: skip
_NOT_WAVELENGTHS = NOT_POSITIVE | NOT_FINITE | among("'633'", "None", "[]", "[633.0, 500.0]", "True", "{}", "1e-3", "1e7")
_NOT_PHOTONS = NOT_LENGTHS | among("1e-10")
_NOT_NEGATIVE = NOT_NUMBERS | NOT_FINITE | TOO_LARGE | among("None") | code(st.floats(max_value=-1e-9, allow_infinity=False))
_DETECTOR = {
    "quantum_efficiency": _NOT_PHOTONS | among("1.0001", "None"),
    "full_well": _NOT_PHOTONS | among("0.5", "None"),
    "dark_electrons": _NOT_NEGATIVE,
    "read_noise": _NOT_NEGATIVE,
    "bits": NOT_COUNTS | among("17", "1000"),
    "gain": _NOT_PHOTONS,
    "black_level": NOT_NUMBERS | NOT_FINITE | NOT_WHOLE | among("-1", "4095", "10**9"),
}
_POSITIONS = among(
    "None", "240.0", "(0, 0)", "(0, 0, 0, 240)", "(0, 0, -240)", "(0, 0, 0)", "(nan, 0, 240)", "(0, inf, 240)",
    "('a', 0, 240)", "'abc'", "[]", "(1e9, 0, 1e-3)", "(0, 0, 10**400)", "(0, 0, 1e300)", "{1, 2, 3}", "(0, 0, 1e-300)",
)  # fmt: skip
_NOT_DECODED = among(
    "image()", "image(), camera=CAMERA.replace(resolution=(32, 32), crop_size=(32, 32))", "image(), camera=CAMERA, white=image()[:5]",
    "image(), camera='x'", "image(), camera={}", "image(), camera=CAMERA, grid='x'", "image(), camera=CAMERA, grid=3",
    "image(), white=image() * 0, grid=LensGrid((16.0, 16.0), (8.0, 8.0), (4, 4))",
    "image(), grid=LensGrid((16.0, 16.0), (8.0, 8.0), (4, 4))",
    "image(), white=image(), grid=LensGrid((1e-3, 1e-3), (0, 0), (10**6, 10**6))",
)  # fmt: skip
_NOT_LIGHT_FIELDS = among(
    "light_field().values", "None", "light_field().transpose('s', 't', 'u', 'v')", "light_field().drop_vars('weight')",
    "light_field()[0]", "light_field().where(light_field() != light_field().max())",
    "light_field() + np.where(light_field().values == light_field().values.max(), inf, 0)",
)  # fmt: skip
_LIGHT_FIELD_USES = (
    "refocus({}, 240.0)", "depth_map({}, 200, 300, planes=3)", "shift_and_add({}, 0.0)", "view({})", "pick_views({}, 1)",
    "epipolar_image({})", "FourierRefocuser({}, 0.1)", "write_mosaic('x.png', {})", "write_lftoolbox('x.mat', {})",
)  # fmt: skip
_NOT_PLACES = NOT_NUMBERS | NOT_FINITE | among("None")
_LIGHT_FIELD_ARGUMENTS = {
    "refocus(light_field(), {})": _NOT_DISTANCES.filter(lambda value: "inf" not in value),
    "focal_stack(light_field(), {})": among("[]", "[240.0], method='magic'", "[240.0], method=None"),
    "shift_and_add(light_field(), {})": _NOT_PLACES,
    "depth_map(light_field(), planes={})": NOT_COUNTS | among("1", "2", "10**6"),
    "depth_map(light_field(), near={}, far=300)": NOT_NUMBERS | NOT_FINITE | among("400"),
    "view(light_field(), u={})": _NOT_PLACES,
    "pick_views(light_field(), {})": NOT_COUNTS | among("1000"),
    "epipolar_image(light_field(), {})": NOT_NAMES,
    "epipolar_image(light_field(), at={})": _NOT_PLACES,
    "FourierRefocuser(light_field(), {})": _NOT_PLACES,
}
_NOT_FILES = among(
    "''", r"'\0'", r"'a\0b.exr'", "None", "3", "b'x.exr'", "'nowhere/raw.exr'", "'.'", "os.mkdir('x.exr') or 'x.exr'", "'x' * 5000",
    "'/dev/null'", "'/dev/full'", "'/proc/version'", "file('grey.exr') + '/raw.exr'",
)  # fmt: skip


def _grid_wrong(values: Code) -> Code:
    return st.builds("({}, 4)".format, values) | st.builds("(4, {})".format, values) | among("(4,)", "4", "None", "'ab'")


ARGUMENTS = st.one_of(
    one_wrong(
        "reconstruct",
        {"capture": "capture()", "distance": "240.0"},
        {
            "distance": _NOT_DISTANCES,
            "method": NOT_NAMES,
            "footprint": NOT_NAMES,
            "oversample": NOT_COUNTS | among("100_000", "10**9"),
            "interleave": NOT_COUNTS | among("10**9", "'AUTO'"),
            "camera": among("'camera'", "1", "{}", "SMALL_CAMERA"),
        },
    ),
    one_wrong(
        "reconstruct",
        {"capture": "image()", "distance": "240.0", "camera": "CAMERA", "method": "'coherent'", "wavelength": "633.0"},
        {"wavelength": _NOT_WAVELENGTHS, "capture": st.builds("image(at={}, to=-1e-3)".format, _PIXELS)},
    ),
    forbidden(st.builds("decode({})".format, _NOT_DECODED)),
    one_wrong("Detector", {}, _DETECTOR),
    one_wrong(
        "expose",
        {"capture": "capture()", "detector": "Detector()", "photons": "10"},
        {
            "photons": _NOT_PHOTONS | among("None"),
            "seed": NOT_NUMBERS | NOT_FINITE | NOT_WHOLE | among("-1", "None"),
        },
    ),
    one_wrong(
        "point_spread_function",
        {"camera": "CAMERA", "position": "(0.0, 0.0, 240.0)", "wavelength": "633.0", "method": "'full_field'"},
        {"position": _POSITIONS, "wavelength": _NOT_WAVELENGTHS, "method": NOT_NAMES},
    ),
    forbidden(st.builds(lambda use, lf: use.format(lf), st.sampled_from(_LIGHT_FIELD_USES), _NOT_LIGHT_FIELDS)),
    forbidden(st.sampled_from(sorted(_LIGHT_FIELD_ARGUMENTS)).flatmap(lambda use: st.builds(use.format, _LIGHT_FIELD_ARGUMENTS[use]))),
    forbidden(st.builds("read_capture({})".format, _NOT_FILES) | st.builds("write_capture({}, capture())".format, _NOT_FILES)),
    one_wrong(
        "LensGrid",
        {"spacing": "(16.0, 16.0)", "offset": "(8.0, 8.0)", "shape": "(4, 4)"},
        {
            "spacing": _grid_wrong(NOT_LENGTHS | among("None")),
            "offset": _grid_wrong(_NOT_PLACES),
            "shape": _grid_wrong(NOT_COUNTS),
            "rotation": _NOT_PLACES,
            "shifted_rows": among("2", "-1", "'x'", "0.5", "nan", "[0]"),
        },
    ),
)  # fmt: skip
