"""Other packages on the work of cameras: rays and waves through the double Gauss, and decoding and refocusing."""

from __future__ import annotations

import importlib
import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates, shift

from mitsuba_plenoptic import decode, load_scene, render_capture
from mitsuba_plenoptic.prescription import bundled_prescription, paraxial
from mitsuba_plenoptic.report.experiment import thin_lens_image
from mitsuba_plenoptic.views import LensGrid, focal_stack, white_image
from mitsuba_plenoptic.views.coordinates import disparity
from mitsuba_plenoptic.views.lens_grid import lens_grid

from ...record_optiland import image_distance, sample
from .. import Row, at_least, at_most, case
from ..measures import agreement, relative
from ..timing import in_process
from .lenses import F_NUMBER, FAR, PIXEL, spread, theirs, traced
from .peers import PAGE, TIMES, Peer, against

NAME, D_LINE, WAVELENGTH = "double_gauss", 587.5618, 633.0
FIELD = 14.0
"""Largest angle of rays in degrees."""


def deeplens_lens(radius: float | None = None, sensor: tuple[float, int] = (40.0, 2000)) -> Any:
    """Return the double Gauss in DeepLens, in double precision, with its glasses from its own catalogue.

    `radius` is that of the entrance pupil; without, no edge blocks a ray. `sensor` is its width and pixels across.
    """
    deeplens, torch = importlib.import_module("deeplens"), importlib.import_module("torch")
    torch.set_num_threads(1)
    lens, numbers = bundled_prescription(NAME), paraxial(bundled_prescription(NAME))
    wider = 4.0 if radius is None else 1.0
    part = 4.0 if radius is None else radius / numbers.entrance_radius
    surfaces: list[dict[str, Any]] = [
        {
            "type": "Spheric", "c": 1 / each.radius, "r": wider * each.semi_aperture, "d_next": each.thickness,
            "mat2": each.glass.name.lower() if each.glass else "air",
        }
        for each in lens.surfaces
    ]  # fmt: skip
    stop = lens.surfaces[lens.stop]
    surfaces[lens.stop] = {
        "type": "Aperture", "r": part * stop.semi_aperture, "d_next": stop.thickness, "is_aperture": True
    }  # fmt: skip
    surfaces[-1]["d_next"] = image_distance(*sample(NAME))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "lens.json"
        width, pixels = sensor
        file.write_text(json.dumps({"surfaces": surfaces, "sensor_size": [width] * 2, "sensor_res": [pixels] * 2}))
        return deeplens.GeoLens(str(file), device="cpu", dtype=torch.float64)


@case(
    "peers.rays",
    "Rays through the double Gauss on one core, in double precision: the largest distance in the image plane from ours,"
    " and times",
    {"work": "{what}", "peer": "{peer}", "apart (mm)": "{difference:.0e}", **TIMES},
    (at_most("difference", 1e-6),),
    page=PAGE,
    quick={"rays": 1000, "repeats": 1},
)
def rays(*, rays: int = 100_000, repeats: int = 5) -> Iterator[Row]:
    """Trace rays that fill 0.7 of the pupil at all angles of the field."""
    yield from in_process(_rays, rays, repeats, cores=1)


def _rays(count: int, repeats: int) -> list[Row]:
    lens, random = bundled_prescription(NAME), np.random.default_rng(0)
    numbers, distance = paraxial(lens), image_distance(*sample(NAME))
    radius, angle = 0.7 * numbers.entrance_radius * np.sqrt(random.random(count)), random.uniform(0, 2 * np.pi, count)
    slopes = np.stack([np.zeros(count), np.tan(np.radians(FIELD * random.random(count)))])
    places = np.stack([radius * np.cos(angle), radius * np.sin(angle)]) - numbers.entrance_pupil * slopes
    N = 1 / np.sqrt(1 + np.sum(slopes**2, axis=0))
    start, direction = np.stack([*(places - 30 * slopes), np.full(count, -30.0)]), np.stack([*(slopes * N), N])
    peer = {"places": places, "slopes": slopes, "image_distance": distance}
    expected = traced(lens, peer, D_LINE)[0]

    def off(found: np.ndarray) -> Row:
        return {"difference": float(np.max(np.abs(found - expected)))}

    def optiland() -> Peer:
        optic, bundle = sample(NAME)[0], importlib.import_module("optiland.rays").RealRays
        ones = np.ones(count)

        def work() -> np.ndarray:
            found = optic.surfaces.trace(bundle(*start, *direction, ones, 1e-3 * D_LINE * ones), skip=1)
            return np.array([found.x, found.y])

        return Peer(work, off(work()), "both with NumPy, its default")

    def deeplens() -> Peer:
        lens, torch = deeplens_lens(), importlib.import_module("torch")
        bundle = importlib.import_module("deeplens.light").Ray

        def work() -> np.ndarray:
            with torch.no_grad():
                ray = bundle(torch.from_numpy(start.T.copy()), torch.from_numpy(direction.T.copy()), 1e-3 * D_LINE)
                return np.asarray(lens.trace2sensor(ray).o[:, :2].T)

        return Peer(work, off(work()), "PyTorch without gradients; ours with NumPy")

    own, makers = {"ours": lambda: traced(lens, peer, D_LINE)}, {"optiland": optiland, "deeplens-core": deeplens}
    return list(against(f"{count} rays", own, makers, repeats))


@case(
    "peers.spread",
    "The point spread on the axis of the double Gauss at f/8, 48 x 48 positions 0.5 µm apart, on one core: relative"
    " L2 from ours, and times",
    {"work": "{what}", "peer": "{peer}", "relative L2": "{difference:.2%}", **TIMES},
    (at_most("difference", "limit"),),
    page=PAGE,
    quick={"rays": 1000},
)
def spreads(*, rays: int = 12_800) -> Iterator[Row]:
    """Give the peers about as many rays each."""
    yield from in_process(_spreads, rays, cores=1)


def _spreads(count: int) -> list[Row]:
    window, across = 48, round(math.sqrt(4 / math.pi * count))
    axis = (np.arange(window) - (window - 1) / 2) * PIXEL
    places = np.meshgrid(axis, axis)

    def off(found: np.ndarray, x: np.ndarray, y: np.ndarray, limit: float) -> Row:
        mine = spread(NAME, 0.0, x, y)
        return {"difference": relative(found * (np.sum(mine * found) / np.sum(found**2)), mine), "limit": limit}

    def optiland() -> Peer:
        psf, (x, y) = theirs(NAME, 0.0, across, window)
        note = f"`HuygensPSF`, {across} x {across} rays, regular"
        return Peer(lambda: theirs(NAME, 0.0, across, window), off(psf, x, y, 0.01), note)

    def deeplens() -> Peer:
        pixels, torch = 2000, importlib.import_module("torch")
        lens = deeplens_lens(paraxial(bundled_prescription(NAME)).focal_length / F_NUMBER / 2, (pixels * PIXEL, pixels))

        def work() -> np.ndarray:
            torch.manual_seed(0)
            return lens.psf_huygens([0.0, 0.0, -FAR], ks=window, wvln=1e-3 * WAVELENGTH, spp=count).numpy()

        # The noise of random rays: 1.8 % for 5000.
        limit = 0.02 * max(1.0, math.sqrt(5000 / count))
        return Peer(work, off(work(), *places, limit), f"`psf_huygens`, {count} rays, random")

    found = against(
        f"f/{F_NUMBER:g}, {WAVELENGTH:g} nm", {"ours": lambda: spread(NAME, 0.0, *places)},
        {"optiland": optiland, "deeplens-core": deeplens}, 1, warm=False,
    )  # fmt: skip
    return list(found)


DISTANCES = (210.0, 240.0, 280.0)


def published_decode(
    image: np.ndarray, white: np.ndarray, grid: LensGrid, reach: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Decode upright micro-images as LFToolbox does: light and white (v, u, t, s), and pixels from view to view.

    D. G. Dansereau, O. Pizarro, S. B. Williams, "Decoding, calibration and rectification for lenselet-based plenoptic
    cameras" (2013), section 3: the picture is resampled, linearly, so that micro-images are a whole even number of
    samples apart and centred on one, and then cut up. The white image is treated alike. Views more than `reach` pixels
    from the middle are left out.
    """
    step = grid.pitch / (2 * math.ceil(grid.pitch / 2))
    half = math.floor(reach / step)
    steps, across = np.arange(-half, half + 1) * step, 2 * half + 1
    column, row = (
        (start - 0.5 + spacing * np.arange(count)[:, None] + steps).ravel()
        for start, spacing, count in zip(grid.offset, grid.spacing, grid.shape[::-1], strict=True)
    )
    places = np.meshgrid(row, column, indexing="ij")
    light, known = (
        map_coordinates(each, places, order=1)
        .reshape(grid.shape[0], across, grid.shape[1], across)
        .transpose(1, 3, 0, 2)
        for each in (image, white)
    )
    return light, known, step


def published_refocus(light: np.ndarray, white: np.ndarray, step: float) -> np.ndarray:
    """Shift views linearly by `step` bins from one to the next and add them up, weighted by the white image.

    As the filter "shift and sum" of the same toolbox; R. Ng et al., "Light Field Photography with a Hand-held Plenoptic
    Camera" (2005), section 4.
    """
    total, weight = np.zeros((2, *light.shape[2:]))
    for v, u in np.ndindex(light.shape[:2]):
        by = -step * (np.array([v, u]) - np.array(light.shape[:2]) // 2)
        total += shift(light[v, u], by, order=1, output=np.float64)
        weight += shift(white[v, u], by, order=1, output=np.float64)
    return total / np.maximum(weight, 1e-6)


@case(
    "peers.light-fields",
    "A capture of the letters decoded and refocused as LFToolbox publishes it, in plain NumPy and SciPy, on one core: "
    "relative L2 from ours, correlations with Mitsuba's thin lens, theirs and ours, and times",
    {
        "work": "{what}", "peer": "{peer}", "relative L2": "{difference:.1%}",
        "correlation, theirs; ours": "{theirs_right:.4f}; {ours_right:.4f}", **TIMES,
    },
    (at_most("difference", "limit"), at_least("ours_right", "least")),
    page=PAGE,
    quick={"resolution": 512, "spp": 8, "reference_spp": 16, "repeats": 1},
)  # fmt: skip
def light_fields(
    *, resolution: int = 2048, spp: int = 64, reference_spp: int = 1024, repeats: int = 3
) -> Iterator[Row]:
    """Refocus to the letters' distances."""
    yield from in_process(_light_fields, resolution, spp, reference_spp, repeats, cores=1)


def _light_fields(resolution: int, spp: int, reference_spp: int, repeats: int) -> list[Row]:
    part = resolution / 4096
    scene = load_scene("letters", parameters={
        "resolution": str(resolution), "detector_width": str(8.192 * part), "letter_scale": str(part)
    })  # fmt: skip
    capture = render_capture(scene, spp=spp)
    grid, white = lens_grid(capture.camera), white_image(capture.camera)
    references = [thin_lens_image(scene, capture.camera, g, reference_spp) for g in DISTANCES]
    lf = decode(capture)
    reach = lf.sizes["u"] / 2
    light, known, step = published_decode(capture.image, white, grid, reach)
    # From view to view they are not a whole pixel apart.
    steps = [disparity(lf, g) * step for g in DISTANCES]
    cut = (slice(4, -4),) * 2
    pictures = [[each[cut] for each in stack] for stack in (
        focal_stack(lf, DISTANCES).values, [published_refocus(light, known, step) for step in steps],
        [np.asarray(each, float).reshape(grid.shape) for each in references],
    )]  # fmt: skip
    mine, published, right = pictures
    scores = [[row[1] for row in agreement(each, right)[1]] for each in (mine, published)]
    bins = f"{grid.shape[1]} x {grid.shape[0]} lenses"
    rows: list[Row] = [
        {"what": f"{bins}, {g:g} mm", "peer": "as published", "difference": relative(b, a), "limit": 0.05,
         "ours_right": score, "theirs_right": others, "least": others - 0.005}
        for g, a, b, score, others in zip(DISTANCES, mine, published, *scores, strict=True)
    ]  # fmt: skip
    views = f"{len(light)} x {len(light)} views; ours {lf.sizes['v']} x {lf.sizes['u']}"
    decoding = Peer(lambda: published_decode(capture.image, white, grid, reach), {}, views)
    refocusing = Peer(lambda: [published_refocus(light, known, step) for step in steps], {}, "linear shifts by SciPy")
    works = {f"decode {bins}": (lambda: decode(capture, white=white), decoding),
             "refocus to 3 distances": (lambda: focal_stack(lf, DISTANCES), refocusing)}  # fmt: skip
    for what, (ours, peer) in works.items():
        rows += against(what, {"ours": ours}, {"as published": lambda peer=peer: peer}, repeats)
    return rows
