"""Cases of the command line: each breaks one rule, and must end with status 2 and one line."""

from __future__ import annotations

from hypothesis import strategies as st

from .values import (
    COUNT_TEXTS,
    LENGTH_TEXTS,
    LENGTHS,
    NAME_TEXTS,
    NOT_FINITE_TEXTS,
    NOT_NUMBER_TEXTS,
    NUMBER_TEXTS,
    Code,
    among,
    code,
    forbidden,
)

NOT_FILES = code(
    st.sampled_from(("nosuch.exr", "", ".", "/", "/dev/null", "\0", "x" * 5000, "nowhere/raw.exr", "\u202e.exr", "-", "\ud800.exr"))
) | st.binary(max_size=99).map("holding('text.exr', {!r})".format)  # fmt: skip
NOT_OUTPUTS = code(
    st.sampled_from(("", ".", "/", "out", "out.jpg", "nowhere/out.exr", "/dev/full", "x" * 5000 + ".exr", "\0.exr", "out.EXE",
                     "/proc/out.exr"))
) | among("os.mkdir('folder.exr') or 'folder.exr'", "file('grey.exr') + '/out.exr'")  # fmt: skip
_RAW = "file('grey.exr')"
_WAVELENGTHS = LENGTH_TEXTS | st.sampled_from(("0.5", "1e7"))
_PLACES = NOT_NUMBER_TEXTS | NOT_FINITE_TEXTS
_NOT_POSITIVE = LENGTH_TEXTS.filter(lambda text: text not in ("1e300", "1e-300")) | st.sampled_from(("1e300", "1e-300"))
_NOT_NEGATIVE = _PLACES | st.sampled_from(("-1", "1e300"))
_SEEDS = NOT_NUMBER_TEXTS | st.sampled_from(("-1", "1.5"))
_VARIANTS = st.sampled_from(("nosuch", "scalar_rgb", "cuda_ad_nosuch", "llvm_ad_mono "))
_VIEW_COUNTS = COUNT_TEXTS | st.just("3")
_DEFINITIONS = (
    st.builds("{}={}".format, LENGTHS, LENGTH_TEXTS)
    | st.builds("resolution={}".format, NUMBER_TEXTS | st.sampled_from(("1.5", "99999999999", "1048577", "65536")))
    | st.sampled_from(("", "resolution", "=", "=3", "nosuch=1", "\0=1", "$x=1", "\x1b=1"))
)
_SCENES = code(st.sampled_from(("nosuch", "", ".", "../scenes/nosuch", "letters.xml", "\0", "x" * 5000, "/dev/zero", "/dev/null",
                                "\x1b[2J"))) | among(_RAW)  # fmt: skip


def _text(values: st.SearchStrategy[str]) -> Code:
    return values.map(ascii)


# What a whole command needs, and for each argument what it may not be. An empty name is the first argument.
COMMANDS: tuple[tuple[str, dict[str, str], dict[str, Code]], ...] = (
    ("render", {"": "'white'", "-o": "'out.exr'", "--spp": "'1'", "-D": "'resolution=256'"}, {
        "": _SCENES, "-o": NOT_OUTPUTS, "--spp": _text(COUNT_TEXTS), "--model": _text(NAME_TEXTS),
        "--seed": _text(_SEEDS | st.sampled_from(("4294967296", "9" * 400))), "--wavelength": among("'633'"),
        "--variant": _text(_VARIANTS), "-D": _text(_DEFINITIONS)}),
    ("render", {"": "'white'", "-o": "'out.exr'", "--spp": "'1'", "-D": "'resolution=256'", "--model": "'wave'"}, {
        "--wavelength": _text(_WAVELENGTHS | st.sampled_from(("0.1", "1,2,3", ","))),
        "--radiators-per-lens": _text(COUNT_TEXTS | st.just("257"))}),
    ("reconstruct", {"": _RAW, "-o": "'out.exr'", "--distance": "'240'"}, {
        "": NOT_FILES, "-o": NOT_OUTPUTS, "--distance": _text(LENGTH_TEXTS | st.sampled_from(("80", "79.9"))),
        "--method": _text(NAME_TEXTS), "--footprint": _text(NAME_TEXTS), "--variant": _text(_VARIANTS),
        "--oversample": _text(COUNT_TEXTS | st.sampled_from(("100000", "99999999")))}),
    ("reconstruct", {"": _RAW, "-o": "'out.exr'", "--distance": "'240'", "--method": "'partial'"}, {
        "--interleave": _text(COUNT_TEXTS | st.sampled_from(("AUTO", "\u0663\u0663\u0663", "\u00b2"))),
        "--wavelength": _text(_WAVELENGTHS)}),
    ("views", {"": _RAW, "-o": "'out.exr'"}, {
        "": NOT_FILES, "-o": NOT_OUTPUTS, "--count": _text(COUNT_TEXTS | st.just("1000")), "--white": NOT_FILES,
        "--view-count": _text(_VIEW_COUNTS)}),
    ("epi", {"": _RAW, "-o": "'out.exr'"}, {
        "-o": NOT_OUTPUTS, "--axis": _text(NAME_TEXTS), "--at": _text(_PLACES), "--through": _text(_PLACES)}),
    ("stack", {"": _RAW, "-o": "'out.exr'", "--distance": "'240'"}, {
        "-o": NOT_OUTPUTS, "--distance": _text(NUMBER_TEXTS.filter(lambda text: "inf" not in text.lower() and "999" not in text)
                                               | st.sampled_from(("80", "1e300"))), "--method": _text(NAME_TEXTS)}),
    ("depth", {"": _RAW, "-o": "'out.exr'"}, {
        "": NOT_FILES, "--near": _text(NUMBER_TEXTS | st.sampled_from(("80", "1e300"))),
        "--far": _text(NOT_NUMBER_TEXTS | st.sampled_from(("0", "-1", "nan", "81"))),
        "--planes": _text(COUNT_TEXTS | st.sampled_from(("2", "1025")))}),
    ("expose", {"": _RAW, "-o": "'out.exr'", "--photons": "'1000'"}, {
        "": NOT_FILES, "-o": NOT_OUTPUTS, "--photons": _text(_NOT_POSITIVE),
        "--quantum-efficiency": _text(_NOT_POSITIVE | st.just("1.01")),
        "--full-well": _text(_NOT_POSITIVE | st.just("0.5")), "--dark-electrons": _text(_NOT_NEGATIVE),
        "--read-noise": _text(_NOT_NEGATIVE), "--bits": _text(COUNT_TEXTS | st.just("17")),
        "--gain": _text(_NOT_POSITIVE), "--seed": _text(_SEEDS),
        "--black-level": _text(NOT_NUMBER_TEXTS | st.sampled_from(("-1", "4095", "1.5", "9" * 5000)))}),
    ("convert", {"": _RAW, "-o": "'out.mat'"}, {
        "": NOT_FILES, "--view-count": _text(_VIEW_COUNTS), "--white": NOT_FILES,
        "-o": code(st.sampled_from(("out", "out.exr", "out.jpg", "nowhere/out.mat", ".mat/x.mat")))}),
    ("info", {"": _RAW}, {"": NOT_FILES | _SCENES.filter(lambda scene: scene != _RAW), "--wavelength": _text(_WAVELENGTHS)}),
    ("info", {"": "'letters'"}, {"-D": _text(st.builds("{}={}".format, LENGTHS, LENGTH_TEXTS))}),
    ("compare", {"": "'letters'", "-o": "'out'", "--distance": "'240'", "--spp": "'1'", "-D": "'resolution=256'"}, {
        "--distance": _text(NUMBER_TEXTS), "--wavelength": _text(_WAVELENGTHS), "--radiators-per-lens": _text(COUNT_TEXTS),
        "--spp": _text(NUMBER_TEXTS), "--variant": _text(st.sampled_from(("nosuch", "llvm_ad_rgb", ""))), "-o": among(_RAW),
        "-D": _text(st.sampled_from(("resolution", "nosuch=1", "mla_pitch=nan")))}),
)  # fmt: skip
_USAGE = (
    "'nosuch'", "'render'", "'render', 'white'", f"'reconstruct', {_RAW}, '-o', 'out.exr'", "'--nosuch'", "'views', '-o'",
    "'render', 'white', '-o', 'out.exr', '--nosuch'", "'render', 'white', 'extra', '-o', 'out.exr'", r"'\x1b[31m'", "'ren der'",
    "'info'", "'info', 'letters', '--wavelength'", f"'reproduce', '-o', {_RAW}", "'reproduce', '-o', 'out', '--preset', 'magic'",
    "'doctor', 'extra'", f"'expose', {_RAW}, '-o', 'out.exr'",
)  # fmt: skip
_CUT_SHORT = (
    "'reconstruct', {}, '-o', 'out.exr', '--distance', '240'", "'views', {}, '-o', 'out.exr'", "'info', {}",
    "'expose', {}, '-o', 'out.exr', '--photons', '100'", "'convert', {}, '-o', 'out.mat'", "'depth', {}, '-o', 'out.exr'",
)  # fmt: skip


def _one_wrong(command: tuple[str, dict[str, str], dict[str, Code]]) -> Code:
    name, right, wrong = command

    def written(option: str, value: str) -> str:
        arguments = {**right, option: value}
        # With "=", so that a value that begins with a hyphen is a value.
        words = [
            f"{option + '='!r} + {value}" if option.startswith("--") else f"{option!r}, {value}" if option else value
            for option, value in arguments.items()
        ]
        return f"command({name!r}, {', '.join(words)})"

    return st.sampled_from(sorted(wrong)).flatmap(lambda option: wrong[option].map(lambda value: written(option, value)))


CASES = forbidden(
    st.sampled_from(COMMANDS).flatmap(_one_wrong)
    | st.sampled_from(_USAGE).map("command({})".format)
    | st.builds(
        lambda words, place: "command({})".format(words.format(f"damaged('grey.exr', [({place}, 2**30, b'')])")),
        st.sampled_from(_CUT_SHORT), st.integers(0, 2000))
)  # fmt: skip
