"""The light-field microscope's point spreads against pyolaf's, and the cost of waves in the Fourier arrangement."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
from cases import relative
from scipy.ndimage import maximum_filter
from scipy.sparse import csr_array

from mitsuba_plenoptic import (
    Capture,
    CaptureOperator,
    Objective,
    PlenopticCamera,
    design,
    point_spread_function,
    reconstruct,
    render_capture,
    with_camera,
)

from .. import Row, at_most, case
from ..timing import once

WAVELENGTH = 550.0

PITCH, MICROLENS, LENSES, PIXELS = 0.15, 3.0, 11, 15
"""Pitch and focal length of the microlenses in millimetres, lenses across the detector, and pixels across a lens."""

DEPTHS, PLACES = (-0.03, 0.0, 0.015), ((0, 0), (4, -6))
"""Depths in millimetres, and places of the image in pixels."""


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


@case(
    "microscope.fourier",
    "Processor time in seconds of captures in the Fourier arrangement, by rays and by waves, in turn in one process",
    {
        "scene": "{scene}", "pixels": "{pixels}", "samples": "{samples}", "rays (s)": "{rays:.2f}",
        "first by waves (s)": "{first:.1f}", "waves (s)": "{waves:.2f}", "waves over rays": "{ratio:.2f}",
        "light over that of rays": "{light:.4f}",
    },
    (at_most("ratio", "limit"),),
    quick={"pixels": (512,)},
)  # fmt: skip
def fourier(
    *,
    pixels: tuple[int, ...] = (1024, 2048),
    samples: int = 16,
    runs: int = 3,
    scenes: tuple[str, ...] = ("plane", "beads"),
) -> Iterator[Row]:
    """Time captures of a textured plane and of beads before seven hexagonal lenses across the stop."""
    for name, size in itertools.product(scenes, pixels):
        lens = Objective(20, 0.5, arrangement="fourier", fourier_focal_length=125.0, field_stop=5.6)
        camera = PlenopticCamera(
            main_lens=lens, mla_pitch=0.9, mla_focal_length=10.0, mla_lattice="hexagonal", detector_width=6.3,
            resolution=(size, size),
        )  # fmt: skip
        scene = with_camera("beads" if name == "beads" else _plane(camera), camera)
        times: dict[str, list[float]] = {"ray": [], "wave": []}
        sums = {}
        for seed, (model, own) in itertools.product(range(1 + runs), times.items()):
            wave = {"wavelength": WAVELENGTH} if model == "wave" else {}
            capture, _, seconds = once(partial(render_capture, scene, model=model, spp=samples, seed=seed, **wave))
            own.append(seconds)
            sums[model] = capture.image.sum(dtype=np.float64)
        rays, waves = (float(np.mean(own[1:])) for own in times.values())
        yield {
            "scene": name, "pixels": size, "samples": samples, "rays": rays, "first": times["wave"][0], "waves": waves,
            "ratio": waves / rays, "light": sums["wave"] / sums["ray"],
            "limit": 1.5 if size >= 2048 else None,
        }  # fmt: skip


def _plane(camera: PlenopticCamera) -> mi.Scene:
    texels = np.random.default_rng(0).random((256, 256, 1)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    place = mi.ScalarTransform4f().rotate([1, 0, 0], 180).scale(0.35)
    plane = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": texture}}
    return mi.load_dict({"type": "scene", "sensor": camera.to_sensor(), "integrator": {"type": "path"}, "plane": plane})


@case(
    "microscope.beads",
    "Twenty beads of one power in five layers before the preset flfm, 500 photons in the brightest pixel of one, found "
    "in volumes of planes one depth step apart, by Richardson and Lucy's iteration with pyolaf's projections, too",
    {
        "method": "{method}", "iterations": "{iterations}", "found": "{found}", "aside (voxels)": "{aside:.2f}",
        "deeper (voxels)": "{deeper:.2f}", "faintest bead": "{faintest:.2f}", "brightest other": "{other:.3f}",
        "seconds": "{seconds:.0f}",
    },
    (at_most("aside", 0.3), at_most("deeper", 0.7), at_most("other", 0.25)),
    page="docs/guides/fourier_microscope.md",
    needs=("pyolaf",),
    quick={"planes": 13},
)  # fmt: skip
def beads(*, planes: int = 21, iterations: int = 60, seed: int = 0) -> Iterator[Row]:
    """Find beads by `deconvolved` and by the peer from one noisy sum of full fields, with the same point spreads."""
    camera, random = PlenopticCamera.preset("flfm"), np.random.default_rng(seed)
    step, voxel = design.depth_step(camera, WAVELENGTH), camera.bin_size(0)
    depths = (np.arange(planes) - planes // 2) * step
    radius = 0.75 * camera.main_lens.field_stop / camera.main_lens.magnification
    beads: list[np.ndarray] = []
    while len(beads) < 20:
        layer = (len(beads) % 5 - 2) * (planes // 5) * step
        bead = np.array([*random.uniform(-radius, radius, 2), layer + random.uniform(-0.5, 0.5) * step])
        apart = all(np.hypot(*(bead - other)[:2]) > 6 * voxel for other in beads)
        if np.hypot(*bead[:2]) < radius and apart:
            beads.append(bead)
    exact = CaptureOperator(camera, beads, wavelength=WAVELENGTH, method="full_field")
    image = exact.forward(np.ones(20)).clip(0)
    scale = 500 / exact.forward(np.eye(20)[0]).max()
    noisy = (random.poisson(image * scale) / scale).astype(np.float32)
    capture = Capture(noisy, camera, WAVELENGTH, "wave", {})

    def ours() -> np.ndarray:
        options = {"method": "deconvolved", "volume": True, "oversample": 1, "iterations": iterations}
        return np.stack([np.nan_to_num(plane.image) for plane in reconstruct(capture, depths.tolist(), **options)])

    def peers() -> np.ndarray:
        """Like pyolaf's example: behind lenses of one pixel, a plane is convolved with one point spread."""
        from pyolaf import project

        # The voxel beside the axis is in the middle of a pixel.
        points = [(voxel / 2, voxel / 2, depth) for depth in depths]
        spreads = [point_spread_function(camera, point, wavelength=WAVELENGTH, method="full_field") for point in points]
        kernels, backward = np.empty((2, 1, 1, planes), object)
        for index, spread in enumerate(spreads):
            kernels[0, 0, index], backward[0, 0, index] = csr_array(spread), csr_array(spread[::-1, ::-1])
        lens = {name: np.array([1, 1]) for name in ("TexNnum", "Nnum", "TexNnum_half", "Nnum_half")}
        lens |= {"texMask": np.array(1), "sensMask": np.ones((1, 1)), "texScaleFactor": np.ones(2)}
        size = np.array(camera.shape)
        centres = np.moveaxis(np.indices(camera.shape), 0, -1) - size // 2
        options = {"px": centres, "vox": centres}, lens, size, "full"
        middle = [
            slice((count - bins) // 2, (count + bins) // 2)
            for count, bins in zip(camera.shape, camera.bin_count[::-1], strict=True)
        ]
        volume = np.zeros((*camera.shape, planes), np.float32)
        volume[*middle] = 1
        ones = project.LFM_forwardProject(kernels, volume, *options)
        norm = project.LFM_backwardProject(backward, ones, *options)
        for _ in range(iterations):
            ratio = np.nan_to_num(noisy / project.LFM_forwardProject(kernels, volume, *options) * ones)
            volume *= np.nan_to_num(project.LFM_backwardProject(backward, ratio, *options) / norm)
        return np.moveaxis(volume[*middle], 2, 0)[:, ::-1, ::-1]

    for method, find in (("deconvolved", ours), ("pyolaf", peers)):
        volume, _, seconds = once(find)
        peaks = np.argwhere((volume == maximum_filter(volume, 5)) & (volume > 1e-3 * volume.max()))
        light, places = [], []
        for peak in peaks:
            around = tuple(slice(max(index - 2, 0), index + 3) for index in peak)
            weights = volume[around]
            index = np.indices(weights.shape) + [[[[part.start]]] for part in around]
            light.append(weights.sum())
            places.append((index * weights).sum((1, 2, 3)) / light[-1])
        z, y, x = np.transpose(places)
        rows, columns = volume.shape[1:]
        found = np.stack([columns / 2 - x - 0.5, rows / 2 - y - 0.5, z - planes // 2], -1)
        apart = found[None] - (np.array(beads) / [voxel, voxel, step])[:, None]
        nearest = np.hypot(np.hypot(apart[..., 0], apart[..., 1]), apart[..., 2]).argmin(1)
        own = apart[np.arange(20), nearest]
        power = np.array(light) / np.mean(np.array(light)[nearest])
        yield {
            "method": method, "iterations": iterations, "found": len(set(nearest.tolist())),
            "aside": float(np.hypot(*own[:, :2].T).max()), "deeper": float(abs(own[:, 2]).max()),
            "faintest": float(power[nearest].min()), "seconds": seconds,
            "other": float(np.delete(power, nearest).max(initial=0)),
        }  # fmt: skip
