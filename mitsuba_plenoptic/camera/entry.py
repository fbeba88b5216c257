"""What the table of a camera's parameters says of each of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, Flag, auto
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, dataclass_transform, overload

Given = TypeVar("Given")
Kept = TypeVar("Kept")
_Record = TypeVar("_Record", bound=type)


class Form(Enum):
    """How a value is written: its type in Python, and in a scene file, which has resolution and crop with the film."""

    NUMBER = "float", "|float|"
    SEVERAL = "float or floats", "|float| or |string|"
    PLACE = "(float, float)", "|string| or |point|"
    NUMBERS = "floats", "|string|"
    COUNT = "int", "|int|"
    WORD = "str", "|string|"
    FILM = "(int, int)", ""
    LENS = "Prescription, Objective, str, path or dict", "|string|"
    GLASS = "Glass, str, float or dict", "|string| or |float|"


class Captures(Flag):
    """Kinds of captures, which depend on a parameter, or have a derivative by it."""

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
    """An entry of the table: a parameter of the type `Given` in the constructor, which a camera keeps as `Kept`.

    The comments say what each attribute is for; only the first three are needed.
    """

    default: Any
    check: Callable[[str, Any], Kept]  # returns the value as it is kept, or refuses it, given the name and the value
    words: str  # sentences of the documentation, in which `names` are those of other parameters
    form: Form = Form.NUMBER
    takes: str = ""  # the type in Python, where the form's own is not exact
    otherwise: str = ""  # the default in words, where it is None or needs them
    unit: str | tuple[str, ...] = ""  # of all its parts, or of each
    parts: tuple[str, ...] = ()  # what a calibration calls them
    known_to: Captures = Captures.RAYS  # captures of other kinds refuse cameras with a value that is not the default
    gradients: Captures = (
        Captures.NONE
    )  # captures with a derivative by it; a parameter with any is exposed by `mi.traverse`
    scale: Callable[[Any], float] | None = None  # change of a camera's value that is a step of a fit; None: a hundredth
    highest: float | None = None  # where fits may go without bounds, if that is not near where they start
    unseen: int = 0  # first parts, which no capture depends on: fits leave them out
    room: int = 0  # parts by which there are derivatives, of a parameter of which a camera may have fewer
    shortest: Callable[[Kept], Any] | None = None  # the form in files, where it is not what is kept
    instead_of: str = ""  # the parameter that is found from this one and is in files
    in_first_files: bool = False  # whether files always had it: others may be missing from what `to_dict` gave
    alias: str = ""  # the name, where the attribute of the camera has another one
    attribute: str = field(default="", init=False)
    name: str = field(default="", init=False)

    def __set_name__(self, owner: type, attribute: str) -> None:
        """Take the names from the table."""
        object.__setattr__(self, "attribute", attribute)
        object.__setattr__(self, "name", self.alias or attribute)

    def plain(self, value: Kept) -> Any:
        """Return a value in its shortest form, as files have it."""
        return self.shortest(value) if self.shortest else value

    @property
    def is_exposed(self) -> bool:
        """Whether sensors expose it to `mi.traverse`."""
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
    """Make a class a record of parameters that cannot be changed."""
    return cast(_Record, dataclass(frozen=True, init=False, repr=False)(cls))
