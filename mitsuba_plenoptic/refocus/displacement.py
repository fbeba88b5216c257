r"""Displacement between bins and the positions from which their light comes, and its correction to first order.

A bin receives light from around its position. Due to diffraction at the microlenses, light of one pupil point appears
to come from another. In the middle of the field this averages out, but at the border of the pupil or the detector the
light comes from one side only. If lenses interfere, the phases of their fields weight the positions from which light
comes. So, to first order, a bin at x that is divided by white reads a linear radiance at :math:`x + s`.

The displacement s is measured with the white capture. In a scene whose radiance rises linearly along the plane of the
bins, the capture is the white capture times the radiance at the positions from which pixels receive their light,
:math:`W (1 + \epsilon u)`. Refocused by the same method and divided by white it reads :math:`1 + \epsilon (x + s)`. The
position u of a pixel is the intersection of the bins' plane with the ray through the centre of its lens and the
centroid of the pixel's light in the pupil. With K, the spread of intensities over the pupil plane by diffraction, it is
:math:`K * (P \, A) / K * A` over the pupil A (Goodman, "Introduction to Fourier Optics", sections 4.4 and 5.2).

The image is then corrected to first order by the slope of a plane fitted to the bins around each bin, at the positions
from which they receive their light (a local linear regression: Fan and Gijbels, "Local Polynomial Modelling and Its
Applications", section 3.1).
"""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
import scipy
import scipy.fft
from scipy.ndimage import map_coordinates

from ..camera import PlenopticCamera
from ..design import focus_type
from ..optics import in_millimetres, rays, soft_edge
from ..rays import follow_back
from ..runtime import Doubles, Floats, Triple, require_memory
from .splatting import pixel_rows


class PupilCentroid:
    """Centroid in the pupil of a pixel's light, with the diffraction by the pixel's microlens."""

    def __init__(self, camera: PlenopticCamera, wavelength: float):
        # Width of the plane in which the pupil is spread, in radii of the pupil.
        window = 8 * camera.aperture_radius
        # Spatial frequencies over the pupil plane correspond to positions in the microlens.
        lens = camera.lattice.aperture_image(in_millimetres(wavelength) * camera.mla_distance / window, 1.0)
        size = scipy.fft.next_fast_len(max(512, 2 * len(lens)), real=True)
        require_memory(100.0 * size**2, f"pupil of {size} x {size} samples")
        amplitude = np.zeros((size, size))
        amplitude[: len(lens), : len(lens)] = lens
        spread = np.abs(scipy.fft.ifft2(np.roll(amplitude, (-(len(lens) // 2),) * 2, (0, 1)))) ** 2
        transfer = scipy.fft.rfft2(spread)
        self._pitch = window / size
        self._first = -(size - 1) / 2
        P = (np.arange(size) + self._first) * self._pitch
        inside = soft_edge((camera.aperture_radius - np.hypot(P, P[:, None])) / self._pitch)

        def blurred(values: Doubles) -> Doubles:
            return scipy.fft.irfft2(scipy.fft.rfft2(values) * transfer, s=(size, size))

        light = blurred(inside)
        # Far from the pupil the rounding of the transform is not light.
        lit = light > 1e-6 * light.max()
        self._tables = [
            np.divide(blurred(inside * along), light, out=np.zeros_like(light), where=lit).clip(
                -camera.aperture_radius, camera.aperture_radius
            )
            for along in (P, P[:, None])
        ]

    def __call__(self, x: Doubles, y: Doubles) -> list[Doubles]:
        """Return the pupil centroids in mm, along x and y, of pixels that see (x, y) through their lens's centre."""
        at = [np.asarray(axis) / self._pitch - self._first for axis in (y, x)]
        return [map_coordinates(table, at, order=1, mode="nearest") for table in self._tables]


def is_known(camera: PlenopticCamera) -> bool:
    """Return whether displacements are known: for unfocused cameras with thin lenses, whose pixels see pupil points."""
    return camera.lens_data.is_thin and focus_type(camera) == "unfocused"


def tilt(camera: PlenopticCamera, distance: float) -> Triple:
    """Return the relative rise of radiance per mm of the MLA plane, 1 on the axis, for the scenes of `rising`.

    The farthest position on the bins that counts, and a pixel's displacement there per pupil displacement, are also
    returned.
    """
    at_pupil, on_bins = follow_back(1.0, 0.0, 0.0, distance, camera)
    of_pupil = on_bins / at_pupil
    farthest = (max(camera.bin_count) / 2 + 1) * camera.row_pitch + abs(of_pupil) * camera.lit_radius
    # Change of white over the light that it has, at most: what is of second order in it is then no tenth of a bin.
    return 0.02 / farthest, farthest, of_pupil


def rising(
    white: Floats, camera: PlenopticCamera, distances: Sequence[float], wavelengths: Sequence[float] | None
) -> Iterator[tuple[Floats, list[float]]]:
    """Yield, for each distance, two captures of scenes whose radiance rises along the bins: to the right and downwards.

    The captures are computed from a white capture. The wavelengths in nanometres are those of the channels of a wave
    capture; None means a ray capture.
    """
    lights = [None] * white.shape[2] if wavelengths is None else list(wavelengths)
    centroids = {light: PupilCentroid(camera, light) for light in lights if light is not None}
    for distance, axis in itertools.product(distances, (0, 1)):
        image = np.empty_like(white)
        slope, farthest, of_pupil = tilt(camera, distance)
        # Pixels that are looked at together.
        for rows, *p in pixel_rows(camera, 2**18):
            cells = rays.chief_lenses(camera, *p)
            ends = [
                np.broadcast_arrays(*follow_back(q, c, c, distance, camera))
                for q, c in zip(p, camera.lattice.centre(*cells), strict=True)
            ]
            P = np.broadcast_arrays(ends[0][0], ends[1][0])
            for channel, light in enumerate(lights):
                moved = 0.0 if light is None else centroids[light](*P)[axis] - P[axis]
                # Where the channel's light comes from on the bins.
                u = np.broadcast_to(ends[axis][1], P[0].shape) + of_pupil * moved
                image[rows, :, channel] = white[rows, :, channel] * (1 + slope * u.clip(-farthest, farthest))
        yield image, [distance]


def displacements(tilted: Sequence[Doubles], slope: float, camera: PlenopticCamera, oversample: int) -> list[Doubles]:
    """Return the displacements in bins, along x and y, from which bins' light comes; 0 without light."""
    moved = []
    for axis, image in enumerate(tilted):
        count = image.shape[1 - axis]
        axis_offset = (np.arange(count) - (count - 1) / 2).reshape((1, -1, 1) if axis == 0 else (-1, 1, 1))
        position = (image - 1) / slope * (oversample / camera.row_pitch)
        # Displacements beyond a lens pitch, as where interference leaves little light, are cut.
        farthest = float(oversample)
        moved.append(np.nan_to_num(position - axis_offset).clip(-farthest, farthest))
    return moved


def brought_back(image: Doubles, moved: Sequence[Doubles], weights: Doubles, reach: int) -> Doubles:
    """Return an image corrected for the displacements of its bins, by weighted fits to `reach` bins on each side."""
    finite = np.isfinite(image)
    values = np.where(finite, image, 0.0)
    light = np.where(finite, weights, 0.0)
    rows, columns = image.shape[:2]
    terms = (
        moved[0] + (np.arange(columns) - columns / 2)[:, None],
        moved[1] + (np.arange(rows) - rows / 2)[:, None, None],
        values,
    )
    # Means over the bins around each bin: of position and value, and of their products.
    mass = _mean_about(light, reach)
    mass = np.where(mass > 0, mass, 1)
    x, y, value = (_mean_about(light * term, reach) / mass for term in terms)

    def covariance(i: int, j: int, means: Doubles) -> Doubles:
        return _mean_about(light * terms[i] * terms[j], reach) / mass - means

    xx = covariance(0, 0, x * x)
    xy = covariance(0, 1, x * y)
    yy = covariance(1, 1, y * y)
    xv = covariance(0, 2, x * value)
    yv = covariance(1, 2, y * value)
    determinant = xx * yy - xy**2
    # A few bins in a line determine no plane. The determinant is that of the covariance of positions, in bins: four in
    # a square have 0.06.
    known_plane = determinant > 1e-3
    safe = np.where(known_plane, determinant, 1)
    across = (yy * xv - xy * yv) / safe
    down = (xx * yv - xy * xv) / safe
    return np.where(known_plane, image - moved[0] * across - moved[1] * down, image)


def _mean_about(image: Doubles, reach: int) -> Doubles:
    """Return the mean over the square of bins around each bin; bins outside the image count as 0."""
    return scipy.ndimage.uniform_filter(image, 2 * reach + 1, mode="constant", axes=(0, 1))
