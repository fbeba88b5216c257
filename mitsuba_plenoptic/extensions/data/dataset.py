"""Data sets of captures with ground truth, made from a recipe: random scenes, cameras, light and noise.

`read_recipe` and `make_dataset` make them; `DataSet` reads them as NumPy arrays and `torch_data.TorchDataset` as
tensors. The command is ``mitsuba-plenoptic dataset``.
"""

from .dataset_production import make_dataset
from .recipe import Recipe, parse_recipe, read_recipe
from .sample import Sample, make_sample
from .shards import DataSet

__all__ = ["DataSet", "Recipe", "Sample", "make_dataset", "make_sample", "parse_recipe", "read_recipe"]
