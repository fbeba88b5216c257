"""Linear maps of light to pixels, the solver that inverts them for light that is never negative, and pixels' noise.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)
