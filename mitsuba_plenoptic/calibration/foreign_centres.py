"""Centres of micro-images as other programs keep them.

- **LFToolbox** (D. G. Dansereau) writes a ``.grid.json`` beside each white image, with the object ``LensletGridModel``.
- **PlenoptiCam** (C. Hahne) writes a JSON file beside the white image, with the list ``mic_list`` of y, x, row and
  column of each micro-image; its pixels are counted as ours, from 0 at the centre of the first.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..io.files import read_text
from ..lightfield.exchange.lftoolbox import grid_of_model

LARGEST_FILE = 2**26
"""Bytes of a table of centres or corners, at most: of more than a million rows."""


def read_foreign_centres(path: str | Path) -> dict[str, np.ndarray]:
    """Read the columns k, l, u and v of a JSON file of LFToolbox or PlenoptiCam.

    Raises
    ------
    InputError
        If it is neither, or damaged.
    """
    text = read_text(path, LARGEST_FILE)
    try:
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
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: it is no grid of micro-images: {type(error).__name__} {error}") from None
    return {"k": k, "l": l, "u": u, "v": v}
