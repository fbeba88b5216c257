"""White images: computed by rays, as the open fraction of the pupil; recorded ones checked and scaled.

`white_image` computes the white capture of a camera by rays; `recorded_white` prepares a recorded one to replace it.
`mitsuba_plenoptic.refocus.radiance.white_sums` makes the divisor of a reconstruction method from it, and
`mitsuba_plenoptic.design.white_mean` is a closed form for design sheets.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import numpy as np

from ..camera import Aperture, Opening, PlenopticCamera, Round, Use, are_alike, require_camera, require_support
from ..design import crosstalk_neighbours, lens_directions, objective_of
from ..detector import DetectorOperator
from ..errors import InputError, refuse_if, short_repr, warn
from ..fields import has_response
from ..io import Capture, recording_of, require_demosaiced
from ..optics import second_leg
from ..rays import STAR, Passage, Walk, deflects_cosines, detector_rows, even_steps, lens_cells, light_of_cells
from ..runtime import Array, Floats, Sizes, array_module, as_pixels, fft, require_memory
from .grid import LensGrid, lens_indices, lens_numbers, lens_types, lenses_of_pixels, micro_image_centres

# Samples that see less of the pupil than this, or whose lens is darker, are left out: dividing by so little would only
# raise their noise.
MINIMUM_WEIGHT = 0.1

# Samples of a table of the pupil along a side, at most.
_WIDEST = 4096


class PupilFraction:
    r"""Fraction of the light from an endless pupil that each pixel receives through the camera's pupil.

    Seen through a point m of its lens, a pixel covers a square of the pupil plane of side :math:`\Delta p\, b/z`; its
    position moves with m by :math:`1 + b/z - b/f_2` times as much. The fraction of the square that
    the pupil's disc covers is averaged over the lens's aperture: what the pixel reads of a scene of uniform radiance 1.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        # Which of its types of lenses, if there are several.
        lens_type: int = 0,
    ):
        smear = abs(camera.pupil_shift(camera.mla_focal_lengths[lens_type]))
        reach = camera.aperture_radius + smear * camera.lattice.aperture_reach + camera.pupil_step
        pixels = 2 * reach / camera.pupil_step
        samples = max(1, min(16, int(_WIDEST / pixels)))
        require_memory(
            100.0 * (samples * pixels) ** 2,
            f"white image of a lens, {2 * camera.aperture_radius / camera.pupil_step:.3g} pixels wide, smeared over "
            f"{2 * smear * camera.lattice.aperture_reach / camera.pupil_step:.3g}",
        )
        self._step = camera.pupil_step / samples
        lens = camera.lattice.aperture_image(self._step, smear)
        half = math.ceil(camera.aperture_radius / self._step + samples) + lens.shape[0] // 2
        axis = np.arange(-half, half + 1) / samples
        radius = camera.aperture_radius / camera.pupil_step
        if camera.aperture == Round():
            pupil = _square_in_disc(axis, axis[:, None], radius)
        else:
            pupil = _square_in_aperture(half, samples, camera.aperture, radius)
        fraction = fft.blur(pupil, lens)
        # The rounding of the transform is not light.
        self._table = np.where(fraction > 1e-6, fraction, 0).clip(max=pupil.max()).astype(np.float32)
        self._half = half
        self.reach = half * self._step

    def __call__(self, x: Array, y: Array) -> Array:
        """Return the fraction for pixels that see (-x, -y) of the pupil plane through their lens's centre."""
        x, y = (np.asarray(axis) / self._step + self._half for axis in (x, y))
        last = 2 * self._half - 1
        column, row = (np.floor(axis).clip(0, last).astype(np.int32) for axis in (x, y))
        fx, fy = ((axis - base).clip(0, 1).astype(np.float32) for axis, base in ((x, column), (y, row)))
        table = self._table.ravel()
        size = self._table.shape[1]
        index = row * size + column
        low = table[index] * (1 - fx) + table[index + 1] * fx
        return low * (1 - fy) + (table[index + size] * (1 - fx) + table[index + size + 1] * fx) * fy


def _square_in_aperture(half: int, samples: int, aperture: Opening, radius: float) -> Array:
    """Return the mean power over the pixel around each step (-x, -y) of `_table`, for a pupil of a radius in pixels."""
    finer = 2 * max(1, min(8, _WIDEST // (2 * half + samples)) // 2)
    position = ((np.arange((2 * half + samples) * finer) + 0.5) / finer - half) / samples - 0.5
    means = aperture.power(*np.broadcast_arrays(-position / radius, -position[:, None] / radius))
    for axis in (0, 1):
        upto = np.insert(np.cumsum(means, axis), 0, 0, axis)
        first = np.arange(2 * half + 1) * finer
        means = (upto.take(first + samples * finer, axis) - upto.take(first, axis)) / (samples * finer)
    return means


def _square_in_disc(x: Array, y: Array, radius: float) -> Array:
    """Return the fraction of a unit square centred at (x, y) within a disc of this radius about the origin."""
    x, y = np.broadcast_arrays(x, y)
    distance = np.hypot(x, y)
    fraction = (distance < radius).astype(np.float64)
    edge = np.abs(distance - radius) < math.sqrt(0.5)
    right, left, above, below = ((c[edge] + side) / radius for c in (x, y) for side in (0.5, -0.5))
    area = _disc_below(right, above) - _disc_below(left, above) - _disc_below(right, below) + _disc_below(left, below)
    fraction[edge] = radius**2 * area.clip(0)
    return fraction


def _disc_below(x: Array, y: Array) -> Array:
    """Return the area of the unit disc's points whose coordinates are less than x and y."""
    x, y = x.clip(-1, 1), y.clip(-1, 1)
    half = np.sqrt(1 - y * y)
    middle = x.clip(-half, half)
    within = _half_disc(middle) - _half_disc(-half)
    return within + y * (middle + half) + np.where(y > 0, 2 * (_half_disc(x) - within), 0)


def _half_disc(x: Array) -> Array:
    """Return the area of the upper half of the unit disc up to x."""
    return (x * np.sqrt(1 - x * x) + np.arcsin(x)) / 2 + np.pi / 4


# Micro-images drawn at once.
_BLOCK = 128

# Light of a lens over that of the brightest: below three stops, more than main lenses vignette by, a white is refused.
_DARKEST = 1 / 8
_DIM = 1 / 2

_MOST = 4
"""Cells along a side of a pixel or a lens at most."""

_log = logging.getLogger(__name__)


def white_image(camera: PlenopticCamera, grid: LensGrid | None = None) -> Array:
    """Return the capture of a scene of uniform radiance 1, computed by rays.

    Behind a thin main lens the value of a pixel is its `PupilFraction`; where micro-images overlap, their light adds.
    Distortion changes nothing, as rays keep their position on the pupil. Behind a real main lens, vignetting, a tilted
    array or one that follows chief rays, with lenses that turn cosines or have figure errors, in a medium where light
    is oblique, and where pixels record oblique light otherwise, rays are traced from the pixels. Values are right
    to 0.2 %, with a picture in the aperture to 1.5 %; figure errors are left out above a million pixels. The detector
    records them as `DetectorOperator` states.

    In the Fourier arrangement it is the light of each pixel's own lens, of the part of it that the stop's image lights,
    within the field stop: without one, even light of other lenses would lie over it.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    grid : LensGrid, optional
        Micro-image centres. Default: the camera's, displaced by its tilt, including centres beyond the image whose
        micro-images reach into it. With vignetting, tilt, or pixels that record oblique light otherwise, the camera's
        are taken in any case, as what differs over the field depends on them.

    Returns
    -------
    (rows, columns) float32 array

    Raises
    ------
    InputError
        If the array is in the image of a telescope's pupil, or micro-images are so wide or so far out of focus that it
        would take an hour, or too much memory.
    """
    require_camera(camera)
    refuse_if(grid is not None and not isinstance(grid, LensGrid), f"grid = {short_repr(grid)}: it must be a LensGrid")
    require_support(camera, Use.WHITE_IMAGES)
    if camera.lens_data.images_stop:
        return np.asarray(DetectorOperator.of(camera).forward(_of_own_lenses(camera)))
    if camera.figure_error and math.prod(camera.shape) > 2**20:
        # It would take many minutes.
        warn("mla_figure_error: white images of more than a million pixels leave it out")
        camera = camera.replace(mla_figure_error=(0.0, 0.0))
    uneven = camera.vignetting is not None or camera.pixel_response or camera.mla_absorption or any(camera.mla_tilt)
    traced = not camera.lens_data.is_thin or deflects_cosines(camera) or camera.figure_error is not None
    # By Snell's law a medium moves micro-images of oblique light from where a grid has them.
    slope = math.hypot(camera.detector_width, camera.detector_height) / 2 / camera.pupil_distance
    moved = camera.reduced_distance * (1 - camera.mla_medium**-2) * slope**3 / 2
    # 0.02: Pixels that are not noticed.
    traced = traced or moved > 0.02 * camera.pixel_size or bool(camera.mla_cra)
    if uneven or (grid is None and traced):
        # What differs over the field depends on where the camera has its lenses.
        return DetectorOperator.of(camera).forward(_traced(camera))
    require_support(camera, Use.LENS_CENTRES)
    camera = camera.regular
    tables = [PupilFraction(camera, lens_type) for lens_type in range(len(camera.mla_focal_lengths))]
    half = math.ceil(max(table.reach for table in tables) / camera.pupil_step)
    rows, columns = camera.shape
    require_memory(
        4.0 * (rows + 2 * half) * (columns + 2 * half) + 100.0 * _BLOCK * (2 * half + 1) ** 2,
        f"white image of {columns} x {rows} pixels, {2 * half + 1} x {2 * half + 1} for each lens",
    )
    if grid is None:
        centres = micro_image_centres(camera, half)
    else:
        centres = grid.centres().reshape(-1, 2)
        # Those whose micro-image reaches the detector.
        centres = centres[((centres > -half) & (centres < [columns + half, rows + half])).all(1)]
    work = float(len(centres)) * (2 * half + 1) ** 2
    # So many pixels of micro-images take an hour.
    refuse_if(
        not work <= 3e10,
        f"camera: its white image takes {work:.2g} evaluations, at most 3e+10 are made: the images of "
        f"{len(centres)} lenses are up to {2 * half + 1} pixels wide",
    )
    image = np.zeros((rows + 2 * half, columns + 2 * half), dtype=np.float32)
    window = np.arange(-half, half + 1)
    step = camera.pixel_size * camera.mla_distance / camera.reduced_distance
    for row in np.array_split(centres, -(-len(centres) // _BLOCK) or 1):
        base = np.floor(row).astype(np.int64)
        # Positions on the pupil that each pixel sees through its lens's centre, except for their sign.
        x, y = ((base[:, axis, None] + window + 0.5 - row[:, axis, None]) * step for axis in (0, 1))
        fraction = np.zeros((len(row), len(window), len(window)), np.float32)
        for lens_type, table in enumerate(tables):
            alike = lens_types(camera, row) == lens_type
            fraction[alike] = table(x[alike, None, :], y[alike, :, None])
        fraction *= np.reshape(camera.lenslet(*lens_indices(camera, row)).gain, (-1, 1, 1))
        down = base[:, 1, None, None] + window[:, None] + half
        across = base[:, 0, None, None] + window + half
        keep = (down >= 0) & (down < image.shape[0]) & (across >= 0) & (across < image.shape[1])
        keep &= fraction > 0
        index = (down * image.shape[1] + across)[keep]
        first = index.min(initial=image.size)
        added = np.bincount(index - first, weights=fraction[keep])
        image.reshape(-1)[first : first + added.size] += added
    return DetectorOperator.of(camera).forward(image[half : half + rows, half : half + columns])


def _of_own_lenses(camera: PlenopticCamera) -> Floats:
    """Return the white image in the Fourier arrangement of light that passed the lenses above the pixels."""
    objective = objective_of(camera)
    lenses = lens_directions(camera)
    lens_number = lenses.at(*lenses_of_pixels(camera))
    lens = camera.lenslet(*lenses.index.T.astype(np.float64))
    image = np.where(lens_number < 0, 0, (lenses.lit * lens.gain)[lens_number])
    pixels = np.meshgrid(*(camera.pixel_coordinates(axis) for axis in (0, 1)))
    if has_response(camera):
        counts = second_leg(camera.pixel_response or (), camera.mla_absorption or 0.0, np.ndarray)
        aside = [q - c[lens_number] for q, c in zip(pixels, np.stack(lens.centre), strict=True)]
        image *= np.mean(
            [
                counts(np.hypot(aside[0] - x, aside[1] - y), camera.detector_distance)
                for x, y in camera.lattice.aperture_grid(8).T
            ],
            axis=0,
        )
    if (stop := objective.field_stop) is None:
        return image.astype(np.float32)
    # The stop's image in pixels, which lenses out of focus blur.
    radius = stop * camera.reduced_distance / objective.last_focal_length / camera.pixel_size
    blur = np.broadcast_to(1 - camera.reduced_distance / lens.focal_length, len(lenses.lit)) / camera.pixel_size
    count = min(8, math.ceil(1 + 2 * float(np.abs(blur).max() * camera.lattice.aperture_width)))
    points = camera.lattice.aperture_grid(count).T
    x, y = ((q - c[lens_number]) / camera.pixel_size for q, c in zip(pixels, lenses.middle.T, strict=True))
    seen = np.zeros(camera.shape)
    for point in points:
        dx, dy = (q - blur[lens_number] * aside for q, aside in zip((x, y), point, strict=True))
        if objective.field_stop_shape == "square":
            seen += np.prod([(radius + 0.5 - abs(q)).clip(0, 1) for q in (dx, dy)], axis=0)
        else:
            seen += _square_in_disc(dx, dy, radius)
    return (image * seen / len(points)).astype(np.float32)


def recorded_white(
    white: Capture | Array, shape: Sizes, cameras: Sequence[PlenopticCamera], computed: Array | None = None
) -> Array:
    """Return a recorded white image, (rows, columns, channels), in units of its radiance if the computed one is given.

    The radiance of a channel is the median of recorded over computed light among the quarter of the lenses that is
    nearest to the axis, where main lenses hardly vignette. Within 5 % of 1 it counts as 1: wave captures may lose as
    much between microlenses with gaps.

    Each lens is judged by its light, the sum over the pixels whose chief rays pass it, over the computed light.

    Parameters
    ----------
    white : Capture or array
        The recorded image.
    shape : (rows, columns[, channels])
        Shape of the capture to be divided; the image has one channel, or as many.
    cameras : sequence of PlenopticCamera
        Allowed cameras of a white `Capture`, apart from `lens_model`; the first one scales the image.
    computed : (rows, columns) array, optional
        Computed white image of the capture's camera. Default: the image is not scaled, as without a camera, or before
        views are sampled.

    Raises
    ------
    InputError
        If the image is a mosaic of colours, has many saturated pixels, is by another camera or of another shape, or
        does not fill the view.
    """
    recorded = white.image if isinstance(white, Capture) else as_pixels("white", white)
    if isinstance(white, Capture):
        require_demosaiced(white)
        saturated = recording_of(white).get("saturated_pixels", 0)
        pixels = math.prod(white.camera.shape)
        refuse_if(
            isinstance(saturated, (int, float)) and saturated > 0.01 * pixels,
            f"white: {saturated} of its {pixels} pixels are saturated: they must be at most 1%",
        )
        if cameras and not any(are_alike(white.camera, camera) for camera in cameras):
            theirs = white.camera.to_dict()
            ours = cameras[-1].to_dict()
            parameters = (name for name in {**ours, **theirs} if name != "lens_model")
            name = next(name for name in parameters if theirs.get(name) != ours.get(name))
            raise InputError(
                f"white: its camera has {name} = {short_repr(theirs.get(name))}, that of the capture "
                f"{short_repr(ours.get(name))}: it must be by the camera of the capture"
            )
    if recorded.shape not in (shape[:2], (*shape[:2], 1), shape):
        raise InputError(f"white of shape {recorded.shape}: it must have the pixels of the capture, {shape[:2]}")
    image = np.atleast_3d(recorded)
    if computed is None:
        return image
    x, y = (cameras[0].pixel_coordinates(axis) for axis in (0, 1))
    numbers, away, model = (values.ravel() for values in (lens_numbers(cameras[0]), np.hypot(x, y[:, None]), computed))
    radius = np.bincount(numbers, away) / np.maximum(np.bincount(numbers), 1)
    light = np.stack([np.bincount(numbers, channel.ravel()) for channel in np.moveaxis(image, -1, 0)], axis=-1)
    expected = np.bincount(numbers, model)
    # Lenses with less than this fraction of the computed light of the fullest are cut by the border too much to be
    # judged.
    judged = (expected > 0) & (expected >= 0.2 * expected.max(initial=0))
    ratio = light[judged] / expected[judged, None]
    brightest = ratio.max(axis=0, initial=0)
    refuse_if(not (brightest > 0).all(), "white: it is dark: it must be a capture of something evenly white")
    least = (ratio / brightest).min(axis=1)
    limit = _DARKEST if least.min() < _DARKEST else _DIM
    # Where a lens's light lies: of white the common part of both images is nearly all.
    light_ratio = light.sum(axis=1) / np.maximum(expected, np.finfo(np.float32).tiny)
    scaled = image.sum(axis=-1).ravel() / np.where(light_ratio > 0, light_ratio, np.inf)[numbers]
    common = float(np.minimum(scaled, model).clip(0).sum() / model.sum())
    # Light that lies within micro-images as computed; waves leave 0.4 in those narrower than the microlens's own blur.
    for fraction, required, text in (
        (
            least.min(),
            _DARKEST,
            f"{np.count_nonzero(least < limit)} of {len(least)} lenses have less than {limit:g} of the light of the "
            "brightest: it must fill the view",
        ),
        (
            common,
            1 / 4,
            f"{common:.0%} of its light is distributed over the micro-images as the camera distributes it: it must be "
            "by this camera and fill the view of the whole pupil",
        ),
    ):
        refuse_if(fraction < required, f"white: {text}")
        if fraction < _DIM:
            warn(f"white: {text}")
    near = radius[judged] <= np.quantile(radius[judged], 0.25)
    radiance = np.median(ratio[near], axis=0)
    scaled_channels = np.abs(radiance - 1) > 0.05
    if scaled_channels.any():
        _log.info("white: its radiance is %s: it is scaled to 1", ", ".join(f"{value:.3g}" for value in radiance))
    return np.asarray(image / np.where(scaled_channels, radiance, 1), np.float32)


def clear(camera: PlenopticCamera) -> PlenopticCamera:
    """Return a camera whose openings let all light through, without stray light: its white is what pixels see of them.

    The white of the camera itself also tells how bright lenses are.
    """
    picture = camera.aperture_image
    vignetting = camera.vignetting
    return camera.replace(
        mla_transmissions=None,
        pupil_apodisation=(0.0, 0.0),
        aperture_image=picture and Aperture(picture.transmission > 0),
        vignetting=vignetting
        and replace(vignetting, slope_x=0.0, slope_y=0.0, apodisation_2=0.0, apodisation_4=0.0, transmission=()),
        stray_light=0.0,
        stray_width=None,
        pixel_response=(),
        **{"mla_absorption": 0.0} if camera.mla_absorption else {},
    )


def open_fraction(white: Floats, alone: Array | None = None) -> Floats:
    """Return the fraction of the pupil that samples see by a recorded white, both (rows, columns, v, u).

    A sample that is not of one lens `alone` sees none of it; without that mask, one beyond the ellipse of the views.

    Of each lens, what its fully open samples read is a plane over the micro-image, as brightness falls off within it,
    too. The fraction is the white over this plane, at most 1.
    """
    # Over the micro-image from -1 to 1.
    down, across = (np.linspace(-1, 1, views) if views > 1 else np.zeros(1) for views in white.shape[2:])
    terms = np.stack(np.broadcast_arrays(1.0, across, down[:, None]), axis=-1).astype(np.float32)
    if alone is None:
        alone = np.hypot(across, down[:, None]) <= 1
    terms = terms[alone]
    samples = white[:, :, alone]
    fit = np.zeros((*white.shape[:2], 3), np.float32)
    # Noise of a few samples must not count as the level.
    fit[..., 0] = np.quantile(samples, 0.95, axis=2)
    for _ in range(3):
        # What sees part of the pupil takes no part.
        # 0.9: Fraction of the pupil from which samples count as fully open.
        full = samples >= 0.9 * (fit @ terms.T)
        moments = np.einsum("rcn,ni,nj->rcij", full, terms, terms, optimize=True)
        # Few samples, or samples in a line, have no slope.
        moments[..., (0, 1, 2), (0, 1, 2)] += (1e-6, 0.1, 0.1)
        sums = np.einsum("rcn,ni->rci", full * samples, terms, optimize=True)
        fit = np.linalg.solve(moments, sums[..., None])[..., 0]
    plane = fit @ terms.T
    fraction = np.zeros_like(white)
    fraction[:, :, alone] = np.divide(samples, plane, out=np.zeros_like(samples), where=plane > 0).clip(0, 1)
    return fraction


def divide_by_white(light: Floats, white: Floats, weight: Floats, alone: Array | bool = True) -> None:
    """Divide samples in place by their white; all three are set to 0 where a sample is not of one lens `alone`.

    So they are where samples see too little of the pupil, or their lens is too dark.
    """
    dark = (weight < MINIMUM_WEIGHT) | (white < MINIMUM_WEIGHT * weight) | np.logical_not(alone)
    np.divide(light, white[..., None], out=light, where=~dark[..., None])
    for samples in (light, white, weight):
        samples[dark] = 0


def _traced(camera: PlenopticCamera) -> Floats:
    """Return the white image of a camera by rays from its pixels.

    The rays between a pixel and a lens are the points of a cube of four dimensions, which is divided into cells.
    """
    types = array_module()
    walk = Walk.of(camera)
    image = np.empty(camera.shape, np.float32)
    response = second_leg(camera.pixel_response, camera.mla_absorption or 0.0, types.Float)
    smear = max(abs(camera.pupil_shift(f2)) for f2 in camera.mla_focal_lengths)
    # 4: Standard deviations of the slopes of figure errors that are followed.
    size, length = camera.mla_figure_error if camera.figure_error else (0.0, 1.0)
    turn = 4 * size / length
    reach = walk.lens.reach + smear * camera.lattice.aperture_reach + camera.pupil_step + camera.pupil_distance * turn
    # Pixels lie behind the lenses of all their points.
    neighbours = crosstalk_neighbours(camera, camera.pixel_size + camera.detector_distance * turn).tolist()
    counts = _cells(walk, smear)
    cells = math.prod(counts)
    for rows, px, py in detector_rows(camera, cells):
        columns = [types.Float(value) for value in (px, py, *walk.chief_cell((px, py))[1])]
        total = dr.zeros(types.Float, dr.width(px))
        for across, down in neighbours:
            # Opaque, so that all neighbours share one kernel.
            steps = [dr.opaque(types.Float, float(step)) for step in (across, down)]
            lens = walk.lenslet(columns[2] + steps[0], columns[3] + steps[1])
            slope, _, _ = walk.out_of_array((columns[0], columns[1]), Passage(lens.centre, lens))
            middle = (walk.lens.pupil.point(c, t, lens.height) for c, t in zip(lens.centre, slope, strict=True))
            lit = dr.compress(dr.hypot(*middle) < reach)
            lane = dr.arange(types.UInt32, cells * dr.width(lit))
            if not dr.width(lane):
                continue
            pixel = dr.gather(types.UInt32, lit, lane // cells)
            x, y, i, j = (dr.gather(types.Float, column, pixel) for column in columns)
            lens = walk.lenslet(i + steps[0], j + steps[1])
            number = types.Float(lane % cells)
            place = []
            for count in counts:
                place.append(types.Float(lane % count) + 0.5)
                lane //= count
            rays = []
            offsets = [*STAR]
            if camera.aperture_image is not None:
                # Light that changes in steps is that of one ray of each cell.
                offsets.append([number * step - dr.floor(number * step) - 0.5 for step in even_steps(4).tolist()])
            for offset in offsets:
                s, t, u, v = ((at + off) / count for at, off, count in zip(place, offset, counts, strict=True))
                position = x + (s - 0.5) * camera.pixel_size, y + (t - 0.5) * camera.pixel_size
                dx, dy = camera.lattice.aperture_point(u, v)
                passage = Passage((lens.centre[0] + dx, lens.centre[1] + dy), lens)
                inside, power = walk.outline(position, passage)
                if camera.pixel_response or camera.mla_absorption:
                    aside = dr.hypot(passage.point[0] - position[0], passage.point[1] - position[1])
                    power *= response(aside, camera.detector_distance + lens.height)
                rays.append((inside, types.Float(power)))
            dr.scatter_add(total, dr.block_sum(types.Float(light_of_cells(rays)), cells) / cells, lit)
        image[rows] = total.numpy().reshape(-1, camera.crop_size[0])
    return image


def _cells(walk: Walk, smear: float) -> tuple[int, int, int, int]:
    """Return into how many cells pixels (x, y) and lenses (along both sides of `aperture_point`) are divided."""
    camera = walk.camera
    lattice = walk.lattice
    radius = float(walk.lens.pupil.radius)
    steps = camera.aperture_image is not None
    # Edges have corners between blades.
    fine = 16 if camera.aperture_blades else 8
    pixel = _MOST if steps else min(_MOST, math.ceil(fine * camera.pupil_step / radius))
    # The response of pixels has a tip where light is upright.
    wide = _MOST if steps else max(3 if camera.pixel_response else 0, 4 * smear * lattice.aperture_width / radius)
    wide = min(_MOST, wide)
    if camera.figure_error:
        wide = min(8.0, max(wide, 3 * lattice.aperture_width / camera.mla_figure_error[1]))
    return pixel, pixel, *lens_cells(lattice, wide)
