"""Powers of a field in a step, for guards: summed as the field streams by."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..optics import EDGE, fraction, frequencies_of, power, power_by_row, rim
from ..runtime import Field, active_backend
from .steps import Step
from .workspace import Rows


class Watch:
    """Power of a field behind an element, and its fractions at the band's edge and in the rim of the next window.

    The outer eighth of the frequencies counts as the edge. The rim is that along y, where a step cuts what it need not
    transform along x. `check` is called with these numbers when all of the spectrum has passed.
    """

    def __init__(self, step: Step, check: Callable[[Watch], None]):
        x = step.x
        y = step.y
        self._step = step
        self.check = check
        self._inner = np.abs(frequencies_of(x.held)) <= 1 - EDGE
        high = np.flatnonzero(np.abs(frequencies_of(y.held)) > 1 - EDGE)
        # The high frequencies are in the middle.
        self._high = slice(int(high[0]), int(high[-1]) + 1) if high.size else slice(0)
        # Around the border of the source's window, wherever the samples of the destination start.
        width = rim(y.new_padded)
        first = (round((y.first - y.start) / y.new_pitch) - width) % y.new_padded
        end = first + 2 * width
        self._rim = slice(first, end), slice(0, max(end - y.new_padded, 0))
        self._total = self._at_edge = self._in_rim = 0.0

    def watched(self, spectrum: Rows) -> Rows:
        """Yield the blocks of a spectrum: lines along y, of some frequencies along x."""
        arrays = active_backend().arrays
        for lines, block in spectrum:
            whole = power_by_row(block)
            high = power_by_row(block[:, self._high])
            self._total += whole.sum()
            self._at_edge += arrays.where(arrays.asarray(self._inner[lines]), high, whole).sum()
            yield lines, block
        sums = arrays.stack([self._total, self._at_edge])
        self._total, self._at_edge = active_backend().to_host(sums).tolist()

    def see_window(self, lines: Field) -> None:
        """Add the power of lines all over the next window along y."""
        self._in_rim += sum(power(lines[:, side]) for side in self._rim)

    @property
    def power(self) -> float:
        """Sum of the squared moduli of the source samples behind the element, if all of their frequencies are held."""
        return float(self._total) * self._step.x.padded * self._step.y.padded

    @property
    def band_edge(self) -> float:
        """Fraction of the power in the outer eighth of the frequencies."""
        return fraction(float(self._at_edge), float(self._total))

    @property
    def in_rim(self) -> float:
        """Fraction of the power in the rim of the destination's window, if free space takes none."""
        return fraction(self._in_rim, float(self._total) * self._step.y.new_padded)
