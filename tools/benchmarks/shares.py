"""Where the time of a wave capture goes on one thread: profiled seconds of functions that do not call each other."""

from __future__ import annotations

import cProfile
import pstats
from typing import Any

from mitsuba_plenoptic.capture import incoherent, patch
from mitsuba_plenoptic.capture.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.runtime import batches, fft

from .point_spreads import WAVELENGTH, radiators
from .table import Row, on_cores

_KINDS: dict[str, Any] = {
    "Fourier transforms": fft.fft,
    "squares, added to tiles": patch.Tile.add,
    "pupils, curvatures, transfer functions (Dr.Jit)": patch.PatchBatch.__init__,
    "finding shared patterns": incoherent.find_patterns,
    "tiles, added to the image": batches.add,
    "integrals over pixels": incoherent.integrate_pixels,
}
_PARAMETERS = {"resolution": "512", "detector_width": "1.024"}
_EVERY = 20
"""Where nothing is shared, every which radiator is taken."""


def run() -> list[Row]:
    """Profile the middle of the letters, with the default accuracy and with nothing shared."""
    return on_cores(1, _rows)


def _rows() -> list[Row]:
    camera, positions, weights, masks = radiators("letters", _PARAMETERS)
    rows = []
    for accuracy, which in ((DEFAULT_ACCURACY, slice(None)), (0.0, slice(None, None, _EVERY))):

        def add(which: slice, accuracy: float = accuracy) -> None:
            incoherent.incoherent_sum(
                camera, positions[which], weights[which], wavelength=WAVELENGTH, accuracy=accuracy,
                pupil_masks=None if masks is None else masks[which], batch_map=batches.InTurn(),
            )  # fmt: skip

        add(slice(None, None, len(positions) // 64))  # compiles the kernels
        profile = cProfile.Profile()
        profile.runcall(add, which)
        rows += _shares(f"letters, 512 x 512, {len(positions[which])} radiators, accuracy {accuracy:g}", profile)
    return rows


def _shares(what: str, profile: cProfile.Profile) -> list[Row]:
    statistics: Any = pstats.Stats(profile)
    total, spent = statistics.total_tt, {}
    for name, function in _KINDS.items():
        code = function.__code__
        key = (code.co_filename, code.co_firstlineno, code.co_name)
        spent[name] = statistics.stats[key][3] if key in statistics.stats else 0.0
    spent["the rest: products, turned blocks, the order of work"] = total - sum(spent.values())
    return [
        Row(f"{what}: {name}", "s", s, "the whole sum", total, s / total, note="share") for name, s in spent.items()
    ]
