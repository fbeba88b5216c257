"""Captures behind lenses of a few wavelengths against exact sums.

The reference shares no code with captures. The field of each point of a wall on some lenses is a sum over the pupil's
directions with the exact path from each pupil point; it passes the lenses, sampled at a quarter of the wavelength in
the medium, and the medium by its angular spectrum. Intensities are integrated over pixels, and over the wall by
Gauss-Legendre nodes, which are exact for the pupil's limited band.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft
from cases import relative
from numpy.typing import NDArray

from mitsuba_plenoptic import Job, PlenopticCamera, load_scene, render_capture
from mitsuba_plenoptic.extensions.onchip.response_tables import PhotodiodeResponses, TableWindow
from mitsuba_plenoptic.extensions.onchip.responses import ResponseSum
from mitsuba_plenoptic.optics import rays
from mitsuba_plenoptic.runtime.batches import SumTask
from mitsuba_plenoptic.waves.spectral_nodes import Node

from .. import Row, at_most, case
from ..measures import mean_of_seeds, write_comparison
from ..timing import once, peak_memory

PITCH, MEDIUM, DEPTH = 0.0028, 1.5, 0.004

_RADII = 24
"""Points of the pupil, from its centre to its edge, of the mean of captures."""

_FINER, _DIRECTIONS, _PARTS = 32, 100, 12
"""Samples of the lenses per sample of the field, directions from the pupil's centre to its edge, parts of each."""


def camera_of(f_number: float, lenses: int, pitch: float = PITCH, depth: float = DEPTH) -> PlenopticCamera:
    """Return a camera of square pixels under lenses that cover two by two of them."""
    b = 50.0
    return PlenopticCamera(
        focal_length=40.0, aperture_radius=b / (2 * f_number), mla_distance=b, mla_pitch=pitch,
        mla_focal_length=depth, detector_distance=depth, mla_medium=MEDIUM,
        detector_width=lenses * pitch, resolution=(2 * lenses, 2 * lenses), lens_model="parabolic",
    )  # fmt: skip


class Wall:
    """A bright rectangle in the image space of the main lens, at a distance behind the array, in millimetres."""

    def __init__(self, camera: PlenopticCamera, wavelength: float, blur: float) -> None:
        self.camera, self.wavelength = camera, wavelength * 1e-6
        self.sine = camera.aperture_radius / math.hypot(camera.aperture_radius, camera.mla_distance)
        self.distance = blur * camera.row_pitch * camera.mla_distance / camera.aperture_radius
        pitch = camera.row_pitch
        half = max(1.0, self.wavelength / (2 * self.sine) / pitch) * pitch
        self.low, self.high = (-1.11 * half, -0.86 * half), (0.79 * half, 1.18 * half)

    def light(self, point: tuple[Any, Any, Any], slope: tuple[Any, Any], active: Any, seed: int) -> list[Any]:
        """Return the radiance along rays that have passed the main lens towards the scene."""
        camera, lit = self.camera, active
        # A lens of the opposite focal length undoes the refraction.
        cosines = (
            rays.main_lens_slope(s, P, -camera.focal_length)
            for s, P in zip(rays.slopes_to_cosines(*slope), point[:2], strict=True)
        )
        for P, t, low, high in zip(point[:2], rays.cosines_to_slopes(*cosines), self.low, self.high, strict=True):
            place = P - (camera.mla_distance + self.distance) * t
            lit = lit & (place > low) & (place < high)
        return [dr.select(lit, mi.Float(1), 0)]

    def nodes(self) -> Iterator[tuple[float, float, float]]:
        """Yield points and weights of the wall's integral."""
        axes = []
        for low, high in zip(self.low, self.high, strict=True):
            count = math.ceil(math.pi * (high - low) * 2 * self.sine / self.wavelength) + 4
            node, weight = np.polynomial.legendre.leggauss(count)
            axes.append(zip(low + (node + 1) / 2 * (high - low), weight * (high - low) / 2, strict=True))
        (across, up) = (list(axis) for axis in axes)
        return ((x, y, u * v) for x, u in across for y, v in up)

    def exact(self) -> NDArray[np.float64]:
        """Return the pixels by direct sums."""
        camera, wavelength = self.camera, self.wavelength
        k, b, index = 2 * math.pi / wavelength, camera.mla_distance, camera.mla_medium
        lenses = round(camera.detector_width / camera.row_pitch)
        each = 2 * math.ceil(camera.row_pitch * 4 * index / wavelength / 2)
        count, step = each * lenses, camera.row_pitch / each
        place = (np.arange(count) + 0.5) * step - count * step / 2
        cell = ((np.arange(each * _FINER) + 0.5) / _FINER - each / 2) * step
        order = scipy.fft.fftfreq(len(cell), 1 / len(cell))
        held = np.abs(order) < each // 2
        amplitude = (
            scipy.fft.fft(np.exp(-1j * math.pi * index * cell**2 / (wavelength * camera.mla_focal_lengths[0])))
        )[held]
        lens = np.exp(2j * math.pi * np.outer((np.arange(each) + 0.5 - 0.5 / _FINER) / each, order[held])) @ amplitude
        array = np.tile(lens / len(cell), lenses) * np.exp(1j * k * place**2 / (2 * b))
        frequency = scipy.fft.fftfreq(count, step)
        medium = np.sqrt((index / wavelength) ** 2 - frequency**2 - frequency[:, None] ** 2 + 0j)
        transfer = np.exp(2j * math.pi * camera.detector_distance * medium).astype(np.complex64)
        turn = min(wavelength / (count * step * 1.5), self.sine / _DIRECTIONS)
        cosine = (np.arange(2 * math.ceil(self.sine / turn) + 2) - math.ceil(self.sine / turn) - 0.5) * turn
        part = ((np.arange(_PARTS) + 0.5) / _PARTS - 0.5) * turn
        square = ((cosine[:, None] + part) ** 2).reshape(-1)
        cover = (square[:, None] + square < self.sine**2).astype(float)
        cover = cover.reshape(len(cosine), _PARTS, len(cosine), _PARTS).mean((1, 3))
        slope = 1 / np.sqrt(np.maximum(1 - cosine**2 - cosine[:, None] ** 2, 0.1))
        Px, Py = -b * cosine * slope, -b * cosine[:, None] * slope
        # Rays pass equal areas of the pupil and of the array equally often.
        source = cover * slope**2 * (turn**2 / wavelength * b / (b + self.distance))
        near = np.sqrt(Px**2 + Py**2 + b * b)
        waves = (np.exp(1j * k * np.outer(place, cosine)) * array[:, None]).astype(np.complex64)
        total = np.zeros((count, count))
        for x, y, weight in self.nodes():
            path = np.sqrt((Px - x) ** 2 + (Py - y) ** 2 + (b + self.distance) ** 2) - near - self.distance
            field = waves @ (source * np.exp(-1j * k * path)).astype(np.complex64) @ waves.T
            field = scipy.fft.ifft2(scipy.fft.fft2(field, overwrite_x=True) * transfer, overwrite_x=True)
            total += weight * (field.real**2 + field.imag**2)
        shape = np.sinc(scipy.fft.fftfreq(count))
        total = scipy.fft.ifft2(scipy.fft.fft2(total) * shape * shape[:, None]).real * step**2
        pixels = total.reshape(2 * lenses, each // 2, 2 * lenses, each // 2).sum((1, 3))
        return np.asarray(pixels * (DEPTH / MEDIUM / (camera.pixel_size * camera.row_pitch)) ** 2)

    def expected(self, plan: PhotodiodeResponses) -> NDArray[np.float64]:
        """Return the pixels that captures have in the mean over their random numbers."""
        camera, table = self.camera, plan.table
        lenses, b, size = round(camera.detector_width / camera.row_pitch), camera.mla_distance, plan.count
        near, far = (part[0].astype(np.float32) for part in (table.near, table.far))
        lens = np.arange(lenses) + 0.5 - lenses / 2
        edge = plan.near.lenses / 2
        total = np.zeros((lenses, lenses, size**2))
        along = (np.arange(2 * _RADII) + 0.5 - _RADII) / _RADII * camera.aperture_radius
        for Py in along:
            for Px in along:
                if Px * Px + Py * Py > camera.aperture_radius**2:
                    continue
                distance = math.sqrt(Px * Px + Py * Py + b * b)
                place = [-P / distance / plan.step + plan.across for P in (Py, Px)]
                low = [math.floor(each) for each in place]
                parts = [0, 0]
                for dy, dx in ((0, 0), (0, 1), (1, 0), (1, 1)):
                    share = abs(1 - dy - place[0] + low[0]) * abs(1 - dx - place[1] + low[1])
                    which = table.nodes[low[0] + dy, low[1] + dx]
                    if which >= 0:
                        parts = [old + share * part[which] for old, part in zip(parts, (near, far), strict=True)]
                # Where the rays through this point of the pupil meet the array, in lenses.
                ends = [
                    [
                        (end * b + P * self.distance) / (b + self.distance) / camera.row_pitch - lens
                        for end in (first, last)
                    ]
                    for P, first, last in zip((Px, Py), self.low, self.high, strict=True)
                ]
                # The far table is used beyond the near one.
                for window, part, limit, sign in (
                    (plan.near, parts[0], edge, 1), (plan.far, parts[1], math.inf, 1), (plan.far, parts[1], edge, -1),
                ):  # fmt: skip
                    across, up = (_hats(*each, window, limit) for each in ends)
                    x, y = (np.flatnonzero(each.any(1)) for each in (across, up))
                    light = np.einsum("ay,yxj,bx->abj", up[y], part, across[x], optimize=True)
                    total[y[:, None], x] += sign * light
        pixels = total.reshape(lenses, lenses, size, size).transpose(0, 2, 1, 3).reshape(lenses * size, lenses * size)
        cell = (camera.aperture_radius / _RADII) ** 2
        return np.asarray(pixels * cell * (DEPTH / MEDIUM / (b * camera.pixel_size)) ** 2)

    def captured(self, plan: PhotodiodeResponses, spp: int, seed: int) -> NDArray[np.float64]:
        """Return the pixels by responses."""
        work = ResponseSum(self.camera, self.light, [Node(plan, (0,), np.ones((1, 1)))], spp=spp, seed=seed)
        items = int(work.items.sum())
        image = Job().run([SumTask(items, lambda: work, lambda image: image)], (*self.camera.shape, 1), items)
        return image[..., 0].astype(float)


def _hats(
    low: NDArray[np.float64], high: NDArray[np.float64], window: TableWindow, limit: float
) -> NDArray[np.float64]:
    """Return the integrals between bounds (lenses,) of the functions by which samples are interpolated linearly.

    Positions are lenses, within a limit and the window.
    """
    place, first, last = window.place, max(-limit, window.place[0]), min(limit, window.place[-1])

    def upto(bound: NDArray[np.float64]) -> NDArray[np.float64]:
        t = np.clip((np.clip(bound, first, last)[:, None] - place) * window.samples, -1, 1)
        return np.where(t < 0, (1 + t) ** 2 / 2, 1 - (1 - t) ** 2 / 2) / window.samples

    return upto(high) - upto(low)


@case(
    "photodiodes",
    "Two by two photodiodes under lenses of 2.8 um in a medium of index 1.5: walls against exact sums, relative L2 "
    "over the pixels, for the mean of all captures, and that of a capture of some rays from this mean",
    {
        "f-number": "f/{f_number:g}", "wavelength (nm)": "{wavelength:g}", "blur (lenses)": "{blur:g}",
        "MiB": "{memory:.0f}", "planning (s)": "{planning:.1f}", "responses": "{difference:.2%}",
        "drawn rays": "{drawn:.1%}", "their noise": "{noise:.1%}", "energy": "{energy:.4f}",
        "points": "{points}", "s": "{seconds:.0f}",
    },
    (at_most("difference", 0.01), at_most("energy_off", 0.005)),
    page="docs/theory/photodiodes.md",
    quick={"f_numbers": (8.0,), "wavelengths": (650.0,), "blurs": (0.0,), "samples": 256},
)  # fmt: skip
def photodiodes(
    output: Path,
    *,
    f_numbers: tuple[float, ...] = (1.8, 4.0, 8.0),
    wavelengths: tuple[float, ...] = (450.0, 550.0, 650.0),
    blurs: tuple[float, ...] = (0.0, 8.0),
    margin: float = 5.0,
    samples: int = 1024,
    seeds: int = 2,
    fine: bool = False,
) -> Iterator[Row]:
    """Compare walls of about two lenses; ``margin`` is the free width around their light in lenses."""
    for f_number in f_numbers:
        for wavelength in wavelengths:
            for blur in blurs:
                spread = f_number * wavelength * 1e-6 / PITCH
                lenses = 2 * math.ceil(abs(blur) + 1.2 * max(1.0, spread) + max(margin, 3.5 * spread))
                camera = camera_of(f_number, lenses)
                wall = Wall(camera, wavelength, blur)
                plan = PhotodiodeResponses(camera, wavelength, fine=fine)
                _, planning, _ = once(lambda plan=plan: plan.table)
                exact, seconds, _ = once(wall.exact)
                image = wall.expected(plan)
                drawn, noise = mean_of_seeds(lambda seed, w=wall, p=plan: w.captured(p, samples, seed), seeds)
                energy = float(image.sum() / exact.sum())
                yield {
                    "f_number": f_number, "wavelength": wavelength, "blur": blur, "memory": plan.nbytes / 2**20,
                    "planning": planning, "difference": relative(image, exact), "drawn": relative(drawn, image),
                    "noise": noise,
                    "energy": energy, "energy_off": abs(energy - 1), "points": sum(1 for _ in wall.nodes()),
                    "seconds": seconds,
                }  # fmt: skip
                name = f"f{f_number:g}_{wavelength:g}_{blur:g}_responses_exact_difference_times_10.png"
                write_comparison(output / name, image, exact, gain=10)


@case(
    "photodiode-cost",
    "The middle of the still life behind 4000 x 3000 lenses of 2.8 um, by rays and by waves in turn: seconds elapsed "
    "and of the processor in the second run, with the tables made, and peak of memory",
    {
        "lenses": "{lenses[0]} x {lenses[1]}", "rays (s)": "{ray[0]:.1f}, {ray[1]:.1f}",
        "waves (s)": "{wave[0]:.1f}, {wave[1]:.1f}", "waves over rays": "{ratio:.2f}", "first waves (s)": "{first:.1f}",
        "light": "{light:.3f}", "peak (GiB)": "{memory:.1f}",
    },
    (at_most("ratio", 1.6), at_most("memory", 6.0)),
    page="docs/theory/photodiodes.md",
    quick={"lenses": (64, 48), "samples": 2},
)  # fmt: skip
def photodiode_cost(
    *, lenses: tuple[int, ...] = (1024, 768), samples: int = 8, aperture_radius: float = 15.0
) -> Iterator[Row]:
    """Compare times; ``lenses=4000,3000`` captures all."""
    whole = 4000, 3000
    camera = PlenopticCamera(
        aperture_radius=aperture_radius, mla_pitch=PITCH, mla_focal_length=DEPTH, mla_medium=MEDIUM,
        detector_width=whole[0] * PITCH, resolution=(2 * whole[0], 2 * whole[1]),
        crop_offset=(whole[0] - lenses[0], whole[1] - lenses[1]), crop_size=(2 * lenses[0], 2 * lenses[1]),
    )  # fmt: skip
    scene, sensor = load_scene("still_life"), mi.load_dict(camera.to_sensor())
    runs: dict[str, list[tuple[Any, float, float]]] = {"ray": [], "wave": []}
    for _ in range(2):
        for model in runs:
            options = {"wavelength": 550.0} if model == "wave" else {}
            capture = once(lambda m=model, o=options: _light(scene, sensor, m, samples, o))
            runs[model].append(capture)
    row = {model: runs[model][1][1:] for model in runs}
    yield {
        **row, "lenses": lenses, "ratio": row["wave"][0] / row["ray"][0], "first": runs["wave"][0][1],
        "light": runs["wave"][1][0] / runs["ray"][1][0], "memory": peak_memory(),
    }  # fmt: skip


def _light(scene: Any, sensor: Any, model: str, samples: int, options: Row) -> float:
    """Return the mean of a capture."""
    return float(render_capture(scene, sensor=sensor, model=model, spp=samples, **options).image.mean())
