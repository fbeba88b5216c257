"""Photodiodes under microlenses of 2 x 2 pixels: which cameras have them, and tables of their response by direction."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from ...errors import put, refuse_if, require_numbers, require_wavelength, short_repr
from ...runtime import Doubles, Numbers, PlainData, as_array, known_record

if TYPE_CHECKING:
    from ...camera import CameraGeometry

ACROSS = 2
"""Pixels across a lens."""

_EXACT = 0.01
"""Largest relative deviation of the pitch from two pixels: that of a pitch which follows the chief rays."""

_STEEPEST = 89.0
"""Largest angle in a table, in degrees."""


def require_pixel_pairs(camera: CameraGeometry) -> None:
    """Refuse a camera whose recorded pixels are not whole lenses of 2 x 2 pixels."""
    camera.require_array("photodiodes")
    refuse_if(
        not camera.lattice.regular.axis_aligned,
        f"mla_lattice = {camera.mla_lattice}, mla_rotation = {camera.mla_rotation:g}: lenses over photodiodes must be "
        "upright squares",
    )
    for pitch in camera.mla_pitches:
        refuse_if(
            not abs(pitch / (ACROSS * camera.pixel_size) - 1) <= _EXACT,
            f"mla_pitch = {pitch:g}: a lens over photodiodes must cover {ACROSS} x {ACROSS} pixels, "
            f"{ACROSS * camera.pixel_size:g}",
        )
    for axis, offset in enumerate(camera.mla_offset):
        border = camera.resolution[axis] / 2 + offset / camera.pixel_size - camera.crop_offset[axis]
        refuse_if(
            not abs(border / ACROSS - round(border / ACROSS)) <= _EXACT or camera.crop_size[axis] % ACROSS,
            f"resolution = {camera.resolution}, crop_offset = {camera.crop_offset}, crop_size = {camera.crop_size}, "
            f"mla_offset = {camera.mla_offset}: the recorded pixels must begin and end between two lenses",
        )


@dataclass(frozen=True, eq=False)
class PhotodiodeResponse(PlainData):
    """Response of the photodiodes under a lens to light by its direction before the lens; bilinear between angles.

    Parameters
    ----------
    angles_x, angles_y : sequence of float
        Angles in degrees, rising, two or more along each axis: the arc tangents of the slopes of the line from the
        lens towards the pupil, in air. Positive angles are towards +x (left as seen from behind the camera) and
        +y (up). The responses at the ends hold beyond them.
    responses : array (rows, columns[, wavelengths], angles_y, angles_x)
        Response, 0 or more, of each photodiode of a lens: 1 or 2 rows and columns, as they lie in a capture. With one
        row a photodiode has two pixels, which record a half each.
    wavelengths : sequence of float, optional
        Wavelengths in nanometres, rising. Between them responses are interpolated, and those at the ends hold beyond.
    """

    angles_x: Numbers
    angles_y: Numbers
    responses: Doubles
    wavelengths: Numbers = ()

    def __post_init__(self) -> None:
        for name in ("angles_x", "angles_y"):
            values = getattr(self, name)
            angles = require_numbers(name, values, count=len(values), minimum=-_STEEPEST, maximum=_STEEPEST)
            refuse_if(len(angles) < 2, f"{name} = {short_repr(values)}: there must be two or more")
            put(self, **{name: _rising(name, angles)})
        wavelengths = tuple(require_wavelength(wavelength, "wavelengths") for wavelength in self.wavelengths)
        put(self, wavelengths=_rising("wavelengths", wavelengths))
        shape = (None, None, *filter(None, (len(wavelengths), len(self.angles_y), len(self.angles_x))))
        table = as_array("responses", self.responses, shape=shape, least=0.0)
        refuse_if(
            not {*table.shape[:2]} <= {1, 2}, f"responses of shape {table.shape}: rows and columns must be 1 or 2"
        )
        put(self, responses=table)

    @cached_property
    def of_pixels(self) -> Doubles:
        """The responses of the 2 x 2 pixels, (2, 2, wavelengths, angles_y, angles_x)."""
        rows, columns = (ACROSS // count for count in self.responses.shape[:2])
        table = self.responses if self.wavelengths else self.responses[:, :, None]
        return np.repeat(np.repeat(table, rows, 0), columns, 1) / (rows * columns)


known_response = partial(known_record, PhotodiodeResponse)
"""Return a photodiode response from any of its forms; None means that the microlenses refract light."""


def _rising(name: str, values: Numbers) -> Numbers:
    refuse_if(any(a >= b for a, b in itertools.pairwise(values)), f"{name} = {short_repr(values)}: they must rise")
    return values
