"""The comparison of rays and waves on any scene: captured, measured, drawn and reported."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from ..errors import refuse_if
from ..io import StageOptions
from ..runtime import Array, Facts, Named
from .comparison_page import ANSWER, write_report
from .edge import square_sharpness
from .experiment import EDGE_TILT, METHOD_TITLES, Experiment, RefocusMethod, Settings, open_store, run_experiment
from .images import Brightness, luminance
from .metrics import (
    ContrastChange,
    Difference,
    capture_difference,
    common_scale,
    contrast_change,
    image_metrics,
    interference,
    lit_region,
    middle_of_micro_images,
    relative_error,
    rounded,
    shape_window,
    ssim_text,
)
from .ordinary import measure_ordinary, ordinary_section
from .pages import scene_name
from .plots import ON_DETECTOR, Plot, annotate, distance_text, object_bar, scale_bar, show, show_difference, styled
from .windows import Zoom, brightest_zoom, lit_window


def compare(
    settings: Settings, output: Path, *, stages: StageOptions | None = None, against: str | None = None
) -> Named:
    """Return measurements of captures by rays and by waves and of their reconstructions, and write the report.

    Both captures have the main lens that the sensor's `lens_model` states, so that they differ by diffraction, at the
    pupil and at the microlenses.

    Parameters
    ----------
    settings : Settings
        Scene, camera, distances and samples.
    output : Path
        The folder of the report, its figures and its data.
    stages : StageOptions, optional
        What finished stages are kept for, and how progress is shown.
    against : {"ordinary"}, optional
        Another camera that the page shows, with its sharpness, beside the first distance: the same main lens and pixels
        without the microlens array, focused at that distance. Default: none.
    """
    refuse_if(not settings.distances, "distance: give at least one to refocus to")
    store = open_store(output, stages)
    experiment = run_experiment(settings, store, against)
    store.notify("report", 0, 0)
    grey = experiment.grey()
    others = []
    measured = measure(grey)
    if experiment.ordinary and grey.ordinary:
        measured["ordinary"] = measure_ordinary(grey, grey.ordinary)
        others.append(ordinary_section(output, experiment, experiment.ordinary, measured["ordinary"]))
    zooms = [brightest_zoom(grey)]
    columns, rows = experiment.camera.lens_count
    return write_report(
        output,
        f"Rays and waves: {scene_name(settings.scene)}",
        f"Recorded through {columns} x {rows} microlenses, once by rays and once by waves at "
        f"{experiment.light} nm, and refocused from one capture.",
        experiment,
        measured,
        zooms=zooms,
        plates=draw_comparison(output, experiment, measured, zooms),
        command=_command(settings, against),
        others=others,
    )


def _command(settings: Settings, against: str | None) -> str:
    words: list = [
        f"mitsuba-plenoptic compare {settings.scene}",
        *(f"--distance {distance:g}" for distance in settings.distances),
        *(f"-D {name}={value}" for name, value in settings.parameters.items()),
        settings.camera_name and f"--camera {settings.camera_name}",
        against and f"--against {against}",
        settings.unit != "mm" and f"--unit {settings.unit}",
        "mono" in settings.variant and f"--wavelength {settings.wavelength:g}",
        f"--spp {settings.spp} --variant {settings.variant}",
    ]
    return " ".join(filter(None, words))


def contrast_changes(experiment: Experiment) -> dict[float, ContrastChange]:
    """Return by distance, largest change first, what waves change of the contrast of images refocused by rays."""
    changes = {}
    for distance in experiment.settings.distances:
        changes[distance] = contrast_change(
            experiment.images["ray_of_ray", distance], experiment.images["ray", distance], experiment.truths[distance]
        )
    return dict(sorted(changes.items(), key=lambda item: -abs(item[1].ratio - 1)))


def answer(experiment: Experiment, difference: Difference) -> str:
    """Return whether rays suffice: in the raw pixels beside the noise, and in images refocused by rays."""
    spp = experiment.settings.spp
    changes = contrast_changes(experiment)
    distance, change = next(iter(changes.items()))
    finest = min(found.finest for found in changes.values())
    if change.ratio != 1:
        frequency = change.frequency / experiment.camera.bin_size(distance)
        refocused = (
            f"At {distance_text(distance)} waves change contrast at {frequency:.2g} cycles a "
            f"{'radian' if math.isinf(distance) else 'mm'} by {change.ratio - 1:+.0%}"
        )
    # Half of what bins can hold must be known to say that rays suffice.
    elif finest >= 0.25:
        refocused = (
            "At these distances rays suffice for refocused images: contrast differs by less than 5 % up to "
            f"{finest:.2g} cycles a bin"
        )
    elif finest:
        refocused = (
            f"Waves change contrast of refocused images by less than 5 % up to {finest:.2g} cycles a bin; noise hides "
            "what they do to finer detail: take more samples"
        )
    else:
        refocused = "Noise hides whether waves change the contrast of refocused images: take more samples"
    noise, true = difference.noise, difference.true
    if noise is None or true is None:
        return f"{refocused}. Of raw pixels it is not known, as one sample tells no noise: take two or more."
    if true < noise or difference.noise_alone:
        # Differences that are not told from noise are smaller than three hundredths of its power.
        most = max(true, 0.17 * noise)
        enough = math.ceil(spp * (noise / most) ** 2)
        return (
            f"{refocused}. What waves change in raw pixels ({most:.1%} at most) is below the noise of {spp} samples "
            f"({noise:.1%}); {enough} samples would show it."
        )
    return (
        f"{refocused}. Waves change raw pixels by {true:.1%}, which is above the noise of {spp} samples ({noise:.1%})."
    )


_COHERENT = ("coherent", "partial")


def measure(experiment: Experiment) -> Named:
    """Return comparisons of the captures, and of the reconstructions with the ideal lens and the one-lens limit."""
    ray = experiment.ray.image
    wave = experiment.wave.image
    points = None
    if experiment.points is not None:
        exact = experiment.points.image
        energy = float(wave.sum(dtype=np.float64) / exact.sum(dtype=np.float64))
        points = {"relative_error": round(relative_error(wave, exact), 5), "energy": round(energy, 5)}
    middle = middle_of_micro_images(experiment.camera)
    differences = {
        name: capture_difference(experiment.ray, experiment.wave, pixels)
        for name, pixels in {"all": None, "middle": middle, "rim": ~middle}.items()
    }
    return {
        "captures": {
            **rounded(image_metrics(ray, wave)),
            "relative_error": round(relative_error(ray, wave), 5),
            "difference": {name: rounded(difference) for name, difference in differences.items()},
            "points": points,
        },
        "answer": answer(experiment, differences["all"]),
        "reconstructions": _reconstructions(experiment),
        "interference": shape_interference(experiment),
        "edges": _edges(experiment),
    }


def _reconstructions(experiment: Experiment) -> list[Named]:
    rows = []
    distances = experiment.settings.distances
    truths = [experiment.truths[distance] for distance in distances]
    for method in experiment.settings.methods:
        images = [experiment.images[method.name, distance] for distance in distances]
        scale = common_scale(images, truths)
        for distance, image, truth in zip(distances, images, truths, strict=True):
            limit = experiment.images.get(("limit", distance))
            row = {
                "method": method.name,
                "distance": distance,
                "bins": list(image.shape[::-1]),
                "scale": round(scale, 5),
                **rounded(image_metrics(scale * image, truth)),
                "energy": round(image_metrics(image, truth).energy, 5),
            }
            if method.name in _COHERENT and limit is not None:
                row["interference"] = round(interference(image, limit, lit_region(limit)), 5)
            rows.append(row)
    return rows


def shape_interference(experiment: Experiment) -> list[Named]:
    """Return the interference within each flat shape at each distance, by coherent methods."""
    rows: list[Named] = []
    if not set(_COHERENT) | {"limit"} <= {name for name, _ in experiment.images}:
        return rows
    for name, (low, high) in experiment.boxes.items():
        window = shape_window(experiment.camera, low, high)
        if high[2] - low[2] > 1e-3 * low[2] or window is None:
            continue
        for distance in experiment.settings.distances:
            row = {"shape": name, "shape_distance": _depth(low), "distance": distance}
            for method in _COHERENT:
                image = experiment.images[method, distance]
                row[method] = round(interference(image, experiment.images["limit", distance], window), 5)
            rows.append(row)
    return rows


def _edges(experiment: Experiment) -> list[Named]:
    rows = []
    camera = experiment.camera
    for name, (low, high) in experiment.boxes.items():
        distance = _depth(low)
        # Ids of the chart's squares, which are slanted edges, begin so.
        if not name.startswith("edge_") or distance not in experiment.settings.distances:
            continue
        scale = 1 / camera.bin_size(low[2])
        column, row = (camera.bin_count[axis] / 2 - (low[axis] + high[axis]) / 2 * scale for axis in (0, 1))
        bin_size = camera.bin_size(distance)
        side = float(high[0] - low[0]) / (math.cos(EDGE_TILT) + math.sin(EDGE_TILT)) * scale
        for method in ("truth", *(method.name for method in experiment.settings.methods)):
            with suppress(ValueError):
                width, mtf50 = square_sharpness(experiment.image(method, distance), row, column, side)
                figures = {"width_mm": round(width * bin_size, 4), "mtf50_per_mm": round(mtf50 / bin_size, 4)}
                rows.append({"shape": name, "distance": distance, "method": method, **figures})
    return rows


def _depth(low: Array) -> float:
    """Return the distance of a flat shape in mm, rounded to remove the noise of single precision."""
    return round(float(low[2]), 3)


def draw_comparison(folder: Path, experiment: Experiment, measured: Facts, zooms: Sequence[Zoom]) -> dict[str, str]:
    """Draw the figures common to all experiments; return their captions by file name."""
    rows = measured["reconstructions"]
    metrics = {(row["method"], row["distance"]): f"{row['psnr']:.1f} dB, SSIM {ssim_text(row['ssim'])}" for row in rows}
    interference = {
        (row["method"], row["distance"]): f"{row['interference']:.1%} of the mean"
        for row in rows
        if "interference" in row
    }
    figure_grid(folder / "methods.png", experiment, metrics)
    captions = {
        "methods.png": "All methods next to the ideal lens. One bin a pixel shows a grid where the image is out of "
        "focus: neighbouring pixels go to bins several apart, and how many meet in one changes from bin to bin. The "
        "lens footprint, which is right there, spreads each pixel over what its lens sees."
        if any(method.name == "ray_point" for method in experiment.settings.methods)
        else "All methods next to the ideal lens.",
        "captures.png": "Micro-images by rays and by waves, and their difference.",
    }
    camera = experiment.camera
    pdf = experiment.settings.pdf
    window = lit_window(list(experiment.truths.values()))
    distance = next(iter(contrast_changes(experiment.grey())))
    cuts = {
        zoom.title: [capture.image[zoom.rows, zoom.columns] for capture in (experiment.ray, experiment.wave)]
        for zoom in zooms
    }
    refocused = [window.of(experiment.images[name, distance]) for name in ("ray_of_ray", "ray")]
    figure_pairs(
        folder / "captures.png",
        cuts,
        0.6,
        lambda axes, image: scale_bar(axes, image.shape[1] * camera.pixel_size, ON_DETECTOR, below=True),
        pdf,
    )
    figure_pairs(
        folder / ANSWER,
        {distance_text(distance): refocused},
        0.4,
        lambda axes, _: object_bar(axes, camera, distance, window),
        pdf,
    )
    captions[ANSWER] = f"What waves change at {distance_text(distance)}: both captures, refocused by rays."
    if interference:
        figure_interference(folder / "interference.png", experiment.grey(), interference)
        captions["interference.png"] = "What interference between lenses adds to the image."
    return captions


@styled
def figure_grid(path: Path, experiment: Experiment, notes: Mapping[tuple[str, float], str]) -> None:
    """Draw the ideal lens, then a row for each method, of both captures at up to two distances, with notes."""
    rows: dict[str, dict[str, RefocusMethod]] = {"": {"ray": RefocusMethod("truth", METHOD_TITLES["truth"], {})}}
    for method in experiment.settings.methods:
        rows.setdefault(str(method.options), {})[method.source] = method
    # With more than four panels in a row, text could not be read where the figure is shown as wide as a page.
    distances = experiment.settings.distances
    together = min(len(distances), 2)
    window = lit_window(list(experiment.truths.values()))
    peak = Brightness().peak([window.of(experiment.truths[distance]) for distance in distances])
    plot = Plot(5.0 * together)
    panels = plot.panels(math.ceil(len(distances) / together) * len(rows), 2 * together, window.aspect)
    for index, distance in enumerate(distances):
        block, column = divmod(index, together)
        for line, row in enumerate(rows.values()):
            for source, method in row.items():
                axes = panels[block * len(rows) + line, 2 * column + (source == "wave")]
                title = f"{source} capture" * (line == 1) if line else distance_text(distance)
                side = row.get("wave", method).title * (not column and source == next(iter(row)))
                image = window.of(experiment.image(method.name, distance))
                show(axes, image, title, peak=peak, side=side, foot=notes.get((method.name, distance), ""))
                object_bar(axes, experiment.camera, distance, window)
    plot.save_both(path, experiment.settings.pdf)


@styled
def figure_pairs(
    path: Path, pairs: Mapping[str, Sequence[Array]], bound: float, bar: Callable[[Axes, Array], None], pdf: bool
) -> None:
    """Draw images by rays, by waves, and their difference up to a bound relative to white; a row for each title.

    `bar` draws the scale of an image.
    """
    images = list(pairs.values())
    peak = Brightness().peak([by_rays for by_rays, _ in images])
    plot = Plot(10.25)
    panels = plot.panels(len(images), 3, images[0][0].shape[0] / images[0][0].shape[1])
    for row, title, pair in zip(panels, pairs, images, strict=True):
        for axes, image in zip(row, pair, strict=False):
            show(axes, image, peak=peak)
        mesh = show_difference(row[2], luminance(pair[1] - pair[0]), bound * peak)
        for axes, name in zip(row, ("By rays", "By waves", "Waves minus rays"), strict=True):
            annotate(axes, title=name if row[0] is panels[0, 0] else "", side=title if axes is row[0] else "")
            bar(axes, pair[0])
    plot.colour_bar(mesh, panels, "radiance")
    plot.save_both(path, pdf)


@styled
def figure_interference(path: Path, experiment: Experiment, notes: Mapping[tuple[str, float], str]) -> None:
    """Draw the difference of coherent methods from the limit in which no two lenses interfere."""
    window = lit_window(list(experiment.truths.values()))
    limits = {distance: experiment.images["limit", distance] for distance in experiment.settings.distances}
    plot = Plot(3.5 * len(limits) + 1.35)
    panels = plot.panels(len(_COHERENT), len(limits), window.aspect)
    bound = 0.15 * np.nanmax(list(limits.values()))
    for row, name in zip(panels, _COHERENT, strict=True):
        for axes, (distance, limit) in zip(row, limits.items(), strict=True):
            mesh = show_difference(axes, window.of(experiment.images[name, distance] - limit), bound)
            object_bar(axes, experiment.camera, distance, window)
            annotate(
                axes,
                title=distance_text(distance) if axes in panels[0] else "",
                side=METHOD_TITLES[name] if axes is row[0] else "",
                foot=notes.get((name, distance), ""),
            )
    plot.colour_bar(mesh, panels, "radiance beyond the limit")
    plot.save_both(path, experiment.settings.pdf)
