"""Refocusing by rays, after Ng, "Digital Light Field Photography" (2006), section 4."""

from __future__ import annotations

import numpy as np

from ..camera import PlenopticCamera
from .methods import Task, method
from .radiance import captures, to_radiance
from .ray_sums import ray_sums
from .white import white_sums


@method("ray", options=("footprint",), waves=False)
def refocus(task: Task, *, footprint: str) -> list[np.ndarray]:
    r"""Follow one ray a pixel back to the object plane and add the pixel's value to the bin it meets.

    The ray goes from the pixel's centre through the centre of its lens. With ``footprint="point"`` the whole value
    goes to one bin; with ``"lens"`` it is spread over the places that the rays through the whole lens meet, because the
    pixel has integrated over the lens: this leaves no grid pattern out of focus. For an unfocused camera that is about
    one bin. Where a focused one is sharp, those places are one point, and what the pixel itself covers is wider: the
    pixel is spread over the wider of the two (see `mitsuba_plenoptic.design`; their convolution is what it has
    integrated over, but once more on the way back that would only blur).

    Bins are divided by what they get of white in the same way. In the plane in focus a point version leaves those bins
    empty that hold no lens's centre; they are NaN.

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance.
    """
    radius = pupil_radius(task.camera)
    reach = [white_sums(task.camera, g, radius, footprint, task.oversample) for g in task.distances]
    sums: list[list[np.ndarray]] = []
    for image, distances, progress in captures(task):
        sums.append([])
        for number, distance in enumerate(distances):
            sums[-1].append(ray_sums(image, task.camera, distance, radius, footprint, task.oversample))
            progress((number + 1) / len(distances))
    return to_radiance(task, sums, reach, reach)


def pupil_radius(camera: PlenopticCamera) -> float:
    """Radius within which a pixel's central ray must pass: half a pixel more than the pupil's, and half a lens's view.

    A pixel at a micro-image's rim is lit in part though its centre may look past the pupil; leaving such pixels out
    would lose 3 % of the paper's light. Through the edge of a lens that is not in focus on the pupil it looks elsewhere
    than through the centre, for a focused camera by a good part of the pupil.
    """
    view = max(abs(camera.pupil_shift(f2) - 1) for f2 in camera.mla_focal_lengths) * camera.lattice.aperture_reach
    return camera.lit_radius + view
