r"""Point spreads on a patch of the detector, many at a time: the workhorse.

A scene point lights a small patch of the MLA. There its field is a sum of plane waves, one for each direction
cosine s from a pupil point P to the centre Mc of the patch, times a common curvature (the Debye integral with its
quadratic term kept; Born and Wolf, "Principles of Optics", section 8.8):

.. math:: u(M_c + \mu) = \frac{ds^2}{\lambda} e^{i k \mu^2 / 2 R_0}
          \sum_s A(s) \, e^{i k (|P - X| - P^2 / 2 f_1 + R - R_0)} \, e^{i k s \cdot \mu},
          \qquad P = M_c - R s, \quad R = \frac{b}{\sqrt{1 - s^2}}

with :math:`A = \mathrm{pupil}(P) \, g R^2 / (|P - X|^2 b)`, so that :math:`\sum |A|^2 ds^2` is the power through the
pupil. The sum is an inverse FFT of which few inputs are not zero. Curvature and microlens phase are products of
a function of x and one of y, so the transforms to the MLA and back to the spectrum are done axis by axis, and rows
outside the pupil never. The transfer function to the detector is that of the angular spectrum.

All of this is done in the frame that is turned with the microlens lattice about the axis, in which the main lens is
the same. Where the microlenses are no product of a function of x and one of y, as on a hexagonal lattice, the field
is there on the MLA in both axes, which costs about twice the time.

The tilt of the chief ray is rounded to a whole number of frequency samples and left out: it shifts the spectrum,
and the intensity does not feel it. So the pitch has to hold only the cone of the pupil and the microlens, and
some of the light that the edges of the microlenses scatter. All intensities are sampled on one grid of the
detector, whatever the patch: they can be added there, and integrated over the pixels once, at the end.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lattice import turn
from ..optics.microlenses import is_separable, plane_transmission, transmission_table, upright
from ..optics.sampling import check_samples, fast_length, footprint, in_millimetres, pupil_turns, scattered_cosine
from ..runtime.backend import backend
from ..runtime.fft import Field, as_field, fft, pack
from ..runtime.indexing import split

_WIDTH_PER_BLUR = 1.2
_WIDTH_STEP = 1.06
_RIM_ANGLES = 16


@dataclass(frozen=True)
class _Sizes:
    """How much is done at a time.

    Attributes
    ----------
    group : int
        Samples of the fields that are transformed together: so many that the calls cost little.
    block : int
        Samples of a block, which stays in a core's own cache; on CUDA there is nothing to gain from blocks.
    """

    group: int
    block: int


_PROCESSOR = _Sizes(group=2**17, block=2**16)
_CUDA = _Sizes(group=2**25, block=2**31)


@dataclass(frozen=True)
class Band:
    r"""How much of the diffracted light a patch keeps.

    Attributes
    ----------
    cone : float
        Directions that are kept on the detector over those of the geometric cone, pupil plus microlens.
    margin : float
        Width of the patch of a point in focus, in units of :math:`\lambda b / D_1`, the scale of its Airy pattern.
    """

    cone: float
    margin: float


@dataclass(frozen=True)
class Grid:
    """The grid of the detector on which intensities are sampled, and what patches on it have in common.

    Attributes
    ----------
    camera : PlenopticCamera
        The camera in the frame of its lattice.
    rotation : float
        Degrees by which that frame is turned, counter-clockwise.
    cosine : float
        Half the range of direction cosines of one scene point's light at the MLA.
    pitch : float64 array (2,)
        Distance between samples along x and y, in millimetres.
    origin : float64 array (2,)
        x and y of sample (0, 0).
    """

    camera: PlenopticCamera
    rotation: float
    wavelength: float
    band: Band
    cosine: float
    pitch: NDArray[np.float64]
    origin: NDArray[np.float64]

    @property
    def lens_samples(self) -> NDArray[np.int64]:
        """Samples along x and y, in columns, from one micro-image to the next along both lattice vectors, in rows."""
        camera = self.camera
        growth = camera.micro_image_pitch / camera.mla_pitch
        return np.rint(np.array(camera.lattice.basis) * growth / self.pitch).astype(np.int64)

    @classmethod
    def of(
        cls,
        camera: PlenopticCamera,
        wavelength: float,
        band: Band,
        positions: NDArray[np.float64],
    ) -> Grid:
        """Lay the grid of a camera for some scene points.

        Its pitch holds the kept directions, and along both axes a whole number of samples lies between neighbouring
        micro-images.
        """
        rotation, camera = camera.mla_rotation, upright(camera)
        powers = np.abs(1 / camera.focal_length - 1 / positions[:, 2])
        cosine = camera.aperture_radius * float(powers.max(initial=1 / camera.mla_distance))
        half_band = band.cone * (cosine + scattered_cosine(camera))
        largest = in_millimetres(wavelength) / (2 * half_band)
        steps = np.array(camera.lattice.grid_step) * (camera.micro_image_pitch / camera.mla_pitch)
        check_samples(float((steps / largest).max()), "from lens to lens")
        origin = -np.array([camera.detector_width, camera.detector_height]) / 2
        return cls(camera, rotation, wavelength, band, cosine, steps / np.ceil(steps / largest), origin)

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


def place(grid: Grid, positions: NDArray[np.float64]) -> Placement:
    """Choose size and place of the patches of some radiators.

    Parameters
    ----------
    grid : Grid
        The grid that they lie on.
    positions : float64 array (n, 3)
        Scene points in the frame of the lattice.

    Returns
    -------
    Placement
    """
    camera, lam = grid.camera, in_millimetres(grid.wavelength)
    image = footprint(camera, positions)
    b = camera.mla_distance
    # Between MLA and detector the light walks sideways: the patch lies half-way.
    walk = camera.detector_distance * image.centre / b
    airy = lam * b / camera.aperture_diameter
    blur = 2 * image.half_width.max(1)
    spread = grid.band.margin * airy
    width = np.maximum(_WIDTH_PER_BLUR * blur + spread / 3, spread) + np.abs(walk).max(1)
    check_samples(
        float(((np.abs(image.centre) + width[:, None]) / grid.pitch).max(initial=0)),
        "from the axis",
    )
    samples = _ladder(width / grid.pitch.min())
    corner = np.rint((image.centre + walk / 2 - grid.origin) / grid.pitch).astype(np.int64)
    step = lam / (samples[:, None] * grid.pitch)
    angle = 2 * math.pi * np.arange(_RIM_ANGLES) / _RIM_ANGLES
    rim = camera.aperture_radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    towards = image.centre[:, None] - rim
    cosine = towards / np.sqrt((towards**2).sum(-1) + b * b)[..., None]
    return Placement(
        samples=samples,
        corner=corner - samples[:, None] // 2,
        image=image.centre,
        first=np.floor(cosine.min(1) / step).astype(np.int64) - 1,
        last=np.ceil(cosine.max(1) / step).astype(np.int64) + 1,
    )


def _ladder(minimum: NDArray[np.float64]) -> NDArray[np.int64]:
    """Round sample counts up to one of few that the FFT does quickly, so that radiators share them."""
    counts = [fast_length(16)]
    while counts[-1] < minimum.max(initial=0):
        length = fast_length(math.ceil(counts[-1] * _WIDTH_STEP))
        # rows a multiple of 2 KiB apart fall into the same few lines of the processor's cache
        counts.append(length if length % 256 else fast_length(length + 1))
    return np.array(counts)[np.searchsorted(counts, minimum)]


class Workspace:
    """Memory for the transforms of a batch's radiators."""

    def __init__(self, batch: PatchBatch) -> None:
        arrays, count, m = batch.libraries.arrays, batch.together, batch.mla_samples
        self.rows = arrays.empty((count, batch.pupil.shape[1], m), np.complex64)
        longest = max(_largest(_blocks(size, m, batch.sizes.block)) for size in (batch.samples, m))
        self.columns = arrays.empty((count, longest, m), np.complex64)
        self.plane = arrays.empty((0 if batch.separable else count, m, batch.samples), np.complex64)
        self.field = arrays.empty((count, batch.samples, batch.samples), np.complex64)


@dataclass(frozen=True)
class Copies:
    """Where and how strongly the intensity of one radiator is added: its own place, and those of its likes.

    Attributes
    ----------
    shifts : int array (copies, 2)
        Samples along x and y by which each copy is moved.
    weights : float32 array (copies, channels)
        Factors on the intensity.
    """

    shifts: NDArray[np.int64]
    weights: NDArray[np.float32]


class Tile:
    """A part of the grid, to which the radiators of one batch are added.

    Parameters
    ----------
    batch : PatchBatch
        Whose patches it covers.
    copies : list of Copies
        For each radiator of the batch.
    """

    def __init__(self, batch: PatchBatch, copies: list[Copies]) -> None:
        corners = [corner + copy.shifts for corner, copy in zip(batch.corner, copies, strict=True)]
        low = np.min([corner.min(0) for corner in corners], axis=0)
        size = np.max([corner.max(0) for corner in corners], axis=0) + batch.samples - low
        self.corner = (int(low[0]), int(low[1]))
        self._targets = [
            [
                (int(place[0]), int(place[1]), int(channel), weights[channel])
                for place, weights in zip(corner - low, copy.weights, strict=True)
                for channel in np.flatnonzero(weights)
            ]
            for corner, copy in zip(corners, copies, strict=True)
        ]
        self._arrays = arrays = batch.libraries.arrays
        self._block = min(batch.sizes.block, batch.samples**2)
        self._scratch = arrays.empty((2, self._block), np.float32)
        self._squares = arrays.empty(2 * self._block, np.float32)
        self._sums = arrays.zeros((copies[0].weights.shape[1], int(size[0]), int(size[1])), np.float32)

    def add(self, field: Field, along_y: slice, radiator: int) -> None:
        """Add the intensity of some columns of a radiator's field, (along x, along y)."""
        arrays = self._arrays
        rows = max(1, self._block // field.shape[1])
        for start, stop in itertools.pairwise([*range(0, len(field), rows), len(field)]):
            part = field[start:stop]
            intensity, weighted = self._scratch[:, : part.size].reshape(2, *part.shape)
            squares = self._squares[: 2 * part.size].reshape(len(part), -1)
            arrays.copyto(squares.view(np.complex64), part)
            arrays.multiply(squares, squares, out=squares)
            arrays.add(squares[:, ::2], squares[:, 1::2], out=intensity)
            for x, y, channel, weight in self._targets[radiator]:
                target = self._sums[channel, x + start : x + stop, y + along_y.start : y + along_y.stop]
                if weight == 1:
                    target += intensity
                else:
                    target += arrays.multiply(intensity, weight, out=weighted)

    def intensity(self) -> NDArray[np.float32]:
        """Return the sum, (channels, rows, columns)."""
        return self._sums.transpose(0, 2, 1)


class PatchBatch:
    """The fields of radiators whose patches have one size, ready to be transformed.

    Parameters
    ----------
    grid : Grid
        The grid that they lie on.
    placement : Placement
        Of these radiators.
    positions : float64 array (n, 3)
        Scene points in the frame of the lattice.
    amplitudes : float64 array (n,)
        Factors on the fields.
    masks : bool array (n, m, m), optional
        Which cells of the pupil's bounding square are open, in the camera frame.
    """

    def __init__(
        self,
        grid: Grid,
        placement: Placement,
        positions: NDArray[np.float64],
        amplitudes: NDArray[np.float64],
        masks: NDArray[np.bool_] | None,
    ) -> None:
        self.libraries = backend()
        self.sizes = _CUDA if self.libraries.is_cuda else _PROCESSOR
        self.samples = int(placement.samples[0])
        self.corner = placement.corner
        step = in_millimetres(grid.wavelength) / (self.samples * grid.pitch)
        finest = float(step.min())
        half = 2 * grid.cosine / finest
        # Orders that would fold back into the kept band are cut; a few more samples keep those of use.
        self.mla_samples = max(self.samples, fast_length(0.87 * (self.samples + half)))
        highest = min(self.samples + half, 2 * self.mla_samples - self.samples - half) / 2 * finest
        self.chief = (placement.first + placement.last) // 2
        self.pupil, power = self._pupil(grid, placement, positions, step, masks)
        arrays = self.libraries.arrays
        lit = power > 0
        shares = arrays.asarray(step.prod() * amplitudes) / arrays.sqrt(arrays.where(lit, power, 1))
        scale = arrays.where(lit, shares, 0)
        scale /= in_millimetres(grid.wavelength) * float(self.mla_samples) ** 2
        self.separable = is_separable(grid.camera)
        self.along_x, self.along_y = self._curvature_and_lenses(grid, placement, scale, highest)
        self.lenses = None if self.separable else self._lenses(grid, placement, highest)
        self.transfer = self._transfer(grid, step)

    def _pupil(
        self,
        grid: Grid,
        placement: Placement,
        positions: NDArray[np.float64],
        step: NDArray[np.float64],
        masks: NDArray[np.bool_] | None,
    ) -> tuple[Field, NDArray[np.float64]]:
        """Plane waves from the pupil, (n, directions, directions), and each radiator's power through it."""
        types = self.libraries.types
        camera, lam = grid.camera, in_millimetres(grid.wavelength)
        count = len(positions)
        size = int((placement.last - placement.first).max()) + 1
        index = dr.arange(types.UInt32, count * size * size)
        radiator, row, column = split(types, index, size, size)

        def value(numbers: NDArray[Any]) -> Any:
            return dr.gather(types.Float64, types.Float64(np.ascontiguousarray(numbers, np.float64)), radiator)

        def constant(number: float) -> Any:
            return dr.opaque(types.Float64, number)

        start = grid.origin + placement.corner * grid.pitch - placement.image
        chief_path = np.sqrt((placement.image**2).sum(1) + camera.mla_distance**2)
        nx = types.Float64(column) + value(placement.first[:, 0])
        ny = types.Float64(row) + value(placement.first[:, 1])
        sx, sy = nx * constant(step[0]), ny * constant(step[1])
        b, a = constant(camera.mla_distance), constant(camera.aperture_radius)
        R = b / dr.sqrt(1 - sx * sx - sy * sy)
        Px, Py = value(placement.image[:, 0]) - R * sx, value(placement.image[:, 1]) - R * sy
        X, Y, g = (value(positions[:, axis]) for axis in range(3))
        turns, length = pupil_turns(camera, Px, Py, X, Y, g, constant(lam))
        turns += (R - value(chief_path)) / constant(lam)
        start[:, 1] *= grid.pitch[0] / grid.pitch[1]
        width = constant(self.samples * grid.pitch[0])
        turns += (nx * value(start[:, 0]) + ny * value(start[:, 1])) / width
        # The edge is softened over one sample, so that it does not fold; the power is that of the hard edge.
        sample = math.sqrt(step.prod())
        inside = types.Float((a - dr.sqrt(Px * Px + Py * Py)) / (R * constant(sample)))
        cover = dr.clip(inside + 0.5, 0, 1)
        if masks is not None:
            cells = masks.shape[1]
            scale, last = constant(cells / camera.aperture_diameter), cells - 1
            if grid.rotation != 0:
                Px, Py = turn(Px, Py, grid.rotation)
            cell_x = types.UInt32(dr.clip((Px + a) * scale, 0, last))
            cell_y = types.UInt32(dr.clip((Py + a) * scale, 0, last))
            opened = types.Float(masks.reshape(-1).astype(np.float32))
            cover *= dr.gather(types.Float, opened, (radiator * cells + cell_y) * cells + cell_x)
        bright = types.Float(g * R * R / (length * length * b))
        power = dr.block_sum(types.Float64(bright * bright * cover), size * size) * step.prod()
        sine, cosine = dr.sincos(types.Float(turns - dr.round(turns)) * (2 * math.pi))
        packed = pack(types.Complex2f(cosine, sine) * (bright * cover))
        dr.eval(packed, power)
        return as_field(packed, (count, size, size)), self.libraries.from_drjit(power)

    def _curvature_and_lenses(
        self, grid: Grid, placement: Placement, scale: Any, highest: float
    ) -> tuple[Field, Field]:
        """Factors on the MLA along x and along y, (n, samples); those along y carry the scale.

        The microlenses are among them if they are such a product.
        """
        types = self.libraries.types
        camera, lam = grid.camera, in_millimetres(grid.wavelength)
        table = transmission_table(camera, grid.wavelength, highest) if self.separable else None
        index = dr.arange(types.UInt32, len(scale) * self.mla_samples)
        _, radiator, sample = split(types, index, len(scale), self.mla_samples)
        square = (placement.image**2).sum(1) + camera.mla_distance**2
        factors = []
        for axis, size in ((0, np.ones(len(scale))), (1, scale)):

            def value(numbers: Any) -> Any:
                if isinstance(numbers, np.ndarray):
                    numbers = np.ascontiguousarray(numbers)
                return dr.gather(types.Float64, types.Float64(numbers), radiator)

            m = value(self._corner(grid, placement)[:, axis])
            m += types.Float64(sample) * dr.opaque(types.Float64, self._mla_pitch(grid)[axis])
            mu = m - value(placement.image[:, axis])
            # path from the pupil: (mu^2 - (s mu)^2) / 2 R, of which the part along the other axis is tiny
            curvature = (1 - placement.image[:, axis] ** 2 / square) / (2 * lam * np.sqrt(square))
            shift = (placement.first - self.chief)[:, axis] + self.samples // 2
            turns = mu * mu * value(curvature)
            turns += types.Float64(sample) * value(shift / self.mla_samples)
            sine, cosine = dr.sincos(types.Float(turns - dr.round(turns)) * (2 * math.pi))
            factor = types.Complex2f(cosine, sine)
            if table is not None:
                place = (m - camera.mla_offset[axis]) * dr.opaque(types.Float64, 1 / camera.mla_pitch)
                factor *= _along_axis(types, table, place)
            factor *= types.Float(value(size))
            factors.append(as_field(pack(factor), (len(scale), self.mla_samples)))
        return factors[0], factors[1]

    def _lenses(self, grid: Grid, placement: Placement, highest: float) -> Field:
        """Transmission of the microlenses, (n, samples along y, samples along x)."""
        types = self.libraries.types
        count, size = len(placement.image), self.mla_samples
        radiator, row, column = split(types, dr.arange(types.UInt32, count * size * size), size, size)
        corner, pitch = self._corner(grid, placement), self._mla_pitch(grid)
        x, y = (
            dr.gather(types.Float64, types.Float64(np.ascontiguousarray(corner[:, axis])), radiator)
            + types.Float64(index) * dr.opaque(types.Float64, pitch[axis])
            for axis, index in ((0, column), (1, row))
        )
        lenses = plane_transmission(grid.camera, grid.wavelength, highest).at(x, y)
        return as_field(pack(lenses), (count, size, size))

    def _corner(self, grid: Grid, placement: Placement) -> NDArray[np.float64]:
        """Places of the first samples on the MLA, (n, 2)."""
        return grid.origin + placement.corner * grid.pitch

    def _mla_pitch(self, grid: Grid) -> NDArray[np.float64]:
        """Distance between samples on the MLA along x and y."""
        return self.samples * grid.pitch / self.mla_samples

    def _transfer(self, grid: Grid, step: NDArray[np.float64]) -> Field:
        """Transfer function from MLA to detector, (along x, along y), of all directions of all the radiators."""
        types = self.libraries.types
        low, high = self.chief.min(0), self.chief.max(0)
        columns, rows = (int(size) for size in high - low + self.samples)
        index = dr.arange(types.UInt32, rows * columns)
        _, row, column = split(types, index, rows, columns)
        first = low - self.samples // 2
        sx = (types.Float64(column) + dr.opaque(types.Float64, float(first[0]))) * dr.opaque(types.Float64, step[0])
        sy = (types.Float64(row) + dr.opaque(types.Float64, float(first[1]))) * dr.opaque(types.Float64, step[1])
        square = sx * sx + sy * sy
        waves = grid.camera.detector_distance / in_millimetres(grid.wavelength)
        turns = dr.opaque(types.Float64, waves) * (dr.sqrt(dr.maximum(1 - square, 0)) - 1)
        sine, cosine = dr.sincos(types.Float(turns - dr.round(turns)) * (2 * math.pi))
        transfer = as_field(pack(dr.select(square < 1, types.Complex2f(cosine, sine), 0)), (rows, columns))
        return self.libraries.arrays.ascontiguousarray(transfer.T)

    @property
    def together(self) -> int:
        """Radiators to transform at a time: small ones in groups, so that the calls cost little."""
        return min(len(self.chief), max(1, self.sizes.group // self.mla_samples**2))

    def add(self, start: int, stop: int, work: Workspace, tile: Tile) -> None:
        """Transform the fields of radiators start ... stop to the detector and add their intensities to a tile.

        Everything is done on blocks that stay in a core's own cache: along x for the directions of the pupil; then,
        turned over, along y to the MLA, to the spectrum and to the detector; at last along x to the detector.

        Parameters
        ----------
        start, stop : int
            Which radiators of the batch, at most `together`.
        work : Workspace
            Overwritten.
        tile : Tile
            Added to.
        """
        n, field = self.samples, work.field[: stop - start]
        if self.lenses is None:
            self._pass_product(start, stop, work)
        else:
            self._pass_plane(start, stop, work, self.lenses)
        for block in _blocks(n, n, self.sizes.block):
            detector = _inverse(field[..., block], axis=1)
            for part, radiator in zip(detector, range(start, stop), strict=True):
                tile.add(part, block, radiator)

    def _pass_product(self, start: int, stop: int, work: Workspace) -> None:
        """Take the fields from the pupil to the detector, along y only: through microlenses axis by axis."""
        n, m, count = self.samples, self.mla_samples, stop - start
        directions = self.pupil.shape[1]
        rows = work.rows[:count]
        rows[..., :directions] = self.pupil[start:stop]
        rows[..., directions:] = 0
        rows = _inverse(rows, axis=2)
        rows *= self.along_x[start:stop, None, :]
        rows = _forward(rows, axis=2)
        for block in _blocks(n, m, self.sizes.block):
            columns = work.columns[:count, : block.stop - block.start]
            columns[..., :directions] = rows[..., block].transpose(0, 2, 1)
            columns[..., directions:] = 0
            columns = _inverse(columns, axis=2)
            columns *= self.along_y[start:stop, None, :]
            self._to_detector(columns, block, start, stop, work)

    def _pass_plane(self, start: int, stop: int, work: Workspace, lenses: Field) -> None:
        """Take the fields from the pupil to the detector, along y only: through microlenses of both axes at once."""
        n, m, count = self.samples, self.mla_samples, stop - start
        directions = self.pupil.shape[1]
        rows = work.rows[:count]
        rows[..., :directions] = self.pupil[start:stop].transpose(0, 2, 1)
        rows[..., directions:] = 0
        rows = _inverse(rows, axis=2)
        rows *= self.along_y[start:stop, None, :]
        for block in _blocks(m, m, self.sizes.block):
            columns = work.columns[:count, : block.stop - block.start]
            columns[..., :directions] = rows[..., block].transpose(0, 2, 1)
            columns[..., directions:] = 0
            columns = _inverse(columns, axis=2)
            columns *= self.along_x[start:stop, None, :]
            columns *= lenses[start:stop, block]
            work.plane[:count, block] = _forward(columns, axis=2)[..., :n]
        for block in _blocks(n, m, self.sizes.block):
            columns = work.columns[:count, : block.stop - block.start]
            columns[...] = work.plane[:count, :, block].transpose(0, 2, 1)
            self._to_detector(columns, block, start, stop, work)

    def _to_detector(self, columns: Field, block: slice, start: int, stop: int, work: Workspace) -> None:
        """Take some columns of the fields, spectra along x and places on the MLA along y, to the detector along y."""
        n = self.samples
        chief = self.chief[start:stop] - self.chief.min(0)
        spectrum = _forward(columns, axis=2)[..., :n]
        for part, (x, y) in zip(spectrum, chief, strict=True):
            part *= self.transfer[x + block.start : x + block.stop, y : y + n]
        work.field[: stop - start, block] = _inverse(spectrum, axis=2)


def _blocks(count: int, length: int, samples: int) -> Iterator[slice]:
    """Cut `count` rows of some length into blocks of about so many samples."""
    parts = max(1, round(count * length / samples))
    edges = [count * part // parts for part in range(parts + 1)]
    return (slice(*pair) for pair in itertools.pairwise(edges))


def _largest(blocks: Iterator[slice]) -> int:
    return max(block.stop - block.start for block in blocks)


def _along_axis(types: Any, table: NDArray[np.complex64], place: Any) -> Any:
    """Interpolate a transmission of one axis at places in periods."""
    period = len(table) - 1
    parts = types.Float(np.ascontiguousarray(table).view(np.float32))
    place = (place - dr.floor(place)) * period
    node = dr.minimum(types.UInt32(place), period - 1)
    part = types.Float(place - types.Float64(node))
    real, imaginary = (
        dr.lerp(dr.gather(types.Float, parts, 2 * node + k), dr.gather(types.Float, parts, 2 * node + 2 + k), part)
        for k in (0, 1)
    )
    return types.Complex2f(real, imaginary)


def _forward(field: Field, axis: int) -> Field:
    """Transform unscaled, on this thread alone."""
    return fft(field, axis=axis, workers=1)


def _inverse(field: Field, axis: int) -> Field:
    """Transform back unscaled, on this thread alone."""
    return fft(field, axis=axis, inverse=True, norm="forward", workers=1)
