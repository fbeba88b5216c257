r"""Pictures of a plane's elements behind a regular array, by waves and by rays, from which a scene's picture is made.

Points one bin apart (`PlenopticCamera.bin_size`: a pitch, back through the middle of the pupil) have equal pictures one
lens apart: exactly behind an objective with the array in its image (Broxton et al. 2013, "Wave optics theory and 3-D
deconvolution for the light field microscope", Optics Express 21, 25418), to first order behind a thin lens. So the
elements before one lens stand for all, and a plane has as many bins as the part has lenses, at every distance.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter

from ...camera import PlenopticCamera
from ...detector import SHARP
from ...points import CaptureOperator, ray_spread
from ...runtime import Array, Named
from .array_part import ArrayPart

_WIDEST = 14.0
"""Blur of the last plane beyond the focus in lenses."""

_PARTS = 2
"""Points along an element's side."""


@dataclass(frozen=True)
class Plane:
    """A plane of elements, with the picture of each of a lens's elements.

    Attributes
    ----------
    distance : float
        Distance in millimetres from the main lens, behind an objective beyond the plane in focus.
    across : int
        Elements along either side of a bin: from lens to lens along the rows, from row to row across them.
    pictures : (rows, columns, elements) float32 array
        Light in pixels of the part's regular array, of an odd number of lenses along a side and the borders of cells,
        over the light through the pupil; elements row by row, in the directions of the picture.
    """

    distance: float
    across: int
    pictures: Array


def distances_of(camera: PlenopticCamera, first: float = 0.75, growth: float = 1.12) -> list[float]:
    """Return the distances of planes in millimetres, in the steps in which a light field resolves them.

    The first one beyond the focus has the blur `first` in lenses; steps grow by the factor `growth`.
    """
    count = int(np.log(1 + (growth - 1) * _WIDEST / first) / np.log(growth))
    blurs = first * (growth ** np.arange(1, count + 1) - 1) / (growth - 1) * camera.row_pitch
    beyond = np.concatenate([-blurs[::-1], [0.0], blurs])
    if camera.objective is not None:
        return list((beyond / camera.blur_diameter(1.0)).tolist())
    # The blur of a thin lens is linear in the inverse of the distance.
    inverse = 1 / camera.focus_distance - beyond / (camera.aperture_diameter * camera.mla_distance)
    return list((1 / inverse[inverse > 0]).tolist())


def plane_of(part: ArrayPart, distance: float) -> Plane:
    """Return a plane's elements with their pictures."""
    model = part.model
    blur = model.camera.blur_diameter(distance) / model.camera.row_pitch
    # Elements along a bin's side, which are coarse from a blur of 6.5 lenses on.
    across = 4 if blur < 6.5 or part.pixels.shift.any() else 3
    row_ratio = float(model.pitch[1] / model.pitch[0])
    # An element may be half a pitch from the middle of its lens.
    # Light of a point beyond its blur's border, in lenses, that counts.
    lenses = 2 * int(np.ceil((blur / 2 + 0.6) / min(row_ratio, 1) + 0.5)) + 1
    camera = _regular(part, lenses)
    step = ((np.arange(across * _PARTS) + 0.5) / (across * _PARTS) - 0.5) * camera.bin_size(distance)
    # The image is upside down.
    y, x = np.meshgrid(-step * row_ratio, -step, indexing="ij")
    points = np.stack([x, y, np.full_like(x, distance)], axis=-1)
    points = points.reshape(across, _PARTS, across, _PARTS, 3).transpose(0, 2, 1, 3, 4).reshape(across**2, -1, 3)
    blurred = part.numbers.blur * part.along / model.pitch[0]
    sharp = _by_rays(camera, points) if model.wavelength is None else _by_waves(camera, points, model.wavelength)
    pictures = gaussian_filter(sharp, (blurred, blurred, 0))
    # Square pixels become those of which a whole number fits from row to row.
    rows = np.arange(lenses * part.down + 2 * part.margin) + 0.5
    place = (rows - len(rows) / 2) * (part.along * row_ratio / part.down) + (len(pictures) - 1) / 2
    return Plane(distance, across, make_interp_spline(np.arange(len(pictures)), pictures)(place).astype(np.float32))


def _regular(part: ArrayPart, lenses: int) -> PlenopticCamera:
    """Return a camera of a few lenses that are those in the middle of a part, without displacements."""
    camera = part.model.camera
    pupil = None
    if camera.vignetting is not None:
        here = camera.vignetting.at(*part.middle)
        numbers: Named = {name: [float(value)] for name, value in here.items()}
        pupil = replace(camera.vignetting, **numbers)
    pitch = camera.row_pitch
    first = camera.lattice.unit_centre(0, 0)
    pixel = pitch * camera.image_growth / part.along
    rows = (lenses + 2 * part.margin / part.down) * camera.lattice.row_distance * camera.image_growth / pixel
    size = (lenses * part.along, 2 * int(np.ceil(rows / 2)) + 2)
    return camera.replace(
        mla_rotation=0.0,
        # A lens is centred on the axis.
        mla_offset=(-first[0] * pitch, -first[1] * camera.lattice.row_distance),
        mla_warp=(),
        mla_cra=(),
        mla_transmissions=None,
        **SHARP,
        vignetting=pupil,
        resolution=size,
        detector_width=size[0] * pixel,
        crop_offset=(0, 0),
        crop_size=size,
    )


def _by_waves(camera: PlenopticCamera, points: Array, wavelength: float) -> Array:
    """Return the pictures of elements, each of several points (elements, points, 3)."""
    weights = np.full(points.shape[1], 1 / points.shape[1])
    # Element by element, so that memory is that of a few patches.
    pictures = [CaptureOperator(camera, some, wavelength=wavelength, accuracy=0).forward(weights) for some in points]
    return np.stack(pictures, axis=-1)


def _by_rays(camera: PlenopticCamera, points: Array) -> Array:
    """Return the pictures of elements, each of several points, by an even grid of rays through the pupil."""
    # 8 rays along a pixel.
    across = 8 * round(camera.micro_image_pitch / camera.pixel_size)
    generator = np.random.default_rng(0)

    def picture(point: Array) -> Array:
        # Places of the grid differ, so that borders of lenses fall between rays by chance.
        samples = np.meshgrid(*((np.arange(across) + generator.random((2, 1))) * (2 / across) - 1))
        return ray_spread(camera, point, np.stack(samples, -1).reshape(-1, 2))

    return np.stack([np.mean([picture(point) for point in some], axis=0) for some in points], -1).astype(np.float32)
