"""Reconstructions of captures by fast cameras: time and memory of each method, and what estimates said."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from mitsuba_plenoptic import (
    PlenopticCamera,
    estimate_reconstruction,
    read_capture,
    reconstruct,
    render_capture,
    write_capture,
)
from mitsuba_plenoptic.refocus import METHODS, planning
from mitsuba_plenoptic.refocus.deconvolution import response

from .. import Pivot, Row, at_most, case
from ..measures import relative
from ..timing import in_process, once, paired, peak_memory
from .lens_models import scene_of
from .speed_reconstructions import bare_transforms

DISTANCE = 285.0
"""Of the wall and of the images, in millimetres; the cameras focus on 320."""

WAVELENGTHS = (611.0, 549.0, 464.0)

FINER_FIELDS = (
    (planning, {
        "GUARD": 1.6, "_PIXEL_GUARD": 2.0, "_DIRECTION_SAMPLES": 6.0, "OBJECT_MARGIN": 12.0, "_MARGIN_ORDERS": 1.5,
        "_MARGIN_LENSES": 3.0,
    }),
)  # fmt: skip
FINER_SPREADS = ((response, {"_ACCURACY": 0.002}),)
FINER = {
    "coherent": FINER_FIELDS, "partial": FINER_FIELDS, "incoherent": FINER_SPREADS, "deconvolved": FINER_SPREADS,
}  # fmt: skip
"""Constants of the sampling rules with which results are compared."""

FAST = 5.6
"""Largest f-number of which the time over that of transforms has a limit; slower cameras take fractions of a second."""

LONG = 30.0
"""Seconds from which on an estimate must be right within a factor of 1.5."""


@case(
    "reconstruction.fast-cameras",
    "Ray captures in three colours by cameras of 100 x 100 lenses of 10 x 10 pixels, refocused by each method in a "
    "process of its own",
    {
        "camera": "{camera}", "method": "{method}", "elapsed s": "{seconds:.3g}", "estimated s": "{estimate:.3g}",
        "factor between them": "{off:.2f}", "estimate took s": "{took:.3g}", "GiB above start": "{memory:.2f}",
        "estimated GiB": "{estimated_memory:.2f}",
    },
    (at_most("off", "most_off"),),
    page="docs/theory/cost.md",
    pivot=Pivot("{method}", "{camera}", "{seconds:.3g} s, {memory:.1f} GiB"),
    quick={"f_numbers": (10.0,), "methods": ("ray", "coherent")},
)  # fmt: skip
def fast_cameras(
    output: Path, *, f_numbers: tuple[float, ...] = (2.8, 5.6, 10.0), methods: tuple[str, ...] = tuple(METHODS)
) -> Iterator[Row]:
    """Refocus a textured wall that fills the view."""
    for f_number in f_numbers:
        path = output / f"f{f_number:g}.exr"
        in_process(_capture, path, f_number)
        for method in methods:
            yield {"camera": f"f/{f_number:g}", "method": method, **in_process(_refocus, path, method)}


@case(
    "reconstruction.fast-sampling",
    "The same cameras in one colour, on one core: processor time of coherent reconstructions over "
    "that of their Fourier transforms alone, and what finer sampling changes (L2)",
    {"camera": "{camera}", "method": "{method}", "over transforms": "{ratio:.2f}", "change": "{change:.2%}"},
    (at_most("ratio", "most"), at_most("change", 0.01)),
    page="docs/theory/cost.md",
    quick={"f_numbers": (10.0,), "lenses": 8},
)
def fast_sampling(*, f_numbers: tuple[float, ...] = (2.8, 5.6, 10.0), lenses: int = 100) -> Iterator[Row]:
    """Patch the constants of the sampling rules for what is finer."""
    for f_number in f_numbers:
        yield from in_process(_sample, f_number, lenses, cores=1)


def _sample(f_number: float, lenses: int) -> list[Row]:
    camera = _camera(f_number, lenses)
    capture = render_capture(scene_of(camera, DISTANCE), model="ray", spp=16)
    rows = []
    for method, finer in FINER.items():
        options = {"wavelength": WAVELENGTHS[1]} | ({"iterations": 5} if method == "deconvolved" else {})
        work = functools.partial(reconstruct, capture, DISTANCE, method=method, **options)
        found = work().image
        with contextlib.ExitStack() as patched:
            for module, values in finer:
                patched.enter_context(mock.patch.multiple(module, **values))
            change = relative(found, work().image)
        rows.append(
            {
                "camera": f"f/{f_number:g}",
                "method": method,
                "ratio": None,
                "most": 1.5 if f_number <= FAST else None,
                "change": change,
            }
        )
        if finer is FINER_FIELDS:
            bare = bare_transforms(capture, DISTANCE, WAVELENGTHS[1], 2 if method == "partial" else 1)
            rows[-1]["ratio"] = paired({"transforms": bare, method: work}, 3)[method].processor_ratio
    return rows


def _camera(f_number: float, lenses: int) -> PlenopticCamera:
    return PlenopticCamera.matched(
        f_number=f_number, lenses=lenses, pixels_per_lens=10, pixel_size=0.005, focal_length=50, focus_distance=320
    )


def _capture(path: Path, f_number: float) -> None:
    camera = _camera(f_number, 100)
    capture = render_capture(scene_of(camera, DISTANCE), model="ray", spp=16)
    colours = capture.image[..., None] * np.array((1, 0.8, 0.6), np.float32)
    write_capture(path, dataclasses.replace(capture, image=colours))


def _refocus(path: Path, method: str) -> Row:
    capture = read_capture(path)
    options: dict[str, Any] = {"wavelength": WAVELENGTHS} if METHODS[method].waves else {}
    start = peak_memory()
    cost, took, _ = once(lambda: estimate_reconstruction(capture, DISTANCE, method=method, **options))
    _, seconds, _ = once(lambda: reconstruct(capture, DISTANCE, method=method, **options))
    return {
        "seconds": seconds, "estimate": cost.seconds, "off": max(seconds / cost.seconds, cost.seconds / seconds),
        "most_off": 1.5 if seconds > LONG else None, "took": took, "memory": peak_memory() - start,
        "estimated_memory": cost.memory / 2**30,
    }  # fmt: skip
