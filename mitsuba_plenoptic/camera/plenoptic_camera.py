"""The camera: its constructor, the checks of parameters in combination, and its forms as dictionary, JSON and sensor.

The table of parameters has the check of each single parameter.
"""

from __future__ import annotations

import functools
import json
import math
import weakref
from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, cast
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from ..array import LATTICES, NO_LATTICE, Displacement, focal_length_of, require_cover
from ..errors import (
    MOST_JITTER,
    MOST_WARP,
    MOST_WARP_SLOPE,
    NO_ARRAY,
    NO_RECORD,
    InputError,
    did_you_mean,
    naming,
    put,
    refuse_if,
    refusing,
    require_choice,
    require_number,
    short_repr,
    suggest_keywords,
    warn,
)
from ..extension import Displayed, missing
from ..prescription import SINGLE, THIN, LensData, image_distance
from ..presets import PRESETS
from ..runtime import Named
from .documentation import numpy_section, signature
from .entry import one_if_equal, record
from .geometry import NO_ARRAY_HERE, CameraGeometry
from .matched import MATCHED, behind_pupil, micrometres, require_enough
from .parameters import PARAMETERS


def checked_values(stated: Named) -> Named:
    """Return all parameters of a camera by attribute: given ones after their checks, otherwise defaults."""
    values: Named = {}
    lattice = PARAMETERS["mla_lattice"]
    has_array = lattice.check(lattice.name, stated.get(lattice.name, lattice.default)) != NO_LATTICE
    for name, entry in PARAMETERS.items():
        without = entry.of_array and not has_array
        value = stated.get(name, None if without else entry.default)
        if without and value is not None:
            raise InputError(f"{name} = {short_repr(value)}: {NO_ARRAY_HERE}; leave it out")
        missing = value is None and (without or entry.default is None)
        values[entry.attribute] = None if missing else entry.check(name, value)

    # The main lens, and the distance of the array from it.
    data = values["main_lens"] or THIN
    focus = values["focus_distance"]
    for name, length in zip(("focal_length", "aperture_radius"), data.own_numbers(values["focal_length"]), strict=True):
        if values[name] is None:
            values[name] = PARAMETERS[name].check(name, length)
    if focus is not None:
        if values["mla_distance"] is not None:
            raise InputError(
                f"mla_distance = {values['mla_distance']:g} and focus_distance = {focus:g}: give one of the two"
            )
        if data.focused_on:
            raise InputError(f"focus_distance = {focus:g}: {data.focused_on}; leave it out")
        conjugate = image_distance(values["focal_length"], focus, name="focus_distance")
        values["mla_distance"] = PARAMETERS["mla_distance"].check("mla_distance", conjugate)
    elif values["mla_distance"] is None:
        values["mla_distance"] = data.array_distance()
    values |= data.settled({name: values[name] for name in ("focal_length", "aperture_radius", "mla_distance")})
    # It is what follows from the others, whatever digits it was given with.
    values["focus_distance"] = data.focus_distance(values["focal_length"], values["mla_distance"])

    if has_array:
        values |= _settled_array(values)

    # The crop window, by default the part of the detector beyond its offset.
    resolution = values["resolution"]
    offset = values["crop_offset"]
    size = values["crop_size"]
    if size is None:
        remaining = tuple(count - first for count, first in zip(resolution, offset, strict=True))
        size = values["crop_size"] = PARAMETERS["crop_size"].check("crop_size", remaining)
    refuse_if(
        any(first + recorded > count for count, first, recorded in zip(resolution, offset, size, strict=True)),
        f"crop_offset = {offset} with crop_size = {size}: the window must lie within the resolution {resolution}",
    )
    return values


def _numbers_of_lens(stated: Named) -> frozenset[str]:
    """Return which of focal length, aperture and distance parameters give, `focus_distance` in place of a distance."""
    names = {
        PARAMETERS[name].instead_of or name
        for name, value in stated.items()
        if value is not None and name in PARAMETERS
    }
    return frozenset(names & {"focal_length", "aperture_radius", "mla_distance"})


def _settled_array(values: Named) -> Named:
    """Return a camera's focal lengths and detector distance of the microlenses; refuse a contradictory array."""
    focal_lengths = values["mla_focal_lengths"] or (0.512,)
    if values["mla_shape"] is not None:
        focal_length = focal_length_of(values["mla_shape"], values["mla_medium"], values["mla_focal_lengths"])
        focal_lengths = PARAMETERS["mla_focal_length"].check("mla_focal_length", focal_length)
        refuse_if(values["mla_glass"] is not None, "mla_glass: an mla_shape brings its own material; leave it out")
    types = LATTICES[values["mla_lattice"]].lens_types
    if len(focal_lengths) not in (1, types):
        of_types = ", ".join(name for name, lattice in LATTICES.items() if lattice.lens_types > 1)
        rule = f"one number or {types}" if types > 1 else f"one number; several need mla_lattice = {of_types}"
        raise InputError(f"mla_focal_length = {short_repr(focal_lengths)}: it must be {rule}")
    size, length = values["mla_figure_error"]
    refuse_if(
        size > 0 and length == 0, f"mla_figure_error = {(size, length)}: its correlation length must be greater than 0"
    )
    bounds = MOST_JITTER * min(values["mla_pitches"]), MOST_JITTER
    for value, most in zip(values["mla_jitter"], bounds, strict=True):
        require_number("mla_jitter", value, maximum=most)
    distance = focal_lengths[0] if values["detector_distance"] is None else values["detector_distance"]
    return {"mla_focal_lengths": focal_lengths, "detector_distance": distance}


def require_whole(camera: CameraGeometry) -> None:
    """Refuse parameters that are valid one by one but not in combination."""
    camera.lens_data.require_fit(camera)
    if camera.phase_screen is not None and camera.phase_screen.reach < camera.aperture_radius * (1 - SINGLE):
        raise InputError(
            f"phase_screen = {camera.phase_screen}: it covers pupils of a radius up to {camera.phase_screen.reach:.6g} "
            f"mm; the aperture_radius is {camera.aperture_radius:g}"
        )
    for entry in PARAMETERS.values():
        if entry.fit is not None and getattr(camera, entry.attribute) != entry.default:
            entry.fit(camera)
    reach = np.hypot(*(np.abs(camera.pixel_coordinates(axis)[[0, -1]]).max() for axis in (0, 1)))
    if camera.has_array:
        require_cover(camera.microlens, camera.lattice)
        require_small_warp(camera)
        rise = reach * np.hypot(*np.tan(np.deg2rad(camera.mla_tilt)))
        refuse_if(
            rise >= min(camera.detector_distance, camera.mla_distance),
            f"mla_tilt = {camera.mla_tilt}: the array rises by {rise:.3g}: it touches detector or lens",
        )
    radius = np.linspace(0, reach, 64) ** 2
    k1, k2, k3 = camera.distortion[:3]
    refuse_if(
        np.min(1 + radius * (3 * k1 + radius * (5 * k2 + radius * 7 * k3))) <= 0,
        f"distortion = {camera.distortion}: it folds the image within {reach:.3g} mm of the axis",
    )


def require_small_warp(camera: CameraGeometry) -> None:
    """Refuse a warp by half a pitch or more, or one that changes lenses' distances much, over the detector."""
    half = np.array([camera.detector_width, camera.detector_height]) / 2
    moved, slope = Displacement(warp=camera.mla_warp).most_smooth(-half, half)
    most = MOST_WARP * min(camera.mla_pitches)
    rule = f"mla_warp = {short_repr(camera.mla_warp)}: the displacement"
    refuse_if(
        not moved < most,
        f"{rule} is up to {moved:.3g} mm over the detector: it must be less than half a pitch, {most:g}",
    )
    refuse_if(
        not slope < MOST_WARP_SLOPE,
        f"{rule} changes by up to {slope:.3g} mm per mm over the detector: it must be less than {MOST_WARP_SLOPE:g}",
    )


@record
class PlenopticCamera(CameraGeometry, Displayed):
    r"""A main lens, a microlens array behind it, and a detector behind that.

    Lengths are scene units, taken as millimetres. Without arguments this is the camera of the paper
    "Wave-Optical Reconstruction of Plenoptic Camera Images": 128 x 128 lenses of 32 x 32 pixels.

    Parameters
    ----------
    TABLE

    Raises
    ------
    InputError
        If a length is not a number from 1e-9 to 1e9 (`focus_distance` may be infinite), a side of the detector is not
        from 1 to 1048576 pixels, one pitch is more than ten times the other, the crop window leaves the detector, a
        tilted array touches detector or main lens, or the distortion folds the image; if a `main_lens` is unknown,
        cannot open so far, comes with aberrations, distortion or a glass, or reaches the array; if an objective
        contradicts focal length, aperture or distance; if a glass is unknown or has no index at the line d; or if a
        camera without an array has a parameter of one, an objective or a collimator.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> camera = mp.PlenopticCamera(aperture_radius=4, focus_distance=300)
    >>> camera.f_number, round(camera.mla_distance, 2), camera.lens_count
    (10.0, 109.09, (128, 128))
    >>> mp.PlenopticCamera.from_json(camera.to_json()) == camera
    True
    """

    _given: ClassVar[frozenset[str]] = frozenset()
    """Those of focal length, aperture and distance that somebody gave: a new lens brings its own of the others."""

    if not TYPE_CHECKING:  # type checkers take the arguments and their types from the table

        def __init__(self, **given):
            put(self, **checked_values(given), _given=_numbers_of_lens(given))
            require_whole(self)

        __init__.__signature__ = signature()
        __init__ = suggest_keywords(
            __init__,
            absent=lambda name: (
                f"{name}: dataclasses.replace does not know which parameters were given; use camera.replace"
                if name in {entry.attribute for entry in PARAMETERS.values()}
                else missing("parameters", name)
            ),
        )
        # Python without docstrings has none.
        __doc__ = (__doc__ or "").replace("    TABLE\n", numpy_section())

    @classmethod
    def preset(cls, name: str) -> PlenopticCamera:
        """Return one of the known cameras; `presets` lists them with the sources of their numbers.

        Parameters
        ----------
        name : {"paper", "lytro", "raytrix", "paper_double_gauss", "raytrix_double_gauss", "lfm", "lfm_water", "flfm", \
            "flfm_oil", "telescope", "shack_hartmann", "full_frame_50mm", "phone", "full_frame_dual", "phone_quad", \
            "phone_quad_bayer"}
            The camera.
        """
        refuse_if(absent := missing("presets", str(name)), absent)
        return cls(**PRESETS[require_choice("preset", name, PRESETS)])

    @classmethod
    @functools.partial(suggest_keywords, others=PARAMETERS)
    def matched(
        cls,
        *,
        f_number: float | None = None,
        lenses: int | Sequence[int] | None = None,
        pixels_per_lens: float | None = None,
        pixel_size: float | None = None,
        sensor_size: float | Sequence[float] | None = None,
        **others: Any,
    ) -> PlenopticCamera:
        r"""Return the unfocused camera whose micro-images touch, from the numbers of a data sheet.

        Micro-images on the detector are `pixels_per_lens` pixels wide and as far apart. Required are `f_number`, the
        focal length of the main lens and its focus; `pixels_per_lens` or `mla_pitch`; and of the detector two of
        `resolution`, `pixel_size` and `sensor_size`, or `pixel_size` and `lenses`.

        Parameters
        ----------
        f_number : float
            Focal length of the main lens over the diameter of its aperture.
        lenses : int or (int, int)
            Lenses in a row across the detector, and rows down the detector; one number stands for both. The detector
            has the pixels that the lenses cover, rounded; rows of a hexagonal lattice are closer than the lenses in a
            row. Four lenses of a square lattice meet on the axis: odd counts leave half a lens at each edge.
        pixels_per_lens : float
            Pixels, 1 at least, from one micro-image to the next of its row.
        pixel_size : float
            Width of a pixel in millimetres.
        sensor_size : float or (float, float)
            Width and height of the detector in millimetres, of whole pixels; one number stands for both.
        **others
            `focal_length`, `focus_distance` or `mla_distance`, `resolution`, `mla_pitch`, and any parameters of a
            camera that do not follow from these, such as `mla_lattice`. With a `main_lens` the `focal_length` may be
            left out.

        Examples
        --------
        >>> import mitsuba_plenoptic as mp
        >>> sheet = {"f_number": 2.8, "lenses": 100, "pixels_per_lens": 10, "pixel_size": 0.005}
        >>> camera = mp.PlenopticCamera.matched(**sheet, focal_length=50, focus_distance=320)
        >>> camera.resolution, round(camera.micro_image_pitch, 12), round(camera.micro_image_diameter, 12)
        ((1000, 1000), 0.05, 0.05)
        """
        sheet: Named = {"f_number": f_number, "lenses": lenses, "pixels_per_lens": pixels_per_lens}
        sheet |= {"pixel_size": pixel_size, "sensor_size": sensor_size}
        sheet |= {name: others.get(name) for name in ("resolution", "mla_pitch")}
        require_enough(sheet | others)
        of_lens = ("main_lens", "focal_length", "focus_distance", "mla_distance")
        behind = cls(**{name: others[name] for name in of_lens if name in others})
        refuse_if(
            not behind.lens_data.converges,
            f"main_lens = {behind.lens_data.label}: f_number is that of thin lenses and prescriptions only",
        )
        number = require_number("f_number", sheet.pop("f_number"), minimum=1e-3, maximum=1e6)
        with naming(f"f_number = {number:g}"):
            behind = behind.replace(aperture_radius=behind.focal_length / (2 * number))
        kinds = cls(**{name: others[name] for name in ("mla_lattice", "mla_medium") if name in others})
        kinds.require_array("matched")
        lengths = behind_pupil(
            behind.pupil_distance, behind.pupil_radius, **sheet, lattice=kinds.mla_lattice, medium=kinds.mla_medium
        )
        if others.get("mla_shape") is not None:
            lengths.pop("mla_focal_length")  # a shape brings its own
        camera = cls(**others | {"aperture_radius": behind.aperture_radius} | lengths)
        for text in micrometres(camera):
            warn(text)
        return camera

    @classmethod
    def from_sensor(cls, sensor: Any) -> PlenopticCamera:
        """Return the camera of a Mitsuba sensor of type ``plenoptic``.

        Parameters
        ----------
        sensor : mitsuba.Sensor
            A sensor of type ``plenoptic``.
        """
        camera = getattr(sensor, "camera", None)
        if not isinstance(camera, cls):
            class_name = getattr(sensor, "class_name", lambda: type(sensor).__name__)()
            raise InputError(f"sensor of type {class_name}: a plenoptic camera needs a sensor of type 'plenoptic'")
        return camera

    @classmethod
    def from_dict(cls, values: Named) -> PlenopticCamera:
        """Return the camera that `to_dict` wrote as a dictionary, for example in a file's header.

        Parameters
        ----------
        values : dict
            Parameters by name.
        """
        if isinstance(values, dict):
            has_array = str(values.get("mla_lattice")) != NO_LATTICE
            for name, entry in sorted(PARAMETERS.items()):
                refuse_if(
                    entry.in_all_files and (has_array or not entry.of_array) and name not in values,
                    f"{name}: it is missing from the camera parameters",
                )
        return cls._from_names(values)

    def arguments(self) -> Named:
        """Return all parameters by name in the form that the camera stores and the constructor accepts."""
        return {name: getattr(self, entry.attribute) for name, entry in PARAMETERS.items() if not entry.instead_of}

    def to_dict(self) -> Named:
        """Return all parameters by name as plain Python values; lens and glasses are dictionaries."""
        plain = {name: PARAMETERS[name].plain(value) for name, value in self.arguments().items()}
        return {name: value for name, value in plain.items() if value is not None}

    @classmethod
    def from_json(cls, text: str) -> PlenopticCamera:
        """Return the camera of a JSON text, an object of parameters or of arguments of `matched`.

        Parameters that are left out have their defaults. What a calibration adds under ``calibration`` is ignored.

        Parameters
        ----------
        text : str
            The text of the file.
        """
        with refusing("camera: it must be a JSON object of camera parameters:", *NO_RECORD):
            values = json.loads(text)
        if isinstance(values, dict):
            values.pop("calibration", None)
        return cls._from_names(values)

    def to_json(self) -> str:
        """Write all parameters as the text of a JSON file, for `from_json`."""
        return json.dumps(self.to_dict(), indent=1) + "\n"

    @classmethod
    def _from_names(cls, values: Any) -> PlenopticCamera:
        """Return the camera of parameters, or arguments of `matched`, that come from a file or a user."""
        if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
            raise InputError(f"camera = {short_repr(values)}: it must be camera parameters by name")
        of_sheet = [name for name in MATCHED if name in values]
        # A single one of them is rather meant for a camera that has its other parameters.
        allowed = {*PARAMETERS, *MATCHED} if len(of_sheet) > 1 else PARAMETERS
        for name in sorted(set(values) - set(allowed)):
            raise InputError(
                missing("parameters", name) or f"{name}: it is not a camera parameter{did_you_mean(name, allowed)}"
            )
        if of_sheet:
            return cls.matched(**values)
        camera = cls(**values)
        # Files state all numbers: those that the camera has without them count as not given.
        of_lens = dict(zip(("focal_length", "aperture_radius"), camera.lens_data.own_numbers(None), strict=True))
        of_lens["mla_distance"] = camera.lens_data.array_distance()
        put(camera, _given=frozenset(name for name in camera._given if getattr(camera, name) != of_lens[name]))
        return camera

    def to_sensor(self, to_world: Any = None, pixel_format: str | None = None) -> Named:
        """Return the sensor plugin ``plenoptic`` of this camera for ``mi.load_dict``, film included.

        Parameters
        ----------
        to_world : mitsuba.ScalarTransform4f, optional
            Camera to world, without scale. Default: the camera is at the origin and looks along +z.
        pixel_format : {"luminance", "luminance_alpha", "rgb", "rgba", "xyz", "xyza"}, optional
            Channels of Mitsuba's ``hdrfilm``. Default: luminance in mono variants, rgb in others; where no variant is
            active yet, that of the variant in which the sensor is loaded.

        Returns
        -------
        dict
            The sensor, whose film is of single precision. When it is loaded, `from_sensor` returns this camera.
        """
        formats = ("luminance", "luminance_alpha", "rgb", "rgba", "xyz", "xyza")
        channels = (
            {} if pixel_format is None else {"pixel_format": require_choice("pixel_format", pixel_format, formats)}
        )
        if pixel_format is None and mi.variant() is not None:
            channels = {"pixel_format": "luminance" if mi.is_monochromatic else "rgb"}
        values = self.to_dict()
        columns, rows = values.pop("resolution")
        left, top = values.pop("crop_offset")
        width, height = values.pop("crop_size")
        sensor: Named = {"type": "plenoptic"}
        for name, value in values.items():
            # Lenses and glasses are JSON, several values have commas between them.
            if isinstance(value, dict):
                sensor[name] = json.dumps(value)
            elif value != ():
                sensor[name] = ", ".join(map(repr, value)) if isinstance(value, tuple) else value
        if to_world is not None:
            sensor["to_world"] = to_world
        crop = {"crop_offset_x": left, "crop_offset_y": top, "crop_width": width, "crop_height": height}
        sensor["film"] = {
            "type": "hdrfilm",
            "width": columns,
            "height": rows,
            # Of a full film a crop would remain where its size is changed later.
            **(crop if self.is_cropped else {}),
            "rfilter": {"type": "box"},
            **channels,
            "component_format": "float32",
        }
        return sensor

    def to_xml(self, to_world: Any = None, pixel_format: str | None = None) -> str:
        """Write the sensor plugin ``plenoptic`` of this camera, film included, as text for a scene file.

        Parameters
        ----------
        to_world, pixel_format
            As for `to_sensor`; `to_world` may also be an array (4, 4).
        """

        def element(tag: str, values: Named, **attributes: str) -> ElementTree.Element:
            node = ElementTree.Element(tag, {"type": values["type"], **attributes})
            for name, value in values.items():
                if isinstance(value, dict):
                    node.append(element(name, value))
                elif name != "type":
                    kind = {int: "integer", float: "float", str: "string"}[type(value)]
                    ElementTree.SubElement(node, kind, name=name, value=str(value))
            return node

        tree = element("sensor", self.to_sensor(pixel_format=pixel_format), id="camera")
        if to_world is not None:
            transform = ElementTree.Element("transform", name="to_world")
            with refusing(f"to_world = {short_repr(to_world)}: it must be a transform, 4 x 4 numbers", *NO_ARRAY):
                matrix = np.array(getattr(to_world, "matrix", to_world), np.float64).squeeze()
            refuse_if(matrix.shape != (4, 4), f"to_world of shape {matrix.shape}: it must be a transform, 4 x 4")
            # Scene files are read in single precision.
            finite = (np.abs(matrix) < np.finfo(np.float32).max).all()
            refuse_if(not finite, "to_world: its numbers must be finite")
            turn = matrix[:3, :3]
            rigid = np.allclose(turn.T @ turn, np.eye(3), atol=1e-3) and np.allclose(matrix[3], (0, 0, 0, 1))
            refuse_if(
                not rigid,
                "to_world: it must be a rotation and a translation, without scale; give lengths in scene units instead",
            )
            ElementTree.SubElement(transform, "matrix", value=" ".join(map(repr, matrix.ravel().tolist())))
            tree.insert(0, transform)
        ElementTree.indent(tree, "    ")
        return ElementTree.tostring(tree, encoding="unicode") + "\n"

    def __repr__(self) -> str:
        values = self.to_dict()
        for name in ("phase_screen", "aperture_image", "mla_transmissions", "vignetting", "stray_light"):
            # Samples are too many to be read.
            values |= {name: getattr(self, name)} if name in values else {}
        return f"PlenopticCamera({', '.join(f'{name}={value!r}' for name, value in values.items())})"

    def replace(self, **changes: Any) -> PlenopticCamera:
        """Return a copy of the camera with some parameters changed; an uncropped camera remains uncropped.

        Parameters
        ----------
        **changes
            Parameters by name. A new `main_lens` is scaled to the focal length. With a new `main_lens` or
            `focal_length`, `aperture_radius` follows again if nobody gave it, or if a lens of surfaces was fully open;
            so does what an objective or a collimator sets. Files and captures state all numbers: there a thin lens's
            5 mm counts as not given.
        """
        values = {name: value for name, value in self.arguments().items() if value is not None}
        if str(changes.get("mla_lattice")) == NO_LATTICE:
            values = {name: value for name, value in values.items() if not PARAMETERS[name].of_array}
        if changes.get("mla_shape", self.mla_shape) is not None:
            # It follows from the shape.
            values.pop("mla_focal_length", None)
        if "resolution" in changes and not self.is_cropped:
            values.pop("crop_size")
        if {"main_lens", "focal_length"} & {*changes}:
            if "main_lens" in changes:
                changes["main_lens"] = PARAMETERS["main_lens"].check("main_lens", changes["main_lens"])
            for name in self._following(changes.get("main_lens", self.main_lens) or THIN):
                values.pop(name, None)
        for name in changes:
            if name in PARAMETERS:
                values.pop(PARAMETERS[name].instead_of, None)
        camera = self._from_names(values | changes)
        unchanged = self._given & {*values} - {*changes}
        put(camera, _given=unchanged | _numbers_of_lens(changes))
        return camera

    def _following(self, lens: LensData) -> set[str]:
        """Return the names of numbers that follow from another main lens or focal length, and are not kept."""
        old, new = ({*data.sets, *(() if data.converges else ("mla_distance",))} for data in (self.lens_data, lens))
        widest = self.lens_data.own_numbers(self.focal_length)[1]
        if self.prescription is not None and math.isclose(self.aperture_radius, widest, rel_tol=SINGLE):
            old.add("aperture_radius")
        return old | ({"aperture_radius", *new} - self._given)

    @property
    def regular(self) -> PlenopticCamera:
        """The camera without `mla_cra` whose regular lenses are nearest to the shifted ones above recorded pixels.

        Reconstructions and fits, which know regular arrays only, use it. Its `mla_pitch` and `mla_offset`
        minimise the mean square distance from the lenses.
        """
        if not self.mla_cra:
            return self
        edges = (self.pixel_coordinates(axis)[[0, -1]] + 0.5 * self.pixel_size * np.array([-1, 1]) for axis in (0, 1))
        # Places across a crop at which shifts to chief rays are fitted.
        grid = np.stack(np.meshgrid(*(np.linspace(low, high, 33) for low, high in edges)))
        shifts = Displacement(chief_rays=self.mla_cra, distance=self.detector_distance, medium=self.mla_medium)
        shift = np.stack(shifts.smooth(*grid))
        middle = grid.mean((1, 2))
        moved = shift.mean((1, 2))
        about = grid - middle[:, None, None]
        stretch = 1 + (about * shift).sum() / (about**2).sum()
        return self.replace(
            mla_cra=(),
            mla_pitch=one_if_equal(tuple((stretch * np.array(self.mla_pitches)).tolist())),
            mla_offset=tuple((stretch * (np.array(self.mla_offset) - middle) + middle + moved).tolist()),
        )

    @property
    def is_dispersive(self) -> bool:
        """Whether paths of rays through the camera depend on the wavelength."""
        glasses = self.glass, self.mla_glass
        by_wavelength = any(glass is not None and glass.form != "index" for glass in glasses)
        shaped = self.mla_shape is not None and self.mla_shape.disperses
        return by_wavelength or shaped or self.lens_data.disperses

    def at_wavelength(self, wavelength: float) -> PlenopticCamera:
        """Return the camera with the focal lengths of its thin lenses at one wavelength, and without their glasses.

        Positions do not change, but the plane in focus does. A `main_lens` remains as it is: its glasses have indices
        of their own.

        Parameters
        ----------
        wavelength : float
            Wavelength in nanometres.
        """
        if self.glass is None and self.mla_glass is None:
            return self
        changes: Named = {"glass": None, "mla_glass": None}
        if self.glass is not None:
            changes["focal_length"] = self.focal_length * self.glass.focal_ratio(wavelength)
        if self.mla_glass is not None:
            ratio = self.mla_glass.focal_ratio(wavelength)
            changes["mla_focal_length"] = tuple(ratio * value for value in self.mla_focal_lengths)
        return self.replace(**changes)


def require_camera(value: Any, name: str = "camera") -> PlenopticCamera:
    """Return the value if it is a camera; refuse anything else, such as the name of a preset."""
    if not isinstance(value, PlenopticCamera):
        raise InputError(f"{name} = {short_repr(value)}: it must be a PlenopticCamera")
    return value


def film_numbers(film: Any) -> Named:
    """Return the parameters of a camera that its film states: resolution and crop, in pixels."""
    return {
        "resolution": tuple(film.size()),
        "crop_offset": tuple(film.crop_offset()),
        "crop_size": tuple(film.crop_size()),
    }


_F = TypeVar("_F", bound=Callable)

_results: weakref.WeakKeyDictionary[PlenopticCamera, tuple[Any, dict[str, dict]]] = weakref.WeakKeyDictionary()
_latest = deque[Any](maxlen=2)
"""Cameras that live on, with their results, for the next capture by them."""


def once_a_camera(function: _F) -> _F:
    """Cache a function's result by its positional arguments, at least for the lifetime of the camera; a decorator."""

    @functools.wraps(function)
    def known(camera: PlenopticCamera, *given: Any, **besides: Any) -> Any:
        equal_camera, results_of = _results.setdefault(camera, (weakref.ref(camera), {}))
        _latest.append(equal_camera())
        results = results_of.setdefault(function.__name__, {})
        if given not in results:
            # Results of a camera that are remembered by each function.
            if len(results) == 32:
                del results[next(iter(results))]
            results[given] = function(camera, *given, **besides)
        return results[given]

    return cast(_F, known)


def are_alike(first: PlenopticCamera, second: PlenopticCamera | None) -> bool:
    """Return whether two cameras are equal apart from `lens_model`, so that their pixels and views correspond."""
    return first == second or (second is not None and first == second.replace(lens_model=first.lens_model))
