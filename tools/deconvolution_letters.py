"""Deconvolve the letters at full size, and compare them with a thin lens and with ray reconstruction.

The scene `letters` is captured by waves; the planes of the '8' (210 mm) and the '#' (280 mm) are reconstructed at four
bins a lens, by rays and by deconvolution, and compared with 512 x 512 renders of Mitsuba's `thinlens` focused there.
The table has the PSNR over the part of the picture that is the letter's own, and the width of the edge from 10 to 90 %
of the white along the steepest side of the letter. Pictures are written beside it: rays, deconvolved, thin lens.
Exits with 1 if the deconvolved PSNR is not above that of rays, or the edge is wider than 0.7 of theirs.

    python tools/deconvolution_letters.py --output out [--letters 8] [--iterations 30]
"""

from __future__ import annotations

import time

import accuracy
import numpy as np

from mitsuba_plenoptic import load_scene, read_capture, reconstruct, render_capture, write_capture
from mitsuba_plenoptic.report.experiment import thin_lens_image
from mitsuba_plenoptic.report.output_files import write_png

DISTANCES = {"8": 210.0, "#": 280.0}
OVERSAMPLE = 4
EDGE = 0.7
COLUMNS = {
    "letter": "{letter}",
    "method": "{method}",
    "PSNR (dB)": "{psnr:.2f}",
    "edge, 10 to 90 % (bins)": "{edge:.2f}",
    "steps": "{iterations}",
    "left of the capture": "{residual}",
    "s": "{seconds:.0f}",
}


def region(reference: np.ndarray) -> tuple[slice, slice]:
    """Return the letter in focus: where the steepest edges of the reference lie, and a little around."""
    steep = np.hypot(*np.gradient(reference))
    rows, columns = np.nonzero(steep > 0.5 * steep.max())
    margin = 4 * OVERSAMPLE
    return tuple(
        slice(max(0, int(np.percentile(index, 1)) - margin), int(np.percentile(index, 99)) + margin)
        for index in (rows, columns)
    )  # type: ignore[return-value]


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the peak signal over the error, in decibels."""
    error = np.mean((image - reference) ** 2)
    return float(10 * np.log10(reference.max() ** 2 / error))


def edge_width(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the mean width of the edges across rows, from 10 to 90 %, where the reference has isolated steep ones."""
    widths = []
    reach = 3 * OVERSAMPLE
    for line, truth in zip(image, reference, strict=True):
        step = np.diff(truth)
        for place in np.flatnonzero(np.abs(step) > 0.3):
            part = slice(place - reach, place + reach + 1)
            if place < reach or place + reach + 1 > len(truth):
                continue
            low, high = truth[part][: reach - 2], truth[part][-(reach - 2) :]
            if np.ptp(low) > 0.1 or np.ptp(high) > 0.1:
                continue
            profile = line[part] if step[place] > 0 else line[part][::-1]
            first, last = profile[:4].mean(), profile[-4:].mean()
            if last - first < 0.3:
                continue
            rising = (profile - first) / (last - first)
            above = int(np.argmax(rising > 0.9))
            below = above - int(np.argmax(rising[above::-1] < 0.1))
            if below < above and rising[below] < 0.1:
                up = above - (rising[above] - 0.9) / max(rising[above] - rising[above - 1], 1e-6)
                down = below + (0.1 - rising[below]) / max(rising[below + 1] - rising[below], 1e-6)
                widths.append(up - down)
    return float(np.median(widths)) if widths else float("nan")


def main() -> int:
    """Capture, reconstruct, and write table and pictures."""
    parser = accuracy.options("deconvolution_letters", __doc__, reference_spp=256)
    parser.add_argument("--letters", nargs="*", choices=DISTANCES, default=list(DISTANCES))
    parser.add_argument("--iterations", type=int, default=30)
    given = accuracy.start(parser)
    scene, path = load_scene("letters"), given.output / "letters.exr"
    if not path.exists():
        write_capture(path, render_capture(scene, model="wave", method="signed_rays", spp=64))
    capture = read_capture(path)
    rows, failed = [], False
    for letter in given.letters:
        distance = DISTANCES[letter]
        reference = thin_lens_image(scene, capture.camera, distance, given.reference_spp, OVERSAMPLE)
        part, images = region(reference), {}
        for method, options in (("ray", {}), ("deconvolved", {"iterations": given.iterations})):
            start = time.time()
            made = reconstruct(capture, distance, method=method, oversample=OVERSAMPLE, **options)
            images[method] = made.image
            rows.append(
                {
                    "letter": letter,
                    "method": method,
                    "psnr": psnr(made.image[part], reference[part]),
                    "edge": edge_width(made.image[part], reference[part]),
                    "iterations": made.facts.get("iterations", "-"),
                    "residual": f"{made.facts['residual']:.0%}" if made.facts else "-",
                    "seconds": time.time() - start,
                }
            )
            print(accuracy.markdown(COLUMNS, rows[-1:]).splitlines()[-1], flush=True)
        ray, finer = rows[-2:]
        failed |= not (finer["psnr"] > ray["psnr"] and finer["edge"] <= EDGE * ray["edge"])
        peak = float(reference.max())
        shown = [np.nan_to_num(image)[part] for image in (images["ray"], images["deconvolved"], reference)]
        write_png(given.output / f"letter_{distance:g}.png", np.concatenate(shown, 1), peak=peak)
        whole = [np.nan_to_num(image) for image in (images["ray"], images["deconvolved"], reference)]
        write_png(given.output / f"plane_{distance:g}.png", np.concatenate(whole, 1), peak=peak)
    accuracy.finish(given, rows, accuracy.markdown(COLUMNS, rows))
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
