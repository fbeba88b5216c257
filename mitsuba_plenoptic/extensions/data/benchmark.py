"""A benchmark of plenoptic captures: ten scenes with ground truth, tasks, scores and baselines.

`make_benchmark` makes the set of captures, `run_baseline` answers its tasks by methods of this package, `score` scores
files, whoever wrote them. The command is ``mitsuba-plenoptic benchmark``.
"""

from .baselines import BASELINES, run_baseline
from .benchmark_production import make_benchmark
from .contents import CAMERAS, CAPTURES, SIZES, Benchmark, Size, benchmark_recipe
from .hci_export import export_hci
from .scenes import SCENES
from .score import TASKS, score, table

__all__ = [
    "BASELINES",
    "CAMERAS",
    "CAPTURES",
    "SCENES",
    "SIZES",
    "TASKS",
    "Benchmark",
    "Size",
    "benchmark_recipe",
    "export_hci",
    "make_benchmark",
    "run_baseline",
    "score",
    "table",
]
