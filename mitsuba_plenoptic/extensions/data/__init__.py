"""Extension `data`: data sets of random scenes, and the benchmark.

The extension needs `onchip` for data sets of dual pixels, and `raw` to export the benchmark.
"""

from ...extension import Extension

EXTENSION = Extension(
    modules={"dataset": "dataset", "benchmark": "benchmark"},
    commands={"dataset": "dataset_command", "benchmark": "benchmark_command"},
)
