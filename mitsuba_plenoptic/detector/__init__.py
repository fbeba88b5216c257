"""The detector: its record, the linear operator from light to signals, the film that applies it, and noise.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)
