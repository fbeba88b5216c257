"""The integrators that record whole captures: what `plenoptic_wave` and `plenoptic_laser` have in common."""

from __future__ import annotations

from typing import Any

import mitsuba as mi

from ..errors import refuse_if
from .properties import require_read


def asked_for(scene: Any, sensor: Any, seed: Any, spp: int) -> tuple[Any, int, int]:
    """Return the sensor, the seed and the count of samples of `mi.render`, which gives indices, arrays or zeros."""
    sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
    return sensor, int(seed[0]) if hasattr(seed, "__len__") else int(seed), spp or sensor.sampler().sample_count()


def make_base() -> type:
    """Define the base of such integrators for the active Mitsuba variant; they offer `record` and `parameters`."""

    class RecordingIntegrator(mi.SamplingIntegrator):
        plugin: str

        def read_child(self, props: Any) -> None:
            """Keep the nested integrator, by default ``path``, and refuse parameters that nothing has read."""
            nested = [value for _, value in props.objects()]
            refuse_if(len(nested) > 1, f"{self.plugin}: {len(nested)} nested plugins: it takes one integrator")
            self.child = nested[0] if nested else mi.load_dict({"type": "path"})
            require_read(props, self.plugin)

        def render(
            self,
            scene: Any,
            sensor: Any = 0,
            seed: Any = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> Any:
            """Render the capture; `spp` is the count of samples that `record` takes."""
            sensor, seed, spp = asked_for(scene, sensor, seed, spp)
            film = self.record(scene, sensor, seed=seed, spp=spp)
            return film.develop() if develop else None

        def to_string(self) -> str:
            """Describe the integrator."""
            lines = [f"  {name} = {value}," for name, value in self.parameters().items()]
            return "\n".join([f"{type(self).__name__}[", *lines, f"  child = {self.child}", "]"])

    return RecordingIntegrator
