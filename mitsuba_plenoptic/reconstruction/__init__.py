"""Refocused images from one capture, by rays and by waves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import overload

import numpy as np

from ..camera import PlenopticCamera, image_distance
from ..capture import Capture
from ..errors import InputError, require_number
from .ray import reconstruct_ray
from .result import Reconstruction, write_reconstruction

__all__ = ["METHODS", "Reconstruction", "reconstruct", "write_reconstruction"]

METHODS = ("ray",)
FOOTPRINTS = ("lens", "point")


@overload
def reconstruct(
    capture: Capture | np.ndarray,
    distance: float,
    *,
    method: str = ...,
    camera: PlenopticCamera | None = ...,
    footprint: str = ...,
    progress: Callable[[int, int], None] | None = ...,
) -> Reconstruction: ...
@overload
def reconstruct(
    capture: Capture | np.ndarray,
    distance: Sequence[float],
    *,
    method: str = ...,
    camera: PlenopticCamera | None = ...,
    footprint: str = ...,
    progress: Callable[[int, int], None] | None = ...,
) -> list[Reconstruction]: ...
def reconstruct(
    capture: Capture | np.ndarray,
    distance: float | Sequence[float],
    *,
    method: str = "ray",
    camera: PlenopticCamera | None = None,
    footprint: str = "lens",
    progress: Callable[[int, int], None] | None = None,
) -> Reconstruction | list[Reconstruction]:
    """Refocus a capture to one or several object distances.

    Parameters
    ----------
    capture : Capture or (rows, columns[, channels]) array
        What the detector recorded. A plain array needs `camera`.
    distance : float or sequence of floats
        Object distances in scene units, beyond the focal length.
    method : {"ray"}
        How light is followed back.
    camera : PlenopticCamera, optional
        The camera of a plain array, or another one than the capture's.
    footprint : {"lens", "point"}
        For rays: whether a pixel spreads over what its whole lens sees, or goes to one bin.
    progress : callable, optional
        Called with the distances done and their number.

    Returns
    -------
    Reconstruction or list of Reconstruction
        One for a single distance, a list for a sequence.

    Raises
    ------
    InputError
        If there is no camera, the array does not fit it or holds NaN or infinity, or an option is out of range.
    """
    if isinstance(capture, Capture):
        if camera is not None:
            capture = Capture(capture.image, camera, capture.wavelength, capture.model, capture.metadata)
    elif camera is None:
        raise InputError("camera = None: a plain array needs the camera that recorded it, reconstruct(..., camera=...)")
    else:
        capture = Capture(np.asarray(capture), camera)
    if method not in METHODS:
        raise InputError(f"method = {method!r}: it must be one of {', '.join(METHODS)}")
    if footprint not in FOOTPRINTS:
        raise InputError(f"footprint = {footprint!r}: it must be one of {', '.join(FOOTPRINTS)}")
    single = np.ndim(distance) == 0
    distances = [require_number("distance", value) for value in ([distance] if single else distance)]  # type: ignore[union-attr]
    for value in distances:
        image_distance(capture.camera.focal_length, value)
    image = capture.image
    # The sum is not finite if any pixel is not, and costs far less than a test of each.
    if not np.isfinite(image.sum(dtype=np.float64 if image.size < 2**20 else np.float32)):
        bad = int(image.size - np.isfinite(image).sum())
        if bad:
            raise InputError(f"capture: {bad} of its pixels are NaN or infinite: all must be finite")

    planes = image if image.ndim == 3 else image[..., None]
    results = []
    for done, value in enumerate(distances):
        if progress:
            progress(done, len(distances))
        refocused = reconstruct_ray(planes, capture.camera, value, footprint=footprint)
        results.append(
            Reconstruction(
                image=refocused if image.ndim == 3 else refocused[..., 0],
                distance=value,
                bin_size=capture.camera.bin_size(value),
                method=method,
                camera=capture.camera,
                options={"footprint": footprint},
            )
        )
    if progress:
        progress(len(distances), len(distances))
    return results[0] if single else results
