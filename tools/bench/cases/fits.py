"""Fits of small cameras' parameters to captures with noise, whose spread must be as stated."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, fit
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays
from mitsuba_plenoptic.fitting import View
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.units import brightness_of

from .. import Row, at_most, case

WAVELENGTH = 633.0


@case(
    "fits.spread",
    "Fits of captures with other noise again and again: squared errors over stated variances, and stated deviations "
    "over the Cramer-Rao bound of the true camera",
    {
        "parameter": "{parameter}", "deviation": "{deviation:.3g}", "mean square over variance": "{square:.3f}",
        "mean error over deviation": "{mean:+.3f}", "deviation over bound, least and most": "{least:.3f}, {most:.3f}",
        "chi-square per pixel": "{chi_square:.3f}",
    },
    (at_most("square_off", 0.25), at_most("bound_off", 0.2)),
    page="docs/fitting.md",
    quick={"seeds": 1, "points": 2, "accuracy": 0.1},
)  # fmt: skip
def spread(
    *,
    lenses: int = 2,
    points: int = 6,
    seeds: int = 40,
    photons: float = 2000.0,
    model: str = "wave",
    accuracy: float = 0.0,
    off: float = 0.005,
    parameters: tuple[str, ...] = ("mla_pitch", "mla_offset", "detector_distance"),
) -> Iterator[Row]:
    """Fit points at several distances; each fit starts off by the given part of the lengths."""
    side = 0.064 * lenses
    camera = PlenopticCamera(
        detector_width=side, resolution=(32 * lenses,) * 2, focal_length=40.0, aperture_radius=2.5, mla_distance=60.0
    )
    rng = np.random.default_rng(0)
    g = rng.uniform(112, 128, points)
    places = np.column_stack([rng.uniform(-0.4, 0.4, (points, 2)) * side * -g[:, None] / 60, g])
    if model == "ray":
        image = PointRays(camera, places, WAVELENGTH).image(OpticalSystem(camera, WAVELENGTH), np.ones(points))
    else:
        operator = CaptureOperator(camera, places, wavelength=WAVELENGTH, accuracy=accuracy)
        image = operator.forward(np.ones(points)).astype(np.float64)
    image *= brightness_of(camera, main_lens(camera))
    weights = np.full(points, 1 / image.max())
    image /= image.max()
    common = {"wavelength": WAVELENGTH, "photons": photons, "accuracy": accuracy, "model": model}
    # A fit of what the true camera records without noise ends there, and states the bound.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that chi-square is 0
        bound = fit(camera, View(image, places, weights), parameters, **common)
    fits = []
    for seed in range(seeds):
        noise = np.random.default_rng(seed + 1)
        counted = noise.poisson(np.maximum(image, 0) * photons) / photons
        away = {
            "mla_pitch": camera.mla_pitch * (1 + noise.uniform(-1, 1) * off),
            "mla_offset": tuple(noise.uniform(-0.3, 0.3, 2) * off * camera.mla_pitch),
        }
        # Parameters that are not fitted are right.
        start = camera.replace(**{name: value for name, value in away.items() if name in parameters})
        fits.append(fit(start, View(counted, places, weights), parameters, **common))
    for name, deviation in bound.deviations.items():
        errors = np.array([(each.values[name] - bound.values[name]) / each.deviations[name] for each in fits])
        stated = np.array([each.deviations[name] for each in fits]) / deviation
        square = float((errors**2).mean())
        yield {
            "parameter": name,
            "deviation": deviation,
            "square": square,
            "mean": errors.mean(),
            "least": stated.min(),
            "most": stated.max(),
            "chi_square": np.mean([each.chi_square for each in fits]),
            # Of so few seeds nothing follows.
            "square_off": abs(square - 1) if seeds >= 40 else None,
            "bound_off": float(np.abs(stated - 1).max()),
        }
