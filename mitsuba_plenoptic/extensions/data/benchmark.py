"""A benchmark of plenoptic captures: ten scenes with ground truth, tasks, scores and baselines.

`make_benchmark` makes the set of captures, `run_baseline` answers its tasks by methods of this package, `score` scores
files, whoever wrote them. The command is ``mitsuba-plenoptic benchmark``.
"""

from .baselines import BASELINES, run_baseline
from .benchmark_production import make_benchmark
from .contents import CAMERAS, CAPTURES, DISTANCES, PUPIL_POINTS, SIZES, Benchmark, Size, benchmark_recipe
from .hci_export import export_hci
from .scenes import SCENES
from .score import TASKS, depth_scores, picture_scores, score, table

__all__ = [
    "BASELINES",
    "CAMERAS",
    "CAPTURES",
    "DISTANCES",
    "PUPIL_POINTS",
    "SCENES",
    "SIZES",
    "TASKS",
    "Benchmark",
    "Size",
    "benchmark_recipe",
    "depth_scores",
    "export_hci",
    "make_benchmark",
    "picture_scores",
    "run_baseline",
    "score",
    "table",
]
