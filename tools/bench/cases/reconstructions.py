"""Reconstructions of built-in scenes against Mitsuba's own thin lens.

White walls and ramps, refocused at their own distance by every method: every bin that is reached, to the border.

A wall of radiance 1 and one whose radiance rises from 0.5 to 1.5 across the field stand at a distance, or are the sky.
Ray captures are refocused by rays without a white reference, all others with that of another white wall, at 400 mm, so
that white walls are judged, too. The worst bin is compared with the known radiance. Bins that are NaN are not reached.

Where the worst bin of a wave capture is beyond its limit, the image is compared with what the diffraction of the
microlenses leaves of the wall (`diffraction`): rows within the limit of that are explained by "diffraction".

Where a coherent or partially coherent image is still beyond it, its difference from the image in which no two lenses
interfere (`auto`) is judged. That difference must have no mean where bins are weighted by their white, since
interference moves power between bins and makes none; its RMS must be at most half as much again as predicted for lenses
of random phases (a field of few fringes scatters by that much); and the image without it must be within the limit.
Such rows are explained by "interference". All others beyond their limit fail.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cases
import numpy as np
from skimage.registration import phase_cross_correlation

from mitsuba_plenoptic import (
    Capture,
    PlenopticCamera,
    load_scene,
    read_capture,
    reconstruct,
    render_capture,
    with_camera,
)
from mitsuba_plenoptic.refocus.straight import straightened
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.report.photographs import thin_lens_image

from .. import Pivot, Row, at_least, at_most, case, pick
from ..measures import scores, write_comparison
from ..scenes.wall_diffraction import expected, interference_shift
from ..timing import once

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
AGREEMENT_LIMITS = (at_least("psnr_db", "least_psnr", digits=1), at_least("correlation", "least_correlation", digits=3))
SHOWN = "{psnr_db:.1f} dB, {correlation:.3f}"


@case(
    "reconstruction.rays",
    "Ray reconstructions of ray captures against Mitsuba's thin lens, one scale factor for a scene and a version",
    {"scene": "{scene}", "version": "{footprint}", **AGREEMENT},
    AGREEMENT_LIMITS,
    page="docs/theory/accuracy.md",
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
        shift = phase_cross_correlation(image, reference, normalization=None)[0]
        yield {"distance": distance, **row, "best_shift": tuple(map(int, shift))}


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
    page="docs/theory/accuracy.md",
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


WARP = (0.5, -0.4, 0.3, 0.5, -0.35, 0.25, 0.2, -0.3, 0.5, 0.4, -0.3, 0.5, 0.2, -0.35)
"""Coefficients of a warp over positions from -1 to 1, which the corners are displaced by 1.3 at most."""

DISPLACED: dict[str, dict[str, Any]] = {
    "straight": {},
    "warp of 0.6 pixels": {"warp": 0.6},
    "warp of 3 pixels": {"warp": 3.0},
    "displaced by 1 um RMS": {"mla_jitter": (0.001, 0.0)},
    "chief rays of 0.8 degrees": {"mla_cra": (0.0, 0.0, 1.5, 0.8)},
    "tilt of 0.3 degrees": {"mla_tilt": (0.25, -0.17)},
    "tilt of 1.2 degrees": {"mla_tilt": (1.0, -0.7)},
    "tilt of 2.4 degrees": {"mla_tilt": (2.0, -1.4)},
}
"""Arrays of 32 x 32 lenses of the paper's camera."""

DISPLACED_METHODS = {
    "ray": {"method": "ray"},
    "coherent": {"method": "coherent"},
    "K = 2": {"method": "partial", "interleave": 2},
    "auto": {"method": "partial", "interleave": "auto"},
    "incoherent": {"method": "incoherent"},
    "deconvolved": {"method": "deconvolved"},
}


@case(
    "reconstruction.displaced",
    "Wave captures of the letters behind displaced or tilted lenses: correlation with Mitsuba's thin lens, and how "
    "far it is below that of the straight camera, at most",
    {
        "array": "{array}", "method": "{method}", "correlation": "{near:.4f}, {middle:.4f}, {far:.4f}",
        "loss": "{loss:.4f}", "as if straight": "{ignored:.4f}",
    },
    (at_most("loss", 0.002),),
    page="docs/theory/reconstruction.md",
    pivot=Pivot("{array}", "{method}", "{loss:.4f} ({ignored:.4f})"),
    quick={"spp": 4, "reference_spp": 16, "arrays": ("straight", "warp of 0.6 pixels"), "methods": ("coherent",)},
)  # fmt: skip
def displaced(
    *, spp: int = 64, reference_spp: int = 4096, arrays: tuple[str, ...] = (), methods: tuple[str, ...] = ()
) -> Iterator[Row]:
    """Refocus with the camera that took the capture, and with the straight one."""
    scene, size = load_scene("letters"), 32
    straight = PlenopticCamera(resolution=(32 * size, 32 * size), detector_width=0.064 * size)
    best: dict[str, list[float]] = {}
    inner = np.s_[1:-1, 1:-1]

    @functools.cache
    def reference(camera: PlenopticCamera, distance: float) -> np.ndarray:
        return thin_lens_image(scene, camera, distance, reference_spp)

    for array, given in pick(DISPLACED, arrays).items():
        changes = dict(given)
        if "warp" in changes:
            half = straight.detector_width / 2
            scale = changes.pop("warp") * straight.pixel_size / 1.3 / np.array([*3 * [half**2], *4 * [half**3]] * 2)
            changes["mla_warp"] = tuple((np.array(WARP) * scale).tolist())
        camera = straight.replace(**changes)
        taken = render_capture(with_camera(scene, camera), model="wave", wavelength=633.0, spp=spp)
        for name, options in pick(DISPLACED_METHODS, methods).items():
            found = []
            for known in (camera, straight):
                images = reconstruct(taken, list(DISTANCES), camera=known, **options)
                # The nearest regular array of lenses aligned to chief rays has bins of its own.
                pairs = [(made.image, reference(straightened(known), made.distance)) for made in images]
                found.append([float(np.corrcoef(a[inner].ravel(), b[inner].ravel())[0, 1]) for a, b in pairs])
            best.setdefault(name, found[0])
            losses = [max(b - c for b, c in zip(best[name], each, strict=True)) for each in found]
            near, middle, far = found[0]
            yield {
                "array": array, "method": name, "near": near, "middle": middle, "far": far,
                "loss": losses[0], "ignored": losses[1],
            }  # fmt: skip


LIMITS = {"ray": 0.02, "wave": 0.03}
LATTICES: dict[str, dict[str, Any]] = {"square": {}, "hexagonal": {"mla_lattice": "hexagonal"}}

WALL_METHODS: dict[str, dict[str, Any]] = {
    "ray": {"method": "ray"},
    "coherent": {"method": "coherent"},
    "K = 2": {"method": "partial", "interleave": 2},
    "auto": {"method": "partial", "interleave": "auto"},
}

INTERFERING = ("coherent", "K = 2")

FREE_OF_MEAN = 0.1
"""Mean over RMS that the difference by interference may have."""

PREDICTED = 1.5
"""RMS of that difference over the predicted one."""

REFERENCE = 400.0
"""Distance of the wall by whose capture the others are divided: none of theirs."""


@case(
    "walls",
    "White walls and ramps that fill the view, refocused by every method: the worst bin against the known radiance",
    {
        "lattice": "{lattice}", "lenses": "{lenses}", "g (mm)": "{distance:g}", "capture": "{model}",
        "method": "{method}", "wall": "{wall}", "worst bin": "{worst:.4f}", "limit": "{limit:g}",
        "explained by": "{explained}", "not reached": "{unreached:.1%}", "s": "{seconds:.1f}",
        "from what diffraction leaves": "{diffraction:.4f}", "contrast of white": "{contrast:.2f}",
        "RMS of interference": "{rms:.4f}", "predicted": "{predicted:.4f}", "mean": "{mean:.4f}",
        "worst bin without": "{without:.4f}",
    },
    (at_most("unexplained", "limit"),),
    page="docs/theory/accuracy.md",
    pivot=Pivot("{lenses} lenses, {model} capture, {lattice}, {wall}, {method}", "{distance:g} mm", "{worst:.3f}"),
    quick={"lenses": (12,), "lattices": ("square",), "distances": (210.0,), "methods": ("ray", "coherent")},
)  # fmt: skip
def compare(
    *,
    lenses: tuple[int, ...] = (24, 128),
    pixels: int = 32,
    distances: tuple[float, ...] = (150.0, 210.0, 280.0, 1000.0, math.inf),
    lattices: tuple[str, ...] = (),
    models: tuple[str, ...] = tuple(LIMITS),
    methods: tuple[str, ...] = (),
    spp: int = 16,
) -> Iterator[Row]:
    """Capture and refocus all combinations."""
    for count, lattice, model in itertools.product(lenses, pick(LATTICES, lattices), models):
        camera = PlenopticCamera(detector_width=0.064 * count, resolution=(pixels * count,) * 2, **LATTICES[lattice])
        reference = cases.wall_capture(camera, REFERENCE, "white", model, spp)
        for distance in distances:
            pair = Walls(camera, distance, model, spp, reference)
            for method in pick(WALL_METHODS, methods):
                yield from ({"lattice": lattice, "lenses": count, **row} for row in pair.compare(method))


class Walls:
    """The captures of both walls by one camera, and what reconstructions make of them."""

    def __init__(self, camera: PlenopticCamera, distance: float, model: str, spp: int, reference: Capture) -> None:
        self._camera, self._distance, self._model, self._reference = camera, distance, model, reference
        self._free: dict[str, np.ndarray] = {}
        self._captures = {wall: cases.wall_capture(camera, distance, wall, model, spp) for wall in cases.WALLS}

    def compare(self, method: str) -> Iterator[Row]:
        """Refocus the captures by one method, and find the worst bin of each."""
        white = self._reference if method != "ray" or self._model == "wave" else None
        for wall, taken in self._captures.items():
            image, _, seconds = once(lambda taken=taken: self._refocus(taken, method, white))
            worst, limit = self._worst(image, wall), LIMITS[self._model]
            yield {
                "distance": self._distance,
                "model": self._model,
                "method": method + (", white reference" if white else ""),
                "wall": wall,
                "worst": worst,
                "limit": limit,
                "unreached": float(np.isnan(image).mean()),
                "seconds": seconds,
                "unexplained": worst,
                **(self._explanation(image, wall, method, limit) if worst > limit else {}),
            }

    def _explanation(self, image: np.ndarray, wall: str, method: str, limit: float) -> Row:
        """Look for diffraction and interference in an image beyond its limit."""
        found: dict[str, Any] = {}
        if self._model == "wave":
            found["diffraction"] = self._from_expected(image, wall)
            if found["diffraction"] <= limit:
                return found | {"explained": "diffraction", "unexplained": found["diffraction"]}
        if method not in INTERFERING:
            return found
        bright = self._refocus(self._reference, method, None)
        free = self._without_interference(wall)
        difference = image - free
        found["contrast"] = float(np.nanstd(bright) / np.nanmean(bright))
        found["rms"], found["mean"] = _mean(difference**2, bright) ** 0.5, _mean(difference, bright)
        shift = interference_shift(self._camera, self._distance, cases.WALL_WAVELENGTH, self._model)
        found["predicted"] = found["contrast"] * shift * cases.SLOPE
        found["without"] = self._worst(free, wall)
        if self._model == "wave":
            found["without"] = min(found["without"], self._from_expected(free, wall))
        predicted = found["rms"] <= PREDICTED * found["predicted"]
        if predicted and abs(found["mean"]) <= FREE_OF_MEAN * found["rms"]:
            found |= {"explained": "interference", "unexplained": found["without"]}
        return found

    def _without_interference(self, wall: str) -> np.ndarray:
        if wall not in self._free:
            self._free[wall] = self._refocus(self._captures[wall], "auto", self._reference)
        return self._free[wall]

    def _refocus(self, taken: Capture, method: str, white: Capture | None) -> np.ndarray:
        wavelength = None if method == "ray" else cases.WALL_WAVELENGTH
        options = WALL_METHODS[method]
        image = reconstruct(taken, self._distance, wavelength=wavelength, white=white, **options).image
        return image.astype(np.float64)

    def _from_expected(self, image: np.ndarray, wall: str) -> float:
        known = expected(self._camera, self._distance, cases.WALL_WAVELENGTH, wall)
        return float(np.nanmax(np.abs(image - known)))

    def _worst(self, image: np.ndarray, wall: str) -> float:
        return float(np.nanmax(np.abs(image - cases.known_radiance(self._camera, wall))))


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    return float(np.nansum(values * weights) / np.nansum(weights))
