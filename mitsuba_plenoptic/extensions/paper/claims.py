"""The paper's conclusions, each with a verdict computed from this package's results."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from ...report import METHOD_TITLES, Experiment, metrics, pages
from ...runtime import Named

CONFIRMED = "confirmed"
PARTLY = "partly"
DIFFERS = "differs"

# Seconds on one core of about 2012, for 4096 x 4096 pixels.
PAPER_SECONDS = {"ray": 330.0, "coherent": 65.0, "partial": 195.0}
PAPER_RESOLUTION = (4096, 4096)

# Interference that an eye finds in an even grey: about one part in fifty.
_VISIBLE = 0.02

# What is left of interference that is strongly reduced, at most.
_STRONGLY = 0.5

# Four subsets by their column of the readings, with the lenses in them, and a remark.
_FOUR = {
    "partial": (
        "every second lens along each axis",
        "Lenses of one subset are neighbours but one, and their images still overlap.",
    ),
    "quarters": (
        "one for each quarter of the array",
        "Neighbours interfere as before; only lenses on both sides of a border do not.",
    ),
    "sublattice": (
        "of the four regular subsets that interfere least",
        "Lenses of a subset are neighbours along one diagonal, whose fringes are finer than the bins.",
    ),
}


@dataclass(frozen=True)
class Claim:
    """A conclusion of the paper beside this package's results."""

    statement: str
    measured: str
    # ``confirmed``, ``partly`` or ``differs``; ``by construction`` where nothing could come out otherwise.
    verdict: str
    remark: str


def claims_section(claims: Sequence[Claim], measured: Named) -> pages.Section:
    """Return the part of the report with the conclusions, and the interference that they rest on."""
    texts = Markup('<div><p class="statement">{}</p><p>{}</p><p class="note">{}</p></div>')
    items = [
        Markup('<li><span class="verdict {}">{}</span>{}</li>').format(
            claim.verdict.replace(" ", "-"),
            claim.verdict,
            texts.format(pages.prose(claim.statement), pages.prose(claim.measured), pages.prose(claim.remark)),
        )
        for claim in claims
    ]
    columns = {
        "Letter": "at {shape_distance:g} mm",
        "Focus": "{distance:g} mm",
        METHOD_TITLES["coherent"]: "{coherent:.1%}",
        METHOD_TITLES["partial"]: "{partial:.1%}",
    }
    blurred = [row for row in measured["interference"] if row["shape_distance"] != row["distance"]]
    return pages.Section(
        "The paper's conclusions",
        [
            "Each verdict is computed from the results next to it.",
            Markup('<ul class="claims">{}</ul>').format(Markup("").join(items)),
            pages.Table(columns, blurred, "Interference within each letter that is out of focus."),
        ],
    )


def check_claims(
    experiment: Experiment, measured: Named, seconds: dict[str, float] | None, near: str, far: str
) -> list[Claim]:
    """Return verdicts on the paper's conclusions, from the letters, `measure`, and seconds on one core by method.

    Without seconds the conclusions on time are left out.

    Near and far are the ids of the nearest letter and of the farthest; each is out of focus where the other is sharp.
    """
    first = experiment.settings.distances[0]
    last = experiment.settings.distances[-1]
    blurred = [
        _row(measured["interference"], shape=shape, distance=distance)
        | _row(measured["readings"], shape=shape, distance=distance)
        for shape, distance in ((near, last), (far, first))
    ]
    sizes = {tuple(row["bins"]) for row in measured["reconstructions"]}
    bins = ", ".join(f"{columns} x {rows}" for columns, rows in sorted(sizes))
    left = [row["partial"] / max(row["coherent"], 1e-9) for row in blurred]
    literal_left = [row["literal_partial"] / max(row["literal_coherent"], 1e-9) for row in blurred]
    needed = math.ceil(experiment.camera.blur_diameter(last) / experiment.camera.row_pitch)
    subsets = " and ".join(f"{row['colours']} subsets at {row['distance']:g} mm" for row in blurred)
    texts = []
    alike = []
    for distance in (first, last):
        partial, coherent = (
            metrics.image_metrics(experiment.images[method, distance], experiment.images["ray", distance])
            for method in ("partial", "coherent")
        )
        ssim = metrics.ssim_text(partial.ssim)
        texts.append(f"{partial.psnr:.1f} dB, SSIM {ssim} at {distance:g} mm, coherent {coherent.psnr:.1f} dB")
        alike.append(partial.psnr > max(30.0, coherent.psnr + 3.0) and (partial.ssim or 0) > 0.95)
    return [
        Claim(
            "Reconstructions by rays and by waves have the same number of pixels.",
            f"All methods: {bins} bins.",
            "by construction",
            "One bin per microlens, because waves are summed over each bin here; they do carry detail finer than that.",
        ),
        Claim(
            "Coherent propagation shows interference where the image is out of focus.",
            _in_letters(blurred, "coherent"),
            verdict([row["coherent"] > _VISIBLE for row in blurred]),
            "Root mean square of the difference from the limit without interference between lenses, over its mean.",
        ),
        Claim(
            "Partially coherent propagation strongly reduces the interference.",
            f"{_in_letters(blurred, 'partial')} Left of the coherent one: {_both(left, '.0%')}.",
            verdict([fraction < _STRONGLY for fraction in left]),
            f"Strongly means to less than {_STRONGLY:.0%}, in both letters. Not all goes: lenses of one subset still "
            "interfere.",
        ),
        Claim(
            "The partially coherent image nearly equals that by rays.",
            f"PSNR {'; '.join(texts)}.",
            verdict(alike),
            "Nearly means above 30 dB and an SSIM of 0.95, and by more than 3 dB nearer "
            "than the coherent image, which is near, too: most of each image is in what all methods share. The rays "
            "spread over what their lens sees.",
        ),
        Claim(
            "Apart from interference, reconstructions by waves and by rays do not differ.",
            f"Without interference: {_in_letters(blurred, 'limit_from_rays')} With it: "
            f"{_both([row['coherent_from_rays'] for row in blurred])}.",
            verdict([row["limit_from_rays"] <= _VISIBLE for row in blurred]),
            f"Root mean square of the difference from the image by rays, over its mean; up to {_VISIBLE:.0%} is not "
            "visible. What remains without interference is fine detail: on the way back, microlenses diffract it "
            "again.",
        ),
        *(
            Claim(
                f"Four propagations, {lenses}, suffice.",
                f"{_in_letters(blurred, reading)} Without subsets: {_both([row['coherent'] for row in blurred])}.",
                # Where nothing stood before, nothing needed to be removed.
                verdict([row[reading] < 0.01 and row["coherent"] > _VISIBLE for row in blurred]),
                f"Enough is what brings it below 1%. {remark}",
            )
            for reading, (lenses, remark) in _FOUR.items()
        ),
        Claim(
            "With four propagations the images of no two lit lenses of a subset overlap.",
            f"A colouring of the lit lenses by the overlap of their images takes {subsets}.",
            verdict([row["colours"] <= 4 for row in blurred]),
            f"The paper's own condition. By the diameter of the blur alone it would take every {needed}th lens at "
            f"{last:g} mm, {needed * needed} propagations.",
        ),
        Claim(
            "With a phase at the detector alone, as the paper writes it, interference and its reduction are as "
            "described.",
            f"{_in_letters(blurred, 'literal_coherent')} Left of it by every second lens: "
            f"{_both(literal_left, '.0%')}.",
            verdict(
                [
                    row["literal_coherent"] > _VISIBLE and fraction < _STRONGLY
                    for row, fraction in zip(blurred, literal_left, strict=True)
                ]
            ),
            "Relative to the limit without interference of the same procedure. All other verdicts let the microlenses "
            "act a second time on the way back.",
        ),
        *(_times(seconds) if seconds else ()),
    ]


def timing_table(experiment: Experiment, seconds: dict[str, float]) -> list[Named]:
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


def timing_section(experiment: Experiment, rows: Sequence[Named]) -> pages.Section:
    """Return the part of the report with the rows of `timing_table`."""
    columns = {"Method": "{title}", "Seconds": "{seconds:.3g}", "Paper": "{paper_seconds:g}"}
    caption = "Ours: processor time, the shorter of two runs."
    records = [row | {"title": METHOD_TITLES[row["method"]]} for row in rows]
    if experiment.camera.resolution == PAPER_RESOLUTION:
        columns["Paper over ours"] = "{ratio}"
        for row in records:
            # Two significant digits, without an exponent.
            value = row["paper_over_ours"]
            row["ratio"] = f"{float(f'{value:.2g}'):,.0f}" if value >= 10 else f"{value:.2g}"
    else:
        size = "{} x {}".format(*experiment.camera.resolution)
        caption += f" This detector has {size} pixels and the paper's 4096 x 4096: no ratio."
    text = (
        "Seconds of a processor core to reconstruct one distance. The paper's core was one of about 2012: a part of "
        "the ratio is due to the machine."
    )
    return pages.Section("Time on one core", [text, pages.Table(columns, records, caption)])


def verdict(holds: list[bool]) -> str:
    """Return the verdict on a statement that holds in some of several cases."""
    return CONFIRMED if all(holds) else PARTLY if any(holds) else DIFFERS


def _times(seconds: dict[str, float]) -> list[Claim]:
    texts = {name: f"{value:.2g} s" if value < 10 else f"{value:.0f} s" for name, value in seconds.items()}
    slower = seconds["coherent"] / seconds["ray"]
    longer = seconds["partial"] / seconds["coherent"]
    ratio = f"rays are {slower:.0f} times faster" if slower > 1 else f"waves are {1 / slower:.1f} times faster"
    return [
        Claim(
            "Reconstruction by waves is faster than by rays: 65 s against 330 s.",
            f"Coherent {texts['coherent']}, rays {texts['ray']}: {ratio}.",
            CONFIRMED if slower < 1 else DIFFERS,
            "One ray a pixel, as here, is a sum over the pixels. The paper does not say how its rays were followed; "
            "how long they take is a matter of the program, not of the method.",
        ),
        Claim(
            "Partially coherent propagation takes four propagations: 195 s against 65 s.",
            f"{texts['partial']} against {texts['coherent']}: {longer:.1f} times as long.",
            CONFIRMED if 2 < longer < 4.5 else DIFFERS,
            "The paper's own ratio, 195/65, is 3 and not 4: part of its work seems to have been done once for all "
            "subsets.",
        ),
    ]


def _in_letters(rows: list[Named], reading: str) -> str:
    values = (
        f"{row[reading]:.1%} in the letter at {row['shape_distance']:g} mm refocused to {row['distance']:g} mm"
        for row in rows
    )
    return f"{' and '.join(values)}."


def _both(values: list[float], form: str = ".1%") -> str:
    return " and ".join(format(value, form) for value in values)


def _row(rows: list[Named], **values: Any) -> Named:
    """Return the first row of a table that has the given values."""
    return next(row for row in rows if all(row[name] == value for name, value in values.items()))
