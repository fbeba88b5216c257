r"""The focus of microlenses, the resolution at each object distance, micro-images, and the lenses that light a pixel.

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
defocus s of the object and :math:`\kappa = 1 + b/z - b/f_2`, the motion of the pupil point per motion of the lens
point, they are :math:`w |1 - s \kappa|` and :math:`p |s| b / z`.
"""

import math
from dataclasses import dataclass

import numpy as np

from ..camera import PlenopticCamera
from ..errors import refuse_if, require_number, require_wavelength
from ..lenses import main_lens
from ..optics import in_millimetres
from ..prescription import conjugate_distance, image_distance

MOST_OVERLAP = 100_000
"""Lenses that may light one pixel."""

# -- what the microlenses are focused on -------------------------------------------------------------


def focus_types(camera: PlenopticCamera) -> tuple[str, ...]:
    r"""Return the name of the plane on which each type of microlens is focused.

    - ``unfocused``: on the main lens, practically at infinity (Ng 2006; the "plenoptic camera 1.0"). The spot of
      parallel light is at most a pixel wide: :math:`D_2 |z / f_2 - 1| \le` pixel.
    - ``keplerian``: on the main lens's image, a real one before the MLA; :math:`z > f_2`.
    - ``galilean``: on the main lens's image, a virtual one behind the detector, where it would be without the MLA;
      :math:`z < f_2`. These two make the "focused plenoptic camera" or "2.0" (Lumsdaine and Georgiev 2009, "The
      focused plenoptic camera"; Perwass and Wietzke 2012, "Single lens 3D-camera with extended depth-of-field").
    """
    # Rounding must not take a lens out of focus.
    limit = camera.pixel_size * (1 + 1e-9)
    spots = [camera.lattice.aperture_width * (camera.reduced_distance / f2 - 1) for f2 in camera.reduced_focal_lengths]
    return tuple("unfocused" if abs(s) <= limit else "keplerian" if s > 0 else "galilean" for s in spots)


def focus_type(camera: PlenopticCamera) -> str:
    """Return the focus type of all microlenses, as in `focus_types`, or ``mixed`` if they differ."""
    types = set(focus_types(camera))
    return types.pop() if len(types) == 1 else "mixed"


def mla_object_distances(camera: PlenopticCamera) -> tuple[float, ...]:
    """Distance a before the MLA, in mm, of the plane that each type of microlens images sharply on the detector.

    :math:`1/a + n/z = n/f_2`; negative for a virtual image behind the MLA, infinite for :math:`z = f_2`.
    """
    return tuple(conjugate_distance(f2, camera.reduced_distance) for f2 in camera.reduced_focal_lengths)


def best_distances(camera: PlenopticCamera) -> tuple[float, ...]:
    """Distance in mm from the main lens of the object plane that each type of microlens sees sharply.

    For an unfocused type the distance is `PlenopticCamera.focus_distance`. It is infinite or negative where no such
    plane exists.
    """
    return tuple(conjugate_distance(camera.focal_length, image) for image in best_images(camera))


def best_images(camera: PlenopticCamera) -> tuple[float, ...]:
    """Distance in mm behind the main lens of the image that each type of microlens is focused on, or of the MLA."""
    camera.require_lens("the plane that microlenses see")
    return tuple(
        camera.mla_distance - (0 if focus == "unfocused" else a)
        for focus, a in zip(focus_types(camera), mla_object_distances(camera), strict=True)
    )


def virtual_depth(camera: PlenopticCamera, distance: float) -> float:
    """Distance before the MLA of the main lens's image of an object, in units of z/n: :math:`v = n a / z`.

    About v microlenses along an axis see a point, and each shrinks the image by the factor v (Perwass and Wietzke 2012,
    section 2). The depth is negative for an image behind the MLA.

    Parameters
    ----------
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
    """Width of the field in the object plane, in millimetres."""
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
        Number of such details across the field, and down it. `rows` is the resolution in line widths per picture
        height.
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

    Projected onto the MLA through the main lens's centre; see the head of this module. In the Fourier arrangement bins,
    which are pixels in the object, count as wide as a lens.

    Parameters
    ----------
    distance, mla_focal_length : float
        Object distance from the main lens, and focal length of the microlens, in millimetres.
    """
    if (lens := camera.objective) and lens.images_stop:
        # Of the object's points that a pixel sees, over the lens's; slopes in the object as those near the axis.
        moved = lens.magnification / (lens.last_focal_length * lens.immersion) * distance
        moved -= (1 - camera.detector_distance / mla_focal_length) / lens.view_scale(camera.reduced_distance)
        return float(abs(moved) * camera.row_pitch / camera.bin_size(distance))
    return abs(1 - camera.defocus(distance) * camera.pupil_shift(mla_focal_length))


def pixel_footprint(camera: PlenopticCamera, distance: float) -> float:
    """Width of what a pixel sees of the object plane through its lens's centre, in mm on the MLA: :math:`p |s| b / z`.

    It is projected onto the MLA through the main lens's centre; see the head of this module.

    Parameters
    ----------
    distance : float
        Object distance from the main lens in millimetres.
    """
    if camera.lens_data.images_stop:
        return camera.row_pitch
    return abs(camera.defocus(distance)) * camera.pupil_step


def lenses_across(camera: PlenopticCamera, distance: float) -> float:
    """Diameter of a point's light cone on the MLA in lens pitches, :math:`D_1 |s| / D_2`.

    If there are two pitches, the greater counts. From 1 on every point is seen by at least two lenses, in part; from 2
    on by the centres of two lenses, which is Perwass and Wietzke's virtual depth of 2 if micro-images touch (2012,
    section 2.2, total covering).

    Parameters
    ----------
    distance : float
        Object distance from the main lens in millimetres.
    """
    camera.require_array("lenses_across")
    return camera.blur_diameter(distance) / max(camera.mla_pitches)


def effective_resolution(
    camera: PlenopticCamera, distance: float, wavelength: float | None = None
) -> EffectiveResolution:
    """Return the finest detail that is resolved at an object distance.

    Parameters
    ----------
    distance, wavelength : float
        Object distance from the main lens in millimetres, and wavelength in nanometres.
    """
    image_distance(camera.focal_length, require_number("distance", distance))
    spot = pixel_footprint(camera, distance) * finest_detail(camera, wavelength) / camera.pixel_size
    lens = min(lens_footprint(camera, distance, f2) for f2 in camera.mla_focal_lengths) * camera.lattice.aperture_width
    detail = max(spot, lens)
    return EffectiveResolution(
        line_width=detail * distance / camera.mla_distance,
        columns=camera.detector_width / detail,
        rows=camera.detector_height / detail,
        samples_per_lens=camera.row_pitch / detail,
        ratio=camera.pixel_size / detail,
    )


def spot_radius(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Radius of a microlens's focal spot in mm, from the centre to the first zero.

    :math:`\lambda z / n w` for a rectangular aperture, w its narrower side; :math:`1.22\, \lambda z / n d` for a disc
    of diameter d; for a hexagon the radius of a disc of equal area.

    Parameters
    ----------
    wavelength : float
        Wavelength in nanometres.
    """
    return in_millimetres(require_wavelength(wavelength)) * camera.reduced_distance / camera.lattice.diffraction_width


def direction_count(camera: PlenopticCamera, wavelength: float | None = None) -> float:
    """Return the number of directions resolved across a micro-image: its diameter over the larger of pixel and spot."""
    return camera.micro_image_diameter / finest_detail(camera, wavelength)


def finest_detail(camera: PlenopticCamera, wavelength: float | None) -> float:
    """Return the finest detail on the detector in millimetres: a pixel, or the spot of diffraction if that is wider."""
    return max(camera.pixel_size, 0.0 if wavelength is None else spot_radius(camera, wavelength))


# -- at which distances ------------------------------------------------------------------------------


def refocus_range(camera: PlenopticCamera, wavelength: float | None = None) -> tuple[float, float]:
    """Nearest and farthest distance, in mm, at which refocusing gives one sample per lens.

    The blur on the MLA may then span as many lenses as directions are resolved under each lens (Ng 2006, "Digital Light
    Field Photography", section 3.4). A microlens in focus at the distance a, not on the main lens, must also blur the
    main lens's image by less than the lens's width; this holds up to 2a. The far end may be infinite.

    Parameters
    ----------
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
    slack = direction_count(camera, wavelength) * camera.row_pitch / camera.aperture_diameter
    ends = []
    for focus, a in zip(focus_types(camera), mla_object_distances(camera), strict=True):
        # The defocus of what has its image at 2a; of what has it at the MLA it is 0.
        twice = -2 * a / (camera.mla_distance - 2 * a)
        ends += [-slack, slack] if focus == "unfocused" else [0.0, min(max(twice, -slack), slack)]
    base = camera.mla_distance / camera.focal_length - 1
    near = base + max(ends)
    far = base + min(ends)
    return (camera.mla_distance / near if near > 0 else math.inf, camera.mla_distance / far if far > 0 else math.inf)


def depth_ranges(camera: PlenopticCamera, wavelength: float | None = None) -> list[tuple[float, float] | None]:
    r"""Nearest and farthest distance, in mm, at which each type of microlens is sharp.

    For an unfocused type this is `refocus_range`. For a focused type, the blur on the detector,
    :math:`w |1/v - 1/v_0|`, is at most a pixel, or the spot of diffraction if that is wider, and every point is seen by
    two lenses at least (`lenses_across` of 1).

    Parameters
    ----------
    wavelength : float
        Wavelength in nanometres.

    Returns
    -------
    list of (float, float) or None
        One for each of the camera's `mla_focal_lengths`; None where there is no such distance. The far end may be
        infinite.
    """
    camera.require_lens("the range of depths")
    ranges: list[tuple[float, float] | None] = []
    for focus, a in zip(focus_types(camera), mla_object_distances(camera), strict=True):
        if focus == "unfocused":
            ranges.append(refocus_range(camera, wavelength))
            continue
        side = math.copysign(1, a)
        # The cone of a point is a lens pitch wide at |s| = D2 / D1, with s = -a / (b - a).
        defocus = max(camera.mla_pitches) / camera.aperture_diameter
        covering = camera.mla_distance * defocus / (1 + side * defocus)
        near, far = sharp_images(camera, a, covering, wavelength)
        images = sorted(camera.mla_distance - side * distance for distance in (near, far))
        # The nearer the object, the farther its image; none is nearer than the focal length.
        objects = [
            math.inf if image <= camera.focal_length else conjugate_distance(camera.focal_length, image)
            for image in reversed(images)
        ]
        ranges.append((objects[0], objects[1]) if near <= far and objects[0] < math.inf else None)
    return ranges


def sharp_images(camera: PlenopticCamera, a: float, covering: float, wavelength: float | None) -> tuple[float, float]:
    """Return the nearest and farthest distance from the MLA of images that are sharp for a lens focused at `a`.

    Images lie on the same side of the array as `a`. From the distance `covering` on, a point's light spans a pitch.
    """
    slack = vergence_slack(camera, wavelength)
    far = math.inf if abs(1 / a) <= slack else 1 / (abs(1 / a) - slack)
    return max(1 / (abs(1 / a) + slack), covering), far


def vergence_slack(camera: PlenopticCamera, wavelength: float | None) -> float:
    """Return how far 1/a may lie from a microlens's focus, in 1/mm, for a blur of at most a pixel or the spot."""
    return finest_detail(camera, wavelength) / camera.lattice.aperture_width / camera.reduced_distance


def suitable_oversample(camera: PlenopticCamera, distance: float, wavelength: float | None = None) -> int:
    """Return the least bins per lens that show the finest detail at a distance: an `oversample` for `reconstruct`.

    Parameters
    ----------
    distance, wavelength : float
        Object distance from the main lens in millimetres, and wavelength in nanometres.
    """
    return max(1, math.floor(effective_resolution(camera, distance, wavelength).samples_per_lens + 1e-6))


# -- micro-images ------------------------------------------------------------------------------------


def image_f_number(camera: PlenopticCamera) -> float:
    """F-number of the main lens as the MLA sees it, :math:`b / D_1`."""
    return camera.mla_distance / camera.aperture_diameter


def mla_f_number(camera: PlenopticCamera) -> float:
    """F-number of a microlens as the detector sees it: :math:`z / n` over the width of its aperture."""
    return camera.reduced_distance / camera.lattice.aperture_width


def micro_image_distance(camera: PlenopticCamera) -> float:
    """Distance in mm between the closest micro-images; micro-images of a smaller diameter do not touch."""
    return camera.lattice.nearest_distance * camera.micro_image_pitch / camera.row_pitch


# -- Fresnel numbers -------------------------------------------------------------------------------------


def mla_fresnel_number(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Fresnel number of a microlens of width w seen from the detector, :math:`n (w/2)^2 / (\lambda z)`."""
    return (camera.lattice.aperture_width / 2) ** 2 / (
        in_millimetres(require_wavelength(wavelength)) * camera.reduced_distance
    )


def main_fresnel_number(camera: PlenopticCamera, wavelength: float) -> float:
    r"""Fresnel number of the main lens seen from the MLA, :math:`(D_1/2)^2 / (\lambda b)`."""
    camera.require_lens("the Fresnel number of the main lens")
    return camera.aperture_radius**2 / (in_millimetres(require_wavelength(wavelength)) * camera.mla_distance)


# -- light of a white scene --------------------------------------------------------------------------


def white_mean(camera: PlenopticCamera) -> float:
    r"""Return the mean of an unbounded capture of a scene of uniform radiance 1.

    The closed form needs no capture. It leaves out vignetting, transmissions of lenses, absorption, responses of pixels
    and stray light, and takes pictures in the aperture by whole cells: `views.white_image` has all of them.

    A micro-image of area :math:`(\pi/4)(D_1 z / b)^2` reads 1 whatever its lens's aperture, because a pixel is the mean
    radiance over the aperture, less what the main lens's `aperture` keeps out; each :math:`A ((b + z)/b)^2` of the
    detector holds one, A being the area of a cell of the lattice.
    """
    growth = camera.micro_image_pitch / camera.row_pitch
    return camera.aperture.share * math.pi / 4 * camera.micro_image_diameter**2 / (camera.lattice.cell_area * growth**2)


def crosstalk_neighbours(camera: PlenopticCamera, beyond: float = 0.0) -> np.ndarray:
    """Return the lenses that can light a pixel, relative to the lens of its chief ray, with an optional margin.

    The ray from a detector point p through the point c + d of a lens meets the pupil plane in
    :math:`(1 + b/z)(c - m) + (1 + b/z - b/f_2) d`, where m is the point of the chief ray, in the cell of its lens. For
    this to be in the pupil, c must be within :math:`(D_1/2) / (1 + b/z)` of some
    :math:`m - d (1 + b/z - b/f_2) / (1 + b/z)`: a cell enlarged by apertures.

    Parameters
    ----------
    beyond : float
        Width in millimetres of the margin.

    Returns
    -------
    (lenses, 2) int array
        Steps in the lattice's indices; the first is the chief ray's own lens.
    """
    lenses, reach, smear = _crosstalk(camera)
    reach += beyond
    refuse_if(
        not lenses <= MOST_OVERLAP,
        f"camera: its micro-images overlap so much that some {lenses:.3g} lenses light each pixel; at most "
        f"{MOST_OVERLAP} are followed",
    )
    return camera.lattice.neighbours(reach, smear)


def crosstalk_reach(camera: PlenopticCamera) -> float:
    """Return the greatest distance in mm from the chief ray's point to the centres of lenses that can light a pixel."""
    _, reach, smear = _crosstalk(camera)
    return float(reach + smear * camera.lattice.aperture_reach)


def pupil_growth(camera: PlenopticCamera) -> float:
    """Return how far rays from one detector point move on the pupil per motion on the array, 1 + b/z in a camera."""
    # Behind an objective all lenses see the stop in the same directions.
    return camera.lens_data.converges + camera.pupil_distance / camera.reduced_distance


def crosstalk_lenses(camera: PlenopticCamera) -> int:
    """Return the number of lenses that can light one pixel; numbers above 100,000 are estimated from areas."""
    lenses = _crosstalk(camera)[0]
    return len(crosstalk_neighbours(camera)) if lenses <= MOST_OVERLAP else round(lenses)


def _crosstalk(camera: PlenopticCamera) -> tuple[float, float, float]:
    """Return roughly how many lenses light a pixel, and the `reach` and `smear` of `Lattice.neighbours` for them."""
    lattice = camera.lattice
    growth = pupil_growth(camera)
    reach = main_lens(camera).reach / growth
    smear = max(abs(camera.pupil_shift(f2)) for f2 in camera.mla_focal_lengths) / growth
    covered = math.pi * (reach + smear * lattice.aperture_reach + max(camera.mla_pitches)) ** 2
    return covered / lattice.cell_area, reach, smear
