"""Design cameras by their own figures, and judge the designs by what the search did not see.

    python tools/design_accuracy.py focal_length [--starts 10]
    python tools/design_accuracy.py wavefront [--starts 3]

``focal_length``: from random starts the microlens focal length is sought by which points between 220 and 260 mm are
refocused with most contrast; each end must lie within 0.5 % of the best of a scan. ``wavefront``: aberrations of the
main lens, tilt and defocus left out, are sought by which captures tell most of the depth of points between 232 and
248 mm. The design must beat the camera that it starts from by its own figure; and with full fields and another count of
photons, in the spread of depths estimated from captures with Poisson's noise, where both must keep to their bounds. For
points that the search did not see the same ratio is told without a limit.

``--half`` takes the main lens at half its size and distances, which costs a fourth. Writes ``design_accuracy_*.md``,
``.json`` and pictures of the spreads before (above) and after (below) to the folder that ``--output`` names; exits
with 1 where a line is not kept.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import accuracy
import numpy as np
from verdict import Verdict

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.optimisation import DepthInformation, Design, RefocusedContrast, maximise
from mitsuba_plenoptic.report.output_files import write_png

WITHIN = 0.005
"""Distance of the ends from the best of the scan."""

SCAN = np.linspace(0.42, 0.66, 25)
"""Microlens focal lengths, in millimetres."""

FREQUENCIES = (0.3, 0.6, 0.9)
PHOTONS, BACKGROUND = 10000.0, 1.0
OTHER_PHOTONS, OTHER_BACKGROUND = 4000.0, 4.0
DRAWS = 300
SEEN = (232.0, 234.0, 236.0, 238.0, 240.0, 242.0, 244.0, 246.0, 248.0)
UNSEEN = (233.0, 235.0, 237.0, 239.0, 241.0, 243.0, 245.0, 247.0)
"""Distances of points by which wavefronts are sought and judged, in millimetres: many, for the figure is of all.

They lie about the plane in focus, where a camera without aberrations tells depth worst.
"""
TERMS = range(5, 12)
"""Aberrations that vary, by Noll's numbers: astigmatism to spherical."""

STEPS = 12
"""Of each search of a wavefront."""

LARGEST = 1.0
"""Waves of each, at most."""


@dataclass(frozen=True)
class Case:
    """A camera, and the points before it."""

    camera: PlenopticCamera
    scale: float

    @classmethod
    def of(cls, half: bool) -> Case:
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


def focal_length(case: Case, starts: int, output: Path) -> tuple[dict, bool]:
    """Seek the microlens focal length from random starts, and scan it."""
    figure = RefocusedContrast(case.camera, case.points((220.0, 230.0, 250.0, 260.0), 1), FREQUENCIES)
    verdict, bounds = Verdict(), {"mla_focal_length": (float(SCAN[0]), float(SCAN[-1]))}
    scan = [figure.value(case.camera.replace(mla_focal_length=f)) for f in SCAN.tolist()]
    best = int(np.argmax(scan))
    # The scan is refined about its best, by as many steps again as one of its own has tenths.
    fine = np.linspace(SCAN[max(best - 1, 0)], SCAN[min(best + 1, len(SCAN) - 1)], 21)
    finer = [figure.value(case.camera.replace(mla_focal_length=f)) for f in fine.tolist()]
    found = float(fine[int(np.argmax(finer))])
    print(f"scan: best {found:.5f} mm, contrast {max(finer):.5f}", flush=True)
    rows = []
    for start in np.random.default_rng(2).uniform(SCAN[0], SCAN[-1], starts).tolist():
        design = maximise(figure, case.camera.replace(mla_focal_length=start), bounds)
        end = design.values["mla_focal_length"]
        rows.append({"start": start, "end": end, "figure": design.figure, "cameras": design.tried})
        verdict.judge(f"from {start:.4f} mm, off the scan's best", abs(end / found - 1), WITHIN)
    pictures = [figure.refocused(case.camera.replace(mla_focal_length=f)) for f in (float(SCAN[0]), found)]
    _draw(output / "design_accuracy_focal_length.png", pictures)
    scanned = dict(zip(map(str, SCAN.round(5).tolist()), map(float, scan), strict=True))
    return {"scan": scanned, "best": found, "searches": rows}, verdict.kept


def wavefront(case: Case, starts: int, output: Path) -> tuple[dict, bool]:
    """Seek aberrations by which depth is told best, and judge them otherwise."""
    plain = case.camera.replace(wavefront=(0.0,) * max(TERMS))
    figure = _figure(case.points(SEEN, 3), PHOTONS, BACKGROUND, "patch")
    rng, bounds = np.random.default_rng(4), {f"wavefront.{term}": (-LARGEST, LARGEST) for term in TERMS}
    designs: list[Design] = []
    # No aberration at all is where the slopes vanish by symmetry: starts lie beside it.
    for number in range(starts):
        coefficients = np.zeros(max(TERMS))
        coefficients[TERMS[0] - 1 :] = rng.uniform(-0.3, 0.3, len(TERMS))
        start = plain.replace(wavefront=tuple(coefficients.tolist()))
        designs.append(
            maximise(
                figure, start, bounds, steps=STEPS, progress=lambda n, f, best, k=number: print(k, n, f, flush=True)
            )
        )
    design = max(designs, key=lambda design: design.figure)
    verdict, results = Verdict(), {"values": design.values, "figures": [one.figure for one in designs]}
    before = figure.value(plain)
    results["own figure"] = {"before": before, "after": design.figure}
    verdict.judge("own figure, deviation after over before", float(np.exp(before - design.figure)), 1.0)

    results |= judged_by_full_fields(case, plain, design.camera, verdict)
    pictures = [list(figure.expected(camera)[0])[::4] for camera in (plain, design.camera)]
    _draw(output / "design_accuracy_wavefront.png", pictures)
    return results, verdict.kept


def judged_by_full_fields(case: Case, plain: PlenopticCamera, design: PlenopticCamera, verdict: Verdict) -> dict:
    """Estimate depths from captures with noise, of the points that the search saw and, without a limit, of others."""
    results: dict = {}
    for which, distances, seed in (("the points of the search", SEEN, 3), ("other points", UNSEEN, 5)):
        other = _figure(case.points(distances, seed), OTHER_PHOTONS, OTHER_BACKGROUND, "full_field")
        spreads = {}
        results[which] = {}
        for name, camera in (("before", plain), ("after", design)):
            bounds, spreads[name] = other.deviations(camera), _estimates(other, camera)
            ratio = spreads[name] / bounds
            results[which][name] = {"bounds": bounds.tolist(), "spreads": spreads[name].tolist()}
            print(f"{which}, {name}: bounds {bounds} mm, spreads over them {ratio}", flush=True)
            off = float(np.abs(np.mean(ratio**2) - 1))
            verdict.judge(f"full fields, {which}, {name}: squared spread over bound, off 1", off, 0.15)
        gain = float(np.exp(np.mean(np.log(spreads["after"] / spreads["before"]))))
        results[which]["after over before"] = gain
        if distances is SEEN:
            verdict.judge(f"full fields, other noise, {which}: spread of depths after over before", gain, 1.0)
        else:
            print(f"full fields, other noise, {which}: spread of depths after over before {gain:.3f}", flush=True)
    return results


def _figure(points: np.ndarray, photons: float, background: float, method: str) -> DepthInformation:
    return DepthInformation(points, photons, background=background, method=method)


def _estimates(figure: DepthInformation, camera: PlenopticCamera) -> np.ndarray:
    """Return the standard deviations of depths, estimated by one step of scoring from captures with other noise."""
    rng, found = np.random.default_rng(6), []
    for image, *slopes in zip(*figure.expected(camera), strict=True):
        noise = np.maximum(image, 0) + OTHER_BACKGROUND
        rows = np.stack([*slopes, image]).reshape(4, -1) / np.sqrt(noise.ravel())
        solve = np.linalg.solve(rows @ rows.T, rows)[2] / np.sqrt(noise.ravel())
        seen = rng.poisson(noise.ravel(), (DRAWS, noise.size))
        found.append(float((seen @ solve).std()))
    return np.array(found)


def _draw(path: Path, rows: list[list[np.ndarray]]) -> None:
    """Write images side by side, each by its own peak."""
    write_png(
        path, np.vstack([np.hstack([np.maximum(image, 0) / image.max() for image in row]) for row in rows]) ** 0.5
    )


def main() -> None:
    """Do what is asked."""
    parser = accuracy.options("design_accuracy", __doc__)
    parser.add_argument("what", choices=("focal_length", "wavefront"))
    parser.add_argument("--starts", type=int, default=10, help="random starts")
    parser.add_argument("--half", action="store_true", help="half the main lens at half the distances")
    arguments = accuracy.start(parser)
    arguments.tool += f"_{arguments.what}"
    case = Case.of(arguments.half)
    if arguments.what == "focal_length":
        results, kept = focal_length(case, arguments.starts, arguments.output)
    else:
        results, kept = wavefront(case, arguments.starts, arguments.output)
    accuracy.finish(arguments, results, f"# Design: {arguments.what}\n", f"```\n{json.dumps(results, indent=1)}\n```\n")
    sys.exit(0 if kept else 1)


if __name__ == "__main__":
    main()
