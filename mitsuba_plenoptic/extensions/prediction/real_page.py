"""Page on a real light field beside simulated ones: pixels, differences, profiles, planes of the scene, figures."""

from pathlib import Path

import numpy as np
from markupsafe import Markup
from scipy.signal import oaconvolve

from ...report import pages, plots
from ...runtime import Array
from .study import LIGHTS, Answer, Study

_BRIGHT = 0.998
"""Quantile of what a picture shows as white."""


def write_page(path: Path, study: Study, answer: Answer) -> None:
    """Write the page, with all figures in it."""
    results = pages.Table(
        {
            "withheld": "{test}",
            "over noise, waves": "{ratio.waves:.3f}",
            "over noise, rays": "{ratio.rays:.3f}",
            "rays over waves (95 %)": "{ratio.ratio:.3f} ({ratio.low:.3f} to {ratio.high:.3f})",
            "relative, waves": "{waves:.1f} %",
            "relative, rays": "{rays:.1f} %",
        },
        [
            {"test": test, "ratio": ratio} | {light: 100 * answer.relative[light][test] for light in LIGHTS}
            for test, ratio in answer.ratios.items()
        ],
        "Residuals are root mean squares: over the noise of photons and of the sensor, and over the light of the "
        "withheld pixels. The interval is from drawing lenses again.",
        words=2,
    )
    controls = [
        f"Of a picture simulated by {light}: {ratio.waves:.3f} by waves, {ratio.rays:.3f} by rays; better: "
        f"{ratio.better}."
        for light, ratio in answer.controls.items()
    ]
    controls += [
        f"Stray light by {light}: {100 * answer.stray[light]:.1f} % of a lens's mean light; strength of the prior "
        f"{strength['pixels']:g} for pixels, {strength['lenses']:g} for lenses."
        for light, strength in answer.strengths.items()
    ]
    controls.append(f"{answer.noise.capitalize()}.")
    compared = (
        "Recorded pixels, simulated ones by waves and by rays, their differences, and a line of pixels. Lenses that "
        "differ as a whole are withheld ones."
    )
    planes = "Planes of the scene by waves and by rays, from all pixels, each as bright as it can be shown."
    how = (
        "Part of the pixels is withheld; a scene is found that explains the others, by waves of "
        f"{study.wavelength:g} nm and by rays; it predicts those that are withheld."
    )
    sections = [
        pages.Section("Predictions", [how, pages.Picture(pictures(study).png(), compared), results]),
        pages.Section("Controls", [controls]),
        pages.Section("The scene", [pages.Picture(slices(study).png(), planes)]),
    ]
    verdict = Markup("<strong>{}</strong>").format(answer.verdict)
    pages.Page("A real light field beside simulated ones", verdict, sections).write(path)


@plots.styled
def pictures(study: Study) -> plots.Plot:
    """Return a figure of recorded and predicted pixels, their differences, and a line of pixels through them."""
    part = study.part("waves")
    recorded = _picture(study, study.electrons(None))
    predicted = {
        light: _picture(study, study.predicted(light, 0, study.strength(light, "pixels"), None)) for light in LIGHTS
    }
    # 10 lenses along a side of the pictures that are shown.
    rows, columns = _most_structured(recorded, int(10 * part.model.pitch.max()))
    peak = float(np.nanquantile(recorded[rows, columns], _BRIGHT))
    plot = plots.Plot(11.7)
    (first, *above), (axes, *below) = plot.panels(2, 3)
    plots.show(first, recorded[rows, columns], "Recorded", peak=peak)
    for light, simulated, difference in zip(LIGHTS, above, below, strict=True):
        plots.show(simulated, predicted[light][rows, columns], f"Simulated by {light}", peak=peak)
        # 0.2: Difference, over bright pixels, that has the strongest colour.
        shades = plots.show_difference(difference, ((recorded - predicted[light]) / peak)[rows, columns], 0.2)
        plots.annotate(difference, title=f"Recorded less {light}")
    plot.colour_bar(shades, below, "of bright pixels")
    axes.set_frame_on(True)
    row = (rows.start + rows.stop) // 2
    length = int(4 * part.model.pitch.max())
    images = {"recorded": recorded, **predicted}.items()
    for (name, image), style, colour in zip(images, ("o", "-", "-"), ("#8a94a3", plots.INK, "#d1495b"), strict=True):
        axes.plot(image[row, columns][:length] / peak, style, color=colour, markersize=3, label=name)
    axes.set(yticks=[0, 0.5, 1], ylim=(0, None))
    axes.tick_params(labelsize=8)
    axes.legend(frameon=False, fontsize=8)
    plots.annotate(axes, title="A line of pixels", foot="pixels")
    return plot


def _picture(study: Study, values: Array) -> Array:
    """Return a part's values as a picture, cut to the box of the study."""
    image = np.full(study.pictures.white.shape, np.nan)
    image.flat[study.part("waves").pixel] = values
    left, top, right, bottom = (round(side) for side in study.box)
    return image[top:bottom, left:right]


def _most_structured(image: Array, size: int) -> tuple[slice, slice]:
    """Return the square of a size within an image whose pixels differ most from their neighbours."""
    change = np.nan_to_num(np.abs(np.diff(image, axis=0)[:, 1:]) + np.abs(np.diff(image, axis=1)[1:]))
    size = min(size, *change.shape)
    total = oaconvolve(change, np.ones((size, size)), "valid")
    row, column = np.unravel_index(total.argmax(), total.shape)
    return slice(int(row), int(row) + size), slice(int(column), int(column) + size)


@plots.styled
def slices(study: Study) -> plots.Plot:
    """Return a figure of the scene's planes, by waves and by rays, from all pixels."""
    scenes = {light: planes_of(study, light) for light in LIGHTS}
    by_structure = sorted(scenes["waves"], key=lambda distance: -np.ptp(scenes["waves"][distance]))
    # Planes of the scene that are shown.
    chosen = sorted(by_structure[:5])
    across, down = study.part("waves").lenses
    plot = plots.Plot(2.2 * len(chosen) + 0.3)
    panels = plot.panels(len(LIGHTS), len(chosen), down / across)
    for row, light in zip(panels, LIGHTS, strict=True):
        for axes, distance in zip(row, chosen, strict=True):
            image = scenes[light][distance]
            peak = float(np.quantile(image, _BRIGHT))
            label = f"{distance:.4g} mm" if study.camera.objective is None else f"{1000 * distance:+.1f} µm"
            plots.show(axes, image, f"{label} by {light}", peak=peak, size=8)
    return plot


def planes_of(study: Study, light: str) -> dict[float, Array]:
    """Return the planes of a scene by distance, within the part, in light per area of the finest elements."""
    scene, _ = study.scene(light)
    projector = study.projector(light)
    planes = {}
    for plane, image in zip(projector.planes, projector.split(scene), strict=True):
        edge = projector.reach * plane.across
        planes[plane.distance] = image[edge:-edge, edge:-edge] * plane.across**2
    return planes
