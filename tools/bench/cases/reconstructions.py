"""Reconstructions of built-in scenes against Mitsuba's own thin lens, and at the sizes of real cameras."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import Capture, load_scene, read_capture, reconstruct, render_capture, write_capture
from mitsuba_plenoptic.report.experiment import thin_lens_image
from mitsuba_plenoptic.report.images import write_png

from .. import Pivot, Row, at_least, at_most, case, pick
from ..measures import best_shift, scores, write_comparison
from ..timing import in_process, once, peak_memory

DISTANCES = (210.0, 240.0, 280.0)
SCENES = {"letters": DISTANCES, "still_life": (215.0, 240.0, 280.0)}
RAY_LIMITS: dict[tuple[str, str], dict[str, tuple[float, ...]]] = {
    ("letters", "point"): {"correlation": (0.998, 1.000, 0.991), "psnr_db": (39.0, 49.7, 32.1)},
    ("letters", "lens"): {"correlation": (0.998, 1.000, 0.998), "psnr_db": (39.0, 48.9, 38.7)},
    ("still_life", "point"): {"psnr_db": (44.4, 43.1, 32.8)},
    ("still_life", "lens"): {"psnr_db": (45.0, 42.5, 36.5)},
}
"""What the first version reached at the distances."""

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
WAVE_LIMITS = {
    "rays of ray capture": (0.998, 1.000, 0.998),
    "rays of wave capture": (0.994, 1.000, 0.993),
    "coherent of wave capture": (0.993, 0.999, 0.991),
    "K = 2 of wave capture": (0.994, 1.000, 0.993),
}
"""Least correlations at the distances."""

AGREEMENT = {
    "g (mm)": "{distance:g}", "PSNR (dB)": "{psnr_db:.1f}", "at least (dB)": "{least_psnr}",
    "correlation": "{correlation:.4f}", "at least": "{least_correlation}", "scale": "{scale:.3f}",
    "best shift": "{best_shift}",
}  # fmt: skip
AGREEMENT_LIMITS = (
    at_least("psnr_db", "least_psnr", digits=1),
    at_least("correlation", "least_correlation", digits=3),
)
SHOWN = "{psnr_db:.1f} dB, {correlation:.3f}"


@case(
    "reconstruction.rays",
    "Ray reconstructions of ray captures against Mitsuba's thin lens, one scale factor for a scene and a version",
    {"scene": "{scene}", "version": "{footprint}", **AGREEMENT},
    AGREEMENT_LIMITS,
    page="docs/theory/image_quality.md",
    pivot=Pivot("{footprint} version", "{scene}, {distance:g} mm", SHOWN),
    quick={"spp": 4, "reference_spp": 16, "scenes": ("letters",)},
)
def rays(output: Path, *, spp: int = 64, reference_spp: int = 4096, scenes: tuple[str, ...] = ()) -> Iterator[Row]:
    """Refocus each scene by both ray versions."""
    for name, distances in pick(SCENES, scenes).items():
        scene = load_scene(name)
        capture = render_capture(scene, spp=spp)
        references = [thin_lens_image(scene, capture.camera, g, reference_spp) for g in distances]
        for footprint in ("point", "lens"):
            images = [each.image.astype(np.float64) for each in reconstruct(capture, distances, footprint=footprint)]
            # They hold for the noise of as many samples.
            limits = RAY_LIMITS[name, footprint] if spp >= 64 and reference_spp >= 4096 else {}
            for index, row in enumerate(_agreement(images, references, distances)):
                least = {f"least_{key.removesuffix('_db')}": values[index] for key, values in limits.items()}
                yield {"scene": name, "footprint": footprint, **row, **least}
                file = output / f"{name}_{row['distance']:g}_{footprint}.png"
                write_comparison(file, row["scale"] * images[index], references[index])


def _agreement(images: list[np.ndarray], references: list[np.ndarray], distances: tuple[float, ...]) -> Iterator[Row]:
    _, found = scores(images, references)
    for distance, image, reference, row in zip(distances, images, references, found, strict=True):
        yield {"distance": distance, **row, "best_shift": best_shift(image, reference)}


@functools.cache
def letters_captures(wave: str, size: int) -> dict[str, Capture]:
    """Render the letters by both models; a wave capture may be named instead."""
    part = size / 4096
    scene = load_scene("letters", parameters={
        "resolution": str(size), "detector_width": str(8.192 * part), "letter_scale": str(part)
    })  # fmt: skip
    options = {"model": "wave", "method": "signed_rays", "spp": 64, "wavelength": 633.0}
    return {
        "ray": render_capture(scene, spp=64),
        "wave": read_capture(wave) if wave else render_capture(scene, **options),
    }


@case(
    "reconstruction.waves",
    "Reconstructions of the wave capture of the letters against Mitsuba's thin lens; the highest PSNR is that of any "
    "picture of the same correlation",
    {
        "method": "{method}", **AGREEMENT, "highest PSNR (dB)": "{highest:.1f}", "s, all distances": "{seconds:.1f}",
    },
    AGREEMENT_LIMITS,
    page="docs/theory/image_quality.md",
    pivot=Pivot("{method}", "{distance:g} mm", SHOWN),
    quick={"reference_spp": 16, "size": 1024},
)  # fmt: skip
def waves(output: Path, *, reference_spp: int = 4096, capture: str = "", size: int = 4096) -> Iterator[Row]:
    """Refocus the letters by every method; limits are those of the full size."""
    captures = letters_captures(capture, size)
    part = size / 4096
    scene = load_scene("letters", parameters={"letter_scale": str(part)})
    references = [thin_lens_image(scene, captures["wave"].camera, g, reference_spp) for g in DISTANCES]
    pictures = [np.concatenate(references, 1)]
    for name, (source, options) in METHODS.items():
        results, seconds, _ = once(lambda s=source, o=options: reconstruct(captures[s], list(DISTANCES), **o))
        images = [result.image.astype(np.float64) for result in results]
        limits = WAVE_LIMITS.get(name, (None,) * 3) if size == 4096 else (None,) * 3
        for row, reference, least in zip(_agreement(images, references, DISTANCES), references, limits, strict=True):
            # What a straight line fitted to the reference leaves.
            left = np.var(reference) * (1 - row["correlation"] ** 2)
            highest = float(10 * math.log10(reference.max() ** 2 / left))
            yield {"method": name, **row, "highest": highest, "seconds": seconds, "least_correlation": least}
        pictures.append(row["scale"] * np.concatenate(images, 1))
    sheet = np.repeat(np.repeat(np.concatenate(pictures, 0), 3, 0), 3, 1)
    write_png(output / "reconstructions.png", sheet, peak=max(float(each.max()) for each in references))


FULL_SIZE = {"coherent": {"method": "coherent"}, "auto": {"method": "partial", "interleave": "auto"}}


@case(
    "reconstruction.full-size",
    "Ray captures by cameras like the Lytro and the Raytrix R12, refocused in the wave model in a process each",
    {
        "camera": "{camera}", "bins": "{columns} x {rows}", "method": "{method}", "g (mm)": "{distance:g}",
        "CPU s": "{processor:.0f}", "GiB": "{memory:.2f}", "not reached": "{unreached:.1%}",
        "least, mean, most": "{least:.3f}, {mean:.3f}, {most:.3f}",
    },
    (at_most("memory", 8.0), at_most("unreached", 0.0)),
    page="docs/theory/cost.md",
    pivot=Pivot("{camera}, {columns} x {rows} bins, {method}", "{place}", "{processor:.0f} s, {memory:.1f} GiB"),
    quick={"cameras": ("lytro",), "methods": ("coherent",), "spp": 1},
)  # fmt: skip
def full_size(
    output: Path,
    *,
    cameras: tuple[str, ...] = ("lytro", "raytrix"),
    methods: tuple[str, ...] = (),
    spp: int = 4,
) -> Iterator[Row]:
    """Refocus to the camera's focus and to infinity."""
    for name in cameras:
        path = output / f"{name}.exr"
        write_capture(path, render_capture(load_scene(name), model="ray", spp=spp))
        focus = round(float(read_capture(path).camera.focus_distance), 3)
        for method in pick(FULL_SIZE, methods):
            for place, distance in (("at the focus", focus), ("at infinity", math.inf)):
                yield {"camera": name, "method": method, "place": place, **in_process(_refocus, path, method, distance)}


def _refocus(path: Path, method: str, distance: float) -> Row:
    capture = read_capture(path)
    result, _, processor = once(lambda: reconstruct(capture, distance, wavelength=550.0, **FULL_SIZE[method]))
    image, lit = result.image, np.nan_to_num(result.image)
    write_png(path.with_name(f"{path.stem}_{method}_{distance:g}.png"), lit, peak=float(np.percentile(lit, 99.5)))
    return {
        "columns": image.shape[1], "rows": image.shape[0], "distance": distance, "processor": processor,
        "memory": peak_memory(), "unreached": float(np.isnan(image).mean()), "least": float(np.nanmin(image)),
        "mean": float(np.nanmean(image)), "most": float(np.nanmax(image)),
    }  # fmt: skip
