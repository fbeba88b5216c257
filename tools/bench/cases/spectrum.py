"""Colour: bands against dense quadrature, and a chart of known reflectances."""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
from cases import relative
from skimage.color import deltaE_ciede2000, xyz2lab

from mitsuba_plenoptic import (
    CaptureOperator,
    Detector,
    PlenopticCamera,
    Spectrum,
    demosaic,
    expose,
    load_scene,
    reconstruct,
    render_capture,
    scene_path,
)
from mitsuba_plenoptic.points.spectral import with_enough_nodes

from .. import Row, case, figure

ERROR = 0.003


CROWN = {"index": 1.5168, "abbe": 64.17}

POINTS = ((0.0, 0.0, 240.0), (0.3, 0.2, 210.0), (0.3, -0.4, 280.0))


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


LIMIT = 1.0
SPACING, WIDTH, COLUMNS, ROWS = 2.5, 2.2, 6, 4
"""Of the chart's patches, in millimetres, and how many there are."""

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


@case(
    "spectrum.chart",
    "The colour chart through capture, mosaic, demosaicking and reconstruction: mean CIEDE2000 from the published "
    "reflectances under D65",
    page="docs/guides/colour.md",
    quick={"spp": 8},
    variant="llvm_ad_spectral",
)
def chart(*, resolution: int = 1024, spp: int = 64, photons: float = 4000.0) -> Iterator[Row]:
    """Compare the patches without a mosaic, demosaicked, and demosaicked without knowing of micro-images."""
    scale = resolution / 4096
    values = {"resolution": resolution, "detector_width": 8.192 * scale, "chart_scale": scale}
    capture = render_capture(
        load_scene("colour_chart", parameters={name: str(v) for name, v in values.items()}), spp=spp
    )
    raw = expose(capture, Detector(mosaic="RGGB"), photons=photons)
    for name, image in (
        ("without a mosaic", capture),
        ("demosaicked", demosaic(raw)),
        ("demosaicked plainly", demosaic(raw, method="plain")),
    ):
        found = reconstruct(image, 240.0)
        rgb = patches(found.image, scale, found.bin_size)
        off = deltaE_ciede2000(lab(rgb @ TO_XYZ.T, TO_XYZ.sum(axis=1)), expected())
        yield figure(name, float(off.mean()), at_most=None if "plainly" in name else LIMIT)
