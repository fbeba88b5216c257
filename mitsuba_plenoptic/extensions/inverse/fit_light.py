"""The known light of a capture, and the noise of its pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from ...camera import PlenopticCamera, Use, require_support
from ...errors import InputError, put, refuse_if, require_count, require_number, require_wavelength
from ...fields import OpticalSystem
from ...io import Capture, digest, require_demosaiced, response_of
from ...linear import PixelNoise
from ...plugins.other_camera import with_camera
from ...points import PupilWeights, brightness_at, check_positions, scene_points
from ...runtime import Array, Doubles, Flags, Floats, Sizes, as_array, as_pixels, one_at_a_time
from ...scene import SceneLight, chosen_integrator, plenoptic_sensor

_LEAST_ELECTRONS = 1.0
"""Variance, in squared electrons, by which pixels are weighted at least: of a stray count in the dark."""

_CLEAR = 4.0
"""Standard deviations by which a pixel that counts is expected below its saturation."""

_NEGATIVE = 6.0
"""Standard deviations of its dark noise, by no more of which a pixel is below zero."""


def noise_of(capture: Capture) -> tuple[PixelNoise | None, float | None]:
    """Return the noise of a capture that `expose` made, from its metadata, and the value at which its pixels saturate.

    Parameters
    ----------
    capture : Capture
        The capture.

    Returns
    -------
    noise : PixelNoise or None
        None if no detector has recorded the capture.
    saturation : float or None
        Four standard deviations of the reading below a full well, or below the largest digital number.
    """
    require_demosaiced(capture)
    exposure = capture.metadata.get("exposure")
    if not isinstance(exposure, dict):
        return None, None
    gain, black, dark, unit = response_of(exposure)
    reading, full = (require_number(name, exposure.get(name), minimum=0) for name in ("read_noise", "full_well"))
    largest = (2 ** require_number("bits", exposure.get("bits"), minimum=1, maximum=16) - 1 - black) / gain
    return PixelNoise.of_exposure(exposure), (min(full, largest) - dark - _CLEAR * reading) / unit


@dataclass(frozen=True)
class Pixels:
    """The expected noise of all pixels of some views, (views, rows, columns)."""

    # Deviations by which residuals are divided; infinite where a pixel does not count.
    weight: Doubles
    # Expected squares of the residuals after that: 1, less in the dark, and 0 where a pixel does not count.
    share: Doubles
    # Variances of those squares.
    spread: Doubles

    @classmethod
    def of(cls, views: Sequence[View], expected: Doubles, default: PixelNoise | None) -> Pixels:
        """Return the noise of views' pixels at expected values; `default` is for views without noise of their own."""
        return cls(*map(np.stack, zip(*map(_pixels, views, expected, [default] * len(views)), strict=True)))


def by_model(view: View, default: PixelNoise | None) -> bool:
    """Return whether the noise of a view, or its set of used pixels, depends on the model's expected image."""
    return view.saturation is not None or isinstance(default if view.noise is None else view.noise, PixelNoise)


def _pixels(view: View, expected: Doubles, default: PixelNoise | None) -> tuple[Doubles, ...]:
    noise: Any = default if view.noise is None else view.noise
    if isinstance(noise, PixelNoise):
        counts = noise.electrons * np.maximum(expected, 0)
        unit = noise.electrons
        variance = counts + noise.dark_variance
        weight = np.maximum(variance, _LEAST_ELECTRONS)
    else:
        counts = np.zeros_like(expected)
        unit = 1.0
        weight = variance = counts + np.square(noise)
    mask = view.used
    if view.saturation is not None:
        # By what is expected alone, so that noise does not decide which pixels near saturation count.
        mask = mask & (expected + _CLEAR * np.sqrt(variance) / unit < view.saturation)
    share = np.where(mask, variance / weight, 0.0)
    # The fourth cumulant of a Poisson distribution is its mean; that of a normal one is zero.
    spread = np.where(mask, (2 * variance**2 + counts) / weight**2, 0.0)
    return np.where(mask, np.sqrt(weight) / unit, np.inf), share, spread


def check_light(view: View, default: PixelNoise | None) -> None:
    """Refuse a view without light, or with pixels further below zero than noise explains."""
    noise = default if view.noise is None else view.noise
    if isinstance(noise, PixelNoise):
        dark, least = (np.sqrt(max(noise.dark_variance, some)) / noise.electrons for some in (0.0, _LEAST_ELECTRONS))
    else:
        dark = 0.0 if noise is None else np.asarray(noise, np.float64)
        least = np.inf if noise is None else dark
    mask = view.used
    image = view.image
    refuse_if(not mask.any(), "image: all of its pixels are left out: by its mask, or as saturated")
    refuse_if(
        # 3: Standard deviations of its dark noise by which the sum of a capture is above zero, or it is
        # black.
        image.sum(where=mask, dtype=np.float64) <= 3 * np.sqrt(np.sum(np.square(dark) * mask)),
        "image: it is black: nothing can be found by it",
    )
    negative = mask & (image < -_NEGATIVE * least)
    if negative.any():
        row, column = np.argwhere(negative)[0]
        raise InputError(
            f"image: {negative.sum()} of its pixels are negative, beyond {_NEGATIVE:g} standard deviations of their "
            f"noise, the first, {image[row, column]:g}, at ({row}, {column}): subtract the right black level, or mask "
            "them"
        )


@dataclass(frozen=True)
class View:
    r"""A capture, and the light that was captured.

    A pixel is expected to be :math:`B \sum_r w_r \, \mathrm{psf}_r`, with what `points.units.brightness` returns as B:
    a capture in the unit of ``plenoptic_wave``. Behind a real main lens each point counts by the part of the pupil
    that is open to it.

    Parameters
    ----------
    image : array (rows, columns)
        The capture.
    points : array (n, 3)
        Incoherent point sources in the camera frame, in millimetres.
    weights : array (n,)
        Weight of each point: its radiance times the solid angle that it covers, seen from the main lens's image side.
    noise : PixelNoise, float or array (rows, columns), optional
        Noise of counted electrons, from `noise_of` for an exposed capture, or the standard deviation of each pixel.
        Default: the noise of the photons given to `fit`.
    pupil_weights, virtual : optional
        As for `CaptureOperator`.
    mask : bool array (rows, columns), optional
        True for pixels that do not count, as in NumPy's masked arrays.
    saturation : float, optional
        Value at which pixels are saturated. Pixels at or above it do not count, nor do pixels that a model expects
        within four standard deviations of it. Light that spills into neighbouring pixels is not modelled: mask these.
    """

    image: Floats
    points: Doubles
    weights: Doubles
    noise: Any = None
    pupil_weights: Any = None
    mask: Any = None
    saturation: float | None = None
    virtual: bool = False

    def __post_init__(self) -> None:
        image = as_pixels("image", self.image)
        refuse_if(image.ndim != 2, f"image of shape {image.shape}: a camera is fitted to images of one channel")
        points = check_positions(self.points, virtual=self.virtual)
        weights = as_array("weights", self.weights, shape=(len(points),), least=0.0)
        refuse_if(not weights.any(), "weights: all of them are 0: there is no light")
        noise = self.noise
        if noise is not None and not isinstance(noise, PixelNoise):
            noise = as_array("noise", noise)
            refuse_if(
                noise.shape not in ((), image.shape) or not (np.isfinite(noise) & (noise > 0)).all(),
                f"noise of shape {noise.shape}: it must be positive and finite, one number or one for each pixel",
            )
        mask = None if self.mask is None else as_array("mask", self.mask, dtype=None)
        if mask is not None and (mask.dtype != bool or mask.shape != image.shape):
            raise InputError(
                f"mask of type {mask.dtype} and shape {mask.shape}: it must be of booleans, {image.shape}: True where "
                "a pixel is left out"
            )
        if self.saturation is not None:
            require_number("saturation", self.saturation, positive=True)
        put(self, image=image, points=points, weights=weights, noise=noise, mask=mask)

    @property
    def used(self) -> Flags:
        """Mask (rows, columns) of the pixels that neither `mask` nor saturation excludes."""
        usable = np.ones(self.image.shape, bool) if self.mask is None else ~self.mask
        return usable if self.saturation is None else usable & (self.image < self.saturation)


def check_views(camera: PlenopticCamera, views: Sequence[View], default: PixelNoise | None = None) -> None:
    """Refuse an empty list of views, captures of another size than the camera's, and captures without light.

    `default` is the noise of views that have none.
    """
    refuse_if(not views, "views: give at least one capture of known light")
    for view in views:
        refuse_if(
            view.image.shape != camera.shape, f"image of shape {view.image.shape}: the camera records {camera.shape}"
        )
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
    """Return a view of a scene's capture; its points are found as by method ``points`` of wave captures.

    Parameters
    ----------
    image : array (rows, columns)
        The capture.
    scene : mitsuba.Scene
        The scene, of matte and emitting surfaces, with its first sensor at the camera's position; of a variant of one
        channel.
    camera : PlenopticCamera
        A camera near enough to the true one, from which rays start.
    wavelength : float
        Wavelength in nanometres.
    points_per_lens : int
        Points for each microlens.
    seed : int
        Seed of the points' pattern.
    noise, mask, saturation
        As for `View`.
    """
    require_support(camera, Use.SCENE_POINTS)
    camera = camera.regular
    placed = with_camera(scene, camera)
    sensor = plenoptic_sensor(placed)
    child = chosen_integrator(placed, "ray", {})
    scene_points.require_matte(placed, sensor, child)
    wavelength = require_wavelength(wavelength)
    light = SceneLight(placed, sensor, child, wavelength if mi.is_spectral else None)
    points = scene_points.find_points([light], camera, require_count("points_per_lens", points_per_lens), seed=seed)
    refuse_if(points.weights.shape[1] != 1, "scene: a camera is fitted to images of one channel; use a mono variant")
    refuse_if(not len(points.positions), "scene: the camera sees nothing that shines")
    weights = points.weights[:, 0] / brightness_at(OpticalSystem(camera, wavelength), points.positions)
    return View(image, points.positions, weights, noise, points.pupil_weights, mask, saturation)


def light_digest(views: list[View]) -> str:
    """Return a digest that identifies captures and their light."""
    arrays: list[Array | None] = []
    for view in views:
        pupil = PupilWeights.of(view.pupil_weights, len(view.points))
        noise = astuple(view.noise) if isinstance(view.noise, PixelNoise) else view.noise
        arrays += [view.image, view.points, view.weights, view.used, None if noise is None else np.asarray(noise)]
        arrays += [None if view.saturation is None else np.asarray(view.saturation)]
        arrays += [None] * 3 if pupil is None else [pupil.table, pupil.index, pupil.slant]
    return digest(*arrays)


def kept_numbers(arrays: Mapping[str, Array], shape: Sizes) -> tuple[Doubles, int]:
    """Return a fit's numbers, and the count of cameras tried, from the arrays of its checkpoint."""
    x = arrays.get("numbers")
    tried = arrays.get("tried")
    if x is None or tried is None or x.shape != shape or tried.shape != (1,):
        raise InputError("checkpoint: it is damaged: its numbers are not those of this fit")
    return x, int(tried[0])
