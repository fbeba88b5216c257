r"""Demosaicking of colour-filter mosaics to three channels, micro-image by micro-image.

A missing colour is estimated from the surrounding pixels of that colour, as ratio to the pixels' values for white:

.. math:: \hat{I}_c(p) = W(p) \, \frac{\sum_q k(p - q) \, m_c(q) \, I(q)}{\sum_q k(p - q) \, m_c(q) \, W(q)}

with the filters :math:`m_c` and the white image W. This is normalised convolution, with the white image as certainty
(Knutsson and Westin 1993). Only pixels q of the lens of p count, since light in a neighbour's micro-image comes from
elsewhere. Where it has none near p, the sums are over its whole micro-image, or that of the nearest lens that has the
colour. Recorded pixels are unchanged.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.ndimage import distance_transform_edt

from ... import choices
from ...detector import filters
from ...errors import InputError, argument, refuse_if, require_choice, suggest_keywords
from ...io import EXPOSED, RECORDED, Capture, mosaic_of, recording_of
from ...runtime import Floats, Progress
from ...views import capture_white, lens_numbers, recorded_white, white_image

METHODS = ("micro-images", "plain")


@suggest_keywords
def demosaic(
    capture: Capture,
    *,
    mosaic: str | None = None,
    white: Capture | None = None,
    method: str = "micro-images",
    progress: Progress | None = None,
) -> Capture:
    """Estimate all three colours of every pixel of a capture that was recorded through a mosaic of filters.

    Parameters
    ----------
    capture : Capture
        A capture exposed by `expose` with a mosaic, or a raw picture of a real camera.
    mosaic : {"RGGB", "GRBG", "GBRG", "BGGR"}, optional
        The filters of the first two pixels of the detector's first row and of its second. Default: what the capture
        says.
    white : Capture, optional
        Capture of something white by the same camera, with one channel or three. Default: computed by the capture's
        model of light; a recorded picture counts as one by rays.
    method : {"micro-images", "plain"}
        ``micro-images`` keeps micro-images apart, and knows how they darken towards their rims. ``plain`` does not:
        bilinear interpolation, as for photographs, to compare with, and for cameras without microlenses.
    progress : callable, optional
        Called with the finished and the total amount of work while a white image by waves is computed.

    Returns
    -------
    Capture
        The capture with three channels, and with the wavelengths before the exposure.
    """
    require_choice("method", method, METHODS)
    if capture.image.ndim != 2:
        raise InputError(f"capture of {capture.image.shape[2]} channels: a mosaic has one")
    stated = mosaic_of(capture)
    refuse_if(
        mosaic is None and stated is None, f"mosaic = None: the capture does not state it; give {argument('mosaic')}"
    )
    refuse_if(
        stated is not None and stated not in choices.MOSAICS,
        f"mosaic = {stated}: each lens has one colour; dual_pixel gives pictures that are Bayer mosaics",
    )
    mosaic = require_choice("mosaic", stated if mosaic is None else mosaic, choices.MOSAICS)
    camera = capture.camera
    filter_channels = filters(capture.camera, mosaic)
    if not camera.has_array:
        method = "plain"
    if method == "plain":
        refuse_if(white is not None, "white: method plain does not take it; it is for micro-images")
        certainty = np.ones((*camera.shape, 3), np.float32)
        lenses = np.zeros(camera.shape, np.int64)
    else:
        camera.require_resolved()
        certainty = _certainty(capture, white, progress)
        lenses = lens_numbers(camera)
    # An image (rows, columns, 3) with the missing channels of each pixel interpolated.
    reach = 1 if method == "plain" else 2
    rows, columns = capture.image.shape
    light, weight = np.zeros((2, rows, columns, 3), np.float32)
    for across, down, kernel in _shifts(reach):
        here = _window(rows, -down), _window(columns, -across)
        there = _window(rows, down), _window(columns, across)
        same = kernel * (lenses[here] == lenses[there])
        for channel in range(3):
            same_channel = same * (filter_channels[there] == channel)
            light[(*here, channel)] += same_channel * capture.image[there]
            weight[(*here, channel)] += same_channel * certainty[(*there, channel)]
    # The colour of the whole lens counts faintly, and alone where no near pixel has the channel.
    faint = 1e-5 * certainty.max()
    for channel in range(3):
        of_lens, white_of_lens = (
            np.bincount(lenses.ravel(), ((filter_channels == channel) * each).ravel())[lenses]
            for each in (capture.image, certainty[..., channel])
        )
        dark = white_of_lens <= 1e4 * faint
        refuse_if(dark.all(), f"mosaic = {mosaic}: no lit pixel has the colour {'RGB'[channel]}")
        nearest = tuple(distance_transform_edt(dark, return_distances=False, return_indices=True))
        light[..., channel] += faint * of_lens[nearest] / white_of_lens[nearest]
    image = np.asarray(
        np.where(
            filter_channels[..., None] == np.arange(3), capture.image[..., None], certainty * light / (weight + faint)
        ),
        np.float32,
    )
    metadata = dict(capture.metadata)
    wavelength = capture.wavelength
    if stated is not None:
        recording = {**recording_of(capture), "mosaic": None, "demosaiced": mosaic}
        stated_wavelength = recording.pop("wavelength", None)
        metadata[EXPOSED if EXPOSED in metadata else RECORDED] = recording
        wavelength = tuple(stated_wavelength) if isinstance(stated_wavelength, (list, tuple)) else stated_wavelength
    return replace(capture, image=image, wavelength=wavelength, noise=None, metadata=metadata)


def balanced(white: Capture, mosaic: str) -> Floats:
    """Return a white capture's mosaic, with each pixel divided by the mean over pixels of the same filter."""
    filter_channels = filters(white.camera, mosaic)
    image = white.image
    means = np.bincount(filter_channels.ravel(), image.ravel(), minlength=3) / np.bincount(
        filter_channels.ravel(), minlength=3
    )
    refuse_if(not means.min() > 0, "white: the pixels of a filter are black")
    return np.asarray(image / means[filter_channels], np.float32)


def _certainty(capture: Capture, white: Capture | None, progress: Progress | None) -> Floats:
    """Return the white image, (rows, columns, 3), as the certainty of each pixel and channel."""
    if white is None:
        image = capture_white(capture, 3, progress)
    else:
        computed = white_image(capture.camera) if capture.camera.lens_data.is_thin else None
        image = recorded_white(white, (*capture.image.shape, 3), [capture.camera], computed)
    return np.broadcast_to(np.maximum(image, 0), (*capture.image.shape, 3))


def _shifts(reach: int) -> Iterator[tuple[int, int, float]]:
    """Yield steps along columns and rows to the surrounding pixels, and the pixels' weights."""
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            if reach == 1:
                yield across, down, (2.0 - abs(across)) * (2.0 - abs(down))
            else:
                # Of the bell of weights, in pixels: neighbours two pixels away count only where there are no nearer
                # ones.
                yield across, down, float(np.exp(-(across**2 + down**2) / (2 * 0.7**2)))


def _window(size: int, step: int) -> slice:
    """Return the slice of an axis whose samples stay inside after a shift by -step."""
    return slice(max(0, step), size + min(0, step))
