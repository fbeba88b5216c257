"""Interference by each reading of ambiguous statements in the paper: the four subsets, and the microlens phase."""

from __future__ import annotations

from typing import Any

from ...errors import InputError
from ...refocus import reconstruct
from ...report.experiment import Experiment
from ...report.metrics import interference, shape_window
from ...report.stage_store import Stages
from .partitions import blocks, coloured, refocused, sublattice


def measure_readings(experiment: Experiment, store: Stages, near: str, far: str) -> list[dict[str, Any]]:
    """Return the interference in images of the shapes `near` and `far`, each refocused to the distance of the other.

    Each row has the interference with four subsets, the quarters of the array or the best sublattice; the number of
    subsets in which no images of lit lenses overlap; the interference without the second microlens phase (`literal`);
    and the difference from the ray image of the coherent image and of its part without interference.
    """
    distances = experiment.settings.distances
    blurred = [(near, distances[-1]), (far, distances[0])]
    found = store.facts(
        "readings",
        {"capture": experiment.wave_key, "blurred": blurred},
        lambda progress: {"rows": _rows(experiment, blurred)},
    )
    return list(found["rows"])


def _rows(experiment: Experiment, blurred: list[tuple[str, float]]) -> list[dict[str, Any]]:
    """Return measurements of shapes at their distances, refocused to all distances at once where possible."""
    capture, camera = experiment.wave, experiment.camera

    def images(distances: list[float], **options: Any) -> dict[float, Any]:
        return {result.distance: result.image for result in reconstruct(capture, distances, **options)}

    distances = [distance for _, distance in blurred]
    quarters = refocused(capture, distances, blocks(camera, 2))
    coherent = images(distances, method="coherent", relay=False)
    partial = images(distances, method="partial", interleave=2, relay=False)
    literal = images(distances, method="partial", interleave="auto", relay=False)
    rows = []
    for shape, distance in blurred:
        window = shape_window(camera, *experiment.boxes[shape])
        if window is None:
            raise InputError(f"{shape}: it is not in the camera's view")
        labels = sublattice(camera, distance, 4, experiment.settings.wavelength)
        best = refocused(capture, [distance], labels)[distance]
        known = {name: experiment.images[name, distance] for name in ("ray", "coherent", "limit")}
        compared = {
            "quarters": (quarters[distance], known["limit"]),
            "sublattice": (best, known["limit"]),
            "literal_coherent": (coherent[distance], literal[distance]),
            "literal_partial": (partial[distance], literal[distance]),
            "coherent_from_rays": (known["coherent"], known["ray"]),
            "limit_from_rays": (known["limit"], known["ray"]),
        }
        values = {name: round(interference(*pair, window), 5) for name, pair in compared.items()}
        colours = int(coloured(capture, distance).max()) + 1
        rows.append({"shape": shape, "distance": distance, "colours": colours, **values})
    return rows
