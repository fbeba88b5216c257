"""The cost of a scene's wave capture by signed rays, from parts that are timed in one run with ray captures.

A capture by signed rays is a ray capture, timed as it is, the coefficients of each ray that meets light, and the
Fourier transforms of the images: one for each coefficient forwards, and one back. Kernels and tables are planned once a
camera. Prints the parts in seconds and their sum over the ray capture's time, which is what to compare.

    python tools/phase_space_cost.py [--pixels 4096] [--samples 16] [--scenes letters still_life]
"""

from __future__ import annotations

import argparse
import time

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.optics.main_lens import main_lens
from mitsuba_plenoptic.optics.phase_space import PhaseSpace, RayCoefficients

RAYS = 1 << 22


def main() -> int:
    """Time the parts and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, default=4096, help="of the paper's detector across")
    parser.add_argument("--samples", type=int, default=16, help="rays a pixel")
    parser.add_argument("--scenes", nargs="+", default=["letters", "still_life"])
    parser.add_argument("--degrees", nargs="+", type=int, default=[2, 4])
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_mono")
    captures = {}
    for name in arguments.scenes:
        scene = mp.load_scene(name, parameters={"resolution": str(arguments.pixels)})
        start = time.perf_counter()
        image = mp.render_capture(scene, model="ray", spp=arguments.samples).image
        captures[name] = time.perf_counter() - start, float((np.asarray(image) > 0).mean())
    transform = fft_time(arguments.pixels)
    print("| scene | degree | values | lit pixels | ray capture | coefficients | transforms | sum over ray capture |")
    print("|---|---|---|---|---|---|---|---|")
    for degree in arguments.degrees:
        plan = PhaseSpace(mp.PlenopticCamera(), 633.0, degree=degree)
        ray = coefficient_time(plan.bind())
        count = len(plan.exponents)
        for name, (seconds, lit) in captures.items():
            coefficients = ray * lit * arguments.samples * arguments.pixels**2
            total = seconds + coefficients + (count + 1) * transform
            print(
                f"| {name} | {degree} | {count} | {lit:.2f} | {seconds:.1f} s | {coefficients:.1f} s "
                f"| {(count + 1) * transform:.1f} s | {total / seconds:.2f} |",
                flush=True,
            )
    return 0


def coefficient_time(coefficients: RayCoefficients) -> float:
    """Return the seconds that the coefficients of a ray take, added up over the rays of a pixel."""
    plan, chance = coefficients.plan, mi.PCG32(size=RAYS)
    radius, pitch = main_lens(plan.camera).pupil_radius, plan.camera.mla_pitch
    best = np.inf
    for _ in range(3):
        point = tuple((chance.next_float32() - 0.5) * (1.25 * pitch) for _ in range(2))
        pupil = tuple((chance.next_float32() - 0.5) * (1.4 * radius) for _ in range(2))
        jitter = tuple(chance.next_float32() for _ in range(4))
        dr.eval(point, pupil, jitter, chance)
        dr.sync_thread()
        start = time.perf_counter()
        values = coefficients(point, pupil, jitter, mi.Bool(True))
        dr.eval([dr.block_sum(value, 16) for value in values])
        dr.sync_thread()
        best = min(best, time.perf_counter() - start)
    return best / RAYS


def fft_time(pixels: int) -> float:
    """Return the seconds of one real transform of the detector."""
    image = np.random.default_rng(0).random((pixels, pixels), np.float32)
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        scipy.fft.rfft2(image, workers=-1)
        best = min(best, time.perf_counter() - start)
    return best


if __name__ == "__main__":
    raise SystemExit(main())
