"""Functions that load the cameras, scenes and captures that options name."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..choices import ANIMATED, RAW_SUFFIXES
from ..errors import SCENE_XML, InputError, content_of, naming, refuse_if, require_count, warn
from ..presets import PRESETS
from ..scene_files import scene_names, scene_path
from .options import require_camera_name

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    import xarray as xr

    from ..camera import PlenopticCamera
    from ..report import images
    from ..runtime import BatchMap

COLOURS = "llvm_ad_rgb"
"""Variant for films that record colours."""

_INSTEAD = "give a preset, a camera's file or its parameters with --camera"

_log = logging.getLogger(__name__)


def load_camera(source: str, parameters: dict[str, str], unit: str = "mm") -> tuple[PlenopticCamera, Any]:
    """Return the camera of a preset, file, parameters or scene, and the record of its calibration (None without one).

    A file takes precedence over a preset or scene of the same name.
    """
    from ..camera import PlenopticCamera, camera_and_record

    if _is_scene(source, parameters, unit):
        return PlenopticCamera.from_sensor(_sensor_of(source, parameters, unit)), None
    return camera_and_record(source)


def stated_camera(source: str) -> dict[str, Any]:
    """Return what a preset, file, text or scene states of a camera, by name, before anything follows from it."""
    from ..camera import PARAMETERS, stated_and_record

    stated = _sensor_of(source, {}).stated if _is_scene(source, {}) else stated_and_record(source)[0]

    def plain(name: str, value: Any) -> Any:
        # Lenses and other objects become dictionaries, as in files.
        is_plain = value is None or isinstance(value, (str, int, float, list, tuple, dict))
        return value if is_plain else PARAMETERS[name].plain(PARAMETERS[name].check(name, value))

    return {name: plain(name, value) for name, value in stated.items()}


def _is_scene(source: str, parameters: dict[str, str], unit: str = "mm") -> bool:
    """Return whether a camera is that of a scene; refuse options of scenes for others."""
    from ..camera import states_camera

    # Some scenes are called as a camera; parameters are theirs.
    preset = source in PRESETS and not Path(source).is_file() and not (parameters and source in scene_names())
    if preset or states_camera(source) or source.lower().endswith((".json", ".js", ".yaml", ".yml")):
        refuse_options(f"{source} is no scene, and", unit=unit != "mm", D=parameters)
        return False
    require_camera_name("camera", source)
    content = content_of(Path(source)) if Path(source).exists() else SCENE_XML
    others = "; views, stack and depth read a light field's folder" if Path(source).is_dir() else ""
    refuse_if(
        content != SCENE_XML, f"{source}: it is {content}; a camera is a preset, a JSON or YAML file or a scene{others}"
    )
    return True


def _sensor_of(source: str, parameters: dict[str, str], unit: str = "mm") -> Any:
    """Return the first sensor of a scene, a plenoptic one."""
    from ..camera import PlenopticCamera
    from ..scene import load_scene

    sensors = load_scene(source, parameters=parameters, unit=unit).sensors()
    refuse_if(not sensors, f"{source}: it has no sensor; {_INSTEAD}, or add one of type 'plenoptic'")
    try:
        PlenopticCamera.from_sensor(sensors[0])
    except InputError as error:
        raise InputError(f"{source}: {error}; {_INSTEAD}") from None
    return sensors[0]


def refuse_options(work: str, **options: object) -> None:
    """Refuse options that a kind of work does not take."""
    for name, value in options.items():
        option = f"{'-' if len(name) == 1 else '--'}{name.replace('_', '-')}"
        refuse_if(value, f"{option}: {work} does not take it; leave it out")


def require_linear(linear: bool, *paths: Path | None) -> None:
    """Refuse ``--linear`` unless an input is a picture."""
    sources = [path for path in paths if path is not None]
    refuse_if(
        linear and not any(path.suffix.lower() in RAW_SUFFIXES for path in sources),
        f"--linear: it is for pictures (.png, .tiff); {sources[0]} holds values proportional to light",
    )


def light_field(
    source: Path, options: Mapping[str, Any], camera: PlenopticCamera | None, truth: Path | bool = False
) -> xr.DataArray:
    """Return the light field that a command reads, by its options `LightField`."""
    from ..views import open_light_field

    return open_light_field(
        source,
        white=options["white"],
        views=options["view_count"],
        linear=options["linear"],
        camera=camera,
        truth=truth,
    )


def require_png(dpi: int | None, *paths: Path | None) -> None:
    """Refuse ``--dpi`` of files that are not PNG, and without any file."""
    for name in [str(path) for path in paths if path is not None] or ["none"]:
        refuse_if(
            dpi is not None and not name.lower().endswith(".png"),
            f"--dpi {dpi}: it is for figures in .png; the output is {name}",
        )


def drawing_of(options: Mapping[str, Any], *paths: Path | None) -> images.Drawing:
    """Return the settings for drawn pictures, the options `Picture`; refuse them where the output is not a picture."""
    from ..report import images

    outputs = [path for path in paths if path is not None]
    for name in ("exposure", "percentile"):
        refuse_if(
            options[name] is not None and not any(path.suffix.lower() in images.SHOWN for path in outputs),
            f"--{name}: it is for pictures ({', '.join(images.SHOWN)}); {outputs[0]} keeps the values as they are",
        )
    suffix = outputs[0].suffix.lower()
    dpi = options.get("dpi")
    require_png(dpi, outputs[0])
    figure = options["figure"] or dpi is not None
    scale = options["scale"]
    refuse_if(
        figure and suffix not in (".png", ".pdf"), f"--figure: it is for .png and .pdf; the output is {outputs[0]}"
    )
    if scale is not None:
        refuse_if(
            figure or suffix not in (".png", *ANIMATED),
            f"--scale {scale}: it is for plain pictures (.png, {', '.join(ANIMATED)}), without --figure and --dpi; the "
            f"output is {outputs[0]}",
        )
        require_count("scale", scale, maximum=64)
    return images.Drawing(images.Brightness(options["exposure"], options["percentile"]), scale, figure, dpi)


def named_camera(source: str | None) -> PlenopticCamera | None:
    """Return the camera that an option names, or None without the option."""
    return None if source is None else load_camera(source, {})[0]


def require_in_sight(source: Path, camera: PlenopticCamera | None, *distances: float) -> PlenopticCamera | None:
    """Return the given camera, or else the camera of the source; refuse distances on which it cannot focus."""
    seen_by = camera
    if camera is None and source.suffix.lower() == ".exr":
        from ..camera import PlenopticCamera
        from ..io import read_attributes

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
    from ..plugins.other_camera import with_camera
    from ..runtime import DEFAULT_VARIANT
    from ..scene import load_scene, plenoptic_sensor

    replacement = named_camera(camera)
    colours = None if variant else colours_of_film(scene, parameters)
    chosen = variant or (COLOURS if colours else DEFAULT_VARIANT)
    loaded = load_scene(scene, variant=chosen, parameters=parameters, unit=unit)
    if replacement is not None:
        require_in_use(scene, parameters)
        # It stands first. Number 0 is the first camera, before which there may be meters.
        loaded = with_camera(loaded, replacement, index or None)
        index = 0
    sensor = plenoptic_sensor(loaded, index)
    camera_of_scene = PlenopticCamera.from_sensor(sensor)
    if colours:
        _log.info("variant %s, as the film records %s; --variant chooses another", COLOURS, colours)
    for text in design_warnings(camera_of_scene):
        warn(text)
    return loaded


def require_in_use(scene: str, parameters: dict[str, str], option: str = "-D") -> None:
    """Refuse parameters of the scene's camera where another camera takes its place.

    The position of the camera and its sampler remain those of the scene. Names that the scene does not have are left
    to its loading.
    """
    from ..scene import names_in

    roots = scene_roots(scene, parameters)
    used_names = set()
    known_names = {name for root in roots for element_of_root in root.iter() for name in names_in(element_of_root)}

    def visit(element: Element, of_camera: bool) -> None:
        # The sampler, the position and the medium remain where another camera takes the sensor's place.
        replaced = element.tag == "sensor" or (of_camera and element.tag not in ("sampler", "transform", "medium"))
        if not replaced and element.tag != "default":
            used_names.update(names_in(element))
        for child in element:
            visit(child, replaced)

    for root in roots:
        visit(root, False)
    # Parameters are used, too, to which the defaults of used ones refer.
    defaults = {
        element_of_root.get("name"): names_in(element_of_root)
        for root in roots
        for element_of_root in root.iter("default")
    }
    while more := {referred for name in used_names for referred in defaults.get(name, ())} - used_names:
        used_names |= more
    for name in parameters:
        if name in known_names - used_names:
            raise InputError(
                f"{option} {name}: it is of the scene's own camera, which another one replaces; leave it out"
            )


def scene_roots(scene: str, parameters: dict[str, str]) -> list[Element]:
    """Return the root elements of a scene file and of all that it includes."""
    from ..scene import check_scene_file

    return check_scene_file(Path(scene) if Path(scene).is_file() else scene_path(scene), parameters)


def colours_of_film(scene: str, parameters: dict[str, str]) -> str | None:
    """Return the colour channels that a scene's film records, None if it records none.

    Films of Mitsuba record rgb by default, as does a sensor without a film.
    """
    from xml.etree.ElementTree import Element

    from ..scene import scene_defaults

    roots = scene_roots(scene, parameters)
    formats = []
    for film in [node for root in roots for node in root.iter("film")] or [Element("film", type="hdrfilm")]:
        named = [node.get("value", "") for node in film.iter("string") if node.get("name") == "pixel_format"]
        formats += named or (["rgb"] if film.get("type") == "hdrfilm" else [])
    values = scene_defaults(roots) | parameters
    for name in formats:
        colours = values.get(name.removeprefix("$"), name).lower()
        if colours in ("rgb", "rgba", "xyz", "xyza"):
            return colours
    return None


def parse_definitions(definitions: list[str] | None) -> dict[str, str]:
    """Return ``name=value`` texts as a dictionary."""
    return {name: value for name, _, value in (text.partition("=") for text in definitions or [])}


def batches_on(workers: int | None, scheduler: str | None) -> contextlib.AbstractContextManager[BatchMap | None]:
    """Return the Dask cluster of the requested workers; without workers a context that yields None."""
    from ..runtime import Cluster

    asks_cluster = workers is not None or scheduler is not None
    return Cluster(workers=workers, scheduler=scheduler) if asks_cluster else contextlib.nullcontext()


def camera_instead(source: str | None, scene: str, parameters: dict[str, str]) -> dict[str, Any] | None:
    """Return the parameters of the camera that replaces a scene's, None where none is named."""
    camera = named_camera(source)
    if camera is None:
        return None
    require_in_use(scene, parameters)
    return camera.to_dict()
