"""Decoding of captures to light fields: micro-images sampled about their true centres, vignetting removed."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import scipy
import xarray as xr

from ..camera import PlenopticCamera, Use, are_alike, require_camera, require_support
from ..errors import InputError, refuse_if, short_repr, suggest_keywords, warn
from ..io import TRUTH_COORDINATES, Capture, CaptureLike, GroundTruth, channel_planes, read_if_path, require_demosaiced
from ..runtime import Floats, Progress, as_pixels, require_memory
from .coordinates import DIMS, light_field
from .fourier_views import decode_views
from .grid import LensGrid, array_places, bin_grid, lens_grid
from .model_white import capture_white, wavelength_of_light
from .white import clear, divide_by_white, open_fraction, recorded_white, white_image


@suggest_keywords
def decode(
    capture: CaptureLike,
    *,
    camera: PlenopticCamera | None = None,
    white: CaptureLike | None = None,
    grid: LensGrid | None = None,
    truth: GroundTruth | None = None,
    progress: Progress | None = None,
) -> xr.DataArray:
    """Return a capture as a light field with one sample per pixel across the pupil and one per lens across the field.

    Micro-images are not a whole number of pixels apart. Each is resampled about its centre by linear interpolation,
    which for a step of one pixel is the mean over a pixel-sized square, so that no light is lost. The capture and the
    white image are sampled alike and then divided. A lattice that is not upright and square is resampled to an upright
    square one, linearly along its rows and between them.

    In a Fourier light-field microscope each lens makes a picture of the whole object: each picture is a view, with one
    sample a pixel across the field, and with the coordinates ``slope_x`` and ``slope_y`` over v and u: the mean slope
    in the object, tan(theta), of the light through the part of its lens that the stop lights. By it `weight` counts
    lenses that the stop cuts. Light fields of a microscope with the array in the native image plane are not decoded.

    Parameters
    ----------
    capture : Capture, (rows, columns[, 3]) array, or path
        The capture, or a file that `read_capture` takes. A plain array needs `camera` or `grid`.
    camera : PlenopticCamera, optional
        The camera of a plain array, or another one than the capture's.
    white : Capture, (rows, columns[, 3]) array, or path, optional
        A picture of something evenly white that fills the view, with the same camera. It is scaled to a radiance of 1
        (see `mitsuba_plenoptic.views.white.recorded_white`). Default: computed from the camera, of wave captures by
        waves, once for a camera and its wavelengths. Without a camera a white picture is needed; the median brightness
        in the middle of micro-images counts as 1, over the quarter of the lenses that is nearest to the middle of the
        grid.
    grid : LensGrid, optional
        Micro-image centres, as `estimate_lens_grid` finds them. Default: those of the camera.
    truth : GroundTruth, optional
        Ground truth of the samples, from `ground_truth` for the same camera; it becomes coordinates of the light field
        over v, u, t and s: ``depth``, ``position_x``, ``normal_x``, ``albedo_r`` and so on, and ``shape_index``.
    progress : callable, optional
        Called with the finished and the total amount of work while a white image by waves is computed.

    Returns
    -------
    xarray.DataArray
        Dimensions ``v, u, t, s[, c]``, see `mitsuba_plenoptic.views.coordinates`. Values are radiance in units of
        the capture, 0 where the coordinate `weight` is 0: the fraction of the pupil's part that belongs to the sample
        through which it sees. The coordinate `white` is what the sample reads of an even radiance of 1. Samples that
        see less than a tenth, or whose lens reads less than that, are left out.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> lf = mp.decode(mp.example("letters-ray"))
    >>> dict(lf.sizes)
    {'v': 11, 'u': 11, 't': 48, 's': 48}
    """
    capture = read_if_path(capture, camera)
    image, reference, seen, camera = checked_images(capture, camera, white, grid, progress)
    if camera is not None and camera.lens_data.images_stop:
        for name, argument in (("grid", grid), ("truth", truth)):
            refuse_if(
                argument is not None,
                f"{name}: a Fourier microscope, each of whose lenses makes a view, is decoded without",
            )
        return decode_views(image, camera, reference, seen)
    if camera is not None:
        lenses = grid or lens_grid(camera)
        bins = bin_grid(camera)
    elif grid is not None:
        lenses = grid
        bins = _upright(grid)
    half, _ = view_window(camera, lenses)
    views = 2 * half + 1
    height, width, channels = image.shape
    # Light, white and weight, each as sampled and in the order of the light field; and the images.
    samples = (math.prod(bins.shape) + math.prod(lenses.shape)) * views**2 * (channels + 2)
    require_memory(
        4.0 * samples + 12.0 * height * width,
        f"light field of {views} x {views} views of {bins.shape[1]} x {bins.shape[0]} pixels",
    )
    light, divisor, weight = lens_samples(image, reference, seen, lenses, camera)
    if not lenses.are_like(bins):
        # Lenses count by what they see, however bright they are.
        resampling = _between_lenses(lenses, bins)
        light *= weight[..., None]
        light, divisor, weight = (
            (resampling @ of_lenses.reshape(math.prod(lenses.shape), -1)).reshape(*bins.shape, *of_lenses.shape[2:])
            for of_lenses in (light, divisor, weight)
        )
        divide_by_white(light, weight.copy(), weight)
        divisor[weight == 0] = 0
        np.minimum(weight, 1, out=weight)
    light, divisor, weight = (
        np.ascontiguousarray(of_bins.transpose(2, 3, 0, 1, *range(4, of_bins.ndim)))
        for of_bins in (light, divisor, weight)
    )
    lf = light_field(light if light.shape[-1] == 3 else light[..., 0], weight, camera, bins, lenses, divisor)
    if isinstance(capture, Capture) and (wavelength := wavelength_of_light(capture)):
        lf.attrs["wavelength"] = json.dumps(wavelength)
    if truth is None:
        return lf
    planes = {TRUTH_COORDINATES[name]: plane for name, plane in channel_planes(truth.views).items()}
    refuse_if(
        not are_alike(truth.camera.regular, camera) or any(plane.shape != lf.shape[:4] for plane in planes.values()),
        "truth: it is of another camera than the light field",
    )
    integer_types = {"shape_index": np.int32}
    return lf.assign_coords(
        {name: (DIMS, plane.astype(integer_types.get(name, plane.dtype))) for name, plane in planes.items()}
    )


def checked_images(
    capture: CaptureLike,
    camera: PlenopticCamera | None,
    white: CaptureLike | None,
    grid: LensGrid | None,
    progress: Progress | None = None,
) -> tuple[np.ndarray, Any, np.ndarray | None, PlenopticCamera | None]:
    """Return image, white image, fractions of the pupil, each (rows, columns, channels), and the camera for `decode`.

    The white image is in units of the radiance 1. The fractions are those of the camera, None where a recorded white
    tells more.
    """
    cameras = [] if camera is None else [camera]
    recorded = read_if_path(capture, camera)
    divisor = read_if_path(white, camera)
    if isinstance(recorded, Capture):
        require_demosaiced(recorded)
        cameras.append(recorded.camera)
    image = as_pixels("capture", recorded)
    refuse_if(
        image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (1, 3)),
        f"capture of shape {image.shape}: it must be an image of 1 or 3 channels",
    )
    refuse_if(grid is not None and not isinstance(grid, LensGrid), f"grid = {short_repr(grid)}: it must be a LensGrid")
    refuse_if(
        not cameras and grid is None,
        "camera = None: a plain array needs its camera, or the grid of its micro-images and a white image",
    )
    upright = require_camera(cameras[0]).regular if cameras else None
    if upright is not None and image.shape[:2] != upright.shape:
        raise InputError(f"capture of shape {image.shape[:2]}: the camera records {upright.shape}")
    if upright is not None:
        require_support(upright, Use.DECODING)
    refuse_if(
        upright is None and white is None, "white = None: without a camera the pupil is known from a white image only"
    )
    reference = seen = None
    if white is not None:
        reference = recorded_white(divisor, (*image.shape[:2], 3), cameras).astype(np.float32).mean(2, keepdims=True)
    if upright is not None:
        computed = white_image(cameras[0], grid)[..., None]
        opened = clear(cameras[0])
        # Of an even pupil a recorded white tells more than the camera: what else cuts it.
        # Parameters by which parts of the pupil may be darker than others.
        if (
            reference is None
            or upright.lens_data.images_stop
            or any(
                getattr(cameras[0], name) != getattr(opened, name)
                for name in ("aperture_image", "pupil_apodisation", "vignetting", "pixel_response", "mla_absorption")
            )
        ):
            seen = computed if opened == cameras[0] else white_image(opened, grid)[..., None]
        if reference is not None:
            reference = recorded_white(reference, reference.shape, [upright], computed[..., 0])
        elif isinstance(recorded, Capture) and recorded.model == "wave":
            reference = capture_white(replace(recorded, camera=cameras[0]), np.atleast_3d(image).shape[2], progress)
        else:
            reference = computed
    return image.reshape(*image.shape[:2], -1).astype(np.float32, copy=False), reference, seen, upright


_ROUNDING = 1e-6
"""Fraction of a pixel by which lengths may be off that are computed from detectors of different sizes."""


def view_window(camera: PlenopticCamera | None, lenses: LensGrid) -> tuple[int, float]:
    """Return the number of views on either side of the central one, and how many pixels from it a lens is alone."""
    reach = lenses.nearest_distance / 2
    views = math.inf
    if camera is not None:
        radius = camera.pupil_radius / camera.pupil_step
        # A lens is alone up to where the micro-image of the next one begins.
        reach = lenses.nearest_distance - radius
        views = math.ceil(radius - 0.5 - _ROUNDING)
    # A sample mixes the pixels whose centres lie within one pixel of it.
    reach = max(reach - 1, 0) + _ROUNDING
    half = int(min(views, math.floor(reach)))
    if camera is not None:
        # Lenses out of focus at the pupil smear its rim over their neighbours' samples, whose depths it would move.
        smear = max(abs(camera.pupil_shift(f2)) for f2 in camera.mla_focal_lengths) - 1
        # Smear of a micro-image's rim, over that of the corners of lenses, up to which it holds hardly any light.
        reach -= max(0.3 * smear * camera.lattice.aperture_reach / camera.pupil_step, 0)
    return half, max(reach, 1 + _ROUNDING)


def _upright(lenses: LensGrid) -> LensGrid:
    """Return an upright square grid of equal density over the area of the lenses."""
    pitch = lenses.pitch
    low, high = (edge(lenses.centres().reshape(-1, 2), axis=0) for edge in (np.min, np.max))
    if lenses.rotation == 0 and lenses.shifted_rows is None and lenses.spacing[0] == lenses.spacing[1]:
        return lenses
    columns, rows = (max(1, round((high[axis] - low[axis]) / pitch) + 1) for axis in (0, 1))
    middle = (low + high) / 2
    start = (float(middle[0] - (columns - 1) / 2 * pitch), float(middle[1] - (rows - 1) / 2 * pitch))
    return LensGrid((pitch, pitch), start, (rows, columns))


def _between_lenses(lenses: LensGrid, bins: LensGrid) -> scipy.sparse.csr_array:
    """Return weights (bins, lenses) that interpolate from lenses to bins: linearly along rows, and between two rows.

    Lenses beyond the grid's edge are left out, so that weights there sum to less than 1.
    """
    rows, columns = lenses.shape
    dx, dy = (lenses.regular(bins.centres().reshape(-1, 2)) - lenses.offset).T
    cosine = math.cos(lenses.rotation)
    sine = math.sin(lenses.rotation)
    x = (cosine * dx + sine * dy) / lenses.spacing[0]
    y = (cosine * dy - sine * dx) / lenses.spacing[1]
    entries = []
    for row in (np.floor(y), np.floor(y) + 1):
        along = x if lenses.shifted_rows is None else x - 0.5 * (row % 2 == lenses.shifted_rows)
        for column in (np.floor(along), np.floor(along) + 1):
            weight = (1 - np.abs(y - row)) * (1 - np.abs(along - column))
            there = (row >= 0) & (row < rows) & (column >= 0) & (column < columns) & (weight > 1e-9)
            lens = (row * columns + column)[there].astype(np.int64)
            entries.append((weight[there].astype(np.float32), np.flatnonzero(there), lens))
    weight, target, source = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    return scipy.sparse.csr_array((weight, (target, source)), shape=(dx.size, rows * columns))


def lens_samples(
    image: Floats, white: Floats, seen: Floats | None, lenses: LensGrid, camera: PlenopticCamera | None
) -> tuple[Floats, Floats, Floats]:
    """Return the radiance of each lens's samples, (rows, columns, v, u, channels), their white, and their weight.

    `seen` tells the fraction of the pupil that pixels see; without it the white does. Without a camera, a white reads 1
    in the middle of the quarter of its lenses that is nearest to their middle, by their median. Behind a tilted array
    steps between samples are those of its micro-images, so that each view is seen from one point of the pupil.
    """
    half, reach = view_window(camera, lenses)
    growth = np.ones(lenses.shape)
    if camera is not None:
        growth *= camera.tilted_growth(camera.array_height(*array_places(camera, lenses.centres())))[1]
        overlap = 2 * camera.pupil_radius / camera.pupil_step - lenses.nearest_distance
        # Half a pixel: no view is lost to less.
        if overlap > 0.5:
            warn(
                f"camera: its micro-images overlap by {overlap:.3g} pixels: samples more than {reach:.3g} from their "
                "middles, which the next lens lights, are left out"
            )
    sampled = partial(_sampled, lenses=lenses, growth=growth, half=half)
    offset = np.arange(-half, half + 1)
    away = np.hypot(offset[:, None], offset)
    light = sampled(image)
    of_colours = sampled(white)
    divisor = of_colours.mean(-1)
    # Diffraction blurs rims more in red than in blue.
    light *= divisor[..., None] / np.maximum(of_colours, 1e-6)
    weight = open_fraction(divisor, away <= reach) if seen is None else sampled(seen)[..., 0].clip(0, 1)
    if camera is None:
        level = divisor[:, :, half, half]
        lit = level > 0
        refuse_if(not lit.any(), "white: it is black in the middle of every micro-image")
        centres = lenses.centres()
        radius = np.hypot(*np.moveaxis(centres - centres.mean(axis=(0, 1)), 2, 0))[lit]
        divisor /= np.median(level[lit][radius <= np.quantile(radius, 0.25)])
    divide_by_white(light, divisor, weight, growth[..., None, None] * away <= reach)
    return light, divisor, weight


def _sampled(image: Floats, lenses: LensGrid, growth: np.ndarray, half: int) -> Floats:
    """Return samples of an image about each micro-image's centre, in steps of its growth, (rows, columns), in pixels.

    The result has the shape (rows, columns, 2 half + 1, 2 half + 1, channels).
    """
    views = 2 * half + 1
    samples = np.zeros((*lenses.shape, views, views, image.shape[2]), dtype=np.float32)
    last = np.array([[image.shape[1]], [image.shape[0]]]) - 1
    offset = np.arange(-half, half + 1)
    for out, row, steps in zip(samples, lenses.centres() - 0.5, growth, strict=True):
        position = row[..., None] + steps[:, None, None] * offset
        for corner in itertools.product((0, 1), (0, 1)):
            pixel = np.floor(position).astype(np.int64) + np.array(corner)[:, None]
            share = ((1 - abs(position - pixel)) * ((pixel >= 0) & (pixel <= last))).astype(np.float32)
            (x, y), (wx, wy) = (np.moveaxis(values, 1, 0) for values in (pixel.clip(0, last), share))
            out += image[y[:, :, None], x[:, None]] * (wy[:, :, None] * wx[:, None])[..., None]
    return samples
