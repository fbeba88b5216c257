"""A real light-field microscope: its white picture against a simulated one.

The pictures, from napari-LF (BSD 3-Clause), are taken from the folder that MITSUBA_PLENOPTIC_DATA names, in ``antleg``.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mitsuba_plenoptic import InputError, PlenopticCamera, StrayLight
from mitsuba_plenoptic.calibration import WhiteFit, fit_white
from mitsuba_plenoptic.camera.camera_files import camera_and_record
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.extensions.calibrate.white_page import side_by_side
from mitsuba_plenoptic.extensions.paper.real_light import TITLES, grid
from mitsuba_plenoptic.io.exr import read_exr
from mitsuba_plenoptic.io.pictures import read_picture
from mitsuba_plenoptic.report import window_sharpness

from .. import Row, at_most, case, figure, pick
from ..timing import once

LETTERS = {
    "focal_length": 200, "aperture_radius": 3.3, "mla_distance": 400, "mla_pitch": 0.3, "mla_focal_length": 18.6,
    "detector_distance": 18.6, "detector_width": 8.256, "resolution": [1280, 960],
}  # fmt: skip
"""The camera of the letters as it is known."""

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
    count, _, variance = mean_micro_image(found.frame.light, found.place[central], found.brightness[central], reach)
    return float(np.sqrt(variance[count > 20].mean()))


def mean_micro_image(
    image: np.ndarray, place: np.ndarray, brightness: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how many pixels of lenses over their brightness are in bins of half a pixel, their mean and variance."""
    window = np.arange(-reach, reach + 1)
    values, bins = [], []
    for (x, y), light in zip(place, brightness, strict=True):
        column, row = round(x), round(y)
        values.append(image[row - reach : row + reach + 1, column - reach : column + reach + 1] / light)
        i, j = (np.rint(2 * (first + window - at)).astype(int) + 2 * reach + 2 for first, at in ((column, x), (row, y)))
        bins.append(j[:, None] * (4 * reach + 5) + i)
    value, bin_ = np.ravel(values), np.ravel(bins)
    known = np.isfinite(value)
    count, total, square = (
        np.bincount(bin_[known], value[known] ** power, minlength=(4 * reach + 5) ** 2) for power in (0.0, 1.0, 2.0)
    )
    mean = total / np.maximum(count, 1)
    return count, mean, (square / np.maximum(count, 1) - mean**2).clip(0)


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


EVEN = """<scene version="3.0.0"><integrator type="direct"/><emitter type="constant"/><sensor type="plenoptic">
<film type="hdrfilm"><string name="pixel_format" value="luminance"/><rfilter type="box"/></film></sensor></scene>"""
"""A scene that is white in all directions, so that every camera sees it."""

STRAY = StrayLight([[0.05, 0.075, 0.05], [0.075, 0.1, 0.075], [0.05, 0.075, 0.05]])
SIMULATED = PlenopticCamera(
    focal_length=50, aperture_radius=1.3, focus_distance=400, mla_focal_length=1.6, detector_distance=1.6,
    mla_pitch=0.08, mla_rotation=0.2, resolution=(640, 480), detector_width=3.2, stray_light=STRAY,
    detector_blur=0.004,
)  # fmt: skip
"""A camera of 40 x 30 lenses with stray light of 10 % in the middle and half of it in the corners."""


def white_pictures(folder: Path, light: tuple[str, ...]) -> dict[str, tuple[Path, Path, str, str]]:
    """Return white and dark picture, known camera and wavelength of two real cameras and a simulated one."""
    real = folder_of_pictures().parent
    (folder / "even.xml").write_text(EVEN)
    (folder / "letters.json").write_text(json.dumps(LETTERS))
    (folder / "known.json").write_text(SIMULATED.replace(stray_light=0.0).to_json())
    (folder / "true.json").write_text(SIMULATED.to_json())
    shown = "--camera", folder / "true.json", *light, "--spp", 1024, "-o", folder / "true.exr"
    command("render", folder / "even.xml", *shown)
    random, image = np.random.default_rng(0), np.squeeze(np.asarray(read_exr(folder / "true.exr")[0]))
    for name, light_in_electrons in (("white", random.poisson(200000 * image)), ("dark", np.zeros(image.shape))):
        numbers = light_in_electrons / 4 + random.normal(100, 1, image.shape)
        Image.fromarray(np.rint(numbers).astype(np.uint16)).save(folder / f"{name}.tif")
    letters = real / "letters_ulf" / "letters_ULF_M1"
    return {
        "ant's leg": (real / "antleg/radiometry_frame.png", real / "antleg/dark_frame.tif", "lfm_water", "510"),
        "letters": (Path(f"{letters}_white.png"), Path(f"{letters}_dark.png"), str(folder / "letters.json"), "550"),
        "simulated": (folder / "white.tif", folder / "dark.tif", str(folder / "known.json"), "550"),
    }


def command(*words: object) -> None:
    """Run a command of the package."""
    if main([*map(str, words)]):
        raise InputError(f"{words[0]}: it failed")


@case(
    "real.rendered",
    "White scenes as `calibrate` and `render --camera` show them: mean micro-image less the recorded one, over the "
    "scatter of pixels about the mean image in the middle of the field, and over what differs from lens to lens",
    {
        "camera": "{camera}", "model": "{model}", "lenses": "{part}", "difference": "{difference:.2%}",
        "scatter": "{scatter:.2%}", "ratio": "{ratio:.2f}", "lens to lens": "{noise:.2%}", "to this": "{closer:.2f}",
    },
    (at_most("ratio", 1.1), at_most("closer", "closest")),
)  # fmt: skip
def rendered(*, cameras: tuple[str, ...] = (), spp: int = 128) -> Iterator[Row]:
    """Fit cameras to white pictures and render a white scene; where stray light is known, compare corners, too."""
    for model in ("wave", "ray"):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            sources = white_pictures(folder, ("--model", model, *["--wavelength", "550"] * (model == "wave")))
            for title, (white, dark, known, wavelength) in pick(sources, cameras).items():
                light = ("--model", model, *["--wavelength", wavelength] * (model == "wave"))
                fitted, capture = folder / "fitted.json", folder / "capture.exr"
                command("calibrate", "white", white, "--dark", dark, "--camera", known, *light, "-o", fitted)
                command("render", folder / "even.xml", "--camera", fitted, *light, "--spp", spp, "-o", capture)
                recorded, black = (read_picture(path, linear=True).astype(float) for path in (white, dark))
                simulated = np.squeeze(np.asarray(read_exr(capture)[0]))
                camera, record = camera_and_record(fitted)
                corners = title == "simulated"
                for row in differences(recorded - black, simulated, camera, corners):
                    noise = record["withheld"]["scatter"]
                    closer = {"noise": noise, "closer": row["difference"] / noise, "closest": 1.1 if corners else None}
                    yield {"camera": title, "model": model, **row, **closer}


def differences(recorded: np.ndarray, simulated: np.ndarray, camera: PlenopticCamera, corners: bool) -> Iterator[Row]:
    """Yield how far mean micro-images of two pictures are apart, over all lenses and over those of parts."""
    size = np.array(camera.resolution)
    half = size * camera.pixel_size / camera.image_growth / 2
    index = camera.lattice.lenses_within(tuple(-half), tuple(half)).astype(float)
    place = np.stack(camera.lattice.centre(*index.T), axis=-1) * camera.image_growth / camera.pixel_size
    reach = int(camera.micro_image_pitch / camera.pixel_size / 2)
    whole = (np.abs(place) < size / 2 - reach - 2).all(1)
    brightness = camera.mla_transmissions.at(camera.lattice, *index[whole].T)
    x, y = (place[whole] / size).T

    def of_both(lenses: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        centre = place[whole][lenses] + (size - 1) / 2
        return [mean_micro_image(image, centre, brightness[lenses], reach) for image in (recorded, simulated)]

    parts = {"all": x < 1, "middle": np.maximum(abs(x), abs(y)) < 0.15}
    parts |= {"upper left": np.maximum(x, y) < -0.3, "lower right": np.minimum(x, y) > 0.3}
    means = {part: of_both(lenses) for part, lenses in parts.items()}
    # Of an exposure that makes both pictures equally bright.
    (count, mean, _), (_, other, _) = means["all"]
    exposure = (count * other).sum() / (count * mean).sum()
    count, _, variance = means["middle"][0]
    scatter = exposure * float(np.sqrt(variance[count > 5].mean()))
    for part, ((count, mean, _), (_, other, _)) in means.items():
        if corners or part == "all":
            apart = float(np.sqrt(((exposure * mean - other)[count > 5] ** 2).mean()))
            yield {"part": part, "difference": apart, "scatter": scatter, "ratio": apart / scatter}


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
