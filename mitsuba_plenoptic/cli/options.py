"""Options that several commands have, with checks that refuse wrong values before the library is imported."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from .. import choices
from ..errors import (
    SCENE_XML,
    InputError,
    content_of,
    did_you_mean,
    refuse_if,
    refusing,
    require_choice,
    require_count,
    require_number,
    require_suffix,
    require_wavelength,
    short_repr,
)
from ..extension import missing
from ..presets import PRESETS
from ..refocus_options import method_names
from ..scene_files import scene_names, scene_path

WAVES = "Options of waves"
EXPERT = "Options for experts"
"""Panels of the help below the one of the options that most people need."""


def checked(check: Callable[[str, Any], object]) -> Callable[..., Any]:
    """Return the callback of an option that calls a check with the option's name and each of its values."""

    def callback(parameter: typer.CallbackParam, value: Any) -> Any:
        name = max(parameter.opts, key=len).lstrip("-").replace("-", "_")
        for item in value if isinstance(value, (list, tuple)) else [value]:
            if item is not None:
                check(name, item)
        return value

    return callback


def ends_in(*suffixes: str, is_folder: bool = False) -> Callable[..., Any]:
    """Return the callback of an option that names an output, which must end in one of the suffixes, and claims it.

    No other process may compute the output meanwhile; an estimate claims nothing.
    """

    def callback(context: typer.Context, path: Path | None) -> Path | None:
        if path is not None and suffixes and not path.is_dir():
            require_suffix(path, suffixes)
        if path is not None and not context.params.get("estimate"):
            from ..runtime import claim

            claim(path, is_folder)
        return path

    return callback


def output_option(metavar: str, text: str, *suffixes: str, is_folder: bool = False) -> Any:
    """Return the option ``-o`` of a command that writes a file that ends in one of the suffixes, or a folder."""
    callback = ends_in(*suffixes, is_folder=is_folder)
    return typer.Option("-o", "--output", metavar=metavar, help=text, callback=callback)


def numeric(
    text: str,
    default: str | None = None,
    *,
    unit: str = "N",
    panel: str | None = None,
    check: Callable[[str, Any], object] | None = None,
) -> Any:
    """Return an option that takes a number; help shows `default` where the parameter's default is None."""
    return typer.Option(
        metavar=unit,
        show_default=default or True,
        help=text,
        rich_help_panel=panel,
        callback=check and checked(check),
    )


def wavelength_option(default: str | None, panel: str | None = None) -> Any:
    """Return an option that takes a wavelength; help shows `default` where the parameter's default is None."""
    return numeric(
        "Of waves: wavelength in nanometres.",
        default,
        unit="NM",
        panel=panel,
        check=lambda name, value: require_wavelength(value, name),
    )


def nanometres_of_channels(name: str, text: str) -> None:
    """Refuse a text that is neither a wavelength nor several."""
    with refusing(
        f"{name} = {short_repr(text)}: it must be nanometres, or three of them separated by commas", ValueError
    ):
        wavelengths = [float(wavelength) for wavelength in text.split(",")]
    for wavelength in wavelengths:
        require_wavelength(wavelength, name)


def _require_file(name: str, path: Path) -> None:
    refuse_if(not path.exists(), f"{path}: there is no such file")


def _require_recording(name: str, path: Path) -> None:
    scene = content_of(path) == SCENE_XML if path.exists() else str(path) in scene_names()
    refuse_if(scene, f"{path}: it is a scene: give what 'render' made of it")
    _require_file(name, path)


def assigned(option: str, form: str) -> Callable[..., Any]:
    """Return the callback of an option whose texts assign a value to a name."""

    def check(parameter: str, text: str) -> None:
        name, equals, _ = text.partition("=")
        refuse_if(not name or not equals, f"{option} {text}: write it as {option} {form}")

    return checked(check)


def _require_variant(name: str, variant: str) -> None:
    import mitsuba as mi

    require_choice(name, variant, mi.variants())


def require_camera_name(name: str, source: str) -> None:
    """Refuse a text that names no camera, that is, no preset, parameters, file or scene."""
    names = scene_names()
    if "=" not in source and not Path(source).exists() and source not in (*PRESETS, *names):
        raise InputError(
            missing("presets", source)
            or f"{source}: there is no such file, and no camera ({', '.join(PRESETS)}) or built-in scene "
            f"({', '.join(names)}) of that name{did_you_mean(source, [*PRESETS, *names])}"
        )


EXISTING = checked(_require_file)
RECORDING = checked(_require_recording)
CAMERA = checked(require_camera_name)
SCENE = checked(lambda _, scene: Path(scene).is_file() or scene_path(scene))
VARIANT = checked(_require_variant)
"""Callbacks of options that name a file, a file that is no scene, a camera, a scene, and a variant of Mitsuba."""

Scene = Annotated[str, typer.Argument(help="A Mitsuba XML file, or the name of a built-in scene.", callback=SCENE)]

CaptureFile = Annotated[
    Path, typer.Argument(metavar="CAPTURE.exr", help="A file that 'render' wrote.", callback=RECORDING)
]

OutputFolder = Annotated[Path, output_option("DIR", "Folder to write into; made if it is not there.", is_folder=True)]

Definitions = Annotated[
    list[str] | None,
    typer.Option(
        "-D",
        "--define",
        metavar="NAME=VALUE",
        help="Set a scene parameter, the $NAME in its XML file; repeat for several.",
        callback=assigned("-D", "NAME=VALUE"),
    ),
]


def distances(*, positive: bool = False, finite: bool = True) -> Any:
    """Return the option ``--distance`` of commands that refocus to several, with bounds of `require_number`."""
    return numeric(
        "Distance from the main lens to focus on, beyond its focal length; repeat for several.",
        unit="MM",
        check=partial(require_number, positive=positive, finite=finite),
    )


Variant = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        show_default="llvm_ad_mono",
        help="Mitsuba variant, for example llvm_ad_rgb or cuda_ad_mono.",
        rich_help_panel=EXPERT,
        callback=VARIANT,
    ),
]

Model = Annotated[
    choices.Model | None,
    typer.Option(show_default="as the scene's integrator has it", help="How light propagates through the camera."),
]

if TYPE_CHECKING:
    Method = str
else:
    Method = Literal[method_names()]
    """A method of reconstruction, of the core or of an installed extension."""

Samples = Annotated[int | None, numeric("Samples per pixel.", "those of the scene's sampler", check=require_count)]

Seed = Annotated[int, numeric("Seed of the random numbers.", check=partial(require_count, minimum=0))]

Workers = Annotated[
    int | None,
    numeric(
        "Of wave captures, deconvolved and data sets: number of processes of this machine; the bits are the same.",
        "threads of one process",
        panel=EXPERT,
    ),
]

Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="The same: workers of this Dask scheduler, for example tcp://10.0.0.1:8786, which must see files under "
        "the same names.",
        rich_help_panel=EXPERT,
    ),
]

Estimate = Annotated[
    bool, typer.Option("--estimate", is_eager=True, help="Print what it would take, after a few seconds, and stop.")
]

CameraFile = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="PRESET|FILE.json|SCENE|NAME=VALUE,...",
        help=f"Camera instead of any other: {', '.join(PRESETS)}, a JSON or YAML file, as 'calibrate' writes it, a "
        "scene's, or parameters, such as f_number=2.8,lenses=100,pixels_per_lens=10,pixel_size=0.005,focal_length=50,"
        "focus_distance=320.",
        callback=CAMERA,
    ),
]

Unit = Annotated[
    choices.Unit,
    typer.Option(help="Unit of the scene's lengths, which are scaled to millimetres; not the camera's."),
]

LightFieldSource = Annotated[
    Path,
    typer.Argument(
        metavar="SOURCE",
        help="A capture (.exr), a light field (.nc, .zarr, LFToolbox's .mat, or a folder of HCI), a mosaic (.png with "
        "--view-count, .eslf.png for the samples of each lens together), or a raw picture of a real camera (.png or "
        ".tiff, with --white or --camera).",
        callback=RECORDING,
    ),
]

White = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        show_default="computed from the camera",
        help="White image of the same camera, .exr, .png or .tiff, by which images are divided. For a raw picture it "
        "shows where the micro-images are.",
        callback=EXISTING,
    ),
]

Truth = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.truth.exr",
        show_default="the one next to the capture, if 'render --aov' wrote it",
        help="Ground truth of the capture.",
        callback=EXISTING,
    ),
]

ViewCount = Annotated[
    int | None, numeric("For a mosaic: how many views it has along each axis, 14 in Lytro's ESLF files.")
]

Linear = Annotated[
    bool,
    typer.Option("--linear", help="Pictures hold values proportional to light, as raw data does, instead of sRGB."),
]

LIGHT_FIELD: dict[str, Any] = {"white": White, "view_count": ViewCount, "linear": Linear, "camera": CameraFile}
"""Options of commands that read a light field: see `inputs.light_field`."""

Exposure = Annotated[
    float | None,
    numeric("Of pictures: the value 2^-STOPS becomes white, so that pictures of several runs compare.", unit="STOPS"),
]

Percentile = Annotated[
    float | None,
    numeric(
        "Of pictures: the value that this percentage does not surpass becomes white; 100: the brightest.",
        "99.5, less where a lamp would make the rest black",
        unit="PERCENT",
    ),
]

_Scale = Annotated[
    int | None,
    numeric(
        "Of plain pictures: pixels that a bin is wide.",
        "as many as fit in 960 pixels, at least 1; in 480 for .gif",
    ),
]

_Figure = Annotated[
    bool,
    typer.Option(
        "--figure",
        help="Make a .png a labelled figure for papers, with colour bar and scale bars, as a .pdf always is.",
    ),
]

Dpi = Annotated[
    int | None,
    numeric(
        "Make a .png a labelled figure of so many dots per inch.",
        "300 for figures",
        check=lambda name, value: require_count(name, value, minimum=20, maximum=2400),
    ),
]

PICTURE: dict[str, Any] = {
    "exposure": Exposure,
    "percentile": Percentile,
    "scale": _Scale,
    "figure": _Figure,
    "dpi": Dpi,
}
"""Options of commands that write pictures: see `inputs.drawing_of`."""

Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Refuse what another run has left at the output, instead of replacing it; the same command goes on from "
        "what it has left itself with and without this.",
        rich_help_panel=EXPERT,
    ),
]
