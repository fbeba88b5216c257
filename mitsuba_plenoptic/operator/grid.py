"""Where point spreads lie, and how finely and widely they are sampled.

All intensities are sampled on one grid of the detector, whatever the patch: there they can be added, and they are
integrated over the pixels once, at the end. The grid lies in the frame that is turned with the microlens lattice about
the axis, and a whole number of its samples lies between neighbouring micro-images, so that a point spread can be moved
from lens to lens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lattice import turn
from ..lenses.base import MainLens
from ..optics.phase import in_millimetres
from ..system.microlens_orders import MicrolensArray
from ..system.microlenses import diffraction, scattering, upright
from ..system.optical_system import OpticalSystem
from ..system.sampling import check_samples, fast_length, footprint

_PITCH_PER_PIXEL = 1.1
"""Distance of samples over a pixel, at most, within `_FINER`: larger pixels average the fringes of steep light."""

_FINER = 1.2
_WIDTH_PER_BLUR = 1.2
_WIDTH_STEP = 1.06
_RIM_ANGLES = 16
_BLOCK = 4096


@dataclass(frozen=True)
class Band:
    """How much of the diffracted light a patch holds."""

    cone: float
    """Directions that are held on the detector over those of the geometric cone, pupil plus microlens, at least."""
    margin: float
    r"""Width of the patch of a point in focus, in units of :math:`\lambda b / D_1`, the scale of its Airy pattern."""
    bends: float
    """Directions that are held besides the pupil's cone, over those that a wide microlens scatters to, at least."""
    orders: float
    """The same, in orders of the diffraction by a microlens's aperture (see `microlenses.diffraction`)."""
    beyond: float = math.inf
    """Directions that are held beyond the geometric cone, in the same orders, at most where lenses leave no gaps."""
    edge: float = 1.0
    """Samples over which the edges of the pupil, and of what hides parts of it, are softened. What a hard edge
    diffracts beyond the patch is folded back into it; what an edge softened over one sample diffracts there is lost. A
    single spread is truer without that light. A sum of many is truer with it, since what one point sends away comes to
    another's patch: its power is right, and so are the rims of micro-images."""
    smooth: bool = False  # whether the softened edges have no kinks: less of what they diffract is then folded back


@dataclass(frozen=True)
class Grid:
    """The grid of the detector on which intensities are sampled, and what patches on it have in common."""

    camera: PlenopticCamera  # in the frame of its lattice
    lens: MainLens  # as the waves of the points pass it
    microlenses: MicrolensArray  # in the frame of the lattice
    rotation: float  # degrees by which that frame is turned, counter-clockwise
    wavelength: float
    band: Band
    cosine: float  # half the range of direction cosines of one scene point's light at the MLA
    pitch: NDArray[np.float64]  # distances between samples along x and y, in millimetres
    origin: NDArray[np.float64]  # x and y of sample (0, 0)

    @property
    def lens_samples(self) -> NDArray[np.int64]:
        """Samples along x and y, in columns, from one micro-image to the next along both lattice vectors, in rows."""
        camera = self.camera
        growth = camera.micro_image_pitch / camera.mla_pitch
        return np.rint(np.array(camera.lattice.basis) * growth / self.pitch).astype(np.int64)

    @classmethod
    def of(
        cls,
        system: OpticalSystem,
        band: Band,
        positions: NDArray[np.float64],
    ) -> Grid:
        """Lay the grid of a camera for some scene points.

        Its pitch holds the directions of the band, and along both axes a whole number of samples lies between
        neighbouring micro-images.
        """
        rotation, camera, wavelength = system.camera.mla_rotation, upright(system.camera), system.wavelength
        lens = system.waves_of(positions)
        cosine = lens.cone(positions[:, 2])
        bent = scattering(camera)
        beside = max(band.bends * bent, diffraction(camera, wavelength, band.orders))
        half_band = max(band.cone * (cosine + bent), cosine + beside)
        if camera.lattice.fills:
            half_band = min(half_band, cosine + bent + diffraction(camera, wavelength, band.beyond))
        largest = in_millimetres(wavelength) / (2 * half_band)
        largest = min(largest, max(_PITCH_PER_PIXEL * camera.pixel_size, largest / _FINER))
        steps = np.array(camera.lattice.grid_step) * (camera.micro_image_pitch / camera.mla_pitch)
        check_samples(float((steps / largest).max()), "from lens to lens")
        origin = -np.array([camera.detector_width, camera.detector_height]) / 2
        return cls(
            camera,
            lens,
            system.upright_microlenses,
            rotation,
            wavelength,
            band,
            cosine,
            steps / np.ceil(steps / largest),
            origin,
        )

    def to_frame(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turn scene points of the camera frame, (n, 3), into the frame of the lattice."""
        if self.rotation == 0:
            return positions
        return np.column_stack([*turn(positions[:, 0], positions[:, 1], -self.rotation), positions[:, 2]])


@dataclass(frozen=True)
class Placement:
    """Sizes and places of patches. Arrays have shape (n,) or, for x and y, (n, 2)."""

    samples: NDArray[np.int64]  # across each patch, on the detector and of its spectrum
    corner: NDArray[np.int64]  # place of each patch's first sample on the grid
    image: NDArray[np.float64]  # centre of the geometric image on the MLA
    first: NDArray[np.int64]  # number of the first direction from the pupil
    last: NDArray[np.int64]  # number of the last one

    def take(self, which: NDArray[Any]) -> Placement:
        """Return some of them."""
        return Placement(**{field.name: getattr(self, field.name)[which] for field in fields(self)})


def place(grid: Grid, positions: NDArray[np.float64]) -> Placement:
    """Choose size and place of the patches of some points.

    The points are in the frame of the lattice.
    """
    # Rays are traced for some points at a time, so that memory does not grow with their number.
    starts = range(0, max(1, len(positions)), _BLOCK)
    parts = [_place(grid, positions[start : start + _BLOCK]) for start in starts]
    return Placement(
        **{field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Placement)}
    )


def _place(grid: Grid, positions: NDArray[np.float64]) -> Placement:
    camera, lens, lam = grid.camera, grid.lens, in_millimetres(grid.wavelength)
    image = footprint(lens, positions)
    a, b = lens.pupil_radius, lens.pupil_distance
    # Between MLA and detector the light moves sideways: the patch lies half-way.
    aside = camera.detector_distance * lens.chief_slope(image.centre)
    airy = lam * b / (2 * a)
    blur = 2 * image.half_width.max(1)
    spread = grid.band.margin * airy
    # What goes sideways on the way to the detector is held on both sides.
    reach = camera.detector_distance * (grid.cosine + diffraction(camera, grid.wavelength, grid.band.orders))
    width = np.maximum(_WIDTH_PER_BLUR * blur + max(spread / 3, 2 * reach), spread) + np.abs(aside).max(1)
    check_samples(
        float(((np.abs(image.centre) + width[:, None]) / grid.pitch).max(initial=0)),
        "from the axis",
    )
    samples = _ladder(width / grid.pitch.min())
    corner = np.rint((image.centre + aside / 2 - grid.origin) / grid.pitch).astype(np.int64)
    step = lam / (samples[:, None] * grid.pitch)
    angle = 2 * math.pi * np.arange(_RIM_ANGLES) / _RIM_ANGLES
    rim = a * np.stack([np.cos(angle), np.sin(angle)], -1)
    cosine = lens.to_array(rim, image.centre[:, None])
    return Placement(
        samples=samples,
        corner=corner - samples[:, None] // 2,
        image=image.centre,
        first=np.floor(cosine.min(1) / step).astype(np.int64) - 1,
        last=np.ceil(cosine.max(1) / step).astype(np.int64) + 1,
    )


def _ladder(minimum: NDArray[np.float64]) -> NDArray[np.int64]:
    """Round sample counts up to one of few that the FFT does quickly, so that points share them."""
    counts = [fast_length(16)]
    while counts[-1] < minimum.max(initial=0):
        length = fast_length(math.ceil(counts[-1] * _WIDTH_STEP))
        # rows a multiple of 2 KiB apart fall into the same few lines of the processor's cache
        counts.append(length if length % 256 else fast_length(length + 1))
    return np.array(counts)[np.searchsorted(counts, minimum)]
