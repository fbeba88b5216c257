"""The numbers that make a camera, as they are kept once they have been checked."""

from __future__ import annotations

from dataclasses import dataclass

from ..lens_data import LensData
from ..prescription import Glass


@dataclass(frozen=True, kw_only=True)
class CameraNumbers:
    """A record of a camera's numbers, which `PlenopticCamera` explains and checks."""

    focal_length: float
    aperture_radius: float
    mla_distance: float
    mla_focal_lengths: tuple[float, ...]
    mla_pitches: tuple[float, float]
    mla_lattice: str
    mla_rotation: float
    mla_offset: tuple[float, float]
    mla_tilt: tuple[float, float]
    mla_aperture: str
    mla_fill: float
    detector_distance: float
    detector_width: float
    resolution: tuple[int, int]
    crop_offset: tuple[int, int]
    crop_size: tuple[int, int]
    lens_model: str
    distortion: tuple[float, ...]
    wavefront: tuple[float, ...]
    main_lens: LensData | None
    glass: Glass | None
    mla_glass: Glass | None
    mla_jitter: tuple[float, float]
    mla_seed: int
    pixel_response: tuple[float, ...]
