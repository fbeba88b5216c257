"""The report: all numbers as JSON, and one HTML file with everything in it, to be opened from anywhere."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from ... import design
from ...io.files import atomic_output
from ..claims import Claim
from ..design_sheet import design_sheet
from ..experiment import TITLES, Experiment
from ..framing import Zoom
from ..metrics import ssim_text
from ..stage_store import software, time_summary, write_json
from .pictures import captures, geometry, plate, reconstructions, report_window, shown_distances

_EXPLANATIONS = {
    "truth": "Mitsuba's own thin-lens camera, focused at the distance",
    "ray": "each pixel is followed back as rays through its lens",
    "coherent": "one field, propagated back as if all light were coherent",
    "partial": "four subsets of lenses, each coherent in itself",
}


@dataclass(frozen=True)
class Report:
    """What a report shows."""

    # Headline and the sentence under it.
    title: str
    lead: str
    experiment: Experiment
    numbers: dict[str, Any]
    # Places on the detector that a button leads to.
    zooms: Sequence[Zoom]
    # Captions of the figures by their files' names.
    plates: dict[str, str]
    # What makes the report again, without the folder.
    command: str
    # The paper's conclusions; none for other scenes.
    claims: Sequence[Claim] = field(default=())
    # Rows as from `timing_table`; none for other scenes.
    timing: Sequence[dict[str, Any]] = field(default=())


def write_report(folder: Path, report: Report) -> dict[str, Any]:
    """Write ``results.json`` and ``report.html`` into the folder that holds the figures; return the results."""
    experiment = report.experiment
    results = {
        "command": report.command,
        "settings": asdict(experiment.settings),
        "camera": experiment.camera.to_dict(),
        "software": software(),
        **report.numbers,
        "timing": list(report.timing),
        "claims": [asdict(claim) for claim in report.claims],
        "stage_seconds": experiment.seconds,
    }
    write_json(folder / "results.json", results)
    with atomic_output(folder / "report.html") as temporary:
        temporary.write_text(_page(folder, report), encoding="utf-8")
    return results


def _page(folder: Path, report: Report) -> str:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "prose": _prose,
        "number": format,
        "ratio": _ratio,
        "first_upper": _first_upper,
        "ssim": ssim_text,
    }
    experiment = report.experiment
    camera, wavelength = experiment.camera, experiment.settings.wavelength
    window = report_window(experiment)
    return environment.get_template("page.html").render(
        report=report,
        experiment=experiment,
        numbers=report.numbers,
        titles=TITLES,
        explanations=_EXPLANATIONS,
        folder=folder.name,
        spot=design.spot_radius(camera, wavelength) / camera.pixel_size,
        pictures=captures(experiment, window),
        geometry=geometry(experiment, report.zooms, window),
        distances=shown_distances(experiment),
        screen=window.of(next(iter(experiment.truths.values()))).shape,
        refocus=reconstructions(experiment, report.numbers, window),
        plates=[plate(folder / name, caption) for name, caption in report.plates.items()],
        sheet=groupby(design_sheet(camera, wavelength), key=lambda row: row.group),
        warnings=design.design_warnings(camera, wavelength),
        facts=_facts(experiment, report.numbers),
    )


def _facts(experiment: Experiment, numbers: dict[str, Any]) -> list[tuple[str, str]]:
    """List what the experiment was made with."""
    settings = experiment.settings
    return [
        ("Wavelength", f"{settings.wavelength:g} nm"),
        ("Samples per pixel, ray and wave capture", f"{settings.spp}"),
        *_points(settings.points, numbers["captures"]["points"]),
        ("Samples per pixel, thin lens", f"{settings.truth_spp}"),
        ("Scene", settings.scene),
        *((f"Scene parameter {name}", value) for name, value in sorted(settings.parameters.items())),
        ("Mitsuba variant", settings.variant),
        *(
            (f"Version of {name}", str(version))
            for name, version in sorted(experiment.wave.metadata.get("software", {}).items())
        ),
        ("Time", time_summary(experiment.seconds)),
    ]


def _points(count: int | None, found: dict[str, float] | None) -> list[tuple[str, str]]:
    """State how far the wave capture is from that of points."""
    if found is None:
        return []
    apart = f"{found['relative_error']:.2%} (relative L2, with the noise of both), energy {found['energy']:.4f}"
    return [(f"Wave capture against {count} points per lens, each propagated by itself", apart)]


def _prose(text: str) -> str:
    """Set quotation marks and apostrophes as books do."""
    return re.sub(r'"(.*?)"', "“\\1”", text.replace("'", "\N{RIGHT SINGLE QUOTATION MARK}"))


def _ratio(value: float) -> str:
    """Write a ratio with two digits that mean something and no exponent."""
    return f"{float(f'{value:.2g}'):,.0f}" if value >= 10 else f"{value:.2g}"


def _first_upper(text: str) -> str:
    """Begin with a capital, and leave the rest as it is."""
    return text[:1].upper() + text[1:]
