"""Surfaces given by samples of their height: freeform and measured ones."""

from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..errors import put_checked, require_number
from ..prescription import LINE_D
from ..runtime import Doubles, Pair
from .sampled_grid import LENGTHS, SampledGrid, known_samples
from .shape import MicrolensShape, excess_index, known_index, per_millimetre


@dataclass(frozen=True, eq=False)
class Sampled(MicrolensShape):
    r"""A thin lens whose surface towards the main lens is sampled.

    Light gains the phase :math:`(n - 1) h / \lambda` in waves, with the height h of the surface. Between samples the
    surface is a bicubic spline, whose gradient deflects rays.

    Parameters
    ----------
    height : array (rows, columns), nested lists, or path
        Height towards the main lens in millimetres at the samples, in rows of rising y and columns of rising x, or an
        NPY or EXR file of it.
    width : float
        Distance of the first and the last column in millimetres; rows are as far apart as columns. The samples must
        cover the lens.
    glass : Glass, str, float or dict
        The lens's material, as `Glass.from_plain` takes it, or its index.
    """

    form = "sampled"

    height: Any
    width: float
    glass: Any = 1.5

    def __post_init__(self) -> None:
        put_checked(
            self,
            height=partial(known_samples, units=LENGTHS),
            width=partial(require_number, positive=True),
            glass=known_index,
        )

    @cached_property
    def _grid(self) -> SampledGrid:
        return SampledGrid(self.height, self.width)

    def waves(self, x: Any, y: Any, wavelength: float) -> Any:
        """Return the phase in waves; see `MicrolensShape.waves`."""
        return self._grid.at(x, y) * (excess_index(self.glass, wavelength) * per_millimetre(wavelength))

    def slopes(self, x: Any, y: Any) -> Pair:
        """Return the gradient of the path; see `MicrolensShape.slopes`."""
        along, across = self._grid.slopes(x, y)
        return along * excess_index(self.glass, LINE_D), across * excess_index(self.glass, LINE_D)

    @cached_property
    def power(self) -> float:
        """Power, at the d line in 1/mm, of the paraboloid of revolution that best fits the heights."""
        return fitted_power(self.height * excess_index(self.glass, LINE_D), self._grid)

    def covers(self, x: Any, y: Any) -> Any:
        """Return a mask of offsets within the samples."""
        return self._grid.covers(x, y)


def fitted_power(path: Doubles, grid: SampledGrid) -> float:
    """Return the power in 1/mm of the paraboloid that best fits samples of a path, besides tilt and offset."""
    x, y = (np.linspace(-half, half, size) for half, size in zip(grid.reach, path.shape[::-1], strict=True))
    x, y = (values.ravel() for values in np.meshgrid(x, y))
    scale = max(grid.reach)
    terms = np.stack([np.ones_like(x), x / scale, y / scale, (x * x + y * y) / scale**2], axis=1)
    return float(-2 * np.linalg.lstsq(terms, path.ravel(), rcond=None)[0][3] / scale**2)
