"""The page of a comparison of rays and waves: captures to swipe between, images to refocus, numbers and figures."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from .. import design
from ..io import write_json
from ..runtime import Array, Facts, Named, software
from .experiment import METHOD_TITLES, Experiment
from .images import Brightness, data_url, encoded, to_bytes
from .metrics import ssim_text
from .pages import Block, Page, Section, Table, pictures_in, template
from .plots import distance_text
from .sheet import sheet_tables
from .windows import Window, Zoom, lit_window

ANSWER = "answer.png"
"""Name of the figure beside the answer."""


def write_report(
    folder: Path,
    title: str,
    lead: str,
    experiment: Experiment,
    measured: Facts,
    *,
    zooms: Sequence[Zoom],
    plates: Mapping[str, str],
    command: str,
    others: Sequence[Section],
) -> Named:
    """Write ``results.json`` and ``report.html`` into the folder that holds the figures; return the results.

    The folder holds the figures, of which `plates` has the captions; buttons lead to the `zooms`; `others` are sections
    that only some comparisons have.
    """
    camera = experiment.camera
    wavelength = experiment.settings.wavelength
    results = {
        "command": command,
        "settings": asdict(experiment.settings),
        "camera": camera.to_dict(),
        "software": software(),
        "timing": [],
        "claims": [],
        **measured,
        "stage_seconds": experiment.seconds,
    }
    write_json(folder / "results.json", results)
    window = lit_window([*experiment.truths.values(), experiment.pinhole], fraction=0.02, margin=0.03)
    geometry = capture_geometry(experiment, zooms, window)
    distances = list(experiment.truths)
    widgets: Any = template("comparison.html").module
    viewer = widgets.viewer(captures(experiment, window), geometry, [zoom.title for zoom in zooms])
    height, width = window.of(next(iter(experiment.truths.values()))).shape[:2]
    titles = {name: METHOD_TITLES[name] for name in ("truth", *experiment.settings.slider_methods)}
    warnings = design.design_warnings(camera, wavelength)
    settings = Table({"Setting": "{0}", "Value": "{1}"}, _facts(experiment, measured), words=2)
    first = distances.index(experiment.settings.distances[0])
    sections = [
        Section("Do rays suffice?", [measured["answer"], *pictures_in(folder, {ANSWER: plates[ANSWER]})]),
        Section("On the detector", [_capture_text(experiment, measured), viewer]),
        Section("Refocused", [widgets.refocus(width, height, titles, [*map(distance_text, distances)], first)]),
        *others,
        Section("In numbers", _numbers(measured)),
        Section("Figures", pictures_in(folder, {name: text for name, text in plates.items() if name != ANSWER})),
        Section("The camera", [widgets.warnings(warnings), sheet_tables(camera, wavelength)]),
        Section("Make it again", [widgets.again(f"{command} -o {folder.name}"), settings]),
    ]
    data = {"capture": geometry, "refocus": reconstructions(experiment, measured, window)}
    foot = "Scalar waves and thin elements; objects do not diffract. Lengths in millimetres. Pictures are sRGB."
    Page(title, lead, sections, foot, "comparison.js", data).write(folder / "report.html")
    return results


def _capture_text(experiment: Experiment, measured: Facts) -> str:
    """Return what tells the captures apart."""
    camera = experiment.camera
    captures = measured["captures"]
    spot = design.spot_radius(camera, experiment.settings.wavelength) / camera.pixel_size
    disc = (
        "micro-image is the object within the field stop, seen from the direction of its lens"
        if camera.objective
        else "disc is the aperture of the main lens as one microlens images it"
    )
    text = (
        f"Every {disc}. Rays give it sharp edges, waves blur it by diffraction at the microlens: {spot:.2g} pixels "
        "from the middle of a spot to its first zero. The two "
        f"captures differ by {captures['relative_error']:.0%} (root mean square, relative), {captures['psnr']:.1f} dB."
    )
    all_pixels, middle, rim = captures["difference"].values()
    if all_pixels["noise"] is None:
        return text
    if all_pixels["noise_alone"]:
        return f"{text} The noise of their samples is enough to explain all of that."
    return (
        f"{text} Of that {all_pixels['noise']:.1%} is the noise of their samples; diffraction makes "
        f"{all_pixels['true']:.1%}, of it {middle['true']:.1%} in the middle of micro-images and {rim['true']:.1%} at "
        "their rim."
    )


def _numbers(measured: Facts) -> list[Block]:
    """Return the tables of reconstructions and of edges."""
    rows = [
        row
        | {
            "title": METHOD_TITLES[row["method"]],
            "ssim": ssim_text(row["ssim"]),
            "focus": distance_text(row["distance"]),
        }
        for row in measured["reconstructions"]
    ]
    blocks: list[Block] = [
        Table(
            {
                "Focus": "{focus}",
                "Method": "{title}",
                "PSNR (dB)": "{psnr:.1f}",
                "SSIM": "{ssim}",
                "Energy": "{energy:.3f}",
                "Interference": "{interference:.1%}",
            },
            sorted(rows, key=lambda row: float(row["distance"])),
            "Reconstructions against the ideal lens. PSNR and SSIM after one scale per method; energy before it: light "
            "that diffraction carries out of the aperture's image is left out of the reconstructions. Interference: "
            "distance from the limit in which no two lenses interfere, over all that is lit.",
            words=2,
            grouped=True,
        )
    ]
    if measured["edges"]:
        columns = {
            "Edge": "{distance:g} mm",
            "Method": "{title}",
            "10 to 90 % (mm)": "{width_mm:.3f}",
            "MTF50 (1/mm)": "{mtf50_per_mm:.2f}",
        }
        edges = [row | {"title": METHOD_TITLES[row["method"]]} for row in measured["edges"]]
        caption = "Slanted edges in focus, after ISO 12233: width in the object's plane, frequency at half contrast."
        blocks.append(Table(columns, edges, caption, words=2))
    return blocks


def _facts(experiment: Experiment, measured: Facts) -> list[tuple[str, str]]:
    """Return the settings and versions of an experiment as pairs of texts."""
    settings = experiment.settings
    apart = None
    seconds = experiment.seconds
    longest = max(seconds, key=seconds.__getitem__)
    if points := measured["captures"]["points"]:
        apart = f"{points['relative_error']:.2%} (relative L2, with the noise of both), energy {points['energy']:.4f}"
    facts = [
        ("Wavelength", f"{experiment.light} nm"),
        ("Samples per pixel, ray and wave capture", f"{settings.spp}"),
        (f"Wave capture against {settings.points} points per lens, each propagated by itself", apart),
        ("Samples per pixel, ideal lens", f"{settings.truth_spp}"),
        ("Scene", settings.scene),
        ("Camera instead of the scene's", settings.camera_name),
        *((f"Scene parameter {name}", value) for name, value in sorted(settings.parameters.items())),
        ("Mitsuba variant", settings.variant),
        *(
            (f"Version of {name}", str(version))
            for name, version in sorted(experiment.wave.metadata.get("software", {}).items())
        ),
        ("Time", f"{sum(seconds.values()):.0f} s, of which {seconds[longest]:.0f} s for {longest.replace('_', ' ')}"),
    ]
    return [(name, fact) for name, fact in facts if fact is not None]


def captures(experiment: Experiment, window: Window) -> dict[str, str]:
    """Return the captures as pictures of bounded size, drawn on one scale."""
    ray, wave = (window.of(capture.image) for capture in (experiment.ray, experiment.wave))
    peak = float(np.quantile(ray[ray > 0.05 * ray.max()], 0.98)) if ray.max() > 0 else 1.0
    pictures = {}
    for name, image in (("ray", ray), ("wave", wave)):
        picture = Image.fromarray(to_bytes(image, peak))
        for quality in (85, 70, 50, 30):
            content = encoded(picture, format="WEBP", quality=quality, method=4)
            # The page stays below 12 MB.
            if len(content) <= 3_500_000:
                break
        pictures[name] = data_url("webp", content)
    return pictures


def capture_geometry(experiment: Experiment, zooms: Sequence[Zoom], window: Window) -> Named:
    """Return the size of the capture's cut-out, and the positions of close-ups as fractions of it."""
    rows, columns = experiment.wave.image.shape[:2]
    height, width = window.of(experiment.wave.image).shape[:2]
    top = round(window.top * rows)
    left = round(window.left * columns)
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


def reconstructions(experiment: Experiment, measured: Facts, window: Window) -> Named:
    """Return pictures by method and distance, with metrics where they are known."""
    peak = Brightness().peak([*map(window.of, experiment.truths.values())])
    facts: dict[str, dict[str, list[list[str]]]] = {}
    for row in measured["reconstructions"]:
        metrics = [
            ["PSNR", f"{row['psnr']:.1f} dB"],
            ["SSIM", ssim_text(row["ssim"])],
            ["Energy", f"{row['energy']:.3f}"],
        ]
        if "interference" in row:
            metrics.append(["Interference", f"{row['interference']:.1%}"])
        facts.setdefault(row["method"], {})[distance_text(row["distance"])] = metrics

    def png(image: Array) -> str:
        picture = Image.fromarray(to_bytes(window.of(image), peak))
        return data_url("png", encoded(picture, format="PNG", optimize=True))

    texts = {distance: distance_text(distance) for distance in experiment.truths}
    images = {
        name: {text: png(experiment.image(name, distance)) for distance, text in texts.items()}
        for name in ("truth", *experiment.settings.slider_methods)
    }
    return {"distances": [*texts.values()], "images": images, "facts": facts}
