"""Plain numbers of a plenoptic camera: their checks, their forms, and the few others that nearly everything uses.

What else follows from them is in `mitsuba_plenoptic.design`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .bounds import (
    FULL_TURN,
    LEAST_FILL,
    MOST_JITTER,
    MOST_SEED,
    MOST_STRETCH,
    STEEPEST_TILT,
    require_length,
    require_lengths,
    require_numbers,
    require_pixels,
    require_place,
    require_response,
    require_wavefront,
)
from .errors import InputError, require_choice, require_count, require_number, shown
from .given_lens import exit_pupil, known_glass, known_lens, nearest_array, own_numbers
from .lattice import APERTURES, LATTICES, Lattice, make_lattice
from .objective import Objective
from .prescription import Glass, Prescription
from .presets import PRESETS
from .thin_lens import conjugate_distance, defocus_factor, image_distance, vergence

LENS_MODELS = ("ideal", "parabolic")

LATER = {
    "mla_jitter",
    "mla_seed",
    "pixel_response",
    "mla_lattice",
    "mla_rotation",
    "mla_offset",
    "mla_tilt",
    "mla_aperture",
    "mla_fill",
    "distortion",
    "wavefront",
}
"""Parameters that files written before there were other lattices do not name."""

_OPTIONAL = {"focus_distance", "main_lens", "glass", "mla_glass"}
"""Parameters that `to_dict` may leave out."""

_SEVERAL = {"mla_focal_lengths": "mla_focal_length", "mla_pitches": "mla_pitch"}
"""Parameters of one number or several, by the fields that hold them as tuples."""


@dataclass(frozen=True, init=False, repr=False)
class PlenopticCamera:
    r"""A main lens, a microlens array behind it, and a detector behind that.

    Lengths are scene units, taken as millimetres. Without arguments this is the camera of the paper
    "Wave-Optical Reconstruction of Plenoptic Camera Images": 128 x 128 lenses of 32 x 32 pixels.

    Parameters
    ----------
    focal_length : float, optional
        Focal length :math:`f_1` of the main lens. Default 80, or that of the `main_lens`, which is scaled to what is
        given.
    aperture_radius : float, optional
        Radius :math:`D_1/2` of the main lens; of its entrance pupil if it is a `main_lens`, which is stopped
        down to it. Default 5, or the fully open `main_lens`.
    mla_distance : float, optional
        Distance :math:`b` from the main lens, from its rear principal plane if it is a `main_lens`, to the microlens
        array (MLA). Default 120 unless `focus_distance` is given.
    focus_distance : float, optional
        Distance of the object plane that is in focus on the MLA; an alternative to `mla_distance`,
        :math:`1/g + 1/b = 1/f_1`. May be infinite.
    mla_focal_length : float or three floats
        Focal length :math:`f_2` of a microlens. Three on a hexagonal lattice make a multi-focus array: interleaved,
        so that no two neighbours are alike, the first on the lens with the indices (0, 0).
    mla_pitch : float or two floats
        Pitch :math:`D_2` of the microlens lattice, the distance of neighbouring centres. Of two the first is that along
        the rows and the second that across them: the lattice is stretched, its cells with it.
    mla_lattice : {"square", "hexagonal"}
        Arrangement of the microlenses: see `mitsuba_plenoptic.lattice`.
    mla_rotation : float
        Angle of the lattice in degrees, counter-clockwise in the camera frame.
    mla_offset : (float, float)
        Place, x and y in the camera frame, of the point of the lattice that is on the axis by default.
    mla_tilt : (float, float)
        Angles in degrees by which the array rises towards the main lens along x and along y, up to 5. Pitches, rotation
        and offset are those of its projection along the axis, and each lens goes on facing the main lens.
    mla_aperture : {"cell", "circle"}
        What of its cell a lens fills: all of it, or a disc. What lies between is opaque.
    mla_fill : float
        Width of a lens's aperture over the pitch, at most 1; of a disc's over the shorter pitch.
    detector_distance : float, optional
        Distance :math:`z` from the MLA to the detector. Default: `mla_focal_length`, the first of three.
    detector_width : float
        Width :math:`W` of the full detector; pixels are square.
    resolution : (int, int)
        Columns and rows of the full detector.
    crop_offset : (int, int)
        Column and row of the first recorded pixel.
    crop_size : (int, int), optional
        Columns and rows that are recorded. Default: all from `crop_offset` on.
    lens_model : {"ideal", "parabolic"}
        How rays refract: stigmatic thin lenses (slopes), or thin parabolic phase elements (direction cosines).
    distortion : five floats
        Of the main lens: k1, k2, k3 (radial, in mm^-2, mm^-4, mm^-6) and p1, p2 (tangential, in mm^-1) of the map that
        takes the distortion away in the plane of the MLA; see `mitsuba_plenoptic.optics.distortion`.
    wavefront : floats
        Aberrations of the main lens: coefficients of Zernike polynomials over its pupil in Noll's order, beginning with
        piston, each in waves of 633 nm root mean square; up to 66, those left out are 0. Other wavelengths see the same
        path.
    main_lens : Prescription, Objective, str or dict, optional
        Surfaces and glasses of a real main lens: a prescription, the name of a bundled one, or what
        `Prescription.from_plain` takes. Or a microscope's objective, as such or as what `Objective.from_plain` takes:
        the origin of the camera frame is then its native object plane, `focal_length` and `aperture_radius` are its
        own, and `mla_distance` is the focal length of the lens before the array. Default: a thin lens.
    glass, mla_glass : Glass, str, float or dict, optional
        Of what the thin main lens and the microlenses are made, or what `Glass.from_plain` takes: `focal_length` and
        `mla_focal_length` are then those at 587.5618 nm (the line d), and other wavelengths have others, see
        `at_wavelength`. Default: the same for all wavelengths.
    mla_jitter : (float, float)
        Standard deviations of what is irregular in the array, for rays: of the lenses' places along x and along y, in
        millimetres and at most 0.1 of the pitch, and of their focal lengths, over these and at most 0.1; see
        `mitsuba_plenoptic.optics.irregular`. What decodes and refocuses knows the regular array.
    mla_seed : int
        Which of all such arrays it is, up to 4294967295.
    pixel_response : floats
        Angular response of the pixels, for rays: angles of incidence in degrees, rising from 0, each followed by a
        response from 0 to 1, with straight lines between and the last beyond. Default: 1 at all angles.

    Raises
    ------
    InputError
        If a length is not a number from 1e-9 to 1e9 (`focus_distance` may be infinite), a side of the detector is not
        from 1 to 1048576 pixels, one pitch is more than ten times the other, the crop window leaves the detector, a
        tilted array touches detector or main lens, the distortion folds the image, a `main_lens` is not one, cannot
        open so far, is given with aberrations, distortion or a glass, or reaches to the array, an objective has another
        focal length, aperture or distance to the array, or a glass is not one or has no index at the line d.
    """

    focal_length: float
    aperture_radius: float
    mla_distance: float
    mla_focal_lengths: tuple[float, ...]
    mla_pitches: tuple[float, float]
    mla_lattice: str
    mla_rotation: float
    mla_offset: tuple[float, float]
    mla_tilt: tuple[float, float]
    mla_aperture: str
    mla_fill: float
    detector_distance: float
    detector_width: float
    resolution: tuple[int, int]
    crop_offset: tuple[int, int]
    crop_size: tuple[int, int]
    lens_model: str
    distortion: tuple[float, float, float, float, float]
    wavefront: tuple[float, ...]
    main_lens: Prescription | Objective | None
    glass: Glass | None
    mla_glass: Glass | None
    mla_jitter: tuple[float, float]
    mla_seed: int
    pixel_response: tuple[float, ...]

    def __init__(
        self,
        *,
        focal_length: float | None = None,
        aperture_radius: float | None = None,
        mla_distance: float | None = None,
        focus_distance: float | None = None,
        mla_focal_length: float | Sequence[float] = 0.512,
        mla_pitch: float | Sequence[float] = 0.064,
        mla_lattice: str = "square",
        mla_rotation: float = 0.0,
        mla_offset: tuple[float, float] = (0.0, 0.0),
        mla_tilt: tuple[float, float] = (0.0, 0.0),
        mla_aperture: str = "cell",
        mla_fill: float = 1.0,
        detector_distance: float | None = None,
        detector_width: float = 8.192,
        resolution: tuple[int, int] = (4096, 4096),
        crop_offset: tuple[int, int] = (0, 0),
        crop_size: tuple[int, int] | None = None,
        lens_model: str = "ideal",
        distortion: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0),
        wavefront: Sequence[float] = (),
        main_lens: Prescription | Objective | str | dict[str, Any] | None = None,
        glass: Glass | str | float | dict[str, Any] | None = None,
        mla_glass: Glass | str | float | dict[str, Any] | None = None,
        mla_jitter: Sequence[float] = (0.0, 0.0),
        mla_seed: int = 0,
        pixel_response: Sequence[float] = (),
    ) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        put("main_lens", known_lens(main_lens))
        own = (80.0, 5.0) if self.main_lens is None else own_numbers(self.main_lens, focal_length)
        put("focal_length", require_length("focal_length", own[0] if focal_length is None else focal_length))
        put(
            "aperture_radius", require_length("aperture_radius", own[1] if aperture_radius is None else aperture_radius)
        )
        if mla_distance is not None and focus_distance is not None:
            raise InputError(
                f"mla_distance = {shown(mla_distance)} and focus_distance = {shown(focus_distance)}: "
                "give one of the two"
            )
        if focus_distance is not None:
            if self.objective is not None:
                raise InputError(
                    f"focus_distance = {shown(focus_distance)}: an objective is focused on its native object plane; "
                    "leave it out"
                )
            mla_distance = image_distance(
                self.focal_length, require_length("focus_distance", focus_distance, finite=False), name="focus_distance"
            )
        usual = 120.0 if self.objective is None else self.objective.last_focal_length
        put("mla_distance", require_length("mla_distance", usual if mla_distance is None else mla_distance))
        put("mla_lattice", require_choice("mla_lattice", mla_lattice, LATTICES))
        types = LATTICES[self.mla_lattice].lens_types
        several = ", ".join(name for name, each in LATTICES.items() if each.lens_types > 1)
        rule = f"one number or {types}" if types > 1 else f"one number; several need mla_lattice = {several}"
        put("mla_focal_lengths", require_lengths("mla_focal_length", mla_focal_length, {1, types}, rule))
        pitches = require_lengths("mla_pitch", mla_pitch, {1, 2}, "one number, or two, along the rows and across them")
        if max(pitches) > MOST_STRETCH * min(pitches):
            raise InputError(f"mla_pitch = {pitches}: neither may be more than {MOST_STRETCH:g} times the other")
        put("mla_pitches", (pitches[0], pitches[-1]))
        put("mla_rotation", require_number("mla_rotation", mla_rotation, minimum=-FULL_TURN, maximum=FULL_TURN))
        put("mla_offset", require_place("mla_offset", mla_offset))
        put("mla_tilt", require_numbers("mla_tilt", mla_tilt, 2, STEEPEST_TILT))
        put("mla_aperture", require_choice("mla_aperture", mla_aperture, APERTURES))
        fill = require_number("mla_fill", mla_fill, positive=True)
        put("mla_fill", require_number("mla_fill", fill, minimum=LEAST_FILL, maximum=1))
        if detector_distance is None:
            detector_distance = self.mla_focal_length
        put("detector_distance", require_length("detector_distance", detector_distance))
        put("detector_width", require_length("detector_width", detector_width))
        put("resolution", require_pixels("resolution", resolution, minimum=1))
        put("crop_offset", require_pixels("crop_offset", crop_offset, minimum=0))
        if crop_size is None:
            crop_size = (
                self.resolution[0] - self.crop_offset[0],
                self.resolution[1] - self.crop_offset[1],
            )
        put("crop_size", require_pixels("crop_size", crop_size, minimum=1))
        for axis in (0, 1):
            if self.crop_offset[axis] + self.crop_size[axis] > self.resolution[axis]:
                raise InputError(
                    f"crop_offset = {self.crop_offset} with crop_size = {self.crop_size}: the window must lie "
                    f"within the resolution {self.resolution}"
                )
        put("lens_model", require_choice("lens_model", lens_model, LENS_MODELS))
        put("distortion", require_numbers("distortion", distortion, 5, 1.0))
        put("wavefront", require_wavefront(wavefront))
        put("mla_jitter", require_numbers("mla_jitter", mla_jitter, 2, MOST_JITTER * max(1.0, *self.mla_pitches)))
        for value, most in zip(self.mla_jitter, (MOST_JITTER * min(self.mla_pitches), MOST_JITTER), strict=True):
            require_number("mla_jitter", value, minimum=0, maximum=most)
        put("mla_seed", require_count("mla_seed", mla_seed, minimum=0, maximum=MOST_SEED))
        put("pixel_response", require_response(pixel_response))
        put("glass", known_glass("glass", glass))
        put("mla_glass", known_glass("mla_glass", mla_glass))
        if self.main_lens is not None:
            self._require_main_lens(own[1])
        reach = np.hypot(*(np.abs(self.pixel_coordinates(axis)[[0, -1]]).max() for axis in (0, 1)))
        rise = reach * np.hypot(*np.tan(np.deg2rad(self.mla_tilt)))
        if rise >= min(self.detector_distance, self.mla_distance):
            raise InputError(f"mla_tilt = {self.mla_tilt}: the array rises by {rise:.3g}: it touches detector or lens")
        radius, (k1, k2, k3) = np.linspace(0, reach, 64) ** 2, self.distortion[:3]
        if np.min(1 + radius * (3 * k1 + radius * (5 * k2 + radius * 7 * k3))) <= 0:
            raise InputError(f"distortion = {self.distortion}: it folds the image within {reach:.3g} mm of the axis")

    def _require_main_lens(self, widest: float) -> None:
        """Refuse what a real main lens cannot be or be given with; `widest` is the radius to which it opens."""
        assert self.main_lens is not None
        for name in ("distortion", "wavefront"):
            if any(getattr(self, name)):
                raise InputError(f"{name} = {getattr(self, name)}: a main_lens brings its own; leave it out")
        if self.glass is not None:
            raise InputError(f"glass = {shown(self.glass.to_plain())}: a main_lens brings its own; leave it out")
        if isinstance(self.main_lens, Objective):
            self._require_objective(self.main_lens)
            return
        # What rounding to single precision adds is no wider stop.
        if self.aperture_radius > widest * (1 + 1e-6):
            raise InputError(f"aperture_radius = {self.aperture_radius:g}: the main_lens opens to {widest:.6g} at most")
        nearest = nearest_array(self.main_lens, self.focal_length)
        if self.mla_distance <= nearest:
            raise InputError(
                f"mla_distance = {self.mla_distance:g}: the array would stand within the main_lens or its exit pupil; "
                f"it must be more than {nearest:.4g}"
            )

    def _require_objective(self, objective: Objective) -> None:
        """Refuse numbers that are not those of the objective, and what a telecentric microscope cannot have."""
        own = {
            "focal_length": objective.focal_length,
            "aperture_radius": objective.stop_radius,
            "mla_distance": objective.last_focal_length,
        }
        for name, number in own.items():
            # Files and scenes may hold them in single precision.
            if not math.isclose(getattr(self, name), number, rel_tol=1e-6):
                raise InputError(
                    f"{name} = {getattr(self, name):g}: with this main_lens it is {number:.6g}; leave it out"
                )
            object.__setattr__(self, name, number)
        if any(self.mla_tilt):
            raise InputError(f"mla_tilt = {self.mla_tilt}: behind an objective it must be 0")

    # -- to and from other forms ---------------------------------------------------------------------

    @classmethod
    def preset(cls, name: str) -> PlenopticCamera:
        """Build a known camera: see `mitsuba_plenoptic.presets` for those there are and where their numbers are from.

        Parameters
        ----------
        name : {"paper", "lytro", "raytrix", "paper_double_gauss", "raytrix_double_gauss", "lfm", "lfm_water"}
            The camera.

        Raises
        ------
        InputError
            If there is none of that name; the message lists those there are.
        """
        if not isinstance(name, str) or name not in PRESETS:
            raise InputError(f"preset = {shown(name)}: it must be one of {', '.join(PRESETS)}")
        return cls(**PRESETS[name])

    @classmethod
    def from_sensor(cls, sensor: Any) -> PlenopticCamera:
        """Take the camera of a Mitsuba sensor of type ``plenoptic``.

        Parameters
        ----------
        sensor : mitsuba.Sensor
            A sensor of type ``plenoptic``.

        Raises
        ------
        InputError
            If the sensor is of another type.
        """
        camera = getattr(sensor, "camera", None)
        if not isinstance(camera, cls):
            found = getattr(sensor, "class_name", lambda: type(sensor).__name__)()
            raise InputError(f"sensor of type {found}: a plenoptic camera needs a sensor of type 'plenoptic'")
        return camera

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> PlenopticCamera:
        """Build a camera from what `to_dict` gave, for example from a file's header.

        Parameters
        ----------
        values : dict
            Parameters by name.

        Raises
        ------
        InputError
            If a name is unknown or missing, or a value is out of range.
        """
        if isinstance(values, dict):
            for name in sorted(set(cls().to_dict()) - set(values) - LATER):
                raise InputError(f"{name}: it is missing from the camera parameters")
        return cls._from_names(values)

    def to_dict(self) -> dict[str, Any]:
        """All parameters by name, in plain numbers, strings and tuples; lens and glasses as dictionaries of such."""
        values = {_SEVERAL.get(f.name, f.name): getattr(self, f.name) for f in fields(self)}
        for name in ("main_lens", "glass", "mla_glass"):
            value = values.pop(name)
            if value is not None:
                values[name] = value.to_plain()
        if len(self.mla_focal_lengths) == 1:
            values["mla_focal_length"] = self.mla_focal_length
        if self.lattice.aspect == 1:
            values["mla_pitch"] = self.mla_pitch
        return values

    @classmethod
    def from_json(cls, text: str) -> PlenopticCamera:
        """Build a camera from the text of a JSON file: an object of parameters; one that is left out has its default.

        What a calibration adds to them, under ``calibration``, is no part of the camera.

        Parameters
        ----------
        text : str
            The text of the file.

        Raises
        ------
        InputError
            If it is not such an object, a name is unknown, or a value is out of range.
        """
        try:
            values = json.loads(text)
        except (ValueError, TypeError, RecursionError) as error:
            raise InputError(f"camera: it must be a JSON object of camera parameters: {error}") from None
        if isinstance(values, dict):
            values.pop("calibration", None)
        return cls._from_names(values)

    def to_json(self) -> str:
        """Write all parameters as the text of a JSON file, for `from_json`."""
        return json.dumps(self.to_dict(), indent=1) + "\n"

    @classmethod
    def _from_names(cls, values: Any) -> PlenopticCamera:
        """Build a camera from parameters of unknown origin."""
        if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
            raise InputError(f"camera = {shown(values)}: it must be camera parameters by name")
        for name in sorted(set(values) - set(cls().to_dict()) - _OPTIONAL):
            raise InputError(f"{name}: it is not a camera parameter")
        return cls(**values)

    def to_sensor(self, to_world: Any = None) -> dict[str, Any]:
        """Describe the sensor plugin ``plenoptic`` of this camera for ``mi.load_dict``, film included.

        Parameters
        ----------
        to_world : mitsuba.ScalarTransform4f, optional
            Camera to world, without scale. Default: the camera is at the origin and looks along +z.

        Returns
        -------
        dict
            The film has one channel, of luminance, in single precision. `from_sensor` of what is loaded from it gives
            this camera.
        """
        values = self.to_dict()
        columns, rows = values.pop("resolution")
        (left, top), (width, height) = values.pop("crop_offset"), values.pop("crop_size")
        sensor: dict[str, Any] = {"type": "plenoptic"} | {
            name: json.dumps(value)
            if isinstance(value, dict)
            else ", ".join(map(repr, value))
            if isinstance(value, tuple)
            else value
            for name, value in values.items()
            if value != ()
        }
        if to_world is not None:
            sensor["to_world"] = to_world
        sensor["film"] = {
            "type": "hdrfilm",
            "width": columns,
            "height": rows,
            "crop_offset_x": left,
            "crop_offset_y": top,
            "crop_width": width,
            "crop_height": height,
            "rfilter": {"type": "box"},
            "pixel_format": "luminance",
            "component_format": "float32",
        }
        return sensor

    def to_xml(self) -> str:
        """Write the sensor plugin ``plenoptic`` of this camera, film included, as text for a scene file."""

        def element(tag: str, values: dict[str, Any], **attributes: str) -> ElementTree.Element:
            made = ElementTree.Element(tag, {"type": values["type"], **attributes})
            for name, value in values.items():
                if isinstance(value, dict):
                    made.append(element(name, value))
                elif name != "type":
                    kind = {int: "integer", float: "float", str: "string"}[type(value)]
                    ElementTree.SubElement(made, kind, name=name, value=str(value))
            return made

        tree = element("sensor", self.to_sensor(), id="camera")
        ElementTree.indent(tree, "    ")
        return ElementTree.tostring(tree, encoding="unicode") + "\n"

    def __repr__(self) -> str:
        return f"PlenopticCamera({', '.join(f'{name}={value!r}' for name, value in self.to_dict().items())})"

    def replace(self, **changes: Any) -> PlenopticCamera:
        """Return a copy of the camera with some parameters changed; what records all goes on recording all.

        Parameters
        ----------
        **changes
            Parameters by name.

        Raises
        ------
        InputError
            If a name is unknown or a value is out of range.
        """
        values = self.to_dict() | changes
        if "resolution" in changes and "crop_size" not in changes and not self.is_cropped:
            values.pop("crop_size")
        if "focus_distance" in changes and "mla_distance" not in changes:
            values.pop("mla_distance")
        return self._from_names(values)

    # -- colour --------------------------------------------------------------------------------------

    @property
    def is_dispersive(self) -> bool:
        """Whether rays of different wavelengths go different ways through it."""
        glasses = [self.glass, self.mla_glass]
        if self.prescription is not None:
            glasses += [surface.glass for surface in self.prescription.surfaces]
        return any(glass is not None and glass.form != "index" for glass in glasses)

    def at_wavelength(self, wavelength: float) -> PlenopticCamera:
        """Return the camera with its thin lenses as one wavelength meets them, and without their glasses.

        What stands where does not move: what is in focus does. A `main_lens` stays as it is, since it has indices of
        its own.

        Parameters
        ----------
        wavelength : float
            Wavelength in nanometres.

        Raises
        ------
        InputError
            If a glass has no index there.
        """
        if self.glass is None and self.mla_glass is None:
            return self
        values = self.to_dict()
        if self.glass is not None:
            values["focal_length"] = self.focal_length * self.glass.focal_ratio(wavelength)
        if self.mla_glass is not None:
            ratio = self.mla_glass.focal_ratio(wavelength)
            values["mla_focal_length"] = tuple(ratio * value for value in self.mla_focal_lengths)
        return self._from_names({name: value for name, value in values.items() if name not in ("glass", "mla_glass")})

    # -- main lens -----------------------------------------------------------------------------------

    @property
    def objective(self) -> Objective | None:
        """The main lens if it is a microscope's objective."""
        return self.main_lens if isinstance(self.main_lens, Objective) else None

    @property
    def prescription(self) -> Prescription | None:
        """The main lens if it has surfaces."""
        return self.main_lens if isinstance(self.main_lens, Prescription) else None

    @property
    def pupil_distance(self) -> float:
        """Distance from the exit pupil to the MLA: :math:`b` for a thin lens, which is its own pupil.

        That of the stop seen through the lens before the array is infinite behind an objective; this is then the focal
        length of that lens, by which places on the stop are divided to have directions at the array.
        """
        return self.mla_distance + exit_pupil(self.main_lens, self.focal_length)[0]

    @property
    def pupil_radius(self) -> float:
        """Radius of the exit pupil near the axis: :math:`D_1/2` for a thin lens."""
        return self.aperture_radius * exit_pupil(self.main_lens, self.focal_length)[1]

    @property
    def aperture_diameter(self) -> float:
        """Diameter :math:`D_1` of the main lens."""
        return 2 * self.aperture_radius

    @property
    def f_number(self) -> float:
        """Focal length of the main lens over its diameter."""
        return self.focal_length / self.aperture_diameter

    @property
    def focus_distance(self) -> float:
        """Distance of the object plane that is in focus on the MLA.

        Infinite if the MLA stands in the focal plane, negative (no real plane) if it stands before that. An
        objective's is its native object plane, at 0.
        """
        if isinstance(self.main_lens, Objective):
            return 0.0
        return conjugate_distance(self.focal_length, self.mla_distance)

    def defocus(self, distance: float) -> float:
        """Diameter of the cone from an on-axis point on the MLA over that on the main lens, with its sign.

        :math:`s = 1 + b/g - b/f_1`: zero in focus, positive for points nearer than that.

        Parameters
        ----------
        distance : float
            Object distance from the main lens in millimetres.

        Raises
        ------
        InputError
            If the main lens is an objective: its image is no such cone.
        """
        self.require_lens("defocus")
        return defocus_factor(distance, self.mla_distance, self.focal_length)

    def blur_diameter(self, distance: float) -> float:
        """Diameter on the MLA of the image of a point at `distance`, by rays: :math:`D_1 |s|`."""
        if isinstance(self.main_lens, Objective):
            return self.main_lens.blur_diameter(distance)
        if self.main_lens is not None:
            # The cone from the exit pupil to the image, which lies this far before the MLA.
            power = vergence(self.focal_length, distance)
            gap = self.mla_distance - (math.inf if power == 0 else 1 / power)
            return 2 * self.pupil_radius * (1.0 if math.isinf(gap) else abs(gap / (self.pupil_distance - gap)))
        return self.aperture_diameter * abs(self.defocus(distance))

    # -- detector and lattice ------------------------------------------------------------------------

    @property
    def lattice(self) -> Lattice:
        """The microlens lattice."""
        return make_lattice(
            self.mla_lattice,
            self.mla_pitches,
            rotation=self.mla_rotation,
            offset=self.mla_offset,
            aperture=self.mla_aperture,
            fill=self.mla_fill,
        )

    @property
    def lenses_like_bins(self) -> bool:
        """Whether each lens is an upright square as large as a bin, without gaps; it may lie between bins."""
        lattice = self.lattice
        return lattice.separable and lattice.fills and lattice.aspect == 1

    @property
    def lenses_are_bins(self) -> bool:
        """Whether there is a lens on each bin, which it fills."""
        return self.lenses_like_bins and self.mla_offset == (0, 0)

    @property
    def mla_pitch(self) -> float:
        """Pitch :math:`D_2` of the microlenses along their rows, and width of a bin of reconstructions."""
        return self.mla_pitches[0]

    @property
    def mla_focal_length(self) -> float:
        """Focal length :math:`f_2` of a microlens; where there are three, the first."""
        return self.mla_focal_lengths[0]

    @property
    def pixel_size(self) -> float:
        """Width of a pixel."""
        return self.detector_width / self.resolution[0]

    @property
    def pupil_step(self) -> float:
        """What a pixel covers of the pupil, seen through its lens's centre: its width times :math:`b / z`."""
        return self.pixel_size * self.pupil_distance / self.detector_distance

    @property
    def lit_radius(self) -> float:
        """Radius within which the pupil is seen by some of a pixel: half a pixel's width more than the pupil's own."""
        return self.pupil_radius + self.pupil_step / 2

    def pupil_shift(self, mla_focal_length: float) -> float:
        r"""How fast the place on the pupil, seen by a point of the detector, moves with that on the lens.

        :math:`\kappa = 1 + b/z - b/f_2`, which is 1 for :math:`z = f_2`; one less behind an objective, whose stop all
        lenses see in the same directions.
        """
        return (
            (self.objective is None)
            + self.pupil_distance / self.detector_distance
            - self.pupil_distance / mla_focal_length
        )

    @property
    def detector_height(self) -> float:
        """Height of the full detector."""
        return self.pixel_size * self.resolution[1]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the recorded image."""
        return self.crop_size[1], self.crop_size[0]

    def pixel_coordinates(self, axis: int) -> np.ndarray:
        """Coordinates of the recorded pixels' centres along x (axis 0) or y (axis 1)."""
        pixel = np.arange(self.crop_size[axis]) + self.crop_offset[axis] + 0.5
        return (pixel - self.resolution[axis] / 2) * self.pixel_size

    @property
    def is_cropped(self) -> bool:
        """Whether less than the full detector is recorded."""
        return self.crop_size != self.resolution

    @property
    def pixels_per_lens(self) -> float:
        """Microlens pitch in pixels, the shorter one if there are two; need not be a whole number."""
        return min(self.mla_pitches) / self.pixel_size

    def require_resolved(self) -> None:
        """Refuse a camera whose lenses are narrower than a pixel, for work that goes from lens to lens.

        Raises
        ------
        InputError
            If they are.
        """
        if self.pixels_per_lens < 1:
            raise InputError(
                f"mla_pitch = {min(self.mla_pitches):g}: it is less than a pixel of {self.pixel_size:g}, so that no "
                "micro-image is resolved"
            )

    def require_lens(self, what: str) -> None:
        """Refuse a camera behind an objective, for numbers that a lens at a finite distance has.

        Parameters
        ----------
        what : str
            The number, the beginning of a sentence.

        Raises
        ------
        InputError
            If it is one.
        """
        if self.objective is not None:
            raise InputError(
                f"main_lens = {self.objective.name}: {what} is not defined behind an objective; "
                "mitsuba_plenoptic.design tells native_field and resolution_limit"
            )

    def require_thin(self, what: str, instead: str = "capture by rays") -> None:
        """Refuse a camera with a real main lens, for work that knows thin ones only.

        Parameters
        ----------
        what : str
            The work, the beginning of a sentence.
        instead : str
            What can be done beside leaving the lens out.

        Raises
        ------
        InputError
            If it has one.
        """
        if self.main_lens is not None:
            raise InputError(
                f"main_lens = {self.main_lens.name or 'prescription'}: {what} for thin main lenses only; "
                f"leave main_lens out, or {instead}"
            )

    @property
    def bin_count(self) -> tuple[int, int]:
        """Bins across a reconstruction and down it: as many squares of one pitch as fit the detector.

        Rounded to even numbers: a corner of four bins lies on the axis, as one of four lenses of the default lattice
        does, so that bins and lenses line up there. On any other lattice the bins are the same. In the Fourier
        arrangement each lens sees the whole object: as many pixels as there are along a pitch.
        """
        if self.objective is not None and self.objective.is_fourier:
            return _even_count(self.mla_pitches[0], self.pixel_size), _even_count(self.mla_pitches[1], self.pixel_size)
        return _even_count(self.detector_width, self.mla_pitch), _even_count(self.detector_height, self.mla_pitch)

    @property
    def lens_count(self) -> tuple[int, int]:
        """Lenses in a row of the lattice across the full detector, and rows down it.

        A turned lattice has as many on the same area.
        """
        columns, rows = (_even_count(width, self.mla_pitch) for width in (self.detector_width, self.detector_height))
        if self.lattice.row_distance != self.mla_pitch:
            rows = max(1, round(self.detector_height / self.lattice.row_distance))
        return columns, rows

    @property
    def micro_image_diameter(self) -> float:
        """Diameter of the main lens's image under one microlens, :math:`D_1 z / b`."""
        return 2 * self.pupil_radius * self.detector_distance / self.pupil_distance

    @property
    def micro_image_pitch(self) -> float:
        """Distance of neighbouring micro-images of a row, :math:`D_2 (b + z) / b`; the pitch behind an objective."""
        if self.objective is not None:
            return self.mla_pitch
        return self.mla_pitch * (self.pupil_distance + self.detector_distance) / self.pupil_distance

    # -- object side ---------------------------------------------------------------------------------

    def bin_size(self, distance: float) -> float:
        """Width in the object plane of one bin of a reconstruction, :math:`D_2 g / b`.

        Behind an objective at all depths :math:`D_2 / M`, in the Fourier arrangement that of a pixel in the object.

        Parameters
        ----------
        distance : float
            Object distance from the main lens in millimetres.
        """
        if self.objective is not None and self.objective.is_fourier:
            return self.pixel_size / self.objective.view_scale(self.detector_distance)
        if self.objective is not None:
            return self.mla_pitch / self.objective.magnification
        return self.mla_pitch * distance / self.mla_distance


def _even_count(width: float, step: float) -> int:
    """Return how many steps fit a width, as the nearest even number."""
    return 2 * max(1, round(width / (2 * step)))
