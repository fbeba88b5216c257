"""Pairs and sequences of particles in a flow, with exact positions and displacements."""

from __future__ import annotations

import itertools
import json
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...camera.plenoptic_camera import require_camera
from ...errors import refuse_if, require_count, require_number, suggest_keywords
from ...io.versions import stamped
from .flows import Flow
from .seeding import MOST, LightSheet, ParticleVolume, Seeding

MOST_FRAMES = 10000

_NODES, _MARGIN = 9, 0.1
"""Points along an axis of the volume whose paths tell from where particles enter, and what is added to their bounds."""


@suggest_keywords
def particle_sequence(
    camera: PlenopticCamera,
    volume: ParticleVolume,
    seeding: Seeding,
    flow: Flow,
    *,
    interval: float,
    frames: int = 2,
    sheet: LightSheet | None = None,
    seed: int = 0,
) -> xr.Dataset:
    """Return particles that a flow carries through a volume, at the times of several frames.

    Particles leave the volume and others enter it: they are spread evenly over all places from which the flow carries
    them into the volume in one of the frames.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera before which the volume is.
    volume : ParticleVolume
        The volume.
    seeding : Seeding
        Density, sizes and material.
    flow : Flow
        The flow.
    interval : float
        Seconds from frame to frame.
    frames : int
        Number of frames, 2 for a pair.
    sheet : LightSheet, optional
        The light. Default: everywhere, along x.
    seed : int
        Seed of positions and diameters.

    Returns
    -------
    xarray.Dataset
        ``position`` (frame, particle, axis) in mm, ``displacement`` (frame, particle, axis) to the next frame, or for
        the last one to where that would be; ``diameter`` (particle,) in micrometres; ``inside`` (frame, particle), 1
        for particles within the volume, others are not recorded; and ``irradiance`` (frame, particle). The attribute
        ``particles`` is a JSON object of all settings.

    Raises
    ------
    InputError
        If the volume is not before the camera, the density is too high, or displacements exceed the volume.
    """
    require_camera(camera)
    interval = require_number("interval", interval, positive=True, maximum=1e9)
    frames = require_count("frames", frames, minimum=1, maximum=MOST_FRAMES)
    volume.before(camera)
    sheet, density = sheet or LightSheet(), seeding.density(volume, camera)
    random = np.random.default_rng(require_count("seed", seed, minimum=0))
    low, high = _reached(volume, flow, interval, frames)
    expected = density * float((high - low).prod())
    refuse_if(
        expected > MOST, f"frames = {frames}: {expected:.3g} particles pass through the volume; {MOST:.0e} at most"
    )
    count = int(random.poisson(expected))
    paths = [random.uniform(low, high, (count, 3))]
    diameters = seeding.diameters(count, random)
    for _ in range(frames):
        paths.append(flow.advected(paths[-1], interval))
    position = np.stack(paths[:-1])
    moved = np.stack([after - before for before, after in itertools.pairwise(paths)])
    inside = volume.contains(position)
    used = inside.any(0)
    _within(volume, interval, moved[:-1][inside[:-1]])
    position, inside = position[:, used], inside[:, used]
    index = seeding.index
    settings = {
        "camera": camera.to_dict(),
        "volume": {"lower": volume.lower, "upper": volume.upper},
        "sheet": vars(sheet),
        "seeding": vars(seeding) | ({} if index is None else {"index": (complex(index).real, complex(index).imag)}),
        "flow": {"kind": type(flow).__name__} | {key: value for key, value in vars(flow).items() if key[0] != "_"},
        "interval": interval,
        "seed": seed,
    }
    along = ("frame", "particle", "axis")
    return xr.Dataset(
        {
            "position": (along, position, {"units": "mm"}),
            "displacement": (along, moved[:, used], {"units": "mm"}),
            "diameter": ("particle", diameters[used], {"units": "um"}),
            "inside": (along[:2], inside.astype(np.int8)),
            "irradiance": (along[:2], sheet.irradiance(position, volume)),
        },
        coords={"time": ("frame", interval * np.arange(frames), {"units": "s"}), "axis": list("xyz")},
        attrs={"particles": json.dumps(stamped(settings))},
    )


def _reached(
    volume: ParticleVolume, flow: Flow, interval: float, frames: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the bounds of the places from which particles come into the volume in one of the frames.

    Flows that carry particles farther than the volume reaches are refused.
    """
    sides = [np.linspace(low, high, _NODES) for low, high in zip(volume.lower, volume.upper, strict=True)]
    nodes = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
    places = [nodes]
    for _ in range(frames - 1):
        places.append(flow.advected(places[-1], -interval))
    _within(volume, interval, np.diff(places[:2], axis=0).reshape(-1, 3))
    low, high = np.min(places, axis=(0, 1)), np.max(places, axis=(0, 1))
    # Paths between the nodes may come from a little farther.
    margin = _MARGIN * np.maximum(high - volume.upper, volume.lower - low)
    return low - margin, high + margin


def _within(volume: ParticleVolume, interval: float, moves: NDArray[np.float64]) -> None:
    """Refuse displacements (n, 3) of particles in the volume that are as long as this."""
    for axis, move, size in zip("xyz", np.abs(moves).max(0, initial=0), volume.size, strict=True):
        refuse_if(
            move >= size,
            f"interval = {interval:g}: particles move by {move:.3g} mm along {axis} from frame to frame, beyond the "
            f"volume, which has {size:.3g} mm",
        )


def settings_of(truth: xr.Dataset) -> dict[str, Any]:
    """Return the settings of a sequence from its attributes."""
    refuse_if("particles" not in truth.attrs, "particles: the data set is not one of 'particle_sequence'")
    return dict(json.loads(truth.attrs["particles"]))
