"""A real light-field microscope: its white picture and its light field against simulated ones, by waves and by rays.

The pictures, from napari-LF (BSD 3-Clause), are taken from the folder that MITSUBA_PLENOPTIC_DATA names, in ``antleg``.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mitsuba_plenoptic import InputError, PlenopticCamera
from mitsuba_plenoptic.calibration import WhiteFit, fit_white
from mitsuba_plenoptic.extensions.calibrate.white_command import sensor_values
from mitsuba_plenoptic.extensions.calibrate.white_page import side_by_side
from mitsuba_plenoptic.extensions.prediction.study import CAMERAS, Pictures, Study
from mitsuba_plenoptic.extensions.prediction.withheld import TESTS
from mitsuba_plenoptic.io.cache import Cache
from mitsuba_plenoptic.io.pictures import read_picture

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
    page="docs/guides/real_camera.md",
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
        yield figure(f"{name}: mean micro-image", mean, at_most=2.0 if wavelength else None, unit="%")
        yield figure(f"{name}: blur", found.camera.detector_blur / found.camera.pixel_size, unit="px")
        yield figure(f"{name}: stray light over the middle", 100 * found.field.coefficients["stray"][0], unit="%")
        recorded, simulated = side_by_side(found, samples)
        rms = 100 * float(np.sqrt(((recorded - simulated) ** 2).mean()))
        yield figure(f"{name}: simulated capture of 12 x 12 lenses from the recorded", rms, unit="%")
        yield figure(f"{name}: processor time of the fit", seconds, unit="s")


@case(
    "real.light_field",
    "Light field of a real microscope: withheld pixels and lenses, predicted by waves and by rays",
    page="docs/guides/real_camera.md",
)
def light_field(
    *,
    left: float = 0.65,
    top: float = 0.6,
    right: float = 0.95,
    bottom: float = 0.87,
    # Where runs are kept and found again; none: a new folder for this time.
    keep: str = "",
) -> Iterator[Row]:
    """Run the study of ``compare --real`` on a part of the picture, given over its size; a quarter takes far longer."""
    names = ("light_field.png", "radiometry_frame.png", "dark_frame.tif")
    light, white, dark = (sensor_values(folder_of_pictures() / name) for name in names)
    rows, columns = white.shape
    box = left * columns, top * rows, right * columns, bottom * rows
    with tempfile.TemporaryDirectory() as folder:
        stages = Cache(Path(keep or folder))
        study = Study(Pictures(light, white, dark), PlenopticCamera.preset("lfm_water"), 510.0, box, stages)
        answer, _, seconds = once(study.answer)
        for camera in CAMERAS:
            for test in TESTS:
                found, relative = answer.ratios[camera][test], answer.relative[camera]
                name = f"{camera} camera, withheld {test}"
                yield figure(f"{name}: residual over noise by waves", found.waves)
                yield figure(f"{name}: residual over noise by rays", found.rays)
                yield figure(f"{name}: rays over waves", found.ratio)
                yield figure(f"{name}: rays over waves, 95 % from", found.low)
                yield figure(f"{name}: rays over waves, 95 % to", found.high)
                for each in relative:
                    yield figure(f"{name}: relative residual by {each}", 100 * relative[each][test], unit="%")
        for each, ratio in answer.controls.items():
            # The test must tell pictures simulated by waves from those by rays.
            waves = each == "waves"
            limits = {"at_least": 1.0} if waves else {"at_most": 1.0}
            value = ratio.low if waves else ratio.high
            yield figure(f"simulated by {each}: rays over waves, nearer end of the interval", value, **limits)
        for length, residual in answer.wavelengths.items():
            yield figure(f"waves of {length:g} nm: residual over noise, withheld pixels", residual)
        for each, stray in answer.stray.items():
            yield figure(f"stray light within lenses by {each}", 100 * stray, unit="%")
        yield figure("processor time", seconds, unit="s")
