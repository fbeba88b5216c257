"""The exit pupil of a main lens as the microlens array sees it, the same record for every lens."""

from dataclasses import dataclass
from typing import Any

from ..runtime import Pair, Triple, sqrt


@dataclass(frozen=True)
class Pupil:
    r"""An exit pupil at a finite distance before the array (k = 1), or a stop that is imaged to infinity (k = 0).

    The ray from a pupil point P to a position m at a height h before the array has the slope
    :math:`t = (P - k m) / (R - k h)` along either axis. Light of a stop imaged to infinity thus has one direction at
    all positions, P / R.

    Parameters
    ----------
    radius : float or Dr.Jit array
        Radius in millimetres of the smallest circle about the axis that contains the pupil.
    distance : float or Dr.Jit array
        R in millimetres: the distance to the array or, for k = 0, the focal length of the lens behind the stop.
    finite : {1, 0}
        k.
    swap : float, optional
        Focal length in millimetres of a last lens, which turns directions into positions and images the stop onto the
        array. Default: there is none, and the array stands in an image of the scene.
    """

    radius: Any
    distance: Any
    finite: int = 1
    swap: Any = None

    @property
    def stop_scale(self) -> Any:
        """Ratio of a coordinate on the stop to the coordinate of its image on the array, where a last lens swaps."""
        return -self.distance / self.swap

    def image(self, pupil: Pair, point: Triple) -> Pair:
        """Return the position of the image, on the array, of a point of the stop, for each of some scene points."""
        # Adding 0 broadcasts the result to the shape of the points.
        return pupil[0] / self.stop_scale + 0 * point[0], pupil[1] / self.stop_scale + 0 * point[0]

    def point(self, position: Any, slope: Any, height: Any = 0.0) -> Any:
        """Return a coordinate on the pupil of the ray from a position at a height before the array.

        Parameters
        ----------
        position, slope, height : array
            Position, slope of the ray, and height of the position before the array.
        """
        if self.swap is not None:
            return self.stop_scale * position
        return self.finite * position + (self.distance - self.finite * height) * slope

    def slope(self, pupil: Any, position: Any, height: Any = 0.0) -> Any:
        """Return the slope, along one axis, of the ray through a point of the pupil and a position as in `point`.

        Parameters
        ----------
        pupil, position, height : array
            Position, and height of the position before the array.
        """
        return (pupil - self.finite * position) / (self.distance - self.finite * height)

    def chief(self, position: Any, behind: Any) -> Any:
        """Return a coordinate, on the array, of the ray from a position behind it to the pupil's centre."""
        return position * (self.distance / (self.distance + self.finite * behind))

    def to_array(self, pupil: Any, position: Any) -> Any:
        """Return the direction cosines, (..., 2), from points of the pupil to positions on the array."""
        towards = self.finite * position - pupil
        return towards / sqrt(self.finite * (towards**2).sum(-1) + self.distance**2)[..., None]

    def from_array(self, cosine: Pair, position: Pair) -> tuple[Pair, Any, Any]:
        """Return the pupil points of plane waves that reach a position on the array, as in the Debye integral.

        Parameters
        ----------
        cosine : (array, array)
            Direction cosines of the waves.
        position : (array, array)
            The position.

        Returns
        -------
        pupil : (array, array)
            Points of the pupil from which they come.
        length : array
            Length on the pupil per small range of direction cosines: :math:`dP = R ds` near the axis.
        path : array
            Path from there to the position, less that from the pupil's centre, in millimetres.
        """
        sx, sy = cosine
        x, y = position
        R = self.distance
        if not self.finite:
            return (-R * sx, -R * sy), R + 0 * sx, sx * x + sy * y
        length = R / sqrt(1 - sx * sx - sy * sy)
        return (x - length * sx, y - length * sy), length, length - sqrt(x * x + y * y + R * R)
