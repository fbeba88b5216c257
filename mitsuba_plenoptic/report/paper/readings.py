"""Interference where the paper can be read in several ways: the four subsets, and the microlens's phase."""

from __future__ import annotations

from typing import Any

from ...errors import InputError
from ...reconstruction import reconstruct
from ...reconstruction.partitions import blocks, coloured, sublattice
from ..experiment import Experiment
from ..metrics import interference, shape_window
from ..stage_store import StageStore


def measure_readings(experiment: Experiment, store: StageStore, near: str, far: str) -> list[dict[str, Any]]:
    """Measure the nearest and the farthest shape, by ids, each refocused to where the other one is.

    Each row has the interference with four subsets, the quarters of the array or the best sublattice; the count of
    subsets in which no images of lit lenses overlap; the interference without the second microlens phase (`literal`);
    and how far the coherent image, and what is left of it without interference, are from that by rays.
    """
    distances = experiment.settings.distances
    blurred = [(near, distances[-1]), (far, distances[0])]
    found = store.facts(
        "readings",
        {"capture": experiment.wave_key, "blurred": blurred},
        lambda progress: {"rows": [_row(experiment, shape, distance) for shape, distance in blurred]},
    )
    return list(found["rows"])


def _row(experiment: Experiment, shape: str, distance: float) -> dict[str, Any]:
    """Measure one shape at one distance."""
    capture, camera, images = experiment.wave, experiment.camera, experiment.images
    wavelength = experiment.settings.wavelength
    window = shape_window(camera, *experiment.boxes[shape])
    if window is None:
        raise InputError(f"{shape}: it is not in the camera's view")

    def image(**options: Any) -> Any:
        return reconstruct(capture, distance, **options).image

    partitions = {"quarters": blocks(camera, 2), "sublattice": sublattice(camera, distance, 4, wavelength)}
    subsets = {name: image(method="partial", partition=labels) for name, labels in partitions.items()}
    literal = {
        "literal_coherent": image(method="coherent", relay=False),
        "literal_partial": image(method="partial", interleave=2, relay=False),
    }
    literal_limit = image(method="partial", interleave="auto", relay=False)
    measured = {
        **{name: (made, images["limit", distance]) for name, made in subsets.items()},
        **{name: (made, literal_limit) for name, made in literal.items()},
        "coherent_from_rays": (images["coherent", distance], images["ray", distance]),
        "limit_from_rays": (images["limit", distance], images["ray", distance]),
    }
    return {
        "shape": shape,
        "distance": distance,
        "colours": int(coloured(capture, distance).max()) + 1,
        **{name: round(interference(*pair, window), 5) for name, pair in measured.items()},
    }
