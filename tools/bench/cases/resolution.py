"""Resolution of every method of reconstruction: contrast of sinusoids, and the width of a slanted edge.

A wall that fills the view radiates a sinusoid of contrast 1, along x or turned by 30 degrees, in two phases, or an edge
turned by 5 degrees. It is captured by rays and by waves, and refocused to its own distance by every method. Contrast is
that of the sinusoid of the known frequency that fits the bins of the middle of the field best. The edge's width is that
between 10 and 90 % of the step, found from all bins by their distance from the edge (ISO 12233).

In focus contrasts are known. The sum of a lens's pixels is the mean over the lens, and the main lens has the transfer
function of a circular pupil (Goodman, "Introduction to Fourier Optics", section 6.3). A focused camera's lens images
through its own square aperture, too, whose transfer function is a triangle along each axis; pixels and bins are means.
Frequencies are given over the lens's own limit, half a period per lens. The limits by pixels and by diffraction of a
microlens are those of `design.resolution_limit`.

Bins within four lenses of the middle count. A detector of 16 lenses cuts some of their light at 210, 280 and 320 mm.
Contrasts of ray reconstructions differ by up to 0.012 from those of 26 lenses; those of 12 lenses by up to 0.02.

When rays suffice for a plenoptic camera's capture.

Cameras of several microlens f-numbers and pitches look at a Siemens star, in focus and four lenses of blur out of
focus; otherwise they are alike: the paper's main lens, stopped down so that micro-images fill two thirds of their
pitch, and 8 x 8 lenses. Captures by both models are compared: root of the summed squared differences over that of the
wave captures, free of noise, because two independent pairs take the place of the square. Averaging pixels gives larger
ones, so that the pixel size needs no captures of its own. The inexpensive approximation between both is the ray capture
convolved with the diffraction spot of a square lens.

The paper says that rays hold for wide apertures and large pixels: the difference must fall with either.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import matplotlib
import mitsuba as mi
import numpy as np
from cases import spot_filtered
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.optimize import curve_fit
from scipy.special import erf, erfinv

from mitsuba_plenoptic import Capture, PlenopticCamera, design, reconstruct, render_capture, scene_path
from mitsuba_plenoptic.design import focus_type, lens_footprint, pixel_footprint, resolution_limit, spot_radius
from mitsuba_plenoptic.extensions.paper.paper_limits import focused_cameras

from .. import Pivot, Row, at_least, at_most, case, pick

WAVELENGTH = 633.0
PATTERNS = ((0.0, 0.0), (30.0, 90.0))
"""Direction and phase of the sinusoids in degrees."""

EDGE_ANGLE = 5.0
TEXELS = 1024
CAMERAS: dict[str, dict[str, Any]] = {
    "paper": {},
    "hexagonal": {"mla_lattice": "hexagonal"},
    "keplerian": {"mla_distance": 121.536, "mla_focal_length": 0.384, "detector_distance": 0.512},
}
SUMS = "sums over lenses"
"""All light of each lens, without refocusing: in focus its contrast is known for waves, too."""

INNER = 4
"""Lenses from the middle of the field in which bins count."""

METHODS: dict[str, dict[str, Any]] = {
    SUMS: {},
    "rays, point": {"method": "ray", "footprint": "point"},
    "rays": {"method": "ray"},
    "coherent": {"method": "coherent"},
    "K = 2": {"method": "partial", "interleave": 2},
    "K = 4": {"method": "partial", "interleave": 4},
    "auto": {"method": "partial", "interleave": "auto"},
    "incoherent": {"method": "incoherent"},
    "deconvolved": {"method": "deconvolved"},
}


def camera_of(name: str, lenses: int) -> PlenopticCamera:
    """Return the paper's camera with a detector of some lenses, or another with three quarters of them."""
    lenses = lenses if name == "paper" else 3 * lenses // 4
    return PlenopticCamera(detector_width=0.064 * lenses, resolution=(32 * lenses,) * 2, **CAMERAS[name])


def captured(
    camera: PlenopticCamera, distance: float, wall: Callable[..., np.ndarray], model: str, spp: int
) -> Capture:
    """Capture a wall whose radiance is a function of the position of its bin, to the right and downwards on the MLA."""
    half = camera.detector_width / 2 + camera.blur_diameter(distance) + 2 * camera.row_pitch
    size = half * distance / camera.mla_distance
    along = half * (2 * (np.arange(TEXELS) + 0.5) / TEXELS - 1)
    # A rectangle that faces the camera has its u to the right in the image, and its v upwards.
    x, y = np.meshgrid(along, -along)
    values = np.repeat(wall(x, y)[..., None], 3, axis=2).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}
    scene = {
        "type": "scene",
        "integrator": {"type": "direct"},
        "sensor": camera.to_sensor(),
        "wall": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f()
            .translate([0, 0, distance])
            .rotate([0, 1, 0], 180)
            .scale([size, size, 1]),
            "emitter": {"type": "area", "radiance": texture},
        },
    }
    options = {"wavelength": WAVELENGTH} if model == "wave" else {}
    return render_capture(mi.load_dict(scene), model=model, spp=spp, **options)


def refocused(capture: Capture, distance: float, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (samples, channels) of a method, and their positions (2, samples) on the array."""
    camera = capture.camera
    if method == SUMS:
        values, (x, y) = sums_over_lenses(capture)
    else:
        options = dict(METHODS[method])
        if capture.model == "ray" and options["method"] == "deconvolved":
            options["response"] = "ray"
        elif capture.model == "ray" and options["method"] != "ray":
            options["wavelength"] = WAVELENGTH
        return binned(reconstruct(capture, distance, **options).image, camera)
    return inner_part(values, np.array([x, y]), camera)


def binned(image: np.ndarray, camera: PlenopticCamera, oversample: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return the bins of an image as values (samples, channels) and positions (2, samples) on the array."""
    rows, columns = image.shape[:2]
    along = ((np.arange(count) - (count - 1) / 2) * camera.row_pitch / oversample for count in (columns, rows))
    places = np.array([axis.ravel() for axis in np.meshgrid(*along)])
    return inner_part(np.asarray(image, np.float64).reshape(rows * columns, -1), places, camera)


def inner_part(values: np.ndarray, places: np.ndarray, camera: PlenopticCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples in the middle of the field; the point version leaves bins empty that hold no lens's centre."""
    inner = (np.abs(places) < INNER * camera.row_pitch).all(0) & np.isfinite(values).all(1)
    return values[inner], places[:, inner]


def sums_over_lenses(capture: Capture) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of the pixels of each lens, and the lenses' positions."""
    camera = capture.camera
    to_array = camera.mla_distance / (camera.mla_distance + camera.detector_distance)
    x, y = np.meshgrid(*(camera.pixel_coordinates(axis) * to_array for axis in (0, 1)))
    cells, lens = np.unique(np.stack(camera.lattice.cell(x.ravel(), y.ravel())), axis=1, return_inverse=True)
    channels = np.moveaxis(np.asarray(capture.image, np.float64), -1, 0)
    sums = [np.bincount(lens, pixels.ravel()) / np.bincount(lens) for pixels in channels]
    return np.stack(sums, axis=-1), np.array(camera.lattice.centre(*cells))


def contrast(values: np.ndarray, places: np.ndarray, frequency: float, angle: float) -> float:
    """Return the contrast of the sinusoid of a frequency (cycles per millimetre of the MLA) that fits best."""
    phase = 2 * np.pi * frequency * (_direction(angle) @ places)
    terms = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=-1)
    mean, cosine, sine = np.linalg.lstsq(terms, values, rcond=None)[0]
    return float(math.hypot(cosine, sine) / mean)


def edge_width(values: np.ndarray, places: np.ndarray, pitch: float) -> float:
    """Return the width between 10 and 90 % of an edge in lens pitches, of the error function that fits best."""
    aside = _direction(EDGE_ANGLE) @ places / pitch

    def step(d: np.ndarray, low: float, high: float, middle: float, width: float) -> np.ndarray:
        return low + (high - low) * (1 + erf((d - middle) / width)) / 2

    start = values[aside < 0].mean(), values[aside > 0].mean(), 0.0, 1.0
    width = curve_fit(step, aside, values, start)[0][3]
    return float(2 * erfinv(0.8) * abs(width))


def _direction(angle: float) -> np.ndarray:
    return np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])


def judged_in_focus(camera: PlenopticCamera, distance: float, model: str) -> str | None:
    """Return the method whose contrast is known in a plane, None where none is."""
    if focus_type(camera) == "unfocused":
        return (SUMS if model == "wave" or camera.mla_lattice != "square" else "rays") if (
            camera.blur_diameter(distance) < 0.1 * camera.row_pitch
        ) else None  # fmt: skip
    sharp = camera.row_pitch * lens_footprint(camera, distance, camera.mla_focal_lengths[0])
    return "rays" if sharp < 0.1 * pixel_footprint(camera, distance) else None


def in_focus(camera: PlenopticCamera, distance: float, frequency: float, angle: float, model: str) -> float:
    """Return the contrast of a plane in focus, in cycles per millimetre of the MLA."""
    if focus_type(camera) == "unfocused":
        # Of as many points in each third of a hexagon.
        grid = (np.arange(402) + 0.5) / 402
        u, v = camera.lattice.aperture_point(*np.meshgrid(grid, grid))
        lens = np.cos(2 * np.pi * frequency * (_direction(angle) @ np.stack([u.ravel(), v.ravel()]))).mean()
    else:
        # A bin; a pixel, once where it records and once where it is spread over its width; a microlens.
        across, pixel = frequency * np.abs(_direction(angle)), pixel_footprint(camera, distance)
        cutoff = camera.pixel_size / pixel / spot_radius(camera, WAVELENGTH)
        means = np.sinc(across * camera.row_pitch) * np.sinc(across * pixel) ** 2
        lens = np.prod(means * (1 - across / cutoff if model == "wave" else 1.0))
    part = frequency * WAVELENGTH * 1e-6 * camera.mla_distance / (2 * camera.aperture_radius)
    pupil = 2 / math.pi * (math.acos(part) - part * math.sqrt(1 - part * part))
    return float(lens * (pupil if model == "wave" else 1.0))


@case(
    "resolution",
    "Contrast of sinusoids of contrast 1 in the plane of refocusing, the mean over two directions and phases, by the "
    "frequency over half a period per lens; and the width of a slanted edge in lens pitches",
    {"camera": "{camera}", "capture": "{model}", "distance (mm)": "{distance:g}", "method": "{method}",
     "contrasts, edge": "{cell}", "off the closed form": "{difference:.3f}", "off rays": "{apart:.3f}"},
    (at_most("difference", 0.02), at_most("apart", 0.05)),
    page="docs/theory/accuracy.md",
    pivot=Pivot("{camera}, {model} capture, {method}", "{distance:g} mm", "{cell}"),
    quick={"distances": (240.0,), "relative": (0.5,), "methods": ("rays",), "models": ("ray",), "lenses": 12},
)  # fmt: skip
def resolution(
    output: Path,
    *,
    cameras: tuple[str, ...] = tuple(CAMERAS),
    models: tuple[str, ...] = ("ray", "wave"),
    distances: tuple[float, ...] = (210.0, 230.0, 240.0, 252.0, 280.0, 320.0),
    relative: tuple[float, ...] = (0.25, 0.5, 0.75, 0.9),
    methods: tuple[str, ...] = (),
    lenses: int = 16,
    spp: int = 8,
) -> Iterator[Row]:
    """Measure contrasts, and draw them for each camera."""
    chosen = pick(METHODS, methods)
    for name in cameras:
        camera = camera_of(name, lenses)
        rows: list[Row] = []
        for model, distance in itertools.product(models, distances):
            for row in _of_plane(camera, model, distance, relative, list(chosen), spp):
                rows.append({"camera": name, "model": model, "distance": distance, "relative": list(relative), **row})
                yield rows[-1]
        _draw(output / f"resolution_{name}.png", rows)


def _of_plane(
    camera: PlenopticCamera, model: str, distance: float, relative: tuple[float, ...], methods: list[str], spp: int
) -> Iterator[Row]:
    """Measure all methods in one plane; captures of three walls are the channels of one."""
    judged = judged_in_focus(camera, distance, model)
    methods = [method for method in methods if method != SUMS or judged == SUMS]
    nyquist = 1 / (2 * camera.row_pitch)
    waves = [(part * nyquist, angle, phase) for part in relative for angle, phase in PATTERNS]
    along, down = _direction(EDGE_ANGLE)
    walls = [*(sinusoid(*wave) for wave in waves), lambda x, y: (x * along + y * down > 0).astype(float)]
    images = [captured(camera, distance, wall, model, spp).image for wall in walls]
    images += [images[-1]] * (-len(images) % 3)
    wavelength = (WAVELENGTH,) * 3 if model == "wave" else None
    threes = zip(*[iter(images)] * 3, strict=True)
    captures = [Capture(np.stack(three, -1), camera, wavelength, model) for three in threes]
    limit = resolution_limit(camera, distance, WAVELENGTH)
    limits = {"pixels": limit.pixels / limit.lenses, "diffraction": limit.waves / limit.lenses}
    text = ", ".join(f"{key} {value:.2g}" for key, value in limits.items() if value < 100)
    yield {"method": "limits", "limits": limits, "cell": text}
    if judged:
        parts = (part * nyquist for part in relative)
        expected = np.array([np.mean([in_focus(camera, distance, f, a, model) for a, _ in PATTERNS]) for f in parts])
        yield {"method": f"closed form of {judged}", "values": expected.tolist(), "cell": _text(expected)}
    by_rays = None
    for method in methods:
        found = [refocused(capture, distance, method) for capture in captures]
        values, places = np.concatenate([part for part, _ in found], axis=-1), found[0][1]
        each = [contrast(values[:, number], places, *wave[:2]) for number, wave in enumerate(waves)]
        contrasts = np.reshape(each, (len(relative), -1)).mean(1)
        width = edge_width(values[:, len(waves)], places, camera.row_pitch)
        row = {
            "method": method,
            "values": contrasts.tolist(),
            "width": width,
            "cell": f"{_text(contrasts)}, {width:.2f}",
        }
        if method == judged:
            row["difference"] = float(np.abs(contrasts - expected).max())
        if method == "rays, point":
            by_rays = contrasts
        if method == "auto" and model == "wave" and by_rays is not None:
            # Without interference, waves back resolve what rays back do, far enough from what microlenses resolve.
            near = np.array(relative) <= min(0.5, limits["diffraction"] / 3)
            row["apart"] = float(np.abs(contrasts - by_rays)[near].max()) if near.any() else None
        yield row


def _text(contrasts: np.ndarray) -> str:
    return " ".join(f"{value:.2f}" for value in contrasts)


@case(
    "arrays.pixels-and-range",
    "Focused cameras like the paper's, and the paper's: samples across, and the range of distances in which a line of "
    "twice the finest period keeps half of its contrast in focus, in wave captures",
    {"virtual depth": "{depth:g}", "pixels across": "{pixels:.0f}", "contrast in focus": "{focus:.2f}",
     "range (mm)": "{near:.0f} to {far:.0f}", "by `design` (mm)": "{expected}", "dioptres": "{dioptres:.3f}"},
    (at_least("focus", 0.4), at_least("wider", 1.0)),
    page="docs/reference/numbers.md",
    quick={"steps": 1, "lenses": 8},
)  # fmt: skip
def pixels_and_range(*, steps: int = 6, lenses: int = 12, spp: int = 8) -> Iterator[Row]:
    """Seek the ends of each range; each coarser camera must have the wider one."""
    whole, before = PlenopticCamera(), math.nan
    for each in focused_cameras(whole, WAVELENGTH):
        size = {"detector_width": whole.row_pitch * lenses, "resolution": (32 * lenses,) * 2}
        camera, detail = each.camera.replace(**size), whole.detector_width / each.pixels
        contrast_at = functools.partial(_fine_contrast, camera, 1 / (4 * detail), spp=spp)
        focus = 1 / whole.focus_distance
        most, ends = contrast_at(1 / focus), []
        for expected in (each.near, each.far):
            # In inverse distances from focus, over that of the expected end.
            inner, outer = 0.0, 3.0
            for _ in range(steps):
                middle = (inner + outer) / 2
                kept = contrast_at(1 / (focus + middle * (1 / expected - focus))) >= most / 2
                inner, outer = (middle, outer) if kept else (inner, middle)
            ends.append(1 / (focus + (inner + outer) / 2 * (1 / expected - focus)))
        dioptres = 1e3 / ends[0] - 1e3 / ends[1]
        yield {
            "depth": each.virtual_depth, "pixels": each.pixels, "focus": most, "near": ends[0], "far": ends[1],
            "expected": f"{each.near:.0f} to {each.far:.0f}", "dioptres": dioptres,
            "wider": None if math.isnan(before) else dioptres / before,
        }  # fmt: skip
        before = dioptres


def _fine_contrast(camera: PlenopticCamera, frequency: float, distance: float, *, spp: int) -> float:
    """Return the contrast of a turned sinusoid that rays bring back from its wave capture."""
    capture = captured(camera, distance, sinusoid(frequency, *PATTERNS[1]), "wave", spp)
    oversample = math.ceil(4 * frequency * camera.row_pitch) if focus_type(camera) != "unfocused" else 1
    values, places = binned(reconstruct(capture, distance, oversample=oversample).image, camera, oversample)
    return contrast(values[:, 0], places, frequency, PATTERNS[1][0])


def sinusoid(frequency: float, angle: float, phase: float) -> Callable[..., np.ndarray]:
    """Return the radiance of a wall of contrast 1 by the position on the array; the angles are in degrees."""
    (along, down), shift = _direction(angle), math.radians(phase)
    return lambda x, y: 1 + np.cos(2 * np.pi * frequency * (x * along + y * down) + shift)


def _draw(path: Path, rows: list[Row]) -> None:
    """Draw contrast against frequency, a panel for each model and distance and a line for each method."""
    matplotlib.use("agg")
    from matplotlib import pyplot

    models, distances = (list(dict.fromkeys(row[key] for row in rows)) for key in ("model", "distance"))
    size = 2.6 * len(distances), 2.9 * len(models)
    figure, panels = pyplot.subplots(
        len(models), len(distances), figsize=size, sharex=True, sharey=True, squeeze=False, layout="constrained"
    )
    for (model, distance), axes in zip(itertools.product(models, distances), panels.flat, strict=True):
        for row in rows:
            if (row["model"], row["distance"]) != (model, distance):
                continue
            if "limits" in row:
                axes.set_title(f"{model} capture, {distance:g} mm\nlimits: {row['cell'] or 'lenses'}", size=8)
                for style, value in zip((":", "--"), row["limits"].values(), strict=True):
                    axes.axvline(value, color="#999999", linestyle=style)
            elif "width" in row:
                colour = f"C{list(METHODS).index(row['method'])}"
                axes.plot(row["relative"], row["values"], ".-", color=colour, label=row["method"], linewidth=1)
            else:
                axes.plot(row["relative"], row["values"], "k+", markersize=12, label="closed form")
        axes.set(xlim=(0.2, 1.05), ylim=(0, 1.3))
        axes.grid(color="#eeeeee")
    for axes in panels[-1]:
        axes.set_xlabel("frequency / lens limit")
    for axes in panels[:, 0]:
        axes.set_ylabel("contrast")
    lines = dict(pair[::-1] for axes in panels.flat for pair in zip(*axes.get_legend_handles_labels(), strict=True))
    columns = min(len(lines), 2 * len(distances))
    figure.legend(lines.values(), lines.keys(), fontsize=8, loc="outside lower center", ncols=columns)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


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
    page="docs/guides/waves.md",
    pivot=Pivot(
        "f/{f_number:g}, {um:g} um, Fresnel number {fresnel:.2f}", "{focus}: rays, with sinc²",
        "{rays:.1%}, {convolved:.1%}", lambda row: row["binning"] == 2,
    ),
    quick={"f_numbers": (8.0,), "pitches": (0.032,), "spp": 16},
)  # fmt: skip
def ray_limits(
    output: Path, *, f_numbers: tuple[float, ...] = F_NUMBERS, pitches: tuple[float, ...] = PITCHES, spp: int = 128
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
