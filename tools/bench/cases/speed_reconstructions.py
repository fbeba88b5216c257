"""Reconstructions of captures by fast cameras: time and memory of each method, what estimates said, and their price.

The step by the angular spectrum against the bare pair of FFTs, and the route on a GPU.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import (
    PlenopticCamera,
    estimate_reconstruction,
    load_scene,
    read_capture,
    reconstruct,
    render_capture,
    with_camera,
    write_capture,
)
from mitsuba_plenoptic.refocus import METHODS

from .. import Pivot, Row, at_most, case
from ..timing import in_process, once, paired, peak_memory
from .lens_models import scene_of

FAST_DISTANCE = 285.0
"""Of the wall and of the images, in millimetres; the cameras focus on 320."""


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
    page="docs/theory/accuracy.md",
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


def _camera(f_number: float, lenses: int) -> PlenopticCamera:
    return PlenopticCamera.matched(
        f_number=f_number, lenses=lenses, pixels_per_lens=10, pixel_size=0.005, focal_length=50, focus_distance=320
    )


def _capture(path: Path, f_number: float) -> None:
    camera = _camera(f_number, 100)
    capture = render_capture(scene_of(camera, FAST_DISTANCE), model="ray", spp=16)
    colours = capture.image[..., None] * np.array((1, 0.8, 0.6), np.float32)
    write_capture(path, dataclasses.replace(capture, image=colours))


def _refocus(path: Path, method: str) -> Row:
    capture = read_capture(path)
    options: dict[str, Any] = {"wavelength": (611.0, 549.0, 464.0)} if METHODS[method].waves else {}
    start = peak_memory()
    cost, took, _ = once(lambda: estimate_reconstruction(capture, FAST_DISTANCE, method=method, **options))
    _, seconds, _ = once(lambda: reconstruct(capture, FAST_DISTANCE, method=method, **options))
    return {
        # Longer estimates must be right within a factor of 1.5.
        "seconds": seconds, "estimate": cost.seconds, "off": max(seconds / cost.seconds, cost.seconds / seconds),
        "most_off": 1.5 if seconds > 30 else None, "took": took, "memory": peak_memory() - start,
        "estimated_memory": cost.memory / 2**30,
    }  # fmt: skip


@case(
    "reconstruction.price",
    "Processor time of refocusing over that of a ray capture of the letters in three colours, with 64 samples in each "
    "of 32 x 32 pixels of 64 x 42 lenses",
    {"method": "{method}", "processor s": "{seconds:.2f}", "over the capture": "{ratio:.2f}"},
    (at_most("ratio", "most"),),
    quick={"width": 16},
    variant="llvm_ad_rgb",
)
def price(*, width: int = 64) -> Iterator[Row]:
    """Capture and refocus in turn, all in one process that has done both before."""
    camera = PlenopticCamera(detector_width=0.064 * width, resolution=(32 * width, 21 * width))
    scene = with_camera(load_scene("letters", parameters={"letter_scale": width / 128}), camera)
    works: dict[str, Any] = {"capture": partial(render_capture, scene, model="ray", spp=64)}
    taken = works["capture"]()
    works |= {method: partial(reconstruct, taken, 210.0, method=method) for method in ("ray", "deconvolved")}
    for method, timing in paired(works, 1).items():
        yield {"method": method, "seconds": timing.processor, "ratio": timing.processor_ratio, "most": 2.6}
