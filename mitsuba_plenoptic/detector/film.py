"""The film of a sensor whose pixels do not record the light as it falls on them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .operator import DetectorOperator


def behind_detector(film: Any) -> Any:
    """Return a film around another one that develops what the detector of its sensor records of the light on it.

    Any integrator records the light on the inner film. The detector acts on its colours, not on alpha and extra
    channels such as depth.
    """

    class DetectorFilm(mi.Film):
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.m_flags, self._extra = film.flags(), 0

        def stand_before(self, detector: DetectorOperator, width: Any) -> None:
            """Record by a detector of a width, with whose gradient the detector's lengths in pixels change.

            Its map of stray light becomes a tensor: `dr.freeze` knows no others.
            """
            if isinstance(detector.stray_light, np.ndarray):
                detector = replace(detector, stray_light=mi.TensorXf(detector.stray_light[..., None]))
            self.detector = detector
            self._width = width

        def prepare(self, aovs: list[str]) -> int:
            self._extra = len(aovs)
            return int(film.prepare(aovs))

        def develop(self, raw: bool = False) -> Any:
            image = film.develop(raw)
            if raw:
                return image
            colours = image.shape[2] - self._extra - int(mi.has_flag(film.flags(), mi.FilmFlags.Alpha))
            light = image[:, :, :colours]
            recorded = self.detector.forward(light)
            if dr.grad_enabled(self._width):
                growth = dr.log(self._width / dr.detach(self._width))
                recorded += growth * self.detector.slope(dr.detach(light))
            return recorded if colours == image.shape[2] else dr.concat([recorded, image[:, :, colours:]], axis=2)

        def bitmap(self, raw: bool = False) -> Any:
            plain = film.bitmap(raw)
            names = [field.name for field in plain.struct_()]
            return plain if raw else mi.Bitmap(self.develop(), plain.pixel_format(), names)

        def write(self, path: Any) -> None:
            self.bitmap().write(path)

        def create_block(self, size: Any = (0, 0), normalize: bool = False, borders: bool = False) -> Any:
            return film.create_block(size, normalize, borders)

        def put_block(self, block: Any) -> None:
            film.put_block(block)

        def clear(self) -> None:
            film.clear()

        def base_channels_count(self) -> int:
            return int(film.base_channels_count())

        def schedule_storage(self) -> None:
            film.schedule_storage()

        def sensor_response_function(self) -> Any:
            return film.sensor_response_function()

        def prepare_sample(self, *given: Any, **options: Any) -> Any:
            return film.prepare_sample(*given, **options)

        def parameters_changed(self, keys: list[str] | None = None) -> None:
            super().parameters_changed(keys or [])
            inner = mi.traverse(film)
            for name in ("size", "crop_size", "crop_offset"):
                inner[name] = getattr(self, name)()
            inner.update()

        def class_name(self) -> str:
            return str(film.class_name())

        def to_string(self) -> str:
            return str(film)

    size = film.size()
    crop = film.crop_size()
    offset = film.crop_offset()
    props = mi.Properties("detector_film")
    for axis, side in enumerate(("width", "height")):
        props[side], props[f"crop_{side}"] = int(size[axis]), int(crop[axis])
        props[f"crop_offset_{'xy'[axis]}"] = int(offset[axis])
    props["rfilter"] = film.rfilter()
    return DetectorFilm(props)
