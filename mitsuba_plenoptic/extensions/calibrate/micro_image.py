r"""Micro-image of an even white scene behind one lens of an array, by waves or by rays, and what a camera's relay adds.

White light fills the pupil with points that are incoherent with each other, if the scene is wide. A lens images each of
them alike, so that the micro-image is the pupil's transmission convolved with the lens's point spread: by waves the
diffraction of its aperture with the defocus of the pupil, by rays the aperture itself, reduced by the defocus (J. W.
Goodman, "Introduction to Fourier Optics", sections 6.3 and 6.4). Relay lenses and pixels add a Gaussian blur and the
width of a pixel; light that is scattered farther than a lens is a constant. Neighbours' micro-images add without
interference, which cancels in white light.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import scipy.fft
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array

from ...camera import PlenopticCamera, Vignetting
from ...errors import refuse_if
from ...runtime import require_memory

_WIDEST = 512
"""Samples of the model along a side, about."""

_PITCHES = 3
"""Pitches along the side of the model's window."""


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

_STEPS = {"stray": 0.001, "ellipse_x": 0.002, "ellipse_y": 0.002}
"""Steps of differences that give derivatives, where they are not 0.01."""


class MicroImageModel:
    """Micro-images of an even white scene under a camera's lenses, sampled about the image of a lens's centre.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, with one focal length of its lenses. Of its vignetting, what is the same over the field counts.
    wavelength : float or None
        Wavelength in nanometres for waves; None for rays.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float | None) -> None:
        pitch = camera.micro_image_pitch / camera.pixel_size
        refuse_if(pitch < 4, f"camera: its micro-images are {pitch:.3g} pixels wide: at least 4")
        refuse_if(
            len(camera.mla_focal_lengths) > 1,
            "mla_focal_length: white pictures are fitted for arrays of one focal length",
        )
        self.shape = replace(camera.vignetting or Vignetting(1.0), radius=1.0, scale=1.0)
        step = max(1 / 4, _PITCHES * pitch / _WIDEST)
        count = scipy.fft.next_fast_len(int(np.ceil(_PITCHES * pitch / step)), real=True)
        require_memory(200.0 * count**2, f"model of micro-images of {count} x {count} samples")
        self._step = step
        self._count = count
        fx, fy = np.meshgrid(scipy.fft.rfftfreq(count, step), scipy.fft.fftfreq(count, step))
        self._f2 = fx * fx + fy * fy
        vectors = np.array(camera.lattice.basis) * (camera.image_growth / camera.pixel_size)
        i, j = (index.ravel() for index in np.mgrid[-2:3, -2:3])
        near = i[:, None] * vectors[0] + j[:, None] * vectors[1]
        near = near[np.hypot(*near.T) < 1.6 * np.hypot(*vectors.T).max()]
        # Micro-images of neighbours in the window, moved by the theorem of displacement.
        neighbours = sum(np.exp(-2j * np.pi * (fx * x + fy * y)) for x, y in near)
        lens = _wave_transfer(camera, wavelength, fx, fy) if wavelength else self._ray_transfer(camera)
        # Pupils are drawn in the middle two of three pitches.
        half = count // 3
        self._axis = np.arange(-half, half + 1) * step
        drawn_at = np.exp(-2j * np.pi * (fx + fy) * step * (count // 2 - half))
        # Coefficients of cubic splines from their values (M. Unser 1999, "Splines").
        spline = 9 / (2 + np.cos(2 * np.pi * fx * step)) / (2 + np.cos(2 * np.pi * fy * step))
        self._transfer = lens * neighbours * np.sinc(fx) * np.sinc(fy) * drawn_at * spline
        self.reach = np.floor(count * step / 2) - 1

    def _ray_transfer(self, camera: PlenopticCamera) -> np.ndarray:
        """Return the transfer of the aperture that rays see beside its focus."""
        smear = abs(camera.pupil_shift(camera.mla_focal_length)) / camera.pupil_step
        image = camera.lattice.aperture_image(self._step, smear)
        size = len(image)
        refuse_if(size > self._count, "camera: its lenses see the pupil out of focus by more than three pitches")
        padded = np.zeros((self._count, self._count))
        padded[:size, :size] = image
        return scipy.fft.rfft2(np.roll(padded, (-(size // 2), -(size // 2)), (0, 1)))

    def samples(self, numbers: PupilNumbers) -> np.ndarray:
        """Return the spline coefficients, for `at`, of a micro-image that is 1 in the middle of an even pupil."""
        return self._image(self._pupil(numbers), self._blur(numbers)) + numbers.stray

    def slopes(self, numbers: PupilNumbers) -> np.ndarray:
        """Return the derivatives of `samples` by each of `NUMBERS`, as quotients of differences."""
        pupil = self._pupil(numbers)
        blur = self._blur(numbers)
        slopes = np.empty((len(NUMBERS), self._count, self._count))
        for name, slope in zip(NUMBERS, slopes, strict=True):
            step = _STEPS.get(name, 0.01)
            moved = replace(numbers, **{name: getattr(numbers, name) + step})
            if name == "stray":
                slope[:] = 1.0
            elif name == "blur":
                slope[:] = self._image(pupil, (self._blur(moved) - blur) / step)
            else:
                slope[:] = self._image((self._pupil(moved) - pupil) / step, blur)
        return slopes

    def shape_slopes(self, numbers: PupilNumbers) -> list[np.ndarray]:
        """Return the derivatives of `samples` by all numbers of `SHAPE`, of a shape that has none yet."""
        blur = self._blur(numbers)
        even = self.shape
        pupil = self._pupil(numbers)
        slopes = []
        for name, count in SHAPE.items():
            for step in 0.01 * np.eye(count):
                self.shape = replace(even, **{name: step})
                slopes.append(self._image((self._pupil(numbers) - pupil) / 0.01, blur))
        self.shape = even
        return slopes

    def _pupil(self, n: PupilNumbers) -> np.ndarray:
        """Return the pupil's transmission in the window's middle."""
        own = ("ellipse_x", "ellipse_y", "slope_x", "slope_y", "apodisation_2", "apodisation_4")
        pupil = replace(self.shape, **{name: float(getattr(n, name)) for name in own})
        drawn = np.zeros((len(self._axis), len(self._axis)))
        # The outline lies within.
        reach = n.radius * (1.1 + 2 * np.hypot(n.ellipse_x, n.ellipse_y)) + 2 * self._step
        columns, rows = (
            slice(*np.searchsorted(self._axis, (middle - reach, middle + reach))) for middle in (n.centre_x, n.centre_y)
        )
        # The pupil's image is upside down.
        x = (n.centre_x - self._axis[columns]) / n.radius
        y = (n.centre_y - self._axis[rows, None]) / n.radius
        outline, transmission = pupil.outline(x, y, 0.0, 0.0)
        drawn[rows, columns] = (outline * (n.radius / self._step) + 0.5).clip(0, 1) * transmission
        return drawn

    def pupil_light(self, numbers: PupilNumbers) -> float:
        """Return the light of the pupil's image, over that in the middle of an even one and the area of a pixel."""
        return float(self._pupil(numbers).sum()) * self._step**2

    def _blur(self, n: PupilNumbers) -> np.ndarray:
        """Return the transfer of the blur."""
        return np.exp(-2 * (np.pi * n.blur) ** 2 * self._f2)

    def _image(self, pupil: np.ndarray, blur: np.ndarray) -> np.ndarray:
        """Return the spline coefficients of the image of a pupil's transmission in the window's middle."""
        # Rows beyond the pupil are dark.
        spectrum = scipy.fft.fft(scipy.fft.rfft(pupil, self._count), self._count, axis=0, overwrite_x=True)
        spectrum *= self._transfer
        spectrum *= blur
        return np.asarray(scipy.fft.irfft2(spectrum, (self._count, self._count), overwrite_x=True))

    def at(self, samples: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return values of `samples`'s samples at offsets in pixels from the image of the lens's regular place."""
        middle = self._count // 2
        places = np.stack([y / self._step + middle, x / self._step + middle])
        return map_coordinates(samples, places, prefilter=False, mode="grid-wrap")

    def splines(self, x: np.ndarray, y: np.ndarray) -> csr_array:
        """Return the matrix that multiplies flat `samples` to values at offsets in pixels, as `at` does."""
        weights = []
        index = []
        for offset in (y, x):
            place = offset / self._step + self._count // 2
            first = np.floor(place)
            t = place - first
            s = 1 - t
            weights.append(np.stack([s**3, 4 - 6 * t * t + 3 * t**3, 4 - 6 * s * s + 3 * s**3, t**3], axis=-1) / 6)
            index.append((first.astype(np.int32)[:, None] + np.arange(-1, 3, dtype=np.int32)) % self._count)
        taps = (weights[0][:, :, None] * weights[1][:, None, :]).ravel()
        columns = (index[0][:, :, None] * self._count + index[1][:, None, :]).ravel()
        rows = np.arange(0, len(taps) + 1, 16, dtype=np.int32)
        return csr_array((taps, columns, rows), shape=(len(x), self._count**2))


def _wave_transfer(camera: PlenopticCamera, wavelength: float, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """Return the optical transfer function of a lens for light of the pupil, at frequencies per pixel.

    The autocorrelation of the aperture, with the phase of its defocus, at distances of wavelength times distance times
    frequency (Goodman, equation 6-28).
    """
    length = wavelength * 1e-6
    reach = length * camera.reduced_distance / camera.pixel_size
    lag = reach * float(fx[0, 1])
    half = int(np.ceil(camera.lattice.aperture_reach / lag))
    refuse_if(half > _WIDEST, f"wavelength = {wavelength:g}: the lenses are too large for it; fit by rays")
    # Fine samples are in or out: those that a border covers in part would count by their squares without a lag.
    finer = int(np.ceil(_WIDEST / (2 * half + 1)))
    size = scipy.fft.next_fast_len(2 * half * finer + 1)
    offset = (np.arange(size) - size // 2) * (lag / finer)
    aperture = camera.lattice.in_aperture(*np.broadcast_arrays(offset, offset[:, None]))
    curvature = np.pi / length * camera.pupil_shift(camera.mla_focal_length) / camera.pupil_distance
    field = aperture * np.exp(1j * curvature * (offset**2 + offset[:, None] ** 2))
    padded = scipy.fft.fft2(field, (2 * size, 2 * size))
    correlation = scipy.fft.ifft2(np.abs(padded) ** 2)
    correlation = correlation / correlation[0, 0].real
    across, down = (finer * np.rint(frequencies * reach / lag).astype(int) for frequencies in (fx, fy))
    within = (np.abs(across) < size) & (np.abs(down) < size)
    return np.where(within, correlation[down % (2 * size), across % (2 * size)], 0)
