r"""Quantities of a light-field microscope, a camera whose main lens is an `Objective`.

Lengths in the object are lengths in the native image plane divided by the magnification M. In the Fourier arrangement
each lens of the width w sees the object through its part of the stop, with :math:`NA_l = M w / 2 f_F`, from a direction
of its own (Guo, Liu, Hua, Li and Jia 2019, "Fourier light-field microscopy", Optics Express 27, 25573).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from ..camera import PlenopticCamera, once_a_camera, one_if_equal
from ..errors import InputError, refuse_if
from ..optics import in_millimetres
from ..prescription import SINGLE, Objective
from ..runtime import Array, Doubles, Integers, Pair
from .quantities import direction_count, focus_types, mla_object_distances, sharp_images, vergence_slack
from .remedies import Finding, detector_at, finer_pixels

_POINTS = 128
"""Points along either side of a lens's aperture by which its lit part is counted."""


def objective_of(camera: PlenopticCamera) -> Objective:
    """Return the objective of a microscope; refuse cameras without one."""
    if camera.objective is None:
        raise InputError(f"main_lens = {camera.lens_data.label}: it must be an Objective; this camera is no microscope")
    return camera.objective


def native_field(camera: PlenopticCamera) -> float:
    r"""Return the width, in millimetres, of the part of the object that the camera sees.

    The width is that of the detector, :math:`W / M`; in the Fourier arrangement, that of the field stop,
    :math:`2 r / M`, or, without one, of the picture for which one lens has room, :math:`D_2 f_F / z M`.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope.
    """
    lens = objective_of(camera)
    if not lens.images_stop:
        return camera.detector_width / lens.magnification
    if lens.field_stop is not None:
        return 2 * lens.field_stop / lens.magnification
    return camera.row_pitch / lens.view_scale(camera.reduced_distance)


def depth_of_field(camera: PlenopticCamera, wavelength: float | None = None) -> Pair:
    r"""Return the least and greatest depth beyond the native object plane, in mm, at which some microlenses are sharp.

    For unfocused microlenses in the native image plane, these are the depths that refocusing restores to one sample per
    lens. The blur :math:`2 M |d| \tan\alpha` on the array may span as many lenses as directions are resolved under each
    lens; for micro-images that touch and a small NA this is Levoy et al.'s :math:`N_u^2 \lambda n / 2 NA^2` from end to
    end (2006, "Light field microscopy", section 3). For focused microlenses, the image of a depth d lies
    :math:`M^2 d / n` before the array, and the range follows as in `depth_ranges`. In the Fourier arrangement, the blur
    of a point in the picture of one lens, :math:`|d| w z M^2 / n f_F^2`, is at most a pixel, or the spot of diffraction
    if that is wider.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope.
    wavelength : float
        Wavelength in nanometres.

    Returns
    -------
    (float, float)
        Limits in millimetres; NaN if no type of microlens is sharp at any depth.
    """
    lens = objective_of(camera)
    ranges: list[Pair] = []
    for focus, a in zip(focus_types(camera), mla_object_distances(camera), strict=True):
        if lens.images_stop:
            scale = lens.immersion * (lens.last_focal_length / lens.magnification) ** 2
            slack = vergence_slack
            ranges += [(-scale * (1 / a + slack(camera, wavelength)), -scale * (1 / a - slack(camera, wavelength)))]
            continue
        # Diameter of a point's light on the array for each millimetre of depth.
        growth = lens.blur_diameter(1)
        if focus == "unfocused":
            reach = direction_count(camera, wavelength) * camera.row_pitch / growth
            ranges += [(-reach, reach)]
            continue
        scale = lens.immersion / lens.magnification**2
        near, far = sharp_images(camera, a, max(camera.mla_pitches) / growth / scale, wavelength)
        ranges += [tuple(sorted(math.copysign(scale * image, a) for image in (near, far)))] if near <= far else []  # type: ignore[list-item]
    return (min(low for low, _ in ranges), max(high for _, high in ranges)) if ranges else (math.nan, math.nan)


def lens_aperture(camera: PlenopticCamera) -> float:
    r"""Return the numerical aperture with which one lens of the Fourier arrangement sees the object.

    :math:`M w / 2 f_F` for a lens of the width w.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.
    """
    lens = _fourier(camera)
    return lens.magnification * camera.lattice.aperture_width / (2 * lens.last_focal_length)


def lenses_across_stop(camera: PlenopticCamera) -> float:
    r"""Return the number of lenses across the stop's image in the Fourier arrangement, :math:`2 f_F NA / M D_2`.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.
    """
    return _fourier(camera).blur_diameter(0) / camera.row_pitch


def lenses_in_stop(camera: PlenopticCamera) -> tuple[Array, Doubles]:
    """Return the lenses of the Fourier arrangement that the stop's image lights, and the part of each that it lights.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.

    Returns
    -------
    index : (lenses, 2) int array
        Indices of the lenses in the lattice.
    open : (lenses,) float64 array
        Lit part of the area of each lens's aperture, above 0.
    """
    lattice = camera.lattice
    radius = _fourier(camera).blur_diameter(0) / 2
    far = radius + float(lattice.aperture_reach)
    index = lattice.lenses_within((-far, -far), (far, far))
    aside = lattice.aperture_grid(_POINTS)
    centre = np.stack(lattice.centre(*index.T))
    lit = (np.hypot(*(centre[:, :, None] + aside[:, None])) <= radius).mean(1)
    return index[lit > 0], lit[lit > 0]


@dataclass(frozen=True, eq=False)
class LensDirections:
    """The directions from which lenses of the Fourier arrangement see the object."""

    # Indices (lenses, 2) of the lenses in the lattice, and the lit part of the area of each.
    index: Array
    lit: Doubles
    # Means over the lit part, (lenses, 2): of the slopes in the object, tan(theta) along x and y, which depth moves the
    # picture against, and of the places on the detector in mm where the native plane's middle is seen.
    slope: Doubles
    middle: Doubles

    def at(self, i: Array, j: Array) -> Integers:
        """Return the positions in these arrays of lenses by their indices, -1 of those that the stop does not light."""
        first = self.index.min(0) - 1
        table = np.full(self.index.max(0) - first + 2, -1)
        table[tuple((self.index - first).T)] = np.arange(len(self.index))
        inside = (np.clip(k - low, 0, size - 1) for k, low, size in zip((i, j), first, table.shape, strict=True))
        return np.asarray(table[tuple(k.astype(np.int64) for k in inside)])


@once_a_camera
def lens_directions(camera: PlenopticCamera) -> LensDirections:
    r"""Return the directions of the lenses that the stop's image lights, from :math:`n \sin\theta = M m / f_F`.

    A lens out of focus, :math:`z \ne f_2`, whose lit part has its mean at m in place of its centre c, shows the object
    displaced by :math:`(1 - z / f_2)(m - c)`.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.
    """
    lens = _fourier(camera)
    lattice = camera.lattice
    index, lit = lenses_in_stop(camera)
    numbers = index.T.astype(np.float64)
    centres = np.stack(lattice.centre(*numbers), -1)
    defocus = 1 - camera.reduced_distance / np.broadcast_to(camera.lenslet(*numbers).focal_length, len(index))
    aside = lattice.aperture_grid(_POINTS)
    slope, middle = np.empty((2, len(index), 2))
    for lens_index, centre in enumerate(centres):
        point = centre[:, None] + aside
        point = point[:, np.hypot(*point) <= lens.blur_diameter(0) / 2]
        sine = point * (lens.magnification / (lens.last_focal_length * lens.immersion))
        slope[lens_index] = (sine / np.sqrt(1 - (sine**2).sum(0))).mean(1)
        middle[lens_index] = centre + defocus[lens_index] * (point.mean(1) - centre)
    return LensDirections(index, lit, slope, middle)


def parallax(camera: PlenopticCamera, position: float) -> float:
    r"""Return the displacement on the detector of a point's picture under one lens, per millimetre of depth.

    :math:`-(z M / f_F) \tan\theta` along the line to the lens, with :math:`n \sin\theta = M c / f_F` for the lens whose
    centre is the distance c from the axis.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.
    position : float
        Distance c in millimetres.
    """
    lens = _fourier(camera)
    growth = lens.magnification / lens.last_focal_length
    sine = growth * position / lens.immersion
    refuse_if(
        abs(sine) > math.sin(lens.half_angle),
        f"position = {position:g}: it must lie in the image of the stop, within {lens.blur_diameter(0) / 2:g}",
    )
    return -camera.reduced_distance * growth * math.tan(math.asin(sine))


def view_resolution(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Return the smallest distance in mm in the object that one lens of the Fourier arrangement resolves.

    :math:`\lambda f_F / M w`, Abbe's limit of the lens's part of the stop (Guo et al. 2019, appendix B).

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.
    wavelength : float
        Wavelength in nanometres.
    """
    return in_millimetres(wavelength) / (2 * lens_aperture(camera))


def view_depth(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Return the depth of field in mm, from end to end, of one lens of the Fourier arrangement.

    :math:`n \lambda / NA_l^2 + n e / NA_l` for a pixel that is e wide in the object (Scrofani et al. 2018; Guo et al.
    2019, appendix E, who take twice as much to be within reach of deconvolution).

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.
    wavelength : float
        Wavelength in nanometres.
    """
    lens = _fourier(camera)
    aperture = lens_aperture(camera)
    return lens.immersion * (in_millimetres(wavelength) / aperture + lens.bin_size(camera, 0)) / aperture


def depth_step(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Return the change of depth in mm that moves a point by a resolved distance under the outermost whole lens.

    `view_resolution` over :math:`\tan\theta` of that lens (Guo et al. 2019, appendix C, in which
    :math:`\tan\theta = M c / f_F`); infinite if at most the lens on the axis is whole.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.
    wavelength : float
        Wavelength in nanometres.
    """
    moved = abs(parallax(camera, outermost_lens(camera))) / _fourier(camera).view_scale(camera.reduced_distance)
    return view_resolution(camera, wavelength) / moved if moved > SINGLE else math.inf


def outermost_lens(camera: PlenopticCamera) -> float:
    """Return the distance in mm from the axis of the outermost whole lens in the stop's image, 0 if there is none.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.
    """
    index, lit = lenses_in_stop(camera)
    # 0.99: Lit part of lenses that count as whole; wave captures take them for alike, too.
    return float(max(np.hypot(*camera.lattice.centre(*index[lit >= 0.99].T)), default=0.0))


def touching_field_stop(camera: PlenopticCamera) -> float:
    r"""Return the radius, or half the width of a square field stop, in mm with which micro-images touch.

    :math:`f_F D / 2 z` for the distance D of neighbouring lenses, that of a square along the detector's sides.

    Parameters
    ----------
    camera : PlenopticCamera
        A microscope in the Fourier arrangement.
    """
    lens = _fourier(camera)
    lattice = camera.lattice.regular
    near = np.array([(i, j) for i in (-2, -1, 0, 1, 2) for j in (-2, -1, 0, 1, 2) if i or j])
    aside = np.stack(lattice.centre(*near.T)) - np.array(lattice.centre(0, 0))[:, None]
    apart = np.abs(aside).max(0) if lens.field_stop_shape == "square" else np.hypot(*aside)
    return float(apart.min() * lens.last_focal_length / (2 * camera.reduced_distance))


def overlap_warnings(camera: PlenopticCamera) -> list[str]:
    """Return whether micro-images of wide objects overlap in the Fourier arrangement, as a warning for their captures.

    Parameters
    ----------
    camera : PlenopticCamera
        Any camera; others have no such warning.
    """
    if camera.objective is None or not camera.objective.images_stop:
        return []
    return [finding.sentence(camera) for finding in _overlap(camera, camera.objective)]


def _overlap(camera: PlenopticCamera, lens: Objective) -> Iterator[Finding]:
    """Yield whether micro-images of wide objects overlap, with the field stop that ends it."""
    stop = touching_field_stop(camera)
    if lens.field_stop is not None and lens.field_stop <= stop * (1 + SINGLE):
        return
    # Of six digits, rounded down.
    stop = float(f"{stop * (1 - 5e-6):.6g}")
    cause = "no field_stop" if lens.field_stop is None else f"a field_stop of {lens.field_stop:.6g} mm"
    yield Finding(
        f"micro-images of wide objects overlap: {cause} bounds them",
        ((f"take a field_stop of {stop:g} mm", {"main_lens": replace(lens, field_stop=stop)}),),
    )


def microscope_findings(camera: PlenopticCamera, wavelength: float | None) -> Iterator[Finding]:
    """Yield findings about the design of a microscope."""
    lens = objective_of(camera)
    if lens.images_stop:
        across = lenses_across_stop(camera)
        if across < 2 * (1 - SINGLE):
            narrower = one_if_equal((camera.mla_pitches[0] * across / 2, camera.mla_pitches[1] * across / 2))
            yield Finding(
                f"no parallax: only {across:.2g} lenses lie across the image of the stop",
                (("take narrower lenses", {"mla_pitch": narrower}),),
            )
        sides = (size * camera.pixel_size / 2 for size in camera.resolution)
        visible = min(sides) * lens.last_focal_length / camera.reduced_distance
        if lens.field_stop is not None and lens.field_stop > visible * (1 + SINGLE):
            yield Finding(
                f"field_stop = {lens.field_stop:.6g}: it is wider than the {visible:.6g} mm to either side in the "
                "native image plane that the detector sees",
                (("narrow it", {"main_lens": replace(lens, field_stop=visible)}),),
            )
        yield from _overlap(camera, lens)
    else:
        fill = camera.micro_image_diameter / camera.row_pitch
        matching = f"a microlens of {lens.magnification / (2 * lens.numerical_aperture):.3g} times its pitch suits"
        remedy = (matching, detector_at(camera, camera.reduced_distance / fill))
        if fill > 1.05:
            yield Finding(f"micro-images overlap: their diameter is {fill:.3g} of their pitch", (remedy,))
        elif fill < 0.5:
            yield Finding(f"pixels are wasted: micro-images fill {fill:.0%} of their pitch", (remedy,))
    if wavelength is not None:
        spot = in_millimetres(wavelength) * camera.reduced_distance / camera.lattice.aperture_width
        if camera.pixel_size > spot / 2 * (1 + SINGLE):
            yield Finding(
                f"the detector undersamples the diffraction spot: a pixel of {1e3 * camera.pixel_size:.4g} um exceeds "
                f"half the spot's radius of {1e3 * spot:.4g} um",
                (("make pixels finer", finer_pixels(camera, 2 * camera.pixel_size / spot)),),
            )


def _fourier(camera: PlenopticCamera) -> Objective:
    lens = objective_of(camera)
    refuse_if(not lens.images_stop, "main_lens: arrangement = image: this is a quantity of the Fourier arrangement")
    return lens
