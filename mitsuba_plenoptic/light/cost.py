"""The estimated cost of a capture."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cost:
    """Estimated time in seconds and memory in bytes of a capture."""

    points: int  # number of points whose light reaches the recorded window; 0 if not determined
    patterns: int  # number of point spreads that are computed for them
    seconds: float  # time, extrapolated from a few point spreads on this machine
    memory: float  # largest memory in bytes
