"""Calibrate a real camera from white pictures and pictures of a checkerboard.

Corners are a table k, l, u, v, cluster, frame: lens along its row, row, pixel, index of the corner, picture.

Parameters
----------
board : COLUMNSxROWS
    Inner corners along the board and across it.
square
    Distance in millimetres of neighbouring corners, the scale of all lengths.
report : FILE.html
    Also write a page with what was found and how well it agrees.
"""

from __future__ import annotations

import contextlib
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ... import choices
from ...cli import inputs, options, stopping
from ...errors import InputError, content_of, naming, refuse_if
from ...runtime import progress_bar

if TYPE_CHECKING:
    from ...camera import PlenopticCamera
    from ...runtime import Array
    from .photon_transfer import PhotonTransfer

# Outliers that are printed by line.
_NAMED = 10


def _require_picture(name: str, path: Path) -> None:
    options.require_file(name, path)
    refuse_if(
        path.suffix.lower() in choices.LYTRO_SUFFIXES,
        f"{path}: a raw picture of a Lytro camera is a mosaic of colours; demosaic it first",
    )
    is_picture = path.suffix.lower() in (".exr", *choices.RAW_SUFFIXES)
    refuse_if(not is_picture, f"{path}: it is {content_of(path)}; pictures are .exr, .png, .tiff or .bmp")


def _require_table(name: str, path: Path) -> None:
    options.require_file(name, path)
    content = content_of(path)
    refuse_if(not content.startswith("text"), f"{path}: it is {content}; corners are a table (.csv)")


Picture = Annotated[Path, options.checked(_require_picture)]
Table = Annotated[Path, options.checked(_require_table)]


def centres(whites: list[Picture], *, output: Annotated[Path, options.ends_in(".csv")], linear: bool = False) -> None:
    """Find the centres of micro-images in a white picture, or in several at different apertures.

    Parameters
    ----------
    whites : WHITE...
        Pictures of something evenly white, .exr, .png or .tiff.
    output : FILE.csv
        File to write: the centres.

    Examples
    --------
    $ mitsuba-plenoptic calibrate centres white.png -o centres.csv
    """
    from ...runtime import require_output
    from . import calibration
    from .calibration_result import listed

    require_output(output, *whites)
    result = calibration.find_centres(*(_values(path, linear) for path in whites))
    calibration.write_centres(output, result)
    if result.doubtful.any():
        lenses = listed([f"({column}, {row})" for column, row in result.lens[result.doubtful].tolist()], _NAMED)
        typer.echo(
            f"{result.doubtful.sum()} doubtful centres, which dust or a defect may displace (column doubtful), of "
            f"lenses (k, l) {lenses}"
        )
    along, across = result.grid.spacing
    rows = "" if result.grid.shifted_rows is None else ", every second row shifted"
    typer.echo(
        f"{output}: {len(result.pixel)} centres, {result.error:.3f} px RMS from a regular grid of {along:.5f} x "
        f"{across:.5f} px{rows}, turned by {math.degrees(result.grid.rotation):.4f} degrees; the faintest micro-image "
        f"has {result.light.min():.0%} of the brightest's light"
    )


def corners(
    pictures: list[Picture],
    *,
    output: Annotated[Path, options.ends_in(".csv")],
    board: str,
    white: options.Existing | None = None,
    camera: options.CameraFile | None = None,
    centres: options.Existing | None = None,
    linear: bool = False,
) -> None:
    """Find the corners of a checkerboard in raw pictures, in every micro-image that shows one.

    Parameters
    ----------
    pictures : PICTURE...
        Raw pictures of the board, one for each pose.
    output : FILE.csv
        File to write: the corners.
    white : FILE
        White picture of the same camera, needed without --camera.
    centres : FILE
        Centres of micro-images, as 'calibrate centres' writes them, or those of LFToolbox and PlenoptiCam (.json).
        Default: those of the camera or the white picture.

    Examples
    --------
    $ mitsuba-plenoptic calibrate corners board*.png --board 9x5 --white white.png -o corners.csv
    """
    import numpy as np

    from ...runtime import require_output
    from ...views import white_image
    from . import calibration
    from .calibrated_cameras import lens_index
    from .detect import camera_centres

    require_output(output, *pictures, centres, white)
    shape = calibration.Board.parse(board, 1.0)
    known_camera, record = inputs.load_camera(camera, {}) if camera else (None, None)
    if known_camera is not None:
        light = white_image(known_camera) if white is None else _values(white, linear)
        middles = camera_centres(known_camera, lens_index(record))
    elif white is not None:
        light = _values(white, linear)
        middles = calibration.find_centres(light).table(white.name)
    else:
        raise InputError("--white, --camera: give a white picture of the same camera, or the camera")
    if centres is not None:
        middles = calibration.read_centres(centres)
    tables = []
    for frame, path in enumerate(pictures):
        table = calibration.detect_corners(
            _values(path, linear), light, middles, shape, camera=known_camera, frame=frame, name=path.name
        )
        tables.append(table)
        distinct = len(np.unique(table["cluster"]))
        typer.echo(f"frame {frame}, {path.name}: {distinct} corners, seen {len(table['k'])} times")
    joined = calibration.concatenate(tables)
    calibration.write_corners(output, joined)
    typer.echo(f"{output}: {len(joined['k'])} corners in {len(pictures)} pictures")


def boards(
    sources: list[options.Existing],
    *,
    output: Annotated[Path, options.ends_in(".json")],
    board: str,
    square: float,
    camera: options.CameraFile | None = None,
    white: options.Existing | None = None,
    centres: options.Existing | None = None,
    linear: bool = False,
    bent: bool = False,
    report: Annotated[Path, options.ends_in(".html")] | None = None,
) -> None:
    """Fit a camera to a checkerboard in several poses: to its corners, or to raw pictures of it.

    Start values come from the data, except for what [bold]--camera[/bold] provides: detector, lattice and f-number.
    Pictures of Lytro's cameras and captures state it themselves.

    Parameters
    ----------
    sources : CORNERS.csv | PICTURE...
        Corners of the board, as 'calibrate corners' writes them, or raw pictures of it, one for each pose; or light
        fields (.mat, .eslf.png, .nc).
    output : FILE.json
        File to write: the camera.
    white : FILE | FOLDER
        For raw pictures: a white picture of the same camera, or a folder of those of a Lytro camera.
    centres : FILE
        Centres of micro-images, fitted jointly, as 'calibrate centres' writes them, or those of LFToolbox and
        PlenoptiCam (.json).
    bent
        Fit the board's shape, too, as of paper that does not lie flat.

    Examples
    --------
    $ mitsuba-plenoptic calibrate boards corners.csv --board 9x5 --square 10 --camera start.json -o camera.json
    $ mitsuba-plenoptic calibrate boards board*.lfr --white whites --board 19x19 --square 3.61 -o camera.json
    """
    from ...runtime import require_output

    for path in filter(None, (output, report)):
        require_output(path, *sources, centres, white)
    from . import calibration
    from .board_model import UNITS
    from .calibration_result import summary
    from .picture_corners import corners_of_pictures, is_light_field

    size = calibration.Board.parse(board, square)
    middles = None if centres is None else calibration.read_centres(centres)
    start = None if camera is None else inputs.load_camera(camera, {})[0]
    tables = [path for path in sources if path.suffix.lower() == ".csv"]
    refuse_if(tables and len(sources) > 1, f"{sources[0]}: give one table of corners, or pictures")
    without_raw = is_light_field(sources[0])
    # Until the camera is written: corners that are found serve another try.
    with contextlib.nullcontext() if tables else stopping.checkpoint_of(output, False) as saved:
        if saved is None:
            if start is None:
                raise InputError("--camera: a table of corners needs it")
            inputs.refuse_options("a table of corners", white=white, linear=linear)
            table = calibration.read_corners(sources[0], size, start.crop_size)
        else:
            if without_raw:
                inputs.refuse_options("a light field", white=white, camera=camera, centres=centres, linear=linear)
            with progress_bar("Finding corners") as progress, stopping.resumable(progress, saved):
                start, table, middles = corners_of_pictures(
                    sources, white, size, start, middles, linear, saved, progress
                )
            for frame, path in enumerate(sources):
                rows = table.keep(table["frame"] == frame)
                seen = f"{len(set(rows['cluster']))} corners, seen {len(rows['u'])} times"
                typer.echo(f"frame {frame}, {path.name}: {seen}")
        result = calibration.calibrate(table, size, start, middles, fills_pupil=without_raw, bent=bent)
        calibration.write_calibration(output, result, size)
    if report:
        from .calibration_page import write_calibration_report

        write_calibration_report(report, result, size, table, middles, () if tables else sources)
    for name, value in result.numbers.items():
        typer.echo(f"{name:>18} {value:14.7g} +- {result.deviations[name]:.2g} {UNITS[name]}".rstrip())
    *lines, error = summary(result, _NAMED)
    typer.echo("\n".join([*lines, f"{output}: {error}"]))


def white(
    picture: Picture,
    *,
    output: Annotated[Path, options.ends_in(".json")],
    camera: options.CameraFile,
    dark: options.Existing | None = None,
    model: choices.Model = "wave",
    wavelength: options.Wavelength | None = None,
    report: Annotated[Path, options.ends_in(".html")] | None = None,
) -> None:
    """Fit a camera to a white picture.

    Of a microscope in the Fourier arrangement the lattice, the stop's image and the field stop are fitted.

    Parameters
    ----------
    picture : WHITE
        Picture of something evenly white, with values proportional to light.
    output : FILE.json
        File to write: the camera.
    dark : FILE
        Picture without light.
    model
        How light propagates in the fit.
    wavelength
        Of waves: wavelength in nanometres. Default: 550.

    Examples
    --------
    $ mitsuba-plenoptic calibrate white white.png --dark dark.tif --camera known.json -o camera.json
    """
    from ...runtime import require_output, write_text

    refuse_if(
        model == "ray" and wavelength is not None, f"--wavelength = {wavelength}: a fit by rays has none; leave it out"
    )
    for path in filter(None, (output, report)):
        require_output(path, picture, dark)
    nominal, _ = inputs.load_camera(camera, {})
    if nominal.lens_data.images_stop:
        refuse_if((report or wavelength) is not None, "--report, --wavelength: not for the Fourier arrangement")
        _stop_image(picture, dark, nominal, output)
        return
    from . import white_result
    from .photon_transfer import photon_transfer
    from .white_fit import fit_white
    from .white_frames import sensor_pictures, values_of
    from .white_page import write_white_report

    light, black = sensor_pictures(picture, dark=dark)
    noise: PhotonTransfer | str | None = None
    if black is not None:
        try:
            noise = photon_transfer(light, black)
        except InputError as error:
            noise = str(error)
    nanometres = None if model == "ray" else wavelength or 550.0
    with naming(picture), progress_bar("Fitting the camera") as progress:
        fit = fit_white(values_of(picture), nominal, dark=black, wavelength=nanometres, progress=progress)
    values = {**fit.camera.to_dict(), "calibration": white_result.record(fit, noise)}
    write_text(output, json.dumps(values, indent=1) + "\n", ".json")
    lines = white_result.summary(fit, noise)
    typer.echo("\n".join(lines))
    if report is not None:
        with progress_bar("Simulating the white picture"):
            write_white_report(report, fit, lines)
    typer.echo(f"{output}: fitted to {(~fit.withheld).sum()} micro-images")


def _stop_image(picture: Path, dark: Path | None, nominal: PlenopticCamera, output: Path) -> None:
    """Fit a microscope in the Fourier arrangement to a white picture; print and write what is found."""
    from ...runtime import write_text
    from .stop_fit import NUMBERS, fit_stop
    from .white_frames import clipped, sensor_pictures

    light, black = sensor_pictures(picture, dark=dark)
    with naming(picture):
        is_raw = picture.suffix.lower() in choices.RAW_SUFFIXES
        refuse_if(is_raw and clipped("white", light).any(), "white: it is overexposed")
        fit = fit_stop(light if black is None else light - black, nominal)
    record = {"deviations": fit.deviations, "residual": fit.residual}
    write_text(output, json.dumps({**fit.camera.to_dict(), "calibration": record}, indent=1) + "\n", ".json")
    for name, value in fit.numbers.items():
        typer.echo(f"{name:>18} {value:12.6g} +- {fit.deviations[name]:.2g} {NUMBERS[name]}".rstrip())
    typer.echo(f"{output}: the picture differs by {fit.residual:.1%} of its light")


def evaluate(corners: Table, *, camera: options.CameraFile, board: str, square: float) -> None:
    """Print how far off a camera is: it is held fixed, and the poses of a checkerboard are fitted.

    Parameters
    ----------
    corners : CORNERS.csv
        Corners of the board, as 'calibrate corners' writes them.

    Examples
    --------
    $ mitsuba-plenoptic calibrate evaluate corners.csv --camera camera.json --board 9x5 --square 10
    """
    tested, record = inputs.load_camera(camera, {})
    from . import calibration
    from .calibrated_cameras import lens_index
    from .calibration_result import error_line, outlier_lines

    index = lens_index(record)
    size = calibration.Board.parse(board, square)
    evaluation = calibration.evaluate(calibration.read_corners(corners, size, tested.crop_size), size, tested, index)
    for frame, error in zip(evaluation.frames, evaluation.pose_errors, strict=True):
        typer.echo(f"frame {frame}: {error:.4f} {evaluation.unit}")
    typer.echo("\n".join([*outlier_lines(evaluation, _NAMED), error_line(evaluation)]))


def _values(path: Path, linear: bool) -> Array:
    """Return the values of a picture, or of a capture."""
    from ...io import Capture
    from ...views import read_recording

    recording = read_recording(path, linear)
    return recording.image if isinstance(recording, Capture) else recording
