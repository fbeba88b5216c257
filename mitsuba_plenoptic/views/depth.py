"""Depth from a light field, by the agreement of its views."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
import xarray as xr

from ..camera import PlenopticCamera, are_alike
from ..design import focus_types
from ..errors import LONGEST, InputError, require_count, require_number, suggest_keywords
from ..fields import OpticalSystem
from ..runtime import Array, Progress, counted, require_memory
from .agreement import ViewComparison, finer_stripes, spread_of_samples
from .coordinates import (
    array_scale,
    camera_of,
    disparity,
    distance_of,
    has_lens,
    require_light_field,
    stated_disparities,
    view_places,
    view_steps,
)
from .lens_agreement import LensComparison, light_of_lens
from .lens_images import MicroImages, micro_images_of
from .plane_choice import LENSES, VIEWS, Disagreement, choose, disagreement
from .refocusing import shift_and_add
from .repetition import wrong_by_repetition
from .viewpoints import view

RIGHT = 0.01
"""Relative error of a depth that counts as right."""

# Without a camera: disparities from this one fall like inverse distances, and the error of one that counts as right.
_ORIGIN = 1e3
_RIGHT_SHIFT = 0.05

# Pixels per view up to which depth is sought by default: views, that then show blur as wide, still show coarse texture.
_WIDEST = 2.0

# Pixels per view beyond the disparities that a light field states: a plane is found between others that agree less.
_BESIDE = 0.5

# Deviation of errors of focused cameras whatever the noise, over the virtual depth: of cards without noise their root
# mean square is 0.1 % with an image 5 detector distances before the array, 0.4 to 0.5 % with one 10 before or 5 to
# 12 behind it, and 0.9 % at 15.
_OFF = 0.005

# Planes for each pixel per view, and for each pixel that micro-images of neighbouring lenses are moved.
_PER_LENS = 32
_PER_PIXEL = 4


@suggest_keywords
def depth_map(
    lf: xr.DataArray,
    near: float | None = None,
    far: float | None = None,
    *,
    micro_images: MicroImages | None = None,
    planes: int | None = None,
    progress: Progress | None = None,
) -> xr.Dataset:
    r"""Return the depth of every bin of the central view, with a confidence.

    For planes spaced in disparity the unexplained fraction of the variance of views is measured: for an unfocused
    camera by `agreement.ViewComparison`, for the micro-images of a focused one by `lens_agreement.LensComparison`.
    `plane_choice` turns the fractions of each bin and its neighbours into probabilities, takes the most probable plane,
    refined by a parabola, and tests whether it explains more than it would for pure noise, and how many neighbours
    agree.

    The confidence is an estimate of the probability that a depth is within 1 % of the true one. Where it is less than
    1/2 the depth is unknown, NaN: without texture, in noise, where views agree at several distances about as well, and
    where stripes may be finer than two lenses or, for a focused camera, have a period of less than five pixels within
    micro-images. It is also unknown where most neighbours are at other distances. The confidence is 0 where views agree
    best at an end of the search, or within 1 % of it: the point is then probably at least that near, or that far. Near
    the plane in focus on a focused camera's array, neighbouring lenses see nothing in common; depths there are unknown
    for the same reason. The confidence of focused cameras can be off by more than 0.1 in noise, for coarse or weak
    texture, and for images eight and more detector distances from the array.

    Parameters
    ----------
    lf : xarray.DataArray
        A light field. Without a camera its disparities are found; then, and of a Fourier microscope, the confidence is
        that of a disparity with an error below 0.05.
    near, far : float
        Range of distances in millimetres to search; without a camera of disparities, the nearest the least. Default:
        the range that a light field's file states, as folders of HCI do, and half a pixel more; else where a point
        moves by at most two pixels from view to view, of a focused camera by one.
    micro_images : MicroImages, optional
        The micro-images of the same capture, from `micro_images`. A focused camera whose lenses are not upright and
        square needs them, as its light field is interpolated between lenses; others do without.
    planes : int, optional
        Number of planes, at least 3. Default: 64, and more where they would be farther than 1/32 pixel per view apart,
        or micro-images of a focused camera would move by more than a quarter of a pixel between them. With fewer,
        depths are off by up to a seventh of the distance between planes.
    progress : callable, optional
        Called with the planes done and their number.

    Returns
    -------
    xarray.Dataset
        Over t, s: ``depth`` (distance from the main lens along the axis, or beyond an objective's native object plane,
        mm; NaN where it is unknown; absent without a camera), ``disparity`` (pixels per view along the index, negative
        nearer than the plane in focus, the best guess everywhere), ``confidence`` (0 to 1), and ``image``, the image in
        focus everywhere; and, where the light field has ground truth, ``truth``, the depth that the central view sees
        (mm), which `depth_error` compares with.

    Raises
    ------
    InputError
        If near is not before far, an argument is out of range, a focused camera resolves
        no depth between near and far, or its micro-images are needed and not given, or of another camera.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> capture, truth = mp.example("letters-ray"), mp.example_truth("letters-ray")
    >>> found = mp.views.depth_map(mp.decode(capture, truth=truth), 200, 300, planes=16)
    >>> mp.views.depth_error(found).median < 0.01  # of the distance
    True
    """
    lf = require_light_field(lf)
    nearest, farthest = _default_search(lf)
    has_camera = bool(lf.attrs.get("camera"))
    # Views that are moved farther have nothing in common with the central one.
    most = None if has_camera else 2 * max(lf.shape[2:4]) / max(1, max(lf.shape[:2]) - 1)
    unit_note = "" if has_camera else ", a disparity without a camera,"
    near = require_number(f"near{unit_note}", nearest if near is None else near, minimum=most and -most)
    far = require_number(f"far{unit_note}", farthest if far is None else far, finite=not has_camera, maximum=most)
    if not near < far:
        raise InputError(f"near = {near:g}, far = {far:g}: near must be less than far")
    if planes is not None:
        planes = require_count("planes", planes, minimum=3, maximum=1024)
    first, last = (disparity(lf, near), disparity(lf, far)) if has_camera else (near, far)
    slopes = _slopes(lf, first, last, planes)
    planes = len(slopes)
    bins = lf.sizes["t"] * lf.sizes["s"]
    channels = lf.sizes.get("c", 1)
    # Views are moved in copies, probabilities are taken in several of the cost that each plane leaves.
    samples = lf.size if micro_images is None else micro_images.values.size
    copies = (40.0 if is_focused(lf) else 6.0) * samples + 4.0 * bins * channels
    plane = 100.0 * bins
    require_memory(
        copies + plane * planes,
        f"depth map of {planes} planes",
        lambda limit: f"planes = {int((limit - copies) // plane)}" if limit > copies + 3 * plane else None,
    )
    choice = choose(
        *disagreement_of_planes(lf, slopes, progress, micro_images), RIGHT if has_lens(lf) else _RIGHT_SHIFT / _ORIGIN
    )
    disparities = np.interp(choice.plane, np.arange(planes), slopes)
    nearest_plane = np.rint(choice.plane).astype(np.int64)
    if is_focused(lf):
        disparities = _by_moves(slopes, nearest_plane, choice.plane - nearest_plane, disparities)
    sharp = np.empty(lf.shape[2:], dtype=np.float32)
    for index in np.unique(nearest_plane):
        here = nearest_plane == index
        sharp[here] = shift_and_add(lf, slopes[index]).values[here]
    # Several distances explain stripes alike, of which sampled ones agree best on a wrong plane.
    if is_focused(lf):
        ambiguous = choice.rival * wrong_by_repetition(micro_images or micro_images_of(lf), slopes)
    else:
        moved = np.abs(disparities) * view_places(lf)[0].max() > 1
        ambiguous = finer_stripes(sharp.reshape(*nearest_plane.shape, -1).mean(axis=2), moved)
    probability = choice.probability * (1 - ambiguous)
    dims = ("t", "s")
    maps = dict[str, Any]()
    if has_camera:
        if has_lens(lf):
            disparities = _straightened(lf, disparities)
        depth = np.where((probability < 0.5) | ~choice.agreed, np.nan, distance_of(lf, disparities))
        maps["depth"] = (dims, depth, {"units": "mm"})
    maps |= {
        "disparity": (dims, disparities, {"units": "pixels per view"}),
        "confidence": (dims, probability),
        "image": (("t", "s", "c")[: sharp.ndim], sharp),
    }
    if "depth" in lf.coords:
        maps["truth"] = (dims, lf.depth.sel(u=0.0, v=0.0, method="nearest").values, {"units": "mm"})
    return xr.Dataset(
        maps,
        coords={dim: lf[dim] for dim in ("t", "s", "c") if dim in lf.coords},
        attrs={**lf.attrs, "near": near, "far": far, "planes": planes},
    )


def _by_moves(slopes: Array, plane: Array, offset: Array, disparities: Array) -> Array:
    """Return disparities between planes of a focused camera, whose micro-images move by the inverse of the disparity.

    The offset is that of the least point of a parabola through three planes as if their moves were evenly spaced.
    """
    before, at, after = (slopes[np.clip(plane + step, 0, len(slopes) - 1)] for step in (-1, 0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        less, more = 1 / before - 1 / at, 1 / after - 1 / at
        falls, rises = (1 + 2 * offset) * more, (1 - 2 * offset) * less
        moved = (falls * more - rises * less) / (2 * (falls - rises))
        refined = at / (1 + at * moved)
    # At the ends of the search, and beside the plane without any moves, nothing is known of one side.
    return np.where(np.isfinite(refined) & (before * after > 0) & (before < at) & (at < after), refined, disparities)


def _off(lf: xr.DataArray, disparities: Array, narrowed: Array | float) -> Array:
    """Return the deviations of errors that depths of these disparities have whatever the noise, over the tolerance.

    Of an unfocused camera, shifts of less than a quarter of a lens at the pupil's rim are found up to a twentieth too
    small; over a whole lens, deviations cancel. By what part blur has `narrowed` the pupil is known to a quarter.
    """
    camera = camera_of(lf)
    steps = view_places(lf)[0].max()
    moved = np.abs(disparities) * steps
    if is_focused(lf):
        off = _OFF * moved
    else:
        off = np.hypot(0.05 * np.minimum(moved, 1 - moved).clip(1e-9, 0.25), narrowed / 4 * moved)
    # What moves as far as the tolerance, in lenses at the pupil's rim; infinity is right.
    right = RIGHT * camera.mla_distance / distance_of(lf, disparities) * camera.pupil_step / camera.row_pitch * steps
    return np.divide(off, right, out=np.zeros_like(off), where=right > 0)


def beyond_search(depth: xr.Dataset) -> tuple[float, float]:
    """Return the fractions of bins that probably see points nearer, and farther, than the range of a depth search.

    Their confidence is 0, and their views agree best within twice the tolerance of the nearest or the farthest plane.
    """
    unknown = depth.confidence.values == 0
    near, far = depth.attrs["near"], depth.attrs["far"]
    position = depth.disparity.values
    if has_lens(depth):
        near *= 1 + 2 * RIGHT
        far /= 1 + 2 * RIGHT
        position = distance_of(depth, position)
    else:
        near, far = (disparity(depth, end) if "depth" in depth else end for end in (near, far))
        near += 2 * _RIGHT_SHIFT
        far -= 2 * _RIGHT_SHIFT
    return float((unknown & (position < near)).mean()), float((unknown & (position > far)).mean())


def _straightened(lf: xr.DataArray, disparities: Array) -> Array:
    """Return the disparities of bins behind an upright array of lenses that pixels see evenly, from those observed.

    A lens at the height h sees the pupil point P of a place h P / b beside that of an upright array. Pixels that prefer
    some directions see the pupil point P through a point beside the middle of their lens, by `_preferred` of P.
    Aberrations move light from the pupil point P by `_aberrated` of P.
    """
    camera = camera_of(lf)
    x, y = np.meshgrid(*(lf[axis].values * array_scale(camera) for axis in "st"))
    height = camera.array_height(x, y)
    size = camera.pupil_step / camera.row_pitch
    slope = -disparities / size
    radius = np.hypot(x, y)
    radii = np.linspace(0, radius.max(), 9)
    # The comparison of micro-images knows what pixels prefer.
    if not is_focused(lf) and (camera.pixel_response or camera.mla_absorption):
        aside = np.interp(radius, radii, [_preferred(camera, distance) for distance in radii])
        slope = (slope + aside) / (1 + aside * np.mean([camera.pupil_shift(f2) for f2 in camera.mla_focal_lengths]))
    if camera.lens_model != "ideal" or camera.wavefront or camera.phase_screen is not None:
        slope -= np.interp(radius, radii, _aberrated(lf, radii))
    slope -= height / (camera.pupil_distance - height)
    if any(camera.distortion):
        # Lenses see as others without distortion, farther apart by the mean of the map's slopes along x and y, in the
        # middle of those that see a bin's point: near the field's edges they are on one side.
        move = np.abs(disparities) * view_steps(lf, "u").max() * camera.row_pitch
        x, y = ((np.maximum(at - move, at.min()) + np.minimum(at + move, at.max())) / 2 for at in (x, y))
        k1, k2, k3, p1, p2 = camera.distortion
        square = x * x + y * y
        slope *= 1 + square * (2 * k1 + square * (3 * k2 + square * 4 * k3)) + 4 * (p1 * x + p2 * y)
    return -slope * size


def _preferred(camera: PlenopticCamera, radius: float) -> float:
    """Return by how much a lens at a distance from the axis is seen beside its middle, over the pupil's coordinates.

    The ratio is fitted to what lies within the pupil for all of the lens.
    """
    f2 = camera.mla_focal_lengths[0]
    reach = camera.pupil_radius - abs(camera.pupil_shift(f2)) * camera.lattice.aperture_reach
    pupil = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, 24) * camera.pupil_radius]))
    pupil = pupil[:, np.hypot(*pupil) < max(reach, camera.pupil_radius / 2)]
    point, light, _ = light_of_lens(camera, f2, np.array([radius, 0.0]), *pupil)
    aside = point @ light.T / np.maximum(light.sum(axis=1), 1e-9)
    return float((aside * pupil).sum() / np.square(pupil).sum())


def _aberrated(lf: xr.DataArray, radii: Array) -> Array:
    """Return by how much aberrations move light at distances from the axis, over the pupil's coordinates.

    The ratios are fitted to the mean light of the views that are compared, from the plane in focus or from infinity.
    """
    camera = camera_of(lf)
    seen = np.median(lf["weight"].values, axis=(2, 3)) >= 0.9
    views = np.stack(np.meshgrid(lf.u.values, lf.v.values))[:, seen]
    if not views.any():
        # Of one view at most: none of its neighbours moves.
        return np.zeros_like(radii)
    spread = [math.sqrt(spread_of_samples(lf, axis)) * camera.pupil_step for axis in (0, 1)]
    pupil = views[..., None] + np.array(list(itertools.product(*([-side, side] for side in spread)))).T[:, None]
    lens = OpticalSystem.by_design(camera).lens
    distance = camera.focus_distance if 0 < camera.focus_distance < math.inf else LONGEST
    points = lens.points(np.column_stack([radii, 0 * radii]), np.full(len(radii), 1 / distance))
    landed = [np.broadcast_arrays(*lens.bind(points).land(tuple(pupil), tuple(point))) for point in points]
    moved = np.mean(landed, axis=-1) * views
    return moved.sum((1, 2)) / np.square(views).sum() - camera.defocus(distance)


def _default_search(lf: xr.DataArray) -> tuple[float, float]:
    """Return the nearest and farthest distance in mm, or disparity, at which views or micro-images can show depth.

    Views can while they move by up to `_WIDEST` pixels, or where the light field
    states the disparities of its scene; micro-images of focused cameras can while their lenses are no farther apart
    than the field that each shows.
    """
    if is_focused(lf):
        near, far = distance_of(lf, np.array([-1.0, 1.0]))
        return float(near), float(far)
    stated = stated_disparities(lf)
    least, greatest = (stated[0] - _BESIDE, stated[1] + _BESIDE) if stated else (-_WIDEST, _WIDEST)
    if not lf.attrs.get("camera"):
        return least, greatest
    near, far = distance_of(lf, np.array([least, greatest]))
    # Nothing nearer than the focal length has an image, and nothing lies within an objective.
    camera = camera_of(lf)
    nearest = 1.01 * camera.focal_length if has_lens(lf) else -0.99 * camera.focal_length
    return max(float(near), nearest), float(far)


def _slopes(lf: xr.DataArray, first: float, last: float, planes: int | None) -> Array:
    """Return the disparities of the search planes, from the first to the last.

    Views move evenly from plane to plane. Micro-images of focused cameras move by the inverse of the disparity, so that
    planes are denser for smaller disparities; planes at which neighbouring lenses have nothing in common are left out,
    except one in their middle.
    """
    if not is_focused(lf):
        return np.linspace(first, last, planes or max(64, math.ceil(_PER_LENS * (last - first)) + 1))
    # A lens's neighbour shows the same at least two views away from the last.
    smallest = 1 / max(1, max(lf.shape[:2]) - 2)
    dense = math.sqrt(_PER_PIXEL / _PER_LENS)

    def steps(slope: Array | float) -> Any:
        """Return the number of planes from a disparity `dense` on: the integral of the larger of both densities."""
        return np.where(
            slope < dense, _PER_PIXEL * (1 / dense - 1 / np.maximum(slope, 1e-9)), _PER_LENS * (slope - dense)
        )

    fine = np.linspace(smallest, max(abs(first), abs(last), smallest), 4096)
    sides = [
        (sign, *np.clip(ends, smallest, None))
        for sign, ends in ((-1, (max(0.0, -last), -first)), (1, (max(0.0, first), last)))
        if ends[1] > smallest
    ]
    if not sides:
        return np.linspace(first, last, planes or 3)
    counts = [float(steps(high) - steps(low)) for _, low, high in sides]
    hole = len(sides) == 2
    total = (planes or max(64, math.ceil(sum(counts)) + 1)) - hole
    slopes = [np.zeros(1)] if hole else []
    left = total
    for index, ((sign, low, high), count) in enumerate(zip(sides, counts, strict=True)):
        of_side = left if index == len(sides) - 1 else min(max(1, round(total * count / sum(counts))), total - 1)
        left -= of_side
        slopes.append(sign * np.interp(np.linspace(steps(low), steps(high), of_side), steps(fine), fine))
    return np.sort(np.concatenate(slopes))


def is_focused(lf: xr.DataArray) -> bool:
    """Return whether all microlenses of a light field's camera are focused on the image of the main lens."""
    return has_lens(lf) and "unfocused" not in focus_types(camera_of(lf))


def disagreement_of_planes(
    lf: xr.DataArray, slopes: Array, progress: Progress | None, micro_images: MicroImages | None
) -> tuple[Disagreement, float]:
    """Return the disagreement of views on planes of rising disparity, and the number of samples.

    `micro_images` must be those of a focused camera.
    """
    central = view(lf).values.reshape(*lf.shape[2:4], -1).mean(axis=2, dtype=np.float64)
    if is_focused(lf):
        images = micro_images_of(lf) if micro_images is None else micro_images
        if not are_alike(images.camera, camera_of(lf)) or images.bins.shape != lf.shape[2:4]:
            raise InputError("micro_images: they are of another camera than the light field, or of another part of it")
        lenses = LensComparison(images)
        measure: Callable[[float], Any] = lenses.disagreement
        samples = LENSES
    else:
        views = ViewComparison(lf)
        measure = views.disagreement
        samples = VIEWS
    brightness = scipy.ndimage.gaussian_filter(central, 2.0)
    measured = np.empty((5, len(slopes), *lf.shape[2:4]), dtype=np.float32)
    for index, slope in enumerate(counted(slopes, progress)):
        measured[:, index] = measure(float(slope))
    if is_focused(lf):
        lenses.compare_farther(measured, slopes)
    ratio, variance, counted_for, independent, noise = measured
    distances = distance_of(lf, slopes) if has_lens(lf) else 1 / (_ORIGIN - slopes)
    if np.isnan(ratio).all():
        raise InputError(
            f"near = {distances[0]:g}, far = {distances[-1]:g}: views have nothing in common there; of a focused "
            "camera, neighbouring lenses see no common part of what is near the plane in focus on the microlens array"
        )
    narrowed = 0.0 if is_focused(lf) else np.array([views.narrowed(float(slope)) for slope in slopes])
    off = _off(lf, slopes, narrowed)[:, None, None] if has_lens(lf) else 0.0
    if is_focused(lf):
        off = off * np.hypot(1, lenses.moved_by_errors() * np.abs(slopes[:, None, None]) / _OFF)
    return disagreement(ratio, variance, counted_for, independent, brightness, 1 / distances, noise, off), samples


@dataclass(frozen=True)
class DepthError:
    """Errors of estimated depths, as fractions of the true distance.

    Attributes
    ----------
    median, percentile_90 : float
        Errors of the bins with sufficient confidence; NaN if there is none.
    share : float
        Fraction of the bins with a finite true depth whose confidence is sufficient.
    """

    median: float
    percentile_90: float
    share: float


def depth_error(found: xr.Dataset, confidence: float = 0.5) -> DepthError:
    """Return the errors of the depths of `depth_map` where the confidence is above a bound.

    Parameters
    ----------
    found : xarray.Dataset
        The depth map, from `depth_map`.
    confidence : float
        Depths of a higher confidence are compared.

    Raises
    ------
    InputError
        If the truth is not known.
    """
    if "truth" not in found:
        raise InputError("depth map: its light field had no ground truth: give it to decode()")
    truth = found.truth.values
    has_truth = np.isfinite(truth)
    sure = has_truth & (found.confidence.values > confidence) & np.isfinite(found.depth.values)
    error = np.abs(found.depth.values[sure] / truth[sure] - 1)
    median, high = np.percentile(error, (50, 90)) if error.size else (np.nan, np.nan)
    return DepthError(float(median), float(high), float(sure.sum() / max(1, has_truth.sum())))
