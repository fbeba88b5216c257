"""Wavefronts from captures of an extended source of known shape that HCIPy simulates."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator

import numpy as np

from mitsuba_plenoptic.optics.waves import in_millimetres
from mitsuba_plenoptic.wavefront import Zone, fit_wavefronts, modes_from_slopes, view_slopes

from .. import Row, at_most, case
from .wavefronts import (
    DIAMETER,
    LENSES,
    WAVELENGTH,
    WIDTH,
    ArrayInFocus,
    ShackHartmann,
    SpotTerms,
    atmosphere,
    rms,
    telescope,
)

DISTANCE = 1e9
STAR = np.zeros((1, 2))
DISC = WIDTH / 2 * np.array([(0.0, 0.0), *((math.cos(k * math.pi / 3), math.sin(k * math.pi / 3)) for k in range(6))])
"""Places of a source's points on the detector in lambda / D: the centre and six points of the edge of a disc."""


def zone(places: np.ndarray) -> Zone:
    """Return a source for our model; the telescope's picture is upside down."""
    points = -places * (in_millimetres(WAVELENGTH) / DIAMETER * DISTANCE)
    return Zone(np.column_stack([points, np.full(len(points), DISTANCE)]))


def image(sensor: ArrayInFocus | ShackHartmann, phase: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return HCIPy's capture of a source: the mean over its points, each a tilted wavefront of its own."""
    x, y = np.asarray(sensor.pupil.x), np.asarray(sensor.pupil.y)
    tilts = 2 * math.pi / DIAMETER * (places[:, :1] * x + places[:, 1:] * y)
    return np.asarray(np.mean([sensor.image(phase + tilt) for tilt in tilts], axis=0))


@case(
    "wavefronts.extended",
    "Zernike terms of atmospheres from one capture of a known disc as wide as a lens of the array, and of a star: "
    "residuals in waves, root mean square over the pupil, of a plenoptic camera and of a Shack-Hartmann sensor; "
    "all captures simulated by HCIPy",
    {
        "D / r0": "{ratio:g}", "source": "{source}", "wavefront": "{true:.3f}", "views": "{views:.3f}",
        "fit": "{fitted:.4f}", "deviation that the fit states": "{stated:.4f}", "Shack-Hartmann": "{spots:.4f}",
    },
    (at_most("fitted", "spots"), at_most("over_stated", 3.0)),
    page="docs/theory/wavefront_reconstruction.md",
    needs=("hcipy",),
    quick={"ratios": (5.0,), "modes": 6, "accuracy": 0.3},
)  # fmt: skip
def extended(
    *, ratios: tuple[float, ...] = (5.0, 10.0), photons: float = 1000.0, modes: int = 36, accuracy: float = 0.1
) -> Iterator[Row]:
    """Find the modes of an atmosphere at each strength from both sources; `photons` are those of a lens."""
    camera, pupil_sensor = telescope(), ShackHartmann()
    sensor = ArrayInFocus(camera)
    basis, pupil_basis = sensor.basis(modes), pupil_sensor.basis(modes)
    spot_terms = SpotTerms(pupil_sensor, pupil_basis)
    total = photons * math.pi / 4 * LENSES**2
    for ratio in ratios:
        terms = atmosphere(ratio, modes, seed=1)
        phase, pupil_phase = (2 * math.pi * np.tensordot(terms, own, 1) for own in (basis, pupil_basis))
        for source, places in (("star", STAR), ("disc", DISC)):
            rng, own = np.random.default_rng(0), zone(places)
            seen = rng.poisson(total * image(sensor, phase, places)).astype(float)
            spots = rng.poisson(total * image(pupil_sensor, pupil_phase, places)).astype(float)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that chi-square shows the difference of the two programs
                (found,) = fit_wavefronts(camera, seen, own, modes=modes, accuracy=accuracy)
            views = modes_from_slopes(view_slopes(camera, seen, own.weights @ own.points), DIAMETER / 2, modes)
            fitted = rms(np.array(found.camera.wavefront) - terms)
            stated = float(np.linalg.norm(list(found.deviations.values())))
            yield {
                "ratio": ratio,
                "source": source,
                "true": rms(terms),
                "views": rms(views - terms),
                "fitted": fitted,
                "stated": stated,
                "spots": rms(spot_terms.find(spots) - terms),
                "over_stated": fitted / stated,
            }
