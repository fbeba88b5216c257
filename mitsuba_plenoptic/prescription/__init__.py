"""Prescriptions of real main lenses: surfaces and glasses, paraxial quantities, and the bundled lenses.

A `Prescription` is plain data. `LensSystem`, in `mitsuba_plenoptic.lenses.lens_system`, follows rays through it.
"""

from .glass import Glass
from .surfaces import BUNDLED, Paraxial, Prescription, Surface, bundled_prescription, paraxial

__all__ = ["BUNDLED", "Glass", "Paraxial", "Prescription", "Surface", "bundled_prescription", "paraxial"]
