"""Captures of known light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..capture.accuracy import DEFAULT_ACCURACY
from ..capture.render import chosen_integrator, plenoptic_sensor
from ..capture.sight import Sight
from ..capture.units import brightness_at
from ..capture.wave_capture import WaveCapture
from ..errors import InputError, require_count
from ..io.captures import as_array, require_pixels
from ..optics.sampling import check_positions
from ..plugins.other_camera import with_camera
from ..runtime.backend import one_at_a_time


@dataclass(frozen=True)
class View:
    r"""A capture, and the light that it shows.

    A pixel is expected to be :math:`B \sum_r w_r \, \mathrm{psf}_r`, with what `capture.units.brightness` returns as B:
    a capture in the unit of ``plenoptic_wave``. Behind a real main lens each radiator counts by the part of the pupil
    that is open to it.

    Parameters
    ----------
    image : array (rows, columns)
        The capture.
    points : array (n, 3)
        Incoherent point sources in the camera frame, in millimetres.
    weights : array (n,)
        Of each, radiance times the solid angle, seen from the main lens's image side, that it stands for.
    noise : float or array (rows, columns), optional
        Standard deviation of the pixels. Default: what `fit` is told of photons.
    pupil_weights, virtual : optional
        As of `CaptureOperator`.

    Raises
    ------
    InputError
        If an input has a wrong shape or value.
    """

    image: NDArray[np.float32]
    points: NDArray[np.float64]
    weights: NDArray[np.float64]
    noise: Any = None
    pupil_weights: Any = None
    virtual: bool = False

    def __post_init__(self) -> None:
        image = as_array("image", self.image)
        if image.ndim != 2:
            raise InputError(f"image of shape {image.shape}: a camera is fitted to images of one channel")
        require_pixels("image", image)
        points, weights = check_positions(self.points, virtual=self.virtual), np.asarray(self.weights, np.float64)
        if weights.shape != (len(points),) or not np.isfinite(weights).all():
            raise InputError(f"weights of shape {weights.shape}: they must be ({len(points)},) finite numbers")
        noise = None if self.noise is None else np.asarray(self.noise, np.float64)
        if noise is not None and (noise.shape not in ((), image.shape) or not (noise > 0).all()):
            raise InputError(f"noise of shape {noise.shape}: it must be positive, one number or one for each pixel")
        for name, value in (("image", image), ("points", points), ("weights", weights), ("noise", noise)):
            object.__setattr__(self, name, value)


def check_views(camera: PlenopticCamera, views: Sequence[View]) -> None:
    """Refuse no view at all, and captures of another size than the camera's."""
    if not views:
        raise InputError("views: give at least one capture of known light")
    for view in views:
        if view.image.shape != camera.shape:
            raise InputError(f"image of shape {view.image.shape}: the camera records {camera.shape}")


@one_at_a_time
def known_view(
    image: Any,
    scene: Any,
    camera: PlenopticCamera,
    *,
    wavelength: float = 633.0,
    radiators_per_lens: int = 8,
    spp: int = 16,
    seed: int = 0,
    noise: Any = None,
) -> View:
    """Return a capture of a scene with the radiators of that scene, found by rays as for ``plenoptic_wave``.

    Parameters
    ----------
    image : array (rows, columns)
        The capture.
    scene : mitsuba.Scene
        What it shows, with the camera's place as that of the first sensor; of a variant of one channel.
    camera : PlenopticCamera
        A camera near enough to the true one, from which rays start.
    wavelength : float
        In nanometres.
    radiators_per_lens, spp, seed
        As of ``plenoptic_wave``.
    noise
        As of `View`.

    Raises
    ------
    InputError
        If an input has a wrong value, or the scene shows nothing that shines.
    """
    seen = with_camera(scene, camera)
    sensor = plenoptic_sensor(seen)
    child = chosen_integrator(seen, "ray", {})
    capture = WaveCapture(
        camera=camera,
        sight=Sight.of(seen, sensor, child, None),
        wavelengths=(require_wavelength(wavelength),),
        radiators_per_lens=require_count("radiators_per_lens", radiators_per_lens),
        passes=1,
        method="patch",
        occlusion=True,
        accuracy=DEFAULT_ACCURACY,
    )
    (radiators,) = capture.radiators("patch", seed, require_count("spp", spp))
    if radiators.radiance.shape[1] != 1:
        raise InputError("scene: a camera is fitted to images of one channel; use a mono variant")
    if not len(radiators.positions):
        raise InputError("scene: the camera sees nothing that shines")
    recorded = (capture.scale(radiators) * radiators.radiance)[:, 0]
    weights = recorded / brightness_at(camera, radiators.positions, capture.wavelengths[0])
    return View(image, radiators.positions, weights, noise, radiators.pupil_weights, virtual=True)
