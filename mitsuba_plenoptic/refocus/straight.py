r"""Captures of displaced, tilted or unequal lenses as a regular, upright array of equal ones would have recorded them.

A tilted array has each lens at its own height h, towards the main lens. A ray through the pupil point P and the lens's
centre c meets the detector at :math:`p = c - (z + h)(P - c) / (b - h)`. In a camera whose array stands upright, the
lens on the same chief ray is at :math:`c b / (b - h)`, and the ray through its centre and P meets the detector around
the same point, at distances smaller by the factor :math:`(z + h) b / (b - h) z`. So every micro-image of the tilted
array is one of the upright array, enlarged about its chief ray, and the lenses are displaced by :math:`c h / b`.

A displaced lens moves its micro-image by its displacement, times :math:`(b + z) / b`. Every micro-image is moved back
to that of the lens's regular position, and reduced to the size of the upright array, by cubic splines. What the lens
has seen then counts to the regular position; where displacements are no small part of a lens, the refocused image is
displaced at the end. Deconvolution leaves the capture as it was recorded: its response moves the light instead
(`regular_place`), and dims it.

Both rays through P come from the same point of the object for P on the axis. For others they are :math:`h P / b` apart
on the array, a defocus that remains.

Where vignetting or single lenses are darker than an even pupil and equal lenses, the capture is divided by the white
image and multiplied by that of the even camera. Light that vignetting keeps out altogether stays missing;
`passed_light` tells methods how much remains of a white scene's light.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter, uniform_filter

from ..array import Displacement
from ..camera import PlenopticCamera, once_a_camera
from ..runtime import Floats, Named, Pair
from ..views import white_image
from .splatting import pixel_rows

_ORDER = 3
"""Order of the splines between pixels."""

_EVEN: Named = {"vignetting": None, "mla_transmissions": None}
"""Parameters of a camera whose lenses see the same pupil equally bright."""


def is_uneven(camera: PlenopticCamera) -> bool:
    """Return whether lenses see different pupils, or are unequally bright."""
    return any(getattr(camera, name) is not None for name in _EVEN)


def straightened(camera: PlenopticCamera) -> PlenopticCamera:
    """Return the camera with an upright array of regular, equal lenses; the same camera if it has these.

    In the image of the stop displaced lenses see the object from other directions, which the response to points knows.
    An array that is turned or moved onto itself is the same: its lenses are numbered anew, so that images are, too.
    """
    if camera.lens_data.images_stop:
        return camera
    regular = _regular(camera)
    kinds = len(regular.mla_focal_lengths)
    if any((*regular.mla_jitter, *regular.mla_figure_error)):
        return regular
    if regular.mla_pitches[0] != regular.mla_pitches[1]:
        turn = 180.0 if kinds == 1 else 360.0
    else:
        turn = 90.0 if regular.mla_lattice == "square" else 60.0 if kinds == 1 else 120.0
    angle = regular.mla_rotation - turn * round(regular.mla_rotation / turn)
    basis = kinds * np.array(regular.lattice.basis)
    steps = np.linalg.solve(basis.T, regular.mla_offset)
    # Multiples of a pitch are rounded: 3 x 0.1 is not 0.3.
    fractions = steps - np.rint(steps)
    # Offset in lattice vectors that is none.
    offset = np.where(abs(fractions) < 1e-9, 0.0, fractions) @ basis
    if angle == regular.mla_rotation and not np.rint(steps).any():
        return regular
    return regular.replace(mla_rotation=angle, mla_offset=tuple(offset.tolist()))


def _regular(camera: PlenopticCamera) -> PlenopticCamera:
    """Return the `straightened` camera, its lenses numbered as those of the camera are."""
    even = camera.replace(**_EVEN) if is_uneven(camera) else camera
    if camera.lattice.displacement is None and not any(camera.mla_tilt):
        return even
    regular = even.regular
    return regular.replace(mla_tilt=(0.0, 0.0), mla_warp=(), mla_jitter=(0.0, camera.mla_jitter[1]))


def straightened_image(image: Floats, camera: PlenopticCamera) -> Floats:
    """Return a capture (rows, columns, channels) by a camera as its `straightened` camera records it."""
    regular = straightened(camera)
    if regular is camera:
        return image
    if is_uneven(camera):
        image = image * evening(camera)[0][..., None]
    return _moved(image, camera)


def _moved(image: Floats, camera: PlenopticCamera) -> Floats:
    """Return an image (rows, columns, channels) with each micro-image where the `straightened` camera has it."""
    if camera.lattice.displacement is None and not any(camera.mla_tilt):
        return image
    regular = _regular(camera)
    moved = np.empty_like(image)
    channels = np.moveaxis(image.astype(np.float64), -1, 0)
    splines = [spline_filter(channel, _ORDER) for channel in channels]
    for rows, x, y in _seen(camera, regular):
        for channel, spline in enumerate(splines):
            moved[rows, :, channel] = map_coordinates(spline, (y, x), order=_ORDER, mode="nearest", prefilter=False)
        row, column = np.indices(x.shape)
        # Pixels by which micro-images may be displaced that stay as they are.
        still = np.maximum(abs(x - column), abs(y - row - rows.start)) < 0.01
        moved[rows][still] = image[rows][still]
    # Splines overshoot at the edges of micro-images, which keep their light.
    least = image.min()
    clipped = moved.clip(least, None)
    if least < 0:
        return clipped
    size = 2 * round(camera.micro_image_pitch / camera.pixel_size / 2) + 1  # odd: even windows lie to one side
    light, more = (uniform_filter(picture, size, mode="nearest", axes=(0, 1)) for picture in (moved, clipped))
    return clipped * np.divide(light, more, out=np.ones_like(more), where=more > 0).clip(0.5, 1)


@once_a_camera
def evening(camera: PlenopticCamera) -> tuple[Floats, Floats]:
    """Return factors of pixels that make white captures of a camera those of the even one, and the light they restore.

    The light, over that of the even camera, is 1 but where vignetting leaves hardly any.
    """
    white = white_image(camera)
    even = white_image(camera.replace(**_EVEN))
    # Light of a pixel in the white image, over that of the even camera, below which the pixel is not brightened.
    lit = (white > 0) & (white > 0.25 * even)
    missing = ~lit & (even > 0)
    return (
        np.where(lit, even / np.where(lit, white, 1), 1).astype(np.float32),
        np.where(missing, white / np.where(missing, even, 1), 1).astype(np.float32),
    )


def passed_light(camera: PlenopticCamera) -> Floats | None:
    """Return the part of a white scene's light that pixels of a `straightened_image` hold; None if they hold all."""
    if straightened(camera) is camera or not is_uneven(camera) or (passed := evening(camera)[1]).min() == 1:
        return None
    return _moved(passed[..., None], camera)[..., 0]


def _seen(camera: PlenopticCamera, regular: PlenopticCamera) -> Iterator[tuple[slice, Any, Any]]:
    """Yield rows of the regular camera's pixels, with the columns and rows, in fractions, that the camera has there."""
    growth = camera.image_growth
    # Pixels that are looked up together.
    for rows, *positions in pixel_rows(camera, 2**20):
        p = np.meshgrid(*positions)
        cells = regular.lattice.cell(*(q / growth for q in p))
        lens = camera.lenslet(*cells)
        nearer, larger = camera.tilted_growth(lens.height)
        places = [
            (c / nearer - larger * before) * growth + larger * q
            for q, c, before in zip(p, lens.centre, regular.lattice.centre(*cells), strict=True)
        ]
        x, y = (
            coordinate / camera.pixel_size + camera.resolution[axis] / 2 - 0.5 - camera.crop_offset[axis]
            for axis, coordinate in enumerate(places)
        )
        yield rows, x, y


def regular_place(camera: PlenopticCamera, x: Any, y: Any) -> Pair:
    """Return where the `straightened` camera has what a camera's detector has at a place, in mm from the axis."""
    growth = camera.image_growth
    cells = camera.lattice.cell(x / growth, y / growth)
    lens = camera.lenslet(*cells)
    nearer, larger = camera.tilted_growth(lens.height)
    regular = _regular(camera).lattice.centre(*cells)
    u, v = (
        (q - (c / nearer - larger * before) * growth) / larger
        for q, c, before in zip((x, y), lens.centre, regular, strict=True)
    )
    return u, v


def displaced_image(image: Floats, camera: PlenopticCamera, oversample: int) -> Floats:
    """Return a refocused image (rows, columns, channels) with its bins displaced like the camera's lenses."""
    if straightened(camera) is camera or not camera.chief_warp:
        return image
    moved, rows, columns = Displacement(camera.chief_warp), *image.shape[:2]
    pitch = camera.row_pitch / oversample
    half = np.array([columns, rows]) * pitch / 2
    # Displacement of lenses over the pitch up to which images stay as they are.
    if moved.most_smooth(-half, half)[0] <= 0.1 * camera.row_pitch:
        return image
    x, y = np.meshgrid(*((np.arange(size) - (size - 1) / 2) * pitch for size in (columns, rows)))
    x, y = (
        coordinate / pitch + (size - 1) / 2
        for coordinate, size in zip(moved.regular(x, y), (columns, rows), strict=True)
    )
    channels = [map_coordinates(channel, (y, x), order=1, mode="nearest") for channel in np.moveaxis(image, -1, 0)]
    return np.stack(channels, axis=-1)
