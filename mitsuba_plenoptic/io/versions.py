"""What files state of themselves: their version, and a digest."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version

import numpy as np

from ..errors import refuse_if
from ..runtime import Array, Facts, Named

VERSION = version("mitsuba-plenoptic")
"""The version that files written by this process state."""

FORMAT = 1
"""The number of the format of files: it grows where a reader of before would misread them."""

KEY = "version"
DIGEST = "digest"
"""Names of the entries that state the version, and the digest of pixels and other entries."""


def stamped(record: Facts) -> Named:
    """Return a file's record with the version of this package and the number of the format added."""
    return {**record, "format": FORMAT, KEY: VERSION}


def sealed(record: Facts, parts: Sequence[Mapping[str, Array]]) -> Named:
    """Return a file's record, as JSON keeps it, with the version, and the digest of it and the planes of its pixels."""
    plain = json.loads(json.dumps(stamped(record), sort_keys=True))
    return {**plain, DIGEST: digest_of(plain, parts)}


def require_seal(record: Named, parts: Sequence[Mapping[str, Array]]) -> None:
    """Refuse a file of a newer format, or whose pixels or record are not those of its digest; it may have none."""
    number = record.get("format")
    newer = isinstance(number, int) and number > FORMAT
    refuse_if(newer, f"format = {number}, of version {record.get(KEY)}: this version reads {FORMAT}")
    stated = record.get(DIGEST)
    refuse_if(
        stated is not None and stated != digest_of(record, parts),
        f"its digest, {str(stated)[:12]}, is not that of its pixels and data: it is damaged, or another program has "
        "changed it and kept the text 'mitsuba_plenoptic'; without this text its pixels are read with a given camera",
    )


def digest_of(record: Facts, parts: Sequence[Mapping[str, Array]]) -> str:
    """Return the digest of planes and of a record without the digest that it states."""
    sealed_record = {name: value for name, value in record.items() if name != DIGEST}
    content_hash = hashlib.sha256(json.dumps(sealed_record, sort_keys=True).encode())
    for name, plane in ((name, planes[name]) for planes in parts for name in sorted(planes)):
        content_hash.update(f"{name} {plane.dtype.name} {plane.shape}".encode() + np.ascontiguousarray(plane).tobytes())
    return content_hash.hexdigest()
