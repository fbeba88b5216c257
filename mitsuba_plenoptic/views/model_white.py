"""The white image of a capture's model of light: by rays, or by waves at the wavelengths of the capture.

By waves it is a capture by signed rays of a scene of radiance 1. Where the array is even, pixels at the same place of a
period of the array have the same light but for the noise: a periodic function, of cubic B-splines two to a pixel, is
fitted to all pixels, and replaces them.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from typing import Any

import numpy as np

from ..camera import PlenopticCamera, has_small_lenses, once_a_camera
from ..detector import DetectorOperator
from ..errors import InputError, warn
from ..extension import hook
from ..io import Capture, mosaic_of, recording_of
from ..optics import Spectrum, guards
from ..runtime import DEFAULT_VARIANT, Doubles, Floats, Job, Progress, begin_step, set_variant, steps_counted
from .white import white_image

_SAMPLES = 64
_LENSES = 576
"""Rays a pixel, and lenses of an even array for which they leave noise of less than 0.2 %; fewer lenses get more."""

_RAYS = 2**25
_LEAST = 8
_MOST = 1024
"""Rays of all pixels up to which each gets more than those, and the least and the most that each gets."""

_KNOTS = 2
_PLACES = 8
"""Splines along a pixel, and places along it at which pixels count as one."""

_BLOCK = 2**20
"""Pixels whose splines are evaluated at once."""

_ASIDE = 0.02
"""Pixels by which oblique light may move micro-images of an array that counts as even."""

_UNEVEN = (
    *("mla_tilt", "mla_jitter", "mla_figure_error", "mla_warp", "mla_cra", "mla_transmissions", "mla_absorption"),
    *("vignetting", "distortion", "pixel_response"),
)
"""Parameters of a camera that make lenses, or the light on them, unequal."""


def capture_white(capture: Capture, channels: int, progress: Progress | None = None) -> Floats:
    """Return the white image (rows, columns, 1 or `channels`) of a capture's model of light, for a radiance of 1.

    A recorded capture, and one that states no wavelength or that signed rays do not compute, has that of rays, without
    diffraction.
    """
    camera = capture.camera
    if capture.model == "wave":
        try:
            return _by_waves(camera, _spectrum_of(capture, channels), progress=progress)
        except InputError as error:
            warn(f"white: it is computed by rays, as by waves it cannot be: {error}")
    return white_pixels(camera)[..., None]


@once_a_camera
def white_pixels(camera: PlenopticCamera) -> Floats:
    """Return the white image (rows, columns) of a camera by rays, as bright as its pixels' response leaves it."""
    return white_image(camera).astype(np.float32)


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

    from ..waves import DEFAULT_ACCURACY, SignedCapture

    def white(point: Any, slope: Any, active: Any, *_: Any) -> list[Any]:
        return [dr.select(active, mi.Float(1), 0)]

    if mi.variant() is None:
        set_variant(None)
    with mi.variant_context(DEFAULT_VARIANT) if mi.variant().startswith("scalar") else nullcontext():
        kind: Any = SignedCapture
        if has_small_lenses(camera, max(spectrum.wavelengths)):
            kind = hook("small lenses", f"mla_pitch = {camera.row_pitch:g}")
        flat = np.ones((1, len(spectrum.wavelengths)))
        slope = math.hypot(camera.detector_width, camera.detector_height) / 2 / camera.pupil_distance
        aside = camera.reduced_distance * slope**3 / 2
        even = (
            camera.has_array
            and camera.lens_data.is_thin
            and aside < _ASIDE * camera.pixel_size
            and camera.lens_model == "ideal"
            and not any(np.any(getattr(camera, name) or 0) for name in _UNEVEN)
        )
        lenses = math.prod(camera.shape) / math.prod(_period(camera))
        spp = min(_MOST, max(_SAMPLES, _RAYS // math.prod(camera.shape)))
        spp = min(spp, max(_LEAST, round(_SAMPLES * _LENSES / lenses))) if even else spp
        with guards.watch():
            capture = kind(camera, white, spectrum, flat, None, DEFAULT_ACCURACY)
            # The fit takes about as long as the capture.
            shown = progress and (lambda done, total: progress(done, (1 + even) * total))
            image = capture.compute(seed=0, spp=spp, job=Job(shown), noise=False)
    image /= spectrum.matrix().sum(1)
    if even:
        steps = image.shape[2] * (1 + math.ceil(math.prod(camera.shape) / _BLOCK))
        with steps_counted(lambda done: progress and progress(round(1000 * (1 + done)), 2000), steps):
            image = np.stack([_folded(image[..., channel], camera) for channel in range(image.shape[2])], axis=-1)
    return np.asarray(DetectorOperator.of(camera).forward(image), np.float32)


def _period(camera: PlenopticCamera) -> tuple[float, float]:
    """Return the sides in pixels, in the lattice frame, of the rectangle with which micro-images repeat."""
    along, across = camera.lattice.period(len(camera.mla_focal_lengths))
    return along * camera.image_growth / camera.pixel_size, across * camera.image_growth / camera.pixel_size


def _folded(image: Floats, camera: PlenopticCamera) -> Doubles:
    """Return an image (rows, columns) as the periodic function that is fitted to it."""
    import scipy

    periods = _period(camera)
    fine = max(_KNOTS, min(_PLACES, math.isqrt(int(2**22 / math.prod(periods)))))
    count, places = ((math.ceil(many * periods[0]), math.ceil(many * periods[1])) for many in (_KNOTS, fine))
    x, y = np.meshgrid(*(camera.pixel_coordinates(axis) / camera.image_growth for axis in (0, 1)))
    lattice = camera.lattice
    phases = [
        offset * camera.image_growth / camera.pixel_size / period % 1
        for offset, period in zip(lattice.to_frame(x - lattice.offset[0], y - lattice.offset[1]), periods, strict=True)
    ]
    column, row = ((phase * size).astype(np.int64) % size for phase, size in zip(phases, places, strict=True))
    place = (row * places[0] + column).ravel()
    pixels = np.bincount(place, minlength=math.prod(places))
    used = np.flatnonzero(pixels)
    means = [np.bincount(place, values.ravel(), math.prod(places))[used] / pixels[used] for values in (*phases, image)]
    root = np.sqrt(pixels[used])
    splines = scipy.sparse.diags_array(root) @ _splines(means[0], means[1], count)
    begin_step("periodic image of white")
    fitted = scipy.sparse.linalg.lsqr(
        splines,
        root * means[2],
        atol=1e-5,
        btol=1e-5,
        iter_lim=30,
    )[0]
    rows = []
    for some in np.array_split(np.arange(len(image)), -(-image.size // _BLOCK)):
        begin_step("white image")
        values = _splines(phases[0][some].ravel(), phases[1][some].ravel(), count) @ fitted
        rows.append(values.reshape(len(some), -1))
    return np.concatenate(rows)


def _splines(x: Doubles, y: Doubles, count: tuple[int, int]) -> Any:
    """Return the values (places, splines) of periodic cubic B-splines at phases along both sides of a period."""
    import scipy

    along = []
    for phase, size in zip((x, y), count, strict=True):
        base = np.floor(phase * size)
        t = phase * size - base
        values = (1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, 1 + 3 * (t + t**2 - t**3), t**3
        along.append([((base.astype(np.int64) + step) % size, value / 6) for step, value in enumerate(values)])
    columns = [row * count[0] + column for row, _ in along[1] for column, _ in along[0]]
    weights = [a * b for _, a in along[1] for _, b in along[0]]
    index = np.tile(np.arange(x.size), 16), np.concatenate(columns)
    return scipy.sparse.csr_array((np.concatenate(weights), index), shape=(x.size, math.prod(count)))
