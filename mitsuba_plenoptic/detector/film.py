"""The film of a plenoptic sensor, whose pixels record light through a detector, and extra outputs of rays that pass."""

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import refuse_if
from .operator import DetectorOperator


def light_power(output: str, outputs: list[str]) -> int:
    """Return the power of light in an extra output of nested integrators: 1 in radiance, 0 in depth or an index.

    Names tell it. Integrators within ``aov`` have an alpha, which colours of surfaces have not. Within ``moment`` the
    second moment of what a child returns has the child's name, that of a point which the child finds has not.
    """
    stem, _, channel = output.replace("m2_", "").rpartition(".")
    place, dot, child = stem.rpartition(".")
    is_light = (
        channel in [*"RGB"] and (f"{stem}.A" in outputs or (stem in ("S0", "S1", "S2", "S3") and "S3.B" in outputs))
    ) or (channel in [*"XYZ"] and f"{place}{dot}m2_{child}.{channel}" in outputs)
    return int(is_light) * 2 ** output.count("m2_")


def behind_detector(film: Any) -> Any:
    """Return a film around another one that develops what the detector of its sensor records of the light on it.

    Any integrator records the light on the inner film. The detector acts on radiance, not on alpha and on outputs such
    as depth. These are means over rays that pass, which the sensor draws again in the place of others.
    """
    return _film_class(mi.variant())(film)


def _of_inner_film(name: str) -> Callable:
    """Return a method that calls that of the inner film."""
    return lambda film, *arguments: getattr(film.inner, name)(*arguments)


def _fit(film: Any, other: Any) -> None:
    """Give a film the size and crop window of another one."""
    parameters = mi.traverse(film)
    window = {name: getattr(other, name)() for name in ("size", "crop_size", "crop_offset")}
    if any(list(parameters[name]) != list(value) for name, value in window.items()):
        parameters.update(window)


@functools.cache
def _film_class(variant: str) -> type:
    """Return the class of films for the active variant; one class for each film would be garbage in a cycle."""

    class DetectorFilm(mi.Film):
        redraws = False
        """Whether an integrator is about to render means over rays that pass."""

        def __init__(self, film: Any):
            props = mi.Properties("detector_film")
            props["rfilter"] = film.rfilter()
            super().__init__(props)
            self.m_flags = film.flags()
            self.inner = film
            _fit(self, film)

        def stand_before(self, detector: DetectorOperator, width: Any, is_coloured: bool) -> None:
            """Record by a detector of a width in mm light along rays, whose weights may differ by colour.

            A map of stray light becomes a tensor: `dr.freeze` knows no others.
            """
            if isinstance(detector.stray_light, np.ndarray):
                detector = replace(detector, stray_light=mi.TensorXf(detector.stray_light[..., None]))
            self.detector = detector
            self._width = width
            self._is_coloured = is_coloured

        def prepare(self, aovs: list[str]) -> int:
            alpha = ["A"] * int(mi.has_flag(self.m_flags, mi.FilmFlags.Alpha))
            self._channels = [*"RGB", *alpha, "W", *aovs]
            # Powers of light in means over rays that pass, and the means of these powers of the rays' weights.
            self._powers = [None, None, None, *(0 for _ in alpha), None, *(light_power(aov, aovs) for aov in aovs)]
            self._weights: list = []
            self.redraws = len(self._powers) > 4
            self.require_outputs(aovs)
            _fit(self.inner, self)
            return int(self.inner.prepare(aovs))

        def require_outputs(self, aovs: list[str]) -> None:
            """Refuse extra outputs that are no means over rays that pass."""
            has_moments = any(light_power(aov, aovs) == 2 for aov in aovs)
            refuse_if(
                (self._is_coloured and (has_moments or "S0.R" in aovs))
                or (has_moments and not self.detector.is_identity),
                f"plenoptic: output {(aovs or [''])[-1]}: Stokes vectors and moments need rays without dispersion, "
                "moments also pixels without detector_blur, pixel_crosstalk and stray_light",
            )

        def draw_again(self, weight: Any, samples: tuple) -> tuple[tuple, Any]:
            """Return the samples of rays drawn again in proportion to their weights, and factors of their new weights.

            Each pixel draws systematically among its rays, of which those without weight are blocked. If an output is
            an index, of which there is no mean, all rays of a pixel are one of them.
            """
            refuse_if(self._weights, "plenoptic: samples_per_pass: extra outputs need all samples in one pass")
            lanes = dr.arange(mi.UInt32, dr.width(samples[2]))
            count = len(lanes) // math.prod(self.crop_size())
            pixel = lanes // count
            first = pixel * count
            weight = weight + dr.zeros(mi.Float, len(lanes))
            highest = max(power or 1 for power in self._powers)
            means = [dr.block_sum(weight**power, count) / count for power in range(1, highest + 1)]
            passes = dr.select(means[0] > 0, mi.Float(1), 0)
            self._weights = [passes, *(mean * (dr.nan if self._is_coloured else 1) for mean in means)]
            sums = dr.block_prefix_sum(weight, count, exclusive=False)
            seed = dr.reinterpret_array(mi.UInt32, dr.gather(mi.Float, samples[2].x, first))
            position = mi.sample_tea_float32(pixel, seed)
            if not any(name.endswith(".I") for name in self._channels):
                position = (mi.Float(lanes - first) + position) / count
            position = dr.minimum(position, 1 - dr.epsilon(mi.Float)) * dr.gather(mi.Float, sums, first + (count - 1))
            ray = first + dr.binary_search(0, count - 1, lambda ray: dr.gather(mi.Float, sums, first + ray) <= position)
            weight = dr.gather(mi.Float, weight, ray)
            growth = dr.select(weight > 0, dr.gather(mi.Float, means[0], pixel) / weight, 0)
            return tuple(dr.gather(type(x), x, ray) if dr.width(x) > 1 else x for x in samples), growth

        def put_block(self, block: Any) -> None:
            self.redraws = False
            if self._weights:
                block = mi.ImageBlock(self._of_passing_rays(block.tensor()), block.offset())
            self.inner.put_block(block)

        def _of_passing_rays(self, sums: Any) -> Any:
            """Return sums over all rays of a pixel, from those in which blocked rays are replaced."""
            channels = []
            for channel, (name, power) in enumerate(zip(self._channels, self._powers, strict=True)):
                value = sums[:, :, channel : channel + 1]
                if power is not None:
                    value = value * mi.TensorXf(self._weights[power], value.shape)
                if power:
                    value = self._recorded(value)
                if name.endswith(".I"):
                    # 2**24: single precision holds no larger sum of indices.
                    value = dr.select(value < 2**24, value, dr.nan)
                channels.append(value)
            return dr.concat(channels, axis=2)

        def _recorded(self, light: Any) -> Any:
            """Return what pixels record of light; with the width's gradient, lengths change as counts of pixels."""
            recorded = self.detector.forward(light)
            if dr.grad_enabled(self._width):
                growth = dr.log(self._width / dr.detach(self._width))
                recorded += growth * self.detector.slope(dr.detach(light))
            return recorded

        def develop(self, raw: bool = False) -> Any:
            image = self.inner.develop(raw)
            if raw or self.detector.is_identity:
                return image
            # Without alpha, which counts as a colour of the film.
            colours = self.inner.base_channels_count() - ("A" in self._channels)
            recorded = self._recorded(image[:, :, :colours])
            return recorded if colours == image.shape[2] else dr.concat([recorded, image[:, :, colours:]], axis=2)

        def bitmap(self, raw: bool = False) -> Any:
            plain = self.inner.bitmap(raw)
            names = [field.name for field in plain.struct_()]
            is_plain = raw or self.detector.is_identity
            return plain if is_plain else mi.Bitmap(self.develop(), plain.pixel_format(), names)

        def write(self, path: Any) -> None:
            (self.inner if self.detector.is_identity else self.bitmap()).write(path)

        create_block = _of_inner_film("create_block")
        clear = _of_inner_film("clear")
        base_channels_count = _of_inner_film("base_channels_count")
        schedule_storage = _of_inner_film("schedule_storage")
        class_name = _of_inner_film("class_name")
        to_string = _of_inner_film("__str__")

    return DetectorFilm
