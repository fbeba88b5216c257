"""Microlens arrays: lattices on the whole detector, and focused cameras against an unfocused one.

Point spreads behind microlenses of any shape against propagation of the same path on a finer grid.

The reference takes the field before the array, and shares nothing else with the package: it multiplies a grid four
times as fine by the path of each lens, computed here from the shapes' definitions, and propagates it by its angular
spectrum.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from mitsuba_plenoptic import Capture, PlenopticCamera, design, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.light.lens_kinds import irregularities
from mitsuba_plenoptic.light.microlens_orders import PlaneFactor, axis_orders
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.microlens import Conic, MicrolensShape, PhaseMap, Sampled, ZoneLens
from mitsuba_plenoptic.points.full_field import point_fields
from mitsuba_plenoptic.points.point_spread import point_spread_function
from mitsuba_plenoptic.report.experiment import thin_lens_image
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.report.metrics import square_sharpness
from mitsuba_plenoptic.views import estimate_lens_grid
from mitsuba_plenoptic.views.lens_grid import micro_image_centres

from .. import Row, at_most, case, pick
from ..measures import agreement, relative, scores, write_comparison

LATTICES = {
    "square": {},
    "square, turned by 0.3 degrees, moved": {"mla_rotation": "0.3", "mla_offset": "0.021, -0.008"},
    "square, turned by 13 degrees, discs of 0.8": {"mla_rotation": "13", "mla_aperture": "circle", "mla_fill": "0.8"},
    "hexagonal": {"mla_lattice": "hexagonal"},
    "hexagonal, turned by 0.3 degrees, discs": {
        "mla_lattice": "hexagonal",
        "mla_rotation": "0.3",
        "mla_aperture": "circle",
    },
    "hexagonal, three focal lengths": {
        "mla_lattice": "hexagonal",
        "mla_focal_length": "0.49, 0.512, 0.535",
        "detector_distance": "0.512",
    },
    "rectangular, pitches of 0.064 and 0.06": {"mla_pitch": "0.064, 0.06"},
    "hexagonal, stretched to pitches of 0.064 and 0.06, turned by 0.3 degrees": {
        "mla_lattice": "hexagonal",
        "mla_pitch": "0.064, 0.06",
        "mla_rotation": "0.3",
    },
}

DISTANCES = (210.0, 240.0, 280.0)

# Half the side of the square about a centre over which its centroid is taken; the micro-images are 21.4 pixels wide.
_HALF = 13


@case(
    "arrays.lattices",
    "Lattices on the whole detector: micro-images of a white capture against the model, refocused letters against "
    "Mitsuba's thin lens",
    {
        "lattice": "{lattice}", "lenses": "{lenses}", "centres, largest error (px)": "{largest:.3f}",
        "RMS (px)": "{rms:.3f}", "white mean / closed form": "{white_mean:.4f}",
        "estimated grid, RMS (px)": "{estimated:.4f}",
        "refocused at 210, 240, 280 mm (dB)": "{psnr_db[0]:.1f}, {psnr_db[1]:.1f}, {psnr_db[2]:.1f}",
    },
    (at_most("largest", "limit"),),
    page="docs/theory/image_quality.md",
    quick={"spp": 16, "reference_spp": 16, "lattices": ("square",)},
)  # fmt: skip
def lattices(
    output: Path, *, spp: int = 64, reference_spp: int = 1024, lattices: tuple[str, ...] = ()
) -> Iterator[Row]:
    """Render the white scene and the letters with each lattice; the grid is estimated from the white capture alone."""
    references: list[np.ndarray] = []
    for number, (name, parameters) in enumerate(pick(LATTICES, lattices).items()):
        white = render_capture(load_scene("white", parameters=parameters), spp=spp)
        centres = micro_image_centres(white.camera, 0)
        size = np.array(white.image.shape[::-1])
        centres = centres[((centres > _HALF + 1) & (centres < size - _HALF - 1)).all(1)]
        error = np.hypot(*(centroids(white.image, centres) - centres).T)
        estimated = cKDTree(estimate_lens_grid(white.image).centres().reshape(-1, 2)).query(centres)[0]
        scene = load_scene("letters", parameters=parameters)
        capture = render_capture(scene, spp=spp)
        if not references:
            references = [thin_lens_image(scene, capture.camera, g, reference_spp) for g in DISTANCES]
        images = [result.image.astype(np.float64) for result in reconstruct(capture, DISTANCES)]
        yield {
            "lattice": name,
            "lenses": len(centres),
            "largest": float(error.max()),
            # Grown by the noise of fewer samples.
            "limit": 0.07 * math.sqrt(64 / spp),
            "rms": float(np.sqrt(np.mean(error**2))),
            "white_mean": mean(white) / design.white_mean(white.camera),
            "estimated": float(np.sqrt(np.mean(estimated**2))),
            "psnr_db": [psnr for psnr, _ in agreement(images, references)[1]],
        }
        write_png(output / f"white_{number}.png", white.image[-256:, -256:], peak=1.0)
        write_png(output / f"letters_{number}.png", np.concatenate(images, axis=1), peak=1.0)


def centroids(image: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Centroid of the image in a square about each centre."""
    base = np.floor(centres).astype(int)
    window = np.arange(-_HALF, _HALF + 1)
    x, y = (base[:, axis, None] + window for axis in (0, 1))
    patch = image[y[:, :, None], x[:, None, :]].astype(np.float64)
    moments = [(patch.sum(1) * (x + 0.5)).sum(1), (patch.sum(2) * (y + 0.5)).sum(1)]
    return np.stack(moments, axis=-1) / patch.sum((1, 2))[:, None]


def mean(white: Capture) -> float:
    """Mean under a window that lets the pattern of the lenses average out."""
    down, across = (np.hanning(n + 2)[1:-1] for n in white.image.shape)
    return float(down @ white.image.astype(np.float64) @ across / (down.sum() * across.sum()))


FOCUS = 240.0

WAVELENGTH = 633.0

CAMERAS = {"unfocused": "chart", "keplerian": "keplerian", "galilean": "galilean"}

# Of the chart at 240 mm: place and size in mm, see its scene.
STAR, STAR_CYCLES = (0.0, 4.4), 24

EDGE, EDGE_SIDE = (0.0, -4.5), 3.0

BARS, BARS_SIZE = (0.0, 0.0), 4.2

# Modulation at which a detail counts as resolved.
RESOLVED = 0.1

"""Modulation from which on a detail counts as resolved."""


@functools.cache
def chart_capture(name: str, model: str, spp: int) -> Capture:
    """Render the chart by one of the cameras."""
    options = {"model": "wave", "wavelength": WAVELENGTH} if model == "wave" else {}
    return render_capture(load_scene(CAMERAS[name]), spp=spp, **options)


@case(
    "arrays.focused-agreement",
    "Focused cameras and an unfocused one, refocused by rays to 240 mm, against Mitsuba's thin lens",
    {
        "camera": "{camera}", "scene": "{scene}", "bins per lens": "{bins_per_lens}", "PSNR (dB)": "{psnr_db:.1f}",
        "correlation": "{correlation:.4f}", "scale": "{scale:.3f}",
    },
    page="docs/theory/image_quality.md",
    quick={"spp": 2, "reference_spp": 16, "cameras": ("keplerian",)},
)  # fmt: skip
def focused_agreement(
    output: Path, *, spp: int = 64, reference_spp: int = 1024, cameras: tuple[str, ...] = ()
) -> Iterator[Row]:
    """Compare letters and chart, with one bin a lens and as many as suit the camera."""
    for name, scene_name in pick(CAMERAS, cameras).items():
        chart = load_scene(scene_name)
        camera = PlenopticCamera.from_sensor(chart.sensors()[0])
        names = ("aperture_radius", "mla_distance", "mla_focal_length", "detector_distance")
        letters = load_scene("letters", parameters={each: str(getattr(camera, each)) for each in names})
        for subject, scene in (("letters", letters), ("chart", chart)):
            taken = chart_capture(name, "ray", spp) if scene is chart else render_capture(scene, spp=spp)
            for oversample in sorted({1, design.suitable_oversample(camera, FOCUS)}):
                reference = thin_lens_image(scene, camera, FOCUS, reference_spp // oversample, oversample)
                image = reconstruct(taken, FOCUS, oversample=oversample).image.astype(np.float64)
                scale, (score,) = scores([image], [reference])
                yield {"camera": name, "scene": subject, "bins_per_lens": oversample, **score}
                write_comparison(output / f"{subject}_{name}_{oversample}.png", scale * image, reference)


@case(
    "arrays.focused-resolution",
    "Resolution of focused cameras and an unfocused one: modulation along circles round a Siemens star, which ends at "
    "38 lp/mm, and the MTF of slanted edges",
    {
        "camera": "{camera}", "capture": "{model}", f"star resolved to {RESOLVED:.0%} (lp/mm)": "{resolved:.1f}",
        "samples per lens": "{samples:.1f}", "expected": "{expected:.1f}", "MTF50 (lp/mm)": "{mtf50:.1f}",
        "edge width (um)": "{edge:.0f}",
    },
    page="docs/theory/image_quality.md",
    quick={"spp": 2, "cameras": ("keplerian",)},
)  # fmt: skip
def focused_resolution(
    output: Path, *, spp: int = 64, cameras: tuple[str, ...] = (), models: tuple[str, ...] = ("ray",)
) -> Iterator[Row]:
    """Measure the finest detail of the chart."""
    tiles = []
    for name in pick(CAMERAS, cameras):
        for model in models:
            taken = chart_capture(name, model, spp)
            row, image = _resolution(taken, max(design.suitable_oversample(taken.camera, FOCUS), 10))
            yield {"camera": name, "model": model, **row}
            tiles.append(image)
    write_png(output / "bars.png", np.concatenate(tiles, 1), peak=1.0)


def _resolution(capture: Capture, oversample: int) -> tuple[Row, np.ndarray]:
    """Measure a capture of the chart; return its bars as a picture, too."""
    result = reconstruct(capture, FOCUS, oversample=oversample)
    image, bin_size = result.image.astype(np.float64), result.bin_size

    def position(point: tuple[float, float]) -> tuple[float, float]:
        """Row and column of a point of the chart, from the image's corner; +x is left."""
        return image.shape[0] / 2 - point[1] / bin_size, image.shape[1] / 2 - point[0] / bin_size

    limit = _resolved_frequency(image, *position(STAR), bin_size)
    edge = square_sharpness(image, *position(EDGE), EDGE_SIDE / bin_size)
    wavelength = WAVELENGTH if capture.model == "wave" else None
    row, column = position(BARS)
    half = round(BARS_SIZE / 2 / bin_size)
    window = image[round(row) - half : round(row) + half, round(column) - half : round(column) + half]
    index = (np.arange(480) * window.shape[0]) // 480
    return {
        "resolved": limit,
        "samples": 2 * limit * bin_size * oversample,
        "expected": design.effective_resolution(capture.camera, FOCUS, wavelength).samples_per_lens,
        "mtf50": edge.mtf50 / bin_size,
        "edge": 1e3 * edge.width * bin_size,
    }, window[np.ix_(index, index)]


def _resolved_frequency(image: np.ndarray, row: float, column: float, bin_size: float) -> float:
    """Frequency in line pairs per mm, from the rim inwards, at which the star's modulation falls below the limit."""
    last = math.nan
    for radius in np.geomspace(1.9, 0.11, 120):
        angle = 2 * math.pi * np.arange(1440) / 1440
        # Rows and columns of pixel centres are half a bin from its corner.
        path = row - 0.5 - radius / bin_size * np.sin(angle), column - 0.5 + radius / bin_size * np.cos(angle)
        values = map_coordinates(image, path, order=1)
        spectrum = np.fft.rfft(values)
        # A square wave's first harmonic is 4/pi of its mean; full modulation is 1.
        modulation = 2 * abs(spectrum[STAR_CYCLES]) / abs(spectrum[0]) * math.pi / 4
        if modulation < RESOLVED:
            break
        last = STAR_CYCLES / (2 * math.pi * radius)
    return last


GREEN = 550.0
ACROSS = np.linspace(-0.033, 0.033, 67)
X, Y = np.meshgrid(ACROSS, ACROSS)


def bumpy(x: Any, y: Any) -> Any:
    """Return the height of a freeform: a dome with coma and astigmatism."""
    r2 = x * x + y * y
    return -(r2 / 0.5) * (1 + 0.8 * x - 0.5 * y) + 0.1 * (x * x - y * y)


def metasurface(x: Any, y: Any, wavelength: float) -> Any:
    """Return the phase in waves of a lens that is the same at two wavelengths."""
    return -(np.sqrt(x * x + y * y + 0.5**2) - 0.5) / (wavelength * 1e-6)


SHAPES: dict[str, MicrolensShape] = {
    "sphere": Conic(0.25),
    "asphere": Conic(0.25, -0.5, (30.0, -2e3), {"index": 1.5168, "abbe": 64.2}),
    "sampled": Sampled(bumpy(X, Y), 0.066),
    "zones": ZoneLens(0.5, 532.0),
    "relief": PhaseMap(metasurface(X, Y, 532.0) % 1, 0.066, 532.0, relief=True),
    "metasurface": PhaseMap([metasurface(X, Y, each) % 1 for each in (500.0, 600.0)], 0.066, (500.0, 600.0)),
}


def path_of(name: str, x: Any, y: Any, wavelength: float) -> Any:
    """Return the path in millimetres of a shape by its definition."""
    r2 = x * x + y * y
    if name == "sphere":
        return 0.5 * (np.sqrt(0.25**2 - r2) - 0.25)
    if name == "asphere":
        glass = Conic(1.0, glass={"index": 1.5168, "abbe": 64.2}).glass
        sag = (1 - np.sqrt(1 - 0.5 * r2 / 0.25**2)) * 0.25 / 0.5 + 30 * r2**2 - 2e3 * r2**3
        return -(glass.at(wavelength) - 1) * sag
    if name == "sampled":
        return 0.5 * bumpy(x, y)
    if name == "metasurface":
        ends = [metasurface(x, y, each) * (wavelength * 1e-6) for each in (500.0, 600.0)]
        return ends[0] + (ends[1] - ends[0]) * (wavelength - 500) / 100
    phase = -r2 / (2 * 532e-6 * 0.5) if name == "zones" else metasurface(x, y, 532.0)
    return (phase - np.floor(phase)) * 532e-6


def propagated(
    camera: PlenopticCamera,
    name: str | Callable[..., Any],
    position: NDArray[np.float64],
    wavelength: float,
    finer: int = 4,
) -> NDArray[np.float64]:
    """Return the pixels of a point's light, propagated from before the array on a finer grid.

    `name` is that of a shape, or the path as a function of the position on the array.
    """
    fields = point_fields(OpticalSystem(camera, wavelength), position)
    before, (rows, columns) = fields.mla, fields.mla.samples.shape
    spectrum = np.fft.fftshift(np.fft.fft2(before.samples.astype(complex)))
    room = [(size * (finer - 1) // 2, size * finer - size - size * (finer - 1) // 2) for size in (rows, columns)]
    light = np.fft.ifft2(np.fft.ifftshift(np.pad(spectrum, room))) * finer**2
    pitch, n, lam = before.pitch / finer, camera.mla_medium, wavelength * 1e-6
    x, y = (before.origin[axis] + np.arange(light.shape[1 - axis]) * pitch for axis in (0, 1))
    if callable(name):
        path = name(*np.meshgrid(x, y))
    else:
        cx, cy = camera.lattice.centre(*camera.lattice.cell(*np.meshgrid(x, y)))
        path = path_of(name, *camera.lattice.to_frame(x - cx, y[:, None] - cy), wavelength)
    light *= np.exp(2j * np.pi * path / lam)
    fx, fy = (np.fft.fftfreq(size, pitch) for size in light.shape[::-1])
    axial = np.sqrt(np.maximum((n / lam) ** 2 - fx**2 - fy[:, None] ** 2, 0))
    light = np.fft.ifft2(np.fft.fft2(light) * np.exp(2j * np.pi * camera.detector_distance * (axial - n / lam)))
    size = camera.pixel_size
    spectrum = np.fft.fft2(np.abs(light) ** 2) * np.sinc(fx * size) * np.sinc(fy * size)[:, None] * size**2
    # At the centres of pixels, a whole number of samples apart.
    first = [camera.pixel_coordinates(axis)[0] - place[0] for axis, place in ((0, x), (1, y))]
    spectrum *= np.exp(2j * np.pi * (fx * first[0] + fy[:, None] * first[1]))
    every = round(size / pitch)
    return np.fft.ifft2(spectrum).real[: every * camera.shape[0] : every, : every * camera.shape[1] : every]


POSITION = np.array([0.03, -0.02, 114.0])
"""Of the point, in millimetres."""

FAR = (4.0, 8.0, 16.0)
"""Phases in radians at the corner of a cell by which aspheres differ from a parabola."""


def camera_of(**microlenses: Any) -> PlenopticCamera:
    """Return a camera of two lenses across, with the angles of the paper's."""
    return PlenopticCamera(
        focal_length=40, aperture_radius=2.5, mla_distance=60, detector_width=0.128, resolution=(64, 64), **microlenses
    )


def irregular(camera: PlenopticCamera) -> Callable[..., Any]:
    """Return the path of an array of parabolic lenses that are displaced and of uneven focal lengths."""

    def path(x: Any, y: Any) -> Any:
        i, j = camera.lattice.cell(x, y)
        cx, cy = camera.lattice.centre(i, j)
        return -((x - cx) ** 2 + (y - cy) ** 2) / (2 * 0.512) / irregularities(camera, i, j)[2]

    return path


def orders() -> float:
    """Return the difference of the orders of a paraboloid's surface from those of a parabolic phase."""
    camera = PlenopticCamera(mla_medium=1.4, mla_shape=Conic(0.2, -1.0, glass=1.6))
    plain = camera.replace(mla_shape=None, mla_focal_length=camera.mla_focal_length)
    along, across = (axis_orders(plain, GREEN, 30, axis)[0] for axis in (0, 1))
    found = PlaneFactor(camera, GREEN, 31 * GREEN * 1e-6 / 0.064 * np.sqrt(2)).orders()
    middle = found.shape[0] // 2
    found = found[middle - 30 : middle + 31, middle - 30 : middle + 31]
    return relative(found, across[:, None] * along)


def arrays() -> dict[str, tuple[PlenopticCamera, str | Callable[..., Any]]]:
    """Return cameras with shaped or irregular arrays, and their paths."""
    found: dict[str, tuple[PlenopticCamera, str | Callable[..., Any]]] = {
        name: (camera_of(mla_shape=shape, mla_medium=1.3), name) for name, shape in SHAPES.items()
    }
    for phase in FAR:
        coefficient = phase * GREEN * 1e-6 / (2 * np.pi * 0.5 * (0.032 * np.sqrt(2)) ** 4)
        camera = camera_of(mla_shape=Conic(0.25, -1.0, (coefficient,)), mla_medium=1.3)
        found[f"{phase:g} rad from a parabola"] = camera, _of_cells(camera, coefficient)
    camera = camera_of(mla_jitter=(0.002, 0.03), mla_seed=3)
    found["displaced lenses"] = camera, irregular(camera)
    return found


def _of_cells(camera: PlenopticCamera, coefficient: float) -> Callable[..., Any]:
    """Return the path of paraboloids with a term of the fourth order."""

    def path(x: Any, y: Any) -> Any:
        cx, cy = camera.lattice.centre(*camera.lattice.cell(x, y))
        square = (x - cx) ** 2 + (y - cy) ** 2
        return -0.5 * (square / 0.5 + coefficient * square**2)

    return path


@case(
    "microlens-shapes",
    "Point spreads behind shaped and irregular microlenses against propagation on a finer grid, relative L2; orders of "
    "a paraboloid against those of a parabolic phase",
    {"microlenses": "{name}", "full_field": "{full_field:.2%}", "patch": "{patch:.2%}", "orders": "{orders:.1e}"},
    (at_most("full_field", "most"), at_most("patch", "most"), at_most("orders", 1e-4)),
    page="docs/guides/microlens_shapes.md",
    quick={"names": ("sphere",)},
)
def microlens_shapes(*, names: tuple[str, ...] = ()) -> Iterator[Row]:
    """Compare the spreads of a point out of focus."""
    yield {"name": "paraboloid", "orders": orders()}
    for name, (camera, path) in pick(arrays(), names).items():
        expected = propagated(camera, path, POSITION, GREEN)
        # Irregular arrays have no orders, of which patches are made.
        methods = ("full_field",) if any(camera.mla_jitter) else ("full_field", "patch")
        found = {
            method: relative(point_spread_function(camera, POSITION, wavelength=GREEN, method=method), expected)
            for method in methods
        }
        yield {"name": name, **found, "most": 0.01 if any(camera.mla_jitter) else 0.005}
