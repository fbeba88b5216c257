"""Checks of the arguments of `reconstruct`: each function returns the form for the methods, or refuses the value."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..detector import require_demosaiced
from ..errors import InputError, argument, require_choice, require_count, require_number, short_repr
from ..io.captures import Capture, as_array
from ..optics.phase import in_millimetres
from ..runtime.limits import largest_fitting, require_memory

FOOTPRINTS = ("lens", "point")
RESPONSES = ("wave", "ray")


def as_capture(capture: Capture | np.ndarray, camera: PlenopticCamera | None) -> Capture:
    """Return the capture with its camera, or with another that is given."""
    if isinstance(capture, Capture):
        require_demosaiced(capture)
        if camera is None:
            return capture
        return Capture(capture.image, camera, capture.wavelength, capture.model, capture.metadata)
    if camera is None:
        raise InputError("camera = None: a plain array needs the camera that recorded it; give camera")
    return Capture(as_array("capture", capture), camera)


def require_upright(camera: PlenopticCamera) -> None:
    """Refuse a tilted array behind a real main lens."""
    if not camera.lens_data.is_thin and any(camera.mla_tilt):
        raise InputError(f"mla_tilt = {camera.mla_tilt}: captures through a main_lens are reconstructed with 0 only")


def require_distances(distance: Any, camera: PlenopticCamera) -> list[float]:
    """Return the distances, all of which lie before the camera."""
    try:
        several = np.ndim(distance) > 0
    except ValueError:
        # Lists of several lengths.
        several = None
    if several is None or isinstance(distance, (str, bytes)):
        raise InputError(f"distance = {short_repr(distance)}: it must be a number or several")
    given = distance if several else [distance]
    distances = [require_number("distance", value, finite=False) for value in given]
    for value in distances:
        camera.lens_data.require_distance(camera, value)
    if not distances:
        raise InputError("distance = []: give at least one")
    return distances


def require_interleave(interleave: Any, camera: PlenopticCamera) -> int | str:
    """Return the period of the subsets of lenses, or ``"auto"``."""
    if isinstance(interleave, str) and interleave == "auto":
        return interleave
    lenses = max(camera.lens_count)
    try:
        return require_count("interleave", interleave, maximum=lenses)
    except InputError:
        raise InputError(
            f"interleave = {short_repr(interleave)}: it must be 'auto' or a whole number from 1 to {lenses}, "
            "the lenses along an axis"
        ) from None


def require_response(response: Any, capture: Capture, wavelength: Any) -> str:
    """Return the model of the light: if not given, the wave model if there is a wavelength, else the capture's own."""
    if response is None:
        return capture.model if wavelength is None else "wave"
    if require_choice("response", response, RESPONSES) == "ray" and wavelength is not None:
        raise InputError(f"{argument('wavelength')}: a response by rays has none; leave it out")
    return str(response)


def require_wavelengths(capture: Capture, wavelength: Any, channels: int, camera: PlenopticCamera) -> list[float]:
    """Return the wavelength of each channel; scalar waves go through lenses that are wider."""
    given: Any = capture.wavelength if wavelength is None else wavelength
    if given is None:
        raise InputError(
            f"wavelength = None: a wave method needs one, and the capture has none; give {argument('wavelength')}"
        )
    values = [given] * channels if np.ndim(given) == 0 else list(given)
    if len(values) != channels:
        raise InputError(
            f"wavelength = {short_repr(given)}: the capture has {channels} channels; give one, or one for each"
        )
    found = [require_wavelength(value) for value in values]
    if in_millimetres(max(found)) >= min(camera.mla_pitches):
        raise InputError(
            f"wavelength = {max(found):g} nm: it must be less than the pitch of the microlenses, "
            f"{min(camera.mla_pitches):g} mm"
        )
    return found


def require_image_memory(
    camera: PlenopticCamera, distances: Sequence[float], oversample: int, shape: tuple[int, ...], drawn_back: bool
) -> None:
    """Refuse images too large, before anything is allocated."""
    columns, rows = camera.bin_count
    height, _, channels = shape

    def memory(oversample: int) -> float:
        across, down = float(columns * oversample), float(rows * oversample)
        # Ray methods bin one axis before the other; wave methods sum powers in double precision.
        fits = 20 * 8 * channels * across * down if drawn_back else 0
        return 4 * channels * across * (down * (len(distances) + 1) + height) + 12 * across * down + fits

    def fitting(limit: float) -> str | None:
        largest = largest_fitting(memory, limit, oversample)
        return f"{argument('oversample')} = {largest}" if largest else None

    what = f"images of {columns * oversample} x {rows * oversample} bins at {len(distances)} distances"
    require_memory(memory(oversample), what, fitting)
