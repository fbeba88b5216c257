"""Digital adaptive optics: a Siemens star behind unknown wavefronts in three zones of the field."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from mitsuba_plenoptic import CaptureOperator
from mitsuba_plenoptic.optics.waves import in_millimetres
from mitsuba_plenoptic.wavefront import Zone, deconvolve_zones, digital_adaptive_optics

from .. import Row, at_least, case
from .wavefronts import DIAMETER, WAVELENGTH, rms, telescope

DISTANCE = 1e9
SPOKES, RADIUS = 18, 9.0
"""Pairs of a bright and a dark spoke, and the star's radius in lambda / D."""

PERIOD = 2.0
"""Period in lambda / D of half the diffraction limit."""

STEP = 0.5
"""Distance of the object's points in lambda / D."""


def _grid(columns: int, rows: int) -> np.ndarray:
    """Return points on the sky, x and y in lambda / D, (rows, columns, 2)."""
    return np.stack(np.meshgrid(*((np.arange(count) - (count - 1) / 2) * STEP for count in (columns, rows))), -1)


def _star(places: np.ndarray) -> np.ndarray:
    """Return a Siemens star, averaged over a fine grid around each point."""
    fine = (np.arange(8) - 3.5) / 8 * STEP
    x, y = places[..., 0, None, None] + fine, places[..., 1, None, None] + fine[:, None]
    bright = (np.cos(SPOKES * np.arctan2(y, x)) > 0) & (np.hypot(x, y) < RADIUS)
    return bright.mean((-2, -1))


def _contrast(values: np.ndarray, places: np.ndarray) -> float:
    """Return the amplitude of the spokes over their mean, where their period is that of half the limit."""
    x, y = places[..., 0], places[..., 1]
    ring = np.abs(np.hypot(x, y) - SPOKES * PERIOD / (2 * math.pi)) < STEP
    angle = SPOKES * np.arctan2(y[ring], x[ring])
    rows = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], -1)
    (mean, along, _), *_ = np.linalg.lstsq(rows, values[ring], rcond=None)
    return float(along / mean)


@case(
    "wavefronts.digital-optics",
    "A Siemens star behind 1 wave RMS of other Zernike terms in each of three zones of the field: contrast of the "
    "deconvolved star at half the diffraction limit over that of the star, without correction, with wavefronts that "
    "digital adaptive optics finds from the same capture, and with the true ones",
    {
        "wavefronts": "{name}", "contrast": "{contrast:.2f}", "correlation with the star": "{correlation:.2f}",
        "error of the wavefronts, waves RMS": "{error:.2f}",
        "misfit per pixel, 1 is noise": "{misfit:.2f}", "turns": "{turns}",
    },
    (at_least("correlation", "least"),),
    page="docs/theory/wavefront_reconstruction.md",
    quick={"modes": 5, "turns": 1, "iterations": 5, "lenses": 12},
)  # fmt: skip
def digital_optics(
    *,
    strength: float = 1.0,
    modes: int = 10,
    photons: float = 1e7,
    lenses: int = 20,
    turns: int = 8,
    iterations: int = 200,
    accuracy: float = 0.3,
    accuracy_of_data: float = 0.1,
) -> Iterator[Row]:
    """Compare three objects; the data are more accurate than the model, and have photon noise."""
    camera = telescope(lenses=lenses, pixels=6, width=2.0)
    places = _grid(36, 44)
    scale = in_millimetres(WAVELENGTH) / DIAMETER * DISTANCE
    star = _star(places)
    strips = np.split(np.arange(36), 3)
    rng = np.random.default_rng(1)
    zones, true, image = [], [], np.zeros(camera.shape)
    for strip in strips:
        own = places[:, strip].reshape(-1, 2) * -scale
        zones.append(Zone(np.column_stack([own, np.full(len(own), DISTANCE)])))
        terms = np.concatenate([np.zeros(4), rng.normal(size=modes - 4)])
        true.append(terms * (strength / np.linalg.norm(terms)))
        operator = CaptureOperator(
            camera.replace(wavefront=tuple(true[-1])),
            zones[-1].points,
            wavelength=WAVELENGTH,
            accuracy=accuracy_of_data,
        )
        image += np.maximum(operator.forward(star[:, strip].ravel()), 0)
    image = rng.poisson(image * photons / image.sum()).astype(float)
    common = {"wavelength": WAVELENGTH, "accuracy": accuracy}
    found = digital_adaptive_optics(camera, image, zones, modes=modes, turns=turns, **common)
    # Artefacts of a wrong wavefront may have the period of the spokes by chance, but not the star's shape.
    within, before = np.hypot(*np.moveaxis(places, -1, 0)) < RADIUS, 0.0
    for name, cameras in (
        ("none", [camera] * 3),
        ("found", found.cameras),
        ("true", [camera.replace(wavefront=tuple(terms)) for terms in true]),
    ):
        made = deconvolve_zones(cameras, image, zones, iterations=iterations, **common)
        picture = np.concatenate([part.reshape(len(places), -1) for part in made.weights], 1)
        contrast = _contrast(picture, places) / _contrast(star, places)
        terms_found = [np.pad(np.array(each.wavefront), (0, modes))[:modes] for each in cameras]
        correlation = float(np.corrcoef(picture[within], star[within])[0, 1])
        before = correlation if name == "none" else before
        yield {
            "name": name,
            "contrast": contrast,
            "correlation": correlation,
            # What is found must not be worse than no correction.
            "least": before if name == "found" else None,
            "error": math.sqrt(np.mean([rms(a - b) ** 2 for a, b in zip(terms_found, true, strict=True)])),
            "misfit": made.misfits[-1],
            "turns": len(found.misfits) - 1 if name == "found" else "",
        }
