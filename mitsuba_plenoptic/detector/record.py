"""An image sensor's effect on a noise-free capture: photon noise, dark noise, saturation and digital numbers."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ..camera import PlenopticCamera
from ..choices import MOSAICS, AnyMosaic
from ..errors import (
    InputError,
    put,
    put_checked,
    refuse_if,
    require_choice,
    require_count,
    require_number,
    short_repr,
    suggest_keywords,
)
from ..io import Capture, read_if_path, recording_of, require_demosaiced
from ..runtime import Array, Integers

# Bounds of what is counted or multiplied, so that no product leaves what a float holds.
_LARGEST = 1e9
_positive = partial(require_number, positive=True, minimum=1e-9, maximum=_LARGEST)


@suggest_keywords
@dataclass(frozen=True)
class Detector:
    r"""A linear image sensor after EMVA Standard 1288, Release 4.0 Linear.

    A Poisson-distributed number of electrons, of mean :math:`\mu_e = \eta \mu_p + \mu_d` for a mean number
    :math:`\mu_p` of photons, is freed in a pixel, at most the full well. Reading adds normal noise of standard
    deviation :math:`\sigma_d`. The digital number is :math:`y = K e` plus the black level, rounded, between 0 and
    :math:`2^{bits} - 1`. Below saturation its mean is :math:`K \mu_e` plus the black level, within 0.003, and its
    variance :math:`\sigma_y^2 = K^2 (\sigma_d^2 + \mu_e) + 1/12`, within 0.03, if :math:`K \sigma_d \geq 1/2` and the
    black level keeps the noise above 0. With less read noise rounding shows: the mean is off by up to half a number,
    and the term 1/12 does not hold.

    The defaults are typical of a CMOS sensor with pixels of 2 micrometres. Every channel of a colour capture is exposed
    as a separate sensor, or, with a `mosaic`, each pixel records one of the three. There is no non-uniformity from
    pixel to pixel.

    Parameters
    ----------
    quantum_efficiency : float
        Fraction :math:`\eta` of photons that free an electron, 1e-9 to 1.
    full_well : float
        Electrons at which a pixel saturates, 1 to 1e9. The next two parameters are at most 1e9, too.
    dark_electrons : float
        Mean number :math:`\mu_d` of electrons that come without light during the exposure.
    read_noise : float
        Standard deviation :math:`\sigma_d` of the dark signal of a very short exposure, in electrons.
    bits : int
        Bits of a digital number, 1 to 16.
    gain : float, optional
        Digital numbers per electron, K, at least 1e-9. Default: the full well is the largest number.
    black_level : int, optional
        Digital number without any electron. Default: four standard deviations of the dark noise, so that it is not
        cut off.
    mosaic : {"RGGB", "GRBG", "GBRG", "BGGR", "QUAD_RGGB", "QUAD_GRBG", "QUAD_GBRG", "QUAD_BGGR"}, optional
        Colours of the filters on the first two pixels of the detector's first row and of its second, repeated all over
        it; of a quad Bayer mosaic on the first two squares of 2 x 2 pixels, each of which may lie under one lens.
        Default: none.
    """

    quantum_efficiency: float = 0.6
    full_well: float = 8000.0
    dark_electrons: float = 0.0
    read_noise: float = 2.5
    bits: int = 12
    gain: float | None = None
    black_level: int | None = None
    mosaic: str | None = None

    def __post_init__(self) -> None:
        noise = partial(require_number, minimum=0, maximum=_LARGEST)
        put_checked(
            self,
            quantum_efficiency=partial(_positive, maximum=1),
            full_well=partial(require_number, minimum=1, maximum=_LARGEST),
            dark_electrons=noise,
            read_noise=noise,
            bits=partial(require_count, maximum=16),
            mosaic=partial(require_choice, choices=AnyMosaic),
        )
        top = 2**self.bits - 1
        black = self.black_level
        if black is None:
            deviation = math.hypot(self.read_noise, math.sqrt(self.dark_electrons))
            scale = top / self.full_well if self.gain is None else _positive("gain", self.gain)
            black = min(math.ceil(4 * scale * deviation), top // 2)
        black = require_count("black_level", black, minimum=0, maximum=top - 1)
        gain = (top - black) / self.full_well if self.gain is None else self.gain
        put(self, black_level=black, gain=_positive("gain", gain))

    def digital_numbers(self, photons: Array, generator: np.random.Generator) -> Array:
        """Return the digital numbers of pixels that are hit by a given mean number of photons.

        Parameters
        ----------
        photons : array
            Mean number of photons in each pixel, not negative.
        generator : numpy.random.Generator
            Source of the noise.

        Returns
        -------
        uint16 array of the same shape
        """
        return self._exposed(photons, generator)[0]

    def _exposed(self, photons: Array, generator: np.random.Generator) -> tuple[Array, Array]:
        """Return the digital numbers, and a mask of pixels with a full well or the largest number."""
        assert self.gain is not None and self.black_level is not None
        # Far beyond saturation the number of electrons does not matter, but would overflow.
        mean = np.minimum(self.quantum_efficiency * photons + self.dark_electrons, 100 * self.full_well + 1e4)
        electrons = np.minimum(generator.poisson(mean), self.full_well)
        read = electrons + generator.normal(0, self.read_noise, electrons.shape)
        largest = 2**self.bits - 1
        numbers = np.clip(np.round(self.gain * read + self.black_level), 0, largest).astype(np.uint16)
        return numbers, (electrons >= self.full_well) | (numbers == largest)


@suggest_keywords
def expose(
    capture: Capture | str | Path, detector: Detector | None = None, *, photons: float, seed: int = 0
) -> Capture:
    """Record a noise-free capture with a real detector.

    The result is in units of the capture again: digital numbers less black level and dark signal, divided by gain,
    quantum efficiency and photons. So all functions that take a capture accept it, and show the effect of noise. Below
    saturation its mean is that of the capture, if the read noise is half a digital number or more. With less, as for
    few bits and a large full well, rounding displaces the mean by up to half a number, which is ``0.5 / (gain *
    quantum_efficiency * photons)`` in units of the capture.

    Parameters
    ----------
    capture : Capture or path
        The capture, or its file; values below 0, which interpolation may leave, count as dark.
    detector : Detector, optional
        The image sensor. Default: that of a `Detector` without arguments.
    photons : float
        Photons that hit a pixel of value 1 during the exposure, 1e-9 to 1e9.
    seed : int
        Seed of the noise; the same seed gives the same image.

    Returns
    -------
    Capture
        With detector, photons and seed in `metadata` under ``exposure``, and there the number of ``saturated_pixels``:
        those with a full well, or with the largest digital number, in any channel. The noise of the rendering is left
        out. With a mosaic it has one channel, for `demosaic`, and its metadata the `wavelength` of the colours under
        ``exposure``.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> detector = mp.Detector(read_noise=2.5, bits=12)
    >>> exposed = mp.expose(mp.example("letters-ray"), detector, photons=1000, seed=1)
    >>> exposed.metadata["exposure"]["saturated_pixels"]
    0
    """
    capture = read_if_path(capture)
    detector = Detector() if detector is None else detector
    if not isinstance(capture, Capture) or not isinstance(detector, Detector):
        raise InputError(f"expose({short_repr(capture)}, {short_repr(detector)}): it takes a Capture and a Detector")
    photons = _positive("photons", photons)
    seed = require_count("seed", seed, minimum=0)
    generator = np.random.default_rng(seed)
    require_demosaiced(capture)
    refuse_if(recording_of(capture), "capture: a detector has recorded it already; expose what was rendered")
    image = capture.image
    wavelength = capture.wavelength
    extra = {}
    if detector.mosaic is not None:
        refuse_if(
            image.ndim != 3 or image.shape[2] != 3,
            f"mosaic = {detector.mosaic}: the capture has 1 channel: filters need three",
        )
        image = np.take_along_axis(image, filters(capture.camera, detector.mosaic)[..., None], 2)[..., 0]
        extra = {"wavelength": wavelength}
        wavelength = None
    assert detector.gain is not None and detector.black_level is not None
    result = np.empty_like(image)
    saturated = 0
    # Values of the image that are exposed at once, at most.
    rows = max(1, 2**22 // (image[0].size))
    for start in range(0, len(image), rows):
        light = image[start : start + rows].astype(np.float64)
        numbers, full = detector._exposed(photons * np.maximum(light, 0), generator)
        saturated += int(np.count_nonzero(full.reshape(*light.shape[:2], -1).any(axis=2)))
        electrons = (numbers.astype(np.float64) - detector.black_level) / detector.gain - detector.dark_electrons
        result[start : start + rows] = electrons / (detector.quantum_efficiency * photons)
    exposure = {**asdict(detector), "photons": photons, "seed": seed, "saturated_pixels": saturated, **extra}
    metadata = {**capture.metadata, "exposure": exposure}
    return replace(capture, image=result, wavelength=wavelength, noise=None, metadata=metadata)


def filters(camera: PlenopticCamera, mosaic: str) -> Integers:
    """Return the channel, 0 to 2 for red to blue, that each recorded pixel sees."""
    tile = np.array(["RGB".index(letter) for letter in mosaic.removeprefix("QUAD_")]).reshape(2, 2)
    repeats = 1 if mosaic in MOSAICS else 2
    left, top = camera.crop_offset
    rows, columns = camera.shape
    return tile[np.ix_((np.arange(rows) + top) // repeats % 2, (np.arange(columns) + left) // repeats % 2)]
