"""How finely and widely a full field is sampled: at the pupil, on the microlens array and on the detector."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..lenses.exit_pupil import ExitPupil
from ..optics.phase import in_millimetres
from ..system.microlenses import diffraction, scattering
from ..system.optical_system import OpticalSystem
from ..system.sampling import bundle_footprint, check_memory, fast_length, footprint

_WINDOW_MARGIN = 1.2
"""Window over what it must hold, on the way to the MLA."""

_AIRY_WIDTHS = 110
r"""Least width of that window in units of :math:`\lambda b / D_1`: it must hold what the pupil's edge diffracts."""

_WINDOW_PER_BLUR = 20
"""Least width of the window behind an objective, over the radius of the image of a point out of focus."""

_PUPIL_BAND = 1.5
"""Sampled directions on the way to the MLA over the steepest ray: the pupil's edge diffracts beyond that."""

_PUPIL_SAMPLES = 250
"""Samples across the pupil's radius at least: an edge softened over one of them loses a third of a sample's light."""

_KEPT_BENDS = 3.3
"""Steepest direction from the microlenses that is kept, over those that a wide one scatters to, at least."""

_KEPT_ORDERS = 20
"""The same, in orders of the diffraction by the aperture of a microlens."""

BLOCK = 512
"""Rows that are transformed together."""


@dataclass(frozen=True)
class FieldGrids:
    """Sizes and places of the grids; pairs are along x and y."""

    pitch: float  # after the MLA: a whole fraction of a pixel
    per_pixel: int
    wide_origin: tuple[float, float]  # of the window that holds pupil, image and detector
    wide_pupil: int  # samples across it, at the pupil's pitch
    wide_mla: int  # samples across it, at the MLA's pitch
    offset: tuple[int, int]  # of the detector's window in it, in samples of the MLA
    count: tuple[int, int]  # samples of the detector's window
    bend: float  # largest change of direction cosine by a microlens that the grid holds
    margin: int  # pixels of the detector's window before the first recorded one


def field_grids(
    system: OpticalSystem,
    position: NDArray[np.float64],
    refinement: float,
    growth: float,
) -> FieldGrids:
    """Choose the grids of one scene point's field; parameters as of `full_field`."""
    camera, wavelength, lens = system.camera, system.wavelength, system.waves_of_one(position)
    p, lam = camera.pixel_size, in_millimetres(wavelength)
    radius = lens.pupil_radius
    if isinstance(lens, ExitPupil):
        places, cosines = lens.bundle
        image = bundle_footprint(places.T[:, None], cosines.T[:, None], lens.pupil_distance)
    else:
        image = footprint(system.lens, position[None])
    place, half_width = image.centre[0], image.half_width[0]
    steepest = float((np.abs(image.cosine[0]) + image.half_cosine[0]).max())
    bent = steepest + max(_KEPT_BENDS * scattering(camera), diffraction(camera, wavelength, _KEPT_ORDERS))
    per_pixel = max(1, math.ceil(p * 2 * bent * refinement / lam))
    pitch = p / per_pixel
    # The recorded window on the detector, with room for light that moves sideways between MLA and detector.
    reach = growth * camera.detector_distance * bent / math.sqrt(max(1e-3, 1 - bent**2))
    margin = math.ceil(reach / p)
    width = np.array([camera.detector_width, camera.detector_height])
    pixels = [fast_length(size + 2 * margin) for size in camera.crop_size]
    start = -width / 2 + (np.array(camera.crop_offset) - margin) * p
    # The window of the way to the MLA, square and on the same grid of pixels.
    low = np.minimum(place - half_width, start)
    high = np.maximum(place + half_width, start + np.array(pixels) * p)
    if camera.lens_data.converges:
        low, high = np.minimum(-radius, low), np.maximum(radius, high)
        diffracted = _AIRY_WIDTHS * lam * lens.pupil_distance / (2 * radius)
    else:
        # The samples of the stop are as many as the window holds waves of the steepest direction; softening its edge
        # over one of them darkens what the edge diffracts far from the image of the point.
        blur = _WINDOW_PER_BLUR * float(half_width.max()) * (not camera.lens_data.images_stop)
        diffracted = max(_PUPIL_SAMPLES * lam / system.lens.cone(position[2]), blur)
    held = max(_WINDOW_MARGIN * float((high - low).max()), diffracted)
    wide = fast_length(growth * held / pitch + per_pixel, per_pixel)
    before = np.floor((start - (low + high - wide * pitch) / 2) / p).astype(int)
    finest = max(2 * _PUPIL_BAND * steepest / lam, _PUPIL_SAMPLES / radius)
    coarse = min(wide, fast_length(wide * pitch * finest * refinement))
    detector_samples = pixels[0] * pixels[1] * per_pixel**2
    check_memory(
        # at the pupil, on the way to the MLA, or with the doubled grid of the detector
        8.0 * max(4 * coarse**2, 2 * coarse**2 + pixels[1] * per_pixel * coarse, 5 * detector_samples)
        + 32.0 * BLOCK * wide,
        f"full field of position = ({position[0]:g}, {position[1]:g}, {position[2]:g})",
    )
    return FieldGrids(
        pitch=pitch,
        per_pixel=per_pixel,
        wide_origin=(float(start[0] - before[0] * p), float(start[1] - before[1] * p)),
        wide_pupil=coarse,
        wide_mla=wide,
        offset=(int(before[0]) * per_pixel, int(before[1]) * per_pixel),
        count=(pixels[0] * per_pixel, pixels[1] * per_pixel),
        bend=lam / (2 * pitch) - steepest,
        margin=margin,
    )
