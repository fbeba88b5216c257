"""The surfaces of a lens, from the scene's side to the array's, as plain data with checks, and paraxial quantities."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

import numpy as np
import yaml

from ..errors import (
    LONGEST,
    SHORTEST,
    InputError,
    did_you_mean,
    refuse_if,
    require_flag,
    require_known,
    require_length,
    require_lengths,
    require_number,
    require_wavelength,
    short_repr,
    warn,
)
from ..runtime import Named, Numbers, Pair, safe_sqrt
from . import lenses
from .glass import LINE_D, Glass
from .lens_data import SINGLE, LensData, require_alone, vergence

MOST_SURFACES = 100
MOST_COEFFICIENTS = 8

LEAST = 1e-12
"""Least argument of square roots, so that rays that miss have numbers and gradients."""

_NAMES = {"radius", "thickness", "glass", "semi_aperture", "conic", "asphere", "stop"}

_USE: dict[str, Callable[[str, Any], Any]] = {
    "object_distance": functools.partial(require_length, finite=False),
    "image_distance": require_length,
    "pupil_diameter": require_length,
    "fields": functools.partial(require_lengths, rule=functools.partial(require_number, minimum=0, maximum=85)),
    "wavelengths": functools.partial(require_lengths, rule=lambda name, value: require_wavelength(value, name)),
}
"""Rules of what is known of a lens's use."""

_ABSENT = (None, "", (), 0.0, math.inf, -math.inf)
"""Values that plain data leave out."""


@dataclass(frozen=True)
class Surface:
    r"""A surface of a lens with the height :math:`c r^2 / (1 + \sqrt{1 - (1 + k) c^2 r^2}) + \sum a_i r^{2 i}`.

    Parameters
    ----------
    radius : float
        Radius of curvature :math:`1/c` in millimetres, positive where the centre is on the array's side; infinite for
        a plane.
    thickness : float
        Distance along the axis to the next surface in millimetres; 0 for the last.
    glass : Glass or None
        Material up to the next surface; None for air.
    semi_aperture : float
        Distance from the axis up to which light passes, in millimetres.
    conic : float
        Conic constant k.
    asphere : tuple of float
        Coefficients of the fourth, sixth, ... power of r.
    """

    radius: float
    thickness: float
    glass: Glass | None
    semi_aperture: float
    conic: float = 0.0
    asphere: Numbers = ()

    @property
    def curvature(self) -> float:
        """Reciprocal of the radius, in 1/mm."""
        return 1 / self.radius

    def to_plain(self) -> Named:
        """Return the surface as plain data for `from_plain`, without entries that have their default."""
        plain = {name: value for name, value in vars(self).items() if value not in _ABSENT}
        if self.glass is not None:
            plain["glass"] = self.glass.to_plain()
        if self.asphere:
            plain["asphere"] = list(self.asphere)
        return plain

    @classmethod
    def from_plain(cls, value: Any, where: str) -> Surface:
        """Return the surface that plain data describe.

        Parameters
        ----------
        value : dict
            Any of ``radius`` (a plane without it), ``thickness``, ``glass``, ``conic``, ``asphere``, ``stop``, and
            ``semi_aperture``.
        where : str
            Name of the surface in messages.
        """
        refuse_if(
            not isinstance(value, dict), f"{where} = {short_repr(value)}: it must be numbers by name, such as radius"
        )
        require_known(f"{where}: ", value, sorted(_NAMES))
        refuse_if(
            "semi_aperture" not in value,
            f"{where}: semi_aperture: it is missing; it is the height up to which light passes",
        )
        radius = require_number(f"{where}: radius", value.get("radius", math.inf), finite=False)
        refuse_if(abs(radius) < SHORTEST, f"{where}: radius = {radius:g}: it must not be 0; a plane has no radius")
        asphere = value.get("asphere", ())
        refuse_if(
            not isinstance(asphere, (list, tuple)) or len(asphere) > MOST_COEFFICIENTS,
            f"{where}: asphere = {short_repr(asphere)}: it must be at most {MOST_COEFFICIENTS} numbers",
        )
        surface = cls(
            radius=radius,
            thickness=require_number(f"{where}: thickness", value.get("thickness", 0.0), minimum=0, maximum=LONGEST),
            glass=None if value.get("glass") is None else Glass.from_plain(value["glass"], f"{where}: glass"),
            semi_aperture=require_number(
                f"{where}: semi_aperture", value["semi_aperture"], minimum=SHORTEST, maximum=LONGEST
            ),
            conic=require_number(f"{where}: conic", value.get("conic", 0.0), minimum=-LONGEST, maximum=LONGEST),
            asphere=tuple(require_number(f"{where}: asphere", entry) for entry in asphere),
        )
        refuse_if(
            (1 + surface.conic) * (surface.semi_aperture * surface.curvature) ** 2 >= 1,
            f"{where}: semi_aperture = {surface.semi_aperture:g}: the surface of radius {surface.radius:g} ends "
            "before that",
        )
        return surface


@dataclass(frozen=True)
class Paraxial:
    """Paraxial quantities of a lens in millimetres; positions are counted along the axis towards the array.

    Parameters
    ----------
    focal_length : float
        Effective focal length.
    front_principal, entrance_pupil : float
        Places of the front principal plane and of the entrance pupil behind the first vertex.
    rear_principal, exit_pupil : float
        Places of the rear principal plane and of the exit pupil behind the last vertex.
    back_focal : float
        Place of the rear focal point behind the last vertex.
    length : float
        Distance of the last vertex from the first.
    entrance_radius, exit_radius : float
        Radii of the pupils with the stop fully open.
    """

    focal_length: float
    front_principal: float
    rear_principal: float
    back_focal: float
    length: float
    entrance_pupil: float
    exit_pupil: float
    entrance_radius: float
    exit_radius: float


@dataclass(frozen=True)
class Prescription(LensData):
    """Main lens as its designer states it: surfaces and glasses, lengths in millimetres.

    Parameters
    ----------
    surfaces : tuple of Surface
        Surfaces from the scene's side to the array's; there is air before the first and behind the last.
    stop : int
        Index of the surface that is the aperture stop; it opens to its semi-aperture at most.
    name : str
        Name of the lens.
    source : str
        Where the lens is published.
    wavelength : float
        Wavelength in nanometres at which rays are traced and focal length and pupils are given; the line d by default.
    object_distance, image_distance : float
        Distances in millimetres from the object to the first vertex, and from the last vertex to the image, for which
        the lens is designed; 0: the image plane is not known.
    pupil_diameter : float
        Diameter in millimetres of the entrance pupil in use; 0: the stop is fully open.
    fields, wavelengths : tuple of float
        Angles in degrees from the axis, seen from the entrance pupil, and wavelengths in nanometres in use.
    """

    mark = "surfaces"
    is_thin = False

    surfaces: tuple[Surface, ...]
    stop: int
    name: str = ""
    source: str = ""
    wavelength: float = LINE_D
    object_distance: float = math.inf
    image_distance: float = 0.0
    pupil_diameter: float = 0.0
    fields: Numbers = ()
    wavelengths: Numbers = ()

    @property
    def traced_surfaces(self) -> tuple[Surface, ...]:
        """All surfaces of the prescription."""
        return self.surfaces

    @property
    def disperses(self) -> bool:
        """Whether one of the glasses has a refractive index that depends on the wavelength."""
        return any(surface.glass is not None and surface.glass.form != "index" for surface in self.surfaces)

    @property
    def paraxial(self) -> Paraxial:
        """Paraxial quantities of the lens at the prescription's wavelength."""
        return paraxial(self)

    def own_numbers(self, focal_length: float | None) -> Pair:
        """Return the focal length and the open entrance pupil's radius, in mm, scaled to a given focal length."""
        numbers = self.paraxial
        length = numbers.focal_length if focal_length is None else require_length("focal_length", focal_length)
        return length, numbers.entrance_radius * length / numbers.focal_length

    def exit_pupil(self, focal_length: float) -> Pair:
        """Return the exit pupil's distance before the rear principal plane, and the pupils' ratio of radii."""
        numbers = self.paraxial
        scale = focal_length / numbers.focal_length
        return scale * (numbers.rear_principal - numbers.exit_pupil), numbers.exit_radius / numbers.entrance_radius

    def require_fit(self, camera: Any) -> None:
        """Refuse further aberrations, a stop wider than the lens opens, and an array within the lens."""
        require_alone(camera)
        numbers = self.paraxial
        widest = self.own_numbers(camera.focal_length)[1]
        refuse_if(
            camera.aperture_radius > widest * (1 + SINGLE),
            f"aperture_radius = {camera.aperture_radius:g}: the main_lens opens to {widest:.6g} at most",
        )
        scale = camera.focal_length / numbers.focal_length
        nearest = -scale * min(numbers.rear_principal, numbers.rear_principal - numbers.exit_pupil)
        refuse_if(
            camera.mla_distance <= nearest,
            f"mla_distance = {camera.mla_distance:g}: the array would stand within the main_lens or its exit "
            f"pupil; it must be more than {nearest:.4g}",
        )

    def image_blur(self, camera: Any, distance: float) -> float:
        """Return the diameter in mm, on the array, of the cone from the exit pupil to a point's image."""
        power = vergence(camera.focal_length, distance)
        # So far the image lies before the array.
        gap = camera.mla_distance - (math.inf if power == 0 else 1 / power)
        return float(2 * camera.pupil_radius * (1.0 if math.isinf(gap) else abs(gap / (camera.pupil_distance - gap))))

    def with_surface(self, index: int, **changes: Any) -> Prescription:
        """Return the lens with changed fields of a surface by its index."""
        surfaces = list(self.surfaces)
        surfaces[index] = replace(surfaces[index], **changes)
        return replace(self, surfaces=tuple(surfaces))

    def to_plain(self) -> Named:
        """Return the prescription as numbers, strings, lists and dictionaries, for `from_plain`."""
        surfaces = [surface.to_plain() for surface in self.surfaces]
        surfaces[self.stop]["stop"] = True
        facts = {name: value for name, value in vars(self).items() if value not in _ABSENT and name != "stop"}
        return {**facts, "surfaces": surfaces}

    @classmethod
    def from_plain(cls, value: Any) -> Prescription:
        """Return the prescription that plain data describe, for example from a file.

        Parameters
        ----------
        value : dict
            ``surfaces``, a list of what `Surface.from_plain` takes, one of them with ``stop: true``; and any of
            ``name``, ``source``, ``wavelength`` and the other fields of a `Prescription`.

        Raises
        ------
        InputError
            If a name is unknown or missing, a value is out of range, not just one surface is the stop, glass follows
            the last surface, a glass has no index at the wavelength, or two surfaces cross near the axis. Surfaces
            that cross within their semi-apertures end there, with a warning.
        """
        if isinstance(value, dict):
            require_known("main_lens: ", value, ("surfaces", "name", "source", "wavelength", *_USE))
        refuse_if(
            not isinstance(value, dict) or "surfaces" not in value,
            f"main_lens = {short_repr(value)}: it must have surfaces, and may have name, source, wavelength",
        )
        listed = value["surfaces"]
        refuse_if(
            not isinstance(listed, (list, tuple)) or not 1 <= len(listed) <= MOST_SURFACES,
            f"main_lens: surfaces = {short_repr(listed)}: it must be a list of 1 to {MOST_SURFACES}",
        )
        surfaces = tuple(
            Surface.from_plain(surface, f"main_lens: surface {index}") for index, surface in enumerate(listed, start=1)
        )
        flags = [surface.get("stop", False) for surface in listed]
        stops = [
            index for index, flag in enumerate(flags) if require_flag(f"main_lens: surface {index + 1}: stop", flag)
        ]
        refuse_if(len(stops) != 1, f"main_lens: {len(stops)} surfaces have stop: true: it must be just one of them")
        if surfaces[-1].glass is not None:
            raise InputError(f"main_lens: surface {len(surfaces)}: glass: air must follow the last surface")
        texts = {name: value.get(name, "") for name in ("name", "source")}
        for name, text in texts.items():
            refuse_if(not isinstance(text, str), f"main_lens: {name} = {short_repr(text)}: it must be text")
        use = {name: rule(f"main_lens: {name}", value[name]) for name, rule in _USE.items() if value.get(name)}
        lens = cls(
            surfaces,
            stops[0],
            **texts,
            **use,
            wavelength=require_wavelength(value.get("wavelength", LINE_D), "main_lens: wavelength"),
        )
        lens.indices(lens.wavelength)
        return lens.clipped()

    def indices(self, wavelength: float) -> list[float]:
        """Return the index behind each surface at a wavelength in nanometres; air has 1."""
        return [1.0 if surface.glass is None else surface.glass.at(wavelength) for surface in self.surfaces]

    def clipped(self) -> Prescription:
        """Return the lens with surfaces cut off where they cross their neighbours, and warn of the cut.

        Published prescriptions list semi-apertures for drawings, which may reach beyond the edge where surfaces meet.
        """
        lens = self
        while crossing := lens._crossing():
            first, second, position, text = crossing
            pair = [lens.surfaces[index].semi_aperture for index in (first, second)]
            # 0.1: Least part of the semi-aperture that a surface which crosses the next may be clipped to; less is a
            # slip.
            refuse_if(
                position < 0.1 * min(pair),
                f"{text}: they must stay apart within a tenth of the smaller of their semi-apertures, {min(pair):.4g}",
            )
            warn(f"{text}: their semi-apertures, {pair[0]:.4g} and {pair[1]:.4g}, end there")
            for index, edge in zip((first, second), pair, strict=True):
                lens = lens.with_surface(index, semi_aperture=min(edge, position))
        return lens

    def require_apart(self) -> None:
        """Refuse a lens in which neighbouring refracting surfaces cross within the area that light passes."""
        if crossing := self._crossing():
            first, second, _, text = crossing
            edge = min(self.surfaces[first].semi_aperture, self.surfaces[second].semi_aperture)
            raise InputError(f"{text}: they must stay apart within the smaller of their semi-apertures, {edge:.4g}")

    def _crossing(self) -> tuple[int, int, float, str] | None:
        """Return the first refracting surfaces that cross where light passes both: indices, distance, and a message."""
        glasses = [None, *(surface.glass for surface in self.surfaces)]
        indices = [index for index, (before, after) in enumerate(itertools.pairwise(glasses)) if before != after]
        for first, second in itertools.pairwise(indices):
            front = self.surfaces[first]
            back = self.surfaces[second]
            thickness = sum(surface.thickness for surface in self.surfaces[first:second])
            position = _meeting(front, back, thickness)
            if position is not None:
                text = f"main_lens: surfaces {first + 1} and {second + 1} cross {position:.4g} mm from the axis"
                return first, second, position, text
        return None


# Checks, pupils and distances of cameras of one prescription ask for it again and again; a result is a few floats.
@functools.lru_cache(maxsize=256)
def paraxial(prescription: Prescription, wavelength: float | None = None) -> Paraxial:
    """Return a lens's focal length, principal planes and pupils, from matrices of paraxial rays.

    Heights and reduced angles n u pass a surface of power P by (y, n u - P y), and a thickness t of index n by
    (y + t/n n u, n u) (Born and Wolf, "Principles of Optics", section 4.4; Kingslake and Johnson, "Lens Design
    Fundamentals", chapter 3).

    Parameters
    ----------
    prescription : Prescription
        The lens.
    wavelength : float, optional
        Wavelength in nanometres. Default: the prescription's own.

    Raises
    ------
    InputError
        If the lens does not converge, or a pupil is at infinity.
    """
    indices = [1.0, *prescription.indices(prescription.wavelength if wavelength is None else wavelength)]
    matrix = np.eye(2)
    before = np.eye(2)
    after = np.eye(2)
    length = 0.0
    for index, surface in enumerate(prescription.surfaces):
        if index == prescription.stop:
            before = matrix
            after = np.eye(2)
        power = (indices[index + 1] - indices[index]) * surface.curvature
        gap = surface.thickness / indices[index + 1] if index < len(prescription.surfaces) - 1 else 0.0
        length += surface.thickness if gap else 0.0
        step = np.array([[1, gap], [0, 1]]) @ np.array([[1, 0], [-power, 1]])
        matrix = step @ matrix
        after = step @ after
    (A, _), (C, D) = matrix
    if not -C > 1e-12:
        text = "infinite" if abs(C) <= 1e-12 else f"{-1 / C:.4g} mm"
        raise InputError(f"main_lens: its focal length is {text}: it must be positive, so that it forms an image")
    refuse_if(
        min(abs(before[0, 0]), abs(after[1, 1])) < 1e-9,
        "main_lens: one of its pupils is at infinity: object- or image-side telecentric lenses are not supported",
    )
    radius = prescription.surfaces[prescription.stop].semi_aperture
    values = (
        -1 / C,
        (D - 1) / C,
        (1 - A) / C,
        -A / C,
        length,
        before[0, 1] / before[0, 0],
        -after[0, 1] / after[1, 1],
        radius / abs(before[0, 0]),
        radius / abs(after[1, 1]),
    )
    refuse_if(not all(map(math.isfinite, values)), "main_lens: its numbers leave what a float holds")
    return Paraxial(*map(float, values))


def height(surface: Any, square: Any) -> Any:
    """Return the height in mm of a surface above the plane of its vertex."""
    c = surface.curvature
    height = c * square / (1 + safe_sqrt(1 - (1 + surface.conic) * c * c * square, LEAST))
    power = square * square
    for coefficient in surface.asphere:
        height = height + coefficient * power
        power = power * square
    return height


def _meeting(front: Surface, back: Surface, thickness: float) -> float | None:
    """Return the distance in mm from the axis at which two surfaces cross within their areas, otherwise None."""
    edge = min(front.semi_aperture, back.semi_aperture)

    def gap(square: Any) -> Any:
        return thickness + height(back, square) - height(front, square)

    # Distances from the axis at which neighbouring surfaces must not have crossed.
    squares = np.linspace(0, edge, 129) ** 2
    # Part of the semi-aperture by which surfaces that meet at their edges may seem to cross by rounding.
    crossed = np.flatnonzero(gap(squares) < -1e-9 * edge)
    if not crossed.size:
        return None
    after = max(1, int(crossed[0]))
    if not gap(squares[after - 1]) > 0:
        return float(np.sqrt(squares[after - 1]))
    # Imported here because it takes longer than the rest of the package.
    from scipy.optimize import brentq

    return float(np.sqrt(brentq(gap, squares[after - 1], squares[after])))


BUNDLED = ("cooke_triplet", "double_gauss", "double_gauss_f2", "phone", "singlet", "tessar")
"""Their names."""


# The bundled files do not change, and prescriptions are immutable.
@functools.cache
def bundled_prescription(name: str) -> Prescription:
    """Return a bundled lens by its name.

    Parameters
    ----------
    name : str
        One of `BUNDLED`; ``.yaml`` may follow it.
    """
    stem = name.removesuffix(".yaml")
    if stem not in BUNDLED:
        raise InputError(
            f"main_lens = {short_repr(name)}: there is no such file, and the bundled lenses are {', '.join(BUNDLED)}"
            f"{did_you_mean(stem, BUNDLED)}"
        )
    text = (resources.files(lenses) / f"{stem}.yaml").read_text(encoding="utf-8")
    return Prescription.from_plain(yaml.safe_load(text))
