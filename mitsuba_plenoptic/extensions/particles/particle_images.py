r"""Captures of particles by waves and by rays: incoherent points that scatter a light sheet's light.

The unit of pixels is the light of a mean particle: the power through the pupil, averaged over the particles that are
within the volume in the first frame. For irradiance 1 a particle sends the integral of its differential cross-section
over the pupil's solid angle, whose mean is the `reference` of a capture, in square micrometres. There is no speckle, as
particles are incoherent; no particle hides another one, and light is scattered once.

The camera looks through a plane window, behind which it sees particles at their paraxial positions. Angles in the fluid
are smaller by Snell's law, and solid angles with them.

Fluorescent beads emit the same light in all directions. In the place of the cross-section they have their volume, so
that the `reference` is in cubic micrometres, as if all of the light that a bead absorbs on a micrometre were emitted.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from ... import choices
from ...camera import PlenopticCamera, Round
from ...errors import refuse_if, require_choice, require_count, require_wavelength, suggest_keywords
from ...fields import OpticalSystem
from ...io import Capture, Checkpoint
from ...points import CaptureOperator
from ...runtime import Array, Job, Progress
from ..inverse.point_rays import PointRays
from .scattering import ScatteredLight
from .seeding import LightSheet, ParticleVolume, Seeding, Window
from .sequence import settings_of


def scattered_light(truth: xr.Dataset, frame: int, wavelength: float, camera: PlenopticCamera) -> ScatteredLight:
    """Return the light of the particles that are lit within the volume in a frame of a sequence."""
    settings = settings_of(truth)
    chosen = truth.isel(frame=frame)
    lit = (chosen["inside"].values == 1) & (chosen["irradiance"].values > 0)
    position, diameter, irradiance = (chosen[name].values[lit] for name in ("position", "diameter", "irradiance"))
    direction = LightSheet(**settings["sheet"]).direction
    seeding = Seeding(**settings["seeding"])
    window = Window(**settings["window"])
    seen = window.apparent(position, camera, wavelength)
    return ScatteredLight(camera, seen, diameter, irradiance, direction, seeding, window, wavelength)


@suggest_keywords
class ParticleImages:
    """The captures of a sequence of particles by one model of light, through the window of their medium.

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
    ):
        self.truth = truth
        self.model = require_choice("model", model, choices.MODELS)
        self.wavelength = require_wavelength(wavelength)
        self._settings = settings_of(truth)
        refuse_if(model == "ray" and accuracy is not None, f"accuracy = {accuracy}: rays take none; leave it out")
        self._accuracy = 0.01 if accuracy is None else accuracy
        self.camera = camera or PlenopticCamera.from_dict(self._settings["camera"])
        ParticleVolume(**self._settings["volume"]).before(self.camera, Window(**self._settings["window"]))
        first = scattered_light(truth, 0, self.wavelength, self.camera)
        refuse_if(not len(first.positions), "volume: no particle is lit within it; raise the density or the thickness")
        self._reference = float(first.powers.sum(0).mean())

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
        """
        require_count("frame", frame, minimum=0, maximum=self.truth.sizes["frame"] - 1)
        light = scattered_light(self.truth, frame, self.wavelength, self.camera)
        # Operators take no further weights where the aperture has its own; the mean over the pupil then counts.
        powers = light.powers.sum(0)[None]
        over_pupil = None
        if self.camera.aperture == Round():
            powers, over_pupil = light.followed(self._accuracy)
        points = np.tile(light.positions, (len(powers), 1))
        weights = powers.ravel() / self._reference
        image: Array = np.zeros(self.camera.shape, np.float32)
        if len(points) and self.model == "ray":
            rays = PointRays(self.camera, points, self.wavelength, over_pupil)
            image = rays.image(OpticalSystem(self.camera, self.wavelength), weights)
        elif len(points):
            operator = CaptureOperator(
                self.camera, points, wavelength=self.wavelength, accuracy=self._accuracy, pupil_weights=over_pupil
            )
            # What interpolation leaves below zero between the samples is not light.
            image = np.maximum(operator.forward(weights, job=Job(progress=progress, keeper=checkpoint)), 0)
        return Capture(image, self.camera, self.wavelength, self.model, self.metadata(frame))
