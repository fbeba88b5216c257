"""Wave reconstructions of the letters: against Mitsuba's thin lens, and against the limit without interference.

Takes a ray and a wave capture of the letters (renders those that are not given), refocuses them by all methods, and
writes two tables and a picture.

Agreement: correlation and PSNR with a `thinlens` render of one pixel a bin, one scale factor per method. Beside the
PSNR stands the highest that any picture of that correlation can have, with a scale and an offset of its own:
-10 log10(v (1 - c^2)), v the reference's variance over its squared peak. Each correlation that has a limit must reach
it, to three decimals; exits with 1 if one does not.

Interference: RMS distance from the image in which every lens is propagated alone, over the mean, in the letters out of
focus; that limit is made with full fields at a period at which no two lenses of a subset overlap. Left out where
`--periods` names none.

    python tools/wave_reconstruction_accuracy.py --output out [--capture wave.exr] [--ray-capture ray.exr]
        [--periods]
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from typing import Any

import accuracy
import numpy as np

from mitsuba_plenoptic import Capture, load_scene, read_capture, reconstruct, render_capture
from mitsuba_plenoptic.report.experiment import agreement, best_shift, thin_lens_image
from mitsuba_plenoptic.report.output_files import write_png

DISTANCES = (210.0, 240.0, 280.0)
LETTERS = {"8": (210.0, 3.2), "F": (240.0, 0.0), "#": (280.0, -3.2)}  # distance, and x at 240 mm
FOCUS = 240.0
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "point rays of ray capture": ("ray", {"method": "ray", "footprint": "point"}),
    "rays of ray capture": ("ray", {"method": "ray"}),
    "point rays of wave capture": ("wave", {"method": "ray", "footprint": "point"}),
    "rays of wave capture": ("wave", {"method": "ray"}),
    "coherent of wave capture": ("wave", {"method": "coherent"}),
    "K = 2 of wave capture": ("wave", {"method": "partial", "interleave": 2}),
    "auto of wave capture": ("wave", {"method": "partial", "interleave": "auto"}),
    "K = 2 without relay": ("wave", {"method": "partial", "interleave": 2, "relay": False}),
}
LIMITS = {
    "rays of ray capture": (0.998, 1.000, 0.998),
    "rays of wave capture": (0.994, 1.000, 0.993),
    "coherent of wave capture": (0.993, 0.999, 0.991),
    "K = 2 of wave capture": (0.994, 1.000, 0.993),
}
"""Least correlations at the distances, to three decimals."""

COLUMNS = {
    "method": "{method}",
    "g (mm)": "{distance:g}",
    "PSNR (dB)": "{psnr_db:.1f}",
    "limit (dB)": "{psnr_limit_db:.1f}",
    "correlation": "{correlation:.4f}",
    "scale": "{scale:.3f}",
    "best shift": "{best_shift}",
    "s, all distances": "{seconds_for_all_distances:.1f}",
    "correlation at least": "{limit}",
    "verdict": "{verdict}",
}


def main() -> int:
    """Refocus, compare, and write tables and picture; 1 if a correlation is below its limit."""
    parser = accuracy.options("wave_reconstruction_accuracy", __doc__, reference_spp=4096)
    parser.add_argument("--capture", type=Path, help="a wave capture of the letters")
    parser.add_argument("--ray-capture", type=Path, help="a ray capture of the letters")
    parser.add_argument("--periods", type=int, nargs="*", default=[1, 2, 4, 8])
    parser.add_argument("--limit-period", type=int, default=16, help="at which no two lenses of a subset overlap")
    arguments = accuracy.start(parser)

    scene = load_scene("letters")
    ray, wave = arguments.ray_capture, arguments.capture
    captures = {
        "ray": read_capture(ray) if ray else render_capture(scene, spp=64),
        "wave": read_capture(wave)
        if wave
        else render_capture(scene, model="wave", method="signed_rays", spp=64, wavelength=633.0),
    }
    references = [thin_lens_image(scene, captures["wave"].camera, g, arguments.reference_spp) for g in DISTANCES]
    table = _agreement(captures, references, arguments.output)
    results, texts = {"agreement": table}, [accuracy.markdown(COLUMNS, table)]
    if arguments.periods:
        interference = _interference(captures["wave"], arguments.periods, arguments.limit_period)
        percent = {"K": "{interleave}", **{place: f"{{{place}:.2f}}" for place in list(interference[0])[1:]}}
        limit = f"the limit without interference (full fields, K = {arguments.limit_period})"
        results["interference"] = interference
        texts += [f"RMS distance from {limit} over the mean, in %:\n", accuracy.markdown(percent, interference)]
    accuracy.finish(arguments, results, *texts)
    return int(any(row["verdict"] == "BROKEN" for row in table))


def _agreement(captures: dict[str, Capture], references: list[np.ndarray], output: Path) -> list[accuracy.Row]:
    rows, pictures = [], [np.concatenate(references, 1)]
    for name, (source, options) in METHODS.items():
        start = time.perf_counter()
        results = reconstruct(captures[source], list(DISTANCES), **options)
        seconds = time.perf_counter() - start
        images = [result.image.astype(np.float64) for result in results]
        scale, scores = agreement(images, references)
        limits = LIMITS.get(name, (None,) * len(DISTANCES))
        for g, image, reference, (psnr, correlation), limit in zip(
            DISTANCES, images, references, scores, limits, strict=True
        ):
            rows.append(
                {
                    "method": name,
                    "distance": g,
                    "psnr_db": round(psnr, 2),
                    "psnr_limit_db": round(_psnr_limit(correlation, reference), 2),
                    "correlation": round(correlation, 5),
                    "scale": round(scale, 4),
                    "best_shift": best_shift(image, reference),
                    "seconds_for_all_distances": round(seconds, 2),
                    "limit": "" if limit is None else f"{limit:.3f}",
                    "verdict": "" if limit is None else "kept" if round(correlation, 3) >= limit else "BROKEN",
                }
            )
        pictures.append(scale * np.concatenate(images, 1))
    sheet = np.repeat(np.repeat(np.concatenate(pictures, 0), 3, 0), 3, 1)
    write_png(output / "wave_reconstructions.png", sheet, peak=max(float(r.max()) for r in references))
    return rows


def _psnr_limit(correlation: float, reference: np.ndarray) -> float:
    """Highest PSNR of any picture of this correlation: what a line fitted to the reference leaves."""
    left = np.var(reference) * (1 - correlation**2)
    return float(10 * math.log10(reference.max() ** 2 / left))


def _interference(capture: Capture, periods: list[int], limit_period: int) -> list[accuracy.Row]:
    def images(interleave: int | str) -> list[np.ndarray]:
        results = reconstruct(capture, list(DISTANCES), method="partial", interleave=interleave)
        return [result.image.astype(np.float64) for result in results]

    limits = images(limit_period)
    rows = []
    for interleave in (*periods, "auto"):
        row: accuracy.Row = {"interleave": interleave}
        for g, image, limit in zip(DISTANCES, images(interleave), limits, strict=True):
            for letter, (own, _) in LETTERS.items():
                if own != g:
                    row[f"{letter} at {g:g}"] = _distance(image, limit, _letter_bins(capture, limit, letter))
        rows.append(row)
    return rows


def _letter_bins(capture: Capture, limit: np.ndarray, letter: str) -> np.ndarray:
    """Bins in a letter's third of the picture that are lit by a fifth of the maximum or more."""
    camera = capture.camera
    centre = LETTERS[letter][1] / FOCUS * camera.mla_distance / camera.mla_pitch
    third = LETTERS["8"][1] / FOCUS * camera.mla_distance / camera.mla_pitch
    # +x is left.
    columns = camera.bin_count[0] / 2 - (np.arange(camera.bin_count[0]) + 0.5) - centre
    return (np.abs(columns) < third / 2) & (limit > 0.2 * limit.max())


def _distance(image: np.ndarray, limit: np.ndarray, bins: np.ndarray) -> float:
    return float(100 * math.sqrt(np.mean((image - limit)[bins] ** 2)) / limit[bins].mean())


if __name__ == "__main__":
    sys.exit(main())
