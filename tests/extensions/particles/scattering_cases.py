"""The mark of tests whose particles scatter light."""

from importlib.util import find_spec

import pytest

needs_miepython = pytest.mark.skipif(find_spec("miepython") is None, reason="spheres scatter light by miepython")
