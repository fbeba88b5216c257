r"""Diffraction by the pupil of an ordinary camera, in phase space: functions of a ray's pupil point, and kernels.

Without a microlens array a ray that passes the pupil at P and would land on the detector at m lands at m + x, with the
signed density

.. math:: K_p(P, x) = \frac{1}{(\lambda b)^2} \int t(P + \eta/2)\, t^*(P - \eta/2)\,
          e^{-2 \pi i \eta \cdot x / \lambda b}\, d^2\eta ,

where t is the transmission of the pupil, aberrations included (`phase_space`). With polynomials :math:`a_n` that are
orthonormal over the pupil with the power :math:`|t|^2` as weight, the first of which is 1,
:math:`K_p(P, x) \approx |t(P)|^2 \sum_n a_n(P)\, \varphi_n(x)`, and a capture is a ray capture of a few values per ray,
whose points P have the density of the power, followed by one convolution for each,

.. math:: I = \sum_n \varphi_n * \sum_{rays} L\, a_n(P), \qquad \varphi_n(x) = \int a_n(P)\, K_p(P, x)\, d^2P .

The first kernel is the point spread function in focus, which is therefore exact. Light from other distances varies with
P; where it does so faster than the polynomials, defocus has already averaged out what diffraction would change. This
does not hold between open parts of a coded aperture, where :math:`K_p` has light although t is 0, nor with large
aberrations: `fitted_pupil` serves these. Rays follow aberrations of first and second order, whose differences t then
lacks; higher orders, and all small aberrations, are in t. Coarse pixels, and lenses with large aberrations, leave all
of them to the rays, without third differences.

P is the middle of two points of the pupil, so that kernels are products of transforms: `lens_functions.of_middles`.
"""

import functools
import math
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..camera import Opening, PlenopticCamera
from ..errors import WAVEFRONT_UNIT, refuse_if
from ..fields import OpticalSystem
from ..optics import in_millimetres
from ..runtime import Doubles, Named, Numbers, Pair, Shape, exponents, single_threaded_blas
from .accuracy import FINER, USUAL
from .fitted_pupil import FittedPupil, PupilFunctions
from .lens_functions import LensFunctions, even_polynomials, of_middles
from .oblique import Oblique
from .pupil_samples import PupilSamples, along, samples_of, spread_points

_SECOND = 6
"""Noll's polynomials up to the second order."""


class PupilDiffraction:
    """Diffraction of one ordinary camera at one wavelength, as functions over the pupil and kernels of images."""

    lands_by_point = True
    """Every ray lands by its own point, and its coefficients are polynomials."""

    tolerance = 0.001
    """Part of images of random light that may be missing for want of images of the places in a pixel."""

    def __init__(
        self,
        # One with glass is taken `at_wavelength`.
        camera: PlenopticCamera,
        wavelength: float,
        fine: bool = False,
        # Shortest wavelength of the plans with which it is used, whose rays start alike. Default: its own wavelength.
        shortest: float | None = None,
        # What is open of the pupil. Default: the camera's aperture.
        opening: Any = None,
        # Most cells across a pixel, beyond which rays are displaced by the point spread function.
        most_cells: int = USUAL.most_airy_cells,
    ):
        self.camera = camera
        self.wavelength = wavelength
        self.options: Named = {"fine": fine, "shortest": shortest}
        # Width of the pupil's diffraction on the detector, lambda b / R, in mm: 1.64 radii of the Airy disc.
        self.unit = in_millimetres(wavelength) * camera.pupil_distance / camera.pupil_radius
        # Widths in mm of the diffraction, and of blur that may differ between wavelengths.
        self.widths = self.unit / 2, self.unit
        # Distance in mm to which captures need kernels.
        self.reach = USUAL.airy_reach * self.unit
        # Width of a pixel over the diffraction of the shortest wavelength.
        pixel = camera.pixel_size / (self.unit * (shortest or wavelength) / wavelength)
        refuse_if(
            pixel < USUAL.finest_pixel,
            f"detector_width = {camera.detector_width:g}: pixels of {camera.pixel_size:.3g} mm are too fine for the "
            f"pupil's diffraction, which is {self.unit:.3g} mm wide: waves of scenes need pixels of "
            f"{USUAL.finest_pixel * self.unit:.2g} mm or more",
        )
        # Count of cells across a pixel that resolve the diffraction. In front of coarser pixels rays themselves are
        # displaced by the point spread function, without kernels if cells are wider than these.
        cells = math.ceil(pixel / USUAL.airy_cell)
        self.is_coarse = cells > most_cells
        self._is_wide = pixel > USUAL.coarse_cells * USUAL.coarse_reach
        self._cells = USUAL.coarse_cells if self.is_coarse else cells
        # Coefficients of the aberrations in the kernels; rays of the optical system follow the others.
        coefficients = np.array(camera.wavefront, float)
        lowest = 3 if np.linalg.norm(coefficients[3:]) <= USUAL.small_aberration else _SECOND
        if self.is_coarse or np.linalg.norm(coefficients[_SECOND:]) > USUAL.most_aberration:
            lowest = len(coefficients)
        in_kernels = np.where(np.arange(len(coefficients)) >= lowest, coefficients, 0)
        by_rays = np.trim_zeros(coefficients - in_kernels, "b")
        self.system = OpticalSystem(camera.replace(wavefront=tuple(by_rays.tolist())), wavelength)
        waves = in_kernels * (WAVEFRONT_UNIT / wavelength)
        self._opening = opening or camera.aperture, tuple(waves.tolist()) if waves.any() else ()
        is_aberrated = np.linalg.norm(in_kernels) > USUAL.small_aberration
        # The pupil may have closed parts between open ones that matter: in coarse pixels they do not.
        is_coded = camera.aperture_image is not None and not self.is_coarse
        self._is_fitted = bool(is_coded or is_aberrated)
        accuracy = FINER if fine or is_aberrated else USUAL
        self._degree = accuracy.part_degree if is_coded else accuracy.pupil_degree

    def parts(self, fine: bool) -> int:
        """Return the number of cells of the grid across a pixel."""
        return self._cells

    @cached_property
    def _pupil(self) -> PupilSamples:
        return samples_of(*self._opening)

    @cached_property
    def fitted(self) -> FittedPupil | None:
        """Functions and fitted kernels of coded or aberrated pupils."""
        return _fitted(*self._opening, self._degree) if self._is_fitted else None

    @cached_property
    @single_threaded_blas()
    def functions(self) -> LensFunctions | PupilFunctions:
        """Functions of a ray's `arguments`: polynomials, fewer where little of the pupil is open."""
        if self.fitted:
            return self.fitted.functions
        return even_polynomials([spread_points(self._pupil.power)], 0 if self._is_wide else self._degree)[0]

    @property
    def oblique(self) -> Oblique:
        """Changes of the kernels with the direction of light, of which there are none."""
        return Oblique.nothing(self.functions.count)

    @cached_property
    def covariance(self) -> Doubles:
        """Covariance of the values of an image's rays, for light with random edges over the pupil."""
        if not isinstance(self.functions, PupilFunctions):
            points = spread_points(self._pupil.power)
            return self.functions.light(*(coordinate[:: USUAL.pupil_every] for coordinate in points))
        assert self.fitted
        return self.fitted.covariance

    def arguments(self, point: Pair, pupil: Pair) -> list:
        """Return the numbers of which a ray's coefficients are polynomials: its pupil point over the radius.

        Behind coded apertures the shares of the pupil's parts follow, by which polynomials are multiplied.
        """
        x, y = (coordinate / self.camera.pupil_radius for coordinate in pupil)
        return [x, y] if self.fitted is None else self.fitted.arguments(x, y)

    def spots(self, places: Doubles) -> Doubles:
        """Return the point spread function in focus (1, n, n), at detector positions in mm along both axes."""
        field = self._fields(places / self.unit, [(0, 0)])[0, 0]
        return (np.abs(field) ** 2)[None] / np.abs(field).max() ** 2

    @cached_property
    def spread(self) -> tuple[Doubles, float]:
        """The point spread function in focus on a grid, and the width of a cell of the grid in mm."""
        step = USUAL.airy_cell / 2
        return np.maximum(self._sampled(step, math.ceil(USUAL.airy_reach / step))[0], 0), step * self.unit

    def kernels(self, step: float, reach: float, kind: int = 0) -> Doubles:
        """Return the kernels (n, k, k) on a grid of width `step` in mm, times the area of a grid cell."""
        if self._is_wide:
            return np.ones((1, 1, 1))
        if not self.is_coarse:
            return self._sampled(step / self.unit, math.ceil(reach / step))
        # Between coarse pixels rays are displaced by the spread of the shortest wavelength.
        parts = 2 * math.ceil(step / (2 * USUAL.airy_cell * self.unit)) + 1
        count = 2 * math.ceil(USUAL.coarse_reach * self.unit / step) + 1
        fine = step / parts
        spectra = scipy.fft.fft2(scipy.fft.ifftshift(self._sampled(fine / self.unit, count * parts // 2), (1, 2)))
        spread = spectra[0]
        if self.options["shortest"] not in (None, self.wavelength):
            shortest = PupilDiffraction(self.camera, self.options["shortest"], self.options["fine"])
            spread = scipy.fft.fft2(scipy.fft.ifftshift(shortest._sampled(fine / shortest.unit, count * parts // 2)[0]))
        # The lowest frequencies, which the grid of pixels can represent.
        order = scipy.fft.ifftshift(np.arange(count) - count // 2)
        low = np.ix_(order, order)
        passed = spread[low]
        # Where hardly anything passes, noise would be amplified.
        ratio = np.stack([spectrum[low] for spectrum in spectra]) * passed.conj()
        ratio /= np.maximum(np.abs(passed) ** 2, USUAL.least_transfer * np.abs(passed))
        return scipy.fft.fftshift(scipy.fft.ifft2(ratio).real, (1, 2))

    @single_threaded_blas()
    def _fields(self, places: Doubles, powers: list[Shape]) -> dict[Shape, NDArray[np.complex128]]:
        """Return transforms of transmission times powers, at detector places in `unit` along both axes."""
        x = along(USUAL.pupil_samples)
        transmission = self._pupil.transmission
        waves = np.exp(-2j * np.pi * np.outer(places, x))
        rows = [(waves * x**b) @ transmission for b in range(max(map(sum, powers)) + 1)]
        columns = [(waves * x**a).T for a in range(len(rows))]
        return {(a, b): rows[b] @ columns[a] for a, b in powers}

    def _sampled(self, step: float, count: int) -> Doubles:
        """Return the kernels (n, k, k) at `count` samples on either side, `step` units apart, times their area."""
        places = step * np.arange(-count, count + 1.0)
        # Powers whose integrals with the pupil's light give kernels, and their coefficients (powers, kernels).
        powers = [(0, 0)] if self.fitted else self.functions.exponents
        combined = np.ones((1, 1)) if self.fitted else self.functions.combined
        products = of_middles(powers, self._fields(places, exponents(max(map(sum, powers)))))
        spacing = 2 / USUAL.pupil_samples
        kernels = np.einsum("mn,myx->nyx", combined, products) * (spacing**4 * step**2 / self._pupil.whole)
        if self.fitted:
            kernels = np.concatenate([kernels, self.fitted.kernels(places) * step**2])
        # They fall to zero, as edges of windows would show around lamps, and keep the energy.
        across = np.hypot(*np.meshgrid(*[np.arange(-count, count + 1.0) / count] * 2))
        kernels *= np.cos(np.pi / 2 * np.clip((across - USUAL.taper) / (1 - USUAL.taper), 0, 1)) ** 2
        tail = np.maximum(1 - across**2, 0) ** 2
        missing = np.eye(len(kernels))[0] - kernels.sum((1, 2))
        return kernels + missing[:, None, None] * (tail / tail.sum())


@functools.lru_cache(maxsize=8)
def _fitted(aperture: Opening, waves: Numbers, degree: int) -> FittedPupil:
    """Return the functions and kernels of a pupil, cached for further wavelengths and captures."""
    return FittedPupil(samples_of(aperture, waves), degree)
