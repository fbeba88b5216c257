"""A data set for PyTorch (extra ``torch``)."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from .shards import DataSet

try:
    import torch
except ImportError:
    raise InputError("a data set for PyTorch needs the package torch: pip install torch") from None


class TorchDataset(torch.utils.data.Dataset):
    """Data set for ``torch.utils.data.DataLoader``, whose items are dictionaries of tensors.

    Colour channels come first, as in PyTorch's convolutions: (3, rows, columns). Everything else is as in `Sample`.
    Unknown values stay NaN, and infinite depths stay infinite. Batches need arrays of one size, so select pixel arrays
    (`fields`) where cameras differ in their number of views.
    """

    def __init__(
        self,
        # What `make_dataset` or ``mitsuba-plenoptic dataset`` wrote.
        folder: str | Path,
        # Names of the arrays to read. Default: all.
        fields: Collection[str] | None = None,
    ):
        self.samples = DataSet(folder, fields)

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return the arrays of a sample as tensors, and its index as ``index``."""
        if isinstance(index, slice):
            raise TypeError(f"sample {index}: give a whole number; torch.utils.data.Subset takes several")
        sample = self.samples[index]
        tensors = {
            name: torch.from_numpy(np.ascontiguousarray(np.moveaxis(array, -1, 0)) if array.ndim == 3 else array)
            for name, array in sample.arrays.items()
        }
        return {**tensors, "index": index}
