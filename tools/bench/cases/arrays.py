"""Point spreads behind microlenses of any shape against propagation of the same path on a finer grid.

The reference takes the field before the array, and shares nothing else with the package: it multiplies a grid four
times as fine by the path of each lens, computed here from the shapes' definitions, and propagates it by its angular
spectrum.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from cases import relative
from numpy.typing import NDArray

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.array import Conic, MicrolensShape, PhaseMap, Sampled, ZoneLens
from mitsuba_plenoptic.fields.microlens_orders import PlaneFactor, axis_orders
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.points.full_fields import point_fields
from mitsuba_plenoptic.points.point_spread import point_spread_function

from .. import Row, at_most, case, pick

# Half the side of the square about a centre over which its centroid is taken; the micro-images are 21.4 pixels wide.
_HALF = 13


def centroids(image: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Centroid of the image in a square about each centre."""
    base = np.floor(centres).astype(int)
    window = np.arange(-_HALF, _HALF + 1)
    x, y = (base[:, axis, None] + window for axis in (0, 1))
    patch = image[y[:, :, None], x[:, None, :]].astype(np.float64)
    moments = [(patch.sum(1) * (x + 0.5)).sum(1), (patch.sum(2) * (y + 0.5)).sum(1)]
    return np.stack(moments, axis=-1) / patch.sum((1, 2))[:, None]


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
        lens = camera.lenslet(*camera.lattice.cell(x, y))
        return -((x - lens.centre[0]) ** 2 + (y - lens.centre[1]) ** 2) / (2 * lens.focal_length)

    return path


def orders() -> float:
    """Return the difference of the orders of a paraboloid's surface from those of a parabolic phase."""
    camera = PlenopticCamera(mla_medium=1.4, mla_shape=Conic(0.2, -1.0, glass=1.6))
    plain = camera.replace(mla_shape=None, mla_focal_length=camera.mla_focal_lengths[0])
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
