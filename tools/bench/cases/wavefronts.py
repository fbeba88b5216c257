"""Wavefronts from captures of stars that HCIPy simulates, and from those of a Shack-Hartmann sensor."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.optics.waves import in_millimetres
from mitsuba_plenoptic.wavefront import Zone, fit_wavefronts, modes_from_slopes, view_slopes

from .. import Row, at_most, case

WAVELENGTH = 633.0
STAR = (0.0, 0.0, 1e9)
DIAMETER, F_NUMBER = 10.0, 50.0
LENSES, PIXELS = 16, 8
"""Lenses across both sensors, and pixels across a lens."""

WIDTH = 4.0
"""Width of a lens of the array in the focus, in lambda / D on the sky."""

FINER = 4
"""Samples of HCIPy's fields across a pixel."""


def cells(image: NDArray[Any], pixels: int) -> NDArray[Any]:
    """Return the cells of the lenses, (rows, columns, pixels, pixels)."""
    rows, columns = (size // pixels for size in image.shape)
    return image.astype(float).reshape(rows, pixels, columns, pixels).transpose(0, 2, 1, 3)


def spots(image: NDArray[Any], pixels: int) -> NDArray[np.float64]:
    """Return the positions of spots in pixels by the phase of the first Fourier coefficient of their cells.

    Other than the centroid it hardly depends on the tails of spots, which the borders of the cells cut off.
    """
    each, waves = cells(image, pixels), np.exp(2j * np.pi * (np.arange(pixels) - (pixels - 1) / 2) / pixels)
    return np.angle(np.stack([each.sum(2) @ waves, each.sum(3) @ waves])) * pixels / (2 * np.pi)


def telescope(lenses: int = LENSES, pixels: int = PIXELS, width: float = WIDTH) -> PlenopticCamera:
    """Return a telescope with the array in its focus, whose micro-images are 0.9 of a lens wide."""
    pitch = width * in_millimetres(WAVELENGTH) * F_NUMBER
    return PlenopticCamera(
        focal_length=F_NUMBER * DIAMETER,
        aperture_radius=DIAMETER / 2,
        mla_distance=F_NUMBER * DIAMETER,
        mla_pitch=pitch,
        mla_focal_length=0.9 * F_NUMBER * pitch,
        detector_width=lenses * pitch,
        resolution=(lenses * pixels,) * 2,
    )


class _Sensor:
    """A sensor of HCIPy: its pupil, its Zernike modes in Noll's order, and its captures."""

    pupil: Any

    @cached_property
    def aperture(self) -> Any:
        import hcipy

        return hcipy.evaluate_supersampled(hcipy.make_circular_aperture(DIAMETER), self.pupil, 4)

    def basis(self, modes: int) -> np.ndarray:
        """Return the modes, (modes, samples), each of a root mean square of 1."""
        import hcipy

        return np.array(hcipy.make_zernike_basis(modes, DIAMETER, self.pupil, 1))

    def start(self, phase: np.ndarray) -> Any:
        """Return the wavefront of a star in the pupil, of a power of 1."""
        import hcipy

        wavefront = hcipy.Wavefront(self.aperture * np.exp(1j * phase), in_millimetres(WAVELENGTH))
        wavefront.total_power = 1
        return wavefront


def _binned(power: Any) -> np.ndarray:
    samples = np.asarray(power.shaped)
    rows, columns = samples.shape
    return samples.reshape(rows // FINER, FINER, columns // FINER, FINER).sum((1, 3))


class ArrayInFocus(_Sensor):
    """HCIPy's own microlens array in the focus of a camera's main lens."""

    def __init__(self, camera: PlenopticCamera) -> None:
        import hcipy

        self.pupil = hcipy.make_pupil_grid(256, DIAMETER)
        focus = hcipy.make_uniform_grid([FINER * camera.resolution[0]] * 2, [camera.detector_width] * 2)
        b, lenses = camera.mla_distance, round(camera.detector_width / camera.row_pitch) + 4
        centres = (np.arange(lenses) - (lenses - 1) / 2) * camera.row_pitch
        lattice = hcipy.CartesianGrid(hcipy.SeparatedCoords((centres, centres)))
        # Fraunhofer's integral leaves out the curvature of the field in the focal plane.
        self._curvature = np.exp(1j * math.pi * (focus.x**2 + focus.y**2) / (in_millimetres(WAVELENGTH) * b))
        self._to_focus = hcipy.FraunhoferPropagator(self.pupil, focus, b)
        self._array = hcipy.MicroLensArray(focus, lattice, camera.mla_focal_lengths[0])
        self._to_detector = hcipy.FresnelPropagator(focus, camera.detector_distance)

    def image(self, phase: np.ndarray) -> np.ndarray:
        """Return the fraction of the star's light in each pixel."""
        focus = self._to_focus(self.start(phase))
        focus.electric_field *= self._curvature
        return _binned(self._to_detector(self._array(focus)).power)


class ShackHartmann(_Sensor):
    """HCIPy's Shack-Hartmann sensor, whose spots are two pixels wide."""

    def __init__(self) -> None:
        import hcipy

        pitch = DIAMETER / LENSES
        self.pupil = hcipy.make_uniform_grid([FINER * LENSES * PIXELS] * 2, [DIAMETER] * 2)
        centres = (np.arange(LENSES) - (LENSES - 1) / 2) * pitch
        lattice = hcipy.CartesianGrid(hcipy.SeparatedCoords((centres, centres)))
        focal_length = 2 * pitch**2 / (PIXELS * in_millimetres(WAVELENGTH))
        self._array = hcipy.MicroLensArray(self.pupil, lattice, focal_length)
        self._to_detector = hcipy.FresnelPropagator(self.pupil, focal_length)

    def image(self, phase: np.ndarray) -> np.ndarray:
        """Return the fraction of the star's light in each pixel."""
        return _binned(self._to_detector(self._array(self.start(phase))).power)


class SpotTerms:
    """Terms from the positions of all spots, by the sensor's answer to 0.02 waves of each mode."""

    def __init__(self, sensor: ShackHartmann, basis: np.ndarray) -> None:
        flat = sensor.image(0 * basis[0])
        light = cells(flat, PIXELS).sum((2, 3))
        self._lit = light > 0.3 * light.max()
        self._flat = self._positions(flat)
        columns = []
        for mode in basis[1:]:
            plus, minus = (self._positions(sensor.image(side * 0.04 * math.pi * mode)) for side in (1, -1))
            columns.append((plus - minus) / 0.04)
        weight = np.sqrt(np.tile(light[self._lit], 2))
        self._matrix = np.linalg.pinv(np.array(columns).T * weight[:, None]) * weight

    def find(self, image: np.ndarray) -> np.ndarray:
        """Return the terms of a capture."""
        return np.concatenate([[0.0], self._matrix @ (self._positions(image) - self._flat)])

    def _positions(self, image: np.ndarray) -> np.ndarray:
        return spots(image, PIXELS)[:, self._lit].ravel()


def atmosphere(ratio: float, modes: int, seed: int) -> np.ndarray:
    """Return the Zernike terms, in waves, of one of HCIPy's Kolmogorov screens; the piston is 0."""
    import hcipy

    pupil = hcipy.make_pupil_grid(64, DIAMETER)
    inside = np.asarray(hcipy.make_circular_aperture(DIAMETER)(pupil)) > 0.5
    strength = hcipy.Cn_squared_from_fried_parameter(DIAMETER / ratio, in_millimetres(WAVELENGTH))
    layer = hcipy.InfiniteAtmosphericLayer(pupil, strength, 20 * DIAMETER, seed=seed)
    basis = np.array(hcipy.make_zernike_basis(modes, DIAMETER, pupil, 1))
    terms, *_ = np.linalg.lstsq(
        basis[:, inside].T, np.asarray(layer.phase_for(in_millimetres(WAVELENGTH)))[inside], rcond=None
    )
    return np.concatenate([[0.0], terms[1:] / (2 * math.pi)])


def rms(terms: np.ndarray) -> float:
    """Return the root mean square over the pupil of a wavefront, in waves."""
    return float(np.linalg.norm(terms[1:]))


@case(
    "wavefronts.stars",
    "Zernike terms of atmospheres from one capture of a star: residuals in waves, root mean square over the pupil, "
    "of a plenoptic camera (slopes of views; fit to pixels) and of a Shack-Hartmann sensor (positions of spots) "
    "with as many lenses, pixels and photons; all captures simulated by HCIPy",
    {
        "D / r0": "{ratio:g}", "photons per lens": "{photons:g}", "wavefront": "{true:.3f}", "views": "{views:.3f}",
        "fit": "{fitted:.4f}", "deviation that the fit states": "{stated:.4f}",
        "Shack-Hartmann": "{spots:.4f}", "the same without noise": "{spots_noiseless:.4f}",
    },
    (at_most("fitted", "spots"), at_most("over_stated", 3.0)),
    page="docs/theory/wavefronts.md",
    needs=("hcipy",),
    quick={"seeds": 1, "ratios": (5.0,), "photons": (1000.0,), "modes": 6, "accuracy": 0.3},
)  # fmt: skip
def stars(
    *,
    ratios: tuple[float, ...] = (5.0, 10.0, 20.0),
    photons: tuple[float, ...] = (100.0, 1000.0, 10000.0),
    modes: int = 36,
    modes_of_screen: int = 36,
    seeds: int = 2,
    accuracy: float = 0.1,
) -> Iterator[Row]:
    """Find the modes of an atmosphere at each strength and exposure.

    The screen has `modes_of_screen`: those that are found, or more, which then remain in the captures.
    """
    camera, pupil_sensor = telescope(), ShackHartmann()
    sensor = ArrayInFocus(camera)
    basis, pupil_basis = sensor.basis(modes_of_screen), pupil_sensor.basis(modes_of_screen)
    spot_terms = SpotTerms(pupil_sensor, pupil_basis[:modes])
    lit = math.pi / 4 * LENSES**2
    for ratio in ratios:
        screens = [atmosphere(ratio, modes_of_screen, seed + 1) for seed in range(seeds)]
        means = [
            [
                each.image(2 * math.pi * np.tensordot(terms, own, 1))
                for each, own in ((sensor, basis), (pupil_sensor, pupil_basis))
            ]
            for terms in screens
        ]
        for count in photons:
            errors = []
            for seed, (screen, (mean, spot_mean)) in enumerate(zip(screens, means, strict=True)):
                terms = screen[:modes]
                rng = np.random.default_rng(seed)
                image, spot_image = (rng.poisson(each * count * lit).astype(float) for each in (mean, spot_mean))
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # that chi-square shows the difference of the two programs
                    found = fit_wavefronts(camera, image, Zone([STAR]), modes=modes, accuracy=accuracy)
                views = modes_from_slopes(view_slopes(camera, image, STAR), DIAMETER / 2, modes)
                errors.append(
                    (
                        rms(terms),
                        rms(views - terms),
                        rms(np.array(found.camera.wavefront) - terms),
                        float(np.linalg.norm(list(found.deviations.values()))),
                        rms(spot_terms.find(spot_image) - terms),
                        rms(spot_terms.find(spot_mean) - terms),
                    )
                )
            true, views, fitted, stated, own, noiseless = np.sqrt(np.mean(np.square(errors), axis=0)).tolist()
            yield {
                "ratio": ratio,
                "photons": count,
                "true": true,
                "views": views,
                "fitted": fitted,
                "stated": stated,
                "spots": own,
                "spots_noiseless": noiseless,
                # Where photons are many, the two programs differ by more than these deviations.
                "over_stated": fitted / stated if count <= 1000 and modes_of_screen == modes else None,
            }
