"""Published lenses that come with the package, each a file in the folder ``lenses`` that tells its source."""

from __future__ import annotations

import functools
from importlib import resources

import yaml

from ..errors import InputError, did_you_mean, shown
from . import lenses
from .data import Prescription

BUNDLED = ("cooke_triplet", "double_gauss", "singlet", "tessar")
"""Their names."""


@functools.cache
def bundled_prescription(name: str) -> Prescription:
    """Return a bundled lens.

    Parameters
    ----------
    name : str
        One of `BUNDLED`; ``.yaml`` may follow it.

    Raises
    ------
    InputError
        If there is none of that name; the message lists those there are.
    """
    stem = name.removesuffix(".yaml")
    if stem not in BUNDLED:
        raise InputError(
            f"main_lens = {shown(name)}: there is no such file, and the bundled lenses are {', '.join(BUNDLED)}"
            f"{did_you_mean(stem, BUNDLED)}"
        )
    text = (resources.files(lenses) / f"{stem}.yaml").read_text(encoding="utf-8")
    return Prescription.from_plain(yaml.safe_load(text))
