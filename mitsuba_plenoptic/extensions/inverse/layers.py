r"""Scenes of textured planes one behind the other, seen by any sensor and differentiable with respect to their texels.

The radiance along a ray is composited from the front to the back,

.. math:: L = \sum_k c_k \, \alpha_k \prod_{j < k} (1 - \alpha_j) ,

with the radiance c and the opacity :math:`\alpha` of the planes where the ray meets them (Porter and Duff 1984,
"Compositing digital images"; for scenes seen from several positions Zhou et al. 2018, "Stereo magnification: learning
view synthesis using multiplane images").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, refuse_if, require_number
from ...runtime import IMAGE, as_array, drjit_array


@dataclass(frozen=True, eq=False)
class Layers:
    """Square textured planes perpendicular to the world's z axis, with their centres on it.

    Between texels, radiance and opacity are interpolated linearly. Beyond its border a plane is transparent, and behind
    all planes it is dark.

    Parameters
    ----------
    depths : sequence of float
        The z of each plane, increasing. The planes are visible to sensors that look along +z, as unrotated sensors do.
    widths : sequence of float
        Width of each plane, in scene units.
    radiance : array (planes, rows, columns) or (planes, rows, columns, channels)
        Radiance of the texels, not negative. Rows begin at the largest y and columns at the largest x, as such a
        sensor sees them.
    opacity : array (planes, rows, columns)
        Opacity of the texels, from 0 to 1.

    Raises
    ------
    InputError
        If an input has a wrong shape or value.
    """

    depths: Sequence[float]
    widths: Sequence[float]
    radiance: NDArray[np.float32]
    opacity: NDArray[np.float32]

    def __post_init__(self) -> None:
        count = len(self.depths)
        refuse_if(not count or len(self.widths) != count, "depths and widths: give one of each for every plane")
        for depth, width in zip(self.depths, self.widths, strict=True):
            require_number("depth", depth)
            require_number("width", width, positive=True)
        refuse_if(sorted(set(self.depths)) != list(self.depths), f"depths = {list(self.depths)}: they must increase")
        radiance, opacity = (
            as_array(name, getattr(self, name), np.float32, ("z", *IMAGE)) for name in ("radiance", "opacity")
        )
        if opacity.ndim != 3 or len(opacity) != count or radiance.ndim > 4 or radiance.shape[:3] != opacity.shape:
            raise InputError(
                f"radiance of shape {radiance.shape} and opacity of shape {opacity.shape}: they must "
                f"have {count} planes of the same texels"
            )
        refuse_if(not (np.isfinite(radiance) & (radiance >= 0)).all(), "radiance: it must be finite and not negative")
        refuse_if(not ((opacity >= 0) & (opacity <= 1)).all(), "opacity: it must be from 0 to 1")
        channels = radiance if radiance.ndim == 4 else radiance[..., None]
        object.__setattr__(self, "radiance", channels)
        object.__setattr__(self, "opacity", opacity)

    @property
    def texels(self) -> NDArray[np.float32]:
        """Radiance by channel, then opacity, of all texels: (planes, rows, columns, channels + 1)."""
        return np.concatenate([self.radiance, self.opacity[..., None]], axis=-1)

    def integrator(self) -> Any:
        """Return a Mitsuba integrator that sees the planes and no other object of a scene."""
        refuse_if(
            mi.variant() is None or mi.is_spectral or mi.is_polarized or "ad" not in mi.variant().split("_"),
            f"variant {mi.variant()}: layers need a variant of one or three channels with derivatives, as llvm_ad_mono",
        )
        count, channels = len(mi.Spectrum(0)), self.radiance.shape[-1]
        refuse_if(channels != count, f"radiance of {channels} channels: variant {mi.variant()} has {count}")
        return make_class()(self)

    def scene(self, sensor: Any) -> Any:
        """Return a scene without objects, with a sensor and the integrator that sees the planes."""
        # Derivatives by signed rays are taken along the rays that meet a surface or an environment.
        dark = {"type": "constant", "radiance": 0.0}
        return mi.load_dict(
            {"type": "scene", "dark": dark, "integrator": self.integrator(), "sensor": sensor}, parallel=False
        )


def make_class() -> type:
    """Define the integrator's class for the active variant, to which its types are bound."""

    class LayersIntegrator(mi.ad.integrators.common.RBIntegrator):
        """Integrator that returns the radiance of layers along rays."""

        def __init__(self, layers: Layers) -> None:
            super().__init__(mi.Properties())
            self._planes = list(zip(layers.depths, layers.widths, strict=True))
            texels = [drjit_array(mi.TensorXf, each) for each in layers.texels]
            self._textures = [mi.Texture2f(each, wrap_mode=dr.WrapMode.Clamp) for each in texels]

        def set_texels(self, values: list[Any]) -> None:
            """Replace the texels of all planes by tensors shaped like `Layers.texels`, which may carry gradients."""
            for texture, value in zip(self._textures, values, strict=True):
                texture.set_tensor(value)

        def sample(
            self, mode: Any, scene: Any, sampler: Any, ray: Any, δL: Any = None, active: Any = True, **_: Any
        ) -> Any:
            """Return the radiance along rays, or propagate its derivative; see Mitsuba's `RBIntegrator`."""
            primal = mode == dr.ADMode.Primal
            with dr.resume_grad(when=not primal):
                light = self._radiance(ray, active)
                if mode == dr.ADMode.Backward:
                    dr.backward_from(δL * light)
                    light = dr.detach(light)
                elif mode == dr.ADMode.Forward:
                    light = dr.forward_to(light)
            return light, mi.Bool(active), [], light

        def _radiance(self, ray: Any, active: Any) -> Any:
            light, passing = mi.Spectrum(0), mi.Float(1)
            for (depth, width), texture in zip(self._planes, self._textures, strict=True):
                t = (depth - ray.o.z) / ray.d.z
                x, y = (0.5 - (ray.o[k] + t * ray.d[k]) / width for k in (0, 1))
                meets = active & (ray.d.z > 0) & (t > 0) & (x >= 0) & (x <= 1) & (y >= 0) & (y <= 1)
                *colour, opacity = texture.eval(mi.Point2f(x, y), meets)
                part = dr.select(meets, passing * opacity, 0)
                light += mi.Spectrum(*colour) * part
                passing = passing - part
            return light

    return LayersIntegrator
