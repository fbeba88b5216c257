"""Particles: volumes and vectors by density, and whether simulation by rays alone tells how good they are."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter
from scipy.stats import t as student

from mitsuba_plenoptic import Capture, Detector, PlenopticCamera, StoredOperator, expose
from mitsuba_plenoptic import particles as pt
from mitsuba_plenoptic.linear.map import LinearMap

from .. import Row, case

WAVELENGTH = 550.0

DISTANCE, FOCAL_LENGTH = 100.0, 50.0
"""Magnification 1, in millimetres."""

CONFIDENCE = 0.95

TOLD = {
    "q": ("Q", "{:.2f}", 1),
    "ghosts": ("ghosts", "{:.1f} %", 100),
    "across": ("errors across", "{:.1f} um", 1),
    "along": ("errors along", "{:.0f} um", 1),
}
"""Names, formats and factors of the measures in verdicts."""


@dataclass(frozen=True)
class Setting:
    """A camera, and a volume in units of a lens across the axis, and along it of the depth that blurs by a lens."""

    f_number: float
    # Pixels to a microlens, microlenses to the detector, and the pitch of these in mm.
    pixels: int
    lenses: int
    pitch: float
    # Widths of the voxels' grid, of the particles' volume and of a voxel, across and along the axis.
    grid: tuple[float, float]
    volume: tuple[float, float]
    voxel: float

    @property
    def camera(self) -> PlenopticCamera:
        """The camera, whose microlenses have the f-number of the image."""
        return PlenopticCamera(
            focal_length=FOCAL_LENGTH,
            aperture_radius=FOCAL_LENGTH / self.f_number / 2,
            focus_distance=DISTANCE,
            mla_pitch=self.pitch,
            mla_focal_length=2 * self.f_number * self.pitch,
            detector_width=self.lenses * self.pitch,
            resolution=(self.lenses * self.pixels,) * 2,
        )

    @property
    def unit(self) -> np.ndarray:
        """The units along x, y and z in millimetres."""
        return self.pitch * np.array([1, 1, 2 * self.f_number])

    def corners(self, size: tuple[float, float]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the corners of a box about the distance in focus."""
        half, centre = np.array([size[0], size[0], size[1]]) / 2 * self.unit, np.array([0, 0, DISTANCE])
        return tuple((centre - half).tolist()), tuple((centre + half).tolist())

    @property
    def voxels(self) -> pt.VoxelGrid:
        """The grid."""
        across, along = (round(size / self.voxel) for size in self.grid)
        return pt.VoxelGrid(*self.corners(self.grid), (along, across, across))

    def truth(self, per_lens: float, move: Sequence[float], seed: int) -> xr.Dataset:
        """Return particles that scatter in air as 1 micrometre does in water, and all move by some units."""
        seeding = pt.Seeding(per_lens=per_lens, diameter=1.333, index=1.59 / 1.333, medium=1.0)
        flow = pt.Uniform(tuple((self.unit * move).tolist()))
        volume = pt.ParticleVolume(*self.corners(self.volume))
        return pt.particle_sequence(self.camera, volume, seeding, flow, interval=1.0, seed=seed)

    def judged(self, volumes: list[xr.DataArray], truth: xr.Dataset, window: tuple[int, int, int]) -> dict[str, float]:
        """Return Q, ghosts and errors (root mean square, in micrometres) of both frames' volumes."""
        there = truth["inside"].values[0] == 1
        places = truth["position"].values[0, there]
        reference = pt.drawn_particles(self.voxels, places, np.ones(len(places)), 0.33 * self.unit)
        return {
            "q": pt.quality(volumes[0], reference),
            "ghosts": pt.ghost_fraction(volumes[0], places, self.unit * (1, 1, 1.5)),
            **rms(errors_of(volumes, truth, window)),
        }


def errors_of(volumes: list[xr.DataArray], truth: xr.Dataset, window: tuple[int, int, int]) -> xr.DataArray:
    """Return the errors of the vectors between both frames' volumes (z, y, x, axis), in micrometres."""
    vectors = pt.correlate_volumes(*volumes, window=window)["displacement"]
    return 1e3 * (vectors - truth["displacement"].values[0, 0])


def rms(errors: xr.DataArray) -> dict[str, float]:
    """Return root mean squares of errors across the axis and along it."""
    across, along = errors.sel(axis=["x", "y"]), errors.sel(axis="z")
    return {"across": math.sqrt(float((across**2).mean())), "along": math.sqrt(float((along**2).mean()))}


def pair_of(truth: xr.Dataset, model: str, photons: float, seed: int) -> list[Capture]:
    """Return both captures of particles, with the noise of photons."""
    images, detector = pt.ParticleImages(truth, wavelength=WAVELENGTH, model=model), Detector(full_well=1e5, bits=16)
    return [expose(images.capture(frame), detector, photons=photons, seed=2 * seed + frame) for frame in range(2)]


def volumes_of(
    pair: list[Capture], projector: LinearMap, grid: pt.VoxelGrid, iterations: int, smoothing: float = 0.0
) -> list[xr.DataArray]:
    """Return the volumes of both captures, smoothed by a normal curve of a standard deviation in voxels."""
    found = [pt.reconstruct_volume(projector, capture, grid, iterations=iterations) for capture in pair]
    return [each.copy(data=gaussian_filter(each.values, smoothing, mode="constant")) for each in found]


def verdict_on(alone: Mapping[str, np.ndarray], real: Mapping[str, np.ndarray]) -> str:
    """Return which measures, of as many seeds, rays alone state too high or too low, beyond the interval of the mean.

    Seeds are paired: both have the same particles.
    """
    told = []
    for name, (words, form, factor) in TOLD.items():
        change = factor * (alone[name] - real[name])
        mean, count = float(change.mean()), len(change)
        half = float(student.ppf((1 + CONFIDENCE) / 2, count - 1)) * float(change.std(ddof=1)) / math.sqrt(count)
        if abs(mean) > half:
            amount = f"{form.format(abs(mean))} (± {form.format(half).split()[0]})"
            told.append(f"{'overstate' if mean > 0 else 'understate'} {words} by {amount}")
    return "; ".join(told) or "no difference beyond the interval"


def row_of(setting: Setting, found: list[list[dict[str, float]]]) -> Row:
    """Return the row of a camera from the results of all seeds by rays alone, and of waves found by rays and waves."""
    alone, *real = ({name: np.array([one[name] for one in results]) for name in TOLD} for results in found)
    medians = {name: [float(np.median(each[name])) for each in (alone, *real)] for name in TOLD}
    return {
        "f_number": setting.f_number, "pixel": 1e3 * setting.camera.pixel_size, **medians,
        "ratio": medians["along"][2] / medians["across"][2], "elongation": pt.elongation(setting.camera, DISTANCE),
        "rays_alone": verdict_on(alone, real[0]), "found": found,
    }  # fmt: skip


THREE = "{%s[0]:%s} / {%s[1]:%s} / {%s[2]:%s}"


@case(
    "particles.study",
    "Particles by rays found by rays / by waves found by rays / by waves found by waves: quality Q, ghosts, errors of "
    "vectors; medians over seeds; verdicts compare the first two seed by seed, 95 %",
    {
        "lens": "f/{f_number:g}", "pixels (um)": "{pixel:.1f}",
        "Q": THREE % (("q", ".2f") * 3), "ghosts": THREE % (("ghosts", ".1%") * 3),
        "across (um)": THREE % (("across", ".1f") * 3), "along (um)": THREE % (("along", ".0f") * 3),
        "along over across": "{ratio:.0f}", "elongation": "{elongation:.0f}", "rays alone": "{rays_alone}",
    },
    page="docs/guides/particles.md",
    needs=("miepython",),
    quick={"f_numbers": (4.0,), "pixels": (7,), "seeds": 2, "iterations": 3},
)  # fmt: skip
def study(
    *,
    f_numbers: tuple[float, ...] = (2.0, 4.0, 8.0),
    pixels: tuple[int, ...] = (14, 10, 7),
    per_lens: float = 1.5,
    photons: float = 1e5,
    iterations: int = 20,
    smoothing: float = 0.7,
    seeds: int = 8,
) -> Iterator[Row]:
    """Cameras of 0.077 mm a lens, with volumes that blur by up to two lenses."""
    for f_number, count in itertools.product(f_numbers, pixels):
        setting = Setting(f_number, count, 11, 0.077, (6, 5), (4.5, 4), 1 / 3)
        camera, grid = setting.camera, setting.voxels
        waves = StoredOperator(camera, grid.points, wavelength=WAVELENGTH, accuracy=0.01)
        rays = pt.RayProjector(camera, grid, wavelength=WAVELENGTH)
        found: list[list[dict[str, float]]] = [[], [], []]
        for seed in range(seeds):
            move = np.random.default_rng(seed).uniform(-0.7, 0.7, 3)
            truth = setting.truth(per_lens, move, seed)
            by_rays, by_waves = (pair_of(truth, model, photons, seed) for model in ("ray", "wave"))
            for results, pair, projector in zip(found, (by_rays, by_waves, by_waves), (rays, rays, waves), strict=True):
                results.append(
                    setting.judged(volumes_of(pair, projector, grid, iterations, smoothing), truth, (12, 10, 10))
                )
        yield row_of(setting, found)


@case(
    "particles.density",
    "Volumes of particles by waves, and vectors, by density: f/4, 16 x 16 lenses of 0.125 mm with 16 x 16 pixels, "
    "photons a particle, MART, windows of 14 x 14 x 12 voxels",
    {
        "particles": "{particles}", "per lens": "{per_lens:g}", "Q": "{q:.2f}", "ghosts": "{ghosts:.1%}",
        "error of vectors across the axis (um)": "{across:.1f}", "along it (um)": "{along:.0f}",
    },
    page="docs/guides/particles.md",
    needs=("miepython",),
    quick={"densities": (0.3,), "iterations": 3},
)  # fmt: skip
def density(
    *, densities: tuple[float, ...] = (0.06, 0.3, 1.0, 3.0), photons: float = 1e5, iterations: int = 30
) -> Iterator[Row]:
    """Particles in 1.5 x 1.5 x 8 mm, which move by a lens along x, half of one along y, and a blur of one along z."""
    setting = Setting(4.0, 16, 16, 0.125, (14, 10), (12, 8), 0.5)
    grid = setting.voxels
    projector = pt.VoxelProjector(setting.camera, grid, wavelength=WAVELENGTH, budget=4.0)
    for per_lens in densities:
        truth = setting.truth(per_lens, (1, -0.5, 1), 0)
        volumes = volumes_of(pair_of(truth, "wave", photons, 0), projector, grid, iterations)
        there = int(truth["inside"].values[0].sum())
        yield {"particles": there, "per_lens": per_lens, **setting.judged(volumes, truth, (12, 14, 14))}


@case(
    "particles.depth",
    "Errors of vectors by depth: 16 x 16 lenses of 0.125 mm with 16 x 16 pixels, waves, MART, windows of 10 x 10 x 8 "
    "voxels, in thirds of the volume's depth; root mean squares over seeds",
    {
        "lens": "f/{f_number:g}", "from focus (mm)": "{near:.1f} to {far:.1f}", "blur (lenses)": "{blur:.1f}",
        "vectors": "{vectors}", "across (um)": "{across:.1f}", "along (um)": "{along:.0f}",
        "along over across": "{ratio:.0f}", "elongation": "{elongation:.1f}",
    },
    page="docs/guides/particles.md",
    needs=("miepython",),
    quick={"f_numbers": (4.0,), "seeds": 1, "iterations": 3},
)  # fmt: skip
def depth(
    *,
    f_numbers: tuple[float, ...] = (4.0, 8.0),
    per_lens: float = 1.5,
    photons: float = 1e5,
    iterations: int = 20,
    smoothing: float = 0.7,
    seeds: int = 4,
) -> Iterator[Row]:
    """Particles in a volume that blurs by up to seven lenses on both sides of the plane in focus."""
    for f_number in f_numbers:
        setting = Setting(f_number, 16, 16, 0.125, (8, 16), (6.5, 14), 0.5)
        camera, grid = setting.camera, setting.voxels
        projector, found = pt.VoxelProjector(camera, grid, wavelength=WAVELENGTH, budget=6.0), []
        for seed in range(seeds):
            truth = setting.truth(per_lens, np.random.default_rng(seed).uniform(-0.7, 0.7, 3), seed)
            volumes = volumes_of(pair_of(truth, "wave", photons, seed), projector, grid, iterations, smoothing)
            found.append(errors_of(volumes, truth, (8, 10, 10)))
        errors, edges = xr.concat(found, "seed"), np.linspace(grid.lower[2], grid.upper[2], 4)
        for near, far in itertools.pairwise(edges):
            part = errors.isel(z=(errors["z"].values >= near) & (errors["z"].values < far))
            middle, each = float(part["z"].mean()), rms(part)
            yield {
                "f_number": f_number, "near": near - DISTANCE, "far": far - DISTANCE,
                "blur": camera.lens_data.image_blur(camera, middle) / camera.row_pitch, "vectors": part.size // 3,
                **each, "ratio": each["along"] / each["across"], "elongation": pt.elongation(camera, middle),
            }  # fmt: skip
