"""The entries of the table of a camera's parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, Flag, auto
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, dataclass_transform, overload

Given = TypeVar("Given")
Kept = TypeVar("Kept")
_Record = TypeVar("_Record", bound=type)


class Form(Enum):
    """Type of a parameter's value in Python and in scene files; resolution and crop belong to the film there."""

    NUMBER = "float", "|float|"
    SEVERAL = "float or floats", "|float| or |string|"
    PLACE = "(float, float)", "|string| or |point|"
    NUMBERS = "floats", "|string|"
    COUNT = "int", "|int|"
    WORD = "str", "|string|"
    FILM = "(int, int)", ""
    LENS = "Prescription, Objective, str, path or dict", "|string|"
    RESPONSE = "PhotodiodeResponse, str, path or dict", "|string|"
    GLASS = "Glass, str, float or dict", "|string| or |float|"
    SHAPE = "MicrolensShape, path or dict", "|string|"
    SCREEN = "PhaseScreen, path or dict", "|string|"
    PICTURE = "Aperture, array, path or dict", "|string|"
    LENSES = "LensTransmissions, array, path or dict", "|string|"
    VIGNETTING = "Vignetting, path or dict", "|string|"


class Captures(Flag):
    """Kinds of captures, used to state which of them support or differentiate a parameter."""

    NONE = 0
    RAYS = auto()
    """Ray captures."""
    EDGES = auto()
    """Among the derivatives: edges of the light in ray captures move with the parameter, whose part is missing."""
    SCENES = auto()
    """Wave captures of scenes."""
    POINTS = auto()
    """Captures of points, by `CaptureOperator` and by rays, and with them fits, searches and wave reconstructions."""
    ALL = RAYS | EDGES | SCENES | POINTS


@dataclass(frozen=True, eq=False, kw_only=True)
class Parameter(Generic[Given, Kept]):
    """Entry of the table of parameters: `Given` is the type in the constructor, `Kept` the type in a camera.

    The comments describe each attribute; only the first three are required.
    """

    default: Any
    check: Callable[[str, Any], Kept]  # takes name and value; returns the stored value, or refuses it
    words: str  # sentences of the documentation, in which `names` are those of other parameters
    form: Form = Form.NUMBER
    takes: str = ""  # the type in Python, where that of the form is not exact
    otherwise: str = ""  # the default in words, where it is None or needs them
    unit: str | tuple[str, ...] = ""  # one for all its components, or one for each
    parts: tuple[str, ...] = ()  # names of the components in calibrations
    known_to: Captures = Captures.RAYS  # captures of other kinds refuse cameras with a value that is not the default
    gradients: Captures = (
        Captures.NONE
    )  # captures with a derivative by it; a parameter with any is exposed by `mi.traverse`
    scale: Callable[[Any], float] | None = None  # step of a fit for a camera; None means a hundredth of the value
    highest: float | None = None  # upper limit of fits without bounds, if it is not a multiple of the step
    unseen: int = 0  # count of leading components that affect no capture: fits leave them out
    room: int = 0  # least count of components with derivatives, also if a camera has fewer
    shortest: Callable[[Kept], Any] | None = None  # converts to the form in files, if it is not the stored one
    of_array: bool = False  # whether only a camera with a microlens array has it: None for one without
    instead_of: str = ""  # the parameter that follows from this one and is written to files instead
    in_first_files: bool = False  # whether all files have it; other parameters may be missing from old files
    fit: Callable[[Any], None] | None = None  # refuses cameras that a value other than the default does not fit
    alias: str = ""  # the name of the parameter, if it is not that of the attribute
    attribute: str = field(default="", init=False)
    name: str = field(default="", init=False)

    def __set_name__(self, owner: type, attribute: str) -> None:
        """Take the name of the parameter from its attribute in the table."""
        object.__setattr__(self, "attribute", attribute)
        object.__setattr__(self, "name", self.alias or attribute)

    def plain(self, value: Kept) -> Any:
        """Return a value in its shortest form, as in files."""
        return value if value is None or self.shortest is None else self.shortest(value)

    @property
    def is_exposed(self) -> bool:
        """Whether sensors expose the parameter to `mi.traverse`."""
        return bool(self.gradients)

    if TYPE_CHECKING:
        # Of a camera the attribute is the value; the constructor takes `Given`.
        @overload
        def __get__(self, camera: None, owner: type) -> Parameter[Given, Kept]: ...
        @overload
        def __get__(self, camera: object, owner: type) -> Kept: ...
        def __get__(self, camera: Any, owner: type) -> Any: ...
        def __set__(self, camera: object, value: Given) -> None: ...


@dataclass_transform(kw_only_default=True, field_specifiers=(Parameter,))
def record(cls: _Record) -> _Record:
    """Return a class turned into a frozen record of parameters."""
    return cast(_Record, dataclass(frozen=True, init=False, repr=False)(cls))


def one_if_equal(pitches: tuple[float, float]) -> float | tuple[float, float]:
    """Return a single pitch if both are equal, or else both."""
    return pitches[0] if pitches[0] == pitches[1] else pitches


def one_if_single(values: tuple[float, ...]) -> float | tuple[float, ...]:
    """Return the only value of a sequence of one value, otherwise all values."""
    return values[0] if len(values) == 1 else values


def one(camera: Any) -> float:
    """Return 1, the step of a fit for a parameter that has a natural unit."""
    return 1.0
