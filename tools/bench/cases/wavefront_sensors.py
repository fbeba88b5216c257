"""Wavefront sensors: images and spots against HCIPy's microlens arrays, and how linear their signals are."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsuba_plenoptic import CaptureOperator, PhaseScreen, PlenopticCamera
from mitsuba_plenoptic.far_sources import star
from mitsuba_plenoptic.lenses.thin import Wavefront
from mitsuba_plenoptic.wavefront import Slopes, modes_from_slopes, spot_slopes

from .. import Row, case
from ..measures import relative
from ..registry import FIGURES, figure

PAGE = "docs/theory/wavefront_sensing.md"
WAVELENGTH = 633.0
PITCH, MICROLENS, PIXEL = 0.32e-3, 16e-3, 10e-6
DIAMETER, FOCAL_LENGTH, MAGNIFICATION = 10e-3, 0.5, 0.32
"""Both presets, in metres as HCIPy has them."""

MODES = {2: "tilt", 4: "defocus", 5: "astigmatism", 7: "coma", 11: "spherical aberration"}
SMALL, STRENGTHS = 0.05, (0.1, 0.25, 0.35, 0.5)
"""Strengths in waves root mean square: that which defines the slope of the response, and others."""


def cells(image: NDArray[Any], pixels: int) -> NDArray[Any]:
    """Return the cells of the lenses, (rows, columns, pixels, pixels)."""
    rows, columns = (size // pixels for size in image.shape)
    return image.astype(float).reshape(rows, pixels, columns, pixels).transpose(0, 2, 1, 3)


def lit(image: NDArray[Any], pixels: int) -> NDArray[np.bool_]:
    """Return which lenses are lit all over."""
    power = cells(image, pixels).sum((2, 3))
    return np.asarray(power > 0.9 * np.median(power[power > 0.3 * power.max()]))


def centroids(image: NDArray[Any], pixels: int) -> NDArray[np.float64]:
    """Return the centroids of all cells in pixels, (2, rows, columns)."""
    each, index = cells(image, pixels), np.arange(pixels) - (pixels - 1) / 2
    return np.stack([each.sum(2) @ index, each.sum(3) @ index]) / each.sum((2, 3))


def spots(image: NDArray[Any], pixels: int) -> NDArray[np.float64]:
    """Return the positions of spots in pixels by the phase of the first Fourier coefficient of their cells.

    Other than the centroid it hardly depends on the tails of spots, which the borders of the cells cut off.
    """
    each, waves = cells(image, pixels), np.exp(2j * np.pi * (np.arange(pixels) - (pixels - 1) / 2) / pixels)
    return np.angle(np.stack([each.sum(2) @ waves, each.sum(3) @ waves])) * pixels / (2 * np.pi)


def capture(camera: PlenopticCamera) -> NDArray[np.float32]:
    """Return the image of a star on the axis."""
    points, weights = star()
    return CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field").forward(weights)


def aberrated(hcipy: Any, grid: Any, diameter: float, ratio: float) -> Any:
    """Return a wavefront in a round aperture: of Zernike terms, or behind turbulence of a D/r0 if that is not 0."""
    aperture = hcipy.evaluate_supersampled(hcipy.make_circular_aperture(diameter), grid, 8)
    wavefront = hcipy.Wavefront(hcipy.Field(aperture + 0j, grid), WAVELENGTH * 1e-9)
    if ratio:
        strength = hcipy.Cn_squared_from_fried_parameter(diameter / ratio, WAVELENGTH * 1e-9)
        wavefront = hcipy.FiniteAtmosphericLayer(grid, strength, L0=100 * diameter, seed=1).forward(wavefront)
    else:
        terms = 0.1 * np.random.default_rng(2).normal(size=18)
        modes = hcipy.make_zernike_basis(18, diameter, grid, starting_mode=4)
        phase = 2 * np.pi * sum(term * mode for term, mode in zip(terms, modes, strict=True))
        wavefront.electric_field *= np.exp(1j * phase)
    wavefront.total_power = 1
    return wavefront


def shack_hartmann(hcipy: Any, optics: Any, finer: int, ratio: float) -> tuple[Any, Any]:
    """Return HCIPy's image and ours of the same wavefront on the pupil's image."""
    # HCIPy has the centre of a lens on the axis, and here as many whole cells as lenses.
    pixels = 352
    camera = PlenopticCamera.preset("shack_hartmann").replace(
        mla_offset=(PITCH * 500, PITCH * 500), detector_width=pixels * PIXEL * 1e3, resolution=(pixels, pixels)
    )
    width, beam = pixels * PIXEL, DIAMETER * MAGNIFICATION
    grid = hcipy.make_pupil_grid(pixels * finer, width)
    given = aberrated(hcipy, grid, beam, ratio)
    sensor = hcipy.SquareShackHartmannWavefrontSensorOptics(grid, MICROLENS / PITCH, round(beam / PITCH), beam)
    theirs = binned(sensor.forward(given).power.shaped, finer)
    # The collimator images the pupil upside down.
    pupil = hcipy.make_pupil_grid(grid.dims, width / MAGNIFICATION)
    turned = hcipy.Wavefront(hcipy.Field(given.electric_field.shaped[::-1, ::-1].ravel(), pupil), WAVELENGTH * 1e-9)
    turned.total_power = 1
    return theirs, optics(camera).forward(turned).shaped


def in_focus(hcipy: Any, optics: Any, finer: int, ratio: float) -> tuple[Any, Any]:
    """Return the same for the array in the focus."""
    camera, pixels = PlenopticCamera.preset("telescope"), 256
    pupil = hcipy.make_pupil_grid(256, DIAMETER * 1.024)
    focus = hcipy.make_pupil_grid(pixels * finer, pixels * PIXEL)
    given = aberrated(hcipy, pupil, DIAMETER, ratio)
    field = hcipy.FraunhoferPropagator(pupil, focus, focal_length=FOCAL_LENGTH).forward(given)
    # Fraunhofer's integral leaves out the curvature of the field in the focal plane.
    field.electric_field *= np.exp(1j * np.pi * (focus.x**2 + focus.y**2) / (WAVELENGTH * 1e-9 * FOCAL_LENGTH))
    centres = (np.arange(10) - 4.5) * PITCH
    array = hcipy.MicroLensArray(focus, hcipy.CartesianGrid(hcipy.SeparatedCoords((centres, centres))), MICROLENS)
    # By default it averages its transfer function over two samples and so loses 0.6 % of this light.
    behind = hcipy.FresnelPropagator(focus, MICROLENS, num_oversampling=1).forward(array.forward(field))
    return binned(behind.power.shaped, finer), optics(camera).forward(given).shaped


def binned(samples: NDArray[Any], finer: int) -> NDArray[Any]:
    """Sum samples over pixels."""
    rows, columns = (size // finer for size in samples.shape)
    return np.asarray(samples.reshape(rows, finer, columns, finer).sum((1, 3)))


@case(
    "wavefront-sensors.hcipy",
    "A Shack-Hartmann sensor and an array in the focus against HCIPy's microlens arrays on the same wavefronts",
    FIGURES,
    page=PAGE,
    quick={"finer": 2, "ratios": (0.0,)},
    needs=("hcipy",),
)
def against_hcipy(*, finer: int = 4, ratios: tuple[float, ...] = (0.0, 10.0)) -> Iterator[Row]:
    """Compare images and spots; `finer` is the count of HCIPy's samples in a pixel, `ratios` are D/r0."""
    hcipy, optics = importlib.import_module("hcipy"), importlib.import_module("mitsuba_plenoptic.hcipy").CameraOptics
    pixels = round(PITCH / PIXEL)
    for ratio in ratios:
        name = f"turbulence, D/r0 = {ratio:g}" if ratio else "18 Zernike terms of 0.1 waves"
        for sensor, make in (("Shack-Hartmann", shack_hartmann), ("array in the focus", in_focus)):
            theirs, ours = make(hcipy, optics, finer, ratio)
            # HCIPy's error falls with its step: 1 % at two samples in a pixel.
            bound = 0.01 if finer >= 4 else 0.02
            yield figure(
                f"{sensor}, {name}: image, relative L2", 100 * relative(ours, theirs), at_most=100 * bound, unit="%"
            )
            if make is shack_hartmann:
                apart = (centroids(ours, pixels) - centroids(theirs, pixels))[:, lit(theirs, pixels)]
                most = 0.01 if finer >= 4 else 0.03
                yield figure(
                    f"{sensor}, {name}: spots, largest difference", np.abs(apart).max(), at_most=most, unit="pixels"
                )


@case(
    "wavefront-sensors.linearity",
    "Slopes of a Shack-Hartmann sensor against the strength of aberrations, and where an array in the focus saturates",
    FIGURES,
    page=PAGE,
    quick={"modes": (2,)},
)
def linearity(*, modes: tuple[int, ...] = tuple(MODES)) -> Iterator[Row]:
    """Measure the responses to Zernike terms by their Noll indices, up to half a wave root mean square."""
    camera, pixels = PlenopticCamera.preset("shack_hartmann"), round(PITCH / PIXEL)
    flat = capture(camera)
    seen, still = lit(flat, pixels), spots(flat, pixels)

    def response(mode: int, strength: float) -> NDArray[np.float64]:
        image = capture(camera.replace(wavefront=[0.0] * (mode - 1) + [strength]))
        return (spots(image, pixels) - still)[:, seen] / strength

    for mode in modes:
        unit = response(mode, SMALL)
        worst = max(relative(response(mode, strength), unit) for strength in STRENGTHS)
        what = f"Shack-Hartmann, {MODES[mode]} up to 0.5 waves: largest deviation of slopes from linear"
        yield figure(what, 100 * worst, at_most=1, unit="%")
        if mode == 2:
            # A tilt of a waves root mean square has the slope 2 a / radius.
            slope = 2 * WAVELENGTH * 1e-9 / (DIAMETER / 2)
            expected = -slope / MAGNIFICATION * MICROLENS / PIXEL
            error = 100 * abs(float(np.median(unit[0])) / expected - 1)
            yield figure("Shack-Hartmann, tilt: slopes against geometry", error, at_most=1, unit="%")
    yield from saturation()


def saturation() -> Iterator[Row]:
    """Follow the first moment of the light over lenses, as a star moves from the corner of four lenses into one."""
    camera, pixels = PlenopticCamera.preset("telescope"), round(PITCH / PIXEL)
    places = (np.arange(camera.lens_count[0]) - (camera.lens_count[0] - 1) / 2) * PITCH * 1e3

    def moment(strength: float) -> float:
        power = cells(capture(camera.replace(wavefront=[0.0, strength])), pixels).sum((0, 2, 3))
        return float(power @ places / power.sum())

    unit = moment(0.01) / 0.01
    strengths = np.array([0.02, 0.04, 0.06, 0.08, 0.1, 0.125, 0.15, 0.2, 0.3, 0.5, 1.0])
    ratios = np.array([moment(strength) / (unit * strength) for strength in strengths])
    for loss in (0.1, 0.5):
        found = float(np.interp(-(1 - loss), -ratios, strengths))
        yield figure(f"array in the focus, tilt: strength at which the signal has lost {loss:.0%}", found, unit="waves")
    yield figure("array in the focus, tilt: signal at 1 wave over that at 0.5 waves", 2 * ratios[-1] / ratios[-2])


@case(
    "wavefront-sensors.slopes",
    "Zernike terms from the slopes of a Shack-Hartmann sensor against the truth",
    FIGURES,
    page="docs/theory/wavefront_reconstruction.md",
    quick={"strengths": (0.3,), "modes": 4},
)
def slopes(*, strengths: tuple[float, ...] = (0.05, 0.3, 1.0), modes: int = 11) -> Iterator[Row]:
    """Fit the slopes of captures of single terms, less those of a flat wavefront, up to a Noll index."""
    camera = PlenopticCamera.preset("shack_hartmann")

    def measured(wavefront: NDArray[Any]) -> Slopes:
        image = capture(camera.replace(wavefront=wavefront))
        size, distance = 1e3 * PIXEL, 1e3 * MICROLENS
        return spot_slopes(
            image, pixels_per_lens=32, pixel_size=size, focal_length=distance, magnification=-MAGNIFICATION
        )

    flat = measured(np.zeros(modes))
    for strength in strengths:
        seen = [measured(strength * term) for term in np.eye(modes)[1:]]
        less = [replace(each, slope=each.slope - flat.slope) for each in seen]
        for words, every in (("less those of a flat wavefront", less), ("as measured", seen)):
            found = np.array([modes_from_slopes(each, camera.aperture_radius, modes) for each in every]) / strength
            error = found - np.eye(modes)[1:]
            own, most = np.abs(np.diag(error, 1)).max(), 2 if every is less else None
            name = f"terms of {strength:g} waves, slopes {words}"
            yield figure(f"{name}: largest error of a term", 100 * own, at_most=most, unit="%")
            others = np.abs(error - np.diag(np.diag(error, 1), 1)[:-1]).max()
            yield figure(f"{name}: largest other term", 100 * others, at_most=most and 4, unit="%")


@case(
    "wavefront-sensors.screens",
    "Screens sampled from Zernike terms against the terms themselves",
    FIGURES,
    page=PAGE,
    quick={"samples": (128,)},
)
def screens(*, samples: tuple[int, ...] = (32, 64, 128)) -> Iterator[Row]:
    """Compare captures with screens of several counts of samples across the pupil."""
    terms = [0.0, *0.15 * np.random.default_rng(1).normal(size=20)]
    for preset in ("telescope", "shack_hartmann"):
        camera = PlenopticCamera.preset(preset)
        exact = capture(camera.replace(wavefront=terms))
        for count in samples:
            width = DIAMETER * 1e3 * (1 + 2 / count)
            places = np.linspace(-width / 2, width / 2, count)
            path = Wavefront(terms, camera.aperture_radius).path(*np.meshgrid(places, places))
            screen = PhaseScreen(path / (WAVELENGTH * 1e-6), width)
            error = relative(capture(camera.replace(phase_screen=screen)), exact)
            most = 1e-4 if count >= 128 else None
            yield figure(f"{preset}, {count} samples across: image, relative L2", error, at_most=most)
