"""Reproduction of the paper's figures, timing and conclusions, with a report."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from ... import design
from ...camera import PlenopticCamera
from ...errors import require_choice
from ...io import Capture, StageOptions
from ...refocus import Reconstruction, reconstruct
from ...report import (
    COMPARED_METHODS,
    METHOD_TITLES,
    Experiment,
    Settings,
    comparison,
    images,
    open_store,
    pages,
    plots,
    run_experiment,
    windows,
    write_report,
)
from ...runtime import Array, Named
from .claims import PAPER_SECONDS, check_claims, claims_section, timing_section, timing_table
from .paper_limits import check_limits, plain_seconds
from .procedures import figure_1, figure_3
from .readings import measure_readings

_LETTERS = {"eight": "the 8 (210 mm)", "f": "the F (240 mm)", "hash": "the # (280 mm)"}

_PLATES = {
    "first.png": "The letters refocused, of the capture by rays and of that by waves.",
    "fig1.png": "The paper's figure 1: the setup. Rays of a point of each object to the microlens array.",
    "fig2.png": "The paper's figure 2: the object and its image on the detector, by waves; below, 8 x 8 lenses of each "
    "letter.",
    "fig3.png": "The paper's figure 3: the way back to the object plane by rays (a) and by waves (b).",
    "fig4.png": "The paper's figure 4: reconstructions by rays (a), coherent (b) and partially coherent (c) at 280 mm, "
    "and partially coherent at 210 mm (d).",
}

_PAPER = Settings(
    scene="letters",
    distances=(210.0, 240.0, 280.0),
    # The paper's lenses are parabolic phases, in both models of light.
    parameters={"lens_model": "parabolic"},
    slider=(200.0, 210.0, 220.0, 230.0, 240.0, 250.0, 260.0, 270.0, 280.0, 290.0, 300.0),
    spp=64,
    points=64,
    truth_spp=4096,
)

# The quick one has the paper's lenses and pixels on a detector of half the width, and letters of half the size.
PRESETS = {
    # A quarter of the samples leaves noise at the rims of letters alone.
    "quick": replace(
        _PAPER,
        spp=16,
        truth_spp=1024,
        parameters={**_PAPER.parameters, "resolution": "2048", "detector_width": "4.096", "letter_scale": "0.5"},
        points=8,
        slider=(200.0, 220.0, 240.0, 260.0, 280.0, 300.0),
        # To embed their fonts takes a tenth of the whole.
        pdf=False,
    ),
    "paper": _PAPER,
}


def reproduce(output: Path, *, preset: str = "quick", stages: StageOptions | None = None) -> Named:
    """Make the paper's figures, its timing comparison and its conclusions, with a report.

    The wave capture is made from signed rays, and again point by point, as in the paper; the report states their
    difference.
    """
    settings = PRESETS[require_choice("preset", preset, PRESETS)]
    store = open_store(output, stages)
    near, _, far = _LETTERS
    objects = dict(zip((title.partition(" (")[0] for title in _LETTERS.values()), settings.distances, strict=True))

    def first(camera: PlenopticCamera, pictures: dict[tuple[str, float], Array]) -> None:
        results_shown = [
            Reconstruction(pictures[name, distance], distance, camera.bin_size(distance), model, camera)
            for name, model in (("ray_of_ray", "rays"), ("partial", "waves"))
            for distance in settings.distances
            if (name, distance) in pictures
        ]
        sheet = plots.contact_sheet(results_shown)
        there = ["first.png"]
        if len(results_shown) == len(settings.distances):
            # That of the waves replaces it.
            sheet.save(output / "first.png")
        else:
            sheet.save_both(output / "first.png", settings.pdf)
            figure_1(output / "fig1.png", camera, objects, settings.pdf)
            there.append("fig1.png")
        _write_growing(output, {name: _PLATES[name] for name in there})

    experiment = run_experiment(settings, store, first=first)
    zooms = _letter_zooms(experiment, _LETTERS)
    last = settings.distances[-1]
    figure_2(output / "fig2.png", experiment, _LETTERS)
    figure_3(output / "fig3.png", experiment.camera, last, settings.pdf)
    panels = [("ray", last), ("coherent", last), ("partial", last), ("partial", settings.distances[0])]
    figure_4(output / "fig4.png", experiment, panels)
    _write_growing(output, _PLATES)
    measured = comparison.measure(experiment) | {"readings": measure_readings(experiment, store, near, far)}
    seconds = store.facts(
        "seconds_of_processor",
        {"capture": experiment.wave_key, "distance": last},
        lambda _: processor_seconds(experiment.wave, last),
    )
    plain = store.facts(
        "seconds_of_plain_loop",
        {"camera": experiment.camera.to_json(), "distance": last},
        lambda _: {"seconds": round(plain_seconds(experiment.camera, last), 1)},
    )
    claims = check_claims(experiment, measured, seconds, near, far)
    claims += check_limits(experiment.camera, settings.wavelength, plain["seconds"], seconds["ray"])
    columns, rows = experiment.camera.lens_count
    confirmed = sum(claim.verdict == "confirmed" for claim in claims)
    measured |= {"timing": timing_table(experiment, seconds), "claims": [asdict(claim) for claim in claims]}
    return write_report(
        output,
        "A plenoptic camera by rays and by waves",
        f"Three letters at 210, 240 and 280 mm, recorded through {columns} x {rows} microlenses at "
        f'{settings.wavelength:g} nm and refocused from one capture, after the paper "Wave-Optical '
        f'Reconstruction of Plenoptic Camera Images". Of its {len(claims)} conclusions {confirmed} are '
        f"confirmed with the preset {preset}.",
        experiment,
        measured,
        zooms=zooms,
        plates=_PLATES | comparison.draw_comparison(output, experiment, measured, zooms),
        command=f"mitsuba-plenoptic reproduce --preset {preset}",
        others=[claims_section(claims, measured), timing_section(experiment, measured["timing"])],
    )


def _write_growing(folder: Path, plates: Mapping[str, str]) -> None:
    """Write ``report.html`` with the figures that are there so far, by their captions, unless a finished one is."""
    if not (folder / "results.json").exists():
        lead = "The rest is being computed. This page shows more as it comes."
        pages.Page(
            "First results", lead, [pages.Section("Figures", pages.pictures_in(folder, plates))], refresh=5
        ).write(folder / "report.html")


def processor_seconds(capture: Capture, distance: float) -> dict[str, float]:
    """Return seconds of processor time, by method of the paper's comparison, for a reconstruction at a distance.

    Processor time does not grow with other work on the machine. The shorter of two runs counts, with compiled kernels.
    """
    seconds = {}
    for method in COMPARED_METHODS:
        if method.name in PAPER_SECONDS:
            runs = []
            for _ in range(2):
                start = time.process_time()
                reconstruct(capture, distance, **method.options)
                runs.append(time.process_time() - start)
            seconds[method.name] = round(min(runs), 3)
    return seconds


def _letter_zooms(experiment: Experiment, letters: Mapping[str, str]) -> list[windows.Zoom]:
    """Return close-ups of the micro-images in the middle of shapes, which are given by ids and titles."""
    middles = {title: np.add(*experiment.boxes[name]) / 2 for name, title in letters.items()}
    return [windows.zoom_at(title, experiment.camera, -middle[:2] / middle[2]) for title, middle in middles.items()]


@plots.styled
def figure_2(path: Path, experiment: Experiment, letters: Mapping[str, str]) -> None:
    """Draw the paper's figure 2: the object, its detector image by waves, and micro-images close up.

    The micro-images belong to three shapes, given by ids and titles.
    """
    camera = experiment.camera
    wave = experiment.wave.image
    window = windows.lit_window([experiment.pinhole, *experiment.truths.values()])
    zooms = _letter_zooms(experiment, letters)
    plot = plots.Plot(10.9, 5.4 * window.aspect + 4.4)
    rows = plot.add_gridspec(2, 1, height_ratios=(5.4 * window.aspect, 3.5))
    upper = rows[0].subgridspec(1, 2).subplots(squeeze=False)[0]
    lower = rows[1].subgridspec(1, len(zooms)).subplots(squeeze=False)[0]
    for panels, aspect in ((upper, window.aspect), (lower, 1)):
        for axes in panels:
            plots.bare(axes).set_box_aspect(aspect)
    axes = upper[0]
    view_of_window = window.of(experiment.pinhole)
    plots.show(axes, view_of_window, "Object, seen from the centre of the main lens")
    in_view = (window.right - window.left) * design.field_width(camera, camera.focus_distance)
    plots.scale_bar(axes, in_view, f"at {camera.focus_distance:g} mm")
    for name in letters:
        low, high = experiment.boxes[name]
        z = (low[2] + high[2]) / 2
        foot = (np.array([(low[0] + high[0]) / 2, low[1]]) / z) * camera.mla_distance
        across = 0.5 - foot[0] / camera.detector_width
        down = 0.5 - foot[1] / camera.detector_height
        axes.text(
            (across - window.left) / (window.right - window.left) * view_of_window.shape[1],
            (down - window.top) / (window.bottom - window.top) * view_of_window.shape[0]
            + 0.025 * view_of_window.shape[1],
            f"{z:g} mm",
            color="white",
            ha="center",
            va="top",
            size=8,
        )

    axes = upper[1]
    peak = float(np.quantile(wave[wave > 0.01 * wave.max()], 0.95))
    view_of_window = window.of(wave)
    small = images.shrink(view_of_window, 1400)
    # Averaging pixels dims the micro-images, which do not fill their cells.
    plots.show(axes, small, "Detector image, by waves", peak=0.7 * peak)
    plots.scale_bar(axes, view_of_window.shape[1] * camera.pixel_size, plots.ON_DETECTOR)
    corner = round(window.top * wave.shape[0]), round(window.left * wave.shape[1])
    for below, letter, zoom in zip(lower, "abc", zooms, strict=True):
        plots.mark(axes, zoom, corner, view_of_window.shape[1] / small.shape[1], letter)
        cut = wave[zoom.rows, zoom.columns]
        plots.show(below, cut, f"({letter})  Micro-images of {zoom.title}", peak=peak)
        plots.scale_bar(below, cut.shape[1] * camera.pixel_size, plots.ON_DETECTOR, below=True)
    plot.save_both(path, experiment.settings.pdf)


@plots.styled
def figure_4(path: Path, experiment: Experiment, panels: Sequence[tuple[str, float]]) -> None:
    """Draw the paper's figure 4: four reconstructions, by method and distance."""
    window = windows.lit_window(list(experiment.truths.values()))
    pictures = [experiment.images[panel] for panel in panels]
    peak = images.Brightness().peak([window.of(image) for image in pictures])
    plot = plots.Plot(10.6)
    axes_of_all = plot.panels(2, 2, window.aspect).flat
    for axes, letter, (name, distance), image in zip(axes_of_all, "abcd", panels, pictures, strict=True):
        plots.show(axes, window.of(image), f"({letter})  {METHOD_TITLES[name]}, {distance:g} mm", peak=peak, size=11)
        plots.object_bar(axes, experiment.camera, distance, window)
    plot.save_both(path, experiment.settings.pdf)
