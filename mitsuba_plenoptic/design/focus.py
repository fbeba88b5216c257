r"""The resolution of a camera at each object distance, for unfocused and focused microlenses.

A pixel gathers the rays through all of its lens. In the plane of the main lens's image of an object, a before the MLA,
they fill a spot, by the similar triangles of thin lenses: as wide as the lens where the MLA is, and as the image of a
pixel where the microlens is in focus, at :math:`a_0` with :math:`1/a_0 + 1/z = 1/f_2`. With the virtual depths
:math:`v = a / z` and :math:`v_0`, a pixel of width p and a lens of width w, it is the convolution of two shapes,

.. math:: w \, |1 - v / v_0| \quad \text{and} \quad p \, |v|

wide. The wider one determines the finest detail. For an unfocused camera the first is w everywhere: one sample per
lens, as far as the second is below that, which is Ng's range of refocusing (2006, "Digital Light Field Photography",
section 3.4). For a focused one at :math:`v_0` only the second is left, :math:`1 / |v_0|` of the detector's resolution
along an axis: the effective resolution of Perwass and Wietzke (2012, "Single lens 3D-camera with extended
depth-of-field", section 2) and of Georgiev and Lumsdaine (2010, "Reducing plenoptic camera artifacts"). A spot of
diffraction wider than a pixel replaces the pixel.

Widths are projected through the main lens's centre onto the MLA, as the bins of a reconstruction are. There, with the
defocus s of the object and :math:`\kappa = 1 + b/z - b/f_2`, how fast the position on the pupil moves with that on the
lens, they read :math:`w |1 - s \kappa|` and :math:`p |s| b / z`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..camera import PlenopticCamera
from ..errors import require_number
from ..prescription.lens_data import conjugate_distance, image_distance
from .micro_images import direction_count, spot_radius

# -- what the microlenses are focused on -------------------------------------------------------------


def focus_types(camera: PlenopticCamera) -> tuple[str, ...]:
    r"""Return the name of the plane on which each type of microlens is focused.

    - ``unfocused``: on the main lens, as good as infinitely far (Ng 2006; the "plenoptic camera 1.0"). It makes a
      spot of at most a pixel of parallel light: :math:`D_2 |z / f_2 - 1| \le` pixel.
    - ``keplerian``: on the main lens's image, a real one before the MLA; :math:`z > f_2`.
    - ``galilean``: on the main lens's image, a virtual one behind the detector, where it would be without the MLA;
      :math:`z < f_2`. These two make the "focused plenoptic camera" or "2.0" (Lumsdaine and Georgiev 2009, "The
      focused plenoptic camera"; Perwass and Wietzke 2012, "Single lens 3D-camera with extended depth-of-field").

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    """
    # Rounding must not take a lens out of focus.
    limit = camera.pixel_size * (1 + 1e-9)
    spots = [camera.lattice.aperture_width * (camera.reduced_distance / f2 - 1) for f2 in camera.reduced_focal_lengths]
    return tuple("unfocused" if abs(s) <= limit else "keplerian" if s > 0 else "galilean" for s in spots)


def focus_type(camera: PlenopticCamera) -> str:
    """Return the name of the plane on which all microlenses are focused, as in `focus_types`, or ``mixed``."""
    types = set(focus_types(camera))
    return types.pop() if len(types) == 1 else "mixed"


def mla_object_distances(camera: PlenopticCamera) -> tuple[float, ...]:
    """Distance a in front of the MLA, towards the main lens, of the plane that each type of microlens images sharply.

    :math:`1/a + n/z = n/f_2`; negative for a virtual image behind the MLA, infinite for :math:`z = f_2`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    """
    return tuple(conjugate_distance(f2, camera.reduced_distance) for f2 in camera.reduced_focal_lengths)


def best_distances(camera: PlenopticCamera) -> tuple[float, ...]:
    """Distance of the object plane that each type of microlens sees sharply through the main lens.

    For an unfocused one, `PlenopticCamera.focus_distance`. Where there is no such plane it is
    infinite or negative.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    """
    return tuple(conjugate_distance(camera.focal_length, image) for image in best_images(camera))


def best_images(camera: PlenopticCamera) -> tuple[float, ...]:
    """Distance behind the main lens of the image that each type of microlens sees: the MLA's for unfocused cameras."""
    camera.require_lens("the plane that microlenses see")
    return tuple(
        camera.mla_distance - (0 if focus == "unfocused" else a)
        for focus, a in zip(focus_types(camera), mla_object_distances(camera), strict=True)
    )


def virtual_depth(camera: PlenopticCamera, distance: float) -> float:
    """Distance before the MLA of the main lens's image of an object, in units of z/n: :math:`v = n a / z`.

    A point is then seen by about as many microlenses along an axis, each of which shrinks the image by that factor
    (Perwass and Wietzke 2012, section 2). Negative for an image behind the MLA.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance from the main lens in millimetres.
    """
    camera.require_lens("virtual depth")
    return (camera.mla_distance - image_distance(camera.focal_length, distance)) / camera.reduced_distance


# -- how finely they see it --------------------------------------------------------------------------


def field_of_view(camera: PlenopticCamera) -> float:
    """Full horizontal field of view in degrees."""
    camera.require_lens("the field of view")
    return math.degrees(2 * math.atan(camera.detector_width / (2 * camera.mla_distance)))


def field_width(camera: PlenopticCamera, distance: float) -> float:
    """Width of the field in the object plane."""
    camera.require_lens("the width of the field")
    return camera.detector_width * distance / camera.mla_distance


@dataclass(frozen=True)
class EffectiveResolution:
    """The resolution of a camera at one object distance, by its sharpest microlenses.

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
    r"""Return the enlargement of a lens's aperture in the object plane, as a pixel sees it: :math:`|1 - s \kappa|`.

    Projected onto the MLA through the main lens's centre; see the head of this module.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance from the main lens in millimetres.
    mla_focal_length : float
        Focal length of the microlens in millimetres.
    """
    return abs(1 - camera.defocus(distance) * camera.pupil_shift(mla_focal_length))


def pixel_footprint(camera: PlenopticCamera, distance: float) -> float:
    """Width of a pixel in the object plane, seen through its lens's centre: :math:`p |s| b / z`.

    Projected onto the MLA through the main lens's centre; see the head of this module.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance from the main lens in millimetres.
    """
    return abs(camera.defocus(distance)) * camera.pupil_step


def lenses_across(camera: PlenopticCamera, distance: float) -> float:
    """Lens pitches across the cone of light of a point where it meets the MLA, :math:`D_1 |s| / D_2`.

    Of two pitches the greater counts. From 1 on every point is seen by at least two lenses, in part; from 2 on by two
    lenses' centres, which for micro-images that touch is Perwass and Wietzke's virtual depth of 2 (2012, section 2.2,
    total covering).

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance from the main lens in millimetres.
    """
    return camera.blur_diameter(distance) / max(camera.mla_pitches)


def effective_resolution(
    camera: PlenopticCamera, distance: float, wavelength: float | None = None
) -> EffectiveResolution:
    """Return the finest detail that is resolved at an object distance.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance from the main lens in millimetres.
    wavelength : float
        Wavelength in nanometres.

    Raises
    ------
    InputError
        If the distance is not beyond the focal length, or the wavelength is out of range.
    """
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


# -- at which distances ------------------------------------------------------------------------------


def refocus_range(camera: PlenopticCamera, wavelength: float | None = None) -> tuple[float, float]:
    """Nearest and farthest distance that refocusing brings back to one sample per lens.

    The blur on the MLA may then span as many lenses as directions are resolved under each (Ng 2006,
    "Digital Light Field Photography", section 3.4). A microlens that is in focus at the distance a, not on the main
    lens, must besides blur the main lens's image by less than its own width, which it does as far as 2a. The far
    end may be infinite.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> camera = mp.PlenopticCamera(aperture_radius=4, focus_distance=300)
    >>> near, far = mp.design.refocus_range(camera, 633)
    >>> round(near), round(far)
    (258, 358)
    """
    camera.require_lens("the range of refocusing")
    slack = direction_count(camera, wavelength) * camera.mla_pitch / camera.aperture_diameter
    ends = []
    for focus, a in zip(focus_types(camera), mla_object_distances(camera), strict=True):
        # The defocus of what has its image at 2a; of what has it at the MLA it is 0.
        twice = -2 * a / (camera.mla_distance - 2 * a)
        ends += [-slack, slack] if focus == "unfocused" else [0.0, min(max(twice, -slack), slack)]
    base = camera.mla_distance / camera.focal_length - 1
    near, far = base + max(ends), base + min(ends)
    return (
        camera.mla_distance / near if near > 0 else math.inf,
        camera.mla_distance / far if far > 0 else math.inf,
    )


def depth_ranges(camera: PlenopticCamera, wavelength: float | None = None) -> list[tuple[float, float] | None]:
    r"""Nearest and farthest distance at which each type of microlens is sharp.

    For an unfocused type that is `refocus_range`. For another, its blur on the detector,
    :math:`w |1/v - 1/v_0|`, is at most a pixel, or the spot of diffraction if that is wider, and every point is seen by
    two lenses at least (`lenses_across` of 1).

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.

    Returns
    -------
    list of (float, float) or None
        One for each of the camera's `mla_focal_lengths`; None where there is no such distance. The far end may be
        infinite.
    """
    camera.require_lens("the range of depths")
    found: list[tuple[float, float] | None] = []
    for focus, a in zip(focus_types(camera), mla_object_distances(camera), strict=True):
        if focus == "unfocused":
            found.append(refocus_range(camera, wavelength))
            continue
        side = math.copysign(1, a)
        near, far = sharp_images(camera, a, _covering(camera, side), wavelength)
        images = sorted(camera.mla_distance - side * distance for distance in (near, far))
        # The nearer the object, the farther its image; none is nearer than the focal length.
        objects = [
            math.inf if image <= camera.focal_length else conjugate_distance(camera.focal_length, image)
            for image in reversed(images)
        ]
        found.append((objects[0], objects[1]) if near <= far and objects[0] < math.inf else None)
    return found


def sharp_images(camera: PlenopticCamera, a: float, covering: float, wavelength: float | None) -> tuple[float, float]:
    """Return the nearest and farthest distance from the MLA of sharp images, on the side where a lens is in focus at a.

    From the distance `covering` on, the light of a point spans a lens pitch.
    """
    slack = vergence_slack(camera, wavelength)
    far = math.inf if abs(1 / a) <= slack else 1 / (abs(1 / a) - slack)
    return max(1 / (abs(1 / a) + slack), covering), far


def vergence_slack(camera: PlenopticCamera, wavelength: float | None) -> float:
    """Return the change of 1/a from a microlens's focus that causes a blur of a pixel, or of the spot if wider."""
    return _finest(camera, wavelength) / camera.lattice.aperture_width / camera.reduced_distance


def suitable_oversample(camera: PlenopticCamera, distance: float, wavelength: float | None = None) -> int:
    """Bins per lens that show the finest detail at a distance and no more: an `oversample` for `reconstruct`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance from the main lens in millimetres.
    wavelength : float
        Wavelength in nanometres.
    """
    return max(1, math.floor(effective_resolution(camera, distance, wavelength).samples_per_lens + 1e-6))


def _finest(camera: PlenopticCamera, wavelength: float | None) -> float:
    """Finest detail on the detector: a pixel, or the spot of diffraction if that is wider."""
    return max(camera.pixel_size, 0.0 if wavelength is None else spot_radius(camera, wavelength))


def _covering(camera: PlenopticCamera, side: float) -> float:
    """Distance of an image from the MLA from which on the cone of a point is a lens pitch wide."""
    # With |s| = D2 / D1 and s = -a / (b - a).
    defocus = max(camera.mla_pitches) / camera.aperture_diameter
    return camera.mla_distance * defocus / (1 + side * defocus)
