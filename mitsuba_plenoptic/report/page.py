"""Reports of experiments and of calibrations: one HTML file with everything in it, to be opened from anywhere."""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from PIL import Image

from .. import design
from ..calibration import Board, Calibration, ResidualMap, Table, residual_map
from ..calibration.model import UNITS
from ..calibration.observations import placed
from ..calibration.result import field_cells, group_means
from ..io.files import write_text
from .design_sheet import design_sheet
from .experiment import SLIDER_METHODS, TITLES, Experiment
from .framing import Window, Zoom, lit_window
from .images import Brightness, to_bytes
from .metrics import ssim_text
from .stage_store import software, time_summary, write_json

_EXPLANATIONS = {
    "truth": "Mitsuba's own thin-lens camera, focused at the distance",
    "ray": "each pixel is followed back as rays through its lens",
    "coherent": "one field, propagated back as if all light were coherent",
    "partial": "four subsets of lenses, each coherent in itself",
}


@dataclass(frozen=True)
class Claim:
    """A conclusion of the paper next to our results."""

    statement: str
    measured: str
    # ``confirmed``, ``partly`` or ``differs``; ``by construction`` where nothing could come out otherwise.
    verdict: str
    remark: str


@dataclass(frozen=True)
class Report:
    """The content of a report."""

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
    write_text(folder / "report.html", _page(folder, report))
    return results


def template(name: str) -> Template:
    """Load a page's template."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "prose": _prose,
        "number": format,
        "ratio": _ratio,
        "first_upper": lambda text: text[:1].upper() + text[1:],
        "ssim": ssim_text,
    }
    return environment.get_template(name)


def _prose(text: str) -> str:
    """Set quotation marks and apostrophes as books do."""
    return re.sub(r'"(.*?)"', "“\\1”", text.replace("'", "\N{RIGHT SINGLE QUOTATION MARK}"))


def _ratio(value: float) -> str:
    """Write a ratio with two significant digits and no exponent."""
    return f"{float(f'{value:.2g}'):,.0f}" if value >= 10 else f"{value:.2g}"


def _page(folder: Path, report: Report) -> str:
    experiment = report.experiment
    camera, wavelength = experiment.camera, experiment.settings.wavelength
    window = lit_window([*experiment.truths.values(), experiment.pinhole], fraction=0.02, margin=0.03)
    return template("page.html").render(
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
        sheet=groupby(design_sheet(camera, wavelength), key=lambda row: row.group),
        warnings=design.design_warnings(camera, wavelength),
        facts=_facts(experiment, report.measured),
    )


def _facts(experiment: Experiment, measured: dict[str, Any]) -> list[tuple[str, str]]:
    """List what the experiment was made with."""
    settings = experiment.settings
    return [
        ("Wavelength", f"{settings.wavelength:g} nm"),
        ("Samples per pixel, ray and wave capture", f"{settings.spp}"),
        *_points(settings.points, measured["captures"]["points"]),
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


def _points(count: int | None, found: dict[str, float] | None) -> list[tuple[str, str]]:
    """State how far the wave capture is from that of points."""
    if found is None:
        return []
    apart = f"{found['relative_error']:.2%} (relative L2, with the noise of both), energy {found['energy']:.4f}"
    return [(f"Wave capture against {count} points per lens, each propagated by itself", apart)]


# Bytes for one capture, so that the file stays below 12 MB; each WebP quality is tried until one fits.
_CAPTURE_BYTES = 3_500_000
_QUALITIES = (85, 70, 50, 30)


def captures(experiment: Experiment, window: Window) -> dict[str, str]:
    """Encode the captures, of one scale, as pictures of bounded size."""
    ray, wave = (window.of(capture.image) for capture in (experiment.ray, experiment.wave))
    peak = float(np.quantile(ray[ray > 0.05 * ray.max()], 0.98)) if ray.max() > 0 else 1.0
    return {"ray": _webp(ray, peak), "wave": _webp(wave, peak)}


def geometry(experiment: Experiment, zooms: Sequence[Zoom], window: Window) -> dict[str, Any]:
    """Return the size of the capture's cut-out, and the positions to zoom to in fractions of it."""
    rows, columns = experiment.wave.image.shape
    height, width = window.of(experiment.wave.image).shape
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
    """List the distances of the slider."""
    return sorted({*experiment.settings.slider, *experiment.settings.distances})


def reconstructions(experiment: Experiment, measured: dict[str, Any], window: Window) -> dict[str, Any]:
    """Return pictures by method and distance, with the metrics of those that have some."""
    distances = shown_distances(experiment)
    peak = Brightness().white([window.of(experiment.truths[distance]) for distance in distances])
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
    return {
        "distances": [float(f"{distance:g}") for distance in distances],
        "images": {
            name: {f"{distance:g}": _png(window.of(experiment.image(name, distance)), peak) for distance in distances}
            for name in ("truth", *SLIDER_METHODS)
        },
        "facts": facts,
    }


def plate(path: Path, caption: str) -> dict[str, Any]:
    """Take a figure into the page."""
    content = path.read_bytes()
    width, height = Image.open(io.BytesIO(content)).size
    return {"source": _data_url("png", content), "width": width, "height": height, "caption": caption}


def _webp(image: np.ndarray, peak: float) -> str:
    picture = Image.fromarray(to_bytes(image, peak))
    content = b""
    for quality in _QUALITIES:
        content = _encoded(picture, format="WEBP", quality=quality, method=4)
        if len(content) <= _CAPTURE_BYTES:
            break
    return _data_url("webp", content)


def _png(image: np.ndarray, peak: float) -> str:
    return _data_url("png", _encoded(Image.fromarray(to_bytes(image, peak)), format="PNG", optimize=True))


def _encoded(picture: Image.Image, **options: Any) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, **options)
    return buffer.getvalue()


def _data_url(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


# Cells across the detector of which the mean residual is drawn, and how much it is enlarged there.
_CELLS = 24
_ENLARGED = 100

# Parts of which the residuals by field and by depth are listed.
_PARTS = 6

_WIDTH = 760
"""Width of the drawings."""


def write_calibration_report(
    path: str | Path, calibration: Calibration, board: Board, corners: Table, centres: Table | None
) -> None:
    """Write the report on a calibration."""
    size, seen = calibration.camera.crop_size, calibration.evaluation
    outliers = seen.outliers
    lens = residual_map(calibration, board, corners, "lens", 1)
    # Rows far off would hide in means what the others show.
    calibration = replace(calibration, evaluation=seen.without_outliers())
    corners = corners.keep(np.delete(np.arange(len(seen.residuals)), outliers))
    field, depth = (
        residual_map(calibration, board, corners, by, parts) for by, parts in (("field", _CELLS), ("depth", _PARTS))
    )
    maps = [("Corners", _arrows(field.key, field.mean, size))]
    if centres is not None:
        used = np.delete(np.arange(len(centres.pixel)), calibration.centre_outliers)
        middle, cell = field_cells(centres.pixel[used], size[0] / _CELLS)
        means = group_means(-calibration.centre_residuals[used], cell)[1]
        maps.append(("Centres of micro-images", _arrows(middle, means, size)))
    radius = np.hypot(*(corners.pixel - (np.array(size) - 1) / 2).T)
    page = template("calibration.html").render(
        calibration=calibration,
        seen=seen,
        outliers=outliers + 2,
        outliers_by_frame=np.bincount(seen.pose[outliers], minlength=len(seen.frames)).tolist(),
        units=UNITS,
        weak=calibration.weak_directions(),
        maps=maps,
        width=_WIDTH,
        height=round(_WIDTH * size[1] / size[0]),
        enlarged=_ENLARGED,
        tables=[
            ("Pixels from the detector's centre", _by(radius, calibration.evaluation.residuals)),
            ("Distance of the corner, mm", [*zip(*depth.key.T, depth.count, depth.error, strict=True)]),
        ],
        lenses=_lenses(lens, size),
        worst=float(lens.error.max()),
        boards=_boards(calibration, board),
    )
    write_text(path, page, ".html")


def _arrows(middle: np.ndarray, mean: np.ndarray, size: Sequence[int]) -> list[tuple[float, float, float, float]]:
    """Return mean residuals as lines from the middle of their cell of the detector, in the drawing's units."""
    lines = np.concatenate([middle + 0.5, middle + 0.5 + _ENLARGED * mean], axis=1) * (_WIDTH / size[0])
    return [tuple(line) for line in lines.round(1).tolist()]


def _lenses(lens: ResidualMap, size: Sequence[int]) -> list[tuple[float, float, float]]:
    """Return each lens's position and darkness: its error over the 95 % quantile of all."""
    position = (lens.key[:, 2:] + 0.5) * (_WIDTH / size[0])
    dark = (lens.error / max(float(np.quantile(lens.error, 0.95)), 1e-12)).clip(0.05, 1)
    return [tuple(mark) for mark in np.column_stack([position.round(1), dark.round(2)]).tolist()]


def _by(quantity: np.ndarray, residuals: np.ndarray) -> list[tuple[float, float, int, float]]:
    """Return ranges of a quantity with as many observations each, and the RMS residual in them."""
    squares = (residuals**2).sum(1)
    return [
        (float(quantity[part[0]]), float(quantity[part[-1]]), len(part), math.sqrt(squares[part].mean()))
        for part in np.array_split(np.argsort(quantity), _PARTS)
        if len(part)
    ]


def _boards(calibration: Calibration, board: Board) -> list[dict[str, Any]]:
    """Draw the boards obliquely from the side, with the camera at the left end of the axis."""
    width, height = (board.columns - 1) * board.square, (board.rows - 1) * board.square
    outline = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    seen = calibration.evaluation
    outlines = [placed(outline, pose[None], np.zeros(len(outline), dtype=int)) for pose in seen.poses]
    scale = (_WIDTH - 40) / max((corner[:, 2] + 0.35 * np.abs(corner[:, 0])).max() for corner in outlines)
    drawings = []
    for frame, corner in zip(seen.frames, outlines, strict=True):
        # Oblique: depth to the right, x towards the reader.
        across = 20 + scale * (corner[:, 2] + 0.35 * corner[:, 0])
        down = 150 - scale * (corner[:, 1] - 0.35 * corner[:, 0])
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))
        drawings.append({"frame": int(frame), "points": points, "x": round(across[0], 1), "y": round(down[0], 1)})
    return drawings
