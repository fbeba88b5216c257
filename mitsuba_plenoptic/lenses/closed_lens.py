"""The base of main lenses with closed forms: thin, telecentric, Fourier and collimated ones."""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, Self

from ..runtime import Doubles, Pair, Triple, sqrt
from .protocol import Light
from .pupil import Pupil


class ClosedLens(Light):
    """A main lens whose light has the same closed form for every scene point, with the whole pupil open to all.

    It is its own light of scene points, which `bind` returns.
    """

    pupil: Pupil
    is_uniform = True

    def __init__(self) -> None:
        """Make a lens without parameters; dataclasses, which derive from it, have their own."""

    @property
    def window(self) -> Pupil:
        """The exit pupil, which bounds the directions of rays at the array."""
        return self.pupil

    @property
    def reach(self) -> Any:
        """Radius of the window in millimetres."""
        return self.window.radius

    def in_window(self, pupil: Pair, point: Triple) -> Pair:
        """Return where light from a scene point through a point of the pupil passes the window."""
        return pupil

    def waves_of(self, points: Doubles) -> Self:
        """Return this lens, whose light is the same for all points."""
        return self

    def bind(self, points: Doubles, index: Any = None) -> Self:
        """Return this lens, whose light is the same for all points."""
        return self

    def opaque(self, convert: Callable[[Any], Any]) -> Self:
        """Return this lens unchanged."""
        return self

    def inside(self, pupil: Pair) -> Any:
        """Return the distance in mm of a point from the edge of the pupil, positive inside."""
        return self.pupil.radius - sqrt(pupil[0] * pupil[0] + pupil[1] * pupil[1])

    def is_open(self, pupil: Pair) -> Any:
        """Return whether a point lies inside the pupil or, up to rounding, on its edge."""
        # Distance outside a round pupil, over its radius, up to which a point counts as on its edge.
        return self.inside(pupil) >= -1e-9 * self.pupil.radius

    @abstractmethod
    def power_through(self, point: Doubles) -> float:
        """Return the integral of the squared amplitude of a scene point over the pupil."""
