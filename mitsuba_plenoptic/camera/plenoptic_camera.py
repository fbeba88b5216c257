"""The camera: what its parameters are, and its forms as a dictionary, as JSON and as a sensor."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ..bounds import require_numbers, require_response, require_wavefront
from ..errors import InputError, did_you_mean, require_choice, shown, suggest_keywords
from ..lens_data import LensData
from ..prescription import Glass
from ..presets import PRESETS
from .checks import array_numbers, detector_numbers, lens_numbers, require_whole
from .geometry import CameraGeometry
from .given_lens import known_glass, known_lens
from .sensor_form import describe, write_xml

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
class PlenopticCamera(CameraGeometry):
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
        takes the distortion away in the plane of the MLA; see `mitsuba_plenoptic.lenses.distortion`.
    wavefront : floats
        Aberrations of the main lens: coefficients of Zernike polynomials over its pupil in Noll's order, beginning with
        piston, each in waves of 633 nm root mean square; up to 66, those left out are 0. Other wavelengths see the same
        path.
    main_lens : Prescription, Objective, str, path or dict, optional
        Surfaces and glasses of a real main lens: a prescription, the name of a file or of a bundled one, see
        `read_prescription`, or what `Prescription.from_plain` takes. Or a microscope's objective, as such, as a file or
        as what `Objective.from_plain` takes: the origin of the camera frame is then its native object plane,
        `focal_length` and `aperture_radius` are its own, and `mla_distance` is the focal length of the lens before the
        array. Default: a thin lens.
    glass, mla_glass : Glass, str, float or dict, optional
        Of what the thin main lens and the microlenses are made, or what `Glass.from_plain` takes: `focal_length` and
        `mla_focal_length` are then those at 587.5618 nm (the line d), and other wavelengths have others, see
        `at_wavelength`. Default: the same for all wavelengths.
    mla_jitter : (float, float)
        Standard deviations of what is irregular in the array, for rays: of the lenses' places along x and along y, in
        millimetres and at most 0.1 of the pitch, and of their focal lengths, over these and at most 0.1; see
        `mitsuba_plenoptic.system.lens_kinds`. What decodes and refocuses knows the regular array.
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

    @suggest_keywords
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
        main_lens: LensData | str | Path | dict[str, Any] | None = None,
        glass: Glass | str | float | dict[str, Any] | None = None,
        mla_glass: Glass | str | float | dict[str, Any] | None = None,
        mla_jitter: Sequence[float] = (0.0, 0.0),
        mla_seed: int = 0,
        pixel_response: Sequence[float] = (),
    ) -> None:
        lens = known_lens(main_lens)
        distances = lens_numbers(lens, focal_length, aperture_radius, mla_distance, focus_distance)
        array = array_numbers(
            mla_lattice,
            mla_focal_length,
            mla_pitch,
            rotation=mla_rotation,
            offset=mla_offset,
            tilt=mla_tilt,
            aperture=mla_aperture,
            fill=mla_fill,
            jitter=mla_jitter,
            seed=mla_seed,
        )
        if detector_distance is None:
            detector_distance = array["mla_focal_lengths"][0]
        super().__init__(
            **distances,
            **array,
            **detector_numbers(detector_distance, detector_width, resolution, crop_offset, crop_size),
            lens_model=require_choice("lens_model", lens_model, LENS_MODELS),
            distortion=require_numbers("distortion", distortion, 5, 1.0),
            wavefront=require_wavefront(wavefront),
            main_lens=lens,
            glass=known_glass("glass", glass),
            mla_glass=known_glass("mla_glass", mla_glass),
            pixel_response=require_response(pixel_response),
        )
        require_whole(self)

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
        return cls(**PRESETS[require_choice("preset", name, PRESETS)])

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
        known = {*cls().to_dict(), *_OPTIONAL}
        for name in sorted(set(values) - known):
            raise InputError(f"{name}: it is not a camera parameter{did_you_mean(name, known)}")
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
        return describe(self.to_dict(), to_world)

    def to_xml(self) -> str:
        """Write the sensor plugin ``plenoptic`` of this camera, film included, as text for a scene file."""
        return write_xml(self.to_sensor())

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
        glasses = self.glass, self.mla_glass
        own = any(glass is not None and glass.form != "index" for glass in glasses)
        return own or self.lens_data.disperses

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


def require_camera(value: Any, name: str = "camera") -> PlenopticCamera:
    """Return a camera, or refuse what is none, such as the name of a preset."""
    if not isinstance(value, PlenopticCamera):
        raise InputError(f"{name} = {shown(value)}: it must be a PlenopticCamera")
    return value
