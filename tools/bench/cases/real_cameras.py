"""A real light-field microscope: its white picture against a simulated one.

The pictures, from napari-LF (BSD 3-Clause), are taken from the folder that MITSUBA_PLENOPTIC_DATA names, in ``antleg``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import InputError, PlenopticCamera
from mitsuba_plenoptic.calibration import WhiteFit, fit_white
from mitsuba_plenoptic.extensions.calibrate.white_page import side_by_side
from mitsuba_plenoptic.extensions.paper.real_light import TITLES, grid
from mitsuba_plenoptic.io.exr import read_exr
from mitsuba_plenoptic.io.pictures import read_picture
from mitsuba_plenoptic.report import window_sharpness

from .. import Row, case, figure
from ..timing import once

MIDDLE = 300.0
"""Half the side, in pixels, of the part in the middle whose lenses' scatter is measured."""


def folder_of_pictures() -> Path:
    """Return the folder of the pictures."""
    folder = Path(os.environ.get("MITSUBA_PLENOPTIC_DATA", "")) / "antleg"
    if not folder.is_dir():
        raise InputError(f"no pictures of a real camera in {folder}: set MITSUBA_PLENOPTIC_DATA")
    return folder


def pictures() -> tuple[np.ndarray, np.ndarray]:
    """Return the white picture and the dark frame."""
    folder = folder_of_pictures()
    white, dark = (read_picture(folder / name, linear=True) for name in ("radiometry_frame.png", "dark_frame.tif"))
    return white, dark


def scatter_of_lenses(found: WhiteFit) -> float:
    """Return how far pixels of single lenses are from the mean micro-image of lenses in the middle of the field, RMS.

    The mean is over bins of half a pixel, values are over the light in each lens's middle.
    """
    rows, columns = found.frame.light.shape
    central = np.abs(found.place - [(columns - 1) / 2, (rows - 1) / 2]).max(1) < MIDDLE
    reach = int(0.7 * found.camera.micro_image_pitch / found.camera.pixel_size)
    window = np.arange(-reach, reach + 1)
    values, bins = [], []
    for (x, y), light in zip(found.place[central], found.brightness[central], strict=True):
        column, row = round(x), round(y)
        values.append(found.frame.light[row - reach : row + reach + 1, column - reach : column + reach + 1] / light)
        i, j = (np.rint(2 * (first + window - at)).astype(int) + 2 * reach + 2 for first, at in ((column, x), (row, y)))
        bins.append(j[:, None] * (4 * reach + 5) + i)
    value, bin_ = np.ravel(values), np.ravel(bins)
    count, total, square = (np.bincount(bin_, value**power) for power in (0.0, 1.0, 2.0))
    seen = count > 20
    variance = square[seen] / count[seen] - (total[seen] / count[seen]) ** 2
    return float(np.sqrt(variance.clip(0).mean()))


@case(
    "real.white",
    "White picture of a real light-field microscope against the camera that is fitted to two thirds of its lenses",
    page="docs/guides/calibration.md",
)
def white(*, samples: int = 128) -> Iterator[Row]:
    """Compare the third of the lenses that fits do not see, by waves of 510 nm and by rays."""
    light, dark = pictures()
    nominal = PlenopticCamera.preset("lfm_water")
    for name, wavelength in (("waves", 510.0), ("rays", None)):
        found, _, seconds = once(
            lambda wavelength=wavelength: fit_white(light, nominal, dark=dark, wavelength=wavelength)
        )
        judged = found.judgement
        if wavelength:
            scatter = scatter_of_lenses(found)
            yield figure("scatter of single lenses about their mean image, middle", 100 * scatter, unit="%")
            yield figure("scatter of single lenses about the mean of an eighth", 100 * judged.scatter, unit="%")
            off = np.sqrt((found.off_array[found.withheld] ** 2).mean(0))
            yield figure("withheld lenses off the warped array, along x", off[0], at_most=0.10, unit="px")
            yield figure("withheld lenses off the warped array, along y", off[1], at_most=0.10, unit="px")
        limit = 110 * scatter if wavelength else None
        yield figure(f"{name}: residual of withheld lenses", 100 * judged.residual, at_most=limit, unit="%")
        yield figure(f"{name}: what zones have alike", 100 * judged.systematic, unit="%")
        mean = 100 * judged.mean_image
        yield figure(f"{name}: mean micro-image", mean, at_most=0.52 if wavelength else None, unit="%")
        yield figure(f"{name}: blur", found.camera.detector_blur / found.camera.pixel_size, unit="px")
        yield figure(f"{name}: stray light over the middle", 100 * found.field.coefficients["stray"][0], unit="%")
        recorded, simulated = side_by_side(found, samples)
        rms = 100 * float(np.sqrt(((recorded - simulated) ** 2).mean()))
        yield figure(f"{name}: simulated capture of 12 x 12 lenses from the recorded", rms, unit="%")
        yield figure(f"{name}: processor time of the fit", seconds, unit="s")


CORNER = (1.36, 1.01)
"""Bins of one a lens before the first column and row of plenoptomos's pictures, by the offset of its example."""


@case(
    "real.letters",
    "Letters by a real plenoptic camera, refocused here and by plenoptomos: contrast of ink, what repeats from lens to "
    "lens in an even area, and the width of an edge from 10 to 90 %",
    {
        "method": "{method}", "at (mm)": "{distance:g}", "bins a lens": "{fine}", "contrast": "{contrast:.2f}",
        "grid": "{grid:.2%}", "edge (mm)": "{width:.3f}", "processor (s)": "{seconds}",
    },
    (),
)  # fmt: skip
def letters(*, ours: str = "", peer: str = "") -> Iterator[Row]:
    """Compare the folder that ``reproduce --real`` wrote with the file of ``tools/plenoptomos_letters.py``."""
    for name, path in (("ours", ours), ("peer", peer)):
        if not Path(path).exists() or not path:
            raise InputError(f"{name} = {path}: give {name}=, what `reproduce --real` or plenoptomos_letters.py wrote")
    results = json.loads((Path(ours) / "results.json").read_text())
    stored = np.load(peer)
    shape = next(shape for shape in results["shapes"].values() if {"even", "edge"} <= set(shape["areas"]))
    distance, areas = shape["distance"], shape["areas"]
    camera = PlenopticCamera.from_json(json.dumps(results["camera"]))
    pictures = {}
    for method, title in TITLES.items():
        (image, *_) = read_exr(Path(ours) / "data" / f"picture_{method}_{distance:g}.exr")
        image = np.squeeze(np.asarray(image))
        pictures[title] = image, image.shape[0] // camera.bin_count[1], (0.0, 0.0), ""
    for method, title in (("bpj", "back-projection"), ("sirt", "SIRT"), ("cp_ls_tv", "least squares with TV and PSF")):
        if (key := f"{method}_{distance:g}") in stored:
            # The program's values grow with the ink.
            image = np.quantile(stored[key], 0.99) - stored[key]
            seconds = f"{float(stored[f'{key}_seconds']):.2g}"
            pictures[f"plenoptomos, {title}"] = image, int(stored["up_sampling"]), CORNER, seconds
    for title, (image, fine, corner, seconds) in pictures.items():

        def part(area: str, image: np.ndarray = image, corner: Any = corner, fine: int = fine) -> np.ndarray:
            left, top, width, height = (
                round(fine * value) for value in np.subtract(areas[area], (*corner, 0.0, 0.0)).tolist()
            )
            return image[top : top + height, left : left + width].astype(float)

        dark, bright = np.nanquantile(part("region"), (0.01, 0.7))
        yield {
            "method": title, "distance": distance, "fine": fine, "seconds": seconds,
            "contrast": float((bright - dark) / (bright + dark)), "grid": grid(part("even"), fine),
            "width": window_sharpness(part("edge")).width * camera.bin_size(distance) / fine,
        }  # fmt: skip
