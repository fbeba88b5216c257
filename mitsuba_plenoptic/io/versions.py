"""What files state of themselves: their version, and a digest; and what files without a version mean.

Up to version 1.0 files state no version, and wave captures treated a thin main lens as a parabolic phase, whatever the
camera's `lens_model`, except in front of microlenses of fewer than 20 wavelengths. Ray captures, and cameras by
themselves, mean what they state.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from ..camera import PlenopticCamera, has_small_lenses
from ..errors import refuse_if
from ..prescription import LINE_D

VERSION = version("mitsuba-plenoptic")
"""The version that files written by this process state."""

KEY = "version"
DIGEST = "digest"
"""Names of the entries that state it, and the digest of pixels and other entries."""


def stamped(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a file's record with the version of this package added."""
    return {**record, KEY: VERSION}


def sealed(record: Mapping[str, Any], parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, Any]:
    """Return a file's record, as JSON keeps it, with the version, and the digest of it and the planes of its pixels."""
    plain = json.loads(json.dumps(stamped(record), sort_keys=True))
    return {**plain, DIGEST: digest_of(plain, parts)}


def require_seal(record: dict[str, Any], parts: Sequence[Mapping[str, np.ndarray]]) -> None:
    """Refuse a file whose pixels or record are not those of its digest; files of earlier versions have none."""
    stated = record.get(DIGEST)
    refuse_if(
        stated is not None and stated != digest_of(record, parts),
        f"its digest, {str(stated)[:12]}, is not that of its pixels and data: it is damaged, or another program has "
        "changed it and kept the text 'mitsuba_plenoptic'; without this text its pixels are read with a given camera",
    )


def digest_of(record: Mapping[str, Any], parts: Sequence[Mapping[str, np.ndarray]]) -> str:
    """Return the digest of planes and of a record without the digest that it states."""
    sealed_record = {name: value for name, value in record.items() if name != DIGEST}
    content_hash = hashlib.sha256(json.dumps(sealed_record, sort_keys=True).encode())
    for name, plane in ((name, planes[name]) for planes in parts for name in sorted(planes)):
        content_hash.update(f"{name} {plane.dtype.name} {plane.shape}".encode() + np.ascontiguousarray(plane).tobytes())
    return content_hash.hexdigest()


def is_of_1_0(record: Mapping[str, Any]) -> bool:
    """Return whether version 1.0 or an earlier one wrote a record, which is the case if it states no version."""
    return KEY not in record


def camera_of_waves(
    camera: PlenopticCamera, wavelength: float | tuple[float, ...] | None, metadata: Mapping[str, Any]
) -> PlenopticCamera:
    """Return the camera of a wave capture of version 1.0 with the `lens_model` that its waves had.

    Whether lenses are small is decided at the longest wavelength of the capture, or at the d line if none is stated.
    """
    if camera.main_lens is not None or camera.lens_model == "parabolic":
        return camera
    spectrum = metadata.get("spectrum")
    stated = wavelength, metadata.get("wavelength"), spectrum.get("wavelengths") if isinstance(spectrum, dict) else None
    longest = max((length for value in stated for length in _numbers(value)), default=LINE_D)
    return camera if has_small_lenses(camera, longest) else camera.replace(lens_model="parabolic")


def _numbers(value: Any) -> Iterator[float]:
    """Yield the positive numbers in a number, a list, or a text with commas; metadata may hold anything else."""
    items = value.split(",") if isinstance(value, str) else value if isinstance(value, (list, tuple)) else [value]
    for item in items:
        try:
            positive = float(item)
        except (TypeError, ValueError):
            continue
        if positive > 0:
            yield positive
