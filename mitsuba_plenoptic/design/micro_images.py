"""The size of a camera's micro-images, with and without diffraction, and the lenses that light a pixel."""

from __future__ import annotations

import itertools
import math

import numpy as np

from ..camera import PlenopticCamera
from ..errors import refuse_if, require_wavelength
from ..lenses.common import chief_points, main_lens
from ..optics.waves import in_millimetres

MOST_OVERLAP = 100_000
"""Lenses that may light one pixel."""

SECTORS = 12
"""Directions in which the reach of light behind lenses that turn direction cosines is stated."""

_LENS_POINTS = 9
"""Points across a lens, and below, angles around the pupil and the field, from which this reach is computed."""

_ANGLES = 16

_BETWEEN = 1.03
"""Factor on it for points between the samples."""


def image_f_number(camera: PlenopticCamera) -> float:
    """F-number of the main lens as the MLA sees it, :math:`b / D_1`."""
    return camera.mla_distance / camera.aperture_diameter


def mla_f_number(camera: PlenopticCamera) -> float:
    """F-number of a microlens as the detector sees it: :math:`z / n` over the width of its aperture."""
    return camera.reduced_distance / camera.lattice.aperture_width


def micro_image_distance(camera: PlenopticCamera) -> float:
    """Distance of the closest micro-images; micro-images of a smaller diameter do not touch."""
    return camera.lattice.nearest_distance * camera.micro_image_pitch / camera.mla_pitch


# -- diffraction -------------------------------------------------------------------------------------


def spot_radius(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Radius of a microlens's focal spot, from its centre to the first zero.

    :math:`\lambda z / n w` for a rectangular aperture, w its narrower side; :math:`1.22\, \lambda z / n d` for a disc
    of diameter d; for a hexagon that of the disc of its area.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    """
    return in_millimetres(require_wavelength(wavelength)) * camera.reduced_distance / camera.lattice.diffraction_width


def direction_count(camera: PlenopticCamera, wavelength: float | None = None) -> float:
    """Return the directions resolved across a micro-image: its diameter over a pixel or the spot, if that is larger."""
    spot = 0.0 if wavelength is None else spot_radius(camera, wavelength)
    return camera.micro_image_diameter / max(camera.pixel_size, spot)


def mla_fresnel_number(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Fresnel number of a microlens of width w seen from the detector, :math:`n (w/2)^2 / (\lambda z)`."""
    return (camera.lattice.aperture_width / 2) ** 2 / (
        in_millimetres(require_wavelength(wavelength)) * camera.reduced_distance
    )


def main_fresnel_number(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Fresnel number of the main lens seen from the MLA, :math:`(D_1/2)^2 / (\lambda b)`."""
    camera.require_lens("the Fresnel number of the main lens")
    return camera.aperture_radius**2 / (in_millimetres(require_wavelength(wavelength)) * camera.mla_distance)


# -- light of a white scene --------------------------------------------------------------------------


def white_mean(camera: PlenopticCamera) -> float:
    r"""Return the mean of an unbounded capture of a scene of uniform radiance 1.

    A micro-image of area :math:`(\pi/4)(D_1 z / b)^2` reads 1 whatever its lens's aperture, because a pixel is the
    mean radiance over the aperture; there is one on each :math:`A ((b + z)/b)^2` of the detector, A the area of
    the lattice's cell.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    """
    growth = camera.micro_image_pitch / camera.mla_pitch
    return math.pi / 4 * camera.micro_image_diameter**2 / (camera.lattice.cell_area * growth**2)


def crosstalk_neighbours(camera: PlenopticCamera, beyond: float = 0.0) -> np.ndarray:
    """Return the lenses that can light a pixel, relative to the lens of its chief ray, with an optional margin.

    The ray from a detector point p through the point c + d of a lens meets the pupil plane in
    :math:`(1 + b/z)(c - m) + (1 + b/z - b/f_2) d`, m the point of the chief ray, which is in its lens's cell. For
    that to be in the pupil, c must be within :math:`(D_1/2) / (1 + b/z)` of some
    :math:`m - d (1 + b/z - b/f_2) / (1 + b/z)`: a cell enlarged by apertures.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    beyond : float
        Width in millimetres of the margin.

    Returns
    -------
    (lenses, 2) int array
        Steps in the lattice's indices; the first is the chief ray's own lens.

    Raises
    ------
    InputError
        If micro-images overlap so much that these are more than 100,000.
    """
    lenses, reach, smear = _crosstalk(camera)
    reach += beyond
    refuse_if(
        not lenses <= MOST_OVERLAP,
        f"camera: its micro-images overlap so much that some {lenses:.3g} lenses light each pixel; at most "
        f"{MOST_OVERLAP} are followed",
    )
    return camera.lattice.neighbours(reach, smear)


def crosstalk_reach(camera: PlenopticCamera) -> float:
    """Return the greatest distance of the centres of lenses that can light a pixel from the point of its chief ray."""
    _, reach, smear = _crosstalk(camera)
    return float(reach + smear * camera.lattice.aperture_reach)


def crosstalk_defocus(camera: PlenopticCamera) -> float:
    """Return the change of `crosstalk_reach` per relative change of a lens's power."""
    growth = camera.lens_data.converges + camera.pupil_distance / camera.reduced_distance
    across = camera.lattice.aperture_reach * camera.pupil_distance
    return float(across / min(camera.reduced_focal_lengths) / growth)


def turns_cosines(camera: PlenopticCamera) -> bool:
    """Return whether microlenses turn direction cosines of rays instead of slopes."""
    return camera.lens_model != "ideal" or camera.mla_shape is not None


def cosine_limits(camera: PlenopticCamera, radii: np.ndarray) -> np.ndarray:
    """Return the largest distances from the chief ray's point of lenses that turn cosines and still light a pixel.

    `crosstalk_neighbours` follows rays by their slopes. Parabolic and shaped lenses turn direction cosines, so that
    rays through the edge of a fast lens meet the detector farther outside. This is the greatest distance of the lens
    from the chief ray's point, among rays from the rim of the pupil.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    radii : (n,) array
        Distances of the lens from the axis.

    Returns
    -------
    (n, SECTORS) array
        By the angle, from 0 to 180 degrees, between the directions towards the lens and away from the axis.
    """
    lens, z, n = main_lens(camera), camera.detector_distance, camera.mla_medium
    s, t = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0, 1, _LENS_POINTS)] * 2))
    offset = np.stack(camera.lattice.aperture_point(s, t))[:, :, None, None]
    angle = 2 * np.pi * np.arange(_ANGLES) / _ANGLES
    around = np.stack([np.cos(angle), np.sin(angle)])
    pupil = lens.reach * around[:, None, :, None]
    # Cells and the pupil look alike from opposite sides of the field.
    away = around[:, None, None, : _ANGLES // 2]
    found = np.zeros((len(radii), SECTORS))
    for (row, radius), f2 in itertools.product(enumerate(radii), camera.reduced_focal_lengths):
        slope = lens.slope_to(pupil, radius * away + offset)
        cosine = slope / np.sqrt(1 + (slope**2).sum(0))
        turn = offset / f2
        if camera.mla_shape is not None:
            slopes = camera.mla_shape.slopes(*camera.lattice.to_frame(*offset))
            turn = -np.stack(camera.lattice.from_frame(*slopes))
        behind = (cosine + turn) / n
        square = (behind**2).sum(0)
        # The rest is reflected totally.
        passes = square < 1
        position = radius * away + offset - z * behind / np.sqrt(np.where(passes, 1 - square, 1))
        towards = radius * away - np.stack(chief_points(lens, (position[0], position[1]), z, n))
        distance = np.hypot(*towards) * passes
        sector = np.arccos(np.clip((towards * away).sum(0) / np.maximum(distance, 1e-12), -1, 1)) * (SECTORS / np.pi)
        np.maximum.at(found[row], np.minimum(sector.astype(int), SECTORS - 1), distance)
    # Points between the samples reach into neighbouring sectors, and a little farther.
    padded = np.pad(found, [(0, 0), (1, 1)], mode="edge")
    return _BETWEEN * np.max([padded[:, i : i + SECTORS] for i in range(3)], axis=0)


def crosstalk_lenses(camera: PlenopticCamera) -> int:
    """Count the lenses that can light one pixel; counts above 100,000 are estimated from the area."""
    lenses = _crosstalk(camera)[0]
    return len(crosstalk_neighbours(camera)) if lenses <= MOST_OVERLAP else round(lenses)


def _crosstalk(camera: PlenopticCamera) -> tuple[float, float, float]:
    """About how many lenses light a pixel, within which distance, and the part of their apertures that adds."""
    b, z, lattice = camera.pupil_distance, camera.reduced_distance, camera.lattice
    # Behind an objective all lenses see the stop in the same directions.
    growth = camera.lens_data.converges + b / z
    reach = main_lens(camera).reach / growth
    smear = max(abs(camera.pupil_shift(f2)) for f2 in camera.mla_focal_lengths) / growth
    covered = math.pi * (reach + smear * lattice.aperture_reach + max(camera.mla_pitches)) ** 2
    return covered / lattice.cell_area, reach, smear
