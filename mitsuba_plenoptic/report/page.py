"""Reports of experiments and of calibrations: one HTML file with everything in it, to be opened from anywhere."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from PIL import Image

from .. import design
from ..io.checkpoints import write_json
from ..runtime.files import write_text
from ..runtime.limits import software
from .design_sheet import design_sheet
from .experiment import SLIDER_METHODS, TITLES, Experiment
from .images import Brightness, data_url, encoded, to_bytes
from .metrics import ssim_text
from .plots import Window, Zoom, lit_window

_EXPLANATIONS = {
    "truth": "Mitsuba's own thin-lens camera, focused at the distance",
    "ray": "each pixel is followed back as rays through its lens",
    "coherent": "one field, propagated back as if all light were coherent",
    "partial": "four subsets of lenses, each coherent in itself",
}


@dataclass(frozen=True)
class Claim:
    """A conclusion of the paper beside this package's results."""

    statement: str
    measured: str
    # ``confirmed``, ``partly`` or ``differs``; ``by construction`` where nothing could come out otherwise.
    verdict: str
    remark: str


@dataclass(frozen=True)
class Report:
    """Content of a report: tables, pictures and texts by section."""

    # Headline and the sentence under it.
    title: str
    lead: str
    experiment: Experiment
    measured: dict[str, Any]
    # Parts of the detector that a button leads to.
    zooms: Sequence[Zoom]
    # Captions of the figures by their files' names.
    plates: dict[str, str]
    # What makes the report again, without the folder.
    command: str
    # The paper's conclusions; none for other scenes.
    claims: Sequence[Claim] = field(default=())
    # Captions of the figures of an ordinary camera by their files' names; none without one.
    ordinary: Mapping[str, str] = field(default_factory=dict)
    # Rows as from `timing_table`; none for other scenes.
    timing: Sequence[dict[str, Any]] = field(default=())


def scene_name(scene: str) -> str:
    """Return the name of a scene in words, from its file or its built-in name."""
    return Path(scene).stem.replace("_", " ")


def write_report(folder: Path, report: Report) -> dict[str, Any]:
    """Write ``results.json`` and ``report.html`` into the folder that holds the figures; return the results."""
    experiment = report.experiment
    results = {
        "command": report.command,
        "settings": asdict(experiment.settings),
        "camera": experiment.camera.to_dict(),
        "software": software(),
        **report.measured,
        "timing": list(report.timing),
        "claims": [asdict(claim) for claim in report.claims],
        "stage_seconds": experiment.seconds,
    }
    write_json(folder / "results.json", results)
    camera, wavelength = experiment.camera, experiment.settings.wavelength
    window = lit_window([*experiment.truths.values(), experiment.pinhole], fraction=0.02, margin=0.03)
    page = template("page.html").render(
        report=report,
        experiment=experiment,
        measured=report.measured,
        titles=TITLES,
        explanations=_EXPLANATIONS,
        folder=folder.name,
        spot=design.spot_radius(camera, wavelength) / camera.pixel_size,
        pictures=captures(experiment, window),
        geometry=geometry(experiment, report.zooms, window),
        distances=shown_distances(experiment),
        screen=window.of(next(iter(experiment.truths.values()))).shape,
        refocus=reconstructions(experiment, report.measured, window),
        plates=[plate(folder / name, caption) for name, caption in report.plates.items()],
        ordinary=[plate(folder / name, caption) for name, caption in report.ordinary.items()],
        sheet=groupby(design_sheet(camera, wavelength), key=lambda row: row.group),
        warnings=design.design_warnings(camera, wavelength),
        facts=_facts(experiment, report.measured),
    )
    write_text(folder / "report.html", page)
    return results


def write_growing(folder: Path, plates: Mapping[str, str]) -> None:
    """Write ``report.html`` with the figures that are there so far, by their captions, unless a finished one is."""
    if not (folder / "results.json").exists():
        figures = [plate(folder / name, caption) for name, caption in plates.items()]
        write_text(folder / "report.html", template("growing.html").render(plates=figures))


def template(name: str, folder: Path = Path(__file__).parent / "templates") -> Template:
    """Return a page's template from a folder, by default the folder of the reports."""
    environment = Environment(
        loader=FileSystemLoader([folder, Path(__file__).parent / "templates"]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        # Quotation marks and apostrophes as in books.
        "prose": lambda text: re.sub(r'"(.*?)"', "“\\1”", text.replace("'", "\N{RIGHT SINGLE QUOTATION MARK}")),
        "number": format,
        # Two significant digits and no exponent.
        "ratio": lambda value: f"{float(f'{value:.2g}'):,.0f}" if value >= 10 else f"{value:.2g}",
        "first_upper": lambda text: text[:1].upper() + text[1:],
        "ssim": ssim_text,
    }
    return environment.get_template(name)


def time_summary(seconds: dict[str, float]) -> str:
    """Return a sentence on the total time of all stages and on the longest stage."""
    total = sum(seconds.values())
    longest = max(seconds, key=lambda name: seconds[name])
    return f"{total:.0f} s, of which {seconds[longest]:.0f} s for {longest.replace('_', ' ')}"


def _facts(experiment: Experiment, measured: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the settings and versions of an experiment as pairs of texts."""
    settings, against, points = experiment.settings, [], measured["captures"]["points"]
    if points is not None:
        apart = f"{points['relative_error']:.2%} (relative L2, with the noise of both), energy {points['energy']:.4f}"
        against = [(f"Wave capture against {settings.points} points per lens, each propagated by itself", apart)]
    return [
        ("Wavelength", f"{experiment.light} nm"),
        ("Samples per pixel, ray and wave capture", f"{settings.spp}"),
        *against,
        ("Samples per pixel, thin lens", f"{settings.truth_spp}"),
        ("Scene", settings.scene),
        *((("Camera instead of the scene's", settings.camera_name),) if settings.camera_name else ()),
        *((f"Scene parameter {name}", value) for name, value in sorted(settings.parameters.items())),
        ("Mitsuba variant", settings.variant),
        *(
            (f"Version of {name}", str(version))
            for name, version in sorted(experiment.wave.metadata.get("software", {}).items())
        ),
        ("Time", time_summary(experiment.seconds)),
    ]


# Bytes for one capture, so that the file stays below 12 MB; each WebP quality is tried until one fits.
_CAPTURE_BYTES = 3_500_000
_QUALITIES = (85, 70, 50, 30)


def captures(experiment: Experiment, window: Window) -> dict[str, str]:
    """Return the captures as pictures of bounded size, drawn on one scale."""
    ray, wave = (window.of(capture.image) for capture in (experiment.ray, experiment.wave))
    peak = float(np.quantile(ray[ray > 0.05 * ray.max()], 0.98)) if ray.max() > 0 else 1.0
    return {"ray": _webp(ray, peak), "wave": _webp(wave, peak)}


def geometry(experiment: Experiment, zooms: Sequence[Zoom], window: Window) -> dict[str, Any]:
    """Return the size of the capture's cut-out, and the positions of close-ups as fractions of it."""
    rows, columns = experiment.wave.image.shape[:2]
    height, width = window.of(experiment.wave.image).shape[:2]
    top, left = round(window.top * rows), round(window.left * columns)
    return {
        "width": width,
        "height": height,
        "pixel": experiment.camera.pixel_size,
        "regions": [
            {
                "x": ((zoom.columns.start + zoom.columns.stop) / 2 - left) / width,
                "y": ((zoom.rows.start + zoom.rows.stop) / 2 - top) / height,
                "size": (zoom.columns.stop - zoom.columns.start) / width,
            }
            for zoom in zooms
        ],
    }


def shown_distances(experiment: Experiment) -> list[float]:
    """Return the distances of the report's slider."""
    return sorted({*experiment.settings.slider, *experiment.settings.distances})


def reconstructions(experiment: Experiment, measured: dict[str, Any], window: Window) -> dict[str, Any]:
    """Return pictures by method and distance, with metrics where they are known."""
    distances = shown_distances(experiment)
    peak = Brightness().peak([window.of(experiment.truths[distance]) for distance in distances])
    facts: dict[str, dict[str, list[list[str]]]] = {}
    for row in measured["reconstructions"]:
        metrics = [
            ["PSNR", f"{row['psnr']:.1f} dB"],
            ["SSIM", ssim_text(row["ssim"])],
            ["Energy", f"{row['energy']:.3f}"],
        ]
        if "interference" in row:
            metrics.append(["Interference", f"{row['interference']:.1%}"])
        facts.setdefault(row["method"], {})[f"{row['distance']:g}"] = metrics

    def png(name: str, distance: float) -> str:
        shown = Image.fromarray(to_bytes(window.of(experiment.image(name, distance)), peak))
        return data_url("png", encoded(shown, format="PNG", optimize=True))

    return {
        "distances": [float(f"{distance:g}") for distance in distances],
        "images": {
            name: {f"{distance:g}": png(name, distance) for distance in distances}
            for name in ("truth", *SLIDER_METHODS)
        },
        "facts": facts,
    }


def plate(path: Path, caption: str) -> dict[str, Any]:
    """Return a figure's picture and caption as the page embeds them."""
    content = path.read_bytes()
    width, height = Image.open(io.BytesIO(content)).size
    return {"source": data_url("png", content), "width": width, "height": height, "caption": caption}


def _webp(image: np.ndarray, peak: float) -> str:
    picture = Image.fromarray(to_bytes(image, peak))
    content = b""
    for quality in _QUALITIES:
        content = encoded(picture, format="WEBP", quality=quality, method=4)
        if len(content) <= _CAPTURE_BYTES:
            break
    return data_url("webp", content)
