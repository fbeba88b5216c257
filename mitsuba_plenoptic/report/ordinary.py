"""The price of a microlens array: a scene with and without one, and the sharpness of both pictures."""

from pathlib import Path

import numpy as np
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, NullLocator
from scipy.ndimage import uniform_filter

from ..errors import refusing
from ..optics import in_millimetres
from ..runtime import Array, Facts, Named
from .edge import window_sharpness
from .experiment import METHOD_TITLES, ORDINARY, SLIDER_METHODS, Experiment, Ordinary
from .images import Brightness, luminance
from .pages import Section, Table, pictures_in
from .plots import ACCENT, FAINT, INK, Plot, annotate, scale_bar, show, styled

_TITLES = {ORDINARY: "Ordinary camera", **{name: METHOD_TITLES[name] for name in SLIDER_METHODS}}


def measure_ordinary(experiment: Experiment, ordinary: Ordinary) -> Named:
    """Return the sharpness of an ordinary camera and of refocused images, in the plane in focus.

    Frequencies are in cycles per millimetre of that plane. Transfer functions include the pixels and end at one cycle
    per pixel; beyond half a cycle they rest on the slant of the edge, as a picture cannot hold such detail.
    """
    camera = ordinary.capture.camera
    distance = ordinary.distance
    on_detector = 2 * camera.pupil_radius / (in_millimetres(experiment.settings.wavelength) * camera.pupil_distance)
    cutoff = on_detector * camera.mla_distance / distance
    # From a 32nd of a cycle per bin.
    frequency = np.geomspace((1 / 32) / experiment.camera.bin_size(distance), cutoff, 128)
    share = np.minimum(frequency / cutoff, 1)
    pictures = []
    for name, (image, pixel) in _pictures(experiment, ordinary).items():
        with refusing(f"against = {ORDINARY}: distance = {distance:g}: {_TITLES[name]}:", ValueError):
            edge = window_sharpness(ordinary.edges[name])
        cycles = frequency[frequency * pixel <= 1] * pixel
        pictures.append(
            {
                "picture": name,
                "title": _TITLES[name],
                "pixels": list(image.shape[::-1]),
                "nyquist_per_mm": round(0.5 / pixel, 4),
                "mtf50_per_mm": round(edge.mtf50 / pixel, 4),
                "mtf10_per_mm": round(edge.falls_to(0.1) / pixel, 4),
                "transfer": np.interp(cycles, edge.frequency, edge.transfer).round(5).tolist(),
            }
        )
    return {
        "camera": camera.to_dict(),
        "distance": distance,
        "cutoff_per_mm": round(cutoff, 4),
        "frequency_per_mm": frequency.round(5).tolist(),
        # The transfer function of a disc.
        "diffraction": (2 / np.pi * (np.arccos(share) - share * np.sqrt(1 - share**2))).round(5).tolist(),
        "pictures": pictures,
    }


def _pictures(experiment: Experiment, ordinary: Ordinary) -> dict[str, tuple[Array, float]]:
    """Return the scene's pictures by name, the ordinary camera's first, with the width of their pixels or bins.

    The width is that in the plane in focus, in millimetres.
    """
    distance = ordinary.distance
    pictures = {ORDINARY: (ordinary.capture.image, ordinary.capture.camera.pixel_in_object(distance))}
    for name in SLIDER_METHODS:
        if (name, distance) in experiment.images:
            pictures[name] = experiment.images[name, distance], experiment.camera.bin_size(distance)
    return pictures


def ordinary_section(folder: Path, experiment: Experiment, ordinary: Ordinary, measured: Facts) -> Section:
    """Draw the pictures and the transfer functions, and return the part of the report that shows them."""
    figure_pictures(folder / "ordinary.png", experiment, ordinary)
    figure_transfer(folder / "mtf.png", measured)
    captions = {
        "ordinary.png": f"The scene by waves: the camera without its microlens array, focused at {ordinary.distance:g} "
        "mm, and a capture with the array, refocused to this distance. Below, the framed part with every pixel.",
        "mtf.png": "Modulation transfer functions of a slanted edge in focus, pixels included, in the plane in focus. "
        "Thin: beyond half a cycle per pixel, where a picture cannot hold detail. Dashed: the limit by diffraction at "
        "the pupil.",
    }
    columns = {
        "Picture": "{title}",
        "Pixels": "{pixels[0]} x {pixels[1]}",
        "50 % contrast": "{mtf50_per_mm:.3g}",
        "10 % contrast": "{mtf10_per_mm:.3g}",
        "Half a cycle per pixel": "{nyquist_per_mm:.3g}",
        "50 %, ordinary over this": "{ratio:.3g}",
    }
    best = measured["pictures"][0]["mtf50_per_mm"]
    return Section(
        "Against an ordinary camera",
        [
            f"The same main lens and pixels without the microlens array, focused at {measured['distance']:g} mm: what "
            "the array costs in sharpness for views and distances to choose from after the capture.",
            *pictures_in(folder, captions),
            Table(
                columns,
                [row | {"ratio": best / row["mtf50_per_mm"]} for row in measured["pictures"]],
                "Sharpness in the plane in focus, from a slanted edge. Frequencies in cycles per mm; beyond half a "
                "cycle per pixel a picture holds no detail, and the slant of the edge tells the contrast. The pupil's "
                f"cut-off is {measured['cutoff_per_mm']:.3g}.",
            ),
        ],
    )


@styled
def figure_pictures(path: Path, experiment: Experiment, ordinary: Ordinary) -> None:
    """Draw the pictures in one frame of the plane in focus, and the place of most contrast with each pixel."""
    pictures = _pictures(experiment, ordinary)
    picture, pixel = pictures[ORDINARY]
    sides = np.array([np.array(image.shape[:2]) * width for image, width in pictures.values()])
    half = sides.min(axis=0) / 2
    # Half of the close-up's eight bins.
    close = min(4 * experiment.camera.bin_size(ordinary.distance), *half)
    # Details that bins blur, without the noise of single pixels.
    smooth = uniform_filter(luminance(picture), max(1, round(pictures["ray"][1] / (2 * pixel))))
    middle = _most_contrast(smooth, pixel, half, close)
    peak = Brightness().peak([picture])
    plot = Plot(2.4 * len(pictures) + 0.1)
    panels = plot.panels(2, len(pictures), (half[0] / half[1], 1))
    for (name, (image, width)), overview, crop in zip(pictures.items(), *panels, strict=True):
        for axes, (down, right), (high, wide) in ((overview, (0.0, 0.0), half), (crop, middle, (close, close))):
            show(axes, image, peak=peak)
            bottom, end = np.array(image.shape[:2]) * width / 2
            axes.images[0].set_extent((-end, end, bottom, -bottom))
            axes.axis((right - wide, right + wide, down + high, down - high))
            if name == ORDINARY:
                scale_bar(axes, 2 * wide, f"at {ordinary.distance:g} mm")
        corner = middle[::-1] - close
        overview.add_patch(Rectangle(corner, 2 * close, 2 * close, fill=False, edgecolor=ACCENT, linewidth=1))
        annotate(overview, title=_TITLES[name], foot=f"{image.shape[1]} x {image.shape[0]} pixels")
    plot.save_both(path)


def _most_contrast(image: Array, pixel: float, half: Array, close: float) -> Array:
    """Return the middle in mm, within half sides, of the square of half a side `close` that has the most contrast."""
    slope = uniform_filter(np.hypot(*np.gradient(image)), max(1, round(2 * close / pixel)))
    down, right = ((np.arange(count) + 0.5 - count / 2) * pixel for count in image.shape)
    reach = half - close
    inside = np.logical_and.outer(np.abs(down) <= reach[0] + pixel, np.abs(right) <= reach[1] + pixel)
    row, column = np.unravel_index(np.argmax(np.where(inside, slope, -1)), image.shape)
    return np.clip([down[row], right[column]], -reach, reach)


@styled
def figure_transfer(path: Path, measured: Facts) -> None:
    """Draw transfer functions over the logarithm of the frequency, with the limit of the pupil."""
    plot = Plot(7.2, 3.6)
    axes = plot.subplots()
    frequency = np.array(measured["frequency_per_mm"])
    for picture in measured["pictures"]:
        transfer = np.array(picture["transfer"])
        cycles = frequency[: transfer.size]
        resolved = cycles <= picture["nyquist_per_mm"]
        (line,) = axes.plot(cycles[resolved], transfer[resolved], linewidth=1.6, label=picture["title"])
        axes.plot(cycles, transfer, linewidth=0.6, color=line.get_color())
    axes.plot(frequency, measured["diffraction"], "--", color=FAINT, linewidth=1.2, label="Diffraction at the pupil")
    axes.set(xscale="log", xlim=(frequency[0], frequency[-1]), ylim=(0, 1.05), yticks=np.linspace(0, 1, 6))
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.tick_params(labelsize=8, color=FAINT, labelcolor=INK)
    axes.set_xlabel(f"cycles per mm at {measured['distance']:g} mm", size=9, color=INK)
    axes.set_ylabel("contrast", size=9, color=INK)
    axes.grid(linewidth=0.4, color="#d0d6dd")
    axes.legend(fontsize=8, frameon=False, loc="lower left")
    plot.save_both(path)
