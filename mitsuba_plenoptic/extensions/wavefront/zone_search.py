"""Wavefronts by zones of the field, fitted to the pixels of a capture by least squares with derivatives.

Each zone of the field, a star or a part of an extended scene, has its own wavefront. Its Zernike terms are fitted by
`fitting.fit` to the capture minus the light of the other zones; zones take turns until neither wavefronts nor
brightness change.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera, Use, require_camera, require_support
from ...errors import (
    InputError,
    put,
    refuse_if,
    require_accuracy,
    require_count,
    require_wavelength,
    suggest_keywords,
    warn,
)
from ...fields.optical_system import OpticalSystem
from ...lenses.common import main_lens
from ...points.operator import CaptureOperator
from ...points.sampling import check_positions
from ...points.units import brightness_at
from ...runtime import as_array
from ..inverse.fit_light import Pixels, check_views
from ..inverse.fitting import Fit, PixelNoise, View, fit
from .slopes import lenses_of_pixels, modes_from_slopes, view_slopes

Array = NDArray[np.float64]

COUNTS = PixelNoise(1.0)
"""Noise of a capture whose pixels are counted electrons."""

_MOST_TURNS = 8
"""How often each zone is fitted at most."""

_SETTLED = 0.1
"""Change of a wavefront, over its standard deviation, below which it has settled."""

_SAME_LIGHT = 1e-3
"""Relative change of a zone's light below which it has settled."""

_LEAST_LIGHT = 1e-6
"""Light of a zone over that of the brightest, at least, so that it can be fitted."""

_DARKEST = 5.0
"""Standard deviations by which a pixel may be below zero when the light of other zones is subtracted."""


_RINGS, _SPOKES = 8, 32
"""Points of the pupil whose rays find whether the detector records light of a zone."""


@dataclass(frozen=True)
class Zone:
    """Part of the field over which the wavefront is constant.

    Parameters
    ----------
    points : array (n, 3)
        Point sources of the zone in the camera frame, in millimetres.
    weights : array (n,), optional
        Their relative brightness, not negative. Default: all alike.

    Raises
    ------
    InputError
        If an input has a wrong shape or value.
    """

    points: Array
    weights: Any = None

    def __post_init__(self) -> None:
        points = check_positions(self.points)
        refuse_if(not len(points), "points: a zone needs at least one")
        given = np.ones(len(points)) if self.weights is None else as_array("weights", self.weights)
        weights = np.asarray(given, np.float64)
        if weights.shape != (len(points),) or not (np.isfinite(weights) & (weights >= 0)).all() or not weights.any():
            raise InputError(
                f"weights of shape {weights.shape}: they must be ({len(points)},) finite numbers, at least 0, not all 0"
            )
        put(self, points=points, weights=weights / weights.sum())


@suggest_keywords
def fit_wavefronts(
    camera: PlenopticCamera,
    image: Any,
    zones: Zone | Sequence[Zone],
    *,
    modes: int = 36,
    wavelength: float = 633.0,
    noise: Any = COUNTS,
    accuracy: float = 0.01,
) -> list[Fit]:
    """Return the wavefront of each zone of the field, fitted to one capture of known points.

    The positions of the points are known, but not their total light in each zone. Tilts are thus measured relative to
    the positions, and defocus relative to the distances.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a thin main lens. If it has a ``wavefront``, the search starts there in all zones; otherwise at
        the terms that fit the slopes of the views.
    image : array (rows, columns)
        Capture.
    zones : Zone, or sequence of Zone
        Parts of the field, each with its points.
    modes : int
        Number of Zernike terms, the piston included, which stays 0; from 2 to 66.
    wavelength : float
        Wavelength in nanometres.
    noise : PixelNoise, float or array (rows, columns)
        Noise as for `fitting.View`. Default: the noise of pixels that are counted electrons.
    accuracy : float
        As for `CaptureOperator`.

    Returns
    -------
    list of Fit
        For each zone; its ``camera.wavefront`` are the terms, and its deviations follow from the noise. The covariance
        of a zone does not include the errors of the others, and its chi-square has a meaning for a single zone alone.

    Raises
    ------
    InputError
        If an input has a wrong shape or value, or for the reasons of `fit`.

    Warns
    -----
    UserWarning
        As `fit`, of the last turn of a single zone; if the zones have not settled after eight turns; or if the whole
        light of a zone would miss the detector but for the fitted tilt, which then stands for wrong positions.
    """
    require_fitted(camera)
    some = known_zones(zones)
    count = require_count("modes", modes, minimum=2, maximum=66)
    search = Search(camera, image, require_wavelength(wavelength), noise, require_accuracy(accuracy))
    names = [f"wavefront.{term}" for term in range(2, count + 1)]
    own = nearest_pixels(camera, np.stack([zone.weights @ zone.points for zone in some]))
    cameras = [_start(camera, search.image * (own == which), zone, count) for which, zone in enumerate(some)]
    expected = [search.expected(each, zone) for each, zone in zip(cameras, some, strict=True)]
    light = search.light(expected, search.image)
    for turn in range(_MOST_TURNS):
        before, settled, found, said = light, True, [], []
        for which, zone in enumerate(some):
            # At first the others are known too badly to be subtracted.
            mask = None if turn or len(some) == 1 else own != which
            one, heard = search.turn(cameras[which], zone, names, expected, light, which, mask)
            moved = terms_of(one.camera, count) - terms_of(cameras[which], count)
            settled &= bool(np.linalg.norm(moved) <= _SETTLED * np.linalg.norm(list(one.deviations.values())))
            cameras[which], expected[which] = one.camera, search.expected(one.camera, zone)
            light = search.light(expected, np.tensordot(light, expected, 1))
            found.append(one)
            said += heard
        if settled and np.allclose(light, before, rtol=_SAME_LIGHT):
            break
    else:
        warn(f"fit_wavefronts: the zones had not settled after {_MOST_TURNS} turns: fit fewer modes, or fewer zones")
    # Where zones overlap, pixels are weighted as no single fit expects, and its chi-square means nothing.
    for each in said if len(some) == 1 else ():
        warn(str(each))
    for which, (zone, fitted) in enumerate(zip(some, found, strict=True)):
        beside = _distance_beside(camera, zone)
        if beside > 0:
            tilt = float(np.hypot(*terms_of(fitted.camera, 3)[1:]))
            warn(
                f"fit_wavefronts: zones: the image of zone {which} is {beside:.3g} mm beside the recorded lenses; a "
                f"tilt of {tilt:.3g} waves was fitted to bring it there; check the positions of its points"
            )
    return found


def _distance_beside(camera: PlenopticCamera, zone: Zone) -> float:
    """Return the distance in mm between the recorded lenses and a zone's nearest ray, with the camera's wavefront."""
    lens = main_lens(camera)
    radius, angle = np.linspace(0, lens.pupil.radius, _RINGS), 2 * np.pi * np.arange(_SPOKES) / _SPOKES
    pupil = np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()
    arrives = np.stack([lens.land(pupil, tuple(point)) for point in zone.points[zone.weights > 0]], -1)
    centres = lenses_of_pixels(camera)[0].reshape(-1, 2).T[..., None, None]
    # Diffraction brings light to the lens beside.
    low, high = centres.min(1) - 1.5 * max(camera.mla_pitches), centres.max(1) + 1.5 * max(camera.mla_pitches)
    return float(np.hypot(*np.maximum(np.maximum(low - arrives, arrives - high), 0)).min())


class Search:
    """A capture, and the captures of zones expected from a camera."""

    def __init__(self, camera: PlenopticCamera, image: Any, wavelength: float, noise: Any, accuracy: float) -> None:
        refuse_if(noise is None, "noise: give that of the capture")
        # A view checks the capture and its noise; this one's light has no meaning.
        self._view = View(image, np.array([[0.0, 0.0, camera.mla_distance]]), np.ones(1), noise)
        check_views(camera, [self._view])
        self.image = np.asarray(self._view.image, np.float64)
        self.wavelength, self.accuracy = wavelength, accuracy

    def operator(self, camera: PlenopticCamera, points: Array) -> CaptureOperator:
        """Return the capture operator of given points."""
        return CaptureOperator(camera, points, wavelength=self.wavelength, accuracy=self.accuracy)

    def expected(self, camera: PlenopticCamera, zone: Zone) -> Array:
        """Return the expected capture of a zone whose points have a total weight of 1, in units of `View`."""
        operator = self.operator(camera, zone.points)
        system = OpticalSystem(operator.camera.at_wavelength(self.wavelength), self.wavelength)
        weights = brightness_at(system, zone.points) * zone.weights
        return np.asarray(operator.forward(weights), np.float64)

    def deviations(self, expected: Array) -> Array:
        """Return the standard deviation of each pixel at given expected values."""
        return Pixels.of([self._view], expected[None], None).weight[0]

    def light(self, expected: Sequence[Array], sum_before: Array) -> Array:
        """Return the weights of the zones whose weighted sum is nearest to the capture, in units of its noise."""
        weight = 1 / self.deviations(np.maximum(sum_before, 0)).ravel()
        rows = np.stack([each.ravel() * weight for each in expected], 1)
        found, *_ = np.linalg.lstsq(rows, self.image.ravel() * weight, rcond=None)
        return np.maximum(found, _LEAST_LIGHT * found.max())

    def turn(
        self,
        camera: PlenopticCamera,
        zone: Zone,
        names: Sequence[str],
        expected: Sequence[Array],
        light: Array,
        which: int,
        mask: NDArray[np.bool_] | None,
        **options: Any,
    ) -> tuple[Fit, list[Warning | str]]:
        """Return the fitted wavefront of one zone, from the pixels outside a mask, and the warnings of the fit.

        `options` are those of `fit`.
        """
        noise, image = self._view.noise, self._view.image
        if len(expected) > 1:
            total = np.tensordot(light, expected, 1)
            others = total - light[which] * expected[which]
            image = image if mask is not None else (image - others).astype(np.float32)
            # The light of the others has noise, too. Where it is known badly, pixels count less.
            noise = np.maximum(self.deviations(total), -image / _DARKEST)
        view = View(image, zone.points, light[which] * zone.weights, noise, mask=mask)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            found = fit(camera, view, names, wavelength=self.wavelength, accuracy=self.accuracy, **options)
        return found, [each.message for each in caught]


def known_zones(zones: Any) -> list[Zone]:
    """Return zones as a list; refuse anything else."""
    some = [zones] if isinstance(zones, Zone) else list(zones) if isinstance(zones, Iterable) else []
    refuse_if(
        not some or not all(isinstance(zone, Zone) for zone in some), "zones: give at least one Zone, and no other"
    )
    return some


def require_fitted(camera: Any) -> None:
    """Refuse a camera whose ``wavefront`` cannot be fitted."""
    require_support(require_camera(camera), Use.LENS_CENTRES)


def terms_of(camera: PlenopticCamera, count: int) -> Array:
    """Return the first Zernike terms of a camera, zeros where it has none."""
    return np.pad(np.array(camera.wavefront, np.float64), (0, count))[:count]


def _start(camera: PlenopticCamera, image: Array, zone: Zone, modes: int) -> PlenopticCamera:
    """Return the camera from which the search for a zone's wavefront starts, estimated from the zone's pixels."""
    if camera.wavefront:
        return camera.replace(wavefront=tuple(terms_of(camera, max(modes, len(camera.wavefront))).tolist()))
    slopes = view_slopes(camera, image, zone.weights @ zone.points)
    return camera.replace(wavefront=tuple(modes_from_slopes(slopes, camera.aperture_radius, modes).tolist()))


def nearest_pixels(camera: PlenopticCamera, points: Array) -> NDArray[np.int64]:
    """Return, for each pixel, the index of the point, of (n, 3), whose image is nearest to the pixel's lens."""
    images = main_lens(camera).images(points)
    lens, _ = lenses_of_pixels(camera)
    return np.asarray(((lens[..., None, :] - images) ** 2).sum(-1).argmin(-1))
