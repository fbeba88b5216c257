"""The command ``mitsuba-plenoptic``, and what the commands of extensions share with it.

`__init__.pyi` names what extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, _ = lazy_loader.attach_stub(__name__, __file__)
