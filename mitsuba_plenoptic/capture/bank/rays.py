r"""The rays from points through the centres of the lenses that they light, and what each brings to the detector.

The ray goes from the point X to the lens's centre c through the pupil point P that solves :math:`M(P) = c`, M the map
of rays from the pupil to the array, and arrives on the detector at :math:`c + z (c - P) / b`. It brings

.. math:: \frac{U^2(P)}{\int U^2} \left|\det \frac{dP}{dM}\right| A_\mathrm{lens} \, c_r(P, v)

of kernel r: U^2 is the power on the pupil, the pupil's weights included, and v the vergence of X's image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
import scipy
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...optics.main_lens import UniformLens, main_lens
from ...optics.rays import conjugate_coordinate
from ...runtime.backend import array_module, backend
from ...runtime.batches import Box
from ...runtime.indexing import quotient
from ..pupil_weights import PupilWeights
from ..splines import spline_parts
from .lens_bank import LensBank

_NEWTON = 3
"""Steps of Newton's method to the pupil point, which starts from rays near the axis."""

_POINTS = 8
"""Points across a cell of the pupil's weights for how much of it lies in the pupil."""


@dataclass(frozen=True)
class Rays:
    """Rays from some points through the centres of the lenses around their images."""

    camera: PlenopticCamera
    banks: list[LensBank]
    pitch: float
    points: NDArray[np.float64]
    around: NDArray[np.int64]
    pupil_weights: PupilWeights | None

    @property
    def samples(self) -> int:
        """Coefficients of all rays."""
        return len(self.points) * len(self.around) * sum(bank.rank for bank in self.banks)

    def trace(self) -> Traced:
        """Find where the rays arrive, and what they bring of each kernel."""
        types, camera, lens = array_module(), self.camera, main_lens(self.camera)
        lattice, b = camera.lattice, lens.pupil_distance
        index = dr.arange(types.UInt32, len(self.points) * len(self.around))
        number = quotient(types, index, len(self.around))
        step = index - number * dr.opaque(types.UInt32, len(self.around))

        def value(array: NDArray[Any], which: Any) -> Any:
            return dr.gather(types.Float64, types.Float64(np.ascontiguousarray(array, np.float64)), which)

        point = tuple(value(self.points[:, axis], number) for axis in range(3))
        vergence = lens.vergence(point[2])
        defocus = 1 - b * vergence
        image = [conjugate_coordinate(X, point[2], b) for X in point[:2]]
        own = lattice.cell(*image)
        i, j = (cell + value(self.around[:, axis], step) for axis, cell in enumerate(own))
        centre = lattice.centre(i, j)
        P = [(c - m) / defocus for c, m in zip(centre, image, strict=True)]
        for _ in range(_NEWTON):
            (ex, ey), (xx, xy, yx, yy) = _landing(lens, P, point)
            ex, ey, det = ex - centre[0], ey - centre[1], xx * yy - xy * yx
            P = [P[0] - (yy * ex - xy * ey) / det, P[1] - (xx * ey - yx * ex) / det]
        inward = dr.minimum(1, lens.pupil_radius * dr.rsqrt(dr.square(P[0]) + dr.square(P[1])))
        pupil = P[0] * inward, P[1] * inward
        on_axis = types.Float64(0), types.Float64(0)
        power = dr.square(lens.amplitude(pupil, point) / lens.amplitude(on_axis, point)) / abs(det)
        power *= lattice.lens_area / (math.pi * lens.pupil_radius**2)
        if self.pupil_weights is not None:
            # A lens takes light from a part of the pupil.
            seen = max(camera.mla_pitches) / abs(defocus)
            power *= self.pupil_weights.at(number, *pupil, lens.pupil_radius, seen)[0]
            mean = self.pupil_weights.means(_POINTS)
            power *= value(1 / np.where(mean > 0, mean, np.inf), number)
        place = [c + (c - p) * (self.banks[0].arrival / b) for c, p in zip(centre, P, strict=True)]
        return collect(camera, self.banks, self.pitch, (i, j), number, place, power, (*P, vergence))


def collect(
    camera: PlenopticCamera,
    banks: list[LensBank],
    pitch: float,
    cell: tuple[Any, Any],
    number: Any,
    place: list[Any],
    power: Any,
    pupil: tuple[Any, Any, Any],
) -> Traced:
    """Evaluate what some rays bring, and keep those that bring any.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    banks : list of LensBank
        One for each type of lenses.
    pitch : float
        Distance of the samples in millimetres.
    cell : (array, array)
        Indices of the lenses that the rays pass.
    number : UInt32 array
        Numbers of their points.
    place : list of arrays
        x and y of where they arrive on the detector.
    power : array
        The fraction of the point's power that is a full lens's.
    pupil : (array, array, array)
        Pupil points and vergences, as of `LensBank.coefficients`.
    """
    types = array_module()
    kind = camera.lattice.lens_type(*cell) if len(banks) > 1 else types.Float64(0)
    coefficients = []
    for lens_type, bank in enumerate(banks):
        factor = types.Float(dr.select(kind == lens_type, power, 0))
        found = bank.coefficients(*(types.Float(value) for value in pupil))
        coefficients += [part * factor for part in found]
    size = (camera.detector_width, camera.detector_height)
    place = [(m + width / 2) / pitch - 0.5 for m, width in zip(place, size, strict=True)]
    dr.eval(coefficients, place, number)
    host = backend()
    arrays = [host.to_host(host.from_drjit(array)) for array in (*place, number, *coefficients)]
    table = np.stack(arrays[3:], axis=-1)
    lit = np.flatnonzero(table.any(1))
    return Traced(arrays[0][lit], arrays[1][lit], arrays[2][lit], table[lit])


def _landing(lens: UniformLens, P: list[Any], point: Any) -> tuple[tuple[Any, Any], tuple[Any, ...]]:
    """Return where rays through pupil points arrive on the array, and the derivatives of x and of y by Px and Py.

    Beyond the rim, where rays may meet before the array, the map goes on as it is at the rim.
    """
    step = 1e-3 * float(lens.pupil_radius)
    inward = dr.minimum(1, lens.pupil_radius * dr.rsqrt(dr.square(P[0]) + dr.square(P[1])))
    beyond, P = [p * (1 - inward) for p in P], [p * inward for p in P]

    def land(x: Any, y: Any) -> tuple[Any, Any]:
        sx, sy = lens.cosines((x, y), point)
        scale = lens.pupil_distance * dr.rsqrt(1 - sx * sx - sy * sy)
        return x + scale * sx, y + scale * sy

    here, right, left = land(*P), land(P[0] + step, P[1]), land(P[0] - step, P[1])
    above, below = land(P[0], P[1] + step), land(P[0], P[1] - step)
    xx, yx = ((high - low) / (2 * step) for high, low in zip(right, left, strict=True))
    xy, yy = ((high - low) / (2 * step) for high, low in zip(above, below, strict=True))
    x, y = here[0] + xx * beyond[0] + xy * beyond[1], here[1] + yx * beyond[0] + yy * beyond[1]
    return (x, y), (xx, xy, yx, yy)


@dataclass(frozen=True)
class Traced:
    """Places in samples of the images, numbers of the points, and coefficients (rays, ranks) of some rays."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    point: NDArray[np.uint32]
    coefficients: NDArray[np.float32]

    @property
    def box(self) -> Box:
        """The samples that they reach."""
        if not len(self.x):
            return Box(0, 0, 1, 1)
        low = np.floor([self.x.min(), self.y.min()]).astype(np.int64) - 1
        return Box.between(low, np.floor([self.x.max(), self.y.max()]).astype(np.int64) + 3)

    def shares(self, box: Box) -> Any:
        """Return the matrix (samples, rays) by which each ray is shared by the nearest samples of a box.

        The parts are those of a cubic B-spline along both axes.
        """
        left, top = np.floor(self.x), np.floor(self.y)
        corner = ((top - 1 - box.top) * box.columns + left - 1 - box.left).astype(np.int32)
        across, down = (
            [part.astype(np.float32) for part in spline_parts(place)] for place in (self.x - left, self.y - top)
        )
        rows = np.concatenate([corner + (row * box.columns + column) for row in range(4) for column in range(4)])
        parts = [down[row] * across[column] for row in range(4) for column in range(4)]
        columns = np.tile(np.arange(len(corner), dtype=np.int32), 16)
        shape = box.rows * box.columns, len(corner)
        return scipy.sparse.coo_array((np.concatenate(parts), (rows, columns)), shape=shape).tocsr()
