"""The table of a camera's parameters, from which all code that handles them is derived.

The record and its constructor, checks, files, scene files, documentation, and the vectors that fits, calibrations,
gradients and searches work with all read this table. A new parameter is one entry here, and a formula that uses it.
"""

import math
from collections import ChainMap
from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from ..array import APERTURES, LATTICES, NO_LATTICE, MicrolensShape, known_shape
from ..errors import (
    FULL_TURN,
    LONGEST,
    MOST_ABERRATIONS,
    MOST_PIXELS,
    STEEPEST_TILT,
    require_choice,
    require_count,
    require_length,
    require_lengths,
    require_number,
    require_numbers,
    require_pair,
    require_pairs,
    require_pitches,
    require_warp,
)
from ..extension import entries, place
from ..prescription import Glass, LensData, known_glass, known_lens, read_lens
from .aperture import Aperture, Blades, known_blades, known_image, require_alone
from .entry import Captures, Form, Parameter, one, one_if_equal, one_if_single, record
from .lens_transmissions import LensTransmissions, known_transmissions
from .phase_screen import PhaseScreen, known_screen
from .stray_light import StrayLight, known_stray_light
from .vignetting import Vignetting, known_vignetting

MOST_APODISATION = 4.0
"""Largest coefficient of a pupil's transmission, which is then at most 9 times as high at the rim as at the centre."""

_pixels = partial(require_pair, meaning="(columns, rows)")
_place = partial(require_number, minimum=-LONGEST, maximum=LONGEST)
_angle = partial(require_number, minimum=-FULL_TURN, maximum=FULL_TURN)

_Glass = Glass | str | float | dict[str, Any]
_Numbers = Parameter[Sequence[float], tuple[float, ...]]
_Length = Parameter[float | None, float]
_Number = Parameter[float, float]
_Word = Parameter[str, str]


@record
class CoreParameters:
    """The table of the core's parameters."""

    focal_length: _Length = Parameter(
        default=None,
        check=require_length,
        words="Focal length :math:`f_1` of the main lens.",
        otherwise="80, or that of `main_lens`, which is scaled to what is given",
        unit="mm",
        gradients=Captures.ALL & ~Captures.EDGES,
        in_all_files=True,
    )
    aperture_radius: _Length = Parameter(
        default=None,
        check=require_length,
        words=(
            "Radius :math:`D_1/2` of the main lens, as for the sensor ``thinlens``; of its entrance pupil if it is a "
            "`main_lens`, which is stopped down to it. Only the edge of the pupil moves with it, so that ray captures "
            "have no gradient by it."
        ),
        otherwise="5, or `main_lens` fully open",
        unit="mm",
        gradients=Captures.POINTS,
        in_all_files=True,
    )
    aperture_blades: Parameter[int | Sequence[float] | Blades | None, Blades | None] = Parameter(
        default=None,
        check=known_blades,
        words=(
            "Number of blades, 3 to 64, of a thin main lens's aperture: a regular polygon in the circle of "
            "`aperture_radius`; a second number is the angle in degrees, from +x to +y of the camera frame, of one of "
            "its corners. The exposure falls with the area: a scene of radiance 1 reads the open part of the circle; "
            "behind microlenses, closed parts of micro-images are dark."
        ),
        form=Form.SEVERAL,
        takes="int or (int, float)",
        otherwise="a round aperture",
        fit=require_alone,
    )
    aperture_image: Parameter[Any, Aperture | None] = Parameter(
        default=None,
        check=lambda _, value: known_image(value),
        words=(
            "Picture in a thin main lens's aperture, see `Aperture`: values from 0 to 1, by which the power of the "
            "light is multiplied, over the square around the circle of `aperture_radius`; as a file, as JSON text or a "
            "JSON file of its parameter, in Python also as an array. Exposure and captures are as by `aperture_blades`."
        ),
        form=Form.PICTURE,
        otherwise="a round aperture",
        fit=require_alone,
    )
    pupil_apodisation: _Numbers = Parameter(
        default=(0.0, 0.0),
        check=partial(require_numbers, count=2, minimum=-MOST_APODISATION, maximum=MOST_APODISATION),
        words=(
            "Coefficients a2 and a4, from -4 to 4, of the transmission of the main lens's pupil, :math:`T(r) = "
            "\\max(0, 1 + a_2 (r/R)^2 + a_4 (r/R)^4)`: the part of the power that passes at a distance r from the "
            "centre of the exit pupil of radius R, of an objective from that of its back focal plane, relative to the "
            "centre. It may rise above 1. A scene of radiance 1 reads T within wide micro-images."
        ),
        form=Form.PLACE,
        otherwise="an evenly open pupil",
        parts=("a2", "a4"),
        fit=require_alone,
    )
    mla_distance: _Length = Parameter(
        default=None,
        check=require_length,
        words=(
            "Distance :math:`b` from the main lens, from the rear principal plane of `main_lens`, to the microlens "
            "array (MLA)."
        ),
        otherwise="120, unless `focus_distance` is given",
        unit="mm",
        gradients=Captures.ALL,
        in_all_files=True,
    )
    focus_distance: _Length = Parameter(
        default=None,
        check=partial(require_length, finite=False),
        words=(
            "Instead of `mla_distance`: distance of the object plane that is in focus on the MLA, :math:`1/g + 1/b = "
            "1/f_1`, larger than `focal_length`; it may be infinite. A camera has it whatever was given: infinite if "
            "the MLA stands in the focal plane, negative (no real plane) if it stands before that, and 0, the native "
            "object plane, for an objective."
        ),
        otherwise="what follows from `mla_distance`",
        unit="mm",
        instead_of="mla_distance",
    )
    mla_focal_lengths: Parameter[float | Sequence[float] | None, tuple[float, ...]] = Parameter(
        default=None,
        check=require_lengths,
        words=(
            "Focal length :math:`f_2` of a microlens. Three on a hexagonal lattice make a multi-focus array: three "
            "types of lenses interleaved, so that no two neighbours are alike, the first on the lens with the indices "
            "(0, 0)."
        ),
        form=Form.SEVERAL,
        takes="float or three floats",
        otherwise="0.512, or that of `mla_shape`",
        unit="mm",
        gradients=Captures.ALL,
        shortest=one_if_single,
        in_all_files=True,
        alias="mla_focal_length",
        of_array=True,
    )
    mla_pitches: Parameter[float | Sequence[float], tuple[float, float]] = Parameter(
        default=0.064,
        check=require_pitches,
        words=(
            "Pitch :math:`D_2` of the microlens lattice, the distance of neighbouring centres. Of two the first is "
            "that along the rows and the second that across them: the lattice is stretched, its cells with it."
        ),
        form=Form.SEVERAL,
        takes="float or two floats",
        unit="mm",
        parts=("pitch_along", "pitch_across"),
        gradients=Captures.ALL,
        shortest=one_if_equal,
        in_all_files=True,
        alias="mla_pitch",
        of_array=True,
    )
    mla_lattice: _Word = Parameter(
        default="square",
        check=partial(require_choice, choices=ChainMap[str, Any]({NO_LATTICE: None}, LATTICES)),
        words=(
            "Arrangement of the microlenses, see `mitsuba_plenoptic.array`. ``square``: the corner of four lenses "
            "is on the axis. ``hexagonal``: rows along x, every second one offset by half a pitch; the centre of a "
            "lens is on the axis. Either covers the whole plane. ``none``: an ordinary camera without an array, whose "
            "detector is at `mla_distance`; it takes no parameter of an array."
        ),
        form=Form.WORD,
        takes='{"square", "hexagonal", "none"}',
    )
    mla_rotation: _Number = Parameter(
        default=0.0,
        check=_angle,
        words=(
            "Angle of the lattice about the axis in degrees, counter-clockwise in the camera frame, that is from left "
            "to up and clockwise as one looks at the capture."
        ),
        unit="degrees",
        gradients=Captures.ALL & ~Captures.SCENES,
        scale=one,
        of_array=True,
    )
    mla_offset: Parameter[tuple[float, float], tuple[float, float]] = Parameter(
        default=(0.0, 0.0),
        check=partial(require_pair, meaning="(x, y)", rule=_place),
        words="Position, x and y in the camera frame, of the point of the lattice that is on the axis by default.",
        form=Form.PLACE,
        unit="mm",
        parts=("offset_x", "offset_y"),
        gradients=Captures.ALL,
        scale=lambda camera: min(camera.mla_pitches),
        of_array=True,
    )
    mla_tilt: _Numbers = Parameter(
        default=(0.0, 0.0),
        check=partial(require_numbers, count=2, minimum=-STEEPEST_TILT, maximum=STEEPEST_TILT),
        words=(
            "Angles in degrees, up to 5, by which the array rises towards the main lens along x and along y. Pitches, "
            "rotation and offset are those of its projection along the axis, and each lens still faces the main lens."
        ),
        form=Form.PLACE,
        unit="degrees",
        parts=("tilt_x", "tilt_y"),
        of_array=True,
    )
    mla_aperture: _Word = Parameter(
        default="cell",
        check=partial(require_choice, choices=APERTURES),
        words=(
            "Shape of a lens. ``cell``: that of its cell, a square or a hexagon. ``circle``: a disc. The rest of the "
            "cell is opaque."
        ),
        form=Form.WORD,
        takes='{"cell", "circle"}',
        of_array=True,
    )
    mla_fill: _Number = Parameter(
        default=1.0,
        # The thinnest line would let no light through.
        check=partial(require_number, positive=True, minimum=1e-3, maximum=1),
        words="Width of a lens's aperture over the pitch, at most 1; of a disc's over the shorter pitch.",
        gradients=Captures.ALL & ~Captures.SCENES,
        highest=1.0,
        of_array=True,
    )
    mla_transmissions: Parameter[Any, LensTransmissions | None] = Parameter(
        default=None,
        check=lambda _, value: known_transmissions(value),
        words=(
            "Relative brightness of single lenses, from 0 to 4, see `LensTransmissions`: a table of rows and columns "
            "of lenses around the axis, beyond which it is 1; as a file, as JSON text or a JSON file of its "
            "parameters, in Python also as an array. Reconstructions divide it out."
        ),
        form=Form.LENSES,
        otherwise="equal lenses",
        of_array=True,
    )
    vignetting: Parameter[Any, Vignetting | None] = Parameter(
        default=None,
        check=lambda _, value: known_vignetting(value),
        words=(
            "Outline, apodisation and slope of the pupil as they change over the field, see `Vignetting`: as a JSON "
            "file, its text or a dictionary of its parameters. The power of light is multiplied by it; light diffracts "
            "at the rim of `aperture_radius` alone. Reconstructions divide it out."
        ),
        form=Form.VIGNETTING,
        otherwise="the same pupil for all lenses",
        of_array=True,
    )
    mla_medium: _Number = Parameter(
        default=1.0,
        check=partial(require_number, minimum=1, maximum=4),
        words=(
            "Refractive index of the medium between the microlenses and the detector, the same at all wavelengths. "
            "`mla_focal_length` and `detector_distance` are lengths in it: parallel light converges there at the "
            "focal length."
        ),
        scale=one,
        of_array=True,
    )
    mla_absorption: _Number = Parameter(
        default=0.0,
        check=partial(require_number, minimum=0),
        words=(
            "Absorption coefficient, in 1/mm, of the medium between the microlenses and the detector, the same at all "
            "wavelengths: a path L in it transmits the fraction :math:`e^{-\\alpha L}` of the light, so that oblique "
            "light loses more."
        ),
        of_array=True,
    )
    mla_shape: Parameter[MicrolensShape | str | Path | dict[str, Any] | None, MicrolensShape | None] = Parameter(
        default=None,
        check=lambda _, value: known_shape(value),
        words=(
            "Shape of the microlenses, see `mitsuba_plenoptic.array`: a sphere, conic, asphere, a sampled surface "
            "or phase, or a diffractive lens, as a JSON file or its text, in Python also as an object or a dictionary. "
            "`mla_focal_length` follows from it, and rays refract at it exactly in either `lens_model`."
        ),
        form=Form.SHAPE,
        otherwise="a parabolic phase of the focal length",
        of_array=True,
    )
    detector_distance: _Length = Parameter(
        default=None,
        check=require_length,
        words="Distance :math:`z` from the MLA to the detector.",
        otherwise="`mla_focal_length`, the first of three",
        unit="mm",
        gradients=Captures.ALL,
        in_all_files=True,
        of_array=True,
    )
    detector_width: _Number = Parameter(
        default=8.192,
        check=require_length,
        words="Width :math:`W` that the columns of the full detector span, cropped or not; pixels are square.",
        unit="mm",
        gradients=Captures.ALL,
        in_all_files=True,
    )
    resolution: Parameter[tuple[int, int], tuple[int, int]] = Parameter(
        default=(4096, 4096),
        check=partial(_pixels, rule=partial(require_count, maximum=MOST_PIXELS)),
        words="Columns and rows of the full detector.",
        form=Form.FILM,
        in_all_files=True,
    )
    crop_offset: Parameter[tuple[int, int], tuple[int, int]] = Parameter(
        default=(0, 0),
        check=partial(_pixels, rule=partial(require_count, minimum=0, maximum=MOST_PIXELS)),
        words="Column and row of the first recorded pixel.",
        form=Form.FILM,
        in_all_files=True,
    )
    crop_size: Parameter[tuple[int, int] | None, tuple[int, int]] = Parameter(
        default=None,
        check=partial(_pixels, rule=partial(require_count, maximum=MOST_PIXELS)),
        words="Columns and rows that are recorded.",
        form=Form.FILM,
        otherwise="all from `crop_offset` on",
        in_all_files=True,
    )
    lens_model: _Word = Parameter(
        default="ideal",
        check=partial(require_choice, choices=("ideal", "parabolic")),
        words=(
            "How a thin main lens refracts, by rays and by waves. ``ideal``: stigmatic, like ``thinlens``. "
            "``parabolic``: as a thin parabolic phase, with its aberrations. By rays also how microlenses refract: "
            "``ideal`` slopes, ``parabolic`` direction cosines; by waves they are thin phases under both names."
        ),
        form=Form.WORD,
        takes='{"ideal", "parabolic"}',
        in_all_files=True,
    )
    distortion: _Numbers = Parameter(
        default=(0.0,) * 5,
        check=partial(require_numbers, count=5, minimum=-1.0, maximum=1.0),
        words=(
            "Distortion of the main lens: k1, k2, k3 (radial, in mm^-2, mm^-4, mm^-6) and p1, p2 (tangential, in "
            "mm^-1) of the map that takes the distortion away in the plane of the MLA; see "
            "`mitsuba_plenoptic.lenses.distortion`."
        ),
        form=Form.NUMBERS,
        takes="five floats",
        otherwise="none",
        unit=("mm^-2", "mm^-4", "mm^-6", "mm^-1", "mm^-1"),
        parts=("k1", "k2", "k3", "p1", "p2"),
    )
    wavefront: _Numbers = Parameter(
        default=(),
        check=partial(
            require_numbers,
            count=range(MOST_ABERRATIONS + 1),
            form=f"at most {MOST_ABERRATIONS} numbers",
            minimum=-1000.0,
            maximum=1000.0,
        ),
        words=(
            "Aberrations of the main lens: coefficients of Zernike polynomials over its pupil in Noll's order, "
            "beginning with piston, each in waves of 633 nm root mean square; up to 66, those left out are 0. Other "
            "wavelengths see the same path. Sensors expose it if it has coefficients."
        ),
        form=Form.NUMBERS,
        otherwise="none",
        gradients=Captures.ALL & ~Captures.SCENES,
        scale=one,
        unseen=1,
        room=36,
    )
    phase_screen: Parameter[PhaseScreen | str | Path | dict[str, Any] | None, PhaseScreen | None] = Parameter(
        default=None,
        check=lambda _, value: known_screen(value),
        words=(
            "Sampled path that light gains over the pupil of the main lens, in addition to `wavefront`: a turbulent "
            "atmosphere or a measured aberration; see `PhaseScreen`, in Python also as itself, or as a JSON file, its "
            "text or a dictionary of its parameters."
        ),
        form=Form.SCREEN,
        otherwise="none",
    )
    mla_jitter: _Numbers = Parameter(
        default=(0.0, 0.0),
        check=partial(require_numbers, count=2, minimum=0.0),
        words=(
            "Standard deviations of what is irregular in the array: of the lenses' positions along x and along y, in "
            "millimetres and at most 0.1 of the pitch, and of their focal lengths, relative and at most 0.1; see "
            "`mitsuba_plenoptic.fields.lens_kinds`."
        ),
        form=Form.PLACE,
        of_array=True,
    )
    mla_warp: _Numbers = Parameter(
        default=(),
        check=require_warp,
        words=(
            "Smooth displacement of the lenses from their regular positions (x, y) in millimetres, as by a relay or a "
            "mount: up to 14 coefficients, of :math:`x^2, xy, y^2` in 1/mm and of :math:`x^3, x^2 y, x y^2, y^3` in "
            "1/mm², first of the displacement along x, then of that along y; or 36, with the terms of fourth and fifth "
            "degree. The displacement must stay below half a pitch over the detector, and its change per millimetre "
            "below 0.1. Lenses keep their size and shape."
        ),
        form=Form.NUMBERS,
        otherwise="a regular array",
        of_array=True,
    )
    mla_figure_error: _Numbers = Parameter(
        default=(0.0, 0.0),
        check=partial(require_numbers, count=2, minimum=0.0),
        words=(
            "Root mean square in millimetres of a random path that errors of the microlenses' surfaces add to light, "
            "and its correlation length in millimetres along the array; see "
            "`mitsuba_plenoptic.array.FigureError`."
        ),
        form=Form.PLACE,
        of_array=True,
    )
    mla_seed: Parameter[int, int] = Parameter(
        default=0,
        check=partial(require_count, minimum=0, maximum=2**32 - 1),
        words="Seed, up to 4294967295, that chooses one of all arrays with this `mla_jitter` and `mla_figure_error`.",
        form=Form.COUNT,
        of_array=True,
    )
    mla_cra: _Numbers = Parameter(
        default=(),
        check=partial(
            require_pairs,
            meaning="an image height and an angle in degrees",
            rising="heights",
            most=(math.inf, 80.0),
            start=0.0,
        ),
        words=(
            "Chief-ray angles to which the lenses are aligned: image heights in millimetres, rising from 0, each "
            "followed by an angle of incidence in degrees before the array, 0 first, with straight lines between and "
            "the last beyond. A lens at this height is shifted towards the axis as far as its chief ray moves on the "
            "way to the detector, be that a fraction of a pitch or several. If the tangent of the angle is "
            "proportional to the height, a smaller `mla_pitch` describes the same array."
        ),
        form=Form.NUMBERS,
        otherwise="no shift",
        of_array=True,
    )
    detector_blur: _Number = Parameter(
        default=0.0,
        check=partial(require_number, minimum=0, maximum=1),
        words=(
            "Standard deviation, at most 1, of a Gaussian blur of the irradiance on the detector, by a relay lens or "
            "the diffusion of charge in pixels. Light that would cross the edge of the recorded pixels stays."
        ),
        unit="mm",
    )
    pixel_crosstalk: _Number = Parameter(
        default=0.0,
        check=partial(require_number, minimum=0, maximum=0.25),
        words=(
            "Fraction, at most 0.25, of a pixel's light that each of its four neighbours receives, through the walls "
            "between photodiodes. No light is lost; across the edge of a capture as much returns as leaves."
        ),
    )
    stray_light: Parameter[Any, float | StrayLight] = Parameter(
        default=0.0,
        check=lambda _, value: known_stray_light(value),
        words=(
            "Light, at most 1, that lenses and walls scatter over the detector: every pixel records besides its own "
            "light this fraction of the mean light around, after `pixel_crosstalk`, of each channel. Or a table of "
            "fractions over the detector, see `StrayLight`: as a file, as JSON text or a JSON file of its parameter, "
            "in Python also as an array."
        ),
        form=Form.STRAY,
    )
    stray_width: Parameter[float | None, float | None] = Parameter(
        default=None,
        check=lambda name, value: None if value is None else require_length(name, value),
        words="Standard deviation of the Gaussian over which the mean of `stray_light` is taken.",
        otherwise="the mean over all recorded pixels",
        unit="mm",
    )
    pixel_response: _Numbers = Parameter(
        default=(),
        check=partial(require_pairs, meaning="an angle in degrees and a response", rising="angles", most=(90.0, 1.0)),
        words=(
            "Angular response of the pixels: angles of incidence in degrees, rising from 0, each followed "
            "by a response from 0 to 1, with straight lines between and the last beyond."
        ),
        form=Form.NUMBERS,
        otherwise="1 at all angles",
    )
    main_lens: Parameter[LensData | str | Path | dict[str, Any] | None, LensData | None] = Parameter(
        default=None,
        check=lambda _, value: known_lens(value),
        words=(
            "Surfaces and glasses of a real main lens: the name of a bundled lens (``cooke_triplet``, "
            "``double_gauss``, ``double_gauss_f2``, ``phone``, ``singlet``, ``tessar``), a YAML, JSON, Zemax or CODE "
            "V file, see `read_prescription`, or the text of a JSON file; in Python also a `Prescription`, or what "
            "`Prescription.from_plain` takes. Or a microscope's `Objective`, as such a file or text with "
            "``magnification`` and ``numerical_aperture``, or in Python as itself: the origin of the camera frame is "
            "then its native object plane, `focal_length` and `aperture_radius` are its own, and `mla_distance` is "
            "the focal length of the lens before the array. Or a telescope with a `Collimator`, as text or in Python "
            "as a dictionary with ``collimator_focal_length``: the array is then in the image of the pupil, which "
            "gives `mla_distance`."
        ),
        form=Form.LENS,
        otherwise="a thin lens",
    )
    glass: Parameter[_Glass | None, Glass | None] = Parameter(
        default=None,
        check=known_glass,
        words=(
            "Glass of the thin main lens: its name in a catalogue, an index, or the object, in a scene file its JSON "
            'text, that `Glass.from_plain` takes, such as ``{"index": 1.5168, "abbe": 64.2}``. `focal_length` is then '
            "that at 587.5618 nm (the line d), and other wavelengths have others, see `at_wavelength`."
        ),
        form=Form.GLASS,
        otherwise="the same focal length for all wavelengths",
    )
    mla_glass: Parameter[_Glass | None, Glass | None] = Parameter(
        default=None,
        check=known_glass,
        words="Glass of the microlenses, written like `glass`: `mla_focal_length` is then that at the line d.",
        form=Form.GLASS,
        otherwise="the same focal length for all wavelengths",
        of_array=True,
    )


if TYPE_CHECKING:

    class ShippedParameters:
        """The parameters that shipped extensions add."""

        photodiode_response: Parameter[Any, Any]

    @record
    class CameraParameters(CoreParameters, ShippedParameters):
        """The parameters of one camera, with their values."""

else:
    _added = {name: place(package, text) for package, name, text in entries("parameters")}
    CameraParameters = record(
        type("CameraParameters", (CoreParameters,), _added | {"__annotations__": dict.fromkeys(_added, Parameter)})
    )
    CameraParameters.__doc__ = "The whole table; an instance holds one camera's values, which `PlenopticCamera` checks."

PARAMETERS = {
    entry.name: entry for entry in (cast(Parameter, parameter.default) for parameter in fields(CameraParameters))
}
"""The entries of the table by the names of the constructor's arguments."""

FILE_READERS: dict[Form, Callable] = {
    Form.LENS: read_lens,
    Form.SHAPE: known_shape,
    Form.SCREEN: known_screen,
    Form.PICTURE: known_image,
    Form.LENSES: known_transmissions,
    Form.VIGNETTING: known_vignetting,
    Form.STRAY: known_stray_light,
}
"""Readers of values that are given as files or their texts.

They take the value and a function that finds a file by its name, for example in the folder of a scene.
"""
