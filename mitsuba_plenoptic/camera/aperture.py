"""Apertures: which part of the light passes each point of the pupil, and random points of the pupil with its density.

Coordinates are those of the camera frame over the pupil's radius: +x is left and +y is up for the photographer behind
the camera, and right and up for somebody who looks into the lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..array import read_table
from ..errors import FULL_TURN, InputError, put, refuse_if, require_count, require_number, short_repr, suggest_keywords
from ..runtime import Doubles, Pair, PlainData, known_record, module_of, select, take

_CELLS = 512
_POINTS = 4
"""Cells across a polygon where cells are asked for, and points across a cell."""


_STEPS = 1024
"""Steps of the square of the radius in which the transmission of an apodised pupil is integrated."""

NOT_ROUND = {"aperture_blades": None, "aperture_image": None, "pupil_apodisation": (0.0, 0.0)}
"""Parameters of pupils that are not evenly open discs, with their defaults."""


class _Outlined:
    """The power that passes an aperture, from its outline."""

    def power(self, x: Any, y: Any) -> Any:
        """Return the part of the power that passes at points over the pupil's radius, in the camera frame."""
        inside, power = self.outline(x, y)
        return select(inside >= 0, power, 0.0)

    def outline(self, x: Any, y: Any) -> Pair:
        """Return how far points are inside the circle over its radius, and the power as if the circle were wider."""
        return 1 - module_of(x).sqrt(x * x + y * y), 1.0


@dataclass(frozen=True)
class Round(_Outlined):
    """A fully open pupil, with the methods of all apertures."""

    @property
    def share(self) -> float:
        """Mean power that passes, over the disc of the pupil."""
        return 1.0

    def draws(self) -> Callable[[Any], Pair]:
        """Return a function that makes points, with the density of the power, from points of the unit square."""

        def drawn(sample: Any) -> Pair:
            x, y = mi.warp.square_to_uniform_disk(sample)
            return x, y

        return drawn

    def cells(self) -> Doubles:
        """Return the power over cells (n, n) of the square around the pupil, each of which has about one value."""
        return np.ones((1, 1))


@dataclass(frozen=True)
class Blades(_Outlined):
    """A regular polygon in the circle of the pupil, one of whose corners is at an angle in degrees from +x to +y."""

    count: int
    angle: float = 0.0

    @property
    def share(self) -> float:
        """Area of the polygon over that of the circle."""
        return self.count / (2 * math.pi) * math.sin(2 * math.pi / self.count)

    def outline(self, x: Any, y: Any) -> Pair:
        """Return how far points are inside the polygon over the pupil's radius, and the power, 1."""
        module = module_of(x)
        sector = 2 * math.pi / self.count
        angle = (dr.atan2 if module is dr else np.arctan2)(y, x) - math.radians(self.angle)
        # From the middle of the nearest side.
        angle = angle - (module.floor(angle / sector) + 0.5) * sector
        return math.cos(sector / 2) - module.sqrt(x * x + y * y) * module.cos(angle), 1.0

    def draws(self) -> Callable[[Any], Pair]:
        """Return a map from the unit square to the triangles between the centre and the sides."""
        sector = 2 * math.pi / self.count
        first = math.radians(self.angle)

        def drawn(sample: Any) -> Pair:
            scaled = mi.Float(sample[0]) * self.count
            radius = dr.sqrt(sample[1])
            side = dr.minimum(dr.floor(scaled), self.count - 1)
            ends = [dr.sincos(first + sector * (side + step)) for step in (0, 1)]
            x, y = (radius * dr.lerp(ends[0][axis], ends[1][axis], scaled - side) for axis in (1, 0))
            return x, y

        return drawn

    def cells(self) -> Doubles:
        """Return the parts of small cells within the polygon."""
        along = (np.arange(_CELLS * _POINTS) + 0.5) * (2 / (_CELLS * _POINTS)) - 1
        inside = self.power(along + 0 * along[:, None], along[:, None] + 0 * along)
        return inside.reshape(_CELLS, _POINTS, _CELLS, _POINTS).mean((1, 3))

    def to_plain(self) -> int | tuple[int, float]:
        """Return the number of blades, with their angle if there is one."""
        return (self.count, self.angle) if self.angle else self.count

    def __str__(self) -> str:
        return f"{self.count}, {self.angle:g}" if self.angle else f"{self.count}"


@suggest_keywords
@dataclass(frozen=True, eq=False)
class Aperture(_Outlined, PlainData):
    """A picture in the pupil of the main lens: a coded aperture, a heart, an apodisation.

    The picture fills the square around the pupil, and each value holds for a cell of the square. Cells whose centres
    are outside the circle must be closed; the circle cuts the others.

    Parameters
    ----------
    transmission : array (n, n), nested lists, or path
        Part of the light's power, from 0 to 1, that passes each cell, in rows of rising y and columns of rising x of
        the camera frame, see `mitsuba_plenoptic.camera.aperture`; at most 512 x 512 values, kept to four decimals. Or
        an NPY, FITS, EXR or grey PNG file of it, whose values are proportional to power, and whose first row has the
        lowest y.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> ring = mp.Aperture([[0, 1, 1, 0], [1, 0, 0, 1], [1, 0, 0, 1], [0, 1, 1, 0]])
    >>> mp.PlenopticCamera(mla_lattice="none", aperture_image=ring).aperture_image == ring
    True
    """

    transmission: Any

    def __post_init__(self) -> None:
        name = "transmission"
        # Digits to which values of a picture are kept, as files hold them.
        # Most rows and columns of a picture.
        values = read_table(name, self.transmission, largest=512, most=1, decimals=4)
        rows, columns = values.shape
        refuse_if(rows != columns, f"{name} of shape {values.shape}: it must be square")
        refuse_if(not values.any(), f"{name}: it is 0 everywhere, so that no light passes")
        centres = (2 * np.arange(rows) + 1) / rows - 1
        beyond = (values > 0) & (np.hypot(centres, centres[:, None]) > 1)
        refuse_if(
            beyond.any(), f"{name}: {np.count_nonzero(beyond)} open cells are beyond aperture_radius; they must be 0"
        )
        put(self, transmission=values)

    @property
    def share(self) -> float:
        """Mean power that passes, over the disc of the pupil, as if the circle cut no cell."""
        return float(self.transmission.mean()) * 4 / math.pi

    def outline(self, x: Any, y: Any) -> Pair:
        """Return how far points are inside the circle over its radius, and the power of their cells."""
        count = len(self.transmission)
        module = module_of(x)
        column, row = (
            module.minimum(module.maximum(module.floor((coordinate + 1) * (count / 2)), 0), count - 1)
            for coordinate in (x, y)
        )
        return super().outline(x, y)[0], take(self.transmission.ravel(), row * count + column)

    def draws(self) -> Callable[[Any], Pair]:
        """Return a map from the unit square to the cells, in which points may be beyond the circle."""
        density = mi.DiscreteDistribution2D(self.transmission.astype(np.float32))
        scale = 2 / len(self.transmission)

        def drawn(sample: Any) -> Pair:
            cell, _, within = density.sample(sample)
            x, y = ((mi.Float(index) + inside) * scale - 1 for index, inside in zip(cell, within, strict=True))
            return x, y

        return drawn

    def cells(self) -> Doubles:
        """Return the picture, which the circle cuts."""
        return np.asarray(self.transmission)

    def __repr__(self) -> str:
        rows, columns = self.transmission.shape
        return f"Aperture({rows} x {columns} values)"


@dataclass(frozen=True)
class Apodised(_Outlined):
    """A round pupil whose transmission varies with the radius r over its own: 1 + a2 r^2 + a4 r^4, at least 0."""

    a2: float
    a4: float

    def _power(self, square: Any) -> Any:
        """Return the transmission at squares of the radius."""
        return module_of(square).maximum(1 + square * (self.a2 + self.a4 * square), 0)

    @property
    def share(self) -> float:
        """Mean power that passes, over the disc of the pupil; above 1 where the transmission rises."""
        return float(self._power((np.arange(_STEPS) + 0.5) / _STEPS).mean())

    def outline(self, x: Any, y: Any) -> Pair:
        """Return how far points are inside the circle over its radius, and the power relative to the centre."""
        return super().outline(x, y)[0], self._power(x * x + y * y)

    def draws(self) -> Callable[[Any], Pair]:
        """Return a map from the unit square to the disc: the squares of radii have the density of the transmission."""
        values = self._power(np.linspace(0, 1, _STEPS + 1)).astype(np.float32)
        density = mi.ContinuousDistribution(mi.ScalarVector2f(0, 1), values)

        def drawn(sample: Any) -> Pair:
            radius = dr.sqrt(density.sample(sample[0]))
            sine, cosine = dr.sincos(2 * math.pi * sample[1])
            return radius * cosine, radius * sine

        return drawn

    def cells(self) -> Doubles:
        """Return the power at the centres of small cells, which the circle cuts."""
        along = ((np.arange(_CELLS) + 0.5) * (2 / _CELLS) - 1) ** 2
        return self._power(along + along[:, None])

    def __str__(self) -> str:
        return f"{self.a2:g}, {self.a4:g}"


Opening = Round | Blades | Aperture | Apodised
"""What passes light: each has its `share`, `power`, `draws` and `cells`."""


def known_blades(name: str, value: Any) -> Blades | None:
    """Return blades given by their number, or by their number and an angle; None means a round aperture."""
    if value is None or isinstance(value, Blades):
        return value
    parts = tuple(value) if isinstance(value, (tuple, list, np.ndarray)) else (value,)
    if len(parts) not in (1, 2):
        raise InputError(f"{name} = {short_repr(value)}: it must be a number of blades, or this and an angle")
    angle = require_number(name, parts[1], minimum=-FULL_TURN, maximum=FULL_TURN) if len(parts) > 1 else 0.0
    return Blades(require_count(name, parts[0], minimum=3, maximum=64), angle)


known_image = partial(known_record, Aperture, "aperture_image")
"""Return a picture in the pupil from any of its forms; None means no picture."""


def require_alone(camera: Any) -> None:
    """Refuse several descriptions of a pupil, and any that the camera's main lens does not have."""
    uneven = {name: value for name in NOT_ROUND if (value := getattr(camera, name)) != NOT_ROUND[name]}
    refuse_if(len(uneven) > 1, f"{', '.join(uneven)}: give one of them")
    for name, value in uneven.items():
        if name == "pupil_apodisation":
            images = camera.lens_data.images_stop
            refuse_if(images, f"{name} = {value}: the array is in the image of the stop; leave it out")
        else:
            refuse_if(camera.main_lens is not None, f"{name} = {value}: a main_lens has a round stop; leave one out")
