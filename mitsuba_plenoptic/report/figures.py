"""Figures of an experiment, as PNG: the paper's, and those that compare."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import design
from .experiment import METHODS, TITLES, Experiment
from .framing import (
    Canvas,
    Zoom,
    annotate,
    common_peak,
    letter_zooms,
    lit_window,
    mark,
    object_bar,
    scale_bar,
    show,
    show_difference,
)
from .images import shrink
from .metrics import ssim_text


def figure_2(path: Path, experiment: Experiment, letters: Mapping[str, str]) -> None:
    """Draw the paper's figure 2: the object and, by waves, the detector image, with micro-images close up.

    These are of three shapes, given with titles by their ids.
    """
    camera, wave = experiment.camera, experiment.wave.image
    window = lit_window([experiment.pinhole, *experiment.truths.values()])
    zooms = letter_zooms(experiment, letters)
    edge, gap, close = 0.25, 0.2, 3.3
    half = (3 * close + gap) / 2
    figure = Canvas(2 * half + gap + 2 * edge, 0.5 + half * window.aspect + 0.55 + close + 0.5)

    axes = figure.axes(edge, 0.5, half, half * window.aspect)
    seen = window.of(experiment.pinhole)
    show(axes, seen, "Object, seen from the centre of the main lens")
    in_view = (window.right - window.left) * design.field_width(camera, camera.focus_distance)
    scale_bar(axes, 2.0, in_view, f"2 mm at {camera.focus_distance:g} mm")
    for name in letters:
        low, high = experiment.boxes[name]
        z = (low[2] + high[2]) / 2
        foot = (np.array([(low[0] + high[0]) / 2, low[1]]) / z) * camera.mla_distance
        across = 0.5 - foot[0] / camera.detector_width
        down = 0.5 - foot[1] / camera.detector_height
        axes.text(
            (across - window.left) / (window.right - window.left) * seen.shape[1],
            (down - window.top) / (window.bottom - window.top) * seen.shape[0] + 0.025 * seen.shape[1],
            f"{z:g} mm",
            color="white",
            ha="center",
            va="top",
            size=8,
        )

    axes = figure.axes(edge + half + gap, 0.5, half, half * window.aspect)
    peak = float(np.quantile(wave[wave > 0.01 * wave.max()], 0.95))
    seen = window.of(wave)
    small = shrink(seen, 1400)
    # Averaging pixels dims the micro-images, which do not fill their cells.
    show(axes, small, "Detector image, by waves", peak=0.7 * peak)
    scale_bar(axes, 1.0, seen.shape[1] * camera.pixel_size, "1 mm")
    corner = round(window.top * wave.shape[0]), round(window.left * wave.shape[1])
    for index, zoom in enumerate(zooms):
        mark(axes, zoom, corner, seen.shape[1] / small.shape[1], "abc"[index])
        cut = wave[zoom.rows, zoom.columns]
        below = figure.axes(edge + index * (close + gap), 0.5 + half * window.aspect + 0.55, close, close)
        show(below, cut, f"({'abc'[index]})  Micro-images of {zoom.title}", peak=peak)
        scale_bar(below, 0.1, cut.shape[1] * camera.pixel_size, "0.1 mm", below=True)
    figure.save(path)


def figure_4(path: Path, experiment: Experiment, panels: Sequence[tuple[str, float]]) -> None:
    """Draw the paper's figure 4: four reconstructions, by method and distance."""
    window = lit_window(list(experiment.truths.values()))
    images = [experiment.images[panel] for panel in panels]
    peak = common_peak(images, window)
    edge, gap, title, wide = 0.2, 0.2, 0.42, 5.0
    tall = wide * window.aspect
    figure = Canvas(2 * wide + gap + 2 * edge, 2 * (title + tall) + edge)
    for index, ((name, distance), image) in enumerate(zip(panels, images, strict=True)):
        down, across = divmod(index, 2)
        axes = figure.axes(edge + across * (wide + gap), title + down * (title + tall), wide, tall)
        show(axes, window.of(image), f"({'abcd'[index]})  {TITLES[name]}, {distance:g} mm", peak=peak, size=11)
        object_bar(axes, experiment.camera, distance, window)
    figure.save(path)


def draw_comparison(
    folder: Path, experiment: Experiment, numbers: Mapping[str, Any], zooms: Sequence[Zoom]
) -> dict[str, str]:
    """Draw the figures that every experiment has; return their captions by file name."""
    rows = numbers["reconstructions"]
    metrics = {(row["method"], row["distance"]): f"{row['psnr']:.1f} dB, SSIM {ssim_text(row['ssim'])}" for row in rows}
    interference = {
        (row["method"], row["distance"]): f"{row['interference']:.1%} of the mean"
        for row in rows
        if "interference" in row
    }
    figure_grid(folder / "methods.png", experiment, metrics)
    figure_interference(folder / "interference.png", experiment, interference)
    figure_captures(folder / "captures.png", experiment, zooms)
    return {
        "methods.png": "All methods next to the thin lens. One bin a pixel shows a grid where the image is out of "
        "focus: neighbouring pixels go to bins several apart, and how many meet in one changes from bin to bin. The "
        "lens footprint, which is right there, spreads each pixel over what its lens sees.",
        "interference.png": "What interference between lenses adds to the image.",
        "captures.png": "Micro-images by rays and by waves, and their difference.",
    }


def figure_grid(path: Path, experiment: Experiment, notes: Mapping[tuple[str, float], str]) -> None:
    """Draw every method at every distance next to the thin lens, with a note under each."""
    names = ["truth", *(method.name for method in METHODS)]
    rows = [(f"{distance:g} mm", distance) for distance in experiment.settings.distances]
    window = lit_window(list(experiment.truths.values()))
    peak = common_peak([experiment.truths[distance] for _, distance in rows], window)
    wide, gap, left, title, foot = 2.7, 0.08, 0.45, 0.4, 0.3
    tall = wide * window.aspect
    figure = Canvas(left + len(names) * (wide + gap), title + len(rows) * (tall + foot))
    for down, (label, distance) in enumerate(rows):
        for across, name in enumerate(names):
            axes = figure.axes(left + across * (wide + gap), title + down * (tall + foot), wide, tall)
            image = experiment.image(name, distance)
            show(axes, window.of(image), "", peak=peak)
            if name == "truth":
                object_bar(axes, experiment.camera, distance, window)
            annotate(
                axes,
                title=TITLES[name] if down == 0 else "",
                side=label if across == 0 else "",
                foot=notes.get((name, distance), ""),
            )
    figure.save(path)


def figure_captures(path: Path, experiment: Experiment, zooms: Sequence[Zoom]) -> None:
    """Draw micro-images by rays, by waves, and their difference."""
    ray, wave, camera = experiment.ray.image, experiment.wave.image, experiment.camera
    peak = float(np.quantile(ray[ray > 0], 0.999)) if np.any(ray > 0) else 1.0
    size, gap, left, title, foot = 2.9, 0.1, 0.45, 0.4, 0.35
    figure = Canvas(left + 3 * (size + gap) + 0.8, title + len(zooms) * (size + gap) + foot)
    drawn: Any = None
    for row, zoom in enumerate(zooms):
        cuts = [image[zoom.rows, zoom.columns] for image in (ray, wave)]
        panels = [figure.axes(left + i * (size + gap), title + row * (size + gap), size, size) for i in range(3)]
        show(panels[0], cuts[0], "", peak=peak)
        show(panels[1], cuts[1], "", peak=peak)
        drawn = show_difference(panels[2], cuts[1] - cuts[0], 0.6 * peak)
        for axes, name in zip(panels, ("By rays", "By waves", "Waves minus rays"), strict=True):
            annotate(axes, title=name if row == 0 else "", side=zoom.title if axes is panels[0] else "")
        if row == len(zooms) - 1:
            scale_bar(panels[0], 0.1, cuts[0].shape[1] * camera.pixel_size, "0.1 mm", below=True)
    figure.colour_bar(drawn, left + 3 * (size + gap), title, min(3.0, size), "radiance")
    figure.save(path)


def figure_interference(path: Path, experiment: Experiment, notes: Mapping[tuple[str, float], str]) -> None:
    """Draw what the coherent methods add to the limit in which no two lenses interfere."""
    window = lit_window(list(experiment.truths.values()))
    distances, names = experiment.settings.distances, ("coherent", "partial")
    wide, gap, left, title, foot = 3.4, 0.1, 0.45, 0.4, 0.32
    tall = wide * window.aspect
    figure = Canvas(left + len(distances) * (wide + gap) + 0.9, title + len(names) * (tall + foot))
    bound = 0.15 * max(float(np.nanmax(experiment.images["limit", distance])) for distance in distances)
    drawn: Any = None
    for down, name in enumerate(names):
        for across, distance in enumerate(distances):
            axes = figure.axes(left + across * (wide + gap), title + down * (tall + foot), wide, tall)
            difference = experiment.images[name, distance] - experiment.images["limit", distance]
            drawn = show_difference(axes, window.of(difference), bound)
            annotate(
                axes,
                title=f"{distance:g} mm" if down == 0 else "",
                side=TITLES[name] if across == 0 else "",
                foot=notes.get((name, distance), ""),
            )
    figure.colour_bar(drawn, left + len(distances) * (wide + gap), title, tall, "radiance beyond the limit")
    figure.save(path)
