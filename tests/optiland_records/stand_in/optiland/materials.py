"""Glasses whose indices were recorded at the wavelengths that are asked for."""

import json
from pathlib import Path


class MaterialFile:
    """A material by its file, as Optiland's class of this name."""

    def __init__(self, filename):
        self.table = json.loads(Path(filename).read_text())

    def n(self, wavelength):
        """Index at a wavelength in micrometres."""
        return self.table[f"{wavelength * 1e3:.10g}"]
