"""Corners of a board and centres of micro-images as files hold them, and the indices of lenses in these files.

Files are CSV tables with a header. Corners have the columns ``k, l`` (indices of the lens along its row and of the
row), ``u, v`` (column and row of the corner in pixels; the centre of the first pixel is 0), ``cluster`` (number of the
corner, row by row along the board's columns, from 0) and ``frame`` (index of the picture, one for each pose of the
board). They may have the column ``rho``: the radius of the corner's blur in pixels, of one sign in front of focus and
of the other behind it. Centres have ``k, l, u, v``, and may have ``doubtful``: 1 for those that dust or a defect
displaces, as `white_centres` finds them; fits leave doubtful centres out. Other columns are ignored.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.polynomial.legendre import legvander2d
from scipy.spatial.transform import Rotation

from ...errors import NO_RECORD, InputError, naming, put_checked, refuse_if, refusing, require_count, require_number
from ...runtime import Shape, atomic_output, read_text
from ..raw.lftoolbox import grid_of_model
from .adjustment import both_axes, robust_lines
from .board_model import Observations

CORNER_COLUMNS = ("k", "l", "u", "v", "cluster", "frame")
VIEW_COLUMNS = ("x", "y", *CORNER_COLUMNS[2:])
BLUR_COLUMN = "rho"
CENTRE_COLUMNS = ("k", "l", "u", "v")
DOUBTFUL_COLUMN = "doubtful"

_WHOLE = {"k", "l", "cluster", "frame", DOUBTFUL_COLUMN}


@dataclass(frozen=True)
class Board:
    """A checkerboard: counts of inner corners, and the size of squares.

    Parameters
    ----------
    columns, rows : int
        Inner corners along the board and across it.
    square : float
        Distance of neighbouring corners in mm.
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        count = partial(require_count, minimum=2, maximum=1000)
        with naming("board"):
            put_checked(self, columns=count, rows=count)
        put_checked(self, square=partial(require_number, positive=True, minimum=1e-6, maximum=1e6))

    @classmethod
    def parse(cls, text: str, square: float) -> Board:
        """Return the board that the text ``COLUMNSxROWS`` describes, for example ``9x5``."""
        columns, x, rows = text.partition("x")
        refuse_if(
            not (x and columns.isdecimal() and rows.isdecimal() and len(text) < 10),
            f"board = {text}: write inner corners along and across it, as 9x5",
        )
        return cls(int(columns), int(rows), square)

    def places(self, corner: np.ndarray) -> np.ndarray:
        """Return the positions (n, 2) of corners on the board in mm."""
        return np.stack([corner % self.columns, corner // self.columns], axis=-1) * self.square

    def shapes(self, corner: np.ndarray) -> np.ndarray:
        """Return the heights (n, terms) of corners on boards bent as polynomials of degree 2 to 5 by a millimetre."""
        x, y = (2 * self.places(corner) / (self.square * (np.array([self.columns, self.rows]) - 1)) - 1).T
        degrees = [(i, j) for i in range(6) for j in range(6) if 2 <= i + j <= 5 and i < self.columns and j < self.rows]
        return legvander2d(x, y, (5, 5))[:, [6 * i + j for i, j in degrees]]


@dataclass(frozen=True)
class LensIndex:
    """Relation between a file's lens indices k, l and the lenses of the camera's lattice.

    Attributes
    ----------
    odd_rows : float
        Offset along the rows, in pitches, of rows with odd l: -0.5 or 0.5 on a hexagonal lattice, 0 on a square one.
    row_sign : int
        -1 if l falls where the camera's rows rise.
    first : (int, int)
        Indices k and l of the camera's lens (0, 0).
    """

    odd_rows: float
    row_sign: int
    first: Shape

    def unit(self, k: np.ndarray, l: np.ndarray) -> np.ndarray:  # noqa: E741
        """Return positions (n, 2) of lenses from lens (0, 0): in pitches along the rows, and in rows across them."""
        k0, l0 = self.first
        return np.stack([k - k0 + self.odd_rows * (l % 2 - l0 % 2), self.row_sign * (l - l0)], axis=-1).astype(float)


@dataclass(frozen=True)
class Table:
    """Columns of a file by name, all of one length.

    Parameters
    ----------
    name : str
        Name of the table in messages, such as its file.
    columns : dict of str to arrays
        Columns by name, all of one length.
    """

    name: str
    columns: dict[str, np.ndarray]

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    @property
    def in_views(self) -> bool:
        """Whether these are corners in views, which have places among lenses."""
        return "x" in self.columns

    @property
    def pixel(self) -> np.ndarray:
        """Columns u and v as an array (n, 2), in pixels."""
        return np.stack([self["u"], self["v"]], axis=-1)

    def keep(self, chosen: np.ndarray) -> Table:
        """Return the table of the chosen rows."""
        return Table(self.name, {name: values[chosen] for name, values in self.columns.items()})


def concatenate(tables: Sequence[Table]) -> Table:
    """Return the rows of tables with the same columns, one after the other."""
    first = tables[0]
    return Table(first.name, {name: np.concatenate([table[name] for table in tables]) for name in first.columns})


def read_table(path: str | Path, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> Table:
    """Return a table of the named columns of a CSV file, with the optional columns that the file has."""
    path = Path(path)
    first, _, body = read_text(path, LARGEST_FILE).partition("\n")
    header = [name.strip() for name in first.split(",")]
    missing = [name for name in names if name not in header]
    if missing:
        raise InputError(f"{path}: it has no column {missing[0]}; it needs {', '.join(names)}")
    names += tuple(name for name in optional if name in header)
    lines = [line for line in body.splitlines() if line.strip()]
    refuse_if(not lines, f"{path}: it has no rows")
    with refusing(f"{path}: it is no table of numbers:", ValueError):
        rows = np.loadtxt(lines, delimiter=",", usecols=[header.index(name) for name in names], ndmin=2)
    return _checked(path, dict(zip(names, rows.T, strict=True)), header=1)


def write_table(path: str | Path, table: Table) -> None:
    """Write a table as a CSV file."""
    formats = ["%d" if name in _WHOLE else "%.4f" for name in table.columns]
    with atomic_output(path, ".csv") as temporary:
        rows = np.column_stack([*table.columns.values()])
        np.savetxt(temporary, rows, formats, ",", header=",".join(table.columns), comments="")


def _checked(path: Path, columns: dict[str, np.ndarray], header: int) -> Table:
    """Return columns as a table if their values are valid; the first row stands in line 1 + `header` of the file."""
    for name, values in columns.items():
        wrong = ~np.isfinite(values) | (np.abs(values) > 2**20)
        if name in _WHOLE:
            wrong |= values != np.round(values)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            rule = "a whole number" if name in _WHOLE else "a finite number"
            raise InputError(
                f"{path}, row {row + 1 + header}: {name} = {values[row]:g}: it must be {rule} within 1048576"
            )
    return Table(
        path.name, {name: values.astype(int) if name in _WHOLE else values for name, values in columns.items()}
    )


def read_corners(path: str | Path, board: Board, size: Shape) -> Table:
    """Return the corners of a board on a detector of a given size, read from a CSV file.

    Parameters
    ----------
    board : Board
        The board that was seen.
    size : (int, int)
        Columns and rows of the pictures.
    """
    in_views = read_text(path, LARGEST_FILE).partition("\n")[0].startswith("x,")
    table = read_table(path, VIEW_COLUMNS if in_views else CORNER_COLUMNS, (BLUR_COLUMN,))
    if BLUR_COLUMN in table.columns and not np.ptp(table[BLUR_COLUMN]) > 0:
        # The programs that write the column fill it with one value where they did not look for blur.
        del table.columns[BLUR_COLUMN]
    count = board.columns * board.rows
    wrong = np.flatnonzero((table["cluster"] < 0) | (table["cluster"] >= count))
    if wrong.size:
        raise InputError(
            f"{path}, row {wrong[0] + 2}: cluster = {table['cluster'][wrong[0]]}: a board of {board.columns}x"
            f"{board.rows} has corners 0 to {count - 1}"
        )
    require_on_detector(table, size)
    return table


def read_centres(path: str | Path) -> Table:
    """Return centres of micro-images, read from a CSV table or a JSON file of LFToolbox or PlenoptiCam."""
    path = Path(path)
    if path.suffix.lower() == ".json":
        return _checked(path, read_foreign_centres(path), header=0)
    return read_table(path, CENTRE_COLUMNS, (DOUBTFUL_COLUMN,))


def require_on_detector(table: Table, size: Shape) -> None:
    """Refuse a table whose positions lie outside the detector."""
    off = np.flatnonzero(((table.pixel < -0.5) | (table.pixel > np.array(size) - 0.5)).any(1))
    if off.size > 0.1 * len(table.pixel):
        u, v = table.pixel[off[0]]
        raise InputError(
            f"{table.name}, row {off[0] + 2}: pixel ({u:g}, {v:g}): the camera's detector has {size[0]} x {size[1]} "
            f"pixels; {off.size} of {len(table.pixel)} rows lie off it"
        )


def observations(
    corners: Table, board: Board, index: LensIndex | None, grid: np.ndarray
) -> tuple[Observations, np.ndarray]:
    """Return the observations for a fit, and the frame index of each pose, with the places of lenses (3, 2)."""
    frames, pose = np.unique(corners["frame"], return_inverse=True)
    positions = board.places(corners["cluster"])
    if corners.in_views or index is None:
        lens = (np.stack([corners["x"], corners["y"]], axis=-1) - grid[0]) @ np.linalg.inv(grid[1:])
    else:
        lens = index.unit(corners["k"], corners["l"])
    return Observations(lens, corners.pixel, positions, pose), frames


def placed(positions: np.ndarray, poses: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return positions on boards, (n, 2), in the camera frame, (n, 3), with the pose of each row."""
    flat = np.concatenate([positions, np.zeros((len(positions), 1))], axis=1)
    return Rotation.from_rotvec(poses[pose, :3]).apply(flat) + poses[pose, 3:]


def find_lens_index(table: Table, hexagonal: bool, middle: np.ndarray) -> tuple[LensIndex, np.ndarray]:
    """Return the indexing of lenses that a table uses, found from the pixel positions, and the fitted grid.

    Shapes: `middle` (2,); the result (3, 2).
    """
    best = None
    other_error = np.inf
    for odd_rows in (-0.5, 0.0, 0.5):
        lenses = LensIndex(odd_rows, 1, (0, 0)).unit(table["k"], table["l"])
        matrix = np.column_stack([np.ones(len(lenses)), lenses])
        refuse_if(
            np.linalg.matrix_rank(matrix) < 3,
            f"{table.name}: all lenses lie on one line; corners of at least two rows are needed",
        )
        grid, distance, good = robust_lines(both_axes(matrix), table.pixel)
        grid = grid.reshape(2, 3).T
        error = float(np.sqrt((distance[good] ** 2).mean()))
        if hexagonal != bool(odd_rows):
            other_error = min(other_error, error)
        elif best is None or error < best[0]:
            best = error, odd_rows, grid
    assert best is not None
    error, odd_rows, grid = best
    if other_error < 0.8 * error:
        rows = "does not shift" if hexagonal else "shifts"
        raise InputError(
            f"{table.name}: the array {rows} its odd rows by half a pitch, other than the camera's mla_lattice: pixels "
            f"lie {error:.3g} from a grid of that and {other_error:.3g} from the other"
        )
    refuse_if(
        error > 0.5 * min(np.hypot(*step) for step in grid[1:]),
        f"{table.name}: pixels lie {error:.3g} from a regular grid of lenses {np.hypot(*grid[1]):.3g} apart: k "
        "must count the lenses of a row and l the rows",
    )
    refuse_if(
        np.hypot(*grid[1]) < 2,
        f"{table.name}: its lenses are {np.hypot(*grid[1]):.3g} pixels apart, where {2} are needed at "
        "least: u and v must be in pixels",
    )
    along, j = np.linalg.solve(grid[1:].T, middle - grid[0])
    j = np.round(j)
    shift = odd_rows * (j % 2)
    i = np.round(along - shift)
    index = LensIndex(odd_rows, 1 if np.linalg.det(grid[1:]) > 0 else -1, (int(i), int(j)))
    first = grid[0] + np.array([i + shift, j]) @ grid[1:]
    return index, np.stack([first, grid[1], index.row_sign * grid[2]])


LARGEST_FILE = 2**26
"""Bytes of a table of centres or corners, at most: of more than a million rows."""


def read_foreign_centres(path: str | Path) -> dict[str, np.ndarray]:
    """Read the columns k, l, u and v of a JSON file of LFToolbox or PlenoptiCam."""
    text = read_text(path, LARGEST_FILE)
    with refusing(f"{path}: it is no grid of micro-images:", OverflowError, *NO_RECORD):
        values = json.loads(text)
        if isinstance(values, dict) and "mic_list" in values:
            v, u, l, k = np.array(values["mic_list"], dtype=np.float64).reshape(-1, 4).T  # noqa: E741
        elif isinstance(values, dict) and "LensletGridModel" in values:
            grid = grid_of_model(values["LensletGridModel"])
            if grid is None:
                raise InputError(f"{path}: its grid has rows along the columns of the picture; transpose the picture")
            # Ours cover [k, k + 1).
            u, v = (grid.centres() - 0.5).reshape(-1, 2).T
            l, k = np.indices(grid.shape, dtype=np.float64).reshape(2, -1)  # noqa: E741
        else:
            raise InputError(f"{path}: it has neither LFToolbox's LensletGridModel nor PlenoptiCam's mic_list")
    return {"k": k, "l": l, "u": u, "v": v}
