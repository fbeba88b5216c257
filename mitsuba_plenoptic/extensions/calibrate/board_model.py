r"""The detector position of a board's corner seen through one lens of a camera, with all derivatives.

The main lens images a point X of the camera frame to :math:`q = -X f / (g - f)` at the distance
:math:`g' = g f / (g - f)` (g: the point's distance). The corner is seen where the ray from q through a microlens's
centre c meets the detector: the same ray that the sensor plugin follows from there, so that a calibrated camera renders
what was observed. With b the distance of the microlens array, h the height of the lens on a tilted array, t the slope
of the ray and U the map that takes the distortion away in the plane :math:`z = -b`, the ray crosses that plane in
:math:`m = c - h t` and the pupil in :math:`P = m + b t`, and behind it seems to come from :math:`U(m)`. It passes
through q where

.. math:: (c + (b - h) t) (1 - \gamma) + \gamma U(c - h t) = q, \qquad \gamma = g' / b,

which is linear in t except for the tilt. The detector point is :math:`c - (z + h) t`.

Images behind the array, as in a Galilean camera, need no separate case.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ...camera import PlenopticCamera, part_units, parts_of, with_parts
from ...lenses import undistort
from ...runtime import Array, Pair, Triple

CALIBRATED = (
    "focal_length",
    "mla_distance",
    "detector_distance",
    "mla_pitch",
    "mla_rotation",
    "mla_offset",
    "mla_tilt",
)
"""Parameters that are calibrated, in the order of a vector, before the principal point and `distortion`."""

UNITS = (
    {number: unit for name in CALIBRATED for number, unit in part_units(name).items()}
    | {"principal_u": "pixels", "principal_v": "pixels"}
    | part_units("distortion")
)
"""The numbers that are fitted, with their units: those of the camera's parameters, but instead of the offset the centre
of lens (0, 0), and the principal point, the pixel on the axis."""

NAMES = tuple(UNITS)
"""Their names, in the order of a vector of them."""

AT = {name: index for index, name in enumerate(NAMES)}
"""Index of each name in the vector, which begins with f, b and z."""

OFFSET = [AT["offset_x"], AT["offset_y"]]
PRINCIPAL = [AT["principal_u"], AT["principal_v"]]
"""Indices of the centre of lens (0, 0) and of the pixel on the axis."""


@dataclass(frozen=True)
class Observations:
    """Observed corners or centres, as arrays with one row per observation.

    Attributes
    ----------
    lens : (n, 2) array
        Position of the lens in the unit frame of its lattice, in pitches along the rows and rows across them.
    pixel : (n, 2) array
        Column and row; the centre of the first pixel is 0.
    board : (n, 2) array
        Position of the corner on its board in mm.
    pose : (n,) array
        Index of the board's pose, from 0.
    bend : (n, terms) array, optional
        Shapes of a bent board at the corner, in mm; numbers that follow those of the camera multiply them.
    """

    lens: Array
    pixel: Array
    board: Array
    pose: Array
    bend: Array | None = None

    def __len__(self) -> int:
        return len(self.pixel)

    @property
    def poses(self) -> int:
        """Number of poses of the board."""
        return int(self.pose.max()) + 1

    def keep(self, chosen: Array) -> Observations:
        """Return the observations in the chosen rows."""
        bend = None if self.bend is None else self.bend[chosen]
        return Observations(self.lens[chosen], self.pixel[chosen], self.board[chosen], self.pose[chosen], bend)


def _left_jacobian(vector: Array) -> Array:
    """Return J with d(exp(w) x) = -[exp(w) x] J dw (Sola, "Quaternion kinematics", eq. 145 of SO(3))."""
    angle = float(np.linalg.norm(vector))
    cross = np.cross(np.eye(3), vector)
    if angle < 1e-4:
        return np.eye(3) + cross / 2 + cross @ cross / 6
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross


def _inverse(matrix: Array) -> Array:
    """Return the inverses of matrices (n, 2, 2), ten times as fast as `numpy.linalg.inv`."""
    (a, b), (c, d) = matrix.transpose(1, 2, 0)
    return (np.stack([d, -b, -c, a]) / (a * d - b * c)).T.reshape(-1, 2, 2)


def _axes(numbers: Array) -> Pair:
    """Return the steps of the lattice's axes, columns of (2, 2), in mm, and the slopes of the tilted array."""
    angle = np.deg2rad(numbers[5])
    rows = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return rows * numbers[3:5], np.tan(np.deg2rad(numbers[8:10]))


def _lenses(numbers: Array, lens: Array, row_ratio: float) -> tuple[Array, Array, Array, Array]:
    """Return the lenses' centres (n, 2) and heights (n,) over the plane z = -b, and their derivatives."""
    axes, slopes = _axes(numbers)
    unit = lens * [1.0, row_ratio]
    spoke = unit @ axes.T
    c = spoke + numbers[OFFSET]
    c_by = np.zeros((len(lens), 2, len(numbers)))
    # Pitches, rotation, offset, and below the tilt.
    c_by[:, :, 3:5] = unit[:, None] * (axes / numbers[3:5])
    c_by[:, :, 5] = np.deg2rad(spoke[:, ::-1] * [-1, 1])
    c_by[:, :, OFFSET] = np.eye(2)
    h_by = slopes @ c_by
    h_by[:, 8:10] += np.deg2rad(c * (1 + slopes**2))
    return c, c @ slopes, c_by, h_by


def _pixels(numbers: Array, p: Array, p_by: Array, pixel_size: float) -> Pair:
    """Return positions on the detector and their derivatives, converted to pixels."""
    by_numbers = p_by / pixel_size
    by_numbers[:, :, PRINCIPAL] += np.eye(2)
    return p / pixel_size + numbers[PRINCIPAL], by_numbers


def predict_centres(numbers: Array, lens: Array, *, pixel_size: float, row_ratio: float) -> Pair:
    r"""Return the centres of micro-images, where the chief ray of each lens meets the detector.

    :math:`c + (z + h) c / (b - h)`, for the ray through the centres of pupil and lens.

    The result has the shape (n, 2), (n, 2, 17).
    """
    c, h, c_by, h_by = _lenses(numbers, lens, row_ratio)
    b, z = numbers[1:3]
    before = (b - h)[:, None]
    behind = (z + h)[:, None]
    p_by = c_by * (1 + behind / before)[:, :, None]
    p_by += (c * (before + behind) / before**2)[:, :, None] * h_by[:, None]
    p_by[:, :, 2] += c / before
    p_by[:, :, 1] -= c * behind / before**2
    return _pixels(numbers, c * (1 + behind / before), p_by, pixel_size)


def centres_of(camera: PlenopticCamera, lens: Array) -> Array:
    """Return the centres (n, 2) in pixels of a camera's micro-images, for positions of lenses as in `Observations`."""
    row_ratio = camera.lattice.row_ratio
    return predict_centres(numbers_of(camera), lens, pixel_size=camera.pixel_size, row_ratio=row_ratio)[0]


def predict(
    numbers: Array,
    poses: Array,
    observed: Observations,
    *,
    pixel_size: float,
    row_ratio: float,
    grid: Array | None = None,
) -> Triple:
    """Return the predicted positions of corners in pixels, and the derivatives of these positions.

    With a grid of lenses in pixels, (3, 2), corners are seen in views instead: a view is what pixels at one place
    beside the grid's lenses see, and the position of the lens is predicted, in pitches along x and y of the lattice.

    Shapes: `numbers` (17 + terms,), `poses` (poses, 6); the result (n, 2), (n, 2, 17 + terms), (n, 2, 6).
    """
    f, b, z = numbers[:3]
    n = len(observed)
    # The point and its image.
    corner = np.pad(observed.board, ((0, 0), (0, 1)))
    bend = np.zeros((n, 0)) if observed.bend is None else observed.bend
    corner[:, 2] = bend @ numbers[len(NAMES) :]
    normal = np.empty((n, 3, 1))
    X = np.empty((n, 3))
    X_by = np.zeros((n, 3, 6))
    for index, pose in enumerate(poses):
        of_pose = observed.pose == index
        rotation = Rotation.from_rotvec(pose[:3])
        rotated = rotation.apply(corner[of_pose])
        X[of_pose] = rotated + pose[3:]
        normal[of_pose] = rotation.apply([[0.0, 0.0, 1.0]]).T
        by_rotated = np.cross(_left_jacobian(pose[:3]), np.eye(3)[:, None], axisa=0, axisc=1)
        X_by[of_pose, :, :3] = np.tensordot(rotated, by_rotated, 1)
        X_by[of_pose, :, 3:] = np.eye(3)
    g = X[:, 2]
    # Nearer than the focal length there is no image: the caller sees values that are not finite.
    beyond = np.where(g > f, g - f, np.nan)
    q = -X[:, :2] * (f / beyond)[:, None]
    gamma = g * f / (beyond * b)
    q_by = np.zeros((n, 2, len(numbers)))
    gamma_by = np.zeros((n, len(numbers)))
    q_by[:, :, 0] = -X[:, :2] * (g / beyond**2)[:, None]
    gamma_by[:, 0] = g**2 / (beyond**2 * b)
    gamma_by[:, 1] = -gamma / b
    c, h, c_by, h_by = _lenses(numbers, observed.lens, row_ratio)
    # What is found: the ray's slope, or in views the lens, by how much it lies from the observed one.
    found = np.zeros((n, 2))
    t = found
    if grid is not None:
        axes, slopes = _axes(numbers)
        p_by_lens = pixel_size * (grid[1:] / [[1.0], [row_ratio]]).T
        p = (observed.pixel - numbers[PRINCIPAL]) * pixel_size
    for _ in range(2):
        # the tilt is a thousandth of a radian and the distortion a few per cent: each step gains five digits
        if grid is not None:
            c, h, c_by, h_by = _lenses(numbers, observed.lens + found / [1.0, row_ratio], row_ratio)
            t = (c - p - found @ p_by_lens.T) / (z + h)[:, None]
        m = c - h[:, None] * t
        P = c + (b - h)[:, None] * t
        source, turned, source_by = _undistorted(m, numbers[12 : len(NAMES)])
        miss = P * (1 - gamma)[:, None] + gamma[:, None] * source - q
        by_c = (1 - gamma)[:, None, None] * np.eye(2) + gamma[:, None, None] * turned
        by_t = ((b - h) * (1 - gamma))[:, None, None] * np.eye(2) - (gamma * h)[:, None, None] * turned
        by_h = -np.einsum("nab,nb->na", by_c, t)
        by_found = by_t
        if grid is not None:
            t_by_lens = (axes - p_by_lens - t[:, :, None] * (slopes @ axes)) / (z + h)[:, None, None]
            by_found = by_c @ axes + by_h[:, :, None] * (slopes @ axes) + by_t @ t_by_lens
        inverse = _inverse(by_found)
        found = found - np.einsum("nab,nb->na", inverse, miss)
        if grid is None:
            t = found
    by_h = -np.einsum("nab,nb->na", by_c, t)
    miss_by = by_c @ c_by + by_h[:, :, None] * h_by[:, None] + (source - P)[:, :, None] * gamma_by[:, None] - q_by
    miss_by[:, :, 1] += (1 - gamma)[:, None] * t
    miss_by[:, :, 12 : len(NAMES)] += gamma[:, None, None] * source_by
    by_X = np.zeros((n, 2, 3))
    by_X[:, 0, 0] = by_X[:, 1, 1] = -f / beyond
    by_X[:, :, 2] = (source - P) * (f**2 / (beyond**2 * b))[:, None] - q / beyond[:, None]
    by_pose = inverse @ by_X @ X_by
    if grid is not None:
        t_by = c_by - t[:, :, None] * h_by[:, None]
        t_by[:, :, 2] -= t
        t_by[:, :, PRINCIPAL] += pixel_size * np.eye(2)
        miss_by += by_t @ t_by / (z + h)[:, None, None]
        place, by_numbers = observed.lens * [1.0, row_ratio] + found, -inverse @ miss_by
    else:
        p_by = c_by + (z + h)[:, None, None] * (inverse @ miss_by) - t[:, :, None] * h_by[:, None]
        p_by[:, :, 2] -= t
        place, by_numbers = _pixels(numbers, c - (z + h)[:, None] * t, p_by, pixel_size)
        by_pose *= (-(z + h) / pixel_size)[:, None, None]
    by_numbers[:, :, len(NAMES) :] = by_pose[:, :, 3:] @ normal * bend[:, None]
    return place, by_numbers, by_pose


def camera_of(numbers: Array, like: PlenopticCamera) -> PlenopticCamera:
    """Return the camera of given parameters, with a principal point at a centre, edge or corner of a pixel.

    Properties that the numbers do not determine are those of `like`: recorded pixels and their size, f-number, lattice,
    apertures and focal lengths of the microlenses, and the refraction model.
    """
    ends = np.cumsum([len(parts_of(like, name)) for name in CALIBRATED])
    *leading, beyond = np.split(numbers, ends)
    values = dict(zip(CALIBRATED, leading, strict=True))
    values |= {"distortion": beyond[2:], "aperture_radius": numbers[:1] / (2 * like.f_number)}
    offset = values["mla_offset"]
    values["mla_offset"] = np.zeros(2)
    resolution = []
    crop = []
    for pixels, principal in zip(like.crop_size, numbers[PRINCIPAL], strict=True):
        # Twice the distance of the axis from the first pixel's edge.
        twice = round(2 * principal) + 1
        crop.append(max(0, pixels - twice))
        resolution.append(max(twice, 2 * pixels - twice))
    camera = with_parts(
        like,
        values,
        detector_width=like.pixel_size * resolution[0],
        resolution=tuple(resolution),
        crop_offset=tuple(crop),
        crop_size=like.crop_size,
    )
    return with_parts(camera, {"mla_offset": offset - camera.lattice.centre(0.0, 0.0)})


def numbers_of(camera: PlenopticCamera) -> Array:
    """Return the parameters of a camera that a calibration fits, as a vector in the order of `NAMES`."""
    values = {name: parts_of(camera, name) for name in CALIBRATED} | {"mla_offset": camera.lattice.centre(0.0, 0.0)}
    principal = [(size - 1) / 2 - offset for size, offset in zip(camera.resolution, camera.crop_offset, strict=True)]
    return np.concatenate([*values.values(), principal, camera.distortion])


def _undistorted(m: Array, distortion: Array) -> Triple:
    """Return the undistorted positions U(m) in mm for positions (n, 2), with derivatives by these and the distortion.

    The derivatives have the shapes (n, 2, 2) and (n, 2, 5).
    """
    k1, k2, k3, p1, p2 = distortion
    x, y = m.T
    square = x * x + y * y
    position = np.stack(undistort(x, y, distortion), axis=-1)
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    growth = 2 * (k1 + square * (2 * k2 + square * 3 * k3))
    by_place = growth[:, None, None] * m[:, :, None] * m[:, None]
    by_place[:, 0, 0] += radial + 6 * p1 * x + 2 * p2 * y
    by_place[:, 1, 1] += radial + 6 * p2 * y + 2 * p1 * x
    by_place[:, [0, 1], [1, 0]] += 2 * (p1 * y + p2 * x)[:, None]
    by_numbers = np.empty((len(m), 2, 5))
    for power in range(3):
        by_numbers[:, :, power] = m * (square ** (power + 1))[:, None]
    by_numbers[:, 0, 3] = square + 2 * x * x
    by_numbers[:, 1, 4] = square + 2 * y * y
    by_numbers[:, 0, 4] = by_numbers[:, 1, 3] = 2 * x * y
    return position, by_place, by_numbers
