"""Rays through the camera: from detector points through the microlenses and the main lens into the scene.

A ray capture draws its rays in `sensor_rays`: for each point of the detector a lens, a point of that lens, and a
wavelength. `lens_choice` says which lenses light a pixel, to rays and to signed rays; `random_numbers` has their
numbers. `tracer` follows rays between detector, array, main lens and scene, in either direction, for ray captures,
wave captures and points alike. `edges` has the mean light of cells of rays. `entrance` gives the points where rays
enter the main lens, the targets of shadow rays.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)
