"""Options that several commands have, with checks that refuse wrong values before the library is imported.

Parameters
----------
scene
    A Mitsuba XML file, or the name of a built-in scene.
capture : CAPTURE.exr
    A file that 'render' wrote.
source : SOURCE
    A capture (.exr), a light field (.nc, .zarr, LFToolbox's .mat, or a folder of HCI), a mosaic (.png with
    --view-count, .eslf.png for the samples of each lens together), or a raw picture of a real camera (.png or .tiff,
    with --white or --camera).
output : DIR
    Folder to write into; made if it is not there.
distance
    Distance in millimetres from the main lens to focus on, beyond its focal length; repeat for several.
wavelength
    Of waves: wavelength in nanometres.
variant : NAME
    Mitsuba variant, for example llvm_ad_rgb or cuda_ad_mono. Default: llvm_ad_mono.
model
    How light propagates through the camera. Default: as the scene's integrator has it.
spp
    Samples per pixel. Default: those of the scene's sampler.
seed
    Seed of the random numbers.
workers
    Of wave captures, deconvolved and data sets: number of processes of this machine; the bits are the same. Default:
    threads of one process.
scheduler : ADDRESS
    The same: workers of this Dask scheduler, for example tcp://10.0.0.1:8786, which must see files under the same
    names.
unit
    Unit of the scene's lengths, which are scaled to millimetres; not the camera's.
white : FILE
    White image of the same camera, .exr, .png or .tiff, by which images are divided. For a raw picture it shows where
    the micro-images are. Default: computed from the camera.
truth : FILE.truth.exr
    Ground truth of the capture. Default: the one next to the capture, if 'render --aov' wrote it.
view_count
    For a mosaic: how many views it has along each axis, 14 in Lytro's ESLF files.
linear
    Pictures hold values proportional to light, as raw data does, instead of sRGB.
exposure : STOPS
    Of pictures: the value 2^-STOPS becomes white, so that pictures of several runs compare.
percentile : PERCENT
    Of pictures: the value that this percentage does not surpass becomes white; 100: the brightest. Default: 99.5, less
    where a lamp would make the rest black.
scale
    Of plain pictures: pixels that a bin is wide. Default: as many as fit in 960 pixels, at least 1; in 480 for .gif.
figure
    Make a .png a labelled figure for papers, with colour bar and scale bars, as a .pdf always is.
dpi
    Make a .png a labelled figure of so many dots per inch. Default: 300 for figures.
resume
    Refuse what another run has left at the output, instead of replacing it; the same command goes on from what it has
    left itself with and without this.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

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


def checked(check: Callable[[str, Any], object]) -> Callable:
    """Return the callback of an option that calls a check with the option's name and each of its values."""

    def callback(parameter: typer.CallbackParam, value: Any) -> Any:
        name = max(parameter.opts, key=len).lstrip("-").replace("-", "_")
        for item in value if isinstance(value, (list, tuple)) else [value]:
            if item is not None:
                check(name, item)
        return value

    return callback


def ends_in(*suffixes: str, is_folder: bool = False) -> Callable:
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


def wavelengths_of(text: str, name: str = "wavelength") -> float | list[float]:
    """Return the wavelength that a text has, or those of several channels; refuse other texts."""
    with refusing(
        f"{name} = {short_repr(text)}: it must be nanometres, or three of them separated by commas", ValueError
    ):
        wavelengths = [float(wavelength) for wavelength in text.split(",")]
    for wavelength in wavelengths:
        require_wavelength(wavelength, name)
    return wavelengths if len(wavelengths) > 1 else wavelengths[0]


def require_file(name: str, path: Path) -> None:
    """Refuse a path at which nothing is."""
    refuse_if(not path.exists(), f"{path}: there is no such file")


def _require_recording(name: str, path: Path) -> None:
    scene = content_of(path) == SCENE_XML if path.exists() else str(path) in scene_names()
    refuse_if(scene, f"{path}: it is a scene: give what 'render' made of it")
    require_file(name, path)


def assigned(option: str, form: str) -> Callable:
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


EXISTING = checked(require_file)
RECORDING = checked(_require_recording)
CAMERA = checked(require_camera_name)
SCENE = checked(lambda _, scene: Path(scene).is_file() or scene_path(scene))
VARIANT = checked(_require_variant)
"""Callbacks of options that name a file, a file that is no scene, a camera, a scene, and a variant of Mitsuba."""

Scene = Annotated[str, SCENE]
CaptureFile = Annotated[Path, RECORDING]
OutputFolder = Annotated[Path, ends_in(is_folder=True)]
Existing = Annotated[Path, EXISTING]
Count = Annotated[int, checked(require_count)]
Number = Annotated[float, checked(require_number)]
Positive = Annotated[float, checked(partial(require_number, positive=True))]
Distances = Annotated[list[float], checked(partial(require_number, finite=False))]
Wavelength = Annotated[float, checked(lambda name, value: require_wavelength(value, name))]
Wavelengths = Annotated[str, checked(lambda name, text: wavelengths_of(text, name))]
Variant = Annotated[str, VARIANT, EXPERT]
Seed = Annotated[int, checked(partial(require_count, minimum=0))]
Workers = Annotated[int, EXPERT]
Scheduler = Annotated[str, EXPERT]
Dpi = Annotated[int, checked(partial(require_count, minimum=20, maximum=2400))]
Resume = Annotated[bool, EXPERT]
"""Types of options with their checks, and panels of the help."""

if TYPE_CHECKING:
    Method = str
else:
    Method = Literal[method_names()]
    """A method of reconstruction, of the core or of an installed extension."""

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

Json = Annotated[bool, typer.Option("--json", help="Print JSON for other programs, and nothing else.")]

Estimate = Annotated[
    bool, typer.Option("--estimate", is_eager=True, help="Print what it would take, after a few seconds, and stop.")
]

CameraFile = Annotated[
    str,
    typer.Option(
        "--camera",
        metavar="PRESET|FILE.json|SCENE|NAME=VALUE,...",
        help=f"Camera instead of any other: {', '.join(PRESETS)}, a JSON or YAML file, as 'calibrate' writes it, a "
        "scene's, or parameters, such as f_number=2.8,lenses=100,pixels_per_lens=10,pixel_size=0.005,focal_length=50,"
        "focus_distance=320.",
        callback=CAMERA,
    ),
]

LightField = Annotated[dict[str, Any], {"white": Existing, "view_count": int, "linear": bool, "camera": CameraFile}]
"""Options of commands that read a light field: see `inputs.light_field`."""

Picture = Annotated[dict[str, Any], {"exposure": float, "percentile": float, "scale": int, "figure": bool, "dpi": Dpi}]
"""Options of commands that write pictures: see `inputs.drawing_of`."""
