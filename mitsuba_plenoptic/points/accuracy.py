r"""Rules that follow from the allowed error of an image: how much light to discard, and which points share a pattern.

The two rules are fitted to captures of walls and scenes by the paper's camera, compared with images in which no point
spreads are shared and only the last 0.1 % of the light is discarded (the case `speed.sharing` of `tools/bench`).

Points share patterns because of the symmetry of the microlens lattice. If a scene point moves so that its image on the
MLA moves by one lens, the pattern on the detector moves by one micro-image, :math:`D_2 (b + z) / b`, and is otherwise
unchanged except for the aberrations of a thin lens far from the axis. Points of the same wavefront at the same position
within their lenses therefore need one propagation for a zone of lenses.

Wavefronts count as equal if one microlens cannot distinguish them. Out of focus a microlens sees only a part of the
pupil, one of :math:`n = 2 a |\Delta b| / b D_2` across. It responds to the change of a wavefront's tilt over this part,
which moves the spot: a change by :math:`\delta` waves at the pupil's edge gives :math:`4 \delta / n` waves across a
lens, and a motion of the image by :math:`\mu` gives :math:`\mu D_1 / \lambda b n`. The steps of position and distance
within which points share a pattern therefore increase with the defocus.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from ..camera import PlenopticCamera
from ..errors import refuse_if, require_accuracy
from ..lenses import MainLens, convergence, inverse_distance, path_change
from ..optics import in_millimetres
from ..runtime import Array, Doubles, Integers
from ..waves import DEFAULT_ACCURACY
from .field_grid import Band
from .pupil_weights import PupilWeights

_BANDS = (
    (0.004, Band(cone=2.5, margin=120, bends=3.45, orders=22)),
    (0.02, Band(cone=1.8, margin=60, bends=2.3, orders=10)),
    (1.0, Band(cone=1.5, margin=45, bends=1.8, orders=8)),
)
"""Bands, each with the allowed error for many points below which it is used."""

_FINEST = Band(cone=2.5, margin=200, bends=5, orders=32, edge=3.0, smooth=True)
"""Band of derivatives at high accuracy (`tools/bench/cases/derivatives.py`)."""

_EXACT = 0.004
"""Allowed error below which `_FINEST` is used."""

_FEW = 512
"""Number of points up to which the errors by discarded light do not average out."""


def chosen_accuracy(accuracy: float | None, method: str, default: float = DEFAULT_ACCURACY) -> float:
    """Return the allowed error of a method, or the method's default; refuse an error that the method ignores."""
    if accuracy is None:
        return 0.0 if method == "full_field" else default
    checked = require_accuracy(accuracy)
    refuse_if(
        checked and method == "full_field",
        f"accuracy = {checked:g}: method = {method} takes none, as it computes every point spread without shortcuts",
    )
    return checked


def band_for(accuracy: float, count: int) -> Band:
    """Return how much of the diffracted light to keep for an allowed error of the sum of some points."""
    allowed = accuracy / 5.0 if count <= _FEW else accuracy
    band = next(band for limit, band in _BANDS if allowed < limit)
    if count <= _FEW:
        return band
    # Light that many points send beyond these orders averages out, so that retaining it gains nothing.
    # With edges of the pupil softened over fewer samples, walls lose 0.3 % of the light, not 1.2 %.
    return replace(band, edge=1 / 4, beyond=math.inf if allowed < _EXACT else band.orders)


def derivative_band_for(accuracy: float, count: int) -> Band:
    """Return how much of the diffracted light to keep for derivatives.

    Derivatives give more weight to light at large angles, whose phase changes fastest. Light of a hard pupil edge that
    is aliased changes fastest of all, so that edges are softer than for images.
    """
    if accuracy < _EXACT:
        return _FINEST
    return replace(band_for(accuracy, count), edge=2.0, smooth=True)


def derivatives_share(accuracy: float, count: int) -> bool:
    """Return whether derivatives of a sum of `count` points share point spreads, as images do."""
    return accuracy >= _EXACT and count > _FEW


def wavefront_step(accuracy: float, camera: PlenopticCamera, lens: MainLens, positions: Doubles) -> float:
    """Return the largest difference, in waves across a microlens, of wavefronts that count as equal.

    The errors of overlapping point spreads average out, so that sums of few spreads need more accurate ones.

    The positions are in the camera frame or, behind a round lens, in a frame rotated about the axis. The result is 0 if
    nothing may be shared.
    """
    if not len(positions):
        return 0.0
    image = lens.images(positions)
    lenses = np.unique(np.floor(image / camera.row_pitch), axis=0)
    # 25: Approximate number of lenses whose points have overlapping spreads.
    overlap = min(len(positions), 25 * len(positions) / len(lenses))
    # Waves across a microlens by which wavefronts may differ, over the allowed error of a sum of many points.
    # 1600 overlapping point spreads or more allow all of them.
    return accuracy * 10.0 * min(1.0, (overlap / 1600) ** 0.5)


ZONES = (2, 3, 4, 6, 8, 12, 16)
"""Numbers of lenses along an axis over which patterns may be shared, besides one."""

_FARTHEST = 1e12
"""Distance, in millimetres, beyond which light counts as collimated."""

_OFF_LATTICE = 0.38196601
"""Fraction of a step by which the bounds of steps are offset from the positions of regular samples."""


@dataclass(frozen=True)
class Patterns:
    """Point patterns, and the index of each point's pattern."""

    positions: Doubles  # scene point for which each pattern is computed, (patterns, 3)
    slant: Doubles | None  # mean slant of the points (see `PupilWeights`), (patterns, 2)
    pattern: Integers  # index of each point's pattern, (n,)
    shift: Integers  # lenses along x and y from the pattern's position to each point's, (n, 2)


def find_patterns(
    camera: PlenopticCamera,
    lens: MainLens,
    positions: Doubles,
    pupil_weights: PupilWeights | None,
    wavelength: float,
    step: float,
) -> Patterns:
    """Return the patterns of points: points with the same pattern share one point spread.

    Wavefronts count as equal if they differ by less than `step` waves across a microlens; with 0 nothing is shared.
    Camera and positions are in the frame of the lattice. Points with different pupil weights never share a pattern.
    """
    if step == 0:
        alone = np.zeros((len(positions), 2), np.int64)
        slant = None if pupil_weights is None else pupil_weights.slant
        return Patterns(positions, slant, np.arange(len(positions)), alone)
    # Positions on the MLA in steps along the lattice vectors, the first of which is along x.
    (width, _), (aside, height) = camera.lattice.basis
    x, y = (lens.images(positions) - np.array(camera.mla_offset)).T
    j = y / height
    image = np.stack([(x - j * aside) / width, j], axis=-1)
    depth, parts = _depth_steps(camera, lens, positions[:, 2], wavelength, step)
    fine = np.floor(image * parts[:, None] + _OFF_LATTICE).astype(np.int64)
    cell = fine // parts[:, None]
    zone, size = _zones(camera, lens, cell, wavelength, step)
    keys = [zone, size[:, None], depth[:, None], fine - cell * parts[:, None]]
    types = len(camera.mla_focal_lengths)
    if types > 1:
        lens_type = camera.lattice.lens_type(*cell.T).astype(np.int64)
        keys.append(lens_type[:, None])
    if pupil_weights is not None:
        # 1.5: Step of slants that are averaged, over the allowed wavefront step in waves.
        slants = np.floor(pupil_weights.slant / (1.5 * step) + 0.5).astype(np.int64)
        keys += [pupil_weights.index[:, None], slants]
    _, first, pattern = np.unique(np.hstack(keys), axis=0, return_index=True, return_inverse=True)
    pattern = pattern.reshape(-1)
    # A pattern is computed for the mean of its points, in the middle of the lenses that use it.
    low, high = np.full((2, len(first), 2), np.iinfo(np.int64).max)
    high = -high
    np.minimum.at(low, pattern, cell)
    np.maximum.at(high, pattern, cell)
    middle = (low + high) // 2
    if types > 1:
        # the nearest lens of the same lens_type
        off = lens_type[first] - camera.lattice.lens_type(*middle.T).astype(np.int64)
        middle[:, 0] += (off + 1) % types - 1
    count = np.bincount(pattern)

    def means(values: Doubles) -> Doubles:
        return np.column_stack([np.bincount(pattern, column) for column in values.T]) / count[:, None]

    mean = np.bincount(pattern, inverse_distance(lens, positions)) / count
    slant = None if pupil_weights is None else means(pupil_weights.slant)
    # If a pattern is shared by diverging and converging light, their mean may be collimated.
    nearness = np.where(np.abs(mean) > 1 / _FARTHEST, mean, 1 / _FARTHEST)
    centres = lens.points(_on_array(camera, means(image - cell) + middle), nearness)
    return Patterns(centres, slant, pattern, cell - middle[pattern])


def _on_array(camera: PlenopticCamera, steps: Array) -> Doubles:
    """Return positions on the MLA, from steps along the lattice vectors, (n, 2)."""
    basis = np.array(camera.lattice.basis)
    offset = np.array(camera.mla_offset)
    return (steps @ (basis / camera.row_pitch) + offset / camera.row_pitch) * camera.row_pitch


def _depth_steps(
    camera: PlenopticCamera, lens: MainLens, g: Doubles, wavelength: float, step: float
) -> tuple[Integers, Integers]:
    """Return the index of each point's step of distance, and the number of parts of a lens along an axis."""
    lam = in_millimetres(wavelength)
    a = lens.pupil.radius
    b = lens.pupil.distance
    defocus = a * a / (2 * lam) * (convergence(lens, g) - 1 / b)
    pitch = max(camera.mla_pitches)
    lenses_per_wave = 4 * b * lam / (a * pitch)
    lenses = np.maximum(1, lenses_per_wave * np.abs(defocus))
    # linear where the blur is below one lens, logarithmic beyond
    scale = np.where(lenses > 1, np.sign(defocus) * (1 + np.log(lenses)) / lenses_per_wave, defocus)
    depth = np.floor(4 * scale / step + _OFF_LATTICE)
    middle = np.abs(depth + 0.5 - _OFF_LATTICE) * step / 4 * lenses_per_wave
    lenses = np.exp(np.maximum(0, middle - 1))
    # 2.5: Largest step of position in pitches over the allowed wavefront step in waves; it is finite as blur has an
    # edge.
    width = np.minimum(step * lam * b / (2 * a) * lenses / pitch, 2.5 * step)
    return depth.astype(np.int64), np.ceil(1 / width).astype(np.int64)


def _zones(
    camera: PlenopticCamera, lens: MainLens, cell: Integers, wavelength: float, step: float
) -> tuple[Integers, Integers]:
    """Return the first lens and the size of each lens's zone, the same along both lattice vectors.

    The wavefront changes by an allowed amount within a zone.
    """
    pitch = max(camera.mla_pitches)
    size = np.ones(len(cell), np.int64)
    for width in ZONES:
        first = cell // width * width
        square = np.max(
            [(_on_array(camera, first + np.array(corner) * width) ** 2).sum(1) for corner in np.ndindex(2, 2)], axis=0
        )
        waves = path_change(lens, np.sqrt(square), pitch, wavelength)
        # 0.6: Width of a zone, in wavefront changes from lens to lens, over the allowed wavefront step.
        size[width * waves <= 0.6 * step] = width
    return cell // size[:, None] * size[:, None], size
