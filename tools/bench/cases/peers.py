"""Other packages on the same work: results are compared first, and then times, which are taken in turn."""

from __future__ import annotations

import importlib
import math
import os
import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import scipy.special
from cases import agreement, relative
from scipy.ndimage import map_coordinates, shift

from mitsuba_plenoptic import PlenopticCamera, decode, load_scene, render_capture
from mitsuba_plenoptic.fields.elements import Element
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.fields.steps import AxisStep
from mitsuba_plenoptic.fields.steps import Step as FieldStep
from mitsuba_plenoptic.optics.waves import propagate
from mitsuba_plenoptic.report.photographs import thin_lens_image
from mitsuba_plenoptic.views import LensGrid, focal_stack, white_image
from mitsuba_plenoptic.views.coordinates import disparity
from mitsuba_plenoptic.views.grid import lens_grid

from .. import Row, at_least, at_most, case
from ..speed import beam
from ..timing import in_process, paired

PAGE = "docs/guides/other_programs.md"
RUNS = 3
PITCH, DISTANCE, WAVELENGTH = 4e-3, 5.0, 633.0
WAVE = WAVELENGTH * 1e-6
"""The wavelength in millimetres."""

TIMES = {
    "ours (ms)": "{ours:.3g}", "theirs (ms)": "{theirs:.3g}",
    "theirs over ours": "{ratio:.3g} ({low:.3g} to {high:.3g})", "note": "{note}",
}  # fmt: skip


@dataclass(frozen=True)
class Peer:
    """What a package does: the work that is timed, how its result agrees, and with which of our works it compares."""

    work: Callable[[], Any]
    figures: Row = field(default_factory=dict)
    note: str = ""
    ours: str = "ours"


def against(
    what: str,
    ours: Mapping[str, Callable[[], Any]],
    makers: Mapping[str, Callable[[], Peer]],
    repeats: int,
    warm: bool = True,
) -> Iterator[Row]:
    """Compare packages, by the names of their distributions; one that is missing or fails gives one line.

    A ratio is the median over three runs, each of which repeats all works in turn; its range is that of the runs.
    """
    peers: dict[str, Peer] = {}
    for name, make in makers.items():
        try:
            peers[name] = make()
        except ImportError as missing:
            yield {"what": what, "peer": name, "note": f"not installed ({missing.name})"}
        except Exception as error:  # Whatever one package raises, the others are compared.
            yield {"what": what, "peer": _shown(name), "note": f"fails: {(str(error) or repr(error)).splitlines()[0]}"}
    works = {**ours, **{name: peer.work for name, peer in peers.items()}}
    runs = [paired(works, repeats, warm=warm) for _ in range(RUNS)] if peers else []
    for name, peer in peers.items():
        ratios = [run[name].ratio / run[peer.ours].ratio for run in runs]
        seconds = {key: statistics.median(run[work].seconds for run in runs)
                   for key, work in (("ours", peer.ours), ("theirs", name))}  # fmt: skip
        yield {
            "what": what, "peer": _shown(name), "note": peer.note, **peer.figures,
            **{key: 1e3 * value for key, value in seconds.items()},
            "ratio": statistics.median(ratios), "low": min(ratios), "high": max(ratios),
        }  # fmt: skip


def _shown(name: str) -> str:
    try:
        return f"{name} {version(name)}"
    except PackageNotFoundError:
        return name


Step = Callable[[np.ndarray], Any]


@case(
    "peers.steps",
    "The angular-spectrum step of other packages on one core: errors (relative L2) of a narrow beam and of one inclined"
    " by 3.4 degrees against the sum of plane waves in double precision, and times",
    {"samples": "{what}", "peer": "{peer}", "narrow": "{difference:.0e}", "inclined": "{steep:.0e}", **TIMES},
    (at_most("difference", 1e-5), at_most("steep", "steep_limit")),
    page=PAGE,
    quick={"sizes": (256,)},
)
def steps(*, sizes: tuple[int, ...] = (1024, 2048, 4096)) -> Iterator[Row]:
    """Compare at several sizes, in a process each."""
    for size in sizes:
        yield from in_process(_steps, size, cores=1)


def _steps(size: int) -> list[Row]:
    for name in ("OMP", "MKL", "NUMEXPR"):
        os.environ[f"{name}_NUM_THREADS"] = "1"
    # Direction cosines of 0.06 and -0.0022.
    beams = [beam(size), beam(size, (round(0.06 * size * PITCH / WAVE), -14))]
    expected = [_sum_of_plane_waves(each) for each in beams]
    carrier = np.exp(2j * math.pi * (DISTANCE / WAVE % 1))

    def figures(step: Step, exact: bool) -> Row:
        # Packages differ in whether they include the carrier.
        off = [
            min(relative(np.asarray(step(each)) * factor, answer) for factor in (1, carrier.conj()))
            for each, answer in zip(beams, expected, strict=True)
        ]
        return {"difference": off[0], "steep": off[1], "steep_limit": 1e-5 if exact else None}

    def ours(samples: np.ndarray) -> np.ndarray:
        return propagate(samples, PITCH, DISTANCE, WAVELENGTH)

    def padded(samples: np.ndarray) -> np.ndarray:
        return ours(np.pad(samples, size // 2))[size // 2 : -(size // 2), size // 2 : -(size // 2)]

    def made(name: str) -> Peer:
        make, exact, note = PEERS[name]
        step = make(size)
        return Peer(lambda: step(beams[0]), figures(step, exact), note, "padded" if name == "hcipy" else "ours")

    what = f"{size} x {size}"
    own = {"ours": lambda: ours(beams[0]), "padded": lambda: padded(beams[0])}
    # All have been run before; the largest are timed once in each run.
    found = against(what, own, {name: lambda name=name: made(name) for name in PEERS}, max(1, 4096 // size - 1), False)
    return [{"what": what, "peer": "ours", **figures(ours, True)}, *found]


def _sum_of_plane_waves(samples: np.ndarray) -> np.ndarray:
    """Advance each plane wave of a periodic field by its own phase, in double precision, without the carrier."""
    cosine = np.fft.fftfreq(len(samples), PITCH) * WAVE
    square = cosine[:, None] ** 2 + cosine**2
    waves = DISTANCE / WAVE * (np.sqrt(1 - square) - 1)
    return np.fft.ifft2(np.fft.fft2(samples.astype(np.complex128)) * np.exp(2j * math.pi * waves))


def _hcipy(size: int) -> Step:
    hcipy = importlib.import_module("hcipy")
    grid = hcipy.make_uniform_grid([size, size], [size * PITCH] * 2)
    step = hcipy.AngularSpectrumPropagator(grid, DISTANCE, num_oversampling=1)
    return lambda samples: np.asarray(
        step.forward(hcipy.Wavefront(hcipy.Field(samples.ravel(), grid), WAVE)).electric_field
    ).reshape(size, size)


def _poppy(size: int) -> Step:
    poppy, units = importlib.import_module("poppy"), importlib.import_module("astropy.units")
    poppy.conf.double_precision = False
    poppy.accel_math.update_math_settings()
    # A beam so wide in Rayleigh's sense is stepped from plane to plane.
    wave = poppy.FresnelWavefront(
        beam_radius=size * PITCH / 2 * units.mm, wavelength=WAVELENGTH * units.nm, npix=size, oversample=1,
        rayleigh_factor=100,
    )  # fmt: skip

    def step(samples: np.ndarray) -> np.ndarray:
        wave.wavefront, wave.z = samples.copy(), 0 * units.m
        wave.propagate_fresnel(DISTANCE * units.mm)
        return wave.wavefront

    return step


def _prysm(size: int) -> Step:
    propagation, conf = importlib.import_module("prysm.propagation"), importlib.import_module("prysm.conf")
    conf.config.precision = 32
    microns = WAVELENGTH * 1e-3
    factor = propagation.angular_spectrum_transfer_function(size, microns, PITCH, DISTANCE).astype(np.complex64)
    return lambda samples: propagation.angular_spectrum(samples, microns, PITCH, DISTANCE, Q=1, tf=factor)


def _lightpipes(size: int) -> Step:
    pipes = importlib.import_module("LightPipes")
    wave = pipes.Begin(size * PITCH * 1e-3, WAVELENGTH * 1e-9, size, dtype=np.complex64)

    def step(samples: np.ndarray) -> np.ndarray:
        wave.field = samples
        return pipes.Forvard(wave, DISTANCE * 1e-3).field

    return step


def _torchoptics(size: int) -> Step:
    torchoptics, torch = importlib.import_module("torchoptics"), importlib.import_module("torch")
    torch.set_num_threads(1)
    return lambda samples: (
        torchoptics.Field(torch.from_numpy(samples), WAVE, 0.0, PITCH)
        .propagate_to_z(DISTANCE, propagation_method="ASM", asm_pad=(0, 0))
        .data.numpy()
    )


def _diffractsim(size: int) -> Step:
    diffractsim = importlib.import_module("diffractsim")
    width = size * PITCH * 1e-3
    wave = diffractsim.MonochromaticField(WAVELENGTH * 1e-9, width, width, size, size)

    def step(samples: np.ndarray) -> np.ndarray:
        wave.E = samples
        wave.propagate(DISTANCE * 1e-3)
        return wave.E

    return step


PEERS: dict[str, tuple[Callable[[int], Step], bool, str]] = {
    "hcipy": (_hcipy, True, "both padded to twice the size; `num_oversampling=1`, propagator reused"),
    "poppy": (_poppy, False, "Fresnel; `double_precision=False`, wavefront reused"),
    "prysm": (_prysm, False, "Fresnel; 32 bits, transfer function reused"),
    "LightPipes": (_lightpipes, False, "Fresnel (`Forvard`); `dtype=complex64`, NumPy's transforms"),
    "torchoptics": (_torchoptics, True, "`asm_pad=0`, double precision"),
    "diffractsim": (_diffractsim, True, "double precision only, NumPy backend"),
}
"""How each steps, whether by the exact transfer function, and what it was given."""


@case(
    "peers.microlenses",
    "A plane wave behind an array of square parabolic microlenses: the diffraction orders that the grid holds, against "
    "their closed form by Fresnel integrals (relative L2), and the time of multiplying a field by the array",
    {"samples": "{what}", "peer": "{peer}", "orders": "{difference:.1e}", **TIMES},
    (at_most("difference", "limit"),),
    page=PAGE,
    quick={"sizes": (256,), "repeats": 1},
)
def microlenses(*, sizes: tuple[int, ...] = (1024, 2048), repeats: int = 5) -> Iterator[Row]:
    """Sample the paper's array at 2 and 1 micrometres, in a process each."""
    for size in sizes:
        yield from in_process(_microlenses, size, 2.048 / size, repeats, cores=1)


def _microlenses(size: int, pitch: float, repeats: int) -> list[Row]:
    camera = PlenopticCamera(detector_width=2.048, resolution=(1024, 1024))
    first, wide = (pitch - 2.048) / 2, (size, size)
    axis = AxisStep(first, pitch, size, size, size, first, size)
    system = OpticalSystem(camera, WAVELENGTH)
    plane, mine = np.ones(wide, np.complex64), np.empty(wide, np.complex64)

    def ours() -> None:
        lenses = Element.by_orders(FieldStep(axis, axis), system.microlenses, WAVE / (2 * pitch))
        lenses.through(slice(0, size), plane, mine)
        np.multiply(mine, lenses.along_y[:, None], out=mine)

    ours()
    highest = math.ceil(camera.row_pitch / pitch / 2) - 1
    numbers = np.arange(-highest, highest + 1)
    line = closed_form_orders(numbers, camera.row_pitch**2 / (WAVE * camera.mla_focal_lengths[0]))
    place = (first + pitch * np.arange(size)) / camera.row_pitch - 0.5
    waves = np.exp(-2j * math.pi * np.outer(numbers, place)) / size

    def off(samples: np.ndarray) -> float:
        return relative(waves @ samples @ waves.T, np.outer(line, line))

    def hcipy() -> Peer:
        package = importlib.import_module("hcipy")
        grid = package.make_uniform_grid([size, size], [2.048, 2.048])
        count = round(2.048 / camera.row_pitch)
        array = package.MicroLensArray(grid, package.make_uniform_grid([count] * 2, [2.048] * 2),
                                       camera.mla_focal_lengths[0])  # fmt: skip
        wave = package.Wavefront(package.Field(plane.ravel(), grid), WAVE)

        def work() -> np.ndarray:
            return np.asarray(array.forward(wave).electric_field).reshape(size, size)

        return Peer(
            work, {"difference": off(work()), "limit": 0.05}, "`MicroLensArray`, reused; the phase at the samples"
        )

    what = f"{size} x {size}, {1e3 * pitch:g} µm"
    own = {"what": what, "peer": "ours", "difference": off(mine), "limit": 1e-5}
    return [own, *against(what, {"ours": ours}, {"hcipy": hcipy}, repeats)]


def closed_form_orders(numbers: np.ndarray, fresnel: float) -> np.ndarray:
    r"""Amplitudes of the orders of a parabolic lens with :math:`p^2 / \lambda f = F`, along one axis.

    Each is the integral over a lens of :math:`\exp(-i \pi F u^2 - 2 \pi i m u)`, u from -1/2 to 1/2, with the square
    completed.
    """
    sine, cosine = scipy.special.fresnel(math.sqrt(2 * fresnel) * (numbers / fresnel + np.array([[0.5], [-0.5]])))
    whole = (cosine[0] - cosine[1]) - 1j * (sine[0] - sine[1])
    return np.asarray(np.exp(1j * math.pi * numbers**2 / fresnel) * whole / math.sqrt(2 * fresnel))


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
