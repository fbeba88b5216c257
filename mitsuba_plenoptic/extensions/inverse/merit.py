"""Figures of merit of a camera with their gradients: sharpness, and the information on depth."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ...camera import PlenopticCamera
from ...errors import InputError, did_you_mean, refuse_if, require_count, require_number, require_wavelength
from ...fields import OpticalSystem
from ...points import CaptureOperator, check_positions, chosen_accuracy
from ...runtime import Doubles, Floats, Named, Pair, Triple
from .differentiable import RayRefocus

Gradient = dict[str, Doubles]


class Spreads:
    """The point spreads of a figure of merit's points, each computed by itself."""

    def __init__(self, points: Any, wavelength: float, accuracy: float | None, method: str):
        # Where they may lie depends on the camera, and is checked with it.
        self.points, self.wavelength = check_positions(points, virtual=True), require_wavelength(wavelength)
        # 0.02: Default error allowed for the point spreads: designs differ by more.
        self._accuracy = chosen_accuracy(accuracy, method, 0.02)
        self._method = method
        self._system: OpticalSystem | None = None

    def images(self, camera: PlenopticCamera, points: Doubles | None = None) -> Doubles:
        """Return the point spreads (n, rows, columns) of the figure's points, or of `points` if given."""
        # One by one: points so near each other must not share a spread.
        return np.stack([operator.forward([1.0]) for operator in self._operators(camera, points)]).astype(np.float64)

    def gradient(
        self, camera: PlenopticCamera, images: Doubles, names: Iterable[str], points: Doubles | None = None
    ) -> Gradient:
        """Return the gradient with respect to camera parameters, from the spreads' gradient (n, rows, columns)."""
        total: Gradient = {}
        for operator, image in zip(self._operators(camera, points), images, strict=True):
            gradients = operator.gradient([1.0], image.astype(np.float32), tuple(names))
            total = {name: value + total.get(name, 0.0) for name, value in gradients.items()}
        return total

    def _operators(self, camera: PlenopticCamera, points: Doubles | None) -> Iterable[CaptureOperator]:
        camera = camera.regular
        if self._system is None or self._system.camera != camera:
            self._system = OpticalSystem(camera.at_wavelength(self.wavelength), self.wavelength)
        # A step from a point far away may lead across infinity.
        options: Named = {"accuracy": self._accuracy, "method": self._method, "virtual": points is not None}
        for point in self.points if points is None else points:
            yield CaptureOperator(camera, [point], wavelength=self.wavelength, system=self._system, **options)


VARYING = ("mla_focal_length", "mla_fill", "wavefront")
"""Parameters on which refocusing by rays does not depend."""


class RefocusedContrast:
    r"""Mean contrast of points refocused by rays: the modulation transfer, averaged over a range of depths.

    .. math:: \frac{1}{n m} \sum_{r, \nu} \frac{|\sum_j b_{rj} \, e^{-2 \pi i \nu \cdot x_j}|}{\sum_j b_{rj}}

    The bins :math:`b_{rj}` are those of the point r, refocused to its distance; the frequencies :math:`\nu` are along x
    and y. The refocusing of one camera serves for all cameras.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera whose refocusing is used. Others may differ from it in ``mla_focal_length``, ``mla_fill`` and
        ``wavefront``.
    points : array (n, 3)
        Scene points (X, Y, g) in the camera frame, in millimetres.
    frequencies : sequence of float
        Spatial frequencies in line pairs per bin of one lens, at most half of `oversample`.
    wavelength : float
        Wavelength in nanometres.
    oversample : int
        Bins per lens along each axis.
    accuracy, method
        As for `CaptureOperator`; the default accuracy of the method "patch" is 0.02.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        points: Any,
        frequencies: Sequence[float],
        *,
        wavelength: float = 633.0,
        oversample: int = 4,
        accuracy: float | None = None,
        method: str = "patch",
    ):
        self._camera, self._spreads = camera, Spreads(points, wavelength, accuracy, method)
        count = require_count("oversample", oversample)
        checked = [require_number("frequencies", frequency, positive=True) for frequency in frequencies]
        refuse_if(
            not checked or max(checked) > count / 2,
            f"frequencies = {tuple(checked)}: give some, at most {count / 2:g}, half of oversample",
        )
        self._refocus = [RayRefocus(camera, g, oversample=count) for g in self._spreads.points[:, 2].tolist()]
        waves = []
        for size in reversed(camera.bin_count):
            waves.append(np.exp(-2j * np.pi * np.array(checked)[:, None] * ((np.arange(size * count) + 0.5) / count)))
        self._along_y, self._along_x = waves

    def value(self, camera: PlenopticCamera) -> float:
        """Return the mean contrast of a camera."""
        return self._contrast(self._images(camera))[0]

    def gradient(self, camera: PlenopticCamera, names: Iterable[str]) -> tuple[float, Gradient]:
        """Return the mean contrast, and its derivatives with respect to camera parameters, by name.

        Parameters
        ----------
        names : iterable of str
            The parameters.

        Raises
        ------
        InputError
            If refocusing depends on a parameter.
        """
        names = tuple(names)
        for name in names:
            if name not in VARYING:
                raise InputError(
                    f"{name}: refocusing does not follow it; parameters that may vary: {', '.join(VARYING)}"
                    f"{did_you_mean(name, VARYING)}"
                )
        value, slopes = self._contrast(self._images(camera))
        return value, self._spreads.gradient(camera, slopes, names)

    def refocused(self, camera: PlenopticCamera) -> list[Floats]:
        """Return the refocused image of each point."""
        return [refocus.forward(image) for refocus, image in zip(self._refocus, self._images(camera), strict=True)]

    def _images(self, camera: PlenopticCamera) -> Doubles:
        # What this figure holds fixed must not differ.
        own = self._camera.to_dict()
        for name, value in camera.to_dict().items():
            if name not in VARYING:
                refuse_if(own[name] != value, f"{name} = {value}: this figure is of cameras with {own[name]}")
        return self._spreads.images(camera)

    def _contrast(self, images: Doubles) -> tuple[float, Doubles]:
        """Return the mean contrast, and its gradient with respect to the point spreads."""
        total = 0.0
        gradients = []
        count = len(images) * (len(self._along_x) + len(self._along_y))
        for refocus, image in zip(self._refocus, images, strict=True):
            bins = refocus.forward(image.astype(np.float32)).astype(np.float64)
            light = bins.sum()
            slope = np.zeros_like(bins)
            refuse_if(not light > 0, "points: one of them sends no light to the recorded pixels")
            for amplitudes, waves, across in (
                (self._along_x @ bins.sum(0), self._along_x, False),
                (self._along_y @ bins.sum(1), self._along_y, True),
            ):
                for amplitude, wave in zip(amplitudes, waves, strict=True):
                    size = abs(amplitude)
                    total += size / light
                    along = (amplitude.conjugate() * wave).real / max(size, 1e-300) / light
                    slope += (along[:, None] if across else along) - size / light**2
            gradients.append(refocus.adjoint(slope / count))
        return total / count, np.stack(gradients)


class DepthInformation:
    r"""Figure of merit: the precision of depths in noisy captures of points of unknown position and brightness.

    The position (X, Y, g) and the brightness w of each point are unknown. With the expected photon counts I and the
    background B of each pixel, Fisher's information is

    .. math:: F_{ab} = \sum_p \frac{\partial_a I_p \, \partial_b I_p}{I_p + B}, \qquad
              \sigma_g = \sqrt{(F^{-1})_{gg}},

    the least standard deviation of an unbiased estimate of the depth (Kay, "Fundamentals of statistical signal
    processing: estimation theory", 1993, chapter 3). The figure is the mean of :math:`-\ln \sigma_g` over the points:
    an increase by 0.69 halves all deviations. Derivatives with respect to position are central differences: sideways,
    and along the chief ray in the vergence 1/g, with steps of a hundredth of a wave of path at the rim of the pupil.

    Parameters
    ----------
    points : array (n, 3)
        Scene points (X, Y, g) in the camera frame, in millimetres.
    photons : float
        Number of photons of each point that pass the pupil.
    background : float
        Variance of each pixel without light, in photons; it must not be zero, or dark pixels would determine
        everything.
    wavelength, accuracy, method
        As for `CaptureOperator`; the default accuracy of the method "patch" is 0.02.
        Derivatives by parameters that hardly change the figure are the least exact: by the focal length of a test
        camera, 12 % too small by default and 3 % too small with the accuracy 0.
    """

    def __init__(
        self,
        points: Any,
        photons: float,
        *,
        background: float = 1.0,
        wavelength: float = 633.0,
        accuracy: float | None = None,
        method: str = "patch",
    ):
        self._spreads = Spreads(points, wavelength, accuracy, method)
        self._photons = require_number("photons", photons, positive=True)
        self._background = require_number("background", background, positive=True)

    def value(self, camera: PlenopticCamera) -> float:
        """Return the mean of -ln of the depths' standard deviations for a camera."""
        return float(-np.log(self.deviations(camera)).mean())

    def deviations(self, camera: PlenopticCamera) -> Doubles:
        """Return the standard deviations of the depths of all points, in millimetres."""
        middle, *slopes = self.expected(camera)
        return np.array([np.sqrt(self._covariance(*parts)[2, 2]) for parts in zip(middle, *slopes, strict=True)])

    def expected(self, camera: PlenopticCamera) -> list[Doubles]:
        """Return the expected photon counts, (n, rows, columns), and their derivatives with respect to X, Y and g."""
        camera.require_array("DepthInformation")
        photons = self._photons
        slopes = []
        for *sides, factor in self._moves(camera):
            there, back = (self._spreads.images(camera, points) for points in sides)
            slopes.append(photons * factor * (there - back))
        for slope, tilt in zip(slopes[:2], self._tilts(camera), strict=True):
            slopes[2] = slopes[2] - tilt * slope
        return [photons * self._spreads.images(camera), *slopes]

    def gradient(self, camera: PlenopticCamera, names: Iterable[str]) -> tuple[float, Gradient]:
        """Return the figure of merit, and its derivatives with respect to camera parameters, by name."""
        names = tuple(names)
        expected = self.expected(camera)
        count = len(expected[0])
        cotangents = [np.zeros_like(gradient_of) for gradient_of in expected]
        value = 0.0
        for index, parts in enumerate(zip(*expected, strict=True)):
            covariance = self._covariance(*parts)
            variance = covariance[2, 2]
            column = covariance[2]
            value -= np.log(variance) / 2 / count
            # d ln(1 / sigma) = c' dF c / 2 sigma^2, with c the depth's column of the covariance.
            noise = self._noise(parts[0])
            along = np.tensordot(column, np.roll(parts, -1, axis=0), 1)
            for back, gradient_of in zip(cotangents, [column[3], *column[:3]], strict=True):
                back[index] = gradient_of * along / noise / variance / count
            # The brightness w is relative: its derivative is the image itself.
            cotangents[0][index] -= along**2 / noise**2 / 2 / variance / count
        total: Gradient = {}
        for points, images in self._moved(camera, cotangents):
            gradients = self._spreads.gradient(camera, self._photons * images, names, points)
            total = {name: gradient_of + total.get(name, 0.0) for name, gradient_of in gradients.items()}
        return float(value), total

    def _moved(self, camera: PlenopticCamera, cotangents: list[Doubles]) -> Iterator[Pair]:
        """Yield displaced positions of the points, and the gradients with respect to their point spreads."""
        image, *along, depth = cotangents
        yield self._spreads.points, image
        given = [*(part - tilt * depth for part, tilt in zip(along, self._tilts(camera), strict=True)), depth]
        for (there, back, factor), part in zip(self._moves(camera), given, strict=True):
            yield there, factor * part
            yield back, -factor * part

    def _tilts(self, camera: PlenopticCamera) -> list[Doubles]:
        """Return X/g and Y/g of the chief rays, (n, 1, 1); behind an objective they are 0."""
        x, y, g = self._spreads.points.T[..., None, None]
        return [x / g, y / g] if camera.lens_data.converges else [0 * x, 0 * y]

    def _moves(self, camera: PlenopticCamera) -> list[Triple]:
        """Return positions (n, 3) to both sides of the points, and factors (n, 1, 1) from differences to derivatives.

        The displacements are along X, along Y, and along the chief ray in vergence.
        """
        points = self._spreads.points
        g = points[:, 2]
        # 0.01: Waves by which a point is moved: the change of its path to the pupil's rim, against that to the middle.
        path = 0.01 * self._spreads.wavelength * 1e-6
        objective = camera.objective
        if objective is None:
            sideways = path * np.abs(g) / camera.aperture_radius
            step = 2 * path / camera.aperture_radius**2
            near = 1 / (1 / g + step)
            far = 1 / (1 / g - step)
            there = points * (near / g)[:, None]
            back = points * (far / g)[:, None]
            rate = -1 / (2 * step * g**2)
        else:
            aperture = objective.numerical_aperture
            sideways = np.full(len(g), path / aperture)
            step = 2 * path * objective.immersion / aperture**2
            there, back = (points + np.array([0, 0, side * step]) for side in (1, -1))
            rate = np.full(len(g), 1 / (2 * step))
        moves = []
        for axis in (0, 1):
            along = sideways[:, None] * (np.arange(3) == axis)
            moves.append((points + along, points - along, (1 / (2 * sideways))[:, None, None]))
        return [*moves, (there, back, rate[:, None, None])]

    def _noise(self, expected: Doubles) -> Doubles:
        """Return the noise variance of each pixel for an expected image."""
        return np.maximum(expected, 0) + self._background

    def _covariance(self, expected: Doubles, *slopes: Doubles) -> Doubles:
        """Return the Cramer-Rao covariance of X, Y, g and the brightness of one point."""
        rows = np.stack([*slopes, expected]) / np.sqrt(self._noise(expected))
        flat = rows.reshape(len(rows), -1)
        return np.asarray(np.linalg.inv(flat @ flat.T))
