"""The wave capture's energy and noise: the table quoted in the README.

Energy against the ray capture of the same scene, sampling noise inside the refocused letters, and what more light
paths per radiator bring and cost in the still life.

    python tools/wave_capture_accuracy.py --output out/wave_capture_accuracy
"""

from __future__ import annotations

import time
from pathlib import Path

import accuracy
import numpy as np
import scipy.ndimage

from mitsuba_plenoptic import load_scene, read_capture, reconstruct, render_capture, write_capture

# A window of 32 x 32 lenses with the paper's pixels.
CROP = {"resolution": "1024", "detector_width": "2.048"}
DISTANCES = (210.0, 240.0, 280.0)
COLUMNS = {"what": "{what}", "value": "{value:.4g}", "limit": "{limit}", "s": "{seconds}"}


def energy(name: str, parameters: dict[str, str], keep: Path | None = None) -> accuracy.Row:
    """Sum of the wave capture over that of the ray capture."""
    scene = load_scene(name, parameters=parameters)
    by_rays = render_capture(scene, spp=64)
    seconds = None
    if keep and keep.is_file():
        by_waves = read_capture(keep)
    else:
        start = time.perf_counter()
        by_waves = render_capture(scene, model="wave")
        seconds = time.perf_counter() - start
        if keep:
            write_capture(keep, by_waves)
    ratio = by_waves.image.sum(dtype=np.float64) / by_rays.image.sum(dtype=np.float64)
    where = f"{parameters['resolution']} x {parameters['resolution']}" if parameters else "4096 x 4096"
    return {"what": f"energy, wave / ray, {name}, {where}", "value": ratio, "limit": "1 +- 0.02", "seconds": seconds}


def letter_noise(capture_path: Path) -> list[accuracy.Row]:
    """Compare refocused letters with those of four times as many radiators, where the image is smooth."""
    capture = read_capture(capture_path)
    finer = render_capture(load_scene("letters"), model="wave", radiators_per_lens=16)
    rows = []
    for coarse, fine in zip(reconstruct(capture, DISTANCES), reconstruct(finer, DISTANCES), strict=True):
        low, high = scipy.ndimage.minimum_filter(fine.image, 3), scipy.ndimage.maximum_filter(fine.image, 3)
        inside = (low > 0.3 * fine.image.max()) & (high < 1.1 * low)
        noise = float((coarse.image - fine.image)[inside].std() / fine.image[inside].mean())
        what = f"noise inside the letters at {coarse.distance:g} mm ({inside.sum()} bins), %"
        rows.append({"what": what, "value": 100 * noise, "limit": "1"})
    return rows


def path_noise(parameters: dict[str, str]) -> list[accuracy.Row]:
    """Compare the still life's noise and time with 4 and with 16 light paths for each of 4 x 4 radiators a lens."""
    scene = load_scene("still_life", parameters=parameters)
    noise, seconds = [], []
    for spp in (4, 16):
        pair = []
        for seed in (1, 2):
            start = time.perf_counter()
            capture = render_capture(scene, model="wave", spp=spp, seed=seed, radiators_per_lens=4)
            pair.append(reconstruct(capture, 240.0).image)
            seconds.append(time.perf_counter() - start)
        noise.append(float((pair[0] - pair[1])[2:-2, 2:-2].std() / np.sqrt(2) / np.mean(pair)))
    longer = sum(seconds[2:]) / sum(seconds[:2])
    return [
        {"what": "still life, noise with 16 paths over that with 4", "value": noise[1] / noise[0], "limit": "0.5"},
        {"what": "still life, time with 16 paths over that with 4", "value": longer, "limit": "1.1"},
    ]


def main() -> None:
    """Run all and write the table as Markdown and JSON; the letters' captures are kept and used again."""
    arguments = accuracy.start(accuracy.options("wave_capture_accuracy", __doc__))
    letters = arguments.output / "letters_wave.exr"
    rows = [
        energy("letters", {}, keep=letters),
        *(energy(name, CROP) for name in ("letters", "white", "still_life")),
        *letter_noise(letters),
        *path_noise({"resolution": "512", "detector_width": "1.024"}),
    ]
    shown = [{**row, "seconds": f"{row['seconds']:.1f}" if row.get("seconds") else ""} for row in rows]
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, shown))


if __name__ == "__main__":
    main()
