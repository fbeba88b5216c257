"""Colour: focal lengths and their shift, bands against dense quadrature, many wavelengths of the letters."""

from __future__ import annotations

from collections.abc import Iterator

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, Spectrum, load_scene
from mitsuba_plenoptic.light.scene_light import SceneLight
from mitsuba_plenoptic.points.scene_points import find_points
from mitsuba_plenoptic.points.spectral import with_enough_nodes
from mitsuba_plenoptic.prescription import bundled_prescription, paraxial
from mitsuba_plenoptic.prescription.glass import LINE_C, LINE_D, LINE_F

from .. import Row, case, figure
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
    page="docs/howto/colour.md",
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
    page="docs/howto/colour.md",
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
    page="docs/howto/colour.md",
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
