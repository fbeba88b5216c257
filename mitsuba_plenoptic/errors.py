"""The exception for a user's mistake, the checks that raise it, and the bounds of a camera's parameters.

Every ``require_...`` returns what it was given, as the type that it should be, or raises an `InputError` that names the
thing, its value and the rule.
"""

import contextlib
import difflib
import functools
import importlib
import inspect
import itertools
import math
import re
import reprlib
import sys
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

_Call = TypeVar("_Call", bound=Callable)

_LONGEST_VALUE = 80

# A list that holds itself many times over, as YAML can write it, would be endless in full.
_SHORT = reprlib.Repr()
_SHORT.maxlevel = 3
_SHORT.maxlist = _SHORT.maxtuple = 12
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = _LONGEST_VALUE - 4


class InputError(ValueError):
    """A user's mistake, described in one line that names the thing, its value and the rule.

    Whatever files and arguments put into the message, it stays one line of printable characters.
    """

    def __init__(self, message: str):
        super().__init__(printable(message, 1000))


def refuse_if(broken: object, message: str) -> None:
    """Raise an `InputError` if a rule is broken; the message is built in any case, so it must be cheap."""
    if broken:
        raise InputError(message)


@contextlib.contextmanager
def naming(thing: object) -> Iterator[None]:
    """Begin the message of an `InputError` with the thing that it is about, such as the path of a file."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{thing}: {error}") from None


NO_ARRAY = TypeError, ValueError, OverflowError
"""Exceptions of NumPy for what is no array of numbers."""

NO_RECORD = ValueError, TypeError, KeyError, RecursionError
"""Exceptions for a text that is no JSON, or not of the entries that are looked for."""


@contextlib.contextmanager
def refusing(rule: str, *kinds: type[Exception]) -> Iterator[None]:
    """Raise an `InputError` that states a rule, in place of the named kinds of exceptions, or of any kind.

    A rule that ends in a colon is followed by the exception's own message.
    """
    kinds = kinds or (Exception,)
    try:
        yield
    except InputError:
        raise
    except kinds as error:
        cause = f"no entry {error}" if isinstance(error, KeyError) else f"{error}"
        raise InputError(f"{rule} {cause}" if rule.endswith(":") else rule) from None


def printable(text: str, longest: int | None = None) -> str:
    """Return a text as one line without terminal control: white space becomes a space, control characters escapes."""
    if longest is not None and len(text) > longest:
        text = f"{text[: longest - 3]}..."
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() else " " if c.isspace() else c.encode("unicode_escape", "surrogatepass").decode()
        for c in text
    )


def short_repr(value: Any) -> str:
    """Return the representation of a value for a message, shortened."""
    try:
        text = _SHORT.repr(value)
    except Exception as error:  # such as an int of more digits than Python prints
        text = f"{type(value).__name__} ({error})"
    return printable(" ".join(text.split()), _LONGEST_VALUE)


SCENE_XML = "XML with the root <scene>"
"""What `content_of` says of a scene."""

_BEGINNINGS = {
    b"\xff\xd8\xff": "a JPEG picture",
    b"\x89PNG": "a PNG picture",
    b"II*\0": "a TIFF picture",
    b"MM\0*": "a TIFF picture",
    b"\x76\x2f\x31\x01": "an OpenEXR image",
    b"\x93NUMPY": "an array of NumPy",
    b"\x1f\x8b": "packed by gzip (unpack it)",
    b"PK": "a ZIP archive (unpack it)",
    b"%YAML:": "YAML of OpenCV",
    b"MATLAB 5.0 MAT-file": "a .mat file of MATLAB 5",
    b"MATLAB 7.3 MAT-file": "a .mat file of MATLAB 7.3",
    b"\x89HDF": "an HDF5 file",
}


def content_of(path: Path) -> str:
    """Return what a file is by its first bytes, for a message; "text" or "XML" begin the answer for these."""
    if not path.is_file():
        return "a folder" if path.is_dir() else "no regular file"
    with path.open("rb") as file:
        first = file.read(2**20)
    text = first.decode("utf-8-sig", errors="replace").strip()
    kinds = [kind for begins, kind in _BEGINNINGS.items() if first.startswith(begins)]
    if kinds or not text or "\0" in text or "\ufffd" in text[:64]:
        return kinds[0] if kinds else "binary data" if text else "an empty file"
    root = re.search(r"<([^\W\d][\w:.-]*)", re.sub(r"(?s)<!--.*?-->", "", text)) if text[0] == "<" else None
    if text[0] == "{":
        return "text in JSON"
    return f"XML with the root <{root[1]}>" if root else f"text that begins with {short_repr(text.splitlines()[0])}"


_options: Mapping[str, str] | None = None
"""Options by the names of the library's arguments that they are for; None in Python."""


@contextlib.contextmanager
def at_shell(options: Mapping[str, str]) -> Iterator[None]:
    """Spell arguments as command-line options in advice while the context is open; `options` lists deviating names."""
    global _options
    before = _options
    _options = options
    try:
        yield
    finally:
        _options = before


def advice(*, python: str, shell: str) -> str:
    """Return the advice for Python or the advice for a shell, whichever the user works in."""
    return python if _options is None else shell


def argument(name: str) -> str:
    """Return the name of an argument for advice: as in Python or, at a shell, as the command's option."""
    return advice(python=name, shell=(_options or {}).get(name, f"--{name.replace('_', '-')}"))


_MATCHED = "PlenopticCamera.matched, --camera and camera files take {} with the rest of a data sheet"

_RELATIONS = {
    "f_number": ("aperture_radius", f"focal_length / (2 f_number); {_MATCHED}"),
    "aperture": ("aperture_radius", "half the diameter of the main lens; mla_aperture is the shape of microlenses"),
    "aperture_diameter": ("aperture_radius", "half of it"),
    "lenses": ("detector_width", f"lenses * pixels_per_lens * pixel_size; {_MATCHED}"),
    "lens_count": ("detector_width", "lens_count * mla_pitch"),
    "pixels_per_lens": (
        "mla_pitch",
        f"pixels_per_lens * pixel_size / (1 + detector_distance / mla_distance); {_MATCHED}",
    ),
    "pixel_size": ("detector_width", f"pixel_size * columns of resolution; {_MATCHED}"),
    "pixel_pitch": ("detector_width", "pixel_pitch * columns of resolution"),
    "sensor_size": ("detector_width", "its first number; the second follows from resolution, as pixels are square"),
    "detector_size": ("detector_width", "its first number; the second follows from resolution, as pixels are square"),
    "detector_height": ("detector_width", "detector_height * columns / rows of resolution, as pixels are square"),
    "lattice": ("mla_lattice", "square or hexagonal"),
    "load": ("from_json", "of the text of a camera's file; read_capture and load_scene read files"),
    "radius": ("core", "the radius of a vortex's core"),
    "pitch": ("mla_pitch", "the distance of neighbouring microlenses in millimetres"),
}
"""Names that parameters, most of them a camera's, have elsewhere: the parameter, and how it follows."""


def relation(name: str) -> str:
    """Return a sentence on the camera parameter that replaces a commonly used name, empty for other names."""
    plain = re.sub(r"[\W_]", "", name.lower())
    for usual, (parameter, rule) in _RELATIONS.items():
        if usual.replace("_", "") == plain:
            return f"{parameter} is {rule.format(usual)}"
    return ""


def did_you_mean(name: Any, names_known: Iterable) -> str:
    """Return the end of a message on an unknown name: the most similar known name, or nothing.

    Of dotted names the last component counts.
    """
    names = {str(candidate).lower().rpartition(".")[2]: str(candidate) for candidate in names_known}
    rule = relation(str(name))
    if rule.partition(" ")[0] in names:
        return f"; {rule}"
    closest = difflib.get_close_matches(str(name).lower()[:_LONGEST_VALUE], names, n=1)
    return f"; did you mean {names[closest[0]]}?" if closest else ""


_PLAIN = {"int", "float", "bool", "str", "tuple", "list", "dict", "Sequence", "Mapping", "Path", "None"}
"""Types of arguments that are not recognised as swapped."""


def suggest_keywords(
    function: _Call, others: Iterable[str] = (), absent: Callable[[str], str] = lambda name: ""
) -> _Call:
    """Return a function that answers an unknown keyword with the most similar known one.

    `others` are keywords that the function hands on; for a class, the constructor counts. `absent` returns the line for
    keywords that a missing extension would add. Modules of such functions postpone annotations: types of arguments in
    wrong places are told by their names as they are written.
    """
    if isinstance(function, type):
        constructor = function.__init__  # type: ignore[misc]
        type.__setattr__(function, "__init__", suggest_keywords(constructor, others, absent))
        return cast(_Call, function)
    parameters = inspect.signature(function).parameters
    keywords = {*parameters, *others}
    types = [set(re.findall(r"\w+", str(parameter.annotation))) for parameter in parameters.values()]

    @functools.wraps(function)
    def called(*arguments: Any, **options: Any) -> Any:
        # Numbers, texts and rows of numbers may be anything, but cameras, scenes and images have one position.
        kinds = [
            {kind.__name__ for kind in type(value).__mro__} - _PLAIN if getattr(value, "ndim", 2) > 1 else set()
            for value in arguments
        ]
        for index, other in itertools.permutations(range(min(len(kinds), len(types))), 2):
            fits = kinds[index] & (types[other] - types[index])
            if fits and "Any" not in types[index] and not kinds[other] & types[other]:
                names = list(parameters)
                raise InputError(
                    f"{names[index]} of type {type(arguments[index]).__name__}, {names[other]} = "
                    f"{short_repr(arguments[other])}: they are swapped; {names[min(index, other)]} comes first"
                )
        for name in options:
            if name not in keywords and absent(name):
                raise InputError(absent(name))
            if name not in keywords:
                raise TypeError(
                    f"{function.__qualname__.removesuffix('.__init__')}() got an unexpected keyword argument '{name}'"
                    f"{did_you_mean(name, keywords)}"
                )
        import numpy as np

        # Small numbers may become 0, even where a user lets NumPy raise errors.
        with np.errstate(under="ignore"):
            try:
                return function(*arguments, **options)
            except RuntimeError as error:
                # What a user's function raises within a generator, such as the report of progress of a sum.
                if isinstance(error.__cause__, StopIteration):
                    raise error.__cause__ from None
                raise

    return cast(_Call, called)


def require_number(
    name: str,
    value: Any,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    positive: bool = False,
    finite: bool = True,
) -> float:
    """Return `value` as a float if it is a number within the bounds; refuse anything else."""
    if _is_flag(value) or isinstance(value, (str, bytes, bytearray)) or value is None:
        has_unit = isinstance(value, str) and re.fullmatch(r"[-+]?\d[\d.e+-]*\s*[^\W\d]+", value.strip())
        units = ", without a unit: lengths are in mm, wavelengths in nm" if has_unit else ""
        raise InputError(f"{name} = {short_repr(value)}: it must be a number{units}")
    try:
        result = float(value)
    except OverflowError:
        raise InputError(f"{name} = {short_repr(value)}: it must be finite") from None
    except (TypeError, ValueError):
        raise InputError(f"{name} = {short_repr(value)}: it must be a number") from None
    if math.isnan(result) or (finite and math.isinf(result)):
        raise InputError(f"{name} = {result:g}: it must be finite")
    if positive and result <= 0:
        raise InputError(f"{name} = {result:g}: it must be greater than 0")
    if minimum is not None and result < minimum:
        raise InputError(f"{name} = {result:g}: it must be at least {minimum:g}")
    if maximum is not None and maximum < result < math.inf:
        raise InputError(f"{name} = {result:g}: it must be at most {maximum:g}")
    return result


def require_choice(name: str, value: Any, choices: Any) -> str:
    """Return a word that is one of the choices, a collection or a `Literal` type; refuse other words."""
    choices = get_args(choices) or choices
    if not isinstance(value, str) or value not in choices:
        rule = f"it must be one of {', '.join(choices)}"
        raise InputError(f"{name} = {short_repr(value)}: {rule}{did_you_mean(value, choices)}")
    return value


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the line outside this package that called it, through decorators and contexts."""
    ours = str(Path(__file__).parent)
    level = 1
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith((ours, contextlib.__file__)):
        level = level + 1
        frame = frame.f_back
    warnings.warn(message, category, stacklevel=level)


def require_suffix(path: Path, suffixes: Collection[str]) -> None:
    """Refuse the name of a file that ends in none of the suffixes."""
    refuse_if(
        not path.name.lower().endswith(tuple(suffixes)), f"{path}: give a name that ends in {' or '.join(suffixes)}"
    )


def require_known(where: str, names: Iterable, allowed: Collection[str]) -> None:
    """Refuse the first name that is not among the known ones; `what` begins the message, such as ``camera: ``."""
    for name in names:
        if name not in allowed:
            raise InputError(f"{where}{name}: it is not one of {', '.join(allowed)}{did_you_mean(name, allowed)}")


def require_pair(
    name: str, value: Any, meaning: str, rule: Callable[[str, Any], Any] = lambda name, entry: entry
) -> tuple[Any, Any]:
    """Return the two entries of a pair, each as a rule returns it; refuse anything that is not a pair."""
    try:
        first, second = value
    except (TypeError, ValueError):
        spelt = advice(python="", shell=f", written {name}={meaning.strip('()').replace(' ', '')}")
        raise InputError(f"{name} = {short_repr(value)}: it must be a pair {meaning}{spelt}") from None
    return rule(name, first), rule(name, second)


def require_flag(name: str, value: Any) -> bool:
    """Return a truth value as a bool; a word such as "no", which Python takes for true, is refused."""
    if not _is_flag(value):
        raise InputError(f"{name} = {short_repr(value)}: it must be True or False")
    return bool(value)


def put(record: Any, **values: Any) -> None:
    """Replace fields of a frozen dataclass while it is being made, for example by their checked values."""
    for name, value in values.items():
        object.__setattr__(record, name, value)


def put_checked(record: Any, **rules: Callable[[str, Any], Any]) -> None:
    """Replace fields of a frozen dataclass that is being made by what their rules return; a default of None stays."""
    for name, rule in rules.items():
        value = getattr(record, name)
        if value is not None or getattr(type(record), name, "") is not None:
            put(record, **{name: rule(name, value)})


def require_module(name: str, message: str) -> Any:
    """Return an optional package's module; the message says what it is for and how to install it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(message) from None


def require_count(name: str, value: Any, *, minimum: int = 1, maximum: int | None = None) -> int:
    """Return an integer within bounds as an int."""
    count = require_number(name, value)
    if count != int(count):
        raise InputError(f"{name} = {short_repr(value)}: it must be a whole number")
    if count < minimum:
        raise InputError(f"{name} = {short_repr(int(count))}: it must be at least {minimum}")
    if maximum is not None and count > maximum:
        raise InputError(f"{name} = {short_repr(int(count))}: it must be at most {maximum}")
    return int(count)


SHORTEST = 1e-9
LONGEST = 1e9
"""Bounds of every length in scene units: a picometre and a thousand kilometres in millimetres.

Between them no product or quotient of a camera's parameters leaves what a float holds.
"""

MOST_PIXELS = 2**20
"""Pixels along an axis of a detector, at most; pixel coordinates stay exact in single precision."""

WAVELENGTHS = (200.0, 2500.0)
"""Bounds of a wavelength in nanometres: where lenses of glass let light through, as catalogues give their indices."""

_UNITS = {"metres": 1e9, "millimetres": 1e6, "micrometres": 1e3, "angstroms": 0.1}
"""Nanometres in the units that wavelengths are given in by mistake."""

WAVEFRONT_UNIT = 633.0
"""Wavelength in nanometres in whose waves aberrations are given; other wavelengths see the same path."""

MOST_ABERRATIONS = 66
"""Zernike polynomials at most: those up to the tenth order."""

FULL_TURN = 360.0
"""Bound of a rotation in degrees, in either direction."""

STEEPEST_TILT = 5.0
"""Degrees by which an array may be tilted."""

MOST_STRETCH = 10.0
"""One pitch over the other, at most."""

MOST_JITTER = 0.1
"""Standard deviation of lenses' positions, over the pitch, and of their focal lengths, over these, at most."""

MOST_WARP = 0.5
MOST_WARP_SLOPE = 0.1
"""Displacement of a warped array's lenses over the pitch, and its change per mm of their positions, at most."""


def require_wavelength(value: Any, name: str = "wavelength") -> float:
    """Return a wavelength in nanometres, from 200 to 2500, as a float; other units are recognised."""
    wavelength = require_number(name, value, positive=True)
    low, high = WAVELENGTHS
    if low <= wavelength <= high:
        return wavelength
    looks = [
        f"; it looks like {unit}, {wavelength * size:.6g} nm"
        for unit, size in _UNITS.items()
        if low <= wavelength * size <= high
    ]
    raise InputError(f"{name} = {wavelength:g}: it must be from {low:g} to {high:g} nm{''.join(looks)}")


def require_accuracy(accuracy: Any, name: str = "accuracy") -> float:
    """Return an allowed error as a float; refuse values that no computation can keep."""
    error = require_number(name, accuracy)
    refuse_if(not 0 <= error < 1, f"{name} = {accuracy!r}: it must be from 0 (exact) to below 1")
    return error


def require_length(name: str, value: Any, *, finite: bool = True) -> float:
    """Return a length in scene units, from 1e-9 to 1e9 or infinite where that is allowed, as a float."""
    return require_number(name, value, positive=True, minimum=SHORTEST, maximum=LONGEST, finite=finite)


def require_lengths(name: str, value: Any, rule: Callable[[str, Any], float] = require_length) -> tuple[float, ...]:
    """Return one or several lengths, or numbers by another rule, as a tuple."""
    value = _plain(value)
    return tuple(rule(name, length) for length in (value if isinstance(value, (tuple, list)) else [value]))


def require_pitches(name: str, value: Any) -> tuple[float, float]:
    """Return the pitches along and across the rows of a lattice, both equal if one number is given."""
    pitches = require_lengths(name, value)
    if len(pitches) not in (1, 2):
        raise InputError(f"{name} = {short_repr(value)}: it must be one number, or two, along the rows and across them")
    if max(pitches) > MOST_STRETCH * min(pitches):
        raise InputError(f"{name} = {pitches}: neither may be more than {MOST_STRETCH:g} times the other")
    return pitches[0], pitches[-1]


def require_warp(name: str, value: Any) -> tuple[float, ...]:
    """Return 14 or 36 coefficients of a warp, fewer than 14 filled up with zeros; none if all are zero."""
    # Terms of third or of fifth degree: 7 or 18 along x, then as many along y.
    numbers = require_numbers(name, value, count=(*range(15), 36), form="at most 14 numbers, or 36")
    return numbers + (0.0,) * (14 - len(numbers)) if any(numbers) else ()


def require_pairs(
    name: str, value: Any, *, meaning: str, rising: str, most: tuple[float, float], start: float | None = None
) -> tuple[float, ...]:
    """Return two or more pairs of nonnegative numbers, the first ones rising from 0, as one tuple; it may be empty.

    Neither number of a pair exceeds `most`, and `start` is the second one of the first pair.
    """
    value = _plain(value)
    if not isinstance(value, (tuple, list)) or len(value) % 2 or len(value) == 2:
        raise InputError(f"{name} = {short_repr(value)}: it must be two or more pairs of {meaning}")
    numbers = require_numbers(name, value, count=len(value), minimum=0)
    first = numbers[::2]
    if numbers and (first[0] != 0 or any(a >= b for a, b in itertools.pairwise(first))):
        raise InputError(f"{name} = {short_repr(value)}: its {rising} must rise from 0")
    if numbers and start not in (None, numbers[1]):
        raise InputError(f"{name} = {short_repr(value)}: its first pair must be 0, {start:g}")
    for index, bound in enumerate(most):
        require_number(name, max(numbers[index::2], default=0.0), maximum=bound)
    return numbers


def require_numbers(
    name: str,
    value: Any,
    *,
    count: int | Collection[int],
    form: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
) -> tuple[float, ...]:
    """Return numbers within bounds as a tuple: `count`, or one of several counts, which `form` states."""
    value = _plain(value)
    counts = [count] if isinstance(count, int) else count
    if not isinstance(value, (tuple, list)) or len(value) not in counts:
        raise InputError(f"{name} = {short_repr(value)}: it must be {form or f'{count} numbers'}")
    return tuple(require_number(name, item, minimum=minimum, maximum=maximum) for item in value)


def _is_flag(value: Any) -> bool:
    """Return whether a value is a truth value of Python or NumPy, without importing NumPy."""
    return isinstance(value, bool) or (type(value).__module__ == "numpy" and type(value).__name__.startswith("bool"))


def _plain(value: Any) -> Any:
    """Return an array of NumPy as lists, and anything else as it is."""
    import numpy as np

    return value.tolist() if isinstance(value, np.ndarray) else value
