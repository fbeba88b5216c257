"""The paper's conclusions, each with a verdict computed from this package's results."""

from __future__ import annotations

import math
from typing import Any

from ...report.comparison import find
from ...report.experiment import Experiment
from ...report.metrics import image_metrics, ssim_text
from ...report.page import Claim

CONFIRMED, PARTLY, DIFFERS = "confirmed", "partly", "differs"
BY_CONSTRUCTION = "by construction"

# Seconds on one core of about 2012, for 4096 x 4096 pixels.
PAPER_SECONDS = {"ray": 330.0, "coherent": 65.0, "partial": 195.0}
PAPER_RESOLUTION = (4096, 4096)

# Interference that an eye finds in an even grey: about one part in fifty.
_VISIBLE = 0.02

# What is left of interference that is strongly reduced, at most.
_STRONGLY = 0.5

# Interference that remains where there are enough subsets.
_ENOUGH = 0.01

# Nearly equal images, and by how much, in dB, the partially coherent one must be nearer than the coherent one.
_NEAR_PSNR, _NEAR_SSIM, _NEARER = 30.0, 0.95, 3.0


def check_claims(
    experiment: Experiment, measured: dict[str, Any], seconds: dict[str, float], near: str, far: str
) -> list[Claim]:
    """Return verdicts on the paper's conclusions, from the letters, `measure`, and seconds on one core by method.

    Near and far are the ids of the nearest letter and of the farthest; each is out of focus where the other is sharp.
    """
    first, last = experiment.settings.distances[0], experiment.settings.distances[-1]
    blurred = [
        find(measured["interference"], shape=shape, distance=distance)
        | find(measured["readings"], shape=shape, distance=distance)
        for shape, distance in ((near, last), (far, first))
    ]
    return [
        _pixel_counts(measured),
        _interference(blurred),
        _reduction(blurred),
        _similarity_to_rays(experiment, (first, last)),
        _interference_alone(blurred),
        *(_four_suffice(blurred, *reading) for reading in _FOUR),
        _separate(experiment, blurred),
        _literal(blurred),
        _speed(seconds),
        _price(seconds),
    ]


def timing_table(experiment: Experiment, seconds: dict[str, float]) -> list[dict[str, Any]]:
    """Return this package's seconds beside the paper's, with their ratio where the detectors are alike."""
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


def _pixel_counts(measured: dict[str, Any]) -> Claim:
    sizes = {tuple(row["bins"]) for row in measured["reconstructions"]}
    text = ", ".join(f"{columns} x {rows}" for columns, rows in sorted(sizes))
    return Claim(
        "Reconstructions by rays and by waves have the same number of pixels.",
        f"All methods: {text} bins.",
        BY_CONSTRUCTION,
        "One bin per microlens, because waves are summed over each bin here; they do carry detail finer than that.",
    )


def _interference(blurred: list[dict[str, Any]]) -> Claim:
    values = [row["coherent"] for row in blurred]
    visible = [value > _VISIBLE for value in values]
    return Claim(
        "Coherent propagation shows interference where the image is out of focus.",
        _percent(blurred, "coherent"),
        _verdict(visible),
        "Root mean square of the difference from the limit without interference between lenses, over its mean.",
    )


def _reduction(blurred: list[dict[str, Any]]) -> Claim:
    fractions = [row["partial"] / max(row["coherent"], 1e-9) for row in blurred]
    reduced = [fraction < _STRONGLY for fraction in fractions]
    return Claim(
        "Partially coherent propagation strongly reduces the interference.",
        f"{_percent(blurred, 'partial')} Left of the coherent one: "
        + " and ".join(f"{fraction:.0%}" for fraction in fractions)
        + ".",
        _verdict(reduced),
        f"Strongly means to less than {_STRONGLY:.0%}, in both letters. Not all goes: lenses of one subset still "
        "interfere.",
    )


def _similarity_to_rays(experiment: Experiment, distances: tuple[float, ...]) -> Claim:
    found = [
        tuple(
            image_metrics(experiment.images[method, distance], experiment.images["ray", distance])
            for method in ("partial", "coherent")
        )
        for distance in distances
    ]
    texts = [
        f"{partial.psnr:.1f} dB, SSIM {ssim_text(partial.ssim)} at {distance:g} mm, coherent {coherent.psnr:.1f} dB"
        for (partial, coherent), distance in zip(found, distances, strict=True)
    ]
    near = [
        partial.psnr > _NEAR_PSNR and (partial.ssim or 0) > _NEAR_SSIM and partial.psnr - coherent.psnr > _NEARER
        for partial, coherent in found
    ]
    return Claim(
        "The partially coherent image nearly equals that by rays.",
        "PSNR " + "; ".join(texts) + ".",
        _verdict(near),
        f"Nearly means above {_NEAR_PSNR:g} dB and an SSIM of {_NEAR_SSIM:g}, and by more than {_NEARER:g} dB nearer "
        "than the coherent image, which is near, too: most of each image is in what all methods share. The rays spread "
        "over what their lens sees.",
    )


def _interference_alone(blurred: list[dict[str, Any]]) -> Claim:
    alike = [row["limit_from_rays"] <= _VISIBLE for row in blurred]
    return Claim(
        "Apart from interference, reconstructions by waves and by rays do not differ.",
        f"Without interference: {_percent(blurred, 'limit_from_rays')} With it: "
        + " and ".join(f"{row['coherent_from_rays']:.1%}" for row in blurred)
        + ".",
        _verdict(alike),
        f"Root mean square of the difference from the image by rays, over its mean; up to {_VISIBLE:.0%} is not "
        "visible. What remains without interference is fine detail: on the way back, microlenses diffract it again.",
    )


# Column of the readings, statement, and remark.
_FOUR = (
    (
        "partial",
        "Four propagations, every second lens along each axis, suffice.",
        "Lenses of one subset are neighbours but one, and their images still overlap.",
    ),
    (
        "quarters",
        "Four propagations, one for each quarter of the array, suffice.",
        "Neighbours interfere as before; only lenses on both sides of a border do not.",
    ),
    (
        "sublattice",
        "Four propagations, of the four regular subsets that interfere least, suffice.",
        "Lenses of a subset are neighbours along one diagonal, whose fringes are finer than the bins.",
    ),
)


def _four_suffice(blurred: list[dict[str, Any]], reading: str, statement: str, remark: str) -> Claim:
    # Where nothing stood before, nothing needed to be removed.
    enough = [row[reading] < _ENOUGH and row["coherent"] > _VISIBLE for row in blurred]
    return Claim(
        statement,
        f"{_percent(blurred, reading)} Without subsets: "
        + " and ".join(f"{row['coherent']:.1%}" for row in blurred)
        + ".",
        _verdict(enough),
        f"Enough is what brings it below {_ENOUGH:.0%}. {remark}",
    )


def _separate(experiment: Experiment, blurred: list[dict[str, Any]]) -> Claim:
    camera, last = experiment.camera, blurred[0]["distance"]
    needed = math.ceil(camera.blur_diameter(last) / camera.mla_pitch)
    return Claim(
        "With four propagations the images of no two lit lenses of a subset overlap.",
        "A colouring of the lit lenses by the overlap of their images takes "
        + " and ".join(f"{row['colours']} subsets at {row['distance']:g} mm" for row in blurred)
        + ".",
        _verdict([row["colours"] <= 4 for row in blurred]),
        f"The paper's own condition. By the diameter of the blur alone it would take every {needed}th lens at "
        f"{last:g} mm, {needed * needed} propagations.",
    )


def _literal(blurred: list[dict[str, Any]]) -> Claim:
    left = [row["literal_partial"] / max(row["literal_coherent"], 1e-9) for row in blurred]
    alike = [
        row["literal_coherent"] > _VISIBLE and fraction < _STRONGLY for row, fraction in zip(blurred, left, strict=True)
    ]
    return Claim(
        "With a phase at the detector alone, as the paper writes it, interference and its reduction are as described.",
        f"{_percent(blurred, 'literal_coherent')} Left of it by every second lens: "
        + " and ".join(f"{fraction:.0%}" for fraction in left)
        + ".",
        _verdict(alike),
        "Relative to the limit without interference of the same procedure. All other verdicts let the microlenses act "
        "a second time on the way back.",
    )


def _verdict(holds: list[bool]) -> str:
    return CONFIRMED if all(holds) else PARTLY if any(holds) else DIFFERS


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
