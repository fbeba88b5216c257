r"""Micro-image of an even white scene behind one lens of an array, by waves or by rays, and what a camera's relay adds.

White light fills the pupil with points that are incoherent with each other, if the scene is wide. Each casts the same
pattern behind the array, beside its own place, so that micro-images are the pupil's transmission convolved with this
pattern: by waves the Fresnel diffraction of the whole array, whose neighbouring lenses interfere (J. W. Goodman,
"Introduction to Fourier Optics", section 4.5.2); by rays the apertures, reduced by the defocus of the pupil. Both are
periodic, with one coefficient for each order of a Fourier series. Relay lenses and pixels add a Gaussian blur and the
width of a pixel; light that is scattered farther than a lens is a constant.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
import scipy.fft
from scipy.sparse import csr_array

from ...camera import PlenopticCamera, Vignetting
from ...errors import refuse_if
from ...runtime import Array, require_memory

_WIDEST = 512
"""Most samples of micro-images along a lattice vector, and fewest of the field behind the array."""

_POINTS = 60
"""Points along a side of a lens, by rays."""


@dataclass
class PupilNumbers:
    """Shape of a pupil seen from one place of the array, and the blur of its image, with lengths in pixels.

    Attributes
    ----------
    radius : float
        Radius of the pupil's image.
    ellipse_x, ellipse_y : float
        Elongation: a rim at :math:`(1 + e_x, 1 - e_x)` radii for small :math:`e_x`, turned by 45 degrees for
        :math:`e_y`.
    centre_x, centre_y : float
        Place of the pupil's centre on the micro-image, from the image of the lens's regular place.
    slope_x, slope_y : float
        Rise of the transmission across the radius of the pupil, whose image is upside down.
    apodisation_2, apodisation_4 : float
        Coefficients of the transmission's second and fourth power of the radius, in units of the rim's.
    blur : float
        Standard deviation of the Gaussian blur of relay and pixels.
    stray : float
        Scattered light, over the light in the middle of the pupil's image.
    """

    radius: float
    ellipse_x: float = 0.0
    ellipse_y: float = 0.0
    centre_x: float = 0.0
    centre_y: float = 0.0
    slope_x: float = 0.0
    slope_y: float = 0.0
    apodisation_2: float = 0.0
    apodisation_4: float = 0.0
    blur: float = 0.0
    stray: float = 0.0


NUMBERS = tuple(field.name for field in fields(PupilNumbers))

SHAPE = {"transmission": 25, "harmonics": 28}
"""Most coefficients of what the vignetting of all lenses has alike."""


class MicroImageModel:
    """Micro-images of an even white scene under a camera's lenses, sampled on a cell along the lattice vectors.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, with one focal length of its lenses. Of its vignetting, what is the same over the field counts.
    wavelength : float or None
        Wavelength in nanometres for waves; None for rays.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float | None):
        pitch = camera.micro_image_pitch / camera.pixel_size
        refuse_if(pitch < 4, f"camera: its micro-images are {pitch:.3g} pixels wide: at least 4")
        refuse_if(
            len(camera.mla_focal_lengths) > 1,
            "mla_focal_length: white pictures are fitted for arrays of one focal length",
        )
        self.shape = replace(camera.vignetting or Vignetting(1.0), radius=1.0, scale=1.0)
        vectors = np.array(camera.lattice.basis) * camera.image_growth / camera.pixel_size
        count = scipy.fft.next_fast_len(int(min(4 * np.hypot(*vectors.T).max(), _WIDEST)), real=True)
        require_memory(200.0 * count**2, f"model of micro-images of {count} x {count} samples")
        self.reach = camera.lattice.cell_reach * camera.image_growth / camera.pixel_size
        self._count = count
        # In pixels, from sample to sample.
        self._steps = vectors / count
        self._area = abs(np.linalg.det(self._steps))
        # Images of all lenses together have the frequencies of the reciprocal lattice alone.
        along = scipy.fft.rfftfreq(count, 1 / count)
        down = scipy.fft.fftfreq(count, 1 / count)
        fx, fy = (a * along + b * down[:, None] for a, b in np.linalg.inv(vectors))
        self._f2 = fx * fx + fy * fy
        pattern = _wave_pattern(camera, wavelength, along, down) if wavelength else _ray_pattern(camera, along, down)
        # Coefficients of cubic splines from their values (M. Unser 1999, "Splines").
        spline = np.outer(*(3 / (2 + np.cos(2 * np.pi * orders / count)) for orders in (down, along)))
        self._transfer = pattern * np.sinc(fx) * np.sinc(fy) * spline

    def samples(self, numbers: PupilNumbers) -> Array:
        """Return the spline coefficients, for `at`, of a micro-image that is 1 in the middle of an even pupil."""
        spectrum = scipy.fft.rfft2(self._pupil(numbers))
        spectrum *= self._transfer
        spectrum *= np.exp(-2 * (np.pi * numbers.blur) ** 2 * self._f2)
        return scipy.fft.irfft2(spectrum, (self._count, self._count), overwrite_x=True) + numbers.stray

    def expanded(self, numbers: PupilNumbers) -> list[Array]:
        """Return `samples`, and their derivatives by each of `NUMBERS` as quotients of differences."""
        images = [self.samples(numbers)]
        for name in NUMBERS:
            # Steps of differences that give derivatives, where they are not 0.01; at no blur only a wide one gives any.
            step = {"stray": 0.001, "ellipse_x": 0.002, "ellipse_y": 0.002, "blur": 0.1}.get(name, 0.01)
            moved = replace(numbers, **{name: getattr(numbers, name) + step})
            images.append((self.samples(moved) - images[0]) / step if name != "stray" else np.ones_like(images[0]))
        return images

    def shape_slopes(self, numbers: PupilNumbers) -> list[Array]:
        """Return the derivatives of `samples` by all numbers of `SHAPE`, of a shape that has none yet."""
        even = self.shape
        samples = self.samples(numbers)
        slopes = []
        for name, count in SHAPE.items():
            for step in 0.01 * np.eye(count):
                self.shape = replace(even, **{name: step})
                slopes.append((self.samples(numbers) - samples) / 0.01)
        self.shape = even
        return slopes

    def _pupil(self, n: PupilNumbers) -> Array:
        """Return the pupil's transmission, that of the neighbours' pupils added, on the samples of a cell."""
        own = ("ellipse_x", "ellipse_y", "slope_x", "slope_y", "apodisation_2", "apodisation_4")
        pupil = replace(self.shape, **{name: float(getattr(n, name)) for name in own})
        centre = np.array([n.centre_x, n.centre_y])
        to_samples = np.linalg.inv(self._steps)
        # The outline lies within.
        reach = (n.radius * (1.1 + 2 * np.hypot(n.ellipse_x, n.ellipse_y)) + 1) * np.hypot(*to_samples)
        first, last = (
            np.rint(centre @ to_samples + side * reach).astype(int).clip(-self._count, self._count) for side in (-1, 1)
        )
        columns, rows = map(np.arange, first, last)
        # The pupil's image is upside down.
        x, y = ((c - a * columns - b * rows[:, None]) / n.radius for c, a, b in zip(centre, *self._steps, strict=True))
        outline, transmission = pupil.outline(x, y, 0.0, 0.0)
        drawn = np.zeros((2 * self._count, 2 * self._count))
        drawn[np.ix_(rows, columns)] = (outline * (n.radius / np.sqrt(self._area)) + 0.5).clip(0, 1) * transmission
        return drawn.reshape(2, self._count, 2, self._count).sum((0, 2))

    def pupil_light(self, numbers: PupilNumbers) -> float:
        """Return the light of the pupil's image, over that in the middle of an even one and the area of a pixel."""
        return float(self._pupil(numbers).sum()) * self._area

    def at(self, samples: Array, x: Array, y: Array) -> Array:
        """Return values of `samples`'s samples at offsets in pixels from the image of the lens's regular place."""
        return self.splines(x, y) @ samples.ravel()

    def splines(self, x: Array, y: Array) -> csr_array:
        """Return the matrix that multiplies flat `samples` to values at offsets in pixels, as `at` does."""
        weights = []
        index = []
        for place in np.linalg.solve(self._steps.T, np.stack([x, y]))[::-1]:
            first = np.floor(place)
            t = place - first
            s = 1 - t
            weights.append(np.stack([s**3, 4 - 6 * t * t + 3 * t**3, 4 - 6 * s * s + 3 * s**3, t**3], axis=-1) / 6)
            index.append((first.astype(np.int32)[:, None] + np.arange(-1, 3, dtype=np.int32)) % self._count)
        taps = (weights[0][:, :, None] * weights[1][:, None, :]).ravel()
        columns = (index[0][:, :, None] * self._count + index[1][:, None, :]).ravel()
        rows = np.arange(0, len(taps) + 1, 16, dtype=np.int32)
        return csr_array((taps, columns, rows), shape=(len(x), self._count**2))


def _ray_pattern(camera: PlenopticCamera, along: Array, down: Array) -> Array:
    """Return orders of the light of a pupil point behind the array by rays: apertures as large as its defocus."""
    points = camera.lattice.aperture_grid(_POINTS)
    smear = (
        camera.pupil_shift(camera.mla_focal_lengths[0]) * camera.pixel_size / (camera.pupil_step * camera.image_growth)
    )
    places = np.linalg.solve(np.transpose(camera.lattice.basis), smear * points)
    first, second = (np.exp(2j * np.pi * np.outer(n, place)) for n, place in zip((along, down), places, strict=True))
    return second @ first.T / _POINTS**2


def _wave_pattern(camera: PlenopticCamera, wavelength: float, along: Array, down: Array) -> Array:
    """Return orders of the light of a pupil point behind the array by waves: its lenses interfere."""
    lattice = camera.lattice
    refuse_if(
        not lattice.fills, "mla_fill, mla_aperture: waves are fitted to lenses that fill their cells; fit by rays"
    )
    length = wavelength * 1e-6
    power = np.pi / length / camera.reduced_focal_lengths[0]
    size = scipy.fft.next_fast_len(int(max(_WIDEST, 3 * power * lattice.cell_reach**2)))
    refuse_if(size > 4 * _WIDEST, f"wavelength = {wavelength:g}: the lenses are too large for it; fit by rays")
    vectors = np.array(lattice.basis)
    steps = np.arange(size) / size
    orders = scipy.fft.fftfreq(size, 1 / size)
    x, y = (c + a * steps + b * steps[:, None] for c, a, b in zip(lattice.centre(0.0, 0.0), *vectors, strict=True))
    fx, fy = (a * orders + b * orders[:, None] for a, b in np.linalg.inv(vectors))
    centre = lattice.centre(*lattice.cell(x, y))
    field = np.exp(-1j * power * ((x - centre[0]) ** 2 + (y - centre[1]) ** 2))
    # A spherical wave casts the pattern of a plane one at a shorter distance, enlarged.
    distance = camera.reduced_distance / camera.image_growth
    field = scipy.fft.ifft2(scipy.fft.fft2(field) * np.exp(-1j * np.pi * length * distance * (fx * fx + fy * fy)))
    light = scipy.fft.fft2(np.abs(field) ** 2) / size**2
    return light[np.ix_(down.astype(int), along.astype(int))]
