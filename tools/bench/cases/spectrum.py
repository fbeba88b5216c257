"""Colour: focal lengths and their shift, bands against dense quadrature, many wavelengths of the letters.

Lateral colour of real lenses, measured in captures and drawn.

The scene is flat and in focus: letters of sharp edges in the middle and towards a corner, and a small square in that
corner. The lenses have the focal length and focus of the paper's camera. The singlet stands behind its stop, as
those of box cameras do, which makes lateral colour that can be seen. Light is that of the illuminant D65, and channels
answer as sRGB has it. The pictures are refocused by a thin lens in the position of the exit pupil, under which all
light of a lens goes into its bin.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.stats import qmc

from mitsuba_plenoptic import (
    Capture,
    CaptureOperator,
    LensSystem,
    PlenopticCamera,
    Prescription,
    Spectrum,
    load_scene,
    reconstruct,
    render_capture,
)
from mitsuba_plenoptic.light.scene_light import SceneLight
from mitsuba_plenoptic.optics.spectrum import RGB_WAVELENGTHS
from mitsuba_plenoptic.points.scene_points import find_points
from mitsuba_plenoptic.points.spectral import with_enough_nodes
from mitsuba_plenoptic.prescription import Surface, bundled_prescription, paraxial
from mitsuba_plenoptic.prescription.glass import LINE_C, LINE_D, LINE_F
from mitsuba_plenoptic.report.plots import Plot, show

from .. import Row, at_most, case, figure, pick
from ..measures import relative
from ..timing import once

LOW, HIGH, COUNT = 400.0, 700.0, 31

ERROR, TIMES = 0.003, 10.0

PER_LENS, TRIED = 16, 6
"""Points that rays find from each lens, and how many of all of them choose the nodes."""

CROWN = {"index": 1.5168, "abbe": 64.17}

POINTS = ((0.0, 0.0, 240.0), (0.3, 0.2, 210.0), (0.3, -0.4, 280.0))


@case(
    "spectrum.focal-lengths",
    "Focal lengths of the bundled singlet against the closed form of a thick lens, chromatic shifts against f / V",
    page="docs/guides/colour.md",
)
def focal_lengths() -> Iterator[Row]:
    """Compare 31 wavelengths."""
    lens = bundled_prescription("singlet")
    first, second = lens.surfaces
    c1, c2, t = first.curvature, second.curvature, first.thickness
    worst = 0.0
    for wavelength in np.linspace(LOW, HIGH, COUNT):
        n = lens.indices(float(wavelength))[0]
        power = (n - 1) * (c1 - c2 + (n - 1) * t * c1 * c2 / n)
        worst = max(worst, abs(paraxial(lens, float(wavelength)).focal_length * power - 1))
    yield figure("focal length of the singlet against the closed form", worst, at_most=1e-6)
    d, f, c = (lens.indices(line)[0] for line in (LINE_D, LINE_F, LINE_C))
    shift = paraxial(lens, LINE_C).focal_length - paraxial(lens, LINE_F).focal_length
    off = abs(shift * (d - 1) / (f - c) / paraxial(lens, LINE_D).focal_length - 1)
    yield figure("chromatic shift of the singlet against f / V", off, at_most=0.02)
    camera = PlenopticCamera(glass=CROWN)
    shift = camera.at_wavelength(LINE_C).focal_length - camera.at_wavelength(LINE_F).focal_length
    off = abs(shift * 64.17 / 80 - 1)
    yield figure("chromatic shift of a thin lens of crown against f / V", off, at_most=0.02)


@case(
    "spectrum.bands",
    "Spreads of bands, with as many wavelengths as are found necessary, against 64",
    page="docs/guides/colour.md",
    quick={"widths": (20.0,), "glass": False},
)
def bands(*, widths: tuple[float, ...] = (20.0, 100.0), glass: bool = True) -> Iterator[Row]:
    """Compare three points, without glass and with crown."""
    for material in (None, CROWN)[: 1 + glass]:
        camera = PlenopticCamera(resolution=(512, 512), detector_width=1.024, glass=material)
        for width in widths:
            worst, counts = 0.0, []
            for point in POINTS:
                dense = Spectrum.band(550, width, 64)
                found = with_enough_nodes(camera, [point], dense, ERROR)
                counts.append(len(found.nodes or found.wavelengths))
                images = [
                    CaptureOperator(camera, [point], spectrum=spectrum, accuracy=0).forward(
                        np.ones((1, len(spectrum.wavelengths)))
                    )
                    for spectrum in (Spectrum.band(550, width, counts[-1]), dense)
                ]
                worst = max(worst, relative(*images))
            what = f"band of {width:g} nm, {'crown' if material else 'no glass'}, {counts} wavelengths"
            yield figure(what, worst, at_most=ERROR)


@case(
    "spectrum.letters",
    "31 wavelengths of points of the letters at once, against 31 sums, in error and in time",
    page="docs/guides/colour.md",
    quick={"resolution": 128, "accuracy": 0.1, "one_spectrum": True},
)
def letters(
    *, resolution: int = 512, accuracy: float = 0.01, glass: bool = False, one_spectrum: bool = False
) -> Iterator[Row]:
    """Sum points whose light changes with the wavelength, each in its own way or all alike.

    At 4096 columns the letters have their full size; the separate sums then take half an hour.
    """
    part = resolution / 4096
    values = {"resolution": str(resolution), "detector_width": str(8.192 * part), "letter_scale": str(part)}
    scene = load_scene("letters", variant="llvm_ad_mono", parameters=values)
    sensor = scene.sensors()[0]
    plain = PlenopticCamera.from_sensor(sensor)
    points = find_points([SceneLight(scene, sensor, mi.load_dict({"type": "path"}))], plain, PER_LENS, seed=0)
    weights, pupils = points.weights[:, 0], points.pupil_weights
    camera = plain.replace(glass=CROWN if glass else None)
    wavelengths = np.linspace(LOW, HIGH, COUNT)
    responses = np.stack([np.exp(-(((wavelengths - middle) / 40) ** 2)) for middle in (610, 540, 460)])
    light = 1 + np.sin(wavelengths / 23 + np.arange(len(weights))[:, None] * (not one_spectrum))
    columns = weights[:, None] * light

    def operator(**options: object) -> CaptureOperator:
        return CaptureOperator(camera, points.positions, accuracy=accuracy, pupil_weights=pupils, **options)

    operator(wavelength=555.0).forward(columns[:, :1])  # compiles the kernels
    # Everything is planned anew, as it is for each of the nodes.
    _, one, _ = once(lambda: operator(wavelength=550.0).forward(columns[:, :1]))
    spectrum = Spectrum(tuple(wavelengths.tolist()), tuple(map(tuple, responses.tolist())))
    some = np.linspace(0, len(weights) - 1, TRIED).astype(int)
    chosen, probing, _ = once(
        lambda: with_enough_nodes(camera, points.positions[some], spectrum, accuracy, pupils and pupils.take(some))
    )
    found, summing, _ = once(lambda: operator(spectrum=chosen).forward(columns))
    expected = np.zeros_like(found)
    for index, wavelength in enumerate(wavelengths):
        own = operator(wavelength=float(wavelength)).forward(columns[:, index])
        expected += own[..., None] * responses[:, index].astype(np.float32)
    yield figure("points", len(weights))
    yield figure("nodes", len(chosen.nodes or wavelengths))
    yield figure("one wavelength", one, unit="s")
    yield figure("of the 31 wavelengths' time, finding the nodes", probing, unit="s")
    worst = max(relative(found[..., i], expected[..., i]) for i in range(3))
    yield figure("31 wavelengths against 31 sums", worst, at_most=ERROR)
    yield figure(
        "time of 31 wavelengths over that of one",
        (probing + summing) / one,
        at_most=TIMES if resolution >= 512 else None,
    )


DISTANCE = 240.0

BEFORE = 5.0
"""Distance of the stop before the singlet, in millimetres of its prescription; scaled to 80 mm it is 16 mm."""

SQUARE = (-6.4, 6.4, 0.5)
"""Middle and half width of the square in millimetres of the object plane."""

MARGIN = 10
"""Lenses around the square's image in which its light is looked for."""

SQUARE_ACCURACY = 0.003
"""Of its capture by waves."""

CLOSE = (slice(4, 44), slice(6, 46))
"""Bins of the close-up: a letter near the corner, and the square."""

LETTERS = ((-0.7, -1.0), (-4.2, 4.6), (5.0, -5.4))
"""Left lower corners of the letters in the object plane, as seen by the camera, to the right and upwards; mm."""


def landscape_lens() -> dict[str, Any]:
    """Return the prescription of the bundled singlet with its stop before it, and its flat side first."""
    lens = bundled_prescription("singlet")
    front, back = lens.surfaces
    stop = Surface(math.inf, BEFORE, None, back.semi_aperture / 2)
    turned = Surface(math.inf, front.thickness, front.glass, back.semi_aperture)
    last = Surface(-front.radius, 0.0, None, front.semi_aperture)
    return Prescription((stop, turned, last), 0, "Plano-convex singlet behind its stop", lens.source).to_plain()


def lenses() -> dict[str, dict[str, Any]]:
    """Return what each camera's main lens is."""
    return {
        "thin lens": {},
        "double Gauss": {"main_lens": "double_gauss"},
        "singlet": {"main_lens": landscape_lens()},
    }


def rectangle(left: float, bottom: float, width: float, height: float) -> dict[str, Any]:
    """Return a lamp in the object plane, in millimetres to the right and upwards as the camera sees it."""
    T = mi.ScalarTransform4f
    # Camera frames have x to the left.
    middle = [-(left + width / 2), bottom + height / 2, DISTANCE]
    turned = T().translate(middle).rotate([0, 1, 0], 180).scale([width / 2, height / 2, 1])
    return {
        "type": "rectangle",
        "to_world": turned,
        "emitter": {"type": "area", "radiance": {"type": "d65"}},
    }


def scene_of(camera: PlenopticCamera, letters: bool = True) -> Any:
    """Return the scene before a camera, or the square alone."""
    x, y, half = SQUARE
    parts = {"square": rectangle(x - half, y - half, 2 * half, 2 * half)}
    for number, (left, bottom) in enumerate(LETTERS if letters else ()):
        # The letter E, 2 mm high.
        strokes = [(0.0, 0.0, 0.4, 2.0), *((0.4, up, 0.9, 0.4) for up in (0.0, 0.8, 1.6))]
        for stroke, (across, up, width, height) in enumerate(strokes):
            parts[f"letter{number}_{stroke}"] = rectangle(left + across, bottom + up, width, height)
    sensor = camera.to_sensor()
    sensor["film"]["pixel_format"] = "rgb"
    return mi.load_dict({"type": "scene", "camera": sensor, "integrator": {"type": "direct"}, **parts})


def traced_colour(camera: PlenopticCamera) -> np.ndarray:
    """Return how far blue light of the square lies from red on the detector, by rays from it; x and y in pixels."""
    x, y, half = SQUARE
    # Where a ray goes jumps from lens to lens: places must be many.
    u, v, Ex, Ey = 2 * qmc.Sobol(4, seed=0).random_base2(20).T - 1
    within = np.hypot(Ex, Ey) < 1
    X, Y, Ex, Ey = -x + half * u[within], y + half * v[within], Ex[within], Ey[within]
    places = []
    for wavelength in (RGB_WAVELENGTHS[0], RGB_WAVELENGTHS[2]):
        lens = LensSystem.of(camera, wavelength)
        numbers, radius = lens.numbers, float(lens.aperture_radius)
        away = DISTANCE - float(lens.scale) * (numbers.front_principal - numbers.entrance_pupil)
        start = (X - radius * Ex) / away, (Y - radius * Ey) / away
        place, slope, is_open, _ = lens.through((X, Y, np.full_like(X, DISTANCE)), start)
        centre = camera.lattice.centre(*camera.lattice.cell(*place))
        z, bend = camera.detector_distance, camera.detector_distance / camera.mla_focal_length
        places.append(
            [np.mean((m - z * t - bend * (m - c))[is_open]) for m, t, c in zip(place, slope, centre, strict=True)]
        )
    return np.asarray(np.subtract(places[1], places[0]) / camera.pixel_size)


def around_square(camera: PlenopticCamera) -> PlenopticCamera:
    """Return the camera that records what is around the square alone."""
    x, y, half = SQUARE
    scale = (camera.mla_distance + camera.detector_distance) / DISTANCE
    reach = half * scale + MARGIN * camera.mla_pitch
    # The image of what is at -x, y in the camera's frame.
    middle = np.array([x, -y]) * scale / camera.pixel_size + np.array(camera.resolution) / 2
    low = np.clip(np.round(middle - reach / camera.pixel_size), 0, camera.resolution).astype(int)
    high = np.clip(np.round(middle + reach / camera.pixel_size), 0, camera.resolution).astype(int)
    return camera.replace(crop_offset=tuple(low.tolist()), crop_size=tuple((high - low).tolist()))


def measured_colour(capture: Capture) -> np.ndarray:
    """Return how far blue light lies from red in a capture; x and y in pixels."""
    rows, columns = (np.arange(count) for count in capture.image.shape[:2])
    part = capture.image.astype(np.float64)
    sums = part.sum((0, 1))
    centres = np.array([columns @ part.sum(0), rows @ part.sum(1)]) / sums
    return np.asarray(centres[:, 2] - centres[:, 0])


def refocused(capture: Capture) -> np.ndarray:
    """Return the picture of the plane in focus."""
    camera = capture.camera
    b = camera.pupil_distance
    like = PlenopticCamera(
        focal_length=1 / (1 / DISTANCE + 1 / b),
        aperture_radius=camera.pupil_radius,
        mla_distance=b,
        resolution=camera.resolution,
    )
    return np.clip(np.nan_to_num(reconstruct(capture.image, DISTANCE, camera=like).image), 0, 1)


def cameras(names: tuple[str, ...], aperture: float, resolution: int) -> dict[str, PlenopticCamera]:
    """Return the cameras with each lens."""
    given = {"focal_length": 80, "aperture_radius": aperture, "focus_distance": DISTANCE}
    return {
        name: PlenopticCamera(**lens, **given, resolution=(resolution, resolution))
        for name, lens in pick(lenses(), names).items()
    }


@case(
    "lens-colour.lateral",
    "How far a square's blue lies from its red in captures, against rays traced through lens and microlenses",
    {
        "lens": "{lens}", "capture": "{model}", "found (pixels)": "{found[0]:+.3f}, {found[1]:+.3f}",
        "traced": "{traced[0]:+.3f}, {traced[1]:+.3f}", "off": "{off:.3f}", "s": "{seconds:.1f}",
    },
    (at_most("off", 0.1),),
    page="docs/guides/colour.md",
    variant="llvm_ad_rgb",
    quick={"names": ("singlet",), "resolution": 512, "spp": 1024, "models": ("ray",)},
)  # fmt: skip
def lateral(
    *,
    names: tuple[str, ...] = (),
    models: tuple[str, ...] = ("ray", "wave"),
    aperture: float = 2.5,
    resolution: int = 1024,
    spp: int = 4096,
) -> Iterator[Row]:
    """Compare the colours of the square, one wavelength to each."""
    for name, camera in cameras(names, aperture, resolution).items():
        scene = scene_of(around_square(camera), letters=False)
        traced = np.zeros(2) if camera.prescription is None else traced_colour(camera)
        for model in models:
            options = {"accuracy": SQUARE_ACCURACY} if model == "wave" else {}
            capture, seconds, _ = once(lambda s=scene, m=model, o=options: render_capture(s, model=m, spp=spp, **o))
            found = measured_colour(capture)
            off = float(np.abs(found - traced).max())
            yield {"lens": name, "model": model, "found": found, "traced": traced, "off": off, "seconds": seconds}


@case(
    "lens-colour.pictures",
    "Pictures of one scene in white light through three lenses, by both models, side by side",
    {"lens": "{lens}", "capture": "{model}", "s": "{seconds:.1f}"},
    page="docs/guides/colour.md",
    variant="llvm_ad_spectral",
    quick={"resolution": 512, "spp": 4, "names": ("thin lens",)},
)
def pictures(
    output: Path,
    *,
    names: tuple[str, ...] = (),
    aperture: float = 2.5,
    resolution: int = 1024,
    spp: int = 128,
    nodes: int = 5,
    accuracy: float = 0.03,
) -> Iterator[Row]:
    """Capture, refocus and draw."""
    chosen = cameras(names, aperture, resolution)
    plot = Plot(9.8)
    panels = plot.panels(4, len(chosen))
    waves = {"responses": "srgb", "nodes": nodes, "accuracy": accuracy}
    for column, (name, camera) in enumerate(chosen.items()):
        scene = scene_of(camera)
        for row, (model, options) in enumerate((("ray", {}), ("wave", waves))):
            capture, seconds, _ = once(lambda s=scene, m=model, o=options: render_capture(s, model=m, spp=spp, **o))
            picture = refocused(capture)
            title = f"{name}, f/{camera.f_number:.3g}, {model}s"
            show(panels[row, column], picture, title, peak=1.0)
            show(panels[2 + row, column], picture[CLOSE], f"corner, {model}s", peak=1.0)
            yield {"lens": name, "model": model, "seconds": seconds}
    plot.save(output / "lenses.png")
