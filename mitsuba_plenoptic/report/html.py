"""The report: one HTML file with everything in it, pictures and program, to be opened from anywhere."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import groupby
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from PIL import Image

from .. import design
from ..io.files import atomic_output
from .claims import Claim
from .design_sheet import design_sheet
from .experiment import SLIDER_METHODS, TITLES, Experiment
from .figures import Window, Zoom, common_peak, lit_window
from .images import to_bytes

_FOLDER = Path(__file__).parent

# Bytes for one capture, so that the file stays below 12 MB; each step is tried until one fits.
_CAPTURE_BYTES = 3_500_000
_QUALITIES = (85, 70, 50, 30)

_EXPLAINED = {
    "truth": "Mitsuba's own thin-lens camera, focused at the distance",
    "ray": "each pixel is followed back as rays through its lens",
    "coherent": "one field, propagated back as if all light were coherent",
    "partial": "four subsets of lenses, each coherent in itself",
}


@dataclass(frozen=True)
class Page:
    """What the report tells.

    Attributes
    ----------
    title, lead : str
        Headline and the sentence under it.
    experiment : Experiment
        The images.
    numbers : dict
        What `measure` gave.
    zooms : sequence of Zoom
        Places on the detector that a button leads to.
    plates : sequence of (Path, str)
        Figures with their captions.
    command : str
        What makes the report again.
    seconds : str
        How long it took, in words.
    claims : sequence of Claim
        The paper's conclusions; none for other scenes.
    timing : sequence of dict
        Rows as from `timing_table`; none for other scenes.
    """

    title: str
    lead: str
    experiment: Experiment
    numbers: dict[str, Any]
    zooms: Sequence[Zoom]
    plates: Sequence[tuple[Path, str]]
    command: str
    seconds: str
    claims: Sequence[Claim] = field(default=())
    timing: Sequence[dict[str, Any]] = field(default=())


def write_page(path: Path, page: Page) -> None:
    """Write the report."""
    sections = [
        ("captures", "On the detector", _captures(page)),
        ("refocus", "Refocused", _refocus(page)),
        *([("claims", "The paper's conclusions", _claims(page))] if page.claims else []),
        *([("timing", "Time on one core", _timing(page))] if page.timing else []),
        ("numbers", "In numbers", _numbers(page)),
        ("figures", "Figures", _plates(page)),
        ("camera", "The camera", _camera(page)),
        ("again", "Make it again", _again(page)),
    ]
    template = Template((_FOLDER / "page.html").read_text())
    content = template.substitute(
        title=_text(page.title),
        lead=_text(page.lead),
        contents=" ".join(f'<a href="#{name}">{_text(title)}</a>' for name, title, _ in sections),
        sections="\n".join(
            f'<section id="{name}" aria-labelledby="{name}-title">\n'
            f'<h2 id="{name}-title">{_text(title)}</h2>\n{text}\n</section>'
            for name, title, text in sections
        ),
        footer=_text(
            "Scalar waves and thin elements; objects do not diffract. Lengths in millimetres. Pictures are sRGB."
        ),
        style=(_FOLDER / "page.css").read_text(),
        script=(_FOLDER / "page.js").read_text(),
        # Within a script element only this could end it.
        data=json.dumps(_data(page)).replace("</", "<\\/"),
    )
    with atomic_output(path) as temporary:
        temporary.write_text(content, encoding="utf-8")


def _window(experiment: Experiment) -> Window:
    return lit_window([*experiment.truths.values(), experiment.pinhole], share=0.02, margin=0.03)


def _captures(page: Page) -> str:
    experiment = page.experiment
    window = _window(experiment)
    ray, wave = (window.of(capture.image) for capture in (experiment.ray, experiment.wave))
    peak = float(np.quantile(ray[ray > 0.05 * ray.max()], 0.98)) if ray.max() > 0 else 1.0
    buttons = "".join(
        f'<button type="button" data-region="{i}">{_text(_capital(zoom.title))}</button>'
        for i, zoom in enumerate(page.zooms)
    )
    likeness = page.numbers["captures"]
    spot = design.spot_radius(experiment.camera, experiment.settings.wavelength) / experiment.camera.pixel_size
    return f"""
<p>Every disc is the aperture of the main lens as one microlens images it. Rays give it sharp edges, waves blur it by
diffraction at the microlens: {spot:.2g} pixels from the middle of a spot to its first zero. The two captures differ
by {likeness["relative_error"]:.0%} (root mean square, relative), {likeness["psnr"]:.1f} dB.</p>
<div class="viewer" id="viewer" tabindex="0" role="group" style="--aspect: {wave.shape[1]} / {wave.shape[0]}"
 aria-label="Detector image. Arrow keys move it, plus and minus zoom, 0 shows all of it.">
<div class="layer"><img alt="Detector image by waves" src="{_webp(wave, peak)}"></div>
<div class="layer upper"><img alt="Detector image by rays" src="{_webp(ray, peak)}"></div>
<div class="divider"></div>
<span class="tag left">Rays</span><span class="tag right">Waves</span>
<div class="ruler"><span></span><i></i></div>
</div>
<div class="controls">
<div class="swipe"><label for="swipe">Swipe</label>
<input type="range" id="swipe" min="0" max="100" value="50" step="0.5"
 aria-label="Share of the picture that shows rays, from the left, in per cent"></div>
<div class="buttons" role="group" aria-label="Zoom">
<button type="button" id="farther" aria-label="Zoom out">&minus;</button>
<button type="button" id="closer" aria-label="Zoom in">+</button>
<button type="button" id="whole">All</button>
{buttons}
</div>
</div>
<p class="hint">Drag to swipe, or, zoomed in, to move. With the picture in focus: arrow keys, + and &minus;, 0, mouse
wheel.</p>
"""


def _refocus(page: Page) -> str:
    experiment = page.experiment
    distances = _distances(experiment)
    start = distances.index(min(distances, key=lambda value: abs(value - experiment.settings.distances[0])))
    choices = "".join(
        f'<label class="choice"><input type="radio" name="method" value="{name}"'
        f"{' checked' if name == 'partial' else ''}>{_text(TITLES[name])}</label>"
        for name in ("truth", *SLIDER_METHODS)
    )
    explained = " ".join(f"<strong>{_text(TITLES[name])}</strong>: {text}." for name, text in _EXPLAINED.items())
    image = _window(experiment).of(experiment.truths[distances[start]])
    return f"""
<p>One bin per microlens, from the wave capture. {explained}</p>
<div class="refocus">
<figure class="screen"><img id="refocused" alt="" width="{image.shape[1]}" height="{image.shape[0]}"></figure>
<div>
<fieldset><legend>Method</legend>{choices}</fieldset>
<div class="distance"><label class="name" for="distance">Distance in focus</label>
<output id="distance-text" for="distance"></output></div>
<input type="range" id="distance" min="0" max="{len(distances) - 1}" value="{start}" step="1">
<div class="ends" aria-hidden="true"><span>{distances[0]:g} mm</span><span>{distances[-1]:g} mm</span></div>
<dl class="facts" id="facts"></dl>
</div>
</div>
"""


def _claims(page: Page) -> str:
    items = "".join(
        f'<li><span class="verdict {claim.verdict}">{claim.verdict}</span><div>'
        f'<p class="statement">{_text(claim.statement)}</p><p>{_text(claim.measured)}</p>'
        f'<p class="note">{_text(claim.remark)}</p></div></li>'
        for claim in page.claims
    )
    return f"<p>Each verdict is computed from the numbers beside it.</p>\n<ul class='claims'>{items}</ul>"


def _timing(page: Page) -> str:
    same = any(row["paper_over_ours"] is not None for row in page.timing)
    rows = [
        [
            TITLES[row["method"]],
            f"{row['seconds']:.3g}",
            f"{row['paper_seconds']:g}",
            *([_ratio(row["paper_over_ours"])] if same else []),
        ]
        for row in page.timing
    ]
    columns, lines = page.experiment.camera.resolution
    note = "" if same else f" This detector has {columns} x {lines} pixels and the paper's 4096 x 4096: no ratio."
    return (
        "<p>Seconds to reconstruct one distance on one processor core. The paper&rsquo;s core was one of about 2012: a "
        "part of the ratio is due to the machine.</p>"
        + _table(
            ["Method", "Seconds", "Paper", *(["Paper over ours"] if same else [])],
            rows,
            f"Ours: processor time, the shortest of three runs.{note}",
        )
    )


def _numbers(page: Page) -> str:
    rows, firsts = [], []
    by_distance = sorted(page.numbers["reconstructions"], key=lambda row: row["distance"])
    for _, group in groupby(by_distance, key=lambda row: row["distance"]):
        for index, row in enumerate(group):
            firsts.append(index == 0)
            rows.append(
                [
                    f"{row['distance']:g} mm" if index == 0 else "",
                    TITLES[row["method"]],
                    f"{row['psnr']:.1f}",
                    f"{row['ssim']:.3f}",
                    f"{row['energy']:.3f}",
                    f"{row['interference']:.1%}" if "interference" in row else "",
                ]
            )
    text = _table(
        ["Focus", "Method", "PSNR (dB)", "SSIM", "Energy", "Interference"],
        rows,
        "Reconstructions against the thin lens. PSNR and SSIM after one scale per method; energy before it: light that "
        "diffraction carries out of the aperture's image is left out of the reconstructions. "
        "Interference: distance from the limit in which no two lenses interfere, over all that is lit.",
        numbers_from=2,
        firsts=firsts,
    )
    blurred = [row for row in page.numbers["interference"] if row["shape_distance"] != row["distance"]]
    if page.claims and blurred:
        text += _table(
            ["Letter", "Focus", TITLES["coherent"], TITLES["partial"]],
            [
                [
                    f"at {row['shape_distance']:g} mm",
                    f"{row['distance']:g} mm",
                    f"{row['coherent']:.1%}",
                    f"{row['partial']:.1%}",
                ]
                for row in blurred
            ],
            "Interference within each letter that is out of focus.",
        )
    if page.numbers["edges"]:
        text += _table(
            ["Edge", "Method", "10 to 90 % (mm)", "MTF50 (1/mm)"],
            [
                [
                    f"{row['distance']:g} mm",
                    TITLES[row["method"]],
                    f"{row['width_mm']:.3f}",
                    f"{row['mtf50_per_mm']:.2f}",
                ]
                for row in page.numbers["edges"]
            ],
            "Slanted edges in focus, after ISO 12233: width in the object's plane and the frequency at half contrast.",
            numbers_from=2,
        )
    return text


def _plates(page: Page) -> str:
    figures = []
    for path, caption in page.plates:
        content = path.read_bytes()
        width, height = Image.open(io.BytesIO(content)).size
        figures.append(
            f'<figure class="plate"><img alt="{_text(caption)}" width="{width}" height="{height}" '
            f'src="data:image/png;base64,{base64.b64encode(content).decode()}">'
            f"<figcaption>{_text(caption)}</figcaption></figure>"
        )
    return "".join(figures)


def _camera(page: Page) -> str:
    camera, wavelength = page.experiment.camera, page.experiment.settings.wavelength
    tables = []
    for group, members in groupby(design_sheet(camera, wavelength), key=lambda row: row.group):
        lines = "".join(
            f'<tr><th scope="row">{_text(row.quantity)}'
            + (f'<br><span class="note">{_text(row.note)}</span>' if row.note else "")
            + f'</th><td class="number">{_text(f"{row.value} {row.unit}".strip())}</td></tr>'
            for row in members
        )
        tables.append(f"<table><caption>{_text(group)}</caption><tbody>{lines}</tbody></table>")
    warnings = "".join(
        f'<p class="warning">{_text(_capital(text))}.</p>' for text in design.design_warnings(camera, wavelength)
    )
    return f'{warnings}<div class="sheet">{"".join(tables)}</div>'


def _again(page: Page) -> str:
    settings = page.experiment.settings
    rows = [
        ["Wavelength", f"{settings.wavelength:g} nm"],
        ["Radiators per lens, wave capture", f"{settings.radiators_per_lens} x {settings.radiators_per_lens}"],
        ["Light paths per radiator", f"{settings.paths}"],
        ["Samples per pixel, ray capture", f"{settings.spp}"],
        ["Samples per pixel, thin lens", f"{settings.truth_spp}"],
        ["Scene", settings.scene],
        *[[f"Scene parameter {name}", value] for name, value in sorted(settings.parameters.items())],
        ["Mitsuba variant", settings.variant],
        *[
            [f"Version of {name}", str(version)]
            for name, version in sorted(page.experiment.wave.metadata.get("software", {}).items())
        ],
        ["Time", page.seconds],
    ]
    return (
        f"<pre><code>{_text(page.command)}</code></pre>"
        "<p>Captures and reconstructions lie beside this file as OpenEXR, in <code>data/</code>, and all numbers in "
        "<code>results.json</code>. What is there and still valid is not computed again.</p>"
        + _table(["Setting", "Value"], rows, "", numbers_from=2)
    )


def _data(page: Page) -> dict[str, Any]:
    experiment = page.experiment
    window = _window(experiment)
    distances = _distances(experiment)
    shown = {"truth": experiment.truths} | {
        name: {distance: experiment.images[name, distance] for distance in distances} for name in SLIDER_METHODS
    }
    peak = common_peak([experiment.truths[distance] for distance in distances], window)
    facts: dict[str, dict[str, list[list[str]]]] = {}
    for row in page.numbers["reconstructions"]:
        told = [["PSNR", f"{row['psnr']:.1f} dB"], ["SSIM", f"{row['ssim']:.3f}"], ["Energy", f"{row['energy']:.3f}"]]
        if "interference" in row:
            told.append(["Interference", f"{row['interference']:.1%}"])
        facts.setdefault(row["method"], {})[f"{row['distance']:g}"] = told
    return {
        "capture": _geometry(experiment, page.zooms, window),
        "refocus": {
            "distances": [float(f"{distance:g}") for distance in distances],
            "images": {
                name: {f"{distance:g}": _png(window.of(images[distance]), peak) for distance in distances}
                for name, images in shown.items()
            },
            "facts": facts,
        },
    }


def _geometry(experiment: Experiment, zooms: Sequence[Zoom], window: Window) -> dict[str, Any]:
    """Size of the capture's cut-out, and the places to zoom to in fractions of it."""
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


def _distances(experiment: Experiment) -> list[float]:
    return sorted({*experiment.settings.slider, *experiment.settings.distances})


def _table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    caption: str,
    *,
    numbers_from: int = 1,
    firsts: Sequence[bool] | None = None,
) -> str:
    """Lay out a table that scrolls by itself where the page is narrow."""

    def cell(tag: str, index: int, text: str, scope: str = "") -> str:
        kind = ' class="number"' if index >= numbers_from else ""
        return f"<{tag}{kind}{scope}>{_text(text)}</{tag}>"

    top = "".join(cell("th", i, text, ' scope="col"') for i, text in enumerate(head))
    body = "".join(
        ("<tr class='first'>" if firsts and firsts[n] else "<tr>")
        + "".join(cell("td", i, text) for i, text in enumerate(row))
        + "</tr>"
        for n, row in enumerate(rows)
    )
    name = _text(caption or head[0])
    told = f"<caption>{_text(caption)}</caption>" if caption else ""
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{name}"><table>{told}'
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _webp(image: np.ndarray, peak: float) -> str:
    """Encode a capture as WebP of bounded size."""
    picture = Image.fromarray(to_bytes(image, peak))
    content = b""
    for quality in _QUALITIES:
        buffer = io.BytesIO()
        picture.save(buffer, format="WEBP", quality=quality, method=4)
        content = buffer.getvalue()
        if len(content) <= _CAPTURE_BYTES:
            break
    return f"data:image/webp;base64,{base64.b64encode(content).decode()}"


def _png(image: np.ndarray, peak: float) -> str:
    buffer = io.BytesIO()
    Image.fromarray(to_bytes(image, peak)).save(buffer, format="PNG", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _ratio(value: float) -> str:
    """Write a ratio with two digits that mean something and no exponent."""
    return f"{float(f'{value:.2g}'):,.0f}" if value >= 10 else f"{value:.2g}"


def _text(text: str) -> str:
    """Escape text for HTML, with typographic quotation marks."""
    return re.sub(r"&quot;(.*?)&quot;", r"&ldquo;\1&rdquo;", escape(text).replace("&#x27;", "&rsquo;"))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
