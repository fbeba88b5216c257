"""The entries of the table of a camera's parameters, and of the table of support."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum, Flag, auto
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar, cast, dataclass_transform, overload

from ..errors import put

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
    STRAY = "float, StrayLight, array, path or dict", "|float| or |string|"
    LENSES = "LensTransmissions, array, path or dict", "|string|"
    VIGNETTING = "Vignetting, path or dict", "|string|"


class Captures(Flag):
    """Kinds of captures, used to state which of them differentiate a parameter."""

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


class Use(Flag):
    """What a camera is used for, in the table of support; uses are joined by ``|``."""

    RAYS = auto()
    SCENES = auto()
    SCENE_POINTS = auto()
    SMALL_LENSES = auto()
    POINTS = auto()
    FULL_FIELDS = auto()
    POINT_FIELDS = auto()
    COHERENT_POINTS = auto()
    WAVEFRONTS = auto()
    POINT_RAYS = auto()
    RAY_SPREADS = auto()
    SPREAD_BANKS = auto()
    RESPONSES = auto()
    KERNELS = auto()
    FIELDS = auto()
    RAY_REFOCUSING = auto()
    DECODING = auto()
    WHITE_IMAGES = auto()
    LENS_CENTRES = auto()
    ROUND_PUPILS = auto()
    CALIBRATION = auto()
    FITS = auto()
    SCENE_DERIVATIVES = auto()
    POINT_DERIVATIVES = auto()
    RECONSTRUCTION_DERIVATIVES = auto()
    FIELD_DERIVATIVES = auto()
    RAY_DERIVATIVES = auto()

    @property
    def words(self) -> str:
        """The use in words, as a plural; of several uses the words of the first."""
        return _WORDS[next(iter(self))]


_WORDS = {
    Use.RAYS: "ray captures",
    Use.SCENES: "wave captures of scenes",
    Use.SCENE_POINTS: "wave captures of scenes by method points",
    Use.SMALL_LENSES: "waves behind lenses of a few wavelengths",
    Use.POINTS: "waves of points by method patch",
    Use.FULL_FIELDS: "waves of points by method full_field",
    Use.POINT_FIELDS: "fields of one point",
    Use.COHERENT_POINTS: "coherent fields of points",
    Use.WAVEFRONTS: "captures of wavefronts",
    Use.POINT_RAYS: "fits and projections of points by rays",
    Use.RAY_SPREADS: "point spreads by rays",
    Use.SPREAD_BANKS: "banks of point spreads",
    Use.RESPONSES: "methods incoherent and deconvolved",
    Use.KERNELS: "responses of straight arrays",
    Use.FIELDS: "methods coherent and partial",
    Use.RAY_REFOCUSING: "refocused images by method ray",
    Use.DECODING: "decoded light fields",
    Use.WHITE_IMAGES: "white images",
    Use.LENS_CENTRES: "centres of micro-images",
    Use.ROUND_PUPILS: "previews, predictions, disparities of half pupils and depth of focused cameras",
    Use.CALIBRATION: "calibrations",
    Use.FITS: "fits of cameras",
    Use.SCENE_DERIVATIVES: "derivatives of wave captures of scenes by the camera",
    Use.POINT_DERIVATIVES: "derivatives of captures of points",
    Use.RECONSTRUCTION_DERIVATIVES: "derivatives of reconstructions",
    Use.FIELD_DERIVATIVES: "derivatives of coherent and partial reconstructions",
    Use.RAY_DERIVATIVES: "derivatives of refocused images by method ray",
}


@dataclass(frozen=True)
class Condition:
    """The cameras of which an entry of the table of support speaks, in words after the parameter's name."""

    words: str
    holds: Callable[[Any], bool]  # of a camera


@dataclass(frozen=True)
class Support:
    """What uses of a camera make of a parameter that is not at its default.

    Words of an approximation say how it is made, those of a refusal why, and those of an exact use why nothing changes.
    """

    uses: Use
    verdict: Literal["exact", "approximate", "refused"]
    words: str
    instead: str = ""  # what works, of a refusal
    where: Condition | None = None  # None means all cameras with the parameter

    @property
    def is_refusal(self) -> bool:
        """Whether the uses refuse the parameter."""
        return self.verdict == "refused"


def no_effect(uses: Use, words: str) -> Support:
    """Return the entry of uses in which a parameter changes nothing, and rightly so."""
    return Support(uses, "exact", words)


def approximate(uses: Use, words: str, where: Condition | None = None) -> Support:
    """Return the entry of uses that approximate a parameter."""
    return Support(uses, "approximate", words, "", where)


def refused(uses: Use, words: str, instead: str = "", where: Condition | None = None) -> Support:
    """Return the entry of uses that refuse a parameter."""
    return Support(uses, "refused", words, instead, where)


ADDED = (refused(~Use.RAYS, "ray captures alone are known to follow it"),)
"""Support of an added parameter that states none."""


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
    support: Sequence[Support] | None = None  # of an extension's parameter; None means that only rays follow it
    gradients: Captures = (
        Captures.NONE
    )  # captures with a derivative by it; a parameter with any is exposed by `mi.traverse`
    scale: Callable[[Any], float] | None = None  # step of a fit for a camera; None means a hundredth of the value
    highest: float | None = None  # upper limit of fits without bounds, if it is not a multiple of the step
    unseen: int = 0  # count of leading components that affect no capture: fits leave them out
    room: int = 0  # least count of components with derivatives, also if a camera has fewer
    shortest: Callable[[Kept], Any] | None = None  # converts to the form in files, if another
    of_array: bool = False  # whether only a camera with a microlens array has it: None for one without
    instead_of: str = ""  # the parameter that follows from this one and is written to files instead
    in_all_files: bool = False  # whether all files have it; others may be missing, such as those of extensions
    fit: Callable[[Any], None] | None = None  # refuses cameras that a value other than the default does not fit
    alias: str = ""  # the name of the parameter, if it is not that of the attribute
    attribute: str = field(default="", init=False)
    name: str = field(default="", init=False)

    def __set_name__(self, owner: type, attribute: str) -> None:
        """Take the name of the parameter from its attribute in the table."""
        put(self, attribute=attribute, name=self.alias or attribute)

    def plain(self, value: Kept) -> Any:
        """Return a value in its shortest form, as in files; of a record its plain data."""
        if hasattr(value, "to_plain"):
            return value.to_plain()
        return value if value is None or self.shortest is None else self.shortest(value)

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
