"""Captures of known light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..capture.render import chosen_integrator, plenoptic_sensor
from ..capture.scene_light import SceneLight
from ..capture.scene_points import find_points, require_matte
from ..errors import InputError, require_count, require_number
from ..io.captures import as_array, require_pixels
from ..operator.units import brightness_at
from ..plugins.other_camera import with_camera
from ..runtime.backend import one_at_a_time
from ..system.optical_system import OpticalSystem
from ..system.sampling import check_positions
from .noise import PixelNoise, check_light


@dataclass(frozen=True)
class View:
    r"""A capture, and the light that it shows.

    A pixel is expected to be :math:`B \sum_r w_r \, \mathrm{psf}_r`, with what `capture.units.brightness` returns as B:
    a capture in the unit of ``plenoptic_wave``. Behind a real main lens each point counts by the part of the pupil
    that is open to it.

    Parameters
    ----------
    image : array (rows, columns)
        The capture.
    points : array (n, 3)
        Incoherent point sources in the camera frame, in millimetres.
    weights : array (n,)
        Of each, radiance times the solid angle, seen from the main lens's image side, that it stands for.
    noise : PixelNoise, float or array (rows, columns), optional
        That of counted electrons, as `kept_noise` has it of a capture that was exposed, or the standard deviation of
        each pixel. Default: that of the photons that `fit` is given.
    pupil_weights, virtual : optional
        As of `CaptureOperator`.
    mask : bool array (rows, columns), optional
        True where a pixel does not count, as in NumPy's masked arrays.
    saturation : float, optional
        Value at which pixels are saturated. Those do not count that are there or above, nor those of which a model
        expects it within four standard deviations. What a pixel spills into its neighbours is not modelled: mask these.

    Raises
    ------
    InputError
        If an input has a wrong shape or value: weights are not negative, nor all zero.
    """

    image: NDArray[np.float32]
    points: NDArray[np.float64]
    weights: NDArray[np.float64]
    noise: Any = None
    pupil_weights: Any = None
    mask: Any = None
    saturation: float | None = None
    virtual: bool = False

    def __post_init__(self) -> None:
        image = as_array("image", self.image)
        if image.ndim != 2:
            raise InputError(f"image of shape {image.shape}: a camera is fitted to images of one channel")
        require_pixels("image", image)
        points = check_positions(self.points, virtual=self.virtual)
        weights = np.asarray(as_array("weights", self.weights), np.float64)
        if weights.shape != (len(points),) or not np.isfinite(weights).all():
            raise InputError(f"weights of shape {weights.shape}: they must be ({len(points)},) finite numbers")
        negative = np.flatnonzero(weights < 0)
        if len(negative):
            first = negative[0]
            raise InputError(
                f"weights: {len(negative)} of them are negative, the first, {weights[first]:g}, at {first}: light is "
                "at least 0"
            )
        if not weights.any():
            raise InputError("weights: all of them are 0: there is no light")
        noise = self.noise
        if noise is not None and not isinstance(noise, PixelNoise):
            noise = np.asarray(as_array("noise", noise), np.float64)
            if noise.shape not in ((), image.shape) or not (np.isfinite(noise) & (noise > 0)).all():
                raise InputError(
                    f"noise of shape {noise.shape}: it must be positive and finite, one number or one for each pixel"
                )
        mask = None if self.mask is None else np.asarray(self.mask)
        if mask is not None and (mask.dtype != bool or mask.shape != image.shape):
            raise InputError(
                f"mask of type {mask.dtype} and shape {mask.shape}: it must be of booleans, {image.shape}: True where "
                "a pixel is left out"
            )
        if self.saturation is not None:
            require_number("saturation", self.saturation, positive=True)
        given = ("image", image), ("points", points), ("weights", weights), ("noise", noise), ("mask", mask)
        for name, value in given:
            object.__setattr__(self, name, value)

    @property
    def kept(self) -> NDArray[np.bool_]:
        """Pixels that count by the mask and by what they show, (rows, columns)."""
        kept = np.ones(self.image.shape, bool) if self.mask is None else ~self.mask
        return kept if self.saturation is None else kept & (self.image < self.saturation)


def check_views(camera: PlenopticCamera, views: Sequence[View], default: PixelNoise | None = None) -> None:
    """Refuse no view at all, captures of another size than the camera's, and those that show no light.

    `default` is the noise of views that have none.
    """
    if not views:
        raise InputError("views: give at least one capture of known light")
    for view in views:
        if view.image.shape != camera.shape:
            raise InputError(f"image of shape {view.image.shape}: the camera records {camera.shape}")
        check_light(view, default)


@one_at_a_time
def known_view(
    image: Any,
    scene: Any,
    camera: PlenopticCamera,
    *,
    wavelength: float = 633.0,
    points_per_lens: int = 64,
    seed: int = 0,
    noise: Any = None,
    mask: Any = None,
    saturation: float | None = None,
) -> View:
    """Return a capture of a scene with points of its surfaces, found by rays as for method ``points`` of waves.

    Parameters
    ----------
    image : array (rows, columns)
        The capture.
    scene : mitsuba.Scene
        What it shows, matte and emitting surfaces, with the camera's place as that of the first sensor; of a variant
        of one channel.
    camera : PlenopticCamera
        A camera near enough to the true one, from which rays start.
    wavelength : float
        In nanometres.
    points_per_lens : int
        Points for each microlens.
    seed : int
        Of their pattern.
    noise, mask, saturation
        As of `View`.

    Raises
    ------
    InputError
        If an input has a wrong value, or the scene shows nothing that shines or what is no matte surface.
    """
    seen = with_camera(scene, camera)
    sensor = plenoptic_sensor(seen)
    child = chosen_integrator(seen, "ray", {})
    require_matte(seen, sensor, child, camera)
    wavelength = require_wavelength(wavelength)
    light = SceneLight(seen, sensor, child, wavelength if mi.is_spectral else None)
    found = find_points([light], camera, require_count("points_per_lens", points_per_lens), seed=seed)
    if found.weights.shape[1] != 1:
        raise InputError("scene: a camera is fitted to images of one channel; use a mono variant")
    if not len(found.positions):
        raise InputError("scene: the camera sees nothing that shines")
    weights = found.weights[:, 0] / brightness_at(OpticalSystem(camera, wavelength), found.positions)
    return View(image, found.positions, weights, noise, found.pupil_weights, mask, saturation)
