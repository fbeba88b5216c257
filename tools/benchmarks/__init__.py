"""Benchmarks, one module a section of `tools/benchmark.py`."""

import warnings

from mitsuba_plenoptic import PhysicsWarning

# Evenly lit pixels are a good load and no camera's capture, as the guards would tell at every run.
warnings.filterwarnings("ignore", category=PhysicsWarning)
