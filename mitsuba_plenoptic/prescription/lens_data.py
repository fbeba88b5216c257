"""The thin-lens formula, and the plain data of a main lens: the interface of all kinds, with a thin lens's answers."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Self

from ..errors import LONGEST, InputError, refuse_if, short_repr


def vergence(focal_length: Any, distance: Any) -> Any:
    """Return the reciprocal of the image distance of a plane, :math:`1/g' = 1/f - 1/g`; zero for the focal plane."""
    return 1 / focal_length - 1 / distance


def defocus_factor(distance: Any, mla_distance: Any, focal_length: Any) -> Any:
    r"""Return the fraction of a pupil coordinate by which a ray misses its object point's image on the MLA.

    :math:`1 + b/g - b/f_1`, so written that it is exactly zero in focus.
    """
    return 1 + mla_distance / distance - mla_distance / focal_length


def conjugate_distance(focal_length: float, distance: float) -> float:
    """Return the distance of the plane that a thin lens images to one at `distance`, :math:`1/x + 1/d = 1/f`.

    Infinite for the focal plane, negative for planes within it, zero for the lens's own plane.
    """
    if distance == 0:
        return 0.0
    power = vergence(focal_length, distance)
    return math.inf if power == 0 else 1 / power


def image_distance(focal_length: float, distance: float, *, name: str = "distance") -> float:
    """Return the distance behind a thin lens at which an object at `distance` is in focus."""
    refuse_if(
        not distance > focal_length, f"{name} = {distance:g}: it must be greater than the focal length {focal_length:g}"
    )
    refuse_if(LONGEST < distance < math.inf, f"{name} = {distance:g}: it must be at most {LONGEST:g}")
    power = vergence(focal_length, distance)
    refuse_if(
        power * LONGEST < 1,
        f"{name} = {distance!r}: its image lies too far behind a lens of focal length {focal_length:g}, at more "
        f"than {LONGEST:g}",
    )
    return 1 / power


SINGLE = 1e-6
"""Relative error of rounding to single precision, at most; values from files and scenes may have it."""

_THIN_LENS = (80.0, 5.0)
"""Focal length and radius of a thin lens, in millimetres, where they are not given."""

_MLA_DISTANCE = 120.0
"""Distance from the main lens to the array, in millimetres, where neither that nor a plane in focus is given."""


class LensData:
    """Plain data of a main lens, here a thin one; real lenses derive their data from this class.

    Attributes
    ----------
    mark : str
        The entry of plain data by which a lens of this kind is known, such as ``surfaces``; "" for none.
    is_thin : bool
        Whether the closed forms of thin lenses hold for its rays.
    converges : bool
        Whether chief rays come to the array from a pupil at a finite distance; else they are parallel to the axis.
    """

    mark: ClassVar[str] = ""
    kinds: ClassVar[list[type[LensData]]] = []

    is_thin: ClassVar[bool] = True
    converges: ClassVar[bool] = True

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        LensData.kinds.append(cls)

    @property
    def name(self) -> str:
        """Name of the lens, empty if it has none."""
        return ""

    @property
    def traced_surfaces(self) -> tuple[Any, ...]:
        """Surfaces through which rays of the lens are traced, empty if there are none."""
        return ()

    @property
    def images_stop(self) -> bool:
        """Whether the array stands in an image of the stop, so that each microlens sees the whole object."""
        return False

    @property
    def nearest(self) -> float | None:
        """The z in the camera frame beyond which all scene points lie; None: in front of the main lens."""
        return None

    @property
    def disperses(self) -> bool:
        """Whether the lens's glasses refract light of different wavelengths differently."""
        return False

    @property
    def label(self) -> str:
        """Name of the lens in messages."""
        return self.name or type(self).__name__.lower()

    def own_numbers(self, focal_length: float | None) -> tuple[float, float]:
        """Return the focal length and the radius of the open entrance pupil, scaled to a given focal length."""
        return _THIN_LENS

    def array_distance(self) -> float:
        """Return the distance to the array for a lens without a given distance or plane in focus."""
        return _MLA_DISTANCE

    def settled(self, given: dict[str, float]) -> dict[str, float]:
        """Return the camera's parameters of the main lens, completed from given ones; refuse contradictions."""
        return given

    def require_focusable(self, focus_distance: Any) -> None:
        """Refuse a lens whose plane in focus cannot be chosen."""

    def require_fit(self, camera: Any) -> None:
        """Refuse a camera whose other parameters do not fit the lens."""

    def require_distance(self, camera: Any, distance: float) -> None:
        """Refuse an object distance that has no real image."""
        image_distance(camera.focal_length, distance)

    def exit_pupil(self, focal_length: float) -> tuple[float, float]:
        """Return the exit pupil's distance before the rear principal plane, and its radius over the entrance pupil's.

        A thin lens is its own pupil. That of an objective is infinitely far, and the values are those of a thin lens.

        Parameters
        ----------
        focal_length : float
            Focal length to which the lens is scaled, in millimetres.
        """
        return 0.0, 1.0

    def focus_distance(self, focal_length: float, mla_distance: float) -> float:
        """Return the distance of the object plane that is in focus on the array."""
        return conjugate_distance(focal_length, mla_distance)

    def image_blur(self, camera: Any, distance: float) -> float:
        """Return the diameter on the array of the image of a point at a distance, by rays."""
        return float(camera.aperture_diameter * abs(camera.defocus(distance)))

    def bin_count(self, camera: Any) -> tuple[int, int]:
        """Return the bins across a reconstruction and down it."""
        pitch = camera.mla_pitch
        return even_count(camera.detector_width, pitch), even_count(camera.detector_height, pitch)

    def bin_size(self, camera: Any, distance: float) -> float:
        """Return the width in the object plane of one bin of a reconstruction."""
        return float(camera.mla_pitch * distance / camera.mla_distance)

    def to_plain(self) -> dict[str, Any]:
        """Return numbers, strings, lists and dictionaries, for `from_plain`, files and headers."""
        raise NotImplementedError

    @classmethod
    def from_plain(cls, value: Any) -> Self:
        """Return the lens that `to_plain` described, after its checks."""
        raise NotImplementedError


THIN = LensData()
"""That of a thin lens."""


def even_count(width: float, step: float) -> int:
    """Return the number of steps that fit a width, as the nearest even number."""
    return 2 * max(1, round(width / (2 * step)))


def known_kind(value: Any, default: type[LensData]) -> type[LensData]:
    """Return the class of plain data by the entry that marks it."""
    if isinstance(value, dict):
        for kind in LensData.kinds:
            if kind.mark and kind.mark in value:
                return kind
    return default


def require_unscaled(given: dict[str, float], own: dict[str, float], tolerance: float) -> dict[str, float]:
    """Return the parameters of a lens; refuse given ones that differ.

    Parameters
    ----------
    given, own : dict
        Values by name: those that are given, and those of the lens.
    tolerance : float
        Allowed relative difference.

    Raises
    ------
    InputError
        If a given value is not the lens's own.
    """
    for name, number in own.items():
        refuse_if(
            not math.isclose(given[name], number, rel_tol=tolerance),
            f"{name} = {given[name]:g}: with this main_lens it is {number:.6g}; leave it out",
        )
    return own


def require_alone(camera: Any) -> None:
    """Refuse parameters of a camera that a real main lens replaces."""
    for name, values in (("distortion", camera.distortion), ("wavefront", camera.wavefront)):
        refuse_if(any(values), f"{name} = {values}: a main_lens brings its own; leave it out")
    refuse_if(
        camera.phase_screen is not None,
        f"phase_screen = {camera.phase_screen}: behind a main_lens there is none; leave it out",
    )
    if camera.glass is not None:
        raise InputError(f"glass = {short_repr(camera.glass.to_plain())}: a main_lens brings its own; leave it out")
