"""Cases of files: captures, scenes, checkpoints, grids of sweeps and light fields that are damaged or lie."""

from __future__ import annotations

import struct
from typing import Any
from xml.sax.saxutils import quoteattr

from hypothesis import strategies as st

from .objects import WRONG_PARAMETER
from .values import (
    EDITS,
    LENGTH_TEXTS,
    LENGTHS,
    NAME_TEXTS,
    NOT_FINITE_TEXTS,
    Code,
    among,
    code,
    forbidden,
)

CAPTURES = st.sampled_from(("grey.exr", "colour.exr"))


def _filled(text: str, *parts: Code) -> Code:
    return st.builds(text.format, *parts)


def _packed(form: str, *numbers: st.SearchStrategy[int]) -> Code:
    return code(st.tuples(*numbers).map(lambda drawn: struct.pack(form, *drawn)))


# OpenEXR.
EXR_BYTES = _filled(
    "whole(read_capture(damaged({!r}, {})))",
    CAPTURES | st.sampled_from(("refocused.exr", "views.exr", "foreign.exr")),
    EDITS,
)
_EDGES = st.sampled_from((-(2**31), -(10**9), -64, -1, 0, 1, 31, 62, 64, 127, 4095, 65535, 2**24, 10**9, 2**31 - 1))
_SIZES = st.integers(1, 2**30).filter(lambda size: size != 64).map(lambda size: size - 1)
_CHANNELS: tuple[list[tuple[str, int, int, int]], ...] = (
    [], [("Z", 2, 1, 1)], [("R", 2, 1, 1)], [("R", 2, 1, 1), ("G", 2, 1, 1)], [("Y", 3, 1, 1)], [("Y", -1, 1, 1)],
    [("Y", 2, 0, 0)], [("Y", 2, 2, 2)], [("Y", 2, -1, 1)], [("Y", 2, 1, 1), ("Y", 2, 1, 1)], [("Y", 2, 2**31 - 1, 1)],
    [(f"c{i}", 2, 1, 1) for i in range(1000)], [("Y" * 300, 2, 1, 1)], [(name, 2, 1, 1) for name in "RGBY"],
)  # fmt: skip
_CHANNEL_LISTS = st.sampled_from(_CHANNELS).map(
    lambda channels: b"".join(name.encode() + b"\0" + struct.pack("<iiii", kind, 0, x, y) for name, kind, x, y in channels)
)
_ATTRIBUTES = st.sampled_from(("channels", "compression", "dataWindow", "displayWindow", "lineOrder", "mitsuba_plenoptic"))
_TYPES = st.sampled_from(("int", "float", "nosuch", "box2f", "m44d", "opaque", "preview", "timecode"))
_READ = "whole(read_capture({}))"
EXR_HEADERS = st.one_of(
    _filled(_READ.format("lying({!r}, {!r}, None, {})"), CAPTURES, st.sampled_from(("dataWindow", "displayWindow")),
            _packed("<iiii", _EDGES, _EDGES, _EDGES, _EDGES)),
    forbidden(_filled(_READ.format("lying({!r}, 'dataWindow', None, {})"), CAPTURES,
                      _packed("<iiii", st.just(0), st.just(0), _SIZES, _SIZES))),
    forbidden(_filled(_READ.format("lying({!r}, 'channels', None, {!r})"), CAPTURES,
                      _CHANNEL_LISTS | _CHANNEL_LISTS.map(lambda channels: channels + b"\0"))),
    _filled(_READ.format("lying({!r}, 'compression', None, {!r})"), CAPTURES, st.binary(min_size=1, max_size=1)),
    forbidden(_filled(_READ.format("lying({!r}, {!r}, None, None)"), CAPTURES, _ATTRIBUTES)),
    forbidden(_filled(_READ.format("lying({!r}, {!r}, {!r}, None)"), CAPTURES, _ATTRIBUTES, _TYPES)),
    _filled(_READ.format("lying({!r}, {!r}, None, {!r} * {})"), CAPTURES, _ATTRIBUTES, st.binary(min_size=1, max_size=9),
            among("0", "1", "3", "100_000")),
    forbidden(_filled(_READ.format("misplaced({!r}, 8 * {}, {})"), CAPTURES, code(st.integers(0, 3)),
                      _packed("<Q", st.sampled_from((0, 1, 8, 2**32, 10**9, 2**63, 2**64 - 1))))),
    forbidden(_filled(_READ.format("misplaced({!r}, {}, {})"), CAPTURES, among("32", "36"),
                      _packed("<i", st.sampled_from((-1, 7, 65535, 10**9, 2**31 - 1, -(2**31)))))),
    forbidden(_filled(_READ.format("damaged({!r}, [(4, 4, {})])"), CAPTURES,
                      _packed("<i", st.sampled_from((0, 1, 3, 0x202, 0x802, 0x1002, 0x1802, 0x10002, 2**31 - 1))))),
    forbidden(_filled(_READ.format("poisoned({!r}, {}, {})"), CAPTURES, code(st.tuples(st.integers(0, 63), st.integers(0, 63))),
                      among("nan", "inf", "-inf", "3e38", "-3e38", "2e30"))),
)  # fmt: skip
_JSON: dict[str, Code] = {
    "('kind',)": among("'reconstruction'", "''", "None", "1", "[]", "{'a': 1}", r"'capture\n'", "..."),
    "('model',)": among("'magic'", "''", "None", "3", "[]", "{}", "'RAY'", r"'\x1b]0;title\x07'", "..."),
    "('metadata',)": among("'text'", "3", "['a']", "True", "1.5"),
    "('camera',)": among("None", "3", "[]", "'camera'", "{}", "[1, 2]", "..."),
    "('camera', 'focal_length')": among("..."),
    "('camera', 'zoom')": among("1.0"),
    "('wavelength',)": among("-1", "0", "'633'", "[]", "[1.0, 2.0]", "{}", "True", "nan", "inf", "1e300", "[0, 0, 0]"),
}
_NOT_JSON = among(
    "'{'", "''", "'[]'", "'null'", "'[' * 100_000", "'{\"a\":' * 100_000", "'9' * 100_000", "'{\"kind\": \"capture\"} extra'",
    "'{\"kind\": \"capture\", \"camera\": {\"focal_length\": ' + '9' * 5000 + '}}'", r"'cos\nsystem\n(S\'true\'\ntR.'",
)  # fmt: skip
EXR_JSON = forbidden(
    _filled("read_capture(relabelled({!r}, {{('camera', name): value for name, value in dict({}).items()}}))", CAPTURES,
            WRONG_PARAMETER)
    | st.sampled_from(sorted(_JSON)).flatmap(
        lambda path: _filled("read_capture(relabelled({!r}, {{{}: {}}}))", CAPTURES, st.just(path), _JSON[path]))
    | _filled("read_capture(relabelled({!r}, {}))", CAPTURES, _NOT_JSON)
)  # fmt: skip

# Scenes.
_WIDTH = '<float name="detector_width" value="0.128"/>'
_INTEGRATOR = '<integrator type="path"/>'
_EMITTER = '<emitter type="constant"/>'
_SCENE_FILES = st.sampled_from(("scene.xml", "scene.xml", "square.ply", "dots.png"))
XML_BYTES = _filled("load_scene(scene(beside=damaged({!r}, {}))) and None", _SCENE_FILES, EDITS) | _filled(
    "render(beside=damaged({!r}, {}))", _SCENE_FILES, EDITS
)


def _changed(old: str, new: st.SearchStrategy[str]) -> Code:
    """Render a scene in which a text is replaced."""
    return forbidden(new.map(lambda text: f"render({(old, text)!a})"))


def _element(kind: str, name: str, value: str) -> str:
    return f'<{kind} name="{name}" value={quoteattr(value)}/>'


def _parameter(kind: str, name: str, value: str) -> str:
    return ("" if name == "detector_width" else _WIDTH) + _element(kind, name, value)


_WAVE_PARAMETERS: tuple[tuple[str, str, st.SearchStrategy[str]], ...] = (
    ("string", "wavelength", LENGTH_TEXTS | st.sampled_from(("1,2,3", "1,2", ",", "0.5", "1e7"))),
    ("integer", "radiators_per_lens", LENGTH_TEXTS | st.sampled_from(("2.5", "9" * 20, "257"))),
    ("integer", "passes", LENGTH_TEXTS | st.sampled_from(("2.5", "9" * 20))),
    ("string", "method", NAME_TEXTS),
    ("boolean", "occlusion", st.sampled_from(("maybe", "2", ""))),
    ("float", "accuracy", st.sampled_from(("wide", "nan", "inf", "-0.1", "1", "2"))),
)
_NOT_SENSOR = (
    '<float name="focus_distance" value="80"/>', '<float name="focus_distance" value="-3"/>',
    '<float name="mla_distance" value="120"/><float name="focus_distance" value="240"/>',
    '<string name="lens_model" value="thick"/>', '<integer name="lens_model" value="3"/>',
    '<float name="focal_lenght" value="80"/>', '<float name="near_clip" value="1"/>',
    '<vector name="mla_pitch" value="1, 2, 3"/>', '<rgb name="mla_pitch" value="1, 2, 3"/>',
    '<boolean name="mla_pitch" value="true"/>', '<transform name="mla_pitch"><scale value="2"/></transform>',
    '<transform name="to_world"><scale value="2"/></transform>',
    '<transform name="to_world"><scale x="0" y="0" z="0"/></transform>',
    '<transform name="to_world"><matrix value="nan 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform>',
    '<transform name="to_world"><translate x="nan"/></transform>',
    '<transform name="to_world"><translate x="inf"/></transform>',
    '<float name="shutter_open" value="2"/><float name="shutter_close" value="1"/>',
)  # fmt: skip
_FILM = '<integer name="width" value="$resolution"/>'
XML_VALUES = st.one_of(
    _changed(_WIDTH, st.builds(_parameter, st.sampled_from(("float", "string")), LENGTHS, LENGTH_TEXTS)),
    _changed(_WIDTH, st.sampled_from(_NOT_SENSOR).map(lambda text: text + _WIDTH)),
    _changed(
        _INTEGRATOR,
        st.sampled_from(_WAVE_PARAMETERS).flatmap(
            lambda parameter: parameter[2].map(
                lambda value: f'<integrator type="plenoptic_wave">{_element(*parameter[:2], value)}</integrator>'
            )
        ),
    ),
    _changed(
        _FILM,
        st.sampled_from(("0", "-1", "1.5", "wide", "2147483648", "99999999999", "1000000000", "2097152")).map(
            lambda value: _element("integer", "width", value)
        ),
    ),
    _changed(
        _FILM,
        st.sampled_from((("crop_offset_x", "-1"), ("crop_offset_x", "17"), ("crop_offset_x", "2147483647"),
                         ("crop_width", "0"), ("crop_width", "-1"), ("crop_width", "17"), ("crop_width", "99999"))).map(
            lambda item: _FILM + _element("integer", *item)
            + (_element("integer", "crop_width", "16") if item[0] == "crop_offset_x" else "")
        ),
    ),
)  # fmt: skip
_NOT_TYPES = st.sampled_from(("../../evil", "/tmp/evil", "nosuch", "", "a b", "..", "plugins/evil", "\\\\a\\b", "path\u202e"))
_NOT_MESHES = st.sampled_from(("/dev/zero", "/dev/stdin", "/dev/random", "/dev/full", "/nowhere/mesh.ply", "/proc/self/mem",
                               "/", "", "square.ply/x", "x" * 5000, "/dev/tty", "scene.xml"))  # fmt: skip
_LAUGHS = "<!DOCTYPE scene [<!ENTITY l0 \"ha\">" + "".join(
    f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 20)
) + "]>"  # fmt: skip
_INCLUDE = '<scene version="3.0.0">{}</scene>'
_HOSTILE = among(
    # The scene file is another.
    *(f"render(beside=holding('scene.xml', {text}))" for text in (
        "'<html></html>'", "''", "'scene'", "SCENE.encode('utf-16')", "SCENE.encode('utf-32')", r"SCENE.encode() + b'\xff\xfe'",
        "SCENE.replace('utf-8', 'cp037').encode()", "SCENE + '<scene version=\"3.0.0\"/>'",
        "'<scene version=\"3.0.0\"><integrator type=\"path\"/><emitter type=\"constant\"/></scene>'",
        "'<!DOCTYPE scene [<!ENTITY x SYSTEM \"file:///etc/passwd\">]><scene>&x;</scene>'",
        f"{_LAUGHS!r} + SCENE.partition('?>')[2].replace('square.ply', '&l19;')",
    )),
    # Something beside it is.
    "render(('square.ply', 'pipe'), beside=os.mkfifo('pipe'))",
    *(f"render(beside=holding('plugins/{name}', b'\\x7fELF'))" for name in ("evil.so", "path.so", "evil.dylib", "x.so.1")),
    *(f"render(beside=holding('square.ply', PLY.replace(b'vertex 3', b'vertex {count}')))"
      for count in ("4000000000", "9" * 20, "-5", "1e9", "2147483647")),
    # It includes others without end.
    *(f"render(({_EMITTER!r}, '<include filename=\"i0.xml\"/>'), beside=[holding(f'i{{n}}.xml', {_INCLUDE!r}.format({text}"
      " if n < 11 else '')) for n in range(12)])" for text in (
        "'<include filename=\"scene.xml\"/>'", "f'<include filename=\"i{n + 1}.xml\"/>'",
        "f'<include filename=\"i{n + 1}.xml\"/>' * 2")),
)  # fmt: skip
_REPLACED = (
    ('value="square.ply"', 'value="a\0b"'), ('type="plenoptic"', 'type="perspective"'), (' version="3.0.0"', ""),
    ("3.0.0", "x.y"), ('type="path"', 'type="ptracer"'), ("<sampler", '<sensor type="plenoptic"/><sampler'),
    (_EMITTER, '<ref id="nowhere"/>'), ('"$resolution"', '"$nosuch"'),
    (_INTEGRATOR, '<integrator type="aov"><string name="aovs" value="d:depth"/></integrator>'),
    (_EMITTER, '<emitter type="constant"><spectrum name="radiance" value="nan"/></emitter>'),
    (_EMITTER, '<emitter type="constant"><spectrum name="radiance" value="inf"/></emitter>'),
)  # fmt: skip
XML_HOSTILE = (
    forbidden(_HOSTILE)
    | forbidden(st.sampled_from(_REPLACED).map("render({!a})".format))
    | forbidden(_filled("render(({0!r}, '<{1} type=\"twosided\">' * {2} + '</{1}>' * {2}))", st.just(_EMITTER),
                        among("bsdf", "shape", "x", "integrator"), code(st.sampled_from((65, 100, 1000, 100_000)))))
    | _changed('type="constant"', _NOT_TYPES.map(lambda name: f"type={quoteattr(name)}"))
    | _changed('type="path"', _NOT_TYPES.map(lambda name: f"type={quoteattr(name)}"))
    | _changed(_EMITTER, _NOT_TYPES.map(lambda name: f"<alias id='x' as={quoteattr(name)}/>{_EMITTER}"))
    | _changed('value="square.ply"', _NOT_MESHES.map(lambda name: f"value={quoteattr(name)}"))
    | forbidden(_filled("render(beside=png('dots.png', {}, {}))", *[code(st.integers(10**6, 2**31 - 1))] * 2))
    | forbidden(st.just("render(('type=\"path\"', 'type=\"plenoptic_wave\"'), ('\"box\"', '\"gaussian\"'))"))
)  # fmt: skip

# Checkpoints and grids of sweeps.
_LIES: dict[str, Code] = {
    "kind": among("'capture'", "None"),
    "format": among("99", "'1'"),
    "sums": among("-1", "10**9", "'a'", "0.5", "None"),
    "batches": among("-1", "10**9", "[]", "0.5"),
    "run": among("{}", "None", "[]"),
    "shapes": among("{}", "{'image': [1, 1, 1]}", "{'image': [-1, 64, 1]}", "{'image': [10**9, 10**9, 10]}",
                    "{'../../evil': [1, 1, 1]}", "[]"),
    "image": among("nan", "inf"),
}  # fmt: skip
CHECKPOINTS = _filled("resume(damaged('stopped.checkpoint', {}))", EDITS) | forbidden(
    st.sampled_from(sorted(_LIES)).flatmap(lambda name: _filled(f"resume(lying_checkpoint({{{{{name!r}: {{}}}}}}))", _LIES[name]))
)
_SWEEP = "command('sweep', scene(), '-o', 'out.nc', {})"
_NOT_GRIDS: tuple[Any, ...] = (
    "", "[]", "3", "text", "a: []", "a: {b: 1}", "a: [1, [2]]", "a: [true]", "a: [null]", "a: [1, 1]", "a: .nan",
    "a: .inf", "1: [2]", "a b: [1]", "? [1]\n: [2]", "a: !!python/object/apply:os.system ['touch hacked']",
    "a: 2020-01-01", "!!python/name:os.system", "a: [", "\t", "a: *nowhere", b"\xff\xfe\0", b"a: [1]\0",
    "a: [1]\na: [2]", "x0: &x0 [1, 1]\n" + "".join(f"x{i}: &x{i} [{', '.join([f'*x{i - 1}'] * 10)}]\n" for i in range(1, 12)),
    "a: &a [*a]", "\u202e: [1]", "---\na: 1\n---\nb: 2",
)  # fmt: skip
_LONG_GRIDS = among("'[' * 10_000", "'a: [' * 5_000", "'a: [' + '0.5, ' * 100_000 + '1]'", "'a: ' + '9' * 10_000",
                    "'a: [' + ', '.join(map(str, range(150_001))) + ']'")  # fmt: skip
_NOT_VARIED = st.sampled_from(("a", "=1", "a=", "a=1,1", "a=1,", "a=,", "a=wide", "a b=1", "1=1", "\0=1")) | st.builds(
    "a={}".format, NOT_FINITE_TEXTS
)
GRIDS = (
    _filled(_SWEEP.format("'--grid', damaged('grid.yaml', {})"), EDITS)
    | forbidden(_filled(_SWEEP.format("'--grid', holding('grid.yaml', {})"), code(st.sampled_from(_NOT_GRIDS)) | _LONG_GRIDS))
    | forbidden(_filled(_SWEEP.format("'--vary', {}"), code(_NOT_VARIED)))
    | forbidden(st.just(_SWEEP.format("'--vary', 'a=1,2', '--vary', 'b=' + ','.join(map(str, range(60_000)))")))
)

# Light fields of other programs. Pictures do not tell how many views they hold.
_OPEN = "open_light_field({})"
_OPEN_PICTURE = "open_light_field({}, views=light_field().sizes['u'])"
LIGHT_FIELD_BYTES = _filled(
    _OPEN.format("damaged({!r}, {})"),
    st.sampled_from(("uint8.mat", "uint16.mat", "single.mat", "version7.mat", "version7.mat")), EDITS,
) | _filled(_OPEN_PICTURE.format("damaged({!r}, {})"), st.sampled_from(("views.png", "lenses.eslf.png")), EDITS)  # fmt: skip
_LF = "np.ones((3, 3, 4, 4, 2), 'u1')"
_GRID_MODEL = (
    "{{'HSpacing': 16.0, 'VSpacing': 16.0, 'HOffset': 8.0, 'VOffset': 8.0, 'Rot': 0.0, 'UMax': 4.0, 'VMax': 4.0, "
    "'FirstPosShiftRow': 5.0, 'Orientation': 'horz', {!r}: {}}}"
)
_GRID_NAMES = st.sampled_from(("HSpacing", "VSpacing", "HOffset", "VOffset", "Rot", "UMax", "VMax", "FirstPosShiftRow"))
_VARIABLES = st.one_of(
    among(
        f"'XX': {_LF}", f"'LF': {_LF}[0, 0]", "'LF': np.ones((2, 2, 3, 3, 7), 'u1')", "'LF': np.zeros((0, 2, 3, 3, 2), 'u1')",
        "'LF': 'text'", "'LF': {'a': 1}", "'LF': np.array([[1, 'a']], object)", f"'LF': {_LF} * 1j",
        f"'LF': {_LF}, 'LensletGridModel': {{'HSpacing': 16.0}}", f"'LF': {_LF}, 'Camera': '{{' * 50_000",
        rf"'LF': {_LF}, 'Camera': 'cos\nsystem\n(S\'true\'\ntR.'",
        f"'LF': {_LF}, 'LensletGridModel': {{'HSpacing': np.zeros(4_000_000)}}",
    ),
    _filled("'LF': np.where(np.arange(288).reshape(3, 3, 4, 4, 2) == {}, {}, 1).astype('f4')", code(st.integers(0, 287)),
            among("nan", "inf", "-inf", "3e38")),
    _filled(f"'LF': {_LF}, 'MaxLum': {{}}", among("nan", "inf", "-inf", "-1.0", "'a'", "1e38")),
    _filled(f"'LF': {_LF}, 'LensletGridModel': {_GRID_MODEL}", _GRID_NAMES,
            among("nan", "inf", "-1e300", "'wide'", "[1.0, 2.0]", "{'a': 1.0}", "np.zeros((50, 50))", "1j")),
    _filled(f"'LF': {_LF}, 'Camera': json.dumps({{{{**CAMERA.to_dict(), {{!r}}: {{}}}}}})",
            st.sampled_from(("focal_length", "mla_pitch", "resolution")), among("-1", "None", "'x'", "nan", "[]")),
)  # fmt: skip
_CLAIMS = code(st.sampled_from(((2**31 - 1, 2**31 - 1, 1, 1), (100_000, 100_000, 10, 10), (-1, 2, 3, 4), (2**16, 2**16, 9, 9))))
_FILLINGS = among(
    *(f"lambda f: f.__setitem__('LF', {value})" for value in (
        "h5py.SoftLink('/nowhere')", "'text'", "np.full(LIGHT_FIELD_SHAPE, nan, 'f4')", "np.ones((9, 4, 4, 3, 3), 'u1')",
        "np.zeros(LIGHT_FIELD_SHAPE, [('a', 'f4'), ('b', 'f4')])", "h5py.Empty('f4')")),
    *(f"lambda f: f.create_dataset('LF', {arguments})" for arguments in (
        "(2, 10**6, 10**6, 9, 9), 'u1', chunks=(1, 16, 16, 3, 3)", "(2, 2**15, 2**15, 15, 15), 'u1', chunks=(1, 16, 16, 3, 3)",
        "LIGHT_FIELD_SHAPE, h5py.ref_dtype", "LIGHT_FIELD_SHAPE, 'u1', external=[(file('grey.exr'), 0, 288)]")),
    "lambda f: f.create_group('LF')", "other_file(virtual)",
    "other_file(lambda f: f.__setitem__('LF', h5py.ExternalLink('other.h5', 'LF')))",
)  # fmt: skip
_PNG_SIZES = st.sampled_from((0, 1, 7, 60_000, 10**6, 2**31 - 1, 2**32 - 1)) | st.integers(20_000, 2**32 - 1)
_DEPTHS = st.sampled_from(("depth=8, colour=0", "depth=16, colour=0", "depth=8, colour=2", "depth=16, colour=6",
                           "depth=8, colour=3", "depth=1, colour=0", "depth=7, colour=9"))  # fmt: skip
LIGHT_FIELD_LIES = st.one_of(
    forbidden(_filled(_OPEN.format("matlab({{{}}}, compressed={})"), _VARIABLES, among("True", "False"))),
    forbidden(_filled(_OPEN.format("matlab_claim({}, {}, {}, {})"), _CLAIMS, among("16", "2**31", "2**32 - 1"),
                      among("88", "2**32 - 1", "8"), among("True", "False"))),
    forbidden(_filled(_OPEN.format("hdf5('light.mat', {})"), _FILLINGS)),
    forbidden(_filled(_OPEN_PICTURE.format("png('views.png', {}, {}, {}, data=bytes(1000), text={})"), code(_PNG_SIZES),
                      code(_PNG_SIZES), _DEPTHS, among("0", "10_000_000"))),
)  # fmt: skip
