"""Pairs and sequences of particles in a flow, with exact positions and displacements."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import xarray as xr

from ...camera import PlenopticCamera, require_camera
from ...errors import refuse_if, require_count, require_number, suggest_keywords, warn
from ...io import versions
from ...runtime import Doubles
from .flows import Flow
from .seeding import MOST, LightSheet, ParticleVolume, Seeding, Window


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
    """Return particles that a flow carries through a volume, at the times of several frames, in mm in the fluid.

    Particles leave the volume and others enter it, so that in each frame those within it are spread evenly. A flow with
    divergence, such as an imported one, gathers or thins them out, of which a warning tells.

    Parameters
    ----------
    camera, volume : PlenopticCamera, ParticleVolume
        The camera, and a volume before it.
    seeding, flow : Seeding, Flow
        What the particles are, and how they move.
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
    """
    require_camera(camera)
    interval = require_number("interval", interval, positive=True, maximum=1e9)
    frames = require_count("frames", frames, minimum=1, maximum=10000)
    near = volume.lower[2]
    window = Window(near if seeding.window is None else seeding.window, seeding.medium)
    refuse_if(
        window.distance > near,
        f"window = {window.distance:g}: it must be before the volume, whose near face is at z = {near:g}",
    )
    volume.before(camera, window)
    sheet = sheet or LightSheet()
    random = np.random.default_rng(require_count("seed", seed, minimum=0))
    expected = seeding.density(volume, volume.lenses(camera, window)) * float(volume.size.prod())
    first = random.uniform(volume.lower, volume.upper, (random.poisson(expected), 3))
    if frames > 1:
        _check_motion(flow, volume, interval, frames, first)
    entering = []
    for frame in range(frames):
        # Particles are even in any frame; of those of a later one, the others are followed already.
        there = random.uniform(volume.lower, volume.upper, (random.poisson(expected), 3)) if frame else first
        paths = [there]
        for _ in range(frame):
            before = flow.advected(paths[0], -interval)
            enters = ~volume.contains(before)
            paths = [path[enters] for path in (before, *paths)]
        for _ in range(frame, frames):
            paths.append(flow.advected(paths[-1], interval))
        entering.append(np.stack(paths))
    followed = np.concatenate(entering, axis=1)
    position = followed[:-1]
    moved = np.diff(followed, axis=0)
    diameters = seeding.diameters(position.shape[1], random)
    inside = volume.contains(position)
    _check_within(volume, interval, moved[:-1][inside[:-1]])
    settings = {
        "camera": camera.to_dict(),
        "volume": {"lower": volume.lower, "upper": volume.upper},
        "window": vars(window),
        "sheet": vars(sheet),
        "seeding": vars(seeding) | {"index": seeding.index and (seeding.index.real, seeding.index.imag)},
        "flow": {"kind": type(flow).__name__} | {key: value for key, value in vars(flow).items() if key[0] != "_"},
        "interval": interval,
        "seed": seed,
    }
    along = ("frame", "particle", "axis")
    return xr.Dataset(
        {
            "position": (along, position, {"units": "mm"}),
            "displacement": (along, moved, {"units": "mm"}),
            "diameter": ("particle", diameters, {"units": "um"}),
            "inside": (along[:2], inside.astype(np.int8)),
            "irradiance": (along[:2], sheet.irradiance(position, volume)),
        },
        coords={"time": ("frame", interval * np.arange(frames), {"units": "s"}), "axis": list("xyz")},
        attrs={"particles": json.dumps(versions.stamped(settings))},
    )


def _check_motion(flow: Flow, volume: ParticleVolume, interval: float, frames: int, points: Doubles) -> None:
    """Refuse flows that carry particles farther than the volume reaches, or too many of them; warn of divergence."""
    after = flow.advected(points, interval)
    _check_within(volume, interval, after - points)
    passing = len(points) + (frames - 1.0) * float((~volume.contains(after)).sum())
    refuse_if(passing > MOST, f"frames = {frames}: {passing:.3g} particles pass through the volume; {MOST:.0e} at most")
    step = 1e-4 * volume.size
    places = np.random.default_rng(0).uniform(volume.lower + step, volume.upper - step, (1000, 3))
    slopes = [flow.velocity(places + move) - flow.velocity(places - move) for move in np.diag(step)]
    divergence = sum(slope[:, axis] / (2 * step[axis]) for axis, slope in enumerate(slopes))
    change = interval * max(float(np.sqrt((divergence**2).mean())), (frames - 1) * abs(float(divergence.mean())))
    # Part of the particles by which divergence may change their density.
    if change > 0.05:
        warn(
            f"flow: by its divergence the density of particles changes by {change:.0%} or more: it gathers or "
            "thins them out, and their number does not stay"
        )


def _check_within(volume: ParticleVolume, interval: float, moves: Doubles) -> None:
    """Refuse displacements (n, 3) of particles that are as long as the volume."""
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
