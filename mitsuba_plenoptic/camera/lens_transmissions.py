"""Transmissions of single microlenses: how bright the light behind each is, as a table over the array."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

from ..array import Lattice, read_table
from ..errors import put, require_count, require_pair, suggest_keywords
from ..runtime import PlainData, known_record, module_of, select, take

_FARTHEST = 10**6
"""Farthest column and row, from lens (0, 0), of the first value."""


@suggest_keywords
@dataclass(frozen=True, eq=False)
class LensTransmissions(PlainData):
    """Relative brightness of single microlenses, as a white picture shows it.

    The power of the light behind a lens is multiplied by its value; lenses beyond the table have 1.

    Parameters
    ----------
    values : array (rows, columns), nested lists, or path
        Values from 0 to 4, kept to five decimals, of rows of lenses with rising y of the lattice and columns with
        rising x; at most 4096 x 4096. Or an NPY, FITS, EXR or grey PNG file of them, whose first row has the lowest y.
    first : (int, int), optional
        Column and row of the lens of the first value. Lens (0, 0) of a square lattice has its lower left corner, in the
        lattice frame, at `mla_offset`, of a hexagonal one its centre; each odd row of a hexagonal lattice is half a
        pitch further in x. Default: minus half the counts, rounded down, so that the table is around the axis.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> dim = mp.LensTransmissions([[0.9, 1.0], [1.0, 1.0]])
    >>> dim.first, mp.PlenopticCamera(mla_transmissions=dim).mla_transmissions == dim
    ((-1, -1), True)
    """

    values: Any
    first: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        # Most rows and columns of a table, and the largest value.
        values = read_table("values", self.values, largest=4096, most=4.0)
        rows, columns = values.shape
        first_lens = (-(columns // 2), -(rows // 2)) if self.first is None else self.first
        index = partial(require_count, minimum=-_FARTHEST, maximum=_FARTHEST)
        put(self, values=values, first=require_pair("first", first_lens, "(column, row)", index))

    def at(self, lattice: Lattice, i: Any, j: Any) -> Any:
        """Return the values of the lenses with some indices of a lattice, NumPy or Dr.Jit arrays.

        Parameters
        ----------
        lattice : Lattice
            The lattice, whose rows may be staggered.
        i, j : array
            Indices of lenses, see `Lattice.cell`.
        """
        assert self.first is not None
        module = module_of(i)
        rows, columns = self.values.shape
        along = i + module.floor(j / 2) if lattice.stagger == 2 else i
        column = along - self.first[0]
        row = j - self.first[1]
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        return select(inside, take(self.values.ravel(), select(inside, row * columns + column, 0)), 1.0)

    def __repr__(self) -> str:
        rows, columns = self.values.shape
        return f"LensTransmissions({rows} x {columns} values, first={self.first})"


known_transmissions = partial(known_record, LensTransmissions, "mla_transmissions")
"""Return the brightness of lenses from any of its forms; None means that lenses are equal."""
