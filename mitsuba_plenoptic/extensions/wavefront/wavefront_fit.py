"""The wavefront of a capture of known points, fitted to its pixels by least squares with derivatives.

Its Zernike terms are fitted by `fitting.fit`, for the light that explains the capture best; terms and light are fitted
in turn until neither changes.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

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
from ...lenses import main_lens
from ...points import CaptureOperator, check_positions
from ...runtime import Doubles, as_array
from ..inverse.fit_light import Pixels, check_views
from ..inverse.fitting import Fit, PixelNoise, View, fit
from .slopes import centres_of_pixels, modes_from_slopes, view_slopes

COUNTS = PixelNoise(1.0)
"""Noise of a capture whose pixels are counted electrons."""

_MOST_FITS = 8
"""How often the terms are fitted at most."""


@dataclass(frozen=True)
class Zone:
    """Part of the field over which the wavefront is constant.

    Parameters
    ----------
    points : array (n, 3)
        Point sources of the zone in the camera frame, in millimetres.
    weights : array (n,), optional
        Their relative brightness, not negative. Default: all alike.
    """

    points: Doubles
    weights: Any = None

    def __post_init__(self) -> None:
        points = check_positions(self.points)
        refuse_if(not len(points), "points: a zone needs at least one")
        relative = np.ones(len(points)) if self.weights is None else self.weights
        weights = as_array("weights", relative, shape=(len(points),), least=0.0)
        refuse_if(not weights.any(), "weights: all of them are 0: there is no light")
        put(self, points=points, weights=weights / weights.sum())


@suggest_keywords
def fit_wavefronts(
    camera: PlenopticCamera,
    image: Any,
    zone: Zone,
    *,
    modes: int = 36,
    wavelength: float = 633.0,
    noise: Any = COUNTS,
    accuracy: float = 0.01,
) -> Fit:
    """Return the wavefront of a zone of the field, fitted to one capture of known points.

    The positions of the points are known, but not their total light. Tilts are thus measured relative to the
    positions, and defocus relative to the distances.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a thin main lens. If it has a ``wavefront``, the search starts there; otherwise at the terms that
        fit the slopes of the views.
    image : array (rows, columns)
        Capture.
    zone : Zone
        The points.
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
    Fit
        Its ``camera.wavefront`` are the terms, and its deviations follow from the noise.

    Warns
    -----
    UserWarning
        As `fit`; if terms and light have not settled after eight fits; or if all light would miss the detector but for
        the fitted tilt, which then stands for wrong positions.
    """
    require_support(require_camera(camera), Use.LENS_CENTRES)
    require_zone(zone)
    count = require_count("modes", modes, minimum=2, maximum=66)
    wavelength = require_wavelength(wavelength)
    accuracy = require_accuracy(accuracy)
    refuse_if(noise is None, "noise: give that of the capture")
    view = View(image, zone.points, zone.weights, noise)
    check_views(camera, [view])
    pixels = np.asarray(view.image, np.float64)
    names = [f"wavefront.{term}" for term in range(2, count + 1)]
    if camera.wavefront:
        terms = _terms(camera, max(count, len(camera.wavefront)))
    else:
        terms = modes_from_slopes(
            view_slopes(camera, pixels, zone.weights @ zone.points), camera.aperture_radius, count
        )
    fitted = camera.replace(wavefront=tuple(terms.tolist()))
    expected = _expected(fitted, zone, wavelength, accuracy)
    light = _light(view, expected, pixels)
    for _ in range(_MOST_FITS):
        before = fitted
        light_before = light
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            fit_of_terms = fit(
                fitted, View(view.image, zone.points, light * zone.weights, view.noise), names, wavelength=wavelength,
                accuracy=accuracy,
            )  # fmt: skip
        fitted = fit_of_terms.camera
        expected = _expected(fitted, zone, wavelength, accuracy)
        light = _light(view, expected, light * expected)
        moved = np.linalg.norm(_terms(fitted, count) - _terms(before, count))
        # 0.1: Change of a wavefront, over its standard deviation, below which it has settled.
        settled = moved <= 0.1 * np.linalg.norm(list(fit_of_terms.deviations.values()))
        # 1e-3: Relative change of the light below which it has settled.
        if settled and np.isclose(light, light_before, rtol=1e-3):
            break
    else:
        warn(f"fit_wavefronts: the wavefront had not settled after {_MOST_FITS} fits: fit fewer modes")
    for warning in caught:
        warn(str(warning.message))
    beside = _distance_beside(camera, zone)
    if beside > 0:
        tilt = float(np.hypot(*_terms(fitted, 3)[1:]))
        warn(
            f"fit_wavefronts: zone: its image is {beside:.3g} mm beside the recorded lenses; a tilt of {tilt:.3g} "
            "waves was fitted to bring it there; check the positions of its points"
        )
    return fit_of_terms


def require_zone(zone: Any) -> None:
    """Refuse anything but one zone."""
    if not isinstance(zone, Zone):
        raise InputError(f"zone of type {type(zone).__name__}: it must be one Zone")


def _terms(camera: PlenopticCamera, count: int) -> Doubles:
    """Return the first Zernike terms of a camera, zeros where it has none."""
    return np.pad(np.array(camera.wavefront, np.float64), (0, count))[:count]


def _expected(camera: PlenopticCamera, zone: Zone, wavelength: float, accuracy: float) -> Doubles:
    """Return the expected capture of a zone whose points have a total weight of 1, in units of `View`."""
    operator = CaptureOperator(camera, zone.points, wavelength=wavelength, accuracy=accuracy)
    return np.asarray(operator.forward(operator.powers(zone.weights)), np.float64)


def _light(view: View, expected: Doubles, before: Doubles) -> float:
    """Return the weight of an expected capture that is nearest to a view, in units of the noise of a capture before."""
    weight = 1 / Pixels.of([view], np.maximum(before, 0)[None], None).weight[0].ravel()
    row = (expected.ravel() * weight)[:, None]
    light, *_ = np.linalg.lstsq(row, np.asarray(view.image, np.float64).ravel() * weight, rcond=None)
    return float(light[0])


def _distance_beside(camera: PlenopticCamera, zone: Zone) -> float:
    """Return the distance in mm between the recorded lenses and a zone's nearest ray, with the camera's wavefront."""
    lens = main_lens(camera)
    # 8 rings of 32 points.
    radius = np.linspace(0, lens.pupil.radius, 8)
    angle = 2 * np.pi * np.arange(32) / 32
    pupil = np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()
    arrives = np.stack([lens.land(pupil, tuple(point)) for point in zone.points[zone.weights > 0]], -1)
    centres = centres_of_pixels(camera).reshape(-1, 2).T[..., None, None]
    # Diffraction brings light to the lens beside.
    low = centres.min(1) - 1.5 * max(camera.mla_pitches)
    high = centres.max(1) + 1.5 * max(camera.mla_pitches)
    return float(np.hypot(*np.maximum(np.maximum(low - arrives, arrives - high), 0)).min())
