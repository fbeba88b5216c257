r"""Captures of particles by waves and by rays: incoherent points that scatter a light sheet's light.

The unit of pixels is the light of a mean particle: the power through the pupil, averaged over the particles that are
within the volume in the first frame. For irradiance 1 a particle sends the integral of its differential cross-section
over the pupil's solid angle, whose mean is the `reference` of a capture, in square micrometres. There is no speckle, as
particles are incoherent; no particle hides another one, and light is scattered once.

The camera is immersed: light goes straight from particles to the pupil, without a window. Behind a flat one, angles in
the fluid are smaller by its refractive index, and solid angles by the square of it.

Fluorescent beads emit the same light in all directions. In the place of the cross-section they have their volume, so
that the `reference` is in cubic micrometres, as if all of the light that a bead absorbs on a micrometre were emitted.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, make_interp_spline

from ... import choices
from ...camera import PlenopticCamera, Round
from ...errors import refuse_if, require_choice, require_count, require_wavelength, suggest_keywords
from ...fields import OpticalSystem
from ...io import Capture, Checkpoint
from ...points import BORDER, CaptureOperator, PupilWeights
from ...runtime import Doubles, Job, Progress, require_memory
from ..inverse.point_rays import PointRays
from .entrance_pupil import EntrancePupil
from .mie import amplitudes
from .seeding import LightSheet, ParticleVolume, Seeding, from_plain
from .sequence import settings_of

ACCURACY = 0.01
"""Allowed relative error of images by waves."""

_PER_WAVE = 8.0
_FEWEST = 4
"""Cells of the pupil across a period of the amplitude of the widest sphere's rim, and across the pupil at least."""

_NEGLIGIBLE = 0.1
"""Mean part of the light of a polarisation, over the allowed error, below which it is not followed on its own."""

_TOGETHER = 2**18
"""Directions whose scattering is computed at a time, which limits memory."""


@dataclass(frozen=True)
class ScatteredLight:
    """The light of particles over the pupil of a camera's main lens.

    Unpolarised light is as good as two incoherent fields, across the plane of its direction and the camera's axis and
    in it. A sphere scatters each into both polarisations, which do not interfere in an image. So there are four
    amplitudes over the pupil; of light from the side through a small aperture two of them are negligible.
    """

    # Positions in the camera frame, (n, 3).
    positions: Doubles
    # Diameters in micrometres, (n,).
    diameters: Doubles
    # Irradiance on each, (n,).
    irradiance: Doubles
    # Direction in which the light travels.
    direction: tuple[float, ...]
    seeding: Seeding
    # In vacuum, in nanometres.
    wavelength: float
    pupil: EntrancePupil

    @cached_property
    def cells(self) -> int:
        """Cells across the square around the pupil, which resolve the fringes of the largest particle's rim."""
        if self.seeding.index is None:
            return _FEWEST
        size = np.pi * float(self.diameters.max(initial=0)) * self.seeding.medium / (self.wavelength * 1e-3)
        # As many as the series has terms, over the angle that the pupil covers.
        waves = (size + 4 * size ** (1 / 3)) * self.pupil.angle(self.positions) / np.pi
        return max(_FEWEST, int(np.ceil(_PER_WAVE * waves)))

    def _amplitudes(self, x: Doubles, y: Doubles) -> NDArray[np.complex128]:
        """Return the four amplitudes towards points (q,) of the pupil, (4, n, q).

        The sum of their squared moduli is the differential cross-section in square micrometres per steradian.
        """
        assert self.seeding.index is not None
        count = len(self.positions)
        medium = self.seeding.medium
        index = complex(self.seeding.index) / medium
        wavelength = self.wavelength / medium
        result = np.empty((4, count, len(x)), complex)
        # 3: Angles at which the scattering of a particle is computed, to each cell across the pupil.
        steps = np.linspace(0, 1, 3 * (self.cells + 2))
        light = np.array(self.direction)
        axis = np.array([0.0, 0.0, -1.0])
        across = np.cross(light, axis) if np.hypot(*light[:2]) > 1e-9 else np.array([1.0, 0, 0])
        across /= np.linalg.norm(across)
        together = max(1, _TOGETHER // len(x))
        for some in (slice(first, first + together) for first in range(0, count, together)):
            towards = self.pupil.towards(self.positions[some], x, y)
            angle = np.arccos(np.clip(towards @ light, -1, 1))
            # Few angles, between which the many of the points are interpolated.
            low = angle.min(1)[:, None]
            high = angle.max(1)[:, None]
            nodes = low + steps * (high - low)
            scattered = amplitudes(self.diameters[some], index, wavelength, np.cos(nodes))
            rows = zip(nodes, scattered.swapaxes(0, 1), angle, strict=True)
            s1, s2 = np.stack([CubicSpline(tabulated, values, axis=1)(angles) for tabulated, values, angles in rows], 1)
            # Across the plane of scattering; straight on and back any direction will do.
            normal = np.cross(light, towards) + 1e-12 * across
            normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
            first = np.cross(normal, light)
            second = np.cross(normal, towards)
            parts = itertools.product((across, np.cross(across, light)), (across, np.cross(across, axis)))
            for pair, (incident, leaving) in enumerate(parts):
                # The lens turns light to the axis, with its polarisation.
                turned = leaving - (towards @ leaving)[..., None] / (1 + towards @ axis)[..., None] * (towards + axis)
                across_plane = s1 * (normal @ incident) * (normal * turned).sum(-1)
                result[pair, some] = across_plane + s2 * (first @ incident) * (second * turned).sum(-1)
        return result * (wavelength * 1e-3 / (2 * np.pi * np.sqrt(2)))

    @cached_property
    def powers(self) -> Doubles:
        """Powers of each particle through the pupil, in square micrometres, by amplitude, (4, n); beads have one."""
        # Gauss's rule in the square of the radius, evenly in angle.
        nodes, weights = np.polynomial.legendre.leggauss(self.cells // 2 + 4)
        turn = 2 * np.pi * (np.arange(self.cells + 12) + 0.5) / (self.cells + 12)
        radius = self.pupil.radius * np.sqrt((nodes + 1) / 2)
        x, y = ((radius[:, None] * function(turn)).ravel() for function in (np.cos, np.sin))
        areas = np.repeat(np.pi * self.pupil.radius**2 * weights / 2 / len(turn), len(turn))
        solid_angles = self.pupil.solid_angles(self.positions, x, y) * areas
        if self.seeding.index is None:
            # Beads emit over the full solid angle.
            return np.asarray(self.irradiance * self.diameters**3 / 24 * solid_angles.sum(1))[None]
        return np.asarray(self.irradiance * (np.abs(self._amplitudes(x, y)) ** 2 * solid_angles).sum(-1))

    def followed(self, accuracy: float) -> tuple[Doubles, PupilWeights | None]:
        """Return the powers of the amplitudes that count, (k, n), and these amplitudes, one after the other."""
        if self.seeding.index is None or not len(self.positions):
            return self.powers, None
        count = len(self.positions)
        cells = self.cells
        require_memory(300.0 * count * (cells + 2 * BORDER) ** 2, f"{count} particles over {cells} x {cells} cells")
        total = self.powers.sum(0)
        strong = self.powers.sum(1) > max(_NEGLIGIBLE * accuracy, 1e-7) * total.sum()
        # Splines through the centres of cells, and two more places at each border, beyond which there may be no light.
        at = np.concatenate([[0, 0.25], np.arange(cells) + 0.5, [cells - 0.25, cells]])
        knots = np.arange(-3.5, cells + 4)
        x, y = (self.pupil.radius * (2 / cells * mesh.ravel() - 1) for mesh in np.meshgrid(at, at))
        table = self._amplitudes(x, y)[strong].reshape(-1, len(at), len(at))
        for _ in "yx":
            table = make_interp_spline(at, table, t=knots, axis=1).c.transpose(1, 2, 0)
        table = table.astype(np.complex64)
        powers = self.powers[strong]
        weights = PupilWeights(table, np.arange(len(table)), np.zeros((len(table), 2)), sampled=True)
        return powers * (total / powers.sum(0)), weights


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
    """The captures of a sequence of particles by one model of light, with the camera immersed in their medium.

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
        self.truth = truth
        self.model = require_choice("model", model, choices.MODELS)
        self.wavelength = require_wavelength(wavelength)
        self._settings = settings_of(truth)
        refuse_if(model == "ray" and accuracy is not None, f"accuracy = {accuracy}: rays take none; leave it out")
        self._accuracy = ACCURACY if accuracy is None else accuracy
        self.camera = camera or PlenopticCamera.from_dict(self._settings["camera"])
        from_plain(ParticleVolume, self._settings["volume"]).before(self.camera)
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

        Raises
        ------
        InputError
            If there is no such frame.
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
