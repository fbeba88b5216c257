"""Ground truth of captures and of the light fields that are decoded from them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..capture.first_hit import FirstHits
from ..capture.render import plenoptic_sensor
from ..errors import suggest_keywords
from ..io.ground_truth import QUANTITIES, GroundTruth, require_quantities
from ..runtime.backend import one_at_a_time
from ..runtime.limits import require_memory
from .decode import view_window
from .geometry import lens_places, pupil_places
from .grid import bin_grid, lens_grid


@suggest_keywords
@one_at_a_time
def ground_truth(scene: Any, names: Iterable[str] = tuple(QUANTITIES), *, sensor: int | Any = 0) -> GroundTruth:
    """Find what a plenoptic camera of the scene looks at: for each pixel, and for each sample of the light field.

    A pixel sees a part of the scene, through all of its lens and so through a part of the pupil. Its ground truth is
    that of one ray, from its middle through the centre of its lens. A sample of the light field that `decode` makes
    stands for a point of the pupil and a bin; its ground truth is that of the ray through these, whichever pixels it
    is interpolated from. Rays end at the first surface, as in Mitsuba's integrator ``aov``: at mirrors and glass, and
    at masks and cut-outs, too.

    Parameters
    ----------
    scene : mitsuba.Scene
        A scene with a sensor of type ``plenoptic``.
    names : sequence of str
        What to find: ``depth``, ``position``, ``normal``, ``albedo``, ``shape_index``; see `GroundTruth`.
    sensor : int or mitsuba.Sensor
        As for `render_capture`.

    Returns
    -------
    GroundTruth

    Raises
    ------
    InputError
        If there is no such sensor, a name is unknown, its lenses are narrower than a pixel, or it would take more
        memory than is allowed.
    """
    names = require_quantities([names] if isinstance(names, str) else names)
    chosen = plenoptic_sensor(scene, sensor)
    camera = PlenopticCamera.from_sensor(chosen)
    bins = bin_grid(camera)
    half, _ = view_window(camera, lens_grid(camera))
    sizes = (2 * half + 1, 2 * half + 1, *bins.shape)
    rows, columns = camera.shape
    numbers = sum(len(QUANTITIES[name]) for name in names)
    require_memory(
        8.0 * numbers * (rows * columns + math.prod(sizes)),
        f"ground truth of {columns} x {rows} pixels and {sizes[1]} x {sizes[0]} views",
    )
    hits = FirstHits(scene, chosen, names)

    def of_pixels(number: Any) -> tuple[Any, Any]:
        row = number // columns
        place = mi.Point2f((number - row * columns + 0.5) / columns, (row + 0.5) / rows)
        return chosen.chief_ray(place)

    pupil = mi.Float(pupil_places(camera, sizes[0]))
    across, down = (mi.Float(lens_places(camera, bins, axis)) for axis in (0, 1))

    def of_views(number: Any) -> tuple[Any, Any]:
        places = []
        for size, coordinates in zip(sizes[::-1], (across, down, pupil, pupil), strict=True):
            rest = number // size
            places.append(dr.gather(mi.Float, coordinates, number - rest * size))
            number = rest
        s, t, u, v = places
        return chosen.pupil_ray((u, v), (s, t))

    pixels, views = hits.along(of_pixels, rows * columns), hits.along(of_views, math.prod(sizes))
    return GroundTruth(
        camera,
        {name: values.reshape(rows, columns, *values.shape[1:]) for name, values in pixels.items()},
        {name: values.reshape(*sizes, *values.shape[1:]) for name, values in views.items()},
        tuple(shape.id() for shape in scene.shapes()),
        np.array(chosen.world_transform().matrix, np.float64).reshape(4, 4),
    )
