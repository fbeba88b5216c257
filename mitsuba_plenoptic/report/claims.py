"""The paper's conclusions, each with a verdict computed from our numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from .experiment import Experiment
from .measurements import find
from .metrics import image_metrics

CONFIRMED, PARTLY, DIFFERS = "confirmed", "partly", "differs"

# Seconds on one core of about 2012, for 4096 x 4096 pixels.
PAPER_SECONDS = {"ray": 330.0, "coherent": 65.0, "partial": 195.0}
PAPER_RESOLUTION = (4096, 4096)

# Interference that an eye finds in an even grey: about one part in fifty.
_VISIBLE = 0.02


@dataclass(frozen=True)
class Claim:
    """A conclusion of the paper beside our numbers.

    Attributes
    ----------
    statement : str
        What the paper says.
    measured : str
        What we find.
    verdict : str
        ``confirmed``, ``partly`` or ``differs``.
    remark : str
        What to keep in mind.
    """

    statement: str
    measured: str
    verdict: str
    remark: str


def check_claims(
    experiment: Experiment, numbers: dict[str, Any], seconds: dict[str, float], near: str, far: str
) -> list[Claim]:
    """Compute the verdicts from the letters, what `measure` gave of them, and seconds on one core by method.

    Near and far are the ids of the nearest letter and of the farthest; each is out of focus where the other is sharp.
    """
    first, last = experiment.settings.distances[0], experiment.settings.distances[-1]
    blurred = [
        find(numbers["interference"], shape=near, distance=last),
        find(numbers["interference"], shape=far, distance=first),
    ]
    return [
        _pixel_counts(numbers),
        _interference(blurred),
        _removal(blurred),
        _similarity_to_rays(experiment, (first, last)),
        _four_suffice(experiment, blurred[0], last),
        _speed(seconds),
        _price(seconds),
    ]


def timing_table(experiment: Experiment, seconds: dict[str, float]) -> list[dict[str, Any]]:
    """List our seconds beside the paper's, with their ratio where the detectors are alike."""
    same = experiment.camera.resolution == PAPER_RESOLUTION
    return [
        {
            "method": method,
            "seconds": seconds[method],
            "paper_seconds": paper,
            "paper_over_ours": round(paper / seconds[method], 2) if same else None,
        }
        for method, paper in PAPER_SECONDS.items()
    ]


def _pixel_counts(numbers: dict[str, Any]) -> Claim:
    sizes = {tuple(row["bins"]) for row in numbers["reconstructions"]}
    text = ", ".join(f"{columns} x {rows}" for columns, rows in sorted(sizes))
    return Claim(
        "Reconstructions by rays and by waves have the same number of pixels.",
        f"All methods: {text} bins.",
        CONFIRMED if len(sizes) == 1 else DIFFERS,
        "One bin per microlens. Here the waves are summed over each bin; they do carry detail finer than that.",
    )


def _interference(blurred: list[dict[str, Any]]) -> Claim:
    values = [row["coherent"] for row in blurred]
    visible = [value > _VISIBLE for value in values]
    return Claim(
        "Coherent propagation shows interference where the image is out of focus.",
        _percent(blurred, "coherent"),
        CONFIRMED if all(visible) else PARTLY if any(visible) else DIFFERS,
        "Root mean square of the difference from the limit without interference between lenses, over its mean.",
    )


def _removal(blurred: list[dict[str, Any]]) -> Claim:
    fractions = [row["partial"] / max(row["coherent"], 1e-9) for row in blurred]
    return Claim(
        "Partially coherent propagation removes the interference.",
        f"{_percent(blurred, 'partial')} Left of the coherent one: "
        + " and ".join(f"{fraction:.0%}" for fraction in fractions)
        + ".",
        CONFIRMED if max(fractions) < 0.5 else PARTLY if min(fractions) < 0.8 else DIFFERS,
        "Most of it, not all: lenses of one subset still interfere.",
    )


def _similarity_to_rays(experiment: Experiment, distances: tuple[float, ...]) -> Claim:
    found = [
        image_metrics(experiment.images["partial", distance], experiment.images["ray", distance])
        for distance in distances
    ]
    texts = [
        f"{one.psnr:.1f} dB, SSIM {one.ssim:.3f} at {distance:g} mm"
        for one, distance in zip(found, distances, strict=True)
    ]
    near = [one.psnr > 30 and one.ssim > 0.95 for one in found]
    return Claim(
        "The partially coherent image nearly equals that by rays.",
        "PSNR " + "; ".join(texts) + ".",
        CONFIRMED if all(near) else PARTLY if any(near) else DIFFERS,
        "Against rays that spread over what their lens sees. Rays that put a pixel into one bin leave a grid of their "
        "own where the image is out of focus.",
    )


def _four_suffice(experiment: Experiment, blurred: dict[str, Any], distance: float) -> Claim:
    camera = experiment.camera
    needed = math.ceil(camera.blur_diameter(distance) / camera.mla_pitch)
    return Claim(
        "Four propagations, every second lens along each axis, suffice.",
        f"{blurred['partial']:.1%} of interference left in the blurred letter at {distance:g} mm, "
        f"where {blurred['coherent']:.1%} stand without subsets.",
        CONFIRMED if blurred["partial"] < 0.05 else DIFFERS,
        f"They suffice although they break the paper's own condition that the lenses of a subset do not overlap: at "
        f"{distance:g} mm that would take every {needed}th lens, {needed * needed} propagations.",
    )


def _speed(seconds: dict[str, float]) -> Claim:
    ratio = seconds["coherent"] / seconds["ray"]
    return Claim(
        "Reconstruction by waves is faster than by rays: 65 s against 330 s.",
        f"Coherent {_seconds(seconds['coherent'])}, rays {_seconds(seconds['ray'])}: "
        + (f"rays are {ratio:.0f} times faster." if ratio > 1 else f"waves are {1 / ratio:.1f} times faster."),
        CONFIRMED if ratio < 1 else DIFFERS,
        "One ray a pixel, as here, is a sum over the pixels. The paper does not say how its rays were followed; how "
        "long they take is a matter of the program, not of the method.",
    )


def _price(seconds: dict[str, float]) -> Claim:
    ratio = seconds["partial"] / seconds["coherent"]
    return Claim(
        "Partially coherent propagation takes four propagations: 195 s against 65 s.",
        f"{_seconds(seconds['partial'])} against {_seconds(seconds['coherent'])}: {ratio:.1f} times as long.",
        CONFIRMED if 2 < ratio < 4.5 else DIFFERS,
        "The paper's own ratio, 195/65, is 3 and not 4: part of its work seems to have been done once for all subsets.",
    )


def _percent(rows: list[dict[str, Any]], method: str) -> str:
    return (
        " and ".join(
            f"{row[method]:.1%} in the letter at {row['shape_distance']:g} mm refocused to {row['distance']:g} mm"
            for row in rows
        )
        + "."
    )


def _seconds(value: float) -> str:
    return f"{value:.2g} s" if value < 10 else f"{value:.0f} s"
