"""``mitsuba-plenoptic calibrate``: a camera from corners, corners and centres from pictures, an evaluation."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ... import choices
from ...cli import inputs, options
from ...errors import content_of, refuse_if

if TYPE_CHECKING:
    from ...camera import PlenopticCamera
    from ...runtime import Array
    from .calibration import Board

# Outliers that are printed by line.
_NAMED = 10

_PICTURES = (".exr", ".png", ".tif", ".tiff")


def calibrate(
    sources: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="CORNERS.csv|WHITE|PICTURES...",
            help="Corners of a board seen through the lenses; or white images (.exr, .png, .tiff) at one or several "
            "apertures; or, with --board, raw pictures of the board, one for each pose.",
            callback=options.EXISTING,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        options.output_option("FILE", "File to write: the camera as JSON; of pictures, corners or centres as CSV."),
    ] = None,
    camera: options.CameraFile = None,
    board: Annotated[
        str | None, typer.Option(metavar="COLUMNSxROWS", help="Inner corners along the board and across it.")
    ] = None,
    square: Annotated[
        float | None, options.numeric("Distance of neighbouring corners, the scale of all lengths.", "none", unit="MM")
    ] = None,
    centres: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Centres of micro-images, fitted jointly; WHITE writes such a file. Or those of LFToolbox and "
            "PlenoptiCam (.json).",
        ),
    ] = None,
    evaluate: Annotated[
        Path | None,
        typer.Option(metavar="CORNERS.csv", help="Hold the camera, refit the poses, and print how far off it is."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Also write a page with parameters, poses and residuals.")
    ] = None,
    white: options.White = None,
    linear: options.Linear = False,
    dark: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Picture without light, for a camera fitted to a white picture.")
    ] = None,
    wavelength: Annotated[float | None, options.wavelength_option("550")] = None,
    model: Annotated[
        choices.Model | None, typer.Option(show_default="wave", help="Light of a fit to a white picture.")
    ] = None,
) -> None:
    """Calibrate a real camera from corners of a checkerboard and white images.

    Corners are a table k, l, u, v, cluster, frame: lens along its row, row,
    pixel, index of the corner, picture. Start values come from the data, except
    for what [bold]--camera[/bold] provides: detector, lattice and f-number.

    [bold]Examples:[/bold]

      mitsuba-plenoptic calibrate white.png -o centres.csv

      mitsuba-plenoptic calibrate white.png --dark dark.tif --camera known.json -o camera.json

      mitsuba-plenoptic calibrate board*.png --board 9x5 --white white.png -o corners.csv

      mitsuba-plenoptic calibrate corners.csv --board 9x5 --square 10 --camera start.json -o camera.json

      mitsuba-plenoptic calibrate --evaluate corners.csv --camera camera.json --board 9x5 --square 10
    """
    from ...runtime import require_apart, require_different, require_writable

    sources = sources or []
    if bool(sources) == (evaluate is not None):
        raise typer.BadParameter("give corners or pictures, or corners to --evaluate", param_hint="SOURCE")
    pictures = [path.suffix.lower() in _PICTURES for path in sources]
    for path in sources if evaluate is None else [evaluate]:
        refuse_if(
            path.suffix.lower() in choices.LYTRO_SUFFIXES,
            f"{path}: a raw picture of a Lytro camera is a mosaic of colours; demosaic it first",
        )
        content = "text" if evaluate is None and path.suffix.lower() in _PICTURES else content_of(path)
        refuse_if(
            not content.startswith("text"),
            f"{path}: it is {content}; corners are a table (.csv), pictures and white images .exr, .png or .tiff",
        )
    if evaluate is not None and output is not None:
        raise typer.BadParameter("--evaluate prints and writes no file", param_hint="--output")
    fitted = all(pictures) and board is None and output is not None and output.suffix.lower() == ".json"
    if report is not None and not fitted and (evaluate is not None or all(pictures)):
        raise typer.BadParameter("a report is of a calibration from corners or a white picture", param_hint="--report")
    require_different(output, report)
    for path in filter(None, (output, report)):
        require_apart(path, *sources, centres, white, dark)
    if not fitted:
        inputs.refuse_options(
            "a calibration without a fit to a white picture", dark=dark, wavelength=wavelength, model=model
        )
    if evaluate is not None:
        inputs.refuse_options("an evaluation", centres=centres, white=white, linear=linear)
        _evaluate(evaluate, camera, board, square)
        return
    if output is None:
        raise typer.BadParameter("name the file to write", param_hint="--output")
    if len(sources) > 1 and (fitted or not all(pictures)):
        message = "a camera is fitted to one white picture" if fitted else "give one table of corners, or pictures"
        raise typer.BadParameter(message, param_hint="SOURCE")
    require_writable(output, ".csv" if all(pictures) and not fitted else ".json")
    if report:
        require_writable(report, ".html")
    if fitted:
        inputs.refuse_options("a fit to a white picture", square=square, centres=centres, white=white, linear=linear)
        by_rays = model == "ray"
        refuse_if(
            by_rays and wavelength is not None, f"--wavelength = {wavelength}: a fit by rays has none; leave it out"
        )
        nominal, _ = _camera(camera)
        from .white_command import fit_camera

        fit_camera(sources[0], output, nominal, dark, None if by_rays else wavelength or 550.0, report)
    elif all(pictures) and board is not None:
        inputs.refuse_options("detecting corners", square=square)
        _detect(sources, output, camera, board, centres, white, linear)
    elif all(pictures):
        inputs.refuse_options(
            "finding centres in white images", camera=camera, square=square, centres=centres, white=white
        )
        _centres(sources, output, linear)
    else:
        inputs.refuse_options("a calibration from corners", white=white, linear=linear)
        _calibrate(sources[0], output, camera, board, square, centres, report)


def _board(board: str | None, square: float | None) -> Board:
    from .calibration import Board

    if board is None or square is None:
        raise typer.BadParameter(
            "corners need the board and the distance of its corners", param_hint="--board --square"
        )
    return Board.parse(board, square)


def _camera(camera: str | None) -> tuple[PlenopticCamera, Any]:
    """Return the camera and the record of its calibration."""
    if camera is None:
        raise typer.BadParameter("name a camera: a preset, a JSON file or a scene", param_hint="--camera")
    return inputs.load_camera(camera, {})


def _evaluate(path: Path, camera: str | None, board: str | None, square: float | None) -> None:
    tested, record = _camera(camera)
    from . import calibration
    from .calibrated_cameras import lens_index
    from .calibration_result import error_line, outlier_lines

    index = lens_index(record)
    size = _board(board, square)
    evaluation = calibration.evaluate(calibration.read_corners(path, size, tested.crop_size), size, tested, index)
    for frame, error in zip(evaluation.frames, evaluation.pose_errors, strict=True):
        typer.echo(f"frame {frame}: {error:.4f} px")
    typer.echo("\n".join([*outlier_lines(evaluation, _NAMED), error_line(evaluation)]))


def _picture(path: Path, linear: bool) -> Array:
    from ...io import Capture
    from ...views import read_recording

    recording = read_recording(path, linear)
    return recording.image if isinstance(recording, Capture) else recording


def _detect(
    paths: list[Path],
    output: Path,
    camera: str | None,
    board: str,
    centres: Path | None,
    white: Path | None,
    linear: bool,
) -> None:
    import numpy as np

    from ...views import white_image
    from . import calibration
    from .calibrated_cameras import lens_index

    known_camera = None
    if camera is not None:
        known_camera, record = _camera(camera)
        light = white_image(known_camera) if white is None else _picture(white, linear)
        middles = calibration.camera_centres(known_camera, lens_index(record))
    elif white is not None:
        light = _picture(white, linear)
        middles = calibration.find_centres(light).table(white.name)
    else:
        raise typer.BadParameter(
            "pictures of a board need a white image of the same camera, or the camera", param_hint="--white --camera"
        )
    if centres is not None:
        middles = calibration.read_centres(centres)
    shape = calibration.Board.parse(board, 1.0)
    tables = []
    for frame, path in enumerate(paths):
        picture = _picture(path, linear)
        table = calibration.detect_corners(
            picture, light, middles, shape, camera=known_camera, frame=frame, name=path.name
        )
        tables.append(table)
        distinct = len(np.unique(table["cluster"]))
        typer.echo(f"frame {frame}, {path.name}: {distinct} corners, seen {len(table['k'])} times")
    corners = calibration.concatenate(tables)
    calibration.write_corners(output, corners)
    typer.echo(f"{output}: {len(corners['k'])} corners in {len(paths)} pictures")


def _centres(paths: list[Path], output: Path, linear: bool) -> None:
    from . import calibration
    from .calibration_result import listed

    centres = calibration.find_centres(*(_picture(path, linear) for path in paths))
    calibration.write_centres(output, centres)
    if centres.doubtful.any():
        lenses = listed([f"({column}, {row})" for column, row in centres.lens[centres.doubtful].tolist()], _NAMED)
        typer.echo(
            f"{centres.doubtful.sum()} doubtful centres, which dust or a defect may displace (column doubtful), of "
            f"lenses (k, l) {lenses}"
        )
    along, across = centres.grid.spacing
    rows = "" if centres.grid.shifted_rows is None else ", every second row shifted"
    typer.echo(
        f"{output}: {len(centres.pixel)} centres, {centres.error:.3f} px RMS from a regular grid of {along:.5f} x "
        f"{across:.5f} px{rows}, turned by {math.degrees(centres.grid.rotation):.4f} degrees; the faintest micro-image "
        f"has {centres.light.min():.0%} of the brightest's light"
    )


def _calibrate(
    path: Path,
    output: Path,
    camera: str | None,
    board: str | None,
    square: float | None,
    centres: Path | None,
    report: Path | None,
) -> None:
    start, _ = _camera(camera)
    from . import calibration
    from .board_model import UNITS
    from .calibration_result import summary

    size = _board(board, square)
    corners = calibration.read_corners(path, size, start.crop_size)
    middles = None if centres is None else calibration.read_centres(centres)
    calibration_found = calibration.calibrate(corners, size, start, middles)
    calibration.write_calibration(output, calibration_found, size)
    if report:
        from .calibration_page import write_calibration_report

        write_calibration_report(report, calibration_found, size, corners, middles)
    for name, value in calibration_found.numbers.items():
        typer.echo(f"{name:>18} {value:14.7g} +- {calibration_found.deviations[name]:.2g} {UNITS[name]}".rstrip())
    *lines, error = summary(calibration_found, _NAMED)
    typer.echo("\n".join([*lines, f"{output}: {error}"]))
