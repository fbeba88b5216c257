r"""Captures of particles by waves and by rays: incoherent points that scatter a light sheet's light.

The unit of pixels is the light of a mean particle: the power through the pupil, averaged over the particles that are
within the volume in the first frame. For irradiance 1 a particle sends the pupil's solid angle (:math:`\pi a^2 / g^2`
of a lens, :math:`2 \pi (1 - \cos\alpha)` of an objective) times the mean of its differential cross-section over the
pupil, which is the `reference` of a capture, in square micrometres. There is no speckle, as points are incoherent; no
particle hides another one, and light is scattered once.

Fluorescent beads emit the same light in all directions. In the place of the cross-section they have their volume, so
that the `reference` is in cubic micrometres, as if all of the light that a bead absorbs on a micrometre were emitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import spline_filter1d

from ...camera import PlenopticCamera
from ...camera.aperture import Round
from ...errors import refuse_if, require_choice, require_count, require_wavelength, suggest_keywords
from ...io.captures import MODELS, Capture
from ...io.checkpoints import Checkpoint
from ...light.optical_system import OpticalSystem
from ...points.operator import CaptureOperator
from ...points.pupil_weights import PupilWeights
from ...runtime.batches import Job, Progress
from ..inverse.point_rays import PointRays
from .entrance_pupil import EntrancePupil
from .mie import cross_sections
from .seeding import LightSheet, ParticleVolume, Seeding, from_plain
from .sequence import settings_of

ACCURACY = 0.01
"""Allowed relative error of images by waves."""

_PER_LOBE, _FEWEST, _MOST = 4.0, 6, 64
"""Cells of the pupil across a lobe of scattered light, and across the pupil at least and at most."""

_ANGLES_PER_CELL = 2
"""Angles at which the scattering of a particle is computed, to each cell across the pupil."""

_TOGETHER = 2048
"""Particles whose scattering is computed at a time, which limits memory."""


@dataclass(frozen=True)
class ScatteredLight:
    """The light of particles over the pupil of a camera's main lens."""

    # Positions in the camera frame, (n, 3).
    positions: NDArray[np.float64]
    # Diameters in micrometres, (n,).
    diameters: NDArray[np.float64]
    # Irradiance on each, (n,).
    irradiance: NDArray[np.float64]
    # Direction in which the light travels.
    direction: tuple[float, ...]
    seeding: Seeding
    # In vacuum, in nanometres.
    wavelength: float
    pupil: EntrancePupil

    @cached_property
    def cells(self) -> int:
        """Cells across the square around the pupil, which resolve the lobes of the largest particle."""
        if self.seeding.index is None:
            return _FEWEST
        lobe = self.wavelength * 1e-3 / self.seeding.medium / float(self.diameters.max(initial=1e-3))
        return int(np.clip(np.ceil(_PER_LOBE * 2 * self.pupil.angle(self.positions) / lobe), _FEWEST, _MOST))

    @cached_property
    def _at(self) -> NDArray[np.float64]:
        """Return the coordinates of the centres of the pupil's cells, in mm."""
        return np.asarray(self.pupil.radius * ((np.arange(self.cells) + 0.5) * (2 / self.cells) - 1))

    @cached_property
    def over_pupil(self) -> NDArray[np.float64]:
        """Differential cross-sections towards the pupil's cells, in square micrometres per steradian, (n, y, x).

        Those of fluorescent beads are volumes over the full solid angle.
        """
        count = len(self.positions)
        if self.seeding.index is None:
            return np.tile((self.diameters**3 / 24)[:, None, None], (self.cells, self.cells))
        blocks = [self._of(slice(first, first + _TOGETHER)) for first in range(0, count, _TOGETHER)]
        return np.concatenate([np.zeros((0, self.cells, self.cells)), *blocks])

    def _of(self, some: slice) -> NDArray[np.float64]:
        """Return the cross-sections of some particles."""
        assert self.seeding.index is not None
        cosine = self.pupil.towards(self.positions[some], self._at) @ np.array(self.direction)
        flat = cosine.reshape(len(cosine), -1)
        low, high = flat.min(1), flat.max(1)
        # Few angles, between which the many of the cells are interpolated.
        steps = np.linspace(0, 1, _ANGLES_PER_CELL * self.cells)
        along = np.clip(low[:, None] + steps * (high - low)[:, None], -1, 1)
        index, medium = complex(self.seeding.index), self.seeding.medium
        sections = cross_sections(self.diameters[some], index / medium, self.wavelength / medium, along)
        rows = zip(flat, along, sections, strict=True)
        return np.stack([np.interp(*row) for row in rows]).reshape(cosine.shape)

    @cached_property
    def powers(self) -> NDArray[np.float64]:
        """Power of each particle through the pupil, in square micrometres, (n,)."""
        solid_angles = self.pupil.solid_angles(self.positions, self._at)
        return np.asarray(self.irradiance * (self.over_pupil * solid_angles).sum((1, 2)))

    def pupil_weights(self) -> PupilWeights | None:
        """Return the relative power over the pupil for a `CaptureOperator`, None if it is even."""
        if self.seeding.index is None:
            return None
        # Cubic B-splines of these coefficients pass through the samples; those of the samples would flatten lobes.
        table, count = self.over_pupil / self.over_pupil.mean((1, 2), keepdims=True), len(self.positions)
        for axis in (1, 2):
            table = spline_filter1d(table, axis=axis)
        table = np.maximum(table, 0).astype(np.float32)
        return PupilWeights(table, np.arange(count), np.zeros((count, 2)), sampled=True)


def scattered_light(truth: xr.Dataset, frame: int, wavelength: float, camera: PlenopticCamera) -> ScatteredLight:
    """Return the light of the particles that are lit within the volume in a frame of a sequence."""
    settings = settings_of(truth)
    chosen = truth.isel(frame=frame)
    lit = (chosen["inside"].values == 1) & (chosen["irradiance"].values > 0)
    return ScatteredLight(
        chosen["position"].values[lit],
        chosen["diameter"].values[lit],
        chosen["irradiance"].values[lit],
        from_plain(LightSheet, settings["sheet"]).direction,
        from_plain(Seeding, settings["seeding"]),
        wavelength,
        EntrancePupil.of(camera, wavelength),
    )


@suggest_keywords
class ParticleImages:
    """The captures of a sequence of particles by one model of light.

    A capture's pixels are in units of a mean particle, whose pixels have the sum 1. To record them with noise, give
    `expose` the photons of a mean particle through the pupil.

    Parameters
    ----------
    truth : xarray.Dataset
        The particles, from `particle_sequence`.
    wavelength : float
        Wavelength in vacuum, in nanometres.
    model : {"wave", "ray"}
        How light propagates through the camera.
    camera : PlenopticCamera, optional
        Another camera than that of the sequence.
    accuracy : float, optional
        Allowed relative error of captures by waves. Default: 0.01.

    Raises
    ------
    InputError
        If no particle is lit, or an argument is out of range.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> from mitsuba_plenoptic import particles
    >>> camera = mp.PlenopticCamera(detector_width=0.256, resolution=(64, 64))
    >>> volume = particles.ParticleVolume((-0.2, -0.2, 236), (0.2, 0.2, 244))
    >>> flow, seeding = particles.Uniform((0.1, 0, 0)), particles.Seeding(count=3)
    >>> truth = particles.particle_sequence(camera, volume, seeding, flow, interval=1)
    >>> particles.ParticleImages(truth, wavelength=550).capture(0).image.shape
    (64, 64)
    """

    def __init__(
        self,
        truth: xr.Dataset,
        *,
        wavelength: float,
        model: str = "wave",
        camera: PlenopticCamera | None = None,
        accuracy: float | None = None,
    ) -> None:
        self.truth, self.model = truth, require_choice("model", model, MODELS)
        self.wavelength, self._settings = require_wavelength(wavelength), settings_of(truth)
        refuse_if(model == "ray" and accuracy is not None, f"accuracy = {accuracy}: rays take none; leave it out")
        self._accuracy = ACCURACY if accuracy is None else accuracy
        self.camera = camera or PlenopticCamera.from_dict(self._settings["camera"])
        from_plain(ParticleVolume, self._settings["volume"]).before(self.camera)
        first = scattered_light(truth, 0, self.wavelength, self.camera)
        refuse_if(not len(first.positions), "volume: no particle is lit within it; raise the density or the thickness")
        self._reference = float(first.powers.mean())

    def metadata(self, frame: int) -> dict[str, Any]:
        """Return the metadata of a frame's capture, which determine it together with wavelength, model and camera."""
        return {
            "particles": self._settings,
            "frame": frame,
            "time": float(self.truth["time"][frame]),
            "reference": self._reference,
        }

    def capture(self, frame: int, *, progress: Progress | None = None, checkpoint: Checkpoint | None = None) -> Capture:
        """Return the capture of a frame.

        Parameters
        ----------
        frame : int
            Number of the frame, from 0.
        progress : callable, optional
            Called with the numbers of particles done and of all.
        checkpoint : Checkpoint, optional
            What is done of a capture by waves, to resume from it.

        Raises
        ------
        InputError
            If there is no such frame.
        """
        require_count("frame", frame, minimum=0, maximum=self.truth.sizes["frame"] - 1)
        light = scattered_light(self.truth, frame, self.wavelength, self.camera)
        points, weights = light.positions, light.powers / self._reference
        # Operators take no further weights where the aperture has its own; the mean over the pupil then counts.
        over_pupil = light.pupil_weights() if self.camera.aperture == Round() else None
        image: NDArray[Any] = np.zeros(self.camera.shape, np.float32)
        if not len(points):
            pass
        elif self.model == "ray":
            rays = PointRays(self.camera, points, self.wavelength, over_pupil)
            image = rays.image(OpticalSystem(self.camera, self.wavelength), weights)
        else:
            operator = CaptureOperator(
                self.camera,
                points,
                wavelength=self.wavelength,
                accuracy=self._accuracy,
                pupil_weights=over_pupil,
            )
            # What interpolation leaves below zero between the samples is not light.
            image = np.maximum(operator.forward(weights, job=Job(progress=progress, keeper=checkpoint)), 0)
        return Capture(image, self.camera, self.wavelength, self.model, self.metadata(frame))
