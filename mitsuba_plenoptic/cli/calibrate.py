"""``mitsuba-plenoptic calibrate``: a camera from corners of a board, centres from white images, a judgement of both."""

from __future__ import annotations

import math
from collections.abc import Sized
from pathlib import Path
from typing import Annotated

import typer

from .. import calibration
from ..calibration import Board
from ..calibration.model import UNITS
from ..io.captures import read_capture
from ..io.files import require_writable
from ..lightfield.exchange import read_picture
from ..report.calibration import write_calibration_report
from .inputs import load_camera
from .options import CameraFile, Linear, number, output_option

# Outliers that are printed by line.
_NAMED = 10

_PICTURES = (".exr", ".png", ".tif", ".tiff")


def calibrate(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="CORNERS.csv|WHITE",
            help="Corners of a board seen through the lenses; or a white image (.exr, .png, .tiff).",
        ),
    ] = None,
    output: Annotated[
        Path | None, output_option("FILE", "File to write: the camera as JSON, or of a white image its centres as CSV.")
    ] = None,
    camera: CameraFile = None,
    board: Annotated[
        str | None, typer.Option(metavar="COLUMNSxROWS", help="Inner corners along the board and across it.")
    ] = None,
    square: Annotated[float | None, number("Distance of neighbouring corners.", "none", unit="MM")] = None,
    centres: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="Centres of micro-images, fitted jointly; WHITE writes such a file."),
    ] = None,
    evaluate: Annotated[
        Path | None,
        typer.Option(metavar="CORNERS.csv", help="Hold the camera, refit the poses, and print how far off it is."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="FILE.html", help="Write a page with numbers, poses and residuals, too.")
    ] = None,
    linear: Linear = False,
) -> None:
    """Calibrate a real camera from corners of a checkerboard and white images.

    Corners are a table k, l, u, v, cluster, frame: lens along its row, row,
    pixel, number of the corner, picture. Start values come from the data, but
    for what [bold]--camera[/bold] tells: detector, lattice and f-number.

    [bold]Examples:[/bold]

      mitsuba-plenoptic calibrate white.png -o centres.csv

      mitsuba-plenoptic calibrate corners.csv --board 9x5 --square 10 --camera start.json -o camera.json

      mitsuba-plenoptic calibrate --evaluate corners.csv --camera camera.json --board 9x5 --square 10
    """
    if (source is None) == (evaluate is None):
        raise typer.BadParameter("give corners or a white image, or corners to --evaluate", param_hint="SOURCE")
    if evaluate is not None:
        _evaluate(evaluate, camera, board, square)
    elif source is not None and source.suffix.lower() in _PICTURES:
        _centres(source, output, linear)
    elif source is not None:
        _calibrate(source, output, camera, board, square, centres, report)


def _board(board: str | None, square: float | None) -> Board:
    if board is None or square is None:
        raise typer.BadParameter(
            "corners need the board and the distance of its corners", param_hint="--board --square"
        )
    return Board.parse(board, square)


def _camera(camera: str | None) -> str:
    if camera is None:
        raise typer.BadParameter("name a camera: a preset, a JSON file or a scene", param_hint="--camera")
    return camera


def _output(output: Path | None) -> Path:
    if output is None:
        raise typer.BadParameter("name the file to write", param_hint="--output")
    return require_writable(output)


def _evaluate(path: Path, camera: str | None, board: str | None, square: float | None) -> None:
    judged, index = load_camera(_camera(camera), {})
    size = _board(board, square)
    found = calibration.evaluate(calibration.read_corners(path, size, judged.crop_size), size, judged, index)
    for frame, error in zip(found.frames, found.pose_errors, strict=True):
        typer.echo(f"frame {frame}: {error:.4f} px")
    typer.echo(
        f"reprojection error {found.error:.4f} px over {len(found.residuals)} observations of {len(found.frames)} poses"
    )


def _centres(path: Path, output: Path | None, linear: bool) -> None:
    output = _output(output)
    white = read_capture(path).image if path.suffix.lower() == ".exr" else read_picture(path, linear=linear)
    found = calibration.find_centres(white)
    calibration.write_centres(output, found)
    along, across = found.grid.spacing
    rows = "" if found.grid.shifted_rows is None else ", every second row shifted"
    typer.echo(
        f"{output}: {len(found.pixel)} centres, {found.error:.3f} px RMS from a regular grid of {along:.5f} x "
        f"{across:.5f} px{rows}, turned by {math.degrees(found.grid.rotation):.4f} degrees; the faintest micro-image "
        f"has {found.light.min():.0%} of the brightest's light"
    )


def _calibrate(
    path: Path,
    output: Path | None,
    camera: str | None,
    board: str | None,
    square: float | None,
    centres: Path | None,
    report: Path | None,
) -> None:
    output = _output(output)
    start, _ = load_camera(_camera(camera), {})
    size = _board(board, square)
    corners = calibration.read_corners(path, size, start.crop_size)
    middles = None if centres is None else calibration.read_centres(centres)
    if report:
        require_writable(report)
    found = calibration.calibrate(corners, size, start, middles)
    calibration.write_calibration(output, found, size)
    if report:
        write_calibration_report(report, found, size, corners, middles)
    for name, value in found.numbers.items():
        typer.echo(f"{name:>18} {value:14.7g} +- {found.deviations[name]:.2g} {UNITS[name]}".rstrip())
    for weakness, parts in found.weak_directions():
        terms = ", ".join(f"{name} {part:+.2f}" for name, part in parts.items())
        typer.echo(f"told badly, {weakness:.1f} times the deviations: {terms}")
    if len(found.evaluation.outliers):
        rows = ", ".join(str(row + 2) for row in found.evaluation.outliers[:_NAMED])
        typer.echo(f"{len(found.evaluation.outliers)} outliers, in lines {rows}{_more(found.evaluation.outliers)}")
    if found.centre_error is not None:
        typer.echo(f"centres of micro-images {found.centre_error:.4f} px RMS over {len(found.centre_residuals)}")
    seen = found.evaluation
    typer.echo(
        f"{output}: reprojection error {seen.error:.4f} px over {len(seen.residuals)} observations of "
        f"{len(seen.frames)} poses"
    )


def _more(rows: Sized) -> str:
    return "" if len(rows) <= _NAMED else " and so on; the file has them all"
