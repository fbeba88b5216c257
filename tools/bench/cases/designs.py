"""Designs of cameras by their own figures, judged by what the search did not see."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.optimisation import DepthInformation, RefocusedContrast, maximise
from mitsuba_plenoptic.report.images import write_png

from .. import Row, case, figure

SCAN = np.linspace(0.42, 0.66, 25)
"""Microlens focal lengths, in millimetres."""

FREQUENCIES = (0.3, 0.6, 0.9)

PHOTONS, BACKGROUND = 10000.0, 1.0

OTHER_PHOTONS, OTHER_BACKGROUND = 4000.0, 4.0

SEEN = (232.0, 234.0, 236.0, 238.0, 240.0, 242.0, 244.0, 246.0, 248.0)

UNSEEN = (233.0, 235.0, 237.0, 239.0, 241.0, 243.0, 245.0, 247.0)
"""Distances of points by which wavefronts are sought and judged, in millimetres.

They lie about the plane in focus, where a camera without aberrations resolves depth worst.
"""

TERMS = range(5, 12)
"""Aberrations that vary, by Noll's numbers: astigmatism to spherical."""

LARGEST = 1.0
"""Waves of each, at most."""


@dataclass(frozen=True)
class Setting:
    """A camera, and the points before it."""

    camera: PlenopticCamera
    scale: float

    @classmethod
    def of(cls, half: bool) -> Setting:
        """Return that of the paper, of a small detector, or with half of its main lens."""
        scale, lenses = (0.5, 10) if half else (1.0, 16)
        camera = PlenopticCamera(
            focal_length=80 * scale,
            aperture_radius=5 * scale,
            mla_distance=120 * scale,
            detector_distance=0.512,
            detector_width=0.064 * lenses,
            resolution=(32 * lenses,) * 2,
        )
        return cls(camera, scale)

    def points(self, distances: tuple[float, ...], seed: int) -> np.ndarray:
        """Return a point at each distance, whose image lies anywhere in the lenses about the axis."""
        g = self.scale * np.array(distances)
        image = np.random.default_rng(seed).uniform(-0.064, 0.064, (len(g), 2))
        return np.column_stack([-image * g[:, None] / self.camera.mla_distance, g])


@case(
    "designs.focal-length",
    "The microlens focal length of most contrast of points refocused between 220 and 260 mm, sought from random "
    "starts, against a scan",
    page="docs/designing.md",
    quick={"starts": 1, "half": True, "scan": 7},
)
def focal_length(output: Path, *, starts: int = 10, half: bool = False, scan: int = 25) -> Iterator[Row]:
    """Search and scan; ``half`` takes the main lens at half its size and distances, which costs a fourth."""
    setting, low, high = Setting.of(half), float(SCAN[0]), float(SCAN[-1])
    measure = RefocusedContrast(setting.camera, setting.points((220.0, 230.0, 250.0, 260.0), 1), FREQUENCIES)

    def best_of(values: np.ndarray) -> int:
        return int(np.argmax([measure.value(setting.camera.replace(mla_focal_length=f)) for f in values.tolist()]))

    coarse = np.linspace(low, high, scan)
    best = best_of(coarse)
    fine = np.linspace(coarse[max(best - 1, 0)], coarse[min(best + 1, scan - 1)], 21)
    found = float(fine[best_of(fine)])
    yield figure("best of the scan", found, unit="mm")
    for start in np.random.default_rng(2).uniform(low, high, starts).tolist():
        design = maximise(measure, setting.camera.replace(mla_focal_length=start), {"mla_focal_length": (low, high)})
        end = design.values["mla_focal_length"]
        yield figure(f"from {start:.4f} mm, off the scan's best", abs(end / found - 1), at_most=0.005)
    draw(
        output / "contrast.png",
        [measure.refocused(setting.camera.replace(mla_focal_length=f)) for f in (low, found)],
    )


@case(
    "designs.wavefront",
    "Aberrations of the main lens, tilt and defocus left out, by which captures resolve most of the depth of points "
    "between 232 and 248 mm, judged by full fields with another noise",
    page="docs/designing.md",
    quick={"starts": 1, "half": True, "steps": 1, "draws": 300},
)
def wavefront(output: Path, *, starts: int = 3, half: bool = False, steps: int = 12, draws: int = 300) -> Iterator[Row]:
    """Seek from random starts near no aberration, where the slopes vanish by symmetry.

    Estimated depths of noisy captures must keep to their bounds. For points that the search did not see the gain is
    stated without a limit.
    """
    setting = Setting.of(half)
    plain = setting.camera.replace(wavefront=(0.0,) * max(TERMS))
    measure = DepthInformation(setting.points(SEEN, 3), PHOTONS, background=BACKGROUND, method="patch")
    rng, bounds = np.random.default_rng(4), {f"wavefront.{term}": (-LARGEST, LARGEST) for term in TERMS}
    designs = []
    for _ in range(starts):
        coefficients = np.zeros(max(TERMS))
        coefficients[TERMS[0] - 1 :] = rng.uniform(-0.3, 0.3, len(TERMS))
        start = plain.replace(wavefront=tuple(coefficients.tolist()))
        designs.append(maximise(measure, start, bounds, steps=steps))
    design = max(designs, key=lambda design: design.figure)
    # A search that is cut short gains nothing.
    whole = 1.0 if steps >= 12 else None
    ratio = np.exp(measure.value(plain) - design.figure)
    yield figure("own figure, deviation after over before", ratio, at_most=whole)
    for which, distances, seed in (("points of the search", SEEN, 3), ("other points", UNSEEN, 5)):
        other = DepthInformation(
            setting.points(distances, seed), OTHER_PHOTONS, background=OTHER_BACKGROUND, method="full_field"
        )
        spreads = []
        for name, camera in (("before", plain), ("after", design.camera)):
            spreads.append(estimates(other, camera, draws))
            off = abs(np.mean((spreads[-1] / other.deviations(camera)) ** 2) - 1)
            yield figure(f"full fields, {which}, {name}: squared spread over bound, off 1", off, at_most=0.15)
        gain = np.exp(np.mean(np.log(spreads[1] / spreads[0])))
        limit = whole if distances is SEEN else None
        yield figure(f"full fields, {which}: spread of depths after over before", gain, at_most=limit)
    draw(output / "spreads.png", [list(measure.expected(camera)[0])[::4] for camera in (plain, design.camera)])


def estimates(measure: DepthInformation, camera: PlenopticCamera, draws: int) -> np.ndarray:
    """Return the standard deviations of depths, estimated by one step of scoring from captures with other noise."""
    rng, found = np.random.default_rng(6), []
    for image, *slopes in zip(*measure.expected(camera), strict=True):
        noise = np.maximum(image, 0) + OTHER_BACKGROUND
        rows = np.stack([*slopes, image]).reshape(4, -1) / np.sqrt(noise.ravel())
        solve = np.linalg.solve(rows @ rows.T, rows)[2] / np.sqrt(noise.ravel())
        found.append(float((rng.poisson(noise.ravel(), (draws, noise.size)) @ solve).std()))
    return np.array(found)


def draw(path: Path, rows: list[list[np.ndarray]]) -> None:
    """Write images side by side, each by its own peak."""
    write_png(
        path, np.vstack([np.hstack([np.maximum(image, 0) / image.max() for image in row]) for row in rows]) ** 0.5
    )
