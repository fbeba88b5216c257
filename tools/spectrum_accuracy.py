"""Measure colour: focal lengths and their shift, bands against dense quadrature, many wavelengths of the letters.

Every figure is printed with its limit; the exit status is 1 if one fails. At --resolution 4096 the letters have their
full size; the sums of each wavelength by itself, with which they are compared, then take half an hour.

    python tools/spectrum_accuracy.py --resolution 512
"""

from __future__ import annotations

import argparse
import sys
import time

import mitsuba as mi
import numpy as np
from verdict import Verdict

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, Spectrum, load_scene
from mitsuba_plenoptic.capture.scene_points import find_points
from mitsuba_plenoptic.capture.signed_rays import SceneLight
from mitsuba_plenoptic.operator.spectral import with_enough_nodes
from mitsuba_plenoptic.prescription import bundled_prescription, paraxial
from mitsuba_plenoptic.prescription.glass import LINE_C, LINE_D, LINE_F

LOW, HIGH, COUNT = 400.0, 700.0, 31
ERROR, TIMES = 0.003, 10.0
PER_LENS, TRIED = 16, 6
"""Points that rays find from each lens, and how many of all of them choose the nodes."""

CROWN = {"index": 1.5168, "abbe": 64.17}
POINTS = ((0.0, 0.0, 240.0), (0.3, 0.2, 210.0), (0.3, -0.4, 280.0))


def relative(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the relative difference (L2)."""
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def focal_lengths(verdict: Verdict) -> None:
    """Compare focal lengths of the bundled singlet with the closed form of a thick lens, and shifts with f / V."""
    lens = bundled_prescription("singlet")
    first, second = lens.surfaces
    c1, c2, t = first.curvature, second.curvature, first.thickness
    worst = 0.0
    for wavelength in np.linspace(LOW, HIGH, COUNT):
        n = lens.indices(float(wavelength))[0]
        power = (n - 1) * (c1 - c2 + (n - 1) * t * c1 * c2 / n)
        worst = max(worst, abs(paraxial(lens, float(wavelength)).focal_length * power - 1))
    verdict.judge("focal length of the singlet against the closed form", worst, 1e-6)
    d, f, c = (lens.indices(line)[0] for line in (LINE_D, LINE_F, LINE_C))
    shift = paraxial(lens, LINE_C).focal_length - paraxial(lens, LINE_F).focal_length
    verdict.judge(
        "chromatic shift of the singlet against f / V",
        abs(shift * (d - 1) / (f - c) / paraxial(lens, LINE_D).focal_length - 1),
        0.02,
    )
    camera = PlenopticCamera(glass=CROWN)
    shift = camera.at_wavelength(LINE_C).focal_length - camera.at_wavelength(LINE_F).focal_length
    verdict.judge("chromatic shift of a thin lens of crown against f / V", abs(shift * 64.17 / 80 - 1), 0.02)


def bands(verdict: Verdict) -> None:
    """Compare spreads of bands, with as many wavelengths as are found necessary, with dense quadrature."""
    for glass in (None, CROWN):
        camera = PlenopticCamera(resolution=(512, 512), detector_width=1.024, glass=glass)
        for width in (20.0, 100.0):
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
            what = f"spread of a band of {width:g} nm, {'crown' if glass else 'no glass'}, {counts} wavelengths"
            verdict.judge(f"{what}, against 64", worst, ERROR)


def letters(verdict: Verdict, resolution: int, glass: dict[str, float] | None, accuracy: float, shared: bool) -> None:
    """Compare 31 wavelengths of points of the letters at once with 31 sums, in error and in time."""
    part = resolution / 4096
    values = {"resolution": str(resolution), "detector_width": str(8.192 * part), "letter_scale": str(part)}
    scene = load_scene("letters", variant="llvm_ad_mono", parameters=values)
    sensor = scene.sensors()[0]
    plain = PlenopticCamera.from_sensor(sensor)
    points = find_points([SceneLight(scene, sensor, mi.load_dict({"type": "path"}))], plain, PER_LENS, seed=0)
    weights, pupils = points.weights[:, 0], points.pupil_weights
    camera = plain.replace(glass=glass)
    wavelengths = np.linspace(LOW, HIGH, COUNT)
    responses = np.stack([np.exp(-(((wavelengths - middle) / 40) ** 2)) for middle in (610, 540, 460)])
    # The light of each point changes with the wavelength, in its own way or as that of all.
    light = 1 + np.sin(wavelengths / 23 + np.arange(len(weights))[:, None] * (not shared))
    columns = weights[:, None] * light

    def operator(**options: object) -> CaptureOperator:
        return CaptureOperator(camera, points.positions, accuracy=accuracy, pupil_weights=pupils, **options)

    operator(wavelength=555.0).forward(columns[:, :1])  # compiles the kernels
    start = time.perf_counter()
    # Everything is planned anew, as it is for each of the nodes.
    operator(wavelength=550.0).forward(columns[:, :1])
    one = time.perf_counter() - start
    spectrum = Spectrum(tuple(wavelengths.tolist()), tuple(map(tuple, responses.tolist())))
    start = time.perf_counter()
    some = np.linspace(0, len(weights) - 1, TRIED).astype(int)
    chosen = with_enough_nodes(camera, points.positions[some], spectrum, accuracy, pupils and pupils.take(some))
    probed = time.perf_counter() - start
    found = operator(spectrum=chosen).forward(columns)
    seconds = time.perf_counter() - start
    expected = np.zeros_like(found)
    for index, wavelength in enumerate(wavelengths):
        own = operator(wavelength=float(wavelength)).forward(columns[:, index])
        expected += own[..., None] * responses[:, index].astype(np.float32)
    name = f"letters at {resolution} pixels, {'crown' if glass else 'no glass'}, accuracy {accuracy:g}"
    name += ", one spectrum" if shared else ""
    print(f"{name}: {len(weights)} points, {len(chosen.nodes or wavelengths)} nodes, "
          f"one wavelength {one:.2f} s, 31 in {seconds:.2f} s of which {probed:.2f} s find the nodes")  # fmt: skip
    worst = max(relative(found[..., i], expected[..., i]) for i in range(3))
    verdict.judge(f"{name}: 31 wavelengths against 31 sums", worst, ERROR)
    verdict.judge(f"{name}: time over that of one wavelength", seconds / one, TIMES)


def main() -> None:
    """Measure all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=512, help="columns of the letters' detector, of 4096")
    parser.add_argument("--accuracy", type=float, default=0.01, help="of the sums")
    parser.add_argument("--glass", action="store_true", help="also the letters through thin lenses of crown")
    parser.add_argument("--one-spectrum", action="store_true", help="all points of the letters have the same one")
    parser.add_argument("--only", choices=("bands", "letters"), help="measure one of the two alone")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_mono")
    verdict = Verdict()
    focal_lengths(verdict)
    if arguments.only != "letters":
        bands(verdict)
    if arguments.only == "bands":
        sys.exit(0 if verdict.kept else 1)
    for glass in (None, CROWN)[: 1 + arguments.glass]:
        letters(verdict, arguments.resolution, glass, arguments.accuracy, arguments.one_spectrum)
    sys.exit(0 if verdict.kept else 1)


if __name__ == "__main__":
    main()
