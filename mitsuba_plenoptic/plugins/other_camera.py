"""Replacement of a scene's sensor by a plenoptic camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera, require_camera
from ..errors import refuse_if, suggest_keywords, warn
from ..runtime import one_at_a_time
from ..scene import as_scene, loading, numbered_sensor, require_active, warn_of_metres, with_objects


@suggest_keywords
@one_at_a_time
def with_camera(
    scene: mi.Scene | str | Path | Mapping[str, Any], camera: PlenopticCamera | str, sensor: int | None = None
) -> mi.Scene:
    """Return a scene of the same objects with a plenoptic camera in the place of a sensor.

    Parameters
    ----------
    scene : mitsuba.Scene, str, path or dict
        A scene, or what `load_scene` makes one of. If it has no sensor of its own, only meters on shapes, the camera is
        at the origin and looks along +z.
    camera : PlenopticCamera or str
        The camera, with lengths in the scene's units, or the name of a preset. Its film has three channels, red, green
        and blue, in rgb variants, and in spectral ones unless the film before it has one; in mono variants it records
        luminance.
    sensor : int, optional
        Index of the sensor that it replaces, counted from 0 as in ``scene.sensors()``. Default: the first that is a
        camera, if there is one.

    Returns
    -------
    mitsuba.Scene
        The new scene, which shares its objects with the given one; all have the same ids. The camera is its first
        sensor, with the id of the one it replaces; meters on shapes follow, and other sensors are left out. It has the
        sampler of a plenoptic camera before it, and the count of samples of any other. Shapes may be
        moved through either scene, and captures and ``mi.render`` of both show them there; functions of ``dr.freeze``
        only after one that is not frozen.

    Warns
    -----
    UserWarning
        If the film before it records bands of wavelengths, which the camera's does not.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> scene = mp.load_scene("letters", variant="llvm_ad_mono", parameters={"resolution": 128})
    >>> camera = mp.PlenopticCamera(focus_distance=210, detector_width=0.256, resolution=(128, 128))
    >>> mp.render_capture(mp.with_camera(scene, camera), spp=4).camera == camera
    True
    """
    scene = as_scene(scene)
    require_active("scene", scene, mi.Scene)
    camera = PlenopticCamera.preset(camera) if isinstance(camera, str) else require_camera(camera)
    perspective = [each for each in scene.sensors() if each.get_shape() is None]
    if sensor is None:
        # Other sensors are meters: they measure along a line, say, whatever place a camera of the scene has.
        cameras = [
            each for each in perspective if isinstance(each, mi.ProjectiveCamera) or hasattr(type(each), "camera")
        ]
        old = next(iter([*cameras, *perspective]), None)
    else:
        old = numbered_sensor(scene, sensor)
    described = camera.to_sensor()
    if mi.is_spectral and old is not None and "pixel_format = y" in str(old.film()):
        described["film"]["pixel_format"] = "luminance"
    if old is not None:
        refuse_if(
            # First parts of the class names of sensors that are at several places, or at infinity.
            old.get_shape() is not None or old.class_name().startswith(("Batch", "Distant")),
            f"sensor {old.class_name()} {old.id()!r}: it has no one place and direction for another camera to take",
        )
        described["to_world"] = mi.ScalarTransform4f(np.array(old.world_transform().matrix, np.float64).reshape(4, 4))
        is_plenoptic = hasattr(type(old), "camera")
        independent = {"type": "independent", "sample_count": old.sampler().sample_count()}
        described["sampler"] = old.sampler() if is_plenoptic else independent
        if old.get_medium() is not None:
            described["medium"] = old.get_medium()
        if old.film().class_name() == "SpecFilm":
            warn("film of type specfilm: the camera in its place records rgb; its bands are responses of wave captures")
    with loading():
        plenoptic = mi.load_dict(described, parallel=False)
        plenoptic.set_id((old.id() if old is not None else "") or "camera")
        changed = with_objects(scene, [plenoptic], perspective)
    for each in (plenoptic, *scene.sensors()):
        if hasattr(type(each), "camera"):
            each.shares_shapes = True
    warn_of_metres(changed, plenoptic)
    return changed
