"""Refocused images from one capture, by rays and by waves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, overload

import numpy as np

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..errors import InputError, require_count, require_number, shown
from ..io.captures import Capture, as_array
from ..optics import guards
from ..runtime.backend import one_at_a_time
from ..runtime.limits import largest_fitting, require_memory
from ..thin_lens import image_distance
from .ray import reconstruct_ray
from .result import Reconstruction, write_reconstruction
from .wave import reconstruct_wave

__all__ = ["FOOTPRINTS", "METHODS", "Reconstruction", "reconstruct", "write_reconstruction"]

METHODS = ("ray", "coherent", "partial")
FOOTPRINTS = ("lens", "point")

_PROGRESS_STEPS = 100


@overload
def reconstruct(
    capture: Capture | np.ndarray,
    distance: float,
    *,
    method: str = ...,
    camera: PlenopticCamera | None = ...,
    wavelength: float | Sequence[float] | None = ...,
    interleave: int | str = ...,
    footprint: str = ...,
    relay: bool = ...,
    oversample: int = ...,
    progress: Callable[[int, int], None] | None = ...,
) -> Reconstruction: ...
@overload
def reconstruct(
    capture: Capture | np.ndarray,
    distance: Sequence[float],
    *,
    method: str = ...,
    camera: PlenopticCamera | None = ...,
    wavelength: float | Sequence[float] | None = ...,
    interleave: int | str = ...,
    footprint: str = ...,
    relay: bool = ...,
    oversample: int = ...,
    progress: Callable[[int, int], None] | None = ...,
) -> list[Reconstruction]: ...
@one_at_a_time
def reconstruct(
    capture: Capture | np.ndarray,
    distance: float | Sequence[float],
    *,
    method: str = "ray",
    camera: PlenopticCamera | None = None,
    wavelength: float | Sequence[float] | None = None,
    interleave: int | str = 2,
    footprint: str = "lens",
    relay: bool = True,
    oversample: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Reconstruction | list[Reconstruction]:
    """Refocus a capture to one or several object distances.

    Images are in units of radiance, whatever the method: a capture of a white scene gives about 1.

    Parameters
    ----------
    capture : Capture or (rows, columns[, channels]) array
        What the detector recorded. A plain array needs `camera`.
    distance : float or sequence of floats
        Object distances in scene units, beyond the focal length. Several share the way up to the main lens.
    method : {"ray", "coherent", "partial"}
        How light is followed back: by one ray a pixel; as one coherent wave, whose amplitude is the square root of
        the capture; or as one such wave for each interleaved subset of lenses, whose intensities are added. Waves
        pass the camera's lenses as thin parabolic phase elements.
    camera : PlenopticCamera, optional
        The camera of a plain array, or another one than the capture's.
    wavelength : float or three floats, optional
        For waves: wavelength in nanometres, or one for each of three channels. Default: the capture's own.
    interleave : int or "auto"
        For ``partial``: a subset is every `interleave`-th lens along both axes. 2 makes four waves; 1 is ``coherent``;
        ``"auto"`` is the limit of large periods, where no two lenses interfere; its last bits follow the number of the
        BLAS's threads.
    footprint : {"lens", "point"}
        For rays: whether a pixel spreads over what its whole lens sees, or goes to one bin.
    relay : bool
        For waves: whether the microlenses act a second time, in the MLA plane. Without it, which is the literal reading
        of the paper, planes out of focus stay blurred: see `mitsuba_plenoptic.reconstruction.coherent`.
    oversample : int
        Bins per lens along each axis. A focused camera tells more than one apart:
        `mitsuba_plenoptic.design.suitable_oversample` and ``mitsuba-plenoptic info`` say how many.
    progress : callable, optional
        Called with the steps done and their number.

    Returns
    -------
    Reconstruction or list of Reconstruction
        One for a single distance, a list for a sequence.

    Raises
    ------
    InputError
        If there is no camera, or no wavelength for a wave method; if the array does not fit the camera or holds NaN or
        infinity, or negative pixels for a wave method; or if an option is out of range.
    PhysicsError
        If next to none of a capture's light goes back through the main lens by waves, or too much of it misses the
        object plane's window.
    """
    capture = _as_capture(capture, camera)
    camera = capture.camera
    if method not in METHODS:
        raise InputError(f"method = {shown(method)}: it must be one of {', '.join(METHODS)}")
    if footprint not in FOOTPRINTS:
        raise InputError(f"footprint = {shown(footprint)}: it must be one of {', '.join(FOOTPRINTS)}")
    if not (isinstance(interleave, str) and interleave == "auto"):
        interleave = _require_interleave(interleave, camera)
    oversample = require_count("oversample", oversample)
    if isinstance(distance, (str, bytes)):
        raise InputError(f"distance = {shown(distance)}: it must be a number or several")
    single = np.ndim(distance) == 0
    distances = [require_number("distance", value) for value in ([distance] if single else distance)]  # type: ignore[union-attr]
    for value in distances:
        image_distance(camera.focal_length, value)
    if method != "ray":
        _require_positive(capture.image)
    if not distances:
        raise InputError("distance = []: give at least one")
    _require_memory(camera, distances, oversample, capture.image, waves=method != "ray")
    planes = capture.image if capture.image.ndim == 3 else capture.image[..., None]

    options: dict[str, Any] = {"oversample": oversample}
    shares: dict[str, float] = {}
    if method == "ray":
        options |= {"footprint": footprint}
        images = []
        for done, value in enumerate(distances):
            _report(progress, done, len(distances))
            images.append(reconstruct_ray(planes, camera, value, footprint=footprint, oversample=oversample))
        _report(progress, len(distances), len(distances))
    else:
        wavelengths = _wavelengths(capture, wavelength, planes.shape[2])
        interleave = 1 if method == "coherent" else interleave
        options |= {"interleave": interleave, "relay": bool(relay), "wavelength": wavelengths}
        channels = []
        with guards.watch() as shares:
            for channel, value in enumerate(wavelengths):

                def step(share: float, channel: int = channel) -> None:
                    total = _PROGRESS_STEPS * len(wavelengths)
                    _report(progress, round((channel + share) * _PROGRESS_STEPS), total)

                step(0)
                channels.append(
                    reconstruct_wave(
                        planes[..., channel],
                        camera,
                        distances,
                        value,
                        interleave=interleave,
                        relay=relay,
                        oversample=oversample,
                        progress=step,
                    )
                )
        images = [np.stack(planes, axis=-1) for planes in zip(*channels, strict=True)]

    results = [
        Reconstruction(
            image=image if capture.image.ndim == 3 else image[..., 0],
            distance=value,
            bin_size=camera.bin_size(value) / oversample,
            method=method,
            camera=camera,
            options=options,
            guards=shares,
        )
        for value, image in zip(distances, images, strict=True)
    ]
    return results[0] if single else results


def _require_memory(
    camera: PlenopticCamera, distances: Sequence[float], oversample: int, image: np.ndarray, *, waves: bool
) -> None:
    """Refuse images too large, before anything is allocated."""
    columns, rows = camera.bin_count
    channels = image.shape[2] if image.ndim == 3 else 1

    def memory(oversample: int) -> float:
        bins = columns * rows * float(oversample) ** 2
        # By rays one axis is binned before the other; by waves powers are summed in double precision.
        work = 12 * bins if waves else 4 * channels * (bins + image.shape[0] * columns * oversample)
        return 4 * channels * bins * (len(distances) + 1) + work

    def fitting(limit: float) -> str | None:
        largest = largest_fitting(memory, limit, oversample)
        return f"oversample = {largest}" if largest else None

    what = f"images of {columns * oversample} x {rows * oversample} bins at {len(distances)} distances"
    require_memory(memory(oversample), what, fitting)
    # Dr.Jit counts in 32 bits.
    values = channels * columns * oversample * max(rows * oversample, image.shape[0])
    if not waves and values >= 2**32:
        raise InputError(f"{what}: {values} values are summed at once, at most {2**32 - 1} can be")


def _as_capture(capture: Capture | np.ndarray, camera: PlenopticCamera | None) -> Capture:
    if isinstance(capture, Capture):
        if camera is None:
            return capture
        return Capture(capture.image, camera, capture.wavelength, capture.model, capture.metadata)
    if camera is None:
        raise InputError("camera = None: a plain array needs the camera that recorded it, reconstruct(..., camera=...)")
    return Capture(as_array("capture", capture), camera)


def _require_interleave(interleave: Any, camera: PlenopticCamera) -> int:
    lenses = max(camera.lens_count)
    try:
        return require_count("interleave", interleave, maximum=lenses)
    except InputError:
        raise InputError(
            f"interleave = {shown(interleave)}: it must be 'auto' or a whole number from 1 to {lenses}, "
            "the lenses along an axis"
        ) from None


def _require_positive(image: np.ndarray) -> None:
    if image.min() < 0:
        bad = int((image < 0).sum())
        raise InputError(f"capture: {bad} of its pixels are negative: a wave's amplitude is their square root")


def _wavelengths(capture: Capture, wavelength: Any, channels: int) -> list[float]:
    """Wavelength of each channel."""
    given: Any = capture.wavelength if wavelength is None else wavelength
    if given is None:
        raise InputError(
            "wavelength = None: a wave method needs one, the capture's or reconstruct(..., wavelength=...)"
        )
    values = [given] * channels if np.ndim(given) == 0 else list(given)
    if len(values) != channels:
        raise InputError(f"wavelength = {shown(given)}: the capture has {channels} channels; give one, or one for each")
    return [require_wavelength(value) for value in values]


def _report(progress: Callable[[int, int], None] | None, done: int, total: int) -> None:
    if progress:
        progress(done, total)
