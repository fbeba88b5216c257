"""When rays suffice for a plenoptic camera's capture.

Cameras of several microlens f-numbers and pitches look at a Siemens star, in focus and four lenses of blur out of
focus; otherwise they are alike: the paper's main lens, stopped down so that micro-images fill two thirds of their
pitch, and 8 x 8 lenses. Captures by both models are compared: root of the summed squared differences over that of the
wave captures, free of noise, because two independent pairs take the place of the square. Averaging pixels gives larger
ones, so that the pixel size needs no captures of its own. The inexpensive approximation between both is the ray capture
convolved with the diffraction spot of a square lens.

The paper says that rays hold for wide apertures and large pixels: the difference must fall with either.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mitsuba_plenoptic import PlenopticCamera, design, render_capture, scene_path

from .. import Pivot, Row, at_most, case
from ..measures import spot_filtered

WAVELENGTH = 633.0

F_NUMBERS = (4.0, 8.0, 16.0)

PITCHES = (0.016, 0.032, 0.064, 0.128)

LENSES = 8

FILL = 2 / 3

MLA_DISTANCE = 120.0

FOCAL_LENGTH = 80.0

BLUR = 4.0

# Pixels across the spot's half width (centre to first zero), before averaging, and how many are averaged.
PIXELS_PER_SPOT = 4

BINNING = (1, 2, 4, 8)


@case(
    "ray-limits",
    "Relative difference of ray captures, and of these convolved with the spot of a microlens, from wave captures",
    {
        "f-number": "{f_number:g}", "pitch (um)": "{um:g}", "focus": "{focus}", "Fresnel number": "{fresnel:.2f}",
        "pixel over spot": "{pixel_over_spot:.2g}", "rays": "{rays:.1%}", "with sinc^2": "{convolved:.1%}",
        "energy, rays over waves": "{energy:.4f}",
    },
    (at_most("by_pixels", 1.0), at_most("by_lenses", 1.0)),
    page="docs/howto/waves.md",
    pivot=Pivot(
        "f/{f_number:g}, {um:g} um, Fresnel number {fresnel:.2f}", "{focus}: rays, with sinc²",
        "{rays:.1%}, {convolved:.1%}", lambda row: row["binning"] == 2,
    ),
    quick={"f_numbers": (8.0,), "pitches": (0.032,), "spp": 16},
)  # fmt: skip
def ray_limits(
    output: Path,
    *,
    f_numbers: tuple[float, ...] = F_NUMBERS,
    pitches: tuple[float, ...] = PITCHES,
    spp: int = 128,
) -> Iterator[Row]:
    """Compare all cameras and draw the differences."""
    rows: list[Row] = []
    for f_number, pitch, focus in itertools.product(f_numbers, pitches, ("in focus", "out of focus")):
        for row in study(f_number, pitch, focus, spp):
            rows.append(row | falls(row, rows))
            yield rows[-1]
    plot(output / "study.png", rows)


def falls(row: Row, others: list[Row]) -> Row:
    """Return the difference of rays over that with pixels half as wide, and over that with lenses half as wide."""

    def over(**halved: float) -> float | None:
        wanted = {key: row[key] for key in ("f_number", "pitch", "focus", "binning")} | halved
        found = [each["rays"] for each in others if all(each[key] == value for key, value in wanted.items())]
        return row["rays"] / found[0] if found else None

    return {"by_pixels": over(binning=row["binning"] // 2), "by_lenses": over(pitch=row["pitch"] / 2)}


def study(f_number: float, pitch: float, focus: str, spp: int) -> list[dict[str, Any]]:
    """Compare the captures of one camera, for all pixel sizes."""
    spot = WAVELENGTH * 1e-6 * f_number
    pixels = 2 * max(1, round(pitch / spot * PIXELS_PER_SPOT / 2))
    diameter = FILL * MLA_DISTANCE / f_number
    # The blur of an object at distance g has the diameter D1 (1 + b/g - b/f1) on the microlenses.
    defocus = 0.0 if focus == "in focus" else BLUR * pitch / diameter
    distance = MLA_DISTANCE / (MLA_DISTANCE / FOCAL_LENGTH - 1 + defocus)
    camera = PlenopticCamera(
        focal_length=FOCAL_LENGTH, aperture_radius=diameter / 2, mla_distance=MLA_DISTANCE,
        mla_focal_length=f_number * pitch, mla_pitch=pitch, detector_width=LENSES * pitch,
        resolution=(LENSES * pixels, LENSES * pixels), lens_model="parabolic",
    )  # fmt: skip
    scene = star(camera, distance)
    rays = [render_capture(scene, model="ray", spp=spp, seed=seed).image.astype(np.float64) for seed in (0, 1)]
    waves = [
        render_capture(scene, model="wave", wavelength=WAVELENGTH, spp=spp, seed=seed).image.astype(np.float64)
        for seed in (2, 3)
    ]
    convolved = [spot_filtered(image, camera) for image in rays]
    return [
        {
            "f_number": f_number,
            "pitch": pitch,
            "um": 1e3 * pitch,
            "focus": focus,
            "fresnel": design.mla_fresnel_number(camera, WAVELENGTH),
            "pixel": camera.pixel_size * binning,
            "pixel_over_spot": camera.pixel_size * binning / spot,
            "binning": binning,
            "rays": difference(rays, waves, binning),
            "convolved": difference(convolved, waves, binning),
            "energy": float(rays[0].sum() / waves[0].sum()),
        }
        for binning in BINNING
        if LENSES * pixels % binning == 0
    ]


def star(camera: PlenopticCamera, distance: float) -> Any:
    """Build a Siemens star that fills four fifths of the field."""
    mesh_width = 4.0
    size = 0.8 * camera.detector_width * distance / MLA_DISTANCE / mesh_width
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 1},
            "camera": camera.to_sensor(),
            "star": {
                "type": "ply",
                "filename": str(scene_path("chart").parent / "meshes" / "star.ply"),
                "face_normals": True,
                "to_world": mi.ScalarTransform4f().translate([0, 0, distance]).scale([size, size, 1]),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.0}},
                "emitter": {"type": "area", "radiance": {"type": "spectrum", "value": 1.0}},
            },
        }
    )


def difference(pair: list[np.ndarray], references: list[np.ndarray], binning: int) -> float:
    """Relative difference of larger pixels from the reference, without the noise of two independent pairs."""
    large = [average(image, binning) for image in references]
    one, two = (average(image, binning) - wave for image, wave in zip(pair, large, strict=True))
    return math.sqrt(max(0.0, float(np.vdot(one, two))) / float(np.vdot(*large)))


def average(image: np.ndarray, binning: int) -> np.ndarray:
    """Average blocks of pixels into larger ones."""
    count = image.shape[0] // binning
    return image.reshape(count, binning, count, binning).mean(axis=(1, 3))


def plot(path: Path, rows: list[dict[str, Any]]) -> None:
    """Draw the error over the Fresnel number, and over the pixel size."""
    figure = Figure(figsize=(11, 4.9), dpi=160, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=[1.15, 1])
    colours = {"in focus": "#b3541e", "out of focus": "#2a5fa5"}
    markers = dict(zip(F_NUMBERS, ("o", "s", "^"), strict=True))
    names = {"rays": "rays", "convolved": "rays with sinc²"}
    for focus, method in itertools.product(colours, names):
        look = {"color": colours[focus], "markerfacecolor": colours[focus] if method == "rays" else "white"}
        label = f"{focus}, {names[method]}"
        chosen = [row for row in rows if row["focus"] == focus]
        for f_number, marker in markers.items():
            points = [row for row in chosen if row["f_number"] == f_number and row["binning"] == 2]
            x, y = [row["fresnel"] for row in points], [100 * row[method] for row in points]
            left.plot(x, y, marker, markersize=7, label=label if marker == "o" else None, **look)
        line = [row for row in chosen if row["f_number"] == 8 and row["pitch"] == 0.064]
        x, y = [row["pixel_over_spot"] for row in line], [100 * row[method] for row in line]
        right.plot(x, y, "o-" if method == "rays" else "o--", label=label, **look)
    left.set(xscale="log", yscale="log", xlabel="Fresnel number of a microlens, $(D_2/2)^2 / \\lambda z$")
    left.set_ylabel("difference from the wave capture (%)")
    left.set_title("Pixels of half the spot's half width", loc="left", size=10)
    for f_number, marker in markers.items():
        left.plot([], [], marker, color="#777777", label=f"microlens f/{f_number:g}")
    left.legend(fontsize=8, frameon=False)

    right.set(xscale="log", yscale="log", xlabel="pixel over the spot's half width, $p D_2 / \\lambda z$")
    right.set_title("The paper's microlenses: f/8, 64 µm", loc="left", size=10)
    right.legend(fontsize=8, frameon=False)
    left.set_xticks([0.5, 1, 2, 5, 10], ["0.5", "1", "2", "5", "10"])
    right.set_xticks([0.25, 0.5, 1, 2], ["0.25", "0.5", "1", "2"])
    for axes in (left, right):
        axes.grid(which="both", color="#e4e4e4", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_yticks([5, 10, 20, 50], ["5", "10", "20", "50"])
        axes.set_ylim(3.5, 80)
        axes.minorticks_off()
    figure.savefig(path)
