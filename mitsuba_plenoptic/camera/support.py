"""The table of support: what each use of a camera makes of the camera's parameters, and the one check of it.

A use takes a parameter exactly unless the table has an entry for both: an approximation, with how it is made; a
refusal, with its reason and what works instead; or a remark why the parameter changes nothing. `require_support` is
called where a camera enters a computation, and prints the refusal; docs/reference/models.md prints the whole table.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

from ..errors import InputError, short_repr
from .entry import ADDED, Condition, Support, Use, approximate, no_effect, refused
from .geometry import NO_ARRAY_HERE, CameraGeometry
from .parameters import PARAMETERS

_SCENES = Use.SCENES | Use.SCENE_DERIVATIVES
_PATCHES = Use.POINTS | Use.SCENE_POINTS | Use.POINT_DERIVATIVES
_FIELDS_OF_POINTS = Use.FULL_FIELDS | Use.POINT_FIELDS | Use.COHERENT_POINTS | Use.WAVEFRONTS
_RECONSTRUCTIONS = Use.RESPONSES | Use.FIELDS
_ROUND_PUPILS = Use.SMALL_LENSES | Use.ROUND_PUPILS | Use.CALIBRATION
_REGULAR = Use.FIELD_DERIVATIVES | Use.RAY_DERIVATIVES
_STRAIGHT = Use.KERNELS | _REGULAR
_WHITE = Use.DECODING | Use.WHITE_IMAGES
_GEOMETRY = Use.RAY_REFOCUSING | Use.DECODING | Use.WHITE_IMAGES
_RECORDED = (
    Use.RAYS
    | _SCENES
    | _PATCHES
    | Use.FULL_FIELDS
    | Use.SMALL_LENSES
    | Use.RAY_SPREADS
    | Use.SPREAD_BANKS
    | Use.WHITE_IMAGES
)

_NO_ARRAY = Condition("without an array", lambda camera: not camera.has_array)
_TWO_PITCHES = Condition("of two", lambda camera: camera.mla_pitches[0] != camera.mla_pitches[1])
_GAPS = Condition("with gaps between lenses", lambda camera: not camera.lattice.fills)
_PRESCRIPTION = Condition("behind a prescription", lambda camera: camera.lens_data.traced_surfaces)
_COLLIMATOR = Condition("behind a collimator", lambda camera: camera.has_array and not camera.refocuses)
_NOT_THIN = Condition("behind other than thin lenses", lambda camera: not camera.lens_data.is_thin)
_STOP_IMAGE = Condition("with the array in the image of the stop", lambda camera: camera.lens_data.images_stop)
_FOURIER = Condition(
    "in the Fourier arrangement", lambda camera: camera.objective is not None and camera.lens_data.images_stop
)
_OBJECT_IMAGE = Condition(
    "behind an objective, with the array in the image of the object",
    lambda camera: camera.objective is not None and not camera.lens_data.images_stop,
)
_UNWEIGHTED = Condition(
    "behind a prescription, or with the array in the image of the stop",
    lambda camera: camera.lens_data.traced_surfaces or camera.lens_data.images_stop,
)
_NO_COMMON_PUPIL = Condition(
    "behind an objective or a prescription",
    lambda camera: camera.objective is not None or camera.prescription is not None,
)
_PLACES = Condition("of places", lambda camera: camera.mla_jitter[0] > 0)
_UNEQUAL = Condition(
    "of focal lengths that spread light over more than 0.35 pixels",
    # The light of one that is off by this fraction is as wide on the detector as the fraction of its lens.
    lambda camera: (
        camera.mla_jitter[1] * max(camera.mla_pitches) * camera.detector_distance / min(camera.mla_focal_lengths)
        > 0.35 * camera.pixel_size
    ),
)

_of_points = partial(refused, Use.POINT_DERIVATIVES | Use.POINT_RAYS, instead="CaptureOperator.forward")
_of_small_lenses = partial(refused, Use.SMALL_LENSES)
_goes_back = partial(refused, _RECONSTRUCTIONS, instead="method ray")

# Reasons that several parameters share.
_UNEVEN = (
    refused(
        Use.SCENE_POINTS,
        "the light of surfaces' points is weighted over evenly open, round pupils",
        "CaptureOperator, which takes it for points that are given",
    ),
    refused(
        Use.COHERENT_POINTS | Use.WAVEFRONTS | Use.POINT_DERIVATIVES | Use.POINT_RAYS,
        "points are summed over an evenly open, round pupil",
        "CaptureOperator.forward, which takes it",
    ),
    _goes_back("the light goes back through an evenly open, round pupil"),
    refused(_ROUND_PUPILS, "the formulas are those of an evenly open, round pupil"),
    refused(
        Use.FULL_FIELDS | Use.POINT_FIELDS,
        "exit pupils of prescriptions are sampled without weights",
        "method patch",
        _PRESCRIPTION,
    ),
)
_NOT_ROUND = (
    refused(
        _SCENES,
        "the pupil's table holds one quarter of one round pupil for all lenses",
        "ray captures or CaptureOperator",
        Condition("behind an array", lambda camera: camera.has_array),
    ),
    *_UNEVEN,
)
_UNEQUAL_LENSES = (
    _of_points("they are those of equally bright lenses and pupils"),
    refused(Use.SMALL_LENSES | Use.FIELD_DERIVATIVES, "the light of one lens stands for that of others", "reconstruct"),
)
_UNEVEN_LENSES = approximate(
    Use.POINTS,
    "strong ones: patches miss up to 1.3 per cent of a spread by full_field, 0.2 to 0.5 behind equal lenses, and 3 in "
    "focus between unequal ones that `mla_cra` moves",
)
_ZONES = "zones of lenses share the pupil of their middle, and other light than that is divided out"
_BEHIND_LENSES = (
    _of_points("they are those of pixels that record all directions alike"),
    _goes_back("light goes back from pixels without a weight by direction"),
)
_NO_DERIVATIVE = refused(
    Use.SCENE_DERIVATIVES, "rays fixed in the scene are traced again through plain thin lenses alone", "differences"
)
_MORE_TERMS = approximate(
    _GEOMETRY,
    "rays go back through an ideal main lens and the centres of microlenses; depth maps correct for aberrations",
)
_STAYS = "it stays in the image, whose brightness is corrected"
_MIXES = (
    approximate(Use.RESPONSES, f"deconvolved inverts it; of incoherent {_STAYS}"),
    approximate(Use.FIELDS | Use.RAY_REFOCUSING | Use.DECODING, _STAYS),
)
_BEFORE_DETECTOR = (
    refused(
        Use.POINT_FIELDS | Use.COHERENT_POINTS, "they are the light before the detector", "CaptureOperator.forward"
    ),
    refused(Use.WAVEFRONTS, "they are the light before the detector"),
    refused(Use.POINT_RAYS, "they are the light before the detector", "waves of points"),
)
_DISPERSES = (
    approximate(Use.RAYS, "mono variants have no wavelengths: rays see the focal length at the line d"),
    approximate(Use.RAY_SPREADS, "without a wavelength rays see the focal length at the line d"),
    approximate(_GEOMETRY, "rays go back with the focal length at the line d"),
    refused(Use.POINT_RAYS, "rays of points have no wavelength", "waves of points"),
    refused(Use.POINT_DERIVATIVES, "they are those of fixed focal lengths", "the camera's at_wavelength"),
    _NO_DERIVATIVE,
)

SUPPORT: dict[str, tuple[Support, ...]] = {
    "focal_length": (no_effect(_WHITE, "the pupil is seen through the centres of lenses, however it bends light"),),
    "aperture_radius": (),
    "aperture_blades": (
        *_NOT_ROUND,
        approximate(
            Use.POINTS, "edges along rows or diagonals of the lattice: patches miss up to 1.2 per cent of a spread"
        ),
    ),
    "aperture_image": _NOT_ROUND,
    "pupil_apodisation": (*_UNEVEN, _NO_DERIVATIVE),
    "mla_distance": (),
    "focus_distance": (),
    "mla_focal_length": (),
    "mla_pitch": (_of_small_lenses("a lens must cover square pixels", "one pitch", _TWO_PITCHES),),
    "mla_lattice": (
        refused(
            Use.SCENE_POINTS
            | Use.SCENE_DERIVATIVES
            | Use.POINT_RAYS
            | _RECONSTRUCTIONS
            | _GEOMETRY
            | Use.LENS_CENTRES
            | Use.CALIBRATION
            | Use.FITS,
            "the camera has no microlens array",
            "",
            _NO_ARRAY,
        ),
        _of_small_lenses("a lens must cover square pixels", "square"),
    ),
    "mla_rotation": (_of_small_lenses("a lens must cover upright pixels"),),
    "mla_offset": (),
    "mla_tilt": (
        refused(
            _PATCHES | _FIELDS_OF_POINTS | Use.POINT_RAYS | Use.RAY_SPREADS,
            "the array is one plane across the axis for waves of points",
            "captures of scenes",
        ),
        refused(Use.SMALL_LENSES | _STRAIGHT, "the light is that of an upright array", "reconstruct"),
        _NO_DERIVATIVE,
    ),
    "mla_aperture": (
        no_effect(_WHITE, "near the microlenses' focus the pupil's image does not depend on a lens's width"),
        refused(Use.POINT_RAYS, "rays of points are drawn over arrays without gaps only", "waves of points", _GAPS),
        _of_small_lenses("their kernels are those of square lenses"),
    ),
    "mla_fill": (
        no_effect(_WHITE, "near the microlenses' focus the pupil's image does not depend on a lens's width"),
        refused(Use.POINT_RAYS, "rays of points are drawn over arrays without gaps only", "waves of points", _GAPS),
    ),
    "mla_transmissions": (*_UNEQUAL_LENSES, _UNEVEN_LENSES, _NO_DERIVATIVE),
    "vignetting": (
        *_UNEQUAL_LENSES,
        approximate(Use.RESPONSES, _ZONES),
        refused(
            Use.COHERENT_POINTS | Use.WAVEFRONTS, "all points of one field share one pupil", "CaptureOperator.forward"
        ),
        refused(
            Use.POINTS | Use.FULL_FIELDS | Use.POINT_FIELDS | Use.SCENE_POINTS,
            "waves of points are weighted where the array is in the image behind thin lenses and objectives alone",
            "captures of scenes by rays or signed rays",
            _UNWEIGHTED,
        ),
        refused(
            Use.RAYS | Use.SCENES | Use.RAY_SPREADS | Use.WHITE_IMAGES,
            "the array is in the stop's image, which all pixels see",
            "mla_transmissions",
            _STOP_IMAGE,
        ),
        _NO_DERIVATIVE,
    ),
    "mla_medium": (refused(Use.CALIBRATION, "it is not told from other distances"),),
    "mla_absorption": (*_BEHIND_LENSES, _NO_DERIVATIVE),
    "mla_shape": (
        _goes_back("the light goes back through parabolic microlenses"),
        _of_points("they are those of parabolic microlenses"),
        refused(Use.CALIBRATION, "they find the focal lengths of parabolic microlenses"),
        approximate(_GEOMETRY, "the lenses count as parabolas of their focal length"),
        _NO_DERIVATIVE,
    ),
    "detector_distance": (),
    "detector_width": (),
    "resolution": (),
    "crop_offset": (),
    "crop_size": (),
    "lens_model": (_MORE_TERMS,),
    "distortion": (
        refused(
            _PATCHES | _FIELDS_OF_POINTS | Use.POINT_RAYS,
            "the phases on the pupil are those of images without it",
            "captures of scenes",
        ),
        _goes_back("the light goes back to undistorted images", instead="method ray, which ignores it"),
        _MORE_TERMS,
        _NO_DERIVATIVE,
    ),
    "wavefront": (
        approximate(Use.FIELDS, "the light goes back through a lens without aberrations"),
        _MORE_TERMS,
        _NO_DERIVATIVE,
    ),
    "phase_screen": (
        approximate(Use.SCENES, "by its slopes, which must vary little between points of the pupil that interfere"),
        _NO_DERIVATIVE,
        refused(
            _PATCHES | Use.POINT_RAYS, "patches sample smooth phases only", "CaptureOperator with method full_field"
        ),
        _goes_back("the light goes back through a lens without it", instead="method ray, which ignores it"),
        _MORE_TERMS,
    ),
    "mla_jitter": (
        refused(
            _PATCHES | Use.POINT_RAYS,
            "patches treat the array as periodic",
            "CaptureOperator with method full_field, or captures of scenes",
        ),
        refused(Use.RESPONSES, "lenses count as equal", "method ray", _UNEQUAL),
        approximate(Use.RESPONSES, "lenses count as equal"),
        refused(_STRAIGHT, "the light is that of a regular array", "reconstruct", _PLACES),
        approximate(Use.FIELDS, "lenses count as equal; micro-images are moved back to regular places"),
        approximate(_GEOMETRY, "lenses count as equal and, when decoding, as regular"),
        _of_small_lenses("their responses repeat with the lenses"),
        _NO_DERIVATIVE,
    ),
    "mla_warp": (
        _UNEVEN_LENSES,
        refused(
            Use.POINT_DERIVATIVES | Use.POINT_RAYS | Use.RECONSTRUCTION_DERIVATIVES,
            "they are those of a regular lattice",
            "differences",
        ),
        _of_small_lenses("their responses repeat with the lenses"),
        _NO_DERIVATIVE,
    ),
    "mla_figure_error": (
        refused(_SCENES, "kernels are those of smooth microlenses", "ray captures, or CaptureOperator in full fields"),
        refused(
            _PATCHES | Use.POINT_RAYS, "patches treat the array as periodic", "CaptureOperator with method full_field"
        ),
        _goes_back("the light goes back through smooth lenses without it", instead="method ray, which ignores it"),
        approximate(_GEOMETRY, "lenses count as perfect"),
    ),
    "mla_seed": (),
    "mla_cra": (
        _UNEVEN_LENSES,
        approximate(
            Use.RAYS | Use.SCENES,
            "apertures keep their size: lenses whose cells shrink by one per cent record one per cent too much",
        ),
        approximate(_RECONSTRUCTIONS | _GEOMETRY | _REGULAR, "the lenses are those of the nearest regular array"),
        _of_points(
            "they are those of a regular lattice, from which lenses are displaced by a hundredth of a pixel or more"
        ),
        _NO_DERIVATIVE,
    ),
    "detector_blur": (
        approximate(
            _RECORDED,
            "it moves what pixels hold, not the light within them: a blur of a third of a pixel is off by 3 % of a "
            "small lamp's image, one of a pixel by 1.3 %",
        ),
        *_BEFORE_DETECTOR,
        *_MIXES,
    ),
    "pixel_crosstalk": (*_BEFORE_DETECTOR, *_MIXES),
    "stray_light": (*_BEFORE_DETECTOR, *_MIXES),
    "stray_width": _MIXES,
    "pixel_response": (*_BEHIND_LENSES, _of_small_lenses("the responses contain it"), _NO_DERIVATIVE),
    "main_lens": (
        approximate(Use.RESPONSES, _ZONES, _PRESCRIPTION),
        refused(
            Use.RAYS | Use.WHITE_IMAGES | _SCENES | Use.SCENE_POINTS | Use.RAY_SPREADS | Use.POINT_RAYS,
            "the array is in the image of the pupil, so that no stop bounds its micro-images",
            "CaptureOperator with method full_field",
            _COLLIMATOR,
        ),
        refused(
            Use.SCENE_DERIVATIVES | Use.SCENE_POINTS | Use.POINT_RAYS,
            "lenses see parts of the stop, not its image",
            "CaptureOperator with method full_field",
            _FOURIER,
        ),
        refused(
            Use.POINTS,
            "light covers all of the stop's image, in which the array stands",
            "CaptureOperator with method full_field",
            _COLLIMATOR,
        ),
        approximate(Use.POINTS, "points of a depth share one spread, moved by splines: errors of 0.1 %", _FOURIER),
        refused(
            _RECONSTRUCTIONS | Use.RAY_REFOCUSING | Use.DECODING,
            "the array is in the image of a telescope's pupil, from which captures are not refocused",
            "mitsuba_plenoptic.wavefront",
            _COLLIMATOR,
        ),
        refused(
            Use.SCENE_POINTS | Use.POINT_DERIVATIVES | Use.SMALL_LENSES | Use.FITS | Use.SPREAD_BANKS,
            "points before an objective lie about its native plane, and the computation is of distances from a lens",
            "",
            Condition("behind an objective", lambda camera: camera.objective is not None),
        ),
        refused(
            Use.FITS | Use.SPREAD_BANKS | Use.LENS_CENTRES | Use.CALIBRATION | Use.POINT_DERIVATIVES,
            "the array is in the image of a telescope's pupil, and shows slopes of a wavefront in place of points",
            "mitsuba_plenoptic.wavefront.spot_slopes",
            _COLLIMATOR,
        ),
        refused(
            Use.FIELDS | Use.RAY_REFOCUSING,
            "behind an objective captures are reconstructed by the camera's own point spreads",
            "method incoherent or deconvolved",
            _OBJECT_IMAGE,
        ),
        refused(
            Use.FIELDS | Use.RAY_DERIVATIVES,
            "no wave goes back from lenses that each see all of the object, and rays are not differentiated",
            "method ray, incoherent or deconvolved of reconstruct",
            _FOURIER,
        ),
        refused(
            Use.DECODING,
            "behind an objective micro-images are not those of a thin lens's pupil",
            "method deconvolved",
            _OBJECT_IMAGE,
        ),
        refused(Use.WAVEFRONTS, "a wavefront fills one pupil, that of all points", "", _NO_COMMON_PUPIL),
        refused(
            Use.COHERENT_POINTS,
            "points are summed over the pupil of a thin main lens",
            "CaptureOperator.forward",
            _NOT_THIN,
        ),
        refused(
            Use.DECODING, "captures are decoded by the centre of a thin lens's pupil", "reconstructions", _PRESCRIPTION
        ),
        refused(
            Use.LENS_CENTRES | Use.CALIBRATION | Use.FIELD_DERIVATIVES,
            "micro-images are centred as behind thin main lenses",
            "",
            _NOT_THIN,
        ),
        _NO_DERIVATIVE,
    ),
    "glass": _DISPERSES,
    "mla_glass": _DISPERSES,
}
"""Entries of each parameter; an extension's parameter brings its own."""


def support_of(name: str) -> tuple[Support, ...]:
    """Return the entries of a parameter; an added one without any is known to ray captures alone."""
    entry = PARAMETERS[name]
    if name in SUPPORT:
        return SUPPORT[name]
    return ADDED if entry.support is None else tuple(entry.support)


def entries_at(camera: CameraGeometry, use: Use) -> Iterator[tuple[str, Any, Support]]:
    """Yield the parameters of a camera that are not at their defaults, with their values and entries for a use."""
    for name, parameter in PARAMETERS.items():
        value = getattr(camera, parameter.attribute)
        if value is None or value == parameter.default or (isinstance(value, tuple) and not any(value)):
            continue
        for entry in support_of(name):
            if use & entry.uses and (entry.where is None or entry.where.holds(camera)):
                yield name, value, entry


def is_supported(camera: CameraGeometry, use: Use) -> bool:
    """Return whether the table refuses no parameter of a camera for a use."""
    return not any(entry.is_refusal for _, _, entry in entries_at(camera, use))


def require_support(camera: CameraGeometry, use: Use) -> None:
    """Refuse a camera with a parameter that the table refuses for a use."""
    for name, value, entry in entries_at(camera, use):
        if entry.is_refusal:
            raise InputError(refusal(name, value, use & entry.uses, entry))


def refusal(name: str, value: Any, use: Use, entry: Support) -> str:
    """Return the sentence that refuses a value of a parameter."""
    if entry.where is _NO_ARRAY:
        return f"{use.words}: {NO_ARRAY_HERE}"
    instead = f"use {entry.instead}, or leave it out" if entry.instead else "leave it out"
    text = value.label if name == "main_lens" else value if isinstance(value, str) else short_repr(value)
    return f"{name} = {text}: {use.words} refuse it: {entry.words}; {instead}"
