"""Prescriptions of real main lenses: surfaces and glasses, paraxial quantities, and the bundled lenses.

A `Prescription` is plain data. `LensSystem`, in `mitsuba_plenoptic.lenses.lens_system`, follows rays through it.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)

__all__ = ["Glass", "Paraxial", "Prescription", "Surface", "paraxial"]
