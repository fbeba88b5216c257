"""The part of ``mitsuba-plenoptic compare`` that compares a real light field with simulated ones."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import typer

from ...camera import PlenopticCamera
from ...errors import naming, refuse_if, refusing
from ...io import Cache, StageOptions, write_json
from ..calibrate.white_frames import sensor_pictures
from .real_page import write_page
from .study import Pictures, Study

PART = "0.25,0.25,0.75,0.75"
"""Left, top, right and bottom of the part that is studied, over the picture's size."""


def compare_real(
    light_field: Path,
    folder: Path,
    camera: PlenopticCamera,
    *,
    white: Path,
    dark: Path | None,
    wavelength: float,
    part: str | None,
    planes: Sequence[float],
    options: StageOptions,
) -> None:
    """Fit the camera by waves and by rays, predict withheld pixels of a light field, and write a page on it."""
    corners = _corners(part or PART)
    pictures = Pictures(*sensor_pictures(white, light_field=light_field, dark=dark))
    rows, columns = pictures.white.shape
    box = tuple(corner * size for corner, size in zip(corners, (columns, rows) * 2, strict=True))
    study = Study(pictures, camera, wavelength, box, planes, Cache(folder, options))
    with naming(white):
        study.fit_cameras()
    answer = study.answer()
    write_json(folder / "results.json", asdict(answer) | {"verdict": answer.verdict})
    write_page(folder / "report.html", study, answer)
    for test, ratio in answer.ratios.items():
        typer.echo(f"withheld {test}: residual over noise {ratio.waves:.2f} by waves, {ratio.rays:.2f} by rays")
    if camera.objective is None:
        typer.echo(f"planes at {', '.join(f'{distance:.4g}' for distance in answer.distances)} mm")
    typer.echo(answer.noise)
    stray = answer.stray
    typer.echo(f"stray light within lenses: {stray['waves']:.1%} by waves and {stray['rays']:.1%} by rays")
    typer.echo(answer.verdict)
    typer.echo(f"{folder / 'report.html'}: open it in a browser")


def _corners(part: str) -> tuple[float, float, float, float]:
    """Return the corners of a part as fractions of the picture."""
    rule = f"part = {part}: it must be LEFT,TOP,RIGHT,BOTTOM in parts of the picture, such as {PART}"
    with refusing(rule, ValueError):
        left, top, right, bottom = map(float, part.split(","))
    refuse_if(not (0 <= left < right <= 1 and 0 <= top < bottom <= 1), rule)
    return left, top, right, bottom
