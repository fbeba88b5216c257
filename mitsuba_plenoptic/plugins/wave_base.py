"""The base of the integrators of wave captures: wavelengths, films, and what all of them refuse."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import InputError, refuse_if, refusing, require_wavelength, short_repr
from ..optics import RGB_WAVELENGTHS
from ..runtime import Floats, Numbers, Pair, drjit_array, require_unfrozen
from ..scene import meet_moved, require_seen
from .properties import require_read


def put(film: Any, image: Floats, channels: int) -> None:
    """Fill a film with an image (rows, columns, channels), whose channels after the first `channels` are noise."""
    extra = image.shape[2] - channels
    # Red, green, blue, a weight of 1, and the noise.
    block = np.ones((*image.shape[:2], 4 + extra), np.float32)
    block[..., :3] = image[..., :channels]
    block[..., 4:] = image[..., channels:]
    film.prepare([f"noise.{channel}" for channel in range(extra)])
    film.put_block(mi.ImageBlock(drjit_array(mi.TensorXf, block), film.crop_offset()))


def developed(film: Any, image: Floats) -> Pair:
    """Return an image (rows, columns, channels) as a tensor with a gradient, and what a film develops of it."""
    light = drjit_array(mi.TensorXf, image)
    dr.enable_grad(light)
    colours = [light] * (3 // image.shape[2])
    film.prepare([])
    block = dr.concat([*colours, dr.ones(mi.TensorXf, (*image.shape[:2], 1))], axis=2)
    film.put_block(mi.ImageBlock(block, film.crop_offset()))
    return light, film.develop()


NAME = "plenoptic_wave"

DEFAULT_WAVELENGTH = 633.0


def read_wavelengths(props: Any) -> Numbers:
    """Read one wavelength, or one for each channel, for the active variant."""
    value = props.get("wavelength", None)
    if value is None:
        return RGB_WAVELENGTHS if mi.is_rgb else (DEFAULT_WAVELENGTH,)
    numbers = value.split(",") if isinstance(value, str) else list(value) if hasattr(value, "__len__") else [value]
    with refusing(
        f"{NAME}: wavelength = {short_repr(value)}: it must be nanometres, or three of them separated by commas",
        ValueError,
    ):
        numbers = [float(number) if isinstance(number, str) else number for number in numbers]
    wavelengths = tuple(require_wavelength(number, f"{NAME}: wavelength") for number in numbers)
    if len(wavelengths) == 1 and mi.is_rgb:
        wavelengths *= 3
    channels = 3 if mi.is_rgb else 1
    if len(wavelengths) != channels:
        there = f"variant {mi.variant()} has {channels} channel{'s' * (channels > 1)}"
        raise InputError(f"{NAME}: wavelength = {short_repr(value)}: {there}")
    return wavelengths


def asked_for(scene: Any, sensor: Any, seed: Any, spp: int) -> tuple[Any, int, int]:
    """Return the sensor, seed and sample count of a call of `mi.render`, which gives indices, arrays or zeros."""
    require_unfrozen("captures by waves")
    sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
    meet_moved(scene, sensor)
    return sensor, int(seed[0]) if hasattr(seed, "__len__") else int(seed), spp or sensor.sampler().sample_count()


def make_base() -> type:
    """Define the base class of integrators with `record` and `parameters` for the active Mitsuba variant."""

    class RecordingIntegrator(mi.SamplingIntegrator):
        plugin: str

        def read_child(self, props: Any) -> None:
            """Keep the nested integrator, by default ``path``, and refuse parameters that nothing has read."""
            nested = [value for _, value in props.objects()]
            refuse_if(len(nested) > 1, f"{self.plugin}: {len(nested)} nested plugins: it takes one integrator")
            self.child = nested[0] if nested else mi.load_dict({"type": "path"})
            require_read(props, self.plugin)
            kind = self.child.class_name() if hasattr(self.child, "class_name") else type(self.child).__name__
            if not isinstance(self.child, mi.SamplingIntegrator) or self.child.aov_names():
                reason = "it cannot tell the radiance along a ray, or also tells what a capture would lose"
                raise InputError(f"{self.plugin}: nested {kind}: {reason}; use path or direct")

        def render(
            self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True, evaluate: bool = True
        ) -> Any:
            """Render the capture; `spp` is the count of samples that `record` takes."""
            sensor, seed, spp = asked_for(scene, sensor, seed, spp)
            require_seen(self, sensor)
            film = self.record(scene, sensor, seed=seed, spp=spp)
            return film.develop() if develop else None

        def aov_names(self) -> list[str]:
            """Refuse integrators around this one, which ask for its outputs."""
            raise InputError(f"{self.plugin}: it is no nested integrator: it makes the whole image of a sensor")

        def to_string(self) -> str:
            """Return the description of the integrator that Mitsuba prints."""
            lines = [f"  {name} = {value}," for name, value in self.parameters().items()]
            return "\n".join([f"{type(self).__name__}[", *lines, f"  child = {self.child}", "]"])

    return RecordingIntegrator
