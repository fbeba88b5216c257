"""Effects of a real main lens on images over the field: spots, light, distortion, colour and modulation transfer.

The modulation transfer function is the autocorrelation of the light of one point on the exit pupil, over the direction
cosines in which it reaches the point's image (Goodman, "Introduction to Fourier Optics", section 6.3). The light is
that of the wave captures: traced path and amplitude, within the edges of all surfaces.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import refuse_if, warn
from ..lenses import FAR, RealLens, sequential
from ..optics import in_millimetres
from ..prescription import LINE_C, LINE_F, Prescription, conjugate_distance
from ..runtime import Doubles, Pair

FIELDS = (0.0, 0.7, 1.0)
"""Heights in the image, over the largest, that are judged if no others are stated."""

_ACROSS = 301
"""Rays across the pupil."""

_DARK = np.full((4, 1), math.nan)
"""Rays where there are none."""


@dataclass(frozen=True)
class FieldFigures:
    """Effects of a main lens on light at one distance from the axis on the microlens array (MLA).

    Parameters
    ----------
    height : float
        Distance from the axis in millimetres.
    rays : dict
        By wavelength in nanometres, an array (4, n) of a point's rays, which fill the stop: positions x, y on the MLA
        in millimetres, from the chief ray, y away from the axis; and slopes dx/dz, dy/dz, z towards the scene. Where
        all is dark, one ray of NaN.
    light : float
        Open area of the exit pupil over the open area on the axis.
    distortion : float
        Displacement of a point's image away from the axis, by its chief ray against paraxial optics in the same plane,
        over its distance; NaN where all is dark.
    colour : float or None
        Difference in image height in millimetres between chief rays of the lines F and C; None of glasses without them.
    transfer : float64 array (2, n)
        Contrast of lines across (tangential) and along (sagittal) the direction to the axis, by frequency.
    """

    height: float
    rays: dict[float, Doubles]
    light: float
    distortion: float
    colour: float | None
    transfer: Doubles


def field_figures(
    lens: RealLens,
    heights: Iterable[float],
    distance: float,
    wavelengths: Sequence[float] | None = None,
    frequencies: Sequence[float] = (),
) -> list[FieldFigures]:
    """Return the field figures of a real main lens, from rays that fill its stop.

    Parameters
    ----------
    lens : RealLens
        The main lens of a camera, as `main_lens` returns it, or of `behind_lens`.
    heights : iterable of float
        Distances from the axis on the MLA in millimetres.
    distance : float
        Distance of the object plane in millimetres; where it is negative, infinitely far points are taken.
    wavelengths : sequence of float, optional
        Wavelengths of rays in nanometres; the points are where chief rays of the prescription's wavelength meet the
        object plane. Default: all of the prescription.
    frequencies : sequence of float
        Cycles per millimetre of the modulation transfer function, which has the prescription's wavelength.
    """
    prescription = lens.prescription
    if wavelengths is None:
        wavelengths = prescription.wavelengths or (lens.light,)
    reaches = [surface.glass.reach for surface in prescription.surfaces if surface.glass is not None]
    in_colour = prescription.disperses and all(low <= LINE_F and high >= LINE_C for low, high in reaches)
    axis = _open_area(lens, 0.0) or 1.0
    # Height over the tangent of the field near the axis; out of focus it is no longer the focal length.
    near_axis = 1e-5 * lens.corner
    scale = -near_axis / chief(lens, near_axis, distance)[0]
    figures = []
    for height in heights:
        light = _open_area(lens, height) / axis
        # Where all is dark there may be no chief ray.
        lines = [LINE_C, LINE_F] if light and in_colour else []
        seen = [chief(replace(lens, wavelength=line), height, distance)[0] for line in lines]
        middle = chief(lens, height, distance)[0] if light else math.nan
        figures.append(
            FieldFigures(
                height,
                {line: _rays(lens, height, distance, line) if light else _DARK for line in wavelengths},
                light,
                -height / (scale * middle) - 1 if height else 0.0,
                # What is seen farther out from the same position is imaged nearer to the axis.
                lens.mla_distance * (seen[1] - seen[0]) if seen else None,
                _transfer(lens, height, distance, frequencies)
                if frequencies and light
                else np.full((2, len(frequencies)), math.nan),
            )
        )
    return figures


def chief(lens: RealLens, height: float, distance: float) -> Pair:
    """Return Y/g of the chief ray of a height on the MLA in an object plane, and Y in mm where the lens begins.

    Parameters
    ----------
    lens, height : RealLens, float
        As for `ray_paths`.
    distance : float
        Distance g of the object plane in millimetres; where it is negative, infinity.
    """
    (_, y, z), (_, t), _ = lens.trace((0.0, height), (0.0, float(lens.chief_slope(height))))
    nearness = max(0.0, 1 / distance)
    return float(y * nearness + (1 - z * nearness) * t), float(y + (lens.front - z) * t)


def _passing(traced: Callable[[Doubles, Doubles], Any], middle: float, reach: float) -> tuple[Doubles, float]:
    """Return what is traced from a grid about (0, `middle`), of the rays that pass the lens, and their area.

    All rays pass within `reach` of the middle and of the axis.
    """
    high = np.array([reach + abs(middle), reach + abs(middle) + middle])
    low = [0, 2 * middle] - high
    # First grids are coarse, but for the ray in the middle; each is as wide as what passes the one before.
    for across in (65, 65, 65, _ACROSS):
        x, y = np.meshgrid(*np.linspace(low, high, across).T)
        *result, is_open = traced(x.ravel(), y.ravel())
        step = (high - low) / (across - 1)
        if is_open.any() and across < _ACROSS:
            places = np.stack([x.ravel(), y.ravel()])[:, is_open]
            low = places.min(1) - step
            high = places.max(1) + step
    return np.array(result)[..., is_open], float(is_open.sum() * step.prod())


def _rays(lens: RealLens, height: float, distance: float, wavelength: float) -> Doubles:
    """Return the rays of the point that the chief ray of a height meets, as `FieldFigures` holds them."""
    seen, entered = chief(lens, height, distance)
    nearness = max(0.0, 1 / distance)
    lens = replace(lens, wavelength=wavelength)

    def traced(x: Doubles, y: Doubles) -> Any:
        slope = (-x * nearness, seen - y * nearness)
        scale = 1 - lens.front * nearness
        place, turned, is_open, _ = lens.through((x, y, np.full_like(x, lens.front)), tuple(t / scale for t in slope))
        return place[0], place[1] - height, *turned, is_open

    rays, _ = _passing(traced, entered, 1.5 * lens.front_bounds[0])
    return rays if rays.size else _DARK


def _open_area(lens: RealLens, height: float) -> float:
    """Return the open area of the exit pupil in square millimetres, as a height on the MLA sees it."""
    middle = height + lens.pupil.distance * float(lens.chief_slope(height))
    return _passing(lambda x, y: (x, lens.ray((x, y), (0 * x, height + 0 * x))[2]), middle, lens.reach)[1]


def _transfer(lens: RealLens, height: float, distance: float, frequencies: Sequence[float]) -> Doubles:
    """Return the contrasts (2, n) of a point's image at frequencies in cycles per mm, as `FieldFigures` has them."""
    g = min(distance, FAR)
    point = np.array([0.0, g * chief(lens, height, distance)[0], g])
    light = lens.waves_of_one(point)
    reach = light.pupil.distance
    wavelength = in_millimetres(lens.light)

    def field(alpha: Doubles, beta: Doubles) -> Doubles:
        away = reach / np.sqrt(1 - alpha**2 - beta**2)
        pupil = alpha * away, height + beta * away
        waves = (light.length(pupil) + away) / wavelength
        amplitude = light.amplitude(pupil, point) * away**2 * light.is_open(pupil)
        return amplitude * np.exp(2j * math.pi * waves)

    slopes = (light.bundle[0] - [0.0, height]) / reach
    cosines = slopes / np.sqrt(1 + (slopes**2).sum(1, keepdims=True))
    # Rays of the fit are sparse, and the pupil may reach a little beyond them.
    margin = 0.05 * np.ptp(cosines, 0)
    cosines = np.meshgrid(*np.linspace(cosines.min(0) - margin, cosines.max(0) + margin, 256).T)
    whole = field(*cosines)
    steps = [(0.0, wavelength * frequency) for frequency in frequencies]
    contrasts = [
        [abs(np.vdot(whole, field(cosines[0] + step[axis], cosines[1] + step[1 - axis]))) for step in steps]
        for axis in (0, 1)
    ]
    return np.array(contrasts) / np.vdot(whole, whole).real


def ray_paths(lens: RealLens, height: float, count: int = 7) -> Pair:
    """Return ray paths, in a plane with the axis, from a position on the MLA through all surfaces to before the lens.

    Parameters
    ----------
    lens : RealLens
        The main lens.
    height : float
        Distance of the position from the axis in millimetres.
    count : int
        Rays, evenly over what the lens lets through.

    Returns
    -------
    z, y : float64 arrays (surfaces + 2, count)
        Their positions in the camera frame: on the MLA, on each surface, and a quarter of the distance to the MLA
        before the lens; NaN where no ray passes the lens.
    """
    slopes = (np.linspace(-1, 1, _ACROSS) * lens.reach - height) / lens.pupil.distance
    _, _, is_open = lens.trace((0.0 * slopes, np.full_like(slopes, height)), (0.0 * slopes, slopes))
    passing = slopes[is_open] if is_open.any() else np.array([math.nan])
    slopes = np.linspace(passing[0], passing[-1], count)
    N = 1 / np.sqrt(1 + slopes**2)
    point = (0.0 * slopes, np.full(count, height / lens.scale), np.full(count, -lens.back_distance / lens.scale))
    direction = (0.0 * slopes, slopes * N, N)
    vertex = lens.front / lens.scale - lens.numbers.length
    z = [vertex + point[2]]
    y = [point[1]]
    for surface in lens.backwards:
        vertex += surface.gap
        point, direction, _, _ = sequential.follow([surface], point, direction)
        # A plane has a single height.
        z.append(vertex + point[2] + 0.0 * slopes)
        y.append(point[1])
    before = np.full(count, (lens.front + 0.25 * lens.mla_distance) / lens.scale)
    y.append(y[-1] + (before - z[-1]) * direction[1] / direction[2])
    return lens.scale * np.array([*z, before]), lens.scale * np.array(y)


def behind_lens(
    lens: Prescription, pupil: float = 0.0, angles: Sequence[float] = ()
) -> tuple[RealLens, float, dict[float, float]]:
    """Return a lens before its image plane, the object's distance, and the fields' image heights by angle.

    Parameters
    ----------
    lens : Prescription
        The lens. Without its designer's image plane, the paraxial one of the object is taken.
    pupil : float
        Diameter in millimetres of the entrance pupil; 0: the designer's. The stop opens to where the ray from the axis
        at the edge of this pupil crosses it.
    angles : sequence of float
        Fields in degrees. Default: the designer's, or else 0; of one or two, 0, 0.7 and 1 times the largest.

    Returns
    -------
    tuple
        The lens, the image plane in place of the MLA; the object's distance from the front principal plane, and the
        heights of chief rays in the image, both in millimetres.
    """
    numbers = lens.paraxial
    from_pupil = lens.object_distance + numbers.entrance_pupil
    if pupil := pupil or lens.pupil_diameter:
        slope = pupil / 2 / from_pupil
        N = 1 / math.hypot(1, slope)
        start = 0.0, pupil / 2 - numbers.entrance_pupil * slope, 0.0
        *before, stop = sequential.elements(lens, lens.wavelength)[: lens.stop + 1]
        lit = [*before, sequential.widened(stop, math.inf)]
        (_, edge, _), _, is_open, _ = sequential.follow(lit, start, (0.0, slope * N, N))
        if not is_open:
            warn(f"entrance pupil of {pupil:g} mm: surfaces before the stop cut off the ray at its edge")
        lens = replace(lens.with_surface(lens.stop, semi_aperture=abs(edge)), pupil_diameter=pupil)
    distance = lens.object_distance + numbers.front_principal
    image = conjugate_distance(numbers.focal_length, distance) + numbers.rear_principal
    image = lens.image_distance or image
    refuse_if(
        not max(0.0, numbers.exit_pupil) < image < math.inf,
        f"image plane {image:.4g} mm behind the last vertex: no detector can stand there, as it must be finite, behind "
        "the lens and its exit pupil",
    )
    shown = RealLens(lens, numbers.focal_length, lens.paraxial.entrance_radius, image - numbers.rear_principal)
    fields = angles or lens.fields or (0.0,)
    heights = {}
    for angle in sorted({fraction * max(fields) for fraction in FIELDS} if len(fields) < 3 else fields):
        slope = math.tan(math.radians(angle)) * (1.0 if math.isinf(distance) else from_pupil / distance)
        height = shown.mla_distance * slope
        step = 1.0
        for _ in range(30 if slope else 0):
            step = -slope / chief(shown, height, distance)[0]
            height *= step
        refuse_if(
            not abs(step - 1) < 1e-6, f"field of {angle:g} degrees: no chief ray of it was found in the image plane"
        )
        heights[angle] = height
    return replace(shown, corner=max(height, 1e-3 * image)), distance, heights
