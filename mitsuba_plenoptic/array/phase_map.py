"""Phases given by samples: diffractive reliefs and metasurfaces."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import put, refuse_if, require_flag, require_number, require_wavelength, short_repr
from ..prescription import LINE_D
from ..runtime import Doubles, Numbers, Pair
from .sampled import fitted_power
from .sampled_grid import SampledGrid, known_samples, phases
from .shape import MM_PER_NM, MicrolensShape


@dataclass(frozen=True, eq=False)
class PhaseMap(MicrolensShape):
    r"""A thin element whose phase is sampled at one or several wavelengths.

    Jumps by whole waves between adjacent samples count as jumps of the phase: elsewhere adjacent samples must differ by
    less than half a wave. Between samples, the phase without jumps is a bicubic spline.

    Parameters
    ----------
    phase : array (rows, columns), nested lists, path, or a sequence of these
        Phase in waves at the samples, in rows of rising y and columns of rising x, or an NPY or EXR file of it; one for
        each wavelength.
    width : float
        Distance of the first and the last column in millimetres; rows are as far apart as columns. The samples must
        cover the lens.
    wavelengths : float or sequence of float
        Wavelengths in nanometres at which the phases are given, rising.
    relief : bool
        Whether the phase is that of a relief, at one design wavelength :math:`\lambda_0`: at others it is
        :math:`\lambda_0 / \lambda` times as large, jumps included. Otherwise it is that of a metasurface, which is
        interpolated linearly between the wavelengths, without jumps, and constant beyond.
    """

    form = "phase_map"

    phase: Any
    width: float
    wavelengths: float | Sequence[float] = LINE_D
    relief: bool = False

    def __post_init__(self) -> None:
        given = self.wavelengths if hasattr(self.wavelengths, "__len__") else [self.wavelengths]
        wavelengths = tuple(require_wavelength(value, "wavelengths") for value in given)  # type: ignore[union-attr]
        refuse_if(
            not wavelengths or any(b <= a for a, b in itertools.pairwise(wavelengths)),
            f"wavelengths = {short_repr(self.wavelengths)}: they must rise",
        )
        maps = [self.phase] if len(wavelengths) == 1 and np.ndim(self.phase) != 3 else self.phase
        refuse_if(
            isinstance(maps, str) or not hasattr(maps, "__len__") or len(maps) != len(wavelengths),
            f"phase: it must be one map for each of {len(wavelengths)} wavelengths",
        )
        relief = require_flag("relief", self.relief)
        refuse_if(relief and len(wavelengths) > 1, "relief: it has one design wavelength; give one")
        units = [phases(wavelength * MM_PER_NM) for wavelength in wavelengths]
        samples = np.stack([known_samples("phase", *pair) for pair in zip(maps, units, strict=True)])
        put(
            self,
            phase=samples,
            width=require_number("width", self.width, positive=True),
            wavelengths=wavelengths,
            relief=relief,
        )

    @cached_property
    def _smooth(self) -> Doubles:
        """Phases without jumps at the centre and between adjacent wavelengths, (wavelengths, rows, columns)."""
        rows, columns = self.phase.shape[1:]
        smooth = np.unwrap(self.phase, period=1, axis=2)
        # Along the middle column first, which the rows then join.
        middle = np.unwrap(smooth[:, :, columns // 2], period=1, axis=1)
        smooth += (middle - smooth[:, :, columns // 2])[..., None]
        centre = smooth[:, rows // 2, columns // 2]
        return smooth + (np.unwrap(centre, period=1) - centre)[:, None, None]

    @cached_property
    def _grids(self) -> list[SampledGrid]:
        return [SampledGrid(samples, self.width) for samples in self._smooth]

    @property
    def _given(self) -> Numbers:
        """Wavelengths of the maps in nanometres, as a tuple."""
        return tuple(self.wavelengths)  # type: ignore[arg-type]

    def _parts(self, wavelength: float) -> list[tuple[int, float]]:
        """Return the maps between which a wavelength lies, and their weights."""
        position = float(np.interp(wavelength, self._given, np.arange(len(self._given))))
        low = min(int(position), max(len(self._given) - 2, 0))
        return [(low + end, weight) for end, weight in enumerate((1 - position + low, position - low)) if weight]

    def waves(self, x: Any, y: Any, wavelength: float) -> Any:
        """Return the phase in waves; see `MicrolensShape.waves`."""
        if self.relief:
            (grid,) = self._grids
            jumps = np.rint(self._smooth[0] - self.phase[0])
            return (grid.at(x, y) - grid.nearest(jumps, x, y)) * (self._given[0] / wavelength)
        return sum(self._grids[index].at(x, y) * weight for index, weight in self._parts(wavelength))

    def slopes(self, x: Any, y: Any) -> Pair:
        """Return the gradient of the path; see `MicrolensShape.slopes`."""
        parts = [(*self._grids[index].slopes(x, y), weight) for index, weight in self._parts(LINE_D)]
        along, across = (
            sum(weighted[axis] * weighted[2] for weighted in parts) * (LINE_D * MM_PER_NM) for axis in (0, 1)
        )
        return along, across

    def strength(self, wavelength: float) -> float:
        """Return the ratio of slopes, for the fitted paraboloids; see `MicrolensShape.strength`."""
        return self._power(wavelength) / self.power

    @cached_property
    def power(self) -> float:
        """Power, at the d line in 1/mm, of the paraboloid of revolution that best fits the phase without jumps."""
        return self._power(LINE_D)

    def _power(self, wavelength: float) -> float:
        phase = sum(self._smooth[index] * weight for index, weight in self._parts(wavelength))
        return fitted_power(np.asarray(phase) * (wavelength * MM_PER_NM), self._grids[0])

    def covers(self, x: Any, y: Any) -> Any:
        """Return a mask of offsets within the samples."""
        return self._grids[0].covers(x, y)
