"""The light-field microscope's point spreads against pyolaf's, and the cost of waves in the Fourier arrangement."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
from cases import relative

from mitsuba_plenoptic import CaptureOperator, Objective, PlenopticCamera, render_capture, with_camera

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
            "limit": 2.0 if name == "plane" and size >= 2048 else None,
        }  # fmt: skip


def _plane(camera: PlenopticCamera) -> mi.Scene:
    texels = np.random.default_rng(0).random((256, 256, 1)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    place = mi.ScalarTransform4f().rotate([1, 0, 0], 180).scale(0.35)
    plane = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": texture}}
    return mi.load_dict({"type": "scene", "sensor": camera.to_sensor(), "integrator": {"type": "path"}, "plane": plane})
