"""A plenoptic camera: the table of its parameters, their checks and forms, and commonly used derived quantities.

Further derived quantities are in `mitsuba_plenoptic.design`.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)
