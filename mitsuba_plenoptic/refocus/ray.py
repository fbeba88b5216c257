"""Refocusing with the ray model, after Ng, "Digital Light Field Photography" (2006), section 4."""

from collections.abc import Sequence

from ..runtime import Array
from .methods import Progress, Task, method
from .projection import pupil_radius, ray_sums
from .radiance import divided_by_white


@method("ray", waves=False)
def refocus(task: Task, *, footprint: str) -> list[Array]:
    r"""Return images of bins, to which each pixel's value is added along one ray back to the object plane.

    The ray passes the centres of the pixel and of its lens. With ``footprint="point"`` the whole value is added to one
    bin. With ``"lens"`` it is spread over the area that rays through the whole lens hit, because the pixel has
    integrated over the lens: this avoids grid patterns out of focus. For an unfocused camera the area is about one bin.
    Where a focused camera is sharp it shrinks to a point, and the projected pixel is wider: the value is spread over
    the wider of the two (see `mitsuba_plenoptic.design`). The pixel has integrated over the convolution of both, but
    spreading the value over it would only blur the image further.

    Each bin is divided by the light that it receives from a white scene by the same method. In the plane in focus,
    ``"point"`` leaves bins empty that do not contain the centre of a lens; they are NaN.

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance.
    """
    radius = pupil_radius(task.camera)

    def sums_of(image: Array, distances: Sequence[float], progress: Progress) -> list[Array]:
        sums = []
        for index, distance in enumerate(distances):
            sums.append(ray_sums(image, task.camera, distance, radius, footprint, task.oversample))
            progress((index + 1) / len(distances))
        return sums

    return divided_by_white(task, sums_of, radius, footprint, "ray", radius, footprint)
