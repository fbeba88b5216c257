"""The interface of microlens shapes, and the conversion of a shape from any of its forms."""

from __future__ import annotations

import importlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..errors import InputError, naming, refuse_if, require_choice, require_wavelength, short_repr
from ..prescription import LINE_D, SINGLE, Glass
from ..runtime import Named, Pair, PlainData, read_json_value
from . import Lattice

MM_PER_NM = 1e-6

FILES = ("conic", "phase_map", "sampled", "zone_lens")
"""Files of this folder with shapes, which are imported when a shape is asked for by its form."""

_RIM = np.linspace(0, 1, 65)
"""Positions across the unit square of an aperture at which a shape must be defined, its edges included."""


class MicrolensShape(PlainData, ABC):
    """The path that a microlens adds to light, as a function of the offset from the lens's centre.

    A subclass is a frozen dataclass; its fields, and its name ``form``, are the entries of its plain form.
    """

    form: ClassVar[str]
    kinds: ClassVar[dict[str, type[MicrolensShape]]] = {}
    glass: Any
    is_parabolic: ClassVar[bool] = False
    """Whether the phase is a parabola, whose diffraction orders have a closed form, and which may turn slopes."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        MicrolensShape.kinds[cls.form] = cls
        cls.where = f"form {cls.form}: "

    @abstractmethod
    def waves(self, x: Any, y: Any, wavelength: float) -> Any:
        """Return the phase in waves at offsets in millimetres, as NumPy or Dr.Jit arrays.

        The phase is larger where light gains a longer path. A constant has no effect.

        Parameters
        ----------
        x, y : array
            Offsets from the centre of the lens in millimetres, in the frame of the lattice.
        wavelength : float
            Wavelength in air in nanometres.
        """

    @abstractmethod
    def slopes(self, x: Any, y: Any) -> Pair:
        """Return the gradient of the path at the d line (587.6 nm), in millimetres per millimetre; see `waves`.

        The gradient deflects rays. For a phase with jumps by whole waves, the phase without jumps counts: rays follow
        the first diffraction order.
        """

    def strength(self, wavelength: float) -> float:
        """Return the slopes at a wavelength divided by the slopes at the d line (587.6 nm)."""
        return excess_index(self.glass, wavelength) / excess_index(self.glass, LINE_D)

    @property
    @abstractmethod
    def power(self) -> float:
        """Power at the d line (587.6 nm): the reciprocal of the focal length in air, in 1/mm."""

    def lens_waves(self, lattice: Lattice, x: Any, y: Any, focal_length: Any, wavelength: float) -> Any:
        """Return the phase in waves of lenses of some focal lengths in air, which scale the path.

        Offsets are given in the camera frame, and the lattice has the rotation of the lenses.
        """
        return self.waves(*lattice.to_frame(x, y), wavelength) * (1 / self.power / focal_length)

    def deflection(self, lattice: Lattice, x: Any, y: Any, focal_length: Any) -> Pair:
        """Return the changes of direction at the d line by lenses of some focal lengths; see `lens_waves`."""
        x, y = lattice.from_frame(*self.slopes(*lattice.to_frame(x, y)))
        weaker = 1 / self.power / focal_length
        return x * weaker, y * weaker

    def covers(self, x: Any, y: Any) -> Any:
        """Return a mask of offsets, NumPy arrays, at which the shape is defined."""
        return x * x + y * y < float("inf")

    @property
    def disperses(self) -> bool:
        """Whether the slopes depend on the wavelength."""
        return self.strength(486.1) != self.strength(656.3)

    def to_plain(self) -> Named:
        """Return the form and the fields as plain data, for files and headers."""
        return {"form": self.form} | super().to_plain()

    def __str__(self) -> str:
        return short_repr(self.to_plain())


@dataclass(frozen=True, eq=False)
class Paraboloid(MicrolensShape):
    r"""A thin lens of the phase :math:`-r^2 / 2 \lambda F` in waves: that of a camera without an `mla_shape`."""

    form = "paraboloid"
    is_parabolic = True
    focal_length: Any

    def waves(self, x: Any, y: Any, wavelength: float) -> Any:
        """Return the phase in waves; see `MicrolensShape.waves`."""
        return (x * x + y * y) * (-0.5 / (wavelength * MM_PER_NM * self.focal_length))

    def slopes(self, x: Any, y: Any) -> Pair:
        """Return the gradient of the path; see `MicrolensShape.slopes`."""
        return -x / self.focal_length, -y / self.focal_length

    def strength(self, wavelength: float) -> float:
        """Return 1: glass changes the focal lengths of such lenses."""
        return 1.0

    @property
    def power(self) -> Any:
        """The reciprocal of the focal length in air, in 1/mm."""
        return 1 / self.focal_length

    def lens_waves(self, lattice: Lattice, x: Any, y: Any, focal_length: Any, wavelength: float) -> Any:
        """Return the phase in waves of other focal lengths; see `MicrolensShape.lens_waves`."""
        return Paraboloid(focal_length).waves(x, y, wavelength)

    def deflection(self, lattice: Lattice, x: Any, y: Any, focal_length: Any) -> Pair:
        """Return the deflection by other focal lengths; see `MicrolensShape.deflection`."""
        return Paraboloid(focal_length).slopes(x, y)


# Cameras state it by its focal length alone.
del MicrolensShape.kinds[Paraboloid.form]


def known_shape(value: Any, resolve: Callable[[str], str] = str) -> MicrolensShape | None:
    """Return a shape, given as a shape, plain data, a JSON file or its text; None means no shape.

    `resolve` finds files by their names, for example in the folder of a scene.
    """
    if value is None or isinstance(value, MicrolensShape):
        return value
    with naming("mla_shape"):
        value = read_json_value(value, resolve)
        if not isinstance(value, dict) or "form" not in value:
            raise InputError(
                f"{short_repr(value)}: it must be a shape, a dictionary with an entry form, or a JSON file"
            )
        for name in FILES:
            importlib.import_module(f"{__package__}.{name}")
        entries = dict(value)
        kind = MicrolensShape.kinds[require_choice("form", entries.pop("form"), MicrolensShape.kinds)]
        return kind.from_plain(entries)


def known_index(name: str, value: Any) -> Glass:
    """Return a lens's material from any form of a glass; its index at the d line must exceed 1."""
    glass = value if isinstance(value, Glass) else Glass.from_plain(value, name)
    refuse_if(not glass.at(LINE_D) > 1, f"{name} = {short_repr(value)}: its index must be greater than 1")
    return glass


def excess_index(glass: Glass, wavelength: float) -> float:
    """Return the refractive index of a material at a wavelength, less 1 for air."""
    return float(glass.at(wavelength)) - 1


def per_millimetre(wavelength: float) -> float:
    """Return the number of waves in a millimetre, from a wavelength in nanometres."""
    return 1 / (require_wavelength(wavelength) * MM_PER_NM)


def focal_length_of(shape: MicrolensShape, medium: float, stated: Sequence[float] | None) -> float:
    """Return a shape's focal length in a medium, in mm; refuse a negative one, and a different given one."""
    refuse_if(
        not shape.power > 0,
        f"mla_shape: its power is {shape.power:.4g} per mm: it must focus light, with a power greater than 0",
    )
    focal_length = medium / shape.power
    refuse_if(
        stated is not None and not all(math.isclose(focal_length, length, rel_tol=SINGLE) for length in stated),
        f"mla_focal_length = {short_repr(stated)}: with this mla_shape it is {focal_length:.7g}; leave it out",
    )
    return focal_length


def require_cover(shape: MicrolensShape, lattice: Lattice) -> None:
    """Refuse a shape that ends within the aperture of a lens."""
    x, y = lattice.aperture_point(*np.meshgrid(_RIM, _RIM))
    covered = shape.covers(*lattice.to_frame(x, y))
    refuse_if(not np.all(covered), "mla_shape: it must be defined all over a lens's aperture, and ends within it")
