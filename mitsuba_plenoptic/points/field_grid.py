"""Sampling of point spreads: the common detector grid, and the size and position of each patch.

All intensities are sampled on one grid of the detector, so that they can be added and, at the end, integrated once over
the pixels. The grid lies in the frame rotated with the microlens lattice about the axis. Neighbouring micro-images are
an integer number of samples apart, so that a point spread can be moved from lens to lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..fields import MicrolensArray, OpticalSystem, diffraction, repetition, scattering, upright
from ..lenses import MainLens, cone
from ..optics import in_millimetres
from ..runtime import Array, Doubles, Integers, fft, turn
from .sampling import footprint

_FINER = 1.2
_WIDTH_PER_BLUR = 1.2
_TAILS = 6
"""Width of a point's patch in focus, over the part that is kept beside light moving from the array to the detector."""

_WIDTH_STEP = 1.06
_RIM_ANGLES = 16
_BLOCK = 4096


@dataclass(frozen=True)
class Band:
    """The extent of the diffracted light that a patch represents."""

    cone: float
    """Least directions represented on the detector over those of the geometric cone, pupil plus microlens."""
    margin: float
    r"""Width of the patch of a point in focus, in units of :math:`\lambda b / D_1`, the scale of its Airy pattern."""
    bends: float
    """Least directions represented besides the pupil's cone, over those to which a wide microlens scatters."""
    orders: float
    """The same, in diffraction orders of a microlens's aperture (see `microlenses.diffraction`)."""
    beyond: float = math.inf
    """Most directions represented beyond the geometric cone, in the same orders, where lenses leave no gaps."""
    edge: float = 1.0
    """Samples over which the edges of the pupil, and of occluders of it, are softened. Light that a hard edge diffracts
    beyond the patch is aliased into it; with an edge softened over one sample that light is lost. A single spread is
    more accurate without that light. A sum of many is more accurate with it, since points exchange such light: the
    total power
    and the rims of micro-images are then right."""
    smooth: bool = False  # whether the softened edges have no kinks, which reduces aliasing


_WITHIN = ((np.multiply.outer((1, 13), np.arange(21)) + 0.5) / 21 % 1 - 0.5).T
"""Places in a sample over which the light of lenses of unequal brightness is averaged: a Fibonacci lattice, whose
coordinates all differ, so that edges along an axis are placed to a 42nd of a sample."""


def lens_amplitude(camera: PlenopticCamera, x: Any, y: Any, steps: Doubles) -> Any:
    """Return the mean amplitude behind lenses of unequal brightness, in samples some steps apart.

    Positions and steps are in mm on the array, as Dr.Jit arrays and along x and y. At single positions, edges between
    bright and dark lenses would lie up to half a sample aside.
    """
    table = camera.mla_transmissions
    if table is None:
        return 1.0
    lattice = camera.lattice
    if lattice.displacement is not None:
        # Once for all parts, as displacements are smooth.
        x, y = lattice.displacement.regular(x, y)
    amplitude = 0.0
    for right, up in (_WITHIN * steps).tolist():
        cell = lattice.regular.cell(x + dr.opaque(type(x), right), y + dr.opaque(type(y), up))
        amplitude += dr.sqrt(table.at(lattice, *cell))
    return amplitude / len(_WITHIN)


@dataclass(frozen=True)
class Grid:
    """The detector grid on which intensities are sampled, with data common to the patches on it."""

    camera: PlenopticCamera  # in the frame of its lattice
    lens: MainLens  # for wave propagation from the points
    microlenses: MicrolensArray  # in the frame of the lattice
    rotation: float  # rotation of that frame in degrees, counter-clockwise
    wavelength: float
    band: Band
    cosine: float  # half the range of direction cosines of one scene point's light at the MLA
    pitch: Doubles  # distances between samples along x and y, in millimetres
    origin: Doubles  # x and y of sample (0, 0)
    means: bool = False  # whether a sample is the mean over its cell, not the value in the middle

    @property
    def lens_samples(self) -> Integers:
        """Number of samples along x and y (columns) between adjacent micro-images along each lattice vector (rows)."""
        return np.rint(repetition(self.camera)[0] * self.camera.image_growth / self.pitch).astype(np.int64)

    @property
    def is_separable(self) -> bool:
        """Whether all factors on the array are functions of one coordinate."""
        return (0, 1) not in self.microlenses.axes and self.camera.mla_transmissions is None

    @classmethod
    def of(cls, system: OpticalSystem, band: Band, positions: Doubles, together: int = 1) -> Grid:
        """Return the grid of a camera for some scene points.

        The pitch represents the directions of the band. Neighbouring micro-images along both axes are an integer number
        of samples apart, a multiple of `together`.
        """
        rotation = system.camera.mla_rotation or 0.0
        camera = upright(system.camera)
        wavelength = system.wavelength
        lens = system.waves_of(positions)
        cosine = cone(lens, positions[:, 2])
        bent = scattering(camera)
        beside = max(band.bends * bent, diffraction(camera, wavelength, band.orders))
        half_band = max(band.cone * (cosine + bent), cosine + beside)
        if beside and system.microlenses.fills:
            half_band = min(half_band, cosine + bent + diffraction(camera, wavelength, band.beyond))
        largest = in_millimetres(wavelength) / (2 * half_band)
        # 1.1: Largest distance of samples over a pixel, within `_FINER`: larger pixels average the fringes of steep
        # light.
        largest = min(largest, max(1.1 * camera.pixel_size, largest / _FINER))
        steps = repetition(camera)[1] * camera.image_growth
        fft.check_samples(float((steps / largest).max()), "from lens to lens")
        origin = -np.array([camera.detector_width, camera.detector_height]) / 2
        return cls(
            camera,
            lens,
            system.upright_microlenses,
            rotation,
            wavelength,
            band,
            cosine,
            steps / (np.ceil(steps / (largest * together)) * together),
            origin,
        )

    def merged(self, together: int) -> Grid:
        """Return the grid of means over `together` x `together` samples."""
        if together == 1:
            return self
        origin = self.origin + (together - 1) / 2 * self.pitch
        return replace(self, pitch=self.pitch * together, origin=origin, means=True)

    def to_frame(self, positions: Doubles) -> Doubles:
        """Return scene points (n, 3) in the lattice frame, from those in the camera frame."""
        if self.rotation == 0:
            return positions
        return np.column_stack([*turn(positions[:, 0], positions[:, 1], -self.rotation), positions[:, 2]])


@dataclass(frozen=True)
class Placement:
    """Sizes and positions of patches, as arrays of shape (n,) or, for x and y, (n, 2)."""

    samples: Integers  # across each patch, on the detector and of its spectrum
    corner: Integers  # index of each patch's first sample on the grid
    image: Doubles  # centre of the geometric image on the MLA
    first: Integers  # index of the first direction from the pupil
    last: Integers  # index of the last direction

    def take(self, points: Array) -> Placement:
        """Return a selection of the patches."""
        return Placement(**{field.name: getattr(self, field.name)[points] for field in fields(self)})


def place(grid: Grid, positions: Doubles) -> Placement:
    """Return the size and position of the patches of points given in the lattice frame."""
    # Rays are traced for a limited number of points at a time, which limits the memory.
    starts = range(0, max(1, len(positions)), _BLOCK)
    parts = [_place(grid, positions[start : start + _BLOCK]) for start in starts]
    return Placement(
        **{
            field.name: np.concatenate([getattr(placement, field.name) for placement in parts])
            for field in fields(Placement)
        }
    )


def _place(grid: Grid, positions: Doubles) -> Placement:
    camera = grid.camera
    lens = grid.lens
    lam = in_millimetres(grid.wavelength)
    image = footprint(lens, positions)
    a = lens.pupil.radius
    b = lens.pupil.distance
    # Between MLA and detector the light moves sideways: the patch is centred half-way.
    distance, medium = camera.space_behind
    aside = distance / medium * -lens.pupil.slope(0.0, image.centre)
    airy = lam * b / (2 * a)
    blur = 2 * image.half_width.max(1)
    spread = grid.band.margin * airy
    # A margin on both sides contains the light that moves sideways between MLA and detector. The microlenses bend it:
    # behind fast lenses it moves farther than the Airy pattern is wide.
    steepest = grid.cosine + scattering(camera) + diffraction(camera, grid.wavelength, grid.band.orders)
    moved = spread / _TAILS + 2 * distance / medium * steepest
    width = np.maximum.reduce([_WIDTH_PER_BLUR * blur + spread / 3, blur + moved, np.full_like(blur, spread)])
    width += np.abs(aside).max(1)
    fft.check_samples(float(((np.abs(image.centre) + width[:, None]) / grid.pitch).max(initial=0)), "from the axis")
    # Sample counts rounded up to a few fast FFT lengths, so that many points share one length.
    minimum = width / grid.pitch.min()
    counts = [fft.fast_length(16)]
    while counts[-1] < minimum.max(initial=0):
        length = fft.fast_length(math.ceil(counts[-1] * _WIDTH_STEP))
        # rows separated by a multiple of 2 KiB map to the same few lines of the processor's cache
        counts.append(length if length % 256 else fft.fast_length(length + 1))
    samples = np.array(counts)[np.searchsorted(counts, minimum)]
    corner = np.rint((image.centre + aside / 2 - grid.origin) / grid.pitch).astype(np.int64)
    step = lam / (samples[:, None] * grid.pitch)
    angle = 2 * math.pi * np.arange(_RIM_ANGLES) / _RIM_ANGLES
    rim = a * np.stack([np.cos(angle), np.sin(angle)], -1)
    cosine = lens.pupil.to_array(rim, image.centre[:, None])
    return Placement(
        samples=samples,
        corner=corner - samples[:, None] // 2,
        image=image.centre,
        first=np.floor(cosine.min(1) / step).astype(np.int64) - 1,
        last=np.ceil(cosine.max(1) / step).astype(np.int64) + 1,
    )
