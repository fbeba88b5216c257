r"""How sharply a camera sees at which distance, whatever its microlenses are focused on.

A pixel gathers the rays through all of its lens. In the plane of the main lens's image of an object, a before the MLA,
they fill a spot, by the similar triangles of thin lenses: as wide as the lens where the MLA is, and as the image of a
pixel where the microlens is in focus, at :math:`a_0` with :math:`1/a_0 + 1/z = 1/f_2`. With the virtual depths
:math:`v = a / z` and :math:`v_0`, a pixel of width p and a lens of width w, it is the convolution of two shapes,

.. math:: w \, |1 - v / v_0| \quad \text{and} \quad p \, |v|

wide. The wider one tells the finest detail. For an unfocused camera the first is w everywhere: one sample per lens, as
far as the second is below that, which is Ng's range of refocusing (2006, "Digital Light Field Photography", section
3.4). For a focused one at :math:`v_0` only the second is left, :math:`1 / |v_0|` of the detector's resolution along an
axis: the effective resolution of Perwass and Wietzke (2012, "Single lens 3D-camera with extended depth-of-field",
section 2) and of Georgiev and Lumsdaine (2010, "Reducing plenoptic camera artifacts"). A spot of diffraction wider than
a pixel takes the pixel's place.

Widths are projected through the main lens's centre onto the MLA, as the bins of a reconstruction are. There, with the
defocus s of the object and :math:`\kappa = 1 + b/z - b/f_2`, how fast the place on the pupil moves with that on the
lens, they read :math:`w |1 - s \kappa|` and :math:`p |s| b / z`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from .camera import PlenopticCamera, conjugate_distance, image_distance, require_wavelength
from .errors import require_number


@dataclass(frozen=True)
class EffectiveResolution:
    """What a camera tells apart at one object distance, by its sharpest microlenses.

    Attributes
    ----------
    line_width : float
        Width of the finest detail in the object plane.
    columns, rows : float
        Such details across the field and down it. `rows` is the resolution in line widths per picture height.
    samples_per_lens : float
        Such details per microlens pitch, along an axis.
    ratio : float
        Such details per pixel of the detector, along an axis: Perwass and Wietzke's effective resolution ratio.
    """

    line_width: float
    columns: float
    rows: float
    samples_per_lens: float
    ratio: float


def lens_footprint(camera: PlenopticCamera, distance: float, mla_focal_length: float) -> float:
    r"""Enlargement of a lens's aperture in the object plane, seen through it by a pixel: :math:`|1 - s \kappa|`.

    Projected onto the MLA through the main lens's centre; see the head of this module.
    """
    return abs(1 - camera.defocus(distance) * camera.pupil_walk(mla_focal_length))


def pixel_footprint(camera: PlenopticCamera, distance: float) -> float:
    """Width of a pixel in the object plane, seen through its lens's centre: :math:`p |s| b / z`.

    Projected onto the MLA through the main lens's centre; see the head of this module.
    """
    return abs(camera.defocus(distance)) * camera.pupil_step


def lenses_across(camera: PlenopticCamera, distance: float) -> float:
    """Lens pitches across the cone of light of a point where it meets the MLA, :math:`D_1 |s| / D_2`.

    From 1 on every point is seen by at least two lenses, in part; from 2 on by two lenses' centres, which for
    micro-images that touch is Perwass and Wietzke's virtual depth of 2 (2012, section 2.2, total covering).
    """
    return camera.blur_diameter(distance) / camera.mla_pitch


def effective_resolution(
    camera: PlenopticCamera, distance: float, wavelength: float | None = None
) -> EffectiveResolution:
    """Tell the finest detail at an object distance.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance, beyond the focal length.
    wavelength : float, optional
        Wavelength in nanometres; without it diffraction is left out.

    Raises
    ------
    InputError
        If the distance or the wavelength is out of range.
    """
    # refuses what is not beyond the focal length
    image_distance(camera.focal_length, require_number("distance", distance))
    spot = pixel_footprint(camera, distance) * _finest(camera, wavelength) / camera.pixel_size
    lens = min(lens_footprint(camera, distance, f2) for f2 in camera.mla_focal_lengths) * camera.lattice.aperture_width
    detail = max(spot, lens)
    return EffectiveResolution(
        line_width=detail * distance / camera.mla_distance,
        columns=camera.detector_width / detail,
        rows=camera.detector_height / detail,
        samples_per_lens=camera.mla_pitch / detail,
        ratio=camera.pixel_size / detail,
    )


def depth_ranges(camera: PlenopticCamera, wavelength: float | None = None) -> list[tuple[float, float] | None]:
    r"""Nearest and farthest distance at which each kind of microlens is sharp.

    For an unfocused kind that is `PlenopticCamera.refocus_range`. For another, its blur on the detector,
    :math:`w |1/v - 1/v_0|`, is at most a pixel, or the spot of diffraction if that is wider, and every point is seen by
    two lenses at least (`lenses_across` of 1).

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float, optional
        Wavelength in nanometres; without it diffraction is left out.

    Returns
    -------
    list of (float, float) or None
        One for each of the camera's `mla_focal_lengths`; None where there is no such distance. The far end may be
        infinite.
    """
    z = camera.detector_distance
    slack = _finest(camera, wavelength) / camera.lattice.aperture_width / z
    found: list[tuple[float, float] | None] = []
    for kind, a in zip(camera.mla_kinds, camera.mla_object_distances, strict=True):
        if kind == "unfocused":
            found.append(camera.refocus_range(wavelength))
            continue
        side = math.copysign(1, a)
        # Distances of the image from the MLA, on the side where the microlens is in focus.
        far = math.inf if abs(1 / a) <= slack else 1 / (abs(1 / a) - slack)
        near = max(1 / (abs(1 / a) + slack), _covering(camera, side))
        images = sorted(camera.mla_distance - side * distance for distance in (near, far))
        # The nearer the object, the farther its image; none is nearer than the focal length.
        objects = [
            math.inf if image <= camera.focal_length else conjugate_distance(camera.focal_length, image)
            for image in reversed(images)
        ]
        found.append((objects[0], objects[1]) if near <= far and objects[0] < math.inf else None)
    return found


def suitable_oversample(camera: PlenopticCamera, distance: float, wavelength: float | None = None) -> int:
    """Bins per lens that show the finest detail at a distance and no more: an `oversample` for `reconstruct`."""
    return max(1, math.floor(effective_resolution(camera, distance, wavelength).samples_per_lens + 1e-6))


def _finest(camera: PlenopticCamera, wavelength: float | None) -> float:
    """Finest detail on the detector: a pixel, or the spot of diffraction if that is wider."""
    return max(camera.pixel_size, 0.0 if wavelength is None else camera.spot_size(require_wavelength(wavelength)))


def _covering(camera: PlenopticCamera, side: float) -> float:
    """Distance of an image from the MLA from which on the cone of a point is a lens pitch wide."""
    # With |s| = D2 / D1 and s = -a / (b - a).
    defocus = camera.mla_pitch / camera.aperture_diameter
    return camera.mla_distance * defocus / (1 + side * defocus)
