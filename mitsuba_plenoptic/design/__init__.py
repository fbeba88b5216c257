"""Quantities that follow from a camera's parameters: functions of a `PlenopticCamera`.

`quantities` has the planes in focus, the resolution at each distance, the size of micro-images and the lenses that
light a pixel; `aberration` has the aberration of parabolic main lenses; `deconvolved_contrast` the resolution that can
be reached by inverting the camera's response; `microscope` quantities of cameras with objectives.

Wavelengths are in nanometres. Where a wavelength is optional, diffraction is neglected without it.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
