"""The light-field microscope's waves: objectives against the Debye integral, the array against pyolaf.

Volumes deconvolved behind an objective: beads over depth, steps against pyolaf's, and the Fourier arrangement.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.special import j0

from mitsuba_plenoptic import Capture, CaptureOperator, Objective, PlenopticCamera, decode, design, reconstruct
from mitsuba_plenoptic.extensions.deconvolution.fourier import FourierResponse
from mitsuba_plenoptic.extensions.deconvolution.response import Response
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.point_spread import point_fields
from mitsuba_plenoptic.points.units import radiance_weight
from mitsuba_plenoptic.refocus import Reconstruction
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.views import view_mosaic

from .. import Row, at_most, case, figure
from ..measures import relative
from ..timing import once, paired, peak_memory

WAVELENGTH = 550.0
OBJECTIVES = {
    "20x/0.5, air": (Objective(20, 0.5), (-0.03, 0.0, 0.01)),
    "20x/1.0, water": (Objective(20, 1.0, 1.33), (-0.01, 0.0, 0.006)),
    "40x/1.3, oil": (Objective(40, 1.3, 1.515, tube_focal_length=180), (-0.004, 0.0, 0.002)),
}
"""Objectives, and depths of points in millimetres."""

PITCH, MICROLENS, LENSES, PIXELS = 0.15, 3.0, 11, 15
"""Pitch and focal length of the microlenses in millimetres, lenses across the detector, and pixels across a lens."""

DEPTHS, PLACES = (-0.03, 0.0, 0.015), ((0, 0), (4, -6))
"""Depths in millimetres, and places of the image in pixels."""


def debye(objective: Objective, radius: np.ndarray, depth: float) -> np.ndarray:
    r"""Return the intensity in the native image plane of a point on the axis, by 400 nodes of Gauss and Legendre.

    It is :math:`|\\int_0^\\alpha \\sqrt{\\cos\\theta} J_0(k n r \\sin\\theta / M) e^{i k n d \\cos\\theta} \\sin\\theta
    d\\theta|^2` (Gu, "Advanced Optical Imaging Theory", section 6.2), normalised by Parseval's theorem.
    """
    nodes, weights = leggauss(400)
    angle, weights = (nodes + 1) * objective.half_angle / 2, weights * objective.half_angle / 2
    k = 2 * np.pi * objective.immersion / (WAVELENGTH * 1e-6)
    pupil = np.sqrt(np.cos(angle)) * np.sin(angle) * np.exp(1j * k * depth * (np.cos(angle) - 1)) * weights
    amplitude = j0(np.outer(radius * k / objective.magnification, np.sin(angle))) @ pupil
    power = 2 * np.pi * (1 - np.cos(objective.half_angle)) * (objective.magnification / k) ** 2
    return np.abs(amplitude) ** 2 / power


@case(
    "microscope.objectives",
    "The intensity behind objectives alone against the Debye integral by quadrature",
    {
        "objective": "{objective}", "depth (mm)": "{depth:.3g}", "position (mm)": "{place}",
        "relative L2": "{error:.4%}",
    },
    (at_most("error", 1e-3),),
    page="docs/guides/microscope.md",
    quick={"count": 2},
)  # fmt: skip
def objectives(*, count: int = 18) -> Iterator[Row]:
    """Compare points on the axis and beside it."""
    points = (
        (name, objective, depth, place)
        for name, (objective, depths) in OBJECTIVES.items()
        for depth in depths
        for place in ((0.0, 0.0), (0.008, -0.005))
    )
    for name, objective, depth, place in itertools.islice(points, count):
        yield {"objective": name, "depth": depth, "place": place, "error": alone(objective, depth, place)}


def alone(objective: Objective, depth: float, place: tuple[float, float]) -> float:
    """Return the relative error of the intensity that comes to the microlenses."""
    camera = PlenopticCamera(
        main_lens=objective, mla_pitch=PITCH, mla_focal_length=MICROLENS, detector_width=1.5, resolution=(100, 100)
    )
    field = point_fields(camera, (*place, depth), wavelength=WAVELENGTH).mla
    rows, columns = np.indices(field.samples.shape)
    x, y = (
        start + number * field.pitch + objective.magnification * X
        for start, number, X in zip(field.origin, (columns, rows), place, strict=True)
    )
    radius = np.hypot(x, y)
    grid = np.linspace(0, radius.max() * 1.001, 20_001)
    reference = np.interp(radius, grid, debye(objective, grid, depth))
    return float(np.linalg.norm(np.abs(field.samples) ** 2 - reference) / np.linalg.norm(reference))


def microscope() -> PlenopticCamera:
    """Return the microscope that is compared with pyolaf, one lens on its axis."""
    return PlenopticCamera(
        main_lens=Objective(20, 0.5),
        mla_pitch=PITCH,
        mla_focal_length=MICROLENS,
        mla_offset=(PITCH / 2, PITCH / 2),
        detector_width=LENSES * PITCH,
        resolution=(LENSES * PIXELS,) * 2,
    )


def obliquity(cells: int = 128) -> np.ndarray:
    """Return the factor (1 + cos)^2 / 4 on the power over the stop, by which pyolaf's apodisation differs."""
    centres = (np.arange(cells) + 0.5) / cells * 2 - 1
    sine = 0.5 * np.minimum(np.hypot(centres, centres[:, None]), 1)
    return (1 + np.sqrt(1 - sine**2)) ** 2 / 4


def ours(depth: float, place: tuple[int, int], like_pyolaf: bool) -> np.ndarray:
    """Return the fractions of a point's light on the detector's pixels; `place` is that of its image, in pixels."""
    camera = microscope()
    X, Y = (-pixels * camera.pixel_size / 20 for pixels in place)
    weights = obliquity()[None] if like_pyolaf else None
    operator = CaptureOperator(
        camera, [(X, Y, depth)], wavelength=WAVELENGTH, method="full_field", pupil_weights=weights
    )
    return operator.forward([1.0])


class Peer:
    """pyolaf's microscope, with `finer` samples across a pixel, an odd number."""

    def __init__(self, finer: int) -> None:
        from pyolaf import lf

        self._lf, self.finer = lf, finer
        # Its lengths are micrometres.
        sample = 1e3 * PITCH / PIXELS / finer
        across, lens = LENSES * PIXELS * finer, PIXELS * finer
        axis = (np.arange(across) - across // 2) * sample
        within = (np.arange(lens) - lens // 2) * sample
        centres = np.arange(LENSES + 2) * lens - (LENSES + 2) // 2 * lens
        px = np.stack(np.meshgrid(centres, centres, indexing="ij"), -1).astype(float)
        lam = WAVELENGTH * 1e-3
        self.camera: dict[str, Any] = {
            "NA": 0.5, "n": 1.0, "M": 20.0, "WaveLength": lam, "k": 2 * np.pi / lam, "dof": 200e3 / 20,
            "fm": 1e3 * MICROLENS, "lensPitch": 1e3 * PITCH,
        }  # fmt: skip
        self.resolution: dict[str, Any] = {
            "yspace": axis, "xspace": axis, "yMLspace": within, "xMLspace": within, "sensorRes": [sample, sample],
            "sensMask": np.ones((lens, lens)), "maskFlag": 1, "usedLensletCenters": {"px": px},
        }  # fmt: skip
        one = lf.LFM_ulensTransmittance(self.camera, self.resolution)
        self._array = lf.LFM_mlaTransmittance(self.camera, self.resolution, one)
        self._fields: dict[float, np.ndarray] = {}

    def spread(self, depth: float, place: tuple[int, int]) -> np.ndarray:
        """Return the light of a point on the detector's pixels, not normalised."""
        if depth not in self._fields:
            self._fields[depth] = self._lf.LFM_calcPSF(0, 0, -1e3 * depth, self.camera, self.resolution)
        shifted = self._lf.imShift2(self._fields[depth], place[1] * self.finer, place[0] * self.finer)
        numbers = self.resolution["sensorRes"], 1e3 * MICROLENS, self.camera["WaveLength"]
        field = self._lf.prop2Sensor(shifted * self._array, *numbers, False)
        pixels = LENSES * PIXELS
        return (np.abs(field) ** 2).reshape(pixels, self.finer, pixels, self.finer).sum((1, 3))


@case(
    "microscope.pyolaf",
    "Point spreads through the array against pyolaf, each over its sum, where pyolaf's last refinement changes it by "
    "less than 1 %",
    {
        "depth (mm)": "{depth}", "position (pixels)": "{place}", "pyolaf's changes": "{changes}",
        "ours": "{ours:.2%}", "ours without its obliquity": "{plain:.2%}", "ours from each": "{each}",
    },
    (at_most("judged", 0.02),),
    page="docs/guides/microscope.md",
    needs=("pyolaf",),
    quick={"finest": 5},
)  # fmt: skip
def against_pyolaf(*, finest: int = 7) -> Iterator[Row]:
    """Compare six points, with odd numbers of pyolaf's samples across a pixel from 3 on.

    pyolaf takes the depth towards the objective as positive; its apodisation is sqrt(cos) (1 + cos), of which ours
    leaves the second factor, an obliquity, to the source; it samples the phase of the microlenses; its intensities are
    samples, of which those within a pixel are added here; its point spreads are not normalised.
    """
    peers = [Peer(finer) for finer in range(3, finest + 1, 2)]
    for depth, place in itertools.product(DEPTHS, PLACES):
        spreads = [each / each.sum() for each in (peer.spread(depth, place) for peer in peers)]
        mine, plain = (each / each.sum() for each in (ours(depth, place, like) for like in (True, False)))
        changes = [relative(a, b) for a, b in itertools.pairwise(spreads)]
        difference = relative(mine, spreads[-1])
        yield {
            "depth": depth,
            "place": place,
            "changes": ", ".join(f"{value:.2%}" for value in changes),
            "ours": difference,
            "plain": relative(plain, spreads[-1]),
            "each": ", ".join(f"{relative(spread, mine):.2%}" for spread in spreads),
            "judged": difference if changes[-1] < 0.01 else None,
        }


DEEP_PITCH, DEEP_PIXELS, BINS = 0.075, 15, 5
"""Nanometres; millimetres; pixels and bins across a lens."""

REACH = 0.25
"""How far from the axis beads lie at most, over the width of the field."""

NEAREST, FARTHEST = 0.016, 0.04
"""Depths in millimetres, beyond that where the lens pitch decides."""


def deep_microscope(lenses: int) -> PlenopticCamera:
    """Return a microscope whose planes are beyond the shallow ones from 13 um on; one lens is on its axis."""
    return PlenopticCamera(
        main_lens=Objective(20, 0.5),
        mla_pitch=DEEP_PITCH,
        mla_focal_length=20 * DEEP_PITCH,
        mla_offset=(DEEP_PITCH / 2, DEEP_PITCH / 2),
        detector_width=lenses * DEEP_PITCH,
        resolution=(lenses * DEEP_PIXELS,) * 2,
    )


def beads(camera: PlenopticCamera, depths: np.ndarray) -> np.ndarray:
    """Return a bead in each plane, (n, 3), one in each cell of a square grid, and not in the middle of bins."""
    random = np.random.default_rng(4)
    across, size = _cells(camera, len(depths))
    cells = random.permutation(across**2)[: len(depths)]
    corner = np.column_stack([cells % across, cells // across]) - across / 2
    return np.column_stack([(corner + random.uniform(0.4, 0.6, corner.shape)) * size, depths])


def _cells(camera: PlenopticCamera, count: int) -> tuple[int, float]:
    """Return the count of cells along an axis for a count of beads, and their width."""
    across = math.ceil(math.sqrt(count))
    return across, 2 * REACH * camera.detector_width / 20 / across


def width(profile: np.ndarray, bin_size: float) -> float:
    """Return the width at half of the peak, between bins by straight lines."""
    peak = int(profile.argmax())
    half, ends = profile[peak] / 2, []
    for side in (profile[peak::-1], profile[peak:]):
        below = int(np.argmax(side < half))
        ends.append(below - (half - side[below]) / (side[below - 1] - side[below]))
    return float(sum(ends) * bin_size)


@case(
    "microscope.beads",
    "Beads, one in each plane, in a volume deconvolved from one capture of exact point spreads: widths against "
    "Broxton's limit, the distance of points just resolved",
    {
        "depth (um)": "{depth:.3g}", "position (bins)": "{error:.3f}", "width (um)": "{width:.3g}",
        "largest width (um)": "{widest:.3g}", "Broxton's distance (um)": "{limit:.3g}",
        "lens pitch (um)": "{pitch:.3g}",
        "s a step": "{step:.3g}", "s planning": "{planning:.3g}", "GiB": "{memory:.2f}",
    },
    (at_most("width", "widest"), at_most("error", 0.25), at_most("memory", 8.0)),
    page="docs/guides/microscope.md",
    quick={"planes": 1, "lenses": 9, "iterations": 10},
)  # fmt: skip
def deconvolved_beads(*, planes: int = 4, lenses: int = 21, iterations: int = 30) -> Iterator[Row]:
    """Measure each bead; whole steps are timed, with everything they do."""
    camera, depths = deep_microscope(lenses), np.linspace(NEAREST, FARTHEST, planes)
    points = beads(camera, depths)
    image = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0).forward(np.ones(len(points)))
    capture = Capture(np.maximum(image, 0), camera, WAVELENGTH, "wave", {})
    times: dict[int, float] = {}
    options = {"method": "deconvolved", "oversample": BINS, "iterations": iterations, "volume": True}
    found = reconstruct(
        capture, depths.tolist(), **options, progress=lambda done, _: times.setdefault(done, time.perf_counter())
    )
    # Point spreads are the first 30 of the 100 parts of the work that progress reports, steps the others.
    planned, first = max(done for done in times if done <= 30), min(done for done in times if done > 30)
    # Where something is compiled it is in the first step.
    seconds = {"step": (times[100] - times[first]) / (iterations - 1), "planning": times[planned] - times[0]}
    for plane, (X, Y, depth) in zip(found, points, strict=True):
        values = np.nan_to_num(plane.image)
        # Pictures have +x to the left and +y up.
        y, x = ((size / 2 - np.arange(size) - 0.5) * plane.bin_size for size in values.shape)
        # Planes show beads of their neighbours, too, in other cells.
        reach = _cells(camera, len(depths))[1] / 2
        own = values * ((np.abs(x - X) < reach) & (np.abs(y - Y) < reach)[:, None])
        row, column = np.unravel_index(own.argmax(), own.shape)
        around = np.s_[max(0, row - 3) : row + 4, max(0, column - 3) : column + 4]
        light = values[around] / values[around].sum()
        error = np.hypot(light.sum(0) @ x[around[1]] - X, light.sum(1) @ y[around[0]] - Y)
        widths = width(own[row], plane.bin_size), width(own[:, column], plane.bin_size)
        limit = 1e3 / design.resolution_limit(camera, depth, WAVELENGTH).waves
        # Nothing is narrower than two bins.
        yield {
            "depth": float(1e3 * depth), "error": float(error / plane.bin_size), "width": 1e3 * max(widths),
            "limit": limit, "widest": max(limit, 2e3 * DEEP_PITCH / 20 / BINS), "pitch": 1e3 * DEEP_PITCH / 20,
            **seconds, "memory": peak_memory(),
        }  # fmt: skip


@case(
    "microscope.steps",
    "A step of Richardson and Lucy, a projection forward and one back, against pyolaf's with as many samples",
    page="docs/guides/microscope.md",
    needs=("pyolaf",),
    quick={"planes": 1, "lenses": 9},
)
def steps(*, planes: int = 4, lenses: int = 21, runs: int = 3) -> Iterator[Row]:
    """Time both in turn."""
    camera, depths = deep_microscope(lenses), np.linspace(NEAREST, FARTHEST, planes)
    response, planning, _ = once(lambda: Response(camera, depths.tolist(), wavelength=WAVELENGTH, oversample=BINS))
    image = np.random.default_rng(0).random(camera.shape).astype(np.float32)
    volume = response.adjoint(image)
    timings = paired(
        {"pyolaf": pyolaf_step(camera, depths), "ours": lambda: response.adjoint(response.forward(volume))}, runs
    )
    yield figure("bins of the volume", sum(values.size for values in volume))
    yield figure("ours, planning", planning, unit="s")
    for name, timing in timings.items():
        yield figure(f"{name}, a step", timing.seconds, unit="s")
    yield figure("step, ours over pyolaf's", timings["ours"].ratio, at_most=1.0)


def pyolaf_step(camera: PlenopticCamera, depths: np.ndarray) -> Any:
    """Return pyolaf's step; its patterns have their sizes and any values, on which its time does not depend."""
    from pyolaf import project
    from scipy.sparse import csr_matrix

    lenses = camera.lens_count[0] // 2 * 2 + 1
    across = int(np.ceil(max(camera.blur_diameter(depth) for depth in depths) / 2 / DEEP_PITCH) + 2)
    patterns = {}
    for name, number, samples in (("H", BINS, DEEP_PIXELS), ("Ht", DEEP_PIXELS, BINS)):
        pattern = csr_matrix(np.ones((2 * across * samples + 1,) * 2, np.float32))
        patterns[name] = np.full((number, number, len(depths)), pattern, dtype=object)
    index = np.arange(lenses) - lenses // 2
    grid = np.stack(np.meshgrid(index, index, indexing="ij"), -1).astype(float)
    centres = {"px": grid * DEEP_PIXELS, "vox": grid * BINS}
    resolution: dict[str, Any] = {
        "TexNnum": np.array([BINS, BINS]), "TexNnum_half": np.array([BINS // 2 + 1] * 2), "texMask": np.array(1),
        "Nnum": np.array([DEEP_PIXELS, DEEP_PIXELS]), "Nnum_half": np.array([DEEP_PIXELS // 2 + 1] * 2),
        "sensMask": np.ones((DEEP_PIXELS, DEEP_PIXELS)), "texScaleFactor": np.array([BINS / DEEP_PIXELS] * 2),
    }  # fmt: skip
    detector, volume = np.array([lenses * DEEP_PIXELS] * 2), np.ones((lenses * BINS, lenses * BINS, len(depths)))

    def step() -> None:
        image = project.LFM_forwardProject(patterns["H"], volume, centres, resolution, detector, "full")
        project.LFM_backwardProject(patterns["Ht"], image, centres, resolution, detector // DEEP_PIXELS * BINS, "full")

    return step


PHOTONS = 2000.0
DEEPEST = 0.045
"""Depth in millimetres of the outermost planes, within the depth of field of a lens."""

NEAR = 8
"""Bins around a bead whose light counts as its own."""


def fourier_microscope() -> PlenopticCamera:
    """Return a 20x/0.5 fourier_microscope with 5 lenses across the image of its stop and 50 pixels across a view."""
    return PlenopticCamera(
        main_lens=Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50),
        mla_pitch=0.5,
        mla_focal_length=20.0,
        mla_offset=(0.25, 0.25),
        detector_width=3.0,
        resolution=(300, 300),
    )


def weight(camera: PlenopticCamera, oversample: int) -> float:
    """Return the light of a bin of radiance 1."""
    return radiance_weight(
        camera,
        main_lens(camera),
        (camera.pixel_size / oversample * camera.mla_distance / camera.detector_distance) ** 2,
    )


def worst_spread(camera: PlenopticCamera, depth: float, oversample: int) -> float:
    """Return the largest difference of the response to a bin from its exact spreads, at three places of the field."""
    response = FourierResponse(camera, [depth], wavelength=WAVELENGTH, oversample=oversample)
    rows, columns = response.shapes[0]
    size, inner, found = camera.bin_size(0) / oversample, (np.arange(3) + 0.5) / 3, []
    for row, column in ((rows // 2, columns // 2), (1, columns // 3), (rows - 2, 1)):
        values = np.zeros((rows, columns), np.float32)
        values[row, column] = 1
        x, y = np.meshgrid((column - columns / 2 + inner) * size, (row - rows / 2 + inner) * size)
        points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, depth)])
        exact = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field").forward(
            np.full(len(points), weight(camera, oversample) / len(points))
        )
        found.append(relative(response.forward([values]), exact))
    return max(found)


def seen(plane: Reconstruction, bead: np.ndarray, power: float, light_of_bin: float) -> tuple[float, float, float]:
    """Return the error of a bead's place in bins, its power over the true one, and what else its plane holds of it."""
    light = np.nan_to_num(plane.image) * light_of_bin / power
    # Pictures have +x to the left and +y up.
    y, x = ((size / 2 - np.arange(size) - 0.5) * plane.bin_size for size in light.shape)
    across, down = np.abs(x - bead[0]) < NEAR * plane.bin_size, np.abs(y - bead[1]) < NEAR * plane.bin_size
    mine = light * (across & down[:, None])
    total = float(mine.sum())
    place = np.array([(mine.sum(0) @ x) / total, (mine.sum(1) @ y) / total]) - bead[:2]
    return float(np.hypot(*place)) / plane.bin_size, total, float(light.sum()) - total


@case(
    "microscope.fourier",
    "The Fourier microscope's deconvolution: its response against exact spreads, and a known volume of beads, also "
    "with 2000 photons in the brightest pixel, stopped by the method itself",
    page="docs/guides/microscope.md",
    quick={"planes": 2, "beads": 1, "iterations": 10},
)
def fourier(
    output: Path, *, planes: int = 9, beads: int = 5, oversample: int = 2, iterations: int = 60
) -> Iterator[Row]:
    """Measure beads of random powers at random positions, in some of the planes.

    Their capture is the sum of exact point spreads (`full_field`); the response moves one spread for a plane.
    """
    camera, random = fourier_microscope(), np.random.default_rng(3)
    depths = np.linspace(-DEEPEST, DEEPEST, planes)
    half = 0.35 * camera.bin_size(0) * camera.bin_count[0]
    which = np.sort(random.choice(planes, beads, replace=False))
    points = np.column_stack([random.uniform(-half, half, (beads, 2)), depths[which]])
    powers = random.uniform(0.5, 1.5, beads)
    for depth in (0.0, DEEPEST):
        what = f"response {1e3 * depth:.3g} um from the native plane against exact spreads"
        yield figure(what, worst_spread(camera, depth, oversample), at_most=0.01)
    image = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field").forward(powers)
    capture = Capture(np.maximum(image, 0), camera, WAVELENGTH, "wave", {})
    photons = PHOTONS / float(capture.image.max())
    counts = (random.poisson(capture.image * photons) / photons).astype(np.float32)
    noisy = Capture(counts, camera, WAVELENGTH, "wave", {})
    options = {"method": "deconvolved", "volume": True, "oversample": oversample}
    found, seconds, _ = once(lambda: reconstruct(capture, depths.tolist(), iterations=iterations, **options))
    rough = reconstruct(noisy, depths.tolist(), photons=photons, **options)
    light = weight(camera, oversample)
    for number, bead, power in zip(which, points, powers, strict=True):
        place, whole, elsewhere = seen(found[number], bead, power, light)
        noisy_place, noisy_power, _ = seen(rough[number], bead, power, light)
        at = f"bead at {1e3 * bead[2]:.3g} um: "
        yield figure(at + "position", place, at_most=0.1, unit="bins")
        yield figure(at + "power, off", abs(whole - 1), at_most=0.03)
        yield figure(at + "light elsewhere in its plane", elsewhere, at_most=0.03)
        yield figure(at + "position with noise", noisy_place, at_most=0.1, unit="bins")
        yield figure(at + "power with noise, off", abs(noisy_power - 1), at_most=0.03)
    yield figure(f"{planes} planes, {iterations} steps, with the point spreads", seconds, unit="s")
    yield figure("steps with noise", rough[0].facts["iterations"])
    mosaic = view_mosaic(decode(capture))
    write_png(output / "views.png", mosaic, peak=float(np.quantile(mosaic, 0.999)))
