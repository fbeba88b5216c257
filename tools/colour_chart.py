"""Take the colour chart through capture, a mosaic of filters, demosaicking and reconstruction: how far colours are off.

The reference are the published reflectances under D65 by the same responses, those of CIE 1931 in linear sRGB, without
any optics. Differences are CIEDE2000. With --plain, too, by a demosaicking that knows nothing of micro-images, to
compare. The exit status is 1 if the mean is 1 or more.

    python tools/colour_chart.py --resolution 1024 --spp 64
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
from skimage.color import deltaE_ciede2000, xyz2lab

from mitsuba_plenoptic import Capture, Detector, demosaic, expose, load_scene, reconstruct, render_capture, scene_path
from mitsuba_plenoptic.report.images import write_png

LIMIT = 1.0
SPACING, WIDTH, COLUMNS, ROWS = 2.5, 2.2, 6, 4
DISTANCE = 240.0

TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
"""From linear sRGB (IEC 61966-2-1)."""


def reflectances() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return wavelengths and reflectances of the patches, in their order, as the scene file has them."""
    found = {}
    for shape in ElementTree.parse(scene_path("colour_chart")).getroot().iter("shape"):
        spectrum = shape.find("bsdf/spectrum")
        if shape.get("id") != "board" and spectrum is not None:
            pairs = [pair.split(":") for pair in str(spectrum.get("value")).split(",")]
            found[str(shape.get("id"))] = tuple(np.array(pairs, float).T)
    return found


def lab(xyz: np.ndarray, white: np.ndarray) -> np.ndarray:
    """Return CIE L*a*b* of colours (n, 3) relative to a white, which is taken to that of D65."""
    d65 = np.array([0.95047, 1.0, 1.08883])
    return xyz2lab(np.asarray(xyz) / white * d65, illuminant="D65", observer="2")


def expected() -> np.ndarray:
    """Integrate reflectance times D65 times colour matching functions; return L*a*b* (24, 3)."""
    wavelengths = np.arange(380.0, 781.0, 1.0)
    matching = np.array(mi.cie1931_xyz(mi.Float(wavelengths)), float)
    light = np.array(mi.cie_d65(mi.Float(wavelengths)), float)
    white = matching @ light
    xyz = [matching @ (light * np.interp(wavelengths, *curve)) for curve in reflectances().values()]
    return lab(np.array(xyz) / white[1], white / white[1])


def patches(image: np.ndarray, scale: float, bin_size: float) -> np.ndarray:
    """Return the mean colours (24, 3) of the middles of the patches in a reconstruction."""
    rows, columns, _ = image.shape
    means = []
    for row in range(ROWS):
        for column in range(COLUMNS):
            place = (column - (COLUMNS - 1) / 2) * SPACING * scale, (row - (ROWS - 1) / 2) * SPACING * scale
            half = 0.5 * WIDTH * scale - bin_size
            x = ((np.arange(columns) + 0.5) - columns / 2) * bin_size
            y = ((np.arange(rows) + 0.5) - rows / 2) * bin_size
            inside = np.ix_(np.abs(y - place[1]) <= half, np.abs(x - place[0]) <= half)
            means.append(image[inside].reshape(-1, 3).mean(axis=0))
    return np.array(means)


def differences(capture: Capture, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the differences (24,) of a capture in three colours, and its reconstruction."""
    found = reconstruct(capture, DISTANCE)
    rgb = patches(found.image, scale, found.bin_size)
    return deltaE_ciede2000(lab(rgb @ TO_XYZ.T, TO_XYZ.sum(axis=1)), expected()), found.image


def main() -> None:
    """Measure all of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=1024, help="columns of the detector, of 4096")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel")
    parser.add_argument("--photons", type=float, default=4000.0, help="that a pixel of value 1 counts")
    parser.add_argument("--mosaic", default="RGGB", help="of the filters")
    parser.add_argument("--plain", action="store_true", help="also by plain demosaicking")
    parser.add_argument("--output", type=Path, default=Path("out/colour_chart"), help="folder for pictures")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    scale = arguments.resolution / 4096
    values = {"resolution": arguments.resolution, "detector_width": 8.192 * scale, "chart_scale": scale}
    scene = load_scene(
        "colour_chart", variant="llvm_ad_spectral", parameters={name: str(value) for name, value in values.items()}
    )
    capture = render_capture(scene, spp=arguments.spp)
    raw = expose(capture, Detector(mosaic=arguments.mosaic), photons=arguments.photons)
    images = {"without a mosaic": capture, "demosaicked": demosaic(raw)}
    if arguments.plain:
        images["demosaicked plainly"] = demosaic(raw, method="plain")
    kept = True
    for name, image in images.items():
        found, picture = differences(image, scale)
        write_png(arguments.output / f"{name.replace(' ', '_')}.png", np.clip(np.nan_to_num(picture), 0, 1))
        text = f"{name}: CIEDE2000 mean {found.mean():.3f}, largest {found.max():.3f}"
        print(f"{text} ({list(reflectances())[int(found.argmax())]})", flush=True)
        if name == "demosaicked":
            kept = bool(found.mean() < LIMIT)
    print(f"mean CIEDE2000 of the 24 patches below {LIMIT:g}: {'ok' if kept else 'FAILED'}")
    sys.exit(0 if kept else 1)


if __name__ == "__main__":
    main()
