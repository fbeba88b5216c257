"""Arguments and options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..io.captures import MODELS
from ..presets import PRESETS


def output_option(metavar: str, text: str) -> Any:
    """Return the option ``-o`` of a command that writes a file or a folder."""
    return typer.Option("-o", "--output", metavar=metavar, help=text)


def number(text: str, default: str | None = None, *, unit: str = "N") -> Any:
    """Return an option that takes a number; `default` is what the help shows for a default of None."""
    return typer.Option(metavar=unit, show_default=default or True, help=text)


Scene = Annotated[str, typer.Argument(help="A Mitsuba XML file, or the name of a built-in scene.")]
CaptureFile = Annotated[Path, typer.Argument(metavar="CAPTURE.exr", help="A file that 'render' wrote.")]
OutputFolder = Annotated[Path, output_option("DIR", "Folder to write into; made if it is not there.")]
CaptureOutput = Annotated[Path, output_option("FILE.exr", "File to write.")]

RawOutput = Annotated[Path, output_option("FILE", "File to write: .exr, or .png or .tiff for digital numbers.")]

Definitions = Annotated[
    list[str] | None,
    typer.Option(
        "-D",
        "--define",
        metavar="NAME=VALUE",
        help="Set a scene parameter, the $NAME in its XML file; repeat for several.",
    ),
]

Distances = Annotated[
    list[float],
    number("Distance from the main lens to focus on, beyond its focal length; repeat for several.", unit="MM"),
]

Variant = Annotated[
    str | None,
    typer.Option(
        metavar="NAME", show_default="llvm_ad_mono", help="Mitsuba variant, for example llvm_ad_rgb or cuda_ad_mono."
    ),
]

Model = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(MODELS),
        show_default="as the scene's integrator has it",
        help="How light propagates through the camera.",
    ),
]

Samples = Annotated[int | None, number("Samples per pixel.", "those of the scene's sampler")]

Seed = Annotated[int, number("Seed of the random numbers.")]

Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Go on from the checkpoint of a wave capture that was stopped; refuse one of another scene, camera or "
        "version.",
    ),
]

# For commands that always resume.
ResumeOnly = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Refuse the checkpoint of another scene, camera or version, if the folder holds one, instead of "
        "replacing it.",
    ),
]

Workers = Annotated[
    int | None,
    number(
        "By waves: number of processes of this machine to sum on; the capture has the same bits.",
        "threads of one process",
    ),
]

Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="By waves: sum on the workers of this Dask scheduler, for example tcp://10.0.0.1:8786."
    ),
]

CameraFile = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="PRESET|FILE.json|SCENE",
        help=f"Camera, in the place of any that there is: {', '.join(PRESETS)}, a JSON file, as 'calibrate' writes it, "
        "or a scene's.",
    ),
]

LightFieldSource = Annotated[
    Path,
    typer.Argument(
        metavar="SOURCE",
        help="A capture (.exr), a light field (.nc, .zarr, or LFToolbox's .mat), a mosaic (.png with --view-count, "
        ".eslf.png for the samples of each lens together), or a raw picture of a real camera (.png or .tiff, with "
        "--white or --camera).",
    ),
]

White = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        show_default="computed from the camera",
        help="White image of the same camera, .exr, .png or .tiff. For a raw picture it shows where the micro-images "
        "are.",
    ),
]

Truth = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        metavar="FILE.truth.exr",
        show_default="the one next to the capture, if 'render --aov' wrote it",
        help="Ground truth of the capture.",
    ),
]

Exposure = Annotated[
    float | None,
    number("Of a .png: the value 2^-STOPS becomes white, so that pictures of several runs compare.", unit="STOPS"),
]

Percentile = Annotated[
    float | None,
    number(
        "Of a .png: the value that this percentage does not surpass becomes white, so that a lamp does not make the "
        "rest black; 100: the brightest.",
        "99.5",
        unit="PERCENT",
    ),
]

ViewCount = Annotated[
    int | None, number("For a mosaic: how many views it has along each axis, 14 in Lytro's ESLF files.")
]

Linear = Annotated[
    bool,
    typer.Option("--linear", help="Pictures hold values proportional to light, as raw data does, instead of sRGB."),
]
