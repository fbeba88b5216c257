"""Quantities that follow from a camera's parameters: functions of a `PlenopticCamera`.

`quantities` has the planes in focus, the resolution at each distance, the size of micro-images and the lenses that
light a pixel; `aberration` has the aberration of parabolic main lenses; `deconvolved_contrast` the resolution that can
be reached by inverting the camera's response; `microscope` quantities of cameras with objectives.

Wavelengths are in nanometres. Where a wavelength is optional, diffraction is neglected without it.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import inspect
from typing import Any

import lazy_loader

from ..errors import suggest_keywords

_of_stub, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    entry = _of_stub(name)
    # The stub's loader has stored the bare function under its name.
    globals()[name] = suggest_keywords(entry) if inspect.isfunction(entry) else entry
    return globals()[name]
