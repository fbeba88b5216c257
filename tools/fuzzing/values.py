"""Values that break rules, and mutations of bytes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

NOT_NUMBERS: tuple[Any, ...] = (
    "80", "", "nan", b"1", [], {}, [1.0, 2.0], (), {"a": 1}, object(), 1j, True, False, np.array([1.0, 2.0]),
    np.True_, "\x1b[31m", "a\nb", "\u202e", "\ud800", "x" * 10_000,
)  # fmt: skip
NOT_FINITE: tuple[Any, ...] = (math.nan, math.inf, -math.inf, np.float32("nan"), np.float64("inf"), 10**400, -(10**400))
NOT_POSITIVE: tuple[Any, ...] = (0, -1, -0.0, 0.0, -1e-300, -80.5, np.int64(-3), -(10**30))
NOT_WHOLE: tuple[Any, ...] = (0.5, 2.5, 1e-9, math.pi)
TOO_SMALL: tuple[Any, ...] = (1e-300, 5e-324, 1e-10)
TOO_LARGE: tuple[Any, ...] = (1e300, 1.7e308, 1e10, 10**20)

# As texts of the command line and of XML.
NOT_NUMBER_TEXTS = ("wide", "1,5", "0x10", "1e", "--", "1 2", "\u0663x", "nan nan", "1_0_", "\x1b[2J", "x" * 5000)
NOT_FINITE_TEXTS = ("nan", "inf", "-inf", "1e999", "-1e999", "NaN", "infinity")
NOT_POSITIVE_TEXTS = ("0", "-1", "-0.0", "-1e-30", "-80")
OUT_OF_RANGE_TEXTS = ("1e300", "1e-300", "1e30", "1e-20")


def pick(random: np.random.Generator, values: Any) -> Any:
    """Choose one of several."""
    return values[int(random.integers(len(values)))]


def mutate(random: np.random.Generator, data: bytes) -> tuple[bytes, str]:
    """Damage bytes in one of many ways."""
    edited = bytearray(data)
    size = len(edited)
    # Most of what matters is in the header.
    place = int(random.integers(min(size, 2048) if random.random() < 0.7 else size))
    way = pick(random, ("flips", "byte", "truncate", "remove", "insert", "repeat", "zero", "ones", "word", "swap"))
    if way == "flips":
        for _ in range(int(random.integers(1, 17))):
            edited[int(random.integers(size))] ^= 1 << int(random.integers(8))
    elif way == "byte":
        edited[place] = int(random.integers(256))
    elif way == "truncate":
        del edited[int(random.integers(size)) :]
    elif way == "remove":
        del edited[place : place + int(random.integers(1, 64))]
    elif way == "insert":
        edited[place:place] = random.bytes(int(random.integers(1, 64)))
    elif way == "repeat":
        edited[place:place] = edited[place : place + int(random.integers(1, 4096))]
    elif way in ("zero", "ones"):
        count = min(int(random.integers(1, 64)), size - place)
        edited[place : place + count] = bytes([0 if way == "zero" else 255]) * count
    elif way == "word":
        word = pick(random, (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**30, 65536, 2**16 - 1))
        edited[place : place + 4] = int(word).to_bytes(4, pick(random, ("little", "big")))
    else:
        other = int(random.integers(size))
        a, b = edited[place : place + 16], edited[other : other + 16]
        edited[place : place + len(a)], edited[other : other + len(b)] = b[: len(a)], a[: len(b)]
    return bytes(edited), f"{way} at byte {place}"
