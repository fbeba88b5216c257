"""The thin-lens formula, and the plain data of a main lens: the common interface, with a thin lens's answers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from ..errors import LONGEST, InputError, refuse_if, short_repr
from ..runtime import Pair, PlainData, Shape


def vergence(focal_length: Any, distance: Any) -> Any:
    """Return the reciprocal of an image distance, :math:`1/g' = 1/f - 1/g`, in 1/mm; zero for the focal plane."""
    return 1 / focal_length - 1 / distance


def defocus_factor(distance: Any, mla_distance: Any, focal_length: Any) -> Any:
    r"""Return the ratio of a ray's miss distance on the MLA, from its object point's image, to its pupil coordinate.

    :math:`1 + b/g - b/f_1`, in a form that is exactly zero in focus.
    """
    return 1 + mla_distance / distance - mla_distance / focal_length


def conjugate_distance(focal_length: float, distance: float) -> float:
    """Return the distance of the plane that a thin lens images to a plane at `distance`, :math:`1/x + 1/d = 1/f`.

    The result is infinite for the focal plane, negative for planes within it, and zero for the lens's plane.
    """
    if distance == 0:
        return 0.0
    power = vergence(focal_length, distance)
    return math.inf if power == 0 else 1 / power


def image_distance(focal_length: float, distance: float, *, name: str = "distance") -> float:
    """Return the distance behind a thin lens at which an object at `distance` is in focus."""
    refuse_if(
        not distance > focal_length,
        f"{name} = {distance:g}: it must be greater than the focal length {focal_length:g}"
        + (", in millimetres; multiply metres by 1000" if 0 < distance < focal_length else ""),
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


@dataclass(frozen=True, eq=False)
class LensData(PlainData):
    """Plain data of a main lens, here a thin one; classes of other lenses derive from it.

    Attributes
    ----------
    mark : str
        The entry of plain data by which a lens of this kind is known, such as ``surfaces``; "" for none.
    is_thin : bool
        Whether the closed forms of thin lenses hold for its rays.
    converges : bool
        Whether chief rays come to the array from a pupil at a finite distance; else they are parallel to the axis.
    focused_on : str
        What the lens is focused on, if its plane in focus cannot be chosen.
    sets : tuple of str
        Parameters of the camera that the lens alone determines.
    """

    mark: ClassVar[str] = ""
    where: ClassVar[str] = "main_lens: "
    kinds: ClassVar[list[type[LensData]]] = []

    is_thin: ClassVar[bool] = True
    converges: ClassVar[bool] = True
    focused_on: ClassVar[str] = ""
    sets: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        LensData.kinds.append(cls)

    @property
    def name(self) -> str:
        """Name of the lens, empty if it has none."""
        return ""

    @property
    def traced_surfaces(self) -> tuple:
        """Surfaces through which rays of the lens are traced, empty if there are none."""
        return ()

    @property
    def images_stop(self) -> bool:
        """Whether the array stands in an image of the stop, so that each microlens sees the whole object."""
        return False

    @property
    def nearest(self) -> float | None:
        """The z in the camera frame beyond which all scene points lie; None means in front of the main lens."""
        return None

    @property
    def disperses(self) -> bool:
        """Whether the lens's glasses have a refractive index that depends on the wavelength."""
        return False

    @property
    def label(self) -> str:
        """Name of the lens in messages."""
        return self.name or type(self).__name__.lower()

    def own_numbers(self, focal_length: float | None) -> Pair:
        """Return the focal length and the open entrance pupil's radius, in mm, scaled to a given focal length."""
        # Focal length and radius of a thin lens, in millimetres, where they are not given.
        return 80.0, 5.0

    def array_distance(self) -> float:
        """Return the distance to the array in mm if neither it nor a plane in focus is given."""
        # 120.0: Distance from the main lens to the array, in millimetres, where neither that nor a plane in focus is
        # given.
        return 120.0

    def settled(self, stated: dict[str, float]) -> dict[str, float]:
        """Return the camera's main lens parameters, completed from given ones; refuse contradictions."""
        return stated

    def require_fit(self, camera: Any) -> None:
        """Refuse a camera whose other parameters do not fit the lens."""

    def require_distance(self, camera: Any, distance: float) -> None:
        """Refuse an object distance that has no real image."""
        image_distance(camera.focal_length, distance)

    def exit_pupil(self, focal_length: float) -> Pair:
        """Return the exit pupil's distance from the rear principal plane, and its radius over the entrance pupil's.

        A thin lens is its own pupil. An objective's pupil is infinitely far, and the values are those of a thin lens.

        Parameters
        ----------
        focal_length : float
            Focal length to which the lens is scaled, in millimetres.
        """
        return 0.0, 1.0

    def focus_distance(self, focal_length: float, mla_distance: float) -> float:
        """Return the distance in mm of the object plane in focus on the array."""
        return conjugate_distance(focal_length, mla_distance)

    def image_blur(self, camera: Any, distance: float) -> float:
        """Return the diameter in mm, on the array, of the image of a point at a distance, by rays."""
        return float(camera.aperture_diameter * abs(camera.defocus(distance)))

    def bin_count(self, camera: Any) -> Shape:
        """Return the number of bins across and down a reconstruction."""
        pitch = camera.row_pitch
        return even_count(camera.detector_width, pitch), even_count(camera.detector_height, pitch)

    def bin_size(self, camera: Any, distance: float) -> float:
        """Return the width in mm of one bin of a reconstruction, in the object plane."""
        return float(camera.row_pitch * distance / camera.mla_distance)


THIN = LensData()
"""That of a thin lens."""


def even_count(width: float, step: float) -> int:
    """Return the even number nearest to the number of steps that fit a width."""
    return 2 * max(1, round(width / (2 * step)))


def known_kind(value: Any, default: type[LensData]) -> type[LensData]:
    """Return the class of plain data by the entry that marks it, otherwise `default`."""
    if isinstance(value, dict):
        for kind in LensData.kinds:
            if kind.mark and kind.mark in value:
                return kind
    return default


def require_unscaled(stated: dict[str, float], settled: dict[str, float], tolerance: float) -> dict[str, float]:
    """Return a lens's own parameters; refuse given parameters that differ.

    `stated` are a camera's, `settled` the lens's.
    """
    for name, value in settled.items():
        refuse_if(
            not math.isclose(stated[name], value, rel_tol=tolerance),
            f"{name} = {stated[name]:g}: with this main_lens it is {value:.6g}; leave it out",
        )
    return settled


def require_alone(camera: Any) -> None:
    """Refuse camera parameters that a real main lens replaces."""
    for name, values in (("distortion", camera.distortion), ("wavefront", camera.wavefront)):
        refuse_if(any(values), f"{name} = {values}: a main_lens brings its own; leave it out")
    refuse_if(
        camera.phase_screen is not None,
        f"phase_screen = {camera.phase_screen}: behind a main_lens there is none; leave it out",
    )
    if camera.glass is not None:
        raise InputError(f"glass = {short_repr(camera.glass.to_plain())}: a main_lens brings its own; leave it out")
