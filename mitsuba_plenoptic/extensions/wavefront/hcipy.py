"""Plenoptic and Shack-Hartmann sensors as optical elements of HCIPy, and HCIPy's atmospheres as phase screens.

The extra ``ao`` installs HCIPy. HCIPy's lengths are metres, its x and y are those of the camera frame.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ...camera import PhaseScreen, PlenopticCamera, Use, require_camera, require_support
from ...errors import WAVEFRONT_UNIT, WAVELENGTHS, InputError, refuse_if, require_number
from ...fields import OpticalSystem
from ...optics import band_edge_fraction, guards
from ...points import SampledField, full_field
from ...runtime import one_at_a_time
from .far_sources import INFINITY

try:
    import hcipy
except ImportError:
    raise InputError("mitsuba_plenoptic.hcipy needs the package hcipy: pip install 'mitsuba-plenoptic[ao]'") from None

__all__ = ["CameraOptics", "phase_screen"]


class CameraOptics(hcipy.OpticalElement):
    """A camera as an optical element of HCIPy: from a wavefront on the main lens's pupil to the powers of the pixels.

    The wavefront has its own aperture: the camera's `aperture_radius` is not applied, but should be about as large, as
    it determines the sampling. A star off axis is a tilt of the wavefront. Aberrations of the camera are added. Between
    its samples the wavefront is interpolated by its band limit, as in HCIPy's propagations.

    Parameters
    ----------
    camera : PlenopticCamera
        A camera with a thin main lens, such as the preset ``telescope``, or with a `Collimator`, such as
        ``shack_hartmann``.

    Attributes
    ----------
    output_grid : hcipy.Grid
        Centres of the recorded pixels in metres.
    """

    def __init__(self, camera: PlenopticCamera):
        require_support(require_camera(camera), Use.WAVEFRONTS)
        self.camera = camera
        left, top = (float(camera.pixel_coordinates(axis)[0]) for axis in (0, 1))
        pixel = np.full(2, camera.pixel_size)
        coordinates = hcipy.RegularCoords(pixel * 1e-3, camera.crop_size, np.array([left, top]) * 1e-3)
        self.output_grid = hcipy.CartesianGrid(coordinates)

    @one_at_a_time
    def forward(self, wavefront: Any) -> Any:
        """Return the power in each recorded pixel, like a detector of HCIPy.

        Parameters
        ----------
        wavefront : hcipy.Wavefront
            Scalar field on a regular grid over the pupil, with equal steps along x and y.

        Returns
        -------
        hcipy.Field
            Powers on `output_grid`; over the whole plane they sum to the wavefront's total power.

        Raises
        ------
        PhysicsError
            If too much of the light is lost, the wavefront is much wider than the camera's aperture, or it is sampled
            too coarsely (see `optics.guards`).
        """
        if not isinstance(wavefront, hcipy.Wavefront):
            raise InputError(f"wavefront of type {type(wavefront).__name__}: it must be of HCIPy")
        incident = _sampled(wavefront.electric_field)
        power = float(wavefront.total_power)
        wavelength = _nanometres(wavefront.wavelength)
        refuse_if(not 0 < power < math.inf, f"wavefront of the power {power:g}: it must be greater than 0")
        system = OpticalSystem(self.camera.at_wavelength(wavelength), wavelength)
        with guards.watch():
            spectrum = np.ascontiguousarray(np.fft.fft2(incident.samples).astype(np.complex64))
            guards.check(guards.UNDERSAMPLED, band_edge_fraction(spectrum))
            image = full_field(system, np.array([0.0, 0.0, INFINITY]), incident=incident)
        # What interpolation leaves below zero between the samples is not light, and detectors refuse it.
        return hcipy.Field(np.maximum(image, 0).astype(np.float64).ravel() * power, self.output_grid)


def phase_screen(phase: Any, wavelength: float) -> PhaseScreen:
    """Return a phase of HCIPy as a phase screen of a camera.

    Parameters
    ----------
    phase : hcipy.Field
        Phase in radians, without jumps, on a regular grid of at least the pupil's size: ``phase_for(wavelength)`` of an
        atmospheric layer, or a surface's.
    wavelength : float
        Wavelength of the phase in metres.

    Examples
    --------
    >>> import hcipy
    >>> from mitsuba_plenoptic.hcipy import phase_screen
    >>> grid = hcipy.make_pupil_grid(64, 0.012)
    >>> layer = hcipy.InfiniteAtmosphericLayer(grid, hcipy.Cn_squared_from_fried_parameter(0.002, 633e-9), 1, seed=1)
    >>> phase_screen(layer.phase_for(633e-9), 633e-9)
    PhaseScreen(64 x 64 samples, width=11.8125)
    """
    field = _sampled(phase)
    waves = _nanometres(wavelength) / WAVEFRONT_UNIT
    refuse_if(np.iscomplexobj(field.samples), "phase: its values are complex; give the phase of the field, in radians")
    rows, columns = field.samples.shape
    middle = [start + (count - 1) / 2 * field.pitch for start, count in zip(field.origin, (columns, rows), strict=True)]
    refuse_if(
        max(map(abs, middle)) > 1e-6 * columns * field.pitch, f"phase: its grid's centre is {middle}: it must be 0"
    )
    return PhaseScreen(field.samples * (waves / (2 * math.pi)), (columns - 1) * field.pitch)


def _nanometres(wavelength: Any) -> float:
    """Return a wavelength given in metres in nanometres; refuse wavelengths out of range."""
    metres = require_number("wavelength", wavelength, positive=True)
    low, high = (bound * 1e-9 for bound in WAVELENGTHS)
    refuse_if(not low <= metres <= high, f"wavelength = {metres:g}: it must be from {low:g} to {high:g} metres")
    return metres * 1e9


def _sampled(values: Any) -> SampledField:
    """Return a scalar field of HCIPy on a regular grid, with lengths in millimetres."""
    grid = getattr(values, "grid", None)
    if grid is None or not (grid.is_("cartesian") and grid.is_regular and grid.ndim == 2):
        raise InputError("field: it must be of HCIPy, on a regular Cartesian grid of two axes")
    refuse_if(np.ndim(values) != 1, "field: it must be scalar; polarised wavefronts are not supported")
    refuse_if(
        not math.isclose(*grid.delta, rel_tol=1e-9),
        f"field: its steps are {grid.delta}: they must be equal along x and y",
    )
    left, bottom = (float(start) * 1e3 for start in grid.zero)
    return SampledField(np.asarray(values.shaped), (left, bottom), float(grid.delta[0]) * 1e3)
