"""Ground truth: the surfaces that rays of a capture and of its views meet, in a file next to the capture."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..camera import PlenopticCamera
from ..choices import QUANTITIES
from ..errors import InputError, naming, refuse_if, require_choice, short_repr
from ..runtime import Array, as_array
from .exr import read_exr_parts, write_exr_parts

TRUTH_SUFFIX = ".truth.exr"
"""Suffix that replaces a capture's ``.exr``."""

TRUTH_NAME = "ground_truth"
"""Key of the file in the metadata of its capture."""

TRUTH_COORDINATES = {
    f"{name}.{letter}": name if len(letters) == 1 else f"{name}_{letter.lower()}"
    for name, letters in QUANTITIES.items()
    for letter in letters
}
"""Names of the channels in light fields."""

_PIXELS = "capture"
_VIEWS = "views"


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """The surfaces that the camera's rays meet first, named as by Mitsuba's integrator ``aov``.

    ``depth`` is the distance from the main lens along the camera's axis, in scene units, taken as millimetres; it is
    infinite where a ray meets nothing. ``virtual_depth`` is the same except in plane mirrors, where it is the distance
    of the mirror image, as views show it. ``position`` and ``normal`` (of shading) are in the world's frame, ``albedo``
    is the diffuse reflectance; these are NaN where nothing is met. ``shape_index`` is an integer, 0 where nothing is
    met. Where the main lens lets no such ray through, all but the index are NaN. All values belong to single rays and
    are not averaged.

    Attributes
    ----------
    pixels : dict
        Arrays (rows, columns[, 3]) by quantity, float32: of the ray from the middle of each pixel through the centre
        of its lens, or of the pupil without microlenses.
    views : dict
        Arrays (v, u, t, s[, 3]) by quantity: of the rays that the samples of the decoded light field stand for, from
        their point on the pupil, as by a ``perspective`` camera there. Empty without a microlens array.
    shapes : tuple of str
        Names of the scene's shapes, the first that of index 1.
    to_world : (4, 4) float64 array
        The camera's transform.
    """

    camera: PlenopticCamera
    pixels: dict[str, Array]
    views: dict[str, Array]
    shapes: tuple[str, ...]
    to_world: Array


def require_quantities(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of quantities without repetitions; refuse unknown names."""
    quantities = tuple(dict.fromkeys(names))
    for name in quantities:
        require_choice("aov", name, QUANTITIES)
    refuse_if(not quantities, f"aov: name at least one of {', '.join(QUANTITIES)}")
    return quantities


def channel_planes(values: Mapping[str, Array]) -> dict[str, Array]:
    """Return the arrays of quantities by channel, such as ``normal.X``, without the axis of three components."""
    return {
        f"{name}.{letter}": array[..., index] if len(letters) > 1 else array
        for name, array in values.items()
        for letters in (QUANTITIES[name],)
        for index, letter in enumerate(letters)
    }


def truth_path(capture: Path) -> Path:
    """Return the path of a capture's ground truth."""
    return capture.with_name(capture.name.removesuffix(capture.suffix) + TRUTH_SUFFIX)


def write_ground_truth(path: str | Path, truth: GroundTruth) -> None:
    """Write ground truth as OpenEXR: the part ``capture``, pixel for pixel, and the part ``views``, side by side.

    The channels are depth.Z, virtual_depth.Z, position.X, .Y and .Z, normal.X, .Y and .Z, albedo.R, .G and .B, and
    shape_index.I. The views are arranged as by `views.view_mosaic`.

    Parameters
    ----------
    truth : GroundTruth
        The ground truth to write.
    """
    parts = {_PIXELS: channel_planes(truth.pixels)}
    attributes = {
        "kind": "ground truth",
        "camera": truth.camera.to_dict(),
        "shapes": truth.shapes,
        "to_world": truth.to_world.tolist(),
    }
    if truth.views:
        v, u, t, s = attributes["views"] = next(iter(truth.views.values())).shape[:4]
        views = channel_planes(truth.views)
        parts[_VIEWS] = {name: plane.swapaxes(1, 2).reshape(v * t, u * s) for name, plane in views.items()}
    write_exr_parts(path, parts, attributes)


def read_ground_truth(path: str | Path) -> GroundTruth:
    """Return the ground truth in a file of `write_ground_truth`."""
    parts, attributes = read_exr_parts(path)
    with naming(path):
        refuse_if(
            attributes.get("kind") != "ground truth",
            f"it holds a {short_repr(attributes.get('kind'))}, not ground truth",
        )
        camera = PlenopticCamera.from_dict(attributes.get("camera", {}))
        sizes = attributes.get("views")
        shapes_of = {_PIXELS: camera.shape}
        if sizes is not None:
            if not isinstance(sizes, list) or len(sizes) != 4 or not all(isinstance(n, int) and n > 0 for n in sizes):
                raise InputError(f"views = {short_repr(sizes)}: they must be four numbers")
            v, u, t, s = sizes
            shapes_of[_VIEWS] = (v * t, u * s)
        refuse_if(
            set(parts) != set(shapes_of),
            f"its parts are {short_repr(sorted(parts))}: they must be {' and '.join(shapes_of)}",
        )
        for part_name, shape in shapes_of.items():
            for plane in parts[part_name].values():
                refuse_if(plane.shape != shape, f"its part {part_name} has the shape {plane.shape}: it must be {shape}")
        to_world = as_array("to_world", attributes.get("to_world"), shape=(4, 4))
        shapes = attributes.get("shapes")
        if not isinstance(shapes, list) or not all(isinstance(shape, str) for shape in shapes):
            raise InputError(f"shapes = {short_repr(shapes)}: they must be names")
        pixels, views = (
            _quantities(parts[part_name], len(shapes)) if part_name in parts else {} for part_name in (_PIXELS, _VIEWS)
        )
        if views:
            views = {name: array.reshape(v, t, u, s, *array.shape[2:]).swapaxes(1, 2) for name, array in views.items()}
        return GroundTruth(camera, pixels, views, tuple(shapes), to_world)


def _quantities(planes: Mapping[str, Array], shapes: int) -> dict[str, Array]:
    """Return quantities from channels, the inverse of `channel_planes`, for a scene of `shapes` shapes."""
    names = [name for name in QUANTITIES if any(key.startswith(f"{name}.") for key in planes)]
    keys = {name: [f"{name}.{letter}" for letter in QUANTITIES[name]] for name in names}
    refuse_if(
        not names or set().union(*keys.values()) != set(planes),
        f"its channels are {short_repr(sorted(planes))}: they must be whole quantities",
    )
    arrays = {
        name: np.stack([planes[key] for key in of_name], axis=-1) if len(of_name) > 1 else planes[of_name[0]]
        for name, of_name in keys.items()
    }
    index = arrays.get("shape_index")
    refuse_if(
        index is not None and not np.isin(index, np.arange(shapes + 1)).all(),
        f"its shape_index is not always a whole number from 0 to {shapes}",
    )
    return arrays
