"""Focused cameras against Mitsuba's own thin lens and against an unfocused camera of the same detector.

At the distance at which the microlenses are sharp, 240 mm for all three cameras: letters and chart refocused by rays,
against the image of a `thinlens` sensor of one pixel a bin (PSNR over the whole image, one scale factor each); and how
fine a detail of the chart comes back, from the modulation along circles round the Siemens star and the MTF of the
slanted edges. The star's inner end, at 38 lp/mm, is the finest there is. An unfocused camera's lenses alias beyond half
a cycle per lens.

    python tools/focused_accuracy.py --output out/focused [--spp 64] [--wave]
"""

from __future__ import annotations

import math

import accuracy
import numpy as np
from scipy.ndimage import map_coordinates

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.design import effective_resolution, suitable_oversample
from mitsuba_plenoptic.report.experiment import thin_lens_image
from mitsuba_plenoptic.report.measurements import square_sharpness
from mitsuba_plenoptic.report.output_files import write_png

DISTANCE = 240.0
WAVELENGTH = 633.0
CAMERAS = {"unfocused": "chart", "keplerian": "keplerian", "galilean": "galilean"}

# Of the chart at 240 mm: place and size in mm, see its scene.
STAR, STAR_CYCLES = (0.0, 4.4), 24
EDGE, EDGE_SIDE = (0.0, -4.5), 3.0
BARS, BARS_SIZE = (0.0, 0.0), 4.2

# Modulation at which a detail counts as resolved.
LIMIT = 0.1

AGREEMENT = {
    "camera": "{camera}",
    "scene": "{scene}",
    "bins per lens": "{bins_per_lens}",
    "PSNR (dB)": "{psnr_db:.1f}",
    "correlation": "{correlation:.4f}",
    "scale": "{scale:.3f}",
}
RESOLUTION = {
    "camera": "{camera}",
    "capture": "{model}",
    f"star resolved to {LIMIT:.0%} (lp/mm)": "{resolved_lp_per_mm:.1f}",
    "samples per lens": "{resolved_samples_per_lens:.1f}",
    "expected": "{expected_samples_per_lens:.1f}",
    "MTF50 (lp/mm)": "{mtf50_lp_per_mm:.1f}",
    "edge width (um)": "{edge_width_um:.0f}",
}


def main() -> None:
    """Render, refocus, compare, and write the tables as Markdown and JSON with a picture beside them."""
    parser = accuracy.options("focused_accuracy", __doc__, spp=64, reference_spp=1024)
    parser.add_argument("--wave", action="store_true", help="captures by waves, too")
    arguments = accuracy.start(parser)
    against, resolved, tiles = [], [], []
    for name, scene_name in CAMERAS.items():
        chart = load_scene(scene_name)
        camera = PlenopticCamera.from_sensor(chart.sensors()[0])
        finest = suitable_oversample(camera, DISTANCE)
        letters = load_scene("letters", parameters=_parameters(camera))
        capture = render_capture(chart, spp=arguments.spp)
        for subject, scene, taken in (("letters", letters, None), ("chart", chart, capture)):
            taken = taken or render_capture(scene, spp=arguments.spp)
            for oversample in sorted({1, finest}):
                reference = thin_lens_image(scene, camera, DISTANCE, arguments.reference_spp // oversample, oversample)
                image = reconstruct(taken, DISTANCE, oversample=oversample).image.astype(np.float64)
                scale, (score,) = accuracy.scores([image], [reference])
                against.append({"camera": name, "scene": subject, "bins_per_lens": oversample, **score})
                picture = arguments.output / f"{subject}_{name}_{oversample}.png"
                accuracy.write_comparison(picture, scale * image, reference)
        captures = {"ray": capture}
        if arguments.wave:
            captures["wave"] = render_capture(chart, model="wave", spp=arguments.spp, wavelength=WAVELENGTH)
        for model, taken in captures.items():
            row, image = _resolution(taken, max(finest, 10))
            resolved.append({"camera": name, "model": model, **row})
            tiles.append(image)

    write_png(arguments.output / "bars.png", np.concatenate(tiles, 1), peak=1.0)
    tables = accuracy.markdown(AGREEMENT, against), accuracy.markdown(RESOLUTION, resolved)
    accuracy.finish(arguments, {"referee": against, "resolution": resolved}, *tables)


def _parameters(camera: PlenopticCamera) -> dict[str, str]:
    """Parameters that make a scene of the paper's camera take another one."""
    names = ("aperture_radius", "mla_distance", "mla_focal_length", "detector_distance")
    return {name: str(getattr(camera, name)) for name in names}


def _resolution(capture: Capture, oversample: int) -> tuple[accuracy.Row, np.ndarray]:
    """Measure the finest detail of the chart; give its bars as a picture, too."""
    camera = capture.camera
    result = reconstruct(capture, DISTANCE, oversample=oversample)
    image, bin_size = result.image.astype(np.float64), result.bin_size
    lens = bin_size * oversample

    def place(point: tuple[float, float]) -> tuple[float, float]:
        """Row and column of a point of the chart, from the image's corner; +x is left."""
        return image.shape[0] / 2 - point[1] / bin_size, image.shape[1] / 2 - point[0] / bin_size

    limit = _resolved_frequency(image, *place(STAR), bin_size)
    edge = square_sharpness(image, *place(EDGE), EDGE_SIDE / bin_size)
    wavelength = WAVELENGTH if capture.model == "wave" else None
    expected = effective_resolution(camera, DISTANCE, wavelength)
    row, column = place(BARS)
    half = round(BARS_SIZE / 2 / bin_size)
    window = image[round(row) - half : round(row) + half, round(column) - half : round(column) + half]
    side = 480
    index = (np.arange(side) * window.shape[0]) // side
    return {
        "resolved_lp_per_mm": round(limit, 2),
        "resolved_samples_per_lens": round(2 * limit * lens, 2),
        "mtf50_lp_per_mm": round(edge.mtf50 / bin_size, 2),
        "mtf50_cycles_per_lens": round(edge.mtf50 * oversample, 3),
        "edge_width_um": round(1e3 * edge.width * bin_size, 1),
        "expected_samples_per_lens": round(expected.samples_per_lens, 2),
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
        if modulation < LIMIT:
            break
        last = STAR_CYCLES / (2 * math.pi * radius)
    return last


if __name__ == "__main__":
    main()
