"""Replacement of a scene's sensor by a plenoptic camera."""

from __future__ import annotations

import re
from typing import Any

import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera, require_camera
from ..errors import InputError
from ..light.scene import loading
from ..light.scene_light import warn_of_metres
from ..runtime.backend import one_at_a_time


@one_at_a_time
def with_camera(scene: Any, camera: PlenopticCamera) -> Any:
    """Return a scene of the same objects with a plenoptic camera at the position of the first sensor.

    Parameters
    ----------
    scene : mitsuba.Scene
        A scene. If it has no sensor, the camera is at the origin and looks along +z.
    camera : PlenopticCamera
        The camera, with lengths in the scene's units. Its film has three channels in rgb variants, and records
        luminance in others.

    Returns
    -------
    mitsuba.Scene
        The new scene, which shares its objects with the given one.

    Raises
    ------
    InputError
        If an argument is not a scene or a camera, the first sensor's transform scales, or Mitsuba cannot render the
        camera.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> scene = mp.load_scene("letters", variant="llvm_ad_mono", parameters={"resolution": 64})
    >>> camera = mp.PlenopticCamera(focus_distance=210, detector_width=0.256, resolution=(128, 128))
    >>> mp.render_capture(mp.with_camera(scene, camera), spp=4).camera == camera
    True
    """
    if not isinstance(scene, mi.Scene):
        raise InputError(f"scene of type {type(scene).__name__}: it must be a mitsuba.Scene of the active variant")
    require_camera(camera)
    # Area emitters are part of their shapes.
    lamps = [lamp for lamp in scene.emitters() if not mi.has_flag(lamp.flags(), mi.EmitterFlags.Surface)]
    objects: dict[str, Any] = {}
    for index, item in enumerate((*scene.shapes(), *lamps)):
        # Objects without a name in the file have none here, or one that Mitsuba generated and would refuse.
        named = re.fullmatch(r"[A-Za-z]\w*", item.id()) and item.id() not in objects
        objects[item.id() if named else f"object_{index}"] = item
    sensor = camera.to_sensor()
    if mi.is_rgb:
        sensor["film"]["pixel_format"] = "rgb"
    for old in scene.sensors()[:1]:
        sensor["to_world"] = mi.ScalarTransform4f(np.array(old.world_transform().matrix, np.float64).reshape(4, 4))
        sensor["sampler"] = {"type": "independent", "sample_count": old.sampler().sample_count()}
        if old.get_medium() is not None:
            sensor["medium"] = old.get_medium()
    if scene.integrator() is not None:
        objects["integrator"] = scene.integrator()
    with loading():
        made = mi.load_dict({"type": "scene", **objects, "camera": sensor}, optimize=False)
    made.set_id(scene.id())
    warn_of_metres(made, made.sensors()[0])
    return made
