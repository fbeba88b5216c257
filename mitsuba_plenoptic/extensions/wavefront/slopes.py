r"""Slopes of a wavefront over the pupil, measured in captures of a point source, and Zernike terms fitted to them.

An aberration W tilts the ray from the pupil point P by its slope, so that the ray meets the array displaced by

.. math:: \Delta m = b \, \nabla W(P)

from the image of the point. Behind an array in focus each lens shows the pupil, so that a pixel stands for a lens and a
pupil point: the centroid of the lenses lit from a pupil point is the slope there (Clare and Lane, "Wave-front sensing
from subdivision of the focal plane with a lenslet array", J. Opt. Soc. Am. A 22, 2005). Behind an array in the pupil's
image (Shack-Hartmann) a lens stands for a square of the pupil, and the position of its spot is the mean slope there.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from ...camera import PlenopticCamera, Use, require_support
from ...errors import InputError, refuse_if, require_count, require_length, require_number
from ...lenses import Wavefront, main_lens
from ...points import check_positions
from ...runtime import Array, Doubles, Flags, as_pixels
from ...views import lenses_of_pixels


@dataclass(frozen=True)
class Slopes:
    """Slopes of a wavefront at points of the pupil, with their light.

    Attributes
    ----------
    pupil : float64 array (n, 2)
        Points of the pupil, x and y in millimetres.
    slope : float64 array (n, 2)
        Derivatives of the path along x and y, in millimetres per millimetre.
    light : float64 array (n,)
        Light that each slope was measured with, in the unit of the capture.
    width : float
        Side, in millimetres, of the square about each point over which the slope is the mean; 0 for slopes at points.
    """

    pupil: Doubles
    slope: Doubles
    light: Doubles
    width: float = 0.0


def view_slopes(camera: PlenopticCamera, image: Any, point: Any) -> Slopes:
    """Return slopes measured in the views of a capture: the centroid of the lenses lit from each pupil point.

    The slopes are those of geometrical optics, for light that spreads over several lenses. They saturate where light
    stays within one lens, and coarse pixels make them some percent too small. They start `fit_wavefronts`.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a thin main lens and its array in focus.
    image : array (rows, columns)
        Capture of a point source; negative pixels, which noise makes, count as dark.
    point : (X, Y, g)
        The point source in the camera frame, in millimetres.

    Returns
    -------
    Slopes
        At pupil points about one pixel of a micro-image apart.
    """
    require_support(camera, Use.LENS_CENTRES)
    pixels = _known_image(image, camera)
    image_of_point = main_lens(camera).images(check_positions([point], camera))[0]
    lens = centres_of_pixels(camera)
    detector = np.stack(np.meshgrid(camera.pixel_coordinates(0), camera.pixel_coordinates(1)), -1)
    # What pixels see through the centres of their lenses.
    pupil = lens + (lens - detector) * (camera.mla_distance / camera.reduced_distance)
    inside = np.hypot(pupil[..., 0], pupil[..., 1]) <= camera.aperture_radius
    light = pixels[inside]
    moved = (lens - image_of_point)[inside] / camera.mla_distance
    refuse_if(not light.any(), "image: it is black where the pupil is seen: nothing can be found by it")
    # Views as far apart as pixels, which are not at the same pupil points behind all lenses.
    cells, index = np.unique(np.rint(pupil[inside] / camera.pupil_step), axis=0, return_inverse=True)
    total = np.bincount(index, light, len(cells)).astype(np.float64)
    lit = total > 0
    both = np.hstack([pupil[inside], moved])
    means = np.stack([np.bincount(index, light * column, len(cells)) for column in both.T], -1)[lit] / total[lit, None]
    return Slopes(means[:, :2], means[:, 2:], total[lit])


def spot_slopes(
    image: Any, *, pixels_per_lens: int, pixel_size: float, focal_length: float, magnification: float = 1.0
) -> Slopes:
    """Return slopes measured by the positions of the spots in a capture of a Shack-Hartmann sensor.

    Positions are phases of the first Fourier coefficient of each lens's pixels, which uniform light does not change.
    Centroids would be some percent too small, as the borders of cells cut off the tails of spots; they are used for two
    pixels a lens.

    Parameters
    ----------
    image : array (rows, columns)
        Capture of a point source; negative pixels count as dark.
    pixels_per_lens : int
        Rows and columns of pixels behind a lens, which divide those of the image; x and y grow with column and row.
    pixel_size : float
        Width of a pixel in millimetres.
    focal_length : float
        Distance from the lenses to the detector, in millimetres.
    magnification : float
        Size of the pupil's image on the lenses over that of the pupil; negative where the image is upside down, as
        behind a `Collimator`: -0.32 for the preset ``shack_hartmann``.

    Returns
    -------
    Slopes
        At the centres of the lenses that are lit, in the pupil, as means over lenses.
    """
    pixels = _known_image(image)
    n = require_count("pixels_per_lens", pixels_per_lens)
    size = require_length("pixel_size", pixel_size)
    rows, columns = pixels.shape
    refuse_if(
        bool(rows % n or columns % n),
        f"image of shape {pixels.shape}: its sides must be multiples of {n} pixels a lens",
    )
    growth = require_number("magnification", magnification)
    require_length("magnification", abs(growth))
    spots = pixels.reshape(rows // n, n, columns // n, n)
    light = spots.sum((1, 3))
    refuse_if(not light.any(), "image: it is black: nothing can be found by it")
    lit = light > 0
    # Pixels along a lens from which on the phase of their first Fourier coefficient tells a place.
    if n < 3:
        moved = _sums(spots, (np.arange(n) - (n - 1) / 2) * size)[lit] / light[lit, None]
    else:
        turn = 2 * np.pi / n
        moved = np.angle(_sums(spots, np.exp(1j * turn * (np.arange(n) - (n - 1) / 2))))[lit] * (size / turn)
    centre = [(np.arange(count) - (count - 1) / 2) * n * size / growth for count in (columns // n, rows // n)]
    lenses = np.stack(np.meshgrid(*centre), -1)
    bend = growth / require_length("focal_length", focal_length)
    return Slopes(lenses[lit], moved * bend, light[lit], abs(n * size / growth))


def _sums(spots: Doubles, factors: Array) -> Array:
    """Return sums over each lens's pixels, weighted by column factors and by row factors, (rows, columns, 2)."""
    return np.stack([np.einsum("imjn,n->ij", spots, factors), np.einsum("imjn,m->ij", spots, factors)], -1)


def modes_from_slopes(slopes: Slopes, radius: float, modes: int) -> Doubles:
    """Return Zernike terms fitted to slopes by least squares, weighted by the light of each slope.

    Slopes that are means over squares are fitted by means over the part of each square in the pupil; squares outside
    are ignored.

    Parameters
    ----------
    slopes : Slopes
        Slopes at points of the pupil.
    radius : float
        Radius of the pupil in millimetres.
    modes : int
        Number of terms, piston included, which stays 0.

    Returns
    -------
    float64 array (modes,)
        Coefficients in the unit and order of the camera's ``wavefront``.
    """
    count = require_count("modes", modes, minimum=2)
    if slopes.slope.size < count:
        raise InputError(f"modes = {count}: {slopes.slope.size} slopes cannot determine them")
    finite = all(np.isfinite(values).all() for values in (slopes.pupil, slopes.slope, slopes.light))
    refuse_if(not (finite and np.any(slopes.light > 0)), "slopes: they must be finite, and have some light")
    rows, within = _mean_slopes(slopes, require_length("radius", radius), count)
    weight = np.sqrt(slopes.light * within)
    terms, *_ = np.linalg.lstsq(
        (rows * weight[:, None]).reshape(count - 1, -1).T, (slopes.slope * weight[:, None]).ravel(), rcond=None
    )
    return np.concatenate([[0.0], terms])


_POINTS = 16
"""Points along a square over which slopes of terms are averaged."""


def _mean_slopes(slopes: Slopes, radius: float, modes: int) -> tuple[Doubles, Flags]:
    """Return the slopes of the terms as means over the squares of `slopes`, and a mask of squares in the pupil."""
    if slopes.width == 0:
        return mode_slopes(slopes.pupil, radius, modes), np.ones(len(slopes.pupil), bool)
    step = ((np.arange(_POINTS) + 0.5) / _POINTS - 0.5) * slopes.width
    points = slopes.pupil[:, None] + np.stack(np.meshgrid(step, step), -1).reshape(-1, 2)
    inside = np.hypot(points[..., 0], points[..., 1]) <= radius
    share = inside / np.maximum(inside.sum(1), 1)[:, None]
    terms = mode_slopes(points.reshape(-1, 2), radius, modes).reshape(modes - 1, *points.shape)
    return np.einsum("klsd,ls->kld", terms, share), np.asarray(inside.any(1))


def mode_slopes(pupil: Doubles, radius: float, modes: int) -> Doubles:
    """Return the slopes (modes - 1, n, 2) at pupil points of each Zernike term, of one unit, without the piston."""
    x, y = pupil.T
    terms = np.eye(modes)[1:]
    return np.stack([np.stack(np.broadcast_arrays(*Wavefront(term, radius).slope(x, y)), -1) for term in terms])


def centres_of_pixels(camera: PlenopticCamera) -> Doubles:
    """Return the centre of each pixel's lens, (rows, columns, 2)."""
    return np.stack(camera.lattice.centre(*lenses_of_pixels(camera).astype(np.float64)), -1)


def _known_image(image: Any, camera: PlenopticCamera | None = None) -> Doubles:
    """Return a capture of one channel with negative pixels set to 0; refuse other captures."""
    pixels = as_pixels("image", image, np.float64)
    refuse_if(pixels.ndim != 2, f"image of shape {pixels.shape}: wavefronts are measured in images of one channel")
    if camera is not None:
        refuse_if(pixels.shape != camera.shape, f"image of shape {pixels.shape}: the camera records {camera.shape}")
    return np.maximum(pixels, 0)
