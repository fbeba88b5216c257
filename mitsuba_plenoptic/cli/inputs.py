"""Options that several commands have, and functions that load the cameras, scenes and captures they name."""

from __future__ import annotations

import contextlib
import logging
import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import SCENE_XML, InputError, content_of, naming, refuse_if, require_count, require_number, warn
from ..presets import PRESETS
from ..scene_files import scene_names, scene_path
from .choices import MODELS, UNITS
from .judging import CAMERA, COUNTED, FILE, RECORDING, SCENE, Judged, one_of, require_camera_name

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from ..camera import PlenopticCamera
    from ..report.images import Drawing
    from ..runtime.batches import BatchMap


def output_option(metavar: str, text: str) -> Any:
    """Return the option ``-o`` of a command that writes a file or a folder."""
    return typer.Option("-o", "--output", metavar=metavar, help=text)


WAVES, EXPERT = "Options of waves", "Options for experts"
"""Panels of the help below the one of the options that most people need."""


def numeric(text: str, default: str | None = None, *, unit: str = "N", panel: str | None = None) -> Any:
    """Return an option that takes a number; help shows `default` where the parameter's default is None."""
    return typer.Option(metavar=unit, show_default=default or True, help=text, rich_help_panel=panel)


Scene = Annotated[str, typer.Argument(help="A Mitsuba XML file, or the name of a built-in scene."), SCENE]
CaptureFile = Annotated[Path, typer.Argument(metavar="CAPTURE.exr", help="A file that 'render' wrote."), RECORDING]
OutputFolder = Annotated[Path, output_option("DIR", "Folder to write into; made if it is not there.")]

Definitions = Annotated[
    list[str] | None,
    typer.Option(
        "-D",
        "--define",
        metavar="NAME=VALUE",
        help="Set a scene parameter, the $NAME in its XML file; repeat for several.",
    ),
]

_DISTANCE = numeric("Distance from the main lens to focus on, beyond its focal length; repeat for several.", unit="MM")

# Depths before an objective may be negative, and only the capture tells whether there is one.
Distances = Annotated[list[float], _DISTANCE, Judged(partial(require_number, finite=False))]
AnyDistances = Annotated[list[float] | None, _DISTANCE, Judged(partial(require_number, finite=False))]
Disparities = Annotated[
    list[float] | None,
    numeric("Instead: shift of points in focus from view to view, negative nearer; no camera needed.", unit="LENSES"),
    Judged(require_number),
]
PositiveDistances = Annotated[list[float] | None, _DISTANCE, Judged(partial(require_number, positive=True))]

Variant = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        show_default="llvm_ad_mono",
        help="Mitsuba variant, for example llvm_ad_rgb or cuda_ad_mono.",
        rich_help_panel=EXPERT,
    ),
]

Model = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(MODELS),
        show_default="as the scene's integrator has it",
        help="How light propagates through the camera.",
    ),
    one_of(MODELS),
]

Samples = Annotated[int | None, numeric("Samples per pixel.", "those of the scene's sampler"), COUNTED]

Seed = Annotated[int, numeric("Seed of the random numbers.")]

Workers = Annotated[
    int | None,
    numeric(
        "Wave captures: number of processes of this machine to sum on; the capture has the same bits.",
        "threads of one process",
        panel=EXPERT,
    ),
]

Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Wave captures: sum on the workers of this Dask scheduler, for example tcp://10.0.0.1:8786.",
        rich_help_panel=EXPERT,
    ),
]

CameraFile = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="PRESET|FILE.json|SCENE|NAME=VALUE,...",
        help=f"Camera instead of any other: {', '.join(PRESETS)}, a JSON or YAML file, as 'calibrate' writes it, a "
        "scene's, or parameters, such as f_number=2.8,lenses=100,pixels_per_lens=10,pixel_size=0.005,focal_length=50,"
        "focus_distance=320.",
    ),
    CAMERA,
]

Unit = Annotated[
    str,
    typer.Option(
        metavar="|".join(UNITS), help="Unit of the scene's lengths, which are scaled to millimetres; not the camera's."
    ),
    one_of(UNITS),
]

LightFieldSource = Annotated[
    Path,
    typer.Argument(
        metavar="SOURCE",
        help="A capture (.exr), a light field (.nc, .zarr, LFToolbox's .mat, or a folder of HCI), a mosaic (.png with "
        "--view-count, .eslf.png for the samples of each lens together), or a raw picture of a real camera (.png or "
        ".tiff, with --white or --camera).",
    ),
    RECORDING,
]

White = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        show_default="computed from the camera",
        help="White image of the same camera, .exr, .png or .tiff. For a raw picture it shows where the micro-images "
        "are.",
    ),
    FILE,
]

Truth = Annotated[
    Path | None,
    typer.Option(
        "--truth",
        metavar="FILE.truth.exr",
        show_default="the one next to the capture, if 'render --aov' wrote it",
        help="Ground truth of the capture.",
    ),
    FILE,
]

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

Scale = Annotated[
    int | None,
    numeric(
        "Of plain pictures: pixels that a bin is wide.",
        "as many as fit in 960 pixels, at least 1; in 480 for .gif",
    ),
]

Figure = Annotated[
    bool,
    typer.Option(
        "--figure",
        help="Make a .png a labelled figure for papers, with colour bar and scale bars, as a .pdf always is.",
    ),
]

_LARGEST_SCALE = 64

ViewCount = Annotated[
    int | None, numeric("For a mosaic: how many views it has along each axis, 14 in Lytro's ESLF files.")
]

Linear = Annotated[
    bool,
    typer.Option("--linear", help="Pictures hold values proportional to light, as raw data does, instead of sRGB."),
]


_COLOURS = "llvm_ad_rgb"
"""Variant for films that record colours."""

_log = logging.getLogger(__name__)


def load_camera(source: str, parameters: dict[str, str], unit: str = "mm") -> tuple[PlenopticCamera, Any]:
    """Return the camera of a preset, file, parameters or scene, and the record of its calibration (None without one).

    A file takes precedence over a preset or scene of the same name.
    """
    from ..camera import PlenopticCamera
    from ..light.scene import load_scene

    preset = source in PRESETS and not Path(source).is_file()
    # Some scenes are called as a camera; parameters are theirs.
    preset = preset and not (parameters and source in scene_names())
    stated = re.match(r"\w+=", source) is not None and not Path(source).is_file()
    if preset or stated or source.lower().endswith((".json", ".js", ".yaml", ".yml")):
        refuse_if(
            unit != "mm", f"--unit {unit}: {source} is no scene, and has its lengths in millimetres; leave it out"
        )
        refuse_if(parameters, f"-D: {source} is no scene, and has no scene parameters; leave it out")
        from ..camera.camera_files import camera_and_record

        return camera_and_record(source)
    require_camera_name("camera", source)
    found = content_of(Path(source)) if Path(source).is_file() else SCENE_XML
    refuse_if(found != SCENE_XML, f"{source}: it is {found}; a camera is a preset, a JSON or YAML file or a scene")
    sensors = load_scene(source, parameters=parameters, unit=unit).sensors()
    refuse_if(not sensors, f"{source}: it has no sensor; add one of type 'plenoptic'")
    return PlenopticCamera.from_sensor(sensors[0]), None


def require_linear(linear: bool, *paths: Path | None) -> None:
    """Refuse ``--linear`` unless an input is a picture."""
    from ..io.captures import RAW_SUFFIXES

    given = [path for path in paths if path is not None]
    refuse_if(
        linear and not any(path.suffix.lower() in RAW_SUFFIXES for path in given),
        f"--linear: it is for pictures (.png, .tiff); {given[0]} holds values proportional to light",
    )


def drawing_of(
    exposure: float | None, percentile: float | None, scale: int | None, figure: bool, *paths: Path | None
) -> Drawing:
    """Return the settings for drawn pictures; refuse these options where the output is not a picture."""
    from ..report.images import ANIMATED, PICTURES, Brightness, Drawing

    named = "--exposure" if exposure is not None else "--percentile" if percentile is not None else None
    given = [path for path in paths if path is not None]
    refuse_if(
        named and not any(path.suffix.lower() in PICTURES for path in given),
        f"{named}: it is for pictures ({', '.join(PICTURES)}); {given[0]} keeps the values as they are",
    )
    suffix = given[0].suffix.lower()
    refuse_if(figure and suffix not in (".png", ".pdf"), f"--figure: it is for .png and .pdf; the output is {given[0]}")
    if scale is not None:
        refuse_if(
            figure or suffix not in (".png", *ANIMATED),
            f"--scale {scale}: it is for plain pictures (.png, {', '.join(ANIMATED)}), without --figure; the output is "
            f"{given[0]}",
        )
        require_count("scale", scale, maximum=_LARGEST_SCALE)
    return Drawing(Brightness(exposure, percentile), scale, figure)


def named_camera(source: str | None) -> PlenopticCamera | None:
    """Return the camera that an option names, or None without the option."""
    return None if source is None else load_camera(source, {})[0]


def require_in_sight(source: Path, camera: PlenopticCamera | None, *distances: float) -> PlenopticCamera | None:
    """Return the given camera, or else the camera of the source; refuse distances on which it cannot focus."""
    seen_by = camera
    if camera is None and source.suffix.lower() == ".exr":
        from ..camera import PlenopticCamera
        from ..io.exr import read_attributes

        record = read_attributes(source).get("camera")
        with naming(source):
            seen_by = PlenopticCamera.from_dict(record) if isinstance(record, dict) else None
    if seen_by is not None:
        for distance in distances:
            seen_by.lens_data.require_distance(seen_by, distance)
    return camera


def open_scene(
    scene: str,
    parameters: dict[str, str],
    variant: str | None,
    camera: str | None = None,
    index: int = 0,
    unit: str = "mm",
) -> Any:
    """Return a loaded scene, by default in the variant that fits its film; warn of a poor design.

    Another camera takes the place of the sensor of this index, and is the first of the scene returned.
    """
    from ..camera import PlenopticCamera
    from ..design import design_warnings
    from ..light.render_capture import plenoptic_sensor
    from ..light.scene import load_scene
    from ..plugins.other_camera import with_camera
    from ..runtime.backend import DEFAULT_VARIANT

    other = named_camera(camera)
    colours = None if variant else _colours_of_film(scene, parameters)
    chosen = variant or (_COLOURS if colours else DEFAULT_VARIANT)
    loaded = load_scene(scene, variant=chosen, parameters=parameters, unit=unit)
    if other is not None:
        require_in_use(scene, parameters)
        # It stands first. Number 0 is the first camera, before which there may be meters.
        loaded, index = with_camera(loaded, other, index or None), 0
    sensor = plenoptic_sensor(loaded, index)
    seen = PlenopticCamera.from_sensor(sensor)
    if colours:
        _log.info("variant %s, as the film records %s; --variant chooses another", _COLOURS, colours)
    for text in design_warnings(seen):
        warn(text)
    return loaded


_OWN = ("sampler", "transform", "medium")
"""Elements of a scene's sensor that remain where another camera takes its place."""


def require_in_use(scene: str, parameters: dict[str, str], option: str = "-D") -> None:
    """Refuse parameters of the scene's camera where another camera takes its place.

    The position of the camera and its sampler remain those of the scene. Names that the scene does not have are left
    to its loading.
    """
    from ..light.scene import names_in

    roots, used = scene_roots(scene, parameters), set()
    known = {name for root in roots for each in root.iter() for name in names_in(each)}

    def visit(element: Element, of_camera: bool) -> None:
        replaced = element.tag == "sensor" or (of_camera and element.tag not in _OWN)
        if not replaced and element.tag != "default":
            used.update(names_in(element))
        for part in element:
            visit(part, replaced)

    for root in roots:
        visit(root, False)
    # Parameters are used, too, to which the defaults of used ones refer.
    defaults = {each.get("name"): names_in(each) for root in roots for each in root.iter("default")}
    while more := {other for name in used for other in defaults.get(name, ())} - used:
        used |= more
    for name in parameters:
        if name in known - used:
            raise InputError(
                f"{option} {name}: it is of the scene's own camera, which another one replaces; leave it out"
            )


def scene_roots(scene: str, parameters: dict[str, str]) -> list[Element]:
    """Return the root elements of a scene file and of all that it includes."""
    from ..light.scene import check_scene_file

    return check_scene_file(Path(scene) if Path(scene).is_file() else scene_path(scene), parameters)


def _colours_of_film(scene: str, parameters: dict[str, str]) -> str | None:
    """Return the colour channels that a scene's film records, None if it records none.

    Films of Mitsuba record rgb by default, as does a sensor without a film.
    """
    from xml.etree.ElementTree import Element

    from ..light.scene import scene_defaults

    roots = scene_roots(scene, parameters)
    formats: list[str] = []
    for film in [each for root in roots for each in root.iter("film")] or [Element("film", type="hdrfilm")]:
        named = [each.get("value", "") for each in film.iter("string") if each.get("name") == "pixel_format"]
        formats += named or (["rgb"] if film.get("type") == "hdrfilm" else [])
    values = scene_defaults(roots) | parameters
    for name in formats:
        colours = values.get(name.removeprefix("$"), name).lower()
        if colours in ("rgb", "rgba", "xyz", "xyza"):
            return colours
    return None


def parse_definitions(definitions: list[str] | None) -> dict[str, str]:
    """Return ``name=value`` texts as a dictionary."""
    parameters = {}
    for text in definitions or []:
        name, equals, value = text.partition("=")
        refuse_if(not name or not equals, f"-D {text}: write it as -D NAME=VALUE")
        parameters[name] = value
    return parameters


def batches_on(workers: int | None, scheduler: str | None) -> contextlib.AbstractContextManager[BatchMap | None]:
    """Return the Dask cluster of the requested workers; without workers a context that yields None."""
    from ..runtime.batches import Cluster

    given = workers is not None or scheduler is not None
    return Cluster(workers=workers, scheduler=scheduler) if given else contextlib.nullcontext()


def camera_instead(
    source: str | None, scene: str, parameters: dict[str, str], varied: dict[str, str] | None = None
) -> dict[str, Any] | None:
    """Return the parameters of the camera that replaces a scene's, None where none is named."""
    camera = named_camera(source)
    if camera is None:
        return None
    require_in_use(scene, parameters)
    require_in_use(scene, varied or {}, "grid:")
    return camera.to_dict()
