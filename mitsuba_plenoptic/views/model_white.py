"""The white image of a capture's model of light: by rays, or by waves at the wavelengths of the capture.

By waves it is a capture by signed rays of a radiance of 1, and right to 0.2 % of its level. Noise of 1 % remains where
random rays are needed: behind `pixel_response` near the microlenses' focus, and `vignetting` without an array.
"""

import math
from contextlib import nullcontext
from typing import Any

import numpy as np

from ..camera import PlenopticCamera, has_small_lenses, once_a_camera
from ..design import overlap_warnings
from ..detector import DetectorOperator
from ..errors import InputError, warn
from ..extension import hook
from ..io import RECORDED, Capture, mosaic_of, recording_of
from ..optics import Spectrum, guards
from ..runtime import DEFAULT_VARIANT, Floats, Job, Progress, set_variant
from .white import white_image

_SAMPLES = 64
_RAYS = 2**25
_MOST = 1024
"""Random rays a pixel where some are needed, those of all pixels up to which each gets more, and the most of each."""


def capture_white(capture: Capture, channels: int, progress: Progress | None = None) -> Floats:
    """Return the white image (rows, columns, 1 or `channels`) of a capture's model of light, for a radiance of 1.

    A recorded capture, and one that states no wavelength or that signed rays do not compute, has that of rays, without
    diffraction; so has that of a Fourier microscope whose micro-images overlap, where a pixel's own lens counts.
    """
    overlaps = capture.camera.lens_data.images_stop and any(overlap_warnings(capture.camera))
    if capture.model == "wave" and not overlaps:
        try:
            return wave_white(capture, channels, progress)
        except InputError as error:
            warn(f"white: it is computed by rays, as by waves it cannot be: {error}")
    return white_pixels(capture.camera)[..., None]


def wave_white(capture: Capture, channels: int, progress: Progress | None = None) -> Floats:
    """Return the white image (rows, columns, 1 or `channels`) of a capture by waves, for a radiance of 1.

    Raises an `InputError` where signed rays do not compute such captures.
    """
    return _by_waves(capture.camera, _spectrum_of(capture, channels), progress=progress)


@once_a_camera
def white_pixels(camera: PlenopticCamera) -> Floats:
    """Return the white image (rows, columns) of a camera by rays, as bright as its pixels' response leaves it."""
    return white_image(camera).astype(np.float32)


def wavelength_of_light(capture: Capture) -> float | None:
    """Return the mean wavelength in nm of a capture's light, 550 of a real camera's; None by rays, or if unstated."""
    if RECORDED in capture.metadata:
        return 550.0
    if capture.model != "wave":
        return None
    try:
        spectrum = _spectrum_of(capture, capture.image.shape[2] if capture.image.ndim == 3 else 1)
    except InputError:
        return None
    return float(np.average(spectrum.wavelengths, weights=np.abs(spectrum.matrix()).sum(0)))


def _spectrum_of(capture: Capture, channels: int) -> Spectrum:
    """Return the wavelengths of a wave capture with the responses of its channels."""
    spectrum = capture.metadata.get("spectrum")
    if isinstance(spectrum, dict) and len(spectrum["responses"]) == channels:
        return Spectrum(tuple(spectrum["wavelengths"]), tuple(map(tuple, spectrum["responses"])))
    stated: Any = capture.wavelength
    if stated is None and mosaic_of(capture):
        stated = recording_of(capture).get("wavelength")
    if stated is None:
        # A luminance film adds up several wavelengths.
        stated = [float(value) for value in str(capture.metadata.get("wavelength", "")).split(",") if value]
        if channels == 1 and len(stated) == 3:
            return Spectrum(tuple(stated), ((0.2126, 0.7152, 0.0722),))
    if not np.size(stated):
        raise InputError("wavelength = None: the capture states none")
    return Spectrum.lines(*np.unique(stated).tolist() if np.size(stated) != channels else np.ravel(stated).tolist())


@once_a_camera
def _by_waves(camera: PlenopticCamera, spectrum: Spectrum, progress: Progress | None = None) -> Floats:
    """Return the white image (rows, columns, channels) of a spectrum's channels, each of which records 1 of white."""
    # Most white images need neither of these.
    import drjit as dr
    import mitsuba as mi

    from ..waves import DEFAULT_ACCURACY, WhiteCapture

    def white(point: Any, slope: Any, active: Any, *_: Any) -> list:
        return [dr.select(active, mi.Float(1), 0)]

    if mi.variant() is None:
        set_variant(None)
    with mi.variant_context(DEFAULT_VARIANT) if mi.variant().startswith("scalar") else nullcontext():
        kind: Any = WhiteCapture
        if has_small_lenses(camera, max(spectrum.wavelengths)):
            kind = hook("small lenses", f"mla_pitch = {camera.row_pitch:g}")
        flat = np.ones((1, len(spectrum.wavelengths)))
        with guards.watch():
            capture = kind(camera, white, spectrum, flat, None, DEFAULT_ACCURACY)
            spp = min(_MOST, max(_SAMPLES, _RAYS // math.prod(camera.shape)))
            image = capture.compute(seed=0, spp=spp, job=Job(progress), noise=False)
    image /= spectrum.matrix().sum(1)
    return np.asarray(DetectorOperator.of(camera).forward(image), np.float32)
